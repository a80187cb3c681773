"""Newton and Gauss-Newton on a manifold, one row. It knows no mechanism.

The solution carries exact derivatives of any order with respect to everything that `linearize`
closes over, by the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

Linearize = Callable[[Any], tuple[jax.Array, jax.Array]]  # point -> F (c,), A (c, n)


class Solution(NamedTuple):
    """Where the iteration ended, whatever became of it."""

    point: Any
    residual: jax.Array  # () norm of F, evaluated afresh at the point
    is_stationary: jax.Array  # () the last step was at roundoff level
    steps: jax.Array  # ()


class _State(NamedTuple):
    point: Any
    value: jax.Array
    jacobian: jax.Array
    damping: jax.Array
    steps: jax.Array
    small_steps: jax.Array


def solve(
    linearize: Linearize,
    retract: Callable[[Any, jax.Array], Any],
    start: Any,
    *,
    scale: jax.Array,
    steps: int = 100,
    is_needed: jax.Array | bool = True,
) -> Solution:
    """Minimize |F|^2 from `start` by Levenberg-Marquardt that becomes Newton near a root.

    linearize:  point -> F (c,) and its tangent Jacobian (c, n), c >= n
    retract:    (point, tangent increment) -> point
    scale:      (n,) natural size of each tangent coordinate: a step is at most 0.5 of it
    is_needed:  False: no step is taken

    A step that does not reduce |F| is refused and the damping grows; an accepted one divides it
    by ten, and below 1e-6 it is zero, so that convergence at a regular root is quadratic. The
    iteration ends after two consecutive steps at roundoff level, or after `steps`.
    """
    value, jacobian = linearize(start)
    tiny = 64 * jnp.finfo(value.dtype).eps
    zero = jnp.zeros((), value.dtype)
    count = jnp.zeros((), jnp.int32)

    def is_running(state: _State) -> jax.Array:
        is_good = jnp.all(jnp.isfinite(state.value)) & is_needed
        return (state.small_steps < 2) & (state.steps < steps) & is_good

    def advance(state: _State) -> _State:
        scaled = state.jacobian * scale
        damping = jnp.where(state.damping < 1e-6, zero, state.damping) * jnp.linalg.norm(scaled)
        increment = -_least_squares(scaled, state.value, damping)
        longest = jnp.max(jnp.abs(increment))
        increment = increment * jnp.minimum(1, 0.5 / jnp.where(longest > 0, longest, 1))
        point = retract(state.point, increment * scale)
        value, jacobian = linearize(point)
        # NaN compares False, so a step into the void is refused like any other bad one
        is_small = longest < tiny
        # near the least of a |F| that is not zero, a good step changes it by less than roundoff
        roundoff = tiny / 16 * jnp.linalg.norm(scaled)
        improves = jnp.linalg.norm(value) < jnp.linalg.norm(state.value) + roundoff
        accept = improves | (is_small & jnp.all(jnp.isfinite(value)))
        chosen = jax.tree.map(
            lambda new, old: jnp.where(accept, new, old),
            (point, value, jacobian),
            (state.point, state.value, state.jacobian),
        )
        # an undamped step may be refused only because |F| is already at roundoff
        damping = jnp.where(accept, state.damping / 10, jnp.maximum(4 * state.damping, 1e-4))
        small_steps = jnp.where(is_small, state.small_steps + 1, jnp.zeros_like(state.small_steps))
        return _State(*chosen, damping, state.steps + 1, small_steps)

    state = lax.while_loop(is_running, advance, _State(start, value, jacobian, zero, count, count))
    return Solution(state.point, jnp.linalg.norm(state.value), state.small_steps >= 2, state.steps)


def implicit(
    residual: Callable[[Any], jax.Array],
    retract: Callable[[Any, jax.Array], Any],
    point: Any,
    size: int,
) -> Any:
    """`point`, a root of `residual`, with the derivatives of the implicit function theorem.

    The value is unchanged. For more equations than unknowns the point is a stationary point of
    |F|^2 / 2 and its gradient is the equation that is differentiated, exact at any residual.
    """
    point = lax.stop_gradient(point)

    def equation(increment):
        def at(twist):
            return residual(retract(point, twist))

        value, pull_back = jax.vjp(at, increment)
        return value if value.shape[0] == size else pull_back(value)[0]

    def dense_solve(linear_map, rhs):
        return jnp.linalg.solve(jax.jacobian(linear_map)(jnp.zeros_like(rhs)), rhs)

    # zeros that are batched wherever the point is: an unbatched root with a batched derivative
    # breaks the vmap of custom_root (TypeError in broadcast_in_dim, jax 0.10)
    leaves = jax.tree.leaves(point)
    zero = 0 * sum(jnp.sum(jnp.isfinite(leaf)) for leaf in leaves)
    start = jnp.zeros(size, leaves[0].dtype) + zero
    increment = lax.custom_root(equation, start, lambda _, guess: guess, dense_solve)
    return retract(point, increment)


def _least_squares(a: jax.Array, b: jax.Array, damping: jax.Array) -> jax.Array:
    """argmin |a x - b|^2 + damping^2 |x|^2 by QR of the stacked matrix. -> (n,)"""
    n = a.shape[1]
    q, r = jnp.linalg.qr(jnp.concatenate([a, damping * jnp.eye(n, dtype=a.dtype)]))
    diagonal = jnp.abs(jnp.diagonal(r))
    regular = jnp.min(diagonal) > 0
    r = jnp.where(regular, r, jnp.eye(n, dtype=a.dtype))  # a singular step is NaN, not a crash
    x = jax.scipy.linalg.solve_triangular(r, q.T[:, : a.shape[0]] @ b)
    return jnp.where(regular, x, jnp.nan)
