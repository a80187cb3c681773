"""Published designs, each with its source."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pk_jax import checks
from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.casing_oscillator import CasingOscillator
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.planar_rpr import PlanarRPR
from pk_jax.mechanisms.planar_rrr import PlanarRRR
from pk_jax.mechanisms.six_link import SixLink
from pk_jax.mechanisms.stewart import Stewart
from pk_jax.mechanisms.two_rpr import TwoRPR

_NAM = "Nam, Lee and Park 2006, Trans. KSME A 30(11)"
_EXAMPLE = "example geometry (the paper prints none) of the screw paper's"
_PATENT = "example geometry (the patent prints none) of Ryu et al., KR 10-2000-0073215"

_INCH, _MM = 0.0254, 1e-3


def _hexapod_log() -> Stewart:
    base = [
        [124.762, 32.11, 39.656],
        [-34.524, 123.974, 39.655],
        [-90.537, 91.909, 39.654],
        [-90.15, -92.096, 39.657],
        [-34.687, -124.359, 39.655],
        [124.665, -32.552, 39.655],
    ]
    platform = [
        [57.844, 70.715, -25.602],
        [32.128, 85.518, -25.602],
        [-90.266, 14.421, -25.603],
        [-90.216, -15.174, -25.601],
        [32.637, -85.55, -25.603],
        [57.865, -70.593, -25.603],
    ]
    return Stewart(base=_MM * np.array(base), platform=_MM * np.array(platform))


def _linuxcnc() -> Stewart:
    corners = np.array([[-22.95, 13.25, 0], [22.95, 13.25, 0], [0, -26.5, 0]])
    platform = [
        [-1, 11.5, 0],
        [1, 11.5, 0],
        [10.459, -4.884, 0],
        [9.459, -6.616, 0],
        [-9.459, -6.616, 0],
        [-10.459, -4.884, 0],
    ]
    return Stewart(base=_INCH * corners[[0, 1, 1, 2, 2, 0]], platform=_INCH * np.array(platform))


def _nine_lengths(heights: float) -> Stewart:
    """The semi-regular platform with three sensors, its base joints `heights` above and below in turn."""
    circle = lambda radius, degrees: (
        radius
        * np.stack([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)), np.zeros(len(degrees))], axis=1)
    )
    legs = circle(1.0, [42, 138, 162, 258, 282, 18])
    legs[:, 2] = heights * np.array([1, -1, 1, -1, 1, -1])
    corners = circle(1 / np.sqrt(3), [90, 210, 330])
    near, far = [0, 0, 1, 1, 2, 2], [2, 1, 0, 2, 1, 0]
    joints = 0.85 * corners[near] + 0.15 * corners[far]
    return Stewart(
        base=np.concatenate([legs, circle(0.6, [150, 270, 30])]), platform=np.concatenate([joints, corners])
    )


def _calibration_nominal() -> Stewart:
    base = [[305.4001, 111.1565, 0], [-56.4357, 320.0625, 0], [-248.9644, 208.906, 0]]
    platform = [[92.1597, 84.4488, 0], [27.055, 122.037, 0], [-119.2146, 37.5882, 0]]
    mirrored = lambda points: _MM * np.array(points + [[x, -y, z] for x, y, z in reversed(points)])
    return Stewart(base=mirrored(base), platform=mirrored(platform))


def _dietmaier() -> Stewart:
    base = [
        [0, 0, 0],
        [1.107915, 0, 0],
        [0.549094, 0.756063, 0],
        [0.735077, -0.223935, 0.525991],
        [0.514188, -0.526063, -0.368418],
        [0.590473, 0.094733, -0.205018],
    ]
    platform = [
        [0, 0, 0],
        [0.542805, 0, 0],
        [0.956919, -0.528915, 0],
        [0.665885, -0.353482, 1.402538],
        [0.478359, 1.158742, 0.107672],
        [-0.137087, -0.235121, 0.353913],
    ]
    return Stewart(base=base, platform=platform)


def _sauer_3_rpr() -> PlanarRPR:
    return PlanarRPR(base=[[0, 0], [5, 0], [0, 6]], platform=[[0, 0], [3, 0], [3, 3]])


def _arte_3_rpr() -> PlanarRPR:
    return PlanarRPR(
        base=[[0, 0], [2.5, 0], [1.25, 2.5]], platform=[[0, 0], [0.5, 0], [0.25, 0.25 * np.sqrt(3)]]
    )


def _regular_rrr(arms: int) -> PlanarRRR:
    turns = np.pi / 2 + 2 * np.pi / arms * (np.arange(arms) + (0.5 if arms % 2 == 0 else 0.0))
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return PlanarRRR(base=0.5 * ring, platform=0.15 * ring, proximal=0.3, distal=0.3)


class Entry(NamedTuple):
    """A design by name. `make` builds it, so that reading the catalogue creates no array."""

    make: Callable[[], Mechanism]
    source: str


CATALOGUE: dict[str, Entry] = {
    "nam-2-rpr": Entry(
        lambda: TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0),
        f"{_NAM}, Table 1, chosen for all three indices; lengths over R",
    ),
    "nam-2-rrr": Entry(
        lambda: FiveBar(half_base=1.0, proximal=1.0, distal=2.15),
        f"{_NAM}, Table 2, chosen for all three indices; lengths over R",
    ),
    "nam-2-rrr-isotropic": Entry(
        lambda: FiveBar(half_base=1.0, proximal=1.39, distal=2.69, reach=(2.08, 4.08)),
        f"{_NAM}, Table 2, weights (1, 0, 0); lengths over R",
    ),
    "semi-regular-stewart": Entry(
        lambda: Stewart.semi_regular(1.0, 0.45368859, np.deg2rad(12.0), np.deg2rad(9.52)),
        "joints in pairs on circles of radius 1 and 0.454 (on the edges of a triangle of side 1, at 0.85)",
    ),
    "wide-semi-regular-stewart": Entry(
        lambda: Stewart.semi_regular(1.0, 0.7, np.deg2rad(20.0), np.deg2rad(15.0)),
        "joints in pairs, 20 and 15 degrees off their middles, on circles of radius 1 and 0.7",
    ),
    "nine-lengths": Entry(
        lambda: _nine_lengths(0.0),
        f"{_PATENT}, embodiment 2 (planar base); six legs, three sensors",
    ),
    "nine-lengths-general": Entry(
        lambda: _nine_lengths(0.15),
        f"{_PATENT}, embodiment 1 (base joints anywhere); six legs, three sensors",
    ),
    "hexapod-log": Entry(
        _hexapod_log,
        "36 parameters identified from the controller's log of github.com/legendryflyer/"
        "Forward-Kinematic-Algorithm-for-Real-Time-Control-of-General-Six-Degree-of-Freedom-Parallel-Robot "
        "(MIT, (c) 2026 Tavish Anade)",
    ),
    "linuxcnc-hexapod": Entry(
        _linuxcnc, "default geometry of LinuxCNC's genhexkins (inches there): base joints in three pairs"
    ),
    "calibration-hexapod": Entry(
        _calibration_nominal,
        "hexapod machine tool, nominal geometry of the 42-parameter calibration benchmark "
        "(Masory, Wang and Zhuang)",
    ),
    "dietmaier-40": Entry(
        _dietmaier,
        "Dietmaier 1998, The Stewart-Gough platform of general geometry can have 40 real postures, Advances "
        "in Robot Kinematics: at lengths 1, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071; no unit",
    ),
    "5-link": Entry(
        lambda: FiveBar(half_base=0.1, proximal=0.2, distal=0.25), f"{_EXAMPLE} 5-link; lengths in m"
    ),
    "3-rrr": Entry(lambda: _regular_rrr(3), f"{_EXAMPLE} 3-RRR; lengths in m"),
    "4-rrr": Entry(lambda: _regular_rrr(4), f"{_EXAMPLE} redundant 4-RRR; lengths in m"),
    "6-link": Entry(
        lambda: SixLink(base=[[-0.2, 0], [0.2, 0]], platform=[[-0.1, 0], [0.1, 0]], proximal=0.3, distal=0.3),
        f"{_EXAMPLE} redundant 6-link; lengths in m",
    ),
    "casing-oscillator": Entry(
        CasingOscillator,
        "construction machine of Nam, Bae and Park, Table 1, carriage restored; lengths in m",
    ),
    "sauer-3-rpr": Entry(
        _sauer_3_rpr, "planar Stewart platform of Sauer, Numerical Analysis, Reality Check 1; no unit"
    ),
    "arte-3-rpr": Entry(_arte_3_rpr, "3-RPR of the ARTE toolbox (github.com/4rtur1t0/ARTE); lengths in m"),
}


def catalogued(name: str) -> Mechanism:
    """The mechanism of a catalogue entry."""
    if not isinstance(name, str) or name not in CATALOGUE:
        raise ValueError(f"no catalogue entry {checks.shown(name)}; there are {', '.join(CATALOGUE)}")
    return CATALOGUE[name].make()
