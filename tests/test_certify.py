"""What is certified is true: checked by Newton's method with 50 digits, on equations of its own."""

import functools
import math
from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import outsiders
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import said_by
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.geometry.poses import retract, tangent_size
from pk_jax.mechanisms.catalogue import CATALOGUE

pytestmark = pytest.mark.usefixtures("compiled_in_haste")
pick = lambda tree, row: jax.tree.map(lambda leaf: leaf[row], tree)


# ---------------------------------------------------------------- roots with 50 digits


def exactly(array):
    """Floats as the decimal numbers that they are, in nested lists."""
    array = np.asarray(array)
    return [exactly(row) for row in array] if array.ndim else Decimal(float(array))


PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899")


def cosine_and_sine(angle):
    """By their series."""
    angle -= round(angle / (2 * PI)) * 2 * PI
    terms, total = Decimal(1), [Decimal(1), Decimal(0)]
    for k in range(1, 80):
        terms *= angle / k
        total[k % 2] += (-1) ** (k // 2) * terms
    return total


def dot(u, v):
    return sum(a * b for a, b in zip(u, v, strict=True))


def turn_of(w):
    """Cayley's map, (1 + |h|^2) C = (1 - |h|^2) + 2 h h^T + 2 [h], h = w / 2."""
    x, y, z = (each / 2 for each in w)
    s, d = 1 - x * x - y * y - z * z, 1 + x * x + y * y + z * z
    rows = [
        [s + 2 * x * x, 2 * (x * y - z), 2 * (x * z + y)],
        [2 * (x * y + z), s + 2 * y * y, 2 * (y * z - x)],
        [2 * (x * z - y), 2 * (y * z + x), s + 2 * z * z],
    ]
    return [[each / d for each in row] for row in rows]


def product(a, b):
    return [[dot(row, column) for column in zip(*b, strict=True)] for row in a]


class Spatial:
    """A translation and an exact rotation."""

    size = 6

    def __init__(self, translation, rotation):
        self.translation, self.rotation = translation, rotation

    @classmethod
    def near(cls, pose):
        x, y, z, w = exactly(Rotation.from_matrix(np.asarray(pose.rotation)).as_quat())
        return cls(exactly(pose.translation), turn_of([2 * x / w, 2 * y / w, 2 * z / w]))

    def moved(self, by):
        to = [a + b for a, b in zip(self.translation, by[:3], strict=True)]
        return Spatial(to, product(turn_of(by[3:]), self.rotation))

    def distance(self, pose, length):
        """From a pose in float64; the angle is that of the chord |.|_F / sqrt 2."""
        v = [a - b for a, b in zip(self.translation, exactly(pose.translation), strict=True)]
        pairs = zip(self.rotation, exactly(pose.rotation), strict=True)
        squares = [(a - b) ** 2 for rows in pairs for a, b in zip(*rows, strict=True)]
        chord = (sum(squares) / 2).sqrt()
        angle = Decimal(2 * math.asin(min(1.0, float(chord) / 2)))
        return float((dot(v, v) + (length * angle) ** 2).sqrt())


class Plane:
    """Coordinates; the third is an angle."""

    def __init__(self, coordinates):
        self.at, self.size = coordinates, len(coordinates)

    @classmethod
    def near(cls, pose):
        return cls(exactly(pose))

    def moved(self, by):
        return Plane([a + b for a, b in zip(self.at, by, strict=True)])

    def distance(self, pose, length):
        v = [a - b for a, b in zip(self.at, exactly(pose), strict=True)]
        return float((dot(v, v) + (length * length - 1) * sum(each * each for each in v[2:])).sqrt())


def leg_equations(mech, joints):
    """|leg|^2 - l^2 of a Stewart platform, with sensors or without."""
    base, platform, joints = exactly(mech.base), exactly(mech.platform), exactly(joints)

    def closure(pose):
        found = []
        for a, b, length in zip(base, platform, joints, strict=True):
            ends = zip(pose.translation, pose.rotation, a, strict=True)
            leg = [t + dot(row, b) - start for t, row, start in ends]
            found.append((dot(leg, leg) - length * length) / 2)
        return found

    return closure


def planar_equations(mech, joints):
    """|leg|^2 - l^2 of a 3-RPR."""
    base, platform, joints = exactly(mech.base), exactly(mech.platform), exactly(joints)

    def closure(pose):
        x, y, phi = pose.at
        c, s = cosine_and_sine(phi)
        found = []
        for (ax, ay), (bx, by), length in zip(base, platform, joints, strict=True):
            leg = x + c * bx - s * by - ax, y + s * bx + c * by - ay
            found.append(dot(leg, leg) - length * length)
        return found

    return closure


def five_bar_equations(mech, joints):
    """|distal link|^2 - lb^2 of a five-bar."""
    half, proximal, distal = (Decimal(float(each)) for each in (mech.half_base, mech.proximal, mech.distal))
    arms = [cosine_and_sine(angle) for angle in exactly(joints)]
    elbows = [(side * half + proximal * c, proximal * s) for side, (c, s) in zip((1, -1), arms, strict=True)]

    def closure(pose):
        links = [(pose.at[0] - x, pose.at[1] - y) for x, y in elbows]
        return [dot(link, link) - distal**2 for link in links]

    return closure


def point_equations(mech, joints):
    """|leg|^2 - l^2 of legs that meet in a point."""
    base, joints = exactly(mech.base), exactly(joints)

    def closure(pose):
        legs = [[x - a for x, a in zip(pose.at, foot, strict=True)] for foot in base]
        return [(dot(leg, leg) - length**2) / 2 for leg, length in zip(legs, joints, strict=True)]

    return closure


def differences(function, pose, step):
    """The derivatives by each coordinate, one row each."""
    found = []
    for i in range(pose.size):
        by = [step if j == i else Decimal(0) for j in range(pose.size)]
        ends = function(pose.moved(by)), function(pose.moved([-each for each in by]))
        found.append([(a - b) / (2 * step) for a, b in zip(*ends, strict=True)])
    return found


def solved(rows, values):
    """The solution of a linear system given by columns, by elimination."""
    n = len(values)
    table = [[*row, value] for row, value in zip(zip(*rows, strict=True), values, strict=True)]
    for k in range(n):
        pivot = max(range(k, n), key=lambda i: abs(table[i][k]))
        table[k], table[pivot] = table[pivot], table[k]
        for i in range(n):
            if i != k:
                factor = table[i][k] / table[k][k]
                table[i] = [a - factor * b for a, b in zip(table[i], table[k], strict=True)]
    return [table[k][n] / table[k][k] for k in range(n)]


def root_near(equations, pose, *, digits=50):
    """Newton's method from a pose: the zero, to `digits` digits; of more equations, where their sum of
    squares is stationary. None where it is not found.
    """
    if len(equations(pose)) > pose.size:
        squares = equations
        equations = lambda at: [
            dot(squares(at), rates) for rates in differences(squares, at, Decimal(10) ** (-digits // 2))
        ]
    for _ in range(60):
        by = [-each for each in solved(differences(equations, pose, Decimal("1e-20")), equations(pose))]
        pose = pose.moved(by)
        if max(map(abs, by)) < Decimal("1e-30"):
            return pose
    return None


def ratios(mech, equations, kind, poses, joints, *, digits=50):
    """Where certified, how far the root is over the radius. -> (certified,), the largest must be <= 1"""
    found, length, shares = pk.certify(mech, poses, joints), Decimal(float(mech.length())), []
    with localcontext(prec=digits):
        for row in np.flatnonzero(found.is_certified):
            pose = pick(poses, row)
            root = root_near(equations(mech, joints[row]), kind.near(pose), digits=digits)
            off = math.inf if root is None else root.distance(pose, length)
            shares.append(off / float(found.radius[row]))
    assert np.all(found.radius[found.is_certified] <= found.unique_within[found.is_certified])
    return np.array(shares)


# ---------------------------------------------------------------- random configurations


def moved(mech, poses, sizes, seed=0):
    """Every pose of a batch moved by random increments of some size, without units."""
    rng, n = np.random.default_rng(seed), tangent_size(pick(poses, 0))
    turns = rng.standard_normal((len(sizes), n))
    twists = np.asarray(sizes)[:, None] * turns / np.linalg.norm(turns, axis=1, keepdims=True)
    units = pk.geometry.poses.pose_units(pick(poses, 0), mech.pose_units)
    twists = twists * np.where(units, float(mech.length()), 1.0)
    return _RETRACT(poses, twists)


_RETRACT = jax.jit(jax.vmap(retract))
_INVERSE = jax.jit(jax.vmap(lambda mech, pose: mech.inverse(pose), in_axes=(None, 0)))


def around_home(mech, count, size=0.3, seed=0):
    """Poses around home, and their joints."""
    home = mech.home()[0]
    start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), home)
    poses = moved(mech, start, size * np.random.default_rng(seed).uniform(size=count), seed)
    return poses, _INVERSE(mech, poses)


STEWART = pk.catalogued("semi-regular-stewart")
RPR = pk.catalogued("arte-3-rpr")
TWO_RPR = pk.catalogued("nam-2-rpr")
SIZES = 10.0 ** np.linspace(-14, 0, 300)


# ---------------------------------------------------------------- every mechanism


EVERY = {name: functools.partial(pk.catalogued, name) for name in CATALOGUE} | {
    "three_rpr": outsiders.three_rpr,
    "three_legs": outsiders.three_legs,
}
QUICK = ("4-rrr", "6-link")  # the other families have tests of their own


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.soak) for name in EVERY]
)
def test_solutions_of_every_mechanism_are_certified_closely(name):
    mech = EVERY[name]()
    poses, joints = around_home(mech, 20, size=0.05)
    found, length = pk.certify(mech, poses, joints), float(mech.length())
    assert np.all(found.is_certified)
    assert np.all(found.radius < 1e-12 * length)
    assert np.all(found.unique_within > 1e-4 * length)


@pytest.mark.parametrize("count", [300, pytest.param(4000, marks=pytest.mark.soak)])
def test_solutions_of_six_legs_are_certified(count):
    """All but one in a thousand, though poses are up to 0.7 of the platform's size and of a radian off."""
    for name in ("semi-regular-stewart", "hexapod-log", "linuxcnc-hexapod", "calibration-hexapod"):
        mech = pk.catalogued(name)
        found = pk.certify(mech, *around_home(mech, count, size=0.7))
        assert np.sum(found.is_certified) >= 0.999 * count


# ---------------------------------------------------------------- the root is inside of the ball


@pytest.mark.parametrize("count", [300, pytest.param(10_000, marks=pytest.mark.soak)])
def test_the_root_of_six_legs_is_in_the_ball(count):
    poses, joints = around_home(STEWART, count)
    sizes = 10.0 ** np.linspace(-14, 0, count)
    shares = ratios(STEWART, leg_equations, Spatial, moved(STEWART, poses, sizes, 1), joints)
    assert np.all(shares <= 1)
    assert len(shares) > 0.7 * count  # whatever is closer than 1 %


CASES = {
    "3-RPR": (lambda: RPR, planar_equations),
    "five-bar": (lambda: pk.catalogued("5-link"), five_bar_equations),
    "three legs": (outsiders.three_legs, point_equations),
}


@pytest.mark.parametrize("name", CASES)
def test_the_root_in_the_plane_is_in_the_ball(name):
    make, equations = CASES[name]
    mech = make()
    poses, joints = around_home(mech, 60, size=0.2)
    poses = moved(mech, poses, 10.0 ** np.linspace(-14, 0, 60), 1)
    shares = ratios(mech, equations, Plane, poses, joints, digits=80)
    assert np.all(shares <= 1) and len(shares) > 40


def test_the_stationary_point_of_nine_lengths_is_in_the_ball():
    """Lengths that disagree: no pose has them all."""
    mech = pk.catalogued("nine-lengths")
    poses, joints = around_home(mech, 6, size=0.1)
    joints = joints * (1 + 1e-5 * np.random.default_rng(2).standard_normal(joints.shape))
    shares = ratios(
        mech, leg_equations, Spatial, moved(mech, poses, 10.0 ** np.arange(-9, -3), 1), joints, digits=80
    )
    assert len(shares) == 6 and np.all(shares <= 1)


def test_the_radius_is_not_much_more_than_the_distance():
    poses, joints = around_home(STEWART, 20)
    given = moved(STEWART, poses, np.full(20, 1e-6))
    shares = ratios(STEWART, leg_equations, Spatial, given, joints)
    assert len(shares) == 20 and np.all(shares > 0.5)


def test_angles_of_many_turns():
    """Turns of the platform by 2 pi k leave the solution where it is, but for roundoff of the angle."""
    poses, joints = pick(around_home(RPR, 60, size=0.2), slice(8))
    turned = poses + 2 * np.pi * np.arange(-150, 170, 40)[:, None] * np.array([0, 0, 1])
    shares = ratios(RPR, planar_equations, Plane, turned, joints)
    assert len(shares) == 8 and np.all(shares <= 1)
    assert np.all(pk.certify(RPR, turned, joints).radius < 1e-10)


def test_a_rotation_of_six_digits():
    poses, joints = around_home(STEWART, 20)
    printed = pk.SE3(poses.translation, np.round(np.asarray(poses.rotation), 6))
    found, length = pk.certify(STEWART, printed, joints), float(STEWART.length())
    assert np.all(found.is_certified)
    assert np.all((found.radius > 1e-7 * length) & (found.radius < 1e-5 * length))
    assert np.all(ratios(STEWART, leg_equations, Spatial, printed, joints) <= 1)


def test_a_matrix_that_is_too_long_is_not_the_rotation_nearest_to_it():
    """The same numbers times 1.000002: the rotation is the same, the radius counts what it cannot know."""
    poses, joints = around_home(STEWART, 20)
    found = pk.certify(STEWART, pk.SE3(poses.translation, 1.000002 * poses.rotation), joints)
    assert np.all(found.is_certified) and np.all(found.radius > 2e-6 * float(STEWART.length()))


# ---------------------------------------------------------------- no other root is in the ball


@given(st.floats(-1.5, 1.5), st.floats(-9, 0.3))
@settings(max_examples=25)
def test_the_mirrored_mode_is_outside(x, log_height):
    """Two legs to a point: its solutions are (x, y) and (x, -y), however close."""
    height = 10.0**log_height
    pose = np.array([x, height])
    found = pk.certify(TWO_RPR, pose, TWO_RPR.inverse(pose))
    assert not found.unique_within >= 2 * height
    if height > 1e-3 and abs(abs(x) - 1) > 0.1:
        assert found.is_certified and found.unique_within > height / 100


def test_assembly_modes_are_outside_of_each_others_balls():
    """3-RPR have up to six; the angle is the shorter way round."""
    mech = pk.catalogued("sauer-3-rpr")
    joints = np.asarray(around_home(mech, 60, size=0.5)[1])
    modes, is_real = jax.jit(jax.vmap(mech.forward))(joints)
    rows, slots = np.nonzero(np.asarray(is_real))
    poses = np.asarray(modes)[rows, slots]
    found = pk.certify(mech, poses, joints[rows])
    apart = poses[:, None] - poses
    apart[:, :, 2] = float(mech.length()) * (np.mod(apart[:, :, 2] + np.pi, 2 * np.pi) - np.pi)
    apart = np.linalg.norm(apart, axis=2)
    is_other = (rows[:, None] == rows) & (slots[:, None] != slots)
    assert np.sum(is_other) > 60 and np.mean(found.is_certified) > 0.95
    is_close = found.unique_within[:, None] - found.radius[None, :] >= apart
    assert not np.any(is_other & is_close)


class Stairs(pk.Mechanism):
    """x - step(x) = q: for q = 0 the solutions 0 and 1, and the slope 1 at both."""

    size: jax.Array

    def residual(self, pose, joints):
        return pose - jnp.where(pose > 0.5, 1.0, 0.0) - joints

    def home(self):
        return jnp.zeros(1), jnp.zeros(1)

    def length(self):
        return self.size

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(jnp.zeros((1, 2)), ())


def test_jumps_end_what_is_proved():
    found = pk.certify(Stairs(size=4.0), np.zeros(1), np.zeros(1))
    assert found.is_certified and 0.1 < found.unique_within <= 0.5
    assert not pk.certify(Stairs(size=4.0), np.array([0.5]), np.array([0.5])).is_certified


# ---------------------------------------------------------------- what is not certified


def test_singular_poses_are_not():
    """Two legs on one line; a semi-regular platform a quarter turn from level and unturned."""
    flat = np.array([0.2, 0.0])
    assert not pk.certify(TWO_RPR, flat, TWO_RPR.inverse(flat)).is_certified
    home = STEWART.home()[0]
    for degrees, is_regular in ((90, False), (-90, False), (60, True)):
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        pose = pk.SE3(home.translation, turn)
        found = pk.certify(STEWART, pose, STEWART.inverse(pose))
        assert found.is_certified == is_regular
        assert np.isnan(found.radius) == np.isnan(found.unique_within) == (not is_regular)


def test_wrong_joints_are_not():
    poses, joints = around_home(STEWART, 20)
    assert not np.any(pk.certify(STEWART, poses, joints * 1.2).is_certified)
    assert not np.any(pk.certify(STEWART, poses, -joints).is_certified)  # they are distances
    assert not np.any(pk.certify(STEWART, poses, joints[::-1]).is_certified)


def test_a_pose_that_is_off_has_a_radius_that_says_so():
    poses, joints = around_home(STEWART, 20, size=0.1)
    found = pk.certify(STEWART, moved(STEWART, poses, np.full(20, 1e-3)), joints)
    assert np.all(found.is_certified)
    assert np.all(found.radius >= 1e-3 * 0.999 * float(STEWART.length()))
    assert not np.any(pk.certify(STEWART, moved(STEWART, poses, np.full(20, 0.5)), joints).is_certified)


def spoiled(poses, joints):
    """A batch with rows that are none: NaN, infinite, a reflection, a stretched matrix, one of zeros."""
    translation, rotation = (np.array(leaf) for leaf in (poses.translation, poses.rotation))
    joints = np.array(joints)
    translation[1, 0], rotation[2, 1, 1], joints[3, 4], translation[4, 2] = np.nan, np.nan, np.nan, np.inf
    rotation[5] *= -1
    rotation[6] *= 1.001
    rotation[7] = 0
    joints[8, 0] = np.inf
    return jax.tree.unflatten(jax.tree.structure(poses), [translation, rotation]), joints


def test_bad_rows_are_not_and_hurt_no_other():
    poses, joints = around_home(STEWART, 20)
    whole, found = pk.certify(STEWART, poses, joints), pk.certify(STEWART, *spoiled(poses, joints))
    np.testing.assert_array_equal(found.is_certified, np.isin(np.arange(20), range(1, 9), invert=True))
    is_good = np.asarray(found.is_certified)
    for name in ("radius", "unique_within"):
        assert np.all(np.isnan(getattr(found, name)[~is_good]))
        np.testing.assert_array_equal(getattr(found, name)[is_good], getattr(whole, name)[is_good])


# ---------------------------------------------------------------- rows


def test_a_batch_is_its_rows(monkeypatch):
    monkeypatch.setattr("pk_jax.kinematics.certify.ROWS", 4)
    for mech in (STEWART, RPR):
        poses, joints = pick(around_home(mech, 20), slice(7))
        found = pk.certify(mech, poses, joints)
        assert found.radius.shape == found.unique_within.shape == found.is_certified.shape == (7,)
        alone = [pk.certify(mech, pick(poses, row), joints[row]) for row in range(7)]
        for name in found._fields:
            assert getattr(alone[0], name).shape == ()
            np.testing.assert_array_equal(getattr(found, name), [getattr(each, name) for each in alone])
        one_pose = pk.certify(mech, pick(poses, 3), joints)
        one_row = pk.certify(mech, poses, joints[3])
        for each in (one_pose, one_row):
            assert each.radius.shape == (7,) and each.radius[3] == found.radius[3]
    none = pk.certify(RPR, np.zeros((0, 3)), np.zeros((0, 3)))
    assert none.is_certified.shape == none.radius.shape == (0,)


def test_a_slide_and_a_turn():
    mech = pk.CasingOscillator()
    poses, joints = around_home(mech, 20, size=0.1)
    found = pk.certify(mech, moved(mech, poses, np.full(20, 1e-5)), joints)
    exact = pk.certify(mech, poses, joints)
    assert np.all(found.is_certified) and np.all(exact.is_certified)
    off = 1e-5 * float(mech.length())
    assert np.all((found.radius > 0.999 * off) & (found.radius < 1.2 * off)) and np.all(exact.radius < 1e-13)


# ---------------------------------------------------------------- with forward kinematics


def test_forward_kinematics_certifies_what_is_ok():
    """A robot without closed form; one row has no question to answer."""
    mech = outsiders.delta()
    joints = 0.3 * np.random.default_rng(1).standard_normal((5, 3))
    joints[2, 1] = np.nan
    found = pk.forward_kinematics(mech, joints, certify=True)
    np.testing.assert_array_equal(found.is_certified, found.status == pk.Status.OK)
    np.testing.assert_array_equal(found.is_certified, [True, True, False, True, True])
    np.testing.assert_array_equal(np.isnan(found.radius), ~found.is_certified)
    assert np.nanmax(found.radius) < 1e-13
    one = pk.forward_kinematics(mech, joints[0], certify=True)
    assert one.is_certified and one.radius.shape == () and one.radius < 1e-13
    plain = pk.forward_kinematics(mech, joints)
    for mine, others in zip(plain, found[:7], strict=True):  # certifying changes nothing else
        np.testing.assert_array_equal(mine, others)


# ---------------------------------------------------------------- refusals


def test_what_cannot_be_certified_is_refused():
    pose, joints = STEWART.home()
    assert "outside of jit" in said_by(jax.jit(lambda q: pk.certify(STEWART, pose, q)), joints)
    assert "outside of jit" in said_by(jax.jit(lambda: pk.certify(STEWART, pose, joints)))
    traced = jax.jit(lambda q: pk.forward_kinematics(STEWART, q, certify=True))
    assert "certify=True needs known values" in said_by(traced, joints)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), STEWART)
    for call in (pk.certify, lambda mech, pose, q: pk.forward_kinematics(mech, q, certify=True)):
        assert "enable_x64" in said_by(call, single, pose, joints)
    assert "takes a pk_jax.Mechanism" in said_by(pk.certify, "stewart", pose, joints)
    assert "SE3" in said_by(pk.certify, STEWART, np.zeros(6), joints)
    assert "(6,)" in said_by(pk.certify, STEWART, pose, joints[:5])
    assert "(3,)" in said_by(pk.certify, RPR, np.zeros(2), np.ones(3))
    poses = around_home(STEWART, 20)[0]
    assert "number of rows" in said_by(pk.certify, STEWART, poses, np.stack([joints] * 2))


class Tilted(Stairs):
    def residual(self, pose, joints):
        return jnp.arctan2(pose, self.size) - joints


def test_a_primitive_without_bounds_is_named():
    assert "atan2" in said_by(pk.certify, Tilted(size=1.0), np.zeros(1), np.zeros(1))
