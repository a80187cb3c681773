"""Intervals that hold every value their expression can take: arithmetic with outward rounding.

One-configuration code is evaluated by `entrywise` with each entry an `Interval` over many boxes of its
arguments. The bounds rely on IEEE 754 double precision addition, multiplication, division and square
root alone, as NumPy does them, one operation at a time and rounded to nearest; sines and cosines are
summed from their series, not taken from a library. NaN stands for a bound that is not known:
it stays NaN, and no comparison with it holds.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import jax
import numpy as np

from pk_jax.kinematics.entrywise import Rules, UnknownPrimitive, entrywise, of_known, picked
from pk_jax.kinematics.lanes import Entries, is_entries

_UNIT = 2.0**-53 * (1 + 2.0**-51)  # |x| of this is at least half the gap beside x
_LEAST = 2.0**-1074


class Interval:
    """[lower, upper], arrays of one shape: an entry per box."""

    __slots__ = ("lower", "upper")
    dtype = np.dtype(np.float64)

    def __init__(self, lower: Any, upper: Any) -> None:
        self.lower, self.upper = lower, upper

    def __repr__(self) -> str:
        return f"Interval({self.lower}, {self.upper})"

    @property
    def middle(self) -> np.ndarray:
        """A number inside, near the middle."""
        return np.clip(self.lower + (self.upper - self.lower) / 2, self.lower, self.upper)


Item = Any  # an Interval, or a known float: exactly that number


def enclosure(function: Callable, *arguments: Any, is_sure: bool = False) -> Any:
    """Bounds of `function(*arguments)`, code of one configuration, over boxes.

    The leaves of the arguments are `Interval`s of arrays (boxes, *shape), or arrays known exactly; those of
    the answer are `Interval`s (boxes, *shape). UnknownPrimitive for code with primitives that have no
    rule here (loops, factorizations, `stop_gradient`, whose slope is none).

    is_sure: where a choice (`jnp.where`) is not known over a box, NaN instead of both values. The function
    may jump there, which its derivatives don't tell.
    """
    split = lambda leaf: _split(leaf) if isinstance(leaf, Interval) else _exactly(leaf)
    is_leaf = lambda leaf: isinstance(leaf, Interval)
    entries = jax.tree.map(split, arguments, is_leaf=is_leaf)
    boxes = next(len(leaf.lower) for leaf in jax.tree.leaves(arguments, is_leaf=is_leaf) if is_leaf(leaf))
    with np.errstate(all="ignore"):
        found = entrywise(function, *entries, rules=SURE if is_sure else RULES)
    return jax.tree.map(lambda each: _joined(each, boxes), found, is_leaf=is_entries)


def _split(box: Interval) -> Entries:
    shape = box.lower.shape[1:]
    ends = [np.moveaxis(np.asarray(end, float).reshape(len(end), -1), 0, 1) for end in (box.lower, box.upper)]
    return Entries(shape, [Interval(*map(np.ascontiguousarray, each)) for each in zip(*ends, strict=True)])


def _exactly(leaf: Any) -> Entries:
    array = np.asarray(leaf, float)
    return Entries(array.shape, array.ravel().tolist())


def _joined(entries: Entries, boxes: int) -> Interval:
    spread = lambda values: np.stack([np.broadcast_to(v, boxes) for v in values], -1).reshape(
        boxes, *entries.shape
    )
    items = [as_interval(item) for item in entries.items]
    return Interval(spread([i.lower for i in items]), spread([i.upper for i in items]))


def as_interval(item: Item) -> Interval:
    return item if isinstance(item, Interval) else Interval(np.float64(item), np.float64(item))


def _outward(lower: Any, upper: Any) -> Interval:
    """Bounds that were rounded to nearest, each moved outward by half a gap between numbers at least.

    Rump, Zimmermann, Boldo and Melquiond 2009, BIT 49, 419-431: x - (u (1 + 4u) |x| + least) is below
    every number that rounds to x.
    """
    return Interval(
        lower - (_UNIT * np.abs(lower) + _LEAST),
        upper + (_UNIT * np.abs(upper) + _LEAST),
    )


# --- arithmetic; what is known stays known where the result is exact


def plus(a: Item, b: Item) -> Item:
    if not isinstance(a, Interval) and a == 0:
        return b
    if not isinstance(b, Interval) and b == 0:
        return a
    if (exact := _exact(Fraction.__add__, a, b)) is not None:
        return exact
    a, b = as_interval(a), as_interval(b)
    return _outward(a.lower + b.lower, a.upper + b.upper)


def negative(a: Item) -> Item:
    return Interval(-a.upper, -a.lower) if isinstance(a, Interval) else -a


def minus(a: Item, b: Item) -> Item:
    return plus(a, negative(b))


def times(a: Item, b: Item) -> Item:
    if a is b:
        return square(a)
    if isinstance(b, Interval) and not isinstance(a, Interval):
        a, b = b, a
    if not isinstance(b, Interval):
        if b == 0:
            return 0.0
        if abs(b) == 1:
            return a if b == 1 else negative(a)
        if isinstance(a, Interval):
            ends = a.lower * b, a.upper * b
            return _outward(*(ends if b > 0 else ends[::-1]))
        if (exact := _exact(Fraction.__mul__, a, b)) is not None:
            return exact
        a, b = as_interval(a), as_interval(b)
    if np.ndim(a.lower) == 0 and a.lower == a.upper:
        return times(b, float(a.lower))
    corners = a.lower * b.lower, a.lower * b.upper, a.upper * b.lower, a.upper * b.upper
    least = np.minimum(np.minimum(*corners[:2]), np.minimum(*corners[2:]))
    greatest = np.maximum(np.maximum(*corners[:2]), np.maximum(*corners[2:]))
    return _outward(least, greatest)


def over(a: Item, b: Item) -> Item:
    if not isinstance(a, Interval) and a == 0:
        return 0.0
    if not isinstance(b, Interval) and b != 0 and (exact := _exact(Fraction.__truediv__, a, b)) is not None:
        return exact
    b = as_interval(b)
    holds_zero = (b.lower <= 0) & (b.upper >= 0)
    inverse = _outward(1 / b.upper, 1 / b.lower)
    unknown = np.where(holds_zero, np.nan, 0.0)
    return times(a, Interval(inverse.lower + unknown, inverse.upper + unknown))


def square(a: Item) -> Item:
    if not isinstance(a, Interval):
        exact = _exact(Fraction.__mul__, a, a)
        return exact if exact is not None else square(as_interval(a))
    size = absolute(a)
    found = _outward(size.lower * size.lower, size.upper * size.upper)
    return Interval(np.maximum(found.lower, 0.0), found.upper)


def power(a: Item, y: int) -> Item:
    if y < 0:
        return over(1.0, power(a, -y))
    if y % 2:
        return a if y == 1 else times(a, power(a, y - 1))
    return square(power(a, y // 2)) if y else 1.0


def absolute(a: Item) -> Item:
    if not isinstance(a, Interval):
        return abs(a)
    return Interval(np.maximum(np.maximum(a.lower, -a.upper), 0.0), np.maximum(-a.lower, a.upper))


def root(a: Item) -> Item:
    """NaN where the argument may be negative."""
    a = as_interval(a)
    found = _outward(np.sqrt(a.lower), np.sqrt(a.upper))
    return Interval(np.maximum(found.lower, 0.0), found.upper)


def greater(a: Item, b: Item) -> Item:
    a, b = as_interval(a), as_interval(b)
    return Interval(np.maximum(a.lower, b.lower), np.maximum(a.upper, b.upper))


def lesser(a: Item, b: Item) -> Item:
    return negative(greater(negative(a), negative(b)))


def _exact(operation: Callable, a: Item, b: Item) -> float | None:
    """The result on two known numbers where it is a float64 itself."""
    if isinstance(a, Interval) or isinstance(b, Interval) or not (math.isfinite(a) and math.isfinite(b)):
        return None
    result = operation(Fraction(a), Fraction(b))
    try:
        return float(result) if Fraction(float(result)) == result else None
    except OverflowError:
        return None


# --- sine and cosine

_LARGEST = 7.0  # rad; what is beyond it, and stays there when whole turns are taken off, has [-1, 1]
_TERMS = 24  # of the series: 7^48 / 48! < 1e-20
_PI = Interval(np.float64(3.141592653589793), np.float64(3.1415926535897936))
_TURN = Interval(2 * _PI.lower, 2 * _PI.upper)


def cosine(a: Item) -> Item:
    return 1.0 if not isinstance(a, Interval) and a == 0 else _wave(a, 0.0)


def sine(a: Item) -> Item:
    return 0.0 if not isinstance(a, Interval) and a == 0 else _wave(a, 0.5)


def _wave(a: Item, shift: float) -> Interval:
    """cos(a - shift pi): the hull of both ends, and +-1 where an extreme may lie between them."""
    a = _turned_back(as_interval(a))
    series = _sine_of if shift else _cosine_of
    ends = [as_interval(series(Interval(end, end))) for end in (a.lower, a.upper)]
    least = np.minimum(ends[0].lower, ends[1].lower)
    greatest = np.maximum(ends[0].upper, ends[1].upper)
    turns = as_interval(minus(over(a, _PI), shift))  # extremes are where this is whole
    first, last = np.ceil(turns.lower), np.floor(turns.upper)
    count = last - first
    is_even = np.mod(first, 2) == 0
    has_top = (count >= 1) | ((count == 0) & is_even)
    has_bottom = (count >= 1) | ((count == 0) & ~is_even)
    is_far = ~_is_near(a)
    unknown = np.where(np.isnan(a.lower + a.upper), np.nan, 0.0)
    lower = np.where(has_bottom | is_far, -1.0, np.maximum(least, -1.0)) + unknown
    return Interval(lower, np.where(has_top | is_far, 1.0, np.minimum(greatest, 1.0)) + unknown)


def _turned_back(a: Interval) -> Interval:
    """Angles less whole turns, where that brings them near zero."""
    if np.all(_is_near(a)):
        return a
    less = minus(a, times(_TURN, thin(np.rint(a.middle / _TURN.lower))))
    is_better = _is_near(less) & ~_is_near(a)
    return Interval(np.where(is_better, less.lower, a.lower), np.where(is_better, less.upper, a.upper))


def _is_near(a: Interval) -> np.ndarray:
    return np.maximum(np.abs(a.lower), np.abs(a.upper)) <= _LARGEST


def _cosine_of(x: Interval) -> Interval:
    return _series(square(x), 0)


def _sine_of(x: Interval) -> Interval:
    return times(x, _series(square(x), 1))


def _series(squared: Interval, odd: int) -> Interval:
    """The sum of (-x^2)^k / (2 k + odd)!. What is left out is less than its first term (Lagrange)."""
    bound = _over_factorial(2 * _TERMS + odd).upper
    total = Interval(-bound, bound)
    for k in reversed(range(_TERMS)):
        total = plus(times(negative(squared), total), _over_factorial(2 * k + odd))
    return total


def _over_factorial(n: int) -> Interval:
    """1 / n!"""
    nearest = np.float64(Fraction(1, math.factorial(n)))
    return Interval(np.nextafter(nearest, -np.inf), np.nextafter(nearest, np.inf))


# --- whole arrays of intervals; the first axis is that of the boxes


def thin(values: Any) -> Interval:
    """Numbers as intervals that hold nothing else."""
    values = np.asarray(values, float)
    return Interval(values, values)


def total(a: Interval, axis: int) -> Interval:
    """The sum along an axis."""
    count = a.lower.shape[axis]
    return functools.reduce(plus, [_part(a, k, axis) for k in range(count)])


def _part(a: Interval, k: int, axis: int) -> Interval:
    return Interval(np.take(a.lower, k, axis), np.take(a.upper, k, axis))


def matrix_product(a: Interval, b: Interval) -> Interval:
    """(k, n, l) times (k, l, ...). -> (k, n, ...)"""
    more = (1,) * (b.lower.ndim - 2)
    columns = (
        Interval(*(end.reshape(*end.shape, *more) for end in _ends(_part(a, j, 2))))
        for j in range(a.lower.shape[2])
    )
    rows = (Interval(*(end[:, None] for end in _ends(_part(b, j, 1)))) for j in range(b.lower.shape[1]))
    return functools.reduce(plus, map(times, columns, rows))


def _ends(a: Interval) -> tuple[np.ndarray, np.ndarray]:
    return a.lower, a.upper


def determinant(a: Interval) -> Interval:
    """Of matrices (k, n, n), by minors of the first rows: 2^n of them. -> (k,)"""
    n = a.lower.shape[-1]
    minors = {(): thin(1.0)}
    for row in range(n):
        entries = [_part(_part(a, row, 1), j, 1) for j in range(n)]
        minors = {
            columns: functools.reduce(
                plus,
                [
                    times((-1.0) ** (row - i), times(entries[j], minors[columns[:i] + columns[i + 1 :]]))
                    for i, j in enumerate(columns)
                ],
            )
            for columns in itertools.combinations(range(n), row + 1)
        }
    return minors[tuple(range(n))]


# --- rules for `entrywise`


def _elementwise(equation: Any, *items: Item, is_sure: bool = False) -> Item:
    if (item := picked(equation, *items)) is not None:
        return item
    name = equation.primitive.name
    is_number = np.issubdtype(equation.outvars[0].aval.dtype, np.floating)
    if not is_number and not any(isinstance(item, Interval) for item in items):
        return of_known(equation, *items)
    if name == "stop_gradient" and not isinstance(items[0], Interval):
        return items[0]
    if (
        name == "convert_element_type"
        and np.issubdtype(equation.invars[0].aval.dtype, np.floating)
        and is_number
    ):
        return items[0]
    if name == "select_n" and is_sure:
        return _sure(*items)
    if name not in _ELEMENTWISE:
        raise UnknownPrimitive(name)
    return _ELEMENTWISE[name](*items)


def _sure(condition: Interval, otherwise: Item, then: Item) -> Interval:
    """What is chosen; NaN where that is not known."""
    found = chosen(condition, otherwise, then)
    unknown = np.where(condition.lower == condition.upper, 0.0, np.nan)
    return Interval(found.lower + unknown, found.upper + unknown)


# --- comparisons: [1, 1] where they hold all over a box, [0, 0] where nowhere, else [0, 1]


def _below(a: Item, b: Item, *, strictly: bool) -> Interval:
    a, b = as_interval(a), as_interval(b)
    compare = np.less if strictly else np.less_equal
    is_known = ~np.isnan(a.lower + a.upper + b.lower + b.upper)
    surely = compare(a.upper, b.lower) & is_known
    possibly = compare(a.lower, b.upper) | ~is_known
    return Interval(surely.astype(float), possibly.astype(float))


def chosen(condition: Item, otherwise: Item, then: Item) -> Item:
    """`then` where the condition holds, else `otherwise`; both where that is not known."""
    a, b = as_interval(otherwise), as_interval(then)
    surely, possibly = condition.lower == 1, condition.upper == 1
    lower = np.where(surely, b.lower, np.where(possibly, np.minimum(a.lower, b.lower), a.lower))
    upper = np.where(surely, b.upper, np.where(possibly, np.maximum(a.upper, b.upper), a.upper))
    return Interval(lower, upper)


_ELEMENTWISE: dict[str, Callable] = {
    "and": lesser,
    "ge": lambda a, b: _below(b, a, strictly=False),
    "gt": lambda a, b: _below(b, a, strictly=True),
    "le": lambda a, b: _below(a, b, strictly=False),
    "lt": lambda a, b: _below(a, b, strictly=True),
    "not": lambda a: Interval(1 - a.upper, 1 - a.lower),  # exact
    "or": greater,
    "select_n": chosen,
    "abs": absolute,
    "cos": cosine,
    "max": greater,
    "min": lesser,
    "sin": sine,
    "sqrt": root,
}

RULES = Rules(
    plus,
    minus,
    times,
    over,
    negative,
    square,
    power,
    greater,
    lesser,
    _elementwise,
    can_fall_back=False,
)
SURE = RULES._replace(elementwise=functools.partial(_elementwise, is_sure=True))
