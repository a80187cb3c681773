"""Design problems of any mechanism: optima that are known, or that scipy finds too; every bit resumed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import pk_jax as pk
from pk_jax.analysis.indices import indices_at
from pk_jax.design import lagrangian, pareto
from pk_jax.design.problem import DesignProblem
from pk_jax.design.robust import normal_pairs, robust
from pk_jax.design.search import (
    BLOCK,
    advance,
    arrays_of,
    begin,
    optimize_problem,
    search_of,
    start_boxes,
    summary,
)

pytestmark = pytest.mark.usefixtures("compiled_in_haste")


class Point(pk.Mechanism):
    """Nothing but its fields: for problems whose optimum is known."""

    x: jax.Array

    def residual(self, pose, joints):
        return pose - joints

    def home(self):
        return jnp.zeros(1), jnp.zeros(1)

    def length(self):
        return jnp.ones(())

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(jnp.zeros((1, 2)), ())


def point_problem(objective, slacks=None, *, lower, upper, name="points"):
    return DesignProblem(
        lambda variables: Point(x=variables["x"]),
        {"x": (lower, upper)},
        lambda point: objective(point.x),
        None if slacks is None else lambda point: slacks(point.x),
        name=name,
    )


def run(problem, starts=4, steps=100, **options):
    search = begin(problem, start_boxes(problem, starts), **options)
    search = advance(problem, search, steps)
    return search, summary(problem, search)


def same(one, other):
    return all(
        np.array_equal(a, b, equal_nan=True)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )


def lanes(search, which):
    return jax.tree.map(lambda leaf: leaf[which], search)


# --- problems

POSES = jnp.array([[x, y] for x in (-0.4, 0.0, 0.4) for y in (1.2, 1.5, 1.8)])


def _least_isotropy(mechanism):
    """1/kappa at the poses; 0 where one is out of reach: the slacks are what tells there."""

    def one(pose):
        margins = mechanism.margins(pose, jnp.zeros(2))
        is_reached = jnp.min(jnp.stack([margins["reach_min"], margins["reach_max"]])) > 0
        nearest, farthest = mechanism.limits()
        nearest = jnp.maximum(nearest, mechanism.half_base)
        middle = jnp.sqrt(jnp.maximum((nearest**2 + farthest**2) / 2 - mechanism.half_base**2, 1e-3))
        pose = jnp.where(is_reached, pose, jnp.stack([0.0, middle]))
        return jnp.where(is_reached, indices_at(mechanism, pose, mechanism.inverse(pose))[0], 0)

    return jax.vmap(one)(POSES)


def _reach(mechanism):
    margins = jax.vmap(lambda pose: mechanism.margins(pose, jnp.zeros(2)))(POSES)
    return {"reach_min": margins["reach_min"], "reach_max": margins["reach_max"]}


@functools.cache
def five_bar():
    return DesignProblem(
        lambda variables: pk.FiveBar(**variables),
        {"half_base": (0.3, 1.5), "proximal": (0.5, 2.0), "distal": (0.5, 2.0)},
        _least_isotropy,
        _reach,
        name="five-bar",
    )


@functools.cache
def disk():
    """The far end of a disk along (1, 1): sqrt(2). No value beyond x[0] = 1.6, none for x[1] < -1.8."""
    is_there = lambda x: (x[0] <= 1.6) & (x[1] >= -1.8)
    return point_problem(
        lambda x: jnp.where(is_there(x), x[0] + x[1], jnp.nan),
        lambda x: {"inside": 1 - x @ x},
        lower=np.full(2, -2.0),
        upper=np.full(2, 2.0),
        name="disk",
    )


@functools.cache
def rosen_suzuki():
    """Rosen and Suzuki's: concave, three quadratic constraints; 44 at (0, 1, 2, -1)."""

    def objective(x):
        return (
            -(x[0] ** 2 + x[1] ** 2 + 2 * x[2] ** 2 + x[3] ** 2) + 5 * x[0] + 5 * x[1] + 21 * x[2] - 7 * x[3]
        )

    def slacks(x):
        a, b, c, d = x
        first = 8 - a * a - b * b - c * c - d * d - a + b - c + d
        second = 10 - a * a - 2 * b * b - c * c - 2 * d * d + a + d
        return {"g": jnp.stack([first, second, 5 - 2 * a * a - b * b - c * c - 2 * a + b + d])}

    return point_problem(objective, slacks, lower=np.full(4, -3.0), upper=np.full(4, 3.0))


# --- what a problem is


def test_entries_are_named_and_in_order():
    problem = DesignProblem(
        lambda v: pk.FiveBar(half_base=v["r"], proximal=v["links"][0, 0], distal=v["links"][0, 1]),
        {"r": (0.5, 1.0), "links": (np.array([[1.0, 2.0]]), np.array([[3.0, 5.0]]))},
        lambda m: m.proximal,
        lambda m: {"z": m.distal - 1, "a": jnp.stack([m.half_base, m.proximal])},
    )
    assert problem.entries == ("r", "links[0,0]", "links[0,1]")
    assert problem.constraint_names == ("a[0]", "a[1]", "z")
    objective, slacks = jax.jit(problem.measure)(jnp.array([0.75, 2.0, 4.0]))
    np.testing.assert_array_equal(objective, [2.0])
    np.testing.assert_array_equal(slacks, [0.75, 2.0, 3.0])
    found = problem.variables_of([0.75, 2.0, 4.0])
    np.testing.assert_array_equal(found["links"], [[2.0, 4.0]])
    assert float(problem.design(jnp.array([0.75, 2.0, 4.0])).distal) == 4
    assert hash(problem) != hash(five_bar())


def test_the_box_reaches_the_bounds_exactly():
    rng = np.random.default_rng(5)
    lower = rng.normal(size=500) * 10.0 ** rng.integers(-9, 9, 500)
    upper = lower + np.abs(rng.normal(size=500)) * 10.0 ** rng.integers(-9, 9, 500) + 1e-6 * abs(lower)
    problem = point_problem(jnp.sum, lower=lower, upper=upper)
    for end, bound in ((0.0, lower), (1.0, upper)):
        np.testing.assert_array_equal(problem.vector(jnp.full(500, end)), bound)
        np.testing.assert_array_equal(problem.box(bound), end)
    inside = rng.uniform(size=500)
    np.testing.assert_allclose(problem.box(problem.vector(jnp.asarray(inside))), inside, atol=1e-9)


GOOD = {"x": (np.zeros(2), np.ones(2))}
MAKE = lambda v: Point(x=v["x"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((3, GOOD, jnp.sum), "mechanism must be a function"),
        ((MAKE, GOOD, "x"), "objective must be a function"),
        ((MAKE, GOOD, lambda m: m.x[0], 1), "constraints must be a function"),
        ((MAKE, {}, jnp.sum), "variables must be a dict"),
        ((MAKE, {1: (0, 1)}, jnp.sum), "named by strings"),
        ((MAKE, {"x": 3}, jnp.sum), r"variables['x'] must be (lower, upper)"),
        ((MAKE, {"x": (0, [1, 2])}, jnp.sum), "one shape"),
        ((MAKE, {"x": (1.0, 1.0)}, jnp.sum), "lower < upper"),
        ((MAKE, {"x": (0, np.nan)}, jnp.sum), "finite"),
        ((MAKE, {"x": (-1.7e308, 1.7e308)}, jnp.sum), "lower < upper"),
        ((MAKE, {"x": ("a", "b")}, jnp.sum), "real numbers"),
        ((lambda v: v["x"], GOOD, jnp.sum), "mechanism must return a Mechanism"),
        ((MAKE, GOOD, lambda m: m.x[None]), "objective must return"),
        ((MAKE, GOOD, lambda m: m.x[:0]), "objective must return"),
        ((MAKE, GOOD, lambda m: m.x[0] > 0), "objective must be real numbers"),
        ((MAKE, GOOD, lambda m: m.x[0], lambda m: m.x), "constraints must return a dict"),
        ((MAKE, GOOD, lambda m: m.x[0], lambda m: {"a": m.x > 0}), "constraints['a'] must be real"),
    ],
)
def test_what_is_no_problem(arguments, words):
    with pytest.raises(ValueError) as told:
        DesignProblem(*arguments)
    assert words in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"starts": 0}, "starts must be an integer"),
        ({"starts": [[0.0, 3.0]]}, "x[1] in [-2, 2], got 3"),
        ({"starts": [[np.nan, 0.0]]}, "starts must be finite"),
        ({"starts": [[0.0]]}, "starts must have shape"),
        ({"steps": 0}, "steps must be an integer"),
        ({"chunk": 2.5}, "chunk must be an integer"),
        ({"seed": -1}, "seed must be an integer"),
        ({"tolerance": 0}, "tolerance must be a number"),
        ({"tolerance": np.nan}, "tolerance must be a number"),
    ],
)
def test_bad_options(options, words):
    with pytest.raises(ValueError) as told:
        optimize_problem(disk(), **options)
    assert words in str(told.value) and "\n" not in str(told.value)
    with pytest.raises(ValueError, match="problem must be a DesignProblem"):
        optimize_problem(pk.design_space("2-rpr"))
    with pytest.raises(ValueError, match="boxes must be"):
        begin(disk(), [[0.0, 1.5]])


# --- optima


def test_a_known_optimum_with_its_multipliers():
    top = jnp.array([0.0, 1.0, 2.0, -1.0])  # balanced there, and everything is concave
    (value,), slacks = rosen_suzuki().measure(top)
    of_value, of_slacks = jax.jacfwd(rosen_suzuki().measure)(top)
    assert value == 44 and slacks.tolist() == [0, 1, 0]
    np.testing.assert_array_equal(of_value[0] + of_slacks[0] + 2 * of_slacks[2], 0)
    search, found = run(rosen_suzuki())
    assert found.status == pk.Status.OK and search.is_solved.all() and search.evaluations.max() < 90
    np.testing.assert_allclose(found.vector, [0, 1, 2, -1], atol=1e-6)
    np.testing.assert_allclose(found.values, 44, atol=1e-6)
    assert found.active == ("g[0]", "g[2]") and found.kkt < 1e-6 and found.violation < 1e-7
    np.testing.assert_allclose([found.multipliers[name] for name in found.active], [1, 2], atol=1e-6)


def test_max_min_of_many_is_the_linear_program():
    """The best quartic for exp on [-1, 1] at 31 nodes: 62 objectives, six of them equal at the top."""
    nodes = np.linspace(-1, 1, 31)
    powers = np.stack([nodes**i for i in range(5)], axis=1)
    rows, shift = np.concatenate([powers, -powers]), np.concatenate([np.exp(nodes), -np.exp(nodes)])
    problem = point_problem(
        lambda x: jnp.asarray(rows) @ x - shift, lower=np.full(5, -2.0), upper=np.full(5, 2.0)
    )
    search, found = run(problem)
    program = scipy.optimize.linprog(
        [0] * 5 + [-1], np.hstack([-rows, np.ones((62, 1))]), -shift, bounds=[(-2, 2)] * 5 + [(None, None)]
    )
    tight = np.sort(np.argsort(program.ineqlin.marginals)[:6])  # HiGHS is exact in what is tight only
    exact = np.linalg.solve(np.hstack([-rows[tight], np.ones((6, 1))]), -shift[tight])
    assert found.status == pk.Status.OK and search.evaluations.max() <= 30
    np.testing.assert_allclose(search.value, exact[5], atol=1e-9)
    np.testing.assert_allclose(found.vector, exact[:5], atol=1e-7)
    shares = np.array([found.multipliers[f"objective[{i}]"] for i in tight])
    np.testing.assert_allclose(shares, -program.ineqlin.marginals[tight], atol=1e-7)
    assert abs(shares.sum() - 1) < 1e-9


@functools.cache
def five_bar_found():
    return run(five_bar(), starts=16, steps=60)


def test_a_five_bar_over_a_rectangle_of_poses():
    """No start of scipy's finds a better one, and the bound on half_base is reached, not approached."""
    problem = five_bar()
    search, found = five_bar_found()
    assert found.status == pk.Status.OK and found.kkt < 1e-6 and found.violation == 0
    assert found.vector[0] == 0.3 and found.active == ("half_base = 0.3",)
    assert np.sum(np.abs(search.value - found.value) < 1e-6) >= 4  # starts that agree
    measure = jax.jit(jax.vmap(problem.measure))

    def merit(vectors):
        objective, slacks = map(np.asarray, measure(jnp.asarray(vectors.T)))
        worst = np.minimum(slacks.min(axis=1), 0)
        return np.where(worst < 0, 1 - worst, -objective.min(axis=1))

    searched = scipy.optimize.differential_evolution(
        merit,
        list(zip(problem.lower, problem.upper, strict=True)),
        seed=1,
        vectorized=True,
        updating="deferred",
        maxiter=80,
        polish=False,
    )
    assert -searched.fun <= found.value + 1e-9
    assert abs(searched.fun + found.value) < 1e-3
    # the multiplier is the price of the bound
    moved = -merit(found.vector[:, None] + np.array([[1e-6], [0], [0]]))[0]
    price = found.multipliers["half_base = 0.3"]
    assert price > 0.1 and found.value - moved > 0.5e-6 * price


def test_a_sigmoid_bijection_does_not_reach_the_bound():
    """The same problem in u, variables lower + (upper - lower) / (1 + exp(-u)), by SLSQP from our optimum."""
    problem, (_, found) = five_bar(), five_bar_found()
    vector = lambda u: problem.lower + (problem.upper - problem.lower) / (1 + np.exp(-u))
    measure, slopes = jax.jit(problem.measure), jax.jit(jax.jacfwd(lambda v: problem.measure(v)[0]))

    def slack(ut):
        return np.asarray(measure(vector(ut[:-1]))[0]) - ut[-1]

    def slack_slope(ut):
        inner = 1 / (1 + np.exp(-ut[:-1]))
        by_u = np.asarray(slopes(vector(ut[:-1]))) * (problem.upper - problem.lower) * inner * (1 - inner)
        return np.column_stack([by_u, -np.ones(len(by_u))])

    box = np.clip(np.asarray(problem.box(found.vector)), 0.05, 0.95)
    start = np.append(np.log(box / (1 - box)), 0.5)
    bent = scipy.optimize.minimize(
        lambda ut: -ut[-1],
        start,
        jac=lambda ut: np.append(np.zeros(3), -1.0),
        constraints={"type": "ineq", "fun": slack, "jac": slack_slope},
        method="SLSQP",
        options={"maxiter": 200, "ftol": 1e-12},
    )
    reached = vector(bent.x[:-1])
    assert abs(-bent.fun - found.value) < 1e-6
    assert reached[0] - 0.3 > 1e-12 and found.vector[0] == 0.3


# --- lanes, chunks, devices, files: the same bits


def test_a_start_does_not_depend_on_the_others():
    boxes = start_boxes(disk(), BLOCK + 3)
    whole = advance(disk(), begin(disk(), boxes), 12)
    for which in (slice(0, 1), slice(BLOCK, None), slice(1, None, 3), slice(None, None, -1)):
        alone = advance(disk(), begin(disk(), boxes[which]), 12)
        assert same(alone, lanes(whole, which))
    device = jax.devices()[0]
    assert same(advance(disk(), begin(disk(), boxes), 12, devices=[device] * 2), whole)


def test_a_five_bar_resumes_bit_for_bit():
    search = five_bar_found()[0]
    again = begin(five_bar(), start_boxes(five_bar(), 16)[::2])
    for steps in (1, 4, 10, 45):
        again = search_of(five_bar(), {k: np.array(v) for k, v in arrays_of(again).items()})
        again = advance(five_bar(), again, steps)
    assert same(again, lanes(search, slice(None, None, 2)))
    finished = search.is_done
    assert finished.any()
    assert same(lanes(advance(five_bar(), search, 7), finished), lanes(search, finished))


def test_arrays_of_another_problem_are_refused():
    arrays = arrays_of(begin(disk(), start_boxes(disk(), 3)))
    assert all(isinstance(array, np.ndarray) and array.dtype != object for array in arrays.values())
    for broken in (
        {name: array for name, array in arrays.items() if name != "penalty"},
        arrays | {"box": arrays["box"][:, :1]},
        arrays | {"value": arrays["value"].astype(np.float32)},
        {},
    ):
        with pytest.raises(ValueError, match="search array"):
            search_of(disk(), broken)
    with pytest.raises(ValueError, match="search array"):
        search_of(rosen_suzuki(), arrays)


def test_seeds_shift_the_starts():
    boxes = [start_boxes(disk(), 8, seed=seed) for seed in (0, 0, 1, 2)]
    assert np.array_equal(boxes[0], boxes[1])
    assert not np.allclose(boxes[0], boxes[2]) and not np.allclose(boxes[2], boxes[3])
    assert all(np.all((box > 0) & (box < 1)) for box in boxes)


# --- verdicts


def test_a_start_that_is_not_there_is_lost_alone():
    good = np.array([[0.1, 0.1], [0.3, -0.5], [1.0, 1.0]])
    vectors = np.insert(good, 1, [1.9, 0.0], axis=0)
    search, found = run(disk(), vectors)
    assert same(lanes(search, [0, 2, 3]), run(disk(), good)[0])
    assert np.isnan(search.value[1]) and search.is_done[1] and search.evaluations[1] == 1
    assert found.status == pk.Status.OK and np.isnan(found.values[1])
    np.testing.assert_allclose(found.values[[0, 2, 3]], np.sqrt(2), atol=1e-7)
    np.testing.assert_allclose(found.vector, np.sqrt(0.5), atol=1e-7)
    assert abs(found.multipliers["inside"] - np.sqrt(0.5)) < 1e-6

    nowhere = run(disk(), [[1.9, 0.0], [1.8, 1.0]])[1]
    assert nowhere.status == pk.Status.NONFINITE and np.isnan(nowhere.value) and np.isnan(nowhere.kkt)


def test_a_hole_beside_the_way_is_no_step():
    """From x[1] = -1.7 the first steps overshoot what is there."""
    search, found = run(disk(), [[1.5, -1.75], [-1.9, -1.7], [1.59, 1.9]])
    assert found.status == pk.Status.OK
    np.testing.assert_allclose(search.value, np.sqrt(2), atol=1e-7)


def test_too_few_steps():
    said = []
    found = optimize_problem(disk(), starts=3, steps=5, chunk=2, report=lambda *what: said.append(what))
    assert found.status == pk.Status.STEP_LIMIT and found.evaluations == 15
    assert [what[:3] for what in said] == [("disk", 2, 5), ("disk", 4, 5), ("disk", 5, 5)]


def test_no_design_is_feasible():
    problem = point_problem(
        lambda x: x[0], lambda x: {"far": x @ x - 100}, lower=np.full(2, -2.0), upper=np.full(2, 1.0)
    )
    found = run(problem, starts=2)[1]
    assert found.status == pk.Status.UNREACHABLE and np.isnan(found.value) and np.all(np.isnan(found.values))
    assert abs(found.violation - 92) < 1e-9  # the least possible, at the corner (-2, -2)
    np.testing.assert_array_equal(found.vector, [-2, -2])


def test_optimize_design_takes_problems():
    found = pk.optimize_design(disk(), starts=3, steps=40)
    again = optimize_problem(disk(), starts=3, steps=40, chunk=7)
    assert same([found.vector, found.values, found.kkt], [again.vector, again.values, again.kkt])
    assert found.active == again.active == ("inside",)
    for options in ({"weights": (1, 1, 1)}, {"bounds": (np.zeros(3), np.ones(3))}):
        with pytest.raises(ValueError, match=f"{next(iter(options))} belong to the composite index"):
            pk.optimize_design(disk(), **options)


# --- multipliers


def test_projection_on_the_simplex():
    rng = np.random.default_rng(2)
    for size in (1, 2, 7, 40):
        points = rng.normal(size=(50, size)) * 10.0 ** rng.integers(-3, 4, (50, 1))
        found = np.asarray(jax.vmap(lagrangian.onto_simplex)(jnp.asarray(points)))
        assert np.all(found >= 0)
        np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-9)
        # nearest: the point lies beyond the face of each kept entry equally, of the others no farther
        for point, near in zip(points, found, strict=True):
            beyond = point - near
            level = beyond[near > 0].mean()
            np.testing.assert_allclose(beyond[near > 0], level, atol=1e-9 * (1 + abs(level)))
            assert np.all(beyond <= level + 1e-9 * (1 + abs(level)))


def test_least_squares_with_signs_is_that_of_scipy():
    rng = np.random.default_rng(4)
    for _ in range(60):
        columns = rng.normal(size=rng.integers(1, 7, 2))
        target = rng.normal(size=len(columns))
        found = lagrangian.least_squares(columns, target)
        best = scipy.optimize.nnls(columns, target)[1]
        assert np.all(found >= 0)
        assert abs(np.linalg.norm(columns @ found - target) - best) < 1e-9


# --- fronts


def test_the_front_is_what_nothing_dominates():
    rng = np.random.default_rng(8)
    rows = rng.integers(0, 6, (60, 3)).astype(float)
    rows[7] = np.nan
    feasible = rng.uniform(size=60) < 0.8
    valid = [i for i in range(60) if feasible[i] and i != 7]
    dominates = lambda a, b: all(a >= b) and any(a > b)
    expected = [i for i in valid if not any(dominates(rows[j], rows[i]) for j in valid)]
    assert pareto.pareto_front(rows, feasible).tolist() == expected
    assert pareto.pareto_front(np.zeros((3, 2))).tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="is_feasible"):
        pareto.pareto_front(rows, feasible[:5])


def test_fronts_of_a_problem():
    """Two paraboloids: weights (w, 1 - w) lead to x = (1 - w, 0)."""
    paraboloids = lambda x: -jnp.stack([x @ x, (x[0] - 1) ** 2 + x[1] ** 2])
    problem = point_problem(paraboloids, lower=np.full(2, -2.0), upper=np.full(2, 2.0))
    front = pareto.pareto_problem(problem, [[1, 3], [1, 1], [2, 0]], starts=2, steps=40)
    assert front.status == pk.Status.OK
    np.testing.assert_allclose(front.vectors, [[0.75, 0], [0.5, 0], [0, 0]], atol=1e-6)
    with pytest.raises(ValueError, match="weights must be >= 0"):
        pareto.pareto_problem(problem, [[0, 0]])


def test_a_front_that_is_not_convex():
    """f = (x, (1 - x)^2): sums find the ends only, the least of w (f - reference) what lies between."""
    hollow = lambda x: jnp.stack([x[0], (1 - x[0]) ** 2 - x[1] ** 2])
    problem = point_problem(hollow, lower=np.zeros(2), upper=np.ones(2))
    reference = [-0.5, -0.25]
    front = pareto.pareto_problem(problem, [[1, 1], [2, 1]], reference=reference, starts=2, steps=40)
    assert front.status == pk.Status.OK
    # x + 0.5 = (1 - x)^2 + 0.25, and 2 (x + 0.5) = (1 - x)^2 + 0.25
    np.testing.assert_allclose(front.vectors[:, 0], [(3 - np.sqrt(6)) / 2, 2 - np.sqrt(3.75)], atol=1e-7)
    np.testing.assert_allclose(front.vectors[:, 1], 0, atol=1e-7)


@pytest.mark.soak
def test_the_front_of_the_five_bar_space():
    space = pk.design_space("2-rrr")
    front = pareto.pareto_designs(space, 12, starts=3, steps=60)
    assert front.status == pk.Status.OK and len(front.vectors) >= 3
    ranges = np.subtract(*np.asarray(pk.index_bounds(space))[::-1])
    boxes = np.random.default_rng(0).uniform(size=(64, 2))
    others = pareto.indices_and_slopes(space, np.array([space.from_box(jnp.asarray(box)) for box in boxes]))[
        0
    ]
    for indices, weights in zip(front.indices, front.weights, strict=True):
        assert np.all((others / ranges) @ weights <= (indices / ranges) @ weights + 1e-6)
    assert len(pareto.pareto_front(front.indices)) == len(front.indices)


# --- tolerances


def test_errors_have_the_moments_asked_for():
    for samples, dimension, seed in ((8, 2, 0), (16, 5, 3), (6, 3, 1)):
        errors = normal_pairs(samples, dimension, seed)
        np.testing.assert_allclose(errors.mean(axis=0), 0, atol=1e-15)
        np.testing.assert_allclose(errors.T @ errors / samples, np.eye(dimension), atol=1e-12)
        np.testing.assert_array_equal(errors, normal_pairs(samples, dimension, seed))
    assert not np.allclose(normal_pairs(8, 2, 1), normal_pairs(8, 2, 2))


def test_the_mean_of_a_quadratic_is_exact():
    """E of -(x - a)' Q (x - a) is that of x less trace(Q C)."""
    q = jnp.array([[2.0, 0.5], [0.5, 1.0]])
    bowl = lambda x: -(x - 0.3) @ q @ (x - 0.3)
    problem = point_problem(bowl, lambda x: {"low": 1 - x}, lower=np.full(2, -2.0), upper=np.full(2, 2.0))
    scattered = robust(problem, {"x": [0.1, 0.2]}, samples=8)
    for vector in ([0.3, 0.3], [1.0, -0.7]):
        mean, slacks = scattered.measure(jnp.array(vector))
        np.testing.assert_allclose(mean, bowl(jnp.array(vector)) - 2 * 0.1**2 - 1 * 0.2**2, rtol=1e-12)
        assert slacks.shape == (16,) == (len(scattered.constraint_names),)
    assert scattered.constraint_names[3] == "low[1] of sample 1"
    lower = robust(problem, {"x": [0.1, 0.2]}, samples=8, deviations=2.0).measure(jnp.full(2, 0.7))[0]
    values = np.array([bowl(jnp.full(2, 0.7) + e) for e in normal_pairs(8, 2) * [0.1, 0.2]])
    np.testing.assert_allclose(lower, values.mean() - 2 * values.std(), rtol=1e-12)


@pytest.mark.soak
def test_the_composite_index_may_be_expected_of_links_that_are_made_with_errors():
    """GII, GRI and SUI of Nam, Lee and Park 2006, by the integrals of any mechanism also off eq. (22)."""
    bounds = pk.index_bounds(pk.design_space("2-rrr"))
    five_bar = lambda v: pk.FiveBar(half_base=1.0, **v, reach=(1.3, 3.3))

    def cpi(mech):
        found = pk.workspace_integral(mech, ("isotropy", "resistivity"), rule="panels", nodes=8)
        box = 2 * (mech.reach[0] + 1) * jnp.sqrt(mech.reach[1] ** 2 - 1)
        return pk.composite_index(jnp.append(found.mean, found.volume / box), bounds)

    problem = DesignProblem(five_bar, {"proximal": (0.9, 1.6), "distal": (2.2, 2.8)}, cpi)
    own_rule = pk.workspace_indices(five_bar({"proximal": 1.05, "distal": 2.25}))
    at_once = pk.evaluate_designs(problem, [[1.05, 2.25]], slopes=False)
    np.testing.assert_allclose(at_once.objective[0, 0], pk.composite_index(own_rule, bounds), rtol=2e-3)
    made = [1.1, 2.3] + 0.01 * normal_pairs(4, 2)
    each = pk.evaluate_designs(problem, made)
    expected = pk.evaluate_designs(
        robust(problem, {"proximal": 0.01, "distal": 0.01}, samples=4), [[1.1, 2.3]]
    )
    np.testing.assert_allclose(expected.objective[0], each.objective.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(expected.objective_slopes[0], each.objective_slopes.mean(axis=0), rtol=1e-9)


def test_the_worst_case_keeps_its_distance():
    """Maximize x where x <= 1 for every sample: the optimum is 1 less the largest error."""
    problem = point_problem(
        lambda x: x[0], lambda x: {"left": 1 - x[0]}, lower=np.zeros(1), upper=np.full(1, 2.0)
    )
    scattered = robust(problem, {"x": 0.05}, samples=4, measure="worst")
    found = run(scattered, starts=2, steps=40)[1]
    largest = 0.05 * normal_pairs(4, 1).max()
    assert found.status == pk.Status.OK
    np.testing.assert_allclose(found.vector, 1 - largest, atol=1e-7)
    np.testing.assert_allclose(found.value, 1 - 2 * largest, atol=1e-7)


@pytest.mark.parametrize(
    ("tolerances", "options", "words"),
    [
        ({}, {}, "tolerances must be a dict"),
        ({"y": 0.1}, {}, "tolerances must be of the variables x, got 'y'"),
        ({"x": -0.1}, {}, "must be >= 0"),
        ({"x": np.nan}, {}, "must be finite"),
        ({"x": 0.0}, {}, "positive for at least one"),
        ({"x": [0.1, 0.1, 0.1]}, {}, "shape (2,)"),
        ({"x": 0.1}, {"samples": 3}, "samples must be even"),
        ({"x": 0.1}, {"measure": "median"}, "measure must be one of mean, worst"),
        ({"x": 0.1}, {"measure": "worst", "deviations": 1}, "deviations must be a number >= 0"),
    ],
)
def test_bad_tolerances(tolerances, options, words):
    with pytest.raises(ValueError) as told:
        robust(disk(), tolerances, **options)
    assert words in str(told.value) and "\n" not in str(told.value)
