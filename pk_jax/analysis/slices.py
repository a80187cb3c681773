"""Some coordinates of a pose vary, the others stay: planes and boxes in the workspace of any mechanism."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import Turning, like, pose_units, position, tangent_size
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.batching import all_finite, home_shapes, rows_of
from pk_jax.kinematics.in_blocks import padded
from pk_jax.kinematics.inverse import inverse_kinematics, working_modes
from pk_jax.mechanisms.base import Mechanism

SPACE = ("x", "y", "z", "rx", "ry", "rz")
ABOUT_AN_AXIS = ("s", "roll", "pitch", "yaw")
BLOCK = 2048  # poses solved at a time
COARSE = 32  # nodes along each axis when the reach is sought
FAR = 4  # times the size of the mechanism: where the reach is sought


def coordinate_names(mech: Mechanism) -> tuple[str, ...]:
    """Names of the coordinates of a pose: x, y, z of its position, rx, ry, rz of a turn from it, phi.

    Of an `AxisPose` they are its slide s and its angles roll, pitch, yaw.
    """
    pose = home_shapes(mech)[0]
    if isinstance(pose, Turning):
        return SPACE if isinstance(pose, SE3) else ABOUT_AN_AXIS
    unit = pose_units(pose, mech.pose_units)
    if unit == (1, 1, 0):
        return ("x", "y", "phi")
    if all(unit) and len(unit) <= 3:
        return SPACE[: len(unit)]
    return tuple(f"p{i}" for i in range(1, len(unit) + 1))


class Slice(NamedTuple):
    """The poses whose coordinates `axes` vary about `at`: a plane, or a box."""

    axes: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[int, ...]  # 1 = length, 0 = angle
    at: Any
    lower: np.ndarray  # (d,)
    upper: np.ndarray

    def pose(self, values: jax.Array) -> Any:
        return pose_on(self.at, self.axes, values)

    def grid(self, nodes: int) -> tuple[list[np.ndarray], Any]:
        """Nodes along each axis, and the poses of all, batch first, in row-major order."""
        lines = [np.linspace(lo, hi, nodes) for lo, hi in zip(self.lower, self.upper, strict=True)]
        values = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
        return lines, poses_on(self.at, self.axes, jnp.asarray(values, position(self.at).dtype))


def pose_on(at: Any, axes: tuple[int, ...], values: jax.Array) -> Any:
    """`at` with some coordinates replaced; turns of an `SE3` are rotation vectors counted from it."""
    axes = np.array(axes)
    if isinstance(at, AxisPose):
        all_four = jnp.append(at.s, rotations.to_angles(at.rotation)).at[axes].set(values)
        return like(at, all_four[0], rotations.from_angles(all_four[1:]))
    if not isinstance(at, SE3):
        return at.at[axes].set(values)
    all_six = jnp.concatenate([at.translation, jnp.zeros_like(at.translation)]).at[axes].set(values)
    turn = rotations.from_rotation_vector(all_six[3:])
    return like(at, all_six[:3], turn @ at.rotation)


def coordinates_of(poses: Any) -> np.ndarray:
    """Coordinates of a batch of poses; turns of an `SE3` are zero, being counted from it. -> (batch, n)"""
    if isinstance(poses, AxisPose):
        return np.column_stack([poses.s, poses.angles()])
    if isinstance(poses, SE3):
        return np.column_stack([poses.translation, np.zeros((len(poses.translation), 3))])
    return np.asarray(poses)


@partial(jax.jit, static_argnums=1)
def poses_on(at: Any, axes: tuple[int, ...], values: jax.Array) -> Any:
    """`pose_on` of many values (batch, d)."""
    return jax.vmap(lambda value: pose_on(at, axes, value))(values)


def joints_of(mech: Mechanism, poses: Any, branch: np.ndarray | None = None, free: Any = None) -> np.ndarray:
    """Joints of many poses in one working mode, NaN out of reach, in blocks of one size. -> (batch, m)

    Stretched and folded legs are given, too. free: values (k,) of kinematically redundant joints
    """
    if branch is None:
        branch = working_modes(mech)[0]
    signs = branch if len(branch) else None
    poses = jax.tree.map(np.asarray, poses)
    count = len(jax.tree.leaves(poses)[0])
    found = []
    for first in range(0, count, BLOCK):
        rows = jax.tree.map(lambda leaf, first=first: padded(leaf[first : first + BLOCK], BLOCK), poses)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # far poses are meant
            found.append(np.asarray(inverse_kinematics(mech, rows, signs, free=free).candidate))
    return np.concatenate(found)[:count]


def slice_of(
    mech: Mechanism, axes: Sequence[str] | None, at: Any = None, ranges: Any = None, *, most: int = 3
) -> Slice:
    """The slice that a user names; ValueError where it says none.

    axes:    two names of coordinates, or more; default: the first two
    at:      pose that has the other coordinates; default: home
    ranges:  ((lower, upper), ...) of the axes; default: what the mechanism reaches
    """
    names, joints = coordinate_names(mech), home_shapes(mech)[1].shape[0]
    if joints - mech.free_joints < len(names):
        raise ValueError(
            f"{type(mech).__name__} has {joints} joints for {len(names)} coordinates of its pose: a platform "
            "that is constrained fills no slice of them"
        )
    if axes is None:
        axes = names[:2]
    axes = checks.are_words("axes", axes)
    if not (2 <= len(axes) <= most and len(set(axes)) == len(axes) and set(axes) <= set(names)):
        raise ValueError(f"axes must be 2 to {most} different ones of {', '.join(names)}, got {axes}")
    home_pose = home_shapes(mech)[0]
    if at is None:
        at = mech.home()[0]
    else:
        at, many = rows_of("at", at, home_pose)
        if many:
            raise ValueError("at must be one pose, got a batch")
        if not bool(all_finite(at)):
            raise ValueError("at must be finite")
    if tangent_size(at) < 2:
        raise ValueError(f"{type(mech).__name__} has a single coordinate, a slice needs two")
    index = tuple(names.index(name) for name in axes)
    unit = pose_units(at, mech.pose_units)
    found = Slice(index, axes, tuple(unit[i] for i in index), at, np.zeros(len(axes)), np.zeros(len(axes)))
    if ranges is None:
        lower, upper = _reach(mech, found)
    else:
        ranges = checks.real_numpy("ranges", ranges)
        if ranges.shape != (len(axes), 2) or not np.all(np.isfinite(ranges)):
            raise ValueError(f"ranges must be finite, of shape {(len(axes), 2)}, got {ranges.tolist()}")
        lower, upper = ranges.T
        if not np.all(lower < upper):
            raise ValueError(f"ranges must be (lower, upper) with lower < upper, got {ranges.tolist()}")
    return found._replace(lower=np.asarray(lower, float), upper=np.asarray(upper, float))


def _reach(mech: Mechanism, found: Slice) -> tuple[np.ndarray, np.ndarray]:
    """A box a little wider than what inverse kinematics reaches; where that has no end, one about home."""
    home, joints = mech.home()
    is_joint_length = np.asarray(mech.joint_units or (1,) * len(joints), bool)
    size = float(mech.length()) + np.max(np.abs(np.asarray(joints))[is_joint_length], initial=0.0)
    centre = np.append(np.asarray(position(home)), np.zeros(3))[list(found.axes)]  # no angle at home
    is_length = np.asarray(found.units, bool)
    box = lambda half: (np.where(is_length, centre - half, -np.pi), np.where(is_length, centre + half, np.pi))
    half = np.full(len(centre), FAR * size)
    lower, upper = box(half)
    for attempt in range(8):
        lines, poses = found._replace(lower=lower, upper=upper).grid(COARSE)
        is_reached = np.isfinite(joints_of(mech, poses)).all(axis=1)
        grid = is_reached.reshape((COARSE,) * len(lines))
        if not grid.any():
            lower, upper = box(half := half / 3)
            continue
        if grid.all():  # no limit in sight: look farther, or be content
            if attempt >= 2 or not is_length.any():
                return box(np.full(len(centre), FAR / 2 * size))
            lower, upper = box(half := 3 * half)
            continue
        spans, is_cut = [], False
        for axis, line in enumerate(lines):
            inside = np.flatnonzero(grid.any(axis=tuple(k for k in range(len(lines)) if k != axis)))
            step = line[1] - line[0]
            if not is_length[axis]:
                spans.append((line[0], line[-1]))
                continue
            at_ends = inside[0] == 0, inside[-1] == COARSE - 1
            wide = [COARSE if at_end else 2 for at_end in at_ends]  # tips lie between the nodes
            is_cut |= any(at_ends)
            spans.append((line[inside[0]] - wide[0] * step, line[inside[-1]] + wide[1] * step))
        lower, upper = np.array(spans).T
        if not is_cut and attempt >= 3:
            break
    return lower, upper
