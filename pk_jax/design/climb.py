"""One start of a search: it climbs an augmented Lagrangian, whose multipliers are renewed where it is still.

`step` is one evaluation of objective and slacks and of their derivatives. From these comes a model of the
Lagrangian in which all limits are linear; the way to its top is the direction that is searched next.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from pk_jax.design import ascent, lagrangian, quasi_newton
from pk_jax.design.lagrangian import Multipliers
from pk_jax.design.problem import DesignProblem

FIRST_PENALTY, MOST_PENALTY = 10.0, 1e7
FIRST_STILL = 1e-2  # projected gradient at which the multipliers are renewed first
GAP_SHARE = 0.25  # of the gap that may remain after a round; otherwise the penalty grows
MOST_ROUNDS = 40  # renewals of the multipliers
MOST_A_ROUND = 50  # evaluations before they are renewed anyway


class Search(NamedTuple):
    """All starts, batch first. Arrays only: `arrays_of` names them for a file."""

    ascent: ascent.Ascent  # of the augmented Lagrangian
    objective: jax.Array  # (k,) at ascent.box
    slacks: jax.Array  # (p,) there
    multipliers: Multipliers  # their estimate, of the objective over its scale
    shares: Multipliers  # those that the gradient at ascent.box is made with
    penalty: jax.Array  # ()
    still: jax.Array  # () projected gradient at which the multipliers are renewed
    gap: jax.Array  # () of complementarity at the last renewal
    rounds: jax.Array  # () renewals
    since: jax.Array  # () evaluations at the last of them
    scale: jax.Array  # () of the objective: the greatest entry of its gradient at the start
    tolerance: jax.Array  # () of projected gradient, gap and violation
    box: jax.Array  # (n,) best so far: the feasible before the infeasible, then the greater value
    value: jax.Array  # () least objective there; NaN where nothing finite was met
    violation: jax.Array  # () there: greatest -c_j, at least 0
    evaluations: jax.Array  # () of value and gradient
    is_solved: jax.Array  # () bool, the conditions of optimality hold at `box`
    is_done: jax.Array  # () bool


def lane_at(problem: DesignProblem, box: jax.Array, tolerance: jax.Array) -> Search:
    """One start before its first evaluation."""
    count, slacks = problem.objective_count, len(problem.constraint_names)
    is_plain = count == 1 and not slacks
    number = lambda value: jnp.full((), value, box.dtype)
    none, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    return Search(
        ascent=ascent.begin(box)._replace(memory=quasi_newton.blank(box)),
        objective=jnp.full(count, jnp.nan, box.dtype),
        slacks=jnp.full(slacks, jnp.nan, box.dtype),
        multipliers=lagrangian.no_knowledge(count, slacks, box.dtype),
        shares=lagrangian.no_knowledge(count, slacks, box.dtype),
        penalty=number(FIRST_PENALTY),
        still=tolerance if is_plain else jnp.maximum(tolerance, FIRST_STILL),
        gap=number(jnp.inf),
        rounds=none,
        since=none,
        scale=number(1),
        tolerance=tolerance,
        box=box,
        value=number(jnp.nan),
        violation=number(jnp.inf),
        evaluations=none,
        is_solved=no,
        is_done=no,
    )


def step(problem: DesignProblem, lane: Search) -> Search:
    """One evaluation: keep the trial where it is best, accept it or cut the step, renew the multipliers."""
    trial = ascent.propose(lane.ascent)
    objective, slacks, slopes = _linearized(problem, trial)
    is_first = lane.evaluations == 0
    lane = lane._replace(
        scale=jnp.where(is_first, _scale(objective, slopes), lane.scale), evaluations=lane.evaluations + 1
    )
    lane = _with_best(lane, trial, objective, slacks)
    slopes = slopes._replace(objective=slopes.objective / lane.scale)

    here = _lagrangian(lane, objective, slacks, slopes)
    is_accepted = quasi_newton.rises(lane.ascent, trial, here.value, here.gradient)
    moved = lane._replace(
        ascent=_moved(lane, trial, here, slopes), objective=objective, slacks=slacks, shares=here.multipliers
    )
    refused = lane._replace(ascent=ascent.shortened(lane.ascent, here.value))
    lane = jax.tree.map(lambda a, b: jnp.where(is_accepted, a, b), moved, refused)

    is_still = ascent.stationarity(lane.ascent.box, lane.ascent.gradient) <= lane.still
    is_long = (lane.evaluations - lane.since >= MOST_A_ROUND) & (not _is_plain(lane))
    is_stuck = lane.ascent.cuts > ascent.MOST_CUTS
    ends = is_stuck | (is_accepted & (is_still | is_long))
    lane = jax.tree.map(lambda a, b: jnp.where(ends, a, b), _renewed(lane, is_stuck), lane)

    lane = jax.tree.map(lambda a, b: jnp.where(is_accepted, a, b), _aimed(lane, slopes), lane)
    return lane._replace(is_done=lane.is_done | (is_first & ~is_accepted))


def _aimed(lane: Search, slopes: Multipliers) -> Search:
    """A new direction from where the lane is: to the top of the model, all limits linearized."""
    here = _lagrangian(lane, lane.objective, lane.slacks, slopes)  # as it is with the new multipliers
    state = lane.ascent._replace(value=here.value, gradient=here.gradient)
    start = state.box

    def model(box):
        step = box - start
        objective = lane.objective + lane.scale * (slopes.objective @ step)
        found = _lagrangian(lane, objective, lane.slacks + slopes.constraints @ step, slopes)
        bent = state.memory @ step
        known = lagrangian.curvature_of(slopes, found.multipliers, lane.penalty)
        return found.value - step @ bent / 2, found.gradient - bent, known

    top = quasi_newton.top_of(model, state, lagrangian.curvature_of(slopes, here.multipliers, lane.penalty))
    uphill = jnp.where(ascent.is_free(start, state.gradient), state.gradient, 0)
    toward = ascent.within_reach(top - start, uphill)
    return lane._replace(
        ascent=state._replace(toward=toward, length=jnp.ones_like(state.length)), shares=here.multipliers
    )


class _Lagrangian(NamedTuple):
    value: jax.Array  # ()
    gradient: jax.Array  # (n,)
    multipliers: Multipliers


def _lagrangian(lane: Search, objective: jax.Array, slacks: jax.Array, slopes: Multipliers) -> _Lagrangian:
    """The augmented Lagrangian that the lane climbs, at measures and slopes over its scale."""
    new = lagrangian.next_multipliers(objective / lane.scale, slacks, lane.multipliers, lane.penalty)
    value = lagrangian.value_of(objective / lane.scale, slacks, lane.multipliers, new, lane.penalty)
    return _Lagrangian(value, lagrangian.gradient_of(slopes, new), new)


def _moved(lane: Search, trial: jax.Array, here: _Lagrangian, slopes: Multipliers) -> ascent.Ascent:
    """The accepted trial, and what the step to it says of the curvature at fixed multipliers."""
    state, step = lane.ascent, trial - lane.ascent.box
    turned = jax.tree.map(jnp.subtract, here.multipliers, lane.shares)
    falls = state.gradient - here.gradient + lagrangian.gradient_of(slopes, turned)
    size = lambda shares: 1 + jnp.sum(shares.constraints)
    matrix = state.memory * jnp.minimum(1, size(here.multipliers) / size(lane.shares))
    memory = jnp.where(jnp.any(step != 0), quasi_newton.updated(matrix, step, falls), matrix)
    return state._replace(
        box=trial,
        value=here.value,
        gradient=here.gradient,
        memory=memory,
        cuts=jnp.zeros_like(state.cuts),
        evaluations=state.evaluations + 1,
    )


def _linearized(problem: DesignProblem, box: jax.Array) -> tuple[jax.Array, jax.Array, Multipliers]:
    """Objective (k,), slacks (p,) and their derivatives in the box, (k, n) and (p, n).

    Forward: it passes through loops, and takes no more memory than the mechanism itself.
    """
    measure = lambda box: problem.measure(problem.vector(box))
    twice = lambda box: (measure(box),) * 2
    slopes, (objective, slacks) = jax.jacfwd(twice, has_aux=True)(box)
    return objective, slacks, Multipliers(*slopes)


def _scale(objective: jax.Array, slopes: Multipliers) -> jax.Array:
    """Of the objective: its steepest entry, or where it is flat its size. -> (), positive"""
    size = lambda array: jnp.max(jnp.where(jnp.isfinite(array), jnp.abs(array), 0))
    scale = jnp.maximum(size(slopes.objective), 1e-3 * size(objective))
    return jnp.where(scale > 0, scale, 1)


def _with_best(lane: Search, box: jax.Array, objective: jax.Array, slacks: jax.Array) -> Search:
    """The trial becomes the best where it is better."""
    value, violation = jnp.min(objective), _violation(slacks)
    fits, fitted = violation <= lane.tolerance, lane.violation <= lane.tolerance
    is_better = jnp.where(fits & fitted, value > lane.value, (violation < lane.violation) & ~fitted)
    is_better &= jnp.isfinite(value) & jnp.isfinite(violation)
    return _with(lane, is_better, box, value, violation)


def _with(lane: Search, where: jax.Array, box: jax.Array, value: jax.Array, violation: jax.Array) -> Search:
    return lane._replace(
        box=jnp.where(where, box, lane.box),
        value=jnp.where(where, value, lane.value),
        violation=jnp.where(where, violation, lane.violation),
    )


def _violation(slacks: jax.Array) -> jax.Array:
    return jnp.max(jnp.maximum(-slacks, 0), initial=0)


def _renewed(lane: Search, is_stuck: jax.Array) -> Search:
    """The multipliers that the end of this ascent suggests, and the next ascent; or the end of the search."""
    old, new, penalty = lane.multipliers, lane.shares, lane.penalty
    gap = lagrangian.gap(old, new, penalty)
    is_still = ascent.stationarity(lane.ascent.box, lane.ascent.gradient) <= lane.tolerance
    is_closed = gap <= lane.tolerance
    is_solved = is_still & is_closed
    is_over = _is_plain(lane) | is_solved | (is_stuck & is_closed) | (lane.rounds >= MOST_ROUNDS)

    # an end beats the points on the way, unless one of them was better by more than the tolerance is worth
    value, violation = jnp.min(lane.objective), _violation(lane.slacks)
    near = value >= lane.value - 1e3 * lane.tolerance * lane.scale
    is_taken = is_solved & (violation <= lane.tolerance) & (near | (lane.violation > lane.tolerance))
    is_taken &= jnp.isfinite(value)
    lane = _with(lane, is_taken, lane.ascent.box, value, violation)

    grows = (gap > GAP_SHARE * lane.gap) & (gap > lane.tolerance)
    return lane._replace(
        ascent=_again(lane.ascent, is_stuck),
        multipliers=new,
        penalty=jnp.where(grows, jnp.minimum(10 * penalty, MOST_PENALTY), penalty),
        still=jnp.maximum(lane.tolerance, jnp.minimum(0.1 * lane.still, gap)),
        gap=gap,
        rounds=lane.rounds + 1,
        since=lane.evaluations,
        is_solved=is_taken,
        is_done=is_over,
    )


def _is_plain(lane: Search) -> bool:
    """One objective, no constraints: nothing to renew."""
    return lane.objective.size == 1 and lane.slacks.size == 0


def _again(state: ascent.Ascent, is_stuck: jax.Array) -> ascent.Ascent:
    """Ascend on; where no step was good, from a fresh evaluation and with all curvature forgotten."""
    fresh = state._replace(
        value=jnp.full_like(state.value, -jnp.inf),
        toward=jnp.zeros_like(state.toward),
        memory=jnp.zeros_like(state.memory),
        cuts=jnp.zeros_like(state.cuts),
    )
    return jax.tree.map(lambda a, b: jnp.where(is_stuck, a, b), fresh, state)
