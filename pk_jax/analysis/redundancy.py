"""Where to put a kinematically redundant joint: a pose leaves it free, limits and singularities do not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax import checks
from pk_jax.kinematics import newton
from pk_jax.kinematics.batching import home_shapes, over_rows, rows_of
from pk_jax.kinematics.inverse import branch_rows, inverse_kinematics
from pk_jax.kinematics.jacobian import scaled_jacobians
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

WAYS = ("margin", "conditioning", "middle")
NODES = 17  # of the first search
HALVINGS = 52


class Redundancy(NamedTuple):
    """One entry a row; batch first."""

    free: jax.Array  # (1,) value of the redundant joint; NaN unless the status is OK
    joints: jax.Array  # (m,) all joints, it included
    value: jax.Array  # () what was maximized
    status: jax.Array  # () Status, of the inverse kinematics


def resolve_redundancy(mech: Mechanism, pose: Any, by: str = "margin", branch: Any = None) -> Redundancy:
    """The value of the kinematically redundant joint that suits a pose best, within its `free_range()`.

    pose:    one or many
    by:      "margin": the smallest of all margins is greatest. The pose is inside all limits for some
             value of the joint just where the result is >= 0.
             "conditioning": the ratio of least to greatest singular value of A without units is greatest
             "middle": the middle of the range, whatever the pose; the value is the smallest margin
    branch:  working mode, as for `inverse_kinematics`

    By a first search on 17 values and bisection on the sign of the derivative: exact where the objective has
    one maximum beside the best of these values. The smallest of strokes and cones of straight legs along
    a straight rail, whose superlevel sets are intervals, has one. Differentiable in the pose and
    the geometry; at a value where margins change places by their balance, at an end of the range as that end.
    ValueError for a mechanism without exactly one such joint, or without margins for `by="margin"`.
    """
    require_mechanism("resolve_redundancy", mech)
    checks.is_word("by", by, WAYS)
    if mech.free_joints != 1:
        raise ValueError(
            f"resolve_redundancy takes mechanisms with one redundant joint, {type(mech).__name__} has "
            f"{mech.free_joints}"
        )
    home_pose, _ = home_shapes(mech)
    if by != "conditioning" and not jax.eval_shape(lambda mech: mech.margins(*mech.home()), mech):
        raise ValueError(f"{type(mech).__name__} has no margins to keep")
    pose, many = rows_of("pose", pose, home_pose)
    branch, branches = (None, False) if branch is None else branch_rows(mech, branch)
    return _solve(mech, (pose, branch), by, (many, branches))


@partial(jax.jit, static_argnums=(2, 3))
def _solve(mech, rows, by, are_batched):
    return over_rows(partial(_one, mech, by), rows, are_batched)


def _one(mech: Mechanism, by: str, pose: Any, branch: Any) -> Redundancy:
    objectives = partial(_conditioning if by == "conditioning" else margins_of, branch=branch)
    if by == "middle":
        place = lax.stop_gradient(jnp.mean(mech.free_range()))
    else:
        place = lax.stop_gradient(best_free(*lax.stop_gradient((mech, pose)), objectives))
    solved = inverse_kinematics(mech, pose, branch, free=place[None])
    is_ok = solved.status == Status.OK
    home_pose, home_joints = lax.stop_gradient(mech.home())
    safe_pose = jax.tree.map(lambda a, b: jnp.where(is_ok, a, b), pose, home_pose)
    place = jnp.where(is_ok, place, home_joints[-1])
    balance = partial(_balance, mech, safe_pose, objectives, place)
    if by == "middle":
        balance = lambda free: free - jnp.mean(mech.free_range())
    free = newton.implicit(balance, lambda x, step: x + step, place[None], 1)
    joints = inverse_kinematics(mech, safe_pose, branch, free=free).joints
    value = jnp.min(objectives(mech, safe_pose, free[0]))
    masked = lambda x: jnp.where(is_ok, x, jnp.nan)
    return Redundancy(masked(free), masked(joints), masked(value), solved.status)


def margins_of(mech: Mechanism, pose: Any, free: jax.Array, *, branch: Any) -> jax.Array:
    """All margins of a pose, with the redundant joint at `free` (). -> (margins,)"""
    joints = _joints(mech, pose, free, branch)
    return jnp.concatenate([jnp.ravel(margin) for margin in mech.margins(pose, joints).values()])


def _conditioning(mech: Mechanism, pose: Any, free: jax.Array, *, branch: Any) -> jax.Array:
    sigma = jnp.linalg.svd(
        scaled_jacobians(mech, pose, _joints(mech, pose, free, branch)).pose, compute_uv=False
    )
    return (sigma[-1] / sigma[0])[None]


def _joints(mech: Mechanism, pose: Any, free: jax.Array, branch: Any) -> jax.Array:
    if hasattr(mech, "inverse"):
        return mech.inverse(pose, branch, free=free[None])
    return inverse_kinematics(mech, pose, branch, free=free[None]).joints


def best_free(mech: Mechanism, pose: Any, objectives: Callable) -> jax.Array:
    """The value within `free_range()` whose least objective is greatest. -> ()"""

    def evaluate(free):
        return jax.value_and_grad(lambda free: jnp.min(objectives(mech, pose, free)))(free)

    return greatest(evaluate, *mech.free_range()[0])


def greatest(evaluate: Callable, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """Where a function of one variable is greatest, a number or one a lane.

    evaluate: -> value, slope. By a first search on `NODES` values and bisection on the sign of the slope.
    """
    step = (upper - lower) / (NODES - 1)

    def look(k, state):
        best, place = state
        value = evaluate(lower + k * step)[0]
        is_better = value > best  # NaN compares False
        return jnp.where(is_better, value, best), jnp.where(is_better, k, place)

    start = jnp.full_like(lower, -jnp.inf), jnp.zeros(jnp.shape(lower), jnp.int32)
    place = lax.fori_loop(0, NODES, look, start)[1]

    def halve(_, ends):
        middle = (ends[0] + ends[1]) / 2
        is_rising = evaluate(middle)[1] > 0
        return jnp.where(is_rising, middle, ends[0]), jnp.where(is_rising, ends[1], middle)

    ends = jnp.maximum(lower + (place - 1) * step, lower), jnp.minimum(lower + (place + 1) * step, upper)
    low, high = lax.fori_loop(0, HALVINGS, halve, ends)
    return jnp.where(low == lower, lower, jnp.where(high == upper, upper, (low + high) / 2))


def _balance(mech: Mechanism, pose: Any, objectives: Any, place: jax.Array, free: jax.Array) -> jax.Array:
    """What is zero at the best value: an end, the difference of two margins, or the slope of one. -> (1,)"""
    lower, upper = mech.free_range()[0]
    fixed, at = lax.stop_gradient((mech, pose))
    beside = 1e-6 * lax.stop_gradient(upper - lower)
    before, after = (jnp.argmin(objectives(fixed, at, place + way * beside)) for way in (-1, 1))
    of = lambda x: objectives(mech, pose, x)
    slopes = jax.jvp(of, (free[0],), (jnp.ones_like(free[0]),))[1]
    balanced = jnp.where(before == after, slopes[before], of(free[0])[before] - of(free[0])[after])
    is_low, is_high = place == lax.stop_gradient(lower), place == lax.stop_gradient(upper)
    return jnp.where(is_low, free[0] - lower, jnp.where(is_high, free[0] - upper, balanced))[None]
