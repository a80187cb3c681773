"""Pareto fronts: designs of which no objective can grow without another one falling."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.design.optimize import (
    Report,
    index_bounds,
    indices_and_slopes,
    maximize,
    require_options,
    require_space,
)
from pk_jax.design.problem import DesignProblem
from pk_jax.design.search import Search, advance, begin, must_fit, start_boxes
from pk_jax.design.variables import DesignSpace
from pk_jax.geometry.spread import evenly
from pk_jax.status import Status

OPTIMAL_WITHIN = 1e-5  # projected gradient in the unit box (float32: 0.1)
SAME_WITHIN = 1e-6  # of the range of an objective: such rows are one design


class ParetoFront(NamedTuple):
    """Designs that no other one dominates, in the order of their weights."""

    vectors: np.ndarray  # (f, n)
    indices: np.ndarray  # (f, 3) gii, gri, sui
    cpi: np.ndarray  # (f,) composite index with weights (1, 1, 1)
    weights: np.ndarray  # (f, 3) for which each is best
    status: Status  # OK, or STEP_LIMIT, STALLED where one of them is no optimum


class ParetoDesigns(NamedTuple):
    """The same of a `DesignProblem`."""

    vectors: np.ndarray  # (f, n)
    objectives: np.ndarray  # (f, k)
    weights: np.ndarray  # (f, k)
    status: Status  # OK; STEP_LIMIT, STALLED; UNREACHABLE, NONFINITE: of some weights no design was found


def pareto_front(objectives: Any, is_feasible: Any = None) -> np.ndarray:
    """Indices of the rows of objectives (k, m), all maximized, that no other row dominates. -> (f,) ascending

    is_feasible:  (k,) bool, rows that count; default: all. Rows with NaN never count. A row dominates
                  another where no entry is less and one is greater: of equal rows all are kept.
    """
    rows = checks.real_numpy("objectives", objectives)
    checks.has_shape("objectives", rows, (None, None))
    counts = np.ones(len(rows), bool) if is_feasible is None else np.asarray(is_feasible)
    if counts.shape != (len(rows),) or counts.dtype != bool:
        raise ValueError(f"is_feasible must be bools of shape ({len(rows)},), got {counts.shape}")
    candidates = np.flatnonzero(counts & ~np.isnan(rows).any(axis=1))
    among = rows[candidates]
    is_dominated = [np.any(np.all(among >= row, axis=1) & np.any(among > row, axis=1)) for row in among]
    return candidates[~np.array(is_dominated, bool)]


def pareto_designs(
    space: DesignSpace,
    weights: Any = 21,
    *,
    starts: Any = 4,
    steps: int = 60,
    tolerance: float | None = None,
    report: Report | None = None,
) -> ParetoFront:
    """Pareto front of GII, GRI and SUI: the composite index is maximized for many weights in one batch.

    weights:  (k, 3) each >= 0, no row all zero; or how many, spread over all directions
    others:   as for `optimize_design`

    Weighted sums find the part of the front that lies on its convex hull.
    """
    require_space(space)
    require_options(space, starts, steps, tolerance, report)
    weights = _weights(weights, 3)
    bounds = index_bounds(space, report=report)
    lower, ranges = np.asarray(bounds.lower), np.asarray(bounds.upper - bounds.lower)
    found = maximize(space, weights / ranges, starts=starts, steps=steps, tolerance=tolerance, report=report)
    vectors = np.array([maximum.vector for maximum in found])
    indices = indices_and_slopes(space, vectors)[0]
    front = _distinct((indices - lower) / ranges)
    ends = [found[i] for i in front]
    is_optimal = all(end.history.stationarity[-1] <= _optimal_within() * 10 for end in ends)
    stopped = Status.STALLED if all(end.is_done for end in ends) else Status.STEP_LIMIT
    return ParetoFront(
        vectors[front],
        indices[front],
        ((indices[front] - lower) / ranges).sum(axis=1),
        weights[front],
        Status.OK if is_optimal else stopped,
    )


def pareto_problem(
    problem: DesignProblem,
    weights: Any = 21,
    *,
    reference: Any = None,
    starts: Any = 4,
    steps: int = 200,
    tolerance: float | None = None,
    report: Report | None = None,
) -> ParetoDesigns:
    """Pareto front of a problem's objective (k,): of weights @ objective, for many weights in one batch.

    weights:    (w, k) each >= 0, no row all zero; or how many, spread over all directions
    reference:  (k,): maximize the least of weights * (objective - reference) instead, weights > 0
                (Chebyshev): that finds fronts which are not convex, too, beyond a point below all of them
    others:     as for `optimize_problem`
    """
    if not isinstance(problem, DesignProblem):
        raise ValueError(f"problem must be a DesignProblem, got {type(problem).__name__}")
    checks.is_function("report", report)
    weights = _weights(weights, problem.objective_count)
    steps = checks.is_count("steps", steps, most=100_000)
    if reference is not None:
        reference = checks.real_numpy("reference", reference)
        checks.has_shape("reference", reference, (problem.objective_count,))
        checks.is_finite("reference", reference)
        weights = weights[np.all(weights > 0, axis=1)]
        if not len(weights):
            raise ValueError("weights must be positive where a reference is given")
    starts = start_boxes(problem, starts)
    weighted = _Weighted(problem, reference)
    must_fit(weighted, len(weights) * len(starts))
    each = np.repeat(weights / weights.max(axis=1, keepdims=True), len(starts), axis=0)
    search = begin(
        weighted, np.concatenate([np.tile(starts, (len(weights), 1)), each], axis=1), tolerance=tolerance
    )
    for done in range(0, steps, 10):
        search = advance(weighted, search, min(10, steps - done))
        if report is not None:
            report(problem.name, min(done + 10, steps), steps, float(np.mean(search.is_done)))
        if search.is_done.all():
            break
    return _best_of_each(problem, search, weights)


def _best_of_each(problem: DesignProblem, search: Search, weights: np.ndarray) -> ParetoDesigns:
    fits = search.violation <= search.tolerance
    values = np.where(fits, search.value, -np.inf).reshape(len(weights), -1)
    best = values.argmax(axis=1) + np.arange(len(weights)) * values.shape[1]
    vectors = np.asarray(problem.vector(search.box[best][:, : len(problem.entries)]))
    objectives = np.array(_objectives(problem, jnp.asarray(vectors)))
    objectives[~fits[best]] = np.nan
    if not fits[best].any():
        is_finite = np.isfinite(search.value).any()
        status = Status.UNREACHABLE if is_finite else Status.NONFINITE
        return ParetoDesigns(vectors[:0], objectives[:0], weights[:0], status)
    scores = objectives / np.maximum(np.ptp(objectives[fits[best]], axis=0), 1e-300)
    front = _distinct(scores)
    if not fits[best].all():
        status = Status.UNREACHABLE
    elif search.is_solved[best[front]].all():
        status = Status.OK
    else:
        status = Status.STALLED if search.is_done[best[front]].all() else Status.STEP_LIMIT
    return ParetoDesigns(vectors[front], objectives[front], weights[front], status)


@functools.partial(jax.jit, static_argnums=0)
def _objectives(problem: DesignProblem, vectors: jax.Array) -> jax.Array:
    return jax.vmap(lambda vector: problem.measure(vector)[0])(vectors)


class _Weighted(DesignProblem):
    """One objective made of several; the weights are entries of the vector that nothing moves."""

    def __init__(self, problem: DesignProblem, reference: np.ndarray | None) -> None:
        count = problem.objective_count
        self.name, self.constraint_names = problem.name, problem.constraint_names
        self.of, self.reference = problem, reference
        self.entries = (*problem.entries, *(f"weights[{i}]" for i in range(count)))
        self.lower = np.append(problem.lower, np.zeros(count))
        self.upper = np.append(problem.upper, np.ones(count))
        self.objective_count = 1 if reference is None else count

    def measure(self, vector: jax.Array) -> tuple[jax.Array, jax.Array]:
        own = len(self.of.entries)
        weights = jax.lax.stop_gradient(vector[own:])
        objective, slacks = self.of.measure(vector[:own])
        if self.reference is None:
            return (weights @ objective)[None], slacks
        return weights * (objective - self.reference), slacks


def _distinct(scores: np.ndarray) -> np.ndarray:
    """The non-dominated rows of objectives that range over about 1, of rows that agree the first."""
    front, kept = pareto_front(scores), []
    for i in front:
        if all(np.max(np.abs(scores[i] - scores[j])) > SAME_WITHIN for j in kept):
            kept.append(i)
    return np.array(kept, int)


def _weights(weights: Any, count: int) -> np.ndarray:
    """Rows of weights (w, count), each >= 0; so many are spread: first each objective alone."""
    if isinstance(weights, bool | int | np.integer | float):
        wanted = checks.is_count("weights", weights, most=10_000)
        gaps = np.diff(np.sort(evenly(wanted, count - 1), axis=1), prepend=0, append=1, axis=1)
        gaps[:count] = np.eye(count)[:wanted]
        return gaps
    rows = checks.real_numpy("weights", weights)
    checks.has_shape("weights", rows, (None, count))
    checks.is_finite("weights", rows)
    if len(rows) == 0 or np.any(rows < 0) or np.any(np.all(rows == 0, axis=1)):
        raise ValueError("weights must be >= 0, no row all zero, at least one row")
    return rows


def _optimal_within() -> float:
    return OPTIMAL_WITHIN if jnp.zeros(()).dtype == jnp.float64 else 1e4 * OPTIMAL_WITHIN
