"""Screws and statics: lines by construction, the power balance, published stiffness, and what is refused."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import outsiders
import pytest
from refusals import said_by
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.geometry.poses import place, retract
from pk_jax.kinematics.inverse import working_modes
from pk_jax.papers.planar_screws import geometric_screws, singular_cases

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

NAN, INF = np.nan, np.inf
ROWS = 32


# ---------------------------------------------------------------- mechanisms and poses


def _names(kind):
    return [field.name for field in dataclasses.fields(kind)]


def unchecked(kind, **fields):
    """A mechanism without the checks at the door, which compile the search for a home."""
    tree = jax.tree.structure(jax.eval_shape(lambda fields: kind(**fields), fields))
    return jax.tree.unflatten(tree, [jnp.asarray(fields[name]) for name in _names(kind) if name in fields])


def five_bar(rng):
    half_base, proximal, distal = rng.uniform([0.0, 0.15, 0.15], [0.15, 0.25, 0.3])
    return pk.FiveBar(half_base=half_base, proximal=proximal, distal=distal)


def ring(rng, legs, radius):
    turns = 2 * np.pi / legs * (np.arange(legs) + rng.uniform(-0.3, 0.3, legs))
    return radius * np.stack([np.cos(turns), np.sin(turns)], axis=1) + rng.uniform(-0.05, 0.05, 2)


def rrr(rng, arms=3):
    ends, links = (ring(rng, arms, 0.5), ring(rng, arms, 0.15)), rng.uniform(0.28, 0.4, (2, arms))
    return unchecked(pk.PlanarRRR, base=ends[0], platform=ends[1], proximal=links[0], distal=links[1])


def rpr(rng, legs=3):
    return unchecked(pk.PlanarRPR, base=ring(rng, legs, 0.5), platform=ring(rng, legs, 0.2)[::-1])


def six_link(rng):
    base = np.array([[-0.2, 0], [0.2, 0]]) + rng.uniform(-0.05, 0.05, (2, 2))
    platform = np.array([[-0.1, 0], [0.1, 0]]) + rng.uniform(-0.05, 0.05, (2, 2))
    links = rng.uniform(0.25, 0.35, (2, 2))
    return unchecked(pk.SixLink, base=base, platform=platform, proximal=links[0], distal=links[1])


PLANAR = {
    "5-link": five_bar,
    "3-RRR": rrr,
    "4-RRR": partial(rrr, arms=4),
    "3-RPR": rpr,
    "6-link": six_link,
}
SEMI = pk.catalogued("semi-regular-stewart")


def nine_rows():
    rng = np.random.default_rng(8)
    more = rng.uniform(-0.5, 0.5, (2, 3, 3))
    ends = (np.concatenate([SEMI.base, more[0]]), np.concatenate([SEMI.platform, 0.3 * more[1]]))
    return unchecked(pk.Stewart, base=ends[0], platform=ends[1])


class Serial(pk.Mechanism):
    """Three motors in a row hold a platform (x, y, phi): one block of three equations."""

    links: jax.Array  # (3,)
    joint_units = (0, 0, 0)
    pose_units = (1, 1, 0)

    def points(self, joints):
        turns = jnp.cumsum(joints)
        steps = self.links[:, None] * jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=1)
        return jnp.cumsum(steps, axis=0)

    def residual(self, pose, joints):
        return jnp.append(pose[:2] - self.points(joints)[2], pose[2] - jnp.sum(joints))

    def home(self):
        joints = jnp.array([0.3, 0.9, -0.7])
        return jax.lax.stop_gradient(jnp.append(self.points(joints)[2], jnp.sum(joints))), joints

    def length(self):
        return self.links[0]

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(self.points(joints), ((0, 1), (1, 2)))


class Mixed(pk.LegMechanism):
    """A point (x, y) held by two lengths and one driven arm: joint forces of both kinds."""

    base: jax.Array  # (3, 2)
    links: jax.Array  # (2,)
    joint_units = (1, 1, 0)

    def attachments(self):
        return jnp.zeros((3, 2))

    def legs(self, points, joints):
        elbow = self.base[2] + self.links[0] * jnp.stack([jnp.cos(joints[2]), jnp.sin(joints[2])])
        held = jnp.append(
            jnp.sum((points[:2] - self.base[:2]) ** 2, axis=1), jnp.sum((points[2] - elbow) ** 2)
        )
        return (held - jnp.append(joints[:2], self.links[1]) ** 2) / 2

    def home(self):
        joints = jnp.stack([*jnp.linalg.norm(self.base[:2], axis=1), 2.0])
        return jnp.zeros(2), joints

    def length(self):
        return 3.0 + 0 * self.links[0]

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(self.base, ((0, 1),))


def mixed():
    """Closed at home, the point in the origin."""
    elbow = np.array([-2.0, 0.3])
    base = np.array([[1.0, 0.2], [0.1, 1.2], elbow - 1.5 * np.array([np.cos(2.0), np.sin(2.0)])])
    return Mixed(base=base, links=[1.5, np.linalg.norm(elbow)])


@jax.jit
def jacobians(mech, pose, joints):
    a = jax.vmap(pk.pose_jacobian, (None, 0, 0))(mech, pose, joints)
    b = jax.vmap(pk.joint_jacobian, (None, 0, 0))(mech, pose, joints)
    return a, b


@jax.jit
def joints_of(mech, poses, branches):
    return jax.vmap(mech.inverse)(poses, branches)


# where poses are taken from: the middle, and how far to either side
REGIONS = {
    pk.FiveBar: ([0, 0.2], [0.15, 0.15]),
    pk.PlanarRRR: ([0, 0, 0], [0.1, 0.1, 0.6]),
    pk.PlanarRPR: ([0, 0, 0.3], [0.2, 0.2, 0.8]),
    pk.SixLink: ([0, 0.3, 0], [0.2, 0.2, 0.6]),
    pk.Stewart: ([0, 0, 0.8, 0, 0, 0], [0.3, 0.3, 0.2, 0.3, 0.3, 0.3]),
    pk.TwoRPR: ([0, 1.5], [0.5, 0.5]),
    outsiders.ThreeLegs: ([0.9, 0.7], [0.4, 0.4]),
}


def configurations(mech, seed=0):
    """Regular poses over all working modes, ROWS of them: poses, joints, A, B and the modes."""
    modes = working_modes(mech)
    many = 16 * ROWS
    middle, to_side = map(np.array, REGIONS[type(mech)])
    pose = middle + to_side * np.random.default_rng(seed).uniform(-1, 1, (many, len(middle)))
    if isinstance(mech, pk.Stewart):
        pose = pk.SE3(pose[:, :3], Rotation.from_rotvec(pose[:, 3:]).as_matrix())
    joints = joints_of(mech, pose, modes[np.arange(many) % len(modes)])
    pose, joints = jax.tree.map(np.asarray, (pose, joints))
    a, b = map(np.asarray, jacobians(mech, pose, joints))
    is_real = np.all(np.isfinite(joints), axis=1)[:, None, None]
    size = np.linalg.norm(a, axis=2, keepdims=True)
    least = [np.linalg.svd(np.where(is_real, x / size, 0), compute_uv=False)[:, -1] for x in (a, b)]
    good = np.flatnonzero((least[0] > 0.02) & (least[1] > 0.01))
    good = np.concatenate([good[good % len(modes) == k][: -(-ROWS // len(modes))] for k in range(len(modes))])
    assert len(good) >= ROWS and len(set(good % len(modes))) == len(modes)  # every mode
    good = good[:ROWS]
    return (
        jax.tree.map(lambda leaf: leaf[good], pose),
        joints[good],
        a[good],
        b[good],
        modes[good % len(modes)],
    )


def lift(screws, b):
    """J_F^T from lines and arms."""
    return np.asarray(screws.lines) / np.asarray(screws.arms)[..., None]


def at_home(mech):
    pose, joints = mech.home()
    return pose, joints, *(np.asarray(f(mech, pose, joints)) for f in (pk.pose_jacobian, pk.joint_jacobian))


def close(found, expected, to=1e-12):
    """To a part of the largest entry."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=to * np.max(np.abs(expected)))


# ---------------------------------------------------------------- lines


@pytest.mark.parametrize("make", PLANAR.values(), ids=PLANAR.keys())
def test_screws_of_planar_robots_are_the_lines_through_their_joints(make):
    """eqs. (21)-(24), (29)-(31), (34): two paths, by ruler and from the residual, in every working mode."""
    drawn = jax.jit(lambda mech, pose, joints: jax.vmap(partial(geometric_screws, mech))(pose, joints))
    for seed in range(3):
        mech = make(np.random.default_rng(seed))
        pose, joints, a, b, _ = configurations(mech, seed)
        found, ruled = pk.screws(mech, pose, joints), drawn(mech, pose, joints)
        close(found.lines, ruled.lines)
        close(found.arms, ruled.arms)
        assert isinstance(mech, pk.PlanarRPR) or (np.min(ruled.arms) < -0.01 and np.max(ruled.arms) > 0.01)
        np.testing.assert_allclose(np.linalg.norm(found.lines[..., :2], axis=-1), 1, rtol=0, atol=1e-14)
        close(found.lines / found.arms[..., None], -np.linalg.solve(b, a))
        np.testing.assert_array_equal(found.constraints, a)


def test_what_is_no_planar_robot_is_not_drawn():
    pose, joints = SEMI.home()
    assert said_by(geometric_screws, SEMI, pose, joints).startswith("geometric_screws takes")


OTHERS = {
    "nine rows": nine_rows,
    "ThreeLegs": outsiders.three_legs,
    "TwoRPR": lambda: pk.catalogued("nam-2-rpr"),
}


@pytest.mark.parametrize("make", OTHERS.values(), ids=OTHERS.keys())
def test_screws_of_telescopic_legs_are_their_lines(make):
    mech = make()
    pose, joints, a, b, _ = configurations(mech)
    found = pk.screws(mech, pose, joints)
    close(found.lines / found.arms[..., None], -np.linalg.solve(b, a))
    close(found.arms, np.ones(joints.shape))
    points = np.asarray(jax.vmap(place, (0, None))(pose, mech.attachments()))
    legs = points - np.asarray(mech.base() if callable(mech.base) else mech.base)
    u = legs / np.linalg.norm(legs, axis=-1, keepdims=True)
    close(found.lines[..., : u.shape[-1]], u)
    origin = np.asarray(pose.translation if isinstance(pose, pk.SE3) else pose[:, : u.shape[-1]])
    if found.lines.shape[-1] > u.shape[-1]:  # the platform turns
        arms = points - origin[:, None]
        is_plane = u.shape[-1] == 2
        moment = arms[..., 0] * u[..., 1] - arms[..., 1] * u[..., 0] if is_plane else np.cross(arms, u)
        close(found.lines[..., u.shape[-1] :], moment.reshape(*joints.shape, -1))


def test_screws_of_a_delta_are_its_rods():
    mech = outsiders.delta()
    pose, joints, a, b = at_home(mech)
    found = pk.screws(mech, pose, joints)
    shoulders, elbows, ends = np.asarray(jnp.stack(mech.rings(pose, joints))).swapaxes(1, 2)
    rods = (ends - elbows) / 0.8
    close(found.lines, rods)
    close(lift(found, b), -np.linalg.solve(b, a))
    radial, down = shoulders / 0.2, np.array([0, 0, -1.0])  # an arm turns its elbow at arm * down
    close(found.arms, 0.35 * rods @ down)
    assert np.max(np.abs(np.sum(radial * found.lines, axis=1))) > 0.1


def test_screws_of_three_motors_in_a_row():
    """The line of each motor meets the axes of the other two, its arm is its distance from its own."""
    mech = Serial(links=[0.5, 0.4, 0.3])
    for joints in ([0.3, 0.9, -0.7], [-1.0, -0.5, 2.0], [0.4, 1e-12, 0.8], [0.4, 0.0, 0.8]):
        joints = np.array(joints)
        points = np.asarray(mech.points(joints))
        axes = np.concatenate([np.zeros((1, 2)), points[:2]])
        pose = np.append(points[2], np.sum(joints))
        lines, arms, a = map(np.asarray, pk.screws(mech, pose, joints))
        np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1, rtol=0, atol=1e-14)
        for k in range(3):
            reach = axes - points[2]
            about = lines[k, 2] - (reach[:, 0] * lines[k, 1] - reach[:, 1] * lines[k, 0])
            np.testing.assert_allclose(about, np.where(np.arange(3) == k, arms[k], 0), rtol=0, atol=1e-14)
        if abs(joints[1]) > 0.1:
            b = np.asarray(pk.joint_jacobian(mech, pose, joints))
            close(lines / arms[:, None], -np.linalg.solve(b, a))
            assert lines[0, :2] @ (axes[2] - axes[1]) > 0  # from the base to the platform


# ---------------------------------------------------------------- the equations of the screw analysis


@pytest.mark.parametrize("make", [five_bar, rrr], ids=["5-link", "3-RRR"])
def test_velocity_jacobian_is_the_inverse_transpose(make):
    """eq. (27): J = J_F^-T."""
    mech = make(np.random.default_rng(1))
    pose, joints, _, b, _ = configurations(mech)
    found = jax.jit(jax.vmap(pk.velocity_jacobian, (None, 0, 0)))(mech, pose, joints)
    expected = np.linalg.inv(lift(pk.screws(mech, pose, joints), b))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def test_determinant_of_the_five_bar():
    """eqs. (23), (24), (28): det J_F = sin(alpha_2 - alpha_1) / (r_1 r_2), r_i = la sin(psi_i)."""
    mech = five_bar(np.random.default_rng(2))
    pose, joints, _, b, _ = configurations(mech)
    distal = pose[:, None] - np.asarray(jax.vmap(mech.elbows)(joints))
    alpha = np.arctan2(distal[..., 1], distal[..., 0])
    r = float(mech.proximal) * np.sin(alpha - joints)
    expected = np.sin(alpha[:, 1] - alpha[:, 0]) / np.prod(r, axis=1)
    found = np.linalg.det(np.swapaxes(lift(pk.screws(mech, pose, joints), b), 1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-11)


@pytest.mark.parametrize("arms", [3, 4])
def test_rows_of_the_residual_of_arms(arms):
    """With F = (|C - B|^2 - lb^2) / 2: row i of A is lb_i times the line, B is -diag(lb_i r_i)."""
    mech = rrr(np.random.default_rng(0), arms)
    pose, joints, a, b, _ = configurations(mech)
    lines, of_arms, _ = pk.screws(mech, pose, joints)
    lb = np.asarray(mech.distal)
    close(a, lb[:, None] * lines)
    close(b, -(lb * of_arms)[..., None] * np.eye(arms))


# ---------------------------------------------------------------- forces

FORCES = {name: partial(PLANAR[name], np.random.default_rng(4)) for name in ("5-link", "4-RRR", "6-link")}
FORCES |= {"nine rows": nine_rows, "two kinds of joints": mixed}


def some(mech, seed=0):
    """Configurations, J_F of the actuators, wrenches and joint forces."""
    pose, joints, a, b = (
        jax.tree.map(lambda leaf: np.asarray(leaf)[None], at_home(mech))
        if isinstance(mech, Mixed)
        else configurations(mech)[:4]
    )
    rng = np.random.default_rng(seed)
    rows = mech.actuated_rows or a.shape[1]
    j_f = np.swapaxes(-np.linalg.solve(b, a)[:, :rows], 1, 2)
    tau = rng.uniform(-1, 1, joints.shape) * (np.arange(joints.shape[1]) < rows)
    return pose, joints, j_f, rng.uniform(-1, 1, (len(joints), a.shape[2])), tau


@pytest.mark.parametrize("make", FORCES.values(), ids=FORCES.keys())
def test_wrench_and_forces(make):
    """Power balance for every motion, least norm, and preloads that exert nothing."""
    mech = make()
    pose, joints, j_f, wrench, tau = some(mech)
    n, m = j_f.shape[1:]
    exerted = pk.platform_wrench(mech, pose, joints, tau)
    close(exerted, np.einsum("knm,km->kn", j_f, tau[:, :m]))
    twist = np.random.default_rng(5).uniform(-1, 1, (len(joints), n))
    close(np.sum(exerted * twist, axis=1), np.einsum("km,knm,kn->k", tau[:, :m], j_f, twist))

    forces = np.asarray(pk.joint_forces(mech, pose, joints, wrench))
    np.testing.assert_array_equal(forces[:, m:], 0)  # sensors
    weight = float(mech.length()) ** np.asarray((mech.joint_units or (1,) * m)[:m])
    if len(set(weight)) == 1:
        weight = np.ones(m)
    expected = np.einsum("kmn,kn->km", np.linalg.pinv(j_f / weight), wrench) / weight
    close(forces[:, :m], expected, 1e-11)
    close(pk.platform_wrench(mech, pose, joints, forces), wrench, 1e-11)
    if n == m:
        close(pk.joint_forces(mech, pose, joints, exerted), tau, 1e-11)

    free = np.asarray(pk.preloads(mech, pose, joints))
    assert free.shape == (len(joints), m - n, joints.shape[1])
    if m > n:
        np.testing.assert_allclose(
            free @ np.swapaxes(free, 1, 2), np.tile(np.eye(m - n), (len(free), 1, 1)), rtol=0, atol=1e-14
        )
        assert np.max(np.abs(j_f @ np.swapaxes(free, 1, 2))) <= 1e-12 * np.max(np.abs(j_f))


@pytest.mark.parametrize("name", ["4-RRR", "6-link", "nine rows"])
def test_virtual_work_of_a_finite_motion(name):
    """W . x' = tau . q', the joints being those of the inverse kinematics a step on and a step back."""
    mech = FORCES[name]()
    pose, joints, _, _, branches = configurations(mech)
    n = 6 if name == "nine rows" else 3
    wrench, twist = np.random.default_rng(6).uniform(-1, 1, (2, ROWS, n))
    tau, h = np.asarray(pk.joint_forces(mech, pose, joints, wrench)), 1e-5
    moved = lambda by: np.asarray(joints_of(mech, jax.vmap(retract)(pose, by * twist), branches))
    rate = (moved(h) - moved(-h) + np.pi) % (2 * np.pi) - np.pi
    work = np.sum(tau * rate / (2 * h), axis=1)
    np.testing.assert_allclose(work, np.sum(wrench * twist, axis=1), rtol=0, atol=1e-5 * np.max(np.abs(work)))


def test_sensors_carry_no_force():
    nine = nine_rows()
    pose, joints, _, wrench, tau = some(nine)
    six = [np.asarray(f) for f in (pk.joint_forces(SEMI, pose, joints[:, :6], wrench), tau[:, :6])]
    close(pk.joint_forces(nine, pose, joints, wrench)[:, :6], six[0])
    loud = np.where(np.arange(9) < 6, tau, 1e9)
    np.testing.assert_array_equal(
        pk.platform_wrench(nine, pose, joints, loud), pk.platform_wrench(nine, pose, joints, tau)
    )
    close(pk.platform_wrench(nine, pose, joints, tau), pk.platform_wrench(SEMI, pose, joints[:, :6], six[1]))
    k = np.arange(1.0, 10)
    close(pk.stiffness(nine, pose, joints, k), pk.stiffness(SEMI, pose, joints[:, :6], k[:6]))
    assert pk.preloads(nine, pose, joints).shape == (ROWS, 0, 9)


# ---------------------------------------------------------------- bounds


def best(j_f, wrench, lower, upper, toward):
    """The forces within bounds that are farthest against `toward`; None: there are none. By HiGHS."""
    bounds = [tuple(None if np.isinf(b) else b for b in pair) for pair in zip(lower, upper, strict=True)]
    scale = np.max(np.abs(j_f))
    found = linprog(toward, A_eq=j_f / scale, b_eq=wrench / scale, bounds=bounds, method="highs")
    assert found.status in (0, 2)
    return found.fun if found.status == 0 else None


REDUNDANT = {
    "one preload": partial(rrr, arms=4),
    "two arms of two": six_link,
    "two preloads": partial(rrr, arms=5),
    "three preloads": partial(rpr, legs=6),
}


@pytest.mark.parametrize("make", REDUNDANT.values(), ids=REDUNDANT.keys())
def test_forces_within_bounds_are_the_least(make):
    """f is the least in a convex set where no point of it is on the near side: min y.f over it is f.f."""
    mech = make(np.random.default_rng(1))
    pose, joints, j_f, wrench, _ = some(mech)
    free = np.einsum("kmn,kn->km", np.linalg.pinv(j_f), wrench)
    wrench, free = (x / np.max(np.abs(free), axis=1, keepdims=True) for x in (wrench, free))
    close(pk.bounded_joint_forces(mech, pose, joints, wrench, -INF, INF).forces, free, 1e-11)
    m = free.shape[1]
    statuses, held = [], set()
    for lower, upper in (
        (-0.9, 0.8),
        (-0.7, np.where(np.arange(m) == 1, 0.1, INF)),
        (-0.3 - 0.1 * np.arange(m), 0.7),
    ):
        found = jax.tree.map(np.asarray, pk.bounded_joint_forces(mech, pose, joints, wrench, lower, upper))
        low, high = np.broadcast_to(lower, m), np.broadcast_to(upper, m)
        for k, forces in enumerate(found.forces):
            is_open = best(j_f[k], wrench[k], low, high, np.zeros(m)) is not None
            statuses.append(pk.Status.OK if is_open else pk.Status.UNREACHABLE)
            assert found.status[k] == statuses[-1]
            assert np.all(np.isfinite(forces)) == is_open
            if is_open:
                assert np.all((forces >= low) & (forces <= high))
                close(j_f[k] @ forces, wrench[k], 1e-10)
                assert best(j_f[k], wrench[k], low, high, forces) >= forces @ forces - 1e-8
                held.add(int(np.sum((np.abs(forces - low) < 1e-12) | (np.abs(forces - high) < 1e-12))))
    assert statuses.count(pk.Status.UNREACHABLE) >= 2 and statuses.count(pk.Status.OK) >= 15
    assert held >= set(range(m - 3 + 1))  # none, one ... as many bounds as preloads hold


def test_bounds_may_be_traced():
    mech = outsiders.three_legs()
    solve = jax.jit(lambda upper: pk.bounded_joint_forces(mech, *mech.home(), [0.5, 1.0], -INF, upper))
    assert solve(0.0).status == pk.Status.OK


def test_cables_only_pull():
    """Three tendons around a point pull in every direction, by no more than they must."""
    mech = outsiders.three_legs()
    pose, joints = mech.home()
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    wrench = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    found = pk.bounded_joint_forces(mech, np.tile(pose, (12, 1)), np.tile(joints, (12, 1)), wrench, -INF, 0)
    np.testing.assert_array_equal(found.status, pk.Status.OK)
    assert np.all(found.forces <= 0) and np.all(np.max(found.forces, axis=1) > -1e-15)
    close(pk.platform_wrench(mech, pose, joints, found.forces), wrench, 1e-11)
    pushed = pk.bounded_joint_forces(mech, pose, joints, wrench[0], 1.0, 2.0)
    assert pushed.status == pk.Status.UNREACHABLE


def test_bounds_where_nothing_can_be_chosen():
    pose, joints = SEMI.home()
    weight = np.array([0, 0, 1.0, 0, 0, 0])
    forces = pk.joint_forces(SEMI, pose, joints, weight)
    found = pk.bounded_joint_forces(SEMI, pose, joints, weight, 0, 1)
    close(found.forces, forces)
    assert found.status == pk.Status.OK
    found = pk.bounded_joint_forces(SEMI, pose, joints, weight, 0, 0.5 * np.max(forces))
    assert found.status == pk.Status.UNREACHABLE and np.all(np.isnan(found.forces))
    wrenches = np.stack([weight, NAN * weight, -weight])
    poses = pk.SE3(*(np.tile(leaf, (3,) + (1,) * leaf.ndim) for leaf in (pose.translation, pose.rotation)))
    found = pk.bounded_joint_forces(SEMI, poses, np.tile(joints, (3, 1)), wrenches, -1, 1)
    assert [pk.Status(s).name for s in found.status] == ["OK", "BAD_INPUT", "OK"]
    close(found.forces[0], forces)
    close(found.forces[2], -forces)


def test_too_many_preloads_for_bounds_are_refused():
    mech = rpr(np.random.default_rng(0), 7)
    assert "at most 3 preloads, got 4" in said_by(
        pk.bounded_joint_forces, mech, *mech.home(), np.ones(3), 0, 1
    )


# ---------------------------------------------------------------- singular poses

CASES = singular_cases()
LOST = [case for case in CASES if case.kind == pk.SingularityKind.TYPE_I]
FREE = [case for case in CASES if case.kind in (pk.SingularityKind.TYPE_II, pk.SingularityKind.TYPE_III)]
named = lambda cases: [f"{case.figure} {case.title}" for case in cases]


@pytest.mark.parametrize("case", LOST, ids=named(LOST))
def test_a_collinear_arm_has_its_line_and_no_arm(case):
    mech, pose, joints = case.mechanism, case.pose, case.joints
    lines, arms, _ = map(np.asarray, pk.screws(mech, pose, joints))
    ruled = geometric_screws(mech, pose, joints)
    np.testing.assert_allclose(lines, ruled.lines, rtol=0, atol=1e-14)
    np.testing.assert_allclose(arms, ruled.arms, rtol=0, atol=1e-14)
    is_lost = np.abs(np.asarray(ruled.arms)) < 1e-12
    assert np.sum(is_lost) >= 1
    assert np.all(np.abs(arms[~is_lost]) > 0.05)
    forces = np.asarray(pk.joint_forces(mech, pose, joints, np.array([0.3, -0.8, 0.1])[: lines.shape[1]]))
    assert np.all(np.isfinite(forces))
    if not isinstance(mech, pk.SixLink):  # of two motors at one arm neither line is its own any more
        np.testing.assert_allclose(forces[is_lost], 0, rtol=0, atol=1e-14)
    else:
        _, joint = (np.asarray(f(mech, pose, joints)) for f in (pk.pose_jacobian, pk.joint_jacobian))
        assert np.linalg.norm(forces) > 0.01 and joint.shape == (4, 4)


def test_lines_are_continuous_through_a_collinear_arm():
    """A leg turned through full stretch: the line turns on, the arm changes sign."""
    mech = pk.catalogued("5-link")
    for leg_line in (0.45, 0.05):
        lines, arms = [], []
        for psi in (-1e-7, 0.0, 1e-7):
            bend = psi if leg_line > 0.1 else np.pi + psi
            first = 2.3
            pose = np.asarray(mech.base())[0] + 0.2 * e(first) + 0.25 * e(first + bend)
            joints = np.append(first, mech.inverse(pose)[1])
            found = pk.screws(mech, pose, joints)
            lines.append(np.asarray(found.lines)), arms.append(float(found.arms[0]))
        assert np.all(np.isfinite(lines))
        np.testing.assert_allclose(lines[0], lines[1], rtol=0, atol=1e-6)
        np.testing.assert_allclose(lines[2], lines[1], rtol=0, atol=1e-6)
        sign = 1 if leg_line > 0.1 else -1
        np.testing.assert_allclose(arms, sign * np.array([-2e-8, 0, 2e-8]), rtol=0, atol=1e-15)


def e(angle):
    return np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("case", FREE, ids=named(FREE))
def test_forces_at_a_direct_singularity_are_nan(case):
    mech, pose, joints = case.mechanism, case.pose, case.joints
    n = len(pose)
    assert np.all(np.isnan(pk.joint_forces(mech, pose, joints, np.ones(n))))
    assert np.all(np.isfinite(pk.screws(mech, pose, joints).lines))
    if len(joints) > n or isinstance(mech, pk.FiveBar):
        found = pk.bounded_joint_forces(mech, pose, joints, np.ones(n), -1, 1)
        assert found.status == pk.Status.SINGULAR and np.all(np.isnan(found.forces))


def test_wrench_and_stiffness_are_not_finite_where_an_arm_is_zero():
    """To the bit: a proximal link along x, a distal link along x."""
    mech = pk.FiveBar(half_base=1.0, proximal=1.0, distal=1.5)
    pose = np.array([3.5, 0.0])
    joints = np.array([0.0, 0.0])
    wide = pk.FiveBar(half_base=1.0, proximal=1.0, distal=1.5, reach=[0.5, 2.5])
    assert wide.half_base == mech.half_base
    assert not np.all(np.isfinite(pk.platform_wrench(mech, pose, joints, np.ones(2))))
    assert not np.all(np.isfinite(pk.stiffness(mech, pose, joints, 1.0)))


@pytest.mark.parametrize("case", LOST[:2], ids=named(LOST[:2]))
def test_wrench_and_stiffness_are_not_finite_where_an_arm_is_roundoff(case):
    mech, pose, joints = case.mechanism, case.pose, case.joints
    assert not np.all(np.isfinite(pk.platform_wrench(mech, pose, joints, np.ones(len(joints)))))
    assert not np.all(np.isfinite(pk.stiffness(mech, pose, joints, 1.0)))


def test_forces_at_dependent_equations_are_right_or_nan():
    """The 6-link of Fig. 12: half a force across the line at C and D each, torques by the lever rule."""
    (case,) = [case for case in CASES if case.kind == pk.SingularityKind.CONFIGURATION_SPACE]
    found = np.asarray(pk.joint_forces(case.mechanism, case.pose, case.joints, [0.0, 1.0, 0.0]))
    levers = np.array([0.1, 0.4, -0.1, -0.4])  # C - A, C - B, D - F, D - E, along the line
    assert np.all(np.isnan(found)) or np.allclose(found, 0.5 * levers, rtol=0, atol=1e-9)


# ---------------------------------------------------------------- stiffness


@pytest.mark.parametrize("name", ["4-RRR", "6-link"])
def test_stiffness_is_that_of_springs_at_the_joints(name):
    mech = FORCES[name]()
    pose, joints, j_f, _, _ = some(mech)
    k = np.random.default_rng(7).uniform(0.5, 2, joints.shape[1])
    found = np.asarray(pk.stiffness(mech, pose, joints, k))
    expected = j_f * k @ np.swapaxes(j_f, 1, 2)
    size = np.max(np.abs(expected), axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found / size, np.swapaxes(found, 1, 2) / size, rtol=0, atol=1e-15)
    assert np.all(np.linalg.eigvalsh(found) > 0)
    np.testing.assert_allclose(
        pk.stiffness(mech, pose, joints, 2.0),
        pk.stiffness(mech, pose, joints, np.full(len(k), 2.0)),
        rtol=1e-15,
    )


# H, MO_B, Hc, FOc in m: height, {B} over the platform, cube, its centre; diagonal of K and K_x,ry as printed
CUBES = [
    (0.10, -0.05, 0.10, 0.05, [2, 2, 2, 0.015, 0.015, 0.06], 0),
    (0.10, 0.02, 0.10, 0.05, [2, 2, 2, 0.025, 0.025, 0.06], -0.14),
    (0.08, -0.03, 0.10, 0.05, [2, 2, 2, 0.015, 0.015, 0.06], 0),
    (0.10, -0.05, 0.15, 0.06, [2, 2, 2, 0.034, 0.034, 0.14], 0.02),
    (0.10, -0.05, 0.04, 0.05, [2, 2, 2, 0.0024, 0.0024, 0.0096], 0),
    (0.10, -0.05, 0.15, 0.05, [2, 2, 2, 0.034, 0.034, 0.14], 0),
    (0.10, -0.05, 0.25, 0.05, [2, 2, 2, 0.094, 0.094, 0.37], 0),
]


def cubic(height, above, cube, centre):
    """Legs along six edges of a cube on its corner, of which those edges span the height `cube`."""
    turns = np.deg2rad(60.0 * np.arange(6))  # corners, low and high in turn, on a circle of cube * sqrt(2)
    corners = np.stack(
        [np.sqrt(2) * np.cos(turns), np.sqrt(2) * np.sin(turns), np.tile([-0.5, 0.5], 3)], axis=1
    )
    corners = cube * corners + [0, 0, centre]
    low, high = corners[[0, 2, 2, 4, 4, 0]], corners[[1, 1, 3, 3, 5, 5]]
    at = lambda z: low + (high - low) * (z - low[:, 2:]) / cube
    origin = np.array([0, 0, height + above])
    return pk.Stewart(base=at(0.0), platform=at(height) - origin), pk.SE3(origin, np.eye(3)), high - low


@pytest.mark.parametrize("printed", CUBES)
def test_published_stiffness_of_cubic_platforms(printed):
    """The tables of github.com/tdehaeze/stewart-simscape (MIT), org/cubic-configuration.org, two digits."""
    height, above, cube, centre, diagonal, across = printed
    mech, pose, legs = cubic(height, above, cube, centre)
    np.testing.assert_allclose(legs @ legs.T / cube**2, 3 * parallel(legs), rtol=0, atol=1e-12)  # edges
    k = np.asarray(pk.stiffness(mech, pose, mech.inverse(pose), 1.0))
    off = height + above - centre  # {B} over the middle of the cube: there K is (2, 2, 2, Hc^2 (3/2, 3/2, 6))
    tilt, turn = 1.5 * cube**2 + 2 * off**2, 6 * cube**2
    expected = np.diag([2, 2, 2, tilt, tilt, turn])
    expected[0, 4] = expected[4, 0] = -2 * off
    expected[1, 3] = expected[3, 1] = 2 * off
    np.testing.assert_allclose(k, expected, rtol=0, atol=1e-12)
    digit = 10.0 ** (np.floor(np.log10(np.array(diagonal))) - 1)
    assert np.all(np.abs(np.diag(k) - diagonal) <= 0.5 * digit * (1 + 1e-9))
    assert abs(k[0, 4] - across) <= 0.005


def parallel(legs):
    """+-1 where edges are parallel, else 0: of the six edges opposite ones are."""
    unit = legs / np.linalg.norm(legs, axis=1, keepdims=True)
    return np.round(unit @ unit.T)


# ---------------------------------------------------------------- batches, jit, grad


@pytest.mark.soak
def test_a_batch_equals_a_loop():
    mech = FORCES["6-link"]()
    pose, joints, _, wrench, tau = jax.tree.map(lambda leaf: leaf[:3], some(mech))
    calls = {
        "screws": lambda x, q, w, t: pk.screws(mech, x, q),
        "joint_forces": lambda x, q, w, t: pk.joint_forces(mech, x, q, w),
        "platform_wrench": lambda x, q, w, t: pk.platform_wrench(mech, x, q, t),
        "preloads": lambda x, q, w, t: pk.preloads(mech, x, q),
        "stiffness": lambda x, q, w, t: pk.stiffness(mech, x, q, 3.0),
        "bounded": lambda x, q, w, t: pk.bounded_joint_forces(mech, x, q, w, -9.0, 9.0),
    }
    for what, call in calls.items():
        every = call(pose, joints, wrench, tau)
        for k in range(3):
            one = call(*jax.tree.map(lambda leaf, k=k: leaf[k], (pose, joints, wrench, tau)))
            jax.tree.map(
                lambda a, b, k=k, what=what: np.testing.assert_allclose(
                    a[k], b, rtol=1e-12, atol=1e-12, err_msg=what
                ),
                every,
                one,
            )
    one = jax.tree.map(lambda leaf: leaf[0], (pose, joints))
    of_many = pk.joint_forces(mech, *one, wrench)  # one configuration, many wrenches
    close(of_many, np.stack([pk.joint_forces(mech, *one, w) for w in wrench]))


def test_stiffness_is_differentiable_in_the_geometry():
    mech = pk.catalogued("6-link")
    pose, _ = mech.home()
    weights = np.random.default_rng(9).uniform(-1, 1, (3, 3))

    @jax.jit
    def value(mech):
        return jnp.sum(weights * pk.stiffness(mech, pose, mech.inverse(pose), 2.0))

    directly = jnp.sum(weights * pk.stiffness(mech, pose, mech.inverse(pose), 2.0))
    np.testing.assert_allclose(value(mech), directly, rtol=1e-12)
    gradient = jax.jit(jax.grad(value))(mech)
    leaves, tree = jax.tree.flatten(mech)
    way = [np.random.default_rng(k).uniform(-1, 1, leaf.shape) for k, leaf in enumerate(leaves)]
    moved = lambda h: value(jax.tree.unflatten(tree, [x + h * w for x, w in zip(leaves, way, strict=True)]))
    h = 1e-4
    slope = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
    along = sum(np.sum(g * w) for g, w in zip(jax.tree.leaves(gradient), way, strict=True))
    np.testing.assert_allclose(along, slope, rtol=1e-8)


def test_derivatives_of_lines_are_finite_at_a_collinear_arm():
    case = LOST[0]
    lines = lambda joints: pk.screws(case.mechanism, case.pose, joints)[:2]
    for rate in jax.tree.leaves(jax.jit(jax.jacrev(lines))(case.joints)):
        assert np.all(np.isfinite(rate))


# ---------------------------------------------------------------- refusals


def test_what_is_refused():
    mech = pk.catalogued("4-rrr")
    pose, joints = mech.home()
    at = (mech, pose, joints)
    assert "screws takes a pk_jax.Mechanism" in said_by(pk.screws, "4-rrr", pose, joints)
    assert said_by(pk.screws, mech, pose[:2], joints).startswith("pose must have shape")
    assert said_by(pk.screws, mech, pose, joints[:3]).startswith("joints must have shape")
    assert said_by(pk.joint_forces, *at, np.ones(4)).startswith("wrench must have shape")
    assert said_by(pk.platform_wrench, *at, np.ones(3)).startswith("forces must have shape")
    assert said_by(pk.joint_forces, *at, "push").startswith("wrench must be")
    two, three = np.tile(pose, (2, 1)), np.ones((3, 3))
    assert "same number of rows" in said_by(pk.joint_forces, mech, two, joints, three)
    for k in (np.ones(3), np.ones((2, 4)), -1.0, [1, 1, 1, -1e-9], NAN, INF):
        assert said_by(pk.stiffness, *at, k).startswith("k must ")
    weight = np.ones(3)
    assert said_by(pk.bounded_joint_forces, *at, weight, np.ones(3), 2).startswith("lower must have shape")
    assert said_by(pk.bounded_joint_forces, *at, weight, 0, [1, 1, NAN, 1]).startswith(
        "lower must be at most upper"
    )
    assert said_by(pk.bounded_joint_forces, *at, weight, 1, 0).startswith("lower must be at most upper")
    assert said_by(pk.bounded_joint_forces, *at, weight, [0, 0, 0, 2], 1).startswith("lower must be at most")


class Sliding(pk.LegMechanism):
    """A point on two legs whose first foot slides, too: a motor more than equations."""

    apart: jax.Array

    def attachments(self):
        return jnp.zeros((2, 2))

    def legs(self, points, joints):
        feet = jnp.stack([jnp.stack([joints[2], 0 * joints[2]]), jnp.stack([self.apart, 0 * self.apart])])
        return (jnp.sum((points - feet) ** 2, axis=1) - joints[:2] ** 2) / 2

    def home(self):
        return jnp.array([0.5, 1.0]), jnp.stack([jnp.sqrt(1.25), jnp.hypot(0.5 - self.apart, 1.0), 0.0])

    def length(self):
        return self.apart

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], ())


def test_screws_of_too_many_joints_are_refused():
    mech = Sliding(apart=1.2)
    said = said_by(pk.screws, mech, *mech.home())
    assert said == "screws need as many joints as closure equations, Sliding has 2 joints in 1 of them"
