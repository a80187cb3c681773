"""The composite performance index (CPI)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks


class IndexBounds(NamedTuple):
    """Least and greatest value of GII, GRI and SUI over a design space: the frozen normalization."""

    lower: jax.Array  # (3,)
    upper: jax.Array  # (3,)


def index_vector(indices: Any) -> jax.Array:
    """(gii, gri, sui) of `WorkspaceIndices`, or an array that already is that. -> (..., 3)"""
    if hasattr(indices, "gii"):
        return jnp.stack([indices.gii, indices.gri, indices.sui], axis=-1)
    return checks.real_array("indices", indices)


def composite_index(indices: Any, bounds: Any, weights: Any = (1, 1, 1)) -> jax.Array:
    """Weighted sum of the indices, each normalized to [0, 1] (Nam, Lee and Park 2006, eq. 27). -> (...)

    indices:  `WorkspaceIndices` or (..., 3) gii, gri, sui
    bounds:   (lower (3,), upper (3,)), such as `IndexBounds`; constants, also under differentiation
    weights:  (3,) each >= 0, not all zero
    """
    values = index_vector(indices)
    if values.ndim == 0 or values.shape[-1] != 3:
        raise ValueError(f"indices must have shape (..., 3), got {values.shape}")
    lower, upper = (jax.lax.stop_gradient(bound) for bound in require_bounds(bounds))
    return jnp.sum(require_weights(weights) * (values - lower) / (upper - lower), axis=-1)


def require_weights(weights: Any) -> jax.Array:
    """`weights` as an array; ValueError unless three finite numbers >= 0, not all zero."""
    array = checks.real_array("weights", weights)
    checks.has_shape("weights", array, (3,))
    if checks.is_concrete(array):
        checks.is_finite("weights", array)
        if np.any(np.asarray(array) < 0) or np.all(np.asarray(array) == 0):
            raise ValueError(f"weights must be >= 0 and not all zero, got {array.tolist()}")
    return array


def require_bounds(bounds: Any) -> IndexBounds:
    """`bounds` as arrays; ValueError unless lower < upper for each index."""
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"bounds must be (lower, upper), three numbers each, got {checks.shown(bounds)}")
    found = IndexBounds(*(checks.real_array("bounds", bound) for bound in bounds))
    for bound in found:
        checks.has_shape("bounds", bound, (3,))
    if checks.is_concrete(found):
        for bound in found:
            checks.is_finite("bounds", bound)
        if not np.all(np.asarray(found.lower) < np.asarray(found.upper)):
            raise ValueError(
                f"bounds must have lower < upper, got {found.lower.tolist()}, {found.upper.tolist()}"
            )
    return found
