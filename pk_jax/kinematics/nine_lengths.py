"""Pose of a Stewart platform from nine lengths: closed form, then weighted least squares.

Six legs and three sensors between the base and three points T_j of the platform, Ryu et al., patent
application KR 10-2000-0073215. The closed form needs no guess; alone it amplifies noise, so it is
only the start of a Gauss-Newton iteration on all nine lengths, weighted.
"""

from __future__ import annotations

from functools import partial, reduce
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations
from pk_jax.geometry.poses import retract, tangent_size
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics import elimination, lane_newton, newton
from pk_jax.kinematics.batching import is_possible, over_rows, rows_of, same_size, where, without_derivatives
from pk_jax.kinematics.closed_form import candidates, closed_form, closed_form_on_lanes, mirrored
from pk_jax.kinematics.closure import pose_scale
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.forward import blanked
from pk_jax.kinematics.in_blocks import redo
from pk_jax.kinematics.lane_map import lane_map
from pk_jax.kinematics.lanes import Entries, Lane, items_of
from pk_jax.kinematics.length_errors import Judged, LengthErrors, judge, judge_on_lanes
from pk_jax.kinematics.linear_stage import IN_PLANE_TO, ROWS, Stage, at_least, condition_of, rank_of, stage_of
from pk_jax.mechanisms.stewart import LEGS, Stewart
from pk_jax.status import Status

METHODS = ("linear", "products", "macaulay", "quintic")
ON_LANES = METHODS[:2]
SUSPICIOUS_ABOVE = 1e-3  # RMS error of the lengths over their mean: other starts are tried
FAR = 0.3  # of the platform's size, from the closed form to the estimate: the same
INCONSISTENT_ABOVE = 1e-2  # RMS error over the mean length: these lengths do not belong together
SINGULAR_BELOW = 1e-6  # least singular value of the nine rows, without units
PRODUCTS_UP_TO = 1e8  # condition of what gives the products; beyond it the Macaulay matrix is used
STARTS = np.array([(turn * np.pi / 3, tilt) for tilt in (0.0, 0.5) for turn in range(6)])  # yaw, tilt: rad


class NineLengthPose(NamedTuple):
    """One entry a row; batch first."""

    pose: SE3  # NaN unless the status is OK
    status: jax.Array  # () Status
    closed_form: SE3  # before Gauss-Newton
    rank: jax.Array  # () of the linear stage: 6, or the closed form would not be unique
    condition: jax.Array  # () of the linear stage, without units
    z_squared: jax.Array  # () least squared height of T_j over a planar base, before any clamp; else NaN
    residual: jax.Array  # () weighted RMS error of the nine lengths
    steps: jax.Array  # () Gauss-Newton steps taken
    sigma_min: jax.Array  # () lower bound of the least singular value of the weighted Jacobian, without units
    covariance: jax.Array  # (6, 6) of the pose's tangent (v, w), for length variances 1 / weights
    candidate: SE3  # the last iterate, whatever the status


def nine_length_pose(
    stewart: Stewart, lengths: Any, weights: Any = None, *, method: str | None = None
) -> NineLengthPose:
    """The pose of a platform whose six legs and three sensors are measured; no guess is needed.

    stewart:  nine rows, legs first; all platform joints in the plane of the sensors' T1, T2, T3
    lengths:  (9,) or (batch, 9), as measured
    weights:  (9,) or (batch, 9), 1 / variance of each length; default: all equal, 1
    method:   of the closed form: "linear" for a planar base (embodiment 2: M q = L, eqs. 22-24);
              "products", "macaulay" or "quintic" (eqs. 8-17) for any other (embodiment 1); default:
              linear or products. They differ in how they amplify noise, not in the final pose.

    The pose minimizes sum_i weights_i (|leg_i| - lengths_i)^2. Over a planar base its mirror
    image fits as well; it is the one on the side of home (`nine_length_candidates` has both).

    Status: OK; INCONSISTENT: the weighted RMS error exceeds 1 % of the mean length, in spite of twelve
    other starts; STALLED: no start came to rest; SINGULAR: nine lengths, as weighted, do not fix the pose
    there, or the linear stage is singular; BAD_INPUT: NaN, infinity, or a length <= 0.

    The pose carries exact derivatives in lengths, weights and geometry at any residual, zero on
    rows that are not OK. ValueError for joints outside the T plane, and for layouts whose linear stage is
    singular (`sensor_layout` tells how far from it one is).

    Source: Ryu et al., patent application KR 10-2000-0073215, both embodiments.
    """
    require_nine_rows("nine_length_pose", stewart)
    if method is not None:
        checks.is_word("method", method, METHODS)
    is_known = checks.is_concrete((stewart, lengths, weights)) and not checks.is_staged()
    one = jax.ShapeDtypeStruct((ROWS,), stewart.base.dtype)
    lengths, many = rows_of("lengths", lengths, one, numpy=is_known)
    weights = np.ones(ROWS, one.dtype) if weights is None else weights
    weights, weighted = rows_of("weights", weights, one, numpy=is_known)
    if many and weighted:
        same_size((lengths, weights), (many, weighted))
    if checks.is_concrete(weights):
        checks.is_finite("weights", weights)
        checks.is_positive("weights", weights)
    if checks.is_concrete(stewart):
        method = method_for("nine_length_pose", stewart, method)
    stage = known(stewart).stage if checks.is_concrete(stewart) else None
    if is_known and method in ON_LANES:
        rows = np.broadcast_arrays(np.atleast_2d(lengths), weights)
        found = _known_rows(stewart, stage, *rows, method)
        return found if many or weighted else jax.tree.map(lambda leaf: leaf[0], found)
    return _solve(stewart, stage, (lengths, weights), (many, weighted), method)


class NineLengthCandidates(NamedTuple):
    """Every pose that the closed form offers; batch first, then the candidates, best first."""

    poses: SE3  # (k,)
    residual: jax.Array  # (k,) RMS error of the nine lengths there, before any Gauss-Newton step


def nine_length_candidates(
    stewart: Stewart, lengths: Any, *, method: str | None = None
) -> NineLengthCandidates:
    """All real candidates for nine lengths, and how far each is off them.

    method:  "linear" (planar base): the pose and its mirror image, which fit alike; "quintic" (any other
             base, default): one for the real part of each root, of which generically one fits;
             "macaulay": one. All but "linear" add the pose that a planar base would have.

    Lengths as for `nine_length_pose`; candidates of bad ones are NaN.
    """
    require_nine_rows("nine_length_candidates", stewart)
    if method is not None:
        checks.is_word("method", method, METHODS)
    lengths, many = rows_of("lengths", lengths, jax.ShapeDtypeStruct((ROWS,), stewart.base.dtype))
    if not checks.is_concrete(stewart):
        raise ValueError("nine_length_candidates takes a Stewart with known values")
    if method == "products":
        raise ValueError("method 'products' offers no candidates to choose from; take 'macaulay'")
    found = method_for("nine_length_candidates", stewart, method)
    method = "quintic" if method is None and found != "linear" else found
    return _candidates(stewart, known(stewart).stage, lengths, many, method)


@partial(jax.jit, static_argnums=(3, 4))
def _candidates(stewart, stage, lengths, many, method):
    def one(lengths):
        given = jnp.where(is_possible(stewart, lengths), lengths, jnp.nan)
        poses = candidates(stage, given, method)[0]
        off = jax.vmap(lambda pose: jnp.sqrt(jnp.mean((stewart.inverse(pose) - given) ** 2)))(poses)
        order = jnp.argsort(off, stable=True)
        return NineLengthCandidates(*jax.tree.map(lambda leaf: leaf[order], (poses, off)))

    return over_rows(one, (lengths,), (many,))


class Known(NamedTuple):
    """What is found out once of a known geometry."""

    stage: Stage
    refusal: str | None  # why the closed form cannot work
    method: str  # that suits the layout
    rank: int
    condition: float


def known(stewart: Stewart) -> Known:
    """The linear stage of a known geometry and what it is worth, computed once."""
    found = _known.get(stewart)
    if found is None:
        with checks.known_values():
            stage = jax.tree.map(jnp.asarray, _stage(stewart))
        given = jax.tree.map(np.asarray, stage)
        general = "products" if given.squares_condition < PRODUCTS_UP_TO else "macaulay"
        method = "linear" if given.is_planar else general
        rank, condition = int(rank_of(given)), float(condition_of(given))
        found = _known[stewart] = Known(stage, refusal(given), method, rank, condition)
    return found


_known: WeakKeyDictionary[Stewart, Known] = WeakKeyDictionary()
_stage = jax.jit(stage_of)


def require_nine_rows(function: str, stewart: Any) -> None:
    if not isinstance(stewart, Stewart):
        raise ValueError(f"{function} takes a pk_jax.Stewart, got {type(stewart).__name__}")
    if stewart.base.shape[0] != ROWS:
        raise ValueError(
            f"{function} takes a Stewart with nine rows, six legs and then three sensors, "
            f"got {stewart.base.shape[0]}"
        )


def method_for(function: str, stewart: Stewart, method: str | None) -> str:
    """The method that is asked for, or that suits the layout. ValueError where none can work."""
    suited = known(stewart)
    if suited.refusal is not None:
        raise ValueError(f"{function}: {suited.refusal}")
    if suited.method == "linear" and method not in (None, "linear"):
        raise ValueError(
            f"method {method!r} is for bases that are not planar: of this one the pose and its mirror image "
            "are both roots; use 'linear'"
        )
    if suited.method != "linear" and method == "linear":
        raise ValueError("method 'linear' is for planar bases, all A_i and S_j in one plane")
    return method or suited.method


def refusal(stage: Any) -> str | None:
    """Why the closed form cannot work for a layout, a `Stage` of NumPy arrays; None where it can."""
    frame = stage.frame
    if not frame.slimness > 1e-6:
        return "the sensors' platform joints T1, T2, T3 (Stewart.platform[6:9]) must not lie on one line"
    if frame.off.max() > at_least(IN_PLANE_TO, frame.off.dtype) * np.sqrt(np.mean(frame.sides)):
        worst = int(frame.off.argmax())
        return (
            f"all platform joints must lie in the plane of T1, T2, T3, but Stewart.platform[{worst}] is "
            f"{frame.off[worst]:.6g} off it (forward_kinematics solves nine rows of any layout from a guess)"
        )
    if (rank := int(rank_of(stage))) < LEGS:
        return (
            f"the layout is singular: its linear stage has rank {rank} of 6 in every pose; move the sensors "
            "(see sensor_layout)"
        )
    return None


def _verdict(judged: Judged, is_stationary: Any) -> Any:
    """Status of an estimate."""
    status = jnp.where(judged.share < INCONSISTENT_ABOVE, Status.OK, Status.INCONSISTENT)
    status = jnp.where(judged.sigma_min < SINGULAR_BELOW, Status.SINGULAR, status)
    return jnp.where(is_stationary, status, Status.STALLED)


def _is_near(errors: LengthErrors, start: SE3, pose: SE3) -> jax.Array:
    """Whether an estimate is where the closed form said. -> ()"""
    moved = (pose.translation - start.translation) / errors.length()
    return jnp.sum(moved**2) + jnp.sum((pose.rotation - start.rotation) ** 2) < FAR**2


class Found(NamedTuple):
    """One row; many on lanes."""

    pose: Any
    closed_form: Any
    covariance: Any
    status: Any
    z_squared: Any
    residual: Any
    steps: Any
    sigma_min: Any


# --- known rows, whatever their number: on lanes in blocks, the lost ones again


def _known_rows(
    stewart: Stewart, stage: Stage, lengths: np.ndarray, weights: np.ndarray, method: str
) -> NineLengthPose:
    t, r, start_t, start_r, covariance, status, squared, residual, steps, sigma = lane_map(
        _LANE_VALUES[method], (stewart, stage), (lengths, weights), _SHAPES
    )
    as_pose = lambda *parts: jax.tree.unflatten(jax.tree.structure(stage.home), parts)
    status, steps = status.astype(np.int32), steps.astype(np.int32)
    found = Found(
        as_pose(t, r), as_pose(start_t, start_r), covariance, status, squared, residual, steps, sigma
    )
    lost = np.flatnonzero(status == Status.STALLED)
    redo(partial(_persist_rows, stewart, stage), lost, (lengths, weights), found)
    return _answer(stewart, found)


def _lane_values(mech: tuple, lengths: Entries, weights: Entries, *, method: str) -> list[Lane]:
    """All that `Found` holds, of one row."""
    stewart, stage = mech
    is_given = reduce(jnp.logical_and, [jnp.isfinite(length) & (length > 0) for length in lengths.items])
    home = entrywise(lambda s, x: s.inverse(x), stewart, stage.home).items
    pairs = zip(lengths.items, home, strict=True)
    lengths = Entries((ROWS,), [jnp.where(is_given, *pair) for pair in pairs])
    start, squared = closed_form_on_lanes(stage, lengths, method)
    errors = LengthErrors.of(stewart, Entries((ROWS,), [jnp.sqrt(w) for w in weights.items]))
    ended = lane_newton.iterate(errors, lengths, start, elimination.NORMAL, None, ROWS)
    judged = judge_on_lanes(errors, ended.pose, lengths)
    is_trusted = ended.is_stationary & entrywise(_is_near, errors, start, ended.pose).items[0]
    is_trusted = is_trusted & (judged.share < SUSPICIOUS_ABOVE)
    status = jnp.where(is_given, _verdict(judged, is_trusted), Status.BAD_INPUT)
    found = Found(
        ended.pose, start, judged.covariance, status, squared, judged.residual, ended.steps, judged.sigma_min
    )
    dtype = judged.residual.dtype
    return [item.astype(dtype) for item in (*items_of(found[:3]), *found[3:])]


_LANE_VALUES = {method: partial(_lane_values, method=method) for method in ON_LANES}
_SHAPES = ((3,), (3, 3), (3,), (3, 3), (6, 6), *[()] * 5)


@jax.jit
def _persist_rows(stewart, stage, lengths, weights, found):
    return jax.vmap(partial(_persist, stewart, stage))(lengths, weights, found)


def _answer(stewart: Stewart, found: Found) -> NineLengthPose:
    """Many rows of NumPy arrays."""
    is_bad = found.status == Status.BAD_INPUT
    candidate, start, covariance, squared, residual, sigma = blanked(
        (found.pose, found.closed_form, found.covariance, found.z_squared, found.residual, found.sigma_min),
        is_bad,
    )
    return jax.device_put(
        NineLengthPose(
            pose=blanked(found.pose, found.status != Status.OK),
            status=found.status,
            closed_form=start,
            rank=np.full(is_bad.shape, known(stewart).rank),
            condition=np.full(is_bad.shape, known(stewart).condition),
            z_squared=squared,
            residual=residual,
            steps=np.where(is_bad, 0, found.steps),
            sigma_min=sigma,
            covariance=covariance,
            candidate=candidate,
        )
    )


# --- traced values: one row's function, differentiable


@partial(jax.jit, static_argnums=(3, 4))
def _solve(stewart, stage, lengths_and_weights, are_batched, method):
    stage = stage_of(stewart) if stage is None else stage
    one = lambda *row: _one(stewart, stage, *row, method)
    return over_rows(one, lengths_and_weights, are_batched)


def _one(
    stewart: Stewart, stage: Stage, lengths: jax.Array, weights: jax.Array, method: str | None
) -> NineLengthPose:
    found = without_derivatives(partial(_locate, method=method))(stewart, stage, lengths, weights)
    is_ok, is_given = found.status == Status.OK, found.status != Status.BAD_INPUT
    home_lengths = stewart.inverse(stage.home)  # lost rows work at home and are masked after
    lengths = jnp.where(is_ok, lengths, home_lengths)
    errors = LengthErrors.of(stewart, jnp.sqrt(weights))
    at = where(is_ok, found.pose, stage.home)
    pose = newton.implicit(lambda x: errors.residual(x, lengths), retract, at, tangent_size(at))
    start = closed_form(stage, lengths, method)[0]
    masked = lambda tree: jax.tree.map(lambda leaf: jnp.where(is_given, leaf, jnp.nan), tree)
    return NineLengthPose(
        pose=where(is_ok, pose, jnp.nan),
        status=found.status,
        closed_form=where(is_ok, start, masked(found.closed_form)),
        rank=rank_of(stage),
        condition=condition_of(stage),
        z_squared=masked(found.z_squared),
        residual=masked(found.residual),
        steps=jnp.where(is_given, found.steps, 0),
        sigma_min=masked(found.sigma_min),
        covariance=jnp.where(is_ok, judge(errors, pose, lengths).covariance, masked(found.covariance)),
        candidate=masked(found.pose),
    )


def _locate(
    stewart: Stewart, stage: Stage, lengths: jax.Array, weights: jax.Array, *, method: str | None
) -> Found:
    """One row without derivatives."""
    is_given = is_possible(stewart, lengths)
    lengths = jnp.where(is_given, lengths, stewart.inverse(stage.home))
    start, squared = closed_form(stage, lengths, method)
    errors = LengthErrors.of(stewart, jnp.sqrt(weights))
    is_regular = rank_of(stage) == LEGS
    solution = _least_squares(errors, stage, lengths, start, is_given & is_regular)
    judged = judge(errors, solution.point, lengths)
    is_trusted = solution.is_stationary & _is_near(errors, start, solution.point)
    status = _verdict(judged, is_trusted & (judged.share < SUSPICIOUS_ABOVE))
    status = jnp.where(is_regular, status, Status.SINGULAR)
    found = Found(
        pose=solution.point,
        closed_form=start,
        covariance=judged.covariance,
        status=jnp.where(is_given, status, Status.BAD_INPUT).astype(jnp.int32),
        z_squared=squared,
        residual=judged.residual,
        steps=solution.steps,
        sigma_min=judged.sigma_min,
    )
    return _persist(stewart, stage, lengths, weights, found)


# --- lost rows


def _persist(stewart: Stewart, stage: Stage, lengths: jax.Array, weights: jax.Array, found: Found) -> Found:
    """A STALLED row again, from its own start and twelve others; any other as it is."""
    is_lost = found.status == Status.STALLED
    lengths = jnp.where(is_lost, lengths, stewart.inverse(stage.home))
    errors = LengthErrors.of(stewart, jnp.sqrt(weights))
    own = where(jnp.all(jnp.isfinite(found.closed_form.rotation)), found.closed_form, stage.home)
    starts = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), own, _starts(stage))
    solutions = jax.vmap(lambda start: _least_squares(errors, stage, lengths, start, is_lost))(starts)
    cost = jnp.where(jnp.isnan(solutions.residual), jnp.inf, solutions.residual)
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(cost)], solutions)
    is_below = stage.is_planar & ~_is_above(stage, best.point)  # the mirror image fits as well
    pose = where(is_below, mirrored(stage, best.point), best.point)
    judged = judge(errors, pose, lengths)
    status = _verdict(judged, best.is_stationary)
    is_off = (status == Status.STALLED) & (judged.share >= INCONSISTENT_ABOVE)  # from every start
    again = found._replace(
        pose=pose,
        covariance=judged.covariance,
        status=jnp.where(is_off, Status.INCONSISTENT, status).astype(jnp.int32),
        residual=judged.residual,
        steps=found.steps + best.steps,
        sigma_min=judged.sigma_min,
    )
    return where(is_lost, again, found)


def _least_squares(
    errors: LengthErrors, stage: Stage, lengths: jax.Array, start: SE3, is_needed: jax.Array
) -> newton.Solution:
    linearize = lambda pose: errors.linearize(pose, lengths)
    scale = pose_scale(errors, stage.home)
    return newton.solve(linearize, retract, start, scale=scale, is_needed=is_needed)


def _starts(stage: Stage) -> SE3:
    """Home, turned about the base's normal and tilted about the triangle's centre. -> (12,)"""
    home, centre = stage.home, stage.frame.centre
    at = home.translation + home.rotation @ centre

    def turned(turn):
        lean = rotations.from_rotation_vector(turn[1] * (home.rotation @ stage.frame.axes[:, 0]))
        rotation = rotations.from_rotation_vector(turn[0] * stage.up) @ lean @ home.rotation
        return SE3(at - rotation @ centre, rotation)

    return jax.vmap(turned)(jnp.asarray(STARTS, at.dtype))


def _is_above(stage: Stage, pose: SE3) -> jax.Array:
    """Whether the centre of the triangle is on home's side of the base. -> ()"""
    return (pose.translation + pose.rotation @ stage.frame.centre - stage.middle) @ stage.up > 0
