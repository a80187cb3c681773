"""What three extra length sensors are worth: whether a layout can do, and how it passes noise on."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry.poses import difference
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.batching import home_shapes, over_rows, rows_of
from pk_jax.kinematics.closed_form import closed_form
from pk_jax.kinematics.length_errors import LengthErrors
from pk_jax.kinematics.linear_stage import IN_PLANE_TO, Stage, at_least, rank_of, stage_of
from pk_jax.kinematics.nine_lengths import known, require_nine_rows
from pk_jax.mechanisms.stewart import LEGS, Stewart


class SensorLayout(NamedTuple):
    """The linear stage of a nine-length platform: a property of the layout, the same in every pose."""

    kind: str  # "planar base" (embodiment 2) or "general base" (embodiment 1)
    rank: int  # of the six linear equations
    condition: float  # greatest over least singular value
    singular_values: np.ndarray  # (6,) over the size of the base
    reason: str | None  # why the closed form is impossible; None where it is not


def sensor_layout(stewart: Stewart) -> SensorLayout:
    """Rank and conditioning of the linear stage of a platform with six legs and three sensors.

    Singular exactly where some matrix G other than zero has [A_i; 1]^T G [b_i; 1] = 0 for all nine
    pairs of joints beyond those every layout has: two regular hexagons leave rank 5; a base that is an
    affine copy of the platform, sensors included, rank 3; legs that meet in pairs at the T_j with the
    S_j on the lines through their feet (6-3) rank 3. Sensors at one point in the middle of the base, or
    turned against the T_j, do well.
    """
    require_nine_rows("sensor_layout", stewart)
    if not checks.is_concrete(stewart):
        raise ValueError("sensor_layout takes a Stewart with known values")
    found = known(stewart)
    return SensorLayout(
        "planar base" if bool(found.stage.is_planar) else "general base",
        found.rank,
        found.condition,
        np.asarray(found.stage.singular_values),
        found.refusal,
    )


def pose_covariance(stewart: Stewart, pose: Any, weights: Any = None) -> jax.Array:
    """Covariance of the weighted least-squares pose from measured lengths. -> (..., 6, 6)

    In the tangent (v, w) of the pose, v in the unit of length, w in rad, base axes.

    pose:     `SE3`, one or a batch
    weights:  (k,) 1 / variance of each length; default: 1
    """
    return _gains(stewart, pose, weights, ("estimate",))["estimate"]


class NoiseGain(NamedTuple):
    """RMS pose error over that of the lengths: position () without unit, rotation () in rad a length."""

    position: jax.Array
    rotation: jax.Array


class NoiseGains(NamedTuple):
    """What reaches the pose of independent errors of the lengths; batch first."""

    estimate: NoiseGain  # weighted least squares of all nine
    closed_form: NoiseGain  # alone; NaN where the layout makes it impossible
    legs: NoiseGain  # six legs, no sensors


def noise_gains(stewart: Stewart, pose: Any, weights: Any = None) -> NoiseGains:
    """How a platform with nine rows passes length noise on to its pose, by three ways of computing it.

    To first order, by derivatives of the three poses in the lengths. Errors have variances 1 / weights
    (default: 1, so that gains are per unit of RMS length error).

    pose:     `SE3`, one or a batch
    """
    require_nine_rows("noise_gains", stewart)
    found = _gains(stewart, pose, weights, NoiseGains._fields)
    split = lambda c: NoiseGain(*(jnp.sqrt(jnp.trace(part, axis1=-2, axis2=-1)) for part in _blocks(c)))
    return NoiseGains(*(split(found[name]) for name in NoiseGains._fields))


def _blocks(covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
    return covariance[..., :3, :3], covariance[..., 3:, 3:]


def _gains(stewart: Any, pose: Any, weights: Any, names: tuple[str, ...]) -> dict[str, jax.Array]:
    if not isinstance(stewart, Stewart):
        raise ValueError(f"a pk_jax.Stewart is needed, got {type(stewart).__name__}")
    pose, many = rows_of("pose", pose, home_shapes(stewart)[0])
    rows = stewart.base.shape[0]
    weights = checks.real_array("weights", np.ones(rows) if weights is None else weights)
    checks.has_shape("weights", weights, (rows,))
    if checks.is_concrete(weights):
        checks.is_positive("weights", weights)
        checks.is_finite("weights", weights)
    return _covariances(stewart, pose, weights.astype(stewart.base.dtype), many, names)


@partial(jax.jit, static_argnums=(3, 4))
def _covariances(stewart, pose, weights, many, names):
    each = {"estimate": covariance_at, "closed_form": _of_closed_form, "legs": _of_legs}
    given = (stage_of(stewart),) if "closed_form" in names else (None,)
    return {
        name: over_rows(lambda p, f=each[name]: f(stewart, *given, p, weights), (pose,), (many,))
        for name in names
    }


def covariance_at(stewart: Stewart, stage: Any, pose: SE3, weights: jax.Array) -> jax.Array:
    """(J^T W J)^-1 with J = d |leg| / d pose. -> (6, 6)"""
    errors = LengthErrors.of(stewart, jnp.sqrt(weights))
    jacobian = errors.linearize(pose, stewart.inverse(pose))[1]
    return jnp.linalg.inv(jacobian.T @ jacobian)


def _of_legs(stewart: Stewart, stage: Any, pose: SE3, weights: jax.Array) -> jax.Array:
    errors = LengthErrors.of(stewart, jnp.sqrt(weights))
    jacobian = errors.linearize(pose, stewart.inverse(pose))[1][:LEGS]
    inverse = jnp.linalg.inv(jacobian)
    return inverse @ inverse.T


def _of_closed_form(stewart: Stewart, stage: Stage, pose: SE3, weights: jax.Array) -> jax.Array:
    at = stewart.inverse(pose)
    moved = lambda lengths: difference(pose, closed_form(stage, lengths, None)[0])
    jacobian = jax.jacfwd(moved)(at)
    size = jnp.sqrt(jnp.mean(stage.frame.sides))
    is_flat = jnp.max(stage.frame.off) <= at_least(IN_PLANE_TO, at.dtype) * size
    is_possible = is_flat & (rank_of(stage) == LEGS)
    return jnp.where(is_possible, jacobian / weights @ jacobian.T, jnp.nan)
