"""When a residual counts as zero, and how large a step of each coordinate is."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pk_jax.geometry.poses import pose_units, position
from pk_jax.kinematics.jacobian import joint_jacobian, units
from pk_jax.mechanisms.base import Mechanism

ROUNDOFFS = 256  # the residual of an exact configuration may be this many roundings of its terms
INCONSISTENT_ABOVE = 1e-6  # of the size of each closure equation, for redundant mechanisms


def pose_scale(mech: Mechanism, pose: Any) -> jax.Array:
    """Natural size of each tangent coordinate of the pose: a length, or one radian. -> (n,)"""
    at = position(pose)
    unit = units(pose_units(pose, mech.pose_units), at.dtype)
    return jnp.where(unit > 0, mech.length() + jnp.max(jnp.abs(at) * unit[: at.shape[0]]), 1)


def joint_scale(mech: Mechanism, joints: jax.Array) -> jax.Array:
    """Natural size of each joint coordinate: a length, or one radian. -> (m,)"""
    unit = units(mech.joint_units or (1,) * joints.shape[0], joints.dtype)
    return jnp.where(unit > 0, mech.length() + jnp.max(jnp.abs(joints) * unit), 1)


def closure(
    mech: Mechanism, pose: Any, joints: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """F (c,), A (c, n), and () whether the equations hold: redundant ones to 1e-6, and to roundoff."""
    value, jacobian, size, of_pose = _sizes(mech, pose, joints)
    is_exact = _is_within(value, closed_to(value.dtype) * size)
    if jacobian.shape[0] == jacobian.shape[1]:
        return value, jacobian, is_exact, is_exact
    return value, jacobian, _is_within(value, INCONSISTENT_ABOVE * of_pose), is_exact


def is_closed(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """() True where every closure equation holds to roundoff: |F_i| against the size of its terms."""
    value, _, size, _ = _sizes(mech, pose, joints)
    return _is_within(value, closed_to(value.dtype) * size)


def closed_to(dtype: Any) -> float:
    """|F_i| of an exact configuration, over the size of the terms of equation i."""
    return ROUNDOFFS * float(jnp.finfo(dtype).eps)


def _sizes(
    mech: Mechanism, pose: Any, joints: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """F (c,), A (c, n), the size of the terms of each equation (c,), and of those of its pose alone (c,)."""
    value, jacobian = mech.linearize(pose, joints)
    of_pose = jnp.abs(jacobian) @ pose_scale(mech, pose)
    of_joints = jnp.abs(joint_jacobian(mech, pose, joints)) @ joint_scale(mech, joints)
    return value, jacobian, of_pose + of_joints, of_pose


def _is_within(value: jax.Array, allowed: jax.Array) -> jax.Array:
    return jnp.all(jnp.abs(value) <= allowed)
