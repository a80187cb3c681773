"""What a pose is, how it moves, and where it carries the platform's points.

A pose is an array of coordinates, moved by addition: (x, y) and (x, y, z) are translations,
(x, y, phi) with planar points is a planar rigid motion whose tangent is (x', y', phi'). Or it is
an `SE3`, moved by a translation and a rotation in base axes, or an `AxisPose`, a rotation and a slide along
the platform's own axis. Solvers carry planar rigid motions as
`Turned`, which moves without a cosine.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.planar import cross, direction, rotation, turn_onto
from pk_jax.geometry.rotations import cayley
from pk_jax.geometry.se3 import ORTHONORMAL_TO, SE3

Pose = Any  # jax.Array, SE3 or AxisPose; inside of solvers also Turned
Turning = SE3 | AxisPose  # with a rotation matrix


class Turned(NamedTuple):
    """A planar rigid motion with the tangent of (x, y, phi)."""

    translation: jax.Array  # (2,)
    direction: jax.Array  # (2,) cos(phi), sin(phi)


def turned(pose: jax.Array) -> Turned:
    """(x, y, phi) without its angle."""
    return Turned(pose[:2], direction(pose[2]))


def unturned(pose: Turned, near: jax.Array) -> jax.Array:
    """(x, y, phi), phi within half a turn of that of the pose `near` (3,)."""
    u, v = direction(near[2]), pose.direction
    return jnp.append(pose.translation, near[2] + jnp.arctan2(cross(u, v), jnp.sum(u * v)))


def is_pose(pose: Pose) -> jax.Array:
    """() False where a rotation is not orthonormal or a reflection."""
    if not isinstance(pose, Turning):
        return jnp.asarray(True)
    r = pose.rotation
    off = jnp.max(jnp.abs(r @ r.T - jnp.eye(3, dtype=r.dtype)))
    return (off <= ORTHONORMAL_TO) & (jnp.sum(r[2] * jnp.cross(r[0], r[1])) > 0)


def settle(pose: Pose) -> Pose:
    """The pose with its rotation made orthonormal to roundoff: the nearest one, by two Newton steps."""
    if not isinstance(pose, Turning):
        return pose
    r = pose.rotation
    for _ in range(2):
        r = r @ (3 * jnp.eye(3, dtype=r.dtype) - r.T @ r) / 2
    return like(pose, _shift(pose), r)


def like(pose: Turning, shift: jax.Array, rotation: jax.Array) -> Turning:
    """A pose of the same kind: `shift` is a translation (3,), or a slide ()."""
    return jax.tree.unflatten(jax.tree.structure(pose), (shift, rotation))


def _shift(pose: Turning) -> jax.Array:
    return pose.s if isinstance(pose, AxisPose) else pose.translation


def retract(pose: Pose, twist: jax.Array) -> Pose:
    """The pose reached from `pose` by the tangent increment `twist` (n,)."""
    if isinstance(pose, SE3):
        return like(pose, pose.translation + twist[:3], cayley(twist[3:]) @ pose.rotation)
    if isinstance(pose, AxisPose):
        return like(pose, pose.s + twist[0], cayley(twist[1:]) @ pose.rotation)
    if isinstance(pose, Turned):  # Cayley's map in the plane
        (c, s), half = pose.direction, twist[2] / 2
        cosine, sine = (1 - half * half) / (1 + half * half), 2 * half / (1 + half * half)
        around = jnp.stack([c * cosine - s * sine, s * cosine + c * sine])
        return Turned(pose.translation + twist[:2], around)
    return pose + twist


def difference(pose: Pose, other: Pose) -> jax.Array:
    """The tangent that retracts `pose` to `other`. -> (n,)"""
    if isinstance(pose, Turning):
        turn = other.rotation @ pose.rotation.T
        axial = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        return jnp.concatenate([position(other) - position(pose), 2 * axial / (1 + jnp.trace(turn))])
    return other - pose


def features(
    poses: Pose, declared: tuple[int, ...] | None, length: float, *, come_round: bool = True
) -> np.ndarray:
    """Known poses, batch first, as points (k, f) whose distances are those of the poses, without units.

    Of positions over `length`, and of turns by their chords, so that a full turn is none; angles that do not
    `come_round` as they are. `declared` as for `pose_units`.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(poses)]
    if isinstance(poses, Turning):
        shift, rotation = (leaf.reshape(len(leaf), -1) for leaf in leaves)
        return np.concatenate([shift / length, rotation / np.sqrt(2)], axis=1)
    units = (1,) * leaves[0].shape[1] if declared is None else declared
    angles, shifts = (leaves[0][:, np.equal(units, unit)] for unit in (0, 1))
    turns = [np.cos(angles), np.sin(angles)] if come_round else [angles]
    return np.concatenate([shifts / length, *turns], axis=1)


def tangent_size(pose: Pose) -> int:
    """n, the number of degrees of freedom."""
    if isinstance(pose, Turning):
        return 6 if isinstance(pose, SE3) else 4
    return 3 if isinstance(pose, Turned) else pose.shape[0]


def tangent_zero(pose: Pose) -> jax.Array:
    """The zero tangent at `pose`. -> (n,)"""
    return jnp.zeros(tangent_size(pose), position(pose).dtype)


def position(pose: Pose) -> jax.Array:
    """The coordinates of the pose that are not a rotation matrix. -> (d,)"""
    if isinstance(pose, AxisPose):
        return pose.s[..., None]
    return pose.translation if isinstance(pose, SE3 | Turned) else pose


def pose_units(pose: Pose, declared: tuple[int, ...] | None) -> tuple[int, ...]:
    """1 = length, 0 = angle, for every tangent coordinate; undeclared means all lengths."""
    if isinstance(pose, SE3):
        return (1, 1, 1, 0, 0, 0)
    if isinstance(pose, AxisPose):
        return (1, 0, 0, 0)
    if isinstance(pose, Turned):
        return (1, 1, 0)
    return (1,) * pose.shape[0] if declared is None else declared


def place(pose: Pose, points: jax.Array) -> jax.Array:
    """Platform points (k, d) from the platform frame into the base frame. -> (k, d)"""
    count, dimension = points.shape
    if isinstance(pose, SE3):
        return pose.translation + points @ pose.rotation.T
    if isinstance(pose, AxisPose):
        along = jnp.asarray([0.0, 0.0, 1.0], points.dtype)
        return (points + pose.s * along) @ pose.rotation.T
    if isinstance(pose, Turned):
        return pose.translation + points @ turn_onto(pose.direction).T
    if pose.shape == (dimension,):
        return pose + points
    if pose.shape == (3,) and dimension == 2:
        return pose[:2] + points @ rotation(pose[2]).T
    raise ValueError(f"a pose of shape {pose.shape} cannot carry points of shape {(count, dimension)}")


def place_jacobian(pose: Pose, points: jax.Array) -> jax.Array:
    """Velocity of every placed point per unit twist: the rigid-body map. -> (k, d, n)"""
    return jax.jacfwd(lambda twist: place(retract(pose, twist), points))(tangent_zero(pose))
