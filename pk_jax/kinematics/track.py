"""Following a path of joints: each pose starts from the one before, and no branch is left unnoticed."""

from __future__ import annotations

from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax import checks
from pk_jax.geometry.poses import difference, is_pose, settle
from pk_jax.kinematics import lane_newton, rows
from pk_jax.kinematics.batching import (
    all_finite,
    home_shapes,
    is_possible,
    rows_of,
    where,
    without_derivatives,
)
from pk_jax.kinematics.closure import pose_scale
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.forward import with_derivatives
from pk_jax.kinematics.lanes import Entries, is_entries, split, stack, times
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

CLOSEST = 1e-4  # sigma_min of a pose that counts as singular
REACH = 1.25  # times the last fall of sigma_min: what the next step may bring


class Track(NamedTuple):
    """One entry a row of the path."""

    pose: Any  # NaN unless the status is OK
    status: jax.Array  # () Status
    residual: jax.Array  # () |F|
    steps: jax.Array  # () iterations taken
    sigma_min: jax.Array  # () lower bound of the least singular value of A without units
    det_sign: jax.Array  # () sign of det A over its sign at home
    reached: jax.Array  # () how many rows were followed, of the whole path


def track(mech: Mechanism, joints_path: Any, start: Any = None, *, closest: float = CLOSEST) -> Track:
    """The poses along a path of joints (rows, m), from the pose `start` (default: home) on.

    The path ends, and every later row is INCOMPLETE, at the first row that is
    SINGULAR: sigma_min < closest; or sigma_min has been falling so fast that the singularity may be
        reached within this step. Beyond it the lengths alone cannot tell the branches apart:
        Newton would converge, with zero residual, and on the wrong one;
    OTHER_MODE: det A changed its sign, or the pose lies more than twice the first Newton step away,
        farther than where Newton's method is sure to belong to its start (Kantorovich);
    STALLED, INCONSISTENT, BAD_INPUT (also a start that is no pose): as for `forward_kinematics`.

    Sample the path finely: the rows are all it is known by. Differentiable in the joints and the
    geometry; vmap it over many paths.
    """
    require_mechanism("track", mech)
    home_pose, home_joints = home_shapes(mech)
    path = checks.real_array("joints_path", joints_path)
    checks.has_shape("joints_path", path, (None, *home_joints.shape))
    if start is not None:
        start, many = rows_of("start", start, home_pose)
        if many:
            raise ValueError("start must be one pose; vmap track for many paths")
    closest = checks.real_array("closest", closest)
    checks.has_shape("closest", closest, ())
    if checks.is_concrete(closest) and not 0 <= float(closest) < 1:
        raise ValueError(
            f"closest must be in [0, 1), a singular value without units, got {float(closest):.6g}"
        )
    path = path.astype(home_joints.dtype)
    home, order = rows.prepared(mech)[:2] if checks.is_concrete(mech) else (None, None)
    count = path.shape[0]
    if count == 0:
        raise ValueError("joints_path must have one row at least, got none")
    # rounded up to a power of two, so that few lengths of paths are compiled
    filled = jnp.concatenate(
        [path, jnp.full((2 ** (count - 1).bit_length() - count, *path.shape[1:]), jnp.nan)]
    )
    found = _track(mech, home, filled.astype(path.dtype), start, closest, order)
    return jax.tree.map(lambda leaf: leaf[:count] if leaf.ndim else leaf, found)


@partial(jax.jit, static_argnums=5)
def _track(mech, home, path, start, closest, order):
    if home is None:
        home = lane_newton.home_from(*lane_newton.at_home(mech), mech.actuated_rows)
    follow = without_derivatives(lambda *given: _follow(*given, order=order))
    found = follow(*lax.stop_gradient((mech, home, path, home.pose if start is None else start, closest)))
    attach = lambda q, pose, status: with_derivatives(mech, home.pose, q, pose, status)
    return found._replace(pose=jax.vmap(attach)(path, found.pose, found.status))


def _follow(mech: Mechanism, home: Any, path: jax.Array, start: Any, closest: Any, *, order: Any) -> Track:
    entries, at_home = jax.tree.map(split, (mech, home))
    by = lane_newton.eliminated_by(order, at_home)
    is_square = home.first.shape[0] == home.first.shape[1]
    is_known = all_finite(start) & is_pose(start)
    start = settle(where(is_known, start, home.pose))
    from_start = jax.tree.map(split, start)
    side = jnp.ones_like(home.sign)
    if by is not None:
        side = lane_newton.start_sign(entries, split(path[0]), from_start, by, mech.actuated_rows)

    def step(before, q):
        pose, sigma, fall, stopped = before
        is_given = is_possible(mech, q) & is_known
        at, q = jax.tree.map(split, pose), split(jnp.where(is_given, q, home.joints))
        ended = lane_newton.iterate(entries, q, at, by, None, home.first.shape[1])
        judged = lane_newton.judge(entries, q, ended.pose, by, mech.actuated_rows)
        status = lane_newton.verdict(judged, ended.is_stationary, judged.sign * side, is_square=is_square)
        first = _size(entries, at, lane_newton.first_step(entries, q, at, by))
        moved = _size(entries, at, entrywise(difference, at, ended.pose))
        is_far = moved > 2 * first + 1e-6
        status = jnp.where((status == Status.OK) & is_far, Status.OTHER_MODE, status)
        is_solved = (status == Status.OK) | (status == Status.OTHER_MODE)
        is_near = (is_solved & (judged.sigma_min < closest)) | (sigma <= REACH * fall)
        status = jnp.where(is_near, Status.SINGULAR, status)
        status = jnp.where(is_given, status, Status.BAD_INPUT)
        status = jnp.where(stopped, Status.INCOMPLETE, status).astype(jnp.int32)
        is_ok = status == Status.OK
        new = jax.tree.map(stack, ended.pose, is_leaf=is_entries)
        numbers = (judged.residual, judged.sigma_min, judged.sign * home.sign)
        residual, sigma_min, det_sign = where(stopped | ~is_given, jnp.nan * jnp.zeros(3), jnp.stack(numbers))
        steps = jnp.where(stopped, 0, ended.steps)
        row = (where(is_ok, new, jnp.nan), status, residual, steps, sigma_min, det_sign)
        fall = jnp.where(jnp.isfinite(sigma), sigma - judged.sigma_min, 0)
        return (where(is_ok, new, pose), judged.sigma_min, fall, stopped | ~is_ok), row

    infinite = jnp.full_like(home.sign, jnp.inf)
    begin = (start, infinite, jnp.zeros_like(home.sign), jnp.zeros((), bool))
    found = lax.scan(step, begin, path)[1]
    return Track(*found, jnp.sum(found[1] == Status.OK))


def _size(mech: Any, pose: Any, increment: Entries | list) -> Any:
    """The greatest entry of a tangent increment, in natural units."""
    scale = entrywise(pose_scale, mech, pose).items
    items = increment.items if isinstance(increment, Entries) else increment
    return reduce(jnp.maximum, [jnp.abs(times(d, 1 / s)) for d, s in zip(items, scale, strict=True)])
