"""A mechanism and its Jacobians as text."""

from __future__ import annotations

import dataclasses
import json
from typing import Any, NamedTuple

import jax
import numpy as np

from pk_jax.files.mechanism_file import ANGLES, DIRECTIONS, NOT_IN_FILES
from pk_jax.files.named import Named, source_of
from pk_jax.files.python_file import is_python
from pk_jax.files.stream import (
    free_of,
    joint_layouts,
    joints_columns,
    output_layout,
    pose_columns,
    pose_of,
)
from pk_jax.kinematics.jacobian import joint_jacobian, pose_jacobian, scaled_jacobians, velocity_jacobian
from pk_jax.status import Status


class Jacobians(NamedTuple):
    """A, B and J in metres and radians at a configuration in the unit of the user."""

    unit: str
    pose: dict[str, float]
    joints: dict[str, float]
    status: str
    a: np.ndarray
    b: np.ndarray
    j: np.ndarray
    sigma_a: float  # least singular values of A and B without units
    sigma_b: float


def configuration_at(
    named: Named, text: str | None, branch: Any = None, free: str | None = None
) -> tuple[Any, jax.Array, Status]:
    """Home, or the pose that `text` says, with its joints. ValueError where it has none."""
    if text is None and free is None:
        return *named.mechanism.home(), Status.OK
    pose = named.mechanism.home()[0] if text is None else pose_of(named, text)
    joints, status = free_of(named, free)(pose, branch)
    status = Status(int(status))
    if status not in (Status.OK, Status.SINGULAR):  # where a leg is stretched it can be looked at, too
        raise ValueError(f"--pose {text} is {status.name}: there are no joints for it")
    return pose, joints, status


def jacobians_at(named: Named, text: str | None, free: str | None = None) -> Jacobians:
    """A, B and J at home or at a pose."""
    mech = named.mechanism
    pose, joints, status = configuration_at(named, text, free=free)
    scaled = scaled_jacobians(mech, pose, joints)
    least = lambda matrix: float(np.linalg.svd(matrix, compute_uv=False)[-1])
    a, b, j = (f(mech, pose, joints) for f in (pose_jacobian, joint_jacobian, velocity_jacobian))
    return Jacobians(
        named.unit,
        *_configuration(named, pose, joints),
        status.name,
        *map(np.asarray, (a, b, j)),
        least(scaled.pose[: mech.actuated_rows]),
        least(scaled.joints),
    )


def as_json(found: dict[str, Any]) -> str:
    """Strict JSON; what is not finite is null."""
    return json.dumps(_finite(found), indent=2, allow_nan=False)


def as_text(found: Jacobians) -> str:
    lines = [_line("pose", found.pose, found.unit), _line("joints", found.joints, found.unit)]
    if found.status != "OK":
        lines.append(f"status {found.status}")
    for title, matrix in (("A = dF/dx", found.a), ("B = dF/dq", found.b), ("J, x' = J q'", found.j)):
        lines += [f"\n{title}, {matrix.shape[0]} x {matrix.shape[1]}, m and rad", *map(_row, matrix)]
    lines.append(f"\nleast singular value without units: A {found.sigma_a:.6g}, B {found.sigma_b:.6g}")
    return "\n".join(lines)


def describe(named: Named) -> str:
    """Name, source, family, fields, home, length and margins."""
    mech = named.mechanism
    pose, joints = mech.home()
    lines = [named.name, *filter(None, [source_of(named)])]
    lines.append(f"\nfamily {type(mech).__name__}, {_lengths(named.unit)}, angles in rad")
    own = is_python(named.path)  # of its fields nobody knows which are lengths
    if own and named.metres != 1:
        lines.append("fields as in the file, lengths in m")
    for field in dataclasses.fields(mech):
        if (value := getattr(mech, field.name)) is not None and field.name not in NOT_IN_FILES:
            is_length = not own and field.name not in (*ANGLES, *DIRECTIONS)
            lines += _field(field.name, np.asarray(value) / (named.metres if is_length else 1))
    values = _configuration(named, pose, joints)
    lines += [
        "",
        *(_line(f"home {name}", v, named.unit) for name, v in zip(("pose", "joints"), values, strict=True)),
    ]
    lines.append(f"length {float(mech.length()) / named.metres:.9g}")
    for name, margin in mech.margins(pose, joints).items():
        lines.append(f"margin {name}: {', '.join(f'{v:.6g}' for v in np.atleast_1d(margin))}")
    return "\n".join(lines)


def _configuration(named: Named, pose: Any, joints: jax.Array) -> tuple[dict[str, float], dict[str, float]]:
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], pose)
    numbers = pose_columns(named, batch), joints_columns(named, np.asarray(joints)[None])
    layouts = output_layout(named), joint_layouts(named)[0]
    named_numbers = [
        {column.name: float(number[0]) for column, number in zip(layout, columns, strict=True)}
        for layout, columns in zip(layouts, numbers, strict=True)
    ]
    return named_numbers[0], named_numbers[1]


def _line(title: str, values: dict[str, float], unit: str) -> str:
    return (
        f"{title}: {', '.join(f'{name} {value:.9g}' for name, value in values.items())}  ({_lengths(unit)})"
    )


def _lengths(unit: str) -> str:
    return "lengths without a unit" if unit == "1" else f"lengths in {unit}"


def _field(name: str, value: np.ndarray) -> list[str]:
    if value.ndim < 2:
        return [f"{name} {', '.join(f'{v:.9g}' for v in np.atleast_1d(value))}"]
    return [name, *(_row(row) for row in value.reshape(-1, value.shape[-1]))]


def _row(row: np.ndarray) -> str:
    return "".join(f"{value:15.7g}" for value in row)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, np.ndarray | list):
        return [_finite(each) for each in (value.tolist() if isinstance(value, np.ndarray) else value)]
    return None if isinstance(value, float) and not np.isfinite(value) else value
