"""Bad input is told at the door: one line that names the field, the value and what is allowed.

Shapes are always checked. Values are checked only where they are known, that is, outside of
`jit`, `grad` and `vmap`; inside, a bad row gets a `Status` instead.
"""

from __future__ import annotations

import contextlib
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

UNITS_DIFFER_BY = 100


def is_concrete(*trees: Any) -> bool:
    """True where every leaf has a value that can be read now (no tracer among them)."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def known_values() -> contextlib.AbstractContextManager:
    """Within it, what is computed from known values is known too, also inside of a `jit`.

    Outside of one it does nothing: `ensure_compile_time_eval` runs jitted functions op by op.
    """
    return jax.ensure_compile_time_eval() if is_staged() else contextlib.nullcontext()


def is_staged() -> bool:
    """Whether a `jit` is being traced, in which even what is computed from known values is not known."""
    return isinstance(jnp.zeros(()), jax.core.Tracer)


def real_array(name: str, value: Any) -> jax.Array:
    """`value` as a floating-point array. Floats keep their precision, integers become floats."""
    if isinstance(value, jax.core.Tracer):
        if jnp.issubdtype(value.dtype, jnp.floating):
            return value
        if jnp.issubdtype(value.dtype, jnp.integer):
            return value.astype(jnp.result_type(float))
        raise ValueError(f"{name} must be real numbers, got {value.dtype}")
    return jnp.asarray(real_numpy(name, value))


def real_numpy(name: str, value: Any) -> np.ndarray:
    """The same as a NumPy array, for values that are known."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged nested lists
        raise ValueError(f"{name} must be a number or a regular array, got {_short(repr(value))}") from None
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    if np.issubdtype(array.dtype, np.integer):
        return array.astype(jnp.result_type(float))
    raise ValueError(f"{name} must be real numbers, got {_short(value)} ({array.dtype})")


def has_shape(name: str, value: jax.Array, shape: tuple[int | None, ...]) -> None:
    """`None` in `shape` stands for any size."""
    fits = len(value.shape) == len(shape) and all(
        want is None or got == want for got, want in zip(value.shape, shape, strict=True)
    )
    if not fits:
        wanted = str(tuple("any" if n is None else n for n in shape)).replace("'", "")
        raise ValueError(f"{name} must have shape {wanted}, got {tuple(value.shape)}")


def is_number(value: Any) -> bool:
    """Whether `value` is one finite real number; bools are none."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and np.isfinite(value)


def is_finite(name: str, value: jax.Array) -> None:
    if not np.all(np.isfinite(value)):
        raise ValueError(f"{name} must be finite, got {_short(value)}")


def is_positive(name: str, value: jax.Array) -> None:
    if not np.all(np.asarray(value) > 0):
        raise ValueError(f"{name} must be positive, got {_short(value)}")


def warn_of_units(what: str, ratio: float, *, stacklevel: int) -> None:
    """Warn where two lengths that belong together differ so much that one is in another unit."""
    if not 1 / UNITS_DIFFER_BY <= ratio <= UNITS_DIFFER_BY:  # NaN, too
        warnings.warn(f"{what} differ {ratio:.3g} times: are they in one unit?", stacklevel=stacklevel + 1)


def is_count(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """`value` as an int within [least, most]; bools, floats and strings are refused."""
    limit = f">= {least}" if most is None else f"from {least} to {most}"
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name} must be an integer {limit}, got {value!r}")
    if value < least or (most is not None and value > most):
        raise ValueError(f"{name} must be an integer {limit}, got {value}")
    return int(value)


def _short(value: Any) -> str:
    text = " ".join(str(np.asarray(value)).split())
    return text if len(text) <= 60 else text[:57] + "..."
