"""Poses that turn about a point and slide along their own axis, against SciPy and by difference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import said_by
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.geometry import rotations
from pk_jax.geometry.poses import (
    difference,
    is_pose,
    place,
    place_jacobian,
    pose_units,
    position,
    retract,
    settle,
    tangent_size,
    tangent_zero,
)

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

BATCH = 6
POINTS = np.random.default_rng(0).uniform(-1, 1, (5, 3))

turn = st.floats(-np.pi, np.pi)
tilt = st.floats(-np.pi / 2 + 1e-3, np.pi / 2 - 1e-3)


def euler(angles):
    """About the fixed axes x, y, z in this order: Rz Ry Rx."""
    return Rotation.from_euler("xyz", angles).as_matrix()


def some(seed=0, rows=BATCH):
    """Slides and rotations over all of SO(3)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 2, rows), Rotation.random(rows, rng=rng).as_matrix()


# functions of one pose, compiled once
to_angles = jax.jit(rotations.to_angles)
from_angles = jax.jit(rotations.from_angles)
moved = jax.jit(retract)
apart = jax.jit(difference)
carried = jax.jit(place)
settled = jax.jit(settle)
turns_of_angles = jax.jit(jax.jacfwd(rotations.from_angles))
angles_of_turns = {"forward": jax.jit(jax.jacfwd(rotations.to_angles))}
angles_of_turns |= {"reverse": jax.jit(jax.jacrev(rotations.to_angles))}


# ---------------------------------------------------------------- what it holds


def test_one_pose_and_a_batch():
    s, rotation = some()
    one, many = pk.AxisPose(s[0], rotation[0]), pk.AxisPose(s, rotation)
    assert one.s.shape == () and one.rotation.shape == (3, 3)
    assert many.s.shape == (BATCH,) and many.rotation.shape == (BATCH, 3, 3)
    assert {leaf.dtype for leaf in jax.tree.leaves((one, many))} == {np.dtype(np.float64)}
    np.testing.assert_array_equal(many.s, s)
    np.testing.assert_array_equal(many.rotation, rotation)


def test_integers_become_floats_and_float32_stays():
    whole = pk.AxisPose(2, np.eye(3, dtype=int))
    assert whole.s.dtype == whole.rotation.dtype == np.float64 and whole.s == 2
    single = pk.AxisPose(np.float32(0.5), np.eye(3, dtype=np.float32))
    assert single.s.dtype == single.rotation.dtype == np.float32
    turned = pk.AxisPose.from_angles(np.float32(0.5), np.float32(0.3), np.float32(0), np.float32(0))
    assert turned.s.dtype == turned.rotation.dtype == turned.angles().dtype == np.float32


def test_rows_by_indexing():
    s, rotation = some()
    many = pk.AxisPose(s, rotation)
    np.testing.assert_array_equal(many[2].s, s[2])
    np.testing.assert_array_equal(many[2].rotation, rotation[2])
    for rows in (slice(1, 4), np.array([4, 0]), np.arange(BATCH) % 2 == 0):
        np.testing.assert_array_equal(many[rows].s, s[rows])
        np.testing.assert_array_equal(many[rows].rotation, rotation[rows])


def test_it_is_frozen():
    with pytest.raises(AttributeError):
        pk.AxisPose(1.0, np.eye(3)).s = 2.0


def test_it_is_a_pytree_of_slide_and_rotation():
    s, rotation = some()
    pose = pk.AxisPose(s, rotation)
    found = jax.tree_util.tree_flatten_with_path(pose)[0]
    assert [jax.tree_util.keystr(path) for path, _ in found] == [".s", ".rotation"]
    doubled = jax.tree.map(lambda leaf: 2 * leaf, pose)  # not a rotation: a tree may hold anything
    assert isinstance(doubled, pk.AxisPose)
    np.testing.assert_array_equal(doubled.rotation, 2 * rotation)


def test_jit_vmap_and_grad_take_it():
    s, rotation = some()
    pose = pk.AxisPose(s, rotation)
    weight = np.arange(1.0, 4.0)

    def height(pose):  # of the platform's centre: s n . weight
        return weight @ place(pose, jnp.zeros((1, 3)))[0]

    found = jax.jit(jax.vmap(height))(pose)
    np.testing.assert_allclose(found, s * (rotation[:, :, 2] @ weight), rtol=0, atol=1e-14)
    gradient = jax.jit(jax.vmap(jax.grad(height)))(pose)
    assert isinstance(gradient, pk.AxisPose)
    np.testing.assert_allclose(gradient.s, rotation[:, :, 2] @ weight, rtol=0, atol=1e-14)
    expected = np.zeros((BATCH, 3, 3))
    expected[:, :, 2] = s[:, None] * weight
    np.testing.assert_allclose(gradient.rotation, expected, rtol=0, atol=1e-14)
    made = jax.jit(lambda s, roll: pk.AxisPose.from_angles(s, roll=roll))(s, s)  # inside of a trace, too
    np.testing.assert_allclose(made.rotation, euler(np.outer(s, [1, 0, 0])), rtol=0, atol=1e-15)


# ---------------------------------------------------------------- angles


def test_angles_are_about_fixed_axes_in_the_order_x_y_z():
    rng = np.random.default_rng(1)
    s, angles = rng.uniform(0.1, 2, BATCH), rng.uniform(-np.pi, np.pi, (BATCH, 3))
    many = pk.AxisPose.from_angles(s, *angles.T)
    np.testing.assert_allclose(many.rotation, euler(angles), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(many.s, s)
    one = pk.AxisPose.from_angles(0.3, *angles[0])
    assert one.s.shape == () and one.s == 0.3
    np.testing.assert_allclose(one.rotation, euler(angles[0]), rtol=0, atol=1e-15)


def test_slides_and_angles_broadcast_and_are_zero_where_left_out():
    level = pk.AxisPose.from_angles([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(level.rotation, np.broadcast_to(np.eye(3), (3, 3, 3)))
    pitched = pk.AxisPose.from_angles(0.4, pitch=[0.1, 0.2], yaw=-0.5)
    np.testing.assert_array_equal(pitched.s, [0.4, 0.4])
    np.testing.assert_allclose(pitched.rotation, euler([[0, 0.1, -0.5], [0, 0.2, -0.5]]), rtol=0, atol=1e-15)
    assert pk.AxisPose.from_angles(1, 0, 0, 0).s.dtype == np.float64  # integers are numbers


@given(roll=turn, pitch=tilt, yaw=turn)
def test_angles_come_back(roll, pitch, yaw):
    """To roundoff, that of roll and yaw over the cosine of the pitch; +-pi is one angle."""
    off = np.asarray(to_angles(from_angles(np.array([roll, pitch, yaw])))) - [roll, pitch, yaw]
    off = np.angle(np.exp(1j * off))
    assert np.all(np.abs(off) <= 4e-15 / np.cos(pitch))


@given(angles=st.tuples(*[st.floats(-7, 7)] * 3))
def test_any_angles_come_back_as_the_same_rotation(angles):
    rotation = euler(angles)
    again = np.asarray(to_angles(rotation))
    assert np.all(np.abs(again) <= [np.pi, np.pi / 2, np.pi])
    np.testing.assert_allclose(euler(again), rotation, rtol=0, atol=1e-14)


def test_angles_of_a_batch_are_those_of_its_rows():
    angles = np.random.default_rng(2).uniform(-1.5, 1.5, (BATCH, 3))
    pose = pk.AxisPose.from_angles(np.ones(BATCH), *angles.T)
    np.testing.assert_allclose(pose.angles(), angles, rtol=0, atol=1e-13)
    assert pose[0].angles().shape == (3,)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_upright_a_rotation_comes_back_with_no_roll(pitch):
    """Only the sum or the difference of roll and yaw is known there."""
    for roll, yaw in np.random.default_rng(3).uniform(-3, 3, (20, 2)):
        rotation = euler([roll, pitch, yaw])
        found = np.asarray(to_angles(rotation))
        np.testing.assert_allclose(euler(found), rotation, rtol=0, atol=1e-14)
        assert found[0] == 0 and found[1] == pitch
        both = yaw - np.sign(pitch) * roll
        assert abs(np.angle(np.exp(1j * (found[2] - both)))) < 1e-14


def test_derivatives_of_angles_are_the_inverse_of_those_of_the_rotation():
    for angles in np.random.default_rng(4).uniform(-1.4, 1.4, (20, 3)):
        rotation = euler(angles)
        for found in angles_of_turns.values():
            back = np.einsum("kij,ijm->km", found(rotation), turns_of_angles(angles))
            np.testing.assert_allclose(back, np.eye(3), rtol=0, atol=1e-13)


QUARTERS = [Rotation.identity(), *(Rotation.from_rotvec(np.pi / 2 * k * np.eye(3)[0]) for k in (1, 2, 3))]
QUARTERS += [turned * Rotation.from_rotvec([0, 0, np.pi / 2 * k]) for turned in QUARTERS for k in (1, 2, 3)]


@pytest.mark.parametrize("way", angles_of_turns)
def test_derivatives_of_angles_are_finite_at_quarter_turns(way):
    """Entries that are exactly zero; upright, too, though they say nothing there."""
    for turned in QUARTERS:
        rotation = np.round(turned.as_matrix())
        assert np.all(np.isfinite(angles_of_turns[way](rotation))), rotation
        upright = rotation @ np.round(euler([0, np.pi / 2, 0]))
        assert np.all(np.isfinite(angles_of_turns[way](upright))), upright


# ---------------------------------------------------------------- motion


def test_it_carries_points_along_its_own_axis():
    """R (b + s e3)."""
    s, rotation = some()
    for k in range(BATCH):
        expected = (rotation[k] @ (POINTS + [0, 0, s[k]]).T).T
        np.testing.assert_allclose(
            carried(pk.AxisPose(s[k], rotation[k]), POINTS), expected, rtol=0, atol=1e-15
        )


def test_its_tangent_is_a_slide_and_a_turn_about_the_base():
    """A placed point p moves by s' n + w x p: in closed form and by central differences."""
    assert tangent_size(pk.AxisPose(1.0, np.eye(3))) == 4
    assert pose_units(pk.AxisPose(1.0, np.eye(3)), None) == (1, 0, 0, 0)
    jacobian = jax.jit(place_jacobian)
    for s, rotation in zip(*some(5), strict=True):
        pose = pk.AxisPose(s, rotation)
        np.testing.assert_array_equal(tangent_zero(pose), np.zeros(4))
        np.testing.assert_array_equal(position(pose), [s])
        found = np.asarray(jacobian(pose, POINTS))
        assert found.shape == (5, 3, 4)
        at = (POINTS + [0, 0, s]) @ rotation.T
        turning = np.stack([np.cross(unit, at) for unit in np.eye(3)], axis=-1)
        sliding = np.broadcast_to(rotation[:, 2], (5, 3))
        expected = np.concatenate([sliding[..., None], turning], axis=-1)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
        h = 1e-5
        for k, unit in enumerate(np.eye(4)):
            ahead, behind = (np.asarray(carried(moved(pose, way * h * unit), POINTS)) for way in (1, -1))
            np.testing.assert_allclose(found[..., k], (ahead - behind) / (2 * h), rtol=0, atol=1e-9)


def test_retract_turns_by_cayley_in_base_axes():
    """By 2 arctan(|w| / 2) about w, on the left; the slide adds."""
    rng = np.random.default_rng(6)
    for s, rotation in zip(*some(6), strict=True):
        twist = rng.uniform(-2, 2, 4)
        size = np.linalg.norm(twist[1:])
        about = Rotation.from_rotvec(2 * np.arctan(size / 2) / size * twist[1:]).as_matrix()
        there = moved(pk.AxisPose(s, rotation), twist)
        assert isinstance(there, pk.AxisPose) and abs(there.s - (s + twist[0])) < 1e-15
        np.testing.assert_allclose(there.rotation, about @ rotation, rtol=0, atol=1e-14)


def test_difference_and_retract_undo_one_another():
    rng = np.random.default_rng(7)
    for s, rotation in zip(*some(7), strict=True):
        pose, twist = pk.AxisPose(s, rotation), rng.uniform(-1.5, 1.5, 4)
        np.testing.assert_allclose(apart(pose, moved(pose, twist)), twist, rtol=0, atol=1e-13)
        near = pk.AxisPose(s + 0.3, Rotation.from_rotvec(rng.uniform(-1, 1, 3)).as_matrix() @ rotation)
        there = moved(pose, apart(pose, near))
        np.testing.assert_allclose(there.s, near.s, rtol=0, atol=1e-15)
        np.testing.assert_allclose(there.rotation, near.rotation, rtol=0, atol=1e-14)


def test_settle_gives_the_nearest_rotation_and_keeps_the_slide():
    rng = np.random.default_rng(8)
    for s, rotation in zip(*some(8), strict=True):
        rough = rotation + rng.uniform(-3e-6, 3e-6, (3, 3))
        found = settled(pk.AxisPose(s, rough))
        assert isinstance(found, pk.AxisPose) and found.s == s
        assert np.max(np.abs(rough @ rough.T - np.eye(3))) > 1e-7
        np.testing.assert_allclose(found.rotation, polar(rough)[0], rtol=0, atol=2e-15)


def test_what_is_no_rotation_is_known_under_jit():
    asked = jax.jit(lambda rotation: is_pose(pk.AxisPose(1.0, rotation)))
    assert asked(np.eye(3)) and asked(euler([0.1, 0.2, 0.3]))
    assert not asked(2 * np.eye(3)) and not asked(np.diag([1.0, 1.0, -1.0]))


# ---------------------------------------------------------------- at the door


SKEWED = np.eye(3) + 1e-4 * np.eye(3)[[1, 2, 0]]
REFUSED = {
    "stretched": ((1.0, 1.1 * np.eye(3)), "AxisPose.rotation must be orthonormal"),
    "skewed": ((1.0, SKEWED), "AxisPose.rotation must be orthonormal"),
    "one of many": (([1.0, 2.0], [np.eye(3), SKEWED]), "AxisPose.rotation[1] must be orthonormal"),
    "reflection": ((1.0, np.diag([1.0, 1.0, -1.0])), "AxisPose.rotation is a reflection"),
    "reflected row": (([1.0, 2.0], [np.eye(3), -np.eye(3)]), "AxisPose.rotation[1] is a reflection"),
    "a vector as matrix": ((1.0, [0.1, 0.2, 0.3]), "AxisPose.rotation must have shape (3, 3), got (3,)"),
    "two rows of a matrix": ((1.0, np.eye(3)[:2]), "AxisPose.rotation must have shape (3, 3), got (2, 3)"),
    "one slide, many turns": ((1.0, [np.eye(3)] * 2), "AxisPose.rotation must have shape (3, 3)"),
    "many slides, one turn": (([1.0, 2.0], np.eye(3)), "AxisPose.rotation must have shape (2, 3, 3)"),
    "a grid": (([[1.0, 2.0]], [[np.eye(3)] * 2]), "AxisPose.s must have shape (any,), got (1, 2)"),
    "a word": (("far", np.eye(3)), "AxisPose.s must be real numbers"),
    "words": ((1.0, [["a", "b", "c"]] * 3), "AxisPose.rotation must be real numbers"),
    "complex": ((1j, np.eye(3)), "AxisPose.s must be real numbers"),
    "none": ((None, np.eye(3)), "AxisPose.s must be real numbers"),
    "ragged": ((1.0, [[1, 0, 0], [0, 1], [0, 0, 1]]), "AxisPose.rotation must be a number or a regular"),
}


@pytest.mark.parametrize(("given", "said"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_pose_is_refused_in_one_line(given, said):
    assert said_by(pk.AxisPose, *given).startswith(said)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"s": "far"}, "s must be real numbers"),
        ({"s": 1.0, "pitch": "steep"}, "pitch must be real numbers"),
        ({"s": 1.0, "yaw": True}, "yaw must be real numbers"),
        ({"s": np.ones((2, 2))}, "AxisPose.s must have shape"),
    ],
)
def test_angles_that_are_none_are_refused_in_one_line(given, said):
    assert said_by(pk.AxisPose.from_angles, **given).startswith(said)


def test_a_rotation_of_six_digits_is_one():
    rough = np.round(euler([0.4, -0.7, 1.1]), 6)
    assert 1e-8 < np.max(np.abs(rough @ rough.T - np.eye(3))) < 1e-5
    np.testing.assert_array_equal(pk.AxisPose(1.0, rough).rotation, rough)


def test_rows_of_nan_are_allowed():
    lost = pk.AxisPose([np.nan, 1.0, 2.0], [np.eye(3), np.full((3, 3), np.nan), np.eye(3)])
    np.testing.assert_array_equal(np.isnan(lost.s), [True, False, False])
    angles = np.asarray(lost.angles())
    assert np.all(np.isnan(angles[1])) and np.all(angles[[0, 2]] == 0)
    assert np.isnan(pk.AxisPose.from_angles(1.0, np.nan).rotation).any()


SEMI = pk.catalogued("semi-regular-stewart")
CASING = pk.CasingOscillator()


def test_one_kind_of_pose_is_refused_where_the_other_is_wanted():
    spatial, axial = pk.SE3([0.0, 0.0, 0.4], np.eye(3)), pk.AxisPose(0.48, np.eye(3))
    asked = pk.inverse_kinematics
    assert said_by(asked, CASING, spatial) == "pose must be a pk_jax.AxisPose, got SE3"
    assert said_by(asked, CASING, [0.48, 0, 0, 0]).startswith("pose must be a pk_jax.AxisPose, got list")
    assert said_by(asked, SEMI, axial) == "pose must be a pk_jax.SE3, got AxisPose"
    flat = pk.catalogued("nam-2-rpr")
    assert said_by(asked, flat, axial) == "pose must be an array of shape (2,), got an AxisPose"
    joints = CASING.home()[1]
    said = said_by(pk.forward_kinematics, CASING, joints, spatial)
    assert said == "guess must be a pk_jax.AxisPose, got SE3"
    said = said_by(pk.classify_singularity, CASING, spatial, joints)
    assert said == "pose must be a pk_jax.AxisPose, got SE3"
