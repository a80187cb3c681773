"""Forward kinematics: the pose that closes the loops for given joints."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry.poses import retract, tangent_size
from pk_jax.kinematics import lane_newton, newton, rows
from pk_jax.kinematics.batching import home_shapes, over_rows, rows_of, same_size, where
from pk_jax.kinematics.closure import pose_scale
from pk_jax.kinematics.lanes import is_entries, split, stack
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

UNITS_DIFFER_BY = 100  # joints that many times the length of the home's are most likely in another unit


class ForwardKinematics(NamedTuple):
    """One entry a row; batch first."""

    pose: Any  # NaN unless the status is OK
    status: jax.Array  # () Status
    residual: jax.Array  # () |F| at the pose, evaluated afresh, in the residual's own unit
    steps: jax.Array  # () iterations taken
    sigma_min: jax.Array  # () lower bound of the least singular value of A without units
    det_sign: jax.Array  # () sign of det A over its sign at home; 0 where actuation is redundant
    candidate: Any  # the last iterate, whatever the status


def forward_kinematics(mech: Mechanism, joints: Any, guess: Any = None) -> ForwardKinematics:
    """The pose for given joints, by damped Newton from `guess` (default: home).

    joints:  (m,) or (batch, m)
    guess:   one pose for all rows, or one a row

    Status: OK: closed to roundoff; OTHER_MODE: closed, but det A has another sign than at the
    start; SINGULAR: closed on a type II singularity; UNREACHABLE: the mechanism's closed form says
    that no real pose exists; STALLED: the iteration ended off a solution; STEP_LIMIT; BAD_INPUT:
    NaN, infinity or a distance <= 0 in the joints, or a NaN guess; INCONSISTENT: redundant
    equations that disagree by more than 1e-6 of their terms (for redundant equations OK means that
    the pose is a least-squares solution, its residual reported). An equal det_sign means "same side of
    the singularity", not "same assembly mode": only a path (`track`) tells the mode.

    sigma_min is 1 / |A^-1|_F of A without units (lengths over `length()`, rows of unit norm): at most the
    least singular value, at least that over sqrt(n).

    The pose carries exact derivatives of any order in the joints and the geometry, by the implicit
    function theorem; zero on rows that are not OK.
    """
    require_mechanism("forward_kinematics", mech)
    if checks.is_concrete((mech, joints, guess)):
        return _known(mech, joints, guess)
    home_pose, home_joints = home_shapes(mech)
    joints, many = rows_of("joints", joints, home_joints)
    home, order = (None, UNKNOWN) if not checks.is_concrete(mech) else rows.prepared(mech)[:2]
    if guess is None:
        return _solve(mech, home, (joints,), (many,), order)
    guess, guesses = rows_of("guess", guess, home_pose)
    return _solve(mech, home, (joints, guess), (many, guesses), order)


UNKNOWN = "the geometry is traced: the order of pivots is found at run time"


# --- traced: one function, differentiable


@partial(jax.jit, static_argnums=(3, 4))
def _solve(mech, home, joints_and_guess, are_batched, order):
    return over_rows(lambda *row: _one(mech, home, order, *row), joints_and_guess, are_batched)


def _one(mech: Mechanism, home: Any, order: Any, joints: jax.Array, guess: Any = None) -> ForwardKinematics:
    fixed, q = lax.stop_gradient((mech, joints))
    if order is UNKNOWN:
        pose, at_pose, jacobian = lane_newton.at_home(fixed)
        order = lane_newton.order_of(jacobian, mech.actuated_rows)
        home = lane_newton.home_from(pose, at_pose, jacobian, order, mech.actuated_rows)
    start = lax.stop_gradient(home.pose if guess is None else guess)
    found = _attempt_one(fixed, home, order, q, None if guess is None else start)
    found = _persist(fixed, home, order, q, start, found, is_home=guess is None)

    is_ok = found.status == Status.OK
    home_joints = mech.home()[1]  # lost rows work at home and are masked after
    pose = newton.implicit(
        lambda x: mech.residual(x, jnp.where(is_ok, joints, home_joints)),
        retract,
        where(is_ok, found.candidate, home.pose),
        tangent_size(home.pose),
    )
    return found._replace(pose=where(is_ok, pose, jnp.nan))


def _attempt_one(mech: Mechanism, home: Any, order: Any, joints: jax.Array, guess: Any) -> ForwardKinematics:
    """Newton on the lanes of one row."""
    entries, at_home, q, start = jax.tree.map(
        split, (mech, home, joints, home.pose if guess is None else guess)
    )
    found = lane_newton.attempt(entries, q, start, at_home, order, kind=type(mech), is_home=guess is None)
    return _answer(jax.tree.map(stack, found.pose, is_leaf=is_entries), *found[1:])


def _persist(
    mech: Mechanism,
    home: Any,
    order: Any,
    joints: jax.Array,
    start: Any,
    found: ForwardKinematics,
    *,
    is_home: bool,
) -> ForwardKinematics:
    """A row that Newton has lost again, by Levenberg-Marquardt."""
    is_lost = found.status == Status.STALLED
    start = where(is_lost, start, home.pose)
    joints = jnp.where(is_lost, joints, home.joints)
    solution = newton.solve(
        lambda x: mech.linearize(x, joints), retract, start, scale=pose_scale(mech, start), is_needed=is_lost
    )
    entries, at_home, q, at_start, at = jax.tree.map(split, (mech, home, joints, start, solution.point))
    judged = lane_newton.judge(entries, q, at, order, mech.actuated_rows)
    is_square = home.first.shape[0] == home.first.shape[1]
    side = judged.sign * at_home.sign.items[0]
    if is_square and not is_home:
        side = judged.sign * lane_newton.start_sign(entries, q, at_start, order, None)
    status = lane_newton.verdict(judged, solution.is_stationary, side, is_square=is_square)
    limit_hit = (status == Status.STALLED) & ~solution.is_stationary
    status = jnp.where(limit_hit, Status.STEP_LIMIT, status)
    if hasattr(mech, "forward"):
        is_unreal = ~jnp.any(mech.forward(joints)[1])
        is_unsolved = (status == Status.STALLED) | (status == Status.STEP_LIMIT)
        status = jnp.where(is_unsolved & is_unreal, Status.UNREACHABLE, status)
    steps = found.steps + solution.steps
    det_sign = judged.sign * home.sign
    again = _answer(solution.point, status, judged.residual, steps, judged.sigma_min, det_sign)
    return where(is_lost, again, found)


def _answer(
    point: Any, status: Any, residual: Any, steps: Any, sigma_min: Any, det_sign: Any
) -> ForwardKinematics:
    """One row, masked where it is not OK."""
    is_given = status != Status.BAD_INPUT
    masked = lambda value: where(is_given, value, jnp.nan)
    return ForwardKinematics(
        where(status == Status.OK, point, jnp.nan),
        status.astype(jnp.int32),
        masked(residual),
        steps.astype(jnp.int32),
        masked(sigma_min),
        masked(det_sign),
        masked(point),
    )


# --- known values: rows in blocks, whatever their number


def _known(mech: Mechanism, joints: Any, guess: Any) -> ForwardKinematics:
    home, order, (home_pose, home_joints) = rows.prepared(mech)[:3]
    joints, many = rows_of("joints", joints, home_joints, numpy=True)
    guess, guesses = (None, False) if guess is None else rows_of("guess", guess, home_pose, numpy=True)
    if not (many or guesses):
        found = _one_known(mech, home, joints, guess, order)
        if int(found.status) != Status.STALLED:
            return found
        joints, guess, found = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (joints, guess, found))
        found = _again(mech, home, joints, guess, found, order)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), found)
    if many and guesses:
        same_size((joints, guess), (True, True))
    elif guesses:
        joints = np.broadcast_to(joints, (jax.tree.leaves(guess)[0].shape[0], *joints.shape))
    solved = rows.solve(mech, joints, guess, one_guess=not guesses)
    is_bad, is_wrong = solved.status == Status.BAD_INPUT, solved.status != Status.OK
    found = ForwardKinematics(_blanked(solved.pose, is_wrong), *solved[1:], _blanked(solved.pose, is_bad))
    found = found._replace(
        residual=_blanked(solved.residual, is_bad),
        sigma_min=_blanked(solved.sigma_min, is_bad),
        det_sign=_blanked(solved.det_sign, is_bad),
    )
    if np.any(solved.status == Status.STALLED):
        each = (
            guess
            if guesses or guess is None
            else jax.tree.map(lambda leaf: _repeated(leaf, len(joints)), guess)
        )
        found = _again(mech, home, joints, each, found, order)
    return jax.device_put(found)  # arrays that are aligned are taken over without a copy


@partial(jax.jit, static_argnums=4)
def _one_known(mech, home, joints, guess, order):
    return _attempt_one(mech, home, order, joints, guess)


def _again(
    mech: Mechanism, home: Any, joints: np.ndarray, guess: Any, found: ForwardKinematics, order: Any
) -> ForwardKinematics:
    """The lost rows of a batch once more, in blocks of few sizes so that few are compiled."""
    lost = np.flatnonzero(np.asarray(found.status) == Status.STALLED)
    _warn_of_units(mech, joints[lost], np.asarray(home.joints))
    found = jax.tree.map(lambda leaf: np.array(leaf), found)
    size = 16 if len(lost) <= 16 else 1024
    for first in range(0, len(lost), size):
        these = lost[first : first + size]
        padded = np.resize(these, size)
        taken = jax.tree.map(lambda leaf, padded=padded: leaf[padded], (joints, guess, found))
        again = _persist_rows(mech, home, *taken, order)
        for whole, part in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
            whole[these] = np.asarray(part)[: len(these)]
    return found


@partial(jax.jit, static_argnums=5)
def _persist_rows(mech, home, joints, guess, found, order):
    def persist(joints, guess, found):
        start = home.pose if guess is None else guess
        return _persist(mech, home, order, joints, start, found, is_home=guess is None)

    return jax.vmap(persist)(joints, guess, found)


def _blanked(tree: Any, rows: np.ndarray) -> Any:
    """The same arrays, with NaN in some rows."""
    if not rows.any():
        return tree

    def blank(leaf):
        leaf = leaf.copy()
        leaf[rows] = np.nan
        return leaf

    return jax.tree.map(blank, tree)


def _repeated(leaf: np.ndarray, count: int) -> np.ndarray:
    return np.broadcast_to(leaf, (count, *leaf.shape))


def _warn_of_units(mech: Mechanism, joints: np.ndarray, home: np.ndarray) -> None:
    """Lost rows whose lengths are of another order than the mechanism's are a mistake of units."""
    is_length = np.asarray(mech.joint_units or (1,) * home.size, bool)
    given, own = np.abs(joints[:, is_length]), np.abs(home[is_length])
    given = given[np.isfinite(given) & (given > 0)]
    if given.size and own.any():
        ratio = np.median(given) / np.median(own)
        if not 1 / UNITS_DIFFER_BY < ratio < UNITS_DIFFER_BY:
            warnings.warn(
                f"joints are {ratio:.3g} times those of {type(mech).__name__}'s home: are they in its unit?",
                stacklevel=5,
            )
