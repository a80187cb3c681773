"""Isotropy and resistivity of the 2-RRR integrated over its workspace: panels in elbow angles.

R = 1 throughout, and la = 1 + v^2: the integrals are smooth in v, not in la, at la = 1.

The elbow angles phi_i (0 = stretched, phi_max = at l_min) of half the workspace, phi1 <= phi2, are
laid out as a = phi2 - phi1 in [0, phi_max], phi1 = rho s, rho = phi_max - a, s in [0, 1]. That
collapses the corner where both base joints and the end point are in line (y = 0), and every square
root of the problem ends on an edge, where `smooth_ends` removes it. What is left are the isotropic
poses, conical points of 1/kappa: on a = 0, and one pair on b = phi1 + phi2 = pi. Panel borders run
through them, and through the real part of the complex pair near b = pi.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax.analysis.quadrature import smooth_ends, spread
from pk_jax.geometry import safe

NEAREST_CUT = 1e-4  # of the interval: a panel border closer to an end is not worth its panel
FADE = 1e-2  # borders stop following the design within this distance of where they vanish


class Integrals(NamedTuple):
    """Integrals over the whole workspace, R = 1."""

    isotropy: jax.Array
    resistivity: jax.Array
    area: jax.Array


class _Links(NamedTuple):
    """Link lengths, and the limits of the elbow angle and of the leg length."""

    la: jax.Array
    lb: jax.Array
    l_min: jax.Array
    l_max: jax.Array
    phi_max: jax.Array
    half_limit: tuple[jax.Array, jax.Array]  # sine and cosine of phi_max / 2


def integrals(l_min: jax.Array, v: jax.Array, outer: int, inner: int) -> Integrals:
    """Integrals of 1/kappa, of 1/|det J| and of 1 with 3 outer x 3 inner Gauss panels.

    l_min >= 1, 0 <= v <= sqrt((l_min - 1) / 2); la = 1 + v^2, lb = l_min + 1 - v^2 (eq. 22).
    """
    links = _links(l_min, v)
    zero, phi_max = jnp.zeros_like(links.phi_max), links.phi_max
    first, second = _outer_cuts(links)
    cuts = jnp.stack([zero, first, second, phi_max])
    a, rho, outer_weight = spread(smooth_ends(outer), cuts, phi_max - cuts)

    def row(a, rho):
        first, second = _inner_cuts(links, a, rho)
        ends = jnp.stack([jnp.zeros_like(a), first, second, jnp.ones_like(a)])
        s, away, weight = spread(smooth_ends(inner), ends, 1 - ends)
        densities = _densities(links, a, rho * s, rho * away)
        return jnp.stack([jnp.sum(weight * density) for density in densities])

    return Integrals(*((outer_weight * rho) @ jax.vmap(row)(a, rho)))


def _links(l_min, v) -> _Links:
    excess = v * v
    # tan^2(phi_max / 2) = (l_max^2 - l_min^2) / (l_min^2 - (lb - la)^2), without its cancellation
    sine, cosine = jnp.sqrt(l_min + 1), v * jnp.sqrt(l_min - excess)
    size = jnp.sqrt(sine**2 + cosine**2)
    phi_max = 2 * jnp.arctan2(sine, cosine)
    return _Links(1 + excess, l_min + 1 - excess, l_min, l_min + 2, phi_max, (sine / size, cosine / size))


def _densities(links: _Links, a, phi1, away2) -> tuple[jax.Array, jax.Array, jax.Array]:
    """1/kappa, 1/|det J| and 1, each times dW / dphi1 dphi2, over both halves of the workspace.

    away2 = phi_max - phi2 is given apart from phi1, because both ends are approached closely, and
    every sum of half angles is expanded so that nothing cancels there. gamma is the angle between
    the distal links at the end point, Gamma that between the legs, and alpha_i that between leg and
    distal link: gamma = Gamma + alpha1 + alpha2.
    """
    la, lb, l_min, l_max, sin_limit, cos_limit = (
        links.la,
        links.lb,
        links.l_min,
        links.l_max,
        *links.half_limit,
    )
    sin_a, cos_a = jnp.sin(a / 2), jnp.cos(a / 2)
    sin_p, cos_p = jnp.sin(phi1 / 2), jnp.cos(phi1 / 2)  # p, q: the halves of phi1, phi2
    sin_w, cos_w = jnp.sin(away2 / 2), jnp.cos(away2 / 2)
    sin_q = sin_a * cos_p + cos_a * sin_p
    cos_q = cos_limit * cos_w + sin_limit * sin_w
    sin1, cos1 = 2 * sin_p * cos_p, 1 - 2 * sin_p**2
    sin2, cos2 = 2 * sin_q * cos_q, 1 - 2 * sin_q**2

    p1, q1, p2, q2 = lb + la * cos1, la * sin1, lb + la * cos2, la * sin2  # l_i e^(i alpha_i)
    l1, l2 = jnp.sqrt(p1**2 + q1**2), jnp.sqrt(p2**2 + q2**2)
    # distances of the leg lengths from their limits: differences of cosines as products of sines
    below_max1 = 4 * la * lb * sin_p**2 / (l_max + l1)
    above_min1 = (
        4 * la * lb * (sin_a * cos_w + cos_a * sin_w) * (sin_limit * cos_p + cos_limit * sin_p) / (l1 + l_min)
    )
    above_min2 = 4 * la * lb * sin_w * (sin_limit * cos_q + cos_limit * sin_q) / (l2 + l_min)
    # 16 y^2 = ((l1 + l2)^2 - 4) (4 - (l1 - l2)^2)
    tall = (l1 + l2 + 2) * (above_min1 + above_min2 + 2 * (l_min - 1))
    y = jnp.sqrt(tall * (2 + l1 - l2) * (below_max1 + above_min2)) / 4

    real, imaginary = p1 * p2 - q1 * q2, p1 * q2 + q1 * p2
    half = (l1**2 + l2**2 - 4) / 2  # l1 l2 cos(Gamma); l1 l2 sin(Gamma) = 2 y
    product = (l1 * l2) ** 2
    sin_gamma = (half * imaginary + 2 * y * real) / product
    cos_gamma = (half * real - 2 * y * imaginary) / product

    both = 2 * sin1 * sin2
    determinant, total = both * sin_gamma, sin1**2 + sin2**2
    # total - determinant as a sum of squares; sin1 - sin2 = -2 sin(a / 2) cos(p + q)
    apart = 4 * (sin_a * (cos_p * cos_q - sin_p * sin_q)) ** 2 + both * cos_gamma**2 / (1 + sin_gamma)
    isotropy = determinant / (total + safe.sqrt((total + determinant) * apart))

    measure = (la * lb) ** 2 * sin1 * sin2 / y
    return measure * isotropy, lb**2 * sin_gamma / y, measure


def _inner_cuts(links: _Links, a, rho) -> tuple[jax.Array, jax.Array]:
    """Panel borders of the row at a, as fractions s. b = phi1 + phi2 = a + 2 rho s."""
    near_pi, right, has_right = _isotropic_curve(links, a)
    scale = lambda b: safe.divide(b - a, 2 * rho)
    return _cuts(scale(near_pi), jnp.ones_like(has_right), scale(right), has_right, 1.0)


def _isotropic_curve(links: _Links, a) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where gamma = pi/2 at given a: b = m1, m2. -> m1 drawn towards pi, m2, whether they exist

    gamma = pi/2 is la^2 w^2 + 2 la lb cos(a/2) w + lb^2 = 2 with w = cos(b/2) - sin(b/2).
    Close to the isotropic pair on b = pi the complex zeros of 1/kappa leave m1 for pi: their real
    part is m1 + u^2 d^3 / (u^2 d^2 + V^2), d = pi - m1, V = cos(a/2) cos(gamma) at b = pi.
    """
    la, lb = links.la, links.lb
    u, c = jnp.sin(a / 2), jnp.cos(a / 2)
    under_root = 2 - (lb * u) ** 2
    exists = under_root > 0
    arc = (lb * c - safe.sqrt(under_root)) / (la * jnp.sqrt(2.0))
    half_width = 2 * safe.arccos(jnp.where(exists, arc, 0))
    half_width = _faded(half_width, jnp.minimum(under_root, 1 - arc**2) / FADE)
    m1, m2 = 1.5 * jnp.pi - half_width, 1.5 * jnp.pi + half_width

    gap = jnp.pi - m1
    v = c * _cos_gamma_at_pi(links, a)
    drawn = m1 + safe.divide(u**2 * gap**3, u**2 * gap**2 + v**2)
    return jnp.where(exists, drawn, jnp.pi), m2, exists


def _cos_gamma_at_pi(links: _Links, a) -> jax.Array:
    """cos(gamma) on b = phi1 + phi2 = pi."""
    la, lb = links.la, links.lb
    sine, cosine = la * jnp.cos(a / 2), la * jnp.sin(a / 2)  # of phi = pi/2 -+ a/2, times la
    squares = (lb + cosine) ** 2 + sine**2, (lb - cosine) ** 2 + sine**2
    product = squares[0] * squares[1]
    half = (squares[0] + squares[1] - 4) / 2
    real, imaginary = lb**2 - cosine**2 - sine**2, 2 * lb * sine
    return (half * real - safe.sqrt(product - half**2) * imaginary) / product


def _outer_cuts(links: _Links) -> tuple[jax.Array, jax.Array]:
    """Panel borders in a: the isotropic pair on b = pi, and where the border near pi leaves the row."""
    la, lb, phi_max = links.la, links.lb, links.phi_max
    pair = (2 - (lb - la) ** 2) / (4 * la * lb)  # sin^2(a / 4)
    has_pair = (pair > 0) & (pair < 1)
    a_pair = 4 * safe.arcsin(safe.sqrt(jnp.where(has_pair, pair, 0)))
    a_pair = _faded(a_pair, jnp.minimum(pair, 1 - pair) / FADE)

    fixed = lax.stop_gradient(links)
    overshoot = lambda links, a: _isotropic_curve(links, a)[0] - (2 * links.phi_max - a)

    def bisect(_, interval):
        low, high = interval
        middle = (low + high) / 2
        is_inside = overshoot(fixed, middle) < 0
        return jnp.where(is_inside, middle, low), jnp.where(is_inside, high, middle)

    start = jnp.zeros_like(fixed.phi_max), fixed.phi_max
    leave = sum(lax.fori_loop(0, 50, bisect, start)) / 2
    slope = jax.jvp(lambda a: overshoot(fixed, a), (leave,), (jnp.ones_like(leave),))[1]
    miss = overshoot(links, leave)
    is_root = jnp.abs(lax.stop_gradient(miss)) < 1e-6
    moving = leave - safe.divide(miss - lax.stop_gradient(miss), slope)  # implicit function theorem
    leave = jnp.where(is_root, _faded(moving, jnp.abs(slope) / FADE), 2 * phi_max - jnp.pi)
    return _cuts(a_pair, has_pair, leave, jnp.ones_like(has_pair), phi_max)


def _cuts(p, has_p, q, has_q, end) -> tuple[jax.Array, jax.Array]:
    """Two increasing borders in [0, end]: p and q where they exist inside, halves or thirds else."""
    inside = lambda x, has: has & (x > NEAREST_CUT * end) & (x < (1 - NEAREST_CUT) * end)
    has_p, has_q = inside(p, has_p), inside(q, has_q)
    only = jnp.where(has_p, p, q)
    longer_half = jnp.where(only > end / 2, only / 2, (only + end) / 2)
    has_both, has_one = has_p & has_q, has_p ^ has_q
    third = end / 3 + 0 * only
    x = jnp.where(has_both, p, jnp.where(has_one, only, third))
    y = jnp.where(has_both, q, jnp.where(has_one, longer_half, 2 * third))
    return jnp.minimum(x, y), jnp.maximum(x, y)


def _faded(x, share) -> jax.Array:
    """x, its derivative multiplied by `share` clipped to [0, 1].

    Where a border is may depend on the design in any way, exact or not: the integral does not. But
    borders that follow the singularities keep the rule's error from moving, and with it the
    gradient's error; borders that move infinitely fast ruin it.
    """
    fixed = lax.stop_gradient(x)
    return fixed + jnp.clip(lax.stop_gradient(share), 0, 1) * (x - fixed)
