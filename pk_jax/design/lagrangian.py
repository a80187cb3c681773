"""Max-min under inequalities as one smooth function of the design: the augmented Lagrangian.

Maximize the least f_i where all c_j >= 0. Powell, Hestenes and Rockafellar keep estimates of the multipliers
and a penalty r, and minimize over the multipliers, held near their estimates (y, z):

    L(x) = min over m in the simplex of m f(x) + |m - y|^2 / (2 r)
         + min over n >= 0           of n c(x) + |n - z|^2 / (2 r)

The first is what remains of the epigraph form "maximize t where f_i >= t" once t is solved for. Both
minimizers are projections, and are the next estimates; the gradient of L is that of m f + n c.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Multipliers(NamedTuple):
    """Of the objective's entries, in the simplex, and of the constraints, >= 0; or one row for each."""

    objective: jax.Array  # (k,)
    constraints: jax.Array  # (p,)


def no_knowledge(objective_count: int, constraint_count: int, dtype: jnp.dtype) -> Multipliers:
    """The first estimate: all objectives alike, no constraint active."""
    return Multipliers(
        jnp.full(objective_count, 1 / objective_count, dtype), jnp.zeros(constraint_count, dtype)
    )


def next_multipliers(
    objective: jax.Array, slacks: jax.Array, old: Multipliers, penalty: jax.Array
) -> Multipliers:
    """The minimizers m (k,) and n (p,) at f (k,), c (p,)."""
    return Multipliers(
        onto_simplex(old.objective - penalty * objective),
        jnp.maximum(old.constraints - penalty * slacks, 0),
    )


def value_of(
    objective: jax.Array, slacks: jax.Array, old: Multipliers, new: Multipliers, penalty: jax.Array
) -> jax.Array:
    """L itself, from the minimizers. -> ()"""
    of = lambda by, what: jnp.sum(jnp.where(by > 0, by * what, 0))  # infinitely far from a limit: no share
    moved = jnp.sum((new.objective - old.objective) ** 2) + jnp.sum((new.constraints - old.constraints) ** 2)
    return of(new.objective, objective) + of(new.constraints, slacks) + moved / (2 * penalty)


def gradient_of(slopes: Multipliers, by: Multipliers) -> jax.Array:
    """That of m f + n c, from the derivatives (k, n) and (p, n) of f and c. -> (n,)"""
    part = lambda by, slope: jnp.sum(jnp.where(by[:, None] != 0, by[:, None] * slope, 0), axis=0)
    return part(by.objective, slopes.objective) + part(by.constraints, slopes.constraints)


def curvature_of(slopes: Multipliers, new: Multipliers, penalty: jax.Array) -> jax.Array:
    """The share of -L'' that is due to the multipliers' dependence on x: r times squares. -> (n, n)"""
    is_active = (new.objective > 0)[:, None]
    rows = jnp.where(is_active, slopes.objective, 0)
    rows = jnp.where(is_active, rows - jnp.sum(rows, axis=0) / jnp.maximum(jnp.sum(is_active), 1), 0)
    tight = jnp.where((new.constraints > 0)[:, None], slopes.constraints, 0)
    return penalty * (rows.T @ rows + tight.T @ tight)


def gap(old: Multipliers, new: Multipliers, penalty: jax.Array) -> jax.Array:
    """How far active entries are from f_i = t and c_j = 0; all c_j >= -gap, all f_i >= t - gap. -> ()"""
    both = zip(old, new, strict=True)
    moved = jnp.concatenate([jnp.where(n > 0, jnp.abs(n - o), 0) for o, n in both])
    return jnp.max(moved) / penalty


def onto_simplex(point: jax.Array) -> jax.Array:
    """The nearest point with entries >= 0 of sum 1. (k,) -> (k,)"""
    if point.size == 1:
        return jnp.ones_like(point)
    descending = -jnp.sort(-point)
    level = (jnp.cumsum(descending) - 1) / jnp.arange(1, point.size + 1)
    count = jnp.sum(descending > level)
    return jnp.maximum(point - level[jnp.maximum(count, 1) - 1], 0)


def least_squares(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Coefficients >= 0 of columns (m, k) whose sum is nearest to target (m,), by active sets. -> (k,)"""
    count = columns.shape[1]
    found, used = np.zeros(count), np.zeros(count, bool)
    tiny = 1e-12 * max(1.0, np.abs(columns).max(initial=0)) * max(1e-300, np.abs(target).max(initial=0))
    for _ in range(3 * count):
        slope = columns.T @ (target - columns @ found)
        slope[used] = -np.inf
        if used.all() or slope.max() <= tiny:
            break
        used[int(np.argmax(slope))] = True
        found = _step_to_least(columns, target, found, used)
    return found


def _step_to_least(columns, target, found, used) -> np.ndarray:
    """Move to the least squares solution on the used columns, dropping those that turn negative."""
    while used.any():
        wanted = np.zeros_like(found)
        wanted[used] = np.linalg.lstsq(columns[:, used], target, rcond=None)[0]
        falls = used & (wanted <= 0)
        if not falls.any():
            return wanted
        share = np.min(found[falls] / (found[falls] - wanted[falls] + 1e-300))
        found = np.where(used, found + share * (wanted - found), 0)
        used &= ~(falls & (found <= 1e-14 * np.abs(found).max(initial=0)))
        if share == 0:
            used &= ~falls
    return found * used
