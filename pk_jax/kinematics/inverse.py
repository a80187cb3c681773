"""Inverse kinematics: the joints of a pose."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry.poses import is_pose, pose_units, position, settle
from pk_jax.kinematics import newton
from pk_jax.kinematics.batching import all_finite, home_shapes, over_rows, rows_of, where
from pk_jax.kinematics.blocks import has_one_joint_an_equation, joint_blocks
from pk_jax.kinematics.closure import is_closed, joint_scale
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, joint_jacobian, scaled_jacobians
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status


class InverseKinematics(NamedTuple):
    """One entry a row; batch first."""

    joints: jax.Array  # (m,), NaN unless the status is OK
    status: jax.Array  # () Status
    candidate: jax.Array  # (m,) the joints, also where a leg is stretched or folded


def inverse_kinematics(
    mech: Mechanism, pose: Any, branch: Any = None, *, free: Any = None
) -> InverseKinematics:
    """Joints that hold the platform at `pose`, in one working mode.

    pose:    like the mechanism's, or batched on a leading axis
    branch:  signs of the working mode, (s,) or (batch, s), as many as the mechanism's own, which is the
             default
    free:    values of the kinematically redundant joints, of mechanisms that have some, (k,) or
             (batch, k); of a single one also () or (batch,); default: as at home. See
             `resolve_redundancy` for others.

    Status: OK: closed to roundoff; UNREACHABLE: no real joints; SINGULAR: a type I singularity (a leg
    stretched or folded), where the joints exist, in `candidate`, but their rates do not; BAD_INPUT:
    NaN or infinity in the pose, or a free joint that is none; STALLED: joints that do not close
    the loops. Without a closed form they come from Newton, started at home. BAD_INPUT also: a traced
    branch that holds no signs, or a traced rotation that is none.
    The derivative of a row that is not OK is zero.
    """
    require_mechanism("inverse_kinematics", mech)
    pose, many = rows_of("pose", pose, home_shapes(mech)[0])
    if checks.is_concrete((mech, pose)):
        _warn_of_units(mech, pose)
    branch, branches = (None, False) if branch is None else branch_rows(mech, branch)
    free, frees = (None, False) if free is None else free_rows(mech, free)
    return _solve(mech, (pose, branch, free), (many, branches, frees))


def free_rows(mech: Mechanism, free: Any) -> tuple[jax.Array, bool]:
    """Values of the kinematically redundant joints, (k,) or (batch, k), in all forms that users give."""
    count = mech.free_joints
    if not count:
        raise ValueError(f"free must be left out: {type(mech).__name__} has no kinematically redundant joint")
    array = checks.real_array("free", free)
    if count == 1 and array.shape != (1,) and array.ndim < 2:
        array = array[..., None]
    return rows_of("free", array, jax.ShapeDtypeStruct((count,), home_shapes(mech)[1].dtype))


def _warn_of_units(mech: Mechanism, pose: Any) -> None:
    """Positions a hundred times as far as the mechanism is large are most likely in another unit."""
    is_length = np.asarray(pose_units(home_shapes(mech)[0], mech.pose_units), bool)
    at = np.asarray(position(pose))
    with np.errstate(over="ignore"):
        far = np.linalg.norm(at[..., is_length[: at.shape[-1]]], axis=-1)
    far = far[np.isfinite(far)]
    if far.size:
        what = f"positions and {type(mech).__name__}.length()"
        checks.warn_of_units(what, max(float(np.median(far)) / float(mech.length()), 1.0), stacklevel=3)


def branch_rows(mech: Mechanism, branch: Any) -> tuple[jax.Array, bool]:
    """Signs of a working mode, (s,) or (batch, s); ValueError where they are not signs."""
    array, many = rows_of("branch", branch, branch_shape(mech))
    if checks.is_concrete(array) and not np.all(np.abs(np.asarray(array)) == 1):
        raise ValueError(f"branch must hold only +1 and -1, got {np.asarray(array).tolist()}")
    return array, many


def branch_shape(mech: Mechanism) -> jax.ShapeDtypeStruct:
    """Shape and dtype of the signs of a working mode: the mechanism's own, or one sign a joint."""
    shape = jax.eval_shape(lambda mech: mech.default_branch(), mech)
    return home_shapes(mech)[1] if shape is None else shape


def working_modes(mech: Mechanism) -> np.ndarray:
    """Every working mode of the closed form as signs for `branch`, the default one first. -> (2^s, s)

    One row of no signs where there is a single mode.
    """
    require_mechanism("working_modes", mech)
    shape = jax.eval_shape(lambda mech: mech.default_branch(), mech)
    if shape is None:
        return np.zeros((1, 0))
    with checks.known_values():
        default = np.asarray(mech.default_branch())
    return default * np.array(list(itertools.product((1.0, -1.0), repeat=shape.shape[0])), default.dtype)


@partial(jax.jit, static_argnums=2)
def _solve(mech, rows, are_batched):
    return over_rows(partial(_one, mech), rows, are_batched)


def _one(mech: Mechanism, pose: jax.Array, branch: Any = None, free: Any = None) -> InverseKinematics:
    home_pose, home_joints = mech.home()
    is_given = all_finite(pose) & is_pose(pose)
    is_mode = True if branch is None else jnp.all(jnp.abs(branch) == 1)
    if free is not None:
        at_home = home_joints[home_joints.shape[0] - mech.free_joints :]
        is_given &= all_finite(free) & (jnp.all(free > 0) if mech.joints_are_distances else True)
        free = jnp.where(is_given, free, at_home)
    pose = settle(where(is_given, pose, home_pose))  # lost rows work on the home pose and are masked after
    if hasattr(mech, "inverse"):
        joints_at = lambda pose: mech.inverse(pose, branch, free=free)
        failed = Status.UNREACHABLE
    else:
        joints_at = lambda pose: _by_newton(mech, pose, free)
        failed = Status.STALLED

    found = lax.stop_gradient(joints_at(lax.stop_gradient(pose)))
    is_real = all_finite(found)
    at = lax.stop_gradient(where(is_real, pose, home_pose))
    q = jnp.where(is_real, found, home_joints)
    sigma = least_joint_sigma(lax.stop_gradient(mech), at, q)
    is_exact = is_closed(lax.stop_gradient(mech), at, q)
    status = jnp.where(is_exact, Status.OK, Status.STALLED)
    status = jnp.where(sigma < SINGULAR_BELOW, Status.SINGULAR, status)
    status = jnp.where(is_real, status, failed)
    status = jnp.where(is_given, status, Status.BAD_INPUT)
    status = jnp.where(is_mode, status, Status.BAD_INPUT).astype(jnp.int32)

    is_ok = status == Status.OK
    joints = joints_at(where(is_ok, pose, home_pose))  # what is differentiated never sees a limit
    return InverseKinematics(jnp.where(is_ok, joints, jnp.nan), status, jnp.where(is_given, found, jnp.nan))


def least_joint_sigma(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """Least singular value of B without units (`scaled_jacobians`). -> ()"""
    scaled = scaled_jacobians(mech, pose, joints).joints
    if has_one_joint_an_equation(joint_blocks(mech, pose, joints)):
        return jnp.min(jnp.abs(jnp.diagonal(scaled)))
    return jnp.linalg.svd(scaled, compute_uv=False)[-1]


def _by_newton(mech: Mechanism, pose: jax.Array, free: Any = None) -> jax.Array:
    """Joints from the residual alone; NaN where Newton did not end on a root. -> (m,)"""
    fixed, at = lax.stop_gradient((mech, pose))
    start = fixed.home()[1]
    count = start.shape[0] - mech.free_joints  # the others stay where they are
    held = start[count:] if free is None else free
    whole = lambda q, held: jnp.concatenate([q, held])
    add = lambda joints, step: joints + step
    still = lax.stop_gradient(held)

    def linearize(q):
        q = whole(q, still)
        return fixed.residual(at, q), joint_jacobian(fixed, at, q)[:, :count]

    scale = joint_scale(fixed, start)[:count]
    found = newton.solve(linearize, add, start[:count], scale=scale).point
    joints = whole(newton.implicit(lambda q: mech.residual(pose, whole(q, held)), add, found, count), held)
    return jnp.where(is_closed(fixed, at, whole(found, still)), joints, jnp.nan)
