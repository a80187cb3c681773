"""What a pose is, how it moves, and where it carries the platform's points.

A pose is an array of coordinates, moved by addition: (x, y) and (x, y, z) are translations,
(x, y, phi) with planar points is a planar rigid motion whose tangent is (x', y', phi').
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pk_jax.geometry.planar import rotation


def retract(pose: jax.Array, twist: jax.Array) -> jax.Array:
    """The pose reached from `pose` by the tangent increment `twist` (n,)."""
    return pose + twist


def tangent_zero(pose: jax.Array) -> jax.Array:
    """The zero tangent at `pose`. -> (n,)"""
    return jnp.zeros_like(pose)


def place(pose: jax.Array, points: jax.Array) -> jax.Array:
    """Platform points (k, d) from the platform frame into the base frame. -> (k, d)"""
    count, dimension = points.shape
    if pose.shape == (dimension,):
        return pose + points
    if pose.shape == (3,) and dimension == 2:
        return pose[:2] + points @ rotation(pose[2]).T
    raise ValueError(f"a pose of shape {pose.shape} cannot carry points of shape {(count, dimension)}")


def place_jacobian(pose: jax.Array, points: jax.Array) -> jax.Array:
    """Velocity of every placed point per unit twist: the rigid-body map. -> (k, d, n)"""
    return jax.jacfwd(lambda twist: place(retract(pose, twist), points))(tangent_zero(pose))
