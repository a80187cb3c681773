"""Directions of ascent where part of the curvature is known: dense BFGS for the rest.

The rest is that of the Lagrangian m f + n c at fixed multipliers. It changes little from one set of active
constraints to the next, so nothing is forgotten where the set changes.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from pk_jax.design import ascent

DAMPED_BELOW = 0.2  # share of the curvature expected along a step; less is mixed with what was expected
SLOPE_LEFT = 0.9  # share of the slope that may remain after a step whose gain is roundoff
MODEL_STEPS = 30  # evaluations of the model, which is cheap
MODEL_STILL = 1e-2  # share of the projected gradient that may remain at its top
SMALLEST = 1e-10  # eigenvalue of the whole, over its greatest diagonal entry

Model = Callable[[jax.Array], tuple[jax.Array, jax.Array, jax.Array]]


def blank(box: jax.Array) -> jax.Array:
    """Nothing is known. -> (n, n)"""
    return jnp.zeros((box.size, box.size), box.dtype)


def updated(matrix: jax.Array, step: jax.Array, falls: jax.Array) -> jax.Array:
    """Positive definite approximation of -L'', after a step along which the gradient fell by so much. (n,)"""
    is_blank = jnp.all(matrix == 0)
    along = step @ falls
    first = jnp.where(along > 0, falls @ falls / along, jnp.linalg.norm(falls) / jnp.linalg.norm(step))
    matrix = jnp.where(is_blank, first * jnp.eye(step.size, dtype=step.dtype), matrix)
    expected = matrix @ step
    size = step @ expected
    mix = jnp.where(along >= DAMPED_BELOW * size, 1, (1 - DAMPED_BELOW) * size / (size - along))
    falls = mix * falls + (1 - mix) * expected
    new = matrix - jnp.outer(expected, expected) / size + jnp.outer(falls, falls) / (step @ falls)
    is_sound = jnp.all(jnp.isfinite(new)) & (size > 0)
    return jnp.where(is_sound, (new + new.T) / 2, jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0))


def rises(state: ascent.Ascent, trial: jax.Array, value: jax.Array, gradient: jax.Array) -> jax.Array:
    """Whether a trial is good enough: by its value, or by its slope where gains drown in roundoff. -> ()"""
    step = trial - state.box
    promised = state.gradient @ step
    is_level = jnp.abs(value - state.value) <= roundoff(state.value)
    found = value >= state.value + ascent.SUFFICIENT * promised
    found |= is_level & (jnp.abs(gradient @ step) <= SLOPE_LEFT * promised)
    return found & jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))


def roundoff(value: jax.Array) -> jax.Array:
    return ascent.ROUNDOFFS * jnp.finfo(value.dtype).eps * (1 + jnp.abs(value))


def top_of(model: Model, start: ascent.Ascent, known: jax.Array) -> jax.Array:
    """Where a concave, piecewise quadratic model is greatest in the unit box, by Newton's method. -> (n,)

    model:  box (n,) -> value (), gradient (n,), curvature (n, n) known, beside start.memory
    start:  with value and gradient of the model there, whose known curvature is `known`
    """
    fresh = start._replace(cuts=jnp.zeros_like(start.cuts), is_done=jnp.zeros_like(start.is_done))
    still = ascent.stationarity(start.box, start.gradient)
    still = still * jnp.minimum(MODEL_STILL, still)

    def improve(carry):
        count, state = carry
        trial = ascent.propose(state)
        value, gradient, known = model(trial)
        moved = state._replace(box=trial, value=value, gradient=gradient, cuts=jnp.zeros_like(state.cuts))
        accept = rises(state, trial, value, gradient)
        refused = ascent.shortened(state, value)
        state = jax.tree.map(lambda a, b: jnp.where(accept, a, b), aimed(moved, known), refused)
        is_still = ascent.stationarity(state.box, state.gradient) <= still
        return count + 1, state._replace(is_done=is_still | (state.cuts > ascent.MOST_CUTS))

    goes_on = lambda carry: (carry[0] < MODEL_STEPS) & ~carry[1].is_done
    return jax.lax.while_loop(goes_on, improve, (0, aimed(fresh, known)))[1].box


def aimed(state: ascent.Ascent, known: jax.Array) -> ascent.Ascent:
    """A new direction from the point where the state is: Newton's on the free variables."""
    free = ascent.is_free(state.box, state.gradient)
    uphill = jnp.where(free, state.gradient, 0)
    unit = jnp.eye(free.size, dtype=uphill.dtype)
    steepest = jnp.max(jnp.abs(uphill))
    whole = state.memory + known
    whole = whole + jnp.where(jnp.all(state.memory == 0), steepest / ascent.LONGEST_STEP, 0) * unit
    whole = whole + SMALLEST * jnp.max(jnp.diagonal(whole)) * unit
    whole = jnp.where(free[:, None] & free, whole, unit)
    toward = jax.scipy.linalg.solve(whole, uphill, assume_a="pos")
    toward = ascent.within_reach(toward, uphill)
    return state._replace(toward=toward, length=jnp.ones_like(state.length), free=free)
