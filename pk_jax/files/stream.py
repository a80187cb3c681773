"""Forward and inverse kinematics of rows in a CSV file, chunk by chunk: files may be larger than memory."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

from pk_jax.analysis.redundancy import WAYS, resolve_redundancy
from pk_jax.analysis.slices import coordinate_names
from pk_jax.files.atomic import output_file
from pk_jax.files.columns import Column, Layout, is_number
from pk_jax.files.named import Named
from pk_jax.files.rows_file import CHUNK, format_rows, open_rows, parse_row
from pk_jax.geometry import rotations
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import Turning, pose_units, position
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.batching import home_shapes
from pk_jax.kinematics.forward import forward_kinematics
from pk_jax.kinematics.inverse import inverse_kinematics
from pk_jax.kinematics.linear_stage import ROWS
from pk_jax.kinematics.nine_lengths import nine_length_pose, require_nine_rows
from pk_jax.mechanisms.stewart import LEGS
from pk_jax.status import Status

Solve = Callable[[Layout, np.ndarray], tuple[list[Any], np.ndarray]]  # -> columns to write, statuses

_QUATERNION = ("qw", "qx", "qy", "qz")
_TURN = {SE3: ("rx", "ry", "rz"), AxisPose: ("roll", "pitch", "yaw")}
_PLACE = {SE3: 3, AxisPose: 1}  # columns before the turn
_KINDS = ("angle", "length")


def forward_rows(
    named: Named, source: str, target: str | None, *, certify: bool = False, **options: Any
) -> Counter[str]:
    """Poses of the joints in `source`, written to `target`; see `_stream`.

    certify:  prove of each pose how near the exact one is: a column more, NaN where that is not proved
    """
    header = [c.name for c in output_layout(named)]
    header += ["status", "residual", "steps", "sigma_min", "det_sign"]
    header += ["certified_within"] if certify else []
    solve = partial(_forward, named, _Padding(), certify)
    return _stream(named, source, target, joint_layouts(named), header, solve, **options)


def nine_length_rows(
    named: Named, source: str, target: str | None, *, sigma: str | None = None, **options: Any
) -> Counter[str]:
    """Poses of nine lengths by the closed form and the weighted estimate; see `_stream`.

    sigma:  standard deviations of a leg's length and a sensor's, in the unit of the user; default: equal.
            Where they are given, so are those of the pose
    """
    weights = _weights_of(named, sigma)
    header = [c.name for c in output_layout(named)]
    header += ["status", "residual", "steps", "sigma_min", "z_squared"]
    if weights is not None:
        header += [f"sd_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")]
    solve = partial(_nine_lengths, named, _Padding(), weights)
    return _stream(named, source, target, joint_layouts(named), header, solve, **options)


def _weights_of(named: Named, sigma: str | None) -> np.ndarray | None:
    require_nine_rows("--closed-form", named.mechanism)
    if sigma is None:
        return None
    fields = sigma.split(",")
    found = [float(field) * named.metres if is_number(field) else np.nan for field in fields]
    if len(found) != 2 or not all(np.isfinite(each) and each > 0 for each in found):
        raise ValueError(f"--sigma must be two positive numbers, of a leg and of a sensor, got {sigma!r}")
    return np.repeat(1 / np.square(found), [LEGS, ROWS - LEGS])


def inverse_rows(
    named: Named, source: str, target: str | None, *, free: str | None = None, **options: Any
) -> Counter[str]:
    """Joints of the poses in `source`, written to `target`; see `_stream` and `free_of`."""
    header = [c.name for c in joint_layouts(named)[0]] + ["status"]
    solve = partial(_inverse, named, _Padding(), free_of(named, free))
    return _stream(named, source, target, pose_layouts(named), header, solve, **options)


def _stream(
    named: Named,
    source: str,
    target: str | None,
    layouts: list[Layout],
    header: list[str],
    solve: Solve,
    *,
    columns: str | None = None,
    chunk: int = CHUNK,
    note: Callable[[str], None] = lambda _: None,
) -> Counter[str]:
    """Read, solve and write chunk by chunk; how many rows have which status.

    `source` "-" is stdin, `target` None or "-" stdout; a target file appears whole at the end or not at all.
    """
    is_file = target not in (None, "-")
    for name, path in (("input", source), ("mechanism", named.path)):
        if is_file and path not in (None, "-") and _is_same(path, target):
            raise ValueError(f"the output {target} is the {name} file: it must be another one")
    found, begun = Counter(), time.monotonic()
    with (
        open_rows(source, layouts, unit=named.unit, columns=columns, chunk=chunk) as reader,
        _output(target if is_file else None) as write,
    ):
        for rows in reader:
            if not found:
                write(",".join(header) + "\n")
                note("compiling")
            solved, status = solve(reader.layout, rows)
            write(format_rows(solved))
            found.update({Status(k).name: n for k, n in enumerate(np.bincount(status).tolist()) if n})
            if reader.fraction != 1:  # then all is said at the end
                done = found.total()
                part = "" if reader.fraction is None else f" ({reader.fraction:.0%})"
                note(f"{done} rows{part}  {done / (time.monotonic() - begun):.0f}/s")
    return found


@contextlib.contextmanager
def _output(target: str | None) -> Iterator[Callable[[str], Any]]:
    """Where text is written to; None: stdout."""
    if target is None:
        yield sys.stdout.write
        sys.stdout.flush()
        return
    with output_file(target) as file:
        yield lambda text: file.write(text.encode())


def _is_same(first: str, second: str) -> bool:
    with contextlib.suppress(OSError):
        return os.path.samefile(os.path.expanduser(first), os.path.expanduser(second))
    return False


# What the columns are


def joint_layouts(named: Named) -> list[Layout]:
    """The mechanism's own names of its joints; q1, ..., qm; or l1, ..., lm where all are lengths."""
    units = named.mechanism.joint_units or (1,) * home_shapes(named.mechanism)[1].shape[0]
    names = [[f"{a}{i}" for i in range(1, len(units) + 1)] for a in ("ql" if all(units) else "q")]
    if named.mechanism.joint_names is not None:
        names[:] = [named.mechanism.joint_names]
    return [tuple(Column(name, _KINDS[u]) for name, u in zip(each, units, strict=True)) for each in names]


def free_columns(named: Named) -> Layout:
    """The kinematically redundant joints."""
    layout = joint_layouts(named)[0]
    return layout[len(layout) - named.mechanism.free_joints :]


def pose_layouts(named: Named) -> list[Layout]:
    """Position, then quaternion or rotation vector (`AxisPose`: angles); or what an array pose holds."""
    layout, kind = _position(named), type(home_shapes(named.mechanism)[0])
    if not issubclass(kind, Turning):
        return [layout]
    return [(*layout, *_numbers(_QUATERNION)), (*layout, *_angles(_TURN[kind]))]


def output_layout(named: Named) -> Layout:
    layout, kind = _position(named), type(home_shapes(named.mechanism)[0])
    if not issubclass(kind, Turning):
        return layout
    return (*layout, *_numbers(_QUATERNION), *_angles(_TURN[kind]))


def _position(named: Named) -> Layout:
    pose = home_shapes(named.mechanism)[0]
    units = pose_units(pose, named.mechanism.pose_units)
    named_units = zip(coordinate_names(named.mechanism), units, strict=True)
    return tuple(Column(name, _KINDS[u]) for name, u in named_units)[: _PLACE.get(type(pose))]


def _numbers(names: tuple[str, ...]) -> Layout:
    return tuple(Column(name, "number") for name in names)


def _angles(names: tuple[str, ...]) -> Layout:
    return tuple(Column(name, "angle") for name in names)


# Rows in units of the user, and the solvers


def free_numbers(named: Named, text: str, words: tuple[str, ...] = ()) -> np.ndarray:
    """Values of the kinematically redundant joints in m and rad. words: what may be said instead."""
    layout = free_columns(named)
    if not layout:
        raise ValueError(f"--free: {named.name} has no kinematically redundant joint")
    fields = text.split(",")
    if len(fields) != len(layout) or not all(map(is_number, fields)):
        wanted = ",".join(column.name for column in layout)
        raise ValueError(f"--free must be {' or '.join((f'numbers {wanted}', *words))}, got {text!r}")
    return np.array([float(field) for field in fields]) * scale_of(named, layout)


def free_of(named: Named, text: str | None) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Inverse kinematics, (pose, branch) -> (joints, status), with the free joints that an option says.

    text: values of the kinematically redundant joints in the unit of the user, or what to choose them
    by, one of `WAYS`; default: as at home
    """
    mech = named.mechanism
    if text in WAYS:

        def solve(pose, branch=None):
            found = resolve_redundancy(mech, pose, text, branch)
            return found.joints, found.status

        return solve
    free = None if text is None else free_numbers(named, text, WAYS)

    def solve_at(pose, branch=None):
        found = inverse_kinematics(mech, pose, branch, free=free)
        return found.candidate, found.status

    return solve_at


def pose_of(named: Named, text: str, option: str = "--pose") -> Any:
    """The pose that an option says, as a row of `ik`."""
    layout, row = parse_row(option, text, pose_layouts(named))
    return jax.tree.map(lambda leaf: leaf[0], as_pose(named, layout, row[None]))


def pose_columns(named: Named, pose: Any) -> list[np.ndarray]:
    """The numbers of a batch of poses, in the unit of the user."""
    if not isinstance(pose, Turning):
        return [*np.asarray(pose).T / scale_of(named, _position(named))[:, None]]
    quaternion, turn = map(np.asarray, _from_rotation(pose))
    quaternion = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    return [*np.asarray(position(pose)).T / named.metres, *quaternion.T, *turn.T]


def joints_columns(named: Named, joints: Any) -> list[np.ndarray]:
    """The numbers of a batch of joints, in the unit of the user."""
    return [*np.asarray(joints).T / scale_of(named, joint_layouts(named)[0])[:, None]]


def _forward(
    named: Named, pad: _Padding, certify: bool, layout: Layout, rows: np.ndarray
) -> tuple[list[Any], np.ndarray]:
    found = forward_kinematics(named.mechanism, rows * scale_of(named, layout), certify=certify)
    poses = jax.tree.map(lambda leaf: pad(np.asarray(leaf)), found.pose)
    numbers = [column[: len(rows)] for column in pose_columns(named, poses)]
    status, residual, steps, sigma, signs = (np.asarray(each) for each in found[1:6])
    signs = [f"{sign:.0f}" for sign in signs.tolist()]
    proved = [np.asarray(found.radius) / named.metres] if certify else []
    return [*numbers, _names(status), residual, steps, sigma, signs, *proved], status


def _nine_lengths(
    named: Named, pad: _Padding, weights: np.ndarray | None, layout: Layout, rows: np.ndarray
) -> tuple[list[Any], np.ndarray]:
    found = nine_length_pose(named.mechanism, rows * scale_of(named, layout), weights)
    poses = jax.tree.map(lambda leaf: pad(np.asarray(leaf)), found.pose)
    numbers = [column[: len(rows)] for column in pose_columns(named, poses)]
    status, residual, steps, sigma, squared = map(
        np.asarray, (found.status, found.residual, found.steps, found.sigma_min, found.z_squared)
    )
    columns = [
        *numbers,
        _names(status),
        residual / named.metres,
        steps,
        sigma,
        squared / named.metres**2,
    ]
    if weights is not None:
        spread = np.sqrt(np.diagonal(np.asarray(found.covariance), axis1=1, axis2=2))
        columns += [*(spread / np.repeat([named.metres, 1.0], 3)).T]
    return columns, status


def _inverse(
    named: Named, pad: _Padding, solve: Callable, layout: Layout, rows: np.ndarray
) -> tuple[list[Any], np.ndarray]:
    joints, status = (np.asarray(each)[: len(rows)] for each in solve(as_pose(named, layout, pad(rows))))
    joints = np.where((status == Status.OK)[:, None], joints, np.nan)
    return [*joints_columns(named, joints), _names(status)], status


def as_pose(named: Named, layout: Layout, rows: np.ndarray) -> Any:
    rows = rows * scale_of(named, layout)
    kind = type(home_shapes(named.mechanism)[0])
    if kind not in _PLACE:
        return rows
    place, turn = np.split(rows, [_PLACE[kind]], axis=1)
    if turn.shape[1] == 4:
        with np.errstate(invalid="ignore"):  # a quaternion of zero length is no rotation: NaN, BAD_INPUT
            turn = turn / np.abs(turn).max(axis=1, keepdims=True)
    return _from_rows(kind, place, turn)


@partial(jax.jit, static_argnums=0)
def _from_rows(kind: type, place: jax.Array, turn: jax.Array) -> Any:
    if kind is AxisPose:
        to_matrix = rotations.from_quaternion if turn.shape[1] == 4 else rotations.from_angles
        return AxisPose(place[:, 0], jax.vmap(to_matrix)(turn))
    return (SE3.from_quaternion if turn.shape[1] == 4 else SE3.from_rotation_vector)(place, turn)


@jax.jit
def _from_rotation(pose: Any) -> tuple[jax.Array, jax.Array]:
    of_turn = rotations.to_angles if isinstance(pose, AxisPose) else rotations.to_rotation_vector
    return jax.vmap(rotations.to_quaternion)(pose.rotation), jax.vmap(of_turn)(pose.rotation)


def scale_of(named: Named, layout: Layout) -> np.ndarray:
    return np.array([named.metres if column.kind == "length" else 1.0 for column in layout])


class _Padding:
    """Fills batches up to a power of two, never a smaller one than before, so that few sizes are compiled."""

    def __init__(self) -> None:
        self.size = 2

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        self.size = max(self.size, 1 << (len(rows) - 1).bit_length())
        extra = np.broadcast_to(rows[-1:], (self.size - len(rows), *rows.shape[1:]))
        return np.concatenate([rows, extra])


def _names(status: np.ndarray) -> list[str]:
    names = [each.name for each in Status]
    return [names[k] for k in status.tolist()]
