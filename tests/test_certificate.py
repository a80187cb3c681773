"""A certificate is a proof, checked here at points by formulas of their own; or it says that it is none."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import outsiders
import pytest
from refusals import said_by
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.analysis.certificate import _dominant

OSCILLATOR = pk.CasingOscillator()
STROKES = ("stroke_min", "stroke_max")
NAMES = ("s", "roll", "pitch", "yaw", "E")
POSES = {
    "s": (0.413, 0.543),
    "roll": tuple(np.deg2rad([-16, 16])),
    "pitch": tuple(np.deg2rad([-18.5, 14.5])),
    "yaw": tuple(np.deg2rad([-14, 14])),
}
PAPER = {**POSES, "E": (0.6675, 0.7922)}
SMALL = {"pitch": (-0.1, 0.1), "E": (0.7, 0.76)}
TWO_RPR = pk.catalogued("nam-2-rpr")


# ---------------------------------------------------------------- what the proofs are about, in NumPy


def legs_of(mech, values):
    """Of coordinates (k, 5): the normal of the platform, the ends of the legs, the legs themselves."""
    s, roll, pitch, yaw, carriage = np.asarray(values).T
    turn = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1)).as_matrix()
    r, zero = float(mech.platform_radius), np.zeros_like(s)
    attached = r * np.array([[1, 1, 0], [0, 1, 0], [0, -1, 0], [1, -1, 0]])
    ends = np.einsum("kij,kpj->kpi", turn, attached + s[:, None, None] * np.array([0, 0, 1]))
    on_carriage = np.stack([carriage, zero, zero], axis=-1)
    left = np.stack([zero, zero + float(mech.base_radius), zero], axis=-1)
    return turn[:, :, 2], ends, ends - np.stack([on_carriage, left, -left, on_carriage], axis=1)


def det_of(mech, values):
    """det A of the casing oscillator: its legs against a slide along n and turns about O."""
    normal, ends, legs = legs_of(mech, values)
    along = np.einsum("kpi,ki->kp", legs, normal)
    return np.linalg.det(np.concatenate([along[..., None], np.cross(ends, legs)], axis=-1))


def least_stroke(mech, values):
    """The least of the stroke's margins. -> (k,)"""
    joints = np.linalg.norm(legs_of(mech, values)[2], axis=-1)
    joints = np.concatenate([joints, np.asarray(values)[:, 4:]], axis=-1)
    least, greatest = np.asarray(mech.stroke).T
    return np.minimum(joints - least, greatest - joints).min(axis=-1) / float(mech.platform_radius)


def scale(values):
    """4 E^2 R r s^3"""
    return 4 * values[4] ** 2 * 0.25 * 0.25 * values[0] ** 3


def at_random(found, count, seed=0):
    """Points of the whole box, some of them at its corners. -> (count, d)"""
    rng = np.random.default_rng(seed)
    part = np.clip(rng.uniform(-0.2, 1.2, (count, len(found.names))), 0, 1)
    return found.lower + part * (found.upper - found.lower)


def on_faces(found, count, seed=0):
    """Points of the faces of the poses, the free joint anywhere."""
    rng, points = np.random.default_rng(seed), at_random(found, count, seed)
    axis = rng.integers(0, 4, count)
    ends = np.stack([found.lower, found.upper])[rng.integers(0, 2, count), axis]
    points[np.arange(count), axis] = ends
    return points


def home_of(mech):
    return np.array([float(mech.neutral[0]), 0, 0, 0, float(mech.neutral[1])])


def is_none(found):
    return not found.is_proved and np.isnan(found.bound) and len(found.unsettled[0]) > 0


# ---------------------------------------------------------------- the box of the paper


@functools.cache
def paper_regular():
    return pk.certify_regular(OSCILLATOR, PAPER, scale=scale, at_least=0.5)


@functools.cache
def paper_confined():
    return pk.certify_confined(OSCILLATOR, POSES, within=STROKES)


@pytest.mark.soak  # `pk-jax reproduce casing-oscillator` proves it, too
def test_the_box_of_the_paper_is_regular():
    found = paper_regular()
    assert found.is_proved and found.bound > 0.5 and len(found.unsettled[0]) == 0
    assert found.names == NAMES
    np.testing.assert_array_equal(np.stack([found.lower, found.upper], axis=1), [PAPER[n] for n in NAMES])
    points = at_random(found, 2000)
    assert found.bound <= np.min(np.abs(det_of(OSCILLATOR, points)) / scale(points.T))


def test_the_workspace_of_the_paper_is_confined():
    found = paper_confined()
    assert found.is_proved and found.bound > 0 and len(found.unsettled[0]) == 0
    np.testing.assert_array_equal([found.lower[4], found.upper[4]], OSCILLATOR.stroke[4])
    margins = least_stroke(OSCILLATOR, on_faces(found, 8000))
    assert np.all(margins <= -found.bound)
    assert least_stroke(OSCILLATOR, home_of(OSCILLATOR)[None]) > 0


# ---------------------------------------------------------------- what is not proved


def test_a_singularity_inside_is_found_quickly():
    found = pk.certify_regular(OSCILLATOR, {**PAPER, "pitch": (-0.3, 1.2)}, scale=scale)
    assert is_none(found) and found.boxes < 5000
    signs = np.sign(det_of(OSCILLATOR, at_random(found, 2000)))
    assert np.any(signs != signs[0])


def singular_pitch():
    """Unturned otherwise, and at home."""
    at = lambda pitch: det_of(OSCILLATOR, [home_of(OSCILLATOR) + [0, 0, pitch, 0, 0]])[0]
    return brentq(at, 1.0, 1.2, xtol=1e-15)


@pytest.mark.parametrize(
    ("below", "above"), [(0.3, 0.2), pytest.param(0.1, 0.0, marks=pytest.mark.soak), (0.0, 0.1)]
)
def test_a_box_that_reaches_a_singularity_is_not_proved(below, above):
    pitch = singular_pitch()
    found = pk.certify_regular(OSCILLATOR, {"pitch": (pitch - below, pitch + above)}, at_least=1e-9, most=100)
    assert is_none(found)
    lower, upper = found.unsettled
    assert np.any((lower[:, 2] <= pitch) & (pitch <= upper[:, 2]))


class Touching(pk.TwoRPR):
    """A = diag(1, (y - 3/2)^2): singular at y = 3/2, where its determinant does not change its sign."""

    def legs(self, points, joints):
        return jnp.stack([points[0, 0] - joints[0], (points[1, 1] - 1.5) ** 3 / 3 - joints[1]])


TOUCHING = Touching(half_base=1.0, l_min=1.0, l_max=3.0)


def test_a_singularity_without_change_of_sign_is_not_overlooked():
    found = pk.certify_regular(TOUCHING, {"y": (1.0, 2.7)}, scale=lambda v: 1 + 0 * v[0], most=200)
    assert is_none(found)
    lower, upper = found.unsettled
    assert np.any((lower[:, 1] <= 1.5) & (upper[:, 1] >= 1.5))
    beside = pk.certify_regular(TOUCHING, {"y": (1.6, 2.7)}, scale=lambda v: 1 + 0 * v[0])
    assert beside.is_proved and 0 < beside.bound <= 0.01


@pytest.mark.parametrize(("name", "ends"), [("yaw", (-10, 14)), ("roll", (-16, 9)), ("pitch", (-18.5, 9))])
def test_a_face_inside_the_workspace_is_a_way_out(name, ends):
    """One point of that face within all strokes, and it is over."""
    found = pk.certify_confined(OSCILLATOR, {**POSES, name: np.deg2rad(ends)}, within=STROKES)
    assert is_none(found) and found.boxes < 3000
    points = at_random(found, 40000)
    inner = int(abs(ends[0]) > abs(ends[1]))
    points[:, NAMES.index(name)] = (found.lower, found.upper)[inner][NAMES.index(name)]
    assert np.any(least_stroke(OSCILLATOR, points) >= 0)


def test_what_no_box_attains_is_not_proved():
    found = pk.certify_regular(OSCILLATOR, SMALL, at_least=1.5, most=300)
    assert is_none(found)
    found = pk.certify_confined(OSCILLATOR, POSES, within=STROKES, at_least=0.5, most=300)
    assert is_none(found)


class Gate(pk.TwoRPR):
    """A strip, |x| <= 0.2, is allowed, by code that jumps."""

    def margins(self, pose, joints):
        return {"gate": jnp.where((pose[0] < 0.2) & (pose[0] > -0.2), 1.0, -1.0)}


class Hidden(pk.TwoRPR):
    """The same strip, by code that hides from derivatives."""

    def margins(self, pose, joints):
        return {"gate": 0.04 - jax.lax.stop_gradient(pose[0]) ** 2}


class Slack(pk.TwoRPR):
    """Regular, but in a strip 0.1 < y < 0.2 in which nothing holds the platform."""

    def legs(self, points, joints):
        y = points[1, 1]
        return jnp.stack([points[0, 0] - joints[0], jnp.where((y > 0.1) & (y < 0.2), 0 * y, y) - joints[1]])


def is_proved_at_all(certify, mech, ranges):
    """Refused is not proved."""
    try:
        return certify(mech, ranges, most=500).is_proved
    except ValueError:
        return False


@pytest.mark.parametrize("kind", [Gate, Hidden])
def test_a_margin_that_jumps_or_hides_confines_nothing(kind):
    """The strip leads out of the box, past the middles of its faces."""
    mech = kind(half_base=1.0, l_min=1.0, l_max=3.0)
    assert mech.margins(jnp.array([0.1, 1.0]), None)["gate"] > 0
    assert not is_proved_at_all(pk.certify_confined, mech, {"x": (-1, 1.5), "y": (1, 2.5)})


def test_a_matrix_that_jumps_is_not_regular():
    mech = Slack(half_base=1.0, l_min=1.0, l_max=3.0)
    a = np.asarray(mech.linearize(jnp.array([0.0, 0.15]), jnp.ones(2))[1])
    assert np.linalg.matrix_rank(a) == 1
    assert not is_proved_at_all(pk.certify_regular, mech, {"x": (-0.5, 0.5), "y": (0.05, 1.0)})


# ---------------------------------------------------------------- whatever is proved, holds


def random_oscillator(rng):
    """Up to a tenth off that of the paper, its strokes so much about its neutral joints."""
    radius, platform, s, carriage = np.array([0.25, 0.25, 0.48, 0.73]) * rng.uniform(0.9, 1.1, 4)
    long, short = np.sqrt((platform - carriage) ** 2 + platform**2 + s**2), np.hypot(platform - radius, s)
    return pk.CasingOscillator(
        base_radius=radius,
        platform_radius=platform,
        neutral=[s, carriage],
        stroke=np.outer([long, short, short, long, carriage], [1, 1])
        * (1 + np.outer([6, 6, 6, 6, 2], [-0.01, 0.01])),
    )


def random_box(rng, mech, size):
    """About home, which is inside, of slides and carriages a part of home's."""
    home = home_of(mech)
    reach = size * np.where(home > 0, home / 2, 1.0)
    lower, upper = home - reach * rng.uniform(0.5, 1, 5), home + reach * rng.uniform(0.5, 1, 5)
    return {name: (low, high) for name, low, high in zip(NAMES, lower, upper, strict=True)}


@pytest.mark.parametrize("at_least", [0.0, 0.3])
def test_proved_regular_is_regular(at_least):
    """Random machines, random boxes: one sign of det A, and never less of it than the bound."""
    rng = np.random.default_rng(7)
    outcomes = []
    for size in np.linspace(0.05, 0.7, 4):
        mech = random_oscillator(rng)
        found = pk.certify_regular(mech, random_box(rng, mech, size), at_least=at_least, most=60)
        outcomes.append(found.is_proved)
        if found.is_proved:
            det = det_of(mech, at_random(found, 500)) / det_of(mech, [home_of(mech)])
            assert found.bound > at_least and np.all(det >= found.bound)
        else:
            assert is_none(found)
    assert True in outcomes and False in outcomes


def test_proved_confined_is_confined():
    """Random machines, random boxes: all over the faces some leg is too short or too long, by the bound."""
    rng = np.random.default_rng(8)
    outcomes = []
    for size in np.linspace(0.2, 0.7, 3):
        mech = random_oscillator(rng)
        ranges = random_box(rng, mech, size)
        del ranges["E"]
        at_least = rng.choice([0.0, 0.02])
        found = pk.certify_confined(mech, ranges, within=STROKES, at_least=at_least, most=1500)
        outcomes.append(found.is_proved)
        if found.is_proved:
            assert found.bound > at_least
            assert np.all(least_stroke(mech, on_faces(found, 2000)) <= -found.bound)
        else:
            assert is_none(found)
    assert True in outcomes and False in outcomes


class Opposed(pk.TwoRPR):
    """On a face of y = 1, 2.5 either margin is positive somewhere, and at x = 0 both are -1/16."""

    def margins(self, pose, joints):
        both = 0.5 - (pose[1] - 1.75) ** 2
        return {"left": 9 * pose[0] + both, "right": -9 * pose[0] + both}


def test_margins_exclude_together():
    """In one step, and by no more than they do."""
    mech = Opposed(half_base=1.0, l_min=1.0, l_max=3.0)
    found = pk.certify_confined(mech, {"x": (-1, 1), "y": (1, 2.5)})
    assert found.is_proved and found.boxes == 4 and 0.06 < found.bound <= 1 / 16
    assert not pk.certify_confined(mech, {"x": (-1, 1), "y": (1, 2.5)}, at_least=0.07, most=50).is_proved


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_dominant_diagonals_bound_the_determinant(n):
    """|det(1 + D)| >= (1 - r)^n, r the spectral radius of |D|; equal where D = -r."""
    rng = np.random.default_rng(n)
    off = rng.uniform(-1, 1, (300, n, n)) * rng.uniform(0, 3 / n, (300, 1, 1))
    off[:20] = -np.linspace(0, 0.9, 20)[:, None, None] * np.eye(n)
    bound = _dominant(np.abs(off))
    assert np.any(bound > 0.1) and np.any(np.isnan(bound))
    det = np.abs(np.linalg.det(np.eye(n) + off))
    assert not np.any(bound > det * (1 + 1e-14))
    np.testing.assert_allclose(bound[:20], det[:20], rtol=1e-6)


class Curved(pk.TwoRPR):
    """Allowed are two strips beside x = 1, where the first margin is least and has no slope."""

    def margins(self, pose, joints):
        return {"out": (pose[0] - 1) ** 2 - 0.5, "in": 1.5 - (pose[0] - 1) ** 2}


def test_slopes_are_those_of_the_whole_box():
    mech = Curved(half_base=1.0, l_min=1.0, l_max=3.0)
    assert is_none(pk.certify_confined(mech, {"x": (-1, 3), "y": (1, 2.5)}, most=1000))


def test_regular_wherever_the_strokes_allow():
    """A larger box holds singularities, all of them out of reach."""
    ranges = {"pitch": (0, np.deg2rad(65)), "s": (0.43, 0.53), "roll": (-0.1, 0.1)}
    found = pk.certify_regular(OSCILLATOR, ranges, within=STROKES)
    assert found.is_proved and found.bound > 0
    points = at_random(found, 4000)
    det = det_of(OSCILLATOR, points) / det_of(OSCILLATOR, [home_of(OSCILLATOR)])
    is_inside = least_stroke(OSCILLATOR, points) >= 0
    assert np.any(det < 0) and np.any(is_inside)
    assert np.all(det[is_inside] >= found.bound)
    assert is_none(pk.certify_regular(OSCILLATOR, ranges, most=2000))


# ---------------------------------------------------------------- other mechanisms


def rows_of(mech, values):
    """A of a platform in space or in the plane on plain legs, turned about its own point. -> (k, n, n)"""
    base, platform = np.asarray(mech.base), np.asarray(mech.platform)
    if base.shape[1] == 2:
        turn = Rotation.from_rotvec(values[:, 2:] * [0, 0, 1]).as_matrix()[:, :2, :2]
        arms = np.einsum("kij,pj->kpi", turn, platform)
        legs = values[:, None, :2] + arms - base
        moment = arms[..., 0] * legs[..., 1] - arms[..., 1] * legs[..., 0]
        return np.concatenate([legs, moment[..., None]], axis=-1)
    half = np.concatenate([values[:, 3:] / 2, np.ones((len(values), 1))], axis=1)  # (x, y, z, w)
    turn = Rotation.from_quat(half).as_matrix() @ np.asarray(mech.home()[0].rotation)
    arms = np.einsum("kij,pj->kpi", turn, platform)
    legs = values[:, None, :3] + arms - base
    return np.concatenate([legs, np.cross(arms, legs)], axis=-1)


def around_home(mech, length, angle):
    pose = mech.home()[0]
    names = ("x", "y", "phi") if not isinstance(pose, pk.SE3) else ("x", "y", "z", "rx", "ry", "rz")
    at = np.asarray(pose) if not isinstance(pose, pk.SE3) else np.append(pose.translation, np.zeros(3))
    reach = [length if name in "xyz" else angle for name in names]
    return {name: (x - d, x + d) for name, x, d in zip(names, at, reach, strict=True)}, at


@pytest.mark.parametrize(
    ("name", "length", "angle"),
    [("semi-regular-stewart", 0.03, 0.03), ("sauer-3-rpr", 0.2, 0.1), ("arte-3-rpr", 0.03, 0.1)],
)
def test_platforms_are_regular_about_home(name, length, angle):
    mech = pk.catalogued(name)
    ranges, home = around_home(mech, length, angle)
    found = pk.certify_regular(mech, ranges)
    assert found.is_proved and 0 < found.bound <= 1 and found.names == tuple(ranges)
    det = np.linalg.det(rows_of(mech, at_random(found, 2000))) / np.linalg.det(rows_of(mech, home[None]))
    assert found.bound <= np.min(det)


def test_a_2rpr_is_singular_on_its_base():
    """det A = -2 R y."""
    height = float(TWO_RPR.home()[0][1])
    found = pk.certify_regular(TWO_RPR, {"x": (-1, 1), "y": (0.5, 3)})
    assert found.is_proved and 0.2 < found.bound <= 0.5 / height
    below = pk.certify_regular(
        TWO_RPR, {"x": (-1, 1), "y": (-3, -0.5)}, scale=lambda v: -2 * v[1], at_least=0.9
    )
    assert below.is_proved and 0.9 < below.bound <= 1
    assert is_none(pk.certify_regular(TWO_RPR, {"x": (-1, 1), "y": (-0.01, 3)}))


def test_a_2rpr_stays_where_its_legs_reach():
    """Legs of 1 to 3 stand at x = +-1: |x| <= 2 above the base, y^2 <= 8. Below the base is the side."""
    found = pk.certify_confined(TWO_RPR, {"x": (-2.2, 2.2), "y": (-0.1, 3)})
    assert found.is_proved and 0.05 < found.bound <= 0.1
    for ranges in ({"x": (-1.9, 2.2), "y": (-0.1, 3)}, {"x": (-2.2, 2.2), "y": (-0.1, 2.8)}):
        assert is_none(pk.certify_confined(TWO_RPR, ranges))
    assert is_none(pk.certify_confined(TWO_RPR, {"x": (-2.2, 2.2), "y": (-0.1, 3)}, within=STROKES, most=500))


@pytest.mark.parametrize(
    ("mech", "what"),
    [
        (pk.catalogued("5-link"), "FiveBar: A depends on joints that are not free"),
        (pk.catalogued("3-rrr"), "A depends on joints that are not free"),
        (outsiders.three_legs(), "as many equations as coordinates, ThreeLegs has others"),
        (pk.catalogued("4-rrr"), "as many equations as coordinates"),
    ],
    ids=["5-link", "3-rrr", "three legs", "4-rrr"],
)
def test_mechanisms_without_a_certificate(mech, what):
    assert what in said_by(pk.certify_regular, mech, {})


class Exponential(pk.TwoRPR):
    def legs(self, points, joints):
        return jnp.exp(points[:, 1]) - joints


def test_code_without_bounds_is_named():
    mech = Exponential(half_base=1.0, l_min=1.0, l_max=3.0)
    assert "Exponential" in (said := said_by(pk.certify_regular, mech, {"x": (-0.1, 0.1)}))
    assert "primitive exp" in said
    said = said_by(
        pk.certify_confined, pk.catalogued("5-link"), {"x": (-1, 1), "y": (-1, 1)}, within=["side"]
    )
    assert "FiveBar" in said and "primitive" in said


# ---------------------------------------------------------------- the call


def test_what_is_left_out_stays_at_home():
    found = pk.certify_regular(OSCILLATOR, {"pitch": (-0.1, 0.1)})
    home = home_of(OSCILLATOR)
    np.testing.assert_allclose(found.lower, home - [0, 0, 0.1, 0, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(found.upper, home + [0, 0, 0.1, 0, 0], rtol=0, atol=1e-15)
    assert found.is_proved


def test_a_point_is_a_box():
    for ranges in ({}, {"pitch": (0.2, 0.2), "s": (0.45, 0.45)}):
        found = pk.certify_regular(OSCILLATOR, ranges)
        exact = det_of(OSCILLATOR, found.lower[None])[0] / det_of(OSCILLATOR, [home_of(OSCILLATOR)])[0]
        assert found.is_proved and found.boxes == 1
        assert exact - 1e-12 < found.bound < exact + 1e-12


def test_progress_is_reported():
    said = []
    found = pk.certify_regular(
        OSCILLATOR,
        {"pitch": (-0.3, 0.3), "s": (0.45, 0.5)},
        at_least=0.5,
        report=lambda *each: said.append(each),
    )
    what, done, in_all = zip(*said, strict=True)
    assert set(what) == {"no singularity: boxes"} and list(done) == sorted(set(done)) and len(done) > 2
    assert all(d <= n for d, n in zip(done, in_all, strict=True))
    assert done[-1] == in_all[-1] == found.boxes
    pk.certify_confined(TWO_RPR, {"x": (-2.2, 2.2), "y": (-0.1, 3)}, report=lambda *each: said.append(each))
    assert said[-1][0] == "no way out: boxes"


def test_the_same_again():
    for call in (
        lambda: pk.certify_regular(OSCILLATOR, PAPER, scale=scale, at_least=0.5, most=60),
        lambda: pk.certify_regular(TWO_RPR, {"x": (-1, 1), "y": (0.5, 3)}, at_least=0.28),
        lambda: pk.certify_confined(OSCILLATOR, POSES, within=("stroke_max",), most=60),
    ):
        first, second = call(), call()
        assert first.names == second.names
        for one, other in zip(*(jax.tree.leaves(c._replace(names=())) for c in (first, second)), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("most", [1, 10, 100])
def test_no_more_boxes_than_allowed(most):
    assert pk.certify_regular(OSCILLATOR, PAPER, at_least=0.99, most=most).boxes <= most


def test_where_nothing_is_settled_all_is_left():
    """Nowhere is there more of det A than 1.5 times that at home."""
    ranges = {"pitch": (-0.5, 0.5), "yaw": (-0.3, 0.3), "s": (0.47, 0.48)}
    found = pk.certify_regular(OSCILLATOR, ranges, at_least=1.5, most=100)
    lower, upper = found.unsettled
    sizes = (upper - lower)[:, [0, 2, 3]]
    assert is_none(found) and len(lower) > 50
    np.testing.assert_allclose(np.sum(np.prod(sizes, axis=1)), 0.01 * 1.0 * 0.6, rtol=1e-12)
    for point in at_random(found, 300):
        assert np.any(np.all((lower <= point) & (point <= upper), axis=1))


def test_what_is_settled_is_not_left():
    ranges = {"pitch": (-0.5, 0.9), "yaw": (-0.3, 0.3)}
    volume = lambda found: np.sum(np.prod((found.unsettled[1] - found.unsettled[0])[:, 2:4], axis=1))
    few, more = (pk.certify_regular(OSCILLATOR, ranges, at_least=0.7, most=most) for most in (3, 300))
    assert is_none(few) and is_none(more) and volume(more) < volume(few)
    points = at_random(more, 1000)
    ratio = det_of(OSCILLATOR, points) / det_of(OSCILLATOR, [home_of(OSCILLATOR)])
    lower, upper = (end[:, None] for end in more.unsettled)
    is_left = np.any(np.all((lower <= points) & (points <= upper), axis=2), axis=0)
    assert np.any(~is_left) and np.all(ratio[~is_left] > 0.7)


@pytest.mark.parametrize("certify", [pk.certify_regular, pk.certify_confined])
def test_floating_point_errors_have_no_say(certify):
    """Whatever the user has NumPy do about underflow."""
    found = {}
    for setting in ("ignore", "raise"):
        with np.errstate(all=setting):
            found[setting] = certify(OSCILLATOR, FINE[certify], most=20)
    np.testing.assert_equal(*(each._replace(names=()) for each in found.values()))


# ---------------------------------------------------------------- refusals

REGULAR, CONFINED = pk.certify_regular, pk.certify_confined
FINE = {pk.certify_regular: SMALL, pk.certify_confined: POSES}
BOTH = pytest.mark.parametrize("certify", [REGULAR, CONFINED])


@BOTH
@pytest.mark.parametrize(
    ("ranges", "what"),
    [
        ({"z": (0, 1)}, "'z'"),
        ({"pitch": (0, np.nan)}, "ranges['pitch'] must be (lower, upper)"),
        ({"pitch": (-np.inf, 0.1)}, "ranges['pitch'] must be (lower, upper)"),
        ({"pitch": (0.1, -0.1)}, "lower <= upper, got (0.1, -0.1)"),
        ({"pitch": (0.1,)}, "ranges['pitch'] must be (lower, upper)"),
        ({"pitch": 0.1}, "ranges['pitch'] must be (lower, upper)"),
        ({"pitch": "ab"}, "ranges['pitch'] must be real numbers"),
        ({"pitch": np.zeros((2, 2))}, "ranges['pitch'] must be (lower, upper)"),
    ],
)
def test_ranges_that_are_refused(certify, ranges, what):
    assert what in said_by(certify, OSCILLATOR, {**FINE[certify], **ranges})


@BOTH
def test_mechanisms_that_are_refused(certify):
    assert f"{certify.__name__} takes a pk_jax.Mechanism, got dict" in said_by(certify, {}, FINE[certify])
    fields = {name: getattr(OSCILLATOR, name) for name in ("neutral", "stroke", "base_cone", "platform_cone")}
    radii = {"base_radius": 0.25, "platform_radius": 0.25}
    single = {name: jnp.asarray(value, jnp.float32) for name, value in (fields | radii).items()}
    assert "float64" in said_by(certify, pk.CasingOscillator(**single), FINE[certify])


@BOTH
@pytest.mark.parametrize("mech", [OSCILLATOR, TWO_RPR], ids=["oscillator", "2-RPR"])
def test_traced_mechanisms_are_refused(certify, mech):
    ranges = FINE[certify] if mech is OSCILLATOR else {"x": (-2.2, 2.2), "y": (0.5, 3)}
    assert "known values" in said_by(jax.jit(lambda mech: certify(mech, ranges).bound), mech)


@BOTH
@pytest.mark.parametrize("most", [0, -1, 2.5, True])
def test_numbers_of_boxes_that_are_refused(certify, most):
    assert "most must be an integer" in said_by(certify, OSCILLATOR, FINE[certify], most=most)


@BOTH
@pytest.mark.parametrize("at_least", [-1.0, np.nan])
def test_proofs_of_less_than_nothing_are_refused(certify, at_least):
    assert "at_least" in said_by(certify, OSCILLATOR, FINE[certify], at_least=at_least, most=100)


@BOTH
@pytest.mark.parametrize("within", [("stroke",), ("stroke_min", "strokes")])
def test_unknown_margins_are_named(certify, within):
    said = said_by(certify, OSCILLATOR, FINE[certify], within=within, most=10)
    assert within[-1] in said and "stroke_max" in said


def test_confined_by_no_margin_is_refused():
    ranges = {"x": (-9, 9), "y": (-9, 9), "phi": (-1, 1)}
    assert "margin" in said_by(pk.certify_confined, pk.catalogued("sauer-3-rpr"), ranges)
    assert "margin" in said_by(pk.certify_confined, OSCILLATOR, POSES, within=())


def test_boxes_of_the_workspace_that_are_refused():
    some = {name: POSES[name] for name in ("s", "roll")}
    assert "pitch, yaw missing" in said_by(pk.certify_confined, OSCILLATOR, some)
    for ends in ((0.5, 0.6), (0.3, 0.4), (0.48, 0.6)):
        assert "home" in said_by(pk.certify_confined, OSCILLATOR, {**POSES, "s": ends})
    for name, end in (("pitch", np.pi / 2), ("roll", np.pi), ("yaw", np.pi)):
        for ends in ((-end, 0.2), (-0.2, end), (-4, 4)):
            said = said_by(pk.certify_confined, OSCILLATOR, {**POSES, name: ends})
            assert f"ranges['{name}'] must be inside" in said
