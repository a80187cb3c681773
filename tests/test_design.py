"""Design spaces, the composite index, and the ascent in the box; the optima are in test_reproduce."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pk_jax as pk
from pk_jax.design import ascent

RPR, RRR = pk.design_space("2-rpr"), pk.design_space("2-rrr")


# --- spaces


@pytest.mark.parametrize("space", [RPR, RRR], ids=str)
def test_the_box_is_the_feasible_set(space):
    boxes = np.random.default_rng(1).uniform(0, 1, (200, len(space.variables)))
    boxes[:40] = np.round(boxes[:40])  # corners and edges
    for box in boxes:
        vector = space.from_box(jnp.asarray(box))
        assert min(space.constraints(vector).values()) >= -1e-12
        assert np.all(vector >= np.array(space.bounds[0])) and np.all(
            vector <= np.array(space.bounds[1]) + 1e-15
        )
        again = space.from_box(space.to_box(vector))
        np.testing.assert_allclose(again, vector, atol=1e-12)


def test_faces_of_the_box_are_constraints():
    low = RRR.from_box(jnp.array([0.0, 0.3]))
    assert abs(RRR.constraints(low)["lb - la = R"]) < 1e-12
    assert RRR.constraints(RRR.from_box(jnp.array([0.3, 0.0])))["v = 0"] == 0
    assert abs(RRR.constraints(RRR.from_box(jnp.array([1.0, 0.3])))["l_min = 5 R"]) < 1e-12
    np.testing.assert_allclose(RRR.from_box(jnp.zeros(2)), [1, 0])
    assert RPR.constraints(RPR.from_box(jnp.ones(1)))["l_min = 3 R"] == 0


def test_mechanisms_of_a_space_satisfy_equation_22():
    mech = RRR.mechanism(jnp.array([2.08, np.sqrt(0.39)]))
    np.testing.assert_allclose([mech.proximal, mech.distal, *mech.reach], [1.39, 2.69, 2.08, 4.08])
    mech = RPR.mechanism(jnp.array([1.01]))
    np.testing.assert_allclose([mech.l_min, mech.l_max], [1.01, 3.01])


@pytest.mark.soak
def test_the_gradient_passes_through_the_mechanism_at_la_equal_r():
    """d gri / dv at v = 0 is not 0, though d la / dv is: the mechanism carries v."""
    slope = jax.jit(jax.grad(lambda v: pk.workspace_indices(RRR.mechanism(jnp.stack([1.7, v]))).gri))(0.0)
    assert np.isfinite(slope) and abs(slope) > 0.1


def test_unknown_space():
    with pytest.raises(ValueError, match="design space must be one of 2-rpr, 2-rrr, got '3-rrr'"):
        pk.design_space("3-rrr")


# --- composite index


def test_composite_index_is_equation_27():
    indices = jnp.array([0.5, 1.0, 0.3])
    bounds = (jnp.array([0.2, 0.4, 0.1]), jnp.array([0.7, 2.4, 0.5]))
    expected = 2 * (0.3 / 0.5) + 1 * (0.6 / 2.0) + 3 * (0.2 / 0.4)
    assert abs(pk.composite_index(indices, bounds, (2, 1, 3)) - expected) < 1e-15
    batch = pk.composite_index(jnp.stack([indices, bounds[1]]), bounds, (1, 1, 1))
    np.testing.assert_allclose(batch, [0.6 + 0.3 + 0.5, 3.0])
    found = pk.workspace_indices(pk.TwoRPR(half_base=1, l_min=2, l_max=4))
    as_array = pk.composite_index(jnp.stack([found.gii, found.gri, found.sui]), bounds)
    assert pk.composite_index(found, bounds) == as_array


def test_the_normalization_is_frozen():
    gradient = jax.grad(lambda b: pk.composite_index(jnp.ones(3), (b, jnp.full(3, 5.0)), (1, 1, 1)))(
        jnp.zeros(3)
    )
    np.testing.assert_array_equal(gradient, 0)


@pytest.mark.parametrize(
    "weights",
    [(0, 0, 0), (-1, 1, 1), (np.nan, 1, 1), (np.inf, 1, 1), (1, 1), (1, 1, 1, 1), 1, "abc", (1, "a", 1)],
)
def test_bad_weights(weights):
    with pytest.raises(ValueError, match="weights") as told:
        pk.composite_index(jnp.ones(3), (np.zeros(3), np.ones(3)), weights)
    assert "\n" not in str(told.value)
    with pytest.raises(ValueError, match="weights"):
        pk.optimize_design(RPR, weights)


@pytest.mark.parametrize(
    "bounds",
    [
        None,
        3,
        (np.ones(3), np.ones(3)),
        (np.ones(3), np.zeros(3)),
        (np.zeros(2), np.ones(2)),
        ([0, 0, np.nan], [1, 1, 1]),
    ],
)
def test_bad_bounds(bounds):
    with pytest.raises(ValueError, match="bounds"):
        pk.composite_index(jnp.ones(3), bounds)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"starts": 0}, "starts must be an integer"),
        ({"starts": -3}, "starts must be an integer"),
        ({"starts": [[0.9]]}, "starts lies outside the 2-rpr designs, beyond l_min = R"),
        ({"starts": [[3.1]]}, "beyond l_min = 3 R"),
        ({"starts": [[1.5, 0.1]]}, "starts must have shape"),
        ({"starts": [[np.nan]]}, "starts must be finite"),
        ({"steps": 0}, "steps must be an integer"),
        ({"steps": 10**24}, "steps must be an integer"),
        ({"steps": 2.5}, "steps must be an integer"),
        ({"tolerance": 0}, "tolerance"),
        ({"tolerance": "x"}, "tolerance"),
        ({"bounds": (1, 2)}, "bounds"),
    ],
)
def test_bad_options(options, words):
    with pytest.raises(ValueError) as told:
        pk.optimize_design(RPR, **({"bounds": (np.zeros(3), np.ones(3))} | options))
    assert words in str(told.value) and "\n" not in str(told.value)


def test_space_must_be_a_space():
    with pytest.raises(ValueError, match=r"space must come from design_space"):
        pk.optimize_design("2-rpr")


# --- ascent, on functions with known maxima


def climb(function, starts, steps=60, tolerance=1e-9, values=None, first=None):
    def advance(state):
        return ascent.judge(state, *jax.value_and_grad(function)(ascent.propose(state)), tolerance)

    step = jax.jit(jax.vmap(advance))
    states = jax.vmap(ascent.begin)(jnp.asarray(starts)) if first is None else first
    for _ in range(steps):
        states = step(states)
        if values is not None:
            values.append(states.value)
    return states


STARTS = np.random.default_rng(3).uniform(0, 1, (8, 3))


def test_a_concave_quadratic_with_bounds():
    target = jnp.array([0.3, 1.7, -0.4])  # the last two lie outside: bounds bind there
    states = climb(lambda x: -jnp.sum(jnp.array([1.0, 30.0, 5.0]) * (x - target) ** 2), STARTS)
    np.testing.assert_allclose(states.box, np.tile([0.3, 1.0, 0.0], (8, 1)), atol=1e-8)
    assert np.all(states.box[:, 1] == 1) and np.all(states.box[:, 2] == 0)  # reached, not approached
    assert np.all(states.is_done) and np.all(states.evaluations < 25)


def test_a_curved_valley():
    """Rosenbrock's function: neither concave nor well scaled."""
    states = climb(
        lambda x: -(100 * (x[1] - x[0] ** 2) ** 2 + (0.7 - x[0]) ** 2 + x[2] ** 2), STARTS, steps=150
    )
    np.testing.assert_allclose(states.box, np.tile([0.7, 0.49, 0.0], (8, 1)), atol=1e-5)


def test_no_step_goes_down():
    """Steep and wavy: most full steps overshoot, and none that loses may be accepted."""
    wavy = lambda x: jnp.sum(jnp.sin(25 * x)) - 8 * jnp.sum((x - 0.4) ** 2)
    values = []
    climb(wavy, STARTS, steps=24, values=values)
    assert np.all(np.diff(np.array(values), axis=0) >= 0)


def test_a_climb_goes_on_by_a_better_rule():
    """What the rough one said of the curvature saves most of the way."""
    scales, target = jnp.array([1.0, 30.0, 5.0]), jnp.array([0.3, 1.7, 0.6])
    true = lambda x: -jnp.sum(scales * (x - target) ** 2)
    rough = climb(lambda x: true(x) + 1e-3 * jnp.sum(jnp.sin(x)), STARTS, tolerance=1e-2)
    assert rough.is_done.all() and abs(rough.box - jnp.array([0.3, 1, 0.6])).max() > 1e-5
    slopes = jax.vmap(jax.value_and_grad(true))(rough.box)
    states = jax.vmap(lambda *lane: ascent.restated(*lane, 1e-9))(rough, *slopes)
    np.testing.assert_array_equal(states.box, rough.box)
    np.testing.assert_array_equal(states.value, slopes[0])
    assert not states.is_done.any() and np.all(states.evaluations == rough.evaluations + 1)
    ended = climb(true, STARTS, first=states)
    np.testing.assert_allclose(ended.box, np.tile([0.3, 1.0, 0.6], (8, 1)), atol=1e-6)  # gains are roundoff
    assert np.all(ended.is_done) and np.all(ended.evaluations - states.evaluations <= 6)
    anew = jax.vmap(lambda *lane: ascent.restated(*lane, 1e-5))(ended, ended.value, ended.gradient)
    assert anew.is_done.all()


def test_a_nan_gradient_is_no_step_either():
    """At 0.7 the value goes on, but its derivative there is 0 * inf."""
    edge = lambda x: jnp.sum(x) + 0 * jnp.sqrt(jnp.maximum(0.7 - x[0], 0))
    states = climb(edge, np.full((1, 3), 0.4))
    assert np.all(np.isfinite(states.gradient)) and states.box[0, 0] < 0.7


def test_a_finished_start_stays_and_a_nan_is_no_step():
    def hole(x):
        return jnp.where(x[0] > 0.8, jnp.nan, x[0] - (x[1] - 0.5) ** 2 - (x[2] - 0.5) ** 2)

    states = climb(hole, np.full((1, 3), 0.4))
    assert np.all(np.isfinite(states.box)) and 0.7 < states.box[0, 0] <= 0.8
    flat = climb(lambda x: 0 * jnp.sum(x), STARTS, steps=5)
    np.testing.assert_array_equal(flat.box, STARTS)
    assert np.all(flat.evaluations == 1)
