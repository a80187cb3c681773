"""What three length sensors are worth: rank, conditioning and noise of a layout, and where to put them."""

from functools import partial

import jax
import numpy as np
import pytest
from refusals import said_by
from test_nine_lengths import (
    BOTH,
    GENERAL,
    PLANAR,
    at_random,
    error_of,
    flat,
    lengths_of,
    on_edges,
    paired,
    place,
    rng_of,
    some_layout,
    some_platform,
    some_poses,
    stage_at,
    stage_condition,
    take,
    tangent,
)

import pk_jax as pk
from pk_jax import Status
from pk_jax.kinematics.closed_form import closed_form

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

NAN, INF = np.nan, np.inf
SINGULAR, RANK = paired(rng_of(11)), 3  # legs in pairs, sensors on the lines through their feet


def jacobian_of(platform, pose):
    """d |leg| / d (v, w) in NumPy, rows the unit vectors and their moments about the platform's origin."""
    arms = np.einsum("...ij,kj->...ki", np.asarray(pose.rotation), np.asarray(platform.platform))
    legs = np.asarray(pose.translation)[..., None, :] + arms - np.asarray(platform.base)
    unit = legs / np.linalg.norm(legs, axis=-1, keepdims=True)
    return np.concatenate([unit, np.cross(arms, unit)], axis=-1)


@partial(jax.jit, static_argnums=2)
def closed(stage, lengths, method):
    return jax.vmap(lambda row: closed_form(stage, row, method)[0])(lengths)


def gain_of(covariance):
    return [np.sqrt(np.trace(covariance[..., s, s], axis1=-2, axis2=-1)) for s in (slice(3), slice(3, 6))]


# ---------------------------------------------------------------- layouts


@BOTH
def test_a_layout_says_what_it_is(embodiment):
    base, level, k, _ = some_layout(rng_of(31, embodiment), embodiment, most=100)
    found = pk.sensor_layout(pk.Stewart(base=base, platform=level))
    assert found.kind == {GENERAL: "general base", PLANAR: "planar base"}[embodiment]
    assert found.rank == 6 and found.reason is None
    assert found.singular_values.shape == (6,) and np.all(np.diff(found.singular_values) <= 0)
    np.testing.assert_allclose(found.condition, stage_condition(base, on_edges(k)), rtol=1e-9)
    np.testing.assert_allclose(
        found.condition, found.singular_values[0] / found.singular_values[-1], rtol=1e-12
    )


@BOTH
def test_a_layout_does_not_hang_on_frames_or_units(embodiment):
    rng = rng_of(32, embodiment)
    base, level, _, _ = some_layout(rng, embodiment, most=100)
    found = pk.sensor_layout(pk.Stewart(base=base, platform=level))
    ground, tool = (some_poses(rng, 1, tilt=180)[0] for _ in range(2))
    for unit in (1.0, 1e3, 1e-6):
        other = pk.sensor_layout(
            pk.Stewart(base=unit * place(ground, base), platform=unit * place(tool, level))
        )
        assert (other.kind, other.rank, other.reason) == (found.kind, 6, None)
        np.testing.assert_allclose(other.singular_values, found.singular_values, rtol=1e-9)


def test_a_singular_layout_has_its_rank_and_a_reason():
    base, inside = SINGULAR
    found = pk.sensor_layout(pk.Stewart(base=base, platform=flat(inside)))
    assert found.rank == RANK and f"rank {RANK} of 6" in found.reason
    assert not found.condition < 1e12


def test_joints_off_the_plane_are_the_reason():
    base, inside = at_random(rng_of(33))
    platform = flat(inside)
    platform[2, 2] = 0.05
    assert "Stewart.platform[2]" in pk.sensor_layout(pk.Stewart(base=base, platform=platform)).reason


def test_sensors_on_a_line_are_the_reason():
    base, inside = at_random(rng_of(34))
    inside[8] = 2 * inside[7] - inside[6]
    assert "one line" in pk.sensor_layout(pk.Stewart(base=base, platform=flat(inside))).reason


# ---------------------------------------------------------------- noise


@pytest.fixture(scope="module", params=[GENERAL, PLANAR], ids=["general", "planar"])
def placed(request):
    rng = rng_of(35, request.param)
    return some_platform(rng, request.param, most=30), some_poses(rng, 4, tilt=25), rng.uniform(0.2, 5, 9)


def test_the_covariance_is_that_of_least_squares(placed):
    platform, poses, weights = placed
    jacobian = jacobian_of(platform, poses)
    expected = np.linalg.inv(np.swapaxes(jacobian, -1, -2) @ (weights[:, None] * jacobian))
    np.testing.assert_allclose(pk.pose_covariance(platform, poses, weights), expected, rtol=1e-8, atol=1e-12)


def test_the_gain_of_the_estimate_is_that_of_its_covariance(placed):
    platform, poses, weights = placed
    found = pk.noise_gains(platform, poses, weights).estimate
    np.testing.assert_allclose(
        found, gain_of(np.asarray(pk.pose_covariance(platform, poses, weights))), rtol=1e-12
    )


def test_the_gain_of_six_legs_is_that_of_their_inverse(placed):
    platform, poses, weights = placed
    inverse = np.linalg.inv(jacobian_of(platform, poses)[:, :6])
    expected = gain_of(inverse / weights[:6] @ np.swapaxes(inverse, -1, -2))
    np.testing.assert_allclose(pk.noise_gains(platform, poses, weights).legs, expected, rtol=1e-9)


def test_the_gain_of_the_closed_form_is_that_of_differences(placed):
    platform, poses, weights = placed
    h = 1e-6
    at = np.repeat(lengths_of(platform, poses), 18, axis=0)
    at += np.tile(np.concatenate([h * np.eye(9), -h * np.eye(9)]), (4, 1))
    method = "products" if np.any(np.asarray(platform.base)[:, 2]) else "linear"
    ends = closed(stage_at(platform), at, method)
    moved = tangent(take(poses, np.repeat(np.arange(4), 18)), ends).reshape(4, 2, 9, 6)
    jacobian = np.swapaxes(moved[:, 0] - moved[:, 1], 1, 2) / (2 * h)
    expected = gain_of(jacobian / weights @ np.swapaxes(jacobian, 1, 2))
    np.testing.assert_allclose(pk.noise_gains(platform, poses, weights).closed_form, expected, rtol=1e-4)


def test_the_sensors_pay_only_by_least_squares():
    """Medians over random layouts: 1.6 for the estimate, 4 to 5 for the closed form and for six legs."""
    rng = rng_of(36)
    gains = []
    for embodiment in 25 * (GENERAL, PLANAR):
        found = pk.noise_gains(some_platform(rng, embodiment), some_poses(rng, 4))
        gains.append([getattr(found, name).position for name in found._fields])
    estimate, closed, legs = np.median(np.asarray(gains).swapaxes(0, 1).reshape(3, -1), axis=1)
    assert estimate <= 2.0 < 3.0 < min(closed, legs)


@pytest.mark.soak
def test_the_covariance_is_that_of_the_answer():
    for embodiment in (GENERAL, PLANAR):
        rng = rng_of(37, embodiment)
        platform, poses = some_platform(rng, embodiment, most=100), some_poses(rng, 4)
        weights = rng.uniform(0.2, 5, 9)
        found = pk.nine_length_pose(platform, lengths_of(platform, poses), weights)
        expected = pk.pose_covariance(platform, poses, weights)
        np.testing.assert_allclose(found.covariance, expected, rtol=1e-7, atol=1e-10)


def test_gains_take_one_pose_or_many(placed):
    platform, poses, _ = placed
    many = pk.pose_covariance(platform, poses)
    assert many.shape == (4, 6, 6)
    np.testing.assert_allclose(pk.pose_covariance(platform, poses[1]), many[1], rtol=1e-9, atol=1e-12)


# ---------------------------------------------------------------- placement


@pytest.fixture(scope="module")
def workspace():
    rng = rng_of(38)
    platform = some_platform(rng, PLANAR, most=100)
    return platform, some_poses(rng, 4, tilt=20)


@pytest.fixture(scope="module")
def placement(workspace):
    poses = some_poses(rng_of(39), 4, tilt=20)
    return pk.place_sensors(workspace[0], poses, radius=0.8, starts=4, steps=30, most_condition=4.0)


def gain_over(platform, poses):
    inverse = np.linalg.inv(np.swapaxes(j := jacobian_of(platform, poses), -1, -2) @ j)
    joints = np.asarray(platform.platform)[:6]
    size = np.sqrt(np.mean(np.sum((joints - joints.mean(axis=0)) ** 2, axis=1)))
    return np.sqrt(np.mean(np.einsum("nii,i->n", inverse, [1, 1, 1, size**2, size**2, size**2])))


@pytest.mark.soak  # notebook 05 places some, too
def test_placed_sensors_pass_less_noise_on(workspace, placement):
    platform, found = workspace[0], placement
    poses = some_poses(rng_of(39), 4, tilt=20)
    np.testing.assert_allclose(found.gain_before, gain_over(platform, poses), rtol=1e-9)
    np.testing.assert_allclose(found.gain, gain_over(found.stewart, poses), rtol=1e-9)
    assert found.gain < found.gain_before
    assert found.gains.shape == (4,) and found.gain <= found.gains.min() * (1 + 1e-9)
    assert found.evaluations > 4


@pytest.mark.soak  # notebook 05 places some, too
def test_placed_sensors_are_where_they_may_be_and_can_do(workspace, placement):
    platform, found = workspace[0], placement
    assert found.layout.rank == 6 and found.layout.reason is None and found.layout.condition < 4.1
    assert found.status in (Status.OK, Status.STEP_LIMIT)
    for name in ("base", "platform"):
        np.testing.assert_array_equal(getattr(found.stewart, name)[:6], getattr(platform, name)[:6])
    np.testing.assert_array_equal(found.stewart.platform, platform.platform)
    middle = np.asarray(platform.base)[:6].mean(axis=0)
    assert np.abs(np.asarray(found.stewart.base)[6:] - middle).max() <= 0.8 + 1e-12


@pytest.mark.soak
def test_placed_sensors_give_the_pose(placement):
    found, poses = placement, some_poses(rng_of(40), 4, tilt=20)
    answer = pk.nine_length_pose(found.stewart, lengths_of(found.stewart, poses))
    assert error_of(answer.pose, poses) <= 1e-9


@pytest.mark.soak
def test_more_starts_are_never_worse(workspace):
    platform, poses = workspace
    few, many = (pk.place_sensors(platform, poses, radius=0.8, starts=n, steps=30) for n in (4, 12))
    np.testing.assert_allclose(many.gains[:4], few.gains, rtol=1e-6)
    assert many.gain <= few.gain * (1 + 1e-9)


@pytest.mark.soak
def test_moving_the_platform_joints_too_is_better_still(workspace):
    platform, poses = workspace
    legs = pk.Stewart(base=platform.base[:6], platform=platform.platform[:6])
    kept = pk.place_sensors(legs, poses, radius=0.8, starts=12, steps=60)
    moved = pk.place_sensors(legs, poses, radius=0.8, platform_radius=0.6, starts=24, steps=60)
    assert kept.gain_before == moved.gain_before == INF
    np.testing.assert_array_equal(kept.stewart.platform[6:], platform.platform[:6:2])
    assert moved.gain < kept.gain and moved.layout.reason is None


# ---------------------------------------------------------------- what is refused


def without_sensors(platform):
    return pk.Stewart(base=platform.base[:6], platform=platform.platform[:6])


def test_platforms_without_sensors_are_refused(workspace):
    platform, poses = workspace
    legs = without_sensors(platform)
    assert "nine rows" in said_by(pk.sensor_layout, legs)
    assert "nine rows" in said_by(pk.noise_gains, legs, poses)


def test_traced_layouts_are_refused(workspace):
    with pytest.raises(ValueError, match="known values"):
        jax.eval_shape(lambda s: pk.sensor_layout(s).singular_values, workspace[0])


@pytest.mark.parametrize("function", [pk.noise_gains, pk.pose_covariance])
def test_wrong_poses_and_weights_are_refused(function, workspace):
    platform, poses = workspace
    assert said_by(function, platform, np.ones(6)).startswith("pose must be a pk_jax.SE3")
    assert said_by(function, platform, poses, np.ones(6)).startswith("weights must have shape (9,)")
    for bad in (0.0, -1.0, NAN, INF):
        assert said_by(function, platform, poses, [1.0] * 8 + [bad]).startswith("weights must be")
    assert "Stewart" in said_by(function, "hexapod", poses)


@pytest.mark.parametrize(
    ("named", "field"),
    [
        ({"radius": 0.0}, "radius"),
        ({"radius": NAN}, "radius"),
        ({"radius": INF}, "radius"),
        ({"platform_radius": -1.0}, "platform_radius"),
        ({"most_condition": 1.0}, "most_condition"),
        ({"most_condition": NAN}, "most_condition"),
        ({"starts": 0}, "starts"),
        ({"starts": 2.5}, "starts"),
        ({"steps": 0}, "steps"),
        ({"weights": np.ones(6)}, "weights"),
        ({"weights": np.zeros(9)}, "weights"),
    ],
)
def test_wrong_wishes_are_refused_with_the_field(named, field, workspace):
    platform, poses = workspace
    assert said_by(pk.place_sensors, platform, poses, **{"radius": 0.5, **named}).startswith(field)


def test_poses_that_are_no_numbers_place_no_sensors(workspace):
    platform, poses = workspace
    lost = pk.SE3(poses.translation.at[1, 2].set(np.nan), poses.rotation)
    assert said_by(pk.place_sensors, platform, lost, radius=0.5).startswith("poses must be finite")
    assert said_by(pk.place_sensors, platform, poses, radius="1").startswith("radius must be positive")


def test_only_platforms_with_six_or_nine_rows_get_sensors(workspace):
    platform, poses = workspace
    eight = pk.Stewart(base=platform.base[:8], platform=platform.platform[:8])
    assert "six rows, or nine" in said_by(pk.place_sensors, eight, poses, radius=0.5)
    assert "six rows, or nine" in said_by(pk.place_sensors, None, poses, radius=0.5)
