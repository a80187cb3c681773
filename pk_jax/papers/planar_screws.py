"""The screw analysis of planar parallel robots: its screws drawn by ruler, and its singular poses.

Nothing here looks at a residual. A screw is found as the analysis finds it, as a line through two joints,
with its angle alpha, its distance r from the driven joint and its moment about the end point; the
singular poses are built so that the lines meet as its figures show. What `pk_jax.screws` and
`pk_jax.classify_singularity` make of them is for the tests and the figures.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.singularity import SingularityKind
from pk_jax.geometry.planar import cross, direction
from pk_jax.geometry.poses import place
from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.planar_rpr import PlanarRPR
from pk_jax.mechanisms.planar_rrr import PlanarRRR
from pk_jax.mechanisms.six_link import SixLink


class GeometricScrews(NamedTuple):
    """Lines of action by construction; `lines` and `arms` are those of `pk_jax.screws`."""

    lines: (
        jax.Array
    )  # (m, n) (cos alpha, sin alpha), and where the platform turns the moment about its origin
    arms: jax.Array  # (m,) signed distance from the driven joint to the line; 1 for a telescopic leg
    driven: jax.Array  # (m, 2) the driven joints
    points: jax.Array  # (m, 2, 2) the two joints that the line is drawn through


def geometric_screws(mech: Mechanism, pose: jax.Array, joints: jax.Array) -> GeometricScrews:
    """Screws of one configuration of a 5-link, k-RRR, k-RPR or 6-link, from the positions of its joints.

    Source: eqs. (21)-(24), (29)-(31), (34) and Figs. 4, 5, 8, 11. ValueError for another mechanism.
    """
    if not isinstance(mech, FiveBar | PlanarRRR | PlanarRPR | SixLink):
        raise ValueError(f"geometric_screws takes one of the planar robots, got {type(mech).__name__}")
    pose, joints = jnp.asarray(pose), jnp.asarray(joints)
    match mech:
        case FiveBar():  # BP and CP
            driven, first, second = mech.base(), mech.elbows(joints), jnp.stack([pose, pose])
        case PlanarRRR():  # the distal links
            driven, first, second = mech.base, mech.elbows(joints), place(pose, mech.platform)
        case PlanarRPR():  # the legs
            driven, first, second = mech.base, mech.base, place(pose, mech.platform)
        case SixLink():  # motors A, B, F, E: lines BC, AC, ED, FD
            elbows = mech.elbows(joints)
            driven = jnp.stack([mech.base, elbows], axis=1).reshape(4, 2)
            first = jnp.stack([elbows, mech.base], axis=1).reshape(4, 2)
            second = jnp.repeat(place(pose, mech.platform), 2, axis=0)
    along = second - first
    u = direction(jnp.arctan2(along[:, 1], along[:, 0]))
    moments = cross(second - pose[:2], u)[:, None]
    lines = u if isinstance(mech, FiveBar) else jnp.concatenate([u, moments], axis=1)
    arms = jnp.ones(len(u), u.dtype) if isinstance(mech, PlanarRPR) else cross(second - driven, u)
    return GeometricScrews(lines, arms, driven, jnp.stack([first, second], axis=1))


class Case(NamedTuple):
    """A singular configuration, exact to roundoff."""

    figure: str
    title: str
    mechanism: Mechanism
    pose: np.ndarray
    joints: np.ndarray
    kind: SingularityKind  # what the closure equations make of it


STRETCHED, FOLDED = 0.0, np.pi  # psi, from the proximal to the distal link
TRIANGLE = 0.15 * np.exp(1j * np.deg2rad([100.0, 215.0, 330.0]))  # platform joints, x + iy
SQUARE = 0.15 * np.exp(1j * np.deg2rad([50.0, 140.0, 220.0, 310.0]))
BENT = np.array([0.9, -1.1, 1.3, -0.8])  # psi of regular arms


def singular_cases() -> tuple[Case, ...]:
    """The singular configurations of Figs. 2, 3, 6, 7, 9, 10, 12, 13, and one of both kinds.

    The geometries are examples, chosen case by case; the analysis prints none. In Fig. 12 all screws of
    the 6-link lie on one line, which takes both arms and the coupler on it: the closure equations are
    then dependent. Arms collinear on two lines, their screws of rank 2, are type I only: locked motors
    hold C and D.
    """
    i, ii = SingularityKind.TYPE_I, SingularityKind.TYPE_II
    return (
        *_five_bar_cases(),
        _rrr("6(a)", "3-RRR, three parallel screws", TRIANGLE, np.full(3, 1.2), BENT[:3], ii),
        _rrr("6(b)", "3-RRR, screws meet in a point", TRIANGLE, _toward(0.4 + 0.3j, TRIANGLE), BENT[:3], ii),
        _rrr("6(b)", "3-RRR, screws meet in P", TRIANGLE, _toward(0, TRIANGLE), BENT[:3], ii),
        _rrr("7(a)", "3-RRR, one arm stretched", TRIANGLE, _aside(TRIANGLE), _with(STRETCHED, 3), i),
        _rrr("7(b)", "3-RRR, one arm folded", TRIANGLE, _aside(TRIANGLE), _with(FOLDED, 3), i),
        _rrr("9(a)", "4-RRR, four parallel screws", SQUARE, np.full(4, 1.2), BENT, ii),
        _rrr("9(b)", "4-RRR, screws meet in a point", SQUARE, _toward(0.4 + 0.3j, SQUARE), BENT, ii),
        _rrr("10(a)", "4-RRR, one arm stretched", SQUARE, _aside(SQUARE), _with(STRETCHED, 4), i),
        _rrr("10(b)", "4-RRR, one arm folded", SQUARE, _aside(SQUARE), _with(FOLDED, 4), i),
        _six(
            "12",
            "6-link, all screws on one line",
            [0, np.pi],
            [FOLDED, FOLDED],
            SingularityKind.CONFIGURATION_SPACE,
        ),
        _six("12", "6-link, screws on two lines", [1.1, 2.3], [STRETCHED, STRETCHED], i),
        _six("13(a)", "6-link, one arm stretched", [1.1, 2.5], [STRETCHED, 1.2], i),
        _six("13(b)", "6-link, one arm folded", [1.1, 2.5], [FOLDED, 1.2], i),
    )


def _five_bar_cases() -> list[Case]:
    """Fig. 2: elbows at (+-lb, h) with P between them, or both at (0, h). Fig. 3: P beyond one leg."""
    i, ii, iii = SingularityKind.TYPE_I, SingularityKind.TYPE_II, SingularityKind.TYPE_III
    wide = FiveBar(half_base=0.1, proximal=0.25, distal=0.25)  # la^2 = (lb - R)^2 + h^2, h = 0.2
    narrow = FiveBar(half_base=0.15, proximal=0.25, distal=0.3)  # la^2 = R^2 + h^2
    outward, inward = np.arctan2(0.2, 0.15), np.arctan2(0.2, -0.15)
    at = lambda angle: np.array([0.0, 0.2]) + 0.3 * _e(angle)
    cases = [
        Case("2(a)", "5-link, BP and CP in line", wide, np.array([0, 0.2]), _both(outward), ii),
        Case("2(b)", "5-link, BP and CP overlap", narrow, at(1.1), _both(inward), ii),
        Case("", "5-link, leg 1 stretched over CP", narrow, at(inward), _both(inward), iii),
    ]
    mech = FiveBar(half_base=0.1, proximal=0.2, distal=0.25)
    for letter, leg, what, reach, turn in (
        ("a", 0, "stretched", 0.45, 2.3),
        ("b", 0, "folded", -0.05, -1.2),
        ("c", 1, "stretched", 0.45, np.pi - 2.3),
        ("d", 1, "folded", -0.05, np.pi + 1.2),
    ):
        pose = np.asarray(mech.base())[leg] + reach * _e(turn)
        joints = np.array(mech.inverse(pose))
        joints[leg] = turn
        cases.append(Case(f"3({letter})", f"5-link, leg {leg + 1} {what}", mech, pose, joints, i))
    return cases


def _rrr(figure: str, title: str, ends: Any, alpha: Any, psi: Any, kind: SingularityKind) -> Case:
    """Arms put to platform joints with distal links at angles alpha and joints bent by psi."""
    la, lb, pose, shift = 0.25, 0.35, np.array([0.05, 0.1, 0.3]), 0.05 + 0.1j
    links = lb * np.exp(1j * alpha) + la * np.exp(1j * (alpha - psi))
    platform = _xy(ends * np.exp(-0.3j))  # in the frame of the platform
    mech = PlanarRRR(base=_xy(ends + shift - links), platform=platform, proximal=la, distal=lb)
    return Case(figure, title, mech, pose, alpha - psi, kind)


def _six(figure: str, title: str, alpha: Any, psi: Any, kind: SingularityKind) -> Case:
    """C and D on the x axis and about P = (0, 0), arms put to them."""
    la, lb, alpha, psi = 0.3, 0.4, np.array(alpha), np.array(psi)
    ends = np.array([-0.1, 0.1]) + 0j
    base = ends - lb * np.exp(1j * alpha) - la * np.exp(1j * (alpha - psi))
    mech = SixLink(base=_xy(base), platform=_xy(ends), proximal=la, distal=lb)
    return Case(figure, title, mech, np.zeros(3), np.stack([alpha - psi, psi], axis=1).reshape(4), kind)


def _toward(point: complex, ends: np.ndarray) -> np.ndarray:
    """Angles of lines from the platform joints to a point, its origin being 0."""
    return np.angle(point - ends)


def _aside(ends: np.ndarray) -> np.ndarray:
    """Angles of lines that pass the origin at a distance, all on one side: a regular platform."""
    return np.angle(-ends) + 0.7


def _with(psi: float, arms: int) -> np.ndarray:
    return np.append(psi, BENT[1:arms])


def _both(angle: float) -> np.ndarray:
    """Joints of a 5-link that is its own mirror image."""
    return np.array([angle, np.pi - angle])


def _e(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def _xy(points: np.ndarray) -> np.ndarray:
    return np.stack([points.real, points.imag], axis=1)
