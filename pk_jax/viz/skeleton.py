"""Any mechanism, from its skeleton."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from pk_jax.kinematics.batching import configurations
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.viz.style import INK, axes_or_new


def draw(mech: Mechanism, pose: Any, joints: jax.Array, ax: Axes | None = None, **line: Any) -> Axes:
    """Draw one configuration: bars as lines, joints as circles, joints on the base as triangles.

    Lengths in the mechanism's unit, equal on all axes. A skeleton in space needs 3-D axes, which
    are made where `ax` is left out. `line` goes to `Axes.plot` (color, linewidth, alpha, ...).
    """
    if isinstance(mech, Mechanism):
        (pose, joints), are_batched = configurations(mech, pose, joints)
        if any(are_batched):
            raise ValueError("draw takes one configuration, got a batch")
    elif not hasattr(mech, "skeleton"):  # anything that has one can be drawn
        require_mechanism("draw", mech)
    skeleton = mech.skeleton(pose, joints)
    points = np.asarray(skeleton.points)
    is_spatial = points.shape[-1] == 3
    ax = axes_or_new(ax, **({"projection": "3d"} if is_spatial else {}))
    if is_spatial != (ax.name == "3d"):
        wanted = "3-D" if is_spatial else "2-D"
        raise ValueError(f"ax must be {wanted} axes for this skeleton, got {ax.name!r}")

    line = {"color": INK, "linewidth": 2.0, "solid_capstyle": "round", "zorder": 3} | line
    (bars,) = ax.plot(*polyline(points, skeleton.segments).T, **line)
    dots = {
        "linestyle": "none",
        "color": bars.get_color(),
        "alpha": bars.get_alpha(),
        "zorder": bars.get_zorder() + 1,
    }
    moving = np.setdiff1d(np.arange(len(points)), skeleton.ground)
    ax.plot(*points[list(skeleton.ground)].T, marker="^", markersize=9, **dots)
    ax.plot(*points[moving].T, marker="o", markersize=5.5, markerfacecolor="white", **dots)
    ax.set_aspect("equal")
    ax.locator_params(nbins=5 if is_spatial else 8)
    for name, axis in zip("xyz", (ax.xaxis, ax.yaxis, getattr(ax, "zaxis", None)), strict=True):
        if axis is not None and not axis.get_label_text():
            axis.set_label_text(f"${name}$")
    return ax


def polyline(points: np.ndarray, segments: tuple[tuple[int, int], ...]) -> np.ndarray:
    """The bars of one or many skeletons as ONE line, interrupted by NaN. (..., p, d) -> (k, d)"""
    bars = points[..., np.asarray(segments), :]
    gaps = np.full_like(bars[..., :1, :], np.nan)
    return np.concatenate([bars, gaps], axis=-2).reshape(-1, points.shape[-1])
