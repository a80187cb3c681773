"""Proofs over boxes of poses: no singularity inside, and no way out of them within the joints' limits.

Everything is bounded by intervals with outward rounding (`kinematics.intervals`), boxes are bisected until
each is settled, and what could not be settled is handed back: a certificate is a proof or says that it is
none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.boxes import (
    MOST,
    Box,
    Certificate,
    Report,
    Settled,
    bisected,
    check_chart,
    free_names,
    halved,
    pose_at,
)
from pk_jax.analysis.slices import coordinate_names
from pk_jax.kinematics.intervals import (
    Interval,
    absolute,
    determinant,
    matrix_product,
    minus,
    over,
    plus,
    power,
    thin,
    times,
    total,
)
from pk_jax.mechanisms.base import Mechanism, require_mechanism


def certify_regular(
    mech: Mechanism,
    ranges: Mapping[str, Sequence[float]],
    *,
    scale: Callable[[jax.Array], jax.Array] | None = None,
    at_least: float = 0.0,
    within: Sequence[str] = (),
    most: int = MOST,
    report: Report | None = None,
) -> Certificate:
    """Prove that a box of poses and free joints has no type II singularity: A regular all over it.

    ranges:  (lower, upper) by name: coordinates of the pose as in `singularity_locus`, angles in rad, and
             free joints. Coordinates that are left out stay as at home. The turn (rx, ry, rz) of an
             `SE3` is here a Cayley vector, 2 tan(angle / 2) along the axis, from home.
    scale:   what |det A| is measured in, a positive function of the coordinates in the order of
             `Certificate.names` (all of them); default: |det A| at home
    at_least: what |det A| / scale must exceed, so that `bound` does
    within:  names of margins: parts of the box where one of them is negative need not be regular
    most:    boxes to examine at most
    report:  called with (what, done, total)

    On every part, C A = 1 + D with C close to A^-1 at its middle; where every row of |D|, scaled,
    sums up to less than 1, A is regular, and det A = det(1 + D) / det C is bounded. `bound` is a lower bound
    of |det A| / scale over the whole box. Not proved where boxes are left: the box may hold a
    singularity, or `most` was too small. ValueError for mechanisms that `enclosure` has no
    rules for, or whose A depends on joints that are not free.
    """
    _check("certify_regular", mech, at_least, report)
    box = Box(mech, ranges)
    if box.equations != box.n:
        raise ValueError(
            f"certify_regular needs as many equations as coordinates, {type(mech).__name__} has others"
        )
    at = [np.asarray(_matrix(mech, box.at_home(), v)) for v in (box.home, Interval(*box.whole).middle)]
    if not np.all(np.isfinite(at)):
        raise ValueError(f"no certificate for {type(mech).__name__}: A depends on joints that are not free")
    at_home, at_centre = np.linalg.det(at)
    checks.is_function("scale", scale)
    scale = abs(at_home) if scale is None else scale
    within = checks.are_words("within", within) and _margins_named(mech, within)
    settle = partial(_regular, box, scale, within, at_least, np.sign(at_centre))
    return bisected(box, settle, [box.whole], most, report, "no singularity")


def certify_confined(
    mech: Mechanism,
    ranges: Mapping[str, Sequence[float]],
    *,
    at_least: float = 0.0,
    within: Sequence[str] | None = None,
    most: int = MOST,
    report: Report | None = None,
) -> Certificate:
    """Prove that the platform cannot leave a box of poses within its limits, starting from home.

    ranges:  (lower, upper) of every coordinate of the pose, as for `certify_regular`. Free joints may have
             any value in their `free_range()`, whatever the ranges say.
    at_least: how far below zero a margin must be, so that `bound` exceeds it
    within:  names of the margins that limit it; default: all
    most, report:  as for `certify_regular`

    On no face of the box are all margins >= 0, with any value of the free joints: so the component of the
    workspace that home belongs to, connected in poses and free joints, lies inside the box. A part of
    a face is ruled out by one margin, or by a sum of margins with weights >= 0 that is negative all over
    it (as in Farkas' lemma). `bound` is a number that on every face one margin is below the negative of.
    ValueError where home is not inside the box and the margins, or the angles are not those of one chart:
    |pitch| < pi/2, |roll|, |yaw|, |phi| < pi.
    """
    _check("certify_confined", mech, at_least, report)
    names = coordinate_names(mech)
    if missing := [name for name in names if name not in checks.is_dict("ranges", ranges)]:
        raise ValueError(f"ranges must have every coordinate of the pose, {', '.join(missing)} missing")
    free = dict(zip(free_names(mech), np.asarray(mech.free_range()), strict=True)) if mech.free_joints else {}
    box = Box(mech, {**ranges, **free})
    check_chart(box)
    whole_lower, whole_upper = box.whole
    at_home = box.home[: len(names)]
    if not np.all((whole_lower[: len(names)] < at_home) & (at_home < whole_upper[: len(names)])):
        raise ValueError(f"ranges must hold the home pose, {dict(zip(names, at_home.tolist(), strict=True))}")
    faces = []
    for axis in range(len(names)):
        for end in box.whole:
            lower, upper = whole_lower.copy(), whole_upper.copy()
            lower[axis] = upper[axis] = end[axis]
            faces.append((lower, upper))
    within = _margins_named(mech, within)
    if not float(jnp.min(_margins(mech, mech.home(), jnp.asarray(box.home), within))) >= 0:
        raise ValueError("home must be inside the margins, it is not")
    settle = partial(_excluded, box, within, at_least)
    return bisected(box, settle, faces, most, report, "no way out")


def _check(function: str, mech: Any, at_least: Any, report: Any) -> None:
    require_mechanism(function, mech)
    checks.is_function("report", report)
    if not checks.is_concrete(mech) or mech.length().dtype != jnp.float64:
        raise ValueError("a certificate needs known values in float64: call pk_jax.enable_x64() first")
    if not (checks.is_number(at_least) and at_least >= 0):
        raise ValueError(f"at_least must be a finite number >= 0, got {checks.shown(at_least)}")


# --- one box: A is regular


@jax.jit
def _matrix(mech: Mechanism, home: Any, values: jax.Array) -> jax.Array:
    """A at coordinates, of which the last are the free joints; the others are those of `home`. -> (n, n)"""
    pose, joints = home
    count = mech.free_joints
    joints = jnp.concatenate([joints[: joints.shape[0] - count], values[values.shape[0] - count :]])
    return mech.linearize(pose_at(pose, values), joints)[1]


@jax.jit
def _matrix_slopes(mech: Mechanism, home: Any, values: jax.Array) -> jax.Array:
    return jax.jacfwd(lambda v: _matrix(mech, home, v))(values)


def _regular(
    box: Box,
    scale: Callable | float,
    within: tuple[str, ...],
    least: float,
    sign: float,
    lower: np.ndarray,
    upper: np.ndarray,
) -> Settled:
    """|det A| / scale bounded from below, over each box."""
    middle, half = halved(lower, upper)
    natural, at_middle = (box.enclosed(_matrix, *ends) for ends in ((lower, upper), (middle, middle)))
    slopes = box.enclosed(_matrix_slopes, lower, upper)
    near = at_middle.middle
    signs = np.sign(np.linalg.det(near))
    inverse = thin(np.linalg.inv(np.where((signs != 0)[:, None, None], near, np.eye(box.n))))
    changes = times(absolute(matrix_product(inverse, slopes)), thin(half[:, None, None, :])).upper
    changes = changes + _unknown(natural)[:, :, :, None]  # slopes do not tell of jumps
    change = total(thin(changes), axis=3).upper
    off = minus(matrix_product(inverse, at_middle), thin(np.eye(box.n)))
    off = plus(off, Interval(-change, change))  # C A - 1
    det = np.fmax(determinant(plus(off, thin(np.eye(box.n)))).lower, _dominant(absolute(off).upper))
    of_inverse = absolute(determinant(inverse)).upper
    unit = box.enclosed(lambda mech, home, v: scale(v), lower, upper) if callable(scale) else thin(scale)
    bound = over(thin(det), times(thin(of_inverse), unit)).lower
    is_done = bound > least
    if within:
        is_done |= box.enclosed(_Margins(within), lower, upper).upper.min(axis=1) < 0
        bound = np.where(is_done & ~(bound > least), np.inf, bound)
    is_lost = not within and bool(np.any(signs * sign <= 0))  # det A changes its sign in the box
    return Settled(bound, is_done, changes.sum(axis=(1, 2)), is_lost)


def _unknown(natural: Interval) -> np.ndarray:
    """NaN where bounds are not known, else 0."""
    return np.where(np.isnan(natural.lower + natural.upper), np.nan, 0.0)


def _dominant(size: np.ndarray) -> np.ndarray:
    """A lower bound of |det(1 + D)| where |D| <= size (k, n, n): (1 - r)^n, r >= the spectral radius."""
    n = size.shape[-1]
    x = np.ones(size.shape[:2])
    for _ in range(20):  # towards the eigenvector of Perron; any positive x is as right
        x = np.einsum("kij,kj->ki", size, x) + 1e-9
        x /= x.max(axis=1, keepdims=True)
    rows = total(times(thin(size), thin(x[:, None, :])), axis=2)
    radius = over(rows, thin(x)).upper.max(axis=1)
    rest = minus(1.0, thin(radius))
    return np.where(radius < 1, power(rest, n).lower, np.nan)


# --- one box: some margin is negative


def _excluded(
    box: Box, within: tuple[str, ...], least: float, lower: np.ndarray, upper: np.ndarray
) -> Settled:
    """A bound of how negative the least margin is, over each box."""
    middle, half = halved(lower, upper)
    function = _Margins(within)
    natural, at_middle = (box.enclosed(function, *ends) for ends in ((lower, upper), (middle, middle)))
    slopes = box.enclosed(function.slopes, lower, upper)  # (k, margins, d)
    weights = _weights(at_middle.middle, slopes.middle, half)
    of_slopes = total(times(thin(weights[:, :, None]), slopes), axis=1)
    changes = times(absolute(of_slopes), thin(half)).upper
    changes = changes + _unknown(natural).sum(axis=1, keepdims=True)  # slopes do not tell of jumps
    value = plus(total(times(thin(weights), at_middle), axis=1), total(thin(changes), axis=1))
    # the weights sum up to 1 but for roundoff, and so does what they weigh
    combined = over(value, total(thin(weights), axis=1)).upper
    bound = -np.fmin(natural.upper.min(axis=1), combined)
    is_lost = bool(np.any(at_middle.lower.min(axis=1) >= -least))
    return Settled(bound, bound > least, changes, is_lost)


def _weights(values: np.ndarray, slopes: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Weights >= 0 of margins, sum 1, whose weighted sum is least at its greatest over a box. (k, margins)

    Minimizes w . values + sum_d half_d |w . slopes_d| by exponentiated gradients; whatever they are, the
    bound that is made with them holds.
    """
    of_half = np.abs(slopes) @ half[:, :, None]
    size = np.abs(values).max(axis=1, keepdims=True) + of_half[:, :, 0].max(axis=1, keepdims=True)
    now = np.full(values.shape, 1 / values.shape[1])
    best, least = now, np.full(len(values), np.inf)
    for step in range(60):
        along = np.einsum("km,kmd->kd", now, slopes)
        reached = np.sum(now * values, axis=1) + np.sum(half * np.abs(along), axis=1)
        is_better = reached < least
        least, best = np.where(is_better, reached, least), np.where(is_better[:, None], now, best)
        gradient = values + np.einsum("kmd,kd->km", slopes, half * np.sign(along))
        now = now * np.exp(-20 / np.sqrt(step + 1) * gradient / size)
        now = now / now.sum(axis=1, keepdims=True)
    return best


def _margins_named(mech: Mechanism, within: Sequence[str] | None) -> tuple[str, ...]:
    """Names of margins, by default all; ValueError where the mechanism does not have them."""
    known = tuple(mech.margins(*mech.home()))
    within = known if within is None else checks.are_words("within", within)
    if not within:
        raise ValueError(f"{type(mech).__name__} has no margins: give it limits (strokes, cones, ...)")
    if unknown := [name for name in within if name not in known]:
        raise ValueError(f"within must name some of {', '.join(known) or 'none'}, got {unknown[0]!r}")
    if not hasattr(mech, "inverse"):
        raise ValueError(f"margins need the closed form `inverse`, {type(mech).__name__} has none")
    return within


class _Margins:
    """The margins of some names, as a function of coordinates. -> (margins,)"""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names

    def __call__(self, mech: Mechanism, home: Any, values: jax.Array) -> jax.Array:
        return _margins(mech, home, values, self.names)

    def slopes(self, mech: Mechanism, home: Any, values: jax.Array) -> jax.Array:
        return _margin_slopes(mech, home, values, self.names)


@partial(jax.jit, static_argnums=3)
def _margins(mech, home, values, names):
    pose = pose_at(home[0], values)
    free = values[values.shape[0] - mech.free_joints :] if mech.free_joints else None
    found = mech.margins(pose, mech.inverse(pose, free=free))
    return jnp.concatenate([jnp.ravel(found[name]) for name in names])


@partial(jax.jit, static_argnums=3)
def _margin_slopes(mech, home, values, names):
    return jax.jacfwd(lambda v: _margins(mech, home, v, names))(values)
