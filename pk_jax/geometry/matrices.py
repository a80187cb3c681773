"""Small matrices without LAPACK: written out, they vectorize over batches, and never wait for one another.

Batched calls of LAPACK from several places of one program can block each other for good on a CPU.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np


def small_inverse(matrix: jax.Array) -> jax.Array:
    """A^-1 of a small square matrix; not finite where it is singular. -> (n, n)

    Two and three rows by the adjugate, more by orthogonal elimination.
    """
    n = len(matrix)
    if n == 1:
        return 1 / matrix
    if n == 2:
        (a, b), (c, d) = matrix
        return jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]) / (a * d - b * c)
    if n == 3:
        crosses = jnp.cross(jnp.roll(matrix, -1, axis=0), jnp.roll(matrix, -2, axis=0))
        return crosses.T / jnp.dot(matrix[0], crosses[0])
    rows, done, _ = orthonormal(matrix)
    return rows.T @ done


def orthonormal(matrix: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rows (k, m) made orthonormal, k <= m: Q, the T (k, k), lower, with T A = Q, and its diagonal's inverse.

    Gram and Schmidt, each row twice, which is enough.
    """
    rows, done, sizes = list(matrix), list(jnp.eye(len(matrix), dtype=matrix.dtype)), []
    for k in range(len(rows)):
        for _ in range(2):
            for i in range(k):
                along = rows[k] @ rows[i]
                rows[k], done[k] = rows[k] - along * rows[i], done[k] - along * done[i]
        size = jnp.sqrt(rows[k] @ rows[k])
        rows[k], done[k] = rows[k] / size, done[k] / size
        sizes.append(size)
    return jnp.stack(rows), jnp.stack(done), jnp.stack(sizes)


def small_det(matrix: jax.Array) -> jax.Array:
    """Determinant of a small square matrix; above three rows by Laplace's expansion in two blocks. -> ()"""
    n = len(matrix)
    if n == 1:
        return matrix[0, 0]
    if n == 2:
        return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    if n == 3:
        return jnp.dot(matrix[0], jnp.cross(matrix[1], matrix[2]))
    half = n // 2
    chosen = np.array(list(itertools.combinations(range(n), half)))
    others = np.array([[j for j in range(n) if j not in row] for row in chosen])
    signs = (-1.0) ** (chosen.sum(axis=1) - half * (half - 1) // 2)
    minors = lambda rows, columns: jax.vmap(lambda own: small_det(rows[:, own]))(columns)
    return jnp.sum(signs * minors(matrix[:half], chosen) * minors(matrix[half:], others))


def least_direction(points: jax.Array) -> jax.Array:
    """Unit vector along which centred points (k, 3) spread least. -> (3,)

    The power method on the adjugate of their scatter, squared until nothing moves.
    """
    scatter = points.T @ points
    scatter = scatter / jnp.trace(scatter)
    rows = scatter + 1e-9 * jnp.eye(3, dtype=points.dtype)
    power = jnp.cross(jnp.roll(rows, -1, axis=0), jnp.roll(rows, -2, axis=0))
    for _ in range(12):
        power = power / jnp.trace(power)
        power = power @ power
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    return column / jnp.sqrt(jnp.sum(column**2))
