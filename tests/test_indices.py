"""Isotropy and resistivity against numpy, at every kind of singularity, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from outsiders import delta, three_legs, three_rpr

import pk_jax as pk
from pk_jax import Status

R, LA, LB = 1.0, 1.3, 1.9
RPR = pk.TwoRPR(half_base=R, l_min=1.0, l_max=3.0)
ARMS = pk.FiveBar(half_base=R, proximal=LA, distal=LB)
MODES = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def rpr_jacobian(pose):
    """J = Jx^-1 Jq of Nam, Lee and Park (2006), eqs. 8, 10, 11."""
    legs = np.array([[pose[0] - R, pose[1]], [pose[0] + R, pose[1]]])
    return np.linalg.solve(legs, np.diag(np.hypot(*legs.T)))


def arms_jacobian(pose, phi, la=LA, half_base=R):
    """Eqs. 8, 14, 15."""
    elbows = np.array([[half_base, 0], [-half_base, 0]]) + la * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    X, Y = (np.asarray(pose) - elbows).T
    j_q = np.diag(-la * (X * np.sin(phi) - Y * np.cos(phi)))
    return np.linalg.solve(np.stack([X, Y], axis=1), j_q)


def expected(jacobian):
    """1 / kappa and 1 / |det| by numpy."""
    sigma = np.linalg.svd(jacobian, compute_uv=False)
    return sigma[-1] / sigma[0], 1 / np.prod(sigma)


# ---------------------------------------------------------------- values


def test_two_rpr_indices_are_those_of_numpy():
    rng = np.random.default_rng(1)
    poses = np.stack([rng.uniform(-2, 2, 40), rng.uniform(-2, 2, 40)], axis=1)
    found = pk.local_indices(RPR, poses)
    assert np.all(found.status == Status.OK)
    isotropy, resistivity = np.array([expected(rpr_jacobian(pose)) for pose in poses]).T
    np.testing.assert_allclose(found.isotropy, isotropy, rtol=1e-12)
    np.testing.assert_allclose(found.resistivity, resistivity, rtol=1e-12)


def test_five_bar_indices_are_those_of_numpy_in_every_working_mode():
    rng = np.random.default_rng(2)
    poses = np.stack([rng.uniform(-0.9, 0.9, 40), rng.uniform(1.0, 2.2, 40)], axis=1)
    modes = np.repeat(MODES, 10, axis=0)
    found = pk.local_indices(ARMS, poses, modes)
    joints = pk.inverse_kinematics(ARMS, poses, modes).joints
    assert np.all(found.status == Status.OK)
    jacobians = [arms_jacobian(pose, phi) for pose, phi in zip(poses, np.asarray(joints), strict=True)]
    isotropy, resistivity = np.array([expected(j) for j in jacobians]).T
    np.testing.assert_allclose(found.isotropy, isotropy, rtol=1e-11)
    np.testing.assert_allclose(found.resistivity, resistivity, rtol=1e-11)
    assert np.ptp(isotropy) > 0.5


def test_five_bar_default_mode_is_elbows_out():
    poses = np.array([[0.2, 1.6], [-0.5, 2.0]])
    default, out, other = (pk.local_indices(ARMS, poses, *b) for b in ((), ([1, -1],), ([-1, 1],)))
    np.testing.assert_array_equal(default.isotropy, out.isotropy)
    assert np.all(np.abs(default.isotropy - other.isotropy) > 1e-3)


@given(st.floats(-3, 3), st.floats(0.01, 3))
def test_two_rpr_resistivity_follows_from_isotropy(x, y):
    """J^-1 has unit rows, so omega = 2 k / (1 + k^2), k = 1 / kappa: one index says both."""
    found = pk.local_indices(RPR, np.array([x, y]))
    k = float(found.isotropy)
    np.testing.assert_allclose(found.resistivity, 2 * k / (1 + k * k), rtol=1e-12)


def test_a_mechanism_of_mixed_units_is_measured_in_its_length():
    """Planar 3-RPR: 1/kappa of J with lengths over length(); 1/|det J| in its own unit."""
    mech, pose = three_rpr(), np.array([0.5, 0.45, 1.2])
    joints = pk.inverse_kinematics(mech, pose).joints
    j = np.asarray(pk.velocity_jacobian(mech, pose, joints))
    L = float(mech.length())
    scaled = np.diag([1 / L, 1 / L, 1]) @ j * L
    found = pk.local_indices(mech, pose)
    np.testing.assert_allclose(found.isotropy, expected(scaled)[0], rtol=1e-12)
    np.testing.assert_allclose(found.resistivity, 1 / abs(np.linalg.det(j)), rtol=1e-12)


def test_a_mechanism_without_closed_form_has_indices():
    mech, pose = delta(), np.array([0.05, 0.02, -0.6])
    joints = pk.inverse_kinematics(mech, pose).joints
    isotropy, resistivity = expected(np.asarray(pk.velocity_jacobian(mech, pose, joints)))
    found = pk.local_indices(mech, pose)
    np.testing.assert_allclose(found.isotropy, isotropy, rtol=1e-12)
    np.testing.assert_allclose(found.resistivity, resistivity, rtol=1e-12)


def test_a_redundant_mechanism_has_indices():
    """c > n: 1 / sqrt(det(J J^T)) with J the pseudo-inverse of the legs' unit vectors."""
    mech, pose = three_legs(), np.array([0.9, 0.4])
    legs = pose - np.asarray(mech.base)
    j = np.linalg.pinv(legs / np.linalg.norm(legs, axis=1, keepdims=True))
    found = pk.local_indices(mech, pose)
    assert int(found.status) == Status.OK
    np.testing.assert_allclose(found.isotropy, expected(j)[0], rtol=1e-12)
    np.testing.assert_allclose(found.resistivity, 1 / np.sqrt(np.linalg.det(j @ j.T)), rtol=1e-12)


@pytest.mark.parametrize("s", [1e-3, 85.0, 1e4])
def test_units_scale_as_they_must(s):
    """Angles drive the five-bar: det J is an area a square radian, 1/|det J| goes with 1 / s^2."""
    pose = np.array([0.3, 1.7])
    small, large = (
        pk.local_indices(ARMS, pose),
        pk.local_indices(jax.tree.map(lambda x: s * x, ARMS), s * pose),
    )
    np.testing.assert_allclose(large.isotropy, small.isotropy, rtol=1e-11)
    np.testing.assert_allclose(large.resistivity * s**2, small.resistivity, rtol=1e-11)
    small, large = pk.local_indices(RPR, pose), pk.local_indices(jax.tree.map(lambda x: s * x, RPR), s * pose)
    np.testing.assert_allclose(large.isotropy, small.isotropy, rtol=1e-12)
    np.testing.assert_allclose(large.resistivity, small.resistivity, rtol=1e-12)


# ---------------------------------------------------------------- isotropic and singular poses

# distal links at 45 degrees to the axis of symmetry, perpendicular: the elbows are LB / sqrt 2 outside
ISOTROPIC_ARMS = np.array([0.0, LA * np.sqrt(1 - ((LB / np.sqrt(2) - R) / LA) ** 2) + LB / np.sqrt(2)])
ISOTROPIC_RPR = np.array([0.0, R])  # the legs are perpendicular


def along(angle, distance):
    return np.array([R + distance * np.cos(angle), distance * np.sin(angle)])


@pytest.fixture(scope="module")
def gradient():
    """d isotropy, d resistivity / d (mechanism, pose), summed over the rows that have a value."""

    def of(which):
        def total(mech, poses):
            value = pk.local_indices(mech, poses)[which]
            return jnp.sum(jnp.where(jnp.isfinite(value), value, 0))

        return jax.jit(jax.grad(total, argnums=(0, 1)))

    return of(0), of(1)


CASES = {
    "2-RPR": (
        RPR,
        {
            "OK, isotropic": (ISOTROPIC_RPR, 1.0, 1.0),
            "OK, isotropic, J a rotation": (-ISOTROPIC_RPR, 1.0, 1.0),
            "OK": ((0.4, 0.9), *expected(rpr_jacobian(np.array([0.4, 0.9])))),
            "SINGULAR, on the base line": ((0.3, 0.0), 0.0, 0.0),
            "SINGULAR, on the base line outside": ((-1.7, 0.0), 0.0, 0.0),
            "BAD_INPUT, NaN": ((np.nan, 1.0), np.nan, np.nan),
            "BAD_INPUT, infinite": ((0.0, np.inf), np.nan, np.nan),
        },
    ),
    "2-RRR": (
        ARMS,
        {
            "OK, isotropic": (ISOTROPIC_ARMS, 1.0, None),
            "SINGULAR, stretched": (along(2.2, LA + LB), 0.0, np.inf),
            "SINGULAR, folded": (along(2.0, LB - LA), 0.0, np.inf),
            "UNREACHABLE": ((9.0, 9.0), np.nan, np.nan),
            "BAD_INPUT, NaN": ((0.1, np.nan), np.nan, np.nan),
            "BAD_INPUT, infinite": ((-np.inf, 1.0), np.nan, np.nan),
        },
    ),
}


@pytest.mark.parametrize(("mech", "rows"), CASES.values(), ids=CASES.keys())
def test_every_row_gets_its_status_and_its_limit(mech, rows):
    found = pk.local_indices(mech, np.array([pose for pose, _, _ in rows.values()]))
    assert [Status(int(s)).name for s in found.status] == [name.partition(",")[0] for name in rows]
    np.testing.assert_allclose(found.isotropy, [k for _, k, _ in rows.values()], rtol=1e-12, atol=1e-15)
    known = [i for i, (_, _, omega) in enumerate(rows.values()) if omega is not None]
    resistivity = [list(rows.values())[i][2] for i in known]
    np.testing.assert_allclose(np.asarray(found.resistivity)[known], resistivity, rtol=1e-12, atol=1e-15)
    assert found.resistivity[0] > 0


@pytest.mark.parametrize(("mech", "rows"), CASES.values(), ids=CASES.keys())
def test_derivatives_are_finite_on_every_row(gradient, mech, rows):
    poses = np.array([pose for pose, _, _ in rows.values()])
    for which, of in enumerate(gradient):
        in_geometry, in_pose = of(mech, poses)
        assert np.all(np.isfinite(in_pose))
        assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(in_geometry))
        for row, name in enumerate(rows):
            if not name.startswith("OK") and "base line" not in name:
                np.testing.assert_array_equal(in_pose[row], 0)
        if which == 0 and mech is RPR:  # exactly isotropic: the mean of all directions
            np.testing.assert_array_equal(in_pose[:2], 0)


def test_the_isotropic_pose_is_a_conical_point():
    """1 / kappa falls off linearly on both sides, so zero is a choice, not a stationary point."""
    step = 1e-4
    poses = ISOTROPIC_RPR + step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    fall = (1 - np.asarray(pk.local_indices(RPR, poses).isotropy)) / step
    assert np.all(fall[2:] > 0.5)


def test_parallel_distal_links_are_a_type_two_singularity():
    """Both distal links on one horizontal line: X1 Y2 - X2 Y1 = 0."""
    mech = pk.FiveBar(half_base=1.0, proximal=1.0, distal=1.2)
    pose = np.array([0.0, np.sqrt(1 - 0.2**2)])  # elbows at +-1.2
    found = pk.local_indices(mech, pose)
    assert int(found.status) == Status.SINGULAR
    np.testing.assert_allclose([found.isotropy, found.resistivity], 0, atol=1e-14)


@pytest.mark.soak
def test_derivatives_agree_with_central_differences(gradient):
    rng = np.random.default_rng(3)
    poses = np.stack([rng.uniform(-0.9, 0.9, 6), rng.uniform(1.2, 2.2, 6)], axis=1)
    step = 1e-5
    for which, of in enumerate(gradient):
        for mech in (RPR, ARMS):
            in_geometry, in_pose = of(mech, poses)
            value = lambda m, x, which=which: np.asarray(pk.local_indices(m, x)[which])
            for axis in range(2):
                h = step * np.eye(2)[axis]
                slope = (value(mech, poses + h) - value(mech, poses - h)) / (2 * step)
                np.testing.assert_allclose(in_pose[:, axis], slope, rtol=1e-6, atol=1e-7)
            h = jax.tree.map(lambda leaf: step * jnp.ones_like(leaf), mech)
            plus, minus = (jax.tree.map(lambda a, b, s=s: a + s * b, mech, h) for s in (1, -1))
            slope = np.sum(value(plus, poses) - value(minus, poses)) / (2 * step)
            np.testing.assert_allclose(sum(jax.tree.leaves(in_geometry)), slope, rtol=1e-6)


def test_lost_rows_change_no_other_row():
    poses = np.array([[0.2, 1.6], [-0.5, 2.0], [0.1, 1.9]])
    clean = pk.local_indices(ARMS, poses)
    for poison in (np.nan, np.inf, 50.0):
        spoiled = poses.copy()
        spoiled[1, 0] = poison
        found = pk.local_indices(ARMS, spoiled)
        assert int(found.status[1]) != Status.OK
        for mine, theirs in zip(found, clean, strict=True):
            np.testing.assert_array_equal(np.asarray(mine)[[0, 2]], np.asarray(theirs)[[0, 2]])


# ---------------------------------------------------------------- the door


def test_one_row_many_rows_and_none():
    one = pk.local_indices(ARMS, [0.2, 1.6])
    many = pk.local_indices(ARMS, [[0.2, 1.6]] * 3)
    assert one.isotropy.shape == () and many.isotropy.shape == many.status.shape == (3,)
    np.testing.assert_allclose(many.isotropy, one.isotropy, rtol=1e-15)
    assert pk.local_indices(ARMS, np.zeros((0, 2))).resistivity.shape == (0,)


@pytest.mark.parametrize("bad", [[1.0, 2.0, 3.0], "12", 1j, [True, False], [[1], [1, 2]], None])
def test_bad_poses_are_told(bad):
    with pytest.raises(ValueError, match=r"^pose must [^\n]*$"):
        pk.local_indices(ARMS, bad)


@pytest.mark.parametrize("bad", [[1.0, 0.5], [1, 1, 1], "+-", [np.nan, 1.0]])
def test_bad_branches_are_told(bad):
    with pytest.raises(ValueError, match=r"^branch must [^\n]*$"):
        pk.local_indices(ARMS, [0.2, 1.6], bad)


@pytest.mark.soak
def test_many_rows_of_a_platform_in_space_come_back():
    """Batched calls of LAPACK that did not wait for one another blocked each other for good."""
    mech = pk.catalogued("semi-regular-stewart")
    home = mech.home()[0]
    shifts = np.random.default_rng(0).uniform(-0.1, 0.1, (26_000, 3))
    rotations = np.broadcast_to(home.rotation, (len(shifts), 3, 3))
    found = pk.local_indices(mech, pk.SE3(np.asarray(home.translation) + shifts, rotations))
    few = pk.local_indices(mech, pk.SE3(np.asarray(home.translation) + shifts[:3], rotations[:3]))
    np.testing.assert_allclose(found.isotropy[:3], few.isotropy, rtol=1e-12)
