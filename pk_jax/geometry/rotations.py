"""Rotations in space: matrices, unit quaternions (w, x, y, z) and rotation vectors (axis times angle)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pk_jax.geometry import safe


def skew(v: jax.Array) -> jax.Array:
    """The matrix of v x. -> (3, 3)"""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def cayley(w: jax.Array) -> jax.Array:
    """(I - [w/2])^-1 (I + [w/2]): orthogonal for every w, exp([w]) to second order. -> (3, 3)"""
    half = w / 2
    k = skew(half)
    return jnp.eye(3, dtype=w.dtype) + (2 / (1 + jnp.sum(half * half))) * (k + k @ k)


def about(axis: int, angle: jax.Array) -> jax.Array:
    """Rotation by `angle` about a coordinate axis, 0 = x, 1 = y, 2 = z. -> (3, 3)"""
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    turned = jnp.stack([jnp.stack([one, zero, zero]), jnp.stack([zero, c, -s]), jnp.stack([zero, s, c])])
    return jnp.roll(turned, axis, axis=(0, 1))


def from_quaternion(q: jax.Array) -> jax.Array:
    """Rotation of a quaternion (w, x, y, z) of any length but zero. -> (3, 3)"""
    q = q / jnp.linalg.norm(q)
    k = skew(q[1:])
    return jnp.eye(3, dtype=q.dtype) + 2 * (q[0] * k + k @ k)


def to_quaternion(r: jax.Array) -> jax.Array:
    """Unit quaternion (w, x, y, z) with its largest entry positive. -> (4,)

    Row i of q q^T is read off the matrix for each i; the row of the largest entry is divided by
    that entry, so that nothing cancels at any angle (Shepperd 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = r
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    outer = jnp.stack([jnp.stack(row) for row in rows])  # 4 q q^T
    row = outer[jnp.argmax(jnp.diagonal(outer))]
    return row / safe.norm(row)


def from_rotation_vector(v: jax.Array) -> jax.Array:
    """Rotation about v by |v| radians. -> (3, 3)"""
    angle = safe.norm(v)
    k = skew(v)
    # sin(t)/t and (1 - cos t)/t^2 through sinc, whose derivatives at 0 are right
    return jnp.eye(3, dtype=v.dtype) + jnp.sinc(angle / jnp.pi) * k + _versine(angle) * (k @ k)


def to_rotation_vector(r: jax.Array) -> jax.Array:
    """Axis times angle, |.| <= pi. -> (3,)"""
    q = to_quaternion(r)
    q = jnp.where(q[0] < 0, -q, q)
    sine = safe.norm(q[1:])
    # angle / sin(angle / 2), 2 at the identity
    ratio = jnp.where(sine > 0, safe.divide(2 * jnp.arctan2(sine, q[0]), sine), 2 / q[0])
    return ratio * q[1:]


def _versine(angle: jax.Array) -> jax.Array:
    return jnp.sinc(angle / (2 * jnp.pi)) ** 2 / 2
