"""Where rays from a centre are inside a region: every interval, each end with the limit that ends it.

Each limit is followed by itself, so that slivers between two limits, narrower than a cell of the scan, are
found; extrema that reach over zero within a cell are sought by their slopes. Ends are roots of ONE
smooth function and carry its derivatives, exact to every order.

All rays of a block are looked at together, ray last: that is what makes the machine fast.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

NEWTON_STEPS = 8  # of a root, within its bracket, after the halvings
ORIGIN = -1  # in place of a limit: the interval begins at the centre, or ends where the ray does
NONE = -2  # no interval
GRAZING = 1e-3  # slope of a limit at its root, over its natural size, below which a ray is tangent

Along = Callable[[jax.Array], jax.Array]  # distances (s, rays) -> every function (k, s, rays)


class Detail(NamedTuple):
    """How finely a ray is looked at."""

    cells: int = 64  # of a scan
    slots: int = 12  # brackets kept
    intervals: int = 6
    halvings: int = 24  # of a bracket


class Intervals(NamedTuple):
    """Of every ray; unused entries have no length."""

    lower: jax.Array  # (i, rays)
    upper: jax.Array  # (i, rays)
    lower_by: jax.Array  # (i, rays) function whose root it is, ORIGIN or NONE
    upper_by: jax.Array  # (i, rays)
    is_open: jax.Array  # (rays,) still inside where the ray ends
    is_crowded: jax.Array  # (rays,) more brackets or intervals than there are slots
    is_grazing: jax.Array  # (rays,) tangent to a limit


class _Samples(NamedTuple):
    t: jax.Array  # (s, rays) increasing
    value: jax.Array  # (k, s, rays), -1 where there is none
    slope: jax.Array
    is_known: jax.Array


class _Bracket(NamedTuple):
    a: jax.Array  # (slots, rays)
    b: jax.Array
    root: jax.Array  # between them
    which: jax.Array  # function
    is_root: jax.Array  # and no extremum, or a value that ceases to be


def intervals_of(along: Along, limits: int, far: jax.Array, detail: Detail) -> Intervals:
    """All intervals of [0, far] in which the first `limits` functions are >= 0, broken by the others.

    far (rays,): where the rays end
    """
    cells, slots, most, halvings = detail
    steps = jnp.arange(cells + 1, dtype=far.dtype)[:, None] / cells

    def nearer(k, far):  # nothing is possible beyond the last cell in which it is
        t = far * steps ** jnp.where(k == 0, 3, 1)
        possible = _possible(_look(along, t), limits)
        last = jnp.max(jnp.where(possible, jnp.arange(1, cells + 1)[:, None], 0), axis=0)
        return jnp.where(last > 0, jnp.take_along_axis(t, last[None], axis=0)[0], t[1])

    far = lax.fori_loop(0, 2, nearer, far)
    base = far * steps

    def refined(k, carry):  # first roots and extrema, then all roots between these
        bracket, crowded = carry
        s = _look(along, jnp.sort(jnp.concatenate([base, bracket.a, bracket.b]), axis=0))
        mask = _crossings(s) | (_turns(s) & (k == 0))
        bracket, more = _brackets(along, s, mask & _possible(s, limits), slots, halvings)
        return bracket, crowded | more

    shape = (slots, len(far))
    none = jnp.broadcast_to(far, shape)
    start = _Bracket(none, none, none, jnp.zeros(shape, jnp.int32), jnp.zeros(shape, bool))
    bracket, crowded = lax.fori_loop(0, 2, refined, (start, jnp.zeros(far.shape, bool)))

    roots = jnp.where(bracket.is_root, bracket.root, far)
    order = jnp.argsort(roots, axis=0, stable=True)
    which = jnp.take_along_axis(bracket.which, order, axis=0)
    is_root = jnp.take_along_axis(bracket.is_root, order, axis=0)
    roots = jnp.take_along_axis(roots, order, axis=0)
    none = jnp.full((1, len(far)), ORIGIN)
    by = jnp.concatenate([none, jnp.where(is_root, which, ORIGIN), none])
    ends = jnp.concatenate([jnp.zeros((1, len(far)), far.dtype), roots, far[None]])
    s = _look(along, jnp.concatenate([(ends[1:] + ends[:-1]) / 2, roots]))
    is_wide = ends[1:] - ends[:-1] > 64 * jnp.finfo(far.dtype).eps * far
    is_inside = jnp.all((s.value >= 0)[:limits, : slots + 1], axis=0) & is_wide
    chosen, is_kept = _first(is_inside, most)
    pick = lambda values, none: jnp.where(is_kept, jnp.take_along_axis(values, chosen, axis=0), none)
    lower, upper = pick(ends[:-1], 0), pick(ends[1:], 0)
    lower_by, upper_by = pick(by[:-1], NONE), pick(by[1:], NONE)
    is_tangent = is_root & (jnp.abs(_of(s.slope[:, slots + 1 :], which)) * far < GRAZING)
    return Intervals(
        lower,
        upper,
        lower_by,
        upper_by,
        jnp.any(is_kept & (upper >= far), axis=0),
        crowded | (jnp.sum(is_inside, axis=0) > most),
        jnp.any(is_tangent, axis=0),
    )


def _look(along: Along, t: jax.Array) -> _Samples:
    value, slope = jax.jvp(along, (t,), (jnp.ones_like(t),))
    is_known = jnp.isfinite(value)
    return _Samples(t, jnp.where(is_known, value, -1), jnp.where(is_known, slope, 0), is_known)


def _of(values: jax.Array, which: jax.Array) -> jax.Array:
    """The function that each asks for. values (k, s, rays), which (s, rays) -> (s, rays)"""
    return jnp.take_along_axis(values, which[None], axis=0)[0]


def _first(mask: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Where a mask (s, rays) holds first, `count` times, and whether it does so often. (count, rays) twice"""
    index = jax.vmap(lambda m: jnp.nonzero(m, size=count, fill_value=0)[0], in_axes=1, out_axes=1)(mask)
    return index, jnp.arange(count)[:, None] < jnp.sum(mask, axis=0)


def _crossings(s: _Samples) -> jax.Array:
    """Cells with a change of sign. -> (k, s - 1, rays)"""
    return (s.value[:, 1:] >= 0) != (s.value[:, :-1] >= 0)


def _turns(s: _Samples) -> jax.Array:
    """Cells of one sign whose tangents meet on the other side of zero, or near it. -> (k, s - 1, rays)"""
    width = s.t[1:] - s.t[:-1]
    v, w, p, q = s.value[:, :-1], s.value[:, 1:], s.slope[:, :-1], s.slope[:, 1:]
    turns = (p > 0) != (q > 0)
    bend = jnp.where(turns, q - p, 1)
    meet = (v * q - w * p + width * p * q) / jnp.where(bend == 0, 1, bend)
    is_hill, is_valley = (v < 0) & (w < 0) & (p > 0), (v >= 0) & (w >= 0) & (p < 0)
    reserve = jnp.abs(p) * width / 4  # tangents overestimate what bends evenly, not what bends late
    return turns & ((is_hill & (meet >= -reserve)) | (is_valley & (meet <= reserve)))


def _possible(s: _Samples, limits: int) -> jax.Array:
    """Cells in which no limit is known to be negative throughout. -> (s - 1, rays)"""
    positive = (s.value[:, 1:] >= 0) | (s.value[:, :-1] >= 0)
    half_known = s.is_known[:, 1:] != s.is_known[:, :-1]
    return jnp.all((positive | half_known | _turns(s))[:limits], axis=0)


def _brackets(
    along: Along, s: _Samples, mask: jax.Array, slots: int, halvings: int
) -> tuple[_Bracket, jax.Array]:
    """The marked cells, the first `slots` of them, narrowed about their root or their extremum.

    A limit that changes sign where it ceases to have a value has no root there: another limit has.
    """
    functions, cells, rays = mask.shape
    by_cell = jnp.moveaxis(mask, 0, 1).reshape(cells * functions, rays)
    index, is_used = _first(by_cell, slots)
    cell, which = index // functions, (index % functions).astype(jnp.int32)
    at = lambda values, cell: jnp.take_along_axis(_flat(values), which * values.shape[1] + cell, axis=0)
    is_root = at(_crossings(s), cell)
    was_positive, was_rising = at(s.value, cell) >= 0, at(s.slope, cell) > 0

    def narrow(k, ends):
        low, high, middle = ends
        found = _look(along, middle)
        value, slope = _of(found.value, which), _of(found.slope, which)
        is_ahead = jnp.where(is_root, (value >= 0) == was_positive, (slope > 0) == was_rising)
        new = middle, _of(found.is_known, which)
        low, high = (
            jax.tree.map(partial(jnp.where, takes), new, end)
            for takes, end in ((is_ahead, low), (~is_ahead, high))
        )
        closer = jnp.clip(middle - value / jnp.where(slope == 0, 1, slope), low[0], high[0])
        is_newton = is_root & (k >= halvings) & (slope != 0)
        return low, high, jnp.where(is_newton, closer, (low[0] + high[0]) / 2)

    take = lambda cell: (jnp.take_along_axis(s.t, cell, axis=0), at(s.is_known, cell))
    low, high = take(cell), take(cell + 1)
    start = low, high, (low[0] + high[0]) / 2
    low, high, middle = lax.fori_loop(0, halvings + NEWTON_STEPS, narrow, start)
    end = s.t[-1]
    own = [jnp.where(is_used, each, end) for each in (low[0], high[0], middle)]
    is_root = is_used & is_root & low[1] & high[1]
    return _Bracket(*own, which, is_root), jnp.sum(by_cell, axis=0) > slots


def _flat(values: jax.Array) -> jax.Array:
    return values.reshape(-1, values.shape[-1])


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def root(function: Any, given: Any, t: jax.Array, which: jax.Array) -> jax.Array:
    """`t`, roots of function(given, t, which), with the derivatives of the implicit function theorem.

    t, which and the function's values: (s, rays). The rule calls the decorated
    function itself, which makes it right for every order. 0 where the ray is tangent to the limit, or
    `which` says that there is none.
    """
    return t


@root.defjvp
def _root_jvp(function, primals, tangents):
    given, t, which = primals
    t = root(function, given, t, which)
    of = lambda given, t: function(given, t, which)
    _, by = jax.jvp(lambda given: of(given, t), (given,), (tangents[0],))
    _, slope = jax.jvp(lambda t: of(given, t), (t,), (jnp.ones_like(t),))
    is_good = (which >= 0) & (slope != 0) & jnp.isfinite(slope)
    return t, jnp.where(is_good, -by / jnp.where(is_good, slope, 1), 0)
