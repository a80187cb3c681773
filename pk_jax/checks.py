"""Bad input is told at the door: one line that names the field, the value and what is allowed.

Shapes are always checked. Values are checked only where they are known, that is, outside of
`jit`, `grad` and `vmap`; inside, a bad row gets a `Status` instead.
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import warnings
from collections.abc import Iterable, Mapping, Set
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

UNITS_DIFFER_BY = 100
ROOM = 4  # times its own size: what an array of rows takes with what is made of it
_CGROUP = "/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"  # of containers


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
    if isinstance(value, list | tuple) and not is_concrete(value):
        value = jnp.asarray(value)  # numbers that are traced one by one
    if isinstance(value, jax.core.Tracer):
        if jnp.issubdtype(value.dtype, jnp.floating):
            return value
        if jnp.issubdtype(value.dtype, jnp.integer):
            return value.astype(jnp.result_type(float))
        raise ValueError(f"{name} must be real numbers, got {value.dtype}")
    return jnp.asarray(real_numpy(name, value))


def real_numpy(name: str, value: Any) -> np.ndarray:
    """The same as a NumPy array, for values that are known."""
    if isinstance(value, np.ma.MaskedArray):
        value = value.astype(float).filled(np.nan)  # what is masked is no number
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):  # ragged nested lists, keys of jax.random
        raise ValueError(f"{name} must be a number or a regular array, got {shown(value)}") from None
    fits(name, ROOM * array.nbytes, "take fewer rows at a time")
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array if array.dtype.itemsize <= 8 else array.astype(np.float64)  # JAX has no longer ones
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
    is_real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if is_real and isinstance(value, int | np.integer):
        return bool(abs(value) <= sys.float_info.max)
    return is_real and math.isfinite(value)


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
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_integer or value < least or (most is not None and value > most):
        raise ValueError(f"{name} must be an integer {limit}, got {shown(value)}")
    return int(value)


def is_flag(name: str, value: Any) -> bool:
    """`value`, True or False; 1 and "no" are neither."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def is_function(name: str, value: Any) -> None:
    """That `value` can be called, or is None."""
    if not (value is None or callable(value)):
        raise ValueError(f"{name} must be a function or None, got {shown(value)}")


def is_dict(name: str, value: Any) -> Mapping:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a dict, name -> (lower, upper), got {shown(value)}")
    return value


def are_devices(name: str, value: Any) -> list[jax.Device]:
    """Devices of JAX, one at least; None: the first one of this process."""
    found = jax.local_devices()[:1] if value is None else value
    if not isinstance(found, list | tuple) or not all(isinstance(device, jax.Device) for device in found):
        raise ValueError(f"{name} must be a list of jax.devices(), got {shown(value)}")
    if not found:
        raise ValueError(f"{name} must hold at least one")
    return list(found)


def is_word(name: str, value: Any, words: Iterable[str]) -> str:
    """`value`, one of some words."""
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{name} must be one of {', '.join(words)}, got {shown(value)}")
    return value


def are_words(name: str, value: Any) -> tuple[str, ...]:
    """Words as users give them: "x,y", or a sequence of strings."""
    found = value.split(",") if isinstance(value, str) else value
    if not isinstance(found, list | tuple | Set) or not all(isinstance(word, str) for word in found):
        raise ValueError(f"{name} must be names, got {shown(value)}")
    return tuple(found)


def fits(what: str, size: float, hint: str) -> None:
    """ValueError where `what`, of so many bytes with all that it takes, is more than the memory there is."""
    if size > (most := _memory()):
        raise ValueError(
            f"{what} would take {size / 1e9:.3g} GB of memory, there are {most / 1e9:.3g}: {hint}"
        )


@lru_cache
def _memory() -> float:
    """Bytes that this process may have; infinite where the system does not say."""
    found = [math.inf]
    with contextlib.suppress(ValueError, OSError, AttributeError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in _CGROUP:
        with contextlib.suppress(ValueError, OSError):  # it may say "max"
            found.append(int(Path(path).read_text()))
    return min(found)


def shown(value: Any) -> str:
    """Any value in a message: one short line."""
    return _cut(repr(value))


def _short(value: Any) -> str:
    return _cut(str(np.asarray(value)))


def _cut(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."
