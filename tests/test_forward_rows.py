"""Forward kinematics of the Stewart platform: many rows, each with its verdict, and exact derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from outsiders import three_legs
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax import Status
from pk_jax.geometry.poses import difference

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

SEMI = pk.catalogued("semi-regular-stewart")
NAN, INF = np.nan, np.inf
RANGES = (35.0, 40.0, 0.35, 0.3)  # tilt, yaw in deg, sideways and up in base radii, all together


def some_poses(mech, count, ranges=RANGES, seed=0):
    """About home: tilted about any horizontal axis, turned, and shifted."""
    rng = np.random.default_rng(seed)
    base = np.asarray(mech.base)[:6]
    size = np.sqrt(np.mean(np.sum((base - base.mean(axis=0)) ** 2, axis=1)))
    tilt, yaw = np.deg2rad(rng.uniform(-1, 1, (2, count)) * np.array(ranges[:2])[:, None])
    around = rng.uniform(0, 2 * np.pi, count)
    axis = np.stack([np.cos(around), np.sin(around), np.zeros(count)], axis=1)
    turn = Rotation.from_rotvec(tilt[:, None] * axis) * Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    home = mech.home()[0]
    shift = size * rng.uniform(-1, 1, (count, 3)) * [ranges[2], ranges[2], ranges[3]]
    return pk.SE3(np.asarray(home.translation) + shift, turn.as_matrix() @ np.asarray(home.rotation))


def lengths(mech, pose):
    """|t + R b - a| in NumPy."""
    points = np.einsum("...ij,kj->...ki", pose.rotation, mech.platform)
    return np.linalg.norm(np.asarray(pose.translation)[..., None, :] + points - mech.base, axis=-1)


def lines(mech, pose):
    """The six leg lines (legs, moments about the platform's origin) over length(), of unit norm."""
    arms = np.einsum("...ij,kj->...ki", pose.rotation, mech.platform)[..., :6, :]
    legs = np.asarray(pose.translation)[..., None, :] + arms - np.asarray(mech.base)[:6]
    joints = np.asarray(mech.platform)[:6]
    size = np.sqrt(np.mean(np.sum((joints - joints.mean(axis=0)) ** 2, axis=1)))
    found = np.concatenate([size * legs, np.cross(arms, legs)], axis=-1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def sides(mech, pose):
    """Sign of det A over its sign at home."""
    return np.sign(np.linalg.det(lines(mech, pose)) * np.linalg.det(lines(mech, mech.home()[0])))


def assert_same_pose(found, expected, atol):
    np.testing.assert_allclose(found.translation, expected.translation, rtol=0, atol=atol)
    np.testing.assert_allclose(found.rotation, expected.rotation, rtol=0, atol=atol)


def take(tree, rows):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


POSES = some_poses(SEMI, 4097)
JOINTS = lengths(SEMI, POSES)


@pytest.fixture(scope="module")
def found():
    return pk.forward_kinematics(SEMI, JOINTS)


# ---------------------------------------------------------------- FK of IK is the identity


def assert_identity(mech, poses, found, size=1.0):
    np.testing.assert_array_equal(found.status, Status.OK)
    np.testing.assert_allclose(lengths(mech, found.pose), lengths(mech, poses), rtol=0, atol=1e-12 * size)
    assert_same_pose(found.pose, poses, 1e-9 * max(size, 1))
    np.testing.assert_array_equal(found.det_sign, sides(mech, poses))
    np.testing.assert_array_equal(found.det_sign, 1)


def test_forward_of_inverse_is_the_identity(found):
    assert_identity(SEMI, POSES, found)
    np.testing.assert_array_equal(found.pose.rotation, found.candidate.rotation)


@pytest.mark.parametrize("name", ["hexapod-log", "linuxcnc-hexapod", "calibration-hexapod"])
def test_forward_of_inverse_is_the_identity_on_published_platforms(name):
    mech = pk.catalogued(name)
    poses = some_poses(mech, 1000, np.array(RANGES) / 3)
    solved = pk.inverse_kinematics(mech, poses)
    np.testing.assert_array_equal(solved.status, Status.OK)
    assert_identity(mech, poses, pk.forward_kinematics(mech, solved.joints))


def test_residual_is_told_afresh(found):
    assert np.all(found.residual < 1e-14)
    assert np.all((found.steps >= 3) & (found.steps <= 10))


def test_sigma_min_bounds_the_least_singular_value(found):
    true = np.linalg.svd(lines(SEMI, POSES), compute_uv=False)[:, -1]
    assert np.all(found.sigma_min <= true * (1 + 1e-9))
    assert np.all(true <= np.sqrt(6) * found.sigma_min * (1 + 1e-9))
    assert np.all(found.sigma_min > 0)


# ---------------------------------------------------------------- one row, many rows, traced rows


def assert_equal_rows(mine, theirs, atol=1e-13):
    np.testing.assert_array_equal(mine.status, theirs.status)
    assert_same_pose(mine.pose, theirs.pose, atol)
    np.testing.assert_array_equal(mine.det_sign, theirs.det_sign)
    np.testing.assert_allclose(mine.sigma_min, theirs.sigma_min, rtol=1e-9)


def test_a_batch_equals_a_loop(found):
    for row in range(5):
        alone = pk.forward_kinematics(SEMI, JOINTS[row])
        assert alone.pose.translation.shape == (3,) and alone.status.shape == ()
        assert_equal_rows(alone, take(found, row))


@pytest.mark.soak
def test_a_batch_equals_the_traced_batch(found):
    traced = jax.jit(lambda q: pk.forward_kinematics(SEMI, q))(JOINTS[:4096])
    assert_equal_rows(traced, take(found, slice(4096)))


@pytest.mark.soak
def test_a_batch_equals_vmapped_rows(found):
    solve = lambda q: pk.forward_kinematics(SEMI, q)
    for function in (solve, jax.vmap(solve)):
        assert_equal_rows(jax.jit(function)(JOINTS[:65]), take(found, slice(65)))


@pytest.mark.parametrize("size", [0, 1, 63, 64, 65, 4096, 4097])
def test_any_number_of_rows_gives_the_same_rows(found, size):
    mine = pk.forward_kinematics(SEMI, JOINTS[:size])
    assert mine.pose.rotation.shape == (size, 3, 3) and mine.status.shape == (size,)
    jax.tree.map(np.testing.assert_array_equal, mine, take(found, slice(size)))


def test_anything_like_an_array_will_do(found):
    for make in (jnp.asarray, np.asfortranarray, lambda q: q.tolist(), lambda q: list(map(tuple, q))):
        mine = pk.forward_kinematics(SEMI, make(JOINTS[:7]))
        jax.tree.map(np.testing.assert_array_equal, mine, take(found, slice(7)))
    strided = np.repeat(JOINTS[:7], 2, axis=0)[::2]
    jax.tree.map(np.testing.assert_array_equal, pk.forward_kinematics(SEMI, strided), take(found, slice(7)))
    rounded = pk.forward_kinematics(SEMI, JOINTS[:7].astype(np.float32))
    assert rounded.pose.rotation.dtype == jnp.float64
    exact = lengths(SEMI, rounded.pose)
    np.testing.assert_allclose(exact, JOINTS[:7].astype(np.float32).astype(float), rtol=0, atol=1e-12)


def test_the_input_is_left_alone():
    joints = JOINTS[:70].copy()
    joints[3] = NAN
    before = joints.copy()
    pk.forward_kinematics(SEMI, joints)
    np.testing.assert_array_equal(joints, before)


# ---------------------------------------------------------------- a guess


def test_a_guess_a_row_and_a_guess_for_all(found):
    near = some_poses(SEMI, 70, seed=5)
    each = pk.forward_kinematics(SEMI, JOINTS[:70], near)
    assert_same_pose(each.pose, take(POSES, slice(70)), 1e-9)
    warm = pk.forward_kinematics(SEMI, JOINTS[:70], take(POSES, slice(70)))
    np.testing.assert_array_equal(warm.status, Status.OK)
    assert np.all(warm.steps <= 2)
    one = pk.forward_kinematics(SEMI, JOINTS[:70], near[0])
    assert_same_pose(one.pose, each.pose, 1e-9)
    lost = pk.SE3(near.translation.at[4].set(NAN), near.rotation)
    spoiled = pk.forward_kinematics(SEMI, JOINTS[:70], lost)
    assert int(spoiled.status[4]) == Status.BAD_INPUT and np.all(np.isnan(spoiled.pose.rotation[4]))
    others = np.delete(np.arange(70), 4)
    jax.tree.map(np.testing.assert_array_equal, take(spoiled, others), take(each, others))
    many = pk.forward_kinematics(SEMI, JOINTS[0], near)  # one row from many guesses
    assert_same_pose(many.pose, take(POSES, np.zeros(70, int)), 1e-9)


def test_a_guess_printed_with_six_digits_gives_the_pose_itself():
    """It passes for a rotation at the door; the answer is one to roundoff."""
    printed = pk.SE3(POSES.translation[:70], np.round(POSES.rotation[:70], 6))
    mine = pk.forward_kinematics(SEMI, JOINTS[:70], printed)
    np.testing.assert_array_equal(mine.status, Status.OK)
    assert_same_pose(mine.pose, take(POSES, slice(70)), 1e-9)


def test_a_traced_guess_that_is_no_rotation_is_never_ok():
    at = np.array([0.0, 0.0, 1.0])
    solve = jax.jit(lambda r: pk.forward_kinematics(SEMI, JOINTS[0], pk.SE3(at, r)).status)
    assert int(solve(np.eye(3))) == Status.OK
    for rotation in (1.2 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3))):
        assert int(solve(rotation)) != Status.OK


@pytest.mark.parametrize(
    "guess",
    [np.zeros(6), "home", [1.0], POSES[:3], POSES[:0]],
    ids=["an array", "a string", "a list", "three rows", "no row"],
)
def test_a_wrong_guess_is_told(guess):
    said = r"^(guess must be a pk_jax.SE3|batched arguments must)"
    with pytest.raises(ValueError, match=said) as caught:
        pk.forward_kinematics(SEMI, JOINTS[:5], guess)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- lost rows

BAD = {
    "NaN": ([1, NAN, 1, 1, 1, 1], {Status.BAD_INPUT}),
    "infinite": ([INF, 1, 1, 1, 1, 1], {Status.BAD_INPUT}),
    "minus infinite": ([1, 1, 1, 1, 1, -INF], {Status.BAD_INPUT}),
    "zero": ([1, 1, 0, 1, 1, 1], {Status.BAD_INPUT}),
    "negative": ([1, 1, 1, -1.2, 1, 1], {Status.BAD_INPUT}),
    "unreachable": ([3, 0.1, 3, 0.1, 3, 0.1], {Status.STALLED, Status.STEP_LIMIT}),
    "one leg far too long": ([9, 1, 1, 1, 1, 1], {Status.STALLED, Status.STEP_LIMIT}),
    "far outside": ([40, 1, 1, 40, 1, 1], {Status.STALLED, Status.STEP_LIMIT}),
    "tiny": ([1e-9] * 6, {Status.STALLED, Status.STEP_LIMIT}),
}
AT = 7 * np.arange(1, len(BAD) + 1)  # rows of the spoiled batch
SPOILED = JOINTS[:70].copy()
SPOILED[AT] = [row for row, _ in BAD.values()]
OTHERS = np.delete(np.arange(70), AT)


def test_lost_rows_have_their_status_and_change_no_other_row(found):
    mine = pk.forward_kinematics(SEMI, SPOILED)
    for row, (name, (_, statuses)) in zip(AT, BAD.items(), strict=True):
        assert Status(int(mine.status[row])) in statuses, name
    for leaf in jax.tree.leaves(mine.pose):
        assert np.all(np.isnan(np.asarray(leaf)[AT]))
    is_bad = np.asarray(mine.status) == Status.BAD_INPUT
    for leaf in (mine.residual, mine.sigma_min, mine.det_sign, *jax.tree.leaves(mine.candidate)):
        assert np.all(np.isnan(np.asarray(leaf)[is_bad])) and np.all(np.isfinite(np.asarray(leaf)[~is_bad]))
    jax.tree.map(np.testing.assert_array_equal, take(mine, OTHERS), take(found, OTHERS))
    ended = take(mine, AT[~is_bad[AT]])  # where the search ended is judged as solutions are
    inverse = np.linalg.inv(lines(SEMI, ended.candidate))
    np.testing.assert_allclose(ended.sigma_min, 1 / np.linalg.norm(inverse, axis=(1, 2)), rtol=1e-6)


def test_one_lost_row_alone():
    for row in (AT[0], AT[5]):
        alone = pk.forward_kinematics(SEMI, SPOILED[row])
        assert int(alone.status) in {Status.BAD_INPUT, Status.STALLED, Status.STEP_LIMIT}
        assert np.all(np.isnan(alone.pose.rotation))


def test_gradients_of_lost_rows_are_zero_and_of_the_others_untouched():
    def total(q):
        return sum(jnp.nansum(jnp.sin(leaf)) for leaf in jax.tree.leaves(pk.forward_kinematics(SEMI, q).pose))

    gradient = jax.jit(jax.grad(total))
    clean, dirty = gradient(JOINTS[:70]), gradient(SPOILED)
    assert np.all(np.isfinite(clean)) and np.all(np.any(np.asarray(clean) != 0, axis=1))
    np.testing.assert_array_equal(dirty[AT], 0)
    np.testing.assert_allclose(dirty[OTHERS], clean[OTHERS], rtol=0, atol=1e-13)


def test_beyond_the_singularity_nothing_is_ok_with_the_other_sign():
    poses = some_poses(SEMI, 4096, (80.0, 120.0, 1.0, 0.7), seed=2)
    assert np.any(sides(SEMI, poses) < 0)  # lengths that have a solution on the other side at least
    mine = pk.forward_kinematics(SEMI, lengths(SEMI, poses))
    status = np.asarray(mine.status)
    is_ok, is_other = status == Status.OK, status == Status.OTHER_MODE
    assert np.any(is_ok) and np.any(is_other)
    np.testing.assert_array_equal(np.asarray(mine.det_sign)[is_ok], 1)
    np.testing.assert_array_equal(sides(SEMI, take(mine.pose, is_ok)), 1)
    np.testing.assert_array_equal(sides(SEMI, take(mine.candidate, is_other)), -1)  # told for a reason
    found = lengths(SEMI, take(mine.candidate, is_ok | is_other))
    np.testing.assert_allclose(found, lengths(SEMI, take(poses, is_ok | is_other)), rtol=0, atol=1e-12)
    for leaf in jax.tree.leaves(mine.pose):
        is_nan = np.isnan(np.asarray(leaf)).reshape(len(status), -1)
        np.testing.assert_array_equal(is_nan.all(axis=1), ~is_ok)
        np.testing.assert_array_equal(is_nan.any(axis=1), ~is_ok)


def test_lengths_in_another_unit_are_noticed():
    with pytest.warns(UserWarning, match="are they in one unit"):
        pk.forward_kinematics(SEMI, 1000 * JOINTS[:3])


# ---------------------------------------------------------------- redundant: sensors

MORE = np.array([[0.9, 0.1, 0.0], [-0.6, 0.8, 0.0], [-0.3, -0.7, 0.1]])
NINE = pk.Stewart(
    base=np.concatenate([SEMI.base, MORE]), platform=np.concatenate([SEMI.platform, 0.4 * MORE[::-1]])
)
NINE_POSES = some_poses(NINE, 65, seed=6)
NINE_JOINTS = lengths(NINE, NINE_POSES)


def test_sensors_agree_or_are_inconsistent():
    off, noisy = NINE_JOINTS.copy(), NINE_JOINTS.copy()
    off[:, 7] += 1e-3
    noisy += np.random.default_rng(7).uniform(-1e-9, 1e-9, noisy.shape)
    exact, wrong, near = (pk.forward_kinematics(NINE, q) for q in (NINE_JOINTS, off, noisy))
    np.testing.assert_array_equal(exact.status, Status.OK)
    assert_same_pose(exact.pose, NINE_POSES, 1e-12)
    np.testing.assert_array_equal(exact.det_sign, sides(NINE, NINE_POSES))
    np.testing.assert_array_equal(wrong.status, Status.INCONSISTENT)
    assert np.all(np.isnan(wrong.pose.rotation)) and np.all(wrong.residual > 1e-5)
    np.testing.assert_array_equal(near.status, Status.OK)
    for joints, pose in ((noisy, near.pose), (off, wrong.candidate)):  # stationary: A^T F = 0
        arms = np.einsum("...ij,kj->...ki", pose.rotation, NINE.platform)
        legs = np.asarray(pose.translation)[:, None] + arms - NINE.base
        jacobian = np.concatenate([legs, np.cross(arms, legs)], axis=-1)
        value = (np.sum(legs**2, axis=-1) - joints**2) / 2
        np.testing.assert_allclose(np.einsum("rkn,rk->rn", jacobian, value), 0, rtol=0, atol=1e-14)


def test_sensors_bound_sigma_min():
    mine = pk.forward_kinematics(NINE, NINE_JOINTS)
    arms = np.einsum("...ij,kj->...ki", NINE_POSES.rotation, NINE.platform)
    legs = np.asarray(NINE_POSES.translation)[:, None] + arms - NINE.base
    rows = np.concatenate([0.45368859 * legs, np.cross(arms, legs)], axis=-1)
    true = np.linalg.svd(rows / np.linalg.norm(rows, axis=-1, keepdims=True), compute_uv=False)[:, -1]
    assert np.all(mine.sigma_min <= true * (1 + 1e-9))
    assert np.all(true <= np.sqrt(6) * mine.sigma_min * (1 + 1e-9))


def test_three_legs_on_a_point():
    spare, pose = three_legs(), np.array([[0.7, 0.9], [1.0, 0.4]])
    joints = np.linalg.norm(pose[:, None] - spare.base, axis=-1)
    mine = pk.forward_kinematics(spare, joints)
    np.testing.assert_array_equal(mine.status, Status.OK)
    np.testing.assert_allclose(mine.pose, pose, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(mine.det_sign, 0)


# ---------------------------------------------------------------- derivatives


def slide(reference):
    """The pose as six numbers, from a reference pose on."""
    return lambda mech, q: difference(reference, pk.forward_kinematics(mech, q).pose)


AT_ROW = POSES[0]
coordinates = slide(AT_ROW)


@pytest.fixture(scope="module")
def slopes():
    """Jacobians in the lengths, forward and reverse, and the geometry's gradients along three directions."""

    @jax.jit
    def evaluate(mech, q):
        forward = jax.jacfwd(coordinates, argnums=1)(mech, q)
        return forward, *jax.jacrev(coordinates, argnums=(1, 0))(mech, q)

    return evaluate


def central(function, step):
    return (function(step) - function(-step)) / (2 * step)


def by_rows(mech, joints):
    """Coordinates of many rows, through the compiled blocks and not the traced row."""
    pose = pk.forward_kinematics(mech, joints).pose
    return np.asarray(jax.vmap(lambda pose: difference(AT_ROW, pose))(pose))


def test_slopes_in_the_lengths(slopes):
    forward, reverse, _ = slopes(SEMI, JOINTS[0])
    expected = central(lambda h: by_rows(SEMI, JOINTS[0] + h * np.eye(6)), 1e-5).T
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(forward / size, expected / size, rtol=0, atol=1e-8)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-13 * size)


def test_slopes_in_the_geometry(slopes):
    gradient, at = slopes(SEMI, JOINTS[0])[2], jax.jit(coordinates)
    assert isinstance(gradient, pk.Stewart)
    rng = np.random.default_rng(8)
    for _ in range(3):
        moves = rng.normal(size=(2, 6, 3))

        def moved(h, moves=moves):
            leaves = (SEMI.base + h * moves[0], SEMI.platform + h * moves[1])
            return np.asarray(at(jax.tree.unflatten(jax.tree.structure(SEMI), leaves), JOINTS[0]))

        expected = central(moved, 1e-5)
        pairs = zip((gradient.base, gradient.platform), moves, strict=True)
        mine = sum(np.einsum("nkd,kd->n", *pair) for pair in pairs)
        size = np.max(np.abs(expected))
        np.testing.assert_allclose(mine / size, expected / size, rtol=0, atol=1e-8)


@pytest.mark.soak
def test_second_derivatives(slopes):
    second = jax.jit(jax.jacfwd(jax.jacfwd(coordinates, argnums=1), argnums=1))(SEMI, JOINTS[0])
    direction = np.array([0.3, -0.5, 0.2, 0.7, -0.1, 0.4])
    expected = central(lambda h: np.asarray(slopes(SEMI, JOINTS[0] + h * direction)[0]), 1e-5)
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(second @ direction / size, expected / size, rtol=0, atol=1e-5)
    np.testing.assert_allclose(second, np.swapaxes(second, 1, 2), rtol=0, atol=1e-11 * size)


@pytest.mark.soak
def test_slopes_of_least_squares():
    """With sensors that disagree a little the residual's curvature counts; where too much, the slope is 0."""
    reference = NINE_POSES[0]
    rate = jax.jit(jax.jacrev(slide(reference), argnums=1))
    joints = NINE_JOINTS[0] + 4e-7 * np.array([0, 0, 0, 0, 0, 0, 1, -1, 1])

    def rows(h):
        pose = pk.forward_kinematics(NINE, joints + h * np.eye(9)).candidate
        return np.asarray(jax.vmap(lambda pose: difference(reference, pose))(pose))

    expected = central(rows, 1e-5).T
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(rate(NINE, joints) / size, expected / size, rtol=0, atol=1e-8)
    joints[8] += 1e-4
    assert int(pk.forward_kinematics(NINE, joints).status) == Status.INCONSISTENT
    np.testing.assert_array_equal(rate(NINE, joints), 0)


# ---------------------------------------------------------------- float32


def test_float32():
    short = pk.Stewart(base=np.asarray(SEMI.base, np.float32), platform=np.asarray(SEMI.platform, np.float32))
    mine = pk.forward_kinematics(short, JOINTS[:65])
    np.testing.assert_array_equal(mine.status, Status.OK)
    for leaf in (*jax.tree.leaves(mine.pose), mine.residual, mine.sigma_min):
        assert leaf.dtype == jnp.float32
    assert_same_pose(mine.pose, take(POSES, slice(65)), 1e-5)


# ---------------------------------------------------------------- inverse


def test_inverse_of_poses_in_space():
    solved = pk.inverse_kinematics(SEMI, POSES[:70])
    np.testing.assert_array_equal(solved.status, Status.OK)
    np.testing.assert_allclose(solved.joints, JOINTS[:70], rtol=1e-15)
    rotation = np.array(POSES.rotation[:70])
    rotation[3] = NAN
    lost = pk.inverse_kinematics(SEMI, pk.SE3(POSES.translation[:70], rotation))
    assert int(lost.status[3]) == Status.BAD_INPUT and np.all(np.isnan(lost.joints[3]))
    np.testing.assert_array_equal(np.delete(lost.joints, 3, axis=0), np.delete(solved.joints, 3, axis=0))


def test_a_traced_rotation_that_is_none_is_bad_input():
    solve = jax.jit(lambda t, r: pk.inverse_kinematics(SEMI, pk.SE3(t, r)).status)
    for rotation in (1.01 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3))):
        assert int(solve(np.array([0.0, 0, 1]), rotation)) == Status.BAD_INPUT
    assert int(solve(np.array([0.0, 0, 1]), np.eye(3))) == Status.OK


@pytest.mark.parametrize("pose", [np.zeros(6), np.zeros((4, 4)), None, "home", (np.zeros(3), np.eye(3))])
def test_what_is_no_pose_is_told_in_one_line(pose):
    with pytest.raises(ValueError, match=r"^pose must be a pk_jax\.SE3, got \w+$"):
        pk.inverse_kinematics(SEMI, pose)


@pytest.mark.parametrize("rows", [(), (3,)])
def test_known_rows_inside_a_jit_are_solved_there(rows):
    pose = SEMI.home()[0]
    q = np.broadcast_to(np.asarray(SEMI.home()[1]), (*rows, 6))
    height = jax.jit(lambda x: x * pk.forward_kinematics(SEMI, q, pose).pose.translation[..., 2])(2.0)
    np.testing.assert_allclose(height, np.full(rows, 2.0), rtol=1e-12)
