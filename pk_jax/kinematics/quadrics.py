"""The three numbers that the linear stage leaves free, from six quadrics.

The sensors' vectors are r = r0 + N y; six of their lengths are known, |r_j| = s_j and the sides
of the triangle. Each says |c + G y|^2 = d with G = D N, one quadric in y (3,). Three ways:

- products: the six quadrics are solved for the six products y_a y_b, which become affine in y;
  that y_a (y_b y_c) does not hang on the brackets gives eight affine equations for y. What has to be
  inverted but for these eight knows no lengths.
- macaulay: the quadrics times {1, y_1, y_2, y_3} are 24 equations in the 20 monomials of degree <= 3;
  their null vector holds y.
- quintic: the squares eliminated orthogonally, three equations are left, of which eqs. (11)-(17) of
  Ryu et al. (KR 10-2000-0073215) make a quintic in y_3; the real part of each root is a candidate.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.kinematics.linear_stage import PRODUCTS, Stage, differences, quadratic_parts


class Quadrics(NamedTuple):
    """|centres + slopes @ y|^2 = squared, six times."""

    centres: jax.Array  # (6, 3)
    slopes: jax.Array  # (6, 3, 3)
    squared: jax.Array  # (6,)


def quadrics_of(stage: Stage, lengths: jax.Array) -> tuple[jax.Array, Quadrics]:
    """r0 (3, 3) and the six quadrics of nine lengths."""
    start = (stage.of_squares @ lengths**2 + stage.offset).reshape(3, 3)
    feet = differences(stage.feet).at[:3].set(0)
    squared = jnp.concatenate([lengths[6:] ** 2, stage.frame.sides])
    centres, slopes = differences(start) + feet, differences(stage.free.reshape(3, 3, 3))
    return start, Quadrics(centres, slopes, squared)


def values_at(quadrics: Quadrics, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The six quadrics and their gradients. -> (6,), (6, 3)"""
    vectors = quadrics.centres + quadrics.slopes @ y
    value = jnp.sum(vectors**2, axis=1) - quadrics.squared
    return value, 2 * jnp.einsum("ki,kia->ka", vectors, quadrics.slopes)


def linear_parts(quadrics: Quadrics) -> jax.Array:
    """Coefficients of y and 1. -> (6, 4)"""
    value, gradient = values_at(quadrics, jnp.zeros_like(quadrics.squared[:3]))
    return jnp.concatenate([gradient, value[:, None]], axis=1)


def products_of(stage: Stage, quadrics: Quadrics) -> jax.Array:
    """y_a y_b, in the order of `PRODUCTS`, as affine functions of y. -> (6, 4)"""
    return -stage.squares @ linear_parts(quadrics)


def bracketings(products: jax.Array) -> jax.Array:
    """Affine equations in y that hold because products do not hang on brackets. -> (8, 4)"""
    rows = []
    for factors in combinations_with_replacement(range(3), 3):
        ways = []
        for first in sorted(set(factors)):
            rest = list(factors)
            rest.remove(first)
            ways.append(_times(products, first, _PLACE[tuple(rest)]))
        rows += [way - ways[0] for way in ways[1:]]
    return jnp.stack(rows)


def _times(products: jax.Array, first: int, rest: int) -> jax.Array:
    """y_first times the product in row `rest`, as an affine function. -> (4,)"""
    affine = products[rest]
    found = sum(affine[a] * products[_PLACE[first, a]] for a in range(3))
    return found.at[first].add(affine[3])


_PLACE = {pair: place for place, (a, b) in enumerate(PRODUCTS) for pair in ((a, b), (b, a))}


def by_macaulay(quadrics: Quadrics) -> jax.Array:
    """y from the null vector of the 24 x 20 matrix. -> (1, 3)"""
    polynomials = _polynomials(quadrics)
    polynomials = polynomials / jnp.linalg.norm(polynomials, axis=1, keepdims=True)
    matrix = jnp.einsum("kq,fqm->kfm", polynomials, jnp.asarray(_SHIFTS, polynomials.dtype))
    null = jnp.linalg.svd(matrix.reshape(24, 20))[2][-1]
    return (null[1:4] / null[0])[None]


def by_quintic(quadrics: Quadrics) -> jax.Array:
    """y for the real part of each root. -> (5, 3)"""
    polynomials = _polynomials(quadrics)
    basis = jnp.linalg.qr(polynomials[:, _SQUARES], mode="complete")[0][:, 3:]
    rest = basis.T @ polynomials  # no squares are left
    one, x, y, z, xy, xz, yz = (rest[:, _AT[m]] for m in ("", "0", "1", "2", "01", "02", "12"))
    zero = jnp.zeros_like(xy)
    # columns of eq. (16) as polynomials in z, ascending: XY, XW, YW, W^2
    h, second, third, fourth = (xy, zero), (x, xz), (y, yz), (one, z)
    d1, d2 = _determinant(second, third, fourth), _determinant(h, third, fourth)
    d3, d4 = _determinant(h, second, fourth), _determinant(h, second, third)
    quintic = (jnp.convolve(d1, d4) - jnp.convolve(d2, d3))[:6]
    heights = jnp.real(jnp.roots(quintic[::-1], strip_zeros=False))

    def rebuilt(height):  # eq. (17)
        left = jnp.stack([xy, x + xz * height, y + yz * height], axis=1)
        others = jnp.linalg.solve(left, -(one + z * height))
        return jnp.stack([others[1], others[2], height])

    return jax.vmap(rebuilt)(heights)


def _determinant(*columns: tuple[jax.Array, jax.Array]) -> jax.Array:
    """det of three columns that are linear in z, ascending. -> (4,)"""
    found = [0.0] * 4
    for powers in np.ndindex(2, 2, 2):
        matrix = jnp.stack([column[p] for column, p in zip(columns, powers, strict=True)], axis=1)
        found[sum(powers)] += matrix[:, 0] @ jnp.cross(matrix[:, 1], matrix[:, 2])
    return jnp.stack(found)


def _polynomials(quadrics: Quadrics) -> jax.Array:
    """Coefficients of the six quadrics, of 1, y, and the products. -> (6, 10)"""
    linear = linear_parts(quadrics)
    return jnp.concatenate([linear[:, 3:], linear[:, :3], quadratic_parts(quadrics.slopes)], axis=1)


_MONOMIALS = [m for degree in range(4) for m in combinations_with_replacement(range(3), degree)]
_QUADRATIC = [(), (0,), (1,), (2,), *PRODUCTS]  # in the order of `_polynomials`
_AT = {"".join(map(str, monomial)): place for place, monomial in enumerate(_QUADRATIC)}
_SQUARES = np.array([_AT["00"], _AT["11"], _AT["22"]])
_SHIFTS = np.zeros((4, 10, 20))  # a quadric times 1, y_1, y_2, y_3
for _f, _factor in enumerate(_QUADRATIC[:4]):
    for _q, _monomial in enumerate(_QUADRATIC):
        _SHIFTS[_f, _q, _MONOMIALS.index(tuple(sorted((*_factor, *_monomial))))] = 1
