"""Small linear systems on lanes: elimination in a fixed order of pivots, and orthogonalization.

Choosing pivots lane by lane costs far more than the elimination. The order is chosen once, by
complete pivoting at a reference matrix, and holds in its neighbourhood; a lane on which it fails shows
in its residual and is solved again by other means. Where the reference is traced, its inverse takes
the part of the order: near it, inverse @ matrix is near the identity and needs no pivots.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from pk_jax.kinematics.lanes import Lane, minus, over, times, total

Matrix = list[list[Lane]]


class Order(NamedTuple):
    """In which order rows and columns are eliminated."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]

    def parity(self) -> int:
        """1 where the two permutations together are even, -1 where they are odd."""
        pairs = ((order, i, j) for order in self for j in range(len(order)) for i in range(j))
        return 1 - 2 * (sum(order[i] > order[j] for order, i, j in pairs) % 2)


class Reference(NamedTuple):
    """A matrix near which all others are: its inverse, and the sign of its determinant."""

    inverse: Matrix
    sign: Lane


def pivot_order(matrix: np.ndarray) -> Order:
    """The order of complete pivoting of a regular matrix (n, n)."""
    n = len(matrix)
    index, is_open = np.arange(n), np.ones((n, n), bool)
    rows, columns = [], []
    for _ in range(n):
        sizes = np.where(is_open, np.abs(matrix), -1)
        # among pivots equal up to roundoff the first, so that the order does not hang on roundoff
        i, j = np.argwhere(sizes >= np.max(sizes) * (1 - 1e-6))[0].tolist()
        if matrix[i, j] != 0:
            matrix = matrix - np.outer(matrix[:, j] / matrix[i, j], matrix[i])
        is_open = is_open & (index != i)[:, None] & (index != j)
        rows.append(i)
        columns.append(j)
    return Order(tuple(rows), tuple(columns))


class Factors(NamedTuple):
    """L U of the matrix as `by` arranges it: unit L below the diagonal, reciprocal pivots beside it."""

    lu: Matrix
    reciprocals: list[Lane]
    by: Order | Reference

    def sign(self) -> Lane:
        """Sign of the determinant."""
        product: Lane = 1.0
        for k, row in enumerate(self.lu):
            product = times(product, row[k])
        return jnp.sign(product) * (self.by.parity() if isinstance(self.by, Order) else self.by.sign)


def factor(matrix: Matrix, by: Order | Reference) -> Factors:
    """Gaussian elimination of a square matrix."""
    if isinstance(by, Order):
        lu = [[matrix[i][j] for j in by.columns] for i in by.rows]
    else:
        lu = [_times(by.inverse, column) for column in zip(*matrix, strict=True)]
        lu = [list(row) for row in zip(*lu, strict=True)]
    n = len(lu)
    reciprocals = []
    for k in range(n):
        reciprocals.append(over(1.0, lu[k][k]))
        for i in range(k + 1, n):
            lu[i][k] = times(lu[i][k], reciprocals[k])
            for j in range(k + 1, n):
                lu[i][j] = minus(lu[i][j], times(lu[i][k], lu[k][j]))
    return Factors(lu, reciprocals, by)


def solve(factors: Factors, right: list[Lane]) -> list[Lane]:
    """x with A x = right."""
    lu, reciprocals, by = factors
    n = len(lu)
    y = [right[i] for i in by.rows] if isinstance(by, Order) else _times(by.inverse, right)
    for i in range(n):
        for j in range(i):
            y[i] = minus(y[i], times(lu[i][j], y[j]))
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            y[i] = minus(y[i], times(lu[i][j], y[j]))
        y[i] = times(y[i], reciprocals[i])
    return [y[i] for i in np.argsort(by.columns)] if isinstance(by, Order) else y


def _times(matrix: Matrix, vector: list[Lane]) -> list[Lane]:
    return [total([times(a, x) for a, x in zip(row, vector, strict=True)]) for row in matrix]


def inverse(factors: Factors) -> Matrix:
    """A^-1, by columns of the identity, whose leading zeros vanish."""
    n = len(factors.lu)
    columns = [solve(factors, [1.0 if i == k else 0.0 for i in range(n)]) for k in range(n)]
    return [list(row) for row in zip(*columns, strict=True)]


def orthogonalize(matrix: Matrix, right: list[Lane]) -> tuple[Matrix, list[Lane]]:
    """R (n, n) and Q^T right (n,) of A = Q R, A (c, n) with c >= n, by modified Gram-Schmidt.

    The right side is carried along as one more column, which makes R x = Q^T right as accurate a
    least-squares solution as Householder's.
    """
    columns = [list(column) for column in zip(*matrix, strict=True)] + [list(right)]
    n = len(columns) - 1
    r: Matrix = [[0.0] * n for _ in range(n)]
    projected: list[Lane] = []
    for k in range(n):
        r[k][k] = jnp.sqrt(total([times(v, v) for v in columns[k]]))
        unit = [over(v, r[k][k]) for v in columns[k]]
        for j in range(k + 1, n + 1):
            along = total([times(u, v) for u, v in zip(unit, columns[j], strict=True)])
            columns[j] = [minus(v, times(along, u)) for u, v in zip(unit, columns[j], strict=True)]
            if j < n:
                r[k][j] = along
            else:
                projected.append(along)
    return r, projected


def back_substitute(r: Matrix, right: list[Lane]) -> list[Lane]:
    """x with R x = right, R upper triangular."""
    x = list(right)
    for i in reversed(range(len(r))):
        for j in range(i + 1, len(r)):
            x[i] = minus(x[i], times(r[i][j], x[j]))
        x[i] = over(x[i], r[i][i])
    return x


# --- normal equations: half the work of orthogonalization, enough where steps are corrected by later ones

NORMAL = "normal"


def normal(rows: Matrix) -> Matrix:
    """A^T A, symmetric. -> (n, n)"""
    columns = list(zip(*rows, strict=True))
    n = len(columns)
    half = [[_dot(columns[i], columns[j]) for j in range(i + 1)] for i in range(n)]
    return [[half[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


class Symmetric(NamedTuple):
    """L D L^T of a positive definite matrix: unit L below the diagonal, reciprocals of D."""

    lower: Matrix
    reciprocals: list[Lane]


def factor_symmetric(matrix: Matrix) -> Symmetric:
    """Without pivots and roots."""
    n = len(matrix)
    lower: Matrix = [[0.0] * n for _ in range(n)]
    pivots: list[Lane] = []
    for i in range(n):
        scaled = []  # L_ij D_j
        for j in range(i):
            scaled.append(minus(matrix[i][j], _dot(scaled[:j], lower[j][:j])))
            lower[i][j] = times(scaled[j], pivots[j])
        pivots.append(over(1.0, minus(matrix[i][i], _dot(scaled, lower[i][:i]))))
    return Symmetric(lower, pivots)


def solve_symmetric(factors: Symmetric, right: list[Lane]) -> list[Lane]:
    """x with A x = right."""
    lower, reciprocals = factors
    n = len(lower)
    x = list(right)
    for i in range(n):
        x[i] = minus(x[i], _dot(lower[i][:i], x[:i]))
    x = [times(item, pivot) for item, pivot in zip(x, reciprocals, strict=True)]
    for i in reversed(range(n)):
        x[i] = minus(x[i], _dot([lower[k][i] for k in range(i + 1, n)], x[i + 1 :]))
    return x


def inverse_symmetric(factors: Symmetric) -> Matrix:
    """A^-1 = K^T D^-1 K with K = L^-1, symmetric."""
    lower, reciprocals = factors
    n = len(lower)
    k: Matrix = [[0.0] * n for _ in range(n)]
    for j in range(n):
        k[j][j] = 1.0
        for i in range(j + 1, n):
            k[i][j] = minus(0.0, _dot(lower[i][j:i], [k[m][j] for m in range(j, i)]))
    scaled = [[times(item, pivot) for item in row] for row, pivot in zip(k, reciprocals, strict=True)]
    entry = lambda i, j: _dot(
        [k[m][i] for m in range(max(i, j), n)], [scaled[m][j] for m in range(max(i, j), n)]
    )
    half = [[entry(i, j) for j in range(i + 1)] for i in range(n)]
    return [[half[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


def _dot(a: Sequence[Lane], b: Sequence[Lane]) -> Lane:
    return total([times(x, y) for x, y in zip(a, b, strict=True)])
