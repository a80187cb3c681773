"""All assembly modes: published counts, completeness, and what is said where it is not reached."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from outsiders import delta, three_rpr

import pk_jax as pk
from pk_jax import Fate, Status
from pk_jax.geometry import rotations
from pk_jax.kinematics.modes import assembly
from pk_jax.kinematics.modes import stewart as stewart_modes
from pk_jax.kinematics.modes.homotopy import End
from pk_jax.mechanisms.catalogue import CATALOGUE, catalogued

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

DIETMAIER = np.array([1, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071])
HOME = pk.SE3.from_rotation_vector([0.1, 0.2, 1.0], [0.3, -0.2, 0.25])


def leg_lengths(stewart, pose):
    """In plain NumPy."""
    ends = np.asarray(stewart.platform) @ np.asarray(pose.rotation).T + np.asarray(pose.translation)
    return np.linalg.norm(ends - np.asarray(stewart.base), axis=1)


def real_poses(modes):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: int(modes.count)], modes.poses)


def holds(modes, pose, within=1e-8):
    """Whether the pose is among the modes."""
    poses = real_poses(modes)
    off = np.abs(poses.rotation - np.asarray(pose.rotation)).max(axis=(1, 2))
    off = np.maximum(off, np.abs(poses.translation - np.asarray(pose.translation)).max(axis=1))
    return bool(np.any(off < within))


def check(modes, stewart, lengths):
    """What every complete answer keeps."""
    poses, count = real_poses(modes), int(modes.count)
    assert modes.is_complete and modes.status == (Status.OK if count else Status.UNREACHABLE)
    assert np.array_equal(modes.is_real, np.arange(40) < count)
    assert np.array_equal(modes.is_real, modes.fates == Fate.FINITE_REAL)
    assert np.all(np.isnan(np.asarray(modes.poses.translation)[count:]))
    for translation, rotation in zip(poses.translation, poses.rotation, strict=True):
        off = leg_lengths(stewart, pk.SE3(translation, rotation)) - lengths
        assert np.abs(off).max() < 1e-12 * np.max(lengths)
        assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14 and np.linalg.det(rotation) > 0
    finite = sum(modes.tally().get(name, 0) for name in ("FINITE_REAL", "FINITE_COMPLEX", "DUPLICATE"))
    assert (finite == modes.expected and (finite - count) % 2 == 0) or "DUPLICATE" in modes.tally()
    return finite


def random_platform(random, scale=0.6):
    return pk.Stewart(base=random.normal(size=(6, 3)), platform=scale * random.normal(size=(6, 3)))


# --- Stewart platforms, general and not


def test_forty_solutions_and_the_pose_that_made_the_lengths():
    random = np.random.default_rng(0)
    for _ in range(8):
        stewart = random_platform(random, random.uniform(0.2, 1.5))
        pose = pk.SE3.from_quaternion(random.normal(size=3), random.normal(size=4))
        lengths = leg_lengths(stewart, pose)
        modes = pk.assembly_modes(stewart, lengths)
        assert modes.method == "homotopy" and check(modes, stewart, lengths) == 40
        assert holds(modes, pose) and modes.count % 2 == 0
        assert np.all(np.asarray(modes.is_certified)[: int(modes.count)])


@pytest.mark.soak
def test_two_hundred_random_platforms():
    random = np.random.default_rng(1)
    complete = 0
    for _ in range(200):
        stewart = random_platform(random, random.uniform(0.2, 1.5))
        pose = pk.SE3.from_quaternion(random.normal(size=3), random.normal(size=4))
        modes = pk.assembly_modes(stewart, leg_lengths(stewart, pose))
        assert holds(modes, pose)
        complete += bool(modes.is_complete) and modes.expected == 40
    assert complete >= 198


def test_forty_real_postures():
    """Dietmaier 1998, Advances in Robot Kinematics: 7-16."""
    stewart = catalogued("dietmaier-40")
    modes = pk.assembly_modes(stewart, DIETMAIER)
    assert modes.count == 40 and check(modes, stewart, DIETMAIER) == 40
    assert np.all(np.asarray(modes.is_certified))
    assert np.sum(np.asarray(modes.det_sign) > 0) == 20  # they come and go in pairs, one of each sign
    poses = real_poses(modes)
    features = np.concatenate([poses.translation, poses.rotation.reshape(40, 9)], axis=1)
    apart = np.linalg.norm(features[:, None] - features[None], axis=2) + np.eye(40)
    assert apart.min() > 1e-3


def layouts():
    random = np.random.default_rng(2)
    points = lambda n: random.normal(size=(n, 3))
    flat = lambda array: array * [1, 1, 0]
    pairs, cycle = [0, 0, 1, 1, 2, 2], [0, 1, 1, 2, 2, 0]
    yield "planar base and platform", flat(points(6)), 0.6 * flat(points(6)), 40
    yield "6-3", points(6), 0.6 * points(3)[pairs], 16
    yield "6-3, planar base", flat(points(6)), 0.6 * points(3)[pairs], 16
    yield "3-6", points(3)[pairs], 0.6 * points(6), 16
    yield "3-3", points(3)[pairs], 0.6 * points(3)[cycle], 16
    yield "6-5", points(6), 0.6 * points(5)[[0, 0, 1, 2, 3, 4]], 40


@pytest.mark.parametrize(("name", "base", "platform", "count"), [*layouts()])
def test_solutions_of_known_layouts(name, base, platform, count):
    stewart = pk.Stewart(base=base, platform=platform)
    lengths = leg_lengths(stewart, HOME)
    modes = pk.assembly_modes(stewart, lengths)
    assert modes.expected == count and check(modes, stewart, lengths) == count
    assert holds(modes, HOME)
    assert modes.tally().get("AT_INFINITY", 0) == 40 - count


def test_the_semi_regular_platform_has_28_finite_solutions():
    stewart = catalogued("semi-regular-stewart")
    modes = pk.assembly_modes(stewart, leg_lengths(stewart, HOME))
    assert modes.expected == 28 and modes.tally()["AT_INFINITY"] == 12
    check(modes, stewart, leg_lengths(stewart, HOME))
    assert holds(modes, HOME)


def test_real_modes_are_in_the_order_of_their_distance_from_home():
    stewart = catalogued("semi-regular-stewart")
    pose, joints = stewart.home()
    modes = pk.assembly_modes(stewart, joints)
    first = real_poses(modes)[0]
    np.testing.assert_allclose(first.translation, pose.translation, atol=1e-13)
    np.testing.assert_allclose(first.rotation, pose.rotation, atol=1e-13)
    turned = np.linalg.norm(real_poses(modes).rotation - np.eye(3), axis=(1, 2)) / np.sqrt(2)
    moved = np.linalg.norm(real_poses(modes).translation - pose.translation, axis=1) / stewart.length()
    assert np.all(np.diff(np.hypot(turned, moved)) > -1e-9)
    assert modes.det_sign[0] == 1


@settings(max_examples=6)
@given(st.integers(0, 10**6))
def test_any_geometry_has_the_pose_that_made_its_lengths(seed):
    random = np.random.default_rng(seed)
    base, platform = random.normal(size=(2, 6, 3)) * random.uniform(0.1, 2, size=(2, 1, 3))
    stewart = pk.Stewart(base=base, platform=platform)
    pose = pk.SE3.from_quaternion(random.normal(size=3), random.normal(size=4))
    modes = pk.assembly_modes(stewart, leg_lengths(stewart, pose))
    assert holds(modes, pose, within=1e-6) and (modes.is_complete or modes.status == Status.INCOMPLETE)


def test_modes_move_with_the_frames_and_scale_with_the_unit():
    random = np.random.default_rng(3)
    stewart = random_platform(random)
    lengths = leg_lengths(stewart, HOME)
    poses = real_poses(pk.assembly_modes(stewart, lengths))
    turns = [np.asarray(rotations.from_quaternion(jnp.asarray(q))) for q in random.normal(size=(2, 4))]
    shifts = random.normal(size=(2, 3))
    ends = [
        1000 * (np.asarray(points) @ turn.T + shift)
        for points, turn, shift in zip((stewart.base, stewart.platform), turns, shifts, strict=True)
    ]
    moved = pk.assembly_modes(pk.Stewart(base=ends[0], platform=ends[1]), 1000 * lengths)
    assert moved.count == len(poses.translation)
    for translation, rotation in zip(poses.translation, poses.rotation, strict=True):
        wanted = turns[0] @ rotation @ turns[1].T
        shift = turns[0] @ translation + shifts[0] - wanted @ shifts[1]
        assert holds(moved, pk.SE3(1000 * shift, wanted), within=1e-8 * 1000)


def test_legs_in_another_order_have_the_same_modes():
    random = np.random.default_rng(4)
    stewart = random_platform(random)
    lengths, order = leg_lengths(stewart, HOME), random.permutation(6)
    poses = real_poses(pk.assembly_modes(stewart, lengths))
    other = pk.Stewart(base=stewart.base[order], platform=stewart.platform[order])
    modes = pk.assembly_modes(other, lengths[order])
    assert modes.count == len(poses.translation)
    assert all(holds(modes, poses[k]) for k in range(int(modes.count)))


def test_lengths_out_of_reach_have_no_mode_and_that_is_complete():
    stewart = random_platform(np.random.default_rng(5))
    lengths = leg_lengths(stewart, HOME) * [0.01, 1, 1, 1, 1, 3]
    modes = pk.assembly_modes(stewart, lengths)
    assert modes.status == Status.UNREACHABLE and modes.is_complete and modes.count == 0
    assert np.all(np.isnan(np.asarray(modes.poses.rotation)))


# --- mirror images


def test_planar_platforms_have_mirror_images_in_the_plane_of_the_base():
    random = np.random.default_rng(6)
    base, platform = random.normal(size=(2, 6, 3)) * [1, 1, 0]
    turn = np.asarray(rotations.from_quaternion(jnp.asarray(random.normal(size=4))))
    stewart = pk.Stewart(base=base @ turn.T + [1, 2, 3], platform=platform)
    modes = pk.assembly_modes(stewart, leg_lengths(stewart, HOME))
    poses, count = real_poses(modes), int(modes.count)
    image = np.asarray(modes.mirror)[:count]
    assert count >= 2 and np.array_equal(image[image], np.arange(count)) and np.all(image != np.arange(count))
    points = np.einsum("kij,nj->kni", poses.rotation, platform) + poses.translation[:, None]
    normal = turn[:, 2]
    reflected = points - 2 * ((points - [1, 2, 3]) @ normal)[..., None] * normal
    np.testing.assert_allclose(reflected, points[image], atol=1e-10)
    assert np.all(np.asarray(modes.mirror)[count:] == -1)


@pytest.mark.parametrize("flat", ["base", "platform", "neither"])
def test_no_mirror_images_where_one_of_them_is_not_planar(flat):
    random = np.random.default_rng(7)
    ends = {name: random.normal(size=(6, 3)) for name in ("base", "platform")}
    if flat in ends:
        ends[flat] *= [1, 1, 0]
    stewart = pk.Stewart(**ends)
    modes = pk.assembly_modes(stewart, leg_lengths(stewart, HOME))
    assert modes.count and np.all(np.asarray(modes.mirror) == -1)


# --- singular lengths


def turned(angle):
    """The semi-regular platform at home, turned about the vertical."""
    pose = pk.SE3.from_rotation_vector([0, 0, 1.0], [0, 0, angle])
    return pose, leg_lengths(catalogued("semi-regular-stewart"), pose)


def test_poses_that_coincide_are_one_mode_and_its_duplicate():
    """Fichter's singularity: two pairs of modes meet at a quarter turn."""
    stewart = catalogued("semi-regular-stewart")
    pose, lengths = turned(np.pi / 2)
    modes = pk.assembly_modes(stewart, lengths)
    assert modes.is_complete and modes.tally()["DUPLICATE"] == 2 and modes.count == 2
    assert holds(modes, pose, within=1e-6)
    assert np.nanmax(modes.sigma_min) < 1e-6 and not np.any(np.asarray(modes.is_certified))
    near = pk.assembly_modes(stewart, turned(np.pi / 2 + 1e-4)[1])
    assert near.is_complete and near.count == 4 and np.all(np.asarray(near.is_certified)[:4])


def test_a_flat_platform_is_eight_modes_in_one():
    stewart = catalogued("semi-regular-stewart")
    flat = pk.SE3(np.zeros(3), np.eye(3))
    modes = pk.assembly_modes(stewart, leg_lengths(stewart, flat))
    assert modes.is_complete and modes.count == 1 and modes.tally()["DUPLICATE"] == 7
    assert holds(modes, flat, within=1e-4)


def test_a_self_motion_is_not_called_complete():
    """Equal bodies and legs of one length: the platform may swing on a sphere."""
    points = np.random.default_rng(8).normal(size=(6, 3))
    stewart = pk.Stewart(base=points, platform=points)
    modes = pk.assembly_modes(stewart, np.full(6, 1.3))
    assert not modes.is_complete and modes.status == Status.INCOMPLETE and modes.tally()["LOST"] > 0
    assert pk.assembly_modes(stewart, 1.3 + 0.1 * np.arange(6)).is_complete


def test_lost_paths_are_said(monkeypatch):
    between = stewart_modes.between

    def losing(*arguments):
        paths = jax.device_get(between(*arguments))
        return paths._replace(end=np.where(np.arange(40) < 25, End.LOST, paths.end))

    stewart = random_platform(np.random.default_rng(9))
    lengths = leg_lengths(stewart, HOME)
    whole = pk.assembly_modes(stewart, lengths)
    monkeypatch.setattr(stewart_modes, "between", losing)
    modes = pk.assembly_modes(stewart, lengths)
    assert not modes.is_complete and modes.status == Status.INCOMPLETE and modes.retries > 0
    assert modes.tally()["LOST"] == 40 - np.sum(modes.fates != Fate.LOST)
    assert modes.expected == 40 and modes.count <= whole.count
    assert all(holds(whole, real_poses(modes)[k]) for k in range(int(modes.count)))


def test_a_real_solution_that_does_not_close_is_lost_and_not_called_complex(monkeypatch):
    solved = assembly.solved_from

    def stalling(*arguments):
        found = jax.device_get(solved(*arguments))
        status = found.status.copy()
        status[np.flatnonzero(status == Status.OK)[0]] = Status.STALLED
        return found._replace(status=status)

    stewart = random_platform(np.random.default_rng(11))
    lengths = leg_lengths(stewart, HOME)
    whole = pk.assembly_modes(stewart, lengths)
    monkeypatch.setattr(assembly, "solved_from", stalling)
    modes = pk.assembly_modes(stewart, lengths)
    assert modes.count == whole.count - 1 and modes.tally()["LOST"] == 1
    assert modes.status == Status.INCOMPLETE and not modes.is_complete


# --- sensors


def test_sensors_choose_among_the_modes_of_the_legs():
    stewart = catalogued("nine-lengths-general")
    pose, lengths = stewart.home()
    modes = pk.assembly_modes(stewart, lengths)
    legs = pk.assembly_modes(pk.Stewart(base=stewart.base[:6], platform=stewart.platform[:6]), lengths[:6])
    assert modes.count == 1 and modes.is_complete and holds(modes, pose)
    assert modes.tally()["EXCLUDED"] == legs.count - 1 and modes.det_sign[0] == 1
    off = np.asarray(lengths) + 0.01 * np.eye(9)[7]
    assert pk.assembly_modes(stewart, off).status == Status.INCONSISTENT


# --- mechanisms with a closed form


@pytest.mark.parametrize(("p2", "count"), [(3.5, 0), (4, 2), (5, 4), (7, 6), (9, 2)])
def test_sauers_platform(p2, count):
    """T. Sauer, Numerical Analysis, Reality Check 1: as many poses as published (4, 5, 7 are printed)."""
    modes = pk.assembly_modes(catalogued("sauer-3-rpr"), [5, p2, 3])
    assert modes.count == count and modes.is_complete and modes.method == "closed form"
    assert modes.expected == 6 and modes.tally().get("FINITE_COMPLEX", 0) == 6 - count
    assert modes.status == (Status.OK if count else Status.UNREACHABLE)
    assert np.all(np.asarray(modes.is_certified)[:count]) and np.all(
        np.asarray(modes.residual)[:count] < 1e-13
    )


@pytest.mark.parametrize("name", ["nam-2-rpr", "4-rrr", "6-link"])
def test_home_is_a_mode_of_its_joints(name):
    mech = catalogued(name)
    pose, joints = mech.home()
    modes = pk.assembly_modes(mech, joints)
    assert modes.is_complete and modes.method == "closed form"
    np.testing.assert_allclose(np.asarray(modes.poses)[0], pose, atol=1e-9)
    assert modes.det_sign[0] == (1 if mech.residual(pose, joints).size == pose.size else 0)


@pytest.mark.soak
def test_modes_of_a_five_bar_mirror_each_other_in_the_line_of_its_elbows():
    mech = catalogued("5-link")
    modes = pk.assembly_modes(mech, mech.home()[1] + np.array([0.1, -0.2]))
    assert modes.count == 2 and np.asarray(modes.mirror).tolist() == [1, 0]
    assert sorted(np.asarray(modes.det_sign).tolist()) == [-1, 1]


@pytest.mark.parametrize("name", ["4-rrr", "6-link"])
def test_redundant_joints_that_disagree_are_inconsistent(name):
    mech = catalogued(name)
    joints = np.asarray(mech.home()[1]) * (1 + 0.01 * np.cos(np.arange(4)))
    modes = pk.assembly_modes(mech, joints)
    assert modes.status == Status.INCONSISTENT and modes.is_complete and modes.count == 0
    assert np.all(modes.fates == Fate.EXCLUDED) and modes.expected == -1


def test_a_closed_form_is_not_believed_where_it_does_not_close(monkeypatch):
    def boastful(mech, joints):
        poses, is_real = jax.device_get(jax.jit(lambda q: mech.forward(q))(joints))
        return poses + [0.02, 0, 0], is_real

    monkeypatch.setattr(assembly, "_forward", boastful)
    modes = pk.assembly_modes(catalogued("sauer-3-rpr"), [5, 5, 3])
    assert modes.count == 0 and modes.tally()["LOST"] == 4
    assert not modes.is_complete and modes.status == Status.INCOMPLETE


# --- any other mechanism: a search, never called complete


def test_a_search_finds_both_poses_of_a_delta():
    mech = delta()
    pose, joints = mech.home()
    modes = pk.assembly_modes(mech, joints)
    assert modes.method == "search" and not modes.is_complete and modes.status == Status.INCOMPLETE
    assert modes.count == 2 and modes.expected == -1
    np.testing.assert_allclose(np.asarray(modes.poses)[0], pose, atol=1e-12)
    assert modes.tally()["DUPLICATE"] > 100 and len(modes.fates) == 256


@pytest.mark.soak
def test_a_search_finds_what_a_closed_form_knows():
    """The outsider's 3-RPR has no closed form; ours has."""
    mech = three_rpr()
    joints = np.asarray(mech.home()[1]) * [1.1, 0.9, 1.0]
    searched = pk.assembly_modes(mech, joints)
    known = pk.assembly_modes(pk.PlanarRPR(base=mech.base, platform=mech.platform), joints)
    assert searched.count == known.count >= 2 and known.is_complete and not searched.is_complete
    poses, wanted = (np.asarray(modes.poses)[: int(known.count)] for modes in (searched, known))
    as_points = lambda x: np.concatenate([x[:, :2], np.cos(x[:, 2:]), np.sin(x[:, 2:])], axis=1)
    off = np.abs(as_points(poses)[:, None] - as_points(wanted)[None]).max(axis=2)
    assert off.min(axis=0).max() < 1e-10 and off.min(axis=1).max() < 1e-10


@pytest.mark.soak  # notebook 06 runs it
def test_a_search_of_the_casing_oscillator():
    mech = catalogued("casing-oscillator")
    pose, joints = mech.home()
    modes = pk.assembly_modes(mech, joints)
    assert not modes.is_complete and modes.count == 12
    np.testing.assert_allclose(modes.poses.s[0], pose.s, rtol=1e-12)
    image = np.asarray(modes.mirror)[:12]
    assert np.array_equal(image[image], np.arange(12))


# --- rows, and what is refused


def test_a_batch_is_a_loop_and_bad_rows_hurt_no_other():
    stewart = random_platform(np.random.default_rng(10))
    good = leg_lengths(stewart, HOME)
    rows = np.stack([good, np.where(np.arange(6) == 2, np.nan, good), -good, 1.01 * good])
    calls = []
    many = pk.assembly_modes(stewart, rows, report=lambda *told: calls.append(told))
    assert many.status.tolist()[1:3] == [Status.BAD_INPUT] * 2 and many.count.tolist()[1:3] == [0, 0]
    assert not many.is_complete[1] and np.all(many.fates[1] == Fate.LOST)
    assert calls[-1][1:] == (4, 4) and many.poses.rotation.shape == (4, 40, 3, 3)
    for k in (0, 3):
        one = pk.assembly_modes(stewart, rows[k])
        for alone, among in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
            if not isinstance(alone, str):
                np.testing.assert_array_equal(alone, among[k])


def test_solutions_near_infinity_are_told_from_those_at_infinity():
    """A real hexapod is nearly symmetric: eight of twelve solutions have |x . x| / |z|^2 above 1e-12."""
    log = catalogued("hexapod-log")
    assert pk.assembly_modes(log, log.home()[1]).expected == 36
    exact = catalogued("calibration-hexapod")
    assert pk.assembly_modes(exact, exact.home()[1]).expected == 28


def test_every_entry_of_the_catalogue_has_its_home_among_its_modes():
    for name in ("linuxcnc-hexapod", "hexapod-log", "calibration-hexapod", "wide-semi-regular-stewart"):
        assert name in CATALOGUE
        stewart = catalogued(name)
        pose, lengths = stewart.home()
        modes = pk.assembly_modes(stewart, lengths)
        scale = float(np.max(lengths))
        assert modes.is_complete and holds(modes, pose, within=1e-9 * scale), name


@pytest.mark.parametrize(
    ("mech", "joints", "message"),
    [
        ("platform", np.ones(6), "assembly_modes takes a pk_jax.Mechanism, got str"),
        (catalogued("dietmaier-40"), np.ones(5), "joints must have shape"),
        (catalogued("dietmaier-40"), np.ones((0, 6)), "joints must have at least one row"),
        (catalogued("dietmaier-40"), np.ones(6) * 1j, "joints must be real"),
        (catalogued("dietmaier-40"), ["a"] * 6, "joints must be real"),
    ],
)
def test_refusals(mech, joints, message):
    with pytest.raises(ValueError, match=message):
        pk.assembly_modes(mech, joints)


def test_known_values_in_float64_are_needed():
    stewart = catalogued("dietmaier-40")
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda lengths: pk.assembly_modes(stewart, lengths).count)(DIETMAIER)
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda: pk.assembly_modes(stewart, DIETMAIER).count)()
    single = pk.Stewart(base=np.float32(stewart.base), platform=np.float32(stewart.platform))
    with pytest.raises(ValueError, match="enable_x64"):
        pk.assembly_modes(single, DIETMAIER)
