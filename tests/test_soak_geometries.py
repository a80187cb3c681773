"""Any geometry is refused at the door in one line, or its joints lead back to a home that is regular."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import pk_jax as pk
from pk_jax import Status
from pk_jax.geometry.poses import difference
from pk_jax.kinematics.closure import pose_scale
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, scaled_jacobians

pytestmark = pytest.mark.usefixtures("compiled_in_haste")


# ---------------------------------------------------------------- geometries of all kinds


ratios = (
    st.floats(0.1, 10) | st.floats(-6, 6).map(lambda power: 10.0**power) | st.sampled_from([1.0, 2.0, 0.5])
)
sizes = st.floats(-6, 6).map(lambda power: 10.0**power)
lengths = ratios | st.sampled_from([0.0, -1.0, np.nan, np.inf])
angles = st.floats(1e-3, 3.2) | ratios


def points(count, dimension):
    """Anywhere in a cube; of few coordinates, so that some coincide or lie on lines; or regular."""
    shape = (count, dimension)
    seeds = st.integers(0, 2**32 - 1)
    anywhere = seeds.map(lambda seed: np.random.default_rng(seed).uniform(-1, 1, shape))
    tied = arrays(float, shape, elements=st.sampled_from([-1.0, -0.5, 0.0, 1e-7, 0.5, 1.0]))
    drawn = arrays(float, shape, elements=st.floats(-1, 1))
    turns = st.floats(0, 1).map(lambda off: _ring(count, dimension, off))
    nearly = st.tuples(tied | turns, anywhere, st.floats(-12, -1)).map(lambda p: p[0] + 10 ** p[2] * p[1])
    moved = st.tuples(anywhere, st.floats(-3, 6)).map(lambda p: p[0] + 10 ** p[1])
    return anywhere | tied | drawn | turns | nearly | moved


def _ring(count, dimension, off):
    turns = 2 * np.pi / count * np.arange(count) + off * (-1) ** np.arange(count)
    return np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)[:, :dimension]


strokes = st.tuples(ratios, ratios).map(sorted).map(np.array)


def scaled(fields, unscaled=()):
    """All lengths times one size."""

    def grown(drawn):
        size, found = drawn
        return {name: value if name in unscaled else size * value for name, value in found.items()}

    return st.tuples(sizes, fields).map(grown)


def platforms(count, dimension, **more):
    """Joints of base and platform, one of which may be far larger, and further fields."""
    ends = {"base": points(count, dimension), "platform": points(count, dimension)}
    ratio = {"base": st.just(1.0), "platform": ratios}
    sized = {name: st.tuples(ends[name], ratio[name]).map(lambda p: p[0] * p[1]) for name in ends}
    return st.fixed_dictionaries({**sized, **more})


def oscillators():
    """Strokes about the neutral joints, or anywhere."""
    numbers = dict.fromkeys(("base_radius", "platform_radius", "s", "E"), ratios)
    drawn = st.fixed_dictionaries(
        {**numbers, "stroke": strokes, "base_cone": angles, "platform_cone": angles}
    )

    def field(p):
        own = ("base_radius", "platform_radius", "base_cone", "platform_cone")
        r, low_high = p["platform_radius"], p["stroke"]
        first = np.sqrt((p["E"] - r) ** 2 + r**2 + p["s"] ** 2)
        second = np.sqrt((p["base_radius"] - r) ** 2 + p["s"] ** 2)
        joints = np.array([first, second, second, first, p["E"]])
        reach = low_high / (low_high[1] + 1e-9)
        stroke = np.stack([joints * (1 - reach[0] / 2), joints * (1 + reach[1])], axis=1)
        return {name: p[name] for name in own} | {"neutral": np.array([p["s"], p["E"]]), "stroke": stroke}

    return drawn.map(field)


CONES = ("base_cone", "platform_cone")
plain = dict.fromkeys
GEOMETRIES = {
    "TwoRPR": (pk.TwoRPR, scaled(st.fixed_dictionaries(plain(("half_base", "l_min", "l_max"), lengths)))),
    "FiveBar": (
        pk.FiveBar,
        scaled(st.fixed_dictionaries(plain(("half_base", "proximal", "distal"), lengths))),
    ),
    "PlanarRPR": (pk.PlanarRPR, scaled(platforms(3, 2))),
    "PlanarRPR of four legs and strokes": (pk.PlanarRPR, scaled(platforms(4, 2, stroke=strokes))),
    "PlanarRRR": (pk.PlanarRRR, scaled(platforms(3, 2, proximal=lengths, distal=lengths))),
    "PlanarRRR of four arms": (
        pk.PlanarRRR,
        scaled(platforms(4, 2, proximal=arrays(float, 4, elements=ratios), distal=lengths)),
    ),
    "SixLink": (pk.SixLink, scaled(platforms(2, 2, proximal=lengths, distal=lengths))),
    "CasingOscillator": (pk.CasingOscillator, scaled(oscillators(), CONES)),
    "Stewart": (pk.Stewart, scaled(platforms(6, 3))),
    "Stewart with limits": (
        pk.Stewart,
        scaled(platforms(6, 3, stroke=strokes, base_cone=angles, platform_cone=angles), CONES),
    ),
    "Stewart with sensors": (pk.Stewart, scaled(platforms(9, 3))),
}
QUICK = ("TwoRPR", "FiveBar")


# ---------------------------------------------------------------- the law


@jax.jit
def there_and_back(mech):
    """Traced: one program for all geometries of a family."""
    pose, joints = mech.home()
    solved = pk.inverse_kinematics(mech, pose)
    return (
        (pose, joints, mech.length(), mech.margins(pose, joints)),
        solved,
        pk.forward_kinematics(mech, solved.joints),
    )


@jax.jit
def roundoffs_apart(mech, pose, joints, other, sigma):
    """Over the natural size of each coordinate, and what the longest link's roundoff makes of it. -> ()"""
    extent = jnp.max(jnp.abs(mech.skeleton(pose, joints).points)) / mech.length()
    off = jnp.max(jnp.abs(difference(pose, other)) / pose_scale(mech, pose))
    return off * sigma / (jnp.finfo(off.dtype).eps * (1 + extent))


def made(cls, fields):
    """The mechanism; None where it is refused as it should be."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*are they in one unit")
        try:
            return cls(**fields)
        except ValueError as error:
            refusal = error
    said = str(refusal)
    assert type(refusal) is ValueError and said.startswith(cls.__name__) and "\n" not in said, repr(refusal)
    return None


def is_finite(tree):
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree))


@jax.jit
def least_sigmas(mech):
    """Least singular values of A and B at home. -> (2,)"""
    jacobians = scaled_jacobians(mech, *mech.home())
    return jnp.stack([jnp.linalg.svd(each, compute_uv=False)[-1] for each in jacobians])


def is_regular(of_pose, of_joints):
    return min(of_pose, of_joints) > 2.5 * SINGULAR_BELOW  # sqrt(6) times: solvers judge by a lower bound


def assert_at_home(mech):
    home, solved, found = there_and_back(mech)
    pose, joints, length, _ = home
    assert is_finite(home) and length > 0
    if not is_regular(*least_sigmas(mech)):
        lost = [each.status != Status.OK for each in (solved, found)]
        assert any(lost) and (not lost[1] or np.all(np.isnan(jax.tree.leaves(found.pose)[0])))
        return
    assert Status(int(solved.status)) == Status.OK
    np.testing.assert_allclose(solved.joints, joints, rtol=1e-12)
    assert Status(int(found.status)) == Status.OK and found.sigma_min >= SINGULAR_BELOW
    assert found.det_sign == (0 if redundant(mech) else 1)
    assert roundoffs_apart(mech, pose, joints, found.pose, found.sigma_min) <= 100


def redundant(mech):
    return isinstance(mech, pk.SixLink) or (
        isinstance(mech, pk.PlanarRPR | pk.PlanarRRR) and len(mech.base) > 3
    )


def assert_refused_or_regular(name, data):
    cls, fields = GEOMETRIES[name]
    mech = made(cls, data.draw(fields))
    if mech is not None:
        assert_at_home(mech)


@pytest.mark.parametrize("name", QUICK)
@settings(max_examples=40)
@given(st.data())
def test_some_geometries(name, data):
    assert_refused_or_regular(name, data)


@pytest.mark.soak
@pytest.mark.parametrize("name", GEOMETRIES)
@settings(max_examples=2000)
@given(st.data())
def test_many_geometries(name, data):
    assert_refused_or_regular(name, data)


SINGULAR = {  # found by the tests above: lengths differ so much that home is as good as singular
    "legs side by side": (pk.TwoRPR, {"half_base": 1e-12, "l_min": 1e-12, "l_max": 3e-5}),
    "distal links side by side": (pk.FiveBar, {"half_base": 0.5, "proximal": 0.125, "distal": 1e6}),
    "driven links too short": (pk.FiveBar, {"half_base": 1e5, "proximal": 0.25, "distal": 1e5}),
}


@pytest.mark.parametrize("name", SINGULAR)
def test_geometries_without_a_regular_home_are_never_ok(name):
    cls, fields = SINGULAR[name]
    assert not is_regular(*least_sigmas(cls(**fields)))
    assert_at_home(cls(**fields))


@pytest.mark.soak
def test_redundant_joints_that_close_are_ok_whatever_the_proportions():
    """Roundoff of links a thousand times the platform's size moves it for ever, and no residual is left."""
    ends = np.array([[0.27, -0.46], [-0.92, -0.97]])
    mech = pk.SixLink(base=ends, platform=ends, proximal=1.0, distal=1000.0)
    assert_at_home(mech)
