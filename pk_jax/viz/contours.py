"""Filled contours with labelled isolines on a grid that need not be rectangular."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from pk_jax.viz.style import INK

ROUNDOFF = 1e-5  # of the range of values, in float32


def contours(
    ax: Axes, x: Any, y: Any, values: Any, levels: np.ndarray, label: str, *, avoid: tuple = ()
) -> None:
    """Draw `values` (j, k) over the nodes x, y, isolines at `levels`, and a colour bar.

    x, y: (j, k), or the axes (k,) and (j,) of a rectangular grid. NaN is left white; what exceeds the
    last level keeps its colour, and the colour bar says so by an arrow. avoid: points (2,) to keep
    labels away from.
    """
    x, y = (x, y) if np.ndim(x) == 2 else np.meshgrid(x, y)
    is_capped = bool(np.nanmax(values) > levels[-1] + ROUNDOFF * (levels[-1] - levels[0]))
    # isolines cannot run to infinity, and the last one shall not trace roundoff
    values = np.ma.masked_invalid(np.minimum(values, 2 * levels[-1] if is_capped else levels[-1]))
    fine = np.linspace(levels[0], levels[-1], 6 * (len(levels) - 1) + 1)
    filled = ax.contourf(x, y, values, levels=fine, extend="max" if is_capped else "neither")

    dark = fine[len(fine) // 2]  # white lines on the dark half of the colours
    colors = ["white" if level < dark else INK for level in levels]
    lines = ax.contour(x, y, values, levels=levels, colors=colors, linewidths=0.7)
    ax.figure.colorbar(filled, ax=ax, label=label, ticks=levels)
    places = _label_places(np.stack([x, y], axis=-1), values, levels, avoid)
    if places:
        ax.figure.draw_without_rendering()  # labels are placed on the final layout
        ax.clabel(lines, fontsize=8, inline_spacing=3, manual=places)


def nice_levels(least: float, most: float, count: int = 12) -> np.ndarray:
    """Round numbers around [least, most]."""
    slack = ROUNDOFF * (most - least)  # a maximum of 1 + eps does not ask for a level 1.1
    return MaxNLocator(count, steps=[1, 2, 2.5, 5, 10]).tick_values(least + slack, most - slack)


def area_quantile(points: np.ndarray, values: np.ndarray, share: float) -> float:
    """The value that `share` of the area of a grid (j, k, 2) stays below."""
    u, v = np.diff(points, axis=0)[:, :-1], np.diff(points, axis=1)[:-1]
    area = np.abs(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]).ravel()
    corners = values[:-1, :-1], values[1:, :-1], values[:-1, 1:], values[1:, 1:]
    cell = sum(corners).ravel() / 4
    order = np.argsort(cell)
    return float(cell[order][np.searchsorted(np.cumsum(area[order]), share * area.sum())])


def _label_places(points: np.ndarray, values: np.ma.MaskedArray, levels: np.ndarray, avoid: tuple) -> list:
    """A point of every level, away from its neighbours; none where the isolines are crowded.

    Looked for along two rows of the grid, neighbouring levels on different ones. Distances are
    fractions of the row.
    """
    places = []
    for i, level in enumerate(levels):
        for share in (0.36, 0.64) if i % 2 else (0.64, 0.36):
            row = int(share * (len(points) - 1))
            steps = np.linalg.norm(np.diff(points[row], axis=0), axis=-1)
            length = np.sum(steps)
            above = np.ma.filled(values[row], np.nan) - level
            crossed = np.flatnonzero(above[1:] * above[:-1] < 0)  # NaN compares False
            crossed = crossed[np.abs(np.cumsum(steps)[crossed] / length - 0.5) < 0.45]
            if not crossed.size:
                continue
            room = (levels[1] - levels[0]) * steps[crossed] / np.abs(np.diff(above)[crossed]) / length
            place = points[row, crossed[np.argmax(room)]]
            is_free = all(np.linalg.norm(place - other) > 0.1 * length for other in (*places, *avoid))
            if is_free and np.max(room) > 0.07:
                places.append(place)
                break
    return places
