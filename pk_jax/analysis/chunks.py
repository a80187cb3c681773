"""Batches of integrals in bounded memory, and their derivatives at the price of forward mode."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

ROWS_AT_ONCE = 16  # fits the cache with some thousand nodes a row


def forward_mode(function: Callable[[jax.Array], jax.Array]) -> Callable[[jax.Array], jax.Array]:
    """`function` (n,) -> (k,), its derivatives always taken by forward mode.

    For integrals of a few design variables over thousands of nodes: reverse mode would keep every
    node in memory. `jax.grad` works as ever; it transposes the (k, n) Jacobian, not the integral.
    Under `jax.vmap` the rows run in chunks.
    """
    value = in_chunks(function)

    def twice(p):
        y = function(p)
        return y, y

    value_and_jacobian = in_chunks(jax.jacfwd(twice, has_aux=True))

    @jax.custom_jvp
    def call(p):
        return value(p)

    @call.defjvp
    def call_jvp(primals, tangents):
        jacobian, y = value_and_jacobian(*primals)
        return y, jacobian @ tangents[0]

    return call


def in_chunks(function: Callable) -> Callable:
    """`function` of one array; a vmap over it becomes a loop over chunks of rows."""
    call = jax.custom_batching.custom_vmap(function)

    @call.def_vmap
    def rule(axis_size, in_batched, rows):
        if not in_batched[0]:  # a derivative of it is batched, it is not
            answers = function(rows)
        elif axis_size <= ROWS_AT_ONCE:
            answers = jax.vmap(function)(rows)
        else:
            answers = _loop(function, rows)
        return answers, jax.tree.map(lambda _: in_batched[0], answers)

    return call


def _loop(function: Callable, rows: jax.Array):
    """vmap in equal chunks; the last is filled up with copies of the last row."""
    count = rows.shape[0]
    chunks = -(-count // ROWS_AT_ONCE)
    fill = jnp.broadcast_to(rows[-1:], (chunks * ROWS_AT_ONCE - count, *rows.shape[1:]))
    filled = jnp.concatenate([rows, fill]).reshape(chunks, ROWS_AT_ONCE, *rows.shape[1:])
    answers = lax.map(jax.vmap(function), filled)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], answers)
