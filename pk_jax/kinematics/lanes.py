"""Lanes: arrays as their scalar entries, each entry an array over many configurations.

Arithmetic on them is written out in Python; entries that are known to be zero or one vanish.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Lane = Any  # an array, all lanes of one shape or scalars; or a known Python number


class Entries(NamedTuple):
    """An array as its entries in row-major order, each a lane."""

    shape: tuple[int, ...]
    items: list[Lane]

    def indices(self) -> np.ndarray:
        """Where each entry is in `items`: structural operations act on these. -> shape"""
        return np.arange(len(self.items)).reshape(self.shape)

    def at(self, indices: np.ndarray) -> Entries:
        return Entries(indices.shape, [self.items[i] for i in indices.ravel()])

    def rows(self) -> list[list[Lane]]:
        """The entries of a matrix."""
        return [[self.items[i] for i in row] for row in self.indices()]


def is_entries(leaf: Any) -> bool:
    return isinstance(leaf, Entries)


def split(array: jax.Array) -> Entries:
    """The entries of one array, as scalars."""
    return Entries(array.shape, [array[i] for i in np.ndindex(array.shape)])


def split_rows(array: jax.Array) -> Entries:
    """The entries of a batch (lanes, ...) of arrays."""
    shape = array.shape[1:]
    return Entries(shape, [array[(slice(None), *i)] for i in np.ndindex(shape)])


def stack(entries: Entries) -> jax.Array:
    """The entries as one array, lanes last. -> (*shape, *lanes)"""
    lanes = jnp.broadcast_shapes(*(jnp.shape(item) for item in entries.items))
    dtype = next((item.dtype for item in entries.items if not is_known(item)), None)
    items = [jnp.broadcast_to(jnp.asarray(item, dtype), lanes) for item in entries.items]
    return jnp.stack(items).reshape(*entries.shape, *lanes)


def items_of(tree: Any) -> list[Lane]:
    """The entries of all leaves, in order."""
    return [item for leaf in jax.tree.leaves(tree, is_leaf=is_entries) for item in leaf.items]


def rebuilt(items: Sequence[Lane], like: Any) -> Any:
    """A tree of `Entries` like another, from the entries of all its leaves."""
    rest = iter(items)
    fill = lambda leaf: Entries(leaf.shape, [next(rest) for _ in leaf.items])
    return jax.tree.map(fill, like, is_leaf=is_entries)


# --- arithmetic in which known zeros and ones vanish


def is_known(item: Lane) -> bool:
    return isinstance(item, bool | int | float | np.generic)


def times(a: Lane, b: Lane) -> Lane:
    for x, y in ((a, b), (b, a)):
        if is_known(x):
            if x == 0:
                return 0.0
            if x == 1:
                return y
            if x == -1:
                return -y
    return a * b


def plus(a: Lane, b: Lane) -> Lane:
    if is_known(a) and a == 0:
        return b
    return a if is_known(b) and b == 0 else a + b


def minus(a: Lane, b: Lane) -> Lane:
    if is_known(a) and a == 0:
        return -b
    return a if is_known(b) and b == 0 else a - b


def over(a: Lane, b: Lane) -> Lane:
    if is_known(a) and a == 0:
        return 0.0
    return times(a, 1 / b) if is_known(b) and b != 0 else a / b


def total(items: Sequence[Lane]) -> Lane:
    """The sum of lanes."""
    return functools.reduce(plus, items, 0.0)
