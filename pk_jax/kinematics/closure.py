"""When a residual counts as zero, and how large a step of each coordinate is."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pk_jax.geometry.poses import pose_units, position
from pk_jax.kinematics.jacobian import joint_jacobian, units
from pk_jax.mechanisms.base import Mechanism

ROUNDOFFS = 256  # the residual of an exact configuration may be this many roundings of its terms


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
    """F (c,), A (c, n), the size of the terms of each equation (c,), and of those of its pose alone (c,)."""
    value, jacobian = mech.linearize(pose, joints)
    of_pose = jnp.abs(jacobian) @ pose_scale(mech, pose)
    of_joints = jnp.abs(joint_jacobian(mech, pose, joints)) @ joint_scale(mech, joints)
    return value, jacobian, of_pose + of_joints, of_pose


def closed_to(dtype: Any) -> float:
    """|F_i| of an exact configuration, over the size of the terms of equation i."""
    return ROUNDOFFS * float(jnp.finfo(dtype).eps)


def is_closed(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """() True where every closure equation holds to roundoff: |F_i| against the size of its terms."""
    value, _, size, _ = closure(mech, pose, joints)
    return jnp.all(jnp.abs(value) <= closed_to(value.dtype) * size)
