"""The casing oscillator: the paper's equations in NumPy, in exact fractions, and at the command line."""

import dataclasses
import itertools
import json
from fractions import Fraction
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from outsiders import ThreeRPR
from refusals import said_by
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.files.mechanism_file import load_mechanism, save_mechanism
from pk_jax.kinematics.jacobian import self_motions

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

NAN = np.nan
ROWS = 200
DEFAULT = pk.CasingOscillator()
DRAWN = {  # of the same shapes, and without its symmetries
    "base_radius": 0.31,
    "platform_radius": 0.22,
    "neutral": (0.52, 0.66),
    "stroke": ((0.5, 0.9), (0.4, 0.7), (0.35, 0.65), (0.45, 0.95), (0.5, 0.8)),
    "base_cone": 0.4,
    "platform_cone": 0.5,
}
OTHER = pk.CasingOscillator(**DRAWN)
IRREGULAR = {"default": DEFAULT, "other": OTHER}


# ---------------------------------------------------------------- the machine in NumPy


def euler(angles):
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    return Rotation.from_euler("xyz", angles).as_matrix()


def drawn(mech, s, rotation, carriage):
    """Platform joints d and base joints B. -> (..., 4, 3) twice"""
    big, r = float(mech.base_radius), float(mech.platform_radius)
    b = np.array([[r, r, 0], [0, r, 0], [0, -r, 0], [r, -r, 0]])
    s, carriage = np.broadcast_arrays(np.asarray(s, float), np.asarray(carriage, float))
    d = (b + s[..., None, None] * [0, 0, 1]) @ np.swapaxes(rotation, -1, -2)
    base = np.zeros_like(d)
    base[..., 0, 0] = base[..., 3, 0] = carriage
    base[..., 1, 1], base[..., 2, 1] = big, -big
    return d, base


def lengths(mech, s, rotation, carriage):
    d, base = drawn(mech, s, rotation, carriage)
    return np.linalg.norm(d - base, axis=-1)


def screw_matrix(mech, s, rotation, carriage):
    """Eq. 34: columns [n . u; d x u] of the four legs; and u. -> (..., 4, 4), (..., 4, 3)"""
    d, base = drawn(mech, s, rotation, carriage)
    u = (d - base) / np.linalg.norm(d - base, axis=-1, keepdims=True)
    along = np.sum(rotation[..., None, :, 2] * u, axis=-1)
    rows = np.concatenate([along[..., None], np.cross(d, u)], axis=-1)
    return np.swapaxes(rows, -1, -2), u


def determinant(carriage, big, r, s, rot):
    """The closed form of det A, of numbers of any kind; rot[i][j] counts from 0."""
    r11, r13, r21 = rot[0][0], rot[0][2], rot[1][0]
    r23, r32, r33 = rot[1][2], rot[2][1], rot[2][2]
    inside = carriage * s**3 * r11 * r33 - carriage * r * s**2 * r13 * r33
    inside -= carriage * big * r**2 * r13 * r23 * r32 + carriage * big * r * s * r32**2
    return -4 * carriage * big * r * (inside + big * r * s**2 * r21 * r32)


def margins(mech, s, rotation, carriage):
    """All margins by name, of one pose."""
    joints = np.append(lengths(mech, s, rotation, carriage), carriage)
    _, u = screw_matrix(mech, s, rotation, carriage)
    _, straight = screw_matrix(mech, float(mech.neutral[0]), np.eye(3), float(mech.neutral[1]))
    size, stroke = float(mech.platform_radius), np.asarray(mech.stroke)
    each = {
        "stroke_min": (joints - stroke[:, 0]) / size,
        "stroke_max": (stroke[:, 1] - joints) / size,
        "base_cone": np.sum(u * straight, axis=1) - np.cos(mech.base_cone),
        "platform_cone": np.sum(u @ rotation * straight, axis=1) - np.cos(mech.platform_cone),
    }
    return {f"{name}[{k}]": value for name, row in each.items() for k, value in enumerate(row)}


def inside(mech, seed, rows=ROWS):
    """Poses well within the reach about neutral, and carriages."""
    rng = np.random.default_rng(seed)
    s, carriage = float(mech.neutral[0]), float(mech.neutral[1])
    return (
        s * rng.uniform(0.88, 1.12, rows),
        euler(rng.uniform(-0.3, 0.3, (rows, 3))),
        carriage * rng.uniform(0.9, 1.1, rows),
    )


def anywhere(seed, rows=ROWS):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.2, 0.8, rows), Rotation.random(rows, rng=rng).as_matrix(), rng.uniform(0.3, 1, rows)


def joints_at(mech, s, rotation, carriage):
    """(rows, 5)"""
    carriage = np.broadcast_to(carriage, np.shape(s))
    return np.concatenate([lengths(mech, s, rotation, carriage), carriage[..., None]], axis=-1)


def close(found, expected, to=1e-12):
    """To a part of the largest entry."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=to * np.max(np.abs(expected)))


@cache
def solved(mech_name, seed):
    """Inverse kinematics with every row's carriage, and what went in."""
    mech = IRREGULAR[mech_name]
    s, rotation, carriage = inside(mech, seed)
    return s, rotation, carriage, pk.inverse_kinematics(mech, pk.AxisPose(s, rotation), free=carriage)


# one configuration a row, compiled once for ROWS
linearized = jax.jit(jax.vmap(pk.pose_jacobian, (None, 0, 0)))
mapped = jax.jit(jax.vmap(pk.velocity_jacobian, (None, 0, 0)))
idle = jax.jit(jax.vmap(self_motions, (None, 0, 0)))


# ---------------------------------------------------------------- laws, and the neutral configuration


@pytest.mark.soak
@pytest.mark.parametrize("mech", IRREGULAR.values(), ids=IRREGULAR)
def test_laws_hold(mech):
    assert len(pk.check_mechanism(mech)) >= 17


def test_neutral_lengths():
    """E = 730 puts legs 1 and 4 on lines of 45 degrees: l1 = sqrt(480^2 + 480^2 + 250^2) mm."""
    pose, joints = DEFAULT.home()
    assert pose.s == 0.48 and np.all(pose.rotation == np.eye(3))
    np.testing.assert_allclose(1e3 * joints, [723.39477, 480, 480, 723.39477, 730], rtol=0, atol=1e-5)
    np.testing.assert_allclose(joints[0], np.sqrt(0.5233), rtol=1e-15)
    assert DEFAULT.joint_names == ("l1", "l2", "l3", "l4", "E") and DEFAULT.free_joints == 1
    np.testing.assert_array_equal(DEFAULT.free_range(), [[0.6675, 0.7922]])


def test_margins_are_strokes_and_cones_about_the_neutral_legs():
    for mech in IRREGULAR.values():
        found = jax.jit(lambda pose, joints, mech=mech: mech.margins(pose, joints))
        for s, rotation, carriage in zip(*inside(mech, 1, 5), strict=True):
            joints = np.append(lengths(mech, s, rotation, carriage), carriage)
            got = found(pk.AxisPose(s, rotation), joints)
            expected = margins(mech, s, rotation, carriage)
            got = {f"{name}[{k}]": float(v) for name, row in got.items() for k, v in enumerate(row)}
            assert got.keys() == expected.keys()
            np.testing.assert_allclose(
                [got[name] for name in expected], list(expected.values()), rtol=0, atol=1e-13
            )
        at_home = mech.margins(*mech.home())
        np.testing.assert_allclose(at_home["base_cone"], 1 - np.cos(mech.base_cone), rtol=0, atol=1e-15)


def test_each_leg_has_its_own_cone_where_four_are_given():
    cones = np.array([0.2, 0.3, 0.4, 0.5])
    each = dataclasses.replace(DEFAULT, base_cone=cones, platform_cone=2 * cones)
    found = each.margins(*each.home())
    np.testing.assert_allclose(found["base_cone"], 1 - np.cos(cones), rtol=0, atol=1e-15)
    np.testing.assert_allclose(found["platform_cone"], 1 - np.cos(2 * cones), rtol=0, atol=1e-15)


def test_the_drawing_has_four_legs_and_the_casing():
    s, rotation, carriage = (each[0] for each in inside(OTHER, 2, 1))
    joints = np.append(lengths(OTHER, s, rotation, carriage), carriage)
    points, segments, ground = OTHER.skeleton(pk.AxisPose(s, rotation), joints)
    sizes = [np.linalg.norm(points[i] - points[j]) for i, j in segments]
    np.testing.assert_allclose(sizes[:4], joints[:4], rtol=0, atol=1e-15)
    assert np.min(np.abs(np.array(sizes) - s)) < 1e-15  # from O to the centre of the platform
    d, base = drawn(OTHER, s, rotation, carriage)
    for point in (*d, *base):
        assert np.min(np.linalg.norm(points - point, axis=1)) < 1e-15
    assert np.all(points[np.array(ground), 2] == 0)


# ---------------------------------------------------------------- the determinant


@pytest.mark.parametrize("mech", IRREGULAR.values(), ids=IRREGULAR)
def test_the_determinant_is_that_of_the_screws_and_the_closed_form(mech):
    """Eq. 34: A = diag(l) S^T, anywhere."""
    s, rotation, carriage = anywhere(3)
    joints = joints_at(mech, s, rotation, carriage)
    a = np.asarray(linearized(mech, pk.AxisPose(s, rotation), joints))
    screws, _ = screw_matrix(mech, s, rotation, carriage)
    allowed = 1e-12 * np.prod(np.linalg.norm(a, axis=2), axis=1)
    found = np.linalg.det(a)
    by_screws = np.prod(joints[:, :4], axis=1) * np.linalg.det(screws)
    assert np.all(np.abs(found - by_screws) <= allowed)
    big, r = float(mech.base_radius), float(mech.platform_radius)
    by_form = determinant(carriage, big, r, s, np.moveaxis(rotation, 0, -1))
    assert np.all(np.abs(found - by_form) <= allowed)
    assert np.median(np.abs(found) / allowed) > 1e8


def exact_determinant(matrix):
    """By permutations."""
    total = Fraction(0)
    for order in itertools.permutations(range(4)):
        sign = (-1) ** sum(order[i] > order[j] for i in range(4) for j in range(i + 1, 4))
        product = Fraction(sign)
        for row, column in enumerate(order):
            product *= matrix[row][column]
        total += product
    return total


def exact_cayley(x, y, z):
    """A rational rotation: of the quaternion (1, x, y, z)."""
    size = 1 + x * x + y * y + z * z
    return [
        [(1 + x * x - y * y - z * z) / size, 2 * (x * y - z) / size, 2 * (x * z + y) / size],
        [2 * (x * y + z) / size, (1 - x * x + y * y - z * z) / size, 2 * (y * z - x) / size],
        [2 * (x * z - y) / size, 2 * (y * z + x) / size, (1 - x * x - y * y + z * z) / size],
    ]


def test_the_closed_form_of_the_determinant_is_exact():
    """In rational numbers: no tolerance."""
    rng = np.random.default_rng(4)
    rational = lambda low: Fraction(int(rng.integers(low, 40)), int(rng.integers(1, 30)))
    values = []
    for _ in range(40):
        rot = exact_cayley(*(rational(-40) for _ in range(3)))
        for i, j in itertools.product(range(3), repeat=2):
            assert sum(rot[i][k] * rot[j][k] for k in range(3)) == (i == j)
        carriage, big, r, s = (rational(1) for _ in range(4))
        b = [[r, r, 0], [0, r, 0], [0, -r, 0], [r, -r, 0]]
        base = [[carriage, 0, 0], [0, big, 0], [0, -big, 0], [carriage, 0, 0]]
        rows = []
        for leg in range(4):
            at = [b[leg][0], b[leg][1], s]
            d = [sum(rot[i][k] * at[k] for k in range(3)) for i in range(3)]
            l = [d[i] - base[leg][i] for i in range(3)]
            turning = [d[i - 2] * l[i - 1] - d[i - 1] * l[i - 2] for i in range(3)]
            rows.append([sum(rot[i][2] * l[i] for i in range(3)), *turning])
        values.append(exact_determinant(rows))
        assert values[-1] == determinant(carriage, big, r, s, rot)
    assert sum(value != 0 for value in values) >= 35


# ---------------------------------------------------------------- travels


TRAVELS = {"roll": (-14.461, 14.461), "pitch": (-5.953, 5.884), "yaw": (-10.777, 10.777)}  # degrees


def ends_of(mech, axis, s, which=""):
    """The first angle at which a margin of that name is used up, either way, and which are; by brentq."""
    carriage, found = float(mech.neutral[1]), []

    def margin(angle, name):
        return margins(mech, s, euler(angle * np.eye(3)[axis]), carriage)[name]

    names = [name for name in margins(mech, s, np.eye(3), carriage) if name.startswith(which)]
    for way in (-1, 1):
        grid, ends = way * np.linspace(0, 1.2, 121), {}
        values = [margins(mech, s, euler(angle * np.eye(3)[axis]), carriage) for angle in grid]
        for name in names:
            out = np.flatnonzero([row[name] < 0 for row in values])
            if len(out):
                between = grid[out[0] - 1], grid[out[0]]
                ends[name] = brentq(margin, *between, args=(name,), xtol=1e-15, rtol=1e-15)
        end = min(ends.values(), key=abs)
        found.append((end, {name for name, at in ends.items() if abs(at - end) < 1e-9}))
    return found


@pytest.mark.parametrize("name", TRAVELS)
def test_travels_are_those_of_the_strokes(name):
    """The paper's, evaluated again to 0.01 degrees, and by roots of the stroke equations."""
    found = pk.travel(DEFAULT, name)
    np.testing.assert_allclose(np.rad2deg([found.lower, found.upper]), TRAVELS[name], rtol=0, atol=0.01)
    axis = list(TRAVELS).index(name)
    by_root = ends_of(DEFAULT, axis, 0.48, "stroke")
    np.testing.assert_allclose([found.lower, found.upper], [end for end, _ in by_root], rtol=0, atol=1e-9)
    for limit, (_, limits) in zip((found.limit_lower, found.limit_upper), by_root, strict=True):
        assert limit in limits


def test_travel_of_the_other_geometry():
    for axis, name in enumerate(TRAVELS):
        found, by_root = pk.travel(OTHER, name), ends_of(OTHER, axis, 0.52)
        ends = [end for end, _ in by_root]
        np.testing.assert_allclose([found.lower, found.upper], ends, rtol=0, atol=1e-9)
        assert found.limit_lower in by_root[0][1] and found.limit_upper in by_root[1][1]


def test_pitch_travel_at_the_wall():
    """s (sin p+ + sin |p-|): about 100 mm at every height, in a batch of three."""
    s = np.array([0.43, 0.48, 0.53])
    found = pk.travel(DEFAULT, "pitch", at=pk.AxisPose.from_angles(s))
    at_wall = 1e3 * s * (np.sin(found.upper) + np.sin(-found.lower))
    np.testing.assert_allclose(at_wall, [95.1, 99.0, 102.2], rtol=0, atol=0.1)
    assert len(found.limit_lower) == len(found.limit_upper) == 3


def test_cones_alone_limit_the_roll():
    """To 18.2 degrees, where strokes are wide: a cone of leg 2 or 3, and it is named."""
    wide = dataclasses.replace(DEFAULT, stroke=np.tile([0.01, 10.0], (5, 1)))
    found = pk.travel(wide, "roll")
    np.testing.assert_allclose(np.rad2deg([-found.lower, found.upper]), 18.2, rtol=0, atol=0.05)
    by_root = ends_of(wide, 0, 0.48)
    np.testing.assert_allclose([found.lower, found.upper], [end for end, _ in by_root], rtol=0, atol=1e-9)
    for limit, (_, limits) in zip((found.limit_lower, found.limit_upper), by_root, strict=True):
        assert limit in limits and limit.split("[")[0].endswith("cone") and limit[-2] in "12"


# ---------------------------------------------------------------- singularities

PITCH = 62.487997376149  # degrees, atan(s / r) at s = 480, r = 250
ROLL = 75.297830305966  # s^2 cos = R r sin^2


def test_singular_angles_are_those_of_the_closed_form():
    """Roots of what the determinant is proportional to, at s = 480 and R = r = 250."""
    assert abs(np.rad2deg(np.arctan2(480, 250)) - PITCH) < 1e-12
    root = brentq(lambda a: 480**2 * np.cos(a) - 250**2 * np.sin(a) ** 2, 1, 1.5, xtol=1e-15)
    assert abs(np.rad2deg(root) - ROLL) < 1e-12


def singular_rows():
    """Base radius, exact singular angles in degrees (rows, 3), and carriages (rows,)."""
    yaws, carriages = [-80, -35, 0, 20, 65], [0.5, 0.73, 0.9]
    for big in (0.25, 0.4):
        rows = [(0, p, y, e) for p in (PITCH, 90, -90) for y in yaws for e in carriages]
        rolls = np.rad2deg(np.arccos((np.sqrt(0.48**4 + 4 * (big * 0.25) ** 2) - 0.48**2) / (2 * big * 0.25)))
        rows += [(way * rolls, 0, 0, e) for way in (-1, 1) for e in carriages]
        rows = np.array(rows, float)
        yield big, rows[:, :3], rows[:, 3]


def test_singular_poses_are_of_type_ii_for_every_yaw_carriage_and_base():
    for big, angles, carriage in singular_rows():
        mech = dataclasses.replace(DEFAULT, base_radius=big, stroke=np.tile([0.01, 10.0], (5, 1)))
        s, rotation = np.full(len(angles), 0.48), euler(np.deg2rad(angles))
        joints = joints_at(mech, s, rotation, carriage)
        found = pk.classify_singularity(mech, pk.AxisPose(s, rotation), joints)
        assert np.all(np.asarray(found.kind) == pk.SingularityKind.TYPE_II)
        assert np.max(found.sigma_direct) < 1e-12 and np.min(found.sigma_inverse) > 0.1
        beside = euler(np.deg2rad(angles) + [[0.02, 0.02, 0]])
        joints = joints_at(mech, s, beside, carriage)
        found = pk.classify_singularity(mech, pk.AxisPose(s, beside), joints)
        assert np.all(np.asarray(found.kind) == pk.SingularityKind.REGULAR)
        assert np.min(found.sigma_direct) > 1e-4


LOCKED = 0.7


@cache
def locus(first):
    """Over an angle and the yaw, the carriage locked."""
    ranges = {"roll": (-1.5, 1.5), "pitch": (0.2, 1.75)}[first], (-0.6, 0.6)
    return pk.singularity_locus(DEFAULT, (first, "yaw"), ranges=ranges, free=LOCKED, nodes=41)


@pytest.mark.soak
@pytest.mark.parametrize("first", ["roll", "pitch"])
def test_loci_are_of_type_ii_and_lock_the_carriage(first):
    found = locus(first)
    assert found.axes == (first, "yaw") and found.units == (0, 0)
    assert found.curves and not found.everywhere
    for curve in found.curves:
        assert curve.kind == pk.SingularityKind.TYPE_II and np.all(curve.sigma < 1e-9)
        np.testing.assert_array_equal(curve.joints[:, 4], LOCKED)
        angles = np.zeros((len(curve.coordinates), 3))
        angles[:, [["roll", "pitch"].index(first), 2]] = curve.coordinates
        np.testing.assert_allclose(curve.pose.rotation, euler(angles), rtol=0, atol=1e-14)
        np.testing.assert_array_equal(curve.pose.s, 0.48)
        expected = lengths(DEFAULT, 0.48, euler(angles), LOCKED)
        np.testing.assert_allclose(curve.joints[:, :4], expected, rtol=0, atol=1e-9)


@pytest.mark.soak  # every pair of axes is compiled anew
def test_the_locus_in_roll_and_yaw_is_the_root_of_the_closed_form():
    """At every point, to 1e-9 degrees; over all yaws, on both sides; at yaw 0 it is +-75.298 degrees."""

    def value(roll, yaw):
        return determinant(LOCKED, 0.25, 0.25, 0.48, euler([roll, 0, yaw]))

    every = np.concatenate([curve.coordinates for curve in locus("roll").curves])
    roots = [brentq(value, roll - 0.02, roll + 0.02, args=(yaw,), xtol=1e-15) for roll, yaw in every]
    np.testing.assert_allclose(np.rad2deg(every[:, 0] - roots), 0, rtol=0, atol=1e-9)
    grid = np.linspace(-1.5, 1.5, 601)
    for yaw in np.linspace(-0.55, 0.55, 12):
        signs = np.sign([value(roll, yaw) for roll in grid])
        at = [
            brentq(value, grid[k], grid[k + 1], args=(yaw,)) for k in np.flatnonzero(signs[1:] != signs[:-1])
        ]
        assert at
        for roll in at:  # the locus misses none
            assert np.min(np.hypot(every[:, 0] - roll, every[:, 1] - yaw)) < 0.05
    crossings = []
    for curve in locus("roll").curves:
        roll, yaw = curve.coordinates.T
        for k in np.flatnonzero(yaw[1:] * yaw[:-1] <= 0):
            crossings.append(
                np.interp(0, *zip(*sorted([(yaw[k], roll[k]), (yaw[k + 1], roll[k + 1])]), strict=True))
            )
    np.testing.assert_allclose(sorted(np.rad2deg(crossings)), [-ROLL, ROLL], rtol=0, atol=0.1)


@pytest.mark.soak
def test_the_locus_in_pitch_and_yaw_is_straight():
    """Pitch atan(s / r) and 90 degrees, whatever the yaw: both, from end to end, and nothing else."""
    every = np.concatenate([curve.coordinates for curve in locus("pitch").curves])
    off = np.abs(np.rad2deg(every[:, :1]) - [PITCH, 90.0])
    assert np.all(np.min(off, axis=1) < 1e-9)
    for line in range(2):
        yaws = np.sort(every[off[:, line] < 1e-9, 1])
        assert abs(yaws[0] + 0.6) < 1e-3 and abs(yaws[-1] - 0.6) < 1e-3
        assert np.max(np.diff(yaws)) < 0.1


def test_there_is_no_type_i_locus_of_a_machine_whose_joints_move_at_rest():
    said = said_by(pk.singularity_locus, DEFAULT, ("roll", "yaw"), kinds="I", nodes=5)
    assert said == "CasingOscillator has kinematically redundant joints: there is no type I locus"
    said = said_by(pk.singularity_locus, DEFAULT, ("roll", "yaw"), free=[0.7, 0.71], nodes=5)
    assert said == "free must be one value of each joint, got a batch"
    said = said_by(pk.singularity_locus, DEFAULT, ("roll", "z"), nodes=5)
    assert said.startswith("axes must be 2 to 3 different ones of s, roll, pitch, yaw, got")
    flat = pk.catalogued("nam-2-rpr")
    assert said_by(pk.singularity_locus, flat, free=0.7, nodes=5).startswith("free must be left out")


# ---------------------------------------------------------------- inverse kinematics, the carriage given


@pytest.mark.parametrize("name", IRREGULAR)
def test_leg_lengths_are_distances(name):
    s, rotation, carriage, found = solved(name, 5)
    assert np.all(np.asarray(found.status) == pk.Status.OK)
    expected = joints_at(IRREGULAR[name], s, rotation, carriage)
    np.testing.assert_allclose(found.joints, expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.joints[:, 4], carriage)


def test_the_carriage_is_given_in_any_form():
    s, rotation, carriage, many = solved("default", 5)
    pose = pk.AxisPose(s, rotation)
    column = pk.inverse_kinematics(DEFAULT, pose, free=carriage[:, None])
    np.testing.assert_array_equal(column.joints, many.joints)
    for free in (0.7, [0.7], np.float32(0.75), 1):
        value = np.ravel(np.asarray(free, float))[0]
        one = pk.inverse_kinematics(DEFAULT, pose[3], free=free)
        assert one.joints.shape == (5,) and one.status == pk.Status.OK
        np.testing.assert_allclose(
            one.joints, joints_at(DEFAULT, s[3], rotation[3], value), rtol=0, atol=1e-15
        )
        shared = pk.inverse_kinematics(DEFAULT, pose, free=free)
        np.testing.assert_allclose(shared.joints, joints_at(DEFAULT, s, rotation, value), rtol=0, atol=1e-15)
    spread = pk.inverse_kinematics(DEFAULT, pose[3], free=carriage)
    expected = joints_at(DEFAULT, np.full(ROWS, s[3]), rotation[3], carriage)
    np.testing.assert_allclose(spread.joints, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", IRREGULAR)
def test_left_out_the_carriage_is_neutral(name):
    mech = IRREGULAR[name]
    s, rotation, _, _ = solved(name, 5)
    found = pk.inverse_kinematics(mech, pk.AxisPose(s, rotation))
    expected = joints_at(mech, s, rotation, float(mech.neutral[1]))
    np.testing.assert_allclose(found.joints, expected, rtol=0, atol=1e-15)


def test_a_carriage_that_is_none_loses_its_own_row():
    s, rotation, carriage, good = solved("default", 5)
    bad = carriage.copy()
    bad[[0, 3, 7, 9]] = NAN, -0.73, 0.0, np.inf
    found = pk.inverse_kinematics(DEFAULT, pk.AxisPose(s, rotation), free=bad)
    is_bad = np.isin(np.arange(ROWS), [0, 3, 7, 9])
    np.testing.assert_array_equal(found.status, np.where(is_bad, pk.Status.BAD_INPUT, pk.Status.OK))
    assert np.all(np.isnan(found.joints[is_bad])) and np.all(np.isnan(found.candidate[is_bad]))
    np.testing.assert_array_equal(found.joints[~is_bad], good.joints[~is_bad])


def test_a_pose_that_is_none_loses_its_own_row():
    s, rotation, carriage, good = solved("default", 5)
    s, rotation = s.copy(), rotation.copy()
    s[1], rotation[4, 1, 2], s[6] = NAN, NAN, np.inf
    found = pk.inverse_kinematics(DEFAULT, pk.AxisPose(s, rotation), free=carriage)
    is_bad = np.isin(np.arange(ROWS), [1, 4, 6])
    np.testing.assert_array_equal(found.status, np.where(is_bad, pk.Status.BAD_INPUT, pk.Status.OK))
    assert np.all(np.isnan(found.joints[is_bad]))
    np.testing.assert_array_equal(found.joints[~is_bad], good.joints[~is_bad])


def legs_at(free, pose):
    return pk.inverse_kinematics(DEFAULT, pose, free=free).joints


RATES = {"forward": jax.jit(jax.jacfwd(legs_at)), "reverse": jax.jit(jax.jacrev(legs_at))}


@pytest.mark.parametrize("way", RATES)
def test_legs_one_and_four_shorten_with_the_carriage(way):
    """l' = -u_x E' of the legs on the carriage, E' itself, and the others stand; a lost row has none."""
    s, rotation, carriage = (each[0] for each in inside(DEFAULT, 6, 1))
    pose = pk.AxisPose(s, rotation)
    _, u = screw_matrix(DEFAULT, s, rotation, carriage)
    np.testing.assert_allclose(RATES[way](carriage, pose), [-u[0, 0], 0, 0, -u[3, 0], 1], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(RATES[way](-carriage, pose), np.zeros(5))


def test_a_carriage_of_the_wrong_kind_is_refused():
    s, rotation, _, _ = solved("default", 5)
    one, many = pk.AxisPose(s[0], rotation[0]), pk.AxisPose(s, rotation)
    ask = lambda pose, free: said_by(pk.inverse_kinematics, DEFAULT, pose, free=free)
    assert ask(many, [0.7, 0.7, 0.7]) == "batched arguments must have the same number of rows, got [3, 200]"
    assert ask(one, [[0.7, 0.7]]).startswith("free must have shape (any, 1)")
    assert ask(one, [[[0.7]]]).startswith("free must have shape (1,) or (batch, ...), got (1, 1, 1)")
    assert ask(one, "any").startswith("free must be real numbers")
    assert ask(one, True).startswith("free must be real numbers")
    flat = pk.catalogued("nam-2-rpr")
    said = said_by(pk.inverse_kinematics, flat, [0.0, 1.5], free=0.7)
    assert said == "free must be left out: TwoRPR has no kinematically redundant joint"


# ---------------------------------------------------------------- forward kinematics


def assert_poses(found, s, rotation, to=1e-11):
    np.testing.assert_allclose(found.s, s, rtol=0, atol=to)
    np.testing.assert_allclose(found.rotation, rotation, rtol=0, atol=to)


@pytest.mark.parametrize("name", ["default", pytest.param("other", marks=pytest.mark.soak)])
def test_forward_of_inverse_is_the_identity_for_every_carriage(name):
    s, rotation, _, found = solved(name, 5)
    back = pk.forward_kinematics(IRREGULAR[name], found.joints)
    assert isinstance(back.pose, pk.AxisPose)
    assert np.all(np.asarray(back.status) == pk.Status.OK)
    assert np.all(np.asarray(back.det_sign) == 1)
    assert_poses(back.pose, s, rotation)
    one = pk.forward_kinematics(IRREGULAR[name], found.joints[0])
    assert_poses(one.pose, s[0], rotation[0])


def test_a_row_that_is_none_hurts_no_other():
    joints = np.array(solved("default", 5)[3].joints)
    good = pk.forward_kinematics(DEFAULT, joints)
    joints[2, 1], joints[5, 0], joints[8, 4], joints[11, 3] = NAN, -0.7, -0.73, 0.0
    found = pk.forward_kinematics(DEFAULT, joints)
    is_bad = np.isin(np.arange(ROWS), [2, 5, 8, 11])
    np.testing.assert_array_equal(found.status, np.where(is_bad, pk.Status.BAD_INPUT, pk.Status.OK))
    for leaf, untouched in zip(jax.tree.leaves(found.pose), jax.tree.leaves(good.pose), strict=True):
        assert np.all(np.isnan(leaf[is_bad]))
        np.testing.assert_array_equal(leaf[~is_bad], untouched[~is_bad])


def test_every_ok_row_closes_and_all_others_are_nan():
    """Joints of poses anywhere, and joints of none."""
    s, rotation, carriage = anywhere(7)
    joints = joints_at(DEFAULT, s, rotation, carriage)
    joints[::4, 0] *= 1.5
    found = pk.forward_kinematics(DEFAULT, joints)
    status = np.asarray(found.status)
    is_ok = status == pk.Status.OK
    assert 10 < np.sum(is_ok) < ROWS - 40 and len(set(status)) >= 3
    at, turned = np.asarray(found.pose.s), np.asarray(found.pose.rotation)
    back = lengths(DEFAULT, at[is_ok], turned[is_ok], carriage[is_ok])
    np.testing.assert_allclose(back, joints[is_ok, :4], rtol=0, atol=1e-12)
    gram = turned[is_ok] @ np.swapaxes(turned[is_ok], 1, 2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), rtol=0, atol=1e-13)
    det = determinant(carriage[is_ok], 0.25, 0.25, at[is_ok], np.moveaxis(turned[is_ok], 0, -1))
    assert np.all(det < 0)  # as at home: -4 E R r E s^3
    assert np.all(np.isnan(at[~is_ok])) and np.all(np.isnan(turned[~is_ok]))
    is_other = status == pk.Status.OTHER_MODE
    there = jax.tree.map(lambda leaf: np.asarray(leaf)[is_other], found.candidate)
    assert np.any(is_other)
    det = determinant(carriage[is_other], 0.25, 0.25, there.s, np.moveaxis(there.rotation, 0, -1))
    assert np.all(det > 0)
    back = lengths(DEFAULT, there.s, there.rotation, carriage[is_other])
    np.testing.assert_allclose(back, joints[is_other, :4], rtol=0, atol=1e-12)


# ---------------------------------------------------------------- velocities


def rates_by_hand(mech, s, rotation, carriage, twist, slide):
    """l' = u . (s' n + w x d) - u_x E'; E'."""
    d, _ = drawn(mech, s, rotation, carriage)
    _, u = screw_matrix(mech, s, rotation, carriage)
    along = twist[:, :1, None] * rotation[:, None, :, 2]
    speed = along + np.cross(twist[:, None, 1:], d)
    legs = np.sum(u * speed, axis=-1)
    legs[:, [0, 3]] -= u[:, [0, 3], 0] * slide[:, None]
    return np.concatenate([legs, slide[:, None]], axis=1)


@pytest.mark.parametrize("name", IRREGULAR)
def test_the_velocity_map_takes_all_five_rates(name):
    mech = IRREGULAR[name]
    s, rotation, carriage, found = solved(name, 5)
    pose = pk.AxisPose(s, rotation)
    j = np.asarray(mapped(mech, pose, found.joints))
    assert j.shape == (ROWS, 4, 5)
    rng = np.random.default_rng(8)
    twist, slide = rng.uniform(-1, 1, (ROWS, 4)), rng.uniform(-1, 1, ROWS)
    rates = rates_by_hand(mech, s, rotation, carriage, twist, slide)
    np.testing.assert_allclose(np.einsum("kij,kj->ki", j, rates), twist, rtol=0, atol=1e-11)

    at_rest = np.asarray(idle(mech, pose, found.joints))
    assert at_rest.shape == (ROWS, 1, 5)
    expected = rates_by_hand(mech, s, rotation, carriage, np.zeros((ROWS, 4)), np.ones(ROWS))
    np.testing.assert_allclose(at_rest[:, 0], expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.einsum("kij,kaj->kia", j, at_rest), 0, rtol=0, atol=1e-12)


def test_the_velocity_map_is_that_of_differences():
    """Central ones of forward kinematics, in each of the five joints."""
    s, rotation, _, found = solved("default", 5)
    rows, h = 8, 1e-6
    j = np.asarray(mapped(DEFAULT, pk.AxisPose(s, rotation), found.joints))[:rows]
    shifted = np.asarray(found.joints)[:rows, None, None] + h * np.stack([np.eye(5), -np.eye(5)], axis=1)
    back = pk.forward_kinematics(DEFAULT, shifted.reshape(-1, 5))
    assert np.all(np.asarray(back.status) == pk.Status.OK)
    at = np.asarray(back.pose.s).reshape(rows, 5, 2)
    turned = np.asarray(back.pose.rotation).reshape(rows, 5, 2, 3, 3)
    slope = (at[..., 0] - at[..., 1]) / (2 * h)
    spin = (turned[:, :, 0] - turned[:, :, 1]) / (2 * h) @ np.swapaxes(rotation[:rows, None], -1, -2)
    turning = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)
    expected = np.concatenate([slope[..., None], turning], axis=-1)
    np.testing.assert_allclose(np.swapaxes(j, 1, 2), expected, rtol=0, atol=1e-8)


# ---------------------------------------------------------------- statics


@cache
def loaded():
    """Configurations, the screws by hand, unit legs, and wrenches."""
    s, rotation, carriage, found = solved("other", 5)
    screws, u = screw_matrix(OTHER, s, rotation, carriage)
    wrench = np.random.default_rng(9).uniform(-1, 1, (ROWS, 4))
    return pk.AxisPose(s, rotation), found.joints, screws, u, wrench


def test_screws_are_the_legs_and_the_carriage_adds_none():
    pose, joints, screws, _, _ = loaded()
    found = pk.screws(OTHER, pose, joints)
    close(found.lines[:, :4], np.swapaxes(screws, 1, 2))
    np.testing.assert_array_equal(found.lines[:, 4], 0)
    np.testing.assert_allclose(found.arms, np.broadcast_to([1, 1, 1, 1, 0], (ROWS, 5)), rtol=0, atol=1e-14)
    close(found.constraints, np.asarray(joints)[:, :4, None] * np.swapaxes(screws, 1, 2))


def test_the_carriage_bears_what_the_legs_load_it_with():
    """Leg forces are S^-1 W, that of the carriage f1 u1x + f4 u4x: power for every motion of all five."""
    pose, joints, screws, u, wrench = loaded()
    forces = np.asarray(pk.joint_forces(OTHER, pose, joints, wrench))
    legs = np.linalg.solve(screws, wrench[..., None])[..., 0]
    close(forces[:, :4], legs, 1e-11)
    close(forces[:, 4], legs[:, 0] * u[:, 0, 0] + legs[:, 3] * u[:, 3, 0], 1e-11)
    rng = np.random.default_rng(10)
    twist, slide = rng.uniform(-1, 1, (ROWS, 4)), rng.uniform(-1, 1, ROWS)
    rates = rates_by_hand(OTHER, np.asarray(pose.s), np.asarray(pose.rotation), joints[:, 4], twist, slide)
    close(np.sum(forces * rates, axis=1), np.sum(wrench * twist, axis=1), 1e-11)


def test_the_wrench_of_forces_is_there_where_the_carriage_is_balanced():
    pose, joints, _, _, wrench = loaded()
    forces = np.array(pk.joint_forces(OTHER, pose, joints, wrench))
    close(pk.platform_wrench(OTHER, pose, joints, forces), wrench, 1e-11)
    forces[::2, 4] += 1e-3 * np.max(np.abs(forces[::2]), axis=1)
    found = np.asarray(pk.platform_wrench(OTHER, pose, joints, forces))
    assert np.all(np.isnan(found[::2]))
    close(found[1::2], wrench[1::2], 1e-11)


def test_there_are_no_preloads():
    pose, joints, *_ = loaded()
    assert pk.preloads(OTHER, pose[0], joints[0]).shape == (0, 5)


def test_a_wrench_at_a_singularity_has_no_forces():
    rotation = euler([0, np.deg2rad(PITCH), 0.3])
    joints = joints_at(DEFAULT, 0.48, rotation, 0.73)
    pose = pk.AxisPose(0.48, rotation)
    assert np.all(np.isnan(pk.joint_forces(DEFAULT, pose, joints, np.ones(4))))


def stiff(screws, u, k):
    """Least energy over E': half of sum k_i (S_i . x' - u_ix E')^2 + k5 E'^2."""
    rows = np.zeros((len(u), 5, 5))
    rows[:, :4, :4] = np.swapaxes(screws, 1, 2)
    rows[:, [0, 3], 4] = -u[:, [0, 3], 0]
    rows[:, 4, 4] = 1
    energy = np.swapaxes(rows, 1, 2) @ (k[:, None] * rows)
    return energy[:, :4, :4] - energy[:, :4, 4:] @ energy[:, 4:, :4] / energy[:, 4:, 4:]


def test_a_soft_carriage_gives_way_in_series():
    """A^T (B K^-1 B^T)^-1 A; and as much as costs least energy; locked, it is that of the legs alone."""
    pose, joints, screws, u, _ = loaded()
    k = np.array([3e5, 2e5, 4e5, 1e5, 2.5e5])
    found = np.asarray(pk.stiffness(OTHER, pose, joints, k))
    size = np.asarray(joints)[:, :4]
    a = size[:, :, None] * np.swapaxes(screws, 1, 2)
    b = np.concatenate([-size[:, :, None] * np.eye(4), np.zeros((ROWS, 4, 1))], axis=2)
    b[:, [0, 3], 4] = -size[:, [0, 3]] * u[:, [0, 3], 0]
    close(found, np.swapaxes(a, 1, 2) @ np.linalg.solve((b / k) @ np.swapaxes(b, 1, 2), a), 1e-11)
    close(found, stiff(screws, u, k), 1e-11)

    locked = (screws * k[:4]) @ np.swapaxes(screws, 1, 2)
    assert np.max(np.abs(found - locked)) > 0.05 * np.max(locked)
    rigid = pk.stiffness(OTHER, pose, joints, [*k[:4], 1e15])
    close(rigid, locked, 1e-8)
    loose = np.asarray(pk.stiffness(OTHER, pose, joints, [*k[:4], 0]))
    close(loose, stiff(screws, u, np.array([*k[:4], 0])), 1e-11)
    least = np.linalg.eigvalsh(loose)
    assert np.all(np.abs(least[:, 0]) < 1e-9 * least[:, -1])  # a motion that nothing holds


# ---------------------------------------------------------------- a mechanism as a user would write it


class Sliding(pk.LegMechanism):
    """A point on two legs whose first foot slides: kinematically redundant, without a closed form."""

    apart: jax.Array

    free_joints = 1

    def attachments(self):
        return jnp.zeros((2, 2))

    def legs(self, points, joints):
        feet = jnp.stack([jnp.stack([joints[2], 0 * joints[2]]), jnp.stack([self.apart, 0 * self.apart])])
        return (jnp.sum((points - feet) ** 2, axis=1) - joints[:2] ** 2) / 2

    def home(self):
        return jnp.array([0.5, 1.0]), jnp.stack([jnp.sqrt(1.25), jnp.hypot(0.5 - self.apart, 1.0), 0.0])

    def free_range(self):
        return jnp.array([[-0.5, 0.5]])

    def length(self):
        return self.apart

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], ())


class Undeclared(Sliding):
    free_joints = 0


class OneEnd(Sliding):
    def free_range(self):
        return jnp.array([-0.5, 0.5])


class Endless(Sliding):
    free_range = pk.Mechanism.free_range


SLIDING = Sliding(apart=1.2)
FOOT = np.array([-0.3, 0.0, 0.2, 0.4])
POINTS = np.array([[0.5, 1.0], [0.6, 0.9], [0.3, 1.2], [0.7, 1.1]])


def by_hand(points, foot):
    return np.stack(
        [np.hypot(points[:, 0] - foot, points[:, 1]), np.hypot(points[:, 0] - 1.2, points[:, 1]), foot],
        axis=1,
    )


@pytest.mark.soak  # compiles for longer than it checks
def test_a_sliding_foot_obeys_the_laws():
    assert len(pk.check_mechanism(SLIDING)) >= 17


def test_newton_finds_the_legs_of_a_sliding_foot():
    found = pk.inverse_kinematics(SLIDING, POINTS, free=FOOT)
    assert np.all(np.asarray(found.status) == pk.Status.OK)
    np.testing.assert_allclose(found.joints, by_hand(POINTS, FOOT), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(found.joints[:, 2], FOOT)
    at_home = pk.inverse_kinematics(SLIDING, POINTS)
    np.testing.assert_allclose(at_home.joints, by_hand(POINTS, 0 * FOOT), rtol=0, atol=1e-14)
    lost = pk.inverse_kinematics(SLIDING, POINTS, free=[NAN, *FOOT[1:]])
    np.testing.assert_array_equal(lost.status, [pk.Status.BAD_INPUT, 0, 0, 0])
    np.testing.assert_array_equal(lost.joints[1:], found.joints[1:])
    back = pk.forward_kinematics(SLIDING, found.joints)
    assert np.all(np.asarray(back.status) == pk.Status.OK)
    np.testing.assert_allclose(back.pose, POINTS, rtol=0, atol=1e-13)


def test_newtons_legs_have_derivatives_in_the_foot():
    rate = jax.jacfwd(lambda free: pk.inverse_kinematics(SLIDING, POINTS[1], free=free).joints)(0.2)
    along = (0.6 - 0.2) / np.hypot(0.6 - 0.2, 0.9)
    np.testing.assert_allclose(rate, [-along, 0, 1], rtol=0, atol=1e-14)


def test_screws_and_forces_of_a_sliding_foot():
    joints = by_hand(POINTS, FOOT)
    feet = np.zeros((4, 2, 2))
    feet[:, 0, 0], feet[:, 1, 0] = FOOT, 1.2
    u = (POINTS[:, None] - feet) / joints[:, :2, None]
    found = pk.screws(SLIDING, POINTS, joints)
    close(found.lines[:, :2], u)
    np.testing.assert_array_equal(found.lines[:, 2], 0)
    np.testing.assert_allclose(found.arms, np.broadcast_to([1, 1, 0], (4, 3)), rtol=0, atol=1e-15)
    wrench = np.array([[1.0, 0.2], [-0.5, 2.0], [0.3, 0.1], [0.0, 1.0]])
    forces = pk.joint_forces(SLIDING, POINTS, joints, wrench)
    legs = np.linalg.solve(np.swapaxes(u, 1, 2), wrench[..., None])[..., 0]
    close(forces, np.column_stack([legs, legs[:, 0] * u[:, 0, 0]]))
    close(pk.platform_wrench(SLIDING, POINTS, joints, forces), wrench)


def test_joints_too_many_are_told_and_so_is_a_range_that_is_none():
    said = said_by(pk.check_mechanism, Undeclared(apart=1.2))
    assert said == "Undeclared has 3 joints in 2 closure equations: the last 1 must be its free_joints"
    said = said_by(pk.check_mechanism, OneEnd(apart=1.2))
    assert said == "OneEnd.free_range must have shape (1, 2), got (2,)"
    with pytest.raises(TypeError, match=r"^Endless is missing free_range\(\): bounds of"):
        Endless(apart=1.2)


def test_joints_too_few_are_told():
    """One joint declared free that the closure equations need."""

    class Short(ThreeRPR):
        free_joints = 1

        def free_range(self):
            return jnp.array([[0.1, 1.0]])

    mech = Short(
        base=[[0.0, 0.0], [1.2, 0.1], [0.4, 1.1]], platform=[[-0.2, -0.15], [0.25, -0.1], [0.02, 0.3]]
    )
    assert "free_joints" in said_by(pk.check_mechanism, mech)


# ---------------------------------------------------------------- the geometry


def changed(row, at, value):
    stroke = [list(ends) for ends in DRAWN["stroke"]]
    stroke[row][at] = value
    return stroke


WRONG = {
    "negative base": ({"base_radius": -0.25}, "base_radius must be positive, got -0.25"),
    "no platform": ({"platform_radius": 0.0}, "platform_radius must be positive"),
    "below the ground": ({"neutral": (-0.5, 0.66)}, "neutral must be positive"),
    "carriage on the other side": ({"neutral": (0.52, -0.66)}, "neutral must be positive"),
    "reversed stroke": ({"stroke": changed(2, 0, 0.9)}, "stroke must be 0 < least < greatest"),
    "no stroke at all": ({"stroke": changed(1, 1, 0.4)}, "stroke must be 0 < least < greatest"),
    "stroke to zero": ({"stroke": changed(0, 0, 0.0)}, "stroke must be 0 < least < greatest"),
    "leg too short": ({"stroke": changed(1, 0, 0.6)}, "neutral must lie inside the stroke, got joints l1 ="),
    "leg too long": ({"stroke": changed(3, 1, 0.5)}, "neutral must lie inside the stroke, got joints l1 ="),
    "carriage off its rail": ({"neutral": (0.52, 0.9)}, "neutral must lie inside the stroke"),
    "no cone": ({"base_cone": 0.0}, "base_cone must be in (0, pi] rad, got 0.0"),
    "cone in degrees": ({"platform_cone": 20.0}, "platform_cone must be in (0, pi] rad, got 20.0"),
    "one cone of four": ({"base_cone": [0.4, 0.4, -0.1, 0.4]}, "base_cone must be in (0, pi] rad"),
    "NaN": ({"base_radius": NAN}, "base_radius must be finite, got nan"),
    "NaN in the stroke": ({"stroke": changed(4, 1, NAN)}, "stroke must be finite"),
    "NaN as cone": ({"platform_cone": NAN}, "platform_cone must be finite, got nan"),
    "infinite neutral": ({"neutral": (np.inf, 0.66)}, "neutral must be finite"),
    "two radii": ({"base_radius": [0.25, 0.25]}, "base_radius must have shape (), got (2,)"),
    "row as radius": ({"platform_radius": [0.25]}, "platform_radius must have shape (), got (1,)"),
    "neutral of three": ({"neutral": (0.5, 0.7, 0.0)}, "neutral must have shape (2,), got (3,)"),
    "one stroke": ({"stroke": (0.4, 0.7)}, "stroke must have shape (5, 2), got (2,)"),
    "strokes of four": ({"stroke": DRAWN["stroke"][:4]}, "stroke must have shape (5, 2), got (4, 2)"),
    "cones of five": ({"base_cone": [0.4] * 5}, "base_cone must have shape () or (4,), got (5,)"),
    "a word": ({"base_radius": "wide"}, "base_radius must be real numbers"),
    "none": ({"stroke": None}, "stroke must be real numbers"),
}


@pytest.mark.parametrize(("wrong", "said"), WRONG.values(), ids=WRONG)
def test_bad_geometry_is_told_in_one_line(wrong, said):
    told = said_by(pk.CasingOscillator, **{**DRAWN, **wrong})
    assert told.startswith(f"CasingOscillator.{said}") and len(told) < 250


def test_the_least_and_the_greatest_cone_are_allowed():
    assert pk.CasingOscillator(**{**DRAWN, "base_cone": np.pi, "platform_cone": [1e-3] * 4}).length() == 0.22


# ---------------------------------------------------------------- files and the command line


def assert_same(found, expected):
    for field in dataclasses.fields(pk.CasingOscillator):
        one, other = (np.asarray(getattr(mech, field.name)) for mech in (found, expected))
        assert one.shape == other.shape and one.tobytes() == other.tobytes(), field.name


def test_a_file_of_the_family_alone_is_the_machine_of_the_paper(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text('family = "CasingOscillator"\nunit = "mm"\n')
    assert_same(load_mechanism(path), DEFAULT)
    assert_same(pk.catalogued("casing-oscillator"), DEFAULT)


def test_fields_of_a_file_are_in_its_unit_and_angles_are_not(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(
        'family = "CasingOscillator"\nunit = "mm"\nbase_radius = 310\nneutral = [485, 729.5]\n'
        "base_cone = [0.1, 0.2, 0.3, 0.4]\nplatform_cone = 0.5\n"
    )
    expected = dataclasses.replace(
        DEFAULT,
        base_radius=0.31,
        neutral=[0.485, 0.7295],
        base_cone=[0.1, 0.2, 0.3, 0.4],
        platform_cone=0.5,
    )
    assert_same(load_mechanism(path), expected)
    path.write_text('family = "CasingOscillator"\nunit = "mm"\nneutral = [480, 900]\n')
    assert "CasingOscillator.neutral must lie inside the stroke" in said_by(load_mechanism, path)


@pytest.mark.parametrize("unit", ["m", "mm", "in"])
def test_what_is_saved_is_loaded(tmp_path, unit):
    rough = dataclasses.replace(OTHER, base_radius=1 / 3, platform_cone=[0.1, 1 / 3, np.pi, 0.7])
    for k, mech in enumerate((DEFAULT, OTHER, rough)):
        save_mechanism(mech, tmp_path / f"{k}.toml", unit=unit)
        assert_same(load_mechanism(tmp_path / f"{k}.toml"), mech)


@pytest.fixture
def run(run, tmp_path, monkeypatch):
    """The command line in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return run


def table(text):
    """Columns by name; numbers as floats."""
    header, *rows = [line.split(",") for line in text.splitlines()]
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    return {k: list(v) if k == "status" else np.array(v, float) for k, v in columns.items()}


NAME = "casing-oscillator"
ANGLES = np.array([[0.1, -0.05, 0.08], [0.0, 0.04, -0.1], [-0.12, 0.02, 0.05]])
SLIDES = np.array([0.48, 0.45, 0.5])


def columns(tmp_path, header, *values):
    """A file of poses."""
    rows = [",".join(map(repr, row)) for row in np.column_stack(values).tolist()]
    (tmp_path / "poses.csv").write_text("\n".join([header, *rows]) + "\n")


def test_rows_there_and_back(run, tmp_path):
    """By angles and by quaternions of any length and sign."""
    quaternions = Rotation.from_euler("xyz", ANGLES).as_quat(scalar_first=True)
    expected = joints_at(DEFAULT, SLIDES, euler(ANGLES), 0.73)
    for header, *values in (
        ("s,roll,pitch,yaw", SLIDES, ANGLES),
        ("s,qw,qx,qy,qz", SLIDES, quaternions * [[1], [-3], [0.2]]),
    ):
        columns(tmp_path, header, *values)
        code, out, _ = run("ik", NAME, "poses.csv", "-o", "joints.csv", "--strict")
        assert code == 0
        found = table((tmp_path / "joints.csv").read_text())
        assert list(found) == ["l1", "l2", "l3", "l4", "E", "status"] and found["status"] == ["OK"] * 3
        got = np.transpose([found[k] for k in ("l1", "l2", "l3", "l4", "E")])
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14)
        code, out, _ = run("fk", NAME, "joints.csv", "--strict")
        back = table(out)
        assert code == 0
        assert list(back)[:8] == ["s", "qw", "qx", "qy", "qz", "roll", "pitch", "yaw"]
        np.testing.assert_allclose(back["s"], SLIDES, rtol=0, atol=1e-12)
        got = np.transpose([back[k] for k in ("roll", "pitch", "yaw")])
        np.testing.assert_allclose(got, ANGLES, rtol=0, atol=1e-11)
        got = np.transpose([back[k] for k in ("qw", "qx", "qy", "qz")])
        np.testing.assert_allclose(got, quaternions * np.sign(quaternions[:, :1]), rtol=0, atol=1e-11)


def test_rows_in_millimetres_and_a_lost_one(run, tmp_path):
    columns(tmp_path, "s_mm,roll,pitch,yaw", 1e3 * SLIDES, [ANGLES[0], [NAN] * 3, ANGLES[2]])
    code, out, err = run("ik", NAME, "poses.csv", "--unit", "mm")
    found = table(out)
    assert code == 0 and found["status"] == ["OK", "BAD_INPUT", "OK"] and "1 BAD_INPUT" in err
    expected = 1e3 * joints_at(DEFAULT, SLIDES, euler(ANGLES), 0.73)
    got = np.transpose([found[k] for k in ("l1", "l2", "l3", "l4", "E")])
    np.testing.assert_allclose(got[[0, 2]], expected[[0, 2]], rtol=0, atol=1e-10)
    assert np.all(np.isnan(got[1]))


def test_show_says_strokes_and_home(run):
    code, out, _ = run("show", NAME, "--unit", "mm")
    assert code == 0 and "family CasingOscillator, lengths in mm" in out
    assert "home joints: l1 723.394775, l2 480, l3 480, l4 723.394775, E 730" in out
    home = next(line for line in out.splitlines() if line.startswith("home pose: "))
    named = dict(pair.split() for pair in home.removeprefix("home pose: ").split("  (")[0].split(", "))
    assert {name: float(value) for name, value in named.items() if float(value)} == {"s": 480, "qw": 1}
    assert list(named) == ["s", "qw", "qx", "qy", "qz", "roll", "pitch", "yaw"]
    assert "base_radius 250\n" in out and "base_cone 0.34906585\n" in out and "margin platform_cone: " in out


def test_jacobian_of_a_pose(run):
    """B is diag(-l) and the carriage's column; J A-dagger: x' = J q'."""
    code, out, _ = run("jacobian", NAME, "--pose", "0.48,0.1,0,0", "--json")
    found, rotation = json.loads(out), euler([0.1, 0, 0])
    screws, u = screw_matrix(DEFAULT, 0.48, rotation, 0.73)
    size = lengths(DEFAULT, 0.48, rotation, 0.73)
    assert code == 0 and found["status"] == "OK"
    np.testing.assert_allclose(list(found["joints"].values()), [*size, 0.73], rtol=0, atol=1e-14)
    assert list(found["joints"]) == ["l1", "l2", "l3", "l4", "E"]
    np.testing.assert_allclose(found["a"], size[:, None] * screws.T, rtol=0, atol=1e-14)
    to_carriage = np.array([u[0, 0], 0, 0, u[3, 0]]) * -size
    np.testing.assert_allclose(found["b"], np.column_stack([-np.diag(size), to_carriage]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.array(found["a"]) @ found["j"], -np.array(found["b"]), rtol=0, atol=1e-13)
    assert found["pose"]["s"] == 0.48 and abs(found["pose"]["roll"] - 0.1) < 1e-15


def test_singularity_of_a_pose(run):
    code, out, _ = run("singularity", NAME, "--pose", f"0.48,0,{np.deg2rad(PITCH):.17g},0.3", "--json")
    found = json.loads(out)
    assert code == 0 and found["kind"] == "TYPE_II" and found["sigma_direct"] < 1e-12
    code, out, _ = run("singularity", NAME, "--pose", "0.48,0.1,0.2,0.3", "--json")
    found = json.loads(out)
    screws, _ = screw_matrix(DEFAULT, 0.48, euler([0.1, 0.2, 0.3]), 0.73)
    assert code == 0 and found["kind"] == "REGULAR"
    np.testing.assert_allclose(found["lines"], [*screws.T.tolist(), [0] * 4], rtol=0, atol=1e-14)
    np.testing.assert_allclose(found["arms"], [1, 1, 1, 1, 0], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("jacobian", NAME, "--pose", "0.48,0.1"), "--pose: there must be"),
        (("singularity", NAME, "--axes", "roll,x"), "axes must be 2 to 3 different ones of s, roll, pitch"),
        (("singularity", NAME, "--axes", "roll,yaw", "--kind", "I"), "there is no type I locus"),
        (("ik", NAME, "poses.csv"), "poses.csv"),
    ],
)
def test_a_mistake_is_one_line(run, arguments, expected, tmp_path):
    (tmp_path / "poses.csv").write_text("s,roll,pitch\n0.48,0,0\n")
    code, out, err = run(*arguments)
    assert code == 2 and not out and err.count("\n") == 1 and expected in err
