"""Small linear systems on lanes: elimination in a fixed order of pivots, and orthogonalization.

Choosing pivots lane by lane costs a hundred times the elimination. The order is chosen once, by
complete pivoting at a reference matrix, and holds in its neighbourhood; a lane on which it fails shows
in its residual and is solved again by other means.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.kinematics.lanes import Entries, Lane, minus, over, stack, times, total

Order = tuple[Any, Any]  # rows and columns: tuples of int, or traced index arrays (n,)
Matrix = list[list[Lane]]


def pivot_order(matrix: Any) -> Order:
    """Rows and columns of a regular matrix (n, n) in the order of complete pivoting.

    Tuples where the matrix is known, else index arrays, which is slower: the rows must be gathered.
    """
    if isinstance(matrix, jax.core.Tracer):
        return _pivot_order(matrix, jnp)
    rows, columns = _pivot_order(np.asarray(matrix), np)
    return tuple(rows.tolist()), tuple(columns.tolist())


def _pivot_order(matrix: Any, np: Any) -> tuple[Any, Any]:
    """The same lines for NumPy and for jax.numpy."""
    n = matrix.shape[0]
    index, is_open = np.arange(n), np.ones((n, n), bool)
    rows, columns = [], []
    for _ in range(n):
        sizes = np.where(is_open, np.abs(matrix), -1)
        # among pivots equal up to roundoff the first, so that the order does not hang on roundoff
        first = np.argmax(sizes.ravel() >= np.max(sizes) * (1 - 1e-6))
        i, j = first // n, first % n
        pivot = matrix[i, j]
        matrix = matrix - np.outer(matrix[:, j] / np.where(pivot == 0, 1, pivot), matrix[i])
        is_open = is_open & (index != i)[:, None] & (index != j)
        rows.append(i)
        columns.append(j)
    return np.stack(rows), np.stack(columns)


class Factors(NamedTuple):
    """L U of the matrix in its order: unit L below the diagonal of `lu`, reciprocal pivots beside it."""

    lu: Matrix
    reciprocals: list[Lane]
    order: Order

    def det(self) -> Lane:
        """Determinant, up to the sign of the order."""
        product: Lane = 1.0
        for k, row in enumerate(self.lu):
            product = times(product, row[k])
        return product


def factor(matrix: Matrix, order: Order) -> Factors:
    """Gaussian elimination of a square matrix in the given order of pivots."""
    rows, columns = order
    if isinstance(rows, tuple):
        lu = [[matrix[i][j] for j in columns] for i in rows]
    else:
        lu = [list(row) for row in _gathered(_gathered(matrix, rows, 0), columns, 1)]
    n = len(lu)
    reciprocals = []
    for k in range(n):
        reciprocals.append(over(1.0, lu[k][k]))
        for i in range(k + 1, n):
            lu[i][k] = times(lu[i][k], reciprocals[k])
            for j in range(k + 1, n):
                lu[i][j] = minus(lu[i][j], times(lu[i][k], lu[k][j]))
    return Factors(lu, reciprocals, order)


def solve(factors: Factors, right: list[Lane]) -> list[Lane]:
    """x with A x = right."""
    lu, reciprocals, (rows, columns) = factors
    is_static = isinstance(rows, tuple)
    n = len(lu)
    y = [right[i] for i in rows] if is_static else _gathered([right], rows, 1)[0]
    for i in range(n):
        for j in range(i):
            y[i] = minus(y[i], times(lu[i][j], y[j]))
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            y[i] = minus(y[i], times(lu[i][j], y[j]))
        y[i] = times(y[i], reciprocals[i])
    places = np.argsort(columns) if is_static else jnp.argsort(columns)
    return [y[i] for i in places] if is_static else _gathered([y], places, 1)[0]


def inverse(factors: Factors) -> Matrix:
    """A^-1, by columns of the identity; for an order known beforehand their leading zeros vanish."""
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


def _gathered(matrix: Matrix, indices: jax.Array, axis: int) -> Matrix:
    """Rows or columns in an order that is known only at run time."""
    items = [item for row in matrix for item in row]
    array = stack(Entries((len(matrix), len(matrix[0])), items))
    array = jnp.take(array, indices, axis=axis)
    return [list(row) for row in array]
