"""One-configuration code over many known rows: on lanes, in blocks, on all cores, in any number."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax.kinematics.compiled import FULL, compiled
from pk_jax.kinematics.in_blocks import aligned, block_size, in_blocks, padded, size_of
from pk_jax.kinematics.lanes import Lane, split, split_rows

Function = Callable[..., list[Lane]]  # of a mechanism and a row, both made of Entries


def lane_map(
    function: Function, mech: Any, rows: tuple, shapes: Sequence[tuple[int, ...]] | None = None
) -> Any:
    """`function(mech, *row)`, a list of lanes, of every row. -> (values, rows)

    rows:    trees of NumPy arrays (batch, ...)
    shapes:  what the values are, one after the other: then a list of arrays (batch, *shape)

    The program is compiled once for all numbers of rows, and for
    each `function`, which must be one object from call to call.
    """
    mech_leaves, mech_tree = jax.tree.flatten(mech)
    leaves, tree = jax.tree.flatten(rows)
    count = len(leaves[0])
    mech_shapes = tuple((leaf.shape, leaf.dtype) for leaf in mech_leaves)
    row_shapes = tuple((leaf.shape[1:], leaf.dtype) for leaf in leaves)
    block = block_size()
    run_block, out_like = _program(function, mech_tree, mech_shapes, tree, row_shapes, block)
    mech_leaves = [jnp.asarray(leaf) for leaf in mech_leaves]
    if shapes is None:
        found = aligned((out_like.shape[0], count), out_like.dtype)
    else:
        found = [aligned((count, *shape), out_like.dtype) for shape in shapes]
        cuts = np.cumsum([0, *map(math.prod, shapes)])

    def run(first: int, last: int) -> None:
        rows, size = slice(first, last), last - first
        given = [jnp.asarray(padded(leaf[rows], block)) for leaf in leaves]
        out = np.asarray(run_block([*mech_leaves, *given, size_of(size)])[0])  # (chunks, values, lanes)
        if shapes is None:
            found[:, rows] = out.transpose(1, 0, 2).reshape(out.shape[1], -1)[:, :size]
            return
        out = out[: -(-size // out.shape[2])]
        for array, begin, end in zip(found, cuts, cuts[1:], strict=False):
            part = out[:, begin:end].transpose(0, 2, 1)
            array[rows] = part.reshape(-1, *array.shape[1:])[:size]

    if count:
        in_blocks(run, count, block)
    return found


@lru_cache(maxsize=64)
def _program(
    function: Function, mech_tree: Any, shapes: tuple, tree: Any, row_shapes: tuple, block: int
) -> tuple[Callable, jax.ShapeDtypeStruct]:
    """The compiled block, (mechanism, rows, number of rows) -> (chunks, values, lanes); and one chunk."""
    mech = jax.tree.unflatten(mech_tree, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    rows = jax.tree.unflatten(
        tree, [jax.ShapeDtypeStruct((block, *shape), dtype) for shape, dtype in row_shapes]
    )
    lanes = FULL.lanes if jax.default_backend() == "cpu" else block
    chunks = block // lanes

    def one_chunk(mech, rows, k):
        at = lambda leaf: split_rows(lax.dynamic_slice_in_dim(leaf, k * lanes, lanes))
        found = function(jax.tree.map(split, mech), *jax.tree.map(at, rows))
        return jnp.stack([jnp.broadcast_to(item, (lanes,)) for item in found])

    like = jax.eval_shape(one_chunk, mech, rows, 0)

    def all_chunks(mech, rows, count):
        body = lambda k, out: lax.dynamic_update_slice_in_dim(out, one_chunk(mech, rows, k)[None], k, 0)
        out = jnp.zeros((chunks, *like.shape), like.dtype)
        return lax.fori_loop(0, jnp.minimum((count + lanes - 1) // lanes, chunks), body, out)

    return compiled(all_chunks, (mech, rows, jax.ShapeDtypeStruct((), jnp.int32))), like
