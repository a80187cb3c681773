"""Integrals over a region by rays from its centre: panels of angles in the plane, many directions above."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from pk_jax.analysis import charts, rays
from pk_jax.analysis.measures import measure_of
from pk_jax.analysis.quadrature import smooth_ends
from pk_jax.analysis.rays import Detail, Intervals
from pk_jax.analysis.region import (
    Given,
    Region,
    added_limits_at,
    count_limits,
    functions_at,
    joints_at,
    plain_limits_at,
)
from pk_jax.analysis.whitening import farthest, whitening
from pk_jax.geometry.spread import directions, evenly
from pk_jax.kinematics.batching import where

BLOCK = 256  # rays at a time
BREAKS = 16  # cells of angles in which something changes, at most
ROUNDS = 2  # changes in one cell, at most
PANELS = 8  # of the circle, before it is broken
HALVINGS = 44  # of an angle between two rays


class Counts(NamedTuple):
    """Rays of a rule, and those that are not what the rule wants."""

    rays: jax.Array
    open: jax.Array  # still inside where they end
    crowded: jax.Array  # with more limits crossed than there is room for
    grazing: jax.Array  # tangent to a limit: their ends move fast


class Problem(NamedTuple):
    """What to integrate over what; static."""

    region: Region
    indices: tuple  # names or functions
    detail: Detail
    nodes: int  # along each interval


def values_at(problem: Problem, given: Given, pose) -> jax.Array:
    """1 and every integrand at a pose. -> (1 + f,)"""
    joints = joints_at(given, pose)
    one = jnp.ones((), joints.dtype)
    measures = [measure_of(index, problem.region.length) for index in problem.indices]
    found = [jnp.ravel(jnp.asarray(of(given.mech, pose, joints), joints.dtype)) for of in measures]
    return jnp.concatenate([one[None], *found])


def intervals(problem: Problem, given: Given, directions: jax.Array) -> Intervals:
    """Of rays y = t direction, directions (n, rays). Never differentiated."""
    given, directions = lax.stop_gradient((given, directions))
    far = jax.vmap(partial(farthest, problem.region, given), in_axes=-1)(directions)
    along = partial(_functions, problem.region, (given, directions))
    return rays.intervals_of(along, sum(count_limits(problem.region, given)), far, problem.detail)


def _functions(region: Region, given_and_directions: tuple[Given, jax.Array], t: jax.Array) -> jax.Array:
    """Every function of a region at distances t (s, rays). -> (k, s, rays)"""
    given, directions = given_and_directions
    y = (directions[:, None] * t).reshape(len(directions), -1)
    found = jax.vmap(partial(functions_at, region, given), in_axes=-1, out_axes=-1)(y)
    return found.reshape(-1, *t.shape)


def _limits_asked(region: Region, given_and_directions: Any, t: jax.Array, which: jax.Array) -> jax.Array:
    """Of every distance the limit that is asked for. t, which (s, rays) -> (s, rays)

    Where others are asked for, limits are evaluated at the centre: at a stretched leg the slopes of some
    are infinite, and reverse mode multiplies them by zero.
    """
    given, directions = given_and_directions
    first, second = count_limits(region, given)
    found = jnp.zeros_like(t)
    for of, begin, count in ((plain_limits_at, 0, first), (added_limits_at, first, second)):
        if not count:
            continue
        is_own = (which >= begin) & (which < begin + count)
        y = (directions[:, None] * jnp.where(is_own, t, 0)).reshape(len(directions), -1)
        values = jax.vmap(partial(of, region, given), in_axes=-1, out_axes=-1)(y).reshape(-1, *t.shape)
        own = jnp.take_along_axis(values, jnp.clip(which - begin, 0, count - 1)[None], axis=0)[0]
        found = jnp.where(is_own, own, found)
    return found


def ray_integrals(
    problem: Problem, given: Given, directions: jax.Array, found: Intervals, rule: Any
) -> jax.Array:
    """sum over the intervals of f t^(n - 1) dt along each ray, for 1 and every integrand. -> (1 + f, rays)"""
    n, count = directions.shape
    function = partial(_limits_asked, problem.region)
    limits = sum(count_limits(problem.region, given))
    own = lambda by: jnp.where(by < limits, by, rays.ORIGIN)  # where only rays are broken nothing ends
    lower = rays.root(function, (given, directions), found.lower, own(found.lower_by))
    upper = rays.root(function, (given, directions), found.upper, own(found.upper_by))
    at, weights = (jnp.asarray(part, lower.dtype)[:, None, None] for part in rule)
    width = upper - lower
    t = (lower + width * at).reshape(-1, count)
    weights = (width * weights).reshape(-1, count) * t ** (n - 1)
    is_used = jnp.tile(found.upper > found.lower, (len(at), 1))
    home = given.home[0]

    def one(y, is_used):
        y = problem.region.whole(given.centre, y)
        pose = where(is_used, charts.pose_at(given.centre, y), home)  # unused nodes are regular ones
        return jnp.where(is_used, values_at(problem, given, pose) * charts.density(given.centre, y), 0)

    y = (directions[:, None] * jnp.where(is_used, t, 0)).reshape(n, -1)
    values = jax.vmap(one, in_axes=-1, out_axes=-1)(y, is_used.ravel())
    return jnp.sum(values.reshape(-1, *t.shape) * weights, axis=1)


def all_intervals(problem: Problem, given: Given, directions: jax.Array) -> Intervals:
    """Of rays in blocks: directions (blocks, n, rays)."""
    return lax.map(partial(intervals, problem, given), directions)


def total(
    problem: Problem, given: Given, directions: jax.Array, found: Intervals, weights: jax.Array, rule: Any
) -> jax.Array:
    """Weighted sums over rays in blocks, each recomputed for its derivatives. -> (r, 1 + f)

    directions (blocks, n, rays), weights (blocks, r, rays): r sums at once; rule: nodes and weights along
    every interval
    """

    @jax.checkpoint
    def add(part):
        directions, found, weights = part
        return weights @ ray_integrals(problem, given, directions, found, rule).T

    return jnp.sum(lax.map(add, (directions, found, weights)), axis=0)


def in_blocks(rows: jax.Array, fill: float | None = None) -> jax.Array:
    """(k, m) as (blocks, m, rays), filled up with copies of the last row, or with a number."""
    count = len(rows)
    block = min(count, BLOCK)
    last = rows[-1:] if fill is None else jnp.full_like(rows[-1:], fill)
    rows = jnp.concatenate([rows, jnp.broadcast_to(last, (-count % block, rows.shape[1]))])
    return jnp.swapaxes(rows.reshape(-1, block, rows.shape[1]), 1, 2)


def counted(found: Intervals, weights: jax.Array) -> Counts:
    """Of the rays that weigh something; of one block each (blocks, rays)."""
    is_own = jnp.any(weights != 0, axis=1)
    flags = found.is_open, found.is_crowded, found.is_grazing
    return Counts(jnp.sum(is_own), *(jnp.sum(flag & is_own) for flag in flags))


# --- in the plane: angles broken where the limits that end a ray change


def panels(problem: Problem, given: Given, angles: int) -> tuple[jax.Array, Counts]:
    """The integrals over a plane region, by Gauss panels between all changes. -> (2, 1 + f), Counts

    By panels and intervals of `nodes` nodes, and by three quarters of them.
    """
    wide, volume = whitening(problem.region, given)
    toward = lambda angle: wide @ jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    ends, crowded = lax.stop_gradient(_breaks(problem, given, toward, angles))
    width = ends[1:] - ends[:-1]

    def by_rule(rule):
        nodes, weights = rule
        theta = (ends[:-1, None] + width[:, None] * nodes).ravel()
        directions = in_blocks(jax.vmap(toward)(theta))
        found = all_intervals(problem, given, directions)
        each = in_blocks((width[:, None] * weights).ravel()[:, None] * volume, 0.0)
        return total(problem, given, directions, found, each, rule)[0], counted(found, each)

    rules = [padded_rule(count, problem.nodes) for count in (problem.nodes, 3 * problem.nodes // 4)]
    rules = jax.tree.map(lambda *parts: jnp.asarray(np.stack(parts), ends.dtype), *rules)
    sums, tally = lax.map(by_rule, rules)
    counts = jax.tree.map(partial(jnp.sum, axis=0), tally)
    return sums, counts._replace(crowded=counts.crowded + crowded)


def padded_rule(count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [0, 1] for square-root ends, filled up to `size` with nodes of no weight."""
    rule, fill = smooth_ends(count), (0, size - count)
    return np.pad(rule.nodes, fill, constant_values=0.5), np.pad(rule.weights, fill)


def _breaks(problem: Problem, given: Given, toward, angles: int) -> tuple[jax.Array, jax.Array]:
    """Ends of the panels over one turn, increasing, and whether there are too many. -> (p + 1,), ()"""
    dtype = jax.tree.leaves(given.centre)[0].dtype

    def labels_at(theta):
        found = intervals(problem, given, jax.vmap(toward, out_axes=-1)(theta))
        return jnp.concatenate([found.lower_by, found.upper_by]).T

    block = min(BLOCK, angles)
    angles += -angles % block
    labels_of = lambda theta: lax.map(labels_at, theta.reshape(-1, block)).reshape(len(theta), -1)
    start = 2 * np.pi * 0.381966 / angles  # no symmetry of a mechanism lies there
    theta = start + 2 * jnp.pi * jnp.arange(angles, dtype=dtype) / angles
    labels = labels_of(theta)
    after = jnp.append(theta[1:], theta[0] + 2 * jnp.pi)
    differs = jnp.any(labels != jnp.roll(labels, -1, axis=0), axis=1)
    cell = jnp.nonzero(differs, size=BREAKS, fill_value=0)[0]
    is_used = jnp.arange(BREAKS) < jnp.sum(differs)

    def halved(ends, _):
        low, high, before, beyond = ends
        middle = (low + high) / 2
        labels = labels_at(middle)
        is_low = jnp.all(labels == before, axis=1)
        beyond = jnp.where(is_low[:, None], beyond, labels)
        return (jnp.where(is_low, middle, low), jnp.where(is_low, high, middle), before, beyond), None

    last = jnp.roll(labels, -1, axis=0)[cell]

    def next_break(ends, _):  # beyond the one before, in the same cell; none where that was the last
        low, before, is_open = ends
        (low, high, _, beyond), _ = lax.scan(halved, (low, after[cell], before, last), length=HALVINGS)
        is_last = jnp.all(beyond == last, axis=1)
        return (high, beyond, is_open & ~is_last), jnp.where(is_open, (low + high) / 2, end)

    end = theta[0] + 2 * jnp.pi
    _, found = lax.scan(next_break, (theta[cell], labels[cell], is_used), length=ROUNDS)
    fixed = theta[0] + 2 * jnp.pi * jnp.arange(PANELS, dtype=dtype) / PANELS
    ends = jnp.sort(jnp.concatenate([found.ravel(), fixed, end[None]]))
    return ends, (jnp.sum(differs) > BREAKS).astype(jnp.int32)


# --- above: sets of directions, turned at random


@lru_cache(maxsize=8)
def direction_sets(n: int, count: int, replicates: int, seed: int) -> np.ndarray:
    """Sets of unit vectors spread evenly, each turned at random. -> (replicates * count, n)

    In space a spherical Fibonacci lattice, above its kin.
    """
    random = np.random.default_rng(seed)
    last = (np.arange(count)[:, None] + 0.5) / count
    unit = directions(np.concatenate([evenly(count, n - 2), last], axis=1))
    turned = []
    for _ in range(replicates):
        q, r = np.linalg.qr(random.standard_normal((n, n)))
        turned.append(unit @ (q * np.sign(np.diag(r))).T)
    return np.concatenate(turned)


def many_rays(
    problem: Problem, given: Given, unit: jax.Array, replicates: int, devices: tuple = ()
) -> tuple[jax.Array, Counts]:
    """The integrals by every set of directions, unit (replicates * k, n). -> (replicates, 1 + f), Counts

    devices: blocks of rays are shared out to them, and their sums added up
    """
    n, count = unit.shape[1], unit.shape[0] // replicates
    wide, volume = whitening(problem.region, given)
    area = 2 * math.pi ** (n / 2) / math.gamma(n / 2)
    own = jnp.repeat(jnp.eye(replicates, dtype=unit.dtype), count, axis=0)
    directions, weights = in_blocks(unit @ wide.T), in_blocks(own * (area * volume / count), 0.0)
    rule = padded_rule(problem.nodes, problem.nodes)

    def share(given, directions, weights):
        found = all_intervals(problem, given, directions)
        return total(problem, given, directions, found, weights, rule), counted(found, weights)

    if len(devices) < 2:
        return share(given, directions, weights)
    fill = -len(directions) % len(devices)  # blocks that weigh nothing
    directions = jnp.concatenate([directions, jnp.repeat(directions[-1:], fill, axis=0)])
    weights = jnp.concatenate([weights, jnp.zeros((fill, *weights.shape[1:]), weights.dtype)])
    rays, everywhere = PartitionSpec("rays"), PartitionSpec()
    return jax.shard_map(
        lambda *parts: lax.psum(share(*parts), "rays"),
        mesh=Mesh(np.array(devices), ("rays",)),
        in_specs=(everywhere, rays, rays),
        out_specs=everywhere,
        check_vma=False,
    )(given, directions, weights)
