"""Coordinates of poses about a centre, in which rays are straight, and the measure that goes with them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.geometry import rotations
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import Turning, like, pose_units
from pk_jax.geometry.se3 import SE3
from pk_jax.mechanisms.base import Mechanism


def pose_at(centre: Any, y: jax.Array) -> Any:
    """The pose of coordinates y (n,): shifts from the centre, and a rotation vector in base axes."""
    if isinstance(centre, SE3):
        return like(
            centre, centre.translation + y[:3], rotations.from_rotation_vector(y[3:]) @ centre.rotation
        )
    if isinstance(centre, AxisPose):
        return like(centre, centre.s + y[0], rotations.from_rotation_vector(y[1:]) @ centre.rotation)
    return centre + y


def density(centre: Any, y: jax.Array) -> jax.Array:
    """Invariant measure per volume of coordinates: Haar's of rotations, else 1. -> ()"""
    return rotations.haar_density(y[-3:]) if isinstance(centre, Turning) else jnp.ones((), y.dtype)


def scale_of(mech: Mechanism, centre: Any, joints: jax.Array) -> jax.Array:
    """How large coordinates can be: four times the size with these joints, or half a turn. -> (n,)"""
    unit = jnp.asarray(pose_units(centre, mech.pose_units), bool)
    is_length = np.asarray(mech.joint_units or (1,) * joints.shape[0], bool)
    size = 4 * (mech.length() + jnp.max(jnp.abs(joints)[is_length], initial=0.0))
    size = size + jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(mech)))
    return jax.lax.stop_gradient(jnp.where(unit, size, jnp.pi))


def farthest(mech: Mechanism, centre: Any, scale: jax.Array, direction: jax.Array) -> jax.Array:
    """How far a ray y = t direction goes: until a shift, or a turn, is as large as it can be. -> ()"""
    far = jnp.asarray(jnp.inf, direction.dtype)
    is_length = np.asarray(pose_units(centre, mech.pose_units), bool)
    for part in (is_length, ~is_length):
        if part.any():
            speed = jnp.sqrt(jnp.sum((direction / scale)[part] ** 2))
            far = jnp.minimum(far, 1 / jnp.where(speed > 0, speed, 1e-30))
    return far
