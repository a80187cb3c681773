"""Optimize the design of any mechanism: many starts at once, bounds by projection, limits by multipliers.

    search = begin(problem, start_boxes(problem, 64))
    while not search.is_done.all():
        search = advance(problem, search, 10)  # save it here: it resumes bit for bit
    found = summary(problem, search)

Each start runs by itself: its answer depends neither on how many others there are, nor on the devices, nor on
where a run was interrupted. `optimize_problem` is that loop.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from pk_jax import checks
from pk_jax.design.climb import Search, lane_at, step
from pk_jax.design.optimum import OptimizedDesign, optimum
from pk_jax.design.problem import DesignProblem
from pk_jax.geometry.spread import evenly

BLOCK = 16  # starts that a device advances together
Report = Callable[[str, int, int, float], None]  # what, steps done, steps allowed, best value


def begin(problem: DesignProblem, boxes: Any, *, tolerance: float | None = None) -> Search:
    """The state before the first evaluation. boxes (starts, n) in the unit box.

    tolerance:  of projected gradient (objective over its scale), gap and violation; default 1e-8
                (float32: 1e-3)
    """
    _require_problem(problem)
    dtype = jnp.zeros(()).dtype
    boxes = np.asarray(checks.real_numpy("boxes", boxes), dtype)
    checks.has_shape("boxes", boxes, (None, len(problem.entries)))
    if len(boxes) == 0 or not np.all((boxes >= 0) & (boxes <= 1)):
        raise ValueError("boxes must be at least one point with entries within [0, 1]")
    must_fit(problem, len(boxes))
    tolerance = _tolerance(tolerance)
    return jax.device_get(_begin(problem, boxes, jnp.full(len(boxes), tolerance, dtype)))


@functools.partial(jax.jit, static_argnums=0)
def _begin(problem: DesignProblem, boxes: jax.Array, tolerances: jax.Array) -> Search:
    return jax.vmap(functools.partial(lane_at, problem))(boxes, tolerances)


def must_fit(problem: DesignProblem, starts: int) -> None:
    """ValueError where the state of so many starts does not fit into memory."""
    like = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.zeros(()).dtype)
    one = jax.eval_shape(functools.partial(_begin, problem), like(1, len(problem.entries)), like(1))
    size = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(one))
    checks.fits(f"{starts} starts of {problem.name}", checks.ROOM * size * starts, "take fewer, or in parts")


def advance(
    problem: DesignProblem, search: Search, steps: int, *, devices: Sequence[Any] | None = None
) -> Search:
    """`steps` evaluations of value and gradient for every start that is not done; those stay as they are.

    devices:  blocks of starts are spread over them; default: one. Of several processes, every one calls
              with the same `search` and all devices, and gets the whole answer.
    """
    steps = checks.is_count("steps", steps, most=100_000)
    devices = checks.are_devices("devices", devices)
    processes = {device.process_index for device in devices}
    if jax.process_index() not in processes:
        raise ValueError("devices must hold at least one of this process")
    search = jax.tree.map(np.asarray, search)
    firsts = range(0, len(search.box), BLOCK)
    owners = [devices[block % len(devices)] for block in range(len(firsts))]

    def block(first, device):
        part = jax.tree.map(lambda leaf: leaf[first : first + BLOCK], search)
        if part.is_done.all() or device.process_index != jax.process_index():
            return part
        count = len(part.box)
        filled = jax.device_put(_filled(part), device)
        return jax.tree.map(
            lambda leaf: leaf[:count], jax.device_get(_run(problem, filled, jnp.int32(steps)))
        )

    with ThreadPoolExecutor(len(devices)) as pool:
        parts = list(pool.map(block, firsts, owners))
    search = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    if processes == {jax.process_index()}:
        return search
    return _gathered(search, np.repeat([device.process_index for device in owners], BLOCK)[: len(search.box)])


def _gathered(search: Search, owners: np.ndarray) -> Search:
    """Every start from the process that owns it."""
    everyone = multihost_utils.process_allgather(search)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[owners, np.arange(len(owners))], everyone)


def _filled(part: Search) -> Search:
    """A whole block: the lanes that were missing are done."""
    missing = BLOCK - len(part.box)
    last = lambda leaf: np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)])
    return jax.tree.map(last, part)._replace(is_done=np.append(part.is_done, np.ones(missing, bool)))


@functools.partial(jax.jit, static_argnums=0)
def _run(problem: DesignProblem, block: Search, steps: jax.Array) -> Search:
    """The number of steps is data, and every block has one shape: one program, and no bit depends on them.

    Sharded over a mesh, XLA compiles another program, which rounds differently.
    """

    def one(lane, steps):
        goes_on = lambda carry: (carry[0] < steps) & ~carry[1].is_done
        go_on = lambda carry: (carry[0] + 1, step(problem, carry[1]))
        return jax.lax.while_loop(goes_on, go_on, (0, lane))[1]

    return jax.vmap(one, in_axes=(0, None))(block, steps)


def summary(problem: DesignProblem, search: Search) -> OptimizedDesign:
    """The best start's end, its multipliers and how well it satisfies the conditions of optimality."""
    _require_problem(problem)
    return optimum(problem, jax.device_get(search))


def optimize_problem(
    problem: DesignProblem,
    *,
    starts: Any = 16,
    steps: int = 200,
    tolerance: float | None = None,
    seed: int = 0,
    chunk: int = 10,
    report: Report | None = None,
    devices: Sequence[Any] | None = None,
) -> OptimizedDesign:
    """The design whose least objective is greatest, from many starts.

    starts:     how many, spread evenly over the bounds; or vectors (n,) or (k, n)
    steps:      evaluations of value and gradient that each start may take
    tolerance:  see `begin`
    seed:       shifts the spread; 0 leaves it
    chunk:      steps between two calls of report(what, steps done, steps allowed, best value)
    devices:    see `advance`
    """
    _require_problem(problem)
    checks.is_function("report", report)
    steps = checks.is_count("steps", steps, most=100_000)
    chunk = checks.is_count("chunk", chunk, most=100_000)
    search = begin(problem, start_boxes(problem, starts, seed=seed), tolerance=tolerance)
    for done in range(0, steps, chunk):
        search = advance(problem, search, min(chunk, steps - done), devices=devices)
        if report is not None:
            fits = search.violation <= search.tolerance
            best = float(np.max(search.value[fits], initial=-np.inf)) if fits.any() else np.nan
            report(problem.name, min(done + chunk, steps), steps, best)
        if search.is_done.all():
            break
    return summary(problem, search)


def start_boxes(problem: DesignProblem, starts: Any, *, seed: int = 0) -> np.ndarray:
    """Starts in the unit box: so many, spread evenly and shifted by the seed, or of vectors. -> (k, n)"""
    dtype = jnp.zeros(()).dtype
    seed = checks.is_count("seed", seed, least=0, most=2**32 - 1)
    if isinstance(starts, bool | int | np.integer | float):
        count = checks.is_count("starts", starts, most=100_000)
        shift = np.random.default_rng(seed).uniform(size=len(problem.entries)) if seed else 0
        return (0.02 + 0.96 * ((evenly(count, len(problem.entries)) + shift) % 1)).astype(dtype)
    vectors = np.atleast_2d(checks.real_numpy("starts", starts))
    checks.has_shape("starts", vectors, (None, len(problem.entries)))
    checks.is_finite("starts", vectors)
    outside = (vectors < problem.lower) | (vectors > problem.upper)
    if outside.any():
        row, entry = np.argwhere(outside)[0]
        raise ValueError(
            f"starts must lie within the bounds, {problem.entries[entry]} in [{problem.lower[entry]:.6g}, "
            f"{problem.upper[entry]:.6g}], got {vectors[row, entry]:.6g}"
        )
    return np.clip(np.asarray(problem.box(vectors)), 0, 1).astype(dtype)


def arrays_of(search: Search) -> dict[str, np.ndarray]:
    """The arrays of a search by name ("ascent.memory.params"), for a file."""
    leaves = jax.tree_util.tree_flatten_with_path(search)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in leaves}


def search_of(problem: DesignProblem, arrays: dict[str, np.ndarray]) -> Search:
    """The search that `arrays_of` took apart. ValueError where the arrays are not those of this problem."""
    count = len(arrays["is_done"]) if "is_done" in arrays and arrays["is_done"].ndim == 1 else 0
    like = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.zeros(()).dtype)
    wanted = jax.eval_shape(
        functools.partial(_begin, problem), like(count, len(problem.entries)), like(count)
    )
    names = list(
        arrays_of(jax.tree.map(lambda leaf: np.broadcast_to(np.zeros((), leaf.dtype), leaf.shape), wanted))
    )
    for name, leaf in zip(names, jax.tree.leaves(wanted), strict=True):
        found = arrays.get(name)
        if found is None or found.shape != leaf.shape or found.dtype != leaf.dtype:
            got = "nothing" if found is None else f"{found.dtype} {found.shape}"
            raise ValueError(f"search array {name} must be {leaf.dtype} {leaf.shape}, got {got}")
    return jax.tree.unflatten(jax.tree.structure(wanted), [np.asarray(arrays[name]) for name in names])


def _require_problem(problem: Any) -> None:
    if not isinstance(problem, DesignProblem):
        raise ValueError(f"problem must be a DesignProblem, got {type(problem).__name__}")


def _tolerance(tolerance: float | None) -> float:
    if tolerance is None:
        return 1e-8 if jnp.zeros(()).dtype == jnp.float64 else 1e-3
    if not (checks.is_number(tolerance) and 0 < tolerance < 1):
        raise ValueError(f"tolerance must be a number between 0 and 1, got {checks.shown(tolerance)}")
    return float(tolerance)
