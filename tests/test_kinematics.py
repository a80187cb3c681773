"""Inverse and forward kinematics: a verdict a row, NaN where it is not OK, exact derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from outsiders import delta, implicit_delta, three_legs, three_rpr

import pk_jax as pk
from pk_jax import Status
from pk_jax.kinematics import batching

RPR = pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0)
ARMS = pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15)
DELTA = delta()
PLANAR = three_rpr()

LEFT, RIGHT = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
NAN, INF = np.nan, np.inf


def along(angle, distance):
    return distance * np.array([np.cos(angle), np.sin(angle)])


def statuses(found):
    return [Status(int(s)).name for s in found.status]


# ---------------------------------------------------------------- inverse: statuses

IK_ROWS = {  # of the five-bar: its first leg stands at RIGHT and reaches from 1.15 to 3.15
    "OK": (0.1, 1.7),
    "UNREACHABLE": (9.0, 9.0),
    "SINGULAR, stretched": RIGHT + along(2.2, 3.15),
    "SINGULAR, folded": RIGHT + along(2.0, 1.15),
    "BAD_INPUT, NaN": (NAN, 1.7),
    "BAD_INPUT, infinite": (0.1, INF),
}


@pytest.fixture(scope="module")
def arms_inverse():
    return pk.inverse_kinematics(ARMS, np.array(list(IK_ROWS.values())))


def test_inverse_gives_every_row_its_status(arms_inverse):
    assert statuses(arms_inverse) == [name.partition(",")[0] for name in IK_ROWS]


def test_inverse_answers_only_where_ok(arms_inverse):
    assert np.all(np.isfinite(arms_inverse.joints[0]))
    assert np.all(np.isnan(arms_inverse.joints[1:]))


def test_inverse_shows_the_joints_of_a_stretched_and_a_folded_leg(arms_inverse):
    candidate = np.asarray(arms_inverse.candidate)
    np.testing.assert_array_equal(candidate[0], arms_inverse.joints[0])
    assert np.all(np.isfinite(candidate[2:4])) and np.all(np.isnan(candidate[4:]))
    # stretched, the driven link points along the leg; folded, with the longer distal link, against it
    np.testing.assert_allclose(candidate[2:4, 0], [2.2, 2.0 - np.pi], rtol=0, atol=1e-7)


@pytest.mark.parametrize("branch", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_inverse_keeps_to_the_working_mode(branch):
    """The sign of the elbow's sine is the branch."""
    poses = np.array([[0.1, 1.7], [-1.2, 1.5], [0.8, 2.1], [0.3, -1.8]])
    found = pk.inverse_kinematics(ARMS, poses, branch)
    assert statuses(found) == ["OK"] * 4
    for pose, joints in zip(poses, np.asarray(found.joints), strict=True):
        for base, phi, sign in zip((RIGHT, LEFT), joints, branch, strict=True):
            link = pose - base - along(phi, 1.0)
            np.testing.assert_allclose(np.hypot(*link), 2.15, rtol=1e-14)
            assert np.sign(np.cos(phi) * link[1] - np.sin(phi) * link[0]) == sign


def test_inverse_of_the_two_rpr_at_a_base_joint_is_singular():
    found = pk.inverse_kinematics(RPR, np.array([[1.0, 0.0], [0.3, 0.0], [-1.0, 0.0], [0.0, 1.0]]))
    assert statuses(found) == ["SINGULAR", "OK", "SINGULAR", "OK"]
    np.testing.assert_array_equal(found.candidate[0], [0, 2])
    np.testing.assert_array_equal(found.joints[1], [0.7, 1.3])


def test_inverse_without_a_closed_form():
    poses = np.array([[0.05, 0.02, -0.6], [0.0, 0.0, -5.0], [NAN, 0.0, -0.6], [0.0, -0.1, -0.7]])
    mech = implicit_delta()
    found = pk.inverse_kinematics(mech, poses)
    assert statuses(found) == ["OK", "STALLED", "BAD_INPUT", "OK"]
    for row in (0, 3):
        np.testing.assert_allclose(mech.residual(poses[row], found.joints[row]), 0, atol=1e-15)
    assert np.all(np.isnan(found.joints[1:3]))


# ---------------------------------------------------------------- forward: statuses


def test_forward_statuses_of_the_two_rpr():
    joints = np.array([[2.0, 1.0], [5.0, 1.0], [1.0, 1.0], [1.0, 3.0], [NAN, 1.0], [2.0, INF]])
    found = pk.forward_kinematics(RPR, joints)
    assert statuses(found) == ["OK", "UNREACHABLE", "SINGULAR", "SINGULAR", "BAD_INPUT", "BAD_INPUT"]
    np.testing.assert_allclose(found.pose[0], [-0.75, np.sqrt(15) / 4], rtol=0, atol=1e-15)
    assert np.all(np.isnan(found.pose[1:]))
    # on a type II singularity the pose is there, to the square root of the precision
    np.testing.assert_allclose(found.candidate[2:4], [[0, 0], [2, 0]], rtol=0, atol=1e-7)
    assert np.all(np.isnan(found.candidate[4:])) and np.all(np.isnan(found.sigma_min[4:]))
    assert found.residual[0] < 1e-15 < 0.1 < found.residual[1]
    np.testing.assert_array_equal(found.det_sign[0], 1)


def test_forward_of_arms_too_far_apart_is_unreachable():
    short = pk.FiveBar(half_base=1.0, proximal=1.0, distal=1.2)  # elbows 4 apart, links 2.4
    found = pk.forward_kinematics(short, [0.0, np.pi])
    assert int(found.status) == Status.UNREACHABLE and np.all(np.isnan(found.pose))


def test_forward_without_a_closed_form_is_lost_but_told():
    """Legs 1 and 2 of 0.1 cannot span base points 1.2 apart with a platform of 0.45."""
    found = pk.forward_kinematics(PLANAR, [0.1, 0.1, 0.6])
    assert Status(int(found.status)) in (Status.STALLED, Status.STEP_LIMIT)
    assert np.all(np.isnan(found.pose)) and np.all(np.isfinite(found.candidate))
    assert found.residual > 1e-3


def test_forward_across_a_singularity_is_told():
    joints = np.array([1.78614784, 0.24899056, 1.90406926])
    found = pk.forward_kinematics(PLANAR, joints)
    assert int(found.status) == Status.OTHER_MODE and np.all(np.isnan(found.pose))
    legs = np.linalg.norm(carried(PLANAR, found.candidate) - PLANAR.base, axis=1)
    np.testing.assert_allclose(legs, joints, rtol=1e-13)  # it is a solution,
    assert side(PLANAR, found.candidate) * side(PLANAR, PLANAR.home()[0]) == found.det_sign == -1
    again = pk.forward_kinematics(PLANAR, joints, found.candidate)  # and from its own side it is OK
    assert int(again.status) == Status.OK and again.det_sign == -1
    np.testing.assert_allclose(again.pose, found.candidate, rtol=0, atol=1e-13)


def carried(mech, pose):
    """Where the platform points of the planar 3-RPR are, by complex numbers. -> (3, 2)"""
    b = np.asarray(mech.platform)
    z = pose[0] + 1j * pose[1] + (b[:, 0] + 1j * b[:, 1]) * np.exp(1j * pose[2])
    return np.stack([z.real, z.imag], axis=1)


def side(mech, pose):
    """Sign of the determinant of the three leg lines' coordinates."""
    points = carried(mech, np.asarray(pose))
    f, arm = points - np.asarray(mech.base), points - np.asarray(pose)[:2]
    lines = np.column_stack([f, arm[:, 0] * f[:, 1] - arm[:, 1] * f[:, 0]])
    return np.sign(np.linalg.det(lines))


def test_forward_takes_one_guess_or_one_a_row():
    joints = np.array([[2.0, 1.5]] * 2)
    above_below = pk.forward_kinematics(RPR, joints, [[0.0, 1.0], [0.0, -1.0]])
    expected = np.array([-0.4375, np.sqrt(4 - 1.4375**2)])
    np.testing.assert_allclose(above_below.pose, [expected, expected * [1, -1]], rtol=1e-15)
    np.testing.assert_array_equal(above_below.det_sign, [1, -1])
    both_below = pk.forward_kinematics(RPR, joints, [0.0, -1.0])
    np.testing.assert_allclose(both_below.pose, [expected * [1, -1]] * 2, rtol=1e-15)
    one = pk.forward_kinematics(RPR, joints[0], [[0.0, 1.0], [0.0, -1.0]])
    np.testing.assert_array_equal(one.pose, above_below.pose)
    default = pk.forward_kinematics(RPR, joints)
    np.testing.assert_allclose(default.pose, [expected] * 2, rtol=1e-15)


def test_forward_starting_at_the_solution_or_on_a_singularity():
    solution = [-0.4375, np.sqrt(4 - 1.4375**2)]
    guesses = np.array([solution, [0.0, 0.0], [NAN, 1.0]])
    found = pk.forward_kinematics(RPR, np.array([[2.0, 1.5]] * 3), guesses)
    assert statuses(found)[0::2] == ["OK", "BAD_INPUT"]
    assert int(found.steps[0]) <= 3
    assert int(found.status[1]) != Status.OK and np.all(np.isnan(found.pose[1:]))


def test_closed_forms_and_newton_agree():
    rng = np.random.default_rng(4)
    for _ in range(15):
        poses = np.stack([rng.uniform(-0.8, 0.8, 4), rng.uniform(1.5, 2.2, 4)], axis=1)
        solved = pk.inverse_kinematics(ARMS, poses)
        found = pk.forward_kinematics(ARMS, solved.joints)
        assert set(statuses(solved)) == set(statuses(found)) == {"OK"}
        np.testing.assert_allclose(found.pose, poses, rtol=0, atol=1e-13)
        modes, _ = jax.vmap(ARMS.forward)(solved.joints)
        np.testing.assert_allclose(modes[:, 0], found.pose, rtol=0, atol=1e-13)


# ---------------------------------------------------------------- redundant: c > n


SPARE = three_legs()


def test_redundant_lengths_that_disagree_are_inconsistent():
    pose = np.array([0.7, 0.9])
    lengths = np.linalg.norm(pose - SPARE.base, axis=1)
    rows = np.stack([lengths, lengths + [0.01, 0, 0], lengths + [1e-8, 0, 0], lengths * np.nan])
    found = pk.forward_kinematics(SPARE, rows)
    assert statuses(found) == ["OK", "INCONSISTENT", "OK", "BAD_INPUT"]
    np.testing.assert_allclose(found.pose[0], pose, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(found.det_sign[:3], 0)
    assert found.residual[1] > 1e-3
    gap = np.asarray(found.candidate[1]) - pose  # still the least-squares pose
    assert 1e-4 < np.linalg.norm(gap) < 0.01


def test_redundant_derivatives_are_those_of_least_squares():
    pose = np.array([0.7, 0.9])
    legs = pose - np.asarray(SPARE.base)
    lengths = np.linalg.norm(legs, axis=1)
    solve = jax.jit(lambda q: pk.forward_kinematics(SPARE, q).pose)
    expected = np.linalg.pinv(legs) @ np.diag(lengths)  # argmin |legs dx - lengths dl|
    np.testing.assert_allclose(jax.jit(jax.jacrev(solve))(lengths), expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(solve))(lengths), expected, rtol=1e-12, atol=1e-13)
    # the velocity Jacobian weighs legs by rates, not by residuals: the pseudo-inverse of unit legs
    unit = legs / lengths[:, None]
    found = pk.velocity_jacobian(SPARE, pose, lengths)
    np.testing.assert_allclose(found, np.linalg.pinv(unit), rtol=1e-12, atol=1e-13)


def test_redundant_inverse_is_exact():
    poses = np.array([[0.7, 0.9], [1.0, 0.2]])
    assert statuses(pk.inverse_kinematics(SPARE, poses)) == ["OK", "OK"]


# ---------------------------------------------------------------- a lost row changes no other row

GOOD_POSES = {
    "2-RPR": (RPR, np.array([[0.1, 1.7], [-1.2, 1.5], [0.8, 2.1], [0.3, 0.9]])),
    "2-RRR": (ARMS, np.array([[0.1, 1.7], [-1.2, 1.5], [0.8, 2.1], [0.3, 1.9]])),
    "Delta": (DELTA, np.array([[0.05, 0.02, -0.6], [0.0, 0.1, -0.7], [-0.1, 0.0, -0.65], [0, 0, -0.6]])),
}
POISON = {"NaN": NAN, "infinite": INF, "far away": 50.0}
each_good = pytest.mark.parametrize(("mech", "poses"), GOOD_POSES.values(), ids=GOOD_POSES.keys())


@each_good
def test_poisoned_rows_leave_the_others_untouched(mech, poses):
    others = np.array([0, 2, 3])
    solved = pk.inverse_kinematics(mech, poses)
    found = pk.forward_kinematics(mech, solved.joints)
    assert set(statuses(solved)) == set(statuses(found)) == {"OK"}
    for poison in POISON.values():
        spoiled = poses.copy()
        spoiled[1, -1] = poison
        lost = pk.inverse_kinematics(mech, spoiled)
        assert int(lost.status[1]) != Status.OK or mech is RPR
        np.testing.assert_array_equal(lost.joints[others], solved.joints[others])
        spoiled = np.array(solved.joints)
        spoiled[1, 0] = poison
        lost = pk.forward_kinematics(mech, spoiled)
        assert int(lost.status[1]) != Status.OK or mech is not RPR
        for mine, theirs in zip(lost, found, strict=True):
            np.testing.assert_array_equal(mine[others], theirs[others])


@pytest.fixture(scope="module")
def gradients():
    """Gradients of sums over all rows, as careless users write them: `jnp.nansum`."""

    def of_inverse(mech, poses):
        return jnp.nansum(jnp.sin(pk.inverse_kinematics(mech, poses).joints))

    def of_forward(mech, joints):
        return jnp.nansum(jnp.sin(pk.forward_kinematics(mech, joints).pose))

    return jax.jit(jax.grad(of_inverse, argnums=(0, 1))), jax.jit(jax.grad(of_forward, argnums=(0, 1)))


@each_good
def test_gradients_of_lost_rows_are_zero_and_of_good_rows_untouched(gradients, mech, poses):
    others = np.array([0, 2, 3])
    joints = np.asarray(pk.inverse_kinematics(mech, poses).joints)
    for gradient, rows in zip(gradients, (poses, joints), strict=True):
        _, clean = gradient(mech, rows)
        assert np.all(np.isfinite(clean)) and np.all(np.any(np.asarray(clean) != 0, axis=1))
        for poison in (NAN, INF, 50.0):
            spoiled = rows.copy()
            spoiled[1] = poison
            if poison == 50 and mech is not RPR and rows is joints:
                continue  # driven angles may be anything
            if poison == 50 and mech is RPR:
                spoiled[1] = (50.0, 1.0) if rows is joints else (1.0, 0.0)  # unreachable; at a base joint
            in_geometry, dirty = gradient(mech, spoiled)
            np.testing.assert_array_equal(dirty[1], 0)
            np.testing.assert_array_equal(dirty[others], clean[others])
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(in_geometry))


def test_gradients_at_the_ends_of_the_reach_are_zero(gradients):
    poses = np.array(list(IK_ROWS.values()))[:4]
    in_geometry, in_pose = gradients[0](ARMS, poses)
    assert np.all(np.isfinite(in_pose[0])) and np.any(in_pose[0] != 0)
    np.testing.assert_array_equal(in_pose[1:], 0)
    alone, _ = gradients[0](ARMS, np.array([poses[0], [NAN, 0], [NAN, 0], [NAN, 0]]))
    for mine, theirs in zip(jax.tree.leaves(in_geometry), jax.tree.leaves(alone), strict=True):
        assert np.isfinite(mine) and mine == theirs != 0


class Rail(pk.LegMechanism):
    """Two carriages on the x axis and a rod each, with the inverse as one writes it down first."""

    rod: jax.Array

    def attachments(self):
        return jnp.zeros((2, 2))

    def legs(self, points, joints):
        return ((points[:, 0] - joints) ** 2 + points[:, 1] ** 2 - self.rod**2) / 2

    def inverse(self, pose, branch=None, *, free=None):
        return pose[0] + jnp.sqrt(self.rod**2 - pose[1] ** 2) * jnp.array([1.0, -1.0])

    def home(self):
        pose = lax.stop_gradient(jnp.stack([0 * self.rod, 0.6 * self.rod]))
        return pose, self.inverse(pose)

    def length(self):
        return self.rod

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], ())


def test_a_users_unguarded_square_root_is_guarded(gradients):
    """NaN beyond the rod's reach and an infinite derivative at its end: neither gets out."""
    rail, poses = Rail(rod=1.0), np.array([[0.1, 0.6], [0.0, 1.5], [0.0, 1.0], [NAN, 0.0]])
    assert statuses(pk.inverse_kinematics(rail, poses)) == ["OK", "UNREACHABLE", "SINGULAR", "BAD_INPUT"]
    in_geometry, in_pose = gradients[0](rail, poses)
    np.testing.assert_array_equal(in_pose[1:], 0)
    expected = np.cos(0.9) - np.cos(-0.7)  # of sin(x + s) + sin(x - s) in s = sqrt(rod^2 - y^2) = 0.8
    np.testing.assert_allclose(in_geometry.rod, expected / 0.8, rtol=1e-13)
    np.testing.assert_allclose(in_pose[0], [np.cos(0.9) + np.cos(0.7), -0.75 * expected], rtol=1e-13)


# ---------------------------------------------------------------- derivatives

SMOOTH = {
    "2-RRR": (ARMS, np.array([0.7, 2.3])),
    "Delta": (DELTA, np.array([0.2, -0.1, 0.3])),
}


def central(function, point, step):
    units = step * np.eye(point.size)
    return np.stack([(function(point + u) - function(point - u)) / (2 * step) for u in units], axis=-1)


forward_pose = jax.jit(lambda mech, q: pk.forward_kinematics(mech, q).pose)
forward_rate = jax.jit(jax.jacfwd(lambda mech, q: pk.forward_kinematics(mech, q).pose, argnums=1))
forward_rate_reverse = jax.jit(jax.jacrev(lambda mech, q: pk.forward_kinematics(mech, q).pose, argnums=1))


@pytest.mark.parametrize(("mech", "joints"), SMOOTH.values(), ids=SMOOTH.keys())
def test_velocity_jacobian_is_the_slope_of_forward_kinematics(mech, joints):
    pose = forward_pose(mech, joints)
    found = pk.velocity_jacobian(mech, pose, joints)
    slope = central(lambda q: np.asarray(forward_pose(mech, q)), joints, 1e-5)
    size = np.max(np.abs(slope))
    np.testing.assert_allclose(found / size, slope / size, rtol=0, atol=1e-8)
    np.testing.assert_allclose(forward_rate(mech, joints) / size, found / size, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["2-RRR", "Delta"])
def test_second_derivatives_of_forward_kinematics(name):
    """Twice through the implicit function theorem; one differentiable Newton step gets them wrong."""
    mech, joints = SMOOTH[name]
    exact = jax.jit(jax.jacfwd(forward_rate, argnums=1))(mech, joints)
    slope = central(lambda q: np.asarray(forward_rate(mech, q)), joints, 1e-5)
    size = np.max(np.abs(slope))
    assert size > 0.1
    np.testing.assert_allclose(exact / size, slope / size, rtol=0, atol=1e-8)
    np.testing.assert_allclose(exact, np.swapaxes(exact, 1, 2), rtol=0, atol=1e-12 * size)
    if name == "2-RRR":
        reverse = jax.jit(jax.jacfwd(forward_rate_reverse, argnums=1))(mech, joints)
        np.testing.assert_allclose(reverse, exact, rtol=0, atol=1e-12 * size)


@pytest.mark.soak
def test_second_derivatives_of_newtons_inverse():
    rate = jax.jit(jax.jacfwd(lambda x: pk.inverse_kinematics(DELTA, x).joints))
    pose = np.array([0.05, 0.02, -0.6])
    slope = central(lambda x: np.asarray(rate(x)), pose, 1e-5)
    exact = jax.jit(jax.jacfwd(rate))(pose)
    size = np.max(np.abs(slope))
    np.testing.assert_allclose(exact / size, slope / size, rtol=0, atol=1e-8)
    joints = pk.inverse_kinematics(DELTA, pose).joints
    a, b = pk.pose_jacobian(DELTA, pose, joints), pk.joint_jacobian(DELTA, pose, joints)
    np.testing.assert_allclose(rate(pose), -np.linalg.solve(b, a), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", ["2-RRR", "Delta"])
def test_geometry_gradients_through_the_solver(name):
    mech, joints = SMOOTH[name]
    weights = np.linspace(1.0, 2.0, joints.size)
    value = jax.jit(lambda mech: jnp.sum(weights * forward_pose(mech, joints)))
    gradient = jax.jit(jax.grad(value))(mech)
    assert type(gradient) is type(mech)
    leaves, tree = jax.tree.flatten(mech)
    for i, entry in enumerate(jax.tree.leaves(gradient)):
        moved = lambda h, i=i: float(value(tree.unflatten([x + h * (i == k) for k, x in enumerate(leaves)])))
        np.testing.assert_allclose(entry, (moved(1e-5) - moved(-1e-5)) / 2e-5, rtol=1e-8, atol=1e-9)


# ---------------------------------------------------------------- jit, vmap, and what comes in


def test_jit_and_vmap_change_nothing():
    poses = GOOD_POSES["2-RRR"][1]
    batch = pk.inverse_kinematics(ARMS, poses)
    for found in (
        jax.jit(pk.inverse_kinematics)(ARMS, poses),
        jax.vmap(lambda pose: pk.inverse_kinematics(ARMS, pose))(poses),
    ):
        np.testing.assert_array_equal(found.status, batch.status)
        np.testing.assert_allclose(found.joints, batch.joints, rtol=0, atol=1e-15)
    batch = pk.forward_kinematics(ARMS, batch.joints)
    joints = pk.inverse_kinematics(ARMS, poses).joints
    found = jax.jit(jax.vmap(pk.forward_kinematics, in_axes=(None, 0)))(ARMS, joints)
    np.testing.assert_array_equal(found.status, batch.status)
    np.testing.assert_allclose(found.pose, batch.pose, rtol=0, atol=1e-14)


def test_many_traced_rows_are_those_of_known_ones():
    """From 4096 rows on they go on lanes, and those that are lost are tried once more."""
    home = np.asarray(PLANAR.home()[0])
    poses = home + 0.3 * np.random.default_rng(6).uniform(-1, 1, (4096, 3))
    joints = np.array(pk.inverse_kinematics(PLANAR, poses).joints)
    joints[[7, 900]], joints[8, 1] = [[9.0, 0.1, 0.1], [0.01, 5.0, 0.2]], NAN
    known = pk.forward_kinematics(PLANAR, joints)
    traced = jax.jit(lambda joints: pk.forward_kinematics(PLANAR, joints))(joints)
    np.testing.assert_array_equal(traced.status, known.status)
    assert np.sum(known.status == Status.OK) > 4000 and not np.any(known.status[np.array([7, 8, 900])] == 0)
    np.testing.assert_allclose(traced.pose, known.pose, rtol=0, atol=1e-12)
    np.testing.assert_allclose(traced.sigma_min, known.sigma_min, rtol=1e-6)


def test_a_constant_has_no_derivatives_of_any_kind_of_number():
    constant = batching.without_derivatives(lambda x: (jnp.sin(x), jnp.argmax(x)))
    found, slopes = jax.jvp(constant, (jnp.arange(3.0),), (jnp.ones(3),))
    np.testing.assert_array_equal(found[0], np.sin(np.arange(3.0)))
    np.testing.assert_array_equal(slopes[0], np.zeros(3))
    assert slopes[0].dtype == jnp.float64 and slopes[1].dtype == jax.dtypes.float0


def test_a_batch_of_mechanisms():
    sizes = np.array([1.0, 2.0, 1000.0])
    mechs = jax.vmap(lambda s: jax.tree.map(lambda leaf: leaf * s, ARMS))(sizes)
    found = jax.jit(jax.vmap(pk.inverse_kinematics))(mechs, sizes[:, None] * np.array([0.1, 1.7]))
    np.testing.assert_allclose(found.joints[1:], np.asarray(found.joints)[[0, 0]], rtol=1e-14)
    rates = jax.vmap(jax.grad(lambda m, x: pk.inverse_kinematics(m, x).joints[0]), in_axes=(0, None))(
        mechs, np.array([0.1, 1.7])
    )
    assert isinstance(rates, pk.FiveBar) and rates.proximal.shape == (3,)
    assert rates.proximal[0] != 0 and rates.proximal[2] == 0  # the last one is out of reach


@pytest.mark.parametrize("make", [np.array, jnp.array, list, tuple, np.float32], ids=lambda f: f.__name__)
def test_anything_like_an_array_will_do(make):
    expected = pk.inverse_kinematics(RPR, [[0.0, 1.0], [2.0, 1.0]]).joints
    np.testing.assert_allclose(expected, np.sqrt([[2, 2], [2, 10]]), rtol=1e-15)
    found = pk.inverse_kinematics(RPR, make([[0.0, 1.0], [2.0, 1.0]]))
    np.testing.assert_array_equal(found.joints, expected)
    assert found.joints.dtype == jnp.float64


def test_integers_are_numbers():
    np.testing.assert_allclose(pk.inverse_kinematics(RPR, [0, 1]).joints, np.sqrt([2, 2]), rtol=1e-15)
    np.testing.assert_allclose(pk.forward_kinematics(RPR, np.array([2, 2])).pose, [0, np.sqrt(3)], atol=1e-15)
    found = pk.inverse_kinematics(ARMS, [0.1, 1.7], np.array([1, -1]))
    np.testing.assert_array_equal(found.joints, pk.inverse_kinematics(ARMS, [0.1, 1.7]).joints)


def test_no_rows_give_no_rows():
    solved = pk.inverse_kinematics(ARMS, np.zeros((0, 2)))
    assert solved.joints.shape == (0, 2) and solved.status.shape == (0,)
    found = pk.forward_kinematics(ARMS, np.zeros((0, 2)))
    assert found.pose.shape == (0, 2) and found.status.shape == (0,) and found.residual.shape == (0,)


NOT_A_PAIR = {
    "a scalar": 1.0,
    "three numbers": [1.0, 2.0, 3.0],
    "rows of three": [[1.0, 2.0, 3.0]],
    "a batch of batches": np.zeros((2, 3, 2)),
    "empty": [],
    "ragged": [[1.0], [1.0, 2.0]],
    "a string": "1, 2",
    "strings": ["1", "2"],
    "complex": [1.0 + 0j, 2.0],
    "bools": [True, False],
    "a bool": True,
    "a dict": {"x": 1.0, "y": 2.0},
    "objects": [object(), object()],
}
CALLS = {
    "pose": lambda bad: pk.inverse_kinematics(ARMS, bad),
    "branch": lambda bad: pk.inverse_kinematics(ARMS, [0.1, 1.7], bad),
    "joints": lambda bad: pk.forward_kinematics(ARMS, bad),
    "guess": lambda bad: pk.forward_kinematics(ARMS, [0.7, 2.3], bad),
}


def said_by(call, *arguments):
    with pytest.raises(ValueError) as caught:
        call(*arguments)
    said = str(caught.value)
    assert "\n" not in said and len(said) < 250
    return said


@pytest.mark.parametrize("bad", NOT_A_PAIR.values(), ids=NOT_A_PAIR.keys())
@pytest.mark.parametrize("name", CALLS)
def test_bad_input_is_told_at_the_door(name, bad):
    assert said_by(CALLS[name], bad).startswith(f"{name} must ")


@pytest.mark.parametrize("name", ["pose", "joints"])
def test_a_missing_input_is_told(name):
    assert said_by(CALLS[name], None).startswith(f"{name} must ")


def test_poses_in_another_unit_are_noticed_where_they_were_given():
    there = [[900.0, 0.2, 0.1], [900.0, 0.3, 0.1]]
    with pytest.warns(UserWarning, match="are they in one unit") as told:
        pk.inverse_kinematics(PLANAR, there)
    assert [each.filename for each in told] == [__file__]
    pk.inverse_kinematics(PLANAR, [[0.1, 0.2, 900.0]])  # an angle may be any


def test_a_mechanism_without_signs_has_one_working_mode():
    assert pk.working_modes(RPR).shape == (1, 0)
    np.testing.assert_array_equal(pk.working_modes(ARMS)[0], ARMS.default_branch())
    assert {tuple(row) for row in pk.working_modes(ARMS)} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}


def test_a_wrong_shape_is_written_like_a_shape():
    assert said_by(CALLS["pose"], [1.0, 2.0, 3.0]) == "pose must have shape (2,), got (3,)"


def test_a_redundant_distance_is_positive():
    casing = pk.CasingOscillator()
    rows = [0.73, 0.0, -1.0, NAN]
    found = pk.inverse_kinematics(casing, casing.home()[0], free=np.array(rows)[:, None])
    assert statuses(found) == ["OK", "BAD_INPUT", "BAD_INPUT", "BAD_INPUT"]


@pytest.mark.parametrize("branch", [[0, 1], [1, 2], [1, -0.5], [NAN, 1], [INF, 1], [[1, 1], [1, 3]]])
def test_a_branch_holds_signs(branch):
    assert "+1 and -1" in said_by(CALLS["branch"], branch)


@pytest.mark.parametrize("branch", [[0.0, 1.0], [1.0, 2.0], [NAN, 1.0]])
def test_a_branch_without_signs_is_never_ok_under_jit(branch):
    """No value can be refused there, so the row is told and its joints are NaN."""
    found = jax.jit(pk.inverse_kinematics)(ARMS, np.array([0.1, 1.7]), np.array(branch))
    assert int(found.status) == Status.BAD_INPUT
    assert np.all(np.isnan(found.joints))


def test_batches_of_different_sizes_are_told():
    said = said_by(pk.inverse_kinematics, ARMS, np.ones((3, 2)), np.ones((2, 2)))
    assert "2" in said and "3" in said and "rows" in said
    said = said_by(pk.forward_kinematics, ARMS, np.ones((3, 2)), np.ones((2, 2)))
    assert "2" in said and "3" in said and "rows" in said


def test_impossible_geometry_under_jit_is_never_ok():
    """Inside jit no constructor looks at values."""

    @jax.jit
    def solve(half_base):
        mech = pk.TwoRPR(half_base=half_base, l_min=1.0, l_max=3.0)
        return pk.inverse_kinematics(mech, [0.1, 1.7]), pk.forward_kinematics(mech, [2.0, 1.5])

    assert [int(found.status) for found in solve(1.0)] == [Status.OK, Status.OK]
    solved, found = solve(NAN)
    assert int(solved.status) != Status.OK and np.all(np.isnan(solved.joints))
    assert int(found.status) != Status.OK and np.all(np.isnan(found.pose))


# ---------------------------------------------------------------- float32


def test_float32_stays_float32_and_works():
    arms = pk.FiveBar(half_base=np.float32(1), proximal=np.float32(1), distal=np.float32(2.15))
    poses = GOOD_POSES["2-RRR"][1]
    solved = pk.inverse_kinematics(arms, poses)
    found = pk.forward_kinematics(arms, solved.joints)
    assert set(statuses(solved)) == set(statuses(found)) == {"OK"}
    for array in (solved.joints, solved.candidate, found.pose, found.residual, found.sigma_min):
        assert array.dtype == jnp.float32
    np.testing.assert_allclose(found.pose, poses, rtol=0, atol=2e-6)
    np.testing.assert_allclose(solved.joints, pk.inverse_kinematics(ARMS, poses).joints, atol=2e-6)


def test_without_x64_everything_is_float32():
    with jax.enable_x64(False):
        mech = pk.TwoRPR(half_base=1.0, l_min=1, l_max=3.0)
        assert {leaf.dtype for leaf in jax.tree.leaves(mech)} == {jnp.dtype("float32")}
        solved = pk.inverse_kinematics(mech, np.array([0.3, 1.2]))
        found = pk.forward_kinematics(mech, solved.joints)
        rate = jax.grad(lambda q: pk.forward_kinematics(mech, q).pose[0])(solved.joints)
        assert int(solved.status) == int(found.status) == Status.OK
        assert solved.joints.dtype == found.pose.dtype == rate.dtype == jnp.float32
        np.testing.assert_allclose(found.pose, [0.3, 1.2], rtol=0, atol=1e-6)
        # eq. 18: dx/dl1 = -l1 / (2 R)
        np.testing.assert_allclose(rate, [-solved.joints[0] / 2, solved.joints[1] / 2], rtol=1e-5)
    assert pk.inverse_kinematics(RPR, [0.3, 1.2]).joints.dtype == jnp.float64
