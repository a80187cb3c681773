"""When a residual counts as zero, and how large a step of each coordinate is."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pk_jax.kinematics.jacobian import joint_jacobian, pose_jacobian, units
from pk_jax.mechanisms.base import Mechanism

ROUNDOFFS = 256  # the residual of an exact configuration may be this many roundings of its terms


def pose_scale(mech: Mechanism, pose: jax.Array) -> jax.Array:
    """Natural size of each tangent coordinate of the pose: a length, or one radian. -> (n,)"""
    unit = units(mech.pose_units, pose.shape[0], pose.dtype)
    return jnp.where(unit > 0, mech.length() + jnp.max(jnp.abs(pose) * unit), 1)


def joint_scale(mech: Mechanism, joints: jax.Array) -> jax.Array:
    """Natural size of each joint coordinate: a length, or one radian. -> (m,)"""
    unit = units(mech.joint_units, joints.shape[0], joints.dtype)
    return jnp.where(unit > 0, mech.length() + jnp.max(jnp.abs(joints) * unit), 1)


def is_closed(mech: Mechanism, pose: jax.Array, joints: jax.Array) -> jax.Array:
    """() True where every closure equation holds to roundoff: |F_i| against the size of its terms."""
    value = mech.residual(pose, joints)
    size = jnp.abs(pose_jacobian(mech, pose, joints)) @ pose_scale(mech, pose)
    size = size + jnp.abs(joint_jacobian(mech, pose, joints)) @ joint_scale(mech, joints)
    return jnp.all(jnp.abs(value) <= ROUNDOFFS * jnp.finfo(value.dtype).eps * size)
