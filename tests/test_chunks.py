"""Forward-mode derivatives and chunked vmaps of `analysis/chunks.py`, on a function with known ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pk_jax.analysis.chunks import ROWS_AT_ONCE, forward_mode


def plain(p):
    return jnp.stack([jnp.sin(p[0]) * p[1] ** 2, jnp.exp(p[0] * p[1])])


wrapped = forward_mode(plain)
ROWS = jnp.linspace(0.1, 1.3, 2 * (2 * ROWS_AT_ONCE + 3)).reshape(-1, 2)  # two chunks and a rest


def test_values_and_derivatives_of_every_kind():
    p = jnp.array([0.7, 1.1])
    for transform in (
        lambda f: f,
        jax.jacfwd,
        jax.jacrev,
        jax.hessian,
        lambda f: jax.jacrev(jax.jacrev(f)),
        lambda f: jax.grad(lambda p: jnp.sum(f(p) ** 2)),
    ):
        np.testing.assert_allclose(transform(wrapped)(p), transform(plain)(p), rtol=1e-13)


@pytest.mark.soak
def test_batches_of_every_size_equal_a_loop():
    for count in (1, 2, ROWS_AT_ONCE, ROWS_AT_ONCE + 1, len(ROWS)):
        rows = ROWS[:count]
        for transform in (lambda f: f, jax.jacfwd, jax.jacrev, jax.hessian):
            batched = jax.jit(jax.vmap(transform(wrapped)))(rows)
            looped = jnp.stack([transform(plain)(row) for row in rows[:3]])
            np.testing.assert_allclose(batched[:3], looped, rtol=1e-12)
            assert batched.shape[0] == count


def test_nested_batches():
    grid = ROWS[:12].reshape(3, 4, 2)
    np.testing.assert_allclose(jax.vmap(jax.vmap(wrapped))(grid), jax.vmap(jax.vmap(plain))(grid), rtol=1e-14)


def test_memory_is_that_of_one_chunk():
    """2,000 rows of 40,000 nodes would take 640 MB at once; a chunk of them takes 5 MB."""
    heavy = forward_mode(
        lambda p: jnp.sum(jnp.sin(jnp.arange(40_000.0) * p[0] + jnp.cumsum(p[1] * jnp.ones(40_000))))[None]
    )
    compiled = jax.jit(jax.vmap(heavy)).lower(jnp.ones((2000, 2))).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 64e6
