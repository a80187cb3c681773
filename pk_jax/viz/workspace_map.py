"""Workspaces within joint limits: the smallest margin over two coordinates."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from pk_jax.analysis.workspace_map import WorkspaceMap
from pk_jax.viz.style import INK, axes_or_new, axis_label


def draw_map(found: WorkspaceMap, ax: Axes | None = None, *, unit: str = "", scale: float = 1.0) -> Axes:
    """The smallest margin where it is not negative, and the boundary of the workspace as a black line.

    Over two axes. Lengths are divided by `scale` and labelled with `unit`, angles are in degrees.
    """
    if len(found.axes) != 2:
        raise ValueError(f"a map over two axes can be drawn, got {', '.join(found.axes)}")
    ax = axes_or_new(ax, width=5.2, height=4.2)
    x, y = in_units(found, scale)
    inside = np.where(found.is_inside, found.margin, np.nan)
    image = ax.pcolormesh(x, y, inside.T, cmap="Blues", vmin=0, shading="nearest", rasterized=True)
    draw_boundary(found, ax, scale=scale, color=INK)
    ax.figure.colorbar(image, ax=ax, label="smallest margin", shrink=0.85)
    label_axes(found, ax, unit)
    return ax


def draw_boundary(found: WorkspaceMap, ax: Axes, *, scale: float = 1.0, **line: object) -> None:
    """The boundary of a workspace: where the smallest margin is zero."""
    x, y = in_units(found, scale)
    margin = np.nan_to_num(found.margin, nan=-1.0)
    if margin.min() < 0 < margin.max():
        colors, widths = line.pop("color", INK), line.pop("linewidth", 1.4)
        ax.contour(x, y, margin.T, levels=[0.0], colors=[colors], linewidths=[widths], **line)


def label_axes(found: WorkspaceMap, ax: Axes, unit: str = "") -> None:
    for set_label, name, is_length in zip(
        (ax.set_xlabel, ax.set_ylabel), found.axes, found.units, strict=True
    ):
        set_label(axis_label(name, is_length, unit))


def in_units(found: WorkspaceMap, scale: float = 1.0) -> list[np.ndarray]:
    """The nodes of both axes, lengths over `scale`, angles in degrees."""
    return [line / (scale if u else np.pi / 180) for line, u in zip(found.nodes, found.units, strict=True)]
