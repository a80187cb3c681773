"""3-RRR and 3-RPR, more arms than needed, 6-link, five-bar, against NumPy, SciPy and publications."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, least_squares

import pk_jax as pk
from pk_jax.geometry.poses import place, place_jacobian, retract, turned, unturned
from pk_jax.kinematics.inverse import working_modes

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

BATCH = 16  # rows of every batch of closed forms here, so that each is compiled once


def ring(angles):
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def ends(k, seed):
    """Irregular base and platform joints. -> (k, 2), (k, 2)"""
    rng = np.random.default_rng(seed)
    turns = 2 * np.pi / k * (np.arange(k) + 0.6 * rng.random(k))
    size = 1 + 0.3 * rng.uniform(-1, 1, (k, 2, 1))
    return 0.5 * size[:, 0] * ring(turns), 0.15 * size[:, 1] * ring(turns + 0.4 * rng.random(k) + 0.5)


@cache
def arms(k, seed=0):
    base, platform = ends(k, seed)
    links = 0.35 + 0.08 * np.random.default_rng(seed + 1).uniform(-1, 1, (2, k))
    return pk.PlanarRRR(base=base, platform=platform, proximal=links[0], distal=links[1])


@cache
def legs(k, seed=0):
    base, platform = ends(k, seed)
    return pk.PlanarRPR(base=base, platform=platform)


@cache
def six_link():
    return pk.SixLink(
        base=[[-0.2, 0.03], [0.25, -0.02]],
        platform=[[-0.12, 0.02], [0.1, -0.03]],
        proximal=[0.3, 0.26],
        distal=[0.28, 0.34],
    )


def equal_arms():
    base, platform = ends(3, 5)
    return pk.PlanarRRR(base=base, platform=platform, proximal=0.36, distal=0.31)


def equal_six_link():
    return pk.SixLink(
        base=[[-0.2, 0.03], [0.25, -0.02]],
        platform=[[-0.12, 0.02], [0.1, -0.03]],
        proximal=0.3,
        distal=0.26,
    )


catalogued = cache(pk.catalogued)
LAWFUL = {
    "3-rrr": lambda: catalogued("3-rrr"),
    "3-rrr, irregular": equal_arms,
    "4-rrr": lambda: catalogued("4-rrr"),
    "6-link": lambda: catalogued("6-link"),
    "6-link, irregular": equal_six_link,
    "sauer-3-rpr": lambda: catalogued("sauer-3-rpr"),
    "arte-3-rpr": lambda: catalogued("arte-3-rpr"),
    "3-rpr, irregular": lambda: legs(3),
    "5-link": lambda: catalogued("5-link"),
    "5-link, coaxial": lambda: pk.FiveBar(half_base=0.0, proximal=0.23, distal=0.35),
}


SLOW = {
    "3-rrr",
    "3-rrr, irregular",
    "4-rrr",
    "5-link",
    "5-link, coaxial",
    "sauer-3-rpr",
    "arte-3-rpr",
    "3-rpr, irregular",
}  # to compile; other arms and legs obey the same code, and an outsider's 3-RPR in test_laws


@pytest.mark.parametrize(
    "build",
    [
        pytest.param(build, id=name, marks=[pytest.mark.soak] * (name in SLOW))
        for name, build in LAWFUL.items()
    ],
)
def test_laws_hold(build):
    assert len(pk.check_mechanism(build())) >= 19


@pytest.mark.soak
def test_one_length_for_all_arms_is_one_each():
    each = pk.PlanarRRR(
        base=equal_arms().base, platform=equal_arms().platform, proximal=[0.36] * 3, distal=[0.31] * 3
    )
    for one, other in zip(equal_arms().home(), each.home(), strict=True):
        np.testing.assert_array_equal(one, other)


# ---------------------------------------------------------------- inverse kinematics in every working mode


inverse = jax.jit(lambda mech, pose, branch: mech.inverse(pose, branch))
forward = jax.jit(lambda mech, joints: mech.forward(joints))
drawn = jax.jit(jax.vmap(lambda mech, pose, joints: mech.skeleton(pose, joints).points, in_axes=(None, 0, 0)))


def arms_of(mech, poses, joints):
    """sign(sin psi) of every arm, from the drawn links; the lengths of its links. -> 3 times (rows, k)"""
    points, k = np.asarray(drawn(mech, poses, joints)), working_modes(mech).shape[1]
    base, elbows, tips = points[:, :k], points[:, k : 2 * k], points[:, 2 * k : 3 * k]
    first, second = elbows - base, tips - elbows  # of a five-bar one tip for both
    signs = np.sign(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
    return signs, np.linalg.norm(first, axis=2), np.linalg.norm(second, axis=2)


ARMED = {"3-rrr": lambda: arms(3), "4-rrr": lambda: catalogued("4-rrr"), "6-link": six_link}
ARMED |= {"5-link": lambda: catalogued("5-link")}  # 4-rrr in make soak: arms as of the 3-rrr, one more


@pytest.mark.parametrize(
    "build",
    [
        pytest.param(build, id=name, marks=[pytest.mark.soak] * (name == "4-rrr"))
        for name, build in ARMED.items()
    ],
)
def test_every_working_mode_closes_the_loops_and_comes_back(build):
    mech = build()
    home, modes = np.asarray(mech.home()[0]), working_modes(mech)
    assert len(np.unique(modes, axis=0)) == len(modes) == 2 ** modes.shape[1]
    steps = np.array([0.1 * mech.length(), -0.07 * mech.length(), 0.05])[: home.size]
    poses = np.repeat([home, home + steps, home - steps], len(modes), axis=0)
    branch = np.tile(modes, (3, 1))
    joints, status, _ = pk.inverse_kinematics(mech, poses, branch)
    assert np.all(np.asarray(status) == pk.Status.OK)
    signs, proximal, distal = arms_of(mech, poses, joints)
    np.testing.assert_array_equal(signs, branch)
    np.testing.assert_allclose(proximal, np.broadcast_to(mech.proximal, signs.shape), rtol=1e-13)
    np.testing.assert_allclose(distal, np.broadcast_to(mech.distal, signs.shape), rtol=1e-13)
    back = pk.forward_kinematics(mech, joints, poses)
    is_ok = np.asarray(back.status) == pk.Status.OK
    assert np.all(is_ok | (np.asarray(back.sigma_min) < 1e-6))  # two distal links may be on one line
    assert np.mean(is_ok) > 0.7
    np.testing.assert_allclose(np.asarray(back.pose)[is_ok], poses[is_ok], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["3-rrr", "4-rrr", "6-link"])
def test_drawn_links_are_rigid_and_hold_together(name):
    mech = catalogued(name)
    home, joints = mech.home()
    pose = home + jnp.array([0.02, -0.03, 0.1])
    links = np.array(mech.skeleton(home, joints).segments)
    ends = [
        np.asarray(mech.skeleton(*at).points)[links] for at in ((home, joints), (pose, mech.inverse(pose)))
    ]
    one, other = (np.linalg.norm(each[:, 0] - each[:, 1], axis=1) for each in ends)
    np.testing.assert_allclose(one, other, rtol=1e-12)
    assert set(links.ravel()) == set(range(links.max() + 1)) and len(set(map(frozenset, links))) == len(links)


def test_home_stands_above_the_base_wherever_that_is():
    base, platform = ends(3, 0)
    links = {"proximal": 0.35, "distal": 0.36}
    for build in (partial(pk.PlanarRRR, **links), pk.PlanarRPR):
        home, joints = build(base=base, platform=platform).home()
        moved, same = build(base=base + [3.0, -2.0], platform=platform).home()
        np.testing.assert_allclose(moved, home + jnp.array([3.0, -2.0, 0]), atol=1e-9)
        np.testing.assert_allclose(same, joints, atol=1e-9)
    assert catalogued("6-link").home()[0][1] > 0


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_modes_are_those_of_any_unit(scale):
    base, platform = ends(3, 0)
    one = pk.PlanarRPR(base=base, platform=platform)
    joints = np.asarray(one.home()[1])
    poses, is_real = forward(one, joints)
    other, also_real = forward(pk.PlanarRPR(base=scale * base, platform=scale * platform), scale * joints)
    np.testing.assert_array_equal(is_real, also_real)
    assert 2 <= np.sum(is_real) <= 6
    np.testing.assert_allclose(other / np.array([scale, scale, 1]), poses, atol=1e-9)


@pytest.mark.parametrize("name", ["4-rrr", "4-rpr"])
def test_modes_of_more_arms_than_needed_close_all_of_them(name):
    mech = catalogued("4-rrr") if name == "4-rrr" else legs(4)
    pose = mech.home()[0] + jnp.array([0.03, -0.02, 0.15])
    joints = inverse(mech, pose, mech.default_branch() if name == "4-rrr" else None)
    poses, is_real = forward(mech, joints)
    found = np.asarray(poses)[np.asarray(is_real)]
    assert len(found) >= 1 and np.abs(found - pose).max(axis=1).min() < 1e-9
    for each in found:
        np.testing.assert_allclose(
            mech.residual(jnp.asarray(each), joints), 0, atol=1e-5 * mech.length() ** 2
        )


@pytest.mark.soak
@pytest.mark.parametrize("build", [*ARMED.values(), lambda: legs(3)], ids=[*ARMED, "3-rpr"])
def test_forward_of_inverse_is_the_identity_in_a_box(build):
    mech = build()
    home = np.asarray(mech.home()[0])
    half = np.array([0.2 * mech.length(), 0.2 * mech.length(), 0.15])[: home.size]
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * home.size), axis=-1).reshape(-1, home.size)
    poses = home + half * grid
    found = pk.forward_kinematics(mech, pk.inverse_kinematics(mech, poses).joints)
    assert np.all(np.asarray(found.status) == pk.Status.OK)
    np.testing.assert_allclose(found.pose, poses, rtol=0, atol=1e-12)


# ---------------------------------------------------------------- every assembly mode


@jax.jit
@jax.vmap
def _rpr_modes(base, platform, lengths):
    return pk.PlanarRPR(base=base, platform=platform).forward(lengths)


@jax.jit
@jax.vmap
def _rrr_modes(base, platform, proximal, distal, pose, branch):
    mech = pk.PlanarRRR(base=base, platform=platform, proximal=proximal, distal=distal)
    joints = mech.inverse(pose, branch)
    return joints, *mech.forward(joints)


def rpr_modes(base, platform, lengths, dtype=float):
    """The real poses of every row; each argument (rows, ...) or without rows."""
    rows = np.broadcast_shapes(*(np.shape(a)[:-d] for a, d in ((base, 2), (platform, 2), (lengths, 1))))[0]
    given = [np.broadcast_to(a, (rows, *s)) for a, s in ((base, (3, 2)), (platform, (3, 2)), (lengths, (3,)))]
    poses, is_real = _rpr_modes(*(np.resize(a.astype(dtype), (BATCH, *a.shape[1:])) for a in given))
    poses, is_real = np.asarray(poses), np.asarray(is_real)
    assert np.all(np.isnan(poses[~is_real])) and np.all(np.isfinite(poses[is_real]))
    return [x[real] for x, real in zip(poses[:rows], is_real[:rows], strict=True)]


def placed(pose, points):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + points @ np.array([[c, s], [-s, c]])


def lengths_at(base, platform, pose):
    return np.linalg.norm(placed(pose, platform) - base, axis=1)


def scanned(base, platform, lengths):
    """All poses of a 3-RPR, by a scan over phi; None where two of them all but coincide.

    With Y from base joint 1 to platform joint 1 and u_j = R d_j - g_j the differences of the three
    squares say 2 Y . u_j = l_j^2 - l_1^2 - |u_j|^2, which gives Y; what is left is |Y| = l_1.
    """
    d, g = platform[1:] - platform[0], base[1:] - base[0]

    def position(phi):  # Y det, det
        c, s = np.cos(phi), np.sin(phi)
        (ux, uy), (vx, vy) = (
            [c * d[j, 0] - s * d[j, 1] - g[j, 0], s * d[j, 0] + c * d[j, 1] - g[j, 1]] for j in (0, 1)
        )
        a = (lengths[1] ** 2 - lengths[0] ** 2 - ux**2 - uy**2) / 2
        b = (lengths[2] ** 2 - lengths[0] ** 2 - vx**2 - vy**2) / 2
        return a * vy - b * uy, b * ux - a * vx, ux * vy - uy * vx

    def left(phi):
        x, y, det = position(phi)
        return x**2 + y**2 - (lengths[0] * det) ** 2

    phi = np.linspace(-np.pi, np.pi, 8001)
    values = left(phi)
    crossings = [
        np.sum(np.diff(np.sign(values + shift * np.max(np.abs(values)))) != 0) for shift in (0, -1e-6, 1e-6)
    ]
    if len(set(crossings)) > 1:
        return None
    poses = []
    for i in np.flatnonzero(np.diff(np.sign(values))):
        turn = brentq(left, phi[i], phi[i + 1], xtol=1e-15)
        x, y, det = position(turn)
        at = base[0] + np.array([x, y]) / det
        poses.append([*(at - placed(np.array([0, 0, turn]), platform)[0]), turn])
    return np.array(poses).reshape(-1, 3)


def assert_same_poses(found, expected, atol):
    """The same set: as many, and each is one of the others; phi modulo full turns."""
    assert len(found) == len(expected)
    if len(found):
        points = [np.concatenate([x[:, :2], ring(x[:, 2])], axis=1) for x in (found, np.asarray(expected))]
        gaps = np.max(np.abs(points[0][:, None] - points[1]), axis=-1)
        assert sorted(gaps.argmin(axis=1)) == list(range(len(found)))
        np.testing.assert_allclose(gaps.min(axis=1), 0, atol=atol)


SAUER = np.array([[0.0, 0], [5, 0], [0, 6]]), np.array([[0.0, 0], [3, 0], [3, 3]])


@pytest.mark.parametrize(("p2", "count"), [(3.5, 0), (4.0, 2), (5.0, 4), (7.0, 6), (9.0, 2)])
def test_sauers_platform_has_as_many_poses_as_published(p2, count):
    """T. Sauer, Numerical Analysis, Reality Check 1 (p1 = 5, p3 = 3); 4, 5, 7 are printed."""
    lengths = np.array([5, p2, 3])
    (found,) = rpr_modes(*SAUER, lengths[None])
    assert len(found) == count
    assert_same_poses(found, scanned(*SAUER, lengths), 1e-12)


def test_sauers_first_case():
    """The same: L1 = 2, L2 = L3 = sqrt 2, gamma = pi / 2, p = sqrt 5, (x1, x2, y2) = (4, 0, 4)."""
    root = np.sqrt(2)
    base, platform = np.array([[0.0, 0], [4, 0], [0, 4]]), np.array([[0, 0], [root, 0], [0, root]])
    (found,) = rpr_modes(base, platform, np.full((1, 3), np.sqrt(5)))
    np.testing.assert_allclose(found, [[1, 2, -np.pi / 4], [2, 1, np.pi / 4]], rtol=0, atol=1e-13)


def test_artes_3_rpr():
    """The toolbox's test_kinematics_3RPR: lengths of four decimals, and the pose it finds."""
    mech, pose = catalogued("arte-3-rpr"), np.array([0.951, 0.9792, -0.3525557899])
    lengths = np.array([1.365, 1.3477, 1.2037])
    np.testing.assert_allclose(
        lengths_at(*map(np.asarray, (mech.base, mech.platform)), pose), lengths, rtol=0, atol=1e-4
    )
    (found,) = rpr_modes(mech.base, mech.platform, lengths[None])
    assert np.min(np.max(np.abs(found - pose), axis=1)) < 5e-4


@pytest.mark.parametrize(
    ("design", "pose", "published"),
    [
        (
            (0.125, 0.205, 0.205),
            (0, 0.3),
            {(1, 1): (0.52040625, 1.30998849), (-1, 1): (1.83160416, 1.30998849)},
        ),
        (
            (0.125, 0.205, 0.205),
            (0, 0.3),
            {(-1, -1): (1.83160416, 2.6211864), (1, -1): (0.52040625, 2.6211864)},
        ),
        ((0.0, 0.23, 0.35), (0, 0.4), {(-1, 1): (2.62800598, 0.51358667)}),
    ],
)
def test_five_bars_with_published_angles(design, pose, published):
    """Values of a public five-bar's tests, eight decimals. They name the leg at -d first, we that at +d."""
    mech = pk.FiveBar(**dict(zip(("half_base", "proximal", "distal"), design, strict=True)))
    for signs, angles in published.items():
        joints = inverse(mech, np.array(pose, float), np.array(signs[::-1], float))
        np.testing.assert_allclose(joints, angles[::-1], rtol=0, atol=5e-9)
        modes, is_real = forward(mech, joints)
        assert all(is_real) and np.min(np.max(np.abs(modes - np.array(pose)), axis=1)) < 1e-14


@pytest.mark.parametrize("seed", range(4))
def test_the_modes_of_any_3_rpr_are_those_of_a_scan(seed):
    rng = np.random.default_rng(seed)
    base, platform = rng.uniform(-1, 1, (2, BATCH, 3, 2))
    poses = rng.uniform(-1, 1, (BATCH, 3)) * [1, 1, np.pi]
    lengths = np.array([lengths_at(*row) for row in zip(base, platform, poses, strict=True)])
    judged = 0
    for c, h, pose, ell, found in zip(
        base, platform, poses, lengths, rpr_modes(base, platform, lengths), strict=True
    ):
        for x in found:
            np.testing.assert_allclose(lengths_at(c, h, x), ell, rtol=0, atol=1e-13)
        expected = scanned(c, h, ell)
        if expected is not None:
            judged += 1
            assert np.min(np.max(np.abs(found - pose), axis=1)) < 1e-9
            assert len(found) % 2 == 0
            assert np.all(np.diff(found[:, 2]) > 0)
            assert_same_poses(found, expected, 1e-9)
    assert judged >= 0.8 * BATCH


@pytest.mark.parametrize("seed", range(2))
def test_the_modes_of_any_3_rrr_are_those_of_a_scan(seed):
    """Drawn from its angles, so that the inverse has an answer to find."""
    rng = np.random.default_rng(100 + seed)
    base, platform = rng.uniform(-1, 1, (2, BATCH, 3, 2))
    poses = rng.uniform(-1, 1, (BATCH, 3)) * [1, 1, np.pi]
    angles, proximal = rng.uniform(-np.pi, np.pi, (BATCH, 3)), rng.uniform(0.2, 1, (BATCH, 3))
    elbows = base + proximal[..., None] * ring(angles)
    links = np.array([placed(*row) for row in zip(poses, platform, strict=True)]) - elbows
    distal = np.linalg.norm(links, axis=2)
    sine = np.cos(angles) * links[..., 1] - np.sin(angles) * links[..., 0]
    joints, modes, is_real = _rrr_modes(base, platform, proximal, distal, poses, np.sign(sine))
    turns = np.angle(np.exp(1j * (np.asarray(joints) - angles)))
    np.testing.assert_allclose(turns[np.abs(sine) > 1e-2], 0, atol=1e-11)
    judged = 0
    for i in range(BATCH):
        found, expected = (
            np.asarray(modes[i])[np.asarray(is_real[i])],
            scanned(elbows[i], platform[i], distal[i]),
        )
        if expected is not None and np.all(np.abs(sine[i]) > 1e-2):
            judged += 1
            assert_same_poses(found, expected, 1e-8)
            assert np.min(np.max(np.abs(found - poses[i]), axis=1)) < 1e-8
    assert judged >= 0.6 * BATCH


def test_modes_move_with_the_base_and_against_the_platform_and_scale():
    base, platform = SAUER
    lengths = np.array([5, 7, 3.0])
    (plain,) = rpr_modes(base, platform, lengths[None])
    at, seen = np.array([2.0, -3.0, 2.5]), np.array([-1.0, 0.5, -2.2])
    sizes = [1e-3, 1e3]
    bases = [placed(at, base), base, *(s * base for s in sizes), base[[2, 0, 1]]]
    platforms = [platform, placed(seen, platform), *(s * platform for s in sizes), platform[[2, 0, 1]]]
    rows = [lengths, lengths, *(s * lengths for s in sizes), lengths[[2, 0, 1]]]
    moved, against, small, large, renumbered = rpr_modes(*map(np.array, (bases, platforms, rows)))
    carried = np.array([[*placed(at, x[None, :2])[0], at[2] + x[2]] for x in plain])
    assert_same_poses(moved, carried, 1e-11)
    back = np.array(
        [[*placed(x, seen[None, :2])[0], x[2] + seen[2]] for x in against]
    )  # platform's old frame
    assert_same_poses(back, plain, 1e-11)
    for size, found in zip(sizes, (small, large), strict=True):
        assert_same_poses(found / [size, size, 1], plain, 1e-11)
    assert_same_poses(renumbered, plain, 1e-11)


def test_two_modes_of_one_phi():
    """Platform = base + multiples of e: at phi = 0 all u_j are along e, and Y may be mirrored in e."""
    base, e = np.array([[0.0, 0], [1.1, 0.1], [0.3, 0.9]]), np.array([0.8, 0.6])
    platform = base + np.outer([0.1, -0.5, 0.3], e)
    pose = np.array([0.4, 0.7, 0.0])
    first = placed(pose, platform)[0] - base[0]
    normal = np.array([-0.6, 0.8])
    mirrored = pose - np.append(2 * (first @ normal) * normal, 0)
    (found,) = rpr_modes(base, platform, lengths_at(base, platform, pose)[None])
    for x in (pose, mirrored):
        assert np.min(np.max(np.abs(found - x), axis=1)) < 1e-9
    assert len(found) % 2 == 0


def test_collinear_joints_give_mirror_pairs():
    """Base and platform on lines: (x, y, phi) and (x, -y, -phi) close alike, also with phi = 0 in common."""
    base, platform = np.array([[0.0, 0], [1, 0], [2.3, 0]]), np.array([[-0.4, 0.0], [0.1, 0], [0.7, 0]])
    poses = np.array([[0.8, 0.9, 0.7], [1.1, 0.6, 0.0], [0.9, -0.8, 2.9]])
    lengths = np.array([lengths_at(base, platform, x) for x in poses])
    for pose, found in zip(poses, rpr_modes(base, platform, lengths), strict=True):
        assert_same_poses(found * [1, -1, -1], found, 1e-9)
        assert np.min(np.max(np.abs(found - pose), axis=1)) < 1e-9


def test_similar_triangles_have_at_most_four_modes_of_phi_in_pairs():
    """Of similar triangles phi enters by cos(phi) alone, in a quadratic (Gosselin and Merlet 1994)."""
    base = np.array([[0.0, 0], [1.2, 0.1], [0.4, 1.1]])
    platform, rng = 0.4 * base, np.random.default_rng(3)
    poses = rng.uniform(-1, 1, (BATCH, 3)) * [1, 1, np.pi]
    lengths = np.array([lengths_at(base, platform, x) for x in poses])
    for pose, ell, found in zip(poses, lengths, rpr_modes(base, platform, lengths), strict=True):
        assert len(found) in (2, 4)
        np.testing.assert_allclose(found[:, 2], -found[::-1, 2], rtol=0, atol=1e-9)
        assert_same_poses(found, scanned(base, platform, ell), 1e-9)
        assert np.min(np.max(np.abs(found - pose), axis=1)) < 1e-9


def test_a_batch_of_modes_equals_a_loop():
    lengths = np.array([[5, p2, 3] for p2 in (4.0, 5.0, 7.0, 9.0)])
    many = rpr_modes(*SAUER, lengths)
    mech = catalogued("sauer-3-rpr")
    for q, rows in zip(lengths, many, strict=True):
        poses, is_real = forward(mech, q)
        assert np.sum(is_real) == len(rows)
        np.testing.assert_allclose(np.asarray(poses)[: len(rows)], rows, rtol=0, atol=1e-12)


def test_float32_finds_the_same_modes():
    lengths = np.array([[5, p2, 3] for p2 in (4.0, 5.0, 7.0, 9.0)])
    many = rpr_modes(*SAUER, lengths)
    for single, double in zip(rpr_modes(*SAUER, lengths, np.float32), many, strict=True):
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, double, rtol=0, atol=1e-4)


def along(t, p2):
    """Modes of Sauer's platform while everything moves: lengths, base and platform."""
    base, platform = (points + t * jnp.asarray(np.cos(points)) / 4 for points in SAUER)
    lengths = jnp.stack([5 + t, p2 - 0.5 * t, 3 + 0.3 * t])
    return pk.PlanarRPR(base=base, platform=platform).forward(lengths)[0]


@pytest.mark.soak
def test_derivatives_of_modes_through_third_order():
    """Each order against central differences, of fourth order, of the one before."""
    orders = [along]
    for _ in range(3):
        orders.append(jax.jacfwd(orders[-1]))
    every = jax.jit(lambda t: jnp.stack([order(t, 7.0) for order in orders]))
    h = 1e-4
    at = {k: np.asarray(every(k * h)) for k in (-2, -1, 0, 1, 2)}
    slopes = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h)
    for order in range(3):
        scale = np.max(np.abs(at[0][order + 1]))
        np.testing.assert_allclose(at[0][order + 1] / scale, slopes[order] / scale, rtol=0, atol=1e-7)


def test_gradients_of_modes_are_finite_where_others_are_not_real():
    """p2 = 4: two modes of six; reverse mode must not meet the NaN of the other four."""
    real = lambda t: jnp.nansum(along(t, 4.0) * jnp.arange(1.0, 4.0))
    both = jax.jit(jax.value_and_grad(real))
    np.testing.assert_allclose(both(0.0)[1], (both(1e-5)[0] - both(-1e-5)[0]) / 2e-5, rtol=1e-7)


# ---------------------------------------------------------------- turns of the platform


def test_turned_and_back():
    rng = np.random.default_rng(1)
    poses, near = rng.uniform(-20, 20, (2, 200, 3))
    back = jax.vmap(lambda x, near: unturned(turned(x), near))(poses, near)
    off = poses - np.asarray(back)
    np.testing.assert_array_equal(off[:, :2], 0)
    np.testing.assert_allclose(off[:, 2] / (2 * np.pi), np.round(off[:, 2] / (2 * np.pi)), rtol=0, atol=1e-14)
    assert np.all(np.abs(back[:, 2] - near[:, 2]) <= np.pi + 1e-12)


def test_turned_poses_move_as_plain_ones():
    """Tangents: d/dt of the points is that of (x, y, phi), which are the columns of the rigid-body map."""
    pose, points = jnp.array([0.3, -0.8, 2.1]), jnp.array([[0.2, 0.1], [-0.4, 0.5], [1.0, -0.7]])
    rates = np.asarray(place_jacobian(turned(pose), points))
    np.testing.assert_allclose(rates, place_jacobian(pose, points), rtol=0, atol=1e-15)
    for k, unit in enumerate(np.eye(3)):
        ahead, behind = (place(retract(turned(pose), h * unit), points) for h in (1e-5, -1e-5))
        np.testing.assert_allclose(rates[..., k], (ahead - behind) / 2e-5, rtol=0, atol=1e-10)
    for twist in ([0.1, 0.2, 0.5], [0.0, 0.0, -1.5]):
        np.testing.assert_allclose(np.hypot(*retract(turned(pose), np.array(twist)).direction), 1, rtol=1e-15)


def test_guesses_choose_the_turn_and_the_traced_path_agrees():
    mech = arms(3)
    home, joints = mech.home()
    offsets = np.random.default_rng(4).uniform(-0.1, 0.1, (24, 3)) * [
        0.1 * mech.length(),
        0.1 * mech.length(),
        1,
    ]
    turns = 2 * np.pi * (np.arange(24) % 7 - 3)
    joints = np.tile(joints, (24, 1))
    guess = np.asarray(home) + offsets
    plain, shifted = (
        pk.forward_kinematics(mech, joints, x) for x in (guess, guess + turns[:, None] * [0, 0, 1])
    )
    assert np.all(np.asarray(plain.status) == 0) and np.all(np.asarray(shifted.status) == 0)
    np.testing.assert_allclose(plain.pose, np.tile(home, (24, 1)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(shifted.pose[:, 2] - plain.pose[:, 2], turns, rtol=0, atol=1e-13)
    assert np.all(np.abs(shifted.pose[:, 2] - (guess[:, 2] + turns)) <= np.pi)
    traced = jax.jit(jax.vmap(partial(pk.forward_kinematics, mech)))(
        joints, guess + turns[:, None] * [0, 0, 1]
    )
    np.testing.assert_array_equal(traced.status, shifted.status)
    np.testing.assert_allclose(traced.pose, shifted.pose, rtol=0, atol=1e-12)


# ---------------------------------------------------------------- more motors than freedoms


def rrr_closure(mech, joints, pose):
    base, platform = np.asarray(mech.base), np.asarray(mech.platform)
    elbows = base + (np.asarray(mech.proximal) * ring(joints).T).T
    return (np.sum((placed(pose, platform) - elbows) ** 2, axis=1) - np.asarray(mech.distal) ** 2) / 2


def six_link_closure(mech, joints, pose):
    elbows = np.asarray(mech.base) + (np.asarray(mech.proximal) * ring(joints[::2]).T).T
    tips = elbows + (np.asarray(mech.distal) * ring(joints[::2] + joints[1::2]).T).T
    return (placed(pose, np.asarray(mech.platform)) - tips).ravel()


@pytest.mark.soak
@pytest.mark.parametrize(
    ("build", "closure"),
    [(lambda: catalogued("4-rrr"), rrr_closure), (six_link, six_link_closure)],
    ids=["4-rrr", "6-link"],
)
def test_motors_that_disagree_are_inconsistent_and_the_candidate_is_least_squares(build, closure):
    mech = build()
    pose = np.asarray(mech.home()[0]) + [0.1 * mech.length(), -0.05 * mech.length(), 0.08]
    joints = np.tile(pk.inverse_kinematics(mech, pose).joints, (5, 1))
    joints[:4] += 1e-3 * np.eye(4)
    found = pk.forward_kinematics(mech, joints)
    assert list(found.status) == [pk.Status.INCONSISTENT] * 4 + [pk.Status.OK]
    assert np.all(np.isnan(found.pose[:4]))
    np.testing.assert_allclose(found.pose[4], pose, rtol=0, atol=1e-13)
    for q, candidate, size in zip(joints, found.candidate, found.residual, strict=True):
        best = least_squares(partial(closure, mech, q), pose, "3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(candidate, best.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(size, np.sqrt(2 * best.cost), rtol=1e-6, atol=1e-14)
    modes = [np.sum(forward(mech, q)[1]) for q in joints]
    assert modes[:4] == [0] * 4 and modes[4] >= 1


# ---------------------------------------------------------------- the geometry: derivatives, bad input


def test_gradients_in_the_geometry():
    mech, weights = arms(3), jnp.array([1.0, -0.5, 0.3])
    home, joints = mech.home()
    both = jax.jit(jax.value_and_grad(lambda mech: weights @ pk.forward_kinematics(mech, joints, home).pose))
    gradient = jax.tree.leaves(both(mech)[1])
    leaves, tree = jax.tree.flatten(mech)
    for i, (leaf, slope) in enumerate(zip(leaves, gradient, strict=True)):
        for at in np.ndindex(leaf.shape):
            moved = lambda h, i=i, at=at: tree.unflatten(
                [*leaves[:i], leaves[i].at[at].add(h), *leaves[i + 1 :]]
            )
            slope_found = (both(moved(1e-5))[0] - both(moved(-1e-5))[0]) / 2e-5
            np.testing.assert_allclose(slope[at], slope_found, rtol=1e-6, atol=1e-8)


def test_home_under_jit_is_home_and_its_pose_has_no_derivative():
    mech = arms(3)
    for one, other in zip(jax.jit(lambda mech: mech.home())(mech), mech.home(), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)
    gradient = jax.jit(jax.grad(lambda mech: jnp.sum(mech.home()[0])))(mech)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(gradient))


TRIANGLE, SMALL = [[0.0, 0], [1, 0], [0.5, 0.9]], [[-0.15, -0.1], [0.15, -0.1], [0.0, 0.2]]
RRR = {"base": TRIANGLE, "platform": SMALL, "proximal": 0.5, "distal": 0.5}
RPR = {"base": TRIANGLE, "platform": SMALL}
SIX = {"base": TRIANGLE[:2], "platform": SMALL[:2], "proximal": 0.5, "distal": 0.5}
WRONG = [
    (pk.PlanarRRR, RRR, {"base": TRIANGLE[:2], "platform": SMALL[:2]}, "PlanarRRR.base"),
    (pk.PlanarRPR, RPR, {"base": TRIANGLE[:2], "platform": SMALL[:2]}, "PlanarRPR.base"),
    (pk.SixLink, SIX, {"base": TRIANGLE, "platform": SMALL}, "SixLink.base"),
    (pk.PlanarRRR, RRR, {"base": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]}, "PlanarRRR.base"),
    (pk.PlanarRRR, RRR, {"platform": SMALL[:2]}, "PlanarRRR.platform"),
    (pk.PlanarRPR, RPR, {"platform": [*SMALL, [0.2, 0.2]]}, "PlanarRPR.platform"),
    (pk.PlanarRRR, RRR, {"proximal": [0.5, 0.5]}, "PlanarRRR.proximal"),
    (pk.PlanarRRR, RRR, {"distal": [[0.5], [0.5], [0.5]]}, "PlanarRRR.distal"),
    (pk.SixLink, SIX, {"proximal": [0.5, 0.5, 0.5]}, "SixLink.proximal"),
    (pk.PlanarRRR, RRR, {"proximal": -0.5}, "PlanarRRR.proximal"),
    (pk.PlanarRRR, RRR, {"distal": [0.5, 0.0, 0.5]}, "PlanarRRR.distal"),
    (pk.SixLink, SIX, {"distal": 0.0}, "SixLink.distal"),
    (pk.PlanarRRR, RRR, {"distal": [0.5, np.nan, 0.5]}, "PlanarRRR.distal"),
    (pk.PlanarRPR, RPR, {"base": [[0, 0], [1, 0], [np.inf, 1]]}, "PlanarRPR.base"),
    (pk.PlanarRRR, RRR, {"base": [[0, 0], [1, 0], [1, 0]]}, "PlanarRRR.base"),
    (pk.PlanarRPR, RPR, {"base": [[0, 0], [1, 0], [0, 0]]}, "PlanarRPR.base"),
    (pk.SixLink, SIX, {"base": [[0.3, 0], [0.3, 0]]}, "SixLink.base"),
    (pk.PlanarRRR, RRR, {"platform": [[0.1, 0.2]] * 3}, "PlanarRRR.platform"),
    (pk.PlanarRPR, RPR, {"platform": [[0.0, 0.0]] * 3}, "PlanarRPR.platform"),
    (pk.SixLink, SIX, {"platform": [[0.1, 0.2]] * 2}, "SixLink.platform"),
    (pk.PlanarRRR, RRR, {"proximal": 0.1, "distal": 0.1}, "PlanarRRR.proximal and distal"),
    (pk.PlanarRRR, RRR, {"proximal": [0.5, 0.5, 9.0]}, "PlanarRRR.proximal and distal"),
    (pk.SixLink, SIX, {"proximal": 0.1, "distal": 0.1}, "SixLink.proximal and distal"),
    (pk.PlanarRPR, RPR, {"stroke": [0.01, 0.1]}, "PlanarRPR.stroke"),
    (pk.PlanarRPR, RPR, {"stroke": [1.0, 0.5]}, "PlanarRPR.stroke"),
    (pk.PlanarRPR, RPR, {"stroke": [0.0, 1.0]}, "PlanarRPR.stroke"),
    (pk.PlanarRPR, RPR, {"stroke": [0.1, 1.0, 2.0]}, "PlanarRPR.stroke"),
    (pk.PlanarRPR, RPR, {"stroke": [[0.1, 1.0], [0.1, 1.0]]}, "PlanarRPR.stroke"),
    (pk.PlanarRPR, RPR, {"stroke": [[0.1, 1.0], [0.1, 1.0], [0.8, 0.8]]}, "PlanarRPR.stroke"),
]


@pytest.mark.parametrize(("family", "good", "wrong", "named"), WRONG)
def test_bad_geometry_is_told_in_one_line(family, good, wrong, named):
    family(**good)
    with pytest.raises(ValueError) as caught:
        family(**{**good, **wrong})
    said = str(caught.value)
    assert said.startswith(f"{named} ") and "\n" not in said and len(said) < 250


@pytest.mark.parametrize(
    "branch", [[1, 1], [1, 1, 1, 1], [1, 0, 1], [1, -2, 1], [[1, 1, 1, 1]], [1, np.nan, 1]]
)
def test_a_working_mode_has_one_sign_an_arm(branch):
    with pytest.raises(ValueError, match=r"^branch must [^\n]*$"):
        pk.inverse_kinematics(arms(3), arms(3).home()[0], branch)
