"""Following a path: every pose from the one before, and a stop where lengths cannot tell branches apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax import Status
from pk_jax.geometry.poses import difference

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

SEMI = pk.catalogued("semi-regular-stewart")
NAN = np.nan
OK, LATER = Status.OK, Status.INCOMPLETE


def lengths(pose, mech=SEMI):
    """|t + R b - a| in NumPy."""
    points = np.einsum("...ij,kj->...ki", pose.rotation, mech.platform)
    return np.linalg.norm(np.asarray(pose.translation)[..., None, :] + points - mech.base, axis=-1)


def side(pose):
    """Sign of the determinant of the six leg lines over that at home."""

    def det(t, r):
        arms = np.asarray(SEMI.platform) @ np.asarray(r).T
        legs = t + arms - SEMI.base
        return np.linalg.det(np.concatenate([legs, np.cross(arms, legs)], axis=1))

    return np.sign(det(pose.translation, pose.rotation) * det(np.array([0, 0, 1.0]), np.eye(3)))


def yaws(degrees):
    """Turned about the vertical at height 1."""
    vectors = np.deg2rad(np.asarray(degrees))[..., None] * np.array([0.0, 0.0, 1.0])
    return pk.SE3(np.zeros_like(vectors) + [0, 0, 1], Rotation.from_rotvec(vectors).as_matrix())


def yaw_of(pose):
    return np.rad2deg(np.arctan2(pose.rotation[..., 1, 0], pose.rotation[..., 0, 0]))


def take(tree, rows):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def assert_same_pose(found, expected, atol):
    np.testing.assert_allclose(found.translation, expected.translation, rtol=0, atol=atol)
    np.testing.assert_allclose(found.rotation, expected.rotation, rtol=0, atol=atol)


def circle(rows=32):
    phase = 2 * np.pi * np.arange(rows) / rows
    across = np.stack([np.cos(phase), np.sin(phase), 0 * phase], axis=1)
    place = 0.2 * across + [0, 0, 1] + 0.1 * np.sin(2 * phase)[:, None] * [0, 0, 1]
    turn = Rotation.from_rotvec(0.3 * across[:, [1, 0, 2]]) * Rotation.from_rotvec(0.2 * across[:, [2, 2, 0]])
    return pk.SE3(place, turn.as_matrix())


CIRCLE = circle()
PATH = lengths(CIRCLE)


@pytest.fixture(scope="module")
def followed():
    return pk.track(SEMI, PATH)


def assert_ended(found, ok, status=None):
    """`ok` rows were followed, one told why no more were, and nothing is known of the others."""
    assert int(found.reached) == ok
    np.testing.assert_array_equal(found.status[:ok], OK)
    assert int(found.status[ok]) not in (OK, LATER)
    assert status is None or int(found.status[ok]) == status
    np.testing.assert_array_equal(found.status[ok + 1 :], LATER)
    for leaf in jax.tree.leaves(found.pose):
        assert np.all(np.isfinite(leaf[:ok])) and np.all(np.isnan(leaf[ok:]))
    for leaf in (found.residual, found.sigma_min, found.det_sign):
        assert np.all(np.isnan(leaf[ok + 1 :]))
    np.testing.assert_array_equal(found.steps[ok + 1 :], 0)


# ---------------------------------------------------------------- following


def test_a_circle_is_followed(followed):
    np.testing.assert_array_equal(followed.status, OK)
    assert int(followed.reached) == 32
    assert_same_pose(followed.pose, CIRCLE, 1e-12)
    np.testing.assert_array_equal(followed.det_sign, 1)
    assert np.all(followed.residual < 1e-14) and np.all(followed.sigma_min > 0)


def test_a_path_of_fewer_rows_is_the_beginning_of_it(followed):
    short = pk.track(SEMI, PATH[:17])
    jax.tree.map(np.testing.assert_array_equal, short[:-1], take(followed[:-1], slice(17)))
    assert int(short.reached) == 17


@pytest.mark.soak
def test_a_path_of_one_row():
    found = pk.track(SEMI, PATH[:1].tolist())
    assert found.pose.rotation.shape == (1, 3, 3) and int(found.reached) == 1
    assert_same_pose(found.pose, take(CIRCLE, slice(1)), 1e-12)


@pytest.mark.soak
def test_a_path_from_a_given_start(followed):
    start = take(CIRCLE, 20)
    found = pk.track(SEMI, np.roll(PATH, -20, axis=0), start)
    np.testing.assert_array_equal(found.status, OK)
    assert int(found.steps[0]) <= 2  # it starts where the path does
    assert_same_pose(found.pose, jax.tree.map(lambda leaf: np.roll(leaf, -20, axis=0), CIRCLE), 1e-12)


@pytest.mark.soak
def test_a_start_printed_with_six_digits_gives_the_poses_themselves():
    start = take(CIRCLE, 0)
    found = pk.track(SEMI, PATH, pk.SE3(start.translation, np.round(start.rotation, 6)))
    np.testing.assert_array_equal(found.status, OK)
    assert_same_pose(found.pose, CIRCLE, 1e-9)


@pytest.mark.soak
def test_the_other_branch_is_followed_from_a_start_on_it():
    ramp = yaws(np.linspace(125, 110, 32))
    assert side(take(ramp, 0)) == -1
    found = pk.track(SEMI, lengths(ramp), take(ramp, 0))
    np.testing.assert_array_equal(found.status, OK)
    np.testing.assert_array_equal(found.det_sign, -1)
    assert_same_pose(found.pose, ramp, 1e-12)


# ---------------------------------------------------------------- the singularity


@pytest.mark.parametrize(("step", "offset"), [(1.0, 0.0), (1.0, 0.37), (0.1, 0.0), (5.0, 0.0), (5.0, 2.0)])
def test_a_path_over_the_singularity_ends_there(step, offset):
    """At a yaw of 90 degrees all six legs touch one linear complex (Fichter 1986)."""
    degrees = np.arange(0, 130.001, step) + offset
    if step < 1:  # as many rows as of one degree, which are compiled
        degrees = np.concatenate([np.arange(0, 82, 2.0), 82 + step * np.arange(90)])
    ramp = yaws(degrees)
    found = pk.track(SEMI, lengths(ramp))
    ok = int(found.reached)
    assert_ended(found, ok, Status.SINGULAR)
    assert 90 - 2 * max(step, 2.5) < degrees[ok] <= 90 + step and degrees[ok - 1] < 90
    assert_same_pose(take(found.pose, slice(ok)), take(ramp, slice(ok)), 1e-6)
    assert np.all(np.diff(found.sigma_min[ok // 2 : ok]) < 0)


@pytest.mark.soak
def test_without_the_stop_newton_goes_on_to_another_pose():
    """Each row from the one before: the lengths are met at every yaw, and the pose is not the path's."""
    degrees = np.arange(80, 101.0) + 0.37
    ramp = yaws(degrees)
    pose, reached = take(ramp, 0), []
    for joints in lengths(ramp):
        found = pk.forward_kinematics(SEMI, joints, pose)
        pose = found.candidate
        assert found.residual < 1e-12
        reached.append(float(yaw_of(pose)))
    before, beyond = degrees < 89, degrees > 92
    np.testing.assert_allclose(np.array(reached)[before], degrees[before], rtol=0, atol=1e-6)
    assert np.all(np.abs(np.array(reached)[beyond] - degrees[beyond]) > 1)


def test_the_limit_of_sigma_min_is_the_callers():
    ramp = yaws(np.linspace(0, 62, 32))
    sigma = np.asarray(pk.track(SEMI, lengths(ramp)).sigma_min)
    closest = float((sigma[20] + sigma[21]) / 2)
    assert_ended(pk.track(SEMI, lengths(ramp), closest=closest), 21, Status.SINGULAR)


# ---------------------------------------------------------------- what ends a path


@pytest.mark.parametrize("bad", [NAN, np.inf, 0.0, -1.0])
def test_bad_input_ends_the_path(followed, bad):
    spoiled = PATH.copy()
    spoiled[11, 2] = bad
    found = pk.track(SEMI, spoiled)
    assert_ended(found, 11, Status.BAD_INPUT)
    jax.tree.map(np.testing.assert_array_equal, take(found[:-1], slice(11)), take(followed[:-1], slice(11)))


@pytest.mark.parametrize("far", [[2.5, 0.8] * 3, [9.0, 1, 1, 1, 1, 1], [0.2] * 6, [30.0] * 6])
def test_a_jump_is_not_followed(far):
    path = PATH.copy()
    path[11] = far
    assert_ended(pk.track(SEMI, path), 11)


def test_wrong_paths_are_refused():
    for path, said in (
        (PATH[:0], "joints_path must have one row at least"),
        (PATH[0], r"joints_path must have shape \(any, 6\)"),
        (PATH[:, :5], r"joints_path must have shape \(any, 6\)"),
        (PATH[None], r"joints_path must have shape \(any, 6\)"),
        ("home", "joints_path must be real numbers"),
    ):
        with pytest.raises(ValueError, match=f"^{said}"):
            pk.track(SEMI, path)
    with pytest.raises(ValueError, match=r"^start must be one pose"):
        pk.track(SEMI, PATH, take(CIRCLE, slice(3)))
    with pytest.raises(ValueError, match=r"^start must be a pk_jax\.SE3"):
        pk.track(SEMI, PATH, np.zeros(6))


# ---------------------------------------------------------------- jit, vmap, derivatives


@pytest.mark.soak
def test_many_paths_are_a_loop_of_paths(followed):
    spoiled = PATH.copy()
    spoiled[5] = NAN
    paths = np.stack([PATH, spoiled, np.roll(PATH, 3, axis=0)])
    found = jax.jit(jax.vmap(lambda path: pk.track(SEMI, path)))(paths)
    for k, path in enumerate(paths):
        alone = pk.track(SEMI, path)
        np.testing.assert_array_equal(found.status[k], alone.status)
        assert_same_pose(take(found.pose, k), alone.pose, 1e-12)
        assert int(found.reached[k]) == int(alone.reached)


def weighted(mech, path):
    """A number made of every pose of a path, by tangents from the circle's."""
    found = pk.track(mech, path)
    twists = jax.vmap(difference)(jax.tree.map(jnp.asarray, CIRCLE), found.pose)
    weights = jnp.cos(jnp.arange(twists.size)).reshape(twists.shape)
    return jnp.sum(weights * jnp.where(jnp.isfinite(twists), jnp.sin(twists), 0))


@pytest.mark.soak
def test_derivatives_in_the_lengths_and_the_geometry():
    both = jax.jit(jax.value_and_grad(weighted, argnums=(0, 1)))
    in_mech, in_path = whole = both(SEMI, PATH)[1]
    assert isinstance(in_mech, pk.Stewart)
    rng = np.random.default_rng(1)
    for _ in range(2):
        moves = rng.normal(size=(2, 6, 3)), rng.normal(size=PATH.shape)

        def at(h, moves=moves):
            leaves = (SEMI.base + h * moves[0][0], SEMI.platform + h * moves[0][1])
            return float(both(jax.tree.unflatten(jax.tree.structure(SEMI), leaves), PATH + h * moves[1])[0])

        expected = (at(1e-5) - at(-1e-5)) / 2e-5
        mine = np.sum(in_mech.base * moves[0][0]) + np.sum(in_mech.platform * moves[0][1])
        np.testing.assert_allclose(mine + np.sum(in_path * moves[1]), expected, rtol=1e-7)
    spoiled = PATH.copy()
    spoiled[11] = NAN
    in_mech, in_path = both(SEMI, spoiled)[1]
    assert all(np.all(np.isfinite(leaf)) for leaf in (in_mech.base, in_mech.platform, in_path))
    np.testing.assert_array_equal(in_path[11:], 0)
    np.testing.assert_allclose(in_path[:11], whole[1][:11], rtol=0, atol=1e-12)


@pytest.mark.parametrize("closest", [np.nan, np.inf, -1e-3, 1.0, "near", [1e-4, 1e-3]])
def test_a_threshold_that_is_none_is_refused(closest):
    with pytest.raises(ValueError, match=r"^closest must"):
        pk.track(SEMI, np.ones((2, 6)), closest=closest)
