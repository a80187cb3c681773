"""Workspaces within limits, and proofs about them, as the command line says and shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pk_jax import checks
from pk_jax.analysis.boxes import Certificate
from pk_jax.analysis.certificate import certify_confined, certify_regular
from pk_jax.analysis.integral import WorkspaceIntegral, workspace_integral
from pk_jax.analysis.slices import coordinate_names
from pk_jax.analysis.workspace_map import ANY, MOST_NODES, Travel, WorkspaceMap, travel, workspace_map
from pk_jax.files.named import Named
from pk_jax.files.options import ranges_of, signs_of, unit_name, units_of
from pk_jax.files.rows_file import format_rows
from pk_jax.files.stream import free_columns, free_numbers
from pk_jax.status import Status

BEYOND = 1.5  # times the travel: how far a map goes where no range is given


def map_of(
    named: Named,
    axes: str | None,
    at: Any,
    ranges: Sequence[str],
    mode: str | None,
    free: str | None,
    nodes: int | None,
) -> tuple[WorkspaceMap, dict[str, Travel]]:
    """The map that the command line says, and the travel of every coordinate about the same pose."""
    if nodes is not None:  # told before the travels are sought
        checks.is_count("nodes", nodes, least=2, most=MOST_NODES)
    mech, given = named.mechanism, ranges_of(named, ranges)
    free = free if free in (None, ANY) else free_numbers(named, free, (ANY,))
    options = {"at": at, "branch": signs_of(mode), "free": free}
    travels = {name: travel(mech, name, **options) for name in coordinate_names(mech)}
    chosen = tuple(axes.split(",")) if axes else tuple(given) or coordinate_names(mech)[:2]
    for name in chosen:
        ends = travels.get(name)
        if name not in given and ends is not None and np.isfinite(ends.lower + ends.upper):
            middle, half = (ends.lower + ends.upper) / 2, (ends.upper - ends.lower) / 2
            given[name] = (middle - BEYOND * half, middle + BEYOND * half)
    if unused := [name for name in given if name not in chosen]:
        raise ValueError(f"--range {unused[0]}: not one of --axes {','.join(chosen)}")
    box = [given[name] for name in chosen] if len(given) == len(chosen) else None
    return workspace_map(mech, chosen, ranges=box, nodes=nodes, **options), travels


def map_text(named: Named, found: WorkspaceMap, travels: dict[str, Travel]) -> str:
    """How much of the map is inside, what limits it, and the travels."""
    units = units_of(named)
    lines = [f"{named.name} over {', '.join(found.axes)}: {found.is_inside.mean():.2%} of the box is inside"]
    for name, nodes in zip(found.axes, found.nodes, strict=True):
        ends = nodes[0] / units[name], nodes[-1] / units[name]
        lines.append(f"  {name:6} {ends[0]:.6g} .. {ends[1]:.6g}{unit_name(named, name)}, {len(nodes)} nodes")
    beside = found.limit[~found.is_inside & (found.limit >= 0)]
    if beside.size:
        counts = np.bincount(beside, minlength=len(found.names)) / beside.size
        worst = sorted(zip(-counts, found.names, strict=True))[:6]
        lines.append("outside by " + ", ".join(f"{name} {-share:.0%}" for share, name in worst if share))
    lines.append("\ntravel of one coordinate, the others held")
    for name, ends in travels.items():
        low, high = (float(end) / units[name] for end in ends[:2])
        limits = " and ".join(str(each) or "none" for each in ends[2:])
        lines.append(f"  {name:6} {low:.9g} .. {high:.9g}{unit_name(named, name)}  (limits: {limits})")
    return "\n".join(lines)


def map_rows(named: Named, found: WorkspaceMap) -> str:
    """Every node as CSV: coordinates, smallest margin, which it is."""
    units = units_of(named)
    grid = np.meshgrid(
        *(line / units[n] for n, line in zip(found.axes, found.nodes, strict=True)), indexing="ij"
    )
    names = np.array([*found.names, ""])
    header = ",".join([*found.axes, "margin", "limit"]) + "\n"
    return header + format_rows(
        [*(each.ravel() for each in grid), found.margin.ravel(), names[found.limit.ravel()].tolist()]
    )


def certificates_of(
    named: Named, ranges: Sequence[str], at_least: float, within: str | None, most: int, report: Any
) -> dict[str, Certificate]:
    """What was proved: the box is regular; and, where it has all coordinates, it cannot be left."""
    mech, given = named.mechanism, ranges_of(named, ranges, with_free=True)
    if not given:
        raise ValueError("--range must be given: NAME=LOWER:UPPER, once for each coordinate of the box")
    margins = None if within is None else tuple(within.split(","))
    regular = dict(given)
    if mech.free_joints:
        names = [column.name for column in free_columns(named)]
        regular = dict(zip(names, np.asarray(mech.free_range()).tolist(), strict=True)) | regular
    found = {"regular": certify_regular(mech, regular, at_least=at_least, most=most, report=report)}
    poses = coordinate_names(mech)
    if set(poses) <= set(given):
        box = {name: given[name] for name in poses}
        found["confined"] = certify_confined(mech, box, within=margins, most=most, report=report)
    return found


def certificates_text(named: Named, found: dict[str, Certificate], at_least: float) -> str:
    units = units_of(named)
    box = next(iter(found.values()))
    lines = [f"{named.name} over"]
    for name, low, high in zip(box.names, box.lower, box.upper, strict=True):
        lines.append(
            f"  {name:6} {low / units[name]:.6g} .. {high / units[name]:.6g}{unit_name(named, name)}"
        )
    says = {
        "regular": f"no type II singularity in the box, |det A| over that at home exceeds {at_least:g}",
        "confined": "no way out of the box within the limits, starting from home",
    }
    for what, each in found.items():
        lines.append(f"{'PROVED' if each.is_proved else 'NOT PROVED'}: {says[what]} ({each.boxes} boxes)")
    return "\n".join(lines)


def integral_of(
    named: Named,
    indices: Sequence[str],
    ranges: Sequence[str],
    axes: str | None,
    clearance: float | None,
    rule: str | None,
    rays: int | None,
) -> WorkspaceIntegral:
    """Volume of the workspace, and integrals of the indices over it, as the command line says."""
    return workspace_integral(
        named.mechanism,
        tuple(indices),
        axes=axes,
        within=ranges_of(named, ranges) or None,
        clearance=clearance,
        rule=rule,
        rays=rays,
    )


def integral_text(named: Named, indices: Sequence[str], found: WorkspaceIntegral) -> str:
    """Every value with its estimated error, and which rays were not what they should be."""
    status = Status(int(found.status))
    lines = [f"{named.name}: {status.name}, lengths in {'its own unit' if named.unit == '1' else 'm'}"]
    entry = lambda name, value, error: f"{name:32}{float(value):.12g}  +- {float(error):.1e}"
    lines.append(entry("volume", found.volume, found.error.volume))
    for k, name in enumerate(indices):
        lines.append(entry(f"integral of {name}", found.integral[k], found.error.integral[k]))
        lines.append(entry(f"mean of {name}", found.mean[k], found.error.mean[k]))
    counts = {name: int(value) for name, value in found.counts._asdict().items()}
    lines.append(", ".join(f"{name} {value}" for name, value in counts.items() if value))
    return "\n".join(lines)
