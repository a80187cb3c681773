"""Optimized designs: the mechanism in its task, and how the search went."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from pk_jax.kinematics.batching import home_shapes
from pk_jax.kinematics.inverse import inverse_kinematics
from pk_jax.mechanisms.base import Mechanism
from pk_jax.status import Status
from pk_jax.viz.skeleton import draw
from pk_jax.viz.style import BLUE, INK, SOFT, TINT, axes_or_new


def draw_design(
    mech: Mechanism, rectangle: tuple[Any, Any] | None = None, ax: Axes | None = None, *, branch: Any = None
) -> Axes:
    """The mechanism in the middle of a rectangle of poses (lower (n,), upper (n,)), which is tinted.

    Without a rectangle, where its poses are no arrays, and where the middle is out of reach: at home.
    """
    pose, joints = mech.home()
    is_task = rectangle is not None and isinstance(home_shapes(mech)[0], jax.ShapeDtypeStruct)
    if is_task:
        lower, upper = (np.asarray(corner, float) for corner in rectangle)
        middle = jnp.asarray((lower + upper) / 2, pose.dtype)
        found = inverse_kinematics(mech, middle, branch)
        if found.status == Status.OK:
            pose, joints = middle, found.joints
    ax = draw(mech, pose, joints, ax)
    if is_task and ax.name != "3d":
        ax.fill_between([lower[0], upper[0]], lower[1], upper[1], color=TINT, zorder=0)
    return ax


def draw_history(history: np.ndarray, ax: Axes | None = None) -> Axes:
    """The best value against evaluations a start, and how many starts have ended.

    history: (chunks, columns) steps, best, violation, feasible, finished, ... as a design run keeps them
    """
    ax = axes_or_new(ax, width=5.2, height=3.6)
    steps, best = history[:, 0], np.where(np.isfinite(history[:, 1]), history[:, 1], np.nan)
    ax.step(steps, best, where="post", color=BLUE)
    ax.plot(steps, best, "o", color=BLUE, markersize=3)
    ax.set_xlabel("evaluations a start")
    ax.set_ylabel("best value", color=BLUE)
    ended = ax.twinx()
    ended.step(steps, history[:, 4], where="post", color=SOFT, linewidth=1)
    ended.set_ylabel("starts ended", color=SOFT)
    ended.set_ylim(bottom=0)
    ended.yaxis.get_major_locator().set_params(integer=True)
    return ax


def draw_front(front: np.ndarray, names: Sequence[str], ax: Axes | None = None) -> Axes:
    """Designs of a Pareto front: the first objective against the second, the third by colour.

    front: (f, 3) objectives; names: of the three
    """
    ax = axes_or_new(ax, width=5.2, height=3.6)
    order = np.argsort(front[:, 0])
    ax.plot(*front[order, :2].T, color=SOFT, linewidth=0.8, zorder=1)
    points = ax.scatter(*front[order].T[:2], c=front[order, 2], edgecolors=INK, linewidths=0.6, zorder=2)
    ax.set_xlabel(names[0])
    ax.set_ylabel(names[1])
    ax.figure.colorbar(points, ax=ax, label=names[2])
    return ax
