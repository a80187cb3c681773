"""Families of designs: a few numbers, with the bounds of sensible ones, that make a whole mechanism."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.casing_oscillator import CasingOscillator
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.planar_rrr import PlanarRRR
from pk_jax.mechanisms.stewart import Stewart
from pk_jax.mechanisms.two_rpr import TwoRPR

THIRDS = np.deg2rad([90.0, 210.0, 330.0])  # where the legs of symmetric planar platforms stand


class Family(NamedTuple):
    """Symmetric designs of one mechanism; lengths in any unit."""

    name: str
    defaults: dict[str, float]
    bounds: dict[str, tuple[float, float]]  # least and greatest of what is varied by default
    mechanism: Callable[[Mapping[str, Any]], Mechanism]  # of all parameters, traceable


def _five_bar(p: Mapping[str, Any]) -> FiveBar:
    return FiveBar(half_base=p["half_base"], proximal=p["proximal"], distal=p["distal"])


def _two_rpr(p: Mapping[str, Any]) -> TwoRPR:
    return TwoRPR(half_base=p["half_base"], l_min=p["l_min"], l_max=p["l_max"])


def _planar_rrr(p: Mapping[str, Any]) -> PlanarRRR:
    circle = np.stack([np.cos(THIRDS), np.sin(THIRDS)], axis=1)
    radius = lambda name: jnp.asarray(p[name]) * circle
    return PlanarRRR(
        base=radius("base_radius"),
        platform=radius("platform_radius"),
        proximal=p["proximal"],
        distal=p["distal"],
    )


def _stewart(p: Mapping[str, Any]) -> Stewart:
    """Strokes reach `half_stroke` either way of the legs that hold the platform level at `height`."""
    names = ("base_radius", "platform_radius", "base_half_angle", "platform_half_angle")
    bare = Stewart.semi_regular(*(p[name] for name in names))
    apart = bare.platform[0] + jnp.array([0.0, 0.0, 1.0]) * p["height"] - bare.base[0]
    leg = jnp.sqrt(jnp.sum(apart**2))
    stroke = jnp.stack([leg - p["half_stroke"], leg + p["half_stroke"]])
    return Stewart(
        base=bare.base,
        platform=bare.platform,
        stroke=stroke,
        base_cone=p["base_cone"],
        platform_cone=p["platform_cone"],
    )


def _casing_oscillator(p: Mapping[str, Any]) -> CasingOscillator:
    """Strokes reach `half_stroke` either way of the neutral configuration."""
    neutral = jnp.stack([jnp.asarray(p["slide"]), jnp.asarray(p["carriage"])])
    radii = {name: p[name] for name in ("base_radius", "platform_radius")}
    cones = {name: p[name] for name in ("base_cone", "platform_cone")}
    wide = jnp.broadcast_to(jnp.array([1e-6, 1e6]), (5, 2))
    joints = CasingOscillator(**radii, **cones, neutral=neutral, stroke=wide).home()[1]
    stroke = jnp.stack([joints - p["half_stroke"], joints + p["half_stroke"]], axis=1)
    return CasingOscillator(**radii, **cones, neutral=neutral, stroke=stroke)


_FAMILIES = {
    family.name: family
    for family in (
        Family(
            "five-bar",
            {"half_base": 0.3, "proximal": 1.0, "distal": 1.5},
            {"half_base": (0.1, 1.0), "proximal": (0.5, 2.0), "distal": (0.5, 2.5)},
            _five_bar,
        ),
        Family(
            "2-rpr",
            {"half_base": 1.0, "l_min": 2.0, "l_max": 4.0},
            {"l_min": (1.0, 3.0)},
            _two_rpr,
        ),
        Family(
            "3-rrr",
            {"base_radius": 1.0, "platform_radius": 0.3, "proximal": 0.55, "distal": 0.55},
            {"platform_radius": (0.1, 0.6), "proximal": (0.5, 1.0), "distal": (0.5, 1.0)},
            _planar_rrr,
        ),
        Family(
            "stewart",
            {
                "base_radius": 1.0,
                "platform_radius": 0.6,
                "base_half_angle": 0.2,
                "platform_half_angle": 0.2,
                "height": 1.0,
                "half_stroke": 0.15,
                "base_cone": 0.6,
                "platform_cone": 0.6,
            },
            {
                "platform_radius": (0.3, 1.0),
                "base_half_angle": (0.1, 0.9),
                "platform_half_angle": (0.1, 0.9),
                "height": (0.6, 1.6),
            },
            _stewart,
        ),
        Family(
            "casing-oscillator",
            {
                "base_radius": 0.25,
                "platform_radius": 0.25,
                "slide": 0.48,
                "carriage": 0.73,
                "half_stroke": 0.06,
                "base_cone": np.pi / 9,
                "platform_cone": np.pi / 9,
            },
            {
                "base_radius": (0.15, 0.4),
                "platform_radius": (0.15, 0.4),
                "slide": (0.35, 0.6),
                "carriage": (0.6, 0.9),
            },
            _casing_oscillator,
        ),
    )
}


def design_family(name: str) -> Family:
    """A family by its name: "five-bar", "2-rpr", "3-rrr", "stewart" or "casing-oscillator".

    five-bar           half_base, proximal, distal; reach all that the links reach
    2-rpr              half_base, l_min, l_max
    3-rrr              base_radius, platform_radius, proximal, distal; joints at 90, 210, 330 degrees
    stewart            as `Stewart.semi_regular`; height of the platform at home, half_stroke about it,
                       half-angles of the cones of the joints, rad
    casing-oscillator  base_radius, platform_radius, slide and carriage of the neutral configuration,
                       half_stroke about it, half-angles of the cones, rad; defaults in metres
    """
    return _FAMILIES[checks.is_word("design family", name, _FAMILIES)]
