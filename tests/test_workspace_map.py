"""Maps of the workspace, travels and the redundant joint, against plain loops and dense scans."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import outsiders
import pytest
from refusals import said_by
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.geometry.poses import retract

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

NAN = np.nan
ROWS = 8
CASING = pk.CasingOscillator()
LOW, HIGH = 0.6675, 0.7922  # the stroke of its carriage
SEMI = pk.catalogued("semi-regular-stewart")


def euler(angles):
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    return Rotation.from_euler("xyz", angles).as_matrix()


@cache
def stewart():
    """Strokes of +-8 % and cones about the legs at home."""
    pose, lengths = jax.tree.map(np.asarray, SEMI.home())
    legs = (pose.translation + np.asarray(SEMI.platform) @ pose.rotation.T - SEMI.base) / lengths[:, None]
    return pk.Stewart(
        base=SEMI.base,
        platform=SEMI.platform,
        stroke=np.stack([0.92 * lengths, 1.08 * lengths], axis=1),
        base_cone=0.25,
        platform_cone=0.3,
        cone_axes=[legs, -legs @ pose.rotation],
    )


def rpr():
    return pk.PlanarRPR(
        base=[[0.0, 0.0], [1.2, 0.1], [0.4, 1.1]],
        platform=[[-0.2, -0.15], [0.25, -0.1], [0.02, 0.3]],
        stroke=[[0.3, 0.9], [0.4, 1.0], [0.2, 0.95]],
    )


# ---------------------------------------------------------------- a plain loop

margins_at = jax.jit(lambda mech, pose, joints: mech.margins(pose, joints))


def names_of(mech):
    """In the mechanism's own order, which jit would sort."""
    return {name: np.size(row) for name, row in mech.margins(*mech.home()).items()}


def looped(mech, poses, **given):
    """All margins of every pose (rows, margins), NaN out of reach, and their names; one pose at a time."""
    sizes = names_of(mech)
    rows = []
    for pose in poses:
        joints = pk.inverse_kinematics(mech, pose, **given).candidate
        found = margins_at(mech, pose, joints)
        row = np.concatenate([np.ravel(found[name]) for name in sizes])
        rows.append(row if np.all(np.isfinite(joints)) else np.full(len(row), NAN))
    return np.array(rows), [
        f"{name}[{k}]" if count > 1 else name for name, count in sizes.items() for k in range(count)
    ]


def nodes_of(found):
    """The grid's values of its axes, one row a node. -> (nodes, d)"""
    return np.stack(np.meshgrid(*found.nodes, indexing="ij"), axis=-1).reshape(-1, len(found.nodes))


def casing_at(axes, values, start=(0.48, 0, 0, 0)):
    at = np.array(start, float)
    at[[["s", "roll", "pitch", "yaw"].index(axis) for axis in axes]] = values
    return pk.AxisPose(at[0], euler(at[1:]))


LEANING = Rotation.from_rotvec([0.05, -0.03, 0.1]).as_matrix()


def stewart_at(axes, values):
    """x moves the platform, rz turns it about an axis of the base, counted from the leaning pose."""
    home = np.asarray(stewart().home()[0].translation)
    assert axes == ("x", "rz")
    return pk.SE3([values[0], *home[1:]], Rotation.from_rotvec([0, 0, values[1]]).as_matrix() @ LEANING)


def planar_at(axes, values):
    at = dict(zip(("x", "y", "phi"), RPR_AT, strict=True)) | dict(zip(axes, values, strict=True))
    return np.array(list(at.values()))


RPR_AT = (0.5, 0.4, 0.1)
MAPS = {
    "casing": (lambda: CASING, ("roll", "pitch"), casing_at, {}, ((-0.4, 0.4), (-0.3, 0.2))),
    "casing, carriage": (lambda: CASING, ("yaw", "s"), casing_at, {"free": 0.7}, ((-0.4, 0.3), (0.4, 0.6))),
    "stewart": (stewart, ("x", "rz"), stewart_at, {}, ((-0.1, 0.15), (-0.3, 0.4))),
    "3-rpr": (rpr, ("x", "phi"), planar_at, {}, ((0.0, 1.0), (-1.0, 1.0))),
    "2-rpr": (
        lambda: pk.catalogued("nam-2-rpr"),
        ("y", "x"),
        lambda axes, values: np.asarray(values)[::-1],
        {},
        ((-0.5, 3.0), (-2.0, 2.0)),
    ),
    "5-link": (
        lambda: pk.catalogued("5-link"),
        ("x", "y"),
        lambda axes, values: np.asarray(values),
        {"branch": [1, 1]},
        ((-0.6, 0.6), (-0.6, 0.6)),
    ),
}


def given_at(name):
    """The pose that has the other coordinates."""
    if name == "stewart":
        return pk.SE3(stewart().home()[0].translation, LEANING)
    return np.array(RPR_AT) if name == "3-rpr" else None


@cache
def mapped(name):
    make, axes, _, given, ranges = MAPS[name]
    return pk.workspace_map(make(), axes, at=given_at(name), ranges=ranges, nodes=(7, 6), **given)


SLOW = {"stewart", "3-rpr"}  # to compile


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.soak] * (n in SLOW)) for n in MAPS])
def test_a_map_is_a_plain_loop(name):
    """The smallest margin at every node, and which it is."""
    make, axes, pose_at, given, ranges = MAPS[name]
    found = mapped(name)
    assert found.axes == axes and found.margin.shape == found.limit.shape == (7, 6)
    for line, ends, count in zip(found.nodes, ranges, (7, 6), strict=True):
        np.testing.assert_allclose(line, np.linspace(*ends, count), rtol=0, atol=1e-15)
    every, names = looped(make(), [pose_at(axes, row) for row in nodes_of(found)], **given)
    assert list(found.names) == names
    least = np.min(every, axis=1)  # NaN stays NaN
    np.testing.assert_allclose(found.margin.ravel(), least, rtol=0, atol=1e-12)
    limit, is_there = found.limit.ravel(), np.isfinite(least)
    np.testing.assert_array_equal(limit == -1, ~is_there)
    at_limit = every[np.arange(len(every)), limit]
    np.testing.assert_allclose(at_limit[is_there], least[is_there], rtol=0, atol=1e-12)
    apart = np.sort(every, axis=1)[:, 1] - least > 1e-9  # no two are least
    np.testing.assert_array_equal(limit[apart], np.argmin(every, axis=1)[apart])
    assert len(set(limit[is_there])) >= 2
    np.testing.assert_array_equal(found.is_inside.ravel(), least >= 0)
    assert found.is_inside.dtype == bool and 0 < np.mean(found.is_inside) < 1


@pytest.mark.soak
def test_units_and_the_pose_that_has_the_other_coordinates_come_along():
    assert mapped("casing").units == (0, 0) and mapped("casing, carriage").units == (0, 1)
    assert mapped("stewart").units == (1, 0) and mapped("2-rpr").units == (1, 1)
    np.testing.assert_array_equal(mapped("stewart").at.rotation, LEANING)
    np.testing.assert_array_equal(mapped("3-rpr").at, RPR_AT)
    assert mapped("casing").at.s == 0.48


def test_out_of_reach_is_nan_and_not_inside():
    found = mapped("5-link")
    mech = pk.catalogued("5-link")
    half, reach = float(mech.half_base), float(mech.proximal + mech.distal)
    x, y = np.meshgrid(*found.nodes, indexing="ij")
    far = np.maximum(np.hypot(x - half, y), np.hypot(x + half, y)) > reach
    assert np.all(np.isnan(found.margin[far])) and np.any(far)
    assert np.all(found.limit[np.isnan(found.margin)] == -1) and not np.any(found.is_inside[far])


def test_three_axes_make_a_box():
    axes = ("s", "roll", "pitch")
    ranges = ((0.42, 0.54), (-0.2, 0.25), (-0.1, 0.1))
    found = pk.workspace_map(CASING, axes, ranges=ranges, nodes=4)
    assert found.margin.shape == found.is_inside.shape == (4, 4, 4) and found.units == (1, 0, 0)
    every, _ = looped(CASING, [casing_at(axes, row) for row in nodes_of(found)])
    np.testing.assert_allclose(found.margin.ravel(), np.min(every, axis=1), rtol=0, atol=1e-12)


def test_by_default_a_map_is_of_the_first_two_coordinates_and_all_that_is_reached():
    """201 nodes each way over the two-legged robot: strokes and the side, by hand."""
    mech = pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0)
    found = pk.workspace_map(mech)
    assert found.axes == ("x", "y") and found.margin.shape == (201, 201)
    x, y = np.meshgrid(*found.nodes, indexing="ij")
    legs = np.stack([np.hypot(x - 1, y), np.hypot(x + 1, y)])
    expected = np.minimum(np.min(np.minimum(legs - 1, 3 - legs), axis=0), y)
    np.testing.assert_allclose(found.margin, expected, rtol=0, atol=1e-13)
    assert found.is_inside.any() and not found.is_inside[[0, -1]].any() and not found.is_inside[:, 0].any()
    named = pk.workspace_map(mech, "y,x", ranges=((0, 1), (0, 2)), nodes=3)
    assert named.axes == ("y", "x") and named.margin.shape == (3, 3)
    assert pk.workspace_map(CASING, ("s", "roll", "yaw"), ranges=[(0, 1)] * 3).margin.shape == (41, 41, 41)


# ---------------------------------------------------------------- the carriage where it is best


@jax.jit
def scanned(mech, pose, carriages):
    """All margins at every carriage. -> (carriages, margins)"""

    def at(carriage):
        joints = mech.inverse(pose, free=carriage)
        return jnp.concatenate([jnp.ravel(row) for row in mech.margins(pose, joints).values()])

    return jax.vmap(at)(carriages)


@jax.jit
def conditions(mech, pose, carriages):
    """Least over greatest singular value of A, lengths over length(), rows of unit norm. -> (carriages,)"""

    def at(carriage):
        a = pk.pose_jacobian(mech, pose, mech.inverse(pose, free=carriage))
        a = a * jnp.array([mech.platform_radius, 1, 1, 1])
        sigma = jnp.linalg.svd(a / jnp.linalg.norm(a, axis=1, keepdims=True), compute_uv=False)
        return sigma[-1] / sigma[0]

    return jax.vmap(at)(carriages)


def best_of(values_at, low=LOW, high=HIGH):
    """Greatest value over the stroke, and where: a dense scan, and a search about the best of it."""
    grid = np.linspace(low, high, 2001)
    values = values_at(grid)
    k = int(np.argmax(values))
    ends = grid[max(k - 1, 0)], grid[min(k + 1, 2000)]
    # 2001 again, so that no other size is compiled
    for _ in range(3):
        fine = np.linspace(*ends, 2001)
        inner = values_at(fine)
        j = int(np.argmax(inner))
        ends = fine[max(j - 1, 0)], fine[min(j + 1, 2000)]
    return (inner[j], fine[j]) if inner[j] >= values[k] else (values[k], grid[k])


def best_margin(pose, mech=CASING):
    stroke = np.asarray(mech.stroke)[4]
    return best_of(lambda e: np.min(scanned(mech, pose, e), axis=1), *stroke)


def test_with_any_carriage_a_map_has_the_best_margin():
    """A dense scan of the stroke at every node; never below it, and what any one carriage reaches is in."""
    axes, ranges = ("roll", "pitch"), ((-0.4, 0.4), (-0.35, 0.3))
    found = pk.workspace_map(CASING, axes, ranges=ranges, nodes=(7, 6), free="any")
    expected = [best_margin(casing_at(axes, row))[0] for row in nodes_of(found)]
    off = found.margin.ravel() - expected
    assert np.all(off >= -1e-12) and np.all(off <= 1e-6)
    fixed = pk.workspace_map(CASING, axes, ranges=ranges, nodes=(7, 6))
    assert np.all(found.margin >= fixed.margin - 1e-12)
    assert np.sum(found.is_inside) > np.sum(fixed.is_inside)
    assert found.names == fixed.names


def test_free_is_a_number_in_any_form():
    """A carriage of its own: shifted, the neutral one is but one of them."""
    look = partial(
        pk.workspace_map, CASING, ("roll", "pitch"), ranges=((-0.4, 0.4), (-0.3, 0.2)), nodes=(7, 6)
    )
    np.testing.assert_array_equal(look(free=0.7).margin, look(free=[0.7]).margin)
    np.testing.assert_allclose(look(free=0.73).margin, mapped("casing").margin, rtol=0, atol=1e-14)
    assert np.max(np.abs(look(free=0.7).margin - mapped("casing").margin)) > 0.01


# ---------------------------------------------------------------- travel


def test_ends_of_travel_by_hand():
    """Straight up at x = 1/2: leg 1 is too short below sqrt(3)/2, leg 2 too long above sqrt(27)/2."""
    mech = pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0)
    found = pk.travel(mech, "y", at=[0.5, 1.5])
    np.testing.assert_allclose([found.lower, found.upper], [np.sqrt(3) / 2, np.sqrt(27) / 2], rtol=1e-14)
    assert (found.limit_lower, found.limit_upper) == ("stroke_min[0]", "stroke_max[1]")
    low = pk.TwoRPR(half_base=1.0, l_min=0.1, l_max=3.0)
    found = pk.travel(low, "y", at=[0.5, 1.5])
    assert found.limit_lower == "side" and abs(found.lower) < 1e-14
    home = pk.travel(mech, "x")  # about home, l = 2
    np.testing.assert_allclose(
        np.asarray([home.lower, home.upper]), [1 - np.sqrt(6), np.sqrt(6) - 1], rtol=1e-14
    )


STARTS = np.array(
    [
        [0.48, 0.0, 0.0, 0.0],
        [0.45, 0.05, -0.03, 0.02],
        [0.5, -0.1, 0.02, 0.03],
        [0.48, 0.0, 1.0, 0.0],  # outside
        [0.52, 0.03, 0.01, -0.1],
        [NAN, 0.0, 0.0, 0.0],
    ]
)


@cache
def travelled(coordinate):
    at = pk.AxisPose(STARTS[:, 0], euler(STARTS[:, 1:]))
    return at, pk.travel(CASING, coordinate, at=at)


@pytest.mark.parametrize("coordinate", ["s", "roll"])
def test_travels_of_a_batch_are_those_of_a_loop(coordinate):
    at, many = travelled(coordinate)
    assert many.lower.shape == many.upper.shape == (len(STARTS),)
    for k in range(len(STARTS)):
        one = pk.travel(CASING, coordinate, at=at[k])
        np.testing.assert_allclose([one.lower, one.upper], [many.lower[k], many.upper[k]], rtol=0, atol=1e-15)
        assert (one.limit_lower, one.limit_upper) == (many.limit_lower[k], many.limit_upper[k])


@pytest.mark.parametrize("coordinate", ["s", "roll"])
def test_ends_of_travel_are_exact(coordinate):
    """A billionth of it inside there is margin, beyond there is none, and the named one is the least."""
    _, many = travelled(coordinate)
    axis = ["s", "roll"].index(coordinate)
    is_outside = np.isin(np.arange(len(STARTS)), [3, 5])
    np.testing.assert_array_equal(np.isnan(many.lower), is_outside)
    np.testing.assert_array_equal(np.isnan(many.upper), is_outside)
    for k in np.flatnonzero(~is_outside):
        assert many.lower[k] < STARTS[k, axis] < many.upper[k]
        for end, way, limit in (
            (many.lower[k], -1, many.limit_lower[k]),
            (many.upper[k], 1, many.limit_upper[k]),
        ):
            beside = []
            for step in (-1e-9, 1e-9):
                row = STARTS[k].copy()
                row[axis] = end + way * step
                beside.append(pk.AxisPose(row[0], euler(row[1:])))
            every, names = looped(CASING, beside)
            assert np.min(every[0]) >= 0 > np.min(every[1])
            assert every[1][names.index(limit)] < 0
    assert [many.limit_lower[k] for k in (3, 5)] == [many.limit_upper[k] for k in (3, 5)] == [""] * 2


def test_travel_looks_no_farther_than_it_is_told():
    wide = dataclasses.replace(CASING, stroke=np.tile([0.01, 10.0], (5, 1)), base_cone=3.0, platform_cone=3.0)
    found = pk.travel(wide, "roll", at=casing_at(["roll"], [0.1]), most=0.25)
    np.testing.assert_allclose([found.lower, found.upper], [-0.15, 0.35], rtol=0, atol=1e-15)
    assert found.limit_lower == found.limit_upper == ""
    one_side = pk.travel(CASING, "pitch", most=np.deg2rad(5.9))  # -5.953 and 5.884 degrees are the ends
    assert one_side.limit_lower == "" and one_side.limit_upper != ""
    assert one_side.lower == -np.deg2rad(5.9) and abs(np.rad2deg(one_side.upper) - 5.884) < 0.01


def test_turns_of_a_platform_in_space_are_counted_from_where_it_is():
    """About an axis of the base, by a root of the margins."""
    mech = stewart()
    start = pk.SE3(mech.home()[0].translation, LEANING)
    found = pk.travel(mech, "rz", at=start)

    assert -1 < found.lower < -0.02 and 0.02 < found.upper < 1
    ends = np.array([found.lower, found.upper])
    turned = lambda angle: Rotation.from_rotvec([0, 0, angle]).as_matrix() @ LEANING
    for angles, is_inside in ((ends * (1 - 1e-9), True), (ends * (1 + 1e-9), False)):
        every, names = looped(mech, [pk.SE3(start.translation, turned(angle)) for angle in angles])
        np.testing.assert_array_equal(np.min(every, axis=1) >= 0, is_inside)
    limits = np.array(names)[np.argmin(every, axis=1)]
    np.testing.assert_array_equal([found.limit_lower, found.limit_upper], limits)


def test_travels_with_any_carriage():
    """No carriage reaches beyond; the farthest of all heights is what optimization found, to 0.01 degrees."""
    heights = np.append(
        0.48, np.concatenate([np.linspace(0.4175, 0.41753, 4), np.linspace(0.5424, 0.5425, 5)])
    )
    found = pk.travel(CASING, "pitch", at=pk.AxisPose.from_angles(heights), free="any", most=0.4, steps=40)
    farthest = np.rad2deg([np.nanmin(found.lower), np.nanmax(found.upper)])
    np.testing.assert_allclose(farthest, [-17.847, 14.099], rtol=0, atol=0.01)
    for row in (0, 3, 6):
        for end in (found.lower[row], found.upper[row]):
            at = lambda pitch, row=row: casing_at(["s", "pitch"], [heights[row], pitch])
            assert best_margin(at(end * (1 - 1e-6)))[0] >= 0 > best_margin(at(end * (1 + 1e-6)))[0]


# ---------------------------------------------------------------- the redundant joint


def poses_near(seed, wide=0.15):
    rng = np.random.default_rng(seed)
    return pk.AxisPose(rng.uniform(0.43, 0.53, ROWS), euler(rng.uniform(-wide, wide, (ROWS, 3))))


SHARP = (0, 1, 5, 6)  # rows whose best carriage is between the ends, and one


LONG = 2.0  # so much longer the carriage's rail has a best conditioning between its ends
LONGER = dataclasses.replace(CASING, stroke=np.asarray(CASING.stroke) + LONG * np.eye(10)[9].reshape(5, 2))


@cache
def resolved(by, seed=1, wide=0.15, mech=CASING):
    pose = poses_near(seed, wide)
    return pose, pk.resolve_redundancy(mech, pose, by=by)


@pytest.mark.soak
def test_the_carriage_with_the_most_margin_is_that_of_a_scan():
    """The value always, and the carriage where it is but one: legs 2 and 3 do not see it."""
    pose, found = resolved("margin")
    assert found.free.shape == (ROWS, 1) and found.joints.shape == (ROWS, 5) and found.value.shape == (ROWS,)
    assert np.all(np.asarray(found.status) == pk.Status.OK)
    for k in range(ROWS):
        value, at = best_margin(pose[k])
        assert abs(found.value[k] - value) < 1e-12
        solved = minimize_scalar(
            lambda e, k=k: -np.min(scanned(CASING, pose[k], np.full(2001, e))[0]),
            bounds=(LOW, HIGH),
            method="bounded",
            options={"xatol": 1e-10},
        )
        assert found.value[k] >= -solved.fun - 1e-12
        if k in SHARP:
            assert abs(found.free[k, 0] - at) < 1e-9 and abs(found.free[k, 0] - solved.x) < 1e-6
        mine = scanned(CASING, pose[k], np.full(2001, found.free[k, 0]))[0]
        assert abs(np.min(mine) - value) < 1e-12
    expected = pk.inverse_kinematics(CASING, pose, free=found.free).joints
    np.testing.assert_allclose(found.joints, expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.joints[:, 4], found.free[:, 0])
    assert np.any(found.value > 0) and np.any(found.value < 0)


AT_AN_END = pytest.param(CASING, id="at an end", marks=pytest.mark.soak)


@pytest.mark.parametrize("mech", [AT_AN_END, pytest.param(LONGER, id="between")])
def test_the_carriage_of_the_best_conditioning_is_that_of_a_scan(mech):
    """Of equations without units."""
    pose, found = resolved("conditioning", 3, 0.5, mech)
    low, high = np.asarray(mech.stroke)[4]
    assert np.all(np.asarray(found.status) == pk.Status.OK)
    for k in range(ROWS):
        value, at = best_of(lambda e, k=k: np.asarray(conditions(mech, pose[k], e)), low, high)
        assert abs(found.value[k] - value) < 1e-12 and abs(found.free[k, 0] - at) < 1e-5
    is_end = np.isin(np.asarray(found.free[:, 0]), [low, high])
    assert np.all(is_end) if mech is CASING else np.sum(~is_end) >= 2


@pytest.mark.soak
def test_a_batch_is_a_loop():
    pose, many = resolved("margin")
    for k in range(0, ROWS, 3):
        one = pk.resolve_redundancy(CASING, pose[k])
        assert one.free.shape == (1,) and one.value.shape == () and one.status == pk.Status.OK
        for got, whole in zip(one[:3], many[:3], strict=True):
            np.testing.assert_allclose(got, whole[k], rtol=0, atol=1e-13)


def test_in_the_middle_the_carriage_stays_where_it_is():
    """Whatever the pose: halfway of its stroke, and the value is the smallest margin there."""
    pose = resolved("margin")[0]
    found = pk.resolve_redundancy(CASING, pose, by="middle")
    np.testing.assert_allclose(found.free, np.full((ROWS, 1), (LOW + HIGH) / 2), rtol=0, atol=1e-15)
    every, _ = looped(CASING, [pose[k] for k in range(ROWS)], free=(LOW + HIGH) / 2)
    np.testing.assert_allclose(found.value, np.min(every, axis=1), rtol=0, atol=1e-13)
    expected = pk.inverse_kinematics(CASING, pose, free=found.free).joints
    np.testing.assert_allclose(found.joints, expected, rtol=0, atol=1e-15)


def best(x, pose, by):
    """Carriage and value of moved poses of a changed machine: x is twist (4,), radii (2,), stroke (10,)."""
    mech = dataclasses.replace(
        CASING,
        base_radius=CASING.base_radius + x[4],
        platform_radius=CASING.platform_radius + x[5],
        stroke=CASING.stroke + x[6:].reshape(5, 2),
    )
    found = pk.resolve_redundancy(mech, retract(pose, x[:4]), by=by)
    return jnp.append(found.free, found.value)


@partial(jax.jit, static_argnums=2)
@partial(jax.vmap, in_axes=(0, None, None))
def rates(x, pose, by):
    """Derivatives (2, 16), and carriage and value (2,)."""

    def both(x):
        found = best(x, pose, by)
        return found, found

    return jax.jacfwd(both, has_aux=True)(x)


def derivatives(pose, by, h, long=0.0):
    """By JAX, and by central differences, of a stroke so much longer. -> (2, 16) twice"""
    steps = long * np.eye(16)[15] + h * np.concatenate([np.zeros((1, 16)), np.eye(16), -np.eye(16)])
    slopes, values = map(np.asarray, rates(steps, pose, by))
    return slopes[0], (values[1:17] - values[17:]).T / (2 * h)


@pytest.mark.soak
def test_derivatives_of_the_best_carriage_are_those_of_differences():
    """In the pose, both radii and all strokes."""
    pose, _ = resolved("margin")
    for k in SHARP:
        got, expected = derivatives(pose[k], "margin", 1e-6)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)
        assert np.max(np.abs(got[0, :4])) > 0.01 and np.max(np.abs(got[0, 6:])) > 0.1


@pytest.mark.soak
def test_where_many_carriages_are_best_derivatives_are_those_of_differences():
    """Leg 2 has the least margin and does not see the carriage: the first of the best is taken."""
    pose = casing_at(["s", "roll", "yaw"], [0.42, 0.01, 0.02])
    found = pk.resolve_redundancy(CASING, pose)
    flat = np.linspace(found.free[0] - 1e-4, found.free[0] + 1e-4, 2001)
    least = np.min(scanned(CASING, pose, flat), axis=1)
    assert np.ptp(least[1000:]) == 0 and least[0] < least[1000] - 1e-6
    got, expected = derivatives(pose, "margin", 1e-6)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)


def test_at_an_end_of_the_stroke_the_carriage_moves_with_it():
    """Poses out of all limits, for which it would go farther: free' is that of the end, and nothing else."""
    ends = []
    for pitch in (0.45, -0.6):
        pose = casing_at(["pitch", "yaw"], [pitch, 0.02])  # not symmetric: no two margins are least
        value, at = best_margin(pose)
        found = pk.resolve_redundancy(CASING, pose)
        assert at in (LOW, HIGH) and found.free[0] == at and abs(found.value - value) < 1e-13
        got, expected = derivatives(pose, "margin", 1e-6)
        np.testing.assert_allclose(got[0], np.eye(16)[6 + 8 + (at == HIGH)], rtol=0, atol=1e-14)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)
        ends.append(at)
    assert sorted(ends) == [LOW, HIGH]


@pytest.mark.soak  # second derivatives of singular values compile for long
def test_derivatives_of_the_best_conditioning_are_those_of_differences():
    """At an end of the stroke, and at a maximum between them."""
    pose = resolved("conditioning", 3, 0.5)[0]
    for row, long, is_end in ((0, 0.0, True), (5, LONG, False)):
        got, expected = derivatives(pose[row], "conditioning", 1e-5, long)
        np.testing.assert_allclose(got[1], expected[1], rtol=0, atol=1e-6)
        np.testing.assert_allclose(got[0], expected[0], rtol=0, atol=1e-4 * np.max(np.abs(got[0])))
        assert (got[0, 15] == 1) == is_end


def test_a_lost_row_is_nan_and_hurts_no_other():
    pose, good = resolved("margin")
    s, rotation = np.array(pose.s), np.array(pose.rotation)
    s[2], rotation[5, 0, 0] = NAN, NAN
    found = pk.resolve_redundancy(CASING, pk.AxisPose(s, rotation))
    is_bad = np.isin(np.arange(ROWS), [2, 5])
    np.testing.assert_array_equal(found.status, np.where(is_bad, pk.Status.BAD_INPUT, pk.Status.OK))
    for got, whole in zip(found[:3], good[:3], strict=True):
        assert np.all(np.isnan(got[is_bad]))
        np.testing.assert_array_equal(got[~is_bad], whole[~is_bad])

    @jax.jit
    def gradient(s, rotation):
        total = lambda s: jnp.nansum(pk.resolve_redundancy(CASING, pk.AxisPose(s, rotation)).value)
        return jax.grad(total)(s)

    lost, whole = gradient(s, rotation), gradient(pose.s, pose.rotation)
    np.testing.assert_array_equal(lost[is_bad], 0)
    np.testing.assert_allclose(lost[~is_bad], whole[~is_bad], rtol=0, atol=1e-14)
    assert np.all(whole != 0)


# ---------------------------------------------------------------- at the door


def test_bad_maps_are_refused_in_one_line():
    two = pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0)
    no_margins = outsiders.three_rpr()
    ask, box = partial(said_by, pk.workspace_map), ((-0.1, 0.1), (-0.1, 0.1))
    assert ask("5-link") == "workspace_map takes a pk_jax.Mechanism, got str"
    assert ask(no_margins) == "ThreeRPR has no margins: give it limits (strokes, cones, ...)"
    assert ask(outsiders.implicit_delta()).startswith("workspace_map needs the closed form")
    for axes in (("roll",), ("roll", "roll"), ("x", "y"), ("s", "roll", "pitch", "yaw"), "roll"):
        assert ask(CASING, axes).startswith("axes must be 2 to 3 different ones of s, roll, pitch, yaw, got")
    assert ask(CASING, free="best") == "free must be numbers or \"any\", got 'best'"
    assert ask(CASING, free=[0.7, 0.71]) == "free must be one value of each joint, got a batch"
    assert ask(two, free="any") == 'free="any" is for one redundant joint, TwoRPR has 0'
    assert ask(two, free=0.7).startswith("free must be left out: TwoRPR has no kinematically redundant joint")
    assert ask(CASING, ranges=((0.1, -0.1), (0, 1))).startswith("ranges must be (lower, upper) with lower <")
    assert ask(CASING, ranges=(0, 1)).startswith("ranges must be finite, of shape (2, 2)")
    assert ask(CASING, at=poses_near(1), ranges=box) == "at must be one pose, got a batch"
    assert ask(CASING, at=pk.AxisPose(NAN, np.eye(3)), ranges=box) == "at must be finite"
    assert ask(CASING, at=pk.SE3([0.0, 0, 0.5], np.eye(3))) == "at must be a pk_jax.AxisPose, got SE3"
    assert ask(pk.catalogued("5-link"), branch=[1, 1, 1]).startswith("branch must have shape (2,)")
    with pytest.raises(ValueError, match=r"^workspace_map works on known values only"):
        jax.jit(lambda free: pk.workspace_map(CASING, free=free, ranges=box).margin)(0.7)


@pytest.mark.parametrize(
    "nodes", [1, 0, -3, 2.5, (5, 1), (5, 5, 5), True, "many", NAN, np.inf, 10**6], ids=repr
)
def test_nodes_that_are_none_are_refused_in_one_line(nodes):
    box = ((-0.1, 0.1), (-0.1, 0.1))
    assert said_by(pk.workspace_map, CASING, ranges=box, nodes=nodes).startswith("nodes must")


def test_bad_travels_are_refused_in_one_line():
    ask = partial(said_by, pk.travel)
    assert ask(CASING, "x") == "coordinate must be one of s, roll, pitch, yaw, got 'x'"
    assert ask(stewart(), "phi") == "coordinate must be one of x, y, z, rx, ry, rz, got 'phi'"
    for most in (0, -1.0, NAN, np.inf):
        assert ask(CASING, "roll", most=most).startswith("most must be positive and finite, got")
    for steps in (0, 2.5, True, 10**6):
        assert ask(CASING, "roll", steps=steps).startswith("steps must be an integer from 1 to 100000, got")
    assert (
        ask(outsiders.three_rpr(), "phi") == "ThreeRPR has no margins: give it limits (strokes, cones, ...)"
    )
    assert ask(CASING, "roll", free="best").startswith("free must be numbers or")
    assert ask(CASING, "roll", at=[0.48, 0, 0, 0]) == "at must be a pk_jax.AxisPose, got list"
    with pytest.raises(ValueError, match=r"^travel works on known values only"):
        jax.jit(lambda mech: pk.travel(mech, "roll").lower)(CASING)


class Rail(pk.Mechanism):
    """Two carriages on one rail hold a point between them: two free joints, no margins."""

    apart: jax.Array

    free_joints = 2

    def residual(self, pose, joints):
        return pose - jnp.stack([joints[0] + joints[2], joints[1] + joints[3]])

    def home(self):
        return jnp.zeros(2), jnp.zeros(4)

    def free_range(self):
        return jnp.array([[-1.0, 1.0], [-1.0, 1.0]])

    def length(self):
        return self.apart

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], ())


class OneRail(Rail):
    free_joints = 1

    def residual(self, pose, joints):
        return pose - jnp.stack([joints[0] + joints[2], joints[1]])

    def home(self):
        return jnp.zeros(2), jnp.zeros(3)

    def free_range(self):
        return jnp.array([[-1.0, 1.0]])


def test_bad_redundancy_is_refused_in_one_line():
    ask = partial(said_by, pk.resolve_redundancy)
    pose, _ = CASING.home()
    assert ask("casing", pose) == "resolve_redundancy takes a pk_jax.Mechanism, got str"
    assert ask(CASING, pose, by="speed").startswith("by must be")
    flat = pk.catalogued("nam-2-rpr")
    assert ask(flat, [0.0, 1.5]).endswith("one redundant joint, TwoRPR has 0")
    assert ask(Rail(apart=1.0), [0.0, 0.0]).endswith("one redundant joint, Rail has 2")
    assert ask(OneRail(apart=1.0), [0.0, 0.0]) == "OneRail has no margins to keep"
    assert ask(CASING, [0.48, 0, 0, 0]) == "pose must be a pk_jax.AxisPose, got list"
    assert ask(CASING, pk.SE3([0.0, 0, 0.48], np.eye(3))) == "pose must be a pk_jax.AxisPose, got SE3"
