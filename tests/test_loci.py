"""Loci of singularities against closed forms, NumPy grids of determinants, and laws."""

from functools import cache

import jax
import numpy as np
import pytest
from outsiders import delta
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree

import pk_jax as pk

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

STEP = 0.012  # of the box: greatest distance of neighbours on a curve
ONE, TWO = pk.SingularityKind.TYPE_I, pk.SingularityKind.TYPE_II


def said_by(call, *arguments, **named):
    with pytest.raises(ValueError) as caught:
        call(*arguments, **named)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def ring(angles):
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


# ---------------------------------------------------------------- mechanisms

FIVE = {
    "long distal": pk.catalogued("5-link"),
    "short distal": pk.FiveBar(half_base=0.15, proximal=0.3, distal=0.2),
}
TRIANGLE = ring(np.array([0.3, 2.2, 4.4]))  # about the origin
SMALLER, OFFSET = 0.4, 0.5
SIMILAR = pk.PlanarRPR(base=TRIANGLE, platform=SMALLER * TRIANGLE + [OFFSET, 0])
SAUER = pk.catalogued("sauer-3-rpr")
RRR = {
    "regular": pk.catalogued("3-rrr"),
    "asymmetric": pk.PlanarRRR(
        base=[[-0.4, -0.3], [0.5, -0.2], [0.05, 0.45]],
        platform=[[-0.15, -0.05], [0.1, -0.1], [0.02, 0.14]],
        proximal=0.31,
        distal=0.34,
    ),
}
FOUR = pk.catalogued("4-rrr")


@cache
def five(name):
    return pk.singularity_locus(FIVE[name], nodes=41)


@cache
def three_rrr(name, phi):
    return pk.singularity_locus(RRR[name], at=[0, 0, phi], kinds="II", nodes=41)


@cache
def sauer(axes):
    return pk.singularity_locus(SAUER, axes, kinds="II", nodes=41)


# ---------------------------------------------------------------- what a configuration is, in NumPy


def planar(mech, pose, joints):
    """Turned platform joints from the end point, lines of force, driven links, each (k, legs, 2)."""
    pose = np.asarray(pose)
    if isinstance(mech, pk.FiveBar):
        r = float(mech.half_base)
        arms, base = np.zeros((len(pose), 2, 2)), np.array([[r, 0], [-r, 0]])
    else:
        turn = np.stack([ring(pose[:, 2]), ring(pose[:, 2] + np.pi / 2)], axis=-1)
        arms, base = np.einsum("kij,lj->kli", turn, np.asarray(mech.platform)), np.asarray(mech.base)
    tips = pose[:, None, :2] + arms
    if isinstance(mech, pk.PlanarRPR):
        return arms, tips - base, None
    driven = np.asarray(mech.proximal)[..., None] * ring(joints)
    return arms, tips - base - driven, driven


def openness(mech, pose, joints):
    _, lines, _ = planar(mech, pose, joints)
    wanted = joints if isinstance(mech, pk.PlanarRPR) else np.asarray(mech.distal)
    return np.max(np.abs(np.sum(lines**2, axis=2) - wanted**2), axis=1)


def screws(mech, pose, joints):
    """Lines [u, moment] of unit direction, moments over length(). -> (k, legs, 3)"""
    arms, lines, _ = planar(mech, pose, joints)
    u = lines / np.linalg.norm(lines, axis=2, keepdims=True)
    return np.concatenate([u, cross(arms, u)[..., None] / float(mech.length())], axis=2)


def bends(mech, pose, joints):
    """sin psi of every arm."""
    _, lines, driven = planar(mech, pose, joints)
    sizes = np.linalg.norm(lines, axis=2) * np.linalg.norm(driven, axis=2)
    return cross(driven, lines) / sizes


def is_lawful(mech, found):
    """Points are configurations of the slice, singular, free to move as they say, of the mode they name."""
    assert found.curves
    size, names = float(mech.length()), ["x", "y", "phi"][: len(found.at)]
    chosen = [names.index(name) for name in found.axes]
    for curve in found.curves:
        pose, q, v = np.asarray(curve.pose), curve.joints, curve.motion
        in_slice = np.array(np.tile(found.at, (len(pose), 1)))
        in_slice[:, chosen] = curve.coordinates
        np.testing.assert_allclose(pose, in_slice, rtol=0, atol=1e-15 * size)
        assert np.max(np.abs(curve.sigma)) <= 1e-10
        assert np.max(openness(mech, pose, q)) <= 1e-10 * size**2
        arms, lines, driven = planar(mech, pose, q)
        if curve.kind == TWO:
            unit = v / np.array([size, size, 1])[: v.shape[1]]
            turn = v[:, 2:, None] if v.shape[1] == 3 else 0
            speeds = v[:, None, :2] + turn * np.stack([-arms[..., 1], arms[..., 0]], axis=-1)
            rates, moved = np.sum(lines * speeds, axis=2), (pose + 1e-4 * v, q)
        else:
            unit = v / size if driven is None else v
            rates, moved = v * (q if driven is None else cross(driven, lines)), (pose, q + 1e-4 * v)
        np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1, rtol=1e-9)
        reach = np.max(np.linalg.norm(lines, axis=2)) + size
        assert np.max(np.abs(rates)) <= 1e-9 * reach**2  # A v = 0, or B v = 0
        assert (
            np.max(openness(mech, *moved)) <= 10 * 1e-4**2 * reach**2
        )  # of second order, 1e-4 if it were of first
        if driven is not None:
            sines, is_named = bends(mech, pose, q), curve.branch != 0
            np.testing.assert_array_equal(curve.branch[is_named], np.sign(sines)[is_named])
            assert np.max(np.abs(sines[~is_named]), initial=0) <= 1e-4


def points_of(found, kind, mode=None):
    """Coordinates and joints of all points of a kind and a working mode. -> (k, d), (k, m)"""
    rows = []
    for curve in found.of(kind):
        of_mode = (
            slice(None) if mode is None else np.all((curve.branch == mode) | (curve.branch == 0), axis=1)
        )
        rows.append((curve.coordinates[of_mode], curve.joints[of_mode]))
    return tuple(np.concatenate(column) for column in zip(*rows, strict=True))


def box(found):
    return np.array([line[-1] - line[0] for line in found.nodes])


def farthest(points, others, size):
    """From any point to the nearest of the others, in boxes."""
    return np.max(cKDTree(others / size).query(points / size)[0])


def length_of(found, kind=TWO):
    return sum(np.sum(np.linalg.norm(np.diff(c.coordinates, axis=0), axis=1)) for c in found.of(kind))


def inside(points, found):
    ends = np.array([[line[0], line[-1]] for line in found.nodes]).T
    return points[np.all((points > ends[0]) & (points < ends[1]), axis=1)]


# ---------------------------------------------------------------- five-bar: closed forms

AROUND = np.linspace(0, 2 * np.pi, 400, endpoint=False)


@pytest.mark.soak  # the laws of five-bars are checked in test_laws
@pytest.mark.parametrize("name", FIVE)
def test_five_bar_obeys_the_laws(name):
    is_lawful(FIVE[name], five(name))


@pytest.mark.soak  # notebook 03 draws them
@pytest.mark.parametrize("name", FIVE)
@pytest.mark.parametrize("leg", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_type_one_of_the_five_bar_are_its_circles(name, leg, sign):
    """|P - A_i| = la + lb or |la - lb|, wherever the other leg reaches, in both of its modes."""
    mech, found = FIVE[name], five(name)
    la, lb, base = float(mech.proximal), float(mech.distal), np.asarray(mech.base())
    radii = np.array([abs(la - lb), la + lb])
    mode = np.array([sign, sign])
    mode[leg] = 0
    points = np.concatenate(
        [c.coordinates[(c.branch[:, leg] == 0) & (c.branch[:, 1 - leg] * sign >= 0)] for c in found.of(ONE)]
    )
    off = np.linalg.norm(points - base[leg], axis=1)[:, None] - radii
    assert np.max(np.min(np.abs(off), axis=1)) <= 1e-12
    circles = (base[leg] + radii[:, None, None] * ring(AROUND)).reshape(-1, 2)
    other = np.linalg.norm(circles - base[1 - leg], axis=1)
    reached = circles[(other > radii[0]) & (other < radii[1])]
    assert farthest(reached, points, box(found)) <= STEP


@pytest.mark.soak
@pytest.mark.parametrize("name", FIVE)
def test_default_ranges_contain_all_that_the_five_bar_reaches(name):
    """It reaches farthest to the sides with one leg stretched, and up with both."""
    mech = FIVE[name]
    la, lb, half = float(mech.proximal), float(mech.distal), float(mech.half_base)
    reached = np.array([la + lb - half, np.sqrt((la + lb) ** 2 - half**2)])
    for line, far in zip(five(name).nodes, reached, strict=True):
        assert line[0] <= -far and line[-1] >= far


@pytest.mark.soak
@pytest.mark.parametrize("name", FIVE)
def test_type_two_of_the_five_bar_are_parallel_distal_links(name):
    """sin(alpha2 - alpha1) = 0: the elbows coincide, or are two distal links apart. Elbows from circles."""
    mech, found = FIVE[name], five(name)
    la, lb, base = float(mech.proximal), float(mech.distal), np.asarray(mech.base())
    points, q = points_of(found, TWO)
    u = screws(mech, points, q)[..., :2]
    assert np.max(np.abs(cross(u[:, 0], u[:, 1]))) <= 1e-10
    first = base[0] + la * ring(AROUND)
    to = base[1] - first
    apart = np.linalg.norm(to, axis=1)
    along = (apart**2 + (2 * lb) ** 2 - la**2) / (
        2 * apart
    )  # circle of 2 lb about elbow 1, of la about base 2
    high = (2 * lb) ** 2 - along**2
    expected = []
    for side in (1, -1):
        with np.errstate(invalid="ignore"):
            normal = side * np.sqrt(high / apart**2)[:, None] * np.stack([-to[:, 1], to[:, 0]], axis=1)
        second = first + (along / apart)[:, None] * to + normal
        expected.append(((first + second) / 2, first, second))
        together = np.array([0, side * np.sqrt(la**2 - float(mech.half_base) ** 2)])
        elbows = np.broadcast_to(together, first.shape)
        expected.append((together + lb * ring(AROUND), elbows, elbows))
    whole = np.concatenate([np.concatenate(each, axis=1) for each in expected])
    whole = whole[np.isfinite(whole).all(axis=1)]
    of_found = np.concatenate([points, *(base[i] + la * ring(q[:, i]) for i in (0, 1))], axis=1)
    assert farthest(whole, of_found, np.tile(box(found), 3)) <= 2 * STEP
    apart = np.linalg.norm(of_found[:, 2:4] - of_found[:, 4:], axis=1)
    assert np.max(np.minimum(apart, np.abs(apart - 2 * lb))) <= 1e-10


# ---------------------------------------------------------------- grids of determinants


def angles_of(mech, points, mode):
    """Driven angles that carry the tips there, NaN out of reach. -> (k, legs)"""
    to = points - np.asarray(mech.base)
    far = np.linalg.norm(to, axis=2)
    la, lb = np.asarray(mech.proximal), np.asarray(mech.distal)
    with np.errstate(invalid="ignore"):
        return np.arctan2(to[..., 1], to[..., 0]) - mode * np.arccos(
            (far**2 + la**2 - lb**2) / (2 * la * far)
        )


def tracks(found, mode):
    """Chords of the type II curves of a mode, cut in eight. -> (k, 2), (k, 2)"""
    for curve in found.of(TWO):
        wrapped = np.arange(len(curve.sigma) + curve.is_closed) % len(curve.sigma)
        track = curve.coordinates[wrapped]
        of_mode = np.full(len(track), True)
        if mode is not None:
            of_mode = np.all((curve.branch == mode) | (curve.branch == 0), axis=1)[wrapped]
        chords = np.flatnonzero(of_mode[1:] & of_mode[:-1])
        weights = np.linspace(0, 1, 9)[:, None, None]
        cut = (1 - weights) * track[chords] + weights * track[chords + 1]
        yield cut[:-1].reshape(-1, 2), cut[1:].reshape(-1, 2)


def compare_with_sign_changes(mech, found, mode=None, nodes=140):
    """Every sign change is near the locus. -> their number, and how often the locus crosses these edges"""
    lines = [np.linspace(line[0], line[-1], nodes) for line in found.nodes]
    pose = np.array(np.tile(found.at, (nodes**2, 1)))
    pose[:, [("x", "y", "phi").index(name) for name in found.axes]] = np.stack(
        np.meshgrid(*lines, indexing="ij"), axis=-1
    ).reshape(-1, 2)
    tips = planar(mech, pose, np.zeros(len(mech.base)))[0] + pose[:, None, :2]
    q = None if mode is None else angles_of(mech, tips, mode)
    with np.errstate(invalid="ignore"):
        det = np.linalg.det(screws(mech, pose, q)).reshape(nodes, nodes)
    points, size = points_of(found, TWO, mode)[0], box(found)
    first, cell = np.array([line[0] for line in lines]), np.array([line[1] - line[0] for line in lines])
    changes = crossings = 0
    for axis in (0, 1):  # that the edges are along
        along = np.moveaxis(det, axis, 0)
        is_change = along[:-1] * along[1:] < 0
        i, j = np.nonzero(is_change)
        middles = first[[axis, 1 - axis]] + cell[[axis, 1 - axis]] * np.stack([i + 0.5, j], axis=1)
        if len(i):
            assert farthest(middles[:, :: 1 - 2 * axis], points, size) <= 1 / (nodes - 1)
        changes += len(i)
        for start, end in tracks(found, mode):
            (i, j), (_, k) = (
                (np.floor((each - first) / cell).T)[[axis, 1 - axis]].astype(int) for each in (start, end)
            )
            crossed = (
                (j != k) & (i >= 0) & (i < nodes - 1) & (np.maximum(j, k) >= 0) & (np.maximum(j, k) < nodes)
            )
            crossings += np.sum(is_change[i[crossed], np.maximum(j, k)[crossed]])
    return changes, crossings


@pytest.mark.soak  # a good deal to compile; notebook 03 draws it
@pytest.mark.parametrize("phi", [0.0, 0.4])
@pytest.mark.parametrize("name", RRR)
def test_type_two_of_the_3_rrr_is_where_the_determinant_changes_sign(name, phi):
    mech, found = RRR[name], three_rrr(name, phi)
    is_lawful(mech, found)
    counts = np.array([compare_with_sign_changes(mech, found, mode) for mode in found.branches])
    assert counts.shape == (8, 2) and np.sum(counts[:, 0]) > 500
    np.testing.assert_allclose(counts[:, 1], counts[:, 0], rtol=0.1, atol=3)  # a curve found twice doubles it
    for curve in found.of(TWO):
        lines = screws(mech, curve.pose, curve.joints)
        assert np.max(np.linalg.svd(lines, compute_uv=False)[:, -1]) <= 1e-9


@pytest.mark.soak  # the 3-RRR is sought in the same way
@pytest.mark.parametrize("axes", [("x", "y"), ("x", "phi")])
def test_type_two_of_the_3_rpr_is_where_the_determinant_changes_sign(axes):
    found = sauer(axes)
    is_lawful(SAUER, found)
    changes, crossings = compare_with_sign_changes(SAUER, found)
    np.testing.assert_allclose(crossings, changes, rtol=0.05)


# ---------------------------------------------------------------- similar triangles: closed forms, tangency


def similar_radius(phi):
    """With base b_i and platform s b_i + o: singular where sin(phi) = 0 or |P + R o| = |R s - 1|."""
    return np.sqrt(1 + SMALLER**2 - 2 * SMALLER * np.cos(phi))


@pytest.mark.soak
def test_similar_triangles_are_singular_on_a_circle():
    found = pk.singularity_locus(SIMILAR, at=[0, 0, 0.9], nodes=41, kinds="II")
    is_lawful(SIMILAR, found)
    from_centre = found.curves[0].coordinates + OFFSET * ring(0.9)
    np.testing.assert_allclose(np.linalg.norm(from_centre, axis=1), similar_radius(0.9), rtol=1e-10)
    circle = similar_radius(0.9) * ring(AROUND) - OFFSET * ring(0.9)
    assert farthest(circle, points_of(found, TWO)[0], box(found)) <= STEP
    np.testing.assert_allclose(length_of(found), 2 * np.pi * similar_radius(0.9), rtol=0.02)  # and once


@pytest.mark.soak
def test_similar_triangles_unturned_are_singular_everywhere():
    found = pk.singularity_locus(SIMILAR, at=[0, 0, 0], nodes=41, kinds="II")
    assert [kind for kind, _ in found.everywhere] == [TWO] and not found.curves
    assert np.nanmax(found.sigma_direct) <= 1e-9


def top():
    """The slice y that only touches the circles' envelope, and where. -> y, x, phi"""
    best = minimize_scalar(
        lambda phi: OFFSET * np.sin(phi) - similar_radius(phi),
        bounds=(-3, -0.5),
        method="bounded",
        options={"xatol": 1e-12},
    )
    return -best.fun, -OFFSET * np.cos(best.x), best.x


@pytest.mark.parametrize(("inwards", "radius"), [(0.0, 1e-4), (1e-4, 0.02), (-1e-3, None)])
def test_a_slice_that_touches_the_locus(inwards, radius):
    """The determinant changes no sign at a point of tangency, nor between the nodes about a small oval."""
    y, x, phi = top()
    ranges = ((x - 1, x + 1), (phi - 0.5, phi + 0.55))
    found = pk.singularity_locus(
        SIMILAR, ("x", "phi"), at=[0, y - inwards, 0], ranges=ranges, nodes=41, kinds="II"
    )
    assert not found.everywhere
    if radius is None:
        assert not found.curves
        return
    points = points_of(found, TWO)[0]
    assert np.max(np.abs(points - [x, phi])) <= radius
    size = np.hypot(points[:, 0] + OFFSET * np.cos(points[:, 1]), y - inwards + OFFSET * np.sin(points[:, 1]))
    np.testing.assert_allclose(size, similar_radius(points[:, 1]), rtol=0, atol=1e-9)


def test_curves_that_cross_are_found_on_both_sides():
    """phi = 0 crosses the circles' surface."""
    found = pk.singularity_locus(
        SIMILAR, ("x", "phi"), at=[0, 0.3, 0], ranges=((-2.5, 1.5), (-1.0, 1.1)), nodes=41, kinds="II"
    )
    phi = np.linspace(-1, 1.1, 300)
    with np.errstate(invalid="ignore"):
        half = np.sqrt(similar_radius(phi) ** 2 - (0.3 + OFFSET * np.sin(phi)) ** 2)
    expected = [np.stack([-OFFSET * np.cos(phi) + side * half, phi], axis=1) for side in (1, -1)]
    expected = np.concatenate([*expected, np.stack([np.linspace(-2.5, 1.5, 300), 0 * phi], axis=1)])
    expected = inside(expected[np.isfinite(expected).all(axis=1)], found)
    points = points_of(found, TWO)[0]
    assert farthest(expected, points, box(found)) <= STEP
    size = np.hypot(points[:, 0] + OFFSET * np.cos(points[:, 1]), 0.3 + OFFSET * np.sin(points[:, 1]))
    off = np.minimum(np.abs(points[:, 1]), np.abs(size - similar_radius(points[:, 1])))
    assert np.max(off) <= 1e-9


@pytest.mark.soak
def test_a_coaxial_five_bar_is_singular_everywhere_with_equal_elbows():
    found = pk.singularity_locus(pk.FiveBar(half_base=0.0, proximal=0.3, distal=0.2), nodes=41)
    modes = {tuple(int(sign) for sign in mode) for kind, mode in found.everywhere if kind == TWO}
    assert modes == {(1, 1), (-1, -1)} and len(found.everywhere) == 2


# ---------------------------------------------------------------- redundant robots


@cache
def four(nodes):
    return pk.singularity_locus(
        FOUR, ("x", "y", "phi"), kinds="II", branch=[1, 1, 1, 1], ranges=FOUR_BOX, nodes=nodes
    )


def four_is_lawful(found):
    is_lawful(FOUR, found)
    for curve in found.curves:
        lines = screws(FOUR, curve.pose, curve.joints)
        sigma = np.linalg.svd(lines, compute_uv=False)
        assert np.max(sigma[:, -1]) <= 1e-10 and np.min(sigma[:, -2]) > 1e-3
        null = np.linalg.svd(lines)[2][:, -1]  # the lines meet in one point, or at infinity: a pencil
        assert np.max(np.abs(np.einsum("kij,kj->ki", lines, null))) <= 1e-10


FOUR_BOX = ((-0.31, 0.31), (-0.31, 0.31), (-np.pi, np.pi))


@pytest.mark.soak  # notebook 03 draws them, too
def test_type_two_of_the_4_rrr_are_curves():
    found = four(25)
    four_is_lawful(found)
    assert sum(len(curve.sigma) > 1 for curve in found.curves) >= 2
    total = lambda found: sum(
        np.sum(np.linalg.norm(np.diff(c.coordinates / box(found), axis=0), axis=1)) for c in found.curves
    )
    np.testing.assert_allclose(total(four(33)), total(found), rtol=0.01)


@pytest.mark.soak
def test_type_two_of_the_4_rrr_in_a_plane_are_points():
    longest = max(four(25).curves, key=lambda curve: len(curve.sigma))
    k = len(longest.sigma) // 2
    found = pk.singularity_locus(
        FOUR, at=longest.pose[k], kinds="II", branch=[1, 1, 1, 1], ranges=FOUR_BOX[:2], nodes=41
    )
    four_is_lawful(found)
    assert all(len(curve.sigma) == 1 for curve in found.curves)
    points = points_of(found, TWO)[0]
    np.testing.assert_allclose(
        np.min(np.linalg.norm(points - longest.coordinates[k, :2], axis=1)), 0, atol=1e-8
    )
    curves = points_of(four(25), TWO)[0]
    assert farthest(np.insert(points, 2, longest.coordinates[k, 2], axis=1), curves, box(four(25))) <= STEP


def test_three_axes_are_for_redundant_robots():
    said = said_by(pk.singularity_locus, RRR["regular"], ("x", "y", "phi"))
    assert said.startswith("axes must be two") and "PlanarRRR" in said


@pytest.mark.soak
def test_the_six_link_has_only_the_circles_of_its_arms():
    mech = pk.catalogued("6-link")
    found = pk.singularity_locus(mech, nodes=25)
    assert not found.of(TWO) and not found.everywhere and found.of(ONE)
    base, platform = np.asarray(mech.base), np.asarray(mech.platform)
    sums = np.asarray(mech.proximal + mech.distal)
    points = points_of(found, ONE)[0]
    off = np.linalg.norm(points[:, None] + platform - base, axis=2) - sums  # folded, equal links are a point
    folded = np.linalg.norm(points[:, None] + platform - base, axis=2)
    assert np.max(np.min(np.minimum(np.abs(off), folded), axis=1)) <= 1e-10
    for arm in (0, 1):
        circle = base[arm] - platform[arm] + sums * ring(AROUND)
        reached = circle[np.linalg.norm(circle + platform[1 - arm] - base[1 - arm], axis=1) < sums]
        assert farthest(reached, points, box(found)) <= STEP


# ---------------------------------------------------------------- in space


@pytest.mark.soak
@pytest.mark.parametrize("sensors", [0, 3])
def test_yaw_of_90_degrees_of_a_semi_regular_platform(sensors):
    """Fichter: six legs; more rows are sensors and carry nothing."""
    semi = pk.catalogued("semi-regular-stewart")
    more = np.pad(np.random.default_rng(8).uniform(-1, 1, (sensors, 2)), ((0, 0), (0, 1)))
    mech = pk.Stewart(
        base=np.concatenate([semi.base, more]), platform=np.concatenate([semi.platform, more / 3])
    )
    found = pk.singularity_locus(mech, ("rx", "rz"), ranges=((-0.3, 0.3), (1.2, 1.9)), nodes=7, kinds="II")
    (curve,) = found.curves
    turn, arms = np.asarray(curve.pose.rotation), np.einsum("kij,lj->kli", curve.pose.rotation, semi.platform)
    legs = np.asarray(curve.pose.translation)[:, None] + arms - semi.base
    lines = np.concatenate([legs, np.cross(arms, legs) / 0.45], axis=2)
    assert np.max(np.linalg.svd(lines, compute_uv=False)[:, -1]) <= 1e-10
    # between two neighbours, as a parabola through the nearest three
    near = np.argsort(np.abs(curve.coordinates[:, 0]))[:3]
    rx, rz = curve.coordinates[near].T
    np.testing.assert_allclose(np.polyval(np.polyfit(rx, rz, 2), 0), np.pi / 2, rtol=0, atol=1e-5)
    assert np.all(np.abs(np.diff(curve.coordinates[[0, -1], 0])) > 0.6 - 0.01) and len(turn) > 20


@pytest.mark.soak
def test_type_one_of_a_mechanism_without_a_closed_form():
    """An arm of the Delta is stretched or folded in line with its rod, seen along its axis."""
    mech = delta()
    found = pk.singularity_locus(mech, ("x", "z"), ranges=((-0.2, 0.2), (-1.2, -0.9)), nodes=7, kinds="I")
    assert found.branches.shape == (1, 0) and found.curves
    for curve in found.curves:
        x, z = curve.coordinates.T
        turns = np.deg2rad([0, 120, 240])
        out = x[:, None] * np.cos(turns) + 0.05 - 0.2
        across = x[:, None] * np.sin(turns)
        rod = np.sqrt(0.8**2 - across**2)
        distance = np.hypot(out, z[:, None])
        off = np.minimum(np.abs(distance - (rod + 0.35)), np.abs(distance - (rod - 0.35)))
        assert np.max(np.min(off, axis=1)) <= 1e-10


# ---------------------------------------------------------------- what a user asks for


def test_one_working_mode_is_its_part_of_the_whole():
    mech, whole = FIVE["long distal"], five("long distal")
    for mode in ((1, -1), (-1, -1)):
        part = pk.singularity_locus(mech, branch=mode, nodes=41)
        np.testing.assert_array_equal(part.branches, [mode])
        for kind in (ONE, TWO):
            for curve in part.of(kind):
                assert np.all((curve.branch == mode) | (curve.branch == 0))
            ours, all_of_mode = points_of(part, kind)[0], points_of(whole, kind, mode)[0]
            assert farthest(ours, all_of_mode, box(whole)) <= STEP
            assert farthest(all_of_mode, ours, box(whole)) <= STEP


def test_ranges_nodes_kinds_and_report_are_honoured():
    mech, whole = FIVE["long distal"], five("long distal")
    said = []
    ranges = ((-0.1, 0.25), (0.05, 0.4))
    part = pk.singularity_locus(
        mech, ("x", "y"), ranges=ranges, nodes=33, kinds=("II",), report=lambda *what: said.append(what)
    )
    assert part.axes == ("x", "y") and part.units == (1, 1) and not part.of(ONE) and part.of(TWO)
    for line, (lower, upper) in zip(part.nodes, ranges, strict=True):
        np.testing.assert_allclose(line, np.linspace(lower, upper, 33), rtol=1e-14)
    assert part.sigma_direct.shape == part.sigma_inverse.shape == (4, 33, 33)
    assert said and all(len(what) == 3 for what in said)
    points = points_of(part, TWO)[0]
    assert farthest(inside(points_of(whole, TWO)[0], part), points, box(whole)) <= STEP
    is_beyond = np.any((points < np.array(ranges)[:, 0]) | (points > np.array(ranges)[:, 1]), axis=1)
    ends = np.concatenate([c.coordinates[[0, -1]] for c in part.of(TWO) if not c.is_closed])
    assert len(ends) and all(np.any(np.all(point == ends, axis=1)) for point in points[is_beyond])


BAD = {
    "unknown axis": (dict(axes=("x", "w")), "axes"),
    "one axis": (dict(axes=("x",)), "axes"),
    "equal axes": (dict(axes=("x", "x")), "axes"),
    "ranges reversed": (dict(ranges=((1, 0), (0, 1))), "ranges"),
    "ranges of NaN": (dict(ranges=((0, np.nan), (0, 1))), "ranges"),
    "ranges of one axis": (dict(ranges=((0, 1),)), "ranges"),
    "one node": (dict(nodes=1), "nodes"),
    "half a node": (dict(nodes=2.5), "nodes"),
    "type III": (dict(kinds=("III",)), "kinds"),
    "no kind": (dict(kinds=()), "kinds"),
    "at a batch": (dict(at=np.zeros((2, 3))), "at"),
    "at NaN": (dict(at=[0, 0, np.nan]), "at"),
    "branch of zeros": (dict(branch=[1, 0, 1]), "branch"),
    "many branches": (dict(branch=np.ones((2, 3))), "branch"),
    "length of zero": (dict(length=0.0), "length"),
    "length of NaN": (dict(length=np.nan), "length"),
    "lengths": (dict(length=[1.0, 2.0]), "length"),
}


@pytest.mark.parametrize(("asked", "named"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_told_by_name(asked, named):
    assert said_by(pk.singularity_locus, RRR["regular"], **asked).startswith(f"{named} must ")


def test_traced_mechanisms_and_other_things_are_refused():
    locus = lambda mech: pk.singularity_locus(mech).sigma_direct
    assert "known values" in said_by(jax.jit(locus), RRR["regular"])
    with pytest.raises((TypeError, ValueError), match="singularity_locus"):
        pk.singularity_locus("3-rrr")


# ---------------------------------------------------------------- what does not matter


@pytest.mark.soak
def test_where_the_whole_stands_does_not_matter():
    mech, turn, shift = RRR["asymmetric"], 0.7, np.array([0.3, -0.2])
    matrix = ring(turn + np.array([0, np.pi / 2])).T
    moved = pk.PlanarRRR(
        base=mech.base @ matrix.T + shift, platform=mech.platform, proximal=mech.proximal, distal=mech.distal
    )
    found = pk.singularity_locus(moved, at=[*shift, 0.4 + turn], kinds="II", nodes=41)
    for mode in found.branches:
        one, other = points_of(three_rrr("asymmetric", 0.4), TWO, mode)[0], points_of(found, TWO, mode)[0]
        assert farthest(one @ matrix.T + shift, other, box(found)) <= STEP
        assert farthest(other, one @ matrix.T + shift, box(found)) <= STEP


def test_the_unit_of_length_does_not_matter():
    found = five("long distal")
    large = pk.FiveBar(half_base=100.0, proximal=200.0, distal=250.0)
    scaled = pk.singularity_locus(large, nodes=41)
    np.testing.assert_allclose(box(scaled), 1000 * box(found), rtol=1e-12)
    for kind in (ONE, TWO):
        # polygons of other corners: a rounding tells them where to begin
        np.testing.assert_allclose(length_of(scaled, kind), 1000 * length_of(found, kind), rtol=5e-3)
        one, other = 1000 * points_of(found, kind)[0], points_of(scaled, kind)[0]
        assert max(farthest(one, other, box(scaled)), farthest(other, one, box(scaled))) <= STEP
