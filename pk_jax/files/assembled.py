"""Assembly modes, as the command line says, shows and writes them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from pk_jax.files.columns import Layout
from pk_jax.files.named import Named
from pk_jax.files.rows_file import format_rows, open_rows, parse_row
from pk_jax.files.stream import joint_layouts, joints_columns, output_layout, pose_columns, scale_of
from pk_jax.kinematics.batching import is_possible
from pk_jax.kinematics.modes.assembly import STARTS, AssemblyModes, Fate, assembly_modes
from pk_jax.kinematics.modes.roadmap import Link, connect_modes
from pk_jax.status import Status

TO_HOME = {Link.PATH: "path", Link.IMPOSSIBLE: "no: det changes sign", Link.NOT_FOUND: "not found"}
QUATERNION = ("qw", "qx", "qy", "qz")
_SIGNS = {1: "+", -1: "-", 0: "0"}


class Assembled(NamedTuple):
    """Rows of joints, in m and rad, and the modes of each."""

    named: Named
    joints: np.ndarray  # (rows, m)
    modes: list[AssemblyModes]  # each without a batch
    to_home: list[np.ndarray] | None  # each (slots,)


def joints_of(named: Named, text: str | None) -> np.ndarray:
    """The joints that an option says; those at home where it says nothing. -> (1, m)"""
    if text is None:
        return np.asarray(named.mechanism.home()[1])[None]
    layout, row = parse_row("--joints", text, joint_layouts(named))
    joints = row * scale_of(named, layout)
    if not is_possible(named.mechanism, joints):
        wanted = "positive and finite" if named.mechanism.joints_are_distances else "finite"
        raise ValueError(f"--joints must be {wanted}, got {text}")
    return joints[None]


def joints_in(named: Named, source: str, columns: str | None) -> np.ndarray:
    """The joints of a CSV file as `fk` reads it. -> (rows, m)"""
    with open_rows(source, joint_layouts(named), unit=named.unit, columns=columns) as reader:
        return np.concatenate(list(reader)) * scale_of(named, reader.layout)


def assembled(
    named: Named, joints: np.ndarray, *, connect: bool = False, report: Callable[..., None] | None = None
) -> Assembled:
    """All modes of every row, and where it is asked for which of them can be reached from home."""
    mech, is_many = named.mechanism, len(joints) > 1
    found = jax.device_get(assembly_modes(mech, joints, report=report if is_many else None))
    modes = [_picked(found, k) for k in range(len(joints))]
    if not connect:
        return Assembled(named, joints, modes, None)
    to_home = []
    for done, (row, each) in enumerate(zip(joints, modes, strict=True), 1):
        to_home.append(connect_modes(mech, row, each).to_home)
        if report is not None and is_many:
            report("paths from home: rows", done, len(joints))
    return Assembled(named, joints, modes, to_home)


def refuse_same(output: str | None, named: Named, rows: str | None) -> None:
    """ValueError where the output would take the place of an input."""
    for what, path in (("mechanism", named.path), ("input", rows)):
        if output and path not in (None, "-") and _is_same(path, output):
            raise ValueError(f"the output {output} is the {what} file: it must be another one")


def _is_same(first: str, second: str) -> bool:
    with contextlib.suppress(OSError):
        return os.path.samefile(os.path.expanduser(first), os.path.expanduser(second))
    return False


# --- as text


def modes_text(one: Assembled) -> str:
    """A statement and a table of the modes; of many rows of joints, a line each."""
    return _one_row(one) if len(one.joints) == 1 else _many_rows(one)


def _one_row(one: Assembled) -> str:
    named, modes = one.named, one.modes[0]
    count = int(modes.count)
    values = [float(column[0]) for column in joints_columns(named, one.joints)]
    given = zip(_names(joint_layouts(named)[0]), values, strict=True)
    lines = [
        f"{named.name}: {_counted(count, 'real mode')}",
        f"joints: {', '.join(f'{name} {value:.9g}' for name, value in given)}",
        because(modes),
        f"{modes.method}: {_tally(modes)}, retries {int(modes.retries)}",
    ]
    if count:
        lengths = "lengths without a unit" if named.unit == "1" else f"lengths in {named.unit}"
        lines += [f"\n{lengths}, angles in rad; det A against its sign at home", *_table(one)]
    return "\n".join(lines)


def because(modes: AssemblyModes) -> str:
    """Whether these are all modes, and why."""
    if modes.status == Status.BAD_INPUT:
        return "not complete: such joints are none"
    if modes.is_complete and modes.expected < 0:
        return "complete: all that the closed form knows"
    if modes.is_complete and modes.method == "closed form":
        return f"complete: all {int(modes.expected)} solutions of the closed form, real and complex"
    if modes.is_complete:
        return f"complete: all {int(modes.expected)} solutions, real and complex, are accounted for"
    if modes.method == "search":
        return f"not complete: a search from {STARTS} poses cannot know whether there are more"
    if lost := int(np.sum(modes.fates == Fate.LOST)):
        return f"not complete: {_counted(lost, 'path')} lost, {int(modes.expected)} solutions expected"
    return f"not complete: {int(modes.expected)} solutions expected, and that number is not sure"


def _table(one: Assembled) -> list[str]:
    named, real = one.named, _picked(one.modes[0], one.modes[0].is_real)
    poses = zip(output_layout(named), pose_columns(named, real.poses), strict=True)
    columns = {c.name: [f"{v:.6g}" for v in values] for c, values in poses if c.name not in QUATERNION}
    columns = {"mode": [f"{k}" for k in range(1, len(real.is_real) + 1)]} | columns
    columns["det A"] = [_SIGNS[int(sign)] for sign in real.det_sign]
    columns["sigma_min"] = [f"{sigma:.3g}" for sigma in real.sigma_min]
    columns["mirror"] = [f"{slot + 1}" if slot >= 0 else "none" for slot in real.mirror]
    columns["certified within"] = _radii(named, real)
    if one.to_home is not None:
        columns["from home"] = [TO_HOME[int(link)] for link in one.to_home[0][one.modes[0].is_real]]
    return _aligned(columns)


def _radii(named: Named, real: AssemblyModes) -> list[str]:
    radii = zip(real.is_certified, real.radius / named.metres, strict=True)
    return [f"{radius:.1e}" if is_certified else "no" for is_certified, radius in radii]


def _aligned(columns: dict[str, list[str]]) -> list[str]:
    """Columns of text under their names, to the right."""
    each = [[name, *values] for name, values in columns.items()]
    widths = [max(map(len, column)) for column in each]
    rows = zip(*each, strict=True)
    return ["   ".join(f"{text:>{w}}" for text, w in zip(row, widths, strict=True)) for row in rows]


def _many_rows(one: Assembled) -> str:
    real = sum(int(modes.count) for modes in one.modes)
    complete = sum(bool(modes.is_complete) for modes in one.modes)
    columns = {
        "row": [f"{k}" for k in range(1, len(one.modes) + 1)],
        "real": [f"{modes.count}" for modes in one.modes],
        "expected": [f"{modes.expected}" if modes.expected >= 0 else "?" for modes in one.modes],
        "status": [Status(int(modes.status)).name for modes in one.modes],
    }
    if one.to_home is not None:
        columns["from home"] = [f"{np.sum(links == Link.PATH)}" for links in one.to_home]
    columns["fates"] = [_tally(modes) for modes in one.modes]
    head = (
        f"{one.named.name}: {_counted(real, 'real mode')} of {len(one.modes)} rows of joints, "
        f"{complete} of them complete; {one.modes[0].method}"
    )
    return "\n".join([head, "", *_aligned(columns)])


def _tally(modes: AssemblyModes) -> str:
    return ", ".join(f"{count} {fate}" for fate, count in modes.tally().items())


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


# --- as a file


def modes_csv(one: Assembled) -> str:
    """Every real mode as CSV, lengths in the unit of the user, which is in the header.

    Joints without a mode have one line, with mode 0 and NaN.
    """
    named = one.named
    header = ["row", "mode", "status", *(_with_unit(named, c.name, c.kind) for c in output_layout(named))]
    header += [
        "residual",
        "det_sign",
        "sigma_min",
        "mirror",
        "certified",
        _with_unit(named, "radius", "length"),
    ]
    header += [] if one.to_home is None else ["to_home"]
    text = ",".join(header) + "\n"
    for k, modes in enumerate(one.modes):
        to_home = None if one.to_home is None else one.to_home[k]
        text += format_rows(_csv_columns(named, k + 1, modes, to_home))
    return text


def _csv_columns(named: Named, row: int, modes: AssemblyModes, to_home: np.ndarray | None) -> list[Any]:
    is_there = modes.is_real if modes.count else np.arange(len(modes.is_real)) < 1
    shown = _picked(modes, is_there)
    count = len(shown.is_real)
    columns = [
        np.full(count, row),
        np.cumsum(shown.is_real),
        [Status(int(modes.status)).name] * count,
        *pose_columns(named, shown.poses),
        shown.residual,
        [f"{sign:.0f}" for sign in shown.det_sign],
        shown.sigma_min,
        shown.mirror + 1,  # 0: none
        shown.is_certified.astype(int),
        shown.radius / named.metres,
    ]
    return columns if to_home is None else [*columns, to_home[is_there].astype(int)]


def _with_unit(named: Named, name: str, kind: str) -> str:
    unit = {"length": "" if named.unit == "1" else named.unit, "angle": "rad"}.get(kind, "")
    return f"{name}_{unit}" if unit else name


def _picked(modes: AssemblyModes, rows: Any) -> AssemblyModes:
    """Some of the rows of a batch, or some of the slots of one."""
    return AssemblyModes(
        *(jax.tree.map(lambda leaf: leaf[rows] if np.ndim(leaf) else leaf, field) for field in modes[:-1]),
        modes.method,
    )


def _names(layout: Layout) -> list[str]:
    return [column.name for column in layout]
