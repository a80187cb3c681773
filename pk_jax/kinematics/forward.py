"""Forward kinematics: the pose that closes the loops for given joints."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax.geometry.poses import retract
from pk_jax.kinematics import newton
from pk_jax.kinematics.batching import all_finite, over_rows, rows_of
from pk_jax.kinematics.closure import is_closed, pose_scale
from pk_jax.kinematics.inverse import SINGULAR_BELOW
from pk_jax.kinematics.jacobian import scaled_jacobians
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

INCONSISTENT_ABOVE = 1e-6  # of the size of each closure equation, for redundant mechanisms


class ForwardKinematics(NamedTuple):
    """One entry a row; batch first."""

    pose: Any  # NaN unless the status is OK
    status: jax.Array  # () Status
    residual: jax.Array  # () |F| at the pose, evaluated afresh, in the residual's own unit
    steps: jax.Array  # () iterations taken
    sigma_min: jax.Array  # () least singular value of A without units (`scaled_jacobians`)
    det_sign: jax.Array  # () sign of det A over its sign at home; 0 for redundant mechanisms
    candidate: Any  # the last iterate, whatever the status


def forward_kinematics(mech: Mechanism, joints: Any, guess: Any = None) -> ForwardKinematics:
    """The pose for given joints, by damped Newton from `guess` (default: home).

    joints:  (m,) or (batch, m)
    guess:   one pose for all rows, or one a row

    Status: OK: closed to roundoff; OTHER_MODE: closed, but det A changed its sign against the
    start; SINGULAR: closed on a type II singularity; UNREACHABLE: the mechanism's closed form says
    that no real pose exists; STALLED: the iteration ended off a solution; STEP_LIMIT; NONFINITE:
    NaN or infinity in the joints or the guess; INCONSISTENT: redundant equations that disagree. An
    equal det_sign means "same side of the singularity", not "same assembly mode".
    The pose carries exact derivatives in the joints and the geometry; zero on rows that are not OK.
    """
    require_mechanism("forward_kinematics", mech)
    home_pose, home_joints = jax.eval_shape(mech.home)
    joints = rows_of("joints", joints, home_joints)
    batched = (joints.ndim > home_joints.ndim,)
    if guess is None:
        return _solve(mech, (joints,), batched)
    guess = rows_of("guess", guess, home_pose)
    return _solve(mech, (joints, guess), (*batched, guess.ndim > home_pose.ndim))


@partial(jax.jit, static_argnums=2)
def _solve(mech, joints_and_guess, are_batched):
    return over_rows(lambda *row: _one(mech, *row), joints_and_guess, are_batched)


def _one(mech: Mechanism, joints: jax.Array, guess: jax.Array | None = None) -> ForwardKinematics:
    home_pose, home_joints = mech.home()
    guess = home_pose if guess is None else guess
    is_given = all_finite(joints, guess)
    start = lax.stop_gradient(jnp.where(is_given, guess, home_pose))
    joints = jnp.where(is_given, joints, home_joints)  # lost rows work at home and are masked after

    fixed, q = lax.stop_gradient((mech, joints))
    solution = newton.solve(lambda x: fixed.linearize(x, q), retract, start, scale=pose_scale(fixed, start))
    found = solution.point
    jacobian = scaled_jacobians(fixed, found, q).pose
    sigma = jnp.linalg.svd(jacobian, compute_uv=False)[-1]
    if jacobian.shape[0] == jacobian.shape[1]:
        sign = lambda pose, q: jnp.sign(jnp.linalg.det(fixed.linearize(pose, q)[1]))
        side = sign(found, q)
        det_sign = side * sign(*lax.stop_gradient((home_pose, home_joints)))
        is_other = side * sign(start, q) < 0
        verdict = jnp.where(is_closed(fixed, found, q), Status.OK, Status.STALLED)
    else:
        det_sign, is_other = jnp.zeros_like(sigma), False
        value = fixed.residual(found, q)
        size = jnp.abs(fixed.linearize(found, q)[1]) @ pose_scale(fixed, found)
        is_consistent = jnp.all(jnp.abs(value) <= INCONSISTENT_ABOVE * size)
        verdict = jnp.where(is_consistent, Status.OK, Status.INCONSISTENT)
        verdict = jnp.where(solution.is_stationary, verdict, Status.STALLED)
    limit_hit = (verdict == Status.STALLED) & ~solution.is_stationary
    verdict = jnp.where(limit_hit, Status.STEP_LIMIT, verdict)
    if hasattr(mech, "forward"):
        unreal = ~jnp.any(fixed.forward(q)[1])
        verdict = jnp.where((verdict != Status.OK) & unreal, Status.UNREACHABLE, verdict)
    solved = verdict == Status.OK
    verdict = jnp.where(solved & is_other, Status.OTHER_MODE, verdict)
    verdict = jnp.where(solved & (sigma < SINGULAR_BELOW), Status.SINGULAR, verdict)
    verdict = jnp.where(is_given, verdict, Status.NONFINITE).astype(jnp.int32)

    is_ok = verdict == Status.OK
    pose = newton.implicit(
        lambda x: mech.residual(x, jnp.where(is_ok, joints, home_joints)),
        retract,
        jnp.where(is_ok, found, home_pose),
        jacobian.shape[1],
    )
    masked = lambda value: jnp.where(is_given, value, jnp.nan)
    return ForwardKinematics(
        jnp.where(is_ok, pose, jnp.nan),
        verdict,
        masked(solution.residual),
        solution.steps,
        masked(sigma),
        masked(det_sign),
        masked(found),
    )
