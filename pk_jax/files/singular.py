"""Singularities as text and as rows of a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from pk_jax.analysis.loci import SingularityLocus, singularity_locus
from pk_jax.analysis.singularity import SingularityKind, classify_singularity
from pk_jax.files.named import Named
from pk_jax.files.options import ranges_of, signs_of
from pk_jax.files.rows_file import format_rows
from pk_jax.files.stream import free_numbers, joint_layouts, joints_columns, output_layout, pose_columns
from pk_jax.kinematics.statics import screws


def classified(named: Named, at: Any, joints: jax.Array, tol: float) -> dict[str, Any]:
    """What kind of singularity a configuration is, how far from one, and its screws; m and rad."""
    mech = named.mechanism
    found = classify_singularity(mech, at, joints, tol=tol)
    lines = screws(mech, at, joints)
    return {
        "pose": dict(zip(_names(output_layout(named)), _one(pose_columns, named, at), strict=True)),
        "joints": dict(
            zip(_names(joint_layouts(named)[0]), _one(joints_columns, named, joints), strict=True)
        ),
        "unit": named.unit,
        "kind": SingularityKind(int(found.kind)).name,
        "sigma_inverse": float(found.sigma_inverse),
        "sigma_direct": float(found.sigma_direct),
        "sigma_configuration": float(found.sigma_configuration),
        "length": float(found.length),
        "lines": np.asarray(lines.lines).tolist(),
        "arms": np.asarray(lines.arms).tolist(),
    }


def classified_text(found: dict[str, Any]) -> str:
    unit = "lengths without a unit" if found["unit"] == "1" else f"lengths in {found['unit']}"
    show = lambda values: ", ".join(f"{name} {value:.9g}" for name, value in values.items())
    lines = [
        f"pose: {show(found['pose'])}  ({unit})",
        f"joints: {show(found['joints'])}  ({unit})",
        f"\n{found['kind']}, lengths measured in {found['length']:.6g}{'' if found['unit'] == '1' else ' m'}",
        f"distance to type I (inverse)   {found['sigma_inverse']:.6g}",
        f"distance to type II (direct)   {found['sigma_direct']:.6g}",
        f"independence of the equations  {found['sigma_configuration']:.6g}",
        "\nscrew of each actuator: unit wrench, and its arm (m and rad)",
    ]
    for line, arm in zip(found["lines"], found["arms"], strict=True):
        lines.append("".join(f"{value:13.6g}" for value in line) + f"   arm {arm:.6g}")
    return "\n".join(lines)


def locus_of(
    named: Named,
    axes: str | None,
    at: Any,
    ranges: Sequence[str],
    branch: str | None,
    kinds: Sequence[str],
    nodes: int | None,
    report: Any,
    free: str | None = None,
) -> SingularityLocus:
    """`singularity_locus` of what the command line says; lengths in the unit of the user, angles in rad."""
    mech = named.mechanism
    given = ranges_of(named, ranges)
    chosen = tuple(axes.split(",")) if axes else tuple(given) or None
    box = None
    if given:
        if set(given) != set(chosen or ()):
            raise ValueError(f"--range must be given for each of --axes {','.join(chosen)}, or for none")
        box = [given[name] for name in chosen]
    held = None if free is None else free_numbers(named, free)
    options = {"branch": signs_of(branch), "free": held, "kinds": kinds, "nodes": nodes}
    return singularity_locus(mech, chosen, at=at, ranges=box, report=report, **options)


def locus_text(named: Named, locus: SingularityLocus) -> str:
    """A table of the curves."""
    unit = "" if named.unit == "1" else f" {named.unit}"
    lines = [f"{named.name} over {', '.join(locus.axes)}, working modes: {max(len(locus.branches), 1)}"]
    for name, line, is_length in zip(locus.axes, locus.nodes, locus.units, strict=True):
        per, what = (named.metres, unit) if is_length else (1.0, " rad")
        lines.append(f"  {name:4} {line[0] / per:.6g} .. {line[-1] / per:.6g}{what}, {len(line)} nodes")
    for kind, mode in locus.everywhere:
        lines.append(f"{kind.name} everywhere in working mode {_signs(mode)}")
    lines.append(f"\n{'kind':9}{'points':>7}  {'':8}{'largest sigma':14}  extent")
    for curve in locus.curves:
        shape = "point" if len(curve.sigma) == 1 else "closed" if curve.is_closed else "open"
        ends = np.stack([curve.coordinates.min(axis=0), curve.coordinates.max(axis=0)], axis=1)
        per = [named.metres if is_length else 1.0 for is_length in locus.units]
        spans = ", ".join(
            f"{name} {low / p:.5g}..{high / p:.5g}"
            for name, (low, high), p in zip(locus.axes, ends, per, strict=True)
        )
        lines.append(f"{curve.kind.name:9}{len(curve.sigma):7}  {shape:8}{curve.sigma.max():<14.1e}  {spans}")
    if not locus.curves:
        lines.append("none found")
    return "\n".join(lines)


def locus_rows(named: Named, locus: SingularityLocus) -> str:
    """Every point of every curve as CSV, in the unit of the user."""
    poses, joints = _names(output_layout(named)), _names(joint_layouts(named)[0])
    text = ",".join(["curve", "kind", *poses, *joints, "mode", "sigma"]) + "\n"
    for number, curve in enumerate(locus.curves, 1):
        count = len(curve.sigma)
        columns = [
            [str(number)] * count,
            [curve.kind.name] * count,
            *pose_columns(named, curve.pose),
            *joints_columns(named, curve.joints),
            [_signs(row) for row in curve.branch],
            curve.sigma,
        ]
        text += format_rows(columns)
    return text


def _names(layout: Any) -> list[str]:
    return [column.name for column in layout]


def _one(columns: Any, named: Named, value: Any) -> list[float]:
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], value)
    return [float(number[0]) for number in columns(named, batch)]


def _signs(mode: Any) -> str:
    return "".join("+" if s > 0 else "-" if s < 0 else "0" for s in mode)
