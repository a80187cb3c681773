"""Gradient ascent in the unit box: optax's L-BFGS on the free variables, projection on the bounds.

One evaluation of value and gradient a step: `propose` a point, evaluate it, `judge` it. Both are
for one start and vmapped over many. Bounds are reached exactly, which a sigmoid bijection never does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

LONGEST_STEP = 0.5  # of the box, in any variable
SUFFICIENT = 1e-4  # share of the promised ascent that a step must keep (Armijo)
ROUNDOFFS = 256  # a promised ascent of this many roundings of the value is none
MOST_CUTS = 12  # of the step length, before the point counts as the end

_direction = optax.scale_by_lbfgs(memory_size=8)


class Ascent(NamedTuple):
    """One start: the best point so far, and what the next trial needs."""

    box: jax.Array  # (n,) best point
    value: jax.Array  # ()
    gradient: jax.Array  # (n,)
    toward: jax.Array  # (n,) current search direction
    length: jax.Array  # () share of it that is tried next
    free: jax.Array  # (n,) bool, variables not held at a bound
    memory: Any  # of the quasi-Newton method
    cuts: jax.Array  # () refusals in a row
    evaluations: jax.Array  # () of value and gradient
    is_done: jax.Array  # () bool


def begin(box: jax.Array) -> Ascent:
    """The state before the first evaluation, which is of the start itself."""
    zero = jnp.zeros((), box.dtype)
    none = jnp.zeros((), jnp.int32)
    return Ascent(
        box=box,
        value=zero - jnp.inf,
        gradient=jnp.zeros_like(box),
        toward=jnp.zeros_like(box),
        length=zero + 1,
        free=jnp.zeros(box.shape, bool),
        memory=_direction.init(box),
        cuts=none,
        evaluations=none,
        is_done=jnp.zeros((), bool),
    )


def propose(state: Ascent) -> jax.Array:
    """The point to evaluate next. -> (n,)"""
    return jnp.clip(state.box + state.length * state.toward, 0, 1)


def judge(state: Ascent, value: jax.Array, gradient: jax.Array, tolerance: float) -> Ascent:
    """Accept the proposed point, whose value and gradient these are, and aim anew; or cut the step.

    A finished start stays as it is.
    """
    trial = propose(state)
    promised = state.gradient @ (trial - state.box)
    # NaN compares False: a trial outside the function's domain is one more refusal
    accept = (value >= state.value + SUFFICIENT * promised) & jnp.all(jnp.isfinite(gradient))
    accepted = _aim(
        state._replace(box=trial, value=value, gradient=gradient, cuts=jnp.zeros_like(state.cuts))
    )
    new = jax.tree.map(lambda a, b: jnp.where(accept, a, b), accepted, shortened(state, value))
    new = new._replace(evaluations=state.evaluations + 1)
    is_still = stationarity(new.box, new.gradient) <= tolerance
    # what the next step promises would drown in the roundoff of the value
    is_spent = new.gradient @ new.toward <= ROUNDOFFS * jnp.finfo(value.dtype).eps * (1 + jnp.abs(value))
    new = new._replace(is_done=is_still | (accept & is_spent) | (new.cuts > MOST_CUTS))
    return jax.tree.map(lambda old, new: jnp.where(state.is_done, old, new), state, new)


def restated(state: Ascent, value: jax.Array, gradient: jax.Array, tolerance: float) -> Ascent:
    """The same point, its value and gradient found anew and better; what is known of the curvature stays."""
    downhill = -jnp.where(is_free(state.box, gradient), gradient, 0)
    aimed = _aim(
        state._replace(
            value=value,
            gradient=gradient,
            memory=state.memory._replace(updates=downhill),  # no step lies between the two gradients
            cuts=jnp.zeros_like(state.cuts),
            evaluations=state.evaluations + 1,
        )
    )
    return aimed._replace(is_done=stationarity(state.box, gradient) <= tolerance)


def shortened(state: Ascent, value: jax.Array) -> Ascent:
    """The trial, which had this value, is refused: a shorter step."""
    promised = state.gradient @ (propose(state) - state.box)
    # the parabola through both values and the slope, kept within [0.1, 0.5] of the step
    curvature = promised - (value - state.value)
    shorter = jnp.where(curvature > 0, promised / (2 * curvature), 0.5)
    length = state.length * jnp.clip(jnp.nan_to_num(shorter, nan=0.1), 0.1, 0.5)
    return state._replace(length=length, cuts=state.cuts + 1)


def is_free(box: jax.Array, gradient: jax.Array) -> jax.Array:
    """Variables that the gradient does not push out of the box. -> (n,) bool"""
    return ~(((box <= 0) & (gradient < 0)) | ((box >= 1) & (gradient > 0)))


def within_reach(toward: jax.Array, uphill: jax.Array) -> jax.Array:
    """A direction, or the gradient where it does not ascend, no longer than may be tried. -> (n,)"""
    ascends = toward @ uphill > 1e-8 * jnp.linalg.norm(toward) * jnp.linalg.norm(uphill)
    ascends = ascends & jnp.all(jnp.isfinite(toward))
    toward = jnp.where(ascends, toward, uphill)  # not concave here: follow the gradient
    longest = jnp.max(jnp.abs(toward))
    return toward * jnp.minimum(1, LONGEST_STEP / jnp.where(longest > 0, longest, 1))


def stationarity(box: Any, gradient: Any) -> Any:
    """Greatest move that the projected gradient would still make; 0 at a constrained optimum. -> (...)"""
    return abs((box + gradient).clip(0, 1) - box).max(axis=-1)


def _aim(state: Ascent) -> Ascent:
    """A direction of ascent on the free variables. A new set of bounds starts with an empty memory."""
    free = is_free(state.box, state.gradient)
    uphill = jnp.where(free, state.gradient, 0)
    same_face = jnp.all(free == state.free)
    memory = jax.tree.map(
        lambda kept, empty: jnp.where(same_face, kept, empty), state.memory, _direction.init(state.box)
    )
    downhill, memory = _direction.update(-uphill, memory, state.box)
    toward = within_reach(jnp.where(free, -downhill, 0), uphill)
    return state._replace(toward=toward, length=jnp.ones_like(state.length), free=free, memory=memory)
