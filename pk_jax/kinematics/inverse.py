"""Inverse kinematics: the joints of a pose."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry.poses import is_pose, pose_units, position, settle
from pk_jax.kinematics import newton
from pk_jax.kinematics.batching import all_finite, home_shapes, over_rows, rows_of, where
from pk_jax.kinematics.closure import is_closed, joint_scale
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, joint_jacobian, scaled_jacobians
from pk_jax.kinematics.lanes import is_known, split
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
    branch:  signs of the working mode, (m,) or (batch, m); default: the mechanism's own
    free:    values of kinematically redundant joints, for mechanisms that have them

    Status: OK: closed to roundoff; UNREACHABLE: no real joints; SINGULAR: a type I singularity (a leg
    stretched or folded), where the joints exist, in `candidate`, but their rates do not; BAD_INPUT:
    NaN or infinity in the pose; STALLED: joints that do not close the loops. Without a closed form
    they come from Newton, started at home. BAD_INPUT also: a traced branch that holds no signs, or a
    traced rotation that is none.
    The derivative of a row that is not OK is zero.
    """
    require_mechanism("inverse_kinematics", mech)
    home_pose, home_joints = home_shapes(mech)
    pose, many = rows_of("pose", pose, home_pose)
    if checks.is_concrete((mech, pose)):
        _warn_of_units(mech, pose)
    if branch is None:
        return _solve(mech, (pose,), free, (many,))
    branch, branches = branch_rows(branch, home_joints)
    return _solve(mech, (pose, branch), free, (many, branches))


def _warn_of_units(mech: Mechanism, pose: Any) -> None:
    """Positions a hundred times as far as the mechanism is large are most likely in another unit."""
    is_length = np.asarray(pose_units(pose, mech.pose_units), bool)
    at = np.asarray(position(pose))
    far = np.linalg.norm(at[..., is_length[: at.shape[-1]]], axis=-1)
    far = far[np.isfinite(far)]
    if far.size:
        what = f"positions and {type(mech).__name__}.length()"
        checks.warn_of_units(what, max(float(np.median(far)) / float(mech.length()), 1.0), stacklevel=3)


def branch_rows(branch: Any, home_joints: jax.Array) -> tuple[jax.Array, bool]:
    """Signs of a working mode, (m,) or (batch, m); ValueError where they are not signs."""
    array, many = rows_of("branch", branch, home_joints)
    if checks.is_concrete(array) and not np.all(np.abs(np.asarray(array)) == 1):
        raise ValueError(f"branch must hold only +1 and -1, got {np.asarray(array).tolist()}")
    return array, many


@partial(jax.jit, static_argnums=3)
def _solve(mech, pose_and_branch, free, are_batched):
    return over_rows(lambda *row: _one(mech, *row, free=free), pose_and_branch, are_batched)


def _one(mech: Mechanism, pose: jax.Array, branch: Any = None, *, free: Any = None) -> InverseKinematics:
    home_pose, home_joints = mech.home()
    is_given = all_finite(pose) & is_pose(pose)
    is_mode = True if branch is None else jnp.all(jnp.abs(branch) == 1)
    pose = settle(where(is_given, pose, home_pose))  # lost rows work on the home pose and are masked after
    if hasattr(mech, "inverse"):
        joints_at = lambda pose: mech.inverse(pose, branch, free=free)
        failed = Status.UNREACHABLE
    else:
        joints_at = lambda pose: _by_newton(mech, pose)
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
    leaves, tree = jax.tree.flatten((mech, pose, joints))
    if _has_one_joint_a_leg(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves)):
        return jnp.min(jnp.abs(jnp.diagonal(scaled)))
    return jnp.linalg.svd(scaled, compute_uv=False)[-1]


@lru_cache(maxsize=256)
def _has_one_joint_a_leg(tree: Any, leaves: tuple) -> bool:
    """Whether B is diagonal: its other entries are known zeros, whatever the values are."""
    answer = []

    def look(*leaves):
        jacobian = entrywise(joint_jacobian, *jax.tree.unflatten(tree, list(map(split, leaves))))
        c, m = jacobian.shape
        off = [jacobian.items[i * m + j] for i in range(c) for j in range(m) if i != j]
        answer.append(c == m and all(is_known(item) and item == 0 for item in off))

    jax.eval_shape(look, *(jax.ShapeDtypeStruct(*leaf) for leaf in leaves))
    return answer[0]


def _by_newton(mech: Mechanism, pose: jax.Array) -> jax.Array:
    """Joints from the residual alone; NaN where Newton did not end on a root. -> (m,)"""
    fixed, at = lax.stop_gradient((mech, pose))
    start = fixed.home()[1]
    add = lambda joints, step: joints + step
    linearize = lambda q: (fixed.residual(at, q), joint_jacobian(fixed, at, q))
    found = newton.solve(linearize, add, start, scale=joint_scale(fixed, start)).point
    joints = newton.implicit(lambda q: mech.residual(pose, q), add, found, start.size)
    return jnp.where(is_closed(fixed, at, found), joints, jnp.nan)
