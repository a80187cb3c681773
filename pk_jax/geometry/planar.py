"""Vectors in the plane."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def cross(u: jax.Array, v: jax.Array) -> jax.Array:
    """z component of u x v, on the last axis. -> (...)"""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def direction(angle: jax.Array) -> jax.Array:
    """Unit vectors at the given angles. -> (..., 2)"""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def rotation(angle: jax.Array) -> jax.Array:
    """Rotation matrix of one angle. -> (2, 2)"""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


def quarter_turn(v: jax.Array) -> jax.Array:
    """v turned by -90 degrees: to the right of its direction. -> (..., 2)"""
    return jnp.stack([v[..., 1], -v[..., 0]], axis=-1)
