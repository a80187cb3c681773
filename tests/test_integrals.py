"""Workspace integrals: reference values, shapes of every kind, laws, gradients of hard values, refusals."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import said_by

import pk_jax as pk
from pk_jax.analysis import integral
from pk_jax.analysis.integral import integral_gradient, workspace_integral
from pk_jax.mechanisms.base import Mechanism, Skeleton
from pk_jax.mechanisms.catalogue import catalogued
from pk_jax.status import Status

pytestmark = pytest.mark.usefixtures("compiled_in_haste")


class Quadrics(Mechanism):
    """A point (x, y); limit i is limits[i] . (1, x, y, x^2, x y, y^2). Its home is the origin."""

    limits: jax.Array

    def residual(self, pose, joints):
        return pose - joints

    def home(self):
        return jnp.zeros(2), jnp.zeros(2)

    def length(self):
        return jnp.ones(())

    def inverse(self, pose, branch=None, *, free=None):
        return pose

    def margins(self, pose, joints):
        x, y = pose
        return {"limit": self.limits @ jnp.stack([jnp.ones(()), x, y, x * x, x * y, y * y])}

    def skeleton(self, pose, joints):
        return Skeleton(pose[None], ())


def disc(radius, x=0.0, y=0.0):
    """Inside of a circle; its negative is the outside."""
    return np.array([radius**2 - x**2 - y**2, 2 * x, 2 * y, -1.0, 0.0, -1.0])


def moved(limits, angle, shift):
    """The same limits of a region that is turned, then shifted."""
    c, s = np.cos(angle), np.sin(angle)
    at = lambda x, y: np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 6))  # six points fix a quadric
    there = at(c * x - s * y + shift[0], s * x + c * y + shift[1])
    return np.linalg.solve(there.T, (limits @ at(x, y)).T).T


IDLE = disc(9.0)
ODD = np.stack([disc(2.0), -disc(0.7, 0.3, 1.0), -disc(0.5, -1.0, -0.5), [1.2, -1.0, -0.4, 0.0, 0.3, 0.0]])
SHAPES = {
    "disc with a hole": np.stack([disc(2.0), -disc(0.5, 1.0), IDLE, IDLE]),
    "ring about its hole": np.stack([disc(2.0), -disc(0.5, 0.1), IDLE, IDLE]),
    "sliver between two circles": np.stack([disc(2.0), -disc(1.995), IDLE, IDLE]),
    "two pieces": np.stack([disc(2.0), np.array([-0.09, 0, 0, 1, 0, 0]), IDLE, IDLE]),
    "two holes and a branch of a hyperbola": ODD,
    "the same, moved": moved(ODD, 0.8, (0.1, -0.2)),
    "open": np.stack([IDLE, [1.0, 1, 0, 0, 0, 0], [1.0, 0, 1, 0, 0, 0], [1.0, 0, 0, 0, 0, 0]])[[1, 2, 3, 3]],
    "empty": np.stack([disc(1.0), -disc(2.0), IDLE, IDLE]),
    "not a number": np.stack([disc(2.0), np.full(6, np.nan), IDLE, IDLE]),
}
NOT_OK = {"open": Status.INCOMPLETE, "empty": Status.UNREACHABLE, "not a number": Status.BAD_INPUT}
FINE = [name for name in SHAPES if name not in NOT_OK]


def squared(mech, pose, joints):
    return pose[0] ** 2 + pose[1] ** 2


def quadrics_and_slopes(limits):
    def of(limits):
        found = workspace_integral(Quadrics(limits=limits), squared, rays=64, nodes=10)
        return jnp.stack([found.volume, found.integral]), found

    slopes, found = jax.jacrev(of, has_aux=True)(limits)
    return found, slopes


@pytest.fixture(scope="module")
def shapes():
    """{name: (WorkspaceIntegral, slopes (2, 4, 6))}, one program for all."""
    found = jax.jit(lambda all_limits: jax.lax.map(quadrics_and_slopes, all_limits))(
        jnp.asarray(np.stack(list(SHAPES.values())))
    )
    return {name: jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i]), found) for i, name in enumerate(SHAPES)}


def hard_value(limits, angles=60000):
    """Area and integral of x^2 + y^2: midpoints in the angle, roots of quadratics along the ray. -> (2,)"""
    theta = (np.arange(angles) + 0.5) * 2 * np.pi / angles
    c, s = np.cos(theta), np.sin(theta)
    constant, linear, square = (
        limits[:, :1] + 0 * c,
        limits[:, 1:3] @ np.stack([c, s]),
        limits[:, 3:] @ np.stack([c * c, c * s, s * s]),
    )
    with np.errstate(all="ignore"):
        root = np.sqrt(linear**2 - 4 * constant * square)
        roots = [(-linear - root) / (2 * square), (-linear + root) / (2 * square), -constant / linear]
    roots = np.where(np.isfinite(np.concatenate(roots)), np.concatenate(roots), 0)
    ends = np.sort(np.clip(np.concatenate([roots, 0 * c[None]]), 0, None), axis=0)
    middle = (ends[1:] + ends[:-1]) / 2
    value = constant[:, None] + linear[:, None] * middle + square[:, None] * middle**2
    is_inside = np.all(value >= 0, axis=0)
    step = 2 * np.pi / angles
    return np.array([np.sum(is_inside * (ends[1:] ** k - ends[:-1] ** k)) / k * step for k in (2, 4)])


# --- shapes


@pytest.mark.parametrize("name", FINE)
def test_every_shape_has_its_area_and_its_second_moment(shapes, name):
    found, _ = shapes[name]
    assert found.status == Status.OK
    both = np.array([found.volume, found.integral])
    expected = hard_value(SHAPES[name])
    np.testing.assert_allclose(both, expected, rtol=5e-6)
    np.testing.assert_allclose(found.mean, both[1] / both[0], rtol=1e-12)
    assert np.all(np.abs(both - expected) < [found.error.volume, found.error.integral] + 1e-6 * expected)


def test_known_areas(shapes):
    segment = 4 * np.arccos(0.15) - 0.3 * np.sqrt(4 - 0.09)
    expected = {
        "disc with a hole": np.pi * (4 - 0.25),
        "ring about its hole": np.pi * (4 - 0.25),
        "sliver between two circles": np.pi * (4 - 1.995**2),
        "two pieces": 2 * segment,
    }
    for name, area in expected.items():
        np.testing.assert_allclose(shapes[name][0].volume, area, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("name", FINE)
def test_slopes_are_those_of_the_hard_value(shapes, name):
    """Four points of a central difference, in a direction that moves every limit in every way."""
    _, slopes = shapes[name]
    limits = SHAPES[name]
    direction = np.random.default_rng(4).uniform(-1, 1, limits.shape)
    step = 2e-4 if "sliver" in name else 3e-3
    value = lambda h: hard_value(limits + h * direction)
    slope = (8 * (value(step) - value(-step)) - value(2 * step) + value(-2 * step)) / (12 * step)
    np.testing.assert_allclose(np.sum(slopes * direction, axis=(1, 2)), slope, rtol=3e-4, atol=3e-4)


def test_a_limit_that_binds_nowhere_has_no_slope(shapes):
    np.testing.assert_array_equal(shapes["disc with a hole"][1][:, 2:], 0)


def test_the_slope_of_a_disc_in_its_squared_radius_is_pi(shapes):
    np.testing.assert_allclose(shapes["disc with a hole"][1][0, :2, 0], np.pi, rtol=1e-6)


def test_turned_and_shifted_shapes_are_as_large(shapes):
    one, other = (shapes[name][0] for name in ("two holes and a branch of a hyperbola", "the same, moved"))
    np.testing.assert_allclose(one.volume, other.volume, rtol=1e-5)
    assert abs(one.integral / other.integral - 1) > 1e-3  # of x^2 + y^2 about the origin


@pytest.mark.parametrize("name", list(NOT_OK))
def test_what_has_no_answer_says_why_and_harms_no_other_row(shapes, name):
    found, _ = shapes[name]
    assert found.status == NOT_OK[name]
    for answer in jax.tree.leaves((found.volume, found.integral, found.mean, found.error)):
        assert np.all(np.isnan(answer))
    assert (found.counts.open > 0) == (name == "open")


@pytest.mark.soak
def test_rows_of_a_batch_are_those_of_a_loop(shapes):
    one = lambda limits: workspace_integral(Quadrics(limits=limits), squared, rays=64, nodes=10)
    many = jax.jit(jax.vmap(one))(jnp.asarray(np.stack(list(SHAPES.values()))))
    for i, (name, limits) in enumerate(SHAPES.items()):
        row = jax.tree.map(lambda leaf, i=i: leaf[i], many)
        assert row.status == shapes[name][0].status
        np.testing.assert_allclose(row.replicates, shapes[name][0].replicates, rtol=1e-9)
        if name != "not a number":  # refused at the door
            np.testing.assert_allclose(one(jnp.asarray(limits)).volume, row.volume, rtol=1e-9)


@pytest.mark.soak
def test_second_derivatives_of_a_ring():
    """Area pi (a - b) and second moment pi (a^2 - b^2) / 2 of squared radii a and b."""

    def of(squares):
        a, b = squares
        limits = jnp.asarray(np.stack([disc(1.0), -disc(1.0)])).at[:, 0].set(jnp.stack([a, -b]))
        found = workspace_integral(Quadrics(limits=limits), squared, rays=16, nodes=6)
        return jnp.stack([found.volume, found.integral])

    at = jnp.array([4.0, 0.25])
    found = jax.jit(jax.jacfwd(jax.jacrev(of)))(at)
    np.testing.assert_allclose(found[0], 0, atol=1e-8)
    np.testing.assert_allclose(found[1], np.pi * np.diag([1.0, -1.0]), atol=1e-8)


# --- two freedoms: the 2-RPR and the five-bar, whose indices are known


def two_rpr(z):
    return pk.TwoRPR(half_base=z[0], l_min=z[1], l_max=z[1] + 2 * z[0])


@cache
def of_two_rpr(half_base, l_min, index=()):
    """One program for all designs."""
    return integral_gradient(two_rpr, [half_base, l_min], index, rays=64, nodes=12)


@pytest.mark.soak
def test_area_of_the_two_rpr():
    """The five-bar's, too: both reach the poses between the same limits."""
    found = of_two_rpr(1.0, 2.08)
    value = found.value
    assert value.status == Status.OK and value.counts.open == value.counts.crowded == 0
    np.testing.assert_allclose(value.volume, 7.280993404, atol=1e-9)
    np.testing.assert_allclose(found.volume[1], 2.17622729, atol=1e-6)
    assert value.mean.shape == (0,) and found.mean.shape == (0, 2)


@pytest.mark.soak
def test_area_goes_with_the_square_of_the_lengths():
    small, large = of_two_rpr(1.0, 2.08), of_two_rpr(2.0, 4.16)
    np.testing.assert_allclose(large.value.volume, 4 * small.value.volume, rtol=1e-8)
    np.testing.assert_allclose(large.volume, 2 * small.volume, rtol=1e-6)
    np.testing.assert_allclose(large.volume @ np.array([2.0, 4.16]), 2 * large.value.volume, rtol=1e-7)


@pytest.mark.soak
def test_indices_of_the_two_rpr_are_those_of_its_own_rule():
    asked = ("isotropy", "resistivity")
    found, large = of_two_rpr(1.0, 2.08, asked), of_two_rpr(2.0, 4.16, asked)
    known, step = pk.workspace_indices(two_rpr([1.0, 2.08])), 1e-4
    off = np.abs(np.asarray(found.value.mean) - np.array([known.gii, known.gri]))
    assert np.all(off < 2e-4) and np.all(off <= np.asarray(found.value.error.mean) + 1e-8)
    ahead, behind = (pk.workspace_indices(two_rpr([1.0, 2.08 + h])) for h in (step, -step))
    slopes = [(a - b) / (2 * step) for a, b in ((ahead.gii, behind.gii), (ahead.gri, behind.gri))]
    np.testing.assert_allclose(found.mean[:, 1], slopes, atol=1e-3)
    np.testing.assert_allclose(large.value.mean, found.value.mean, rtol=1e-6)
    np.testing.assert_allclose(large.mean, np.asarray(found.mean) / 2, atol=1e-6)


def five_bar(z):
    """half_base, la, lb, l_min"""
    return pk.FiveBar(half_base=z[0], proximal=z[1], distal=z[2], reach=jnp.stack([z[3], z[3] + 2 * z[0]]))


FIVE_BAR = np.array([1.0, 1.39, 2.69, 2.08])


@pytest.mark.soak
def test_five_bar_reference():
    found = integral_gradient(five_bar, FIVE_BAR, ())
    np.testing.assert_allclose(found.value.volume, 7.280993404, atol=1e-9)
    np.testing.assert_allclose(found.volume[1:], [0, 0, 2.17622729], atol=1e-6)
    assert found.value.mean.shape == (0,)


@pytest.mark.soak
def test_five_bar_is_that_of_its_own_rule():
    """Along designs of la + lb = l_max; in la alone there is no derivative, the arms end at the limit."""
    along = lambda z: five_bar(jnp.stack([jnp.ones(()), z[1], z[0] + 2 - z[1], z[0]]))
    at = np.array([2.08, 1.39])
    found = integral_gradient(along, at, ("isotropy", "resistivity"), nodes=24)
    known = pk.workspace_indices(along(at))
    np.testing.assert_allclose(found.value.mean, [known.gii, known.gri], atol=1e-4)
    assert found.status == Status.INCOMPLETE  # 1/kappa has edges inside: its small slopes are not known well
    assert (
        np.isnan(found.mean[0]).all() and np.isfinite(found.mean[1]).all() and np.isfinite(found.volume).all()
    )
    step = 1e-4
    for i in range(2):
        ahead, behind = (pk.workspace_indices(along(at + h * np.eye(2)[i])) for h in (step, -step))
        slope = (ahead.gri - behind.gri) / (2 * step)
        np.testing.assert_allclose(found.mean[1, i], slope, atol=found.error.mean[1, i] + 1e-5)


# --- clearance


def five_bar_area(z, clearance, angles=4000, steps=600):
    """Area of the five-bar's poses with this clearance: midpoints in the angle about home, bisected ends."""
    half_base, la, lb, l_min = z
    home = np.array([0.0, 2.2])
    base = np.array([[half_base, 0], [-half_base, 0]])

    def least(theta, r):
        x = home + r[..., None] * np.stack([np.cos(theta), np.sin(theta)], -1)[..., :]
        d = x[..., None, :] - base
        length = np.linalg.norm(d, axis=-1)
        cosine = (length**2 + la**2 - lb**2) / (2 * la * length)
        phi = np.arctan2(d[..., 1], d[..., 0]) - np.array([1, -1]) * np.arccos(np.clip(cosine, -1, 1))
        link = d - la * np.stack([np.cos(phi), np.sin(phi)], -1)
        u = link / np.linalg.norm(link, axis=-1, keepdims=True)
        det = u[..., 0, 0] * u[..., 1, 1] - u[..., 0, 1] * u[..., 1, 0]
        kept = det / np.sqrt(2)  # 1 / |A^-1|_F of unit rows in the plane
        parts = [np.min(length - l_min, -1), np.min(l_min + 2 * half_base - length, -1), x[..., 1]]
        return np.minimum(np.min(parts, axis=0), np.abs(kept) - clearance)

    theta = (np.arange(angles) + 0.5) * 2 * np.pi / angles
    r = np.broadcast_to(np.linspace(0, 6, steps), (angles, steps))
    inside = least(np.broadcast_to(theta[:, None], r.shape), r) >= 0
    row, cell = np.nonzero(inside[:, 1:] != inside[:, :-1])
    low, high, before = r[row, cell], r[row, cell + 1], inside[row, cell]
    for _ in range(45):
        middle = (low + high) / 2
        same = (least(theta[row], middle) >= 0) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.sum(np.where(before, 1, -1) * low**2) / 2 * 2 * np.pi / angles


@pytest.mark.soak
def test_five_bar_with_clearance():
    """The hard value misses parts of the tips narrower than its steps: that bounds the tolerance."""
    z, clearance = np.array([1.0, 1.39, 2.80, 2.08]), 0.55  # the arms reach farther than they may
    found = integral_gradient(five_bar, z, (), clearance=clearance, rays=128)
    assert found.status == Status.OK
    np.testing.assert_allclose(found.value.volume, five_bar_area(z, clearance), rtol=1e-5)
    assert found.value.volume < 0.995 * 7.280993404


def free_five_bar(z):
    return pk.FiveBar(half_base=z[0], proximal=z[1], distal=z[2])


CLEARANCES = {  # one whose limit crosses those of reach plainly, one in cusps, and a 3-RRR at a held angle
    "plain": (free_five_bar, [0.3, 1.0, 1.5], {"clearance": 0.3}),
    "cusps": (free_five_bar, [1.0, 1.39, 2.80], {"clearance": 0.55}),
    "3-RRR": (
        lambda z: three_rrr(z),  # which stands below
        [1.0, 0.3, 0.55, 0.55],
        {"clearance": 0.35, "axes": "x,y", "about": np.array([0.0, 0.0, 0.1])},
    ),
}


@pytest.mark.soak
@pytest.mark.parametrize("name", CLEARANCES)
def test_slopes_with_clearance_are_those_of_differences_to_their_own_errors(name):
    make, z, options = CLEARANCES[name]
    found = integral_gradient(make, z, (), **options)
    if name == "cusps":
        assert found.status == Status.INCOMPLETE and np.isnan(found.volume).all()
        return
    assert found.status == Status.OK
    value = jax.jit(lambda z: workspace_integral(make(z), (), **options).volume)
    step = 1e-4
    for i, h in enumerate(step * np.eye(len(z))):
        near, far = (value(z + k * h) - value(z - k * h) for k in (1, 2))
        difference = (8 * near - far) / (12 * step)  # of fourth order
        roundoff = found.value.error.volume / step
        assert abs(found.volume[i] - difference) <= found.error.volume[i] + roundoff + 1e-7
    assert np.max(found.error.volume / np.abs(found.volume)) < 1e-5


def test_options_are_told_apart_by_their_last_digit():
    """They are a static argument: taken for the same, a cached program would answer for others."""
    same = lambda a, b: integral._Options(a) == integral._Options(b)
    about = np.array([0.1, 0.123456789])
    assert same({"about": about, "clearance": 0.3}, {"about": about.copy(), "clearance": 0.3})
    assert not same({"clearance": 0.123456789}, {"clearance": 0.12345678901})
    assert not same({"about": about}, {"about": about + 1e-16})
    assert not same({"rays": 64}, {"nodes": 64})


@pytest.mark.soak
def test_any_number_of_rays_will_do():
    found = integral_gradient(two_rpr, [1.0, 2.08], (), rays=300, nodes=12)  # no multiple of a block
    np.testing.assert_allclose(found.volume[1], 2.17622729, atol=1e-6)


def test_slopes_that_are_not_known_well_are_refused():
    slopes = jnp.array([[4.0, -1.0], [0.0, 0.0]])
    errors = jnp.array([[0.39, 0.1], [0.0, 0.0]])
    is_sure = lambda slopes, errors: integral._is_sure(slopes, errors).tolist()
    assert is_sure(slopes, errors) == [True, True]
    assert is_sure(slopes, errors.at[0, 1].set(0.41)) == [False, True]  # of the greatest one, not of its own
    assert is_sure(slopes, errors.at[1, 0].set(1e-9)) == [True, False]
    assert is_sure(slopes.at[0, 0].set(jnp.nan), errors) == [False, True]


# --- 3-RRR: two coordinates, and three


RING = np.deg2rad([90, 210, 330])


def three_rrr(z):
    """Base and platform radius, la, lb."""
    ring = np.stack([np.cos(RING), np.sin(RING)], axis=1)
    return pk.PlanarRRR(base=z[0] * ring, platform=z[1] * ring, proximal=z[2], distal=z[3])


THREE_RRR = np.array([1.0, 0.3, 0.55, 0.55])


@pytest.mark.soak
def test_three_rrr_at_a_held_angle():
    found = integral_gradient(three_rrr, THREE_RRR, (), axes="x,y", about=[0.0, 0.0, 0.1])
    np.testing.assert_allclose(found.value.volume, 0.6434623129506, atol=1e-9)
    expected = [-2.93618393892, 2.90900028883, 3.04582588925, 3.04582588925]
    np.testing.assert_allclose(found.volume, expected, atol=1e-7)


@pytest.mark.soak
@pytest.mark.parametrize(("rays", "value", "slope"), [(512, 2e-3, 0.1), (8192, 2e-5, 5e-4)])
def test_three_rrr_with_its_angle(rays, value, slope):
    found = integral_gradient(
        three_rrr, THREE_RRR, (), within={"phi": (-0.6, 0.6)}, rule="rays", rays=rays, replicates=4
    )
    np.testing.assert_allclose(found.value.volume, 0.69657935121157, rtol=value)
    expected = np.array([-3.3433138044454, 3.0088131663660, 3.4852986881443, 3.4852986881443])
    np.testing.assert_allclose(found.volume, expected, atol=slope * np.max(np.abs(expected)))
    assert abs(found.value.volume - 0.69657935121157) < found.value.error.volume
    assert np.all(np.abs(found.volume - expected) < found.error.volume)


# --- in space


def stewart(z):
    """Base and platform radius, half-angles of the pairs."""
    side = jnp.asarray([-1.0, 1.0] * 3)
    middle = np.repeat(np.deg2rad([0.0, 120.0, 240.0]), 2)
    base, platform = middle + side * z[2], middle + side * z[3]
    ring = lambda radius, angle: radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=1)
    return pk.Stewart(
        base=ring(z[0], base), platform=ring(z[1], platform), stroke=[1.0422217097, 1.3264639942]
    )


STEWART = np.array([1.0, 0.6, 0.2, np.pi / 3 - 0.2])


@pytest.mark.soak
def test_stewart_between_its_strokes():
    found = integral_gradient(stewart, STEWART, (), rule="strokes")
    assert found.value.status == Status.OK
    np.testing.assert_allclose(found.value.volume / 0.6**3, 0.002809379, rtol=1e-6)
    # the reference's last variable is the angle off the edge of the pair, 60 degrees less this one
    expected = np.array([-0.00379018, -0.0165156, 0.00861058, 0.00854663])
    np.testing.assert_allclose(found.volume / 0.6**3 * np.array([1, 1, 1, -1]), expected, rtol=1e-4)


@pytest.mark.soak
def test_strokes_and_rays_agree_on_the_stewart():
    """Rays count every component of the workspace: here those of other modes lie behind a margin."""
    mech = stewart(STEWART)
    home = mech.home()[0].rotation

    def of_home(mech, pose, joints):
        cosine = (jnp.trace(pose.rotation @ home.T) - 1) / 2
        return jnp.stack([cosine - np.cos(1.0), pose.translation[2]])

    strokes = workspace_integral(mech, "frobenius_isotropy", rule="strokes")
    rays = workspace_integral(mech, "frobenius_isotropy", rule="rays", margins=of_home)
    assert strokes.status == rays.status == Status.OK
    assert abs(strokes.volume - rays.volume) < rays.error.volume
    assert abs(strokes.mean - rays.mean) < rays.error.mean
    assert rays.error.volume < 0.1 * rays.volume


# --- error estimates


@pytest.mark.soak
def test_error_estimates_hold_for_random_five_bars():
    """The area of designs of eq. (20) is known; at least 95 % of 200 errors are within their estimates."""
    rng = np.random.default_rng(7)
    l_min = rng.uniform(1.05, 4, 200)
    la = 1 + rng.uniform(0, 1, 200) * (l_min - 1) / 2
    designs = np.stack([np.ones(200), la, l_min + 2 - la, l_min], axis=1)
    of = lambda z: workspace_integral(five_bar(z), (), rays=64, nodes=8)
    found = jax.jit(lambda designs: jax.lax.map(of, designs))(jnp.asarray(designs))
    area = jax.vmap(lambda z: pk.workspace_indices(two_rpr(jnp.stack([z[0], z[3]]))).area)(designs)
    assert np.mean(found.status == Status.OK) > 0.99
    assert np.mean(np.abs(found.volume - area) <= found.error.volume + 1e-12) >= 0.95


@pytest.mark.soak
def test_error_estimates_hold_for_random_three_rrr():
    """Against four times the rays."""
    rng = np.random.default_rng(8)
    designs = np.stack([rng.uniform(low, high, 40) for low, high in
                        ((0.9, 1.1), (0.2, 0.4), (0.5, 0.7), (0.5, 0.7))], axis=1)  # fmt: skip

    def of(rays):
        one = lambda z: workspace_integral(
            three_rrr(z), (), within={"phi": (-0.6, 0.6)}, rule="rays", rays=rays, replicates=4
        )
        return jax.jit(lambda designs: jax.lax.map(one, designs))(jnp.asarray(designs))

    coarse, fine = of(256), of(1024)
    both = (coarse.status == Status.OK) & (fine.status == Status.OK)
    assert np.mean(both) > 0.9
    off = np.abs(coarse.volume - fine.volume)
    assert np.mean((off <= coarse.error.volume + fine.error.volume)[both]) >= 0.95


# --- the door


def refused(*arguments, **named):
    mech = catalogued("nam-2-rpr")
    return said_by(workspace_integral, mech, *arguments, **named)


def test_bad_input_is_told():
    assert refused("isotropie").startswith("index must be a function or one of ")
    assert refused(rule="simpson") == "rule must be one of strokes, panels, rays, got 'simpson'"
    assert refused(clearance=np.inf) == "clearance must be a finite number, got inf"
    assert refused(margins=3).startswith("margins must be a function of (mech, pose, joints)")
    assert refused(length=0) == "length must be a positive number, got 0"
    assert refused(within={"z": (0, 1)}).startswith("within must name coordinates, of x, y, got 'z'")
    assert refused(within={"x": (1, 0)}).startswith("within['x'] must be (least, greatest)")
    assert refused(within={"x": (0, np.nan)}).startswith("within['x'] must be (least, greatest)")
    assert refused(axes="x,x").startswith("axes must be different ones of x, y")
    assert refused(axes="x").endswith("coordinates that vary, got 1")
    assert refused(about=[[0.0, 1.0]] * 2).startswith("about must be one pose")
    for name, bad in (("nodes", 1), ("nodes", 65), ("rays", 7), ("cells", 4), ("nodes", 2.5)):
        assert refused(**{name: bad}).startswith(f"{name} must be an integer from ")
    assert refused(rule="rays", replicates=3).startswith("replicates must be an integer from 4 to 16")
    assert refused(rule="rays", seed=-1).startswith("seed must be an integer >= 0")
    assert said_by(workspace_integral, 3).startswith("workspace_integral takes a pk_jax.Mechanism")
    assert "has no margins" in said_by(workspace_integral, catalogued("sauer-3-rpr"))
    assert "rule 'panels'" in said_by(workspace_integral, catalogued("3-rrr"), rule="panels")
    assert "rule 'strokes'" in said_by(workspace_integral, catalogued("6-link"), rule="strokes")
    assert said_by(integral_gradient, 3, [1.0]).startswith("mechanism must be a function of a vector")
    assert said_by(integral_gradient, two_rpr, 1.0).startswith("vector must have shape")
