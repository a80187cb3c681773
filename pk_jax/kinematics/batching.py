"""One row or many: the shape of the input decides, and every public solver decides alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pk_jax import checks


def rows_of(name: str, value: Any, one: jax.Array) -> jax.Array:
    """`value` as an array shaped like `one`, or with one leading batch axis more."""
    array = checks.real_array(name, value).astype(one.dtype)
    if array.ndim == one.ndim + 1:
        checks.has_shape(name, array, (None, *one.shape))
    elif array.ndim == one.ndim:
        checks.has_shape(name, array, one.shape)
    else:
        raise ValueError(f"{name} must have shape {one.shape} or (batch, ...), got {array.shape}")
    return array


def over_rows(function: Callable, arguments: tuple, are_batched: tuple[bool, ...]) -> Any:
    """`function(*arguments)`, vmapped over those arguments that are batched."""
    if not any(are_batched):
        return function(*arguments)
    sizes = {a.shape[0] for a, batched in zip(arguments, are_batched, strict=True) if batched}
    if len(sizes) != 1:
        raise ValueError(f"batched arguments must have the same number of rows, got {sorted(sizes)}")
    return jax.vmap(function, in_axes=tuple(0 if batched else None for batched in are_batched))(*arguments)


def all_finite(*arrays: jax.Array) -> jax.Array:
    """() True where no entry is NaN or infinite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(a)) for a in arrays]))
