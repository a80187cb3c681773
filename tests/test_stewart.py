"""Poses in space and the Stewart platform: what is refused, what is published, and the laws between."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import said_by
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.geometry import poses, rotations
from pk_jax.mechanisms import stewart
from pk_jax.mechanisms.catalogue import CATALOGUE

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

SEMI = pk.catalogued("semi-regular-stewart")
NAN = np.nan


def some_poses(count, reach=1.0):
    turned = Rotation.random(count, rng=np.random.default_rng(3)).as_matrix()
    return pk.SE3(np.random.default_rng(4).uniform(-reach, reach, (count, 3)), turned)


# ---------------------------------------------------------------- SE3 at the door


def turned(rows, row, wrong):
    rotation = np.tile(np.eye(3), (rows, 1, 1))
    rotation[row] = wrong
    return rotation


REFLECTION = np.diag([1.0, 1.0, -1.0])
SHEAR = np.array([[1.0, 2e-5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def test_what_is_not_orthonormal_is_refused_with_its_row():
    said = said_by(pk.SE3, np.zeros((4, 3)), turned(4, 2, SHEAR))
    assert said.startswith("SE3.rotation[2] must be orthonormal") and said.endswith("2e-05")
    both = np.stack([np.eye(3), SHEAR, 1.01 * np.eye(3)])
    assert said_by(pk.SE3, np.zeros((3, 3)), both).startswith("SE3.rotation[1] must be")  # the first one
    assert said_by(pk.SE3, np.zeros(3), 1.01 * np.eye(3)).startswith("SE3.rotation must be orthonormal")
    assert said_by(pk.SE3, np.zeros(3), np.zeros((3, 3))).startswith("SE3.rotation must be orthonormal")


def test_a_reflection_is_refused_with_its_row():
    assert said_by(pk.SE3, np.zeros((4, 3)), turned(4, 3, REFLECTION)).startswith(
        "SE3.rotation[3] is a reflection"
    )
    assert said_by(pk.SE3, np.zeros(3), -np.eye(3)).startswith("SE3.rotation is a reflection")


def test_a_rotation_printed_with_six_digits_is_one():
    printed = np.round(Rotation.random(50, rng=np.random.default_rng(2)).as_matrix(), 6)
    pk.SE3(np.zeros((50, 3)), printed)


def test_nan_rotations_are_left_to_the_solvers():
    rotation = turned(3, 1, np.full((3, 3), NAN))
    np.testing.assert_array_equal(pk.SE3(np.zeros((3, 3)), rotation).rotation, rotation)
    rotation[2] = REFLECTION
    assert "[2]" in said_by(pk.SE3, np.zeros((3, 3)), rotation)


@pytest.mark.parametrize(
    ("translation", "rotation", "field"),
    [
        ((2,), (3, 3), "translation"),
        ((4,), (3, 3), "translation"),
        ((), (3, 3), "translation"),
        ((2, 2, 3), (2, 2, 3, 3), "translation"),
        ((3,), (3,), "rotation"),
        ((3,), (4, 4), "rotation"),
        ((3,), (1, 3, 3), "rotation"),
        ((4, 3), (5, 3, 3), "rotation"),
        ((4, 3), (3, 3), "rotation"),
    ],
)
def test_wrong_shapes_are_refused(translation, rotation, field):
    said = said_by(pk.SE3, np.zeros(translation), np.zeros(rotation))
    assert said.startswith(f"SE3.{field} must have shape ")


@pytest.mark.parametrize("bad", ["0, 0, 1", ["0", "0", "1"], [0j, 0, 1], [True, False, True], None])
def test_what_are_no_numbers_is_refused(bad):
    assert said_by(pk.SE3, bad, np.eye(3)).startswith("SE3.translation must be ")
    assert said_by(pk.SE3, np.zeros(3), bad).startswith("SE3.rotation must be ")
    assert said_by(pk.SE3.from_quaternion, np.zeros(3), bad).startswith("quaternion must be ")
    assert said_by(pk.SE3.from_rotation_vector, np.zeros(3), bad).startswith("rotation vector must be ")


def test_wrong_quaternions_and_rotation_vectors_are_refused():
    assert "zero" in said_by(pk.SE3.from_quaternion, np.zeros((2, 3)), [[1, 0, 0, 0], [0, 0, 0, 0]])
    assert "shape" in said_by(pk.SE3.from_quaternion, np.zeros(3), [1.0, 0, 0])
    assert "shape" in said_by(pk.SE3.from_rotation_vector, np.zeros(3), [1.0, 0, 0, 0])
    assert "shape" in said_by(pk.SE3.from_rotation_vector, np.zeros(3), np.zeros((2, 3)))


def test_integers_and_float32():
    pose = pk.SE3([0, 0, 1], np.eye(3, dtype=int))
    assert pose.translation.dtype == pose.rotation.dtype == jnp.float64
    short = pk.SE3(np.zeros(3, np.float32), np.eye(3, dtype=np.float32))
    assert short.translation.dtype == short.rotation.dtype == jnp.float32
    assert short.quaternion().dtype == short.rotation_vector().dtype == jnp.float32


# ---------------------------------------------------------------- rotations

ANGLES = [
    0,
    1e-300,
    1e-160,
    1e-12,
    1e-8,
    1e-4,
    0.0999,
    0.1999,
    1,
    3,
    *(np.pi - np.array([1e-4, 1e-8, 1e-12, 0])),
]
TILTED = Rotation.random(rng=np.random.default_rng(5)).as_matrix()
AXES = np.concatenate([np.eye(3), -np.eye(3), TILTED])
VECTORS = np.concatenate([angle * AXES for angle in ANGLES])


def test_rotation_vectors_against_scipy_at_every_angle():
    pose = pk.SE3.from_rotation_vector(np.zeros_like(VECTORS), VECTORS)
    np.testing.assert_allclose(pose.rotation, Rotation.from_rotvec(VECTORS).as_matrix(), rtol=0, atol=1e-15)
    back = np.asarray(pose.rotation_vector())
    lengths = np.linalg.norm(VECTORS, axis=1)
    at_pi = lengths > np.pi - 1e-14  # either sign is right there
    sign = np.where(at_pi & (np.sum(back * VECTORS, axis=1) < 0), -1, 1)[:, None]
    np.testing.assert_allclose(sign * back, VECTORS, rtol=0, atol=4e-15)
    tiny = lengths < 1e-7  # to relative precision
    np.testing.assert_allclose(back[tiny], VECTORS[tiny], rtol=1e-14, atol=0)


def test_quaternions_against_scipy_at_every_angle():
    of_scipy = Rotation.from_rotvec(VECTORS).as_quat()[:, [3, 0, 1, 2]]
    of_any_length = of_scipy * np.random.default_rng(1).uniform(0.1, 9, (len(VECTORS), 1))
    pose = pk.SE3.from_quaternion(np.zeros_like(VECTORS), of_any_length)
    np.testing.assert_allclose(pose.rotation, Rotation.from_rotvec(VECTORS).as_matrix(), rtol=0, atol=1e-15)
    found = np.asarray(pose.quaternion())
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=0, atol=1e-15)
    assert np.all(np.take_along_axis(found, np.abs(found).argmax(axis=1)[:, None], axis=1) > 0)
    same = np.sign(np.sum(found * of_scipy, axis=1))[:, None]
    np.testing.assert_allclose(found, same * of_scipy, rtol=0, atol=1e-15)


@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_a_quaternion_has_any_length_but_zero(size):
    pose = pk.SE3.from_quaternion(np.zeros(3), size * np.array([1.0, 0.0, 0.0, 1.0]))
    np.testing.assert_allclose(pose.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], rtol=0, atol=1e-15)


GENERATORS = np.stack([rotations.skew(e) for e in jnp.eye(3)], axis=-1)  # (3, 3, axis)


@pytest.mark.parametrize("function", [rotations.from_rotation_vector, rotations.cayley])
def test_derivatives_at_the_identity_are_those_of_the_exponential(function):
    """To second order: exp([w]) = 1 + [w] + [w][w] / 2 + ..."""
    zero = jnp.zeros(3)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(function))(zero), GENERATORS, rtol=0, atol=1e-16)
    np.testing.assert_allclose(jax.jit(jax.jacrev(function))(zero), GENERATORS, rtol=0, atol=1e-16)
    product = np.einsum("ija,jkb->ikab", GENERATORS, GENERATORS)
    second = (product + np.swapaxes(product, 2, 3)) / 2
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.jacrev(function)))(zero), second, rtol=0, atol=1e-15)


def test_third_derivative_of_the_exponential_at_the_identity():
    """exp([w]) = ... - |w|^2 [w] / 6: along w, the third derivative is -[w] for a unit w."""
    along = lambda t: rotations.from_rotation_vector(t * jnp.array([0.0, 0.0, 1.0]))
    third = jax.jit(jax.jacfwd(jax.jacfwd(jax.jacfwd(along))))(0.0)
    np.testing.assert_allclose(third, -GENERATORS[..., 2], rtol=0, atol=1e-14)


def test_derivatives_back_from_the_identity_are_finite():
    for back in (rotations.to_rotation_vector, rotations.to_quaternion):
        rate = jax.jit(jax.jacrev(back))
        for matrix in (np.eye(3), np.diag([-1.0, -1.0, 1.0])):
            assert np.all(np.isfinite(rate(matrix)))
    there_and_back = lambda w: rotations.to_rotation_vector(rotations.from_rotation_vector(w))
    np.testing.assert_allclose(
        jax.jit(jax.jacfwd(there_and_back))(jnp.zeros(3)), np.eye(3), rtol=0, atol=1e-15
    )
    assert np.all(np.isfinite(jax.jit(jax.jacfwd(jax.jacrev(there_and_back)))(jnp.zeros(3))))


def test_cayley_is_a_rotation_for_every_vector():
    w = np.concatenate([10.0**k * AXES for k in range(-8, 7)])
    r = np.asarray(jax.vmap(rotations.cayley)(w))
    gram = r @ np.swapaxes(r, 1, 2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), rtol=0, atol=2e-15)
    np.testing.assert_allclose(np.linalg.det(r), 1, rtol=0, atol=2e-15)
    # by 2 arctan(|w| / 2) about w
    sizes = np.linalg.norm(w, axis=1, keepdims=True)
    expected = Rotation.from_rotvec(w / sizes * 2 * np.arctan(sizes / 2)).as_matrix()
    np.testing.assert_allclose(r, expected, rtol=0, atol=4e-15)


def test_about_turns_by_the_angle():
    for axis in range(3):
        expected = Rotation.from_rotvec(0.7 * np.eye(3)[axis]).as_matrix()
        np.testing.assert_allclose(rotations.about(axis, jnp.asarray(0.7)), expected, rtol=0, atol=2e-16)


# ---------------------------------------------------------------- moving


def test_retract_and_difference_undo_one_another():
    one, other = some_poses(40), some_poses(80)[40:]
    gap = jax.vmap(poses.difference)(one, other)
    back = jax.vmap(poses.retract)(one, gap)
    np.testing.assert_allclose(back.translation, other.translation, rtol=0, atol=1e-15)
    np.testing.assert_allclose(back.rotation, other.rotation, rtol=0, atol=1e-13)
    twists = np.random.default_rng(6).uniform(-1, 1, (40, 6))
    moved = jax.vmap(poses.retract)(one, twists)
    np.testing.assert_allclose(jax.vmap(poses.difference)(one, moved), twists, rtol=0, atol=2e-15)


def test_a_twist_is_a_velocity_in_base_axes():
    """p' = v + w x (p - t)."""
    pose, points = some_poses(1)[0], np.array([[0.1, 0.2, 0.3], [-1.0, 0.5, 0.0]])
    arms = np.asarray(poses.place(pose, points)) - pose.translation
    np.testing.assert_allclose(arms, points @ np.asarray(pose.rotation).T, rtol=0, atol=1e-15)
    found = jax.jit(poses.place_jacobian)(pose, points)
    for k in range(2):
        np.testing.assert_array_equal(found[k, :, :3], np.eye(3))
        for axis in range(3):
            np.testing.assert_allclose(
                found[k, :, 3 + axis], np.cross(np.eye(3)[axis], arms[k]), rtol=0, atol=1e-15
            )


def test_a_pose_is_a_pytree_and_its_rows_are_poses():
    batch = some_poses(5)
    leaves, tree = jax.tree.flatten(batch)
    again = jax.tree.unflatten(tree, leaves)
    assert isinstance(again, pk.SE3) and [leaf.shape for leaf in leaves] == [(5, 3), (5, 3, 3)]
    np.testing.assert_array_equal(again.rotation, batch.rotation)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(batch)]
    assert names == [".translation", ".rotation"]
    np.testing.assert_array_equal(batch[3].translation, batch.translation[3])
    np.testing.assert_array_equal(batch[1:3].rotation, batch.rotation[1:3])
    np.testing.assert_array_equal(batch[np.array([4, 0])].translation, batch.translation[np.array([4, 0])])
    double = jax.jit(jax.vmap(lambda pose: poses.place(pose, 2 * jnp.eye(3))))(batch)
    expected = np.asarray(batch.translation)[:, None] + 2 * np.swapaxes(batch.rotation, 1, 2)
    np.testing.assert_allclose(double, expected, rtol=0, atol=1e-15)


# ---------------------------------------------------------------- the platform


def lengths(mech, pose):
    """|t + R b - a| in NumPy."""
    t, r = np.asarray(pose.translation), np.asarray(pose.rotation)
    points = t[..., None, :] + np.einsum("...ij,kj->...ki", r, np.asarray(mech.platform))
    return np.linalg.norm(points - np.asarray(mech.base), axis=-1)


def least_sigma(mech, pose):
    """Least singular value of the six leg lines, without units: lines of unit norm over length()."""
    t, r = np.asarray(pose.translation), np.asarray(pose.rotation)
    arms = np.asarray(mech.platform)[:6] @ r.T
    legs = t + arms - np.asarray(mech.base)[:6]
    joints = np.asarray(mech.platform)[:6]
    size = np.sqrt(np.mean(np.sum((joints - joints.mean(axis=0)) ** 2, axis=1)))
    lines = np.concatenate([size * legs, np.cross(arms, legs)], axis=1)
    return np.linalg.svd(lines / np.linalg.norm(lines, axis=1, keepdims=True), compute_uv=False)[-1]


def with_sensors():
    more = np.pad(np.random.default_rng(8).uniform(-1, 1, (3, 2)), ((0, 0), (0, 1)))
    ends = (SEMI.base, 1.3 * more), (SEMI.platform, 0.3 * more[::-1])
    return pk.Stewart(base=np.concatenate(ends[0]), platform=np.concatenate(ends[1]))


def test_inverse_is_the_distance_of_the_ends():
    batch = some_poses(20)
    for mech in (SEMI, with_sensors()):
        found = jax.jit(jax.vmap(mech.inverse))(batch)
        np.testing.assert_allclose(found, lengths(mech, batch), rtol=1e-15)
        assert found.shape == (20, len(mech.base))


def test_lengths_do_not_know_where_the_whole_stands():
    where, at = some_poses(1)[0], some_poses(7, 2.0)
    turn, shift = np.asarray(where.rotation), np.asarray(where.translation)
    moved = pk.Stewart(base=np.asarray(SEMI.base) @ turn.T + shift, platform=SEMI.platform)
    pose = pk.SE3(np.asarray(at.translation) @ turn.T + shift, turn @ np.asarray(at.rotation))
    np.testing.assert_allclose(jax.vmap(moved.inverse)(pose), lengths(SEMI, at), rtol=1e-14)
    # nor which frame the platform's joints are written in
    written = pk.Stewart(base=SEMI.base, platform=(np.asarray(SEMI.platform) - shift) @ turn)
    pose = pk.SE3(at.translation + at.rotation @ shift, at.rotation @ turn)
    np.testing.assert_allclose(jax.vmap(written.inverse)(pose), lengths(SEMI, at), rtol=1e-14)
    np.testing.assert_allclose(moved.length(), SEMI.length(), rtol=1e-15)


def test_length_is_the_size_of_the_platform():
    np.testing.assert_allclose(SEMI.length(), 0.45368859, rtol=1e-15)
    np.testing.assert_allclose(with_sensors().length(), 0.45368859, rtol=1e-15)  # sensors do not count


def test_semi_regular_angles():
    degrees = lambda points: np.rad2deg(np.arctan2(points[:, 1], points[:, 0])) % 360
    np.testing.assert_allclose(degrees(SEMI.base), [42, 138, 162, 258, 282, 18], rtol=1e-14)
    np.testing.assert_allclose(
        degrees(SEMI.platform), [80.48, 99.52, 200.48, 219.52, 320.48, 339.52], rtol=1e-14
    )
    for points, radius in ((SEMI.base, 1.0), (SEMI.platform, 0.45368859)):
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), radius, rtol=1e-15)
        np.testing.assert_array_equal(points[:, 2], 0)


def test_lengths_of_the_lab_sheet():
    """MCL-745: hexagons of radius 100 and 150 mm, 300 mm apart. Nearly similar, and singular there."""
    corners = np.array([[100, 0], [50, 87], [-87, 50], [-100, 0], [-50, -87], [87, -50]])
    feet = np.array([[150, 0], [75, 130], [-130, 75], [-150, 0], [-75, -130], [130, -75]])
    flat = lambda points: np.pad(points, ((0, 0), (0, 1)))
    mech = pk.Stewart(base=flat(feet), platform=flat(corners))
    pose = pk.SE3([0, 0, 300], np.eye(3))
    a, b = 304.138126514911, 304.09537977417546
    np.testing.assert_allclose(mech.inverse(pose), [a, b, b, a, b, b], rtol=1e-15)
    assert least_sigma(mech, pose) < 1e-3


# ---------------------------------------------------------------- home

find_homes = jax.jit(jax.vmap(stewart._best_home))


@pytest.mark.parametrize("depth", [0.0, 0.3, 1.0])
def test_home_of_a_random_geometry_is_regular(depth):
    joints = np.random.default_rng(9).uniform(-1, 1, (2, 200, 6, 3)) * [1, 1, depth]
    mechs = some_stewart(*joints)
    home, clearance = find_homes(mechs)
    least = [
        least_sigma(some_stewart(*joints[:, k]), jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k]), home))
        for k in range(200)
    ]
    assert np.min(least) > 0.02
    assert np.all(clearance <= np.array(least) * (1 + 1e-9))
    assert np.all(np.array(least) <= np.sqrt(6) * clearance * (1 + 1e-9))


def some_stewart(base, platform):
    """Without the checks at the door."""
    return jax.tree.unflatten(jax.tree.structure(SEMI), (base, platform))


PLATFORMS = [name for name in CATALOGUE if "stewart" in name or "hexapod" in name]


@pytest.mark.parametrize("name", PLATFORMS)
def test_home_of_a_published_platform(name):
    mech = pk.catalogued(name)
    pose, joints = mech.home()
    assert least_sigma(mech, pose) > 0.02
    np.testing.assert_allclose(joints, lengths(mech, pose), rtol=1e-14)
    assert np.mean(pose.translation[2] + mech.platform @ pose.rotation[2]) > np.mean(mech.base[:, 2])
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), rtol=0, atol=1e-14)


def test_home_is_in_the_middle_of_the_stroke():
    mech = pk.Stewart(base=SEMI.base, platform=SEMI.platform, stroke=[1.0, 1.6])
    np.testing.assert_allclose(mech.home()[1], 1.3, rtol=1e-14)
    each = np.array([[1.0, 1.6]] * 5 + [[1.1, 1.7]])
    mech = pk.Stewart(base=SEMI.base, platform=SEMI.platform, stroke=each)
    np.testing.assert_allclose(np.mean(mech.home()[1] ** 2), np.mean(each.mean(axis=1) ** 2), rtol=1e-14)


def test_home_does_not_know_where_the_frames_stand():
    """That of the platform may have its origin anywhere, that of the base, too."""
    rng = np.random.default_rng(4)
    up, out = rng.normal(size=3), 3 * rng.normal(size=3)
    base, platform = SEMI.base + 0.1 * rng.normal(size=(6, 3)), SEMI.platform + 0.1 * rng.normal(size=(6, 3))
    pose, joints = pk.Stewart(base=base, platform=platform).home()
    moved, same = pk.Stewart(base=base + up, platform=platform + out).home()
    np.testing.assert_allclose(same, joints, rtol=1e-9)
    np.testing.assert_allclose(moved.rotation, pose.rotation, atol=1e-9)
    np.testing.assert_allclose(moved.translation, pose.translation + up - pose.rotation @ out, atol=1e-9)


def test_home_passes_no_derivatives():
    pose = lambda mech: jax.tree.leaves(mech.home()[0])
    of_pose = jax.jit(jax.jacfwd(lambda scale: pose(jax.tree.map(lambda leaf: scale * leaf, SEMI))))(1.0)
    for leaf in of_pose:
        np.testing.assert_array_equal(leaf, 0)


# ---------------------------------------------------------------- margins


def angles_of_cones(mech, pose, axes):
    t, r = np.asarray(pose.translation), np.asarray(pose.rotation)
    legs = t + np.asarray(mech.platform)[:6] @ r.T - np.asarray(mech.base)[:6]
    on_base = np.arccos(np.sum(legs * axes[0], axis=1) / np.linalg.norm(legs, axis=1))
    seen = -legs @ r
    return on_base, np.arccos(np.sum(seen * axes[1], axis=1) / np.linalg.norm(seen, axis=1))


def test_margins_of_strokes():
    pose = pk.SE3.from_rotation_vector([0.05, -0.1, 1.1], [0.1, 0.2, 0.1])
    joints = lengths(SEMI, pose)
    ends = np.sort(joints[:2])
    mech = pk.Stewart(base=SEMI.base, platform=SEMI.platform, stroke=ends)
    margins = mech.margins(pose, joints)
    np.testing.assert_allclose(margins["stroke_min"], (joints - ends[0]) / 0.45368859, rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(margins["stroke_max"], (ends[1] - joints) / 0.45368859, rtol=1e-14, atol=1e-16)
    assert set(margins) == {"stroke_min", "stroke_max"} and SEMI.margins(pose, joints) == {}
    assert 0 in margins["stroke_min"] and 0 in margins["stroke_max"]


def test_margins_of_cones_are_zero_at_the_limit():
    rng = np.random.default_rng(12)
    axes = np.stack([[0, 0, 1.0], [0, 0, -1.0]])[:, None] + rng.uniform(-0.2, 0.2, (2, 6, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    pose = pk.SE3.from_rotation_vector([0.05, -0.1, 1.1], [0.3, 0.2, 0.4])
    joints = lengths(SEMI, pose)
    on_base, on_platform = angles_of_cones(SEMI, pose, axes)
    mech = pk.Stewart(
        base=SEMI.base, platform=SEMI.platform, base_cone=on_base, platform_cone=1.5, cone_axes=axes
    )
    margins = mech.margins(pose, joints)
    assert set(margins) == {"base_cone", "platform_cone"}
    np.testing.assert_allclose(margins["base_cone"], 0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        margins["platform_cone"], np.cos(on_platform) - np.cos(1.5), rtol=0, atol=1e-14
    )


def test_cones_are_about_the_legs_at_home():
    mech = pk.Stewart(base=SEMI.base, platform=SEMI.platform, base_cone=0.5, platform_cone=np.full(6, 0.6))
    home, joints = mech.home()
    margins = mech.margins(home, joints)
    np.testing.assert_allclose(margins["base_cone"], 1 - np.cos(0.5), rtol=1e-13)
    np.testing.assert_allclose(margins["platform_cone"], 1 - np.cos(0.6), rtol=1e-13)


# ---------------------------------------------------------------- refusals

BASE, PLATFORM = np.asarray(SEMI.base), np.asarray(SEMI.platform)


def replaced(points, row, by):
    return np.concatenate([points[:row], [by], points[row + 1 :]])


def hexagon(radius):
    angle = np.deg2rad(60.0) * np.arange(6)
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


AXES_UP = np.tile([0.0, 0.0, 1.0], (2, 6, 1))
REFUSED = {
    "five legs": (dict(base=BASE[:5], platform=PLATFORM[:5]), "Stewart.base must have six rows"),
    "planar points": (dict(base=BASE[:, :2]), "Stewart.base must have shape (any, 3), got (6, 2)"),
    "five platform rows": (
        dict(platform=PLATFORM[:5]),
        "must have shape (6, 3), got (5, 3)",
    ),
    "NaN": (dict(base=BASE * NAN), "Stewart.base must be finite"),
    "infinite platform": (
        dict(platform=replaced(PLATFORM, 0, [np.inf, 0, 0])),
        "platform must be finite",
    ),
    "strings": (dict(base=[["a"] * 3] * 6), "Stewart.base must be real numbers"),
    "one leg twice": (
        dict(base=replaced(BASE, 4, BASE[1]), platform=replaced(PLATFORM, 4, PLATFORM[1])),
        "Stewart.base and platform must not give the same leg twice, got legs 1 and 4",
    ),
    "base on a line": (dict(base=np.outer(np.arange(6.0), [1, 2, 3])), "Stewart.base must not have all six"),
    "platform in a point": (dict(platform=0 * PLATFORM), "Stewart.platform must not have all six"),
    "similar hexagons": (dict(base=hexagon(2.0), platform=hexagon(1.0)), "architecturally singular"),
    "affine copies": (
        dict(base=BASE, platform=BASE @ np.array([[0.5, 0.1, 0], [0.0, 0.4, 0], [0, 0, 1]])),
        "architecturally singular",
    ),
    "a stroke of one number": (dict(stroke=1.0), "Stewart.stroke must have shape (2,) or (6, 2), got ()"),
    "strokes of five legs": (dict(stroke=np.ones((5, 2))), "Stewart.stroke must have shape"),
    "a stroke turned round": (dict(stroke=[2.0, 1.0]), "Stewart.stroke must be 0 < least < greatest"),
    "a stroke of no width": (dict(stroke=[1.0, 1.0]), "Stewart.stroke must be 0 < least < greatest"),
    "a stroke from zero": (dict(stroke=[0.0, 1.0]), "Stewart.stroke must be 0 < least < greatest"),
    "a stroke of NaN": (dict(stroke=[1.0, NAN]), "Stewart.stroke must be finite"),
    "one stroke wrong": (dict(stroke=[[1.0, 2.0]] * 5 + [[2.0, 1.0]]), "Stewart.stroke must be 0 < least"),
    "a cone of zero": (dict(base_cone=0.0), "Stewart.base_cone must be in (0, pi] rad"),
    "a cone beyond pi": (dict(platform_cone=3.2), "Stewart.platform_cone must be in (0, pi] rad"),
    "cones of five legs": (dict(base_cone=np.ones(5)), "Stewart.base_cone must have shape () or (6,)"),
    "axes not unit": (
        dict(base_cone=1.0, cone_axes=1.01 * AXES_UP),
        "cone_axes must be unit vectors",
    ),
    "axes of the base only": (dict(base_cone=1.0, cone_axes=AXES_UP[0]), "cone_axes must have shape"),
}


@pytest.mark.parametrize(("fields", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_impossible_platforms_are_refused(fields, said):
    found = said_by(pk.Stewart, **(dict(base=BASE, platform=PLATFORM) | fields))
    assert found.startswith("Stewart.") and said in found


def test_base_and_platform_in_different_units_are_noticed():
    with pytest.warns(UserWarning, match="one unit"):
        pk.Stewart(base=1000 * BASE, platform=PLATFORM)
    with pytest.warns(UserWarning, match="one unit"):
        pk.Stewart(base=BASE, platform=1000 * PLATFORM)
    pk.Stewart(base=40 * BASE, platform=PLATFORM)  # the tests make warnings errors
