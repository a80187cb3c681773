"""The two mechanisms with their symbols."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR
from pk_jax.viz.skeleton import draw
from pk_jax.viz.style import BLUE, INK, SOFT, VERMILION, note

ARROW = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}


def two_rpr_schematic(ax: Axes) -> None:
    """The 2-RPR: base joints B_i, legs l_i with their cylinders, end point C and its polar coordinates."""
    mech = TwoRPR(half_base=1.0, l_min=1.2, l_max=3.2)
    pose = jnp.array([-0.55, 2.1])
    draw(mech, pose, mech.inverse(pose), ax)
    base, end = np.asarray(mech.base()), np.asarray(pose)
    for start in base:
        cylinder = start + np.array([[0.1], [0.55]]) * (end - start)
        ax.plot(*cylinder.T, color=INK, linewidth=8, solid_capstyle="butt", zorder=3)
        ax.plot(*cylinder.T, color="#d9d9d9", linewidth=6, solid_capstyle="butt", zorder=3)
    note(ax, "$l_1$", base[0] + 0.35 * (end - base[0]), (13, 6))
    note(ax, "$l_2$", base[1] + 0.35 * (end - base[1]), (-14, 2))
    _frame(ax, base, end)


def two_rrr_schematic(ax: Axes) -> None:
    """The 2-RRR: links l_a and l_b, elbows d_i, driven angles phi_i, end point C as for the 2-RPR."""
    mech = FiveBar(half_base=1.0, proximal=1.05, distal=1.9)
    pose = jnp.array([-0.55, 2.1])
    joints = mech.inverse(pose)
    draw(mech, pose, joints, ax)
    base, end, elbows = np.asarray(mech.base()), np.asarray(pose), np.asarray(mech.elbows(joints))
    for i, side in enumerate((1, -1)):
        angle = float(joints[i]) % (2 * np.pi)
        ax.plot(base[i, 0] + np.array([0, 0.5]), [0, 0], color=SOFT, linewidth=0.8, zorder=1)
        _arc(ax, base[i], 0.33, 0, angle, BLUE)
        note(ax, f"$\\phi_{i + 1}$", base[i] + 0.33 * _unit(angle / 2), (11, 6), color=BLUE)
        note(ax, f"$d_{i + 1}$", elbows[i], (side * 13, 2))
        note(ax, "$l_a$", (base[i] + elbows[i]) / 2, (-10, -5))
        note(ax, "$l_b$", (end + elbows[i]) / 2, (side * 11, 8))
    _frame(ax, base, end)


def _frame(ax: Axes, base: np.ndarray, end: np.ndarray) -> None:
    """Base joints, axes at O, and the polar coordinates l_C, theta of the end point C."""
    for tip, name, offset in (((2.0, 0), "$X$", (8, 0)), ((0, 2.55), "$Y$", (0, 9))):
        ax.annotate("", tip, (0, 0), arrowprops=ARROW, zorder=1)
        note(ax, name, tip, offset)
    ax.plot(*np.stack([0 * end, end]).T, color=VERMILION, linewidth=1.2, linestyle="--", zorder=2)
    theta = np.arctan2(-end[0], end[1])
    _arc(ax, (0, 0), 1.0, np.pi / 2, np.pi / 2 + theta, VERMILION)
    note(ax, "$\\theta$", 1.0 * _unit(np.pi / 2 + theta / 2), (0, 9), color=VERMILION)
    note(ax, "$l_C$", 0.27 * end, (-12, -2), color=VERMILION)
    note(ax, "$C\\,(x, y)$", end, (0, 14))
    note(ax, "$O$", (0, 0), (9, -9))
    for point, name, side in ((base[0], "$B_1$", 1), (base[1], "$B_2$", -1)):
        note(ax, name, point, (side * 4, -16))
        ax.annotate("", (point[0], -0.5), (0, -0.5), arrowprops=ARROW | {"arrowstyle": "<|-|>"})
        note(ax, "$R$", (point[0] / 2, -0.5), (0, -9))
        ax.plot([point[0]] * 2, [-0.42, -0.58], color=INK, linewidth=0.8)
    ax.plot([0, 0], [-0.2, -0.58], color=INK, linewidth=0.8)
    ax.set(xlim=(-2.35, 2.35), ylim=(-0.85, 2.85))
    ax.set_axis_off()


def _arc(ax: Axes, centre, radius: float, start: float, end: float, color: str) -> None:
    arc = np.asarray(centre) + radius * _unit(np.linspace(start, end, 60))
    ax.plot(*arc.T, color=color, linewidth=1.0, zorder=2)
    ax.annotate("", arc[-1], arc[-6], arrowprops=ARROW | {"color": color})


def _unit(angle) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
