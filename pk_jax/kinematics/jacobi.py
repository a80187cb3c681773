"""Singular values on lanes, by one-sided Jacobi rotations: accurate to roundoff, also where they vanish."""

from __future__ import annotations

from functools import reduce
from typing import Any

import jax.numpy as jnp
from jax import lax

from pk_jax.kinematics.elimination import Matrix
from pk_jax.kinematics.lanes import Lane, total

SWEEPS = 16  # convergence is quadratic: three to seven are taken


def orthogonal_rows(matrix: Matrix) -> Matrix:
    """U^T A of A = U S V^T: rows turned among one another until they are orthogonal. (c, n) -> (c, n)

    Their lengths are the singular values, in no order. All entries are whole lanes; one that is done stays as
    it is, so that its bits don't depend on the others.
    """
    width = len(matrix[0])
    pairs = [(i, j) for j in range(len(matrix)) for i in range(j)]
    eps = jnp.finfo(matrix[0][0].dtype).eps

    def is_turning(state):
        sweep, _, aslant = state
        return (sweep < SWEEPS) & jnp.any(aslant > eps)

    def turn(state):
        sweep, items, before = state
        rows = [items[i * width : (i + 1) * width] for i in range(len(matrix))]
        aslant = []
        for i, j in pairs:
            rows[i], rows[j], off = _turned(rows[i], rows[j])
            aslant.append(off)
        stay = lambda new, old: jnp.where(before > eps, new, old)
        turned = [item for row in rows for item in row]
        return sweep + 1, list(map(stay, turned, items)), stay(reduce(jnp.maximum, aslant), before)

    items = [item for row in matrix for item in row]
    if pairs:
        _, items, _ = lax.while_loop(is_turning, turn, (0, items, jnp.ones_like(items[0])))
    return [items[i * width : (i + 1) * width] for i in range(len(matrix))]


def lengths(rows: Matrix) -> list[Lane]:
    return [jnp.sqrt(total([v * v for v in row])) for row in rows]


def least_singular_value(matrix: Any) -> Lane:
    """Of a small matrix (c, n), c >= n, whatever is mapped over it; it calls no LAPACK. -> ()

    Batched calls of LAPACK that don't wait for one another can block each other for good on a CPU.
    """
    columns = [[matrix[i, j] for i in range(matrix.shape[0])] for j in range(matrix.shape[1])]
    return reduce(jnp.minimum, lengths(orthogonal_rows(columns)))


def _turned(first: list[Lane], second: list[Lane]) -> tuple[list[Lane], list[Lane], Lane]:
    """Two rows turned until they are orthogonal, and the cosine of the angle that was between them."""
    a, b = total([v * v for v in first]), total([v * v for v in second])
    product = total([v * w for v, w in zip(first, second, strict=True)])
    size = jnp.sqrt(a * b)
    is_slanted = jnp.abs(product) > jnp.finfo(product.dtype).tiny
    half = (b - a) / jnp.where(is_slanted, 2 * product, 1)
    tangent = jnp.where(half < 0, -1, 1) / (jnp.abs(half) + jnp.sqrt(1 + half * half))
    tangent = jnp.where(is_slanted, tangent, 0)
    cosine = 1 / jnp.sqrt(1 + tangent * tangent)
    sine = cosine * tangent
    both = list(zip(first, second, strict=True))
    turned = [cosine * v - sine * w for v, w in both], [sine * v + cosine * w for v, w in both]
    return *turned, jnp.where(is_slanted & (size > 0), jnp.abs(product) / jnp.where(size > 0, size, 1), 0)
