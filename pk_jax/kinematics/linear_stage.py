"""The linear stage of the nine-length platform: what six legs and three sensors say linearly of the pose.

Legs run from A_i to B_i, i = 1..6, sensors from S_j to T_j, j = 1..3, lengths l_i and s_j. With
B_i = sum_j K_ij T_j, rows of K of sum 1, and r_j = T_j - S_j the vectors of the sensors,

    sum_j K_ij (S_j - A_i) . r_j
        = (l_i^2 + sum_{j<m} K_ij K_im |T_j - T_m|^2 - sum_j K_ij (s_j^2 + |S_j - A_i|^2)) / 2,

six equations for nine numbers (Ryu et al., KR 10-2000-0073215, eqs. (8) and (22)-(24), in one form
for any triangle). Their matrix knows no pose: whether a layout of sensors can do is decided by it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax.geometry.se3 import SE3
from pk_jax.mechanisms.stewart import LEGS, Stewart

ROWS = LEGS + 3
IN_PLANE_TO = 1e-6  # of the platform's size: what joints may be off the plane of T1, T2, T3
PLANAR_TO = 1e-9  # of the base's size: what joints of a planar base may be off its plane
SINGULAR_BELOW = 1e-9  # least over greatest singular value of a stage that is of no use
ROUNDOFFS = 64  # what coordinates are off in any case: counts where floats are short
PAIRS = ((0, 1), (1, 2), (2, 0))  # the sides of the triangle


class Frame(NamedTuple):
    """The platform's triangle T1 T2 T3 and where the other joints are in it."""

    centre: jax.Array  # (3,) of the triangle, platform frame
    axes: jax.Array  # (3, 3) columns: two in the plane, then its normal
    flat: jax.Array  # (3, 2) the triangle from its centre, in these axes
    coordinates: jax.Array  # (6, 3) K
    off: jax.Array  # (6,) distances of the legs' joints from the plane
    sides: jax.Array  # (3,) squared
    slimness: jax.Array  # () least over greatest extent of the triangle

    def corners(self) -> jax.Array:
        """T1, T2, T3 in the platform frame. -> (3, 3)"""
        return self.centre + self.flat @ self.axes[:, :2].T


class Stage(NamedTuple):
    """What the closed form needs of a layout."""

    frame: Frame
    feet: jax.Array  # (3, 3) S_j
    home: SE3
    middle: jax.Array  # (3,) of the base
    up: jax.Array  # (3,) normal of the plane nearest to the base, to the side of home
    of_squares: jax.Array  # (9, 9) the least solution r = of_squares @ lengths^2 + offset
    offset: jax.Array  # (9,)
    free: jax.Array  # (9, 3) what the linear stage leaves free: r + free @ y
    squares: jax.Array  # (6, 6) inverse of the six quadrics' coefficients of y_a y_b
    squares_condition: jax.Array  # () of these coefficients
    singular_values: jax.Array  # (6,) of the linear stage, over the base's size
    is_planar: jax.Array  # () bool: all A_i and S_j in one plane (embodiment 2)


def at_least(tolerance: float, dtype: Any) -> float:
    """A tolerance, or what roundoff needs."""
    return max(tolerance, ROUNDOFFS * float(jnp.finfo(dtype).eps))


def rank_of(stage: Stage) -> jax.Array:
    """How many of the six linear equations are independent. -> () int"""
    values = stage.singular_values
    return (values > at_least(SINGULAR_BELOW, values.dtype) * values[0]).sum()


def condition_of(stage: Stage) -> jax.Array:
    """Greatest over least singular value of the linear stage. -> ()"""
    return stage.singular_values[0] / stage.singular_values[-1]


def frame_of(platform: jax.Array) -> Frame:
    """The triangle of a platform (9, 3)."""
    corners = platform[LEGS:]
    centre = jnp.mean(corners, axis=0)
    along, toward = corners[1] - corners[0], corners[2] - corners[0]
    first = along / jnp.linalg.norm(along)
    normal = jnp.cross(along, toward)
    normal = normal / jnp.linalg.norm(normal)
    axes = jnp.stack([first, jnp.cross(normal, first), normal], axis=1)
    flat = (corners - centre) @ axes[:, :2]
    inside = (platform[:LEGS] - centre) @ axes
    affine = jnp.concatenate([flat, jnp.ones_like(flat[:, :1])], axis=1)  # (3, 3)
    homogeneous = jnp.concatenate([inside[:, :2], jnp.ones_like(inside[:, :1])], axis=1)
    coordinates = jnp.linalg.solve(affine.T, homogeneous.T).T
    extent = jnp.linalg.svd(corners - centre, compute_uv=False)
    sides = jnp.stack([jnp.sum((corners[a] - corners[b]) ** 2) for a, b in PAIRS])
    return Frame(centre, axes, flat, coordinates, jnp.abs(inside[:, 2]), sides, extent[1] / extent[0])


def matrix_of(base: jax.Array, coordinates: jax.Array) -> jax.Array:
    """K_ij (S_j - A_i): the coefficients of r_j in the equation of leg i. -> (6, 3, 3)"""
    return coordinates[:, :, None] * (base[LEGS:] - base[:LEGS, None])


def stage_of(stewart: Stewart) -> Stage:
    """The linear stage of a platform with nine rows; differentiable in its geometry."""
    base, frame = stewart.base, frame_of(stewart.platform)
    matrix = matrix_of(base, frame.coordinates).reshape(LEGS, 9)
    middle = jnp.mean(base, axis=0)
    size = jnp.linalg.norm(base - middle)
    extent, axes = jnp.linalg.svd(lax.stop_gradient(base - middle))[1:]
    is_planar = extent[2] <= at_least(PLANAR_TO, base.dtype) * extent[0]
    home = lax.stop_gradient(stewart.home()[0])
    up = axes[2] * jnp.sign(axes[2] @ (home.translation + home.rotation @ frame.centre - middle))

    values, directions = jnp.linalg.svd(lax.stop_gradient(matrix))[1:]
    straight_up = jnp.kron(jnp.eye(3, dtype=base.dtype), up[:, None])  # (9, 3)
    inverse = jnp.linalg.pinv(matrix, rtol=at_least(SINGULAR_BELOW, base.dtype))
    free = jnp.where(is_planar, straight_up, directions[LEGS:].T)
    free = free - inverse @ (matrix @ free)  # zero, with the right derivative

    feet = base[LEGS:]
    k = frame.coordinates
    apart = jnp.sum((feet - base[:LEGS, None]) ** 2, axis=-1)  # |S_j - A_i|^2
    sides = sum(k[:, a] * k[:, b] * side for (a, b), side in zip(PAIRS, frame.sides, strict=True))
    quadratic = quadratic_parts(differences(free.reshape(3, 3, 3)))
    squares = jnp.linalg.solve(quadratic, jnp.eye(6, dtype=base.dtype))
    return Stage(
        frame=frame,
        feet=feet,
        home=home,
        middle=middle,
        up=up,
        of_squares=inverse @ jnp.concatenate([jnp.eye(LEGS, dtype=base.dtype), -k], axis=1) / 2,
        offset=inverse @ (sides - jnp.sum(k * apart, axis=1)) / 2,
        free=free,
        squares=squares,
        squares_condition=jnp.linalg.cond(lax.stop_gradient(quadratic)),
        singular_values=values / size,
        is_planar=is_planar,
    )


def differences(vectors: jax.Array) -> jax.Array:
    """The six vectors of which the lengths are known: r_1, r_2, r_3 and T_1 - T_2, T_2 - T_3, T_3 - T_1.

    Of `vectors` (3, ...), without the part of the feet. -> (6, ...)
    """
    return jnp.concatenate([vectors, jnp.stack([vectors[a] - vectors[b] for a, b in PAIRS])])


def quadratic_parts(slopes: jax.Array) -> jax.Array:
    """Coefficients of y_a y_b, in the order of `PRODUCTS`, in |c + G y|^2 of six G (6, 3, 3). -> (6, 6)"""
    gram = jnp.einsum("kia,kib->kab", slopes, slopes)
    return jnp.stack([gram[:, a, b] * (1 if a == b else 2) for a, b in PRODUCTS], axis=1)


PRODUCTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
