"""Where to put three length sensors on a Stewart platform, by gradients."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.sensors import SensorLayout, covariance_at, sensor_layout
from pk_jax.design import ascent
from pk_jax.geometry.se3 import SE3
from pk_jax.geometry.spread import evenly
from pk_jax.kinematics.batching import home_shapes, rows_of
from pk_jax.kinematics.linear_stage import IN_PLANE_TO, ROWS, at_least, frame_of, matrix_of
from pk_jax.mechanisms.stewart import LEGS, Stewart
from pk_jax.status import Status

STEEPNESS = 10.0  # of the penalty on a linear stage beyond `most_condition`


class SensorPlacement(NamedTuple):
    """The best of all starts."""

    stewart: Stewart  # nine rows
    gain: float  # RMS over the poses of sqrt(|dt|^2 + (length() dw)^2) for unit errors of all lengths
    gain_before: float  # of the sensors that the platform came with; inf without
    layout: SensorLayout
    gains: np.ndarray  # (starts,) where every start ended
    evaluations: int  # of value and gradient, all starts
    status: Status


def place_sensors(
    stewart: Stewart,
    poses: SE3,
    *,
    radius: float,
    platform_radius: float | None = None,
    weights: Any = None,
    starts: int = 16,
    steps: int = 200,
    most_condition: float = 100.0,
    report: Any = None,
) -> SensorPlacement:
    """Base joints S_j, and platform joints T_j if wished, that pass least noise on to the pose.

    stewart:          six rows, or nine: then the given T_j are kept unless `platform_radius` is given
    poses:            `SE3` batch, the workspace over which the gain is averaged
    radius:           the S_j stay in a square of this half-width about the middle of the base
    platform_radius:  the T_j stay in such a square about the middle of the platform; None: they stay put,
                      of a platform with six rows at every other joint
    weights:          (9,) 1 / variance of each length
    most_condition:   of the linear stage: layouts beyond it, on which the closed form would be poor, are
                      penalized

    ValueError for platforms whose joints are not in one plane. Variables are reached by projected
    L-BFGS from many starts; the gradient is that of the covariance at every pose.
    """
    if not isinstance(stewart, Stewart) or stewart.base.shape[0] not in (LEGS, ROWS):
        raise ValueError("place_sensors takes a Stewart with six rows, or nine")
    checks.is_function("report", report)
    poses, many = rows_of("poses", poses, home_shapes(stewart)[0])
    poses = poses if many else jax.tree.map(lambda leaf: leaf[None], poses)
    for name, value in (("radius", radius), ("platform_radius", platform_radius)):
        is_left_out = value is None and name != "radius"
        if not (is_left_out or (checks.is_number(value) and value > 0)):
            raise ValueError(f"{name} must be positive and finite, got {checks.shown(value)}")
    if not (checks.is_number(most_condition) and most_condition > 1):
        raise ValueError(f"most_condition must be greater than 1, got {checks.shown(most_condition)}")
    starts = checks.is_count("starts", starts, most=10_000)
    steps = checks.is_count("steps", steps, most=100_000)
    weights = checks.real_array("weights", np.ones(ROWS) if weights is None else weights)
    checks.has_shape("weights", weights, (ROWS,))
    checks.is_positive("weights", weights)
    checks.is_finite("weights", weights)
    for leaf in jax.tree.leaves(poses):
        checks.is_finite("poses", leaf)

    count = len(poses.translation)
    checks.fits(f"{starts} starts over {count} poses", 8 * 1000 * starts * count, "take fewer of either")

    _require_flat(np.asarray(stewart.platform))
    room = _room_of(stewart, radius, platform_radius)
    problem = _Problem(stewart, room, poses, weights, jnp.asarray(most_condition, weights.dtype))
    size = 6 if platform_radius is None else 12
    states = jax.vmap(ascent.begin)(_starts(problem, starts, size))
    for done in range(1, steps + 1):
        states = _step(problem, states)
        if report is not None:
            report("sensor placement", done, steps, float(jnp.exp(-jnp.nanmax(states.value))))
        if bool(jnp.all(states.is_done)):
            break
    best = int(jnp.nanargmax(states.value))
    found = _placed(problem, states.box[best])
    placed = _with_sensors(stewart, found[0], found[1])
    gains = np.asarray(jnp.exp(-states.value))
    before = float(gain_over(stewart, poses, weights)) if stewart.base.shape[0] == ROWS else np.inf
    layout = sensor_layout(placed)
    is_done = bool(states.is_done[best])
    status = Status.SINGULAR if layout.reason else Status.OK if is_done else Status.STEP_LIMIT
    gain = float(gain_over(placed, poses, weights))
    return SensorPlacement(placed, gain, before, layout, gains, int(jnp.sum(states.evaluations)), status)


def _require_flat(platform: np.ndarray) -> None:
    """ValueError where the platform's joints are not in one plane."""
    sizes = np.linalg.svd(platform - platform.mean(axis=0), compute_uv=False)
    if not sizes[2] <= at_least(IN_PLANE_TO, platform.dtype) * sizes[0]:
        raise ValueError(
            "place_sensors: all platform joints must lie in one plane, that of the T1, T2, T3 to be found"
        )


def _starts(problem: _Problem, count: int, size: int) -> jax.Array:
    """Points spread over the unit box, none of the worse half; first those that came. -> (count, size)"""
    boxes = jnp.asarray(0.05 + 0.9 * evenly(4 * count, size), problem.weights.dtype)
    scores = jax.jit(jax.vmap(partial(_score, problem)))(boxes)
    scores = jnp.where(jnp.isnan(scores), -jnp.inf, scores)
    boxes = boxes[jnp.argsort(scores < jnp.median(scores), stable=True)[:count]]
    if problem.stewart.base.shape[0] == LEGS:
        return boxes
    squares = (problem.room.base, problem.stewart.base), (problem.room.platform, problem.stewart.platform)
    came = [_in_square(square, joints[LEGS:]) for square, joints in squares[: size // 6]]
    return boxes.at[0].set(jnp.clip(jnp.concatenate(came), 0, 1))


def _in_square(square: tuple[jax.Array, jax.Array], joints: jax.Array) -> jax.Array:
    """Joints (3, 3) in the unit box of their square. -> (6,)"""
    middle, axes = square
    return (((joints - middle) @ axes.T / jnp.sum(axes**2, axis=1) + 1) / 2).ravel()


def gain_over(stewart: Stewart, poses: SE3, weights: jax.Array) -> jax.Array:
    """RMS over `poses` of sqrt(|dt|^2 + (length() dw)^2) for lengths of variances 1 / weights. -> ()"""
    covariances = jax.vmap(lambda pose: covariance_at(stewart, None, pose, weights))(poses)
    scale = jnp.append(jnp.ones(3), jnp.full(3, stewart.length()))
    return jnp.sqrt(jnp.mean(jnp.einsum("nii,i->n", covariances, scale**2)))


class _Room(NamedTuple):
    """Squares in which the sensors' joints may lie: middle (3,), two axes (2, 3), as long as half a side."""

    base: tuple[jax.Array, jax.Array]
    platform: tuple[jax.Array, jax.Array]
    corners: jax.Array  # (3, 3) T_j that stay put


class _Problem(NamedTuple):
    stewart: Stewart
    room: _Room
    poses: SE3
    weights: jax.Array
    most_condition: jax.Array


def _room_of(stewart: Stewart, radius: float, platform_radius: float | None) -> _Room:
    platform = np.asarray(stewart.platform)
    corners = platform[LEGS:] if len(platform) == ROWS else platform[:LEGS:2]
    square = lambda points, half: (points.mean(axis=0), half * _plane(points))
    base = square(np.asarray(stewart.base)[:LEGS], radius)
    return jax.tree.map(jnp.asarray, _Room(base, square(platform[:LEGS], platform_radius or 0.0), corners))


def _plane(points: np.ndarray) -> np.ndarray:
    """Two unit vectors in the plane nearest to points, the first along the frame's x or y. -> (2, 3)"""
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    first = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    first = first - (first @ normal) * normal
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _placed(problem: _Problem, box: jax.Array) -> tuple[jax.Array, jax.Array]:
    """S_j and T_j at a point of the unit box. -> (3, 3), (3, 3)"""
    at = lambda square, part: square[0] + (2 * part.reshape(3, 2) - 1) @ square[1]
    feet = at(problem.room.base, box[:6])
    return feet, at(problem.room.platform, box[6:]) if box.size == 12 else problem.room.corners


def _with_sensors(stewart: Stewart, feet: Any, corners: Any) -> Stewart:
    """The platform with these three sensors; its limits are those of the legs."""
    rows = lambda legs, sensors: jnp.concatenate([legs[:LEGS], sensors])
    return dataclasses.replace(
        stewart, base=rows(stewart.base, feet), platform=rows(stewart.platform, corners)
    )


def _score(problem: _Problem, box: jax.Array) -> jax.Array:
    """-log of the gain, less a penalty on a poor linear stage. -> ()"""
    placed = _with_sensors(problem.stewart, *_placed(problem, box))
    matrix = matrix_of(placed.base, frame_of(placed.platform).coordinates).reshape(LEGS, 9)
    values = jnp.linalg.svd(matrix, compute_uv=False)
    beyond = jnp.maximum(jnp.log(values[0] / values[-1] / problem.most_condition), 0)
    return -jnp.log(gain_over(placed, problem.poses, problem.weights)) - STEEPNESS * beyond**2


@jax.jit
def _step(problem: _Problem, states: ascent.Ascent) -> ascent.Ascent:
    def one(state):
        value, gradient = jax.value_and_grad(partial(_score, problem))(ascent.propose(state))
        return ascent.judge(state, value, gradient, 1e-6)

    return jax.vmap(one)(states)
