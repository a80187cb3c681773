"""Robots that the house does not know, by everything it offers, against NumPy of their own."""

import dataclasses
import itertools
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import outsiders
import pytest
from hypothesis import given
from hypothesis import strategies as st
from outsiders import EXAMPLES, Delta, ThreeRPS
from refusals import said_by
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

import pk_jax as pk

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

OUT = np.array([[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]])
UP = np.array([0, 0, 1.0])
DELTA, RPS = outsiders.delta(), outsiders.three_rps()
AT = np.array([0.12, -0.08, -0.62])  # of the Delta
TILTED = np.array([0.64, 0.3, -0.12])  # of the 3-RPS


# ---------------------------------------------------------------- the robots in NumPy


def delta_joints(mech, pose, outward=True):
    """Clavel's half-angle formula, leg by leg: roots t = tan(q / 2) of a quadratic."""
    found = []
    for out in OUT:
        arm, tip = float(mech.arm), pose + (float(mech.platform_radius) - float(mech.base_radius)) * out
        along, drop = tip @ out, -tip[2]
        k = (tip @ tip + arm**2 - float(mech.rod) ** 2) / (2 * arm)  # along cos(q) + drop sin(q) = k
        root = np.sqrt(along**2 + drop**2 - k**2)
        angles = 2 * np.arctan((drop + np.array([1, -1]) * root) / (along + k))
        reach = float(mech.base_radius) + arm * np.cos(angles)
        found.append(angles[np.argmax(reach) if outward else np.argmin(reach)])
    return np.array(found)


def three_spheres(centres, radius):
    """Both points at one distance from three."""
    a, b, c = centres
    x = (b - a) / np.linalg.norm(b - a)
    y = c - a - (c - a) @ x * x
    z = np.cross(x, y := y / np.linalg.norm(y))
    d, i, j = np.linalg.norm(b - a), (c - a) @ x, (c - a) @ y
    u = d / 2
    v = (i * i + j * j - 2 * i * u) / (2 * j)
    w = np.sqrt(radius**2 - u * u - v * v)
    return np.array([a + u * x + v * y + sign * w * z for sign in (1, -1)])


def delta_poses(mech, joints):
    """The platform's joints moved to its centre: spheres around the elbows moved likewise."""
    swing = np.cos(joints)[:, None] * OUT - np.sin(joints)[:, None] * UP
    shifted = (float(mech.base_radius) - float(mech.platform_radius)) * OUT + float(mech.arm) * swing
    return three_spheres(shifted, float(mech.rod))


def rps_tips(mech, pose):
    """Tips by SciPy's rotation; the shift solved from the planes of the three hinges."""
    z, a, b = pose
    size = np.hypot(a, b)
    angle = 2 * np.arctan(size / 2)
    turn = Rotation.from_rotvec(angle * np.array([a, b, 0]) / max(size, 1e-300)).as_matrix()
    tips = float(mech.platform_radius) * OUT @ turn.T
    across = np.cross(UP, OUT)
    shift, missed = np.linalg.lstsq(across[:, :2], -np.sum(across * tips, axis=1), rcond=None)[:2]
    assert np.all(missed < 1e-24)  # three planes, two shifts: nothing is left for a tilt without torsion
    return tips + [*shift, z]


def rps_joints(mech, pose):
    return np.linalg.norm(rps_tips(mech, pose) - float(mech.base_radius) * OUT, axis=1)


def slopes_of(function, at, step=1e-5):
    """Central differences, a column each."""
    units = step * np.eye(len(at))
    return np.stack([(function(at + u) - function(at - u)) / (2 * step) for u in units], axis=-1)


ROBOTS = {"Delta": (DELTA, AT, delta_joints), "3-RPS": (RPS, TILTED, rps_joints)}
EACH = pytest.mark.parametrize("name", ROBOTS)


@pytest.fixture(scope="module")
def solved():
    return {name: pk.inverse_kinematics(mech, pose).joints for name, (mech, pose, _) in ROBOTS.items()}


# ---------------------------------------------------------------- kinematics and statics


sizes = st.floats(0.85, 1.2)


@given(sizes, sizes, sizes, sizes, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_a_delta_of_any_size_has_the_joints_of_the_half_angle_formula(a, b, c, d, x, y):
    mech = Delta(base_radius=0.2 * a, platform_radius=0.05 * b, arm=0.35 * c, rod=0.8 * d)
    pose = np.asarray(mech.home()[0]) + [x, y, 0.1 * x]
    found = pk.inverse_kinematics(mech, pose)
    assert found.status == pk.Status.OK
    np.testing.assert_allclose(found.joints, delta_joints(mech, pose), atol=1e-10)


@given(sizes, sizes, st.floats(0.4, 0.9), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_a_3_rps_of_any_size_keeps_its_tips_in_the_planes_of_its_hinges(a, b, z, p, q):
    mech = dataclasses.replace(RPS, base_radius=0.3 * a, platform_radius=0.2 * b)
    pose = np.array([z, p, q])
    tips = np.asarray(mech.tips(jnp.asarray(pose)))
    assert np.abs(np.sum(np.cross(UP, OUT) * tips, axis=1)).max() < 1e-15
    np.testing.assert_allclose(tips, rps_tips(mech, pose), atol=1e-14)
    np.testing.assert_allclose(pk.inverse_kinematics(mech, pose).joints, rps_joints(mech, pose), rtol=1e-13)


@EACH
def test_jacobians_and_statics_are_those_of_differences(name, solved):
    mech, pose, joints_of = ROBOTS[name]
    q = solved[name]
    inverse = slopes_of(lambda x: joints_of(mech, x), pose)
    forward = np.linalg.inv(inverse)
    np.testing.assert_allclose(pk.velocity_jacobian(mech, pose, q), forward, rtol=1e-7, atol=1e-7)
    wrench = np.array([1.0, -2.0, 3.0])
    forces = forward.T @ wrench  # virtual work
    np.testing.assert_allclose(pk.joint_forces(mech, pose, q, wrench), forces, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(pk.platform_wrench(mech, pose, q, forces), wrench, rtol=1e-6)
    stiff = inverse.T @ np.diag([1.0, 2.0, 3.0]) @ inverse
    np.testing.assert_allclose(pk.stiffness(mech, pose, q, [1.0, 2.0, 3.0]), stiff, rtol=1e-6, atol=1e-7)
    found = pk.screws(mech, pose, q)
    np.testing.assert_allclose(found.lines / found.arms[:, None], inverse, rtol=1e-6, atol=1e-7)


def test_the_wrench_of_an_arm_is_a_force_along_its_rods(solved):
    points = np.asarray(DELTA.skeleton(AT, solved["Delta"]).points)
    rods = points[6:] - points[3:6]
    np.testing.assert_allclose(np.linalg.norm(rods, axis=1), 0.8, rtol=1e-14)
    lines = np.asarray(pk.screws(DELTA, AT, solved["Delta"]).lines)
    assert np.abs(np.cross(rods, lines)).max() < 1e-14


def test_every_working_mode_closes_and_all_are_different():
    modes = pk.working_modes(DELTA)
    assert sorted(map(tuple, modes)) == sorted(itertools.product((-1.0, 1.0), repeat=3))
    both = np.stack([delta_joints(DELTA, AT, outward) for outward in (True, False)])
    wanted = {tuple(np.round(row, 9)) for row in itertools.product(*both.T)}
    joints = np.asarray(jax.vmap(lambda mode: DELTA.inverse(jnp.asarray(AT), mode))(modes))
    assert {tuple(np.round(row, 9)) for row in joints} == wanted
    np.testing.assert_allclose(joints[0], both[0], atol=1e-14)  # the default: elbows outward
    assert len(pk.working_modes(RPS)) == 1  # lengths are positive


def test_a_geometry_without_a_home_is_refused():
    assert said_by(Delta, base_radius=0.2, platform_radius=0.05, arm=0.8, rod=0.6).startswith(
        "Delta has no home"
    )


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_any_number_of_rows_is_solved(rows):
    found = pk.inverse_kinematics(DELTA, np.repeat(AT[None], rows, axis=0))
    np.testing.assert_allclose(found.joints, [delta_joints(DELTA, AT)] * rows, atol=1e-13)


def test_what_is_out_of_reach_has_no_joints():
    assert pk.inverse_kinematics(DELTA, [0.0, 0, -1.3]).status == pk.Status.UNREACHABLE
    reach = np.asarray(DELTA.reach(jnp.array([0.0, 0, -1.3])))
    assert np.all(reach < 0)
    assert np.all(np.isnan(DELTA.inverse(jnp.array([0.0, 0, -1.3]))))


def test_both_poses_of_a_delta_are_where_three_spheres_meet(solved):
    wanted = delta_poses(DELTA, np.asarray(solved["Delta"]))
    wanted = wanted[np.argsort(np.linalg.norm(wanted - AT, axis=1))]
    modes = pk.assembly_modes(DELTA, solved["Delta"])
    assert modes.count == 2 and not modes.is_complete and modes.method == "search"
    np.testing.assert_allclose(modes.poses[:2], wanted, atol=1e-13)
    assert modes.is_certified[:2].all()


# ---------------------------------------------------------------- the 3-RPS as a body with constraints


@pytest.fixture(scope="module")
def body():
    """The same configuration of the 3-RPS with six coordinates."""
    mech = outsiders.constrained_rps()
    tips = rps_tips(RPS, TILTED)
    turn = Rotation.align_vectors(tips - tips.mean(axis=0), 0.2 * OUT)[0].as_matrix()
    return mech, pk.SE3(jnp.asarray(tips.mean(axis=0)), jnp.asarray(turn))


def test_a_constrained_body_has_the_joints_and_forces_of_its_freedoms(body, solved):
    mech, pose = body
    q = solved["3-RPS"]
    np.testing.assert_allclose(pk.inverse_kinematics(mech, pose).joints, q, rtol=1e-13)
    moved = pk.SE3(pose.translation + jnp.array([0.01, 0, 0]), pose.rotation)
    assert pk.inverse_kinematics(mech, moved).status == pk.Status.STALLED  # out of its planes
    found = pk.forward_kinematics(mech, q)
    np.testing.assert_allclose(found.pose.translation, pose.translation, atol=1e-13)

    def body_at(x):  # a point in space for a pose of the freedoms
        tips = rps_tips(RPS, x)
        return tips.ravel()

    of_tips = slopes_of(body_at, TILTED).reshape(3, 3, 3) @ np.linalg.inv(
        slopes_of(lambda x: rps_joints(RPS, x), TILTED)
    )
    load = np.array([[1.0, 2.0, 3.0], [-2.0, 1.0, 0.0], [0.5, -1.0, -2.0]])  # at the tips
    tips = rps_tips(RPS, TILTED)
    moment = np.sum(np.cross(tips - tips.mean(axis=0), load), axis=0)
    forces = pk.joint_forces(mech, pose, q, np.concatenate([load.sum(axis=0), moment]))
    np.testing.assert_allclose(forces, np.einsum("td,tdq->q", load, of_tips), rtol=1e-6)


def test_what_a_constrained_body_cannot_have_is_refused_in_a_line(body, solved):
    mech, pose = body
    assert "3 joints for a pose of 6 coordinates" in said_by(pk.check_mechanism, mech)
    assert "closed form" in said_by(pk.least_over(np.zeros((1, 3))), mech)
    assert "closed form" in said_by(pk.margins_over(np.zeros((1, 3))), mech)
    assert "fills no slice" in said_by(pk.singularity_locus, mech, ("x", "y"))
    assert "as many joints as closure equations" in said_by(pk.stiffness, mech, pose, solved["3-RPS"], 1.0)
    assert pk.self_motions(mech, pose, solved["3-RPS"]).shape == (0, 3)

    class Sensing(outsiders.ConstrainedRPS):
        actuated_rows = 3

    said = said_by(Sensing, base_radius=0.3, platform_radius=0.2)
    assert said.startswith("Sensing.actuated_rows must be at least 6") and said.endswith("force, too")


def test_lines_are_not_drawn_where_a_pose_is_no_position(solved):
    from pk_jax.viz.singularity import draw_screws

    assert "a pose that is a position" in said_by(draw_screws, RPS, TILTED, solved["3-RPS"])


# ---------------------------------------------------------------- limits, designs, calibration


def test_a_map_says_what_every_pose_of_it_would():
    found = pk.workspace_map(
        DELTA, ("x", "z"), at=[0, 0.1, 0], ranges=((-0.9, 0.9), (-1.2, -0.3)), nodes=(19, 16)
    )
    wanted = np.full(found.margin.shape, -1.0)
    for (i, x), (j, z) in itertools.product(enumerate(found.nodes[0]), enumerate(found.nodes[1])):
        with np.errstate(invalid="ignore"):
            joints = delta_joints(DELTA, np.array([x, 0.1, z])) if z else np.nan
        wanted[i, j] = 1 - np.abs(joints).max() / (np.pi / 2)
    is_inside = wanted >= 0  # NaN compares False
    assert 0.1 < is_inside.mean() < 0.9
    assert np.array_equal(found.is_inside, is_inside)
    assert np.all(
        found.margin[is_inside] <= wanted[is_inside] + 1e-12
    )  # the margin of reach is smaller there


def test_travels_of_the_lift_end_where_a_leg_or_the_tilt_does():
    ends = pk.travel(RPS, "p1")
    np.testing.assert_allclose([ends.lower, ends.upper], np.sqrt(np.array([0.5, 0.8]) ** 2 - 0.1**2))
    assert ends.limit_lower.startswith("short") and ends.limit_upper.startswith("long")
    tilt = pk.travel(RPS, "p2")
    np.testing.assert_allclose([tilt.lower, tilt.upper], np.array([-2, 2]) * np.tan(0.35))


CYLINDER = np.array([[0.2, 0.0, -0.55], [-0.1, 0.17, -0.6], [0.05, -0.1, -0.7]])


def least_isotropy(base, rod):
    mech = dataclasses.replace(DELTA, base_radius=base, rod=rod)
    jacobians = [slopes_of(lambda x: delta_joints(mech, x), pose, 1e-4) for pose in CYLINDER]
    return np.array([1 / np.linalg.cond(j) for j in jacobians])


def test_design_gradients_are_those_of_numpy():
    problem = pk.DesignProblem(
        lambda v: dataclasses.replace(DELTA, **v),
        {"base_radius": (0.1, 0.3), "rod": (0.6, 1.0)},
        pk.least_over(CYLINDER, "isotropy"),
        pk.margins_over(CYLINDER),
    )
    found = pk.evaluate_designs(problem, [[0.2, 0.8]])
    np.testing.assert_allclose(found.objective[0], least_isotropy(0.2, 0.8), rtol=1e-6)
    slopes = slopes_of(lambda v: least_isotropy(*v), np.array([0.2, 0.8]), 1e-4)
    np.testing.assert_allclose(found.objective_slopes[0], slopes, rtol=1e-4, atol=1e-5)
    arms = np.array([1 - np.abs(delta_joints(DELTA, pose)) / (np.pi / 2) for pose in CYLINDER])
    names = [name for name in problem.constraint_names if name.startswith("arms")]
    np.testing.assert_allclose(found.constraints[0, : len(names)].reshape(3, 3), arms, atol=1e-12)


def test_a_log_of_the_lift_gives_its_radii_back():
    poses = TILTED + np.random.default_rng(4).uniform(-0.2, 0.2, (20, 3)) * [0.3, 1, 1]
    joints = np.array([rps_joints(RPS, pose) for pose in poses])
    wrong = dataclasses.replace(RPS, base_radius=0.31, platform_radius=0.19)
    found = pk.calibrate(wrong, poses, joints)
    assert found.status == pk.Status.OK and found.rank == 2
    np.testing.assert_allclose([found.mechanism.base_radius, found.mechanism.platform_radius], [0.3, 0.2])


# ---------------------------------------------------------------- longer


@pytest.mark.soak
@EACH
def test_the_laws_hold(name):
    assert pk.check_mechanism(ROBOTS[name][0])


@pytest.mark.soak
def test_every_pose_of_the_lift_is_found_by_the_angles_of_its_hinges(solved):
    """Unknown are the inclinations of the legs; the sides of the platform are known."""
    q = np.asarray(solved["3-RPS"])
    modes = pk.assembly_modes(RPS, q)
    side, pairs = 0.2 * 3**0.5, ((0, 1), (1, 2), (2, 0))

    def tips(angles):
        return 0.3 * OUT + q[:, None] * (np.sin(angles)[:, None] * UP - np.cos(angles)[:, None] * OUT)

    def open_by(angles):
        p = tips(angles)
        return [np.sum((p[i] - p[j]) ** 2) - side**2 for i, j in pairs]

    seen = []
    for start in np.random.default_rng(1).uniform(-np.pi, np.pi, (600, 3)):
        angles, _, ended, _ = fsolve(open_by, start, full_output=True, xtol=1e-13)
        p = tips(angles)
        turn = Rotation.align_vectors(p - p.mean(axis=0), 0.2 * OUT)[0].as_rotvec()
        if ended != 1 or np.abs(open_by(angles)).max() > 1e-10 or np.linalg.norm(turn) > np.pi - 1e-6:
            continue  # not closed, or half a turn: the other operation mode
        size = np.linalg.norm(turn)
        pose = np.array([p.mean(axis=0)[2], *turn[:2] * 2 * np.tan(size / 2) / max(size, 1e-300)])
        if all(np.abs(pose - other).max() > 1e-5 for other in seen):
            seen.append(pose)
    found = np.asarray(modes.poses)[modes.is_real]
    assert modes.count == len(seen) >= 2
    for pose in seen:
        assert np.abs(found - pose).max(axis=1).min() < 1e-6


@pytest.mark.soak
def test_the_singular_poses_of_a_delta_are_singular_in_numpy():
    height = np.array([0, 0, -0.5])
    mode = pk.working_modes(DELTA)[0]
    locus = pk.singularity_locus(
        DELTA, ("x", "y"), at=height, ranges=((-0.9, 0.9), (-0.9, 0.9)), branch=mode, nodes=31
    )
    assert {int(curve.kind) for curve in locus.curves} >= {1}
    for curve in locus.curves:
        poses = np.column_stack([curve.coordinates, np.full(len(curve.coordinates), -0.5)])
        swing = np.cos(curve.joints)[..., None] * OUT - np.sin(curve.joints)[..., None] * UP
        rods = poses[:, None] + 0.05 * OUT - 0.2 * OUT - 0.35 * swing
        np.testing.assert_allclose(np.linalg.norm(rods, axis=2), 0.8, rtol=1e-9)
        turning = -np.sin(curve.joints)[..., None] * OUT - np.cos(curve.joints)[..., None] * UP
        if curve.kind == pk.SingularityKind.TYPE_I:
            assert np.abs(np.sum(turning * rods, axis=2)).min(axis=1).max() < 1e-8
        else:
            assert np.abs(np.linalg.det(rods / 0.8)).max() < 1e-8


@pytest.mark.soak
def test_the_volume_of_a_workspace_is_that_of_random_poses():
    found = pk.workspace_integral(DELTA, (), about=[0.0, 0, -0.6], rays=512)
    assert found.status == pk.Status.OK
    rng, box = np.random.default_rng(2), np.array([[-1.2, -1.2, -1.2], [1.2, 1.2, 1.2]])
    poses = rng.uniform(*box, (40_000, 3))
    with np.errstate(invalid="ignore"):
        joints = np.array([delta_joints(DELTA, pose) for pose in poses])
        share = np.mean(np.all(np.abs(joints) <= np.pi / 2, axis=1))
    volume = share * 2.4**3
    scatter = 2.4**3 * np.sqrt(share * (1 - share) / len(poses))
    assert abs(found.volume - volume) <= found.error.volume + 3 * scatter


# ---------------------------------------------------------------- what a newcomer gets wrong


class Sound(pk.Mechanism):
    """A slide along one axis."""

    gap: jax.Array

    def residual(self, pose, joints):
        return pose - joints + self.gap

    def home(self):
        return jax.lax.stop_gradient(jnp.ones(1)), jnp.ones(1) + self.gap

    def length(self):
        return jnp.ones(())

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(jnp.zeros((1, 2)), ())


def of_class(bases=(Sound,), **attributes):
    """The TypeError of a class, or of its first instance: one line that names it."""
    with pytest.raises(TypeError) as caught:
        type("Robot", bases, {"__module__": __name__, **attributes})(gap=0.5)
    said = str(caught.value)
    assert said.startswith("Robot") and "\n" not in said
    return said


def test_all_that_is_missing_is_named_at_once():
    kept = {name: vars(Sound)[name] for name in ("residual", "home", "length")}
    said = of_class((pk.Mechanism,), __annotations__={"gap": "jax.Array"}, **kept)
    wanted = "Robot is missing margins(pose, joints): named distances to the limits; skeleton(pose, joints): "
    assert said == wanted + "what to draw; see CONTRIBUTING, A mechanism of your own"
    said = of_class((pk.LegMechanism,), __annotations__={"gap": "jax.Array"}, **kept)
    assert "attachments(): " in said and "legs(points, joints): " in said
    assert "free_range()" in of_class(free_joints=1)


WRONG = {
    "joint_unit": ((0,), "did you mean joint_units?"),
    "pose_unit": ((0,), "did you mean pose_units?"),
    "free_joint": (1, "did you mean free_joints?"),
    "joint_units": ([0], "must be a tuple of 1 = length and 0 = angle, one a joint, got [0]"),
    "pose_units": ((2,), "must be a tuple of 1 = length and 0 = angle, one a coordinate, got (2,)"),
    "joints_are_distances": (1, "must be True or False, got 1"),
    "angles_come_round": (None, "must be True or False, got None"),
    "actuated_rows": (0, "must be a positive integer or None, got 0"),
    "free_joints": (True, "must be an integer >= 0, got True"),
    "joint_names": ("q", "must be a tuple of strings or None, got 'q'"),
    "arm": (0.5, "has no annotation: write `arm: jax.Array = 0.5` for a field"),
    "inverse": (
        lambda self, pose: pose,
        "must be inverse(self, pose, branch=None, *, free=None), got inverse(",
    ),
    "forward": (lambda self: None, "must be forward(self, joints), got forward(self)"),
    "home": (lambda self, pose: None, "must be home(self), got home(self, pose)"),
    "length": (1.0, "must be length(self), got length = 1.0"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_attribute_is_told(name):
    value, wanted = WRONG[name]
    assert of_class(**{name: value}).startswith(f"Robot.{name} ")
    assert wanted in of_class(**{name: value})


@pytest.mark.parametrize(
    ("field", "wanted"),
    [("joint_units", "is a setting: write it without an annotation"), ("length", "cannot be a field")],
)
def test_a_field_that_is_something_else_is_told(field, wanted):
    assert wanted in of_class(__annotations__={field: "tuple"})


def test_a_class_is_not_decorated_and_takes_names():
    for frozen in (True, False):
        with pytest.raises(TypeError):
            dataclasses.dataclass(frozen=frozen)(type("Robot", (Sound,), {}))
    with pytest.raises(TypeError, match=r"Sound takes its geometry by name: Sound\(gap=...\)"):
        Sound(0.5)


def test_constants_and_helpers_are_nobodys_business():
    class Robot(Sound):
        LEGS = 3
        _hidden = "any"

        @property
        def half(self):
            return self.gap / 2

        @staticmethod
        def other(x):
            return x

    assert Robot(gap=0.5).half == 0.25


# each holds joint i in equation i otherwise than an explicit mechanism may
CROOKED = {
    "other joints": (lambda self, pose, q: pose - q * q[::-1], "alone"),
    "a cube": (lambda self, pose, q: pose - q**3, "as a + b q + c q^2"),
    "a distance": (lambda self, pose, q: jnp.sqrt(pose**2 + (q - self.gap) ** 2) - 1, "as a + b q + c q^2"),
    "one more": (lambda self, pose, q: jnp.append(pose - q, 0.0), "residual must have shape (2,)"),
}


@pytest.mark.parametrize("name", CROOKED)
def test_what_is_not_explicit_is_refused(name):
    residual, wanted = CROOKED[name]
    home = lambda self: (jnp.array([1.0, 2.0]), jnp.array([1.0, 2.0]))
    kept = {each: vars(Sound)[each] for each in ("length", "margins", "skeleton")}
    made = {
        "__annotations__": {"gap": "jax.Array"},
        "joint_units": (1, 1),
        "home": home,
        "residual": residual,
        **kept,
    }
    said = said_by(type("Robot", (pk.ExplicitMechanism,), {"__module__": __name__, **made}), gap=0.3)
    assert said.startswith("Robot.residual must") and wanted in said


def test_an_explicit_mechanism_says_what_its_joints_are():
    class Robot(pk.ExplicitMechanism):
        gap: jax.Array
        residual, home, length = Sound.residual, Sound.home, Sound.length
        margins, skeleton = Sound.margins, Sound.skeleton

    assert said_by(Robot, gap=0.5).startswith("Robot.joint_units must say")


class Sliders(pk.ExplicitMechanism):
    """Two sliders and a crank in one: a linear, a quadratic and a trigonometric equation."""

    rod: jax.Array

    joint_units = (1, 1, 0)

    def residual(self, pose, joints):
        x, y, z = pose
        u, v, w = joints
        crank = (y - jnp.cos(w)) ** 2 + (z - jnp.sin(w)) ** 2 - self.rod**2
        return jnp.stack([x + y - 2 * u, (x - v) ** 2 + z**2 - self.rod**2, crank])

    def home(self):
        pose = jax.lax.stop_gradient(jnp.array([0.1, 0.2, 0.3]))
        return pose, self.inverse(pose, jnp.array([-1.0, 1.0, 1.0]))

    def length(self):
        return self.rod

    def margins(self, pose, joints):
        return {"reach": self.reach(pose)}

    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], ())


def test_lengths_and_angles_side_by_side():
    mech, pose = Sliders(rod=1.1), jnp.array([0.15, 0.25, 0.2])
    joints = np.asarray(pk.inverse_kinematics(mech, pose).joints)
    assert np.abs(mech.residual(pose, joints)).max() < 1e-14
    np.testing.assert_allclose(joints[:2], [0.2, 0.15 + np.sqrt(1.1**2 - 0.2**2)])
    other = np.asarray(mech.inverse(pose, jnp.array([-1.0, -1.0, -1.0])))
    np.testing.assert_allclose(other[1], 0.15 - np.sqrt(1.1**2 - 0.2**2))
    assert np.isnan(mech.inverse(pose, jnp.ones(3))[0])  # a line is crossed in one way only
    assert np.abs(np.exp(1j * other[2]) - np.exp(1j * joints[2])) > 0.1


def test_tilts_that_do_not_come_round_must_say_so():
    class Round(ThreeRPS):
        angles_come_round = True

    said = said_by(pk.check_mechanism, Round(**{f: getattr(RPS, f) for f in RPS.__dataclass_fields__}))
    assert said.endswith("a full turn of coordinate 2 of its pose: say angles_come_round = False")


# ---------------------------------------------------------------- FILE.py:NAME


@pytest.fixture
def written(tmp_path):
    def written(text):
        path = tmp_path / "robot.py"
        path.write_text(textwrap.dedent(text))
        return path

    return written


def test_a_mechanism_of_a_python_file_is_shown(run):
    code, out, err = run("show", f"{EXAMPLES / 'delta.py'}:robot")
    assert (code, err) == (0, "")
    assert "Three arms, three rods" in out and "family Delta, lengths in m" in out and "rod 0.8" in out
    code, out, _ = run("show", f"{EXAMPLES / 'three_rps.py'}:robot", "--unit", "mm")
    assert code == 0 and "fields as in the file" in out and "most_tilt 0.7" in out and "length 300" in out


def test_a_callable_of_a_python_file_gives_one(run, written):
    path = written(
        """
        import pk_jax as pk
        from beside import half
        def make():
            return pk.TwoRPR(half_base=half, l_min=1.0, l_max=3.0)
        """
    )
    path.with_name("beside.py").write_text("half = 0.5\n")
    code, out, _ = run("show", f"{path}:make")
    assert code == 0 and "half_base 0.5" in out


FAULTS = {
    "": ("robot", "no name 'robot' in it; it has no mechanism"),
    "import pk_jax as pk\narm = pk.TwoRPR(half_base=1, l_min=1, l_max=3)": (
        "robot",
        "no name 'robot' in it; there are arm",
    ),
    "x = 1\nrobot = 1 / 0": ("robot", "line 2: ZeroDivisionError: division by zero"),
    "def f(:": ("robot", "line 1: SyntaxError"),
    "import nowhere_to_be_found": ("robot", "line 1: ModuleNotFoundError: No module named"),
    "raise SystemExit(3)": ("robot", "line 1: SystemExit: 3"),
    "robot = 3": ("robot", "robot must be a pk_jax.Mechanism, got int"),
    "def robot(x): pass": ("robot", "TypeError: robot() missing 1 required positional argument"),
    "import pk_jax as pk\nclass R(pk.Mechanism): pass\nrobot = R()": (
        "robot",
        "line 3: TypeError: R is missing",
    ),
}


@pytest.mark.parametrize("text", FAULTS)
def test_a_fault_in_a_python_file_is_told_in_a_line(run, written, text):
    name, wanted = FAULTS[text]
    path = written(text)
    code, out, err = run("show", f"{path}:{name}")
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert err.startswith(f"pk-jax: {path}: ") and wanted in err


def test_a_fault_of_a_method_is_told_with_its_line(run, written):
    text = (EXAMPLES / "delta.py").read_text().replace("return self.rod\n", "return self.rods\n")
    path = written(text)
    code, _, err = run("show", f"{path}:robot")
    line = text[: text.index("self.rods")].count("\n") + 1
    assert code == 2 and f"{path}: line {line}: AttributeError: 'Delta' object has no attribute 'rods'" in err


def test_a_python_file_that_is_not_there_is_told(run, tmp_path):
    code, _, err = run("show", f"{tmp_path / 'none.py'}:robot")
    assert code == 4 and "No such file" in err
    code, _, err = run("show", EXAMPLES / "delta.py")
    assert code == 2 and "Write FILE.py:NAME; there are robot" in err
