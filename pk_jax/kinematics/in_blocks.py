"""Rows in blocks of one size, so that one compiled program serves any number of them, on all cores."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

BLOCK = 8192  # rows of one call at most; on an accelerator they are the lanes, all at once
ON_ACCELERATOR = 1 << 16
WORTH_A_THREAD = 4096  # rows
AGAIN = 64  # rows of one call that solves lost ones once more


def block_size() -> int:
    return BLOCK if jax.default_backend() == "cpu" else ON_ACCELERATOR


def in_blocks(run: Callable[[int, int], None], count: int, block: int, workers: int | None = None) -> None:
    """`run(first, last)` for parts of `range(count)`, none longer than a block.

    workers: threads; default: one a core
    """
    workers = cores() if workers is None else workers
    blocks = max(-(-count // block), min(workers, -(-count // WORTH_A_THREAD)), 1)
    share = max(-(-count // blocks), 1)
    starts = iter(range(0, count, share))

    def drain() -> None:
        for first in starts:  # each block is taken by one thread
            run(first, min(first + share, count))

    helpers = [_threads().submit(drain) for _ in range(min(workers, blocks) - 1)]
    drain()
    for helper in helpers:
        helper.result()


def redo(call: Callable, rows: np.ndarray, given: Any, found: Any) -> None:
    """`call(*given, found)` once more for some rows, its answers written into `found`.

    In blocks of one size: no bit of a row depends on how many others are lost. Trees of NumPy arrays, rows
    first.
    """
    for first in range(0, len(rows), AGAIN):
        these = rows[first : first + AGAIN]
        filled = np.resize(these, AGAIN)
        taken = jax.tree.map(lambda leaf, filled=filled: leaf[filled], (given, found))
        answers = call(*taken[0], taken[1])
        for whole, part in zip(jax.tree.leaves(found), jax.tree.leaves(answers), strict=True):
            whole[these] = np.asarray(part)[: len(these)]


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array that JAX takes over without a copy."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    begin = -memory.ctypes.data % 64
    return memory[begin : begin + size].view(dtype).reshape(shape)


def padded(rows: np.ndarray, count: int) -> np.ndarray:
    """At most `count` rows as exactly so many: the last one is repeated."""
    if len(rows) == count:
        return rows
    full = np.empty((count, *rows.shape[1:]), rows.dtype)
    full[: len(rows)], full[len(rows) :] = rows, rows[-1]
    return full


@lru_cache(maxsize=1024)
def size_of(rows: int) -> jax.Array:
    """The number of rows as a program takes it."""
    return jnp.asarray(np.int32(rows))


@cache
def cores() -> int:
    """How many blocks are solved at a time."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="pk_jax")
