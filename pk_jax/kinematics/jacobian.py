"""A, B and J of any mechanism, from its residual alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pk_jax.geometry.poses import Turned, pose_units
from pk_jax.kinematics.batching import configurations, over_rows
from pk_jax.mechanisms.base import Mechanism, require_mechanism

SINGULAR_BELOW = 1e-6  # sine of an angle; a reach limit itself is only known to sqrt(eps)


def _of_rows(function: Callable) -> Callable:
    """A function of one configuration as users call it: checked at the door, one configuration or many."""

    @partial(jax.jit, static_argnums=2)
    def rows(mech, configuration, are_batched):
        return over_rows(partial(function, mech), configuration, are_batched)

    @wraps(function)
    def call(mech, pose, joints):
        require_mechanism(function.__name__, mech)
        if isinstance(pose, Turned):  # a solver's
            return function(mech, pose, joints)
        return rows(mech, *configurations(mech, pose, joints))

    return call


@_of_rows
def pose_jacobian(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """A = dF/dx in the tangent of the pose (Jx of Nam, Lee and Park 2006, eqs. 11, 15). -> (c, n)"""
    return mech.linearize(pose, joints)[1]


@_of_rows
def joint_jacobian(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """B = dF/dq (minus Jq of Nam, Lee and Park 2006, eqs. 10, 14). -> (c, m)"""
    return jax.jacfwd(lambda q: mech.residual(pose, q))(joints)


@_of_rows
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


@_of_rows
def self_motions(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """Joint rates that leave the platform at rest, each redundant joint at rate 1 in a row. -> (k, m)

    k is the number of kinematically redundant joints. Not finite where a leg is at a type I singularity.
    """
    b = joint_jacobian(mech, pose, joints)
    if not mech.free_joints:
        return jnp.zeros((0, b.shape[1]), b.dtype)
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
    a, b = pose_jacobian(mech, pose, joints), joint_jacobian(mech, pose, joints)
    a = a * mech.length() ** units(pose_units(pose, mech.pose_units), a.dtype)
    b = b * mech.length() ** units(mech.joint_units or (1,) * b.shape[1], b.dtype)
    size = jnp.linalg.norm(a, axis=1, keepdims=True)
    size = jnp.where(size > 0, size, 1)
    return ScaledJacobians(a / size, b / size)


def units(powers: tuple[int, ...], dtype: Any) -> jax.Array:
    """Powers of length of the coordinates: 1 = length, 0 = angle."""
    return jnp.asarray(powers, dtype)
