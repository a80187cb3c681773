"""Kinds of singularities and distances to them: exact poses, a NumPy oracle, what must not matter."""

import jax
import jax.numpy as jnp
import numpy as np
import outsiders
import pytest
from refusals import said_by
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.papers.planar_screws import geometric_screws, singular_cases
from pk_jax.status import Status

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

REGULAR, TYPE_I, TYPE_II, TYPE_III, FLAT = list(pk.SingularityKind)[1:]
UNKNOWN = pk.SingularityKind.UNKNOWN
NAN, INF = np.nan, np.inf
CASES = singular_cases()
named = lambda cases: [f"{case.figure} {case.title}" for case in cases]
CASE = {case.title: case for case in CASES}
SEMI = pk.catalogued("semi-regular-stewart")
sigmas = lambda found: np.stack([np.asarray(value) for value in found[1:4]])


def classified(case, **named):
    return pk.classify_singularity(case.mechanism, case.pose, case.joints, **named)


# ---------------------------------------------------------------- exact singular poses


@pytest.mark.parametrize("case", CASES, ids=named(CASES))
def test_singular_poses_of_the_screw_analysis(case):
    """Figs. 2, 3, 6, 7, 9, 10, 12, 13: one configuration, and the same in a batch."""
    one = classified(case)
    many = pk.classify_singularity(case.mechanism, np.tile(case.pose, (3, 1)), np.tile(case.joints, (3, 1)))
    for found in (one, jax.tree.map(lambda leaf: leaf[1] if leaf.ndim else leaf, many)):
        assert found.kind == case.kind and found.status == Status.OK
        inverse, direct, configuration = map(float, found[1:4])
        assert (inverse <= 1e-6) == (case.kind in (TYPE_I, TYPE_III, FLAT))
        assert (direct <= 1e-6) == (case.kind in (TYPE_II, TYPE_III))
        assert (configuration <= 1e-6) == (case.kind == FLAT)
        for sigma in (inverse, direct, configuration):
            assert sigma <= 1e-13 or sigma > 1e-2
    np.testing.assert_allclose(sigmas(many), sigmas(one)[:, None] + np.zeros(3), rtol=0, atol=1e-12)


def test_screws_of_rank_two_do_not_let_a_platform_go():
    """6-link, both arms stretched: its four lines have rank 2, but locked motors hold C and D."""
    case = CASE["6-link, screws on two lines"]
    lines = np.asarray(geometric_screws(case.mechanism, case.pose, case.joints).lines)
    assert np.linalg.svd(lines, compute_uv=False)[2] < 1e-14
    a = np.asarray(pk.pose_jacobian(case.mechanism, case.pose, case.joints))
    assert np.linalg.svd(a, compute_uv=False)[2] > 0.1
    flat = CASE["6-link, all screws on one line"]
    lines = np.asarray(geometric_screws(flat.mechanism, flat.pose, flat.joints).lines)
    assert np.linalg.svd(lines, compute_uv=False)[1] < 1e-14


@pytest.mark.parametrize(
    ("title", "which"),
    [
        ("5-link, BP and CP in line", 1),
        ("3-RRR, screws meet in a point", 1),
        ("6-link, one arm stretched", 0),
    ],
)
def test_distance_is_linear_in_the_angle(title, which):
    """Turned away from the singularity by t: sigma(t) / t has a limit, from 1e-2 down to 1e-5."""
    case = CASE[title]
    mech = case.mechanism
    steps = np.array([1e-2, 1e-3, 1e-4, 1e-5])
    if title.startswith("6"):  # bend the arm at B and let C, D and the pose follow
        bent = case.joints + steps[:, None] * np.array([0, 1.0, 0, 0])
        tip = np.asarray(jax.vmap(mech.tips)(bent))[:, 0]
        moved = np.concatenate([tip, np.zeros((4, 1))], axis=1) - [-0.1, 0, 0]
        rest = [np.asarray(mech.inverse(pose, branch=[1.0, 1.0]))[2:] for pose in moved]
        pose, joints = moved, np.concatenate([bent[:, :2], rest], axis=1)
    else:  # a platform that moves by t changes the directions of its lines by O(t); the joints follow
        way = np.array([0.0, 0.1]) if len(case.pose) == 2 else np.array([0.03, -0.02, 0.5])
        pose = case.pose + steps[:, None] * way
        psi = np.asarray(geometric_screws(mech, case.pose, case.joints).arms)
        joints = np.stack([np.asarray(mech.inverse(x, branch=np.sign(psi))) for x in pose])
    found = pk.classify_singularity(mech, pose, joints)
    assert np.all(np.asarray(found.kind) == REGULAR) and np.all(np.asarray(found.status) == Status.OK)
    rate = sigmas(found)[which] / steps
    assert 0.01 < rate[-1] < 10
    np.testing.assert_allclose(rate, rate[-1], rtol=0.2)
    np.testing.assert_allclose(rate[2], rate[3], rtol=2e-3)


# ---------------------------------------------------------------- the oracle


def oracle(mech, a, b, angles, turns, length):
    """kind by the null space of [A B], by a full SVD; columns that are lengths over `length`."""
    n = a.shape[1]
    m = np.concatenate([a, b], axis=1) * np.where(np.append(turns, angles), 1, length)
    m = m / np.linalg.norm(m, axis=1, keepdims=True)
    sigma = np.linalg.svd(m, compute_uv=False)[-1]
    null = np.linalg.svd(m)[2][len(m) :].T  # motions, regular: of as many columns as freedoms
    x, q = (np.linalg.svd(part, compute_uv=False)[: null.shape[1]] for part in (null[:n], null[n:]))
    return x[-1] if len(x) == null.shape[1] else 0, q[-1] if len(q) == null.shape[1] else 0, sigma


ROBOTS = {
    "5-link": (lambda: pk.catalogued("5-link"), [0, 0.2], [0.15, 0.15]),
    "3-RRR": (lambda: pk.catalogued("3-rrr"), [0, 0, 0], [0.1, 0.1, 0.6]),
    "4-RRR": (lambda: pk.catalogued("4-rrr"), [0, 0, 0], [0.1, 0.1, 0.6]),
    "3-RPR": (lambda: pk.catalogued("arte-3-rpr"), [1.2, 1, 0], [0.5, 0.5, 1]),
    "6-link": (lambda: pk.catalogued("6-link"), [0, 0.3, 0], [0.2, 0.2, 0.6]),
    "Stewart": (lambda: SEMI, [0, 0, 0.8, 0, 0, 0], [0.3, 0.3, 0.2, 0.3, 0.3, 0.3]),
    "Delta": (outsiders.delta, [0, 0, -0.7], [0.1, 0.1, 0.05]),
}


def random_rows(mech, middle, to_side, count):
    """Poses in reach, in working modes by chance."""
    rng = np.random.default_rng(1)
    pose = np.array(middle) + np.array(to_side) * rng.uniform(-1, 1, (2 * count, len(middle)))
    if isinstance(mech, pk.Stewart):
        pose = pk.SE3(pose[:, :3], Rotation.from_rotvec(pose[:, 3:]).as_matrix())
    if not hasattr(mech, "inverse"):  # the Delta: an arm by the half-angle formula
        joints = delta_joints(mech, pose)
    else:
        shape = mech.default_branch()
        branch = rng.choice([-1.0, 1.0], (2 * count, 0 if shape is None else len(shape)))
        joints = np.asarray(jax.jit(jax.vmap(mech.inverse))(pose, branch))
    real = np.flatnonzero(np.all(np.isfinite(joints), axis=1))[:count]
    assert len(real) == count
    return jax.tree.map(lambda leaf: np.asarray(leaf)[real], pose), joints[real]


def delta_joints(mech, pose):
    away = float(mech.base_radius - mech.platform_radius)
    turns = np.array([0, 2, -2]) * np.pi / 3
    along = pose[:, :1] * np.cos(turns) + pose[:, 1:2] * np.sin(turns) - away
    across = -pose[:, :1] * np.sin(turns) + pose[:, 1:2] * np.cos(turns)
    z = pose[:, 2:]
    held = along**2 + across**2 + z**2 + mech.arm**2 - mech.rod**2
    c = np.asarray(held / (2 * mech.arm))
    size = np.hypot(along, z)
    return np.arctan2(-z, along) - np.arccos(c / size)


ORACLES = [
    pytest.param(*robot, id=name, marks=[pytest.mark.soak] if name in ("Stewart", "3-RPR") else [])
    for name, robot in ROBOTS.items()
]


@pytest.mark.parametrize(("make", "middle", "to_side"), ORACLES)
def test_regular_poses_against_the_null_space(make, middle, to_side):
    mech = make()
    pose, joints = random_rows(mech, middle, to_side, 1000)
    found = jax.tree.map(np.asarray, pk.classify_singularity(mech, pose, joints))
    assert np.all(found.status == Status.OK)
    both = lambda x, q: (pk.pose_jacobian(mech, x, q), pk.joint_jacobian(mech, x, q))
    rows = zip(*map(np.asarray, jax.jit(jax.vmap(both))(pose, joints)), strict=True)
    angles = np.array(mech.joint_units or (1,) * joints.shape[1]) == 0
    n = 6 if isinstance(mech, pk.Stewart) else len(middle)
    turns = np.arange(n) >= 3 if n == 6 else np.arange(n) == (2 if mech.pose_units else n)
    expected = np.array([oracle(mech, a, b, angles, turns, float(mech.length())) for a, b in rows]).T
    np.testing.assert_allclose(sigmas(found), expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.kind, REGULAR)  # none so close by chance
    assert np.all((sigmas(found) <= 1 + 1e-15) & (sigmas(found) > 1e-6))


# ---------------------------------------------------------------- what must not matter


def recombined(inner, matrix):
    """The mechanism `inner` with the residual matrix @ F."""

    class Mixed(type(inner)):
        def residual(self, pose, joints):
            return jnp.asarray(matrix) @ super().residual(pose, joints)

        def linearize(self, pose, joints):
            return pk.Mechanism.linearize(self, pose, joints)

    tree = jax.tree.structure(jax.eval_shape(lambda fields: Mixed(**fields), dict(inner.__dict__)))
    return jax.tree.unflatten(tree, jax.tree.leaves(inner))


NEAR = ["3-RRR, screws meet in a point", "6-link, all screws on one line"]


@pytest.mark.parametrize("title", NEAR)
def test_equations_may_be_recombined(title):
    case = CASE[title]
    rows = len(np.asarray(case.mechanism.residual(case.pose, case.joints)))
    matrix = np.random.default_rng(2).uniform(-1, 1, (rows, rows)) + np.diag(np.arange(1.0, rows + 1))
    mixed = recombined(case.mechanism, matrix)
    np.testing.assert_allclose(
        pk.joint_jacobian(mixed, case.pose, case.joints),
        matrix @ pk.joint_jacobian(case.mechanism, case.pose, case.joints),
        rtol=0,
        atol=1e-14,
    )
    before, after = classified(case), pk.classify_singularity(mixed, case.pose, case.joints)
    assert after.kind == before.kind == case.kind
    np.testing.assert_allclose(after[1:3], before[1:3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("title", ["4-RRR, four parallel screws", "3-RRR, one arm stretched"])
def test_place_and_unit_do_not_matter(title):
    """The whole turned and moved, and the whole in millimetres."""
    case = CASE[title]
    mech = case.mechanism
    rows = np.stack([case.pose, case.pose + [0.01, 0.02, 0.1]])
    sign = np.where(np.asarray(geometric_screws(mech, case.pose, case.joints).arms) >= 0, 1.0, -1.0)
    second = mech.inverse(rows[1], branch=sign)
    assert np.all(np.isfinite(second)) or "stretched" in title
    if not np.all(np.isfinite(second)):
        rows[1] = case.pose - [0.01, 0.02, 0.1]
        second = mech.inverse(rows[1], branch=sign)
    joints = np.stack([case.joints, second])
    before = pk.classify_singularity(mech, rows, joints)
    turn, shift, scale = 0.7, np.array([3.0, -1.0]), 1000.0
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    leaves, tree = jax.tree.flatten(mech)
    base, platform, la, lb = leaves
    there = jax.tree.unflatten(tree, [base @ rotation.T + shift, platform, la, lb])
    pose = np.concatenate([rows[:, :2] @ rotation.T + shift, rows[:, 2:] + turn], axis=1)
    after = pk.classify_singularity(there, pose, joints + turn)
    np.testing.assert_array_equal(after.kind, before.kind)
    np.testing.assert_allclose(sigmas(after), sigmas(before), rtol=0, atol=1e-12)
    large = jax.tree.unflatten(tree, [scale * leaf for leaf in leaves])
    after = pk.classify_singularity(large, rows * [scale, scale, 1], joints)
    np.testing.assert_array_equal(after.kind, before.kind)
    np.testing.assert_allclose(sigmas(after), sigmas(before), rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.length, scale * before.length, rtol=1e-14)
    np.testing.assert_array_equal(before.kind, [case.kind, REGULAR])
    # lengths in another length: other sines, the same kinds
    other = pk.classify_singularity(mech, rows, joints, length=1.0)
    assert other.length == 1.0 and np.max(np.abs(sigmas(other) - sigmas(before))) > 1e-3
    np.testing.assert_array_equal(other.kind, before.kind)
    same = pk.classify_singularity(mech, rows, joints, length=before.length)
    np.testing.assert_array_equal(sigmas(same), sigmas(before))
    # a tolerance is a band
    sigma = float(min(sigmas(before)[:2, 1]))
    for tol, is_in in ((0.99 * sigma, False), (1.01 * sigma, True)):
        for found in (
            pk.classify_singularity(mech, rows, joints, tol=tol).kind[1],
            pk.classify_singularity(mech, rows[1], joints[1], tol=tol).kind,
        ):
            assert (found == REGULAR) != is_in


# ---------------------------------------------------------------- the configuration space itself


def flat_rrr():
    """Three equal arms, stretched side by side: a base and a platform that are congruent."""
    mech = pk.catalogued("3-rrr")
    mech = pk.PlanarRRR(base=mech.base, platform=mech.base, proximal=0.5, distal=0.3)
    return mech, np.array([0.8, 0.0, 0.0]), np.zeros(3)


def flat_five_bar():
    """Every link on the line of the base, a leg stretched and one folded."""
    mech = pk.FiveBar(half_base=0.5, proximal=0.5, distal=0.3)
    return mech, np.array([-0.3, 0.0]), np.array([np.pi, 0.0])


def flat_six_link():
    case = CASE["6-link, all screws on one line"]
    return case.mechanism, case.pose, case.joints


@pytest.mark.parametrize("make", [flat_rrr, flat_five_bar, flat_six_link])
def test_flat_mechanisms_are_where_paths_cross(make):
    mech, pose, joints = make()
    turned = np.array([joints, joints + 0.5])  # and an open loop beside it
    one = pk.classify_singularity(mech, pose, joints)
    many = pk.classify_singularity(mech, pose, turned)
    np.testing.assert_array_equal(many.kind, [FLAT, UNKNOWN])
    assert one.kind == FLAT and one.status == Status.OK and one.sigma_configuration < 1e-14
    np.testing.assert_allclose(sigmas(many)[:, 0], sigmas(one), rtol=0, atol=1e-12)
    m = np.concatenate([f(mech, pose, joints) for f in (pk.pose_jacobian, pk.joint_jacobian)], axis=1)
    assert np.linalg.matrix_rank(m) < len(m)


# ---------------------------------------------------------------- lost rows


def test_lost_rows_hurt_no_other():
    case = CASE["6-link, one arm stretched"]
    pose, joints = np.tile(case.pose, (6, 1)), np.tile(case.joints, (6, 1))
    pose[1, 0], pose[3, 2] = NAN, INF
    joints[2, 1], joints[4, 0] = NAN, joints[4, 0] + 1e-3
    expected = [Status.OK, *[Status.BAD_INPUT] * 3, Status.INCONSISTENT, Status.OK]
    found = jax.tree.map(np.asarray, pk.classify_singularity(case.mechanism, pose, joints))
    np.testing.assert_array_equal(found.status, expected)
    np.testing.assert_array_equal(found.kind, [TYPE_I, *[UNKNOWN] * 4, TYPE_I])
    assert np.all(np.isnan(sigmas(found)[:, 1:5])) and np.all(np.isfinite(sigmas(found)[:, [0, 5]]))
    np.testing.assert_array_equal(sigmas(found)[:, 0], sigmas(found)[:, 5])
    for row in range(6):
        one = classified(case._replace(pose=pose[row], joints=joints[row]))
        assert one.status == expected[row] and (one.kind == UNKNOWN) == (expected[row] != Status.OK)
    distance = np.asarray(pk.singularity_distance(case.mechanism, pose, joints, kind="II"))
    np.testing.assert_array_equal(np.isnan(distance), [False, True, True, True, True, False])
    np.testing.assert_allclose(distance[[0, 5]], found.sigma_direct[[0, 5]], rtol=0, atol=1e-13)


def test_a_length_that_is_not_positive_is_bad_input():
    mech, middle, to_side = ROBOTS["3-RPR"]
    pose, joints = random_rows(mech(), middle, to_side, 2)
    found = pk.classify_singularity(mech(), pose, joints * [[1, 1, 1], [1, -1, 1]])
    np.testing.assert_array_equal(found.status, [Status.OK, Status.BAD_INPUT])


def test_loops_may_be_open_by_roundoff():
    """Open by 1e-7 of their size is closed, by 1e-5 it is not."""
    case = CASE["3-RRR, screws meet in P"]
    for step, status in ((1e-8, Status.OK), (1e-4, Status.INCONSISTENT)):
        assert classified(case._replace(joints=case.joints + [step, 0, 0])).status == status


# ---------------------------------------------------------------- in space


@pytest.mark.soak  # notebook 02 turns it, too
def test_a_stewart_platform_turned_by_ninety_degrees():
    """Fichter 1986: a semi-regular platform is singular at a yaw of 90 degrees, not at 0."""
    yaw = np.array([90.0, -90.0, 0.0, 89.0])
    rotation = Rotation.from_euler("z", yaw[:, None], degrees=True).as_matrix()
    pose = pk.SE3(np.tile([0, 0, 1.0], (4, 1)), rotation)
    joints = np.linalg.norm(
        pose.translation[:, None] + SEMI.platform @ np.swapaxes(rotation, 1, 2) - SEMI.base, axis=2
    )
    found = pk.classify_singularity(SEMI, pose, joints)
    np.testing.assert_array_equal(found.status, Status.OK)
    np.testing.assert_array_equal(found.kind, [TYPE_II, TYPE_II, REGULAR, REGULAR])
    assert np.all(sigmas(found)[1, :2] < 1e-12) and np.all(sigmas(found)[1, 2:] > 1e-4)
    assert np.all(sigmas(found)[0] > 0.1)


# ---------------------------------------------------------------- batches, jit, vmap


def test_one_many_vmap_and_jit_agree():
    mech = pk.catalogued("6-link")
    pose, joints = random_rows(mech, [0, 0.3, 0], [0.2, 0.2, 0.6], 6)
    many = pk.classify_singularity(mech, pose, joints)
    call = lambda x, q: pk.classify_singularity(mech, x, q)
    ways = [jax.jit(jax.vmap(call))(pose, joints)]
    ways.append(jax.tree.map(lambda *rows: jnp.stack(rows), *map(call, pose, joints)))
    for found in ways:
        np.testing.assert_array_equal(found.kind, many.kind)
        np.testing.assert_array_equal(found.status, many.status)
        np.testing.assert_allclose(sigmas(found), sigmas(many), rtol=0, atol=1e-13)
    one_pose = pk.classify_singularity(mech, pose[0], joints)  # one pose, many joints: on lanes, too
    np.testing.assert_array_equal(one_pose.status, [Status.OK] + [Status.INCONSISTENT] * 5)
    for kind, sigma in (("I", many.sigma_inverse), ("II", many.sigma_direct)):
        found = pk.singularity_distance(mech, pose, joints, kind=kind)
        np.testing.assert_allclose(found, sigma, rtol=0, atol=1e-13)
    least = np.minimum(many.sigma_inverse, many.sigma_direct)
    np.testing.assert_allclose(pk.singularity_distance(mech, pose, joints), least, rtol=0, atol=1e-13)


def test_in_float32():
    case = CASE["5-link, BP and CP overlap"]
    short = lambda leaf: jnp.asarray(leaf, jnp.float32)
    mech, pose, joints = jax.tree.map(short, (case.mechanism, case.pose, case.joints))
    one = pk.classify_singularity(mech, pose, joints, tol=1e-4)
    many = pk.classify_singularity(mech, pose[None], joints[None], tol=1e-4)
    for found in (one, jax.tree.map(lambda leaf: leaf[0] if leaf.ndim else leaf, many)):
        assert found.kind == case.kind and found.status == Status.OK
        assert found.sigma_direct.dtype == found.sigma_inverse.dtype == jnp.float32
        np.testing.assert_allclose(found[1:4], classified(case)[1:4], rtol=0, atol=1e-5)


# ---------------------------------------------------------------- derivatives


@jax.jit
def distances(mech, pose, joints):
    return jnp.stack([pk.singularity_distance(mech, pose, joints, kind=kind) for kind in ("I", "II")])


rates = jax.jit(jax.jacrev(distances, argnums=(0, 1, 2)))


def test_derivatives_against_differences():
    """In pose, joints and geometry, one after the other: closed loops that open to first order."""
    mech = pk.catalogued("6-link")
    pose, joints = random_rows(mech, [0, 0.3, 0], [0.2, 0.2, 0.6], 3)
    rng, h = np.random.default_rng(4), 1e-7
    for row in range(3):
        leaves, tree = jax.tree.flatten((mech, pose[row], joints[row]))
        gradient = jax.tree.leaves(rates(mech, pose[row], joints[row]))
        for k, leaf in enumerate(leaves):
            way = rng.uniform(-1, 1, leaf.shape)
            at = lambda by, k=k, to=leaves, by_one=way: [*to[:k], to[k] + by * by_one, *to[k + 1 :]]
            ends = [distances(*jax.tree.unflatten(tree, at(by))) for by in (-h, h)]
            along = np.sum((gradient[k] * way).reshape(2, -1), axis=1)
            np.testing.assert_allclose(along, (ends[1] - ends[0]) / (2 * h), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "title", ["6-link, one arm folded", "6-link, all screws on one line", "5-link, BP and CP in line"]
)
def test_derivatives_are_finite_at_a_singular_pose(title):
    case = CASE[title]
    gradient = jax.tree.leaves(rates(case.mechanism, case.pose, case.joints))
    assert all(np.all(np.isfinite(leaf)) for leaf in gradient)
    if case.kind != FLAT:
        assert max(np.max(np.abs(leaf[case.kind - 1])) for leaf in gradient) > 0.1


# ---------------------------------------------------------------- refusals


def test_what_is_refused():
    mech = pk.catalogued("3-rrr")
    at = (mech, np.zeros(3), np.zeros(3))
    assert "takes a pk_jax.Mechanism" in said_by(pk.classify_singularity, "3-rrr", *at[1:])
    assert "takes a pk_jax.Mechanism" in said_by(pk.singularity_distance, "3-rrr", *at[1:])
    assert said_by(pk.classify_singularity, mech, np.zeros(2), np.zeros(3)).startswith("pose must have shape")
    assert said_by(pk.classify_singularity, mech, np.zeros(3), np.zeros(4)).startswith(
        "joints must have shape"
    )
    two, three = np.zeros((2, 3)), np.zeros((3, 3))
    assert "same number of rows" in said_by(pk.classify_singularity, mech, two, three)
    for tol in (0, 1, -1e-6, NAN):
        assert said_by(pk.classify_singularity, *at, tol=tol).startswith("tol must be in (0, 1)")
    for length in (0.0, -1.0, NAN, INF, [1.0, 2.0], "m"):
        assert said_by(pk.classify_singularity, *at, length=length).startswith("length must ")
    assert said_by(pk.singularity_distance, *at, kind="III") == "kind must be one of I, II, any, got 'III'"
