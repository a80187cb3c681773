"""Random rows of every family there and back, judged by formulas typed afresh: none is silently wrong."""

import os
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax
import numpy as np
import pytest
import test_forward_rows as stewart
from outsiders import delta, three_legs, three_rpr
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax import Status

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

MANY = int(os.environ.get("PK_SOAK_ROWS", 1_000_000))
FEW = 2000
BLOCK = 100_000
EXACT, NEAR = 1e-12, 1e-9  # of the size of a row: closed to roundoff; as near as the end of a reach is known
NOT_INCONSISTENT = 1e-5  # of the size of a row: what redundant equations may be off, and more
CLOSED = (Status.OK, Status.OTHER_MODE, Status.SINGULAR)  # what says that there is such a pose


# ---------------------------------------------------------------- the families in NumPy


def ring(angles):
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def base_of(mech):
    if isinstance(mech, pk.TwoRPR | pk.FiveBar):
        return float(mech.half_base) * np.array([[1.0, 0], [-1, 0]])
    return np.asarray(mech.base)


def standing(mech, joints):
    return np.broadcast_to(base_of(mech), (len(joints), *base_of(mech).shape))


def elbows(mech, joints):
    return base_of(mech) + np.asarray(mech.proximal)[..., None] * ring(joints)


def ends_of_arms(mech, joints):
    """Of the 6-link."""
    turns = joints[:, ::2] + joints[:, 1::2]
    return elbows(mech, joints[:, ::2]) + np.asarray(mech.distal)[..., None] * ring(turns)


def on_carriage(mech, joints):
    feet = np.zeros((len(joints), 4, 3))
    feet[:, 0, 0] = feet[:, 3, 0] = joints[:, 4]
    feet[:, 1, 1], feet[:, 2, 1] = mech.base_radius, -mech.base_radius
    return feet


OUT = np.concatenate([ring(np.deg2rad([0, 120, 240])), np.zeros((3, 1))], axis=1)  # of the Delta's arms
UP = np.array([0.0, 0, 1])


def delta_elbows(mech, joints):
    out, up = mech.base_radius + mech.arm * np.cos(joints), -mech.arm * np.sin(joints)
    return np.asarray(out)[..., None] * OUT + np.asarray(up)[..., None] * UP


def at_point(mech, pose):
    return np.repeat(pose[:, None], len(base_of(mech)), axis=1)


def in_plane(mech, pose):
    return pose[:, None, :2] + turned(mech, pose)


def turned(mech, pose):
    (c, s), (x, y) = ring(pose[:, 2]).T[..., None], np.asarray(mech.platform).T
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def in_space(mech, pose):
    return pose.translation[:, None] + np.einsum("rij,kj->rki", pose.rotation, mech.platform)


def about_axis(mech, pose):
    r = float(mech.platform_radius)
    points = np.array([[r, r, 0], [0, r, 0], [0, -r, 0], [r, -r, 0]]) + pose.s[:, None, None] * UP
    return np.einsum("rij,rkj->rki", pose.rotation, points)


def delta_tips(mech, pose):
    return pose[:, None] + float(mech.platform_radius) * OUT


class Family(NamedTuple):
    """What its legs are: from the feet to the tips, of the lengths that they must have."""

    make: Callable
    half: tuple[float, ...]  # of the box of poses about home, in lengths of the mechanism and rad
    feet: Callable  # (mech, joints (rows, m)) -> (rows, k, d)
    tips: Callable  # (mech, poses) -> (rows, k, d)
    spans: Callable  # (mech, joints) -> (rows, k) or ()


GIVEN = lambda mech, joints: joints
DISTAL = lambda mech, joints: np.asarray(mech.distal)
PLANE, SPACE = (standing, in_plane, GIVEN), (standing, in_space, GIVEN)
WIDE = (2.5, 2.5, 2.0, 1.2, 1.2, 1.2)  # of a platform in space


def catalogued(name):
    return lambda: pk.catalogued(name)


def four_legs():
    spare = three_rpr()
    return pk.PlanarRPR(
        base=np.concatenate([spare.base, [[-0.3, 0.8]]]),
        platform=np.concatenate([spare.platform, [[-0.1, 0.2]]]),
    )


def four_rrr():
    """Without symmetries."""
    legs = four_legs()
    return pk.PlanarRRR(
        base=legs.base, platform=legs.platform, proximal=(0.7, 0.6, 0.8, 0.75), distal=(0.8, 0.9, 0.7, 0.85)
    )


FAMILIES = {
    "2-rpr": Family(catalogued("nam-2-rpr"), (4, 4), standing, at_point, GIVEN),
    "2-rrr": Family(catalogued("nam-2-rrr"), (4, 4), elbows, at_point, DISTAL),
    "5-link, coaxial": Family(
        lambda: pk.FiveBar(half_base=0.0, proximal=0.23, distal=0.35), (3, 3), elbows, at_point, DISTAL
    ),
    "3-rpr": Family(catalogued("sauer-3-rpr"), (4, 4, 3.2), *PLANE),
    "4-rpr": Family(four_legs, (6, 6, 3.2), *PLANE),
    "3-rrr": Family(catalogued("3-rrr"), (3, 3, 2), elbows, in_plane, DISTAL),
    "4-rrr": Family(four_rrr, (3, 3, 2), elbows, in_plane, DISTAL),
    "6-link": Family(catalogued("6-link"), (6, 6, 3.2), ends_of_arms, in_plane, lambda mech, joints: 0.0),
    "casing-oscillator": Family(
        pk.CasingOscillator, (1, 0.8, 0.8, 0.8), on_carriage, about_axis, lambda mech, joints: joints[:, :4]
    ),
    **{
        name: Family(catalogued(name), WIDE, *SPACE)
        for name in (
            "semi-regular-stewart",
            "wide-semi-regular-stewart",
            "hexapod-log",
            "linuxcnc-hexapod",
            "calibration-hexapod",
            "dietmaier-40",
            "nine-lengths",
            "nine-lengths-general",
        )
    },
    "delta": Family(
        delta, (1.2, 1.2, 1.0), delta_elbows, delta_tips, lambda mech, joints: np.asarray(mech.rod)
    ),
    "outsider's 3-rpr": Family(three_rpr, (2, 2, 3.2), *PLANE),
    "outsider's three legs": Family(three_legs, (1.5, 1.5), standing, at_point, GIVEN),
}
REDUNDANT = ("4-rpr", "4-rrr", "6-link", "nine-lengths", "nine-lengths-general", "outsider's three legs")
NEVER = ("2-rrr", "5-link, coaxial")  # impossible: the distal links reach from any elbow to any other
QUICK = ("2-rpr", "2-rrr")
made = cache(lambda name: FAMILIES[name].make())


class Drawn(NamedTuple):
    """Rows of a mechanism as NumPy sees them."""

    tips: np.ndarray
    legs: np.ndarray  # feet to tips
    gap: np.ndarray  # (rows,) how far the worst leg is from its length
    size: np.ndarray  # (rows,) farthest joint from the origin


def drawn(name, pose, joints):
    family, mech = FAMILIES[name], made(name)
    tips, feet = family.tips(mech, pose), family.feet(mech, joints)
    legs = tips - feet
    gap = np.abs(np.linalg.norm(legs, axis=-1) - family.spans(mech, joints)).max(axis=1)
    return Drawn(tips, legs, gap, np.abs(np.concatenate([tips, feet], axis=1)).max(axis=(1, 2)))


def wrenches(name, pose, joints):
    """The legs as forces on the platform, one a row: A but for the length of its rows. -> (rows, k, n)"""
    tips, legs, *_ = drawn(name, pose, joints)
    if isinstance(pose, pk.AxisPose):
        along = np.einsum("ri,rki->rk", pose.rotation[..., 2], legs)
        return np.concatenate([along[..., None], np.cross(tips, legs)], axis=-1)
    if isinstance(pose, pk.SE3):
        arms = tips - pose.translation[:, None]
        return np.concatenate([legs, np.cross(arms, legs)], axis=-1)[:, :6]
    if pose.shape[1] == legs.shape[2]:
        return legs
    x, y = np.moveaxis(tips - pose[:, None, :2], -1, 0)
    return np.concatenate([legs, (x * legs[..., 1] - y * legs[..., 0])[..., None]], axis=-1)


def side(name, pose, joints):
    """Sign of det A; 0 where there are more legs than freedoms, but for sensors."""
    rows = wrenches(name, pose, joints)
    if name == "6-link" or rows.shape[1] != rows.shape[2]:
        return np.zeros(len(rows))
    return np.sign(np.linalg.det(rows / np.linalg.norm(rows, axis=-1, keepdims=True)))


def room(name, pose):
    """How far the worst leg is from the ends of its reach: < 0 out of reach. -> (rows,)"""
    mech, tips = made(name), FAMILIES[name].tips(made(name), pose)
    if name == "delta":
        legs = tips - float(mech.base_radius) * OUT
        across = np.einsum("rki,ki->rk", legs, np.cross(UP, OUT))
        distance = np.sqrt(np.maximum(np.sum(legs**2, axis=-1) - across**2, 0))
        squared, first = mech.rod**2 - across**2, float(mech.arm)
        second = np.sqrt(np.maximum(squared, 0))
        found = np.where(squared < 0, -np.sqrt(np.abs(squared)), _between(distance, first, second))
    elif isinstance(mech, pk.FiveBar | pk.PlanarRRR | pk.SixLink):
        distance = np.linalg.norm(tips - base_of(mech), axis=-1)
        found = _between(distance, np.asarray(mech.proximal), np.asarray(mech.distal))
    elif isinstance(mech, pk.CasingOscillator):
        found = np.ones(1)  # any pose has legs
    else:
        found = np.linalg.norm(tips - base_of(mech), axis=-1)
    return np.broadcast_to(found.min(axis=-1), len(tips))


def _between(distance, first, second):
    return np.minimum(first + second - distance, distance - np.abs(first - second))


def impossible_by(name, joints):
    """How far two legs and what is between their ends miss a quadrilateral: > 0, no pose. -> (rows,)"""
    family, mech = FAMILIES[name], made(name)
    feet, home = family.feet(mech, joints), rows_of_home(mech)
    spans = np.broadcast_to(family.spans(mech, joints), feet.shape[:2])
    tips = family.tips(mech, home)[0]
    worst = np.full(len(joints), -np.inf)
    for i in range(len(tips)):
        for j in range(i):
            ends = np.linalg.norm(tips[i] - tips[j]), np.linalg.norm(feet[:, i] - feet[:, j], axis=1)
            sides = np.stack(np.broadcast_arrays(spans[:, i], spans[:, j], *ends))
            worst = np.maximum(worst, 2 * sides.max(axis=0) - sides.sum(axis=0))
    return worst


# ---------------------------------------------------------------- random rows


def rows_of_home(mech, count=1):
    return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], count, axis=0), mech.home()[0])


def some_poses(name, count, rng):
    """Over the workspace and beyond."""
    mech, half = made(name), np.array(FAMILIES[name].half, float)
    home, steps = rows_of_home(mech, count), rng.uniform(-1, 1, (count, half.size)) * half
    shift = {2: 2, 3: 2 if mech.pose_units else 3, 4: 1, 6: 3}[half.size]
    steps[:, :shift] *= float(mech.length())
    if isinstance(home, np.ndarray):
        return home + steps
    turn = Rotation.from_rotvec(steps[:, shift:]).as_matrix() @ home.rotation
    if isinstance(home, pk.AxisPose):
        return pk.AxisPose(home.s + steps[:, 0], turn)
    return pk.SE3(home.translation + steps[:, :shift], turn)


def some_joints(name, count, rng):
    """Any angles, and lengths from a fifth to thrice those at home."""
    home = np.asarray(made(name).home()[1])
    is_angle = ~np.asarray(made(name).joint_units or (1,) * home.size, bool)
    lengths = home * rng.uniform(0.2, 3, (count, home.size))
    return np.where(is_angle, rng.uniform(-np.pi, np.pi, lengths.shape), lengths)


def in_blocks(rows, name):
    """Random numbers for each block of rows, and how many it has."""
    for seed, first in enumerate(range(0, rows, BLOCK)):
        yield np.random.default_rng([seed, *name.encode()]), min(BLOCK, rows - first)


def numpy(tree):
    return jax.tree.map(np.asarray, tree)


def take(tree, rows):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


# ---------------------------------------------------------------- the judges


def assert_true(name, joints, found, allowed, start_side):
    """A row that is OK is a pose, closes, and is on the side it says; any other is NaN. -> is_ok"""
    is_ok = found.status == Status.OK
    pose, q = take(found.pose, is_ok), joints[is_ok]
    seen = drawn(name, pose, q)
    assert np.all(seen.gap <= allowed * seen.size), (seen.gap / seen.size).max()
    if hasattr(pose, "rotation"):
        gram = np.einsum("rij,rkj->rik", pose.rotation, pose.rotation)
        np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), rtol=0, atol=1e-13)
        assert np.all(np.linalg.det(pose.rotation) > 0)
    sign = side(name, pose, q)
    np.testing.assert_array_equal(found.det_sign[is_ok], sign * home_side(name))
    if made_square(name):
        np.testing.assert_array_equal(sign, start_side[is_ok])
    assert np.all(found.sigma_min[is_ok] > 0)
    for leaf in jax.tree.leaves(found.pose):
        assert np.all(np.isnan(leaf[~is_ok]))
    return is_ok


def home_side(name):
    return side(name, rows_of_home(made(name)), np.asarray(made(name).home()[1])[None])[0]


def apart(pose, other):
    """Greatest difference of two numbers of each row."""
    leaves = zip(jax.tree.leaves(pose), jax.tree.leaves(other), strict=True)
    return np.max([np.abs(a - b).reshape(len(a), -1).max(axis=1) for a, b in leaves], axis=0)


def made_square(name):
    return name not in REDUNDANT


def closed_to(name):
    """How far a row that is OK may be from closed, over its size."""
    return EXACT if made_square(name) else NOT_INCONSISTENT


def told(name, what, counts):
    print(f"{name}, {what}: " + ", ".join(f"{count} {key}" for key, count in counts.items() if count))


def statuses(found):
    return Counter({Status(k).name: int(n) for k, n in enumerate(np.bincount(found.status)) if n})


families = pytest.mark.parametrize(
    ("name", "rows"),
    [
        *(pytest.param(name, FEW, id=f"{name}, a few") for name in QUICK),
        *(pytest.param(name, MANY, id=name, marks=pytest.mark.soak) for name in FAMILIES),
    ],
)


@families
def test_there_and_back(name, rows):
    """Poses, their joints, and the poses of those."""
    mech, counts = made(name), Counter()
    for rng, count in in_blocks(rows, name):
        pose = some_poses(name, count, rng)
        solved = numpy(pk.inverse_kinematics(mech, pose))
        is_ok, slack = solved.status == Status.OK, room(name, pose)
        seen = drawn(name, take(pose, is_ok), solved.joints[is_ok])
        assert np.all(seen.gap <= EXACT * seen.size), (seen.gap / seen.size).max()
        assert np.all(slack[is_ok] >= -NEAR * seen.size.max()) and np.all(np.isnan(solved.joints[~is_ok]))
        if hasattr(mech, "inverse"):  # Newton may be lost, a closed form is not
            assert np.all(slack[~is_ok] <= NEAR * seen.size.max())
        pose, joints = take(pose, is_ok), solved.joints[is_ok]
        found = numpy(pk.forward_kinematics(mech, joints))
        sign = np.full(len(joints), home_side(name))
        is_back = assert_true(name, joints, found, closed_to(name), sign)
        is_itself = is_back & (apart(found.pose, pose) <= 1e-6 * seen.size)
        if made_square(name):  # nobody comes back from beyond a singularity, unless the two poses are one
            is_regular = is_itself & (found.sigma_min > 1e-4)
            assert np.all(side(name, pose, joints)[is_regular] == home_side(name))
        else:  # another mode of some legs may close the others to 1e-6 by chance: the residual says so
            gap = drawn(name, take(found.pose, is_back), joints[is_back]).gap / seen.size[is_back]
            by_chance = gap > EXACT
            assert np.sum(by_chance) <= max(1, count * 1e-4)
            assert np.all(found.residual[is_back][by_chance] > EXACT * seen.size[is_back][by_chance])
            counts["closed by chance"] += int(np.sum(by_chance))
        counts += statuses(found) + Counter(
            {"out of reach": int(np.sum(~is_ok)), "itself": int(is_itself.sum())}
        )
    told(name, "there and back", counts)
    assert counts["OK"] > rows / 50


@families
def test_from_any_guess(name, rows):
    """Each row from a pose of its own: the answer is on the side of its guess."""
    mech, counts = made(name), Counter()
    for rng, count in in_blocks(rows // 10, name):
        joints = numpy(pk.inverse_kinematics(mech, some_poses(name, count, rng))).joints
        joints = joints[np.all(np.isfinite(joints), axis=1)]
        guess = some_poses(name, len(joints), rng)
        found = numpy(pk.forward_kinematics(mech, joints, guess))
        assert_true(name, joints, found, closed_to(name), side(name, guess, joints))
        counts += statuses(found)
    told(name, "from any guess", counts)
    assert counts["OK"] > rows / 1000


@families
def test_joints_that_no_pose_has(name, rows):
    """Two legs and the distances of their ends make no quadrilateral: nothing says that there is a pose."""
    mech, counts = made(name), Counter()
    allowed = closed_to(name)
    for rng, count in in_blocks(rows // 10, name):
        joints = some_joints(name, count, rng)
        guess = some_poses(name, count, rng)
        size = float(mech.length()) + np.abs(joints).max(axis=1)
        is_impossible = impossible_by(name, joints) > (NEAR if made_square(name) else 1e-3) * size
        for start in (None, guess):
            found = numpy(pk.forward_kinematics(mech, joints, start))
            sides = np.full(count, home_side(name)) if start is None else side(name, guess, joints)
            assert_true(name, joints, found, allowed, sides)
            assert not np.any(np.isin(found.status[is_impossible], CLOSED))
            counts += statuses(take(found, is_impossible))
    told(name, "impossible", counts)
    assert counts.total() or name in NEVER


@pytest.mark.soak
@pytest.mark.parametrize("name", REDUNDANT)
def test_redundant_joints_that_disagree(name):
    """Off by a thousandth to a tenth: not OK, but for the few that still fit."""
    mech, counts = made(name), Counter()
    for rng, count in in_blocks(MANY // 10, name):
        joints = numpy(pk.inverse_kinematics(mech, some_poses(name, count, rng))).joints
        joints = joints[np.all(np.isfinite(joints), axis=1)]
        off = 10 ** rng.uniform(-3, -1, (len(joints), 1)) * rng.choice([-1, 1], joints.shape)
        joints = joints * (1 + off) if mech.joints_are_distances else joints + off
        found = numpy(pk.forward_kinematics(mech, joints))
        assert_true(name, joints, found, NOT_INCONSISTENT, None)
        counts += statuses(found)
    told(name, "disagreeing", counts)
    assert counts["OK"] <= counts.total() / 100 and counts["INCONSISTENT"] > counts.total() / 4


@pytest.mark.soak
def test_every_pose_about_home_of_a_semi_regular_platform_comes_back_as_itself():
    """Unless it is beyond a singularity; then it does not."""
    mech = pk.catalogued("semi-regular-stewart")
    for seed in range(-(-MANY // BLOCK)):
        poses = stewart.some_poses(mech, min(MANY, BLOCK), seed=seed)
        found = pk.forward_kinematics(mech, stewart.lengths(mech, poses)).pose
        np.testing.assert_array_equal(apart(found, poses) <= 1e-6, stewart.sides(mech, poses) > 0)
