"""Newton and Gauss-Newton for many rows at once, and the verdict on where they ended, on lanes.

It sees a mechanism through `linearize`, `residual` and `retract` only, each evaluated entry by entry.
Rows do not see one another: a row that has converged is frozen, so that its bits don't depend on its
neighbours.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax.geometry.poses import is_pose, pose_units, retract, settle, turned, unturned
from pk_jax.kinematics import elimination
from pk_jax.kinematics.closure import closure, pose_scale
from pk_jax.kinematics.elimination import Matrix, Order, Reference
from pk_jax.kinematics.entrywise import Invariants, entrywise
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, scaled_jacobians, units
from pk_jax.kinematics.lanes import Entries, Lane, is_entries, items_of, over, rebuilt, times, total
from pk_jax.mechanisms.base import LegMechanism, Mechanism
from pk_jax.status import Status

STEPS = 10
LONGEST_STEP = 0.5  # of the natural size of each coordinate


class Ended(NamedTuple):
    """Where the iteration of every row ended."""

    pose: Any  # of Entries
    is_stationary: Lane  # the last step was so small that the next is below roundoff
    steps: Lane


class Judged(NamedTuple):
    """What holds at a pose, from the equations evaluated afresh there."""

    residual: Lane  # |F|
    is_closed: Lane  # square: F is zero to roundoff; redundant: the equations agree to 1e-6
    is_exact: Lane  # F is zero to roundoff: of redundant equations, too, nothing is left to minimize
    sigma_min: Lane  # at most the least singular value of A without units, at least it over sqrt(n)
    sign: Lane  # of det A; 0 where the actuated equations are redundant


class Attempt(NamedTuple):
    """One row: where Newton ended and what that is worth."""

    pose: Any  # of Entries
    status: Lane
    residual: Lane
    steps: Lane
    sigma_min: Lane
    det_sign: Lane


def attempt(
    mech: Any,
    joints: Entries,
    start: Any,
    home: Any,
    order: Order | None,
    *,
    kind: type[Mechanism],
    is_home: bool,
) -> Attempt:
    """Newton from `start` and the verdict, all arguments made of `Entries`. STALLED rows deserve more effort.

    home:     `Home` of `Entries`
    is_home:  the start is the home pose, so that the first step's inverse is known
    """
    is_given = reduce(jnp.logical_and, [jnp.isfinite(q) for q in joints.items])
    if kind.joints_are_distances:
        is_given = reduce(jnp.logical_and, [q > 0 for q in joints.items], is_given)
    if not is_home:
        finite = [jnp.isfinite(x) for x in items_of(start)]
        is_given = reduce(jnp.logical_and, [*finite, *entrywise(is_pose, start).items], is_given)
        start = entrywise(settle, _where(is_given, start, home.pose))
    joints = _where(is_given, joints, home.joints)  # lost rows work at home and are masked after
    by = eliminated_by(order, home)
    first, equations = home.first.rows() if is_home else None, home.first.shape[1]
    is_turning = turns_a_platform(kind, mech)
    carried = entrywise(turned, start) if is_turning else start
    ended = iterate(mech, joints, carried, by, first, equations)
    if is_turning:
        ended = ended._replace(pose=entrywise(unturned, ended.pose, start))
    judged = judge(mech, joints, ended.pose, by, kind.actuated_rows)
    is_square = home.first.shape[0] == home.first.shape[1]
    det_sign = judged.sign * home.sign.items[0]
    side = det_sign
    if is_square and not is_home:
        side = judged.sign * start_sign(mech, joints, start, by, None)
    status = verdict(judged, ended.is_stationary, side, is_square=is_square)
    status = jnp.where(is_given, status, Status.BAD_INPUT)
    steps = jnp.where(is_given, ended.steps, 0)
    return Attempt(ended.pose, status, judged.residual, steps, judged.sigma_min, det_sign)


def turns_a_platform(kind: type[Mechanism], mech: Any) -> bool:
    """Whether poses (x, y, phi) only carry platform points, so that the angle itself is not needed."""
    if not issubclass(kind, LegMechanism):
        return False
    plain = kind.residual is LegMechanism.residual and kind.linearize is LegMechanism.linearize
    given = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, float), mech, is_leaf=is_entries)
    home, _ = jax.eval_shape(lambda mech: mech.home(), given)
    points = jax.eval_shape(lambda mech: mech.attachments(), given)
    return plain and getattr(home, "shape", None) == (3,) and points.shape[1] == 2


def eliminated_by(order: Order | None, home: Home) -> Order | Reference | None:
    """The order of pivots where it is known, else by the inverse at home; None for redundant actuation."""
    if order is None and home.square is not None:
        return Reference(home.square.rows(), home.sign.items[0])
    return order


def verdict(judged: Judged, is_stationary: Lane, side: Lane, *, is_square: bool) -> Lane:
    """Status of a row; `side` is the sign of det A over that at the start."""
    if is_square:
        status = jnp.where(judged.is_closed, Status.OK, Status.STALLED)
        status = jnp.where(judged.is_closed & (side < 0), Status.OTHER_MODE, status)
    else:
        is_stationary = is_stationary | judged.is_exact
        status = jnp.where(judged.is_closed, Status.OK, Status.INCONSISTENT)
        status = jnp.where(is_stationary, status, Status.STALLED)
    is_solved = judged.is_closed & (is_square | is_stationary)
    return jnp.where(is_solved & (judged.sigma_min < SINGULAR_BELOW), Status.SINGULAR, status)


class Home(NamedTuple):
    """What is known of a mechanism before any row is seen."""

    pose: Any
    joints: jax.Array  # (m,)
    first: jax.Array  # (n, c) inverse of A
    square: jax.Array | None  # (n, n) inverse of the actuated rows of A; None where they are redundant
    sign: jax.Array  # () of det A; 0 where the actuated equations are redundant


def at_home(mech: Mechanism) -> tuple[Any, jax.Array, jax.Array]:
    """Pose, joints and A of the home configuration, without derivatives."""
    pose, joints = lax.stop_gradient(mech.home())
    return pose, joints, lax.stop_gradient(mech).linearize(pose, joints)[1]


def order_of(jacobian: Any, actuated: int | None) -> Order | None:
    """The order of pivots at home; None where the actuated equations are redundant or A is traced."""
    square = jacobian[:actuated]
    if not isinstance(square, np.ndarray) or square.shape[0] != square.shape[1]:
        return None
    return elimination.pivot_order(square)


def home_from(pose: Any, joints: Any, jacobian: Any, actuated: int | None) -> Home:
    """`Home` from what `at_home` gives, for NumPy arrays in NumPy."""
    linalg = (np if isinstance(jacobian, np.ndarray) else jnp).linalg
    square = jacobian[:actuated]
    square = linalg.inv(square) if square.shape[0] == square.shape[1] else None
    return Home(pose, joints, linalg.pinv(jacobian), square, sign_of_det(jacobian, actuated))


def sign_of_det(jacobian: Any, actuated: int | None) -> Any:
    """Sign of det A; 0 where the actuated equations are redundant. -> ()"""
    xp = np if isinstance(jacobian, np.ndarray) else jnp
    square = jacobian[:actuated]
    if square.shape[0] != square.shape[1]:
        return xp.zeros((), jacobian.dtype)
    return xp.sign(xp.linalg.det(square))


def iterate(
    mech: Any,
    joints: Entries,
    start: Any,
    by: Order | Reference | str | None,
    first: Matrix | None,
    equations: int,
) -> Ended:
    """At most `STEPS` clipped Newton steps from `start`, all arguments made of `Entries`.

    by:    how A is eliminated; None where its actuated rows are redundant: orthogonally, or by
           `elimination.NORMAL`
    first: inverse of A (n, c) at the start, where it is known; spares the first elimination
    """
    like = joints.items[0]
    per_scale = [1 / scale for scale in entrywise(pose_scale, mech, start).items]
    eps = float(jnp.finfo(like.dtype).eps)
    # the error after a Newton step d is about d^2; Gauss-Newton is only linear
    is_square = equations == len(per_scale)
    small = eps**0.5 / 4 if is_square else 1024 * eps

    def moved(pose: Any, increment: list[Lane]) -> tuple[Any, Lane]:
        longest = reduce(jnp.maximum, [jnp.abs(d) * s for d, s in zip(increment, per_scale, strict=True)])
        shrink = -LONGEST_STEP / jnp.maximum(longest, LONGEST_STEP)
        twist = Entries((len(increment),), [times(d, shrink) for d in increment])
        return entrywise(retract, pose, twist), longest

    pose = start
    if first is not None:
        value = entrywise(lambda m, x, q: m.residual(x, q), mech, pose, joints).items
        step = [total([times(a, f) for a, f in zip(row, value, strict=True)]) for row in first]
        pose, _ = moved(pose, step)
    linearize = lambda m, x, q: m.linearize(x, q)
    invariants = Invariants(mech, joints)
    entrywise(linearize, mech, start, joints, invariants=invariants)
    taken = int(first is not None)
    items = _spread(items_of(pose), like)

    def is_running(state):
        return (state[0] < STEPS - taken) & ~jnp.all(state[3])

    def advance(state):
        k, items, steps, has_stopped, is_stationary = state
        pose = rebuilt(items, start)
        value, jacobian = entrywise(linearize, mech, pose, joints, invariants=invariants)
        pose, longest = moved(pose, _least_squares(jacobian.rows(), value.items, by))
        new = _spread(items_of(pose), like)
        items = [jnp.where(has_stopped, *each) for each in zip(items, new, strict=True)]
        steps = jnp.where(has_stopped, steps, steps + 1)
        is_stationary = is_stationary | (~has_stopped & (longest < small))
        return k + 1, items, steps, is_stationary | jnp.isnan(longest), is_stationary

    none, count = jnp.zeros(like.shape, bool), jnp.full(like.shape, taken, jnp.int32)
    _, items, steps, _, is_stationary = lax.while_loop(is_running, advance, (0, items, count, none, none))
    return Ended(rebuilt(items, start), is_stationary, steps)


def judge(
    mech: Any, joints: Entries, pose: Any, by: Order | Reference | None, actuated: int | None
) -> Judged:
    """The equations at `pose`, evaluated afresh, and how far from a singularity it is."""
    like = joints.items[0]
    value, jacobian, is_closed, is_exact = entrywise(closure, mech, pose, joints)
    rows = jacobian.rows()
    residual = jnp.sqrt(total([times(f, f) for f in value.items]))
    is_square = len(rows) == len(rows[0])

    factors = None if by is None else elimination.factor(rows[:actuated], by)
    sign = jnp.zeros_like(like) if factors is None else factors.sign()
    lengths = entrywise(_column_units, mech, pose).items
    scaled = [[times(a, u) for a, u in zip(row, lengths, strict=True)] for row in rows]
    norms = [jnp.sqrt(total([times(a, a) for a in row])) for row in scaled]
    if is_square:
        inverse = elimination.inverse(factors)
        entries = [
            over(times(a, r), u)
            for row, u in zip(inverse, lengths, strict=True)
            for a, r in zip(row, norms, strict=True)
        ]
    else:
        unit = [[over(a, norm) for a in row] for row, norm in zip(scaled, norms, strict=True)]
        upper, _ = elimination.orthogonalize(unit, [0.0] * len(unit))
        n = len(upper)
        columns = [elimination.back_substitute(upper, [float(i == k) for i in range(n)]) for k in range(n)]
        entries = [item for column in columns for item in column]
    sigma = 1 / jnp.sqrt(total([times(a, a) for a in entries]))
    sigma = jnp.where(jnp.isfinite(sigma), sigma, 0)
    return Judged(residual, is_closed.items[0], is_exact.items[0], sigma, sign)


def judge_one(mech: Mechanism, joints: jax.Array, pose: Any) -> Judged:
    """The same for one row, in ordinary arrays: for where compiling costs more than computing."""
    value, jacobian, is_closed, is_exact = closure(mech, pose, joints)
    sigmas = jnp.linalg.svd(scaled_jacobians(mech, pose, joints).pose, compute_uv=False)
    sigma = 1 / jnp.sqrt(jnp.sum(1 / sigmas**2))
    sign = sign_of_det(jacobian, mech.actuated_rows)
    return Judged(jnp.linalg.norm(value), is_closed, is_exact, sigma, sign)


def start_sign(mech: Any, joints: Entries, start: Any, by: Order | Reference, actuated: int | None) -> Lane:
    """Sign of det A at the start."""
    jacobian = entrywise(lambda m, x, q: m.linearize(x, q)[1], mech, start, joints)
    return elimination.factor(jacobian.rows()[:actuated], by).sign()


def first_step(mech: Any, joints: Entries, start: Any, by: Order | Reference | None) -> list[Lane]:
    """The first Newton step from the start, with the sign changed. -> (n,)"""
    value, jacobian = entrywise(lambda m, x, q: m.linearize(x, q), mech, start, joints)
    return _least_squares(jacobian.rows(), value.items, by)


def _least_squares(rows: Matrix, value: list[Lane], by: Order | Reference | str | None) -> list[Lane]:
    if by == elimination.NORMAL:
        columns = zip(*rows, strict=True)
        right = [total([times(a, f) for a, f in zip(column, value, strict=True)]) for column in columns]
        return elimination.solve_symmetric(elimination.factor_symmetric(elimination.normal(rows)), right)
    if len(rows) == len(rows[0]):
        return elimination.solve(elimination.factor(rows, by), value)
    return elimination.back_substitute(*elimination.orthogonalize(rows, value))


def _column_units(mech: Any, pose: Any) -> jax.Array:
    powers = units(pose_units(pose, mech.pose_units), mech.length().dtype)
    return jnp.where(powers > 0, mech.length(), 1)


def _where(condition: Lane, chosen: Any, other: Any) -> Any:
    """`jnp.where`, entry by entry."""
    choose = lambda a, b: Entries(
        a.shape, [jnp.where(condition, *each) for each in zip(a.items, b.items, strict=True)]
    )
    return jax.tree.map(choose, chosen, other, is_leaf=is_entries)


def _spread(items: list[Lane], like: Lane) -> list[Lane]:
    """Every item as a whole lane."""
    return [jnp.broadcast_to(jnp.asarray(item, like.dtype), like.shape) for item in items]
