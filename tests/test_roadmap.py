"""Which assembly modes are connected without a type II singularity."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import outsiders
import pytest
from jax import lax
from refusals import said_by

import pk_jax as pk
from pk_jax.kinematics.modes import roadmap

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

STEWART = pk.catalogued("semi-regular-stewart")
RPR = pk.PlanarRPR(  # six real modes at LENGTHS
    base=[[0, 0], [15.91, 0], [0, 10]], platform=[[0, 0], [17.04, 0], [13.218, 16.113]]
)
LENGTHS = np.array([14.98, 15.38, 12.0])


def made(poses, is_real, signs):
    """Modes as `assembly_modes` gives them, of poses that are known to be some."""
    full = lambda value: np.full(len(signs), value)
    return pk.AssemblyModes(
        poses=poses,
        is_real=np.asarray(is_real),
        count=np.int32(np.sum(is_real)),
        fates=full(0),
        is_complete=np.bool_(False),
        expected=np.int32(-1),
        status=np.int32(0),
        residual=full(0.0),
        sigma_min=full(0.5),
        det_sign=np.asarray(signs),
        mirror=full(-1),
        is_certified=full(False),
        radius=full(np.nan),
        retries=np.int32(0),
        method="search",
    )


linearized = jax.jit(lambda mech, pose, joints: mech.linearize(pose, joints))


def modes_near(mech, joints, near):
    """The assembly modes by Newton from each pose of `near` (slots, n)."""
    found, signs = [], []
    for pose in np.array(near, float):
        for _ in range(10):
            value, a = linearized(mech, pose, jnp.asarray(joints))
            step = np.linalg.lstsq(a, value)[0]
            pose = pose - step
        np.testing.assert_allclose(step, 0, atol=1e-12)
        found.append(pose)
        signs.append(np.sign(np.linalg.det(a)))
    at_home = np.sign(np.linalg.det(linearized(mech, *mech.home())[1]))
    return made(np.array(found), [True] * len(found), at_home * np.array(signs))


inverses = jax.jit(lambda mech, poses: jax.vmap(mech.inverse)(poses))
inverse_in = jax.jit(lambda mech, pose, branch: mech.inverse(pose, branch))
between = jax.jit(roadmap._between)


@pytest.fixture(scope="module")
def stewart():
    """Legs a little off those of home: joints, modes, connections.

    Four modes above the base, their images below it, slot 7 - k that of slot k, and a slot that is no pose.
    """
    joints = np.asarray(STEWART.home()[1]) * [1.01, 0.99, 1.02, 1.0, 0.98, 1.01]
    near = [
        ([-0.02, -0.03, 1.00], [-0.02, 0.04, 0.01]),
        ([-0.29, 0.15, 0.75], [0.89, 1.69, 0.01]),
        ([-0.01, -0.34, 0.75], [-1.84, 0.05, 0.01]),
        ([0.28, 0.13, 0.73], [1.06, -1.8, 0.01]),
    ]
    above = [stewart_mode(joints, np.array(at), turned(np.array(turn))) for at, turn in near]
    mirror = np.diag([1.0, 1.0, -1.0])
    both = above + [(mirror @ at, mirror @ turn @ mirror) for at, turn in above[::-1]]
    poses = pk.SE3(*(np.stack([*part, np.full_like(part[0], np.nan)]) for part in zip(*both, strict=True)))
    a = [stewart_matrix(STEWART, *each) for each in [leaves(STEWART.home()[0]), *both]]
    signs = np.sign(np.linalg.det(a))
    modes = made(poses, np.arange(9) < 8, np.append(signs[1:] * signs[0], np.nan))
    return joints, modes, pk.connect_modes(STEWART, joints, modes)


def turned(w):
    """The rotation of Cayley's vector w."""
    k = np.cross(np.eye(3), -w / 2).T
    return np.linalg.solve(np.eye(3) - k, np.eye(3) + k)


def stewart_mode(joints, at, turn):
    """The pose (3,), (3, 3) of these joints, by Newton."""
    for _ in range(8):
        arms = np.asarray(STEWART.platform) @ turn.T
        legs = at + arms - np.asarray(STEWART.base)
        step = np.linalg.solve(
            np.hstack([legs, np.cross(arms, legs)]), (joints**2 - np.sum(legs**2, axis=1)) / 2
        )
        at, turn = at + step[:3], turned(step[3:]) @ turn
    np.testing.assert_allclose(step, 0, atol=1e-13)
    return at, turn


@pytest.fixture(scope="module")
def rpr():
    near = [
        [-8.7, 12.2, -1.0],
        [-5.5, -13.9, 0.0],
        [-14.9, 1.5, 0.2],
        [-13.5, -6.6, 0.6],
        [14.9, -1.3, 1.0],
        [14.7, -3.0, 2.1],
    ]
    modes = modes_near(RPR, LENGTHS, near)
    return modes, pk.connect_modes(RPR, LENGTHS, modes)


def leaves(pose):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(pose)]


# --- A of both platforms in NumPy, each row a leg, lengths over the platform's radius


def stewart_matrix(mech, translation, rotation):
    arms = np.asarray(mech.platform) @ rotation.T
    legs = translation + arms - np.asarray(mech.base)
    rows = np.hstack([legs * float(mech.length()), np.cross(arms, legs)])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def rpr_matrix(mech, pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    arms = np.asarray(mech.platform) @ np.array([[c, s], [-s, c]])
    legs = pose[:2] + arms - np.asarray(mech.base)
    turning = arms[:, 0] * legs[:, 1] - arms[:, 1] * legs[:, 0]
    rows = np.column_stack([legs * float(mech.length()), turning])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def matrices(mech, poses):
    if isinstance(poses, pk.SE3):
        return np.array([stewart_matrix(mech, t, r) for t, r in zip(*leaves(poses), strict=True)])
    return np.array([rpr_matrix(mech, pose) for pose in np.asarray(poses)])


def denser(poses, times=10):
    """Poses between the waypoints: chords of their entries, rotations made orthonormal again."""
    share = np.arange(times) / times
    split = lambda leaf: np.concatenate(
        [a + (b - a) * share.reshape(-1, *[1] * a.ndim) for a, b in itertools.pairwise(leaf)]
    )
    parts = [split(leaf) for leaf in leaves(poses)]
    if isinstance(poses, pk.SE3):
        u, _, v = np.linalg.svd(parts[1])
        return pk.SE3(parts[0], u @ v)
    return parts[0]


def check_path(mech, poses, first, last, clearance):
    for found, wanted in ((poses[0], first), (poses[-1], last)):
        for leaf, leaf_wanted in zip(leaves(found), leaves(wanted), strict=True):
            off = leaf - leaf_wanted
            if not isinstance(first, pk.SE3):
                off[2] = np.angle(np.exp(1j * off[2]))
            assert np.abs(off).max() < 1e-9
    shift, turn = leaves(poses) if isinstance(poses, pk.SE3) else (poses[:, :2], np.asarray(poses)[:, 2:])
    assert np.abs(np.diff(shift, axis=0)).max() < 0.25 * float(mech.length())
    assert np.abs(np.diff(turn, axis=0)).max() < np.pi / 32 + 1e-9
    at = matrices(mech, poses)
    sigma = np.linalg.svd(at, compute_uv=False)[:, -1]
    assert np.isclose(sigma.min(), clearance, rtol=1e-9)
    assert np.all(np.linalg.norm(np.diff(at, axis=0), axis=(1, 2)) < np.minimum(sigma[1:], sigma[:-1]) / 2)
    dense = matrices(mech, denser(poses))
    assert len(set(np.sign(np.linalg.det(dense)))) == 1
    assert np.linalg.svd(dense, compute_uv=False)[:, -1].min() > clearance / 2


def check_paths(mech, modes, found):
    assert set(found.paths) == set(np.flatnonzero(found.to_home == pk.Link.PATH))
    assert np.array_equal(np.isfinite(found.clearance), found.to_home == pk.Link.PATH)
    for slot, poses in found.paths.items():
        check_path(mech, poses, mech.home()[0], modes.poses[slot], found.clearance[slot])


# --- a platform in space


def test_every_path_of_a_platform_is_clear(stewart):
    _, modes, found = stewart
    assert found.to_home.dtype == np.int8
    assert found.to_home[0] == pk.Link.PATH  # the mode next to home
    assert found.to_home.tolist() == [1, -1, -1, -1, 1, 1, 1, -1, 0]
    check_paths(STEWART, modes, found)


def test_the_mirror_image_below_the_base_is_out_of_reach(stewart):
    """A reflection in the plane of a flat base and platform turns the sign of det A."""
    _, modes, found = stewart
    image = 7
    assert leaves(modes.poses[0])[0][2] > 0 > leaves(modes.poses[image])[0][2]
    assert found.to_home[image] == pk.Link.IMPOSSIBLE and image not in found.paths
    signs = [np.linalg.det(matrices(STEWART, modes.poses)[slot]) for slot in (0, image)]
    assert signs[0] * signs[1] < 0


def test_groups_have_one_sign_each_and_slots_that_are_no_pose_have_none(stewart):
    _, modes, found = stewart
    assert np.all(found.group[~modes.is_real] == -1) and np.all(found.to_home[~modes.is_real] == 0)
    assert np.array_equal(found.group == 0, found.to_home == pk.Link.PATH)
    for group in set(found.group[modes.is_real]):
        assert len(set(modes.det_sign[found.group == group])) == 1
    assert set(found.group[modes.is_real]) == {0, 1}  # the images of ways are ways


def test_it_finds_the_same_again(stewart):
    joints, modes, found = stewart
    again = pk.connect_modes(STEWART, joints, modes)
    jax.tree.map(np.testing.assert_array_equal, found, again)


@pytest.mark.soak
def test_limits_close_ways(stewart):
    joints, modes, free = stewart
    ends = np.stack([joints, np.asarray(STEWART.home()[1])])
    stroke = np.stack([ends.min(axis=0) - 0.1, ends.max(axis=0) + 0.1], axis=1)
    tight = pk.Stewart(base=STEWART.base, platform=STEWART.platform, stroke=stroke)
    np.testing.assert_allclose(leaves(tight.home()[0])[1], np.eye(3), atol=1e-12)
    others = (free.to_home == pk.Link.PATH) & (np.arange(len(free.to_home)) > 0)
    shut = pk.connect_modes(tight, joints, modes, within_limits=True, nodes=64)
    assert shut.to_home[0] == pk.Link.PATH and np.all(shut.to_home[others] == pk.Link.NOT_FOUND)
    assert np.all(shut.to_home[free.to_home == pk.Link.IMPOSSIBLE] == pk.Link.IMPOSSIBLE)
    for poses in shut.paths.values():
        lengths = np.asarray(inverses(tight, poses))
        assert np.all((lengths >= tight.stroke[:, 0]) & (lengths <= tight.stroke[:, 1]))
    ignored = pk.connect_modes(tight, joints, modes)
    assert np.all(ignored.to_home[others] == pk.Link.PATH)


def test_a_mode_outside_the_limits_is_not_reached(rpr):
    modes, free = rpr
    low, high = LENGTHS - 1, LENGTHS + 1
    high[2] = LENGTHS[2] - 0.5
    at_home = RPR.home()[1]
    stroke = np.stack([np.minimum(low, at_home - 1), high], axis=1)
    mech = pk.PlanarRPR(base=RPR.base, platform=RPR.platform, stroke=stroke)
    found = pk.connect_modes(mech, LENGTHS, modes, within_limits=True)
    assert not found.paths and np.all(found.to_home != pk.Link.PATH) and free.paths
    assert len(set(found.group[modes.is_real])) == modes.count  # each alone


# --- platforms in the plane


@pytest.mark.soak
def test_a_planar_platform_changes_its_mode_without_a_singularity(rpr):
    """All modes of one sign are linked; the joints of the way lead from the one to the other, and back to
    themselves: the phenomenon of Zein, Wenger and Chablat, "Non-singular assembly-mode changing motions for
    3-RPR parallel manipulators".
    """
    modes, found = rpr
    assert modes.count == 6 and sorted(modes.det_sign) == [-1] * 3 + [1] * 3
    assert np.array_equal(found.to_home, np.where(modes.det_sign > 0, pk.Link.PATH, pk.Link.IMPOSSIBLE))
    assert np.array_equal(found.group, np.where(modes.det_sign > 0, 0, 1))
    check_paths(RPR, modes, found)
    first, *others = found.paths
    for other in others:
        way = np.concatenate([np.asarray(found.paths[first])[::-1], np.asarray(found.paths[other])])
        joints = inverses(RPR, way)
        np.testing.assert_allclose(joints[0], joints[-1], rtol=1e-9)
        followed = pk.track(RPR, joints, way[0])
        assert np.all(followed.status == pk.Status.OK)
        np.testing.assert_allclose(followed.pose[:, :2], way[:, :2], atol=1e-6)
        np.testing.assert_allclose(np.exp(1j * followed.pose[:, 2]), np.exp(1j * way[:, 2]), atol=1e-6)


@pytest.mark.parametrize("nodes", [1, 512])
def test_where_the_straight_way_will_do_it_is_taken(rpr, nodes):
    modes, _ = rpr
    alone = modes._replace(is_real=np.arange(6) == 2)
    found = pk.connect_modes(RPR, LENGTHS, alone, nodes=nodes)
    assert np.array_equal(found.group, np.where(alone.is_real, 0, -1)) and list(found.paths) == [2]
    np.testing.assert_allclose(np.diff(found.paths[2], 2, axis=0), 0, atol=1e-9)


def test_progress_is_told(rpr):
    said = []
    pk.connect_modes(RPR, LENGTHS, rpr[0], nodes=1, report=lambda *each: said.append(each))
    assert [each[1:] for each in said] == [(1, 2), (2, 2)]


# --- points, arms, more actuators than needed


@pytest.mark.parametrize("turn", [-0.3, 0.0, 0.2])
def test_the_modes_of_a_five_bar_are_never_linked(turn):
    mech = pk.catalogued("5-link")
    joints = np.asarray(mech.home()[1]) + [turn, 0.1]
    modes = modes_near(mech, joints, [[0, 0.4], [0, -0.2]])
    found = pk.connect_modes(mech, joints, modes)
    assert np.ptp(modes.poses[:, 1]) > 0.1
    assert sorted(found.to_home) == [pk.Link.IMPOSSIBLE, pk.Link.PATH]
    assert sorted(found.group) == [0, 1]


def test_modes_with_other_elbows_are_not_found_and_have_groups_of_their_own():
    mech = pk.catalogued("3-rrr")
    joints = np.array([-2.48, 1.35, 2.25])
    modes = modes_near(
        mech, joints, [[-0.06, 0.23, -0.93], [-0.17, -0.12, 0.36], [-0.2, -0.09, 0.75], [-0.19, -0.06, 0.93]]
    )
    found = pk.connect_modes(mech, joints, modes)
    assert np.all(differ(inverses(mech, modes.poses), joints) > 0.1)
    assert sorted(modes.det_sign) == [-1, -1, 1, 1] and not found.paths
    assert np.array_equal(found.to_home, np.where(modes.det_sign > 0, pk.Link.NOT_FOUND, pk.Link.IMPOSSIBLE))
    one, other = (set(found.group[modes.det_sign == sign]) for sign in (1, -1))
    assert not one & other and 0 not in one | other
    assert len(one | other) < 4  # all have the same elbows, and some are linked


def test_of_modes_with_different_elbows_those_of_home_are_reached():
    mech = pk.catalogued("3-rrr")
    joints = np.array([-1.23, 0.03, 2.13])
    modes = modes_near(
        mech, joints, [[0.12, -0.08, -1.28], [-0.16, 0.13, 0.24], [-0.1, 0.19, 0.61], [0.0, 0.07, 1.72]]
    )
    found = pk.connect_modes(mech, joints, modes)
    is_home = differ(inverses(mech, modes.poses), joints) < 1e-9
    assert is_home.sum() == 1
    assert np.array_equal(is_home, found.to_home == pk.Link.PATH) and np.array_equal(
        is_home, found.group == 0
    )
    driven = inverses(mech, found.paths[int(np.argmax(is_home))])
    assert differ(driven[-1:], joints) < 1e-9 and differ(driven[:1], mech.home()[1]) < 1e-9
    assert differ(driven[1:], driven[:-1]).max() < 0.2


def differ(joints, others):
    return np.abs(np.exp(1j * np.asarray(joints)) - np.exp(1j * np.asarray(others))).max(axis=1)


@pytest.mark.soak
def test_redundant_actuation_rules_nothing_out():
    """A mode of the four arms as at home is reached; one with an elbow turned is not found."""
    mech = pk.catalogued("4-rrr")
    pose = np.asarray(mech.home()[0]) + [0.05, -0.02, 0.4]
    for branch, link in (([1.0, 1, 1, 1], pk.Link.PATH), ([1.0, 1, 1, -1], pk.Link.NOT_FOUND)):
        joints = inverse_in(mech, pose, jnp.array(branch))
        found = pk.connect_modes(mech, joints, made(pose[None], [True], [0.0]))
        assert found.to_home.tolist() == [link] and found.group.tolist() == [1 - link]


# --- joints that a pose leaves free


class Orbiting(pk.LegMechanism):
    """Two lengths hold a point; the foot of the first one goes round the foot of the second."""

    radius: jax.Array

    joint_units = (1, 1, 0)
    free_joints = 1

    def attachments(self):
        return jnp.zeros((2, 2))

    def feet(self, angle):
        return self.radius * jnp.stack([jnp.stack([jnp.cos(angle), jnp.sin(angle)]), jnp.zeros(2)])

    def legs(self, points, joints):
        return (jnp.sum((points - self.feet(joints[2])) ** 2, axis=1) - joints[:2] ** 2) / 2

    def inverse(self, pose, branch=None, *, free=None):
        angle = 0.0 if free is None else jnp.reshape(free, ())
        return jnp.append(jnp.linalg.norm(pose - self.feet(angle), axis=1), angle)

    def home(self):
        pose = lax.stop_gradient(jnp.stack([0 * self.radius, 2 * self.radius]))
        return pose, self.inverse(pose)

    def free_range(self):
        return jnp.array([[0.0, 6.0]])

    def length(self):
        return self.radius

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(jnp.concatenate([self.feet(joints[2]), pose[None]]), ((0, 2), (1, 2)), (0, 1))


@pytest.mark.parametrize(("angle", "link"), [(0.5, pk.Link.PATH), (5.8, pk.Link.NOT_FOUND)])
def test_free_joints_slide_first(angle, link):
    """At 5.8 the foot has been on the line of the other leg twice: home's sign, by a singular way."""
    mech = Orbiting(radius=1.0)
    pose = np.array([0.3, 1.8])
    joints = mech.inverse(pose, free=angle)
    found = pk.connect_modes(mech, joints, made(pose[None], [True], [1.0]))
    assert found.to_home.tolist() == [link]
    for poses in found.paths.values():
        np.testing.assert_allclose(poses[0], mech.home()[0], atol=1e-12)
        np.testing.assert_allclose(poses[-1], pose, atol=1e-12)


def test_a_carriage_stays_where_the_joints_put_it():
    mech = pk.catalogued("casing-oscillator")
    pose = pk.AxisPose.from_angles(float(mech.neutral[0]) + 0.01, 0.01, -0.01, 0.03)
    joints = mech.inverse(pose, free=0.75)
    modes = made(jax.tree.map(lambda leaf: leaf[None], pose), [True], [1.0])
    found = pk.connect_modes(mech, joints, modes, within_limits=True)
    assert found.to_home.tolist() == [pk.Link.PATH]
    np.testing.assert_allclose(mech.inverse(found.paths[0][-1], free=0.75), joints, rtol=1e-12)


# --- what is trusted


def test_the_sign_of_a_singular_mode_proves_nothing():
    mech = pk.catalogued("nam-2-rpr")
    joints = mech.home()[1]
    modes = modes_near(mech, joints, [[0, 1], [0, -1]])
    assert pk.connect_modes(mech, joints, modes).to_home[1] == pk.Link.IMPOSSIBLE
    doubtful = modes._replace(sigma_min=np.array([0.5, 1e-9]))
    assert pk.connect_modes(mech, joints, doubtful).to_home[1] == pk.Link.NOT_FOUND


def test_a_way_through_a_singularity_is_no_road():
    """From above the feet of two legs to below them: glances left and right see one sign each."""
    mech = pk.catalogued("nam-2-rpr")
    side = roadmap._Side(mech, None, np.zeros(0), 0.0, False)  # that would take either sign
    above, below = np.array([[0.1, 1.0]]), np.array([[0.1, -1.03]])
    assert roadmap._driven(side, above, below) == [None]
    assert roadmap._driven(side, above, -below) != [None]


def test_turns_go_the_shorter_way_round():
    mech = pk.catalogued("sauer-3-rpr")
    for one, other in ((3.0, -3.0), (-3.0, 3.0), (0.5, 0.7)):
        middle = between(mech, jnp.array([0, 0, one]), jnp.array([2.0, 4.0, other]), 0.5)
        half = np.angle(np.exp(1j * (other - one))) / 2
        np.testing.assert_allclose(middle, [1.0, 2.0, one + half], atol=1e-12)
    flat, over = pk.SE3(np.zeros(3), np.eye(3)), pk.SE3(np.ones(3), np.diag([1.0, -1.0, -1.0]))
    middle = between(STEWART, flat, over, 0.5)  # half a turn
    np.testing.assert_allclose(np.abs(middle.rotation), [[1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12)


def test_angles_of_a_path_go_on_past_a_full_turn():
    road = lambda start, end: roadmap._Seen(
        np.linspace([0.0, 4.0, start], [1.0, -4.0, end], 5), np.zeros((5, 3, 3)), np.linspace(0.5, 0.4, 5)
    )
    poses, clearance = roadmap._path(RPR, [road(2.6, 3.4), road(3.4 - 2 * np.pi, -2.5)])
    np.testing.assert_allclose(poses[-1], [1.0, -4.0, 2 * np.pi - 2.5], atol=1e-12)
    assert len(poses) == 9 and clearance == 0.4
    assert np.abs(np.diff(poses[:, 2])).max() < 0.25


# --- refusals


def test_it_refuses_what_it_cannot_do(rpr):
    modes, _ = rpr
    ask = lambda mech, joints, modes, **named: said_by(pk.connect_modes, mech, joints, modes, **named)
    batch = "connect_modes takes one row of joints and its assembly modes, got a batch"
    assert ask(RPR, LENGTHS[None], modes) == batch
    assert ask(RPR, LENGTHS, modes._replace(is_real=modes.is_real[None])) == batch
    assert ask(RPR, LENGTHS, "any") == "modes must come from assembly_modes, got str"
    assert ask("any", LENGTHS, modes).startswith("connect_modes takes a pk_jax.Mechanism")
    assert ask(STEWART, np.ones(6), modes).startswith("modes.poses must be a pk_jax.SE3")
    assert ask(RPR, LENGTHS, modes, nodes=0).startswith("nodes must be an integer from 1 to")
    assert ask(outsiders.implicit_delta(), np.zeros(3), modes) == (
        "connect_modes needs a closed form inverse, and ImplicitDelta has none"
    )
    short = jax.tree.map(lambda leaf: leaf.astype(np.float32), RPR)
    assert ask(short, LENGTHS, modes) == "connect_modes needs float64: call pk_jax.enable_x64() first"
    known = "connect_modes needs known values: call it outside of jit, grad and vmap"
    assert said_by(jax.jit(lambda q: pk.connect_modes(RPR, q, modes).to_home), LENGTHS) == known
    assert said_by(jax.jit(lambda: pk.connect_modes(RPR, LENGTHS, modes).to_home)) == known
