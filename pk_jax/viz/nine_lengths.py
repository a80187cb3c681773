"""The sensor-equipped Stewart platform: its figures, and what its loop does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from pk_jax.mechanisms.stewart import LEGS, Stewart
from pk_jax.viz.skeleton import draw
from pk_jax.viz.style import (
    BLUE,
    GREEN,
    INK,
    SOFT,
    TINT,
    VERMILION,
    axes_or_new,
    new_figure,
    note,
    panel_title,
)

ARROW = {
    "arrowstyle": "-|>",
    "color": INK,
    "linewidth": 1.2,
    "shrinkA": 0,
    "shrinkB": 0,
    "mutation_scale": 11,
}
COLORS = {"joint": SOFT, "legs": INK, "closed": VERMILION, "nine": BLUE, "learned": GREEN}
STYLES = {"joint": "-", "legs": (0, (4, 3)), "closed": "-", "nine": "-", "learned": "-"}
NAMES = {
    "joint": "joint lengths",
    "legs": "six legs",
    "closed": "closed form",
    "nine": "nine lengths",
    "learned": "nine, bias learned",
}


def draw_platform(mech: Stewart, pose: Any, joints: Any, ax: Axes | None = None) -> Axes:
    """A platform whose sensors are told from its legs: Figs. 1 and 3 of the patent."""
    ax = axes_or_new(ax, width=5.5, height=5.0, projection="3d")
    legs = type(mech)(base=mech.base[:LEGS], platform=mech.platform[:LEGS])
    draw(legs, pose, joints[:LEGS], ax, linewidth=2.2)
    points = np.asarray(mech.skeleton(pose, joints).points)
    rows = len(points) // 2
    base, platform = points[:rows], points[rows:]
    corners = platform[LEGS:]
    ax.plot(*np.concatenate([corners, corners[:1]]).T, color=VERMILION, linewidth=1.0, linestyle=":")
    for foot, corner in zip(base[LEGS:], corners, strict=True):
        ax.plot(*np.stack([foot, corner]).T, color=VERMILION, linewidth=1.6, linestyle=(0, (4, 2)))
    ax.plot(*base[LEGS:].T, "s", color=VERMILION, markersize=5)
    ax.plot(*corners.T, "o", color=VERMILION, markersize=4.5)
    size = float(np.ptp(points, axis=0).max())
    for name, places, away in (("A", base[:LEGS], 0.09), ("S", base[LEGS:], -0.07), ("T", corners, 0.1)):
        for i, at in enumerate(places, 1):
            _name_joint(ax, f"${name}_{i}$", at, places.mean(axis=0), away * size)
    for i, at in enumerate(platform[:LEGS]):
        others = np.delete(platform[:LEGS], i, axis=0)
        partner = others[np.argmin(np.linalg.norm(others - at, axis=1))]
        _name_joint(ax, f"$B_{i + 1}$", at, partner, 0.07 * size)
    ax.set_box_aspect(None, zoom=0.9)
    ax.view_init(elev=30, azim=-75)
    return ax


def _name_joint(ax: Axes, name: str, at: np.ndarray, other: np.ndarray, away: float) -> None:
    """A name beside a joint, on the line to another point."""
    apart = np.linalg.norm(at - other)
    place = at + away * (at - other) / apart if apart > 0 else at
    color = VERMILION if name[1] in "ST" else INK
    ax.text(*place, name, color=color, ha="center", va="center", fontsize=9)


def platform_plan(mech: Stewart, ax: Axes | None = None) -> Axes:
    """Joints and sensors of the platform in its own plane: Fig. 2 of the patent."""
    ax = axes_or_new(ax, width=4.5, height=4.2)
    joints, corners = np.asarray(mech.platform)[:LEGS, :2], np.asarray(mech.platform)[LEGS:, :2]
    ax.plot(*np.concatenate([corners, corners[:1]]).T, color=VERMILION, linewidth=1.2)
    ax.plot(*np.concatenate([joints, joints[:1]]).T, color=INK, linewidth=2.0)
    ax.plot(*joints.T, "o", color=INK, markerfacecolor="white", markersize=6)
    ax.plot(*corners.T, "o", color=VERMILION, markersize=6)
    for name, places, color, away in (("B", joints, INK, -15), ("T", corners, VERMILION, 14)):
        for i, at in enumerate(places, 1):
            note(ax, f"${name}_{i}$", at, tuple(away * at / np.linalg.norm(at)), color=color)
    first, second = joints[0], corners[0]
    apart = corners[0] - corners[2]
    normal = np.array([apart[1], -apart[0]]) / np.linalg.norm(apart)
    for ends, label, off in (
        ((second, first), "$h_2$", 0.07),
        ((first, joints[5]), "$h_1$", 0.07),
        ((corners[0], corners[2]), "$p$", 0.17),
    ):
        line = np.stack(ends) + off * np.linalg.norm(apart) * -normal * np.sign(
            normal @ -(joints[0] + joints[5])
        )
        ax.annotate("", line[0], line[1], arrowprops=ARROW | {"arrowstyle": "<|-|>", "linewidth": 0.8})
        note(ax, label, line.mean(axis=0), tuple(-11 * normal * np.sign(normal @ -(joints[0] + joints[5]))))
    ax.set_aspect("equal")
    ax.margins(0.14)
    ax.set_axis_off()
    return ax


def control_diagram(ax: Axes | None = None) -> Axes:
    """The loop: Fig. 4 of the patent."""
    ax = axes_or_new(ax, width=7.4, height=2.6)
    boxes = {
        "PID": (2.2, 1.4, 1.3, "PID\ncontroller"),
        "robot": (4.3, 1.4, 1.5, "six actuators,\nplatform"),
        "sensors": (6.4, 1.4, 1.3, "nine length\nsensors"),
        "forward": (4.3, 0.0, 1.5, "forward\nkinematics"),
    }
    for x, y, width, text in boxes.values():
        ax.add_patch(
            FancyBboxPatch(
                (x - width / 2, y - 0.32),
                width,
                0.64,
                boxstyle="round,pad=0.05",
                facecolor=TINT,
                edgecolor=INK,
            )
        )
        note(ax, text, (x, y), fontsize=9)
    ax.plot(0.75, 1.4, "o", markersize=15, markerfacecolor="white", color=INK)
    note(ax, "$+$", (0.75, 1.4), (-16, 7), fontsize=9)
    note(ax, "$-$", (0.75, 1.4), (8, -16), fontsize=9)
    arrow = lambda *points: _path(ax, np.array(points, float))
    arrow((-0.3, 1.4), (0.61, 1.4))
    arrow((0.89, 1.4), (1.5, 1.4))
    arrow((2.9, 1.4), (3.5, 1.4))
    arrow((5.1, 1.4), (5.7, 1.4))
    arrow((6.4, 1.03), (6.4, 0.0), (5.1, 0.0))
    arrow((3.5, 0.0), (0.75, 0.0), (0.75, 1.2))
    for text, at in (
        ("$X_d$", (0.1, 1.6)),
        ("$E$", (1.2, 1.6)),
        ("$A$", (3.2, 1.6)),
        ("$L$", (5.75, 0.2)),
        ("$X_a$", (2.2, 0.2)),
    ):
        note(ax, text, at)
    ax.set(xlim=(-0.5, 7.3), ylim=(-0.55, 1.95))
    ax.set_aspect("equal")
    ax.set_axis_off()
    return ax


def _path(ax: Axes, points: np.ndarray) -> None:
    ax.plot(*points[:-1].T, color=INK, linewidth=1.2)
    ax.annotate("", points[-1], points[-2], arrowprops=ARROW)


def draw_tracking(
    runs: Mapping[str, Any], ax: Axes | None = None, *, scale: float = 1e-6, unit: str = "µm"
) -> Axes:
    """RMS position error over the seeds against time, one line a feedback."""
    ax = axes_or_new(ax, width=6.0, height=3.6)
    for feedback, run in runs.items():
        off = np.sqrt(np.mean(np.asarray(run.position_error) ** 2, axis=0)) / scale
        ax.plot(
            run.time,
            off,
            color=COLORS[feedback],
            linestyle=STYLES[feedback],
            linewidth=1.4,
            label=NAMES[feedback],
        )
    ax.set(xlabel="time (s)", ylabel=f"position error, RMS ({unit})", ylim=(0, None))
    ax.legend(frameon=False, fontsize="small", ncols=2)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def tracking_figure(
    cases: Mapping[str, Mapping[str, Any]], *, scale: float = 1e-6, unit: str = "µm"
) -> Figure:
    """`draw_tracking` of several plants, one above the other."""
    figure = new_figure(6.4, 2.3 * len(cases))
    for ax, (name, runs) in zip(
        figure.subplots(len(cases), 1, sharex=True, squeeze=False)[:, 0], cases.items(), strict=True
    ):
        draw_tracking(runs, ax, scale=scale, unit=unit)
        panel_title(ax, name)
        ax.label_outer()
    for ax in figure.axes[1:]:
        ax.get_legend().remove()
    return figure


def draw_noise(rows: Any, ax: Axes | None = None) -> Axes:
    """Median position errors against the noise of the lengths, `rows` as of `noisy_lengths`."""
    ax = axes_or_new(ax, width=5.0, height=3.8)
    for embodiment, marker in ((2, "o"), (1, "s")):
        cells = [row for row in rows if row.embodiment == embodiment]
        noise = np.array([row.noise for row in cells])
        for name, values in (
            ("closed", [row.median_closed for row in cells]),
            ("legs", [row.median_legs for row in cells]),
            ("nine", [row.median for row in cells]),
        ):
            label = f"{NAMES[name]}, embodiment {embodiment}"
            ax.loglog(
                noise,
                noise * values,
                marker,
                linestyle="-",
                color=COLORS[name],
                linewidth=1.0,
                markersize=5,
                markerfacecolor="white",
                label=label,
            )
    ax.set(xlabel="noise of every length (m)", ylabel="position error, median (m)")
    ax.legend(frameon=False, fontsize="x-small")
    return ax
