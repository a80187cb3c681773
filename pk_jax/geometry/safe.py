"""Elementary functions with finite derivatives everywhere.

`jnp.where(x > 0, jnp.sqrt(x), 0)` still has a NaN gradient at 0: reverse mode multiplies the
discarded branch's infinity by zero. Here the INPUT of the function is guarded instead. Where the
true derivative is infinite the functions return the derivative 0; callers that need to know
report it through a `Status`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def sqrt(x: jax.Array) -> jax.Array:
    """sqrt(x) for x > 0, else 0 with derivative 0; NaN stays NaN."""
    is_zero = x <= 0  # NaN compares False
    return jnp.where(is_zero, 0, jnp.sqrt(jnp.where(is_zero, 1, x)))


def norm(v: jax.Array) -> jax.Array:
    """Euclidean length of the last axis; at the zero vector 0 with derivative 0."""
    return sqrt(jnp.sum(v * v, axis=-1))


def arcsin(x: jax.Array) -> jax.Array:
    """arcsin of x clipped to [-1, 1]; derivative 0 at and beyond the ends."""
    inside = jnp.abs(x) < 1
    return jnp.where(inside, jnp.arcsin(jnp.where(inside, x, 0)), jnp.sign(x) * (jnp.pi / 2))


def arccos(x: jax.Array) -> jax.Array:
    """arccos of x clipped to [-1, 1]; derivative 0 at and beyond the ends."""
    return jnp.pi / 2 - arcsin(x)


def divide(a: jax.Array, b: jax.Array) -> jax.Array:
    """a / b, and 0 with derivative 0 where b = 0."""
    nonzero = b != 0
    return jnp.where(nonzero, a / jnp.where(nonzero, b, 1), 0)
