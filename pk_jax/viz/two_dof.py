"""The figures of Nam, Lee and Park 2006 for the 2-RPR and the 2-RRR, numbered as there."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from pk_jax.analysis.indices import local_indices
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR
from pk_jax.viz import style
from pk_jax.viz.boundary import TwoDof, actuators, boundary, boundary_angles, fitted_grid, outline
from pk_jax.viz.contours import area_quantile, contours, nice_levels
from pk_jax.viz.schematic import two_rpr_schematic, two_rrr_schematic
from pk_jax.viz.skeleton import polyline

SHOWN = 0.9  # share of the workspace's area on which colours tell resistivities apart


def mechanism_figure() -> Figure:
    """Fig. 1: both mechanisms at a generic pose, with their symbols. Not to any scale."""
    figure = style.new_figure(8.0, 3.7)
    left, right = figure.subplots(1, 2)
    two_rpr_schematic(left)
    two_rrr_schematic(right)
    style.panel_title(left, "(a) 2-RPR")
    style.panel_title(right, "(b) 2-RRR")
    return figure


def joint_space_figure(l_min: float = 1.0) -> Figure:
    """Fig. 2: what the joints and the design parameters may be, for legs of at least l_min >= 1 = R.

    (a) 2-RPR: where the legs meet, eq. (19), and the strokes within, eq. (20); leg lengths over R.
    (b) 2-RRR: the links of eq. (22) over R, with l_min = la + lb - 2 R along the diagonals.
    (c) beyond the paper: the driven angles, in degrees, that the workspace of the 2-RRR with la = R,
    lb = l_min + R takes; the mesh is the image of rays from O and of curves across them.
    """
    if not l_min >= 1:
        raise ValueError(f"l_min must be >= 1 (= R), eq. (20), got {l_min}")
    figure = style.new_figure(10.5, 3.9)
    panels = figure.subplots(1, 3)
    _stroke_region(panels[0], l_min)
    _link_region(panels[1], l_min)
    _angle_region(panels[2], FiveBar(half_base=1.0, proximal=1.0, distal=l_min + 1))
    titles = "2-RPR: leg lengths", "2-RRR: link lengths", "2-RRR: driven angles, $l_a=R$"
    for ax, letter, title in zip(panels, "abc", titles, strict=True):
        ax.set_box_aspect(1)
        style.panel_title(ax, f"({letter}) {title}")
    return figure


def cpi_curve(l_min: Any, cpi: Any, best: tuple[float, float], ax: Axes | None = None) -> Axes:
    """Fig. 3(a): composite index of the 2-RPR over l_min / R.

    l_min, cpi: (k,); best: (l_min, cpi) of the optimum, marked.
    """
    ax = style.axes_or_new(ax, width=4.2, height=3.4)
    ax.plot(l_min, cpi, color=style.BLUE, linewidth=2)
    _mark_optimum(ax, best, f"$\\eta={best[1]:.4g}$ at $l_{{\\min}}/R={best[0]:.4g}$", loc="upper right")
    ax.set(xlabel="$l_{\\min}/R$", ylabel="composite index $\\eta$")
    ax.grid(color="0.9")
    return ax


def cpi_surface(
    l_min: Any, la: Any, cpi: Any, best: tuple[float, float, float], ax: Axes | None = None
) -> Axes:
    """Fig. 3(b): composite index of the 2-RRR over (l_min, la) / R, with lb = l_min + 2 R - la.

    cpi: (j, k), NaN outside eq. (22); l_min, la: (j, k) too, or the axes (k,) and (j,) of the grid.
    A grid fitted to 1 <= la <= (l_min + 1) / 2 gives straight edges, and one denser towards la = R,
    where the slope is infinite, smooth isolines. best: (l_min, la, cpi) of the optimum, marked.
    """
    ax = style.axes_or_new(ax, width=5.4, height=3.8)
    levels = nice_levels(np.nanmin(cpi), np.nanmax(cpi))
    contours(ax, l_min, la, np.asarray(cpi), levels, "composite index $\\eta$", avoid=(best[:2],))
    end = np.max(l_min)
    ax.plot([1, end, end, 1], [1, 1, (end + 1) / 2, 1], color=style.INK, linewidth=1.2)
    style.note(ax, "$l_b-l_a=R$", (0.5 * (end + 1), 0.25 * (end + 1) + 0.5), (-38, 4), fontsize=10)
    where = f"({best[0]:.4g}, {best[1]:.4g})"
    _mark_optimum(ax, best[:2], f"$\\eta={best[2]:.4g}$ at {where}", loc="upper left")
    ax.set(xlabel="$l_{\\min}/R$", ylabel="$l_a/R$")
    return ax


def local_index_figure(mech: TwoDof) -> Figure:
    """Figs. 4 and 5: over the workspace, (a) isotropy 1/kappa and (b) resistivity omega = 1/|det J|.

    The grid is fitted to the boundary of eq. (17). The resistivity of the 2-RRR, 1/length^2, grows
    without bound towards it: its colours end at the value that 90 % of the area stay below.
    """
    poses = fitted_grid(mech)
    isotropy, resistivity = index_grid(mech, poses)
    power = sum(mech.joint_units) - 2  # omega dx dy = dq1 dq2
    label = f"resistivity {style.in_units_of_r('ω', mech, power)}"
    most, shown = np.max(resistivity), area_quantile(poses, resistivity, SHOWN)
    if most > 2 * shown:
        label += f"\n(colours span {SHOWN:.0%} of the area)"
        most = shown
    figure = style.new_figure(10.0, 3.3)
    panels = figure.subplots(1, 2)
    for ax in panels:
        workspace_outline(mech, ax)
    x, y = np.moveaxis(poses, -1, 0)
    contours(panels[0], x, y, isotropy, np.linspace(0, 1, 11), "isotropy $1/\\kappa$")
    contours(panels[1], x, y, resistivity, nice_levels(np.min(resistivity), most), label)
    style.panel_title(panels[0], "(a) isotropy")
    style.panel_title(panels[1], "(b) resistivity")
    return figure


def panoramic_figure(mech: TwoDof, count: int = 17) -> Figure:
    """Fig. 6: the mechanism at `count` poses along (a) the outer and (b) the inner boundary.

    Driven links, or legs, blue; distal links grey. Lengths in the mechanism's unit.
    """
    inner, outer = boundary(mech, boundary_angles(mech, count))
    outside, inside = (
        np.asarray(_skeletons(mech, jnp.asarray(poses), _joints(mech, poses))) for poses in (outer, inner)
    )
    width, height = np.ptp(np.concatenate([outside, inside]), axis=(0, 1))
    figure = style.new_figure(9.0, 4.1 * height / width + 0.9)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, points in zip(panels, (outside, inside), strict=True):
        workspace_outline(mech, ax, filled=True)
        _draw_skeletons(ax, mech, points)
    panels[1].set_ylabel("")
    style.panel_title(panels[0], "(a) along the outer boundary")
    style.panel_title(panels[1], "(b) along the inner boundary")
    return figure


def actuator_figure(mech: TwoDof) -> Figure:
    """Fig. 7: actuators over theta in degrees along (a) the outer and (b) the inner boundary.

    2-RPR: leg lengths in the mechanism's unit; 2-RRR: driven angles in degrees, continuous.
    """
    theta = boundary_angles(mech, 721)
    inner, outer = boundary(mech, theta)
    figure = style.new_figure(8.0, 3.4)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    symbol = "l" if isinstance(mech, TwoRPR) else "\\phi"
    for ax, poses in zip(panels, (outer, inner), strict=True):
        first, second = actuators(mech, poses).T
        ax.plot(np.degrees(theta), first, color=style.BLUE, linewidth=2, label=f"${symbol}_1$")
        ax.plot(np.degrees(theta), second, color=style.VERMILION, linewidth=2, ls="--", label=f"${symbol}_2$")
        ax.set_xlabel("$\\theta$ (deg)")
        ax.xaxis.set_major_locator(MultipleLocator(30))
        ax.grid(color="0.9")
        ax.legend(frameon=False)
    if isinstance(mech, TwoRPR):
        panels[0].set_ylabel(f"leg length {style.in_units_of_r('l_i', mech)}")
    else:
        panels[0].set_ylabel("driven angle $\\phi_i$ (deg)")
        panels[0].yaxis.set_major_locator(MultipleLocator(90))
    style.panel_title(panels[0], "(a) along the outer boundary")
    style.panel_title(panels[1], "(b) along the inner boundary")
    return figure


def workspace_outline(mech: TwoDof, ax: Axes | None = None, *, filled: bool = False) -> Axes:
    """Boundary of the workspace, eq. (17), and the base joints, in the mechanism's unit of length."""
    ax = style.axes_or_new(ax)
    edge = outline(mech)
    if filled:
        ax.fill(*edge.T, color=style.TINT, linewidth=0, zorder=1)
    ax.plot(*edge.T, color=style.INK, linewidth=1.2, zorder=2.5)
    ax.plot(*np.asarray(mech.base()).T, "^", color=style.INK, markersize=8, zorder=6)
    ax.use_sticky_edges = False  # a margin all around, although contours end at the outline
    ax.set_aspect("equal")
    ax.set(xlabel=style.in_units_of_r("x", mech), ylabel=style.in_units_of_r("y", mech))
    return ax


def index_grid(mech: TwoDof, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Isotropy and resistivity at a grid of poses. (..., 2) -> (...), (...)

    A node of the boundary that roundoff put out of reach gets the limits there, 0 and infinity.
    """
    found = local_indices(mech, poses.reshape(-1, 2))
    isotropy, resistivity = (np.asarray(x).reshape(poses.shape[:-1]) for x in found[:2])
    lost = np.isnan(isotropy)
    return np.where(lost, 0, isotropy), np.where(lost, np.inf, resistivity)


# --- panels


def _stroke_region(ax: Axes, l_min: float) -> None:
    l_max, end = l_min + 2, l_min + 3
    ax.fill([0, 2, end, end, end - 2], [2, 0, end - 2, end, end], color=style.TINT, linewidth=0)
    ax.plot([end - 2, 0, 2, end], [end, 2, 0, end - 2], color=style.BLUE, linewidth=1.5)
    square = np.array([[l_min, l_min], [l_max, l_min], [l_max, l_max], [l_min, l_max]])
    ax.fill(*square.T, facecolor=style.VERMILION, alpha=0.25, linewidth=0)
    ax.fill(*square.T, fill=False, edgecolor=style.VERMILION, linewidth=1.5)
    style.note(ax, "strokes\neq. (20)", (l_min + 1, l_min + 1), fontsize=10)
    middle = (end - 2) / 2
    style.note(ax, "$l_1+l_2=2R$", (1, 1), (-8, -8), rotation=-45, fontsize=9)
    style.note(ax, "$l_2-l_1=2R$", (middle, middle + 2), (-8, 8), rotation=45, fontsize=9)
    style.note(ax, "$l_1-l_2=2R$", (middle + 2, middle), (8, -8), rotation=45, fontsize=9)
    ax.set(xlim=(0, end), ylim=(0, end), xlabel="$l_1/R$", ylabel="$l_2/R$")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(1))


def _link_region(ax: Axes, l_min: float) -> None:
    most = max(4.0, l_min + 2)
    corner = lambda l_min: (l_min + 1) / 2  # la where lb - la = R
    right, top = corner(most) + 0.3, most + 1
    ax.fill([1, top - 1, 1], [2, top, top], color=style.TINT, linewidth=0)
    ax.plot([1, 1, top - 1], [top, 2, top], color=style.BLUE, linewidth=1.5)
    for value in np.arange(1, right + top - 2):
        ax.plot([1, corner(value)], [value + 1, corner(value) + 1], color=style.SOFT, linewidth=0.9, ls=":")
        text = "$l_{\\min}/R=1$" if value == 1 else f"${value:g}$"
        style.note(ax, text, (corner(value), corner(value) + 1), (8, -4), ha="left", fontsize=9)
    chosen = np.array([[1, l_min + 1], [corner(l_min), corner(l_min) + 1]])
    ax.plot(*chosen.T, "o-", color=style.VERMILION, linewidth=1.8, markersize=4, zorder=3)
    style.note(ax, "$l_a=R$", (1, (top + 2) / 2), (-10, 0), rotation=90, fontsize=9)
    style.note(ax, "$l_b-l_a=R$", (corner(most - 1), corner(most - 1) + 1), (0, -30), fontsize=9)
    ax.set(xlim=(0.75, right), ylim=(1.75, top), xlabel="$l_a/R$", ylabel="$l_b/R$")


def _angle_region(ax: Axes, mech: FiveBar) -> None:
    angles = actuators(mech, fitted_grid(mech))
    edge = np.concatenate([angles[:, -1], angles[::-1, 0], angles[:1, -1]])
    ax.fill(*edge.T, color=style.TINT, linewidth=0)
    mesh = [*angles[:, ::10].transpose(1, 0, 2), *angles[::15]]
    ax.add_collection(LineCollection(mesh, colors=style.SOFT, linewidths=0.6))
    ax.plot(*edge.T, color=style.BLUE, linewidth=1.5)
    ax.set(xlabel="$\\phi_1$ (deg)", ylabel="$\\phi_2$ (deg)")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(90))


def _mark_optimum(ax: Axes, at: tuple[float, float], label: str, loc: str) -> None:
    look = {"linestyle": "none", "marker": "*", "markersize": 13, "markeredgecolor": "white"}
    ax.plot(*at, color=style.VERMILION, clip_on=False, zorder=5, label=label, **look)
    ax.legend(loc=loc, frameon=False, handletextpad=0.2)


def _joints(mech: TwoDof, poses: np.ndarray) -> jax.Array:
    values = actuators(mech, poses)
    return jnp.asarray(values if isinstance(mech, TwoRPR) else np.radians(values))


@jax.jit
def _skeletons(mech: TwoDof, poses: jax.Array, joints: jax.Array) -> jax.Array:
    """Points of the skeleton at every pose. -> (k, p, 2)"""
    return jax.vmap(lambda pose, q: mech.skeleton(pose, q).points)(poses, joints)


def _draw_skeletons(ax: Axes, mech: TwoDof, points: np.ndarray) -> None:
    shape = mech.skeleton(jnp.zeros(2), jnp.zeros(2))
    driven = tuple(bar for bar in shape.segments if set(bar) & set(shape.ground))
    distal = tuple(bar for bar in shape.segments if bar not in driven)
    if distal:
        ax.plot(*polyline(points, distal).T, color=style.SOFT, linewidth=0.9, zorder=3)
        ax.plot(*points[:, 2:-1].reshape(-1, 2).T, "o", color=style.BLUE, mfc="white", ms=3.5, zorder=4.5)
    ax.plot(*polyline(points, driven).T, color=style.BLUE, linewidth=1.1, zorder=4)
    ax.plot(*points[:, -1].T, "o", color=style.VERMILION, markersize=4, zorder=5)
