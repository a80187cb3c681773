"""Every planar pose that puts three points of a platform on three circles: at most six."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax.geometry.planar import rotation

MOST = 6
SAMPLES = 32  # of the polynomial in phi, which has at most six zeros
POLISHED = 8  # Newton steps
CLOSED_TO = 1e-10  # of the size of the equations
APART = 1e-6  # of the size: two poses are two


@jax.jit
def platforms_on_circles(
    platform: jax.Array, centres: jax.Array, radii: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Poses (x, y, phi) with |P + R(phi) h_i - c_i| = r_i, i = 1..3. -> (6, 3), (6,)

    platform (3, 2) the points h_i in the platform frame, centres (3, 2), radii (3,). The real ones first,
    by phi in (-pi, pi], NaN in the others; poses that coincide to 1e-6 are given once. Their derivatives are
    exact through third order.
    """
    given = platform, centres, radii
    known = lax.stop_gradient(given)
    poses = _candidates(*known)
    every = jnp.ones(poses.shape[0], bool)
    poses = lax.fori_loop(0, POLISHED, lambda _, poses: _newton(poses, *known, every), poses)

    size, eps = _size(*known), jnp.finfo(poses.dtype).eps
    turns = jnp.arctan2(jnp.sin(poses[:, 2]), jnp.cos(poses[:, 2]))
    poses = poses.at[:, 2].set(turns)
    off = jnp.max(jnp.abs(_equations(poses, *known)), axis=1) / size**2
    is_real = off < jnp.maximum(CLOSED_TO, 64 * eps)  # NaN compares False
    gaps = jnp.abs(poses[:, None] - poses)
    turned = jnp.abs(2 * jnp.sin(gaps[..., 2] / 2))
    is_same = jnp.maximum(jnp.max(gaps[..., :2], axis=-1) / size, turned) < jnp.maximum(APART, 1e3 * eps)
    is_real = is_real & ~jnp.any(jnp.tril(is_same & is_real, -1), axis=1)
    order = jnp.argsort(jnp.where(is_real, turns, jnp.inf))[:MOST]
    poses, is_real = poses[order], is_real[order]
    for _ in range(2):  # from a root, two steps have its derivatives through third order
        poses = _newton(jnp.where(is_real[:, None], poses, 0), *given, is_real)
    return jnp.where(is_real[:, None], poses, jnp.nan), is_real


def _candidates(platform: jax.Array, centres: jax.Array, radii: jax.Array) -> jax.Array:
    """Poses, every real one among them to the accuracy of a root of a polynomial. -> (12, 3)

    With Y the vector from centre 1 to platform point 1, and u_j that from centre j to point j less Y, the
    differences of the equations say Y . u_j = w_j. Both are linear in z = exp(i phi), and what is left,
    |Y|^2 = r_1^2, is a trigonometric polynomial of degree 3 in phi. In s = tan(phi / 2), phi counted from
    opposite to where it is greatest, it is a polynomial of degree 6 whose leading coefficient is
    that greatest value.
    """
    size = _size(platform, centres, radii)
    points, middles = ((p[:, 0] + 1j * p[:, 1]) / size for p in (platform, centres))
    r = radii / size
    d, g = points[1:] - points[0], middles[1:] - middles[0]
    a = (r[1:] ** 2 - r[0] ** 2 - jnp.abs(d) ** 2 - jnp.abs(g) ** 2) / 2
    b = d * g.conj()
    w = jnp.stack([b.conj() / 2, a + 0j, b / 2], axis=1)  # powers -1, 0, 1 of z
    u = jnp.stack([-g, d], axis=1)  # powers 0, 1
    v = _product(w[0], u[1]) - _product(w[1], u[0])  # i Y D, powers -1 .. 2
    turn = (d[0] * g[1].conj() - d[1] * g[0].conj()) / 2j
    across = jnp.imag(d[0].conj() * d[1] + g[0].conj() * g[1])
    cross = jnp.stack([turn.conj(), across + 0j, turn])  # D = u_1 x u_2
    f = _product(v, v[::-1].conj()) - r[0] ** 2 * jnp.pad(_product(cross, cross), 1)  # -3 .. 3

    powers = jnp.arange(-3, 4)
    angles = jnp.arange(SAMPLES, dtype=r.dtype) * (2 * np.pi / SAMPLES)
    values = jnp.real(jnp.exp(1j * angles[:, None] * powers) @ f)
    opposite = angles[jnp.argmax(jnp.abs(values))] + np.pi
    polynomial = jnp.real(f * jnp.exp(1j * opposite * powers) @ jnp.asarray(_HALF_ANGLE, f.dtype))
    s = jnp.roots(polynomial, strip_zeros=False)
    phi = jnp.tile(opposite + 2 * jnp.arctan(jnp.real(s)), 2)

    # at some phi both signs of what |Y| = r_1 leaves across u_j are poses, when u_1 and u_2 are parallel
    rise = jnp.repeat(jnp.array([1.0, -1.0], r.dtype), MOST)
    each = jnp.exp(1j * phi)[:, None] * d - g
    first = jnp.abs(each[:, 0]) >= jnp.abs(each[:, 1])
    longer = jnp.where(first, each[:, 0], each[:, 1])
    number = jnp.where(first, 0, 1)
    squared = jnp.maximum(jnp.abs(longer) ** 2, jnp.finfo(r.dtype).tiny ** 0.5)
    along = (r[1:][number] ** 2 - r[0] ** 2 - squared) / 2 / squared
    height = jnp.sqrt(jnp.maximum(r[0] ** 2 / squared - along**2, 0))
    y = longer * (along + 1j * rise * height)
    origin = size * (middles[0] + y - jnp.exp(1j * phi) * points[0])
    return jnp.stack([origin.real, origin.imag, phi], axis=1)


def _product(first: jax.Array, second: jax.Array) -> jax.Array:
    """Coefficients of the product of two polynomials."""
    shifted = [jnp.pad(a * second, (i, len(first) - 1 - i)) for i, a in enumerate(first)]
    return sum(shifted[1:], shifted[0])


def _half_angle_powers() -> np.ndarray:
    """(1 + i s)^(3 + k) (1 - i s)^(3 - k), k = -3 .. 3, as polynomials, highest power first. -> (7, 7)"""
    power = np.polynomial.polynomial.polypow
    products = [np.convolve(power([1, 1j], 3 + k), power([1, -1j], 3 - k)) for k in range(-3, 4)]
    return np.array(products)[:, ::-1]


_HALF_ANGLE = _half_angle_powers()


def _size(platform: jax.Array, centres: jax.Array, radii: jax.Array) -> jax.Array:
    spans = [jnp.max(jnp.abs(points - points[0])) for points in (platform, centres)]
    return jnp.maximum(jnp.max(radii), jnp.maximum(*spans))


def _equations(poses: jax.Array, platform: jax.Array, centres: jax.Array, radii: jax.Array) -> jax.Array:
    """(|P + R h_i - c_i|^2 - r_i^2) / 2 of every pose. -> (poses, 3)"""

    def of(pose):
        away = pose[:2] + platform @ rotation(pose[2]).T - centres
        return (jnp.sum(away**2, axis=1) - radii**2) / 2

    return jax.vmap(of)(poses)


def _newton(
    poses: jax.Array, platform: jax.Array, centres: jax.Array, radii: jax.Array, is_wanted: jax.Array
) -> jax.Array:
    """One Newton step of every pose that is wanted, none where it is not finite. -> (poses, 3)"""

    def moved(pose, is_wanted):
        equations = lambda pose: _equations(pose[None], platform, centres, radii)[0]
        value, (a, b, c) = (
            equations(pose),
            jnp.where(is_wanted, jax.jacfwd(equations)(pose), jnp.eye(3, dtype=pose.dtype)),
        )
        crosses = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])  # Cramer's rule
        step = value @ crosses / jnp.dot(a, crosses[0])
        return pose - jnp.where(jnp.isfinite(step), step, 0)

    return jax.vmap(moved)(poses, is_wanted)
