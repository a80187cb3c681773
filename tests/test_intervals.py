"""Intervals hold what exact rational arithmetic gives, closely, and say so where they do not know."""

import functools
import itertools
import math
import operator
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import pk_jax as pk
from pk_jax.geometry import rotations, safe
from pk_jax.kinematics import intervals
from pk_jax.kinematics.entrywise import UnknownPrimitive
from pk_jax.kinematics.intervals import Interval, as_interval, enclosure, thin

NAN, INF = np.nan, np.inf
LEAST, GREATEST = math.ulp(0.0), float(np.finfo(float).max)
PI = Fraction("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899")
quiet = functools.partial(np.errstate, all="ignore")
BINARY = {
    "plus": operator.add,
    "minus": operator.sub,
    "times": operator.mul,
    "over": operator.truediv,
    "greater": max,
    "lesser": min,
}
UNARY = {"negative": operator.neg, "square": lambda x: x * x, "absolute": abs}


def box(lower, upper):
    return Interval(np.array([lower], float), np.array([upper], float))


def computed(name, *items, **named):
    """Lower and upper bound, of one box."""
    with quiet():
        found = as_interval(getattr(intervals, name)(*items, **named))
    return float(np.ravel(found.lower)[0]), float(np.ravel(found.upper)[0])


def holds(bounds, value):
    """Python compares floats with fractions exactly; a bound that is not known excludes nothing."""
    lower, upper = bounds
    return not lower > value and not upper < value


# numbers of all magnitudes, and those where rounding, overflow and underflow are delicate
DELICATE = (0.0, -0.0, LEAST, -LEAST, 2.0**-1022, 0.1, 1 / 3, 1.0, -1.0, 1 + 2.0**-52, GREATEST, -GREATEST)
ANY = st.floats(allow_nan=False, allow_infinity=False) | st.sampled_from(DELICATE) | st.floats(-10, 10)
MODERATE = st.floats(1e-70, 1e70) | st.floats(-1e70, -1e-70) | st.floats(0.1, 9) | st.just(0.0)
PARTS = st.fractions(0, 1, max_denominator=1000)


@st.composite
def boxes(draw, numbers=ANY):
    """Lower end, upper end, and a rational number between them."""
    lower, upper = sorted((draw(numbers), draw(numbers)))
    if draw(st.integers(0, 4)) == 0:
        upper = lower
    inside = Fraction(lower) + draw(PARTS) * (Fraction(upper) - Fraction(lower))
    return lower, upper, inside


# ---------------------------------------------------------------- containment, exactly


@pytest.mark.parametrize("name", BINARY)
@given(boxes(), boxes())
def test_two_intervals_hold_every_exact_result(name, a, b):
    found = computed(name, box(*a[:2]), box(*b[:2]))
    if name == "over" and b[0] <= 0 <= b[1]:
        assert np.isnan(found).all()
    else:
        assert holds(found, BINARY[name](a[2], b[2]))


@pytest.mark.parametrize("name", BINARY)
@given(ANY, boxes())
def test_a_number_and_an_interval_hold_every_exact_result(name, number, b):
    exact, wide = Fraction(number), box(*b[:2])
    if not (name == "over" and b[0] <= 0 <= b[1]) or number == 0:
        assert holds(computed(name, number, wide), 0 if number == 0 == b[2] else BINARY[name](exact, b[2]))
    if number != 0 or name != "over":
        assert holds(computed(name, wide, number), BINARY[name](b[2], exact))


@pytest.mark.parametrize("name", BINARY)
@given(ANY, ANY)
@example(0.1, 0.2)
@example(1.0, 3.0)
@example(LEAST, 0.5)
@example(GREATEST, GREATEST)
def test_numbers_hold_the_exact_result(name, a, b):
    """A known number only where it is exact, else an interval about it: 0.1 + 0.2, 1/3."""
    if name == "over" and b == 0:
        assert np.isnan(computed(name, a, b)).all() or a == 0
        return
    exact = BINARY[name](Fraction(a), Fraction(b))
    found = getattr(intervals, name)
    with quiet():
        of_numbers = found(a, b)
    if isinstance(of_numbers, float):
        assert Fraction(of_numbers) == exact
    for bounds in (computed(name, a, b), computed(name, box(a, a), box(b, b)), computed(name, a, box(b, b))):
        assert holds(bounds, exact)


@pytest.mark.parametrize("name", UNARY)
@given(boxes())
def test_one_interval_holds_every_exact_result(name, a):
    assert holds(computed(name, box(*a[:2])), UNARY[name](a[2]))


@given(boxes(MODERATE), st.integers(-4, 6))
def test_powers_hold_every_exact_power(a, y):
    found = computed("power", box(*a[:2]), y=y)
    if y < 0 and a[0] <= 0 <= a[1]:
        assert np.isnan(found).all()
    else:
        assert holds(found, a[2] ** y)


@given(boxes(st.floats(0, allow_infinity=False)))
@example((0.0, 2.0, Fraction(0)))
@example((2.0, 2.0, Fraction(2)))
@example((0.1, 0.1, Fraction(0.1)))
def test_roots_squared_hold_the_number(a):
    lower, upper = map(Fraction, computed("root", box(*a[:2])))
    assert lower >= 0 and lower**2 <= a[2] <= upper**2


@given(boxes())
def test_the_same_item_is_one_number(a):
    """x x is a square; x - x is not known to be 0, nor x y a square where y happens to be equal."""
    x, y = box(*a[:2]), box(*a[:2])
    assert computed("times", x, x)[0] >= 0 or np.isnan(computed("times", x, x)[0])
    assert holds(computed("minus", x, x), Fraction(a[0]) - Fraction(a[1]))
    assert holds(computed("times", x, y), Fraction(a[0]) * Fraction(a[1]))


# ---------------------------------------------------------------- tightness


def ends(name, *given):
    """Exact least and greatest result over boxes: at their corners, or where a square is 0."""
    corners = [(Fraction(lower), Fraction(upper)) for lower, upper, _ in given]
    results = [(UNARY | BINARY)[name](*corner) for corner in itertools.product(*corners)]
    if name in ("square", "absolute") and given[0][0] <= 0 <= given[0][1]:
        results.append(Fraction(0))
    return min(results), max(results)


@pytest.mark.parametrize("name", [*BINARY, *UNARY])
@given(boxes(MODERATE), boxes(MODERATE))
def test_ends_are_the_exact_ends_to_a_few_gaps(name, a, b):
    given = (a, b) if name in BINARY else (a,)
    if name == "over" and b[0] <= 0 <= b[1]:
        return
    found = computed(name, *(box(*each[:2]) for each in given))
    gaps = 8 if name == "over" else 3  # a quotient is rounded twice
    for bound, end, outward in zip(found, ends(name, *given), (-1, 1), strict=True):
        off = (Fraction(bound) - end) * outward
        assert 0 <= off <= gaps * Fraction(math.ulp(float(end)))


def test_squares_are_not_negative():
    assert computed("square", box(-1, 2))[0] == 0
    assert 4 <= computed("square", box(-1, 2))[1] <= 4 + 4e-15
    assert computed("power", box(-1, 2), y=4)[0] == 0
    lower, upper = computed("minus", box(-1, 2), box(-1, 2))
    assert -3.1 < lower <= -3 and 3 <= upper < 3.1


def test_known_numbers_stay_known_where_they_are_exact():
    x = box(-1, 2)
    assert intervals.plus(x, 0.0) is x and intervals.times(1.0, x) is x and intervals.power(x, 1) is x
    assert intervals.times(x, 0.0) == 0 and intervals.over(0.0, x) == 0 and intervals.power(x, 0) == 1
    assert intervals.plus(0.5, 0.25) == 0.75 and intervals.over(3.0, 4.0) == 0.75


# ---------------------------------------------------------------- what is not known


@pytest.mark.parametrize("name", ["plus", "minus", "times", "greater", "lesser"])
def test_unknown_stays_unknown(name):
    for a, b in itertools.permutations((box(NAN, NAN), box(1, 2))):
        assert np.isnan(computed(name, a, b)).all()
    for unary in ("square", "absolute", "negative", "root", "cosine", "sine"):
        assert np.isnan(computed(unary, box(NAN, NAN))).all()
    assert np.isnan(computed("times", box(NAN, NAN), 2.0)).all()


@pytest.mark.parametrize(("lower", "upper"), [(-1, 1), (0, 1), (-1, 0), (0, 0), (-LEAST, LEAST), (-0.0, 2)])
def test_nothing_is_known_of_division_by_zero(lower, upper):
    for a in (box(1, 2), 1.0, box(-INF, INF)):
        assert np.isnan(computed("over", a, box(lower, upper))).all()


def test_the_root_of_what_may_be_negative_is_unknown():
    assert np.isnan(computed("root", box(-LEAST, 1))[0])
    assert np.isnan(computed("root", box(-2, -1))).all()


@pytest.mark.parametrize("name", ["plus", "times"])
def test_overflow_is_no_finite_bound(name):
    """The greatest number, and one that is not: their sum or product has no float above it."""
    for sign in (1, -1):
        great = box(*sorted((sign * GREATEST / 2, sign * GREATEST)))
        lower, upper = computed(name, great, great if name == "plus" else box(1, 2))
        assert not (upper if sign > 0 else -lower) < INF
    assert not computed("over", 1.0, box(LEAST, 1))[1] < INF
    assert not computed("square", box(-GREATEST, 1))[1] < INF


@pytest.mark.parametrize("code", [lambda x, y: x < y, lambda x, y: ~(y <= x)])
@pytest.mark.parametrize(("x", "y"), [((NAN, NAN), (0, 1)), ((0, 1), (NAN, NAN)), ((-1, NAN), (2, 3))])
def test_no_comparison_with_the_unknown_is_sure(code, x, y):
    found = enclosure(lambda x, y: jnp.where(code(x, y), 1.0, 0.0), box(*x), box(*y))
    assert (found.lower, found.upper) == (0, 1)


# ---------------------------------------------------------------- comparisons

CHOICES = {
    "greater": (lambda x: x > 1, [(2, 3), (1 + 2.0**-52, 3)], [(0, 2), (1, 2)], [(-1, 0), (0, 1)]),
    "at least": (lambda x: x >= 1, [(2, 3), (1, 3)], [(0, 2), (0, 1)], [(-1, 0), (0, 1 - 2.0**-53)]),
    "less": (lambda x: x < 1, [(-1, 0), (0, 1 - 2.0**-53)], [(0, 2), (0, 1)], [(2, 3), (1, 2)]),
    "at most": (lambda x: x <= 1, [(-1, 0), (0, 1)], [(0, 2), (1, 2)], [(2, 3), (1 + 2.0**-52, 3)]),
    "not": (lambda x: ~(x > 1), [(-1, 0), (0, 1)], [(0, 2), (1, 2)], [(2, 3), (1 + 2.0**-52, 3)]),
    "and": (lambda x: (x > 0) & (x < 1), [(0.1, 0.9)], [(0.5, 2), (-1, 0.5), (-1, 2)], [(2, 3), (-2, -1)]),
    "or": (lambda x: (x < 0) | (x > 1), [(2, 3), (-2, -1)], [(0.5, 2), (-1, 0.5), (-1, 2)], [(0.1, 0.9)]),
}


@pytest.mark.parametrize("name", CHOICES)
def test_choices_are_sure_or_both(name):
    condition, surely, maybe, never = CHOICES[name]
    cases = [(case, bounds) for cases, bounds in ((surely, (5, 5)), (maybe, (-7, 5)), (never, (-7, -7)))
             for case in cases]  # fmt: skip
    lower, upper = np.array([case for case, _ in cases], float).T
    found = enclosure(lambda x: jnp.where(condition(x), 5.0, -7.0), Interval(lower, upper))
    assert list(zip(found.lower, found.upper, strict=True)) == [bounds for _, bounds in cases]


def test_both_branches_of_a_choice_that_is_not_sure():
    found = enclosure(lambda x: jnp.where(x > 0, x + 10, x), box(-1, 2))
    assert -1 - 1e-15 <= found.lower <= -1 and 12 <= found.upper <= 12 + 1e-14


# ---------------------------------------------------------------- sine and cosine

WAVES = {"cosine": 0, "sine": 1}


@functools.cache
def wave(name, x, terms=40):
    """cos or sin of a float by its series, in rational numbers. -> value, more than what is left out"""
    odd, x = WAVES[name], Fraction(x)
    term, total = x if odd else Fraction(1), Fraction(0)
    for k in range(terms):
        total += term
        term *= -x * x / ((2 * k + 1 + odd) * (2 * k + 2 + odd))
    assert abs(term) < Fraction(1, 10**35)
    return total, abs(term)


def is_in(name, x, bounds):
    """Whether surely cos x or sin x lies in the bounds."""
    value, rest = wave(name, x)
    return bounds[0] <= value - rest and value + rest <= bounds[1]


def beside(x, count=3):
    """Floats about a number: `count` on each side."""
    up, down = [float(x)], [float(x)]
    for _ in range(count):
        up.append(math.nextafter(up[-1], INF))
        down.append(math.nextafter(down[-1], -INF))
    return [*down, *up[1:]]


QUARTERS = [x for k in range(-4, 5) for x in beside(k * PI / 2) if k]
RANDOM = np.random.default_rng(1).uniform(-7, 7, 80).tolist()


def all_bounds(name, lower, upper):
    with quiet():
        found = getattr(intervals, name)(Interval(np.array(lower, float), np.array(upper, float)))
    return list(zip(found.lower.tolist(), found.upper.tolist(), strict=True))


@pytest.mark.parametrize("name", WAVES)
def test_waves_hold_the_exact_value_closely(name):
    at = [*RANDOM, *QUARTERS, 0.0, 1e-9, -(2.0**-60), 7.0, -7.0]
    for x, bounds in zip(at, all_bounds(name, at, at), strict=True):
        assert is_in(name, x, bounds) and bounds[1] - bounds[0] < 1e-11
        assert bounds[0] >= -1 and bounds[1] <= 1
    assert is_in(name, 0.75, computed(name, 0.75))
    assert getattr(intervals, name)(0.0) == 1 - WAVES[name]


def test_coefficients_of_the_series_hold_the_exact_ones():
    for n in range(2 * intervals._TERMS + 2):
        lower, upper = (Fraction(float(end)) for end in _ends(intervals._over_factorial(n)))
        assert lower <= Fraction(1, math.factorial(n)) <= upper < lower * (1 + Fraction(1, 10**15))
    lower, upper = (Fraction(float(end)) for end in _ends(intervals._PI))
    assert lower < PI < upper < lower + Fraction(1, 10**15)


@pytest.mark.parametrize("name", WAVES)
def test_waves_of_wide_intervals_are_their_range(name):
    """The extremes are where (x - shift) / pi is whole; elsewhere the range is that of the ends."""
    rng = np.random.default_rng(2)
    lower = np.concatenate([rng.uniform(-7, 7, 150), rng.choice(QUARTERS, 60)])
    upper = np.minimum(lower + rng.choice([1e-15, 0.1, 1, 3, 6, 14], lower.size) * rng.random(lower.size), 7)
    for low, high, bounds in zip(lower, upper, all_bounds(name, lower, upper), strict=True):
        turns = [Fraction(float(x)) / PI - Fraction(WAVES[name], 2) for x in (low, high)]
        inside = range(math.ceil(turns[0]), math.floor(turns[1]) + 1)
        values = [wave(name, x)[0] for x in (low, high)]
        values += [(-1) ** k for k in inside]
        assert all(is_in(name, x, bounds) for x in (low, high))
        assert bounds[0] <= min(values) < bounds[0] + 1e-11
        assert bounds[1] - 1e-11 < max(values) <= bounds[1]


@pytest.mark.parametrize("name", WAVES)
def test_waves_far_away_hold_the_exact_value_closely(name):
    """Whole turns are taken off, those of an interval that holds pi."""
    rng = np.random.default_rng(3)
    at = [*rng.uniform(-1e3, 1e3, 40), *(x for k in (-300, -7, 5, 8, 41) for x in beside(k * PI / 2))]
    at += [math.nextafter(7.0, 8), 7.1, -9.0, 50.0]
    for x, bounds in zip(at, all_bounds(name, at, at), strict=True):
        less = Fraction(x) - round(Fraction(x) / (2 * PI)) * 2 * PI
        assert is_in(name, less, bounds) and bounds[1] - bounds[0] < 1e-12
        assert bounds[0] >= -1 and bounds[1] <= 1


@pytest.mark.parametrize("name", WAVES)
def test_wide_waves_far_away_are_their_range(name):
    lower = np.random.default_rng(4).uniform(-200, 200, 100)
    upper = lower + np.tile([0.1, 1, 3, 6], 25)
    for low, high, bounds in zip(lower, upper, all_bounds(name, lower, upper), strict=True):
        turns = [Fraction(x) / PI - Fraction(WAVES[name], 2) for x in (low, high)]
        values = [(-1) ** k for k in range(math.ceil(turns[0]), math.floor(turns[1]) + 1)]
        values += [wave(name, Fraction(x) - round(Fraction(x) / (2 * PI)) * 2 * PI)[0] for x in (low, high)]
        assert bounds[0] <= min(values) < bounds[0] + 1e-11
        assert bounds[1] - 1e-11 < max(values) <= bounds[1]


@pytest.mark.parametrize("name", WAVES)
def test_waves_very_far_away_and_of_the_unknown(name):
    """Where turns cannot be told, or there are several, all that is known is [-1, 1]; of NaN, nothing."""
    far = [(1e18, 1e18), (-1e300, -8), (-9, 9), (0, 1e9), (-GREATEST, GREATEST), (9, INF)]
    assert all_bounds(name, *zip(*far, strict=True)) == [(-1, 1)] * len(far)
    unknown = [(NAN, NAN), (NAN, 1), (0, NAN), (-9, NAN)]
    assert np.isnan(all_bounds(name, *zip(*unknown, strict=True))).all()


# ---------------------------------------------------------------- arrays


def exact_determinant(rows):
    if not rows:
        return Fraction(1)
    minor = lambda j: [row[:j] + row[j + 1 :] for row in rows[1:]]
    return sum((-1) ** j * x * exact_determinant(minor(j)) for j, x in enumerate(rows[0]) if x)


def random_matrices(rng, n, count=4):
    """Whole numbers, numbers of one magnitude and of many. -> (count, n, n) each"""
    numbers = rng.standard_normal((count, n, n))
    return rng.integers(-4, 5, (count, n, n)), numbers, numbers * 10.0 ** rng.integers(-6, 7, (count, n, n))


def fractions_of(matrix):
    return [[Fraction(float(x)) for x in row] for row in matrix]


def about(values, rng, width):
    """Intervals around numbers."""
    values = np.asarray(values, float)
    return Interval(values - width * rng.random(values.shape), values + width * rng.random(values.shape))


@pytest.mark.parametrize("n", range(1, 7))
def test_determinants_hold_the_exact_one(n):
    rng = np.random.default_rng(n)
    for matrices, width in itertools.product(random_matrices(rng, n, 2 if n > 4 else 4), (0, 0.1)):
        found = intervals.determinant(about(matrices, rng, width))
        for matrix, lower, upper in zip(matrices, found.lower, found.upper, strict=True):
            assert lower <= exact_determinant(fractions_of(matrix)) <= upper
            if not width:
                permanent = abs(exact_determinant([[abs(x) for x in row] for row in fractions_of(matrix)]))
                assert upper - lower <= 1e-13 * max(permanent, np.abs(matrix).max() ** n * math.factorial(n))


def test_determinant_of_triangles_and_swapped_rows():
    """The product of the diagonal; a swap of rows turns the sign."""
    upper = np.triu(np.arange(1.0, 37).reshape(6, 6))
    product = math.prod(int(x) for x in np.diagonal(upper))
    found = intervals.determinant(thin(np.stack([upper, upper[[1, 0, 2, 3, 4, 5]], upper.T])))
    np.testing.assert_allclose(found.lower, np.array([1, -1, 1]) * product, rtol=1e-13)
    np.testing.assert_allclose(found.upper, np.array([1, -1, 1]) * product, rtol=1e-13)


@pytest.mark.parametrize("n", range(1, 7))
@pytest.mark.parametrize("width", [0, 0.1])
def test_products_and_sums_hold_the_exact_ones(n, width):
    rng = np.random.default_rng(10 + n)
    for left, right in zip(random_matrices(rng, n), random_matrices(rng, n)[::-1], strict=True):
        right = np.concatenate([right, right[:, :, :1]], axis=2)  # (n, n) @ (n, n + 1)
        a, b = about(left, rng, width), about(right, rng, width)
        product, sums = intervals.matrix_product(a, b), intervals.total(b, axis=2)
        assert product.lower.shape == right.shape and sums.lower.shape == (4, n)
        for k in range(4):
            x, y = fractions_of(left[k]), fractions_of(right[k])
            for i, j in np.ndindex(n, n + 1):
                exact = sum(x[i][l] * y[l][j] for l in range(n))
                assert product.lower[k, i, j] <= exact <= product.upper[k, i, j]
            for i in range(n):
                assert sums.lower[k, i] <= sum(y[i]) <= sums.upper[k, i]
        if not width:
            size = np.abs(left) @ np.abs(right)
            assert np.all(product.upper - product.lower <= 1e-14 * size + 1e-300)


def test_products_along_more_axes():
    """(k, n, l) times (k, l, p, q) is the product for every (p, q)."""
    rng = np.random.default_rng(5)
    a, b = rng.integers(-9, 10, (3, 2, 4)), rng.integers(-9, 10, (3, 4, 2, 5))
    found = intervals.matrix_product(thin(a), thin(b))
    exact = np.einsum("knl,klpq->knpq", a, b)
    assert np.all((found.lower <= exact) & (exact <= found.upper) & (found.upper - found.lower < 1e-11))


def test_numbers_go_with_many_boxes():
    """Arrays (k,), one interval for all boxes, and known numbers: as if each box had its own."""
    many, one = (
        Interval(np.array([-1.0, 0.1, 3.0]), np.array([0.3, 0.2, 3.0])),
        Interval(*np.float64([0.1, 0.7])),
    )
    for name, exact in BINARY.items():
        for a, b in ((many, one), (one, many), (many, 0.3), (0.3, many)):
            rows = [np.broadcast_to(end, 3) for item in (a, b) for end in _ends(item)]
            with quiet():
                found = getattr(intervals, name)(a, b)
            for k, (low, high, of_low, of_high) in enumerate(zip(*rows, strict=True)):
                alone = computed(name, box(low, high), box(of_low, of_high))
                np.testing.assert_allclose((found.lower[k], found.upper[k]), alone, rtol=1e-15, atol=1e-300)
                if not np.isnan(alone).any():
                    value = exact(Fraction(float(low)), Fraction(float(of_high)))
                    assert holds((found.lower[k], found.upper[k]), value)


def _ends(item):
    return as_interval(item).lower, as_interval(item).upper


def test_the_middle_is_inside():
    lower = np.array([-1.0, 1.0, 1.0, -GREATEST, 0.0])
    upper = np.array([2.0, 1.0, 1 + 2.0**-52, GREATEST, LEAST])
    with quiet():
        middle = Interval(lower, upper).middle
    assert np.all((lower <= middle) & (middle <= upper)) and middle[0] == 0.5


# ---------------------------------------------------------------- code over boxes

OSCILLATOR, STEWART = pk.CasingOscillator(), pk.catalogued("semi-regular-stewart")
FIVE_BAR = pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15)


def mixed(v):
    return jnp.stack([v[0] * jnp.sin(v[1]), safe.norm(v), v[2] ** 3 / v[0], jnp.cos(v[0] * v[2]) ** 2])


def oscillator_matrix(mech, v):
    return mech.linearize(pk.AxisPose(v[0], rotations.from_angles(v[1:4])), v[4:])


def stewart_matrix(mech, v):
    return mech.linearize(pk.SE3(v[:3], rotations.cayley(v[3:6])), v[6:])


CODE = {
    "a product of rotations": (
        lambda v: rotations.from_angles(v[:3]) @ rotations.about(2, v[3]),
        (),
        [0.3, -1.2, 2.0, -3.0],
    ),
    "a norm": (safe.norm, (), [0.4, -0.2, 1.3]),
    "mixed": (mixed, (), [1.2, 0.4, -0.8]),
    "derivatives": (jax.jacfwd(mixed), (), [1.2, 0.4, -0.8]),
    "reverse derivatives": (jax.jacrev(mixed), (), [1.2, 0.4, -0.8]),
    "A of the casing oscillator": (
        oscillator_matrix,
        (OSCILLATOR,),
        [0.48, 0.1, -0.2, 0.05, 0.72, 0.48, 0.48, 0.72, 0.73],
    ),
    "A of a Stewart platform": (
        stewart_matrix,
        (STEWART,),
        [0.1, 0.0, 1.1, 0.1, 0.2, -0.1, *[1.2, 1.1, 1.0, 1.3, 1.2, 1.1]],
    ),
    "the residual of a five-bar": (
        lambda mech, v: mech.residual(v[:2], v[2:]),
        (FIVE_BAR,),
        [0.1, 1.8, 0.7, 2.3],
    ),
}


@pytest.mark.parametrize("name", CODE)
@pytest.mark.parametrize("radius", [1e-9, 1e-2, 0.15])
def test_enclosures_hold_the_values_at_points_inside(name, radius):
    function, known, centre = CODE[name]
    rng = np.random.default_rng(len(name))
    centres = np.array(centre) + 0.1 * rng.uniform(-1, 1, (12, len(centre)))
    half = radius * rng.random(centres.shape)
    within = Interval(centres - half, centres + half)
    found = enclosure(function, *known, within)
    points = centres + half * rng.uniform(-1, 1, (100, *centres.shape))
    values = jax.jit(jax.vmap(jax.vmap(functools.partial(function, *known))))(points)
    each_interval = jax.tree.leaves(found, is_leaf=lambda leaf: isinstance(leaf, Interval))
    for bounds, value in zip(each_interval, jax.tree.leaves(values), strict=True):
        value = np.asarray(value)
        assert bounds.lower.shape == value.shape[1:]
        rounded = 1e-14 * (1 + np.abs(value))  # these are floats
        assert np.all((bounds.lower <= value + rounded) & (value - rounded <= bounds.upper))
        if radius < 1e-2:
            assert np.all(bounds.upper - bounds.lower < 1e3 * radius)


def test_exact_arguments_are_exact():
    """0.1 + 0.2 of two arrays is what the rational numbers say, not what floats say."""
    found = enclosure(lambda a, b, x: a + b + 0 * x, np.array([0.1]), np.array([0.2]), box(0, 1))
    assert found.lower < Fraction(0.1) + Fraction(0.2) < found.upper
    found = enclosure(
        lambda matrix, x: matrix @ x, np.eye(2)[::-1], Interval(*np.array([[[1, 2]], [[3, 4]]], float))
    )
    assert found.lower.tolist() == [[2, 1]] and found.upper.tolist() == [[4, 3]]


def test_known_numbers_go_through_every_rule():
    """Code of known arguments alone, beside one that is not: as of thin intervals."""
    code = lambda c: jnp.stack([jnp.sin(jnp.maximum(c, 0.0)), jnp.cos(c) / 3, jnp.sqrt(jnp.abs(c))])
    for c in (-1.0, 0.0, 0.3):
        known = enclosure(lambda c, x: code(c) + 0 * x, np.float64(c), box(0, 1))
        as_thin = enclosure(code, box(c, c))
        values = np.asarray(code(c))
        for found in (known, as_thin):
            assert np.all((found.lower <= values + 1e-16) & (values - 1e-16 <= found.upper))
            assert np.all(found.upper - found.lower < 1e-15)


UNKNOWN = {
    "solve": lambda x: jnp.linalg.solve(jnp.eye(2) * x, jnp.ones(2)),
    "loop": lambda x: jax.lax.while_loop(lambda y: y < 3, lambda y: y + 1, x),
    "exp": jnp.exp,
    "sign": jnp.sign,
    "equal": lambda x: jnp.where(x == 0, 1.0, 2.0),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_code_without_rules_is_refused(name):
    with pytest.raises(UnknownPrimitive):
        enclosure(UNKNOWN[name], box(0.5, 1))


def test_floating_point_warnings_have_no_say():
    """Overflow, division by zero and underflow inside, whatever the user has NumPy do about them."""
    code = lambda x: jnp.stack([1 / x, jnp.sqrt(x), x**9 * 1e300, jnp.sin(x), x * 1e-320])
    within = Interval(np.array([-1.0, 1e-300, 1e40]), np.array([1.0, 2.0, 1e50]))
    found = {}
    for setting in ("raise", "ignore"):
        with np.errstate(all=setting):
            found[setting] = enclosure(code, within)
    for end in ("lower", "upper"):
        np.testing.assert_array_equal(*(getattr(each, end) for each in found.values()))


def test_choices_by_all_and_by_any():
    both = lambda x: jnp.stack([x, x - 1])
    found = enclosure(
        lambda x: jnp.stack([jnp.where(f(both(x) > 0), 10.0, 20.0) for f in (jnp.all, jnp.any)]),
        Interval(np.array([1.5, 0.5, -1.0, -2.0]), np.array([2.0, 0.9, 2.0, -1.0])),
    )
    np.testing.assert_array_equal(found.lower, [[10, 10], [20, 10], [10, 10], [20, 20]])
    np.testing.assert_array_equal(found.upper, [[10, 10], [20, 10], [20, 20], [20, 20]])
