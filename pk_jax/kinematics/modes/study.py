"""Study coordinates: the poses of space as points of a quadric, so that a leg is a quadratic form.

z = (x, y) in P^7 with x . y = 0: x is the quaternion (w, x, y, z) of the rotation, of any length but zero,
and the translation is 2 y x* / x . x. Points with x . x = 0 are no poses: they are "at infinity".
Complex numbers are allowed throughout; products are bilinear, nothing is conjugated.

Source: Study 1903, Geometrie der Dynamen; Husty 1996, Mech. Mach. Theory 31, 365-379.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# (p q)_k = sum_ij PRODUCT[i, j, k] p_i q_j, Hamilton's product
PRODUCT = np.zeros((4, 4, 4))
for _i, _j, _k, _sign in (
    *((0, n, n, 1) for n in range(4)),
    *((n, 0, n, 1) for n in (1, 2, 3)),
    *((n, n, 0, -1) for n in (1, 2, 3)),
    *((1, 2, 3, 1), (2, 3, 1, 1), (3, 1, 2, 1), (2, 1, 3, -1), (3, 2, 1, -1), (1, 3, 2, -1)),
):
    PRODUCT[_i, _j, _k] = _sign
NORM = np.diag([1.0] * 4 + [0.0] * 4)  # z . NORM z = x . x
STUDY = np.kron([[0.0, 0.5], [0.5, 0.0]], np.eye(4))  # z . STUDY z = x . y


class Legs(NamedTuple):
    """Six legs as parameters in which their equations are polynomials; complex ones are no robot."""

    base: jax.Array  # (6, 3)
    platform: jax.Array  # (6, 3)
    offset: jax.Array  # (6,) |base|^2 + |platform|^2 - length^2


def quadrics(legs: Legs) -> jax.Array:
    """Symmetric matrices; z . Q z is |leg|^2 - length^2, times x . x; the last: Study's. -> (7, 8, 8)"""
    left = jnp.einsum("ijk,ni->nkj", PRODUCT[1:], legs.base)  # a x = left x
    right = jnp.einsum("ijk,nj->nki", PRODUCT[:, 1:], legs.platform)  # x b = right x
    turned = right - left
    of_x = legs.offset[:, None, None] * jnp.eye(4) + 2 * left @ right
    of_y = jnp.broadcast_to(4 * jnp.eye(4, dtype=of_x.dtype), of_x.shape)
    rows = (
        jnp.concatenate([of_x, 2 * jnp.swapaxes(turned, 1, 2)], axis=2),
        jnp.concatenate([2 * turned, of_y], axis=2),
    )
    whole = jnp.concatenate(rows, axis=1)
    return jnp.concatenate([(whole + jnp.swapaxes(whole, 1, 2)) / 2, STUDY[None].astype(whole.dtype)])


def motion_of(z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Translation (3,) and rotation (3, 3) of one point, complex where the point is."""
    x, y = z[:4], z[4:]
    conjugate = x * np.array([1.0, -1.0, -1.0, -1.0])
    norm = jnp.sum(x * x)
    multiply = lambda p, q: jnp.einsum("ijk,i,j->k", PRODUCT, p, q)
    units = [multiply(multiply(x, unit), conjugate)[1:] for unit in np.eye(4)[1:]]
    return 2 * multiply(y, conjugate)[1:] / norm, jnp.stack(units, axis=1) / norm


def point_of(translation: jax.Array, quaternion: jax.Array) -> jax.Array:
    """z of a translation (3,) and the quaternion (4,) of a rotation. -> (8,)"""
    moved = jnp.concatenate([jnp.zeros(1, translation.dtype), translation])
    return jnp.concatenate([quaternion, jnp.einsum("ijk,i,j->k", PRODUCT, moved, quaternion) / 2])
