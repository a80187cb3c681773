"""Maximize the composite index of a design space by gradients, from many starts at once."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
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
from pk_jax.design.variables import DesignSpace
from pk_jax.mechanisms.base import Mechanism
from pk_jax.status import Status

STEPS_AT_ONCE = 5  # of a jitted chunk; the host reports in between
LANES = 8  # starts of a jitted block
COARSE = (10, 10)  # Gauss nodes while many starts search
ACTIVE_BELOW = 1e-9  # slack of a constraint that holds with equality

Report = Callable[[str, int, int, float], None]  # what, steps done, steps allowed, best value


class History(NamedTuple):
    """One entry a step of the winning start's last ascent."""

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
    evaluations: int  # of value and gradient, along the winning start
    evaluations_in_all: int  # over all starts, coarse ones included
    status: Status  # OK, STEP_LIMIT, or STALLED where the KKT residual stayed large


def optimize_design(
    space: DesignSpace,
    weights: Any = (1, 1, 1),
    *,
    bounds: Any = None,
    starts: Any = 12,
    steps: int = 100,
    tolerance: float | None = None,
    report: Report | None = None,
) -> DesignResult:
    """The design of greatest composite index (Nam, Lee and Park 2006, eq. 28).

    weights:    (3,) of GII, GRI, SUI, each >= 0, not all zero
    bounds:     normalization (lower (3,), upper (3,)); default: `index_bounds(space)`, frozen
    starts:     how many starts, spread evenly over the space and searched with a coarse rule
                before the best is refined; or design vectors (n,), (k, n), refined all
    steps:      evaluations of value and gradient that each start may take
    tolerance:  of the projected gradient in the unit box; default 1e-7 (float32: 1e-3)
    report:     called between chunks of steps with (what, steps done, steps allowed, best value)
    """
    if not isinstance(space, DesignSpace):
        raise ValueError(f"space must come from design_space(...), got {type(space).__name__}")
    weights = require_weights(weights)
    bounds = index_bounds(space) if bounds is None else require_bounds(bounds)
    checks.is_count("steps", steps, most=100_000)
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


def index_bounds(space: DesignSpace, *, report: Report | None = None) -> IndexBounds:
    """Least and greatest GII, GRI and SUI over the space, found by the same ascent; cached."""
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
    slopes: jax.Array,
    *,
    starts: Any = 12,
    steps: int = 100,
    tolerance: float | None = None,
    report: Report | None = None,
) -> list[Maximum]:
    """Maximize slopes[i] @ (gii, gri, sui) for every row of slopes (k, 3), all in one batch."""
    tolerance = _tolerance(tolerance)
    slopes = np.asarray(slopes)
    size = len(space.variables)
    if isinstance(starts, int | np.integer):
        count = checks.is_count("starts", starts, most=10_000)
        boxes = np.broadcast_to(_even(count, size), (len(slopes), count, size))
        searched = _climb(space, COARSE, slopes, boxes, steps, 1e-4, report, "searching")[-1]
        spent = searched.evaluations.sum(axis=1)
        best = np.nanargmax(searched.value, axis=1)
        boxes = np.take_along_axis(searched.box, best[:, None, None], axis=1)
    else:
        vectors = jnp.atleast_2d(space.require("starts", starts))
        boxes = np.asarray(jax.vmap(space.to_box)(vectors))
        boxes = np.broadcast_to(boxes, (len(slopes), *boxes.shape))
        spent = np.zeros(len(slopes), int)

    trail = _climb(space, None, slopes, boxes, steps, tolerance, report, "refining")
    answers = []
    for i, j in enumerate(np.nanargmax(trail[-1].value, axis=1)):
        own = int(trail[-1].evaluations[i, j])
        path = [jax.tree.map(lambda x, i=i, j=j: x[i, j], state) for state in trail[:own]]
        box, gradient = np.array([p.box for p in path]), np.array([p.gradient for p in path])
        vectors = np.asarray(jax.vmap(space.from_box)(jnp.asarray(box)))
        history = History(vectors, np.array([p.value for p in path]), ascent.stationarity(box, gradient))
        in_all = int(spent[i] + trail[-1].evaluations[i].sum())
        answers.append(Maximum(vectors[-1], history, own, in_all, bool(trail[-1].is_done[i, j])))
    return answers


def _climb(space, nodes, slopes, boxes, steps, tolerance, report, what) -> list[ascent.Ascent]:
    """Ascend from boxes (k, s, n) with slopes (k, 3). -> the states (k, s) after every step, NumPy

    Lanes go through one compiled block at a time, so that any number of them compiles once.
    """
    lanes = boxes.shape[0] * boxes.shape[1]
    fill = -lanes % LANES
    flat_boxes = np.concatenate([boxes.reshape(lanes, -1), np.tile(boxes[-1, -1], (fill, 1))])
    flat_slopes = np.repeat(slopes, boxes.shape[1], axis=0)
    flat_slopes = np.concatenate([flat_slopes, np.tile(slopes[-1], (fill, 1))])
    blocks = [slice(i, i + LANES) for i in range(0, lanes + fill, LANES)]
    states = [jax.vmap(ascent.begin)(jnp.asarray(flat_boxes[block])) for block in blocks]
    trail = []
    for done in range(0, steps, STEPS_AT_ONCE):
        parts = []
        for i, block in enumerate(blocks):
            states[i], part = _chunk(space, nodes, tolerance, jnp.asarray(flat_slopes[block]), states[i])
            parts.append(jax.device_get(part))
        whole = jax.tree.map(
            lambda *x: np.concatenate(x, 1)[:, :lanes].reshape(STEPS_AT_ONCE, *boxes.shape[:2], *x[0].shape[2:]),
            *parts,
        )
        trail += [jax.tree.map(lambda x, step=step: x[step], whole) for step in range(STEPS_AT_ONCE)]
        if report is not None:
            report(f"{space.name}: {what}", done + STEPS_AT_ONCE, steps, float(np.nanmax(trail[-1].value)))
        if trail[-1].is_done.all():
            break
    return trail[:steps]


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _chunk(space, nodes, tolerance, slopes, states):
    def evaluator(slope):
        return jax.value_and_grad(lambda box: slope @ _values(space, nodes)(space.from_box(box)))

    step = jax.vmap(lambda slope, state: ascent.advance(evaluator(slope), tolerance, state))

    def scanned(states, _):
        states = step(slopes, states)
        return states, states._replace(memory=None)

    return jax.lax.scan(scanned, states, length=STEPS_AT_ONCE)


@functools.lru_cache
def _values(space: DesignSpace, nodes: tuple[int, int] | None):
    """vector -> (gii, gri, sui)"""
    return lambda vector: index_vector(workspace_indices(space.mechanism(vector), nodes=nodes))


@functools.partial(jax.jit, static_argnums=0)
def _values_and_slopes(space: DesignSpace, vector: jax.Array):
    """(gii, gri, sui) of a design, and their Jacobian (3, n)."""
    return _values(space, None)(vector), jax.jacfwd(_values(space, None))(vector)


def _optimality(space: DesignSpace, vector: jax.Array, slopes: jax.Array):
    """Active constraints, their multipliers and the KKT residual, in the space's own variables."""
    gradient = np.asarray(slopes @ _values_and_slopes(space, vector)[1])
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


def _even(count: int, dimension: int) -> np.ndarray:
    """Starts spread evenly inside the unit box, the same every time (an additive sequence). (count, n)"""
    root = 2.0
    for _ in range(30):
        root = (1 + root) ** (1 / (dimension + 1))
    steps = root ** -np.arange(1.0, dimension + 1)
    return (0.02 + 0.96 * ((0.5 + np.arange(count)[:, None] * steps) % 1)).astype(jnp.zeros(()).dtype)


def _tolerance(tolerance: float | None) -> float:
    if tolerance is None:
        return 1e-7 if jnp.zeros(()).dtype == jnp.float64 else 1e-3
    if not (isinstance(tolerance, float | int) and 0 < tolerance < 1):
        raise ValueError(f"tolerance must be a number between 0 and 1, got {tolerance!r}")
    return float(tolerance)
