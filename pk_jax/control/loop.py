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
    checked_key,
    drawn,
    driven,
    read,
    weights_of,
    white_variances,
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
MEASURED = FEEDBACKS[2:]  # by all nine lengths
NEWTON_STEPS = 3  # a sample, from the last one's pose
DRIFT = 0.03  # of their spread: what constant errors may wander in a second, as the root of time
SETTLED = 0.02  # of the step
STAYS_FOR = 0.05  # of the run: the least time for which it must stay settled
CLEAR_ABOVE = 1e-2  # least singular value of the legs, without units, below which a run is lost
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
    settling_time: jax.Array  # (seeds,) s until it stays within 2 % of the step; NaN: never, no step
    status: jax.Array  # (seeds,) Status


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
                nine; "learned": the same, while a Kalman filter learns the constant errors of all nine
                encoders from how the lengths contradict one another along the way; it trusts the
                geometry of the sensors, and where that is off it may be worse than "nine"
    key:        of jax.random; seed i is drawn from `fold_in(key, i)`, whatever the number of seeds
    plant:      default `Plant()`
    gains:      default `Gains()`
    weights:    (9,) of "nine", 1 / variance; default: from what `plant` says of its errors, as "learned"
                has it, too: these two know the true variances, which no other feedback needs

    Pose feedback maps the error (v, w) to leg rates by the Jacobian at the estimate. The error is taken
    against the reference as late as a perfect actuator with this delay and lag would be, plant.delay
    samples and the lag, and the feed-forward is of the reference itself, so that an ideal plant follows it.

    A seed that is not OK has NaN in place of its poses, errors and times: SINGULAR where the machine came
    within 1e-2 of a type II singularity (its legs then no longer tell where the platform goes),
    STALLED where its loops would not close, NONFINITE where an estimate was lost. float64 only.
    """
    require_nine_rows("simulate_control", stewart)
    checks.is_word("feedback", feedback, FEEDBACKS)
    if not isinstance(reference, Reference):
        raise ValueError(
            f"reference must come from circle_reference or step_reference, got {type(reference).__name__}"
        )
    if not checks.is_concrete((stewart, weights)) or checks.is_staged():
        raise ValueError("simulate_control takes known values, call it outside of jit")
    if stewart.base.dtype != np.float64:
        raise ValueError(f"simulate_control needs float64 (pk_jax.enable_x64()), got {stewart.base.dtype}")
    plant = Plant() if plant is None else plant
    gains = Gains() if gains is None else gains
    key = checked_key(key)
    check_plant(plant)
    check_gains(gains)
    seeds = checks.is_count("seeds", seeds, most=100_000)
    method = method_for("simulate_control", stewart, None) if feedback in MEASURED else None
    weights = checks.real_array("weights", weights_of(plant) if weights is None else weights)
    checks.has_shape("weights", weights, (ROWS,))
    checks.is_positive("weights", weights)
    checks.is_finite("weights", weights)
    samples = round(min(reference.duration / plant.period, 1e18))
    if not 2 <= samples <= 10_000_000:
        raise ValueError(f"duration over period must be from 2 to 10,000,000 samples, got {samples}")
    numbers = 3 * samples * (42 * seeds + 30)  # a seed has two poses, legs, commands and errors a sample
    checks.fits(f"{samples} samples of {seeds} seeds", 8 * numbers, "take fewer, or a longer period")
    late = plant.delay * plant.period + plant.lag
    if not (late < reference.duration and reference.settled_after < (samples - 1) * plant.period):
        raise ValueError(
            f"the reference is over before it counts: {reference.duration:g} s, of which errors count from "
            f"{reference.settled_after:g} s on, sampled every {plant.period:g} s and {late:g} s late"
        )
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
    """Constant errors of the nine encoders, as far as they are known."""

    bias: jax.Array  # (9,)
    variance: jax.Array  # (9, 9)


def _unlearned(plant: Plant, dtype: Any) -> Learned:
    """What is known of the encoders before anything is measured."""
    variances = jnp.stack([plant.encoder_bias**2] * LEGS + [plant.sensor_bias**2] * (ROWS - LEGS))
    return Learned(jnp.zeros(ROWS, dtype), jnp.diag(variances).astype(dtype))


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
    is_clear: jax.Array  # () so far: no singularity came near


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
        learned=_unlearned(plant, legs.dtype),
        is_closed=jnp.asarray(True),
        is_clear=jnp.asarray(True),
    )

    def sample(state: _Loop, given):
        k, late, late_legs, rates = given
        pose = _newton(built, state.legs, state.pose)
        off = jnp.max(jnp.abs(built.inverse(pose)[:LEGS] - state.legs))
        is_closed = state.is_closed & (off <= CLOSED_TO * stewart.length())
        is_clear = state.is_clear & (_clearance(built, pose) > CLEAR_ABOVE)
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
        after = _Loop(
            legs, leg_rates, pose, waiting[1:], integral, error, estimate, learned, is_closed, is_clear
        )
        said = jax.tree.map(lambda leaf: leaf * jnp.nan, estimate) if feedback == "joint" else estimate
        return after, _Record(pose, said, state.legs, command)

    given = (jnp.arange(sampled.legs.shape[0]), sampled.late, sampled.legs, sampled.rates)
    state, records = lax.scan(sample, state, given)
    return records, state.is_closed, state.is_clear


def length_jacobian(stewart: Stewart, pose: SE3) -> jax.Array:
    """Rates of all lengths of a twist. -> (k, 6)"""
    unweighted = LengthErrors.of(stewart, jnp.ones(stewart.base.shape[0], stewart.base.dtype))
    return unweighted.linearize(pose, stewart.inverse(pose))[1]


def _clearance(stewart: Stewart, pose: SE3) -> jax.Array:
    """Lower bound of the least singular value of the legs, lengths over length(). -> ()"""
    rows = length_jacobian(stewart, pose)[:LEGS]
    inverse = jnp.linalg.inv(rows * jnp.where(jnp.arange(6) < 3, 1, 1 / stewart.length()))
    return 1 / jnp.sqrt(jnp.sum(inverse**2))


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
    """Pose and constant errors together: the pose free in every sample, the errors remembered.

    With S the covariance of what is read, the pose minimizes r^T S^-1 r; what is left of r then
    updates the errors as in a Kalman filter.
    """
    bias, variance = learned
    legs, sensors = white_variances(plant)
    spread = jnp.diag(jnp.stack([legs] * LEGS + [sensors] * (ROWS - LEGS)))
    weights = jnp.linalg.inv(spread + variance)
    corrected = measured - bias
    pose = _least_squares(stewart, pose, corrected, weights)
    jacobian = length_jacobian(stewart, pose)
    along = weights @ jacobian
    left = weights - along @ jnp.linalg.solve(jacobian.T @ along, along.T)
    bias = bias + variance @ weights @ (corrected - stewart.inverse(pose))
    variance = variance - variance @ left @ variance
    wander = DRIFT**2 * plant.period * _unlearned(plant, bias.dtype).variance
    return pose, Learned(bias, (variance + variance.T) / 2 + wander)


def _summed_up(reference: Reference, plant: Plant, size: float, sampled: Sampled, runs: tuple) -> Simulation:
    records, is_closed, is_clear = runs
    time = plant.period * np.arange(sampled.legs.shape[0])
    off_position, off_rotation = _errors(records.pose, sampled.late)
    is_finite = jnp.all(jnp.isfinite(records.command), axis=(1, 2)) & jnp.all(
        jnp.isfinite(off_position), axis=1
    )
    status = jnp.where(is_closed, Status.OK, Status.STALLED)
    status = jnp.where(is_clear, status, Status.SINGULAR)
    status = jnp.where(is_finite, status, Status.NONFINITE).astype(jnp.int32)
    is_ok = status == Status.OK
    masked = lambda leaf: jnp.where(is_ok.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, jnp.nan)
    counts = time >= reference.settled_after
    rms = lambda off: jnp.sqrt(jnp.mean(off[:, counts] ** 2, axis=1))
    settling = jnp.full(is_ok.shape, jnp.nan)
    if reference.settled_after == 0:
        # position and length() times rotation together
        off = np.hypot(np.asarray(off_position), size * np.asarray(off_rotation))
        settling = jnp.asarray(_settling_time(time, off))
    found = Simulation(
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
        status=status,
    )
    kept = jax.tree.map(masked, found._replace(time=None, desired=None, status=None))
    return kept._replace(time=found.time, desired=found.desired, status=status)


@jax.jit
def _errors(pose: SE3, desired: SE3) -> tuple[jax.Array, jax.Array]:
    """Distances and angles between poses. -> (seeds, n) each"""
    turned = pose.rotation - desired.rotation  # |R - R'| = 2 sqrt(2) sin(angle / 2)
    half = safe.arcsin(jnp.sqrt(jnp.sum(turned**2, axis=(-2, -1)) / 8))
    return safe.norm(pose.translation - desired.translation), 2 * half


def _settling_time(time: np.ndarray, off: np.ndarray) -> np.ndarray:
    """From when on errors (seeds, n) stay within 2 % of what they were at first, to the end; NaN: never.

    At least for a twentieth of the run: who crosses the band at the end has not settled. -> (seeds,)
    """
    is_off = ~(off <= SETTLED * off[:, :1])
    after = np.where(is_off, np.arange(time.size), -1).max(axis=1) + 1
    has_settled = after <= (1 - STAYS_FOR) * time.size
    return np.where(has_settled, time[np.minimum(after, time.size - 1)], np.nan)
