"""Integrals over a workspace that strokes alone bound: Gauss nodes on the box of the strokes.

A stroke is a pair of margins, NAME_min and NAME_max, whose sum no pose changes: u = min / (min + max) runs
from 0 to 1. With as many strokes as freedoms the box of all u is the workspace, its boundary is fixed, and
poses are weighed by 1 / |det du/dx|.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax.analysis.quadrature import gauss
from pk_jax.analysis.ray_rules import Problem, values_at
from pk_jax.analysis.region import Given, joints_at, limits_at
from pk_jax.geometry.matrices import small_det
from pk_jax.geometry.poses import retract, tangent_size, tangent_zero
from pk_jax.kinematics import newton
from pk_jax.kinematics.batching import where

BLOCK = 512  # nodes at a time
STEPS = 60  # of Newton's method, from home
CLOSED_TO = 1e-9  # of the strokes


class Validity(NamedTuple):
    """Whether the box of strokes is the workspace; each a number of nodes that say no."""

    lost: jax.Array  # no pose was found
    turned: jax.Array  # beyond a singularity: the sign of det du/dx is not that at home
    limited: jax.Array  # another margin is negative


def stroke_names(margins: dict[str, Any]) -> tuple[str, ...]:
    """NAMEs of the pairs NAME_min, NAME_max."""
    ends = [name.removesuffix("_min") for name in margins if name.endswith("_min")]
    return tuple(sorted(name for name in ends if f"{name}_max" in margins))


def strokes_at(given: Given, pose: Any) -> jax.Array:
    """Every u. -> (k,)"""
    margins = given.mech.margins(pose, joints_at(given, pose))
    names = stroke_names(margins)
    lower = jnp.concatenate([jnp.ravel(margins[f"{name}_min"]) for name in names])
    upper = jnp.concatenate([jnp.ravel(margins[f"{name}_max"]) for name in names])
    return lower / (lower + upper)


def count_strokes(given: Given) -> int:
    """k; 0 where the mechanism has none."""
    home = jax.eval_shape(lambda mech: mech.home(), given.mech)
    if not stroke_names(jax.eval_shape(lambda mech, home: mech.margins(*home), given.mech, home)):
        return 0
    return jax.eval_shape(lambda given: strokes_at(given, given.centre), given).shape[0]


def box(problem: Problem, given: Given, count: int) -> tuple[jax.Array, Validity]:
    """Integrals by `count` Gauss nodes along each stroke. -> (1 + f,), Validity"""
    start = given.home[0]
    n = tangent_size(start)
    rule = gauss(count)
    grid = np.meshgrid(*[rule.nodes] * n, indexing="ij")
    nodes = np.stack([axis.ravel() for axis in grid], axis=1)
    weights = np.prod(np.meshgrid(*[rule.weights] * n, indexing="ij"), axis=0).ravel()
    dtype = tangent_zero(start).dtype
    fill = -len(nodes) % min(BLOCK, len(nodes))
    nodes = np.concatenate([nodes, np.full((fill, n), 0.5)])
    weights = np.concatenate([weights, np.zeros(fill)])
    split = lambda x: jnp.asarray(x, dtype).reshape(-1, min(BLOCK, len(weights)), *x.shape[1:])
    side = lax.stop_gradient(jnp.sign(small_det(_slopes(given, start))))

    @jax.checkpoint
    def add(part):
        each, validity = jax.vmap(partial(_one, problem, given, start, side))(part[0])
        is_own = part[1] > 0
        return part[1] @ each, jax.tree.map(lambda flag: jnp.sum(flag & is_own), validity)

    sums, validity = lax.map(add, (split(nodes), split(weights)))
    return jnp.sum(sums, axis=0), jax.tree.map(jnp.sum, validity)


def _slopes(given: Given, pose: Any) -> jax.Array:
    """du/dx in the tangent of the pose. -> (n, n)"""
    return jax.jacfwd(lambda twist: strokes_at(given, retract(pose, twist)))(tangent_zero(pose))


def _one(problem: Problem, given: Given, start: Any, side: jax.Array, u: jax.Array):
    """The integrands at the pose of strokes u, weighed. -> (1 + f,), Validity of bools"""
    fixed = lax.stop_gradient(given)
    residual = lambda given, pose: strokes_at(given, pose) - u
    linearize = lambda pose: (residual(fixed, pose), _slopes(fixed, pose))
    scale = jnp.full(u.shape, fixed.mech.length())
    found = newton.solve(linearize, retract, start, scale=scale, steps=STEPS)
    is_found = jnp.max(jnp.abs(residual(fixed, found.point))) < CLOSED_TO  # NaN compares False
    pose = where(is_found, found.point, start)
    pose = newton.implicit(lambda pose: residual(given, pose), retract, pose, u.shape[0])
    pose = where(is_found, pose, start)
    det = small_det(_slopes(given, pose))
    is_regular = is_found & (det * side > 0)
    values = values_at(problem, given, pose) / jnp.where(is_regular, jnp.abs(det), 1)
    centred = given._replace(centre=lax.stop_gradient(pose))
    margins = limits_at(problem.region, lax.stop_gradient(centred), jnp.zeros_like(u))
    is_limited = is_found & jnp.any(margins < -CLOSED_TO)
    return jnp.where(is_regular, values, 0), Validity(~is_found, is_found & ~is_regular, is_limited)
