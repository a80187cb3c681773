"""The pose of a Stewart platform from six legs and three sensors: published equations, verdicts and laws."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from outsiders import three_legs
from refusals import said_by
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax import Status
from pk_jax.kinematics.closed_form import closed_form
from pk_jax.kinematics.linear_stage import matrix_of, stage_of
from pk_jax.kinematics.quadrics import quadrics_of

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

NAN, INF = np.nan, np.inf
EDGES = ((0, 2), (0, 1), (1, 0), (1, 2), (2, 1), (2, 0))  # B_i = k T_a + (1 - k) T_b, eq. (1)
GENERAL, PLANAR = 1, 2  # the two embodiments
BOTH = pytest.mark.parametrize("embodiment", [GENERAL, PLANAR])


# ---------------------------------------------------------------- random platforms, poses and lengths


def on_edges(k):
    found = np.zeros((6, 3))
    for row, (a, b) in zip(found, EDGES, strict=True):
        row[a], row[b] = k, 1 - k
    return found


def equilateral(side):
    at = np.deg2rad([90.0, 210.0, 330.0])
    return side / np.sqrt(3) * np.stack([np.cos(at), np.sin(at), 0 * at], axis=1)


def some_base(rng, embodiment, height=0.3):
    base = rng.uniform(-1, 1, (9, 3)) * [1, 1, height if embodiment == GENERAL else 0]
    base[6:, 2] = 0
    return base


def stage_condition(base, k):
    values = np.linalg.svd((k[:, :, None] * (base[6:] - base[:6, None])).reshape(6, 9), compute_uv=False)
    return values[0] / values[-1]


def some_layout(rng, embodiment, height=0.3, most=1e4):
    """Base, platform, k and p of a platform as it is published, T equilateral and B_i on its edges."""
    while True:
        base, k, p = some_base(rng, embodiment, height), rng.uniform(0.6, 0.95), rng.uniform(0.6, 1.2)
        if stage_condition(base, on_edges(k)) <= most:
            return base, np.concatenate([on_edges(k) @ equilateral(p), equilateral(p)]), k, p


def some_platform(rng, embodiment, **named):
    base, platform, _, _ = some_layout(rng, embodiment, **named)
    return pk.Stewart(base=base, platform=platform)


def some_poses(rng, count, tilt=40.0, heights=(0.7, 1.3)):
    tilts, around = np.deg2rad(rng.uniform(0, tilt, count)), rng.uniform(0, 2 * np.pi, count)
    axis = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    yaw = rng.uniform(-np.pi, np.pi, count)[:, None] * [0.0, 0.0, 1.0]
    turn = Rotation.from_rotvec(tilts[:, None] * axis) * Rotation.from_rotvec(yaw)
    shift = np.concatenate([rng.uniform(-0.3, 0.3, (count, 2)), rng.uniform(*heights, (count, 1))], axis=1)
    return pk.SE3(shift, turn.as_matrix())


def place(pose, points):
    turned = np.einsum("...ij,kj->...ki", np.asarray(pose.rotation), np.asarray(points))
    return np.asarray(pose.translation)[..., None, :] + turned


def lengths_of(platform, pose):
    return np.linalg.norm(place(pose, platform.platform) - np.asarray(platform.base), axis=-1)


def error_of(found, expected):
    """Greatest difference of any entry; NaN where one is NaN."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return max(np.abs(np.asarray(a) - np.asarray(b)).max() for a, b in pairs)


def assert_same(found, expected, atol=0.0):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def tangent(pose, other):
    """(v, w) from one pose to another, w a rotation vector in base axes. -> (..., 6)"""
    turn = np.asarray(other.rotation) @ np.swapaxes(np.asarray(pose.rotation), -1, -2)
    w = Rotation.from_matrix(turn).as_rotvec()
    return np.concatenate([np.asarray(other.translation) - np.asarray(pose.translation), w], axis=-1)


def take(tree, rows):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def rng_of(*seed):
    return np.random.default_rng(seed)


# ---------------------------------------------------------------- exact lengths


def check_exact(embodiment, count, seed):
    rng = rng_of(seed, embodiment)
    for _ in range(count):
        platform = some_platform(rng, embodiment)
        poses = some_poses(rng, 4)
        found = pk.nine_length_pose(platform, lengths_of(platform, poses))
        np.testing.assert_array_equal(found.status, Status.OK)
        assert error_of(found.pose, poses) <= 1e-9
        assert np.all(np.asarray(found.residual) < 1e-12)
        np.testing.assert_array_equal(found.rank, 6)


@BOTH
def test_exact_lengths_give_the_pose_without_a_guess(embodiment):
    check_exact(embodiment, 30, 0)


@pytest.mark.soak
@BOTH
def test_exact_lengths_give_the_pose_of_a_thousand_platforms(embodiment):
    check_exact(embodiment, 1000, 1)


@BOTH
def test_any_triangle_any_joints_in_its_plane_and_any_frames(embodiment):
    rng = rng_of(2, embodiment)
    for _ in range(15):
        while True:
            k = rng.uniform(-0.5, 1, (6, 3))
            k[:, 2] = 1 - k[:, 0] - k[:, 1]
            base, triangle = some_base(rng, embodiment), rng.uniform(-0.6, 0.6, (3, 3)) * [1, 1, 0]
            sides = np.linalg.svd(triangle - triangle.mean(axis=0), compute_uv=False)
            if stage_condition(base, k) < 1e3 and sides[1] > 0.3 * sides[0]:
                break
        level = np.concatenate([k @ triangle, triangle])
        poses = some_poses(rng, 4)
        lengths = lengths_of(pk.Stewart(base=base, platform=level), poses)
        ground, tool = some_poses(rng, 1, tilt=60)[0], some_poses(rng, 1, tilt=180)[0]
        platform = pk.Stewart(base=place(ground, base), platform=place(tool, level))
        found = pk.nine_length_pose(platform, lengths)
        np.testing.assert_array_equal(found.status, Status.OK)
        rotation = ground.rotation @ np.asarray(poses.rotation) @ np.asarray(tool.rotation).T
        shift = place(ground, poses.translation) - rotation @ np.asarray(tool.translation)
        assert error_of(found.pose, pk.SE3(shift, rotation)) <= 1e-9


@BOTH
@pytest.mark.parametrize("unit", [1e-6, 1e3, 1e6])
def test_the_unit_of_length_does_not_matter(embodiment, unit):
    rng = rng_of(3, embodiment)
    small = some_platform(rng, embodiment)
    poses = some_poses(rng, 8)
    noisy = lengths_of(small, poses) + 1e-4 * rng.normal(size=(8, 9))
    noisy[7, 0] *= 1.1
    large = pk.Stewart(base=unit * small.base, platform=unit * small.platform)
    found, again = pk.nine_length_pose(small, noisy), pk.nine_length_pose(large, unit * noisy)
    np.testing.assert_array_equal(found.status, again.status)
    np.testing.assert_allclose(again.pose.rotation, found.pose.rotation, rtol=0, atol=1e-11)
    np.testing.assert_allclose(again.pose.translation / unit, found.pose.translation, rtol=0, atol=1e-11)
    for name in ("condition", "sigma_min"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), rtol=1e-9)
    np.testing.assert_allclose(again.residual / unit, found.residual, rtol=1e-9)
    np.testing.assert_allclose(again.z_squared / unit**2, found.z_squared, rtol=1e-9)


stage_at = jax.jit(stage_of)
by_macaulay = jax.jit(jax.vmap(partial(closed_form, method="macaulay"), in_axes=(None, 0)))


def test_the_three_ways_through_the_quadrics_agree():
    rng = rng_of(4)
    for _ in range(20):
        platform = some_platform(rng, GENERAL, most=1e3)
        poses = some_poses(rng, 4)
        lengths = lengths_of(platform, poses)
        products = pk.nine_length_pose(platform, lengths).closed_form
        assert error_of(products, poses) <= 1e-7
        macaulay = by_macaulay(stage_at(platform), jnp.asarray(lengths))[0]
        quintic = take(pk.nine_length_candidates(platform, lengths).poses, (slice(None), 0))
        assert error_of(macaulay, products) <= 1e-6
        assert error_of(quintic, products) <= 1e-6


@pytest.mark.soak
@pytest.mark.parametrize("method", ["macaulay", "quintic"])
def test_the_estimate_does_not_hang_on_the_method(method):
    rng = rng_of(5)
    for _ in range(30):
        platform = some_platform(rng, GENERAL, most=1e3)
        lengths = lengths_of(platform, some_poses(rng, 4)) + 1e-4 * rng.normal(size=(4, 9))
        found, other = (pk.nine_length_pose(platform, lengths, method=m) for m in (None, method))
        assert_same(other.status, found.status)
        assert_same(other.pose, found.pose, 1e-9)


@pytest.mark.soak
@BOTH
def test_float32_is_as_good_as_float32_can_be(embodiment):
    rng = rng_of(6, embodiment)
    for _ in range(10):
        base, level, _, _ = some_layout(rng, embodiment, most=100)
        platform = pk.Stewart(base=base.astype(np.float32), platform=level.astype(np.float32))
        poses = some_poses(rng, 8)
        found = pk.nine_length_pose(platform, lengths_of(platform, poses).astype(np.float32))
        assert found.pose.rotation.dtype == np.float32
        np.testing.assert_array_equal(found.status, Status.OK)
        assert error_of(found.pose, poses) <= 2e-5


# ---------------------------------------------------------------- the equations as they are published


def corners_of_22_to_24(base, k, p, lengths):
    """M q = L typed out, then the heights of eq. (21). -> T (3, 3)"""
    (a, s), (l, m) = (base[:6], base[6:]), (lengths[:6], lengths[6:])
    matrix, right = np.zeros((6, 6)), np.zeros(6)
    for i in range(6):
        k1, k2, k3 = on_edges(k)[i]
        matrix[i] = 2 * np.array(
            [
                k1 * (s[0, 0] - a[i, 0]),
                k1 * (s[0, 1] - a[i, 1]),
                k2 * (s[1, 0] - a[i, 0]),
                k2 * (s[1, 1] - a[i, 1]),
                k3 * (s[2, 0] - a[i, 0]),
                k3 * (s[2, 1] - a[i, 1]),
            ]
        )
        right[i] = (
            (l[i] ** 2 - a[i, 0] ** 2 - a[i, 1] ** 2)
            - k1 * (m[0] ** 2 - s[0, 0] ** 2 - s[0, 1] ** 2)
            - k2 * (m[1] ** 2 - s[1, 0] ** 2 - s[1, 1] ** 2)
            - k3 * (m[2] ** 2 - s[2, 0] ** 2 - s[2, 1] ** 2)
            + p**2 * (k1 * k2 + k2 * k3 + k3 * k1)
        )
    q = np.linalg.solve(matrix, right).reshape(3, 2)
    return np.column_stack([q, np.sqrt(m**2 - np.sum((q - s[:, :2]) ** 2, axis=1))])


def fitted(triangle, corners):
    """Kabsch by SciPy."""
    middle, centre = triangle.mean(axis=0), corners.mean(axis=0)
    rotation = Rotation.align_vectors(corners - centre, triangle - middle)[0].as_matrix()
    return pk.SE3(centre - rotation @ middle, rotation)


def test_over_a_planar_base_the_closed_form_is_eqs_22_to_24():
    rng = rng_of(7)
    for _ in range(15):
        base, level, k, p = some_layout(rng, PLANAR, most=100)
        platform, pose = pk.Stewart(base=base, platform=level), some_poses(rng, 1, tilt=20)
        lengths = lengths_of(platform, pose)[0] + 1e-4 * rng.normal(size=9)
        corners = corners_of_22_to_24(base, k, p, lengths)
        found = pk.nine_length_pose(platform, lengths)
        assert error_of(found.closed_form, fitted(level[6:], corners)) <= 1e-9
        np.testing.assert_allclose(found.z_squared, corners[:, 2].min() ** 2, rtol=1e-9)


def test_over_a_general_base_the_linear_stage_is_eq_8():
    rng = rng_of(8)
    for _ in range(15):
        base, level, k, p = some_layout(rng, GENERAL)
        stage = stage_at(pk.Stewart(base=base, platform=level))
        lengths = rng.uniform(0.5, 2, 9)  # of no pose
        a, s, sensors = base[:6], base[6:], lengths[6:]
        start, _ = quadrics_of(stage, lengths)
        assert np.linalg.matrix_rank(stage.free, tol=1e-6) == 3
        corners = s + np.asarray(start) + (np.asarray(stage.free) @ rng.normal(size=3)).reshape(3, 3)
        for i, (u, v) in enumerate(EDGES):
            left = 2 * k * (s[u] - a[i]) @ corners[u] + 2 * (1 - k) * (s[v] - a[i]) @ corners[v]
            right = lengths[i] ** 2 - a[i] @ a[i] + k * (1 - k) * p**2
            right -= k * (sensors[u] ** 2 - s[u] @ s[u]) + (1 - k) * (sensors[v] ** 2 - s[v] @ s[v])
            np.testing.assert_allclose(left, right, rtol=0, atol=1e-9 * stage_condition(base, on_edges(k)))


# ---------------------------------------------------------------- rank


def rank_by_pairs(base, inside):
    """6 - (9 - rank E), rows of E the Kronecker products of homogenised base and platform joints."""
    one = np.ones((9, 1))
    flat = (base - base.mean(axis=0)) @ np.linalg.svd(base - base.mean(axis=0))[2].T
    keep = np.abs(flat).max(axis=0) > 1e-9
    rows = [
        np.kron(a, b) for a, b in zip(np.hstack([flat[:, keep], one]), np.hstack([inside, one]), strict=True)
    ]
    return 6 - (9 - np.linalg.matrix_rank(np.array(rows), tol=1e-9))


def barycentric(inside):
    homogeneous = np.column_stack([inside, np.ones(9)])
    return np.linalg.solve(homogeneous[6:].T, homogeneous[:6].T).T


def rank_by_stage(base, inside):
    return np.linalg.matrix_rank(np.asarray(matrix_of(base, barycentric(inside))).reshape(6, 9), tol=1e-9)


def around(count, radius, start=0.0):
    at = np.deg2rad(start) + 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(at), np.sin(at)], axis=1)


def flat(points):
    return np.column_stack([points, np.zeros(len(points))])


def hexagons(rng):
    sensors, corners = rng.uniform(-1, 1, (2, 3, 2))
    return flat(np.concatenate([around(6, 1.0), sensors])), np.concatenate([around(6, 0.5, 20), corners])


def affine_copy(rng):
    inside = rng.uniform(-1, 1, (9, 2))
    return flat(inside @ rng.uniform(-1, 1, (2, 2)) + rng.uniform(-1, 1, 2)), inside


def paired(rng, on_the_line=3):
    """6-3: legs meet in pairs at the T_j; S_j on the lines through the feet of the pairs."""
    feet, corners = rng.uniform(-1, 1, (3, 2, 2)), equilateral(1.0)[:, :2]
    share = rng.uniform(-0.5, 1.5, (3, 1))
    sensors = share * feet[:, 0] + (1 - share) * feet[:, 1]
    sensors[on_the_line:] = rng.uniform(-1, 1, (3 - on_the_line, 2))
    return flat(np.concatenate([feet.reshape(6, 2), sensors])), np.concatenate(
        [np.repeat(corners, 2, axis=0), corners]
    )


def at_random(rng, height=0.0):
    return rng.uniform(-1, 1, (9, 3)) * [1, 1, height], rng.uniform(-1, 1, (9, 2))


RANKS = [
    (hexagons, 5),
    (affine_copy, 3),
    (paired, 3),
    (partial(paired, on_the_line=2), 4),
    (partial(paired, on_the_line=1), 5),
    (at_random, 6),
    (partial(at_random, height=0.5), 6),
]


@pytest.mark.parametrize(("layout", "rank"), RANKS, ids=lambda x: "" if isinstance(x, partial) else None)
def test_the_rank_is_that_of_the_pairs_of_joints(layout, rank):
    for seed in range(10):
        base, inside = layout(rng_of(9, seed))
        assert rank_by_stage(base, inside) == rank_by_pairs(base, inside) == rank


def copy_of_a_circle(rng):
    inside = np.concatenate([around(1, 1.0, at) for at in rng.uniform(0, 360, 9)])
    return flat(inside @ rng.uniform(-1, 1, (2, 2))), inside


@pytest.mark.parametrize("layout", [hexagons, copy_of_a_circle])
def test_six_legs_that_are_singular_themselves_are_no_stewart(layout):
    base, inside = layout(rng_of(10))
    assert "architecturally singular" in said_by(pk.Stewart, base=base, platform=flat(inside))


@pytest.mark.parametrize(
    ("layout", "rank"), [(affine_copy, 3), *RANKS[2:5]], ids=lambda x: "" if callable(x) else None
)
def test_a_singular_linear_stage_is_refused_with_its_rank(layout, rank):
    for seed in range(3):
        base, inside = layout(rng_of(11, seed))
        platform = pk.Stewart(base=base, platform=flat(inside))
        assert f"rank {rank} of 6" in said_by(pk.nine_length_pose, platform, np.ones(9))
        assert f"rank {rank} of 6" in said_by(pk.nine_length_candidates, platform, np.ones(9))


@BOTH
def test_rank_and_condition_are_those_of_the_published_matrix(embodiment):
    rng = rng_of(12, embodiment)
    base, level, k, _ = some_layout(rng, embodiment)
    found = pk.nine_length_pose(pk.Stewart(base=base, platform=level), np.ones(9))
    assert found.rank == rank_by_pairs(base, level[:, :2]) == 6
    np.testing.assert_allclose(found.condition, stage_condition(base, on_edges(k)), rtol=1e-9)


# ---------------------------------------------------------------- verdicts

BAD = [NAN, INF, -INF, 0.0, -1.0]


@pytest.fixture(scope="module", params=[GENERAL, PLANAR], ids=["general", "planar"])
def rows(request):
    """A platform, poses, and noisy lengths of eight rows."""
    rng = rng_of(13, request.param)
    platform, poses = some_platform(rng, request.param, most=30), some_poses(rng, 8, tilt=25)
    return platform, poses, lengths_of(platform, poses) + 5e-4 * rng.normal(size=(8, 9))


def test_a_bad_row_is_bad_input_and_hurts_no_other(rows):
    platform, _, lengths = rows
    clean, spoilt = pk.nine_length_pose(platform, lengths), lengths.copy()
    for row, bad in enumerate(BAD):
        spoilt[row, (2 * row) % 9] = bad
    found, hit = pk.nine_length_pose(platform, spoilt), np.arange(len(BAD))
    np.testing.assert_array_equal(found.status, [Status.BAD_INPUT] * 5 + [Status.OK] * 3)
    np.testing.assert_array_equal(clean.status, Status.OK)
    for name in ("pose", "candidate", "closed_form", "covariance", "residual", "sigma_min", "z_squared"):
        assert np.all([np.isnan(leaf).all() for leaf in jax.tree.leaves(take(getattr(found, name), hit))])
    np.testing.assert_array_equal(np.asarray(found.steps)[:5], 0)
    assert_same(take(found, slice(5, 8)), take(clean, slice(5, 8)))


def test_a_wrong_length_is_inconsistent_and_its_candidate_is_the_least_squares_pose(rows):
    platform, _, lengths = rows
    wrong = lengths.copy()
    wrong[np.arange(8), np.arange(2, 10) % 9] *= 1.1
    found = pk.nine_length_pose(platform, wrong)
    rms = np.sqrt(np.mean((lengths_of(platform, found.candidate) - wrong) ** 2, axis=1))
    np.testing.assert_allclose(found.residual, rms, rtol=1e-9)
    is_lost = rms > 1e-2 * wrong.mean(axis=1)
    assert is_lost.sum() > 4
    np.testing.assert_array_equal(found.status, np.where(is_lost, Status.INCONSISTENT, Status.OK))
    np.testing.assert_array_equal(np.isnan(found.pose.rotation).all(axis=(1, 2)), is_lost)
    for row in range(8):
        best = by_scipy(platform, take(found.candidate, row), wrong[row], np.ones(9))
        assert_same(best, take(found.candidate, row), 1e-6)


def test_no_wrong_length_passes_for_a_right_one(rows):
    platform, _, lengths = rows
    for factor in (0.5, 1.5, 3.0):
        wrong = lengths[0] * (1 + (factor - 1) * np.eye(9))
        found = pk.nine_length_pose(platform, wrong)
        rms = np.sqrt(np.mean((lengths_of(platform, found.candidate) - wrong) ** 2, axis=1))
        is_ok = np.asarray(found.status) == Status.OK
        assert np.all(rms[is_ok] <= 1e-2 * wrong.mean(axis=1)[is_ok]) and is_ok.sum() <= 1
        np.testing.assert_array_equal(np.isnan(found.pose.translation[:, 0]), ~is_ok)


@pytest.mark.soak
def test_many_lost_rows_are_each_what_they_are_alone(rows):
    platform, _, lengths = rows
    wrong = lengths[np.arange(300) % 8] * np.where(rng_of(42).uniform(size=(300, 9)) < 0.2, 1.1, 1.0)
    many = pk.nine_length_pose(platform, wrong)
    assert np.sum(np.asarray(many.status) != Status.OK) > 100
    for row in range(0, 300, 7):
        one = pk.nine_length_pose(platform, wrong[row])
        assert one.status == many.status[row]
        if one.status != Status.STALLED:
            np.testing.assert_allclose(one.residual, many.residual[row], rtol=1e-6)


def test_one_row_is_a_row_of_many_and_none_is_none(rows):
    platform, _, lengths = rows
    many, loop = (
        pk.nine_length_pose(platform, lengths),
        [pk.nine_length_pose(platform, row) for row in lengths],
    )
    for row, one in enumerate(loop):
        assert one.status.shape == () and one.covariance.shape == (6, 6)
        assert_same(one, take(many, row))
    none = pk.nine_length_pose(platform, np.zeros((0, 9)))
    assert none.pose.rotation.shape == (0, 3, 3) and none.status.shape == (0,)
    assert_same(pk.nine_length_pose(platform, lengths[0].tolist()), loop[0])


def test_whole_numbers_are_lengths(rows):
    platform, _, lengths = rows
    whole = np.round(1e4 * lengths).astype(int)
    large = pk.Stewart(base=1e4 * platform.base, platform=1e4 * platform.platform)
    assert_same(pk.nine_length_pose(large, whole), pk.nine_length_pose(large, whole.astype(float)))
    np.testing.assert_array_equal(pk.nine_length_pose(large, whole).status, Status.OK)


# ---------------------------------------------------------------- derivatives, and traced rows


def flattened(pose):
    return jnp.concatenate([pose.translation, pose.rotation.ravel()])


@jax.jit
def traced(base, platform, lengths, weights):
    """Answers, and derivatives of their 12 numbers in lengths, weights and base; rows first."""

    def one(lengths, weights, base):
        found = pk.nine_length_pose(pk.Stewart(base=base, platform=platform), lengths, weights)
        return flattened(found.pose), found

    return jax.vmap(jax.jacrev(one, argnums=(0, 1, 2), has_aux=True), in_axes=(0, 0, None))(
        lengths, weights, base
    )


@pytest.fixture(scope="module")
def differentiated(rows):
    """The eight rows, of which row 5 holds a NaN and row 6 a wrong length."""
    platform, _, lengths = rows
    lengths = lengths.copy()
    lengths[5, 3] = NAN
    lengths[6, 0] *= 1.1
    weights = rng_of(14).uniform(0.5, 2, (8, 9))
    return lengths, weights, *traced(platform.base, platform.platform, lengths, weights)


LOST = [5, 6]


@pytest.mark.soak
def test_traced_rows_are_the_known_rows(rows, differentiated):
    lengths, weights, _, found = differentiated
    known = pk.nine_length_pose(rows[0], lengths, weights)
    np.testing.assert_array_equal(found.status, known.status)
    assert list(np.asarray(known.status)[LOST]) == [Status.BAD_INPUT, Status.INCONSISTENT]
    assert_same(found.pose, known.pose, 1e-12)
    assert_same(found.closed_form, known.closed_form, 1e-11)
    for name in ("covariance", "residual", "sigma_min", "condition", "z_squared"):
        np.testing.assert_allclose(getattr(found, name), getattr(known, name), rtol=1e-7, atol=1e-9)
    assert_same(found.candidate, known.candidate, 1e-7)


def test_lost_rows_have_no_derivatives(differentiated):
    for part in differentiated[2]:
        np.testing.assert_array_equal(np.asarray(part)[LOST], 0)
        assert np.all(np.isfinite(part))


def difference_along(solve, h=2e-5):
    ends = [pk.nine_length_pose(*solve(sign * h)) for sign in (1, -1)]
    assert all(end.status == Status.OK for end in ends)
    return (flattened(ends[0].pose) - flattened(ends[1].pose)) / (2 * h)


def test_derivatives_at_a_residual_are_those_of_differences(rows, differentiated):
    platform, rng = rows[0], rng_of(15)
    lengths, weights, (by_length, by_weight, by_base), found = differentiated
    assert found.residual[0] > 1e-4 and np.abs(by_weight[0]).max() > 1e-5
    is_planar = bool(np.all(np.asarray(platform.base)[:, 2] == 0))
    for _ in range(3):
        toward, aside = rng.normal(size=(2, 9))
        shift = rng.normal(size=(9, 3)) * [1, 1, 0 if is_planar else 1]

        def moved(h, shift=shift):
            return pk.Stewart(base=np.asarray(platform.base) + h * shift, platform=platform.platform)

        for derivative, solve in (
            (by_length[0] @ toward, lambda h, d=toward: (platform, lengths[0] + h * d, weights[0])),
            (by_weight[0] @ aside, lambda h, d=aside: (platform, lengths[0], weights[0] + h * d)),
            (
                jnp.sum(by_base[0] * shift, axis=(1, 2)),
                lambda h, move=moved: (move(h), lengths[0], weights[0]),
            ),
        ):
            np.testing.assert_allclose(difference_along(solve), derivative, rtol=0, atol=1e-7)


@pytest.mark.soak
def test_a_known_platform_may_be_closed_over_by_jit():
    platform = some_platform(rng_of(43), PLANAR)
    found = jax.eval_shape(lambda lengths: pk.nine_length_pose(platform, lengths), np.ones((8, 9)))
    assert found.pose.rotation.shape == (8, 3, 3) and found.status.shape == (8,)


# ---------------------------------------------------------------- noise


def by_scipy(platform, pose, lengths, weights):
    """Least squares by another hand, from `pose`."""
    start = Rotation.from_matrix(np.asarray(pose.rotation))

    def moved(x):
        return pk.SE3(np.asarray(pose.translation) + x[:3], (Rotation.from_rotvec(x[3:]) * start).as_matrix())

    def errors(x):
        return np.sqrt(weights) * (lengths_of(platform, moved(x)) - lengths)

    return moved(least_squares(errors, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac").x)


def test_the_estimate_is_that_of_scipy(rows):
    platform, poses, lengths = rows
    weights = rng_of(16).uniform(0.1, 10, 9)
    found = pk.nine_length_pose(platform, lengths, weights)
    for row in range(4):
        assert_same(by_scipy(platform, take(poses, row), lengths[row], weights), take(found.pose, row), 1e-7)
    rms = np.sqrt((lengths_of(platform, found.pose) - lengths) ** 2 @ weights / weights.sum())
    np.testing.assert_allclose(found.residual, rms, rtol=1e-9)


@BOTH
def test_the_estimate_is_as_good_as_it_says_at_every_noise(embodiment):
    check_noise(embodiment, 12, 17)


@pytest.mark.soak
@BOTH
def test_the_estimate_is_as_good_as_it_says_on_many_platforms(embodiment):
    check_noise(embodiment, 300, 18)


def check_noise(embodiment, count, seed):
    rng = rng_of(seed, embodiment)
    for _ in range(count):
        platform, poses = some_platform(rng, embodiment, most=1e3), some_poses(rng, 16)
        for sigma in (1e-6, 1e-5, 1e-4, 1e-3):
            noisy = lengths_of(platform, poses) + sigma * rng.normal(size=(16, 9))
            assert_honest(pk.nine_length_pose(platform, noisy, np.full(9, sigma**-2)), poses)


def assert_honest(found, poses):
    """Every row is OK and within eight standard deviations."""
    np.testing.assert_array_equal(found.status, Status.OK)
    off = tangent(found.pose, poses)
    squared = np.einsum("ni,ni->n", off, np.linalg.solve(found.covariance, off[..., None])[..., 0])
    assert np.sqrt(squared.max()) < 8


@pytest.mark.parametrize("height", [1e-3, 1e-5])
def test_a_nearly_planar_base_makes_no_gross_errors(height):
    rng = rng_of(19)
    for _ in range(10):
        platform, poses = some_platform(rng, GENERAL, height=height, most=1e3), some_poses(rng, 16)
        noisy = lengths_of(platform, poses) + 1e-5 * rng.normal(size=(16, 9))
        assert_honest(pk.nine_length_pose(platform, noisy, np.full(9, 1e10), method="products"), poses)


@pytest.mark.parametrize("spread", [1.0, 30.0], ids=["equal", "unequal"])
def test_the_covariance_is_that_of_many_measurements(rows, spread):
    platform, poses, _ = rows
    sigma = 1e-5 * spread ** np.linspace(-1, 1, 9)
    rng = rng_of(20)
    lengths = lengths_of(platform, poses)[0] + sigma * rng.normal(size=(4000, 9))
    found = pk.nine_length_pose(platform, lengths, 1 / sigma**2)
    off = tangent(take(poses, 0), found.pose)
    root = np.linalg.cholesky(np.linalg.inv(found.covariance[0]))
    np.testing.assert_allclose(np.cov((off @ root).T), np.eye(6), rtol=0, atol=0.1)


def test_only_ratios_of_weights_move_the_pose(rows):
    platform, _, lengths = rows
    weights = rng_of(21).uniform(0.1, 10, 9)
    found, other = (pk.nine_length_pose(platform, lengths, w) for w in (weights, 7 * weights))
    assert_same(other.pose, found.pose, 1e-12)
    np.testing.assert_allclose(7 * np.asarray(other.covariance), found.covariance, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(other.residual, found.residual, rtol=1e-9)
    np.testing.assert_allclose(other.sigma_min, found.sigma_min, rtol=1e-9)


def test_weights_may_differ_from_row_to_row(rows):
    platform, _, lengths = rows
    weights = rng_of(22).uniform(0.1, 10, (8, 9))
    found = pk.nine_length_pose(platform, lengths, weights)
    of_one = pk.nine_length_pose(platform, lengths[0], weights)
    for row in range(8):
        assert_same(pk.nine_length_pose(platform, lengths[row], weights[row]), take(found, row))
        assert_same(pk.nine_length_pose(platform, lengths[0], weights[row]), take(of_one, row))


# ---------------------------------------------------------------- near and through the base's plane


def test_a_platform_that_cuts_the_plane_of_its_base_comes_back():
    rng = rng_of(23)
    for _ in range(10):
        platform = some_platform(rng, PLANAR, most=100)
        poses = some_poses(rng, 8, tilt=80, heights=(0.1, 0.4))
        heights = place(poses, np.asarray(platform.platform)[6:])[..., 2]
        found = pk.nine_length_pose(platform, lengths_of(platform, poses))
        clear = np.abs(heights).min(axis=1) > 1e-3
        assert np.any(heights < 0)
        assert error_of(take(found.pose, clear), take(poses, clear)) <= 1e-9
        assert error_of(take(found.closed_form, clear), take(poses, clear)) <= 1e-6
        np.testing.assert_allclose(found.z_squared, np.min(heights**2, axis=1), rtol=0, atol=1e-10)


def test_a_negative_square_of_a_height_is_told():
    rng = rng_of(24)
    platform = some_platform(rng, PLANAR, most=30)
    lower = np.asarray(platform.platform)[6:, 1].min()
    rotation = Rotation.from_rotvec([0.4, 0, 0]).as_matrix()
    pose = pk.SE3([0.1, 0.0, 1e-3 - lower * np.sin(0.4)], rotation)  # the lowest corners 1 mm above the base
    noisy = lengths_of(platform, pose) + 1e-3 * rng.normal(size=(16, 9))
    found = pk.nine_length_pose(platform, noisy, np.full(9, 1e6))
    assert np.any(np.asarray(found.z_squared) < 0)
    is_ok = np.asarray(found.status) == Status.OK
    assert np.mean(is_ok) > 0.9
    assert np.all(np.isfinite(found.pose.rotation)[is_ok])


def test_over_a_planar_base_every_answer_is_on_the_side_of_home():
    rng = rng_of(25)
    statuses = set()
    for _ in range(10):
        platform, poses = some_platform(rng, PLANAR), some_poses(rng, 8)
        noisy = lengths_of(platform, poses) + 1e-2 * rng.normal(size=(8, 9))
        found = pk.nine_length_pose(platform, noisy)
        centres = place(found.candidate, np.asarray(platform.platform)[6:]).mean(axis=1)
        assert np.all(centres[:, 2] > 0)
        statuses |= set(np.asarray(found.status).tolist())
    assert Status.OK in statuses


# ---------------------------------------------------------------- candidates


def test_the_candidates_over_a_planar_base_are_the_pose_and_its_mirror_image():
    rng = rng_of(26)
    platform, poses = some_platform(rng, PLANAR, most=100), some_poses(rng, 4)
    found = pk.nine_length_candidates(platform, lengths_of(platform, poses))
    assert found.residual.shape == (4, 2) and np.all(np.asarray(found.residual) < 1e-10)
    is_above = np.asarray(found.poses.translation)[..., 2] > 0
    assert np.all(is_above.sum(axis=1) == 1)
    corners = np.asarray(platform.platform)[6:]
    expected = place(poses, corners)
    for up, side in ((True, [1, 1, 1]), (False, [1, 1, -1])):
        chosen = take(found.poses, is_above == up)
        np.testing.assert_allclose(place(chosen, corners), expected * side, rtol=0, atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(chosen.rotation), 1, rtol=1e-12)


def test_of_the_five_roots_exactly_one_fits():
    rng = rng_of(27)
    for _ in range(10):
        platform, poses = some_platform(rng, GENERAL, most=30), some_poses(rng, 4)
        lengths = lengths_of(platform, poses)
        found = pk.nine_length_candidates(platform, lengths)
        off = np.asarray(found.residual)
        assert off.shape == (4, 6)
        assert np.all(np.diff(off, axis=1) >= 0)
        assert np.all(off[:, 0] < 1e-7) and np.all(off[:, 1] > 1e-4)
        assert error_of(take(found.poses, (slice(None), 0)), poses) <= 1e-6
        each = np.stack([lengths_of(platform, take(found.poses, (slice(None), k))) for k in range(6)], axis=1)
        np.testing.assert_allclose(np.sqrt(np.mean((each - lengths[:, None]) ** 2, axis=2)), off, atol=1e-12)


def test_bad_lengths_have_no_candidates():
    platform = some_platform(rng_of(28), PLANAR)
    found = pk.nine_length_candidates(platform, [[1.0] * 8 + [NAN]] * 3 + [[1.0] * 8 + [-1.0]])
    assert np.all(np.isnan(found.residual)) and np.all(np.isnan(found.poses.translation))


# ---------------------------------------------------------------- what is refused


@pytest.fixture(scope="module")
def both():
    return some_platform(rng_of(29), GENERAL), some_platform(rng_of(30), PLANAR)


@pytest.mark.parametrize("function", [pk.nine_length_pose, pk.nine_length_candidates])
def test_platforms_without_nine_rows_are_refused(function):
    for rows in (6, 8, 10):

        def call(base, platform, rows=rows):
            return function(pk.Stewart(base=base, platform=platform), np.ones(rows))

        said = said_by(jax.eval_shape, call, np.ones((rows, 3)), np.ones((rows, 3)))
        assert "nine rows" in said and said.endswith(f"got {rows}")
    assert "Stewart" in said_by(function, three_legs(), np.ones(9))


@pytest.mark.parametrize("function", [pk.nine_length_pose, pk.nine_length_candidates])
def test_joints_off_the_plane_of_the_sensors_are_refused_with_row_and_distance(function, both):
    platform = np.array(both[0].platform)
    platform[4, 2] += 0.0125
    said = said_by(function, pk.Stewart(base=both[0].base, platform=platform), np.ones(9))
    assert "Stewart.platform[4]" in said and "0.0125 off" in said


def test_sensors_on_one_line_of_the_platform_are_refused(both):
    platform = np.array(both[0].platform)
    platform[8] = 0.3 * platform[6] + 0.7 * platform[7]
    said = said_by(pk.nine_length_pose, pk.Stewart(base=both[0].base, platform=platform), np.ones(9))
    assert "must not lie on one line" in said


def test_methods_for_another_base_are_refused(both):
    general, planar = both
    for method in ("products", "macaulay", "quintic"):
        assert repr(method) in said_by(pk.nine_length_pose, planar, np.ones(9), method=method)
    for function in (pk.nine_length_pose, pk.nine_length_candidates):
        assert "'linear' is for planar" in said_by(function, general, np.ones(9), method="linear")
    assert "'products'" in said_by(pk.nine_length_candidates, general, np.ones(9), method="products")
    assert "'sextic'" in said_by(pk.nine_length_pose, general, np.ones(9), method="sextic")


@pytest.mark.parametrize("shape", [(), (6,), (8,), (4, 8), (2, 2, 9)])
def test_wrong_shapes_are_refused_with_the_field(shape, both):
    said = said_by(pk.nine_length_pose, both[1], np.ones(shape))
    assert said.startswith("lengths must have shape") and str(shape) in said
    said = said_by(pk.nine_length_pose, both[1], np.ones(9), np.ones(shape))
    assert said.startswith("weights must have shape")


@pytest.mark.parametrize("bad", [0.0, -1.0, NAN, INF])
def test_weights_that_are_no_weights_are_refused(bad, both):
    weights = np.ones(9)
    weights[4] = bad
    assert said_by(pk.nine_length_pose, both[1], np.ones(9), weights).startswith("weights must be")


@pytest.mark.parametrize("bad", ["1, 2", [True] * 9, [1j] * 9, None])
def test_lengths_that_are_no_numbers_are_refused(bad, both):
    assert said_by(pk.nine_length_pose, both[1], bad).startswith("lengths must be")
