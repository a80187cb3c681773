"""Singularities: a robot with its screws, and the loci over its workspace."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pk_jax.analysis.loci import SingularityLocus
from pk_jax.analysis.singularity import SingularityKind, classify_singularity, scaled_rows
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import Turning, place, pose_units, position
from pk_jax.kinematics.statics import screws
from pk_jax.mechanisms.base import LegMechanism, Mechanism
from pk_jax.viz.skeleton import draw
from pk_jax.viz.style import (
    BLUE,
    GREEN,
    INK,
    SOFT,
    VERMILION,
    axes_or_new,
    axis_label,
    new_figure,
    panel_title,
)

MOST_PANELS = 16
_COLORS = {SingularityKind.TYPE_I: INK, SingularityKind.TYPE_II: VERMILION}
_NAMES = {
    SingularityKind.UNKNOWN: "no configuration",
    SingularityKind.REGULAR: "regular",
    SingularityKind.TYPE_I: "type I (inverse)",
    SingularityKind.TYPE_II: "type II (direct)",
    SingularityKind.TYPE_III: "type III (both)",
    SingularityKind.CONFIGURATION_SPACE: "configuration-space",
}


def kind_name(kind: Any) -> str:
    """A kind of singularity in words."""
    return _NAMES[SingularityKind(int(kind))]


def draw_screws(mech: Mechanism, pose: Any, joints: jax.Array, ax: Axes | None = None) -> Axes:
    """One configuration with the line of action of every actuator (blue, dashed).

    At a type II singularity the motion that stays free with the actuators locked is drawn too: the pole that
    the platform turns about (a cross), the direction that it slides in (an arrow), or the axis through
    the base's origin of an `AxisPose`. The lines go through the platform's origin where the pose has no turn.
    ValueError for a pose that is no position: its wrenches are not lines in space.
    """
    ax = draw(mech, pose, joints, ax)
    points = np.asarray(mech.skeleton(pose, joints).points)
    d = points.shape[1]
    is_position = pose_units(pose, mech.pose_units) in (((1, 1), (1, 1, 0)) if d == 2 else ((1, 1, 1),))
    if not isinstance(pose, Turning) and not is_position:
        raise ValueError(f"draw_screws needs a pose that is a position, that of {type(mech).__name__} is not")
    centre, size = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0).max()
    reach = 3 * size if d == 2 else 0.75 * size  # in the plane the frame cuts it
    for foot, force in _lines(mech, pose, joints, d):
        middle = foot + (centre - foot) @ force * force  # the part of the line that is in sight
        ends = middle + np.array([[-reach], [reach]]) * force
        ax.plot(*ends.T, color=BLUE, linewidth=1.1, linestyle=(0, (5, 3)), zorder=2)
    if isinstance(pose, AxisPose):
        _draw_free_axis(mech, pose, joints, ax, size)
    if d == 2:
        pole = _draw_free_motion(mech, pose, joints, ax, size)
        if pole is not None and np.max(np.abs(pole - centre)) < 1.5 * size:
            points = np.concatenate([points, pole[None]])
        margin = 0.16 * size
        ax.set_xlim(points[:, 0].min() - margin, points[:, 0].max() + margin)
        ax.set_ylim(points[:, 1].min() - margin, points[:, 1].max() + margin)
    return ax


def _lines(mech: Mechanism, pose: Any, joints: jax.Array, d: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """A point and the unit direction of the line of every actuator; pure couples have none."""
    if isinstance(pose, AxisPose):  # its wrenches do not tell what the guide bears
        if not isinstance(mech, LegMechanism):
            return []
        forces = np.asarray(mech.forces(pose, joints)[1])
        points = np.broadcast_to(place(pose, mech.attachments()), forces.shape)
        found = zip(points.reshape(-1, d), forces.reshape(-1, d), strict=True)
        return [(point, force / np.linalg.norm(force)) for point, force in found]
    origin = np.append(np.asarray(position(pose)), np.zeros(d))[:d]
    found = []
    for line in np.asarray(screws(mech, pose, joints).lines):
        if np.isfinite(line).all() and np.linalg.norm(line[:d]) > 0.5:
            found.append((origin + _foot(line[:d], line[d:]), line[:d]))
    return found


def _draw_free_axis(mech: Mechanism, pose: AxisPose, joints: jax.Array, ax: Axes, size: float) -> None:
    """The axis through O of the turn that locked actuators leave free, at a type II singularity."""
    kind = classify_singularity(mech, pose, joints).kind
    if kind not in (SingularityKind.TYPE_II, SingularityKind.TYPE_III):
        return
    a = np.asarray(scaled_rows(mech, pose, joints, mech.length())[0])
    turn = np.linalg.svd(a)[2][-1][1:]
    if np.linalg.norm(turn) > 1e-3:
        ends = np.array([[-0.6], [0.6]]) * size * turn / np.linalg.norm(turn)
        ax.plot(*ends.T, color=VERMILION, linewidth=2.0, linestyle="-.", zorder=5)


def _foot(force: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """The point of a line that is nearest to where its moment is taken."""
    if moment.size == 1 and force.size == 2:
        return moment[0] * np.array([force[1], -force[0]])
    return np.cross(force, moment) if moment.size == 3 else np.zeros_like(force)


def _draw_free_motion(
    mech: Mechanism, pose: Any, joints: jax.Array, ax: Axes, size: float
) -> np.ndarray | None:
    """The pole of the motion that locked actuators leave free, where it has one."""
    if classify_singularity(mech, pose, joints).kind not in (
        SingularityKind.TYPE_II,
        SingularityKind.TYPE_III,
    ):
        return None
    length = float(mech.length())
    a = np.asarray(scaled_rows(mech, pose, joints, mech.length())[0])
    twist = np.linalg.svd(a)[2][-1] * length ** np.asarray(pose_units(pose, mech.pose_units))
    at = np.asarray(pose)[:2]
    turn = twist[2] if twist.size == 3 else 0.0
    if abs(turn) * size > 1e-3 * np.linalg.norm(twist[:2]):
        pole = at + np.array([-twist[1], twist[0]]) / turn
        ax.plot(*pole, marker="X", markersize=9, color=VERMILION, zorder=6)
        return pole
    slide = 0.2 * size * twist[:2] / np.linalg.norm(twist[:2])
    for way in (slide, -slide):
        arrow = {"arrowstyle": "-|>", "color": VERMILION, "linewidth": 1.6}
        ax.annotate("", at + way, at, arrowprops=arrow, zorder=6, annotation_clip=False)
    return None


def singular_configurations(cases: Sequence[Any], columns: int = 4) -> Figure:
    """Robots in singular configurations, with screws; a case has figure, title, mechanism, pose, joints."""
    rows = -(-len(cases) // columns)
    figure = new_figure(3.3 * columns, 3.1 * rows)
    figure.set_layout_engine("constrained")  # panels of many shapes
    for number, case in enumerate(cases, 1):
        points = case.mechanism.skeleton(case.pose, case.joints).points
        panel = figure.add_subplot(rows, columns, number, projection="3d" if points.shape[1] == 3 else None)
        ax = draw_screws(case.mechanism, case.pose, case.joints, panel)
        found = classify_singularity(case.mechanism, case.pose, case.joints)
        label = f"Fig. {case.figure}: " if case.figure else ""
        ax.set_title(f"{label}{case.title}\n{kind_name(found.kind)}", fontsize="small")
        ax.tick_params(labelsize=7)
        ax.locator_params(nbins=4)
        ax.set(xlabel=None, ylabel=None, **({"zlabel": None} if points.shape[1] == 3 else {}))
    return figure


def draw_locus(mech: Mechanism, locus: SingularityLocus, *, unit: str = "", scale: float = 1.0) -> Figure:
    """The loci of every working mode over two axes, on a map of the distance to the nearest singularity.

    Type II vermilion, type I black; three axes: the curves in space. Lengths are divided by `scale` and
    labelled with `unit`.
    """
    scales = np.where(locus.units, scale, np.pi / 180)
    labels = [axis_label(n, u, unit) for n, u in zip(locus.axes, locus.units, strict=True)]
    if len(locus.axes) == 3:
        return _in_space(locus, scales, labels)
    modes = locus.branches[:MOST_PANELS]
    columns = {1: 1, 2: 2, 4: 2, 8: 4, 16: 4}.get(len(modes), min(len(modes), 4))
    rows = -(-len(modes) // columns)
    lines = [line / s for line, s in zip(locus.nodes, scales, strict=True)]
    tall = np.clip(np.ptp(lines[1]) / np.ptp(lines[0]), 0.5, 1.6) if len(set(locus.units)) == 1 else 0.9
    width = 5.0 if columns == 1 else 2.9
    figure = new_figure(width * columns + 0.8, (width * tall + 0.4) * rows)
    distance = np.fmin(locus.sigma_inverse, locus.sigma_direct)
    most = np.nanmax(distance) if np.isfinite(distance).any() else 1.0
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    image = None
    for index, (ax, mode) in enumerate(zip(panels.flat, modes, strict=False)):
        image = ax.pcolormesh(
            *lines, distance[index].T, cmap="Blues_r", vmin=0, vmax=most, shading="nearest", rasterized=True
        )
        for curve in locus.curves:
            in_mode = np.all((curve.branch == mode) | (curve.branch == 0), axis=1)
            values = np.where(in_mode[:, None], curve.coordinates, np.nan) / scales
            if curve.is_closed:
                values = np.concatenate([values, values[:1]])
            style = {"marker": "o", "markersize": 4} if len(values) == 1 else {"linewidth": 1.6}
            ax.plot(*values.T, color=_COLORS[curve.kind], **style)
        if len(modes) > 1:
            panel_title(ax, "(" + " ".join("+" if s > 0 else "\N{MINUS SIGN}" for s in mode) + ")")
        if all(locus.units):
            ax.set_aspect("equal")
        if locus.axes == ("x", "y"):
            _draw_base(mech, locus, ax, scale)
        ax.set_xlim(lines[0][0], lines[0][-1])
        ax.set_ylim(lines[1][0], lines[1][-1])
    for ax in panels.flat[len(modes) :]:
        ax.set_visible(False)
    for ax in panels[-1]:
        ax.set_xlabel(labels[0])
    for ax in panels[:, 0]:
        ax.set_ylabel(labels[1])
    figure.colorbar(image, ax=panels, label="distance to the nearest singularity", shrink=0.8)
    names = [kind for kind in _COLORS if locus.of(kind)]
    if names:
        handles = [Line2D([], [], color=_COLORS[kind], label=kind_name(kind)) for kind in names]
        figure.legend(handles=handles, loc="outside upper right", frameon=False, fontsize="small", ncols=2)
    return figure


def _draw_base(mech: Mechanism, locus: SingularityLocus, ax: Axes, scale: float) -> None:
    skeleton = mech.skeleton(*mech.home())
    if skeleton.points.shape[1] == 2 and skeleton.ground:
        points = np.asarray(skeleton.points)[list(skeleton.ground)] / scale
        ax.plot(*points.T, linestyle="none", marker="^", color=SOFT, markersize=6)


def _in_space(locus: SingularityLocus, scales: np.ndarray, labels: list[str]) -> Figure:
    figure = new_figure(6.0, 5.2)
    ax = axes_or_new(figure.add_subplot(projection="3d"))
    for curve, color in zip(locus.curves, _cycle(len(locus.curves)), strict=True):
        values = curve.coordinates / scales
        if curve.is_closed:
            values = np.concatenate([values, values[:1]])
        ax.plot(*values.T, color=color, linewidth=1.4, marker="o" if len(values) == 1 else None)
    for name, line, label, s in zip("xyz", locus.nodes, labels, scales, strict=True):
        getattr(ax, f"set_{name}lim")(line[0] / s, line[-1] / s)
        getattr(ax, f"set_{name}label")(label)
    ax.set_title(f"{len(locus.curves)} curves of {kind_name(SingularityKind.TYPE_II)}", fontsize="medium")
    return figure


def _cycle(count: int) -> list[str]:
    return [(VERMILION, BLUE, GREEN, INK, SOFT)[k % 5] for k in range(count)]
