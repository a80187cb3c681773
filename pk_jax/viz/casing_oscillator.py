"""Figures of the casing oscillator: its model, and its workspaces at several lengths of the casing."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pk_jax.analysis.workspace_map import Travel, WorkspaceMap
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.mechanisms.casing_oscillator import CasingOscillator
from pk_jax.viz.skeleton import draw
from pk_jax.viz.style import BLUE, INK, SOFT, TINT, VERMILION, axes_or_new, new_figure, panel_title
from pk_jax.viz.workspace_map import draw_boundary, draw_map, label_axes

MM = 1e-3


def model(mech: CasingOscillator, pose: AxisPose, joints: jax.Array, ax: Axes | None = None) -> Axes:
    """The kinematic model, joints and legs named (Fig. 2 of the paper)."""
    ax = axes_or_new(ax, width=5.6, height=5.0, projection="3d")
    points = np.asarray(mech.skeleton(pose, joints).points)
    size = np.ptp(points, axis=0).max()
    draw(mech, pose, joints, ax, linewidth=1.6)
    axis = points[[7, 8]] + np.array([[0.0], [0.18]]) * (points[8] - points[7])
    ax.plot(*axis.T, color=SOFT, linewidth=7, alpha=0.45, solid_capstyle="butt", zorder=1)
    names = ("B_1", "B_2", "B_3", "b_1", "b_2", "b_3", "b_4", "O", "C")
    for name, point in zip(names, points, strict=False):
        away = np.array([0.0, 0.0, -0.06 if name[0] in "BO" else 0.04]) * size
        ax.text(*(point + away), f"${name}$", ha="center", va="center", color=INK)
    for number, (start, end) in enumerate(((0, 3), (1, 4), (2, 5), (0, 6)), 1):
        middle = 0.55 * points[start] + 0.45 * points[end]
        ax.text(*(middle + [0.04 * size, 0, 0]), f"$l_{number}$", color=BLUE, ha="center")
    ax.text(*(points[[9, 10]].mean(axis=0) + [0, 0, 0.05 * size]), "$E$", color=VERMILION, ha="center")
    for name, way in zip("XYZ", np.eye(3), strict=True):
        tip = 0.28 * size * way
        ax.quiver(0, 0, 0, *tip, color=BLUE, linewidth=1.2, arrow_length_ratio=0.12)
        ax.text(*(1.12 * tip), f"${name}$", color=BLUE)
    ax.view_init(elev=20, azim=-52)
    return ax


def positional_workspace(
    slides: np.ndarray, spans: dict[str, tuple[Travel, Travel]], claimed: dict[str, float]
) -> Figure:
    """How far pitch and roll carry the platform's centre sideways, by the length of the casing (Fig. 3).

    spans: of "pitch" and "roll", with the carriage neutral (line), and anywhere (tint)
    claimed: the paper's travel, mm
    """
    figure = new_figure(8.2, 3.6)
    panels = figure.subplots(1, 2, sharey=True)
    for ax, (name, both) in zip(panels, spans.items(), strict=True):
        neutral, anywhere = ([slides * np.sin(end) / MM for end in found[:2]] for found in both)
        ax.fill_betweenx(slides / MM, *anywhere, color=TINT, label="carriage anywhere")
        for end in neutral:
            ax.plot(end, slides / MM, color=INK, label="carriage neutral" if end is neutral[0] else None)
        for side in (-0.5, 0.5):
            label = f"{claimed[name]:.0f} mm, the paper" if side > 0 else None
            ax.axvline(side * claimed[name], color=VERMILION, linestyle=":", label=label)
        ax.set_xlabel(f"travel of the centre by {name} (mm)")
        ax.legend(fontsize="small", loc="lower left", framealpha=0.9)
    panels[0].set_ylabel("$s$ (mm)")
    return figure


def orientation_workspace(maps: Sequence[WorkspaceMap], slides: Sequence[float], middle: int) -> Figure:
    """Orientations within the limits at several lengths of the casing (Figs. 4 and 5)."""
    figure = new_figure(9.4, 3.9)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    draw_map(maps[middle], left)
    panel_title(left, f"$s$ = {slides[middle] / MM:.0f} mm")
    shades = np.linspace(0.15, 0.85, len(maps))
    colors = [(VERMILION if k == middle else str(shade)) for k, shade in enumerate(shades)]
    for found, color in zip(maps, colors, strict=True):
        draw_boundary(found, right, color=color, linewidth=1.8)
    label_axes(maps[0], right)
    handles = [
        Line2D([], [], color=color, label=f"$s$ = {s / MM:.0f} mm")
        for s, color in zip(slides, colors, strict=True)
    ]
    right.legend(
        handles=handles, fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False
    )
    return figure
