"""All assembly modes of a mechanism, side by side."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pk_jax.geometry.poses import place
from pk_jax.mechanisms.base import Mechanism, Skeleton
from pk_jax.viz.skeleton import draw, polyline
from pk_jax.viz.style import BLUE, GREEN, INK, SOFT, VERMILION, new_figure

VIEW = (22.0, -72.0)  # elevation and azimuth, degrees
MOST_LARGE = 8  # panels
HEAD, FOOT = 0.3, 0.35  # above each panel, of its side; below all, inches
FILLED = 1.55  # zoom at which a cube's width is nearly that of its axes
_COLORS = {1: BLUE, -1: VERMILION, 0: GREEN}
_SIGNS = {1: "+", -1: "\N{MINUS SIGN}", 0: "0"}
_SAYS = {1: "det $A$ as at home (+)", -1: "the other sign (\N{MINUS SIGN})", 0: "det $A$ without a sign"}


def draw_modes(mech: Mechanism, joints: Any, modes: Any, *, view: tuple[float, float] = VIEW) -> Figure:
    """Every real posture of `modes`, of one row of joints, at one scale and seen from one side.

    The base is dark, legs are grey, the platform has the colour of the sign of det A. ValueError where
    no mode is real, and for the modes of many rows.
    """
    if np.ndim(modes.count):
        raise ValueError(f"draw_modes takes the modes of one row of joints, got {len(modes.count)} rows")
    if not modes.count:
        raise ValueError("draw_modes takes modes of which at least one is real, got none")
    slots = np.flatnonzero(modes.is_real)
    signs = [int(modes.det_sign[k]) for k in slots]
    poses = [jax.tree.map(lambda leaf, k=k: leaf[k], modes.poses) for k in slots]
    skeletons = [mech.skeleton(pose, joints) for pose in poses]
    points = np.stack([np.asarray(each.points) for each in skeletons])
    panels = _panels(*points.shape[::2])
    for ax, k, pose, skeleton, sign in zip(panels, slots, poses, skeletons, signs, strict=True):
        is_small = len(slots) > MOST_LARGE
        draw(mech, pose, joints, ax, color=SOFT, linewidth=0.7 if is_small else 1.2, zorder=1)
        _emphasised(mech, pose, skeleton, ax, _COLORS[sign], 0.6 if is_small else 1.0)
        _framed(ax, points.reshape(-1, points.shape[2]), view)
        mirror = f"\nmirror of {modes.mirror[k] + 1}" if modes.mirror[k] >= 0 else ""
        _named(ax, f"mode {k + 1}  ({_SIGNS[sign]}){mirror}", 8 if is_small else 9)
    seen = [sign for sign in _COLORS if sign in signs]
    handles = [Line2D([], [], color=_COLORS[sign], linewidth=2.5, label=_SAYS[sign]) for sign in seen]
    figure = panels[0].figure
    figure.legend(handles=handles, loc="lower center", ncols=3, frameon=False, fontsize=8, borderaxespad=0.2)
    return figure


def _emphasised(mech: Mechanism, pose: Any, skeleton: Skeleton, ax: Axes, color: str, size: float) -> None:
    """The base and the platform over the legs, and all joints small enough for a small panel."""
    points, ground = np.asarray(skeleton.points), skeleton.ground
    for marks, scale in zip(ax.lines[1:], (4.5, 3.0), strict=True):
        marks.set(markersize=size * scale, color=INK)
    platform = _platform(mech, pose, points)
    for ends, ink, width in ((set(ground), INK, 1.1), (platform, color, 2.4)):
        bars = [each for each in skeleton.segments if ends.issuperset(each)]
        if bars:
            ax.plot(*polyline(points, tuple(bars)).T, color=ink, linewidth=size * width, zorder=2)
    ax.plot(*points[sorted(platform)].T, "o", color=color, markersize=size * 3.6, zorder=4)


def _platform(mech: Mechanism, pose: Any, points: np.ndarray) -> set[int]:
    """The points of a skeleton that the platform carries; all, where the mechanism doesn't say."""
    if not hasattr(mech, "attachments"):
        return set(range(len(points)))
    carried = np.asarray(place(pose, mech.attachments()))
    off = np.linalg.norm(points[:, None] - carried[None], axis=2).min(axis=1)
    return set(np.flatnonzero(off < 1e-9 * np.ptp(points)).tolist())


def _named(ax: Axes, text: str, size: float) -> None:
    write = ax.text2D if ax.name == "3d" else ax.text
    write(0.5, 1 + 0.85 * HEAD, text, transform=ax.transAxes, ha="center", va="top", fontsize=size, color=INK)


def _panels(count: int, dimension: int) -> list[Axes]:
    """Square axes without frames, side by side, each with room for its name above."""
    rows = max(1, round(np.sqrt(count / 1.6)))
    columns = -(-count // rows)
    side = 2.4 if count <= MOST_LARGE else 1.25
    figure = new_figure(side * columns, side * (1 + HEAD) * rows + FOOT)
    figure.set_layout_engine("none")
    height = (figure.get_figheight() - FOOT) / rows / figure.get_figheight()
    panels = []
    for k in range(count):
        row, column = divmod(k, columns)
        where = (column / columns, 1 - height * (row + 1), 1 / columns, height / (1 + HEAD))
        panels.append(figure.add_axes(where, projection="3d" if dimension == 3 else None))
        panels[-1].set_axis_off()
    return panels


def _framed(ax: Axes, points: np.ndarray, view: tuple[float, float]) -> None:
    """The picture of all points fills the axes."""
    frame = np.eye(2)
    if ax.name == "3d":
        ax.set_proj_type("ortho")
        ax.view_init(*view)
        elev, azim = np.deg2rad(view)
        right = np.array([-np.sin(azim), np.cos(azim), 0])
        toward = np.array([np.cos(elev) * np.cos(azim), np.cos(elev) * np.sin(azim), np.sin(elev)])
        frame = np.stack([right, np.cross(toward, right), toward])
    seen = points @ frame.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, half = frame.T @ (low + high) / 2, 0.5 * np.max((high - low)[:2])
    half *= 1.0 if ax.name == "3d" else 1.1
    ax.set(**{f"{name}lim": (at - half, at + half) for name, at in zip("xyz", middle, strict=False)})
    if ax.name == "3d":
        ax.set_box_aspect((1, 1, 1), zoom=FILLED)
