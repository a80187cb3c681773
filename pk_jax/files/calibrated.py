"""A geometry identified from a logged CSV file, as the command line says and shows it."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from pk_jax.design.calibration import Calibration, calibrate, stewart_from_log
from pk_jax.files.columns import Column, Layout
from pk_jax.files.mechanism_file import UNITS, save_mechanism
from pk_jax.files.named import Named, named_mechanism
from pk_jax.files.rows_file import open_rows
from pk_jax.files.stream import as_pose, joint_layouts, pose_layouts, scale_of
from pk_jax.geometry import rotations
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.batching import home_shapes
from pk_jax.mechanisms.stewart import Stewart

_EULER = ("tx", "ty", "tz")


class Identified(NamedTuple):
    """A calibration, the mechanism by the name of its log, and the columns of its joints."""

    named: Named
    found: Calibration
    joints: Layout


def identified(
    log: str,
    nominal: str | None,
    unit: str | None,
    *,
    offsets: bool = False,
    columns: str | None = None,
    angles: str | None = None,
) -> Identified:
    """The geometry that a log says, from a nominal one on or, of a Stewart platform, from nothing.

    log:     CSV ("-": stdin) of poses and joints as `ik` and `fk` read them; poses in space also as
             x, y, z, tx, ty, tz in degrees
    angles:  the order in which the turns about x, y and z are multiplied, then such angles are expected;
             "xyz", R = Rx(tx) Ry(ty) Rz(tz), where the columns are called so
    """
    named = _of_any_platform(log, unit) if nominal is None else named_mechanism(nominal, unit)
    with open_rows(log, _layouts(named, angles), unit=named.unit, columns=columns) as reader:
        rows, layout = np.concatenate(list(reader)), reader.layout
    count = home_shapes(named.mechanism)[1].shape[0]
    of_pose, of_joints = layout[:-count], layout[-count:]
    poses = _poses(named, of_pose, rows[:, :-count], angles or "xyz")
    joints = rows[:, -count:] * scale_of(named, of_joints)
    mech = stewart_from_log(poses, joints, offsets=offsets) if nominal is None else named.mechanism
    found = calibrate(mech, poses, joints, offsets=offsets)
    return Identified(named._replace(mechanism=found.mechanism), found, of_joints)


def save(path: str, one: Identified) -> None:
    """The geometry as TOML, in the unit of the user."""
    save_mechanism(one.found.mechanism, path, unit=one.named.unit)


def identified_text(one: Identified) -> str:
    """Errors, every unknown with its deviation, and what the log does not say."""
    table, found = identified_table(one), one.found
    unit = _unit(one, one.joints[0].kind)  # every family of the house has joints of one kind
    lines = [
        f"{one.named.name}: {found.rows} of {len(found.row_status)} rows used",
        f"rms {table['rms']:.6g}{unit}, greatest {table['greatest']:.6g}{unit} ({table['greatest_at']})",
        f"{found.rank} of {len(found.unknowns)} unknowns determined, condition {table['condition']:.4g}\n",
    ]
    width = max(map(len, found.unknowns)) + 2
    lines.append(f"{'':{width}}{'found':>15}{'deviation':>15} {_units(one)}")
    for name, value, deviation in zip(found.unknowns, table["values"], table["deviations"], strict=True):
        lines.append(f"{name:{width}}{value:15.9g}{deviation:15.3g}")
    if found.unidentified:
        lines += ["\nnot determined: any multiple may be added of", *(f"  {c}" for c in found.unidentified)]
    lines.append(f"\nstatus {found.status.name} after {found.steps} steps")
    return "\n".join(lines)


def identified_table(one: Identified) -> dict[str, Any]:
    """The same as plain numbers, in the unit of the user and rad."""
    found, metres = one.found, one.named.metres
    scale = scale_of(one.named, one.joints)
    of_unknowns = np.full(len(found.unknowns), metres)
    if "offsets" in found.deviations:
        of_unknowns[-len(scale) :] = scale
    values = [np.ravel(getattr(found.mechanism, name)) for name in found.deviations if name != "offsets"]
    values.append(found.offsets if "offsets" in found.deviations else np.zeros(0))
    deviations = np.concatenate([np.ravel(each) for each in found.deviations.values()])
    errors = np.abs(found.errors / scale[: found.errors.shape[1]])
    row, joint = np.unravel_index(np.nanargmax(errors), errors.shape)
    return {
        "rows": found.rows,
        "rows_left_out": len(found.row_status) - found.rows,
        "unit": one.named.unit,
        "rms": float(np.sqrt(np.nanmean(errors**2))),
        "greatest": float(errors[row, joint]),
        "greatest_at": f"{one.joints[joint].name} of row {row + 1}",
        "rank": found.rank,
        "condition": float(found.singular_values[0] / found.singular_values[max(found.rank - 1, 0)]),
        "unknowns": list(found.unknowns),
        "values": np.concatenate(values) / of_unknowns,
        "deviations": deviations / of_unknowns,
        "unidentified": list(found.unidentified),
        "status": found.status.name,
        "steps": found.steps,
    }


def _units(one: Identified) -> str:
    length, joint = _unit(one, "length"), _unit(one, one.joints[0].kind)
    return f"{length}, offsets in{joint}" if "offsets" in one.found.deviations and joint != length else length


def _of_any_platform(log: str, unit: str | None) -> Named:
    """A Stewart platform whose numbers are not looked at: it says what the columns are."""
    unit = unit or "m"
    if unit not in UNITS:
        raise ValueError(f"--unit must be one of {', '.join(UNITS)}, got {unit!r}")
    return Named(Stewart.semi_regular(2.0, 1.0, 0.2, 0.2), log, unit, float(UNITS[unit]), None)


def _layouts(named: Named, angles: str | None) -> list[Layout]:
    poses = pose_layouts(named)
    if issubclass(type(home_shapes(named.mechanism)[0]), SE3):
        euler = (*poses[0][:3], *(Column(name, "degree") for name in _EULER))
        poses = [euler] if angles else [*poses, euler]
    elif angles:
        raise ValueError(f"--angles: the poses of {named.name} are not x, y, z and three turns")
    return [(*pose, *joints) for pose in poses for joints in joint_layouts(named)]


def _poses(named: Named, layout: Layout, rows: np.ndarray, order: str) -> Any:
    if layout[-1].kind != "degree":
        return as_pose(named, layout, rows)
    return SE3(rows[:, :3] * named.metres, _turned(order, np.deg2rad(rows[:, 3:])))


@partial(jax.jit, static_argnums=0)
def _turned(order: str, angles: jax.Array) -> jax.Array:
    """Rx, Ry and Rz of angles (rows, 3), multiplied in this order. -> (rows, 3, 3)"""
    first, second, third = ("xyz".index(axis) for axis in order)
    turn = jax.vmap(rotations.about, in_axes=(None, 0))
    return turn(first, angles[:, first]) @ turn(second, angles[:, second]) @ turn(third, angles[:, third])


def _unit(one: Identified, kind: str) -> str:
    """After a space."""
    unit = "rad" if kind == "angle" else one.named.unit
    return "" if unit == "1" else f" {unit}"
