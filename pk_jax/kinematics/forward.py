"""Forward kinematics: the pose that closes the loops for given joints."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from pk_jax import checks
from pk_jax.geometry.poses import is_pose, retract, settle, tangent_size
from pk_jax.kinematics import lane_newton, newton, rows
from pk_jax.kinematics.batching import (
    all_finite,
    home_shapes,
    is_possible,
    over_rows,
    rows_of,
    same_size,
    where,
    without_derivatives,
)
from pk_jax.kinematics.certify import certify as prove
from pk_jax.kinematics.certify import check_known
from pk_jax.kinematics.closure import pose_scale
from pk_jax.kinematics.in_blocks import AGAIN, redo
from pk_jax.kinematics.lane_newton import Home
from pk_jax.kinematics.lanes import is_entries, split, stack
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

WORTH_LANES = 4096  # rows of a traced batch


class ForwardKinematics(NamedTuple):
    """One entry a row; batch first."""

    pose: Any  # NaN unless the status is OK
    status: jax.Array  # () Status
    residual: jax.Array  # () |F| at the pose, evaluated afresh, in the residual's own unit
    steps: jax.Array  # () iterations taken
    sigma_min: jax.Array  # () lower bound of the least singular value of A without units
    det_sign: jax.Array  # () sign of det A over its sign at home; 0 where actuation is redundant
    candidate: Any  # the last iterate, whatever the status


class CertifiedKinematics(NamedTuple):
    """`ForwardKinematics`, and what `certify` proves of each pose."""

    pose: Any
    status: jax.Array
    residual: jax.Array
    steps: jax.Array
    sigma_min: jax.Array
    det_sign: jax.Array
    candidate: Any
    is_certified: jax.Array  # () an exact solution is near the pose, and is the only one there
    radius: jax.Array  # () m, how far it is from the pose at most; NaN where none is certified


def forward_kinematics(
    mech: Mechanism, joints: Any, guess: Any = None, *, certify: bool = False
) -> ForwardKinematics | CertifiedKinematics:
    """The pose for given joints, by damped Newton from `guess` (default: home).

    joints:  (m,) or (batch, m)
    guess:   one pose for all rows, or one a row
    certify: prove of every pose that a solution is near, as `pk_jax.certify` does (known values in float64)

    Status: OK: closed to roundoff; OTHER_MODE: closed, but det A has another sign than at the
    start; SINGULAR: closed on a type II singularity; UNREACHABLE: the mechanism's closed form says
    that no real pose exists; STALLED: the iteration ended off a solution; STEP_LIMIT; BAD_INPUT:
    NaN, infinity or a distance <= 0 in the joints, or a guess that is no pose; INCONSISTENT: redundant
    equations that disagree by more than 1e-6 of their terms (for redundant equations OK means that
    the pose is a least-squares solution, its residual reported). An equal det_sign means "same side of
    the singularity", not "same assembly mode": only a path (`track`) tells the mode.

    sigma_min is 1 / |A^-1|_F of A without units (lengths over `length()`, rows of unit norm): at most the
    least singular value, at least that over sqrt(n).

    The pose carries exact derivatives of any order in the joints and the geometry, by the implicit
    function theorem; zero on rows that are not OK.
    """
    require_mechanism("forward_kinematics", mech)
    if checks.is_flag("certify", certify):
        check_known("forward_kinematics with certify=True", mech, joints, guess)
        found = forward_kinematics(mech, joints, guess)
        proved = prove(mech, found.pose, joints)
        return CertifiedKinematics(*found, proved.is_certified, proved.radius)
    if checks.is_concrete((mech, joints, guess)) and (found := _known(mech, joints, guess)) is not None:
        return found
    home_pose, home_joints = home_shapes(mech)
    joints, many = rows_of("joints", joints, home_joints)
    home, order = rows.prepared(mech)[:2] if checks.is_concrete(mech) else (None, None)
    if guess is None:
        return _solve(mech, home, (joints,), (many,), order)
    guess, guesses = rows_of("guess", guess, home_pose)
    return _solve(mech, home, (joints, guess), (many, guesses), order)


# --- traced values: one row's function, differentiable, that sends batches to the lanes


@partial(jax.jit, static_argnums=(3, 4))
def _solve(mech, home, joints_and_guess, are_batched, order):
    if home is None:
        home = lane_newton.home_from(*lane_newton.at_home(mech), mech.actuated_rows)
    return over_rows(lambda *row: _one(mech, home, order, *row), joints_and_guess, are_batched)


def _one(mech: Mechanism, home: Home, order: Any, joints: jax.Array, guess: Any = None) -> ForwardKinematics:
    found = _locate(mech, home, order, joints, guess)
    return found._replace(pose=with_derivatives(mech, home.pose, joints, found.candidate, found.status))


def with_derivatives(mech: Mechanism, home: Any, joints: jax.Array, pose: Any, status: jax.Array) -> Any:
    """The pose of one row, differentiable in joints and geometry; NaN with derivatives 0 where not OK."""
    is_ok = status == Status.OK
    home_joints = mech.home()[1]  # lost rows work at home and are masked after
    exact = newton.implicit(
        lambda x: mech.residual(x, jnp.where(is_ok, joints, home_joints)),
        retract,
        where(is_ok, pose, home),
        tangent_size(home),
    )
    return where(is_ok, exact, jnp.nan)


def _locate(mech: Mechanism, home: Home, order: Any, joints: jax.Array, guess: Any) -> ForwardKinematics:
    """One row without derivatives; under `vmap` all rows on lanes."""

    @custom_vmap
    def locate(mech, home, joints, guess):
        return _persist(mech, home, joints, guess, _untried(home))

    @locate.def_vmap
    def _(size, is_batched, mech, home, joints, guess):
        # a batch of mechanisms, or one for which compiling the lanes, some seconds, would not pay
        if any(jax.tree.leaves(is_batched[:2])) or size < WORTH_LANES:
            axes = jax.tree.map(lambda batched: 0 if batched else None, is_batched)
            found = jax.vmap(locate.fun, in_axes=axes)(mech, home, joints, guess)
        else:
            each = lambda leaf, batched: leaf if batched else jnp.broadcast_to(leaf, (size, *leaf.shape))
            joints, guess = jax.tree.map(each, (joints, guess), tuple(is_batched[2:]))
            found = _locate_all(mech, home, order, joints, guess)
        return found, jax.tree.map(lambda _: True, found)

    return without_derivatives(locate)(*lax.stop_gradient((mech, home, joints, guess)))


def _locate_all(mech: Mechanism, home: Home, order: Any, joints: jax.Array, guess: Any) -> ForwardKinematics:
    """All rows of a batch on lanes, the lost ones again, a few at a time."""
    found = jax.vmap(partial(_attempt_one, mech, home, order))(joints, guess)
    count = joints.shape[0]

    def persist(state):
        found, is_lost = state
        these = jnp.nonzero(is_lost, size=min(count, AGAIN), fill_value=count)[0]
        taken = jax.tree.map(lambda leaf: leaf.at[these].get(mode="clip"), (joints, guess, found))
        again = jax.vmap(partial(_persist, mech, home))(*taken)
        put = lambda whole, part: whole.at[these].set(part, mode="drop")
        return jax.tree.map(put, found, again), is_lost.at[these].set(False, mode="drop")

    is_lost = found.status == Status.STALLED
    return lax.while_loop(lambda state: jnp.any(state[1]), persist, (found, is_lost))[0]


def _attempt_one(mech: Mechanism, home: Home, order: Any, joints: jax.Array, guess: Any) -> ForwardKinematics:
    """Newton on the lanes of one row."""
    entries, at_home, q, start = jax.tree.map(
        split, (mech, home, joints, home.pose if guess is None else guess)
    )
    found = lane_newton.attempt(entries, q, start, at_home, order, kind=type(mech), is_home=guess is None)
    return _answer(jax.tree.map(stack, found.pose, is_leaf=is_entries), *found[1:])


def _untried(home: Home) -> ForwardKinematics:
    zero = jnp.zeros_like(home.sign)
    count = jnp.zeros((), jnp.int32)
    return ForwardKinematics(home.pose, count + Status.STALLED, zero, count, zero, zero, home.pose)


def _persist(
    mech: Mechanism, home: Home, joints: jax.Array, guess: Any, found: ForwardKinematics
) -> ForwardKinematics:
    """A STALLED row again, by Levenberg-Marquardt; any other as it is."""
    is_given = is_possible(mech, joints) & (True if guess is None else all_finite(guess) & is_pose(guess))
    is_lost = (found.status == Status.STALLED) & is_given
    start = home.pose if guess is None else settle(where(is_lost, guess, home.pose))
    q = jnp.where(is_lost, joints, home.joints)
    solution = newton.solve(
        lambda x: mech.linearize(x, q), retract, start, scale=pose_scale(mech, start), is_needed=is_lost
    )
    judged = lane_newton.judge_one(mech, q, solution.point)
    is_square = home.first.shape[0] == home.first.shape[1]
    side = judged.sign * home.sign
    if is_square and guess is not None:
        side = judged.sign * lane_newton.sign_of_det(mech.linearize(start, q)[1], None)
    status = lane_newton.verdict(judged, solution.is_stationary, side, is_square=is_square)
    limit_hit = (status == Status.STALLED) & ~solution.is_stationary
    status = jnp.where(limit_hit, Status.STEP_LIMIT, status)
    if hasattr(mech, "forward") and is_square:
        is_unsolved = ((status == Status.STALLED) | (status == Status.STEP_LIMIT)) & is_lost
        status = jnp.where(_is_unreal(mech, q, is_unsolved), Status.UNREACHABLE, status)
    status = jnp.where(is_given, status, Status.BAD_INPUT)
    steps = found.steps + solution.steps
    again = _answer(solution.point, status, judged.residual, steps, judged.sigma_min, judged.sign * home.sign)
    return where((found.status == Status.STALLED), again, found)


def _is_unreal(mech: Mechanism, joints: jax.Array, is_asked: jax.Array) -> jax.Array:
    """Whether the closed form has no real pose; a batch in which no row asks costs nothing. -> ()"""
    ask = lambda state: (jnp.asarray(False), ~jnp.any(mech.forward(joints)[1]))
    return lax.while_loop(lambda state: state[0], ask, (is_asked, jnp.asarray(False)))[1]


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
        jnp.where(is_given, steps, 0).astype(jnp.int32),
        masked(sigma_min),
        masked(det_sign),
        masked(point),
    )


# --- known values: rows in blocks, whatever their number


def _known(mech: Mechanism, joints: Any, guess: Any) -> ForwardKinematics | None:
    """The answer; None inside of a `jit`, where known values, too, must be traced."""
    home, order, (home_pose, home_joints) = rows.prepared(mech)[:3]
    joints, many = rows_of("joints", joints, home_joints, numpy=True)
    guess, guesses = (None, False) if guess is None else rows_of("guess", guess, home_pose, numpy=True)
    if not (many or guesses):
        found = _one_known(mech, home, joints, guess, order)
        if isinstance(found.status, jax.core.Tracer):  # cheaper to see now than to ask before
            return None
        if int(found.status) != Status.STALLED:
            return found
        joints, guess, found = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (joints, guess, found))
        found = _again(mech, home, joints, guess, found)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), found)
    if checks.is_staged():
        return None
    if many and guesses:
        same_size((joints, guess), (True, True))
    elif guesses:
        joints = np.broadcast_to(joints, (jax.tree.leaves(guess)[0].shape[0], *joints.shape))
    solved = rows.solve(mech, joints, guess, one_guess=not guesses)
    is_wrong = solved.status != Status.OK
    if not is_wrong.any():  # pose and candidate are the same arrays
        solved = jax.device_put(solved)
        return ForwardKinematics(*solved, solved.pose)
    is_bad = solved.status == Status.BAD_INPUT
    pose = blanked(solved.pose, is_wrong)
    residual, sigma_min, det_sign, candidate = blanked(
        (solved.residual, solved.sigma_min, solved.det_sign, solved.pose), is_bad
    )
    found = ForwardKinematics(pose, solved.status, residual, solved.steps, sigma_min, det_sign, candidate)
    if np.any(solved.status == Status.STALLED):
        if not guesses:
            guess = jax.tree.map(lambda leaf: _repeated(leaf, len(joints)), guess)
        found = _again(mech, home, joints, guess, found)
    return jax.device_put(found)  # arrays that are aligned are taken over without a copy


@partial(jax.jit, static_argnums=4)
def _one_known(mech, home, joints, guess, order):
    return _attempt_one(mech, home, order, joints, guess)


def _again(
    mech: Mechanism, home: Home, joints: np.ndarray, guess: Any, found: ForwardKinematics
) -> ForwardKinematics:
    """The lost rows of a batch once more."""
    lost = np.flatnonzero(np.asarray(found.status) == Status.STALLED)
    _warn_of_units(mech, joints[lost], np.asarray(home.joints))
    found = jax.tree.map(lambda leaf: np.array(leaf), found)
    redo(partial(_persist_rows, mech, home), lost, (joints, guess), found)
    return found


@jax.jit
def _persist_rows(mech, home, joints, guess, found):
    return jax.vmap(partial(_persist, mech, home))(joints, guess, found)


def solved_from(mech: Mechanism, joints: np.ndarray, guess: Any) -> ForwardKinematics:
    """Rows (batch, m) from a guess each, by Levenberg-Marquardt alone: one program for all mechanisms alike.

    `forward_kinematics` is faster but compiles lanes for the mechanism's own pivots.
    """
    home = rows.prepared(mech)[0]
    untried = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(joints), *leaf.shape)), _untried(home))
    return _persist_rows(mech, home, joints, guess, untried)


def blanked(tree: Any, rows: np.ndarray) -> Any:
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
        what = f"joints and those of {type(mech).__name__}'s home"
        checks.warn_of_units(what, np.median(given) / np.median(own), stacklevel=5)
