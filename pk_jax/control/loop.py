"""The loop of Fig. 4 of Ryu et al. (KR 10-2000-0073215): measure, estimate, compare, PID, actuate."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.control.plant import (
    Gains,
    Plant,
    check_gains,
    check_plant,
    drawn,
    driven,
    read,
    variances_of,
    weights_of,
)
from pk_jax.control.reference import Reference
from pk_jax.geometry import safe
from pk_jax.geometry.poses import difference, retract
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.closed_form import closed_form
from pk_jax.kinematics.length_errors import LengthErrors
from pk_jax.kinematics.linear_stage import ROWS
from pk_jax.kinematics.nine_lengths import known, method_for, require_nine_rows
from pk_jax.mechanisms.stewart import LEGS, Stewart
from pk_jax.status import Status

FEEDBACKS = ("joint", "legs", "closed", "nine", "learned")
NEWTON_STEPS = 3  # a sample, from the last one's pose
DRIFT = 1e-3  # of their spread: what constant errors may wander in a sample
SETTLED = 0.02  # of the step
CLOSED_TO = 1e-9  # of length(): what the true machine's loops may be open


class Simulation(NamedTuple):
    """Runs of one loop; seeds first, then samples."""

    time: jax.Array  # (n,) s
    desired: SE3  # (n,) the reference, as late as the actuators are
    pose: SE3  # (seeds, n) where the platform is
    estimate: SE3  # (seeds, n) where the controller believes it to be; NaN for feedback by joints
    legs: jax.Array  # (seeds, n, 6)
    command: jax.Array  # (seeds, n, 6) leg rates
    position_error: jax.Array  # (seeds, n) |t - desired t|
    rotation_error: jax.Array  # (seeds, n) rad
    rms_position: jax.Array  # (seeds,) over the samples that count
    rms_rotation: jax.Array  # (seeds,) rad
    settling_time: (
        jax.Array
    )  # (seeds,) s until the error stays within 2 % of the step; NaN: never, or no step
    status: jax.Array  # (seeds,) Status: OK, or STALLED where the platform's loops would not close


def simulate_control(
    stewart: Stewart,
    reference: Reference,
    feedback: str = "nine",
    *,
    key: jax.Array,
    plant: Plant | None = None,
    gains: Gains | None = None,
    seeds: int = 1,
    weights: Any = None,
) -> Simulation:
    """Closed-loop motion of a nine-length platform whose six legs are rate-controlled.

    stewart:    nine rows: what the controller believes; the machine differs by `plant`'s errors
    reference:  `circle_reference(...)` or `step_reference(...)`
    feedback:   "joint": leg lengths alone; "legs": forward kinematics of six legs, Newton from the last
                sample; "closed": the closed form of nine lengths; "nine": weighted least squares of
                nine; "learned": the same, while a Kalman filter learns the constant errors of the encoders
                from how the nine lengths contradict one another along the way
    key:        of jax.random; seed i is drawn from `fold_in(key, i)`, whatever the number of seeds
    plant:      default `Plant()`
    gains:      default `Gains()`
    weights:    (9,) of "nine", 1 / variance; default: from what `plant` says of its errors, as "learned"
                has it, too

    Pose feedback maps the error (v, w) to leg rates by the Jacobian at the estimate. The error is taken
    against the reference as late as a perfect actuator with this delay and lag would be, plant.delay
    samples and the lag, and the feed-forward is of the reference itself, so that an ideal plant follows it.
    """
    require_nine_rows("simulate_control", stewart)
    if feedback not in FEEDBACKS:
        raise ValueError(f"feedback must be one of {', '.join(FEEDBACKS)}, got {feedback!r}")
    if not isinstance(reference, Reference):
        raise ValueError(
            f"reference must come from circle_reference or step_reference, got {type(reference).__name__}"
        )
    plant, gains = plant or Plant(), gains or Gains()
    check_plant(plant)
    check_gains(gains)
    seeds = checks.is_count("seeds", seeds, most=100_000)
    method = method_for("simulate_control", stewart, None) if feedback in ("closed", "nine") else None
    weights = checks.real_array("weights", weights_of(plant) if weights is None else weights)
    checks.has_shape("weights", weights, (ROWS,))
    checks.is_positive("weights", weights)
    samples = round(reference.duration / plant.period)
    if not 2 <= samples <= 10_000_000:
        raise ValueError(f"duration over period must be from 2 to 10,000,000 samples, got {samples}")
    keys = jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(seeds))
    sampled = sampled_reference(stewart, reference, plant, samples)
    numbers = jax.tree.map(lambda value: jnp.asarray(value, stewart.base.dtype), (plant, gains))
    runs = _run_all(
        stewart,
        known(stewart).stage,
        *numbers,
        weights / jnp.max(weights),
        sampled,
        keys,
        feedback,
        method,
        int(plant.delay),
    )
    return _summed_up(reference, plant, float(stewart.length()), sampled, runs)


class Sampled(NamedTuple):
    """The reference as the controller reads it, n samples."""

    start: SE3
    late: SE3  # (n,)
    legs: jax.Array  # (n, 6) of `late`
    rates: jax.Array  # (n, 6) mean leg rates of the reference from each sample to the next


def sampled_reference(stewart: Stewart, reference: Reference, plant: Plant, samples: int) -> Sampled:
    return _sampled(
        stewart,
        reference.start,
        reference.pose_at,
        plant.period,
        plant.delay * plant.period + plant.lag,
        samples,
    )


@partial(jax.jit, static_argnums=(2, 5))
def _sampled(stewart, start, pose_at, period, late, samples):
    time = period * jnp.arange(samples)
    legs_of = lambda pose: stewart.inverse(pose)[:LEGS]
    poses = jax.vmap(lambda t: pose_at(jnp.maximum(t - late, 0)))(time)
    ahead = jax.vmap(lambda t: legs_of(pose_at(t)))(period * jnp.arange(samples + 1))
    return Sampled(start, poses, jax.vmap(legs_of)(poses), jnp.diff(ahead, axis=0) / period)


class Learned(NamedTuple):
    """Constant errors of the legs' encoders, as far as they are known."""

    bias: jax.Array  # (6,)
    variance: jax.Array  # (6, 6)


def _unlearned(plant: Plant, like: jax.Array) -> Learned:
    """What is known of the encoders before anything is measured."""
    return Learned(0 * like, plant.encoder_bias**2 * jnp.eye(LEGS, dtype=like.dtype))


class _Loop(NamedTuple):
    """What a sample hands to the next."""

    legs: jax.Array  # (6,) true
    rates: jax.Array  # (6,) true
    pose: SE3  # true
    waiting: jax.Array  # (delay, 6) commands on their way
    integral: jax.Array  # (6,)
    error: jax.Array  # (6,) of the last sample
    estimate: SE3
    learned: Learned
    is_closed: jax.Array  # () so far


class _Record(NamedTuple):
    pose: SE3
    estimate: SE3
    legs: jax.Array
    command: jax.Array


@partial(jax.jit, static_argnums=(7, 8, 9))
def _run_all(stewart, stage, plant, gains, weights, sampled, keys, feedback, method, delay):
    run = partial(_run, stewart, stage, plant, gains, weights, sampled)
    run = partial(run, feedback=feedback, method=method, delay=delay)
    return jax.vmap(run)(keys)


def _run(stewart, stage, plant, gains, weights, sampled, key, *, feedback, method, delay):
    """One machine, one run. -> records (n, ...), whether its loops stayed closed"""
    of_machine, of_noise = jax.random.split(key)
    built, bias = drawn(of_machine, stewart, plant)
    legs = stewart.inverse(sampled.start)[:LEGS]
    zero = jnp.zeros(LEGS, legs.dtype)
    state = _Loop(
        legs=legs,
        rates=zero,
        pose=_settled_pose(built, legs, sampled.start),
        waiting=jnp.zeros((delay, LEGS), legs.dtype),
        integral=zero,
        error=zero,
        estimate=sampled.start,
        learned=_unlearned(plant, zero),
        is_closed=jnp.asarray(True),
    )

    def sample(state: _Loop, given):
        k, late, late_legs, rates = given
        pose = _newton(built, state.legs, state.pose)
        off = jnp.max(jnp.abs(built.inverse(pose)[:LEGS] - state.legs))
        is_closed = state.is_closed & (off <= CLOSED_TO * stewart.length())
        measured = read(jax.random.fold_in(of_noise, k), built.inverse(pose), bias, plant)

        estimate, learned = state.estimate, state.learned
        if feedback == "legs":
            estimate = _newton(stewart, measured[:LEGS], estimate)
        elif feedback != "joint":
            estimate = closed_form(stage, measured, method)[0]
        if feedback == "nine":
            estimate = _least_squares(stewart, estimate, measured, jnp.diag(weights))
        elif feedback == "learned":
            estimate, learned = _learning(stewart, estimate, measured, learned, plant)
        if feedback == "joint":
            error = late_legs - measured[:LEGS]
        else:
            error = length_jacobian(stewart, estimate)[:LEGS] @ difference(estimate, late)

        change = jnp.where(k > 0, error - state.error, 0) / plant.period
        wanted = gains.feed_forward * rates + gains.kp * error + gains.ki * state.integral + gains.kd * change
        command = jnp.clip(wanted, -plant.rate_limit, plant.rate_limit)
        is_winding_up = (gains.anti_windup > 0) & (command != wanted) & (wanted * error > 0)
        integral = state.integral + jnp.where(is_winding_up, 0, error * plant.period)

        waiting = jnp.concatenate([state.waiting, command[None]])
        legs, leg_rates = driven(state.legs, state.rates, waiting[0], plant)
        after = _Loop(legs, leg_rates, pose, waiting[1:], integral, error, estimate, learned, is_closed)
        said = jax.tree.map(lambda leaf: leaf * jnp.nan, estimate) if feedback == "joint" else estimate
        return after, _Record(pose, said, state.legs, command)

    given = (jnp.arange(sampled.legs.shape[0]), sampled.late, sampled.legs, sampled.rates)
    state, records = lax.scan(sample, state, given)
    return records, state.is_closed


def length_jacobian(stewart: Stewart, pose: SE3) -> jax.Array:
    """Rates of all lengths of a twist. -> (k, 6)"""
    unweighted = LengthErrors.of(stewart, jnp.ones(stewart.base.shape[0], stewart.base.dtype))
    return unweighted.linearize(pose, stewart.inverse(pose))[1]


def _newton(stewart: Stewart, legs: jax.Array, pose: SE3) -> SE3:
    """The pose of six legs, a few steps from one near by."""
    for _ in range(NEWTON_STEPS):
        off = stewart.inverse(pose)[:LEGS] - legs
        pose = retract(pose, -jnp.linalg.solve(length_jacobian(stewart, pose)[:LEGS], off))
    return pose


def _settled_pose(built: Stewart, legs: jax.Array, pose: SE3) -> SE3:
    return _newton(built, legs, _newton(built, legs, pose))


def _least_squares(stewart: Stewart, pose: SE3, measured: jax.Array, weights: jax.Array) -> SE3:
    """A few Gauss-Newton steps on nine lengths, weights (9, 9)."""
    for _ in range(NEWTON_STEPS):
        jacobian = length_jacobian(stewart, pose)
        off = stewart.inverse(pose) - measured
        pose = retract(pose, -jnp.linalg.solve(jacobian.T @ weights @ jacobian, jacobian.T @ weights @ off))
    return pose


def _learning(
    stewart: Stewart, pose: SE3, measured: jax.Array, learned: Learned, plant: Plant
) -> tuple[SE3, Learned]:
    """Pose and constant errors of the legs together: the pose free in every sample, the errors remembered.

    With S the covariance of what is read, the pose minimizes r^T S^-1 r; what is left of r then
    updates the errors as in a Kalman filter.
    """
    bias, variance = learned
    legs, sensors = variances_of(plant)
    spread = jnp.diag(
        jnp.repeat(jnp.stack([legs, sensors]), np.array([LEGS, ROWS - LEGS]), total_repeat_length=ROWS)
    )
    weights = jnp.linalg.inv(spread.at[:LEGS, :LEGS].add(variance))
    corrected = measured.at[:LEGS].add(-bias)
    pose = _least_squares(stewart, pose, corrected, weights)
    jacobian = length_jacobian(stewart, pose)
    along = weights @ jacobian
    left = weights - along @ jnp.linalg.solve(jacobian.T @ along, along.T)
    off = corrected - stewart.inverse(pose)
    bias = bias + variance @ (weights @ off)[:LEGS]
    variance = variance - variance @ left[:LEGS, :LEGS] @ variance
    return pose, Learned(bias, (variance + variance.T) / 2 + DRIFT**2 * _unlearned(plant, bias).variance)


def _summed_up(reference: Reference, plant: Plant, size: float, sampled: Sampled, runs: tuple) -> Simulation:
    records, is_closed = runs
    time = plant.period * np.arange(sampled.legs.shape[0])
    off_position, off_rotation = _errors(records.pose, sampled.late)
    counts = time >= reference.settled_after
    rms = lambda off: jnp.sqrt(jnp.mean(off[:, counts] ** 2, axis=1))
    is_finite = jnp.all(jnp.isfinite(off_position), axis=1)
    settling = jnp.full(is_finite.shape, jnp.nan)
    if reference.settled_after == 0:
        # position and length() times rotation together
        off = np.hypot(np.asarray(off_position), size * np.asarray(off_rotation))
        settling = jnp.asarray(_settling_time(time, off))
    return Simulation(
        time=jnp.asarray(time),
        desired=sampled.late,
        pose=records.pose,
        estimate=records.estimate,
        legs=records.legs,
        command=records.command,
        position_error=off_position,
        rotation_error=off_rotation,
        rms_position=rms(off_position),
        rms_rotation=rms(off_rotation),
        settling_time=settling,
        status=jnp.where(is_closed & is_finite, Status.OK, Status.STALLED),
    )


@jax.jit
def _errors(pose: SE3, desired: SE3) -> tuple[jax.Array, jax.Array]:
    """Distances and angles between poses. -> (seeds, n) each"""
    turned = pose.rotation - desired.rotation  # |R - R'| = 2 sqrt(2) sin(angle / 2)
    half = safe.arcsin(jnp.sqrt(jnp.sum(turned**2, axis=(-2, -1)) / 8))
    return safe.norm(pose.translation - desired.translation), 2 * half


def _settling_time(time: np.ndarray, off: np.ndarray) -> np.ndarray:
    """From when on errors (seeds, n) stay within 2 % of what they were at first; NaN: never. -> (seeds,)"""
    is_off = ~(off <= SETTLED * off[:, :1])
    after = np.where(is_off, np.arange(time.size), -1).max(axis=1) + 1
    return np.where(after < time.size, time[np.minimum(after, time.size - 1)], np.nan)
