"""Rotations in space: matrices, unit quaternions (w, x, y, z) and rotation vectors (axis times angle)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

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
    q = q / lax.stop_gradient(jnp.max(jnp.abs(q)))  # its square neither overflows nor vanishes
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
    squared = jnp.sum(v * v)
    k = skew(v)
    return jnp.eye(3, dtype=v.dtype) + _sine_ratio(squared) * k + _sine_ratio(squared / 4) ** 2 / 2 * (k @ k)


def to_rotation_vector(r: jax.Array) -> jax.Array:
    """Axis times angle, |.| <= pi. -> (3,)"""
    q = to_quaternion(r)
    q = jnp.where(q[0] < 0, -q, q)
    squared = jnp.sum(q[1:] ** 2)
    is_small = squared < SMALL
    sine = jnp.sqrt(jnp.where(is_small, 1, squared))
    return jnp.where(is_small, 2 * _series(_ARCSINE, squared), 2 * jnp.arctan2(sine, q[0]) / sine) * q[1:]


def from_angles(angles: jax.Array) -> jax.Array:
    """Rz(yaw) Ry(pitch) Rx(roll) of (roll, pitch, yaw) in rad. -> (3, 3)"""
    (cr, cp, cy), (sr, sp, sy) = jnp.cos(angles), jnp.sin(angles)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def to_angles(r: jax.Array) -> jax.Array:
    """(roll, pitch, yaw) with |pitch| <= pi/2; at pitch +-pi/2, where only one combination of the
    other two is known, the roll is zero. -> (3,) rad
    """
    flat = r[0, 0] ** 2 + r[1, 0] ** 2
    is_upright = flat < GIMBAL
    cosine = jnp.sqrt(jnp.where(is_upright, 1, flat))
    down = 0 - r[2, 0]  # not -0
    pitch = jnp.where(is_upright, jnp.sign(down) * jnp.pi / 2, jnp.arctan2(down, cosine))
    one, zero = jnp.ones_like(flat), jnp.zeros_like(flat)
    pick = lambda upright, other: jnp.where(is_upright, upright, other)
    roll = pick(zero, jnp.arctan2(r[2, 1], pick(one, r[2, 2])))
    turn = jnp.arctan2(pick(-r[0, 1], zero), pick(r[1, 1], one))  # what is not taken is kept off (0, 0)
    yaw = pick(turn, jnp.arctan2(r[1, 0], pick(one, r[0, 0])))
    return jnp.stack([roll, pitch, yaw])


def haar_density(v: jax.Array) -> jax.Array:
    """Volume of rotations per volume of rotation vectors, (2 sin(t/2) / t)^2 with t = |v|. -> ()"""
    return _sine_ratio(jnp.sum(v * v) / 4) ** 2


# functions of the square of an angle, or of its sine, with derivatives of every order at zero

SMALL = 1e-2
GIMBAL = 1e-24  # squared cosine of the pitch below which roll and yaw are one angle
_SINE = (1, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)
_ARCSINE = (1, 1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240, 10395 / 599040, 135135 / 9676800)


def _sine_ratio(squared: jax.Array) -> jax.Array:
    """sin(t) / t of t^2."""
    is_small = squared < SMALL
    angle = jnp.sqrt(jnp.where(is_small, 1, squared))
    return jnp.where(is_small, _series(_SINE, squared), jnp.sin(angle) / angle)


def _series(coefficients: tuple[float, ...], x: jax.Array) -> jax.Array:
    total = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total
