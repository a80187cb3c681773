"""A simulated control loop: what its sensors are worth, and that the simulation obeys its own physics."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import said_by
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax import Gains, Plant, Status
from pk_jax.control import loop
from pk_jax.control.loop import DRIFT
from pk_jax.control.plant import IDEAL, TINIEST, drawn, read, weights_of
from pk_jax.geometry import rotations


def ring(radius, degrees):
    angles = np.deg2rad(degrees)
    return radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)


BASE = np.concatenate([ring(1, [42, 138, 162, 258, 282, 18]), ring(0.6, [150, 270, 30])])
PLATFORM = np.concatenate(
    [ring(0.45368859, [80.48, 99.52, 200.48, 219.52, 320.48, 339.52]), ring(3**-0.5, [90, 210, 330])]
)
D3 = pk.Stewart(base=BASE, platform=PLATFORM)
KEY, SEEDS = jax.random.key(0), 20  # of 1500 samples: every other shape is compiled anew
FEEDBACKS = ("joint", "legs", "closed", "nine", "learned")
MICROMETRE = 1e-6

CIRCLE = pk.circle_reference(D3, radius=0.1)
STEP = pk.step_reference(D3, [0.03, -0.02, 0.02, 0.05, 0, 0.05], duration=1.5)
FROM_AFAR = CIRCLE._replace(start=STEP.pose_at(0.0))  # saturated at first, then moving along
REFERENCES = {
    "circle": CIRCLE,
    "quick circle": pk.circle_reference(D3, radius=0.02, frequency=2.0, tilt=0.02),
    "step": STEP,
    "from afar": FROM_AFAR,
}
SLOW = IDEAL._replace(period=2e-3)
BIASED = Plant(period=2e-3, encoder_bias=1e-4)
REAL = BIASED._replace(rate_limit=0.3, sensor_bias=3e-5, geometry_error=5e-5, sensor_geometry_error=2e-5)
ODD = Gains(kp=45.0, ki=30.0, kd=0.05, feed_forward=0.8)


pytestmark = pytest.mark.usefixtures("compiled_in_haste")


def on_numpy(tree):
    return jax.tree.map(np.asarray, tree)


def simulated(feedback, reference, plant, *, key=KEY, seeds=SEEDS, **given):
    return on_numpy(pk.simulate_control(D3, reference, feedback, key=key, plant=plant, seeds=seeds, **given))


@cache
def run(feedback, name, plant, gains=None):
    return simulated(feedback, REFERENCES[name], plant, gains=gains)


def rms(runs):
    return np.sqrt(np.mean(runs.rms_position**2))


def legs_of(pose, base=BASE, platform=PLATFORM):
    points = np.einsum("...ij,kj->...ki", pose.rotation, platform) + pose.translation[..., None, :]
    return np.linalg.norm(points - base, axis=-1)


def jacobian_of(pose):
    """Rates of the nine lengths of (v, w): u . v + (R b x u) . w."""
    arms = PLATFORM @ pose.rotation.T
    along = pose.translation + arms - BASE
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.concatenate([along, np.cross(arms, along)], axis=1)


def moved(pose, twist):
    """By (v, w), w = 2 tan(angle / 2) axis."""
    angle = 2 * np.arctan(np.linalg.norm(twist[3:]) / 2)
    axis = twist[3:] / max(np.linalg.norm(twist[3:]), 1e-300)
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    return pk.SE3(pose.translation + twist[:3], turn @ pose.rotation)


def between(pose, other):
    vector = Rotation.from_matrix(other.rotation @ pose.rotation.T).as_rotvec()
    angle = np.linalg.norm(vector)
    w = vector if angle < 1e-9 else vector / angle * 2 * np.tan(angle / 2)
    return np.concatenate([other.translation - pose.translation, w])


@jax.jit
def keys_of(seed):
    """Of the machine and of the noise."""
    return jax.random.split(jax.random.fold_in(KEY, seed))


draw = jax.jit(lambda key, plant: drawn(key, D3, plant))


def machine(seed, plant):
    """Geometry as built and errors of the encoders."""
    return on_numpy(draw(keys_of(seed)[0], plant))


@partial(jax.jit, static_argnums=1)
def noise_of(seed, samples):
    """Of unit variance. -> (samples, 9)"""
    one = lambda k: jax.random.normal(jax.random.fold_in(keys_of(seed)[1], k), (9,))
    return jax.vmap(one)(jnp.arange(samples))


# ---------------------------------------------------------------- what the sensors are worth


@pytest.mark.soak
def test_every_feedback_makes_an_ideal_platform_follow_the_late_circle():
    found = [run(feedback, "circle", SLOW) for feedback in FEEDBACKS]
    assert all(np.all(runs.status == Status.OK) for runs in found)
    errors = [rms(runs) for runs in found]
    assert max(errors) < 1.05 * min(errors) and max(errors) < 50 * MICROMETRE
    late = np.maximum(found[0].time - 2e-3 - 1e-2, 0)
    grown = np.clip(late, 0, 1) ** 3 * (10 - 15 * np.clip(late, 0, 1) + 6 * np.clip(late, 0, 1) ** 2)
    across = 0.1 * grown[:, None] * np.stack([np.cos(np.pi * late), np.sin(np.pi * late), 0 * late], axis=1)
    for runs in found:
        np.testing.assert_allclose(runs.desired.translation, across + [0, 0, 1], rtol=0, atol=1e-12)
        assert np.isnan(runs.settling_time).all()
    for runs in found[1:]:
        np.testing.assert_allclose(runs.estimate.translation, runs.pose.translation, rtol=0, atol=1e-9)
        np.testing.assert_allclose(runs.estimate.rotation, runs.pose.rotation, rtol=0, atol=1e-9)
    assert np.isnan(found[0].estimate.translation).all() and np.isnan(found[0].estimate.rotation).all()


@pytest.mark.parametrize("feedback", ["joint", "nine", "learned"])
def test_a_step_settles_within_150_ms(feedback):
    assert_settles(run(feedback, "step", IDEAL))


@pytest.mark.parametrize("twist", [[0.03, -0.02, 0.02, 0, 0, 0], [0, 0, 0, 0.05, 0, 0.05]])
def test_a_step_that_only_shifts_or_turns_settles(twist):
    assert_settles(simulated("joint", pk.step_reference(D3, twist, duration=1.5), Plant()))


def assert_settles(runs):
    """From then on within 2 % of the step, turns counted at the platform's radius."""
    assert np.all(runs.status == Status.OK)
    off = np.hypot(runs.position_error, 0.45368859 * runs.rotation_error)
    for settled, error in zip(runs.settling_time, off / off[:, :1], strict=True):
        assert 0.05 < settled < 0.15
        assert np.all(error[runs.time >= settled] <= 0.02) and error[runs.time < settled][-1] > 0.02


def test_an_error_that_comes_back_has_not_settled():
    off = np.array(
        [[5, 0.05, 1, 0.1, 0.1], [5, 0.05, 1, 0.1, 0.101], [5, 0.1, 0, 0, 0], [5, 0, 0, np.nan, 0]]
    )
    found = loop._settling_time(np.arange(5.0), off)
    np.testing.assert_array_equal(found, [3, np.nan, 1, 4])


def test_nine_lengths_see_more_of_the_encoders_errors_than_six():
    joint, nine, learned = (rms(run(f, "circle", BIASED)) for f in ("joint", "nine", "learned"))
    assert nine < 0.7 * joint
    assert learned < 0.3 * joint


@pytest.mark.soak
def test_six_legs_see_no_more_than_the_joints_do():
    joint, legs = (rms(run(f, "circle", BIASED)) for f in ("joint", "legs"))
    assert abs(legs / joint - 1) < 0.02


def test_a_filter_finds_the_encoders_errors_while_the_least_squares_do_not():
    """Errors of the estimate early in the circle and late."""
    off = {}
    for feedback in ("nine", "learned"):
        runs = run(feedback, "circle", BIASED)
        off[feedback] = np.linalg.norm(runs.estimate.translation - runs.pose.translation, axis=-1)
    early, late = slice(10), slice(-100, None)
    rms_of = lambda values: np.sqrt(np.mean(values**2))
    np.testing.assert_allclose(rms_of(off["learned"][:, :1]), rms_of(off["nine"][:, :1]), rtol=1e-3)
    assert rms_of(off["learned"][:, late]) < 0.35 * rms_of(off["learned"][:, early])
    assert rms_of(off["nine"][:, late]) > 0.7 * rms_of(off["nine"][:, early])


@pytest.mark.parametrize(("feedback", "rows"), [("joint", 6), ("nine", 9)])
def test_the_covariance_of_a_pose_predicts_the_mean_square(feedback, rows):
    runs = run(feedback, "circle", BIASED)
    known = pk.Stewart(base=BASE[:rows], platform=PLATFORM[:rows])
    at = jax.tree.map(lambda leaf: jnp.asarray(leaf[750::50]), runs.desired)
    covariance = pk.pose_covariance(known, at, weights_of(BIASED)[:rows])
    squares = np.mean(np.trace(covariance, axis1=1, axis2=2)), runs.rms_position**2 + runs.rms_rotation**2
    assert abs(np.mean(squares[1]) - squares[0]) < 2 * np.std(squares[1]) / np.sqrt(SEEDS)


def test_joints_stand_off_by_the_errors_of_their_encoders():
    runs = run("joint", "circle", BIASED)
    off = np.mean((runs.legs - legs_of(runs.desired)[:, :6])[:, 750:], axis=1)
    bias = np.array([machine(seed, BIASED).bias[:6] for seed in range(SEEDS)])
    np.testing.assert_allclose(off, -bias, rtol=0, atol=3 * MICROMETRE)
    assert 0.8 < np.std(bias) / 1e-4 < 1.2


def test_a_weighted_estimate_stands_off_by_what_least_squares_make_of_the_errors():
    runs, weights = run("nine", "circle", BIASED), np.diag(weights_of(BIASED))
    for seed in (0, 7, 19):
        bias = machine(seed, BIASED).bias
        for k in (800, 1100, 1400):
            j = jacobian_of(runs.desired[k])
            expected = -np.linalg.solve(j.T @ weights @ j, j.T @ weights @ bias)
            found = between(runs.desired[k], runs.pose[seed, k])
            np.testing.assert_allclose(found, expected, rtol=0, atol=0.1 * np.abs(expected).max() + 1e-5)


@pytest.mark.soak
def test_sensors_of_no_weight_leave_six_legs():
    weights = [1.0] * 6 + [1e-14] * 3
    nine = simulated("nine", CIRCLE, BIASED, weights=weights)
    legs = run("legs", "circle", BIASED)
    np.testing.assert_allclose(nine.pose.translation, legs.pose.translation, rtol=0, atol=1e-8)


# ---------------------------------------------------------------- the loop, written again


def estimated(feedback, pose, measured, state, plant):
    """Pose and constant errors of the encoders that minimize the weighted squares, by Gauss-Newton."""
    reading = plant.noise**2 + plant.quantum**2 / 12 + TINIEST**2
    legs = reading + 2 * plant.geometry_error**2
    sensors = reading + 2 * plant.sensor_geometry_error**2
    if feedback == "legs":
        for _ in range(4):
            j = jacobian_of(pose)[:6]
            pose = moved(pose, np.linalg.solve(j, measured[:6] - legs_of(pose)[:6]))
        return pose, state
    if feedback == "nine":
        weights = 1 / np.array([legs + plant.encoder_bias**2] * 6 + [sensors + plant.sensor_bias**2] * 3)
        for _ in range(4):
            j = jacobian_of(pose) * weights[:, None]
            pose = moved(pose, np.linalg.solve(j.T @ jacobian_of(pose), j.T @ (measured - legs_of(pose))))
        return pose, state
    mean, variance = state  # of nine errors, known before with this variance
    errors, weights = mean.copy(), np.diag(1 / np.array([legs] * 6 + [sensors] * 3))
    for _ in range(4):
        j = np.concatenate([jacobian_of(pose), np.eye(9)], axis=1)
        prior = np.zeros((15, 15))
        prior[6:, 6:] = np.linalg.inv(variance)
        off = measured - legs_of(pose) - errors
        right = j.T @ weights @ off + prior @ np.append(np.zeros(6), mean - errors)
        information = j.T @ weights @ j + prior
        step = np.linalg.solve(information, right)
        pose, errors = moved(pose, step[:6]), errors + step[6:]
    variance = np.linalg.inv(information)[6:, 6:] + DRIFT**2 * plant.period * prior_of(plant)
    return pose, (errors, variance)


def prior_of(plant):
    return np.diag(np.repeat([plant.encoder_bias**2, plant.sensor_bias**2], [6, 3]))


def again(feedback, reference, plant, gains, seed, samples):
    """Lengths of the legs, commands and estimates of one run, in NumPy."""
    noise = plant.noise * np.asarray(noise_of(seed, samples))
    built, bias = machine(seed, plant)
    times = plant.period * np.arange(samples + 1)
    desired = on_numpy(
        jax.vmap(reference.pose_at)(np.maximum(times - plant.delay * plant.period - plant.lag, 0))
    )
    ahead = np.diff(legs_of(on_numpy(jax.vmap(reference.pose_at)(times)))[:, :6], axis=0) / plant.period
    estimate = pose = on_numpy(reference.start)
    legs, rates, integral, error = legs_of(pose)[:6], np.zeros(6), np.zeros(6), None
    state, waiting = (np.zeros(9), prior_of(plant)), [np.zeros(6)] * plant.delay
    records, decay = [], np.exp(-plant.period / plant.lag)
    for k in range(samples):
        for _ in range(0 if feedback == "joint" else 4):
            off = legs - legs_of(pose, built.base, built.platform)[:6]
            pose = moved(pose, np.linalg.solve(jacobian_of(pose)[:6], off))
        true = np.append(legs, legs_of(pose, built.base, built.platform)[6:])
        measured = true + bias + noise[k]
        measured = plant.quantum * np.round(measured / plant.quantum)
        late, last = desired[k], error
        if feedback == "joint":
            error = legs_of(late)[:6] - measured[:6]
        else:
            estimate, state = estimated(feedback, estimate, measured, state, plant)
            error = jacobian_of(estimate)[:6] @ between(estimate, late)
        wanted = gains.feed_forward * ahead[k] + gains.kp * error + gains.ki * integral
        if last is not None:
            wanted = wanted + gains.kd * (error - last) / plant.period
        command = np.clip(wanted, -plant.rate_limit, plant.rate_limit)
        helps = (command == wanted) | (np.sign(wanted) != np.sign(error))
        integral = integral + np.where(helps, error * plant.period, 0)
        records.append((legs, command, estimate.translation, estimate.rotation))
        waiting.append(command)
        late_command = waiting.pop(0)
        legs = legs + late_command * plant.period + (rates - late_command) * plant.lag * (1 - decay)
        rates = late_command + (rates - late_command) * decay
    return [np.array(record) for record in zip(*records, strict=True)]


@pytest.mark.parametrize(
    ("feedback", "samples"),
    [("joint", 150), pytest.param("legs", 80, marks=pytest.mark.soak), ("nine", 80), ("learned", 80)],
)
def test_the_loop_is_one_written_by_hand(feedback, samples):
    runs = run(feedback, "from afar", REAL, ODD)
    for seed in (13,):
        legs, command, *estimate = again(feedback, FROM_AFAR, REAL, ODD, seed, samples)
        np.testing.assert_allclose(runs.legs[seed, :samples], legs, rtol=0, atol=1e-9)
        np.testing.assert_allclose(runs.command[seed, :samples], command, rtol=0, atol=1e-6)
        is_limited = np.abs(command) == 0.3
        assert is_limited[:5].any() and not is_limited[-5:].any()
        if feedback != "joint":
            for found, expected in zip(jax.tree.leaves(runs.estimate), estimate, strict=True):
                np.testing.assert_allclose(found[seed, :samples], expected, rtol=0, atol=1e-8)


# ---------------------------------------------------------------- the platform's own physics


@pytest.mark.parametrize("feedback", ["joint", "nine"])
def test_the_recorded_legs_are_those_of_the_recorded_poses(feedback):
    runs = run(feedback, "from afar", REAL, ODD)
    assert np.all(runs.status == Status.OK)
    for seed in (0, 1, 19):
        built = machine(seed, REAL).stewart
        legs = legs_of(runs.pose[seed], built.base, built.platform)[:, :6]
        np.testing.assert_allclose(runs.legs[seed], legs, rtol=0, atol=1e-10)
        assert np.abs(legs_of(runs.pose[seed])[:, :6] - legs).max() > 1e-5


def test_every_feedback_meets_the_same_machines():
    first = run("joint", "from afar", REAL, ODD)
    for feedback in ("nine", "learned"):
        other = run(feedback, "from afar", REAL, ODD)
        np.testing.assert_allclose(
            other.pose.translation[:, :2], first.pose.translation[:, :2], rtol=0, atol=1e-14
        )
    spread = np.std(first.pose.translation[:, 0], axis=0)
    assert np.all(spread > 1e-5) and np.all(spread < 1e-3)
    np.testing.assert_allclose(
        first.legs[:, 0], legs_of(FROM_AFAR.start)[None, :6].repeat(SEEDS, 0), atol=1e-15
    )


@pytest.mark.parametrize("case", [("from afar", REAL, ODD), ("step", IDEAL, None)])
def test_legs_advance_as_a_late_first_order_lag_of_the_commands(case):
    plant, runs = case[1], run("joint", *case)
    legs, rate, decay = runs.legs[:, 0], 0.0, np.exp(-plant.period / plant.lag)
    for k in range(400):
        np.testing.assert_allclose(runs.legs[:, k], legs, rtol=0, atol=1e-12)
        command = runs.command[:, k - 1] if k else 0.0
        legs = legs + command * plant.period + (rate - command) * plant.lag * (1 - decay)
        rate = command + (rate - command) * decay
    np.testing.assert_array_equal(runs.legs[:, 1], runs.legs[:, 0])
    assert np.all(runs.legs[:, 2] != runs.legs[:, 0])


def test_no_leg_is_faster_than_its_limit():
    runs = run("joint", "from afar", REAL, ODD)
    assert np.abs(runs.command).max() == 0.3
    rates = np.abs(np.diff(runs.legs, axis=1)) / REAL.period
    assert 0.29 < rates.max() <= 0.3 * (1 + 1e-9)


def test_readings_are_multiples_of_the_quantum_off_by_noise_and_bias():
    keys, lengths = jax.random.split(jax.random.key(3), 2), np.linspace(0.9, 1.3, 100_000)
    bias = np.full_like(lengths, 5e-5)
    said = np.asarray(read(keys[0], lengths, bias, Plant(noise=1e-5, quantum=4e-6)))
    np.testing.assert_allclose(said / 4e-6, np.round(said / 4e-6), rtol=0, atol=1e-6)
    off = said - lengths - bias
    assert abs(np.mean(off)) < 4 * 1e-5 / np.sqrt(lengths.size)
    np.testing.assert_allclose(np.var(off), 1e-10 + 4e-6**2 / 12, rtol=0.02)
    other = read(keys[1], lengths, bias, Plant(noise=1e-5, quantum=4e-6)) - lengths - bias
    assert abs(np.corrcoef(off, other)[0, 1]) < 0.02
    np.testing.assert_array_equal(read(keys[0], lengths, bias, IDEAL), lengths + bias)
    exact = read(keys[0], lengths, 0 * bias, IDEAL._replace(quantum=1e-3))
    np.testing.assert_allclose(exact, np.round(lengths, 3), rtol=0, atol=1e-12)


def test_machines_are_drawn_with_the_errors_that_the_plant_tells():
    plant = Plant(encoder_bias=1.0, sensor_bias=2.0, geometry_error=3.0, sensor_geometry_error=5.0)
    many = jax.vmap(lambda key: draw(key, plant))(jax.random.split(KEY, 3000))
    for values, legs, sensors in (
        (many.bias[..., None], 1, 2),
        (many.stewart.base - BASE, 3, 5),
        (many.stewart.platform - PLATFORM, 3, 5),
    ):
        expected = np.repeat([legs, sensors], [6, 3])[:, None] + np.zeros(values.shape[1:])
        np.testing.assert_allclose(np.std(values, axis=0), expected, rtol=0.06)
        assert np.all(np.abs(np.mean(values, axis=0)) < 4 * expected / np.sqrt(3000))
    together = np.concatenate([np.reshape(leaf, (3000, -1)) for leaf in jax.tree.leaves(many)], axis=1)
    assert np.abs(np.corrcoef(together.T) - np.eye(63)).max() < 0.1
    exact = draw(KEY, IDEAL)
    assert not np.any(exact.bias) and np.array_equal(exact.stewart.base, BASE)


# ---------------------------------------------------------------- seeds and keys


def test_one_key_gives_the_same_bits_and_another_one_others():
    first = run("joint", "circle", BIASED)
    for key, is_same in ((KEY, True), (jax.random.key(1), False)):
        other = simulated("joint", CIRCLE, BIASED, key=key)
        assert np.array_equal(other.legs, first.legs) == is_same
    assert not np.any(np.isin(other.rms_position, first.rms_position))


# ---------------------------------------------------------------- gains


@pytest.mark.parametrize("gains", [(40.0, 0.0, 0.0, 0.0), (40.0, 200.0, 0.6, 0.0), (30.0, 100.0, 0.0, 0.5)])
def test_the_error_at_the_circles_frequency_is_that_of_the_transfer_function(gains):
    """In leg lengths the loop is linear: C = kp + ki/s + kd s, G = exp(-1.5 T s) / (s (1 + lag s))."""
    kp, ki, kd, forward = gains
    runs = run("joint", "quick circle", SLOW, Gains(*gains))
    s, period, lag = 4j * np.pi, SLOW.period, SLOW.lag
    g = np.exp(-1.5 * period * s) / (s * (1 + lag * s))
    late = np.exp(-(period + lag) * s)
    ahead = np.exp(0.5 * period * s) * s / late  # mean rates to the next sample, of the late reference
    expected = 1 - (kp + ki / s + kd * s + forward * ahead) * g / (1 + (kp + ki / s + kd * s) * g)
    wave = np.exp(-s * runs.time[1000:])[:, None]  # two turns
    desired = legs_of(runs.desired)[:, :6]
    found = np.sum(wave * (desired - runs.legs[0])[1000:], axis=0) / np.sum(wave * desired[1000:], axis=0)
    np.testing.assert_allclose(found, np.full(6, expected), rtol=0, atol=0.02 * abs(expected))


def test_without_gains_nothing_moves_and_feed_forward_alone_is_blind():
    still = run("joint", "circle", BIASED, Gains(0.0, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(still.legs, still.legs[:, :1] + 0 * still.legs)
    blind = run("joint", "circle", BIASED, Gains(0.0, 0.0, 0.0, 1.0))
    np.testing.assert_array_equal(blind.legs, np.broadcast_to(blind.legs[:1], blind.legs.shape))
    assert rms(blind) < 200 * MICROMETRE


def overshoot(gains):
    """How far legs go beyond their ends, of a step that takes them most of a second."""
    runs = run("joint", "step", IDEAL._replace(rate_limit=0.1), gains)
    end = legs_of(runs.desired)[-1, :6]
    way = np.sign(end - runs.legs[0, 0])
    return np.max(way * (runs.legs[0] - end))


def test_the_integral_winds_up_unless_it_is_held():
    held, wound = (overshoot(Gains(ki=200.0, anti_windup=is_held)) for is_held in (True, False))
    assert held < 1e-3 and wound > 1e-2


# ---------------------------------------------------------------- nothing late, nothing in reach


def test_without_errors_and_lag_every_sample_is_on_the_late_reference():
    runs = run("joint", "circle", SLOW._replace(lag=0.0))
    assert np.all(runs.status == Status.OK)
    assert runs.position_error.max() < 1e-10 and runs.rotation_error.max() < 1e-9


@pytest.mark.soak
def test_without_a_delay_a_gain_of_one_over_the_period_forgets_all_but_the_last_reading():
    """Each leg is where the last reading says; seed i is drawn the same whatever the number of seeds."""
    plant = Plant(delay=0, lag=0.0, quantum=0.0, rate_limit=100.0, encoder_bias=1e-4)
    step = STEP._replace(duration=0.05)
    runs = simulated("joint", step, plant, gains=Gains(kp=1e3, ki=0.0), seeds=3)
    assert runs.pose.rotation.shape == (3, 50, 3, 3) and runs.rms_position.shape == (3,)
    assert np.all(runs.status == Status.OK) and np.all(runs.settling_time == 1e-3)
    for seed in range(3):
        said = machine(seed, plant).bias + 1e-5 * np.asarray(noise_of(seed, 50))
        expected = legs_of(runs.desired)[1:, :6] - said[:-1, :6]
        np.testing.assert_allclose(runs.legs[seed, 1:], expected, rtol=0, atol=1e-12)


def test_a_path_through_a_singularity_is_not_followed():
    at = CIRCLE.start

    def turned(time):
        return pk.SE3(at.translation, rotations.about(2, 1.1 * time * jnp.clip(time, 0, 1)) @ at.rotation)

    yaw = CIRCLE._replace(pose_at=turned)  # over 90 degrees all legs touch one linear complex (Fichter 1986)
    runs = simulated("joint", yaw, SLOW)
    assert np.all(runs.status == Status.SINGULAR)
    assert np.all(np.isnan(runs.pose.translation)) and np.all(np.isnan(runs.rms_position))


def test_what_is_not_a_number_is_not_ok():
    start = pk.SE3(jnp.asarray([0, 0, np.nan]), jnp.eye(3))
    runs = simulated("joint", CIRCLE._replace(start=start), SLOW)
    assert np.all(runs.status == Status.NONFINITE) and np.isnan(runs.rms_position).all()


# ---------------------------------------------------------------- references


def rates(reference, times):
    """Position, velocity and acceleration of the translation and of the rotation matrix."""
    flat = lambda t: jnp.append(reference.pose_at(t).translation, reference.pose_at(t).rotation)
    first = jax.jacfwd(flat)
    all_three = jax.jit(jax.vmap(lambda t: jnp.stack([flat(t), first(t), jax.jacfwd(first)(t)])))
    return np.asarray(all_three(jnp.asarray(times)))


def test_a_circle_starts_at_rest_and_is_smooth():
    circle = pk.circle_reference(D3, radius=0.2, frequency=0.8, tilt=0.3, ramp=0.7, duration=2.0)
    start = np.append(circle.start.translation, circle.start.rotation)
    first, before, after = rates(circle, [0.0, 0.7 - 1e-7, 0.7 + 1e-7])
    np.testing.assert_allclose(first, [start, 0 * start, 0 * start], rtol=0, atol=1e-12)
    np.testing.assert_allclose(before, after, rtol=0, atol=2e-4)
    assert np.abs(after[2]).max() > 1
    assert circle.duration == 2.0 and circle.settled_after == 1.2
    assert pk.circle_reference(D3, radius=0.2, ramp=0.7, duration=1.1).settled_after == pytest.approx(0.9)


def test_a_circle_has_its_radius_its_frequency_and_its_tilt():
    start = pk.SE3([0.1, -0.1, 0.9], Rotation.from_rotvec([0, 0.2, 0.1]).as_matrix())
    circle = pk.circle_reference(D3, radius=0.2, frequency=0.8, tilt=0.3, centre=start, ramp=0.7, duration=2)
    for time in (0.7, 1.0, 1.9):
        phase, pose = 2 * np.pi * 0.8 * time, circle.pose_at(time)
        around = [0.2 * np.cos(phase), 0.2 * np.sin(phase), 0]
        np.testing.assert_allclose(pose.translation - start.translation, around, rtol=0, atol=1e-12)
        turn = Rotation.from_matrix(pose.rotation @ start.rotation.T).as_rotvec()
        np.testing.assert_allclose(turn, [0.3 * np.sin(phase), 0, 0], rtol=0, atol=1e-12)


def test_a_step_goes_to_its_target_at_once():
    twist = np.array([0.1, 0.2, -0.1, 0.3, -0.2, 0.1])
    start = pk.SE3([0.1, -0.1, 0.9], Rotation.from_rotvec([0, 0.2, 0.1]).as_matrix())
    step = pk.step_reference(D3, twist.tolist(), centre=start, duration=0.3)
    for time in (0.0, 0.2):
        np.testing.assert_allclose(between(start, on_numpy(step.pose_at(time))), twist, rtol=0, atol=1e-12)
    assert step.start is start and step.duration == 0.3 and step.settled_after == 0


# ---------------------------------------------------------------- weights, refusals


def test_weights_are_one_over_the_variances_of_all_that_a_plant_says():
    plant = Plant(noise=3e-5, quantum=2e-5, encoder_bias=1e-4)
    plant = plant._replace(sensor_bias=5e-5, geometry_error=7e-5, sensor_geometry_error=2e-5)
    reading = 9e-10 + 4e-10 / 12
    expected = [reading + 1e-8 + 2 * 49e-10] * 6 + [reading + 25e-10 + 2 * 4e-10] * 3
    np.testing.assert_allclose(1 / weights_of(plant), expected, rtol=1e-6)
    np.testing.assert_allclose(weights_of(IDEAL), np.full(9, 1 / TINIEST**2), rtol=1e-12)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"radius": -0.1}, "radius must be positive and finite, got -0.1"),
        ({"frequency": 0}, "frequency must be positive and finite, got 0"),
        ({"tilt": np.inf}, "tilt must be finite, got inf"),
        ({"ramp": np.nan}, "ramp must be positive and finite, got nan"),
        ({"duration": -1.0}, "duration must be positive and finite, got -1.0"),
        ({"ramp": 3.0}, "duration must be more than the ramp, 3.0 s, got 3.0"),
        ({"centre": np.zeros(3)}, "centre must be a pk_jax.SE3, got ndarray"),
    ],
)
def test_circles_that_are_none_are_refused(given, said):
    assert said_by(pk.circle_reference, D3, **{"radius": 0.1, **given}) == said


@pytest.mark.parametrize(
    ("twist", "given", "said"),
    [
        ([0.0] * 6, {}, "twist must not be zero"),
        ([0.1] * 5, {}, "twist must have shape (6,), got (5,)"),
        ([0.1] * 5 + [np.nan], {}, "twist must be finite"),
        ([0.1] * 6, {"duration": 0}, "duration must be positive and finite, got 0"),
        ([0.1] * 6, {"centre": [0, 0, 1]}, "centre must be a pk_jax.SE3, got list"),
    ],
)
def test_steps_that_are_none_are_refused(twist, given, said):
    assert said_by(pk.step_reference, D3, twist, **given).startswith(said)


def test_references_are_for_platforms_in_space():
    planar = pk.TwoRPR(half_base=1.0, l_min=0.5, l_max=2.0)
    for make, given in ((pk.circle_reference, {"radius": 0.1}), (pk.step_reference, {"twist": [0.1] * 6})):
        assert said_by(make, planar, **given) == "a reference is for platforms in space, got TwoRPR"


BAD_PLANTS = [(name, value) for name in Plant._fields for value in (-1.0, np.nan, np.inf, "1", None, True)]
BAD_PLANTS += [("period", 0.0), ("rate_limit", 0), ("delay", 0.5), ("delay", 1001)]


def refused(**given):
    arguments = {"stewart": D3, "reference": CIRCLE, "feedback": "joint", "key": KEY}
    return said_by(pk.simulate_control, **{**arguments, **given})


@pytest.mark.parametrize(("name", "value"), BAD_PLANTS)
def test_plants_that_cannot_be_are_refused(name, value):
    assert refused(plant=Plant()._replace(**{name: value})).startswith(f"plant.{name} must be ")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"stewart": pk.catalogued("semi-regular-stewart")},
            "simulate_control takes a Stewart with nine rows",
        ),
        ({"stewart": BASE}, "simulate_control takes a pk_jax.Stewart, got ndarray"),
        ({"reference": D3.home()[0]}, "reference must come from circle_reference or step_reference, got SE3"),
        ({"feedback": "six"}, "feedback must be one of joint, legs, closed, nine, learned, got 'six'"),
        ({"plant": {"noise": 1}}, "plant must be a pk_jax.Plant, got dict"),
        ({"gains": (40, 20)}, "gains must be a pk_jax.Gains, got tuple"),
        ({"plant": 0}, "plant must be a pk_jax.Plant, got int"),
        ({"gains": ""}, "gains must be a pk_jax.Gains, got str"),
        ({"gains": Gains(kp="40")}, "gains.kp must be finite, got '40'"),
        ({"gains": Gains(kd=None)}, "gains.kd must be finite, got None"),
        ({"gains": Gains(anti_windup="yes")}, "gains.anti_windup must be true or false, got 'yes'"),
        ({"key": 0}, "key must be one key of jax.random"),
        ({"key": None}, "key must be one key of jax.random"),
        ({"weights": np.full(9, np.inf)}, "weights must be finite"),
        ({"plant": Plant(delay=2990)}, "plant.delay must be a whole number of samples up to 1000"),
        ({"plant": Plant(lag=3.0)}, "the reference is over before it counts"),
        ({"plant": Plant(period=1.4)}, "the reference is over before it counts"),
        ({"gains": Gains(kp=np.nan)}, "gains.kp must be finite, got nan"),
        ({"gains": Gains(feed_forward=np.inf)}, "gains.feed_forward must be finite, got inf"),
        ({"seeds": 0}, "seeds must be an integer from 1 to 100000, got 0"),
        ({"seeds": 2.0}, "seeds must be an integer from 1 to 100000, got 2.0"),
        ({"weights": np.ones(6)}, "weights must have shape (9,), got (6,)"),
        ({"weights": np.zeros(9)}, "weights must be positive"),
        ({"plant": Plant(period=4.0)}, "duration over period must be from 2 to 10,000,000 samples, got 1"),
    ],
)
def test_loops_that_cannot_be_closed_are_refused(given, said):
    assert refused(**given).startswith(said)
