"""Batches of integrals in bounded memory, and their derivatives at the price of forward mode."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

ROWS_AT_ONCE = 16  # fits the cache with some thousand nodes a row


def forward_mode(function: Callable[[jax.Array], jax.Array]) -> Callable[[jax.Array], jax.Array]:
    """`function` (n,) -> array, its derivatives of every order always taken by forward mode.

    For integrals of a few design variables over thousands of nodes: reverse mode would keep every
    node in memory. `jax.grad` works as ever; it transposes the Jacobian, not the integral.
    Under `jax.vmap` the rows run in chunks.
    """

    def with_slopes(p):  # (..., 1 + n): the value, and its derivative in each variable
        def twice(p):
            y = function(p)
            return y, y

        jacobian, y = jax.jacfwd(twice, has_aux=True)(p)
        return jnp.concatenate([y[..., None], jacobian], axis=-1)

    @jax.custom_jvp
    def call(p):
        return in_chunks(function)(p)

    @call.defjvp
    def call_jvp(primals, tangents):
        both = forward_mode(with_slopes)(*primals)
        return both[..., 0], both[..., 1:] @ tangents[0]

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
