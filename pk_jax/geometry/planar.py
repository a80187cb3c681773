"""Vectors in the plane."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pk_jax.geometry import safe


def cross(u: jax.Array, v: jax.Array) -> jax.Array:
    """z component of u x v, on the last axis. -> (...)"""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def direction(angle: jax.Array) -> jax.Array:
    """Unit vectors at the given angles. -> (..., 2)"""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def rotation(angle: jax.Array) -> jax.Array:
    """Rotation matrix of one angle. -> (2, 2)"""
    return turn_onto(direction(angle))


def turn_onto(direction: jax.Array) -> jax.Array:
    """The rotation matrix that carries the x axis onto a unit vector. -> (2, 2)"""
    c, s = direction
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


def quarter_turn(v: jax.Array) -> jax.Array:
    """v turned by -90 degrees: to the right of its direction. -> (..., 2)"""
    return jnp.stack([v[..., 1], -v[..., 0]], axis=-1)


def arm_angles(leg: jax.Array, proximal: jax.Array, distal: jax.Array, branch: jax.Array) -> jax.Array:
    """Angle of the proximal link of each two-link arm that spans `leg` (k, 2). -> (k,)

    branch: sign(sin psi), psi the angle from the proximal to the distal link. With cos psi of the law
    of cosines, the leg turned back by (la + lb cos psi, lb sin psi) is the direction of the link. NaN
    where the ends are out of reach of each other.
    """
    squared = jnp.sum(leg * leg, axis=-1)
    distance = safe.sqrt(squared)
    total, difference = proximal + distal, distal - proximal
    # Heron's factors keep sin(psi) accurate at full stretch and when folded
    heron = (total - distance) * (total + distance) * (distance - difference) * (distance + difference)
    along = (squared + proximal**2 - distal**2) / 2  # la times the projection of la on the leg
    across = -branch * safe.sqrt(heron) / 2
    angle = jnp.arctan2(
        leg[:, 1] * along + leg[:, 0] * across,
        leg[:, 0] * along - leg[:, 1] * across,
    )
    roundoff = 8 * jnp.finfo(leg.dtype).eps * total
    reachable = (distance <= total + roundoff) & (distance >= jnp.abs(difference) - roundoff)
    return jnp.where(reachable & (distance > 0), angle, jnp.nan)
