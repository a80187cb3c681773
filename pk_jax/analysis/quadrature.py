"""Gauss-Legendre rules on panels."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Rule(NamedTuple):
    """Nodes on [0, 1], their distances to 1 (tabulated apart: 1 - nodes cancels), and weights."""

    nodes: np.ndarray
    left: np.ndarray
    weights: np.ndarray


@functools.lru_cache
def gauss(count: int) -> Rule:
    """Gauss-Legendre on [0, 1]: exact for polynomials of degree 2 count - 1."""
    x, w = np.polynomial.legendre.leggauss(count)
    return Rule((1 + x) / 2, (1 - x) / 2, w / 2)


@functools.lru_cache
def smooth_ends(count: int) -> Rule:
    """Gauss-Legendre in t with x = 3 t^2 - 2 t^3: square-root ends become analytic."""
    t, left, weights = gauss(count)
    return Rule(t**2 * (1 + 2 * left), left**2 * (1 + 2 * t), weights * 6 * t * left)


def spread(rule: Rule, ends: jax.Array, left: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A rule laid on every panel between consecutive `ends`.

    ends (..., p + 1) increasing; left (..., p + 1) their distances to the last end, given apart so
    that they need not cancel. -> nodes, distances to the last end, weights, each (..., p * count)
    """
    width = (ends[..., 1:] - ends[..., :-1])[..., None]
    flat = lambda x: x.reshape(*x.shape[:-2], -1)
    dtype = ends.dtype
    nodes, away, weights = (jnp.asarray(part, dtype) for part in rule)
    return (
        flat(ends[..., :-1, None] + width * nodes),
        flat(left[..., 1:, None] + width * away),
        flat(width * weights),
    )
