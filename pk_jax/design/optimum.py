"""What a search found: the best start's end, its multipliers, and how optimal it is."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.design import ascent, lagrangian
from pk_jax.design.problem import DesignProblem
from pk_jax.mechanisms.base import Mechanism
from pk_jax.status import Status

ACTIVE_WITHIN = 10.0  # tolerances: what is nearer to its limit than that holds with equality
OPTIMAL_WITHIN = 100.0  # tolerances of the projected gradient


class OptimizedDesign(NamedTuple):
    """The best design of all starts, and why it is one."""

    mechanism: Mechanism
    vector: np.ndarray  # (n,)
    variables: dict[str, np.ndarray]
    value: float  # least entry of the objective; NaN where no design is feasible
    objective: np.ndarray  # (k,)
    constraints: dict[str, float]  # slacks by name
    active: tuple[str, ...]  # bounds ("proximal = 0.3") and constraints that hold with equality
    multipliers: dict[
        str, float
    ]  # of those, >= 0: d value / d limit; of several objectives, their shares too
    kkt: float  # greatest entry of the projected gradient of the Lagrangian, in the unit box
    violation: float  # greatest -slack, at least 0
    values: np.ndarray  # (starts,) least objective where each start ended, NaN where it is infeasible
    vectors: np.ndarray  # (starts, n) where each start ended
    evaluations: int  # of value and gradient, all starts
    status: (
        Status  # OK; STEP_LIMIT, STALLED: not optimal; UNREACHABLE: none feasible; NONFINITE: no number met
    )


def optimum(problem: DesignProblem, search: Any) -> OptimizedDesign:
    """Judge the best of all starts of a `Search` afresh."""
    fits = search.violation <= search.tolerance
    values = np.where(fits, search.value, np.nan)
    best = _best(search, values)
    tolerance = float(search.tolerance[best])
    box = np.asarray(search.box[best])
    (objective, slacks), slopes = jax.device_get(_fresh(problem, jnp.asarray(box)))
    violation = float(np.max(-slacks, initial=0))
    active, multipliers, kkt = _optimality(
        problem, box, objective, slacks, slopes, tolerance, float(search.scale[best])
    )
    if not np.isfinite(search.value).any():
        status = Status.NONFINITE
    elif not fits.any():
        status = Status.UNREACHABLE
    elif kkt <= OPTIMAL_WITHIN * tolerance * search.scale[best] and violation <= 2 * tolerance:
        status = Status.OK
    else:
        status = Status.STALLED if search.is_done[best] else Status.STEP_LIMIT
    vector = np.asarray(problem.vector(box))
    design = problem.design if fits.any() else jax.jit(problem.design)  # traced, it refuses no geometry
    return OptimizedDesign(
        mechanism=design(jnp.asarray(vector)),
        vector=vector,
        variables=problem.variables_of(vector),
        value=float(objective.min()) if fits.any() else np.nan,
        objective=objective,
        constraints=dict(zip(problem.constraint_names, map(float, slacks), strict=True)),
        active=active,
        multipliers=multipliers,
        kkt=kkt,
        violation=violation,
        values=values,
        vectors=np.asarray(problem.vector(search.box)),
        evaluations=int(search.evaluations.sum()),
        status=status,
    )


@functools.partial(jax.jit, static_argnums=0)
def _fresh(problem: DesignProblem, box: jax.Array) -> Any:
    """Objective and slacks, and their derivatives in the unit box."""

    def twice(box):
        found = problem.measure(problem.vector(box))
        return found, found

    slopes, found = jax.jacfwd(twice, has_aux=True)(box)
    return found, slopes


def _best(search: Any, values: np.ndarray) -> int:
    """The start of greatest value; of those that agree with it, one that is solved. Or the least violated."""
    if np.all(np.isnan(values)):
        return int(np.argmin(search.violation))
    top = np.nanargmax(values)
    agrees = values >= values[top] - ACTIVE_WITHIN * search.tolerance * search.scale
    solved = agrees & search.is_solved
    return int(np.nanargmax(np.where(solved, values, np.nan)) if solved.any() else top)


def _optimality(problem, box, objective, slacks, slopes, tolerance, scale):
    """Active limits, their multipliers and the projected gradient of the Lagrangian."""
    near = ACTIVE_WITHIN * tolerance
    least = np.flatnonzero(objective <= objective.min() + near * scale)
    tight = np.flatnonzero(slacks <= near)
    bounds = [(i, side) for i in range(len(box)) for side in (0, 1) if box[i] == side]
    of_least, of_tight = slopes[0][least], slopes[1][tight]
    if not (len(least) and np.all(np.isfinite(of_least)) and np.all(np.isfinite(of_tight))):
        return (), {}, np.nan
    inwards = np.zeros((len(bounds), len(box)))  # gradients of the bounds' slacks
    for row, (i, side) in enumerate(bounds):
        inwards[row, i] = -1 if side else 1
    shares, of_limits = _balance(of_least, np.concatenate([of_tight, inwards]))
    gradient = shares @ of_least + of_limits[: len(tight)] @ of_tight

    sizes = np.append(np.ones(len(tight)), [(problem.upper - problem.lower)[i] for i, _ in bounds])
    vector = np.asarray(problem.vector(box))
    active = (
        *(problem.constraint_names[j] for j in tight),
        *(f"{problem.entries[i]} = {vector[i]:.6g}" for i, _ in bounds),
    )
    multipliers = dict(zip(active, map(float, of_limits / sizes), strict=True))
    if len(objective) > 1:
        multipliers |= {f"objective[{i}]": float(share) for i, share in zip(least, shares, strict=True)}
    return active, multipliers, float(ascent.stationarity(box, gradient))


def _balance(objectives: np.ndarray, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers >= 0 of gradients (k, n), (p, n), sum nearest to 0; those of the first add up to 1."""
    if len(objectives) == 1:
        return np.ones(1), lagrangian.least_squares(limits.T, -objectives[0])
    rows = np.concatenate([objectives, limits])
    heavy = 1e4 * (np.abs(objectives).max() or 1)  # weight of the equation that says so
    total = np.where(np.arange(len(rows)) < len(objectives), heavy, 0)
    found = lagrangian.least_squares(np.vstack([rows.T, total]), np.append(np.zeros(rows.shape[1]), heavy))
    return np.split(found / found[: len(objectives)].sum(), [len(objectives)])
