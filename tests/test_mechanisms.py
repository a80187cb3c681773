"""The 2-RPR and the 2-RRR against the equations of Nam, Lee and Park (2006), typed here afresh."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import pk_jax as pk

MODES = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
EPS = np.finfo(float).eps

pose_jacobian = jax.jit(pk.pose_jacobian)
joint_jacobian = jax.jit(pk.joint_jacobian)
velocity_jacobian = jax.jit(pk.velocity_jacobian)
inverse = jax.jit(lambda mech, pose, branch: mech.inverse(pose, branch))
forward = jax.jit(lambda mech, joints: mech.forward(joints))
residual = jax.jit(lambda mech, pose, joints: mech.residual(pose, joints))
home = jax.jit(lambda mech: mech.home())
inverse_rate = jax.jit(jax.jacfwd(lambda mech, pose, branch: mech.inverse(pose, branch), argnums=1))


def turns(angle):
    """The angle modulo full turns, in (-pi, pi]."""
    return np.angle(np.exp(1j * np.asarray(angle)))


# ---------------------------------------------------------------- the paper's equations


def legs_of(R, pose):
    """From B_1 = (R, 0) and B_2 = (-R, 0) to C. -> (2, 2)"""
    return np.array([[pose[0] - R, pose[1]], [pose[0] + R, pose[1]]])


def eq_2(R, pose):
    x, y = pose
    return np.array([np.sqrt((x - R) ** 2 + y**2), np.sqrt((x + R) ** 2 + y**2)])


def eq_5(R, la, lb, pose):
    """alpha, beta, gamma of the quadratic in tan(phi / 2), a column a leg."""
    x, y = pose
    alpha = 2 * la * np.array([x - R, x + R])
    beta = 2 * la * np.array([y, y])
    return alpha, beta, -(alpha**2 + beta**2) / (4 * la**2) + lb**2 - la**2


def eq_6(R, la, lb, pose, signs):
    """phi_1, phi_2 where gamma != alpha. Analytic: complex poses give derivatives (`slope`)."""
    alpha, beta, gamma = eq_5(R, la, lb, pose)
    root = np.sqrt(alpha**2 + beta**2 - gamma**2)
    return 2 * np.arctan((-beta + signs * root) / (gamma - alpha))


def eq_6_degenerate(R, la, lb, pose):
    """The finite root where gamma = alpha, corrected: the paper leaves out the arctangent."""
    alpha, beta, gamma = eq_5(R, la, lb, pose)
    return 2 * np.arctan(-(gamma + alpha) / (2 * beta))


def eq_10_11(R, pose, lengths):
    """Jq, Jx of the 2-RPR."""
    x, y = pose
    return np.diag(lengths), np.array([[x - R, y], [x + R, y]])


def eq_14_15(R, la, pose, phi):
    """Jq, Jx of the 2-RRR."""
    x, y = pose
    X = np.array([x - R - la * np.cos(phi[0]), x + R - la * np.cos(phi[1])])
    Y = np.array([y - la * np.sin(phi[0]), y - la * np.sin(phi[1])])
    return np.diag(-la * (X * np.sin(phi) - Y * np.cos(phi))), np.array([[X[0], Y[0]], [X[1], Y[1]]])


def eq_18(R, lengths):
    l1, l2 = lengths
    x = (l2**2 - l1**2) / (4 * R)
    return np.array([x, np.sqrt(l1**2 - (x - R) ** 2)])


def eq_19(R, lengths):
    """Whether a real y exists."""
    l1, l2 = lengths
    return (l1 - l2 + 2 * R) * (l1 + l2 - 2 * R) * (l1 - l2 - 2 * R) <= 0


def slope(function, pose):
    """d function / d pose by complex steps: as exact as the function itself. -> (m, 2)"""
    step = 1e-30
    return np.stack([function(pose + 1j * step * unit).imag / step for unit in np.eye(2)], axis=1)


# ---------------------------------------------------------------- mechanisms and configurations

rpr_poses = [(0.0, 1.2), (0.7, 0.4), (-1.5, 2.0), (0.3, -1.1)]
rpr_designs = st.builds(
    lambda size, low, stroke: (size, size * low, size * (max(low, 1.0) + stroke)),
    st.floats(-3, 4).map(lambda power: 10**power),
    st.floats(0.05, 5),
    st.floats(0.05, 5),
)
five_bars = st.tuples(
    st.floats(-3, 4).map(lambda power: 10**power), st.floats(0.6, 6), st.floats(0.6, 6)
).map(lambda drawn: (drawn[0], drawn[0] * drawn[1], drawn[0] * drawn[2]))
angles = st.floats(-3.1, 3.1)


def two_rpr(R, l_min, l_max):
    return pk.TwoRPR(half_base=R, l_min=l_min, l_max=l_max)


def five_bar(R, la, lb):
    return pk.FiveBar(half_base=R, proximal=la, distal=lb)


def assembled(design, phi1, phi2, mode):
    """A five-bar, its joints, an assembled pose found here by complex numbers, its working mode."""
    R, la, lb = design
    first, second = R + la * np.exp(1j * phi1), -R + la * np.exp(1j * phi2)
    apart = second - first
    assume(0.05 * lb < abs(apart) < 1.98 * lb)
    point = (first + second) / 2 + mode * 1j * apart / abs(apart) * np.sqrt(lb**2 - abs(apart) ** 2 / 4)
    sines = np.array(
        [((point - elbow) * np.exp(-1j * phi)).imag / lb for elbow, phi in ((first, phi1), (second, phi2))]
    )
    assume(np.all(np.abs(sines) > 0.05))
    return five_bar(*design), np.array([phi1, phi2]), np.array([point.real, point.imag]), np.sign(sines)


# ---------------------------------------------------------------- 2-RPR


@pytest.mark.parametrize("pose", rpr_poses)
def test_two_rpr_jacobians_are_eqs_10_and_11(pose):
    mech, pose = two_rpr(1.0, 1.0, 3.0), np.array(pose)
    lengths = eq_2(1.0, pose)
    j_q, j_x = eq_10_11(1.0, pose, lengths)
    np.testing.assert_allclose(pose_jacobian(mech, pose, lengths), j_x, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(joint_jacobian(mech, pose, lengths), -j_q, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(velocity_jacobian(mech, pose, lengths), np.linalg.solve(j_x, j_q), rtol=1e-13)


@given(rpr_designs, st.floats(-3, 3), st.floats(0.05, 3))
def test_two_rpr_determinant_is_eq_12_corrected(design, x, y):
    """det J = det Jq / det Jx = -l1 l2 / (2 R y); the paper prints the product."""
    R = design[0]
    pose = R * np.array([x, y])
    l1, l2 = eq_2(R, pose)
    j = velocity_jacobian(two_rpr(*design), pose, np.array([l1, l2]))
    np.testing.assert_allclose(np.linalg.det(j), -l1 * l2 / (2 * R * pose[1]), rtol=1e-11)


@given(rpr_designs, st.floats(-3, 3), st.floats(-3, 3))
def test_two_rpr_inverse_is_eq_2(design, x, y):
    pose = design[0] * np.array([x, y])
    np.testing.assert_allclose(
        inverse(two_rpr(*design), pose, MODES[0]), eq_2(design[0], pose), rtol=8 * EPS, atol=1e-300
    )


@given(rpr_designs, st.floats(0.01, 4), st.floats(0.01, 4))
def test_two_rpr_forward_is_eqs_18_and_19(design, l1, l2):
    R = design[0]
    lengths = R * np.array([l1, l2])
    assume(min(abs(l1 + l2 - 2), abs(abs(l1 - l2) - 2)) > 1e-6)
    poses, is_real = forward(two_rpr(*design), lengths)
    assert list(is_real) == [eq_19(R, lengths)] * 2
    if not is_real[0]:
        assert np.all(np.isnan(poses))
        return
    above = eq_18(R, lengths)
    np.testing.assert_allclose(poses[0], above, rtol=1e-9, atol=1e-9 * R)
    np.testing.assert_array_equal(poses[1], poses[0] * np.array([1, -1]))  # a mirror pair


def test_two_rpr_forward_keeps_its_digits_where_the_triangle_is_flat():
    """l1 + l2 = 2 R (1 + 1e-12): eq. 18 subtracts away half of its digits, the product does not."""
    gap = 2.0**-40
    poses, is_real = forward(two_rpr(1.0, 0.5, 3.0), np.array([1.0 + gap, 1.0 + gap]))
    assert is_real[0]
    np.testing.assert_allclose(poses[0], [0, np.sqrt(gap * (2 + gap))], rtol=1e-14, atol=0)


@given(rpr_designs, st.floats(-3, 3), st.floats(0.02, 3))
def test_two_rpr_forward_of_inverse(design, x, y):
    mech, pose = two_rpr(*design), design[0] * np.array([x, y])
    poses, is_real = forward(mech, inverse(mech, pose, MODES[0]))
    assert is_real[0]
    np.testing.assert_allclose(poses[0], pose, rtol=0, atol=1e-11 * design[0])


@given(rpr_designs, st.floats(-3, 3), st.floats(0.02, 3), st.floats(-2, 2))
def test_two_rpr_scales_with_its_lengths(design, x, y, power):
    s, pose = 10**power, design[0] * np.array([x, y])
    small, large = two_rpr(*design), two_rpr(*(s * size for size in design))
    np.testing.assert_allclose(
        inverse(large, s * pose, MODES[0]), s * inverse(small, pose, MODES[0]), rtol=1e-14
    )
    np.testing.assert_allclose(home(large)[0], s * home(small)[0], rtol=1e-13)


@given(rpr_designs, st.floats(-3, 3), st.floats(0.02, 3))
def test_two_rpr_mirrored_swaps_its_legs(design, x, y):
    mech, pose = two_rpr(*design), design[0] * np.array([x, y])
    lengths = inverse(mech, pose, MODES[0])
    mirrored = inverse(mech, pose * np.array([-1, 1]), MODES[0])
    np.testing.assert_array_equal(mirrored, lengths[::-1])


def test_two_rpr_joint_space_corners():
    """Fig. 2(a): with l_min = R and l_max = 3 R, l_max - l_min = 2 R is the last real difference."""
    mech = two_rpr(1.0, 1.0, 3.0)
    for lengths, real in (([3, 3], True), ([1.5, 1.5], True), ([1, 3.01], False), ([0.9, 0.9], False)):
        assert list(forward(mech, np.array(lengths, float))[1]) == [real, real]


# ---------------------------------------------------------------- 2-RRR


@pytest.mark.parametrize("signs", MODES)
@pytest.mark.parametrize("pose", [(0.0, 1.9), (0.6, 1.7), (-1.1, 2.1), (0.2, -1.8)])
def test_five_bar_jacobians_are_eqs_14_and_15(pose, signs):
    R, la, lb = 1.0, 1.3, 1.9
    mech, pose = five_bar(R, la, lb), np.array(pose)
    phi = eq_6(R, la, lb, pose, signs)
    j_q, j_x = eq_14_15(R, la, pose, phi)
    np.testing.assert_allclose(pose_jacobian(mech, pose, phi), j_x, rtol=0, atol=16 * EPS)
    np.testing.assert_allclose(joint_jacobian(mech, pose, phi), -j_q, rtol=0, atol=16 * EPS)
    np.testing.assert_allclose(velocity_jacobian(mech, pose, phi), np.linalg.solve(j_x, j_q), rtol=1e-11)
    determinant = np.linalg.det(j_q) / np.linalg.det(j_x)  # eq. 12 corrected
    np.testing.assert_allclose(np.linalg.det(velocity_jacobian(mech, pose, phi)), determinant, rtol=1e-11)


@given(five_bars, angles, angles, st.sampled_from([1, -1]))
def test_five_bar_inverse_is_eq_6_with_its_signs(design, phi1, phi2, mode):
    """The printed + and - are the branch: for leg 1 and leg 2 alike."""
    mech, _, pose, branch = assembled(design, phi1, phi2, mode)
    alpha, _, gamma = eq_5(*design, pose)
    assume(np.all(np.abs(gamma - alpha) > 1e-3 * design[0] ** 2))
    expected = eq_6(*design, pose, branch)
    np.testing.assert_allclose(turns(inverse(mech, pose, branch) - expected), 0, atol=1e-9)


def test_five_bar_default_is_elbows_out():
    """Fig. 1(b): + for leg 1 and - for leg 2, both elbows outside of their legs."""
    mech, pose = five_bar(1.0, 1.0, 2.15), np.array([0.1, 1.7])
    phi = jax.jit(mech.inverse)(pose)
    np.testing.assert_allclose(turns(phi - eq_6(1.0, 1.0, 2.15, pose, np.array([1, -1]))), 0, atol=1e-14)
    first, second = np.cos(phi)
    assert 1 + first > 1 and -1 + second < -1


@pytest.mark.parametrize("mirrored", [1, -1])
def test_five_bar_inverse_on_the_degenerate_branch_of_eq_6(mirrored):
    """An elbow on the x axis towards the centre makes gamma = alpha; no digit may be lost there.

    The two roots are phi = pi and the corrected 2 arctan(-(gamma + alpha) / (2 beta)). The paper's
    -(gamma + alpha) / (2 beta) is not even a solution.
    """
    R, la, lb, pose = 1.0, 1.0, 1.3, np.array([0.5, 1.2])  # 0.5^2 + 1.2^2 = 1.3^2
    alpha, beta, gamma = eq_5(R, la, lb, pose)
    assert abs(gamma[0] - alpha[0]) < 1e-15
    pose = pose * np.array([1, mirrored])
    mech = five_bar(R, la, lb)
    found = np.array([inverse(mech, pose, branch)[0] for branch in MODES[[0, 2]]])
    expected = np.array([np.pi, eq_6_degenerate(R, la, lb, pose)[0]])
    matched = [min(abs(turns(found - phi))) for phi in expected]
    np.testing.assert_allclose(matched, 0, atol=1e-14)
    printed = -(gamma + alpha) / (2 * beta)
    assert min(abs(turns(found - printed[0]))) > 0.05


@given(five_bars, angles, angles, st.sampled_from([1, -1]))
def test_five_bar_forward_and_inverse_undo_each_other(design, phi1, phi2, mode):
    mech, joints, pose, branch = assembled(design, phi1, phi2, mode)
    poses, is_real = forward(mech, joints)
    assert all(is_real)
    gaps = np.max(np.abs(poses - pose), axis=1) / design[0]
    assert gaps.min() < 1e-11
    found = inverse(mech, poses[gaps.argmin()], branch)
    np.testing.assert_allclose(turns(found - joints), 0, atol=1e-11)


@given(five_bars, angles, angles)
def test_five_bar_has_two_assembly_modes_that_mirror_in_the_line_of_elbows(design, phi1, phi2):
    mech, joints, pose, _ = assembled(design, phi1, phi2, 1)
    _, _, other, _ = assembled(design, phi1, phi2, -1)
    R, la, lb = design
    poses, is_real = forward(mech, joints)
    assert is_real.shape == (2,) and all(is_real)
    for x in poses:
        scale = (lb + la + R) ** 2
        np.testing.assert_allclose(residual(mech, x, joints) / scale, 0, atol=1e-14)
    distances = [max(abs(poses[i] - x)) / R for i, x in ((0, other), (1, pose))]
    np.testing.assert_allclose(distances, 0, atol=1e-11)  # the end point above the elbows first


def test_five_bar_above_the_elbows_comes_first():
    poses, _ = forward(five_bar(1.0, 1.0, 2.15), np.array([0.8, np.pi - 0.8]))
    assert poses[0, 1] > np.sin(0.8) > poses[1, 1]


def test_five_bar_elbows_too_far_apart_have_no_pose():
    poses, is_real = forward(five_bar(1.0, 1.0, 1.2), np.array([0.0, np.pi]))  # 4 apart, links 2.4
    assert not any(is_real) and np.all(np.isnan(poses))


@pytest.mark.parametrize("links", [(1.0, 2.15), (2.5, 1.0), (1.5, 1.5)])
def test_five_bar_reaches_exactly_as_far_as_its_links(links):
    la, lb = links
    mech = five_bar(1.0, *links)
    direction = np.array([np.cos(2.2), np.sin(2.2)])
    for distance in (la + lb, abs(lb - la)):
        sign = 1 if distance == la + lb else -1
        inside, outside = distance * (1 - sign * 1e-6), distance * (1 + sign * 1e-6)
        if distance == 0:
            inside, outside = 1e-6, None
        assert np.isfinite(inverse(mech, np.array([1.0, 0]) + inside * direction, MODES[1])[0])
        if outside is not None:
            assert np.isnan(inverse(mech, np.array([1.0, 0]) + outside * direction, MODES[1])[0])


def test_five_bar_inverse_keeps_its_digits_near_full_stretch():
    """Stretched to 3 - 2^-30 along the x axis: exact in binary, while 4 la^2 lb^2 - (...)^2 cancels."""
    gap, mech = 2.0**-30, five_bar(1.0, 1.0, 2.0)
    heron = gap * (6 - gap) * (2 - gap) * (4 - gap)  # 16 area^2 of the triangle la, lb, 3 - gap
    offset = np.arcsin(np.sqrt(heron) / (2 * (3 - gap)))  # sin of the angle between la and the leg
    for branch in MODES[[0, 2]]:
        found = inverse(mech, np.array([4 - gap, 0.0]), branch)[0]
        np.testing.assert_allclose(found, -branch[0] * offset, rtol=1e-14)


@given(five_bars, angles, angles, st.sampled_from([1, -1]), st.floats(-2, 2))
def test_five_bar_angles_do_not_change_with_size(design, phi1, phi2, mode, power):
    mech, joints, pose, branch = assembled(design, phi1, phi2, mode)
    s = 10**power
    large = five_bar(*(s * size for size in design))
    np.testing.assert_allclose(turns(inverse(large, s * pose, branch) - joints), 0, atol=1e-11)
    np.testing.assert_allclose(home(large)[0], s * home(mech)[0], rtol=1e-12, atol=1e-300)


@given(five_bars, angles, angles, st.sampled_from([1, -1]))
def test_five_bar_mirrored_swaps_its_legs(design, phi1, phi2, mode):
    mech, joints, pose, branch = assembled(design, phi1, phi2, mode)
    mirrored = inverse(mech, pose * np.array([-1, 1]), -branch[::-1])
    np.testing.assert_allclose(turns(mirrored - (np.pi - joints[::-1])), 0, atol=1e-11)


def test_five_bar_keeps_its_reach_and_slack_through_jax():
    mech = pk.FiveBar(half_base=2.0, proximal=2.5, distal=5.0, reach=[3.0, 7.0], slack=0.5)
    doubled = jax.tree.map(lambda leaf: 2 * leaf, mech)
    assert isinstance(doubled, pk.FiveBar)
    np.testing.assert_array_equal(doubled.reach, [6, 14])
    assert float(doubled.slack) == 1.0


# ---------------------------------------------------------------- margins, skeleton, home


def test_margins_change_sign_at_the_limits():
    mech = two_rpr(1.0, 1.0, 3.0)
    inside = mech.margins(jnp.array([0.0, 1.0]), jnp.array([1.5, 2.9]))
    np.testing.assert_allclose(inside["stroke_min"], [0.5, 1.9], rtol=1e-14)
    np.testing.assert_allclose(inside["stroke_max"], [1.5, 0.1], rtol=1e-12)
    assert float(mech.margins(jnp.array([0.0, -0.5]), jnp.ones(2))["side"]) == -0.5
    arms = pk.FiveBar(half_base=2.0, proximal=2.0, distal=4.3, reach=[2.5, 6.0])
    pose = jnp.array([2.0, 5.0])  # 5 above the first base joint
    margins = arms.margins(pose, jnp.zeros(2))
    np.testing.assert_allclose(margins["reach_min"][0], (5 - 2.5) / 2)
    np.testing.assert_allclose(margins["reach_max"], [(6 - 5) / 2, (6 - np.hypot(4, 5)) / 2])


def test_skeleton_bars_have_the_lengths_of_the_links():
    mech, pose = pk.FiveBar(half_base=1.0, proximal=1.3, distal=1.9), jnp.array([0.4, 1.8])
    points, bars, ground = mech.skeleton(pose, mech.inverse(pose))
    lengths = [float(np.linalg.norm(points[a] - points[b])) for a, b in bars]
    np.testing.assert_allclose(lengths, [1.3, 1.9, 1.3, 1.9], rtol=1e-14)
    np.testing.assert_array_equal(points[np.array(ground)], [[1, 0], [-1, 0]])
    mech = two_rpr(1.0, 1.0, 3.0)
    points, bars, _ = mech.skeleton(pose, mech.inverse(pose))
    lengths = [float(np.linalg.norm(points[a] - points[b])) for a, b in bars]
    np.testing.assert_allclose(lengths, eq_2(1.0, pose), rtol=1e-14)


@given(five_bars)
def test_five_bar_home_is_about_as_far_from_singular_as_the_axis_allows(design):
    """Clearance: the least sine of the elbow angles and of the angle between the distal links."""
    R, la, lb = design
    nearest, farthest = max(abs(lb - la), R), la + lb
    assume(farthest > 1.05 * nearest)

    def clearance(height):
        leg, lean = np.hypot(R, height), np.arctan2(height, -R)
        cosine = (leg**2 - la**2 - lb**2) / (2 * la * lb)
        sine = np.sqrt(1 - cosine**2)
        phi = lean - np.arctan2(lb * sine, la + lb * cosine)  # elbow outside
        u, v = R + la * np.cos(phi), height - la * np.sin(phi)  # of the distal link
        return np.minimum(sine, np.abs(2 * u * v) / lb**2)

    lengths = nearest + np.linspace(0.01, 0.99, 300) * (farthest - nearest)
    mech = five_bar(*design)
    pose, joints = home(mech)
    assert pose[0] == 0 and pose[1] > 0
    assert clearance(float(pose[1])) > 0.6 * np.max(clearance(np.sqrt(lengths**2 - R**2)))
    np.testing.assert_allclose(residual(mech, pose, joints) / (R + la + lb) ** 2, 0, atol=1e-14)


# ---------------------------------------------------------------- derivatives


@given(five_bars, angles, angles, st.sampled_from([1, -1]))
def test_five_bar_rates_are_the_slope_of_eq_6(design, phi1, phi2, mode):
    mech, _, pose, branch = assembled(design, phi1, phi2, mode)
    alpha, beta, gamma = eq_5(*design, pose)
    # where gamma is close to alpha, eq. (6) itself cancels: it loses (beta / (gamma - alpha))^2
    assume(np.all(np.abs(gamma - alpha) > np.maximum(1e-3 * design[0] ** 2, 1e-2 * np.abs(beta))))
    expected = slope(partial(eq_6, *design, signs=branch), pose)
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(inverse_rate(mech, pose, branch) / scale, expected / scale, rtol=0, atol=1e-9)


@pytest.mark.parametrize("short", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("end", ["stretched", "folded"])
def test_five_bar_rates_near_the_ends_of_the_reach(short, end):
    """Leg 1 within `short` of its limit: the rate grows like 1 / sqrt(short) and stays right.

    With rho the leg's length and psi the elbow angle, dphi/drho = (lb + la cos psi) / (rho la sin psi),
    by the law of cosines; the sign of the branch is that of sin psi.
    """
    R, la, lb = 1.0, 1.0, 2.15
    limit, side = (la + lb, -1.0) if end == "stretched" else (lb - la, 1.0)
    outward = np.array([np.cos(2.0), np.sin(2.0)])
    pose = np.array([R, 0]) + (limit + side * short) * outward
    rho = np.hypot(pose[0] - R, pose[1])
    gap = side * (rho - limit)  # what rounding has left of `short`
    product = gap * ((la + lb + rho) if end == "stretched" else (rho + lb - la))
    other = (rho**2 - (lb - la) ** 2) if end == "stretched" else ((la + lb) ** 2 - rho**2)
    sine = np.sqrt(product * other) / (2 * la * lb)
    cosine = (rho**2 - la**2 - lb**2) / (2 * la * lb)
    leg = (pose - np.array([R, 0])) / rho
    along, across = (lb + la * cosine) / (rho * la * sine), 1 / rho  # radians per length
    for branch in (MODES[1], MODES[2]):
        rate = inverse_rate(five_bar(R, la, lb), pose, branch)[0]
        tolerance = 64 * EPS / short + 1e-12
        assert abs(rate @ leg / (branch[0] * along) - 1) < tolerance
        assert abs(rate @ np.array([-leg[1], leg[0]]) - across) < tolerance * abs(along)


def central(function, point, step):
    """Central differences. -> (..., n)"""
    units = step * np.eye(point.size)
    return np.stack([(function(point + u) - function(point - u)) / (2 * step) for u in units], axis=-1)


@pytest.mark.parametrize("mode", [0, 1])
@pytest.mark.parametrize(
    ("mech", "joints"),
    [(two_rpr(1.0, 1.0, 3.0), [1.7, 2.2]), (five_bar(1.0, 1.0, 2.15), [0.7, 2.6])],
    ids=["2-RPR", "2-RRR"],
)
def test_forward_modes_have_exact_derivatives(mech, joints, mode):
    joints = np.array(joints)
    solve = lambda q: np.asarray(forward(mech, q)[0][mode])
    exact = jax.jit(jax.jacfwd(lambda mech, q: mech.forward(q)[0], argnums=1))(mech, joints)[mode]
    np.testing.assert_allclose(exact, central(solve, joints, 1e-5), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(exact, velocity_jacobian(mech, solve(joints), joints), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(
    ("mech", "pose"),
    [(two_rpr(1.0, 1.0, 3.0), (0.4, 1.1)), (five_bar(1.0, 1.2, 2.15), (0.4, 1.7))],
    ids=["2-RPR", "2-RRR"],
)
def test_geometry_gradient_is_a_mechanism(mech, pose):
    """sin of the joints: a scalar that sees every field that the joints depend on."""
    pose = jnp.array(pose)
    value = lambda mech: jnp.sum(jnp.sin(mech.inverse(pose) * jnp.array([1.0, 2.0])))
    gradient = jax.grad(value)(mech)
    assert type(gradient) is type(mech)
    assert jax.tree.structure(gradient) == jax.tree.structure(mech)
    leaves, tree = jax.tree.flatten(mech)
    for i, entry in enumerate(jax.tree.leaves(gradient)):
        moved = lambda h, i=i: float(value(tree.unflatten([x + h * (i == k) for k, x in enumerate(leaves)])))
        np.testing.assert_allclose(entry, (moved(1e-5) - moved(-1e-5)) / 2e-5, rtol=1e-8, atol=1e-9)
    assert jax.tree.leaves(gradient)[0] != 0


def test_home_has_no_derivative_of_its_pose():
    gradient = jax.grad(lambda mech: jnp.sum(home(mech)[0]))(five_bar(1.0, 1.0, 2.15))
    assert [float(leaf) for leaf in jax.tree.leaves(gradient)] == [0, 0, 0]


def test_five_bar_elbow_angles_are_eq_21():
    mech = pk.FiveBar(half_base=1.0, proximal=1.3, distal=1.9)
    pose = jnp.array([0.4, 1.7])
    for branch in ([1.0, -1.0], [-1.0, -1.0]):
        elbows = mech.elbows(mech.inverse(pose, jnp.array(branch)))
        back, on = mech.base() - elbows, pose - elbows
        cosine = np.sum(back * on, axis=1) / (1.3 * 1.9)
        np.testing.assert_allclose(np.cos(mech.elbow_angles(pose)), cosine, atol=1e-14)
    stretched, folded = jnp.array([1.0, 3.2]), jnp.array([1.0, 0.6])
    np.testing.assert_allclose(mech.elbow_angles(stretched)[0], np.pi, atol=1e-7)
    np.testing.assert_allclose(mech.elbow_angles(folded)[0], 0, atol=1e-7)
    assert np.isnan(mech.elbow_angles(jnp.array([1.0, 3.3]))[0])
    slopes = jax.jacfwd(mech.elbow_angles)(stretched)
    assert np.all(np.isfinite(slopes))
