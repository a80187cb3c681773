"""Maximize the composite index of a design space by gradients, from many starts at once; or any problem."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.workspace import WorkspaceIndices, workspace_indices
from pk_jax.design import ascent
from pk_jax.design.objective import (
    IndexBounds,
    composite_index,
    index_vector,
    require_bounds,
    require_weights,
)
from pk_jax.design.optimum import OptimizedDesign
from pk_jax.design.problem import DesignProblem
from pk_jax.design.search import optimize_problem
from pk_jax.design.variables import DesignSpace
from pk_jax.geometry.spread import evenly
from pk_jax.mechanisms.base import Mechanism
from pk_jax.status import Status

BLOCK = 8  # designs evaluated by one call of the compiled function
ROUGH_STILL = 1e-2  # projected gradient down to which the rough rule is followed
ACTIVE_BELOW = 1e-9  # slack of a constraint that holds with equality

Report = Callable[[str, int, int, float], None]  # what, steps done, steps allowed, best value


class History(NamedTuple):
    """One entry a step of the winning start; the first ones may come from a rougher rule, good to 1e-5."""

    vector: np.ndarray  # (steps, n) best design so far
    objective: np.ndarray  # (steps,)
    stationarity: np.ndarray  # (steps,) projected gradient in the unit box


class DesignResult(NamedTuple):
    """The best design found, and why it is one."""

    mechanism: Mechanism
    vector: np.ndarray  # (n,) the space's variables
    indices: WorkspaceIndices
    objective: float  # composite index with the weights asked for
    cpi: float  # composite index with weights (1, 1, 1)
    bounds: IndexBounds  # the normalization used
    active: tuple[str, ...]  # constraints that hold with equality
    multipliers: dict[str, float]  # of the active constraints, >= 0
    kkt: float  # greatest entry of grad(objective) + sum multiplier grad(slack)
    history: History
    evaluations: int  # of value and gradient, along the winning start, by any rule
    evaluations_in_all: int  # over all starts
    status: Status  # OK, STEP_LIMIT, or STALLED where the KKT residual stayed large


def optimize_design(
    space: DesignSpace | DesignProblem,
    weights: Any = None,
    *,
    bounds: Any = None,
    starts: Any = None,
    steps: int | None = None,
    tolerance: float | None = None,
    report: Report | None = None,
) -> DesignResult | OptimizedDesign:
    """The design of greatest composite index (Nam, Lee and Park 2006, eq. 28), or that of a `DesignProblem`.

    weights:    (3,) of GII, GRI, SUI, each >= 0, not all zero; default: all alike
    bounds:     normalization (lower (3,), upper (3,)); default: `index_bounds(space)`, frozen
    starts:     how many, spread evenly over the space; or design vectors (n,) or (k, n); default 12
    steps:      evaluations of value and gradient that each start may take; default 100
    tolerance:  of the projected gradient in the unit box; default 1e-7 (float32: 1e-3)
    report:     called after every step with (what, steps done, steps allowed, best value)

    A problem has neither weights nor bounds, and the other defaults of `optimize_problem`.
    """
    if isinstance(space, DesignProblem):
        return _optimize_problem(space, weights, bounds, starts, steps, tolerance, report)
    require_space(space, " or be a DesignProblem")
    starts, steps = 12 if starts is None else starts, 100 if steps is None else steps
    weights = require_weights((1, 1, 1) if weights is None else weights)
    require_options(space, starts, steps, tolerance, report)
    bounds = index_bounds(space, report=report) if bounds is None else require_bounds(bounds)
    slopes = weights / (bounds.upper - bounds.lower)
    found = maximize(space, slopes[None], starts=starts, steps=steps, tolerance=tolerance, report=report)[0]

    vector = jnp.asarray(found.vector)
    mechanism = space.mechanism(vector)
    indices = workspace_indices(mechanism)
    objective = composite_index(indices, bounds, weights)
    active, multipliers, kkt = _optimality(space, vector, slopes)
    limit = 100 * _tolerance(tolerance)
    status = Status.OK if kkt <= limit else Status.STALLED if found.is_done else Status.STEP_LIMIT
    shift = float(jnp.sum(weights * bounds.lower / (bounds.upper - bounds.lower)))
    return DesignResult(
        mechanism,
        found.vector,
        indices,
        float(objective),
        float(composite_index(indices, bounds)),
        bounds,
        active,
        multipliers,
        kkt,
        found.history._replace(objective=found.history.objective - shift),
        found.evaluations,
        found.evaluations_in_all,
        status,
    )


def require_space(space: Any, others: str = "") -> None:
    if not isinstance(space, DesignSpace):
        raise ValueError(f"space must come from design_space(...){others}, got {type(space).__name__}")


def require_options(space: DesignSpace, starts: Any, steps: Any, tolerance: Any, report: Any) -> None:
    """What is wrong is told before anything is computed."""
    checks.is_function("report", report)
    checks.is_count("steps", steps, most=100_000)
    _tolerance(tolerance)
    _start_boxes(space, starts)


def _optimize_problem(problem, weights, bounds, starts, steps, tolerance, report) -> OptimizedDesign:
    for name, value in (("weights", weights), ("bounds", bounds)):
        if value is not None:
            raise ValueError(f"{name} belong to the composite index: leave them out for a DesignProblem")
    given = {name: value for name, value in (("starts", starts), ("steps", steps)) if value is not None}
    return optimize_problem(problem, tolerance=tolerance, report=report, **given)


def index_bounds(space: DesignSpace, *, report: Report | None = None) -> IndexBounds:
    """Least and greatest GII, GRI and SUI over the space, found by the same ascent; cached."""
    checks.is_function("report", report)
    require_space(space)
    key = space.name, jnp.zeros(()).dtype.name
    if key not in _bounds:
        signs = jnp.concatenate([-jnp.eye(3), jnp.eye(3)])
        found = maximize(space, signs, report=report)
        extremes = jnp.array([f.history.objective[-1] for f in found])
        _bounds[key] = IndexBounds(-extremes[:3], extremes[3:])
    return _bounds[key]


_bounds: dict[tuple[str, str], IndexBounds] = {}


class Maximum(NamedTuple):
    """Where slopes @ (gii, gri, sui) is greatest."""

    vector: np.ndarray
    history: History
    evaluations: int
    evaluations_in_all: int
    is_done: bool


def maximize(
    space: DesignSpace,
    slopes: Any,
    *,
    starts: Any = 12,
    steps: int = 100,
    tolerance: float | None = None,
    report: Report | None = None,
) -> list[Maximum]:
    """Maximize slopes[i] @ (gii, gri, sui) for every row of slopes (k, 3), all in one batch."""
    slopes, boxes = np.asarray(slopes), _start_boxes(space, starts)
    count = len(boxes)
    size = 8 * (4 * boxes.shape[1] + 6) * steps * count * len(slopes)  # every step is kept
    checks.fits(f"{steps} steps of {count * len(slopes)} starts", size, "take fewer")
    trail = _climb(
        space, np.repeat(slopes, count, axis=0), np.tile(boxes, (len(slopes), 1)), steps, tolerance, report
    )

    answers = []
    final = trail[-1]
    evaluations = np.array([state.evaluations for state in trail])
    for i in range(len(slopes)):
        lanes = slice(i * count, (i + 1) * count)
        best = i * count + int(np.nanargmax(final.value[lanes]))
        own = [trail[row] for row in np.unique(evaluations[:, best], return_index=True)[1]]
        box = np.array([state.box[best] for state in own])
        gradient = np.array([state.gradient[best] for state in own])
        history = History(
            np.asarray(_from_boxes(space, box)),
            np.array([state.value[best] for state in own]),
            ascent.stationarity(box, gradient),
        )
        in_all = int(final.evaluations[lanes].sum())
        answers.append(Maximum(history.vector[-1], history, len(own), in_all, bool(final.is_done[best])))
    return answers


def _climb(space, slopes, boxes, steps, tolerance, report) -> list[ascent.Ascent]:
    """Ascend from boxes (lanes, n) with slopes (lanes, 3). -> the states after every step

    By the rough rule first, if the space has one; its values are moved by what the last of them is off.
    """
    tolerance = _tolerance(tolerance)
    states = jax.vmap(ascent.begin)(jnp.asarray(boxes))
    rough = []
    if space.rough is not None and steps > 1:
        still = max(tolerance, ROUGH_STILL)
        states, rough = _ascend(space, slopes, states, steps - 1, still, report, space.rough)
        values = _values(space, slopes, states.box, slice(None), None)
        off = values[0] - rough[-1].value
        rough = [state._replace(value=state.value + off) for state in rough]
        states = _restated(states, *values, tolerance)
        rough.append(jax.device_get(states._replace(memory=None)))
    return rough + _ascend(space, slopes, states, steps, tolerance, report, None)[1]


def _ascend(space, slopes, states, steps, tolerance, report, nodes):
    """Until all are done, or were evaluated so many times. -> the last states, and all of them"""
    trail = []
    value, gradient = np.zeros(len(slopes), slopes.dtype), np.zeros(states.box.shape, slopes.dtype)
    while True:
        is_running = np.asarray(~states.is_done & (states.evaluations < steps))
        if not is_running.any():  # those that are not are neither evaluated nor changed
            return states, trail
        found = _values(space, slopes, _propose(states), is_running, nodes)
        value[is_running], gradient[is_running] = found
        states = _judge(states, is_running, value, gradient, tolerance)
        trail.append(jax.device_get(states._replace(memory=None)))
        if report is not None:
            done = int(trail[-1].evaluations.max())
            report(space.name, done, steps, float(np.nanmax(trail[-1].value)))


def _values(space, slopes, boxes, chosen, nodes) -> tuple[np.ndarray, np.ndarray]:
    """slopes @ indices at the chosen l of the boxes, and its derivatives in the box. -> (l,), (l, n)"""
    vectors, chain = (np.asarray(part)[chosen] for part in _placed(space, boxes))
    indices, gradients = indices_and_slopes(space, vectors, nodes)
    slopes = slopes[chosen]
    return np.einsum("li,li->l", slopes, indices), np.einsum("li,lij,ljk->lk", slopes, gradients, chain)


_propose = jax.jit(jax.vmap(ascent.propose))


@functools.partial(jax.jit, static_argnums=4)
def _judge(states, is_running, value, gradient, tolerance):
    judged = jax.vmap(lambda *lane: ascent.judge(*lane, tolerance))(states, value, gradient)
    choose = jax.vmap(lambda own, new, old: jax.tree.map(lambda a, b: jnp.where(own, a, b), new, old))
    return choose(is_running, judged, states)


@functools.partial(jax.jit, static_argnums=3)
def _restated(states, value, gradient, tolerance):
    return jax.vmap(lambda *lane: ascent.restated(*lane, tolerance))(states, value, gradient)


@functools.partial(jax.jit, static_argnums=0)
def _placed(space, boxes):
    """Design vectors (lanes, n), and their derivatives in the box (lanes, n, n)."""
    return jax.vmap(space.from_box)(boxes), jax.vmap(jax.jacfwd(space.from_box))(boxes)


@functools.partial(jax.jit, static_argnums=0)
def _from_boxes(space, boxes):
    return jax.vmap(space.from_box)(boxes)


def indices_and_slopes(
    space: DesignSpace, vectors: Any, nodes: tuple[int, int] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(gii, gri, sui) of designs (k, n) and their Jacobians. -> (k, 3), (k, 3, n)

    Any number of designs goes through one compiled block, so that nothing compiles twice.
    """
    vectors = np.asarray(vectors)
    filled = np.concatenate([vectors, np.tile(vectors[-1], (-len(vectors) % BLOCK, 1))])
    blocks = filled.reshape(-1, BLOCK, vectors.shape[1])
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # a block keeps one core busy, no more
        parts = list(pool.map(lambda block: jax.device_get(_block(space, nodes, block)), blocks))
    indices, slopes = (np.concatenate(part)[: len(vectors)] for part in zip(*parts, strict=True))
    return indices, slopes


@functools.partial(jax.jit, static_argnums=(0, 1))
def _block(space, nodes, vectors):
    def twice(vector):
        indices = index_vector(workspace_indices(space.mechanism(vector), nodes=nodes))
        return indices, indices

    slopes, indices = jax.vmap(jax.jacfwd(twice, has_aux=True))(vectors)
    return indices, slopes


def _optimality(space: DesignSpace, vector: jax.Array, slopes: jax.Array):
    """Active constraints, their multipliers and the KKT residual, in the space's own variables."""
    gradient = np.asarray(slopes) @ indices_and_slopes(space, vector[None])[1][0]
    slack = {name: float(value) for name, value in space.constraints(vector).items()}
    slopes_of = jax.jacobian(space.constraints)(vector)
    active: list[str] = []
    for name, value in slack.items():
        normals = np.array([slopes_of[other] for other in (*active, name)])
        if value <= ACTIVE_BELOW and np.linalg.matrix_rank(normals, 1e-9) == len(normals):
            active.append(name)  # a constraint that follows from the ones before it is not counted
    best = np.zeros(0), (), np.max(np.abs(gradient))
    for count in range(1, len(active) + 1):
        for names in itertools.combinations(active, count):
            normals = np.array([slopes_of[name] for name in names])
            found = np.linalg.lstsq(normals.T, -gradient, rcond=None)[0]
            residual = np.max(np.abs(gradient + normals.T @ found))
            if np.all(found >= 0) and residual < best[2]:
                best = found, names, residual
    multipliers = dict.fromkeys(active, 0.0) | dict(zip(best[1], map(float, best[0]), strict=True))
    return tuple(active), multipliers, float(best[2])


def _start_boxes(space: DesignSpace, starts: Any) -> np.ndarray:
    """Starts in the unit box: so many, spread evenly inside it, or those of design vectors. -> (k, n)"""
    if isinstance(starts, int | np.integer):
        count = checks.is_count("starts", starts, most=10_000)
        inside = 0.02 + 0.96 * evenly(count, len(space.variables))
        return inside.astype(jnp.zeros(()).dtype)
    return np.asarray(jax.vmap(space.to_box)(jnp.atleast_2d(space.require("starts", starts))))


def _tolerance(tolerance: float | None) -> float:
    if tolerance is None:
        return 1e-7 if jnp.zeros(()).dtype == jnp.float64 else 1e-3
    if not (isinstance(tolerance, float | int) and 0 < tolerance < 1):
        raise ValueError(f"tolerance must be a number between 0 and 1, got {checks.shown(tolerance)}")
    return float(tolerance)
