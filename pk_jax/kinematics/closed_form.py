"""The pose of a platform from nine lengths in closed form: the linear stage, what it leaves, the triangle.

Each step is written for one configuration, and evaluated on lanes or in ordinary arrays.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pk_jax.geometry import safe
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics import elimination
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.lanes import Entries, Lane
from pk_jax.kinematics.linear_stage import PAIRS, Stage
from pk_jax.kinematics.quadrics import (
    Quadrics,
    bracketings,
    by_macaulay,
    by_quintic,
    products_of,
    quadrics_of,
    values_at,
)


def closed_form(stage: Stage, lengths: jax.Array, method: str | None) -> tuple[SE3, jax.Array]:
    """Pose, and least squared height of the triangle over the base, NaN but for "linear". -> (), ()

    method: None where the geometry is traced: "linear" or "products", as the base is planar or not
    """
    if method is None:
        both = closed_form(stage, lengths, "linear"), closed_form(stage, lengths, "products")
        return jax.tree.map(lambda *pair: jnp.where(stage.is_planar, *pair), *both)
    if method == "linear":
        corners, squared = _over_plane(stage, lengths)
        return pose_of(stage, corners), squared
    none = jnp.full_like(lengths[0], jnp.nan)
    if method == "products":
        equations = _bracketings(stage, lengths)
        orthogonal, upper = jnp.linalg.qr(equations[:, :3])
        y = -jax.scipy.linalg.solve_triangular(upper, orthogonal.T @ equations[:, 3])
        return pose_of(stage, _nearer(stage, lengths, y)), none
    poses, off = candidates(stage, lengths, method)
    best = jnp.argmin(jnp.where(jnp.isnan(off), jnp.inf, off))
    return jax.tree.map(lambda leaf: leaf[best], poses), none


def closed_form_on_lanes(stage: Any, lengths: Entries, method: str) -> tuple[SE3, Lane]:
    """The same of "linear" and "products", everything made of `Entries`."""
    if method == "linear":
        corners, squared = entrywise(_over_plane, stage, lengths)
        return entrywise(pose_of, stage, corners), squared.items[0]
    equations = entrywise(_bracketings, stage, lengths).rows()
    left, right = [row[:3] for row in equations], [-row[3] for row in equations]
    y = elimination.back_substitute(*elimination.orthogonalize(left, right))
    corners = entrywise(_nearer, stage, lengths, Entries((3,), y))
    return entrywise(pose_of, stage, corners), jnp.nan * lengths.items[0]


def candidates(stage: Stage, lengths: jax.Array, method: str) -> tuple[SE3, jax.Array]:
    """Every pose that a method offers, and how far each is off the six quadrics. -> (k,), (k,)

    "linear" offers a pose and its mirror image in the base; the others what the roots give, and
    the pose that a planar base would have.
    """
    start, quadrics = quadrics_of(stage, lengths)
    scaled, size = _scaled(stage, quadrics)
    if method == "linear":
        corners = _over_plane(stage, lengths)[0]
        height = (corners - stage.middle) @ stage.up
        corners = jnp.stack([corners, corners - 2 * height[:, None] * stage.up])
        y = jnp.stack([height, -height]) / size
    else:
        y = {"macaulay": by_macaulay, "quintic": by_quintic}[method](scaled)
        y = jnp.concatenate([y, _as_if_planar(stage, start, scaled, size)[None]])
        corners = jax.vmap(lambda y: _corners(stage, start, size, y))(y)
    off = jax.vmap(lambda y: _off(scaled, y))(y)
    return jax.vmap(lambda c: pose_of(stage, c))(corners), off


def mirrored(stage: Stage, pose: SE3) -> SE3:
    """The pose with all corners mirrored in the base: it has the same lengths over a planar base."""
    corners = pose.translation + (stage.frame.corners() @ pose.rotation.T)
    height = (corners - stage.middle) @ stage.up
    return pose_of(stage, corners - 2 * height[:, None] * stage.up)


def _over_plane(stage: Stage, lengths: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Corners of the triangle over a planar base, eq. (24), and their least squared height.

    Heights are roots of s_j^2 - |T_j - S_j|^2 in the plane; signs relative to the highest one from the
    sides of the triangle, so that the platform may cut the base's plane.
    """
    start, quadrics = quadrics_of(stage, lengths)
    squared = quadrics.squared[:3] - jnp.sum(start**2, axis=1)
    apart = jnp.sum(quadrics.centres[3:] ** 2, axis=1)
    # z_a z_b from (z_a - z_b)^2 = side^2 - what they are apart in the plane
    together = [
        (squared[a] + squared[b] - side + flat) / 2
        for (a, b), side, flat in zip(PAIRS, quadrics.squared[3:], apart, strict=True)
    ]
    z = safe.sqrt(squared)
    xy, yz, zx = (jnp.where(product < 0, -1.0, 1.0) for product in together)
    first = (squared[0] >= squared[1]) & (squared[0] >= squared[2])
    second = ~first & (squared[1] >= squared[2])
    one = jnp.ones_like(xy)
    signs = jnp.where(
        first,
        jnp.stack([one, xy, zx]),
        jnp.where(second, jnp.stack([xy, one, yz]), jnp.stack([zx, yz, one])),
    )
    z = z * signs
    z = z * jnp.where(jnp.sum(z) < 0, -1.0, 1.0)
    return stage.feet + start + z[:, None] * stage.up, jnp.min(squared)


def _scaled(stage: Stage, quadrics: Quadrics) -> tuple[Quadrics, jax.Array]:
    """The quadrics in units of the triangle's sides, and that unit."""
    size = jnp.sqrt(jnp.mean(stage.frame.sides))
    return Quadrics(quadrics.centres / size, quadrics.slopes, quadrics.squared / size**2), size


def _bracketings(stage: Stage, lengths: jax.Array) -> jax.Array:
    return bracketings(products_of(stage, _scaled(stage, quadrics_of(stage, lengths)[1])[0]))


def _corners(stage: Stage, start: jax.Array, size: jax.Array, y: jax.Array) -> jax.Array:
    """T_j of y in units of `size`. -> (3, 3)"""
    return stage.feet + start + size * (stage.free.reshape(3, 3, 3) @ y)


def _nearer(stage: Stage, lengths: jax.Array, y: jax.Array) -> jax.Array:
    """Corners for y, or for what y would be over a planar base, whichever fits the six quadrics better.

    Of a base that is nearly planar the affine equations know little, and the products much.
    """
    start, quadrics = quadrics_of(stage, lengths)
    scaled, size = _scaled(stage, quadrics)
    flat = _as_if_planar(stage, start, scaled, size)
    y = jnp.where(_off(scaled, flat) < _off(scaled, y), flat, y)  # NaN compares False
    return _corners(stage, start, size, y)


def _off(quadrics: Quadrics, y: jax.Array) -> jax.Array:
    return jnp.sum(values_at(quadrics, y)[0] ** 2)


def _as_if_planar(stage: Stage, start: jax.Array, scaled: Quadrics, size: jax.Array) -> jax.Array:
    """y of which only the constant parts of the products count, on home's side of the base. -> (3,)"""
    y = _root_of(products_of(stage, scaled)[:, 3])
    side = jnp.sum((jnp.mean(_corners(stage, start, size, y), axis=0) - stage.middle) * stage.up)
    return y * jnp.where(side < 0, -1.0, 1.0)


def _root_of(products: jax.Array) -> jax.Array:
    """y with these products y_a y_b, by the greatest square. -> (3,)"""
    xx, yy, zz, xy, xz, yz = products
    first, second = (xx >= yy) & (xx >= zz), yy >= zz
    row = jnp.where(
        first,
        jnp.stack([xx, xy, xz]),
        jnp.where(second, jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])),
    )
    greatest = jnp.maximum(jnp.maximum(xx, yy), zz)
    return safe.divide(row, safe.sqrt(greatest))


def pose_of(stage: Stage, corners: jax.Array) -> SE3:
    """The pose whose triangle is nearest to `corners` (3, 3): Kabsch's rotation of a plane figure.

    Two columns are the polar factor H (H^T H)^(-1/2) of a (3, 2) matrix, the third their cross product.
    """
    frame = stage.frame
    centre = jnp.mean(corners, axis=0)
    h = (corners - centre).T @ frame.flat
    gram = h.T @ h
    determinant = jnp.sqrt(gram[0, 0] * gram[1, 1] - gram[0, 1] ** 2)
    trace = gram[0, 0] + gram[1, 1]
    root = determinant * jnp.sqrt(trace + 2 * determinant)
    polar = h @ ((trace + determinant) * jnp.eye(2, dtype=h.dtype) - gram) / root
    columns = jnp.stack([polar[:, 0], polar[:, 1], jnp.cross(polar[:, 0], polar[:, 1])], axis=1)
    rotation = columns @ frame.axes.T
    return SE3(centre - rotation @ frame.centre, rotation)
