"""A, B and J of any mechanism, from its residual alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pk_jax.geometry.poses import pose_units
from pk_jax.mechanisms.base import Mechanism

SINGULAR_BELOW = 1e-6  # sine of an angle; a reach limit itself is only known to sqrt(eps)


@jax.jit
def pose_jacobian(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """A = dF/dx in the tangent of the pose (Jx of Nam, Lee and Park 2006, eqs. 11, 15). -> (c, n)"""
    return mech.linearize(pose, joints)[1]


@jax.jit
def joint_jacobian(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """B = dF/dq (minus Jq of Nam, Lee and Park 2006, eqs. 10, 14). -> (c, m)"""
    return jax.jacfwd(lambda q: mech.residual(pose, q))(joints)


@jax.jit
def velocity_jacobian(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """J with x' = J q': -A^-1 B (eq. 8), or the pseudo-inverse of -B^-1 A when c > n. -> (n, m)

    The rates of kinematically redundant joints count like all others.

    Not finite at a singular configuration: a type II singularity of A, or of B when c > n.
    """
    a = pose_jacobian(mech, pose, joints)
    b = joint_jacobian(mech, pose, joints)
    if a.shape[0] == a.shape[1]:
        return -jnp.linalg.solve(a, b)
    return jnp.linalg.pinv(-jnp.linalg.solve(b, a))


@jax.jit
def self_motions(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """Joint rates that leave the platform at rest, each redundant joint at rate 1 in a row. -> (k, m)

    k is the number of kinematically redundant joints. Not finite where a leg is at a type I singularity.
    """
    b = joint_jacobian(mech, pose, joints)
    bound = b.shape[1] - mech.free_joints
    rates = -jnp.linalg.solve(b[:, :bound], b[:, bound:])
    return jnp.concatenate([rates.T, jnp.eye(mech.free_joints, dtype=rates.dtype)], axis=1)


class ScaledJacobians(NamedTuple):
    """A and B without units: lengths over length(), rows of A of unit norm."""

    pose: jax.Array  # (c, n)
    joints: jax.Array  # (c, m)


def scaled_jacobians(mech: Mechanism, pose: Any, joints: jax.Array) -> ScaledJacobians:
    """A and B with lengths measured in `mech.length()` and each equation scaled to |A row| = 1.

    A condition number, a rank or a distance to a singularity is only ever taken of these.
    """
    a = pose_jacobian(mech, pose, joints)
    b = joint_jacobian(mech, pose, joints)
    a = a * mech.length() ** units(pose_units(pose, mech.pose_units), a.dtype)
    b = b * mech.length() ** units(mech.joint_units or (1,) * b.shape[1], b.dtype)
    size = jnp.linalg.norm(a, axis=1, keepdims=True)
    size = jnp.where(size > 0, size, 1)
    return ScaledJacobians(a / size, b / size)


def units(powers: tuple[int, ...], dtype: Any) -> jax.Array:
    """Powers of length of the coordinates: 1 = length, 0 = angle."""
    return jnp.asarray(powers, dtype)
