"""Colours, axes and labels that the figures share."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pk_jax.mechanisms.base import Mechanism

INK = "#262626"
SOFT = "#8c8c8c"
TINT = "#dceaf5"
# the colour-blind-safe set of Okabe and Ito
BLUE, VERMILION, GREEN = "#0072b2", "#d55e00", "#009e73"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, laid out around axes of fixed aspect. Inches, for fonts of 10 points."""
    return Figure(figsize=(width, height), layout="compressed")


def axes_or_new(ax: Axes | None, *, width: float = 5.0, height: float = 4.0, **subplot: Any) -> Axes:
    """`ax` itself, or the only axes of a new figure."""
    return new_figure(width, height).add_subplot(**subplot) if ax is None else ax


def in_units_of_r(symbol: str, mech: Mechanism, power: int = 1) -> str:
    """The label of a quantity with unit length^power, over R^power where R = 1 is the unit."""
    if not is_unit(mech) or power == 0:
        return f"${symbol}$"
    return f"${symbol}/R$" if power == 1 else f"${symbol}\\,R^{{{-power}}}$"


def is_unit(mech: Mechanism) -> bool:
    """Whether the mechanism's lengths are multiples of R."""
    return bool(np.asarray(mech.half_base) == 1)


def axis_label(name: str, is_length: int, unit: str) -> str:
    """A coordinate with its unit, angles in degrees."""
    if name in ("roll", "pitch", "yaw"):
        return f"{name} (deg)"
    symbol = {"phi": r"\varphi"}.get(name, name if len(name) == 1 else f"{name[0]}_{{{name[1:]}}}")
    if not is_length:
        return f"${symbol}$ (deg)"
    return f"${symbol}$ ({unit})" if unit else f"${symbol}$"


def panel_title(ax: Axes, text: str) -> None:
    ax.set_title(text, fontsize="medium", pad=8)


def note(ax: Axes, text: str, at: Any, offset: tuple[float, float] = (0, 0), **words: Any) -> None:
    """Text whose middle lies `offset` points away from a point of the drawing."""
    words = {"ha": "center", "va": "center", "color": INK, "fontsize": 11} | words
    ax.annotate(text, np.asarray(at), xytext=offset, textcoords="offset points", **words)
