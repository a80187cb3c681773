"""Where a platform can go within the limits of its joints: the smallest margin over a slice, and travels."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.redundancy import greatest, margins_of
from pk_jax.analysis.slices import Slice, coordinate_names, coordinates_of, pose_on, slice_of
from pk_jax.geometry.poses import pose_units
from pk_jax.kinematics.batching import home_shapes, rows_of
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.inverse import branch_rows, free_rows
from pk_jax.kinematics.lane_map import lane_map
from pk_jax.kinematics.lanes import Entries
from pk_jax.mechanisms.base import Mechanism, require_mechanism

NODES = {2: 201, 3: 41}
MOST_NODES = 100_001  # along one axis
ANY = "any"


class WorkspaceMap(NamedTuple):
    """The smallest margin over a slice of the workspace: inside the limits where it is >= 0."""

    axes: tuple[str, ...]
    units: tuple[int, ...]  # of the axes: 1 = length, 0 = angle
    at: Any  # the pose that has the other coordinates
    nodes: tuple[np.ndarray, ...]  # of the grid
    margin: np.ndarray  # (*grid) NaN out of reach
    limit: np.ndarray  # (*grid) which margin it is, an index into `names`; -1 out of reach
    names: tuple[str, ...]

    @property
    def is_inside(self) -> np.ndarray:
        """(*grid) bool"""
        return self.margin >= 0  # NaN compares False


def workspace_map(
    mech: Mechanism,
    axes: Sequence[str] | str | None = None,
    *,
    at: Any = None,
    ranges: Any = None,
    branch: Any = None,
    free: Any = None,
    nodes: int | Sequence[int] | None = None,
) -> WorkspaceMap:
    """The smallest margin of a mechanism over two or three coordinates of its pose.

    axes:    names of coordinates as for `singularity_locus`; default: the first two
    at:      pose with the other coordinates; default: home
    ranges:  ((lower, upper), ...) of the axes; default: what the mechanism reaches
    branch:  working mode; default: the mechanism's own
    free:    values of kinematically redundant joints; default: as at home; "any": for each pose the value
             that makes the smallest margin greatest (`resolve_redundancy`), so that the map is of all that
             can be reached
    nodes:   of the grid, along each axis or all; 201 by default, 41 for three axes

    ValueError for a mechanism without margins. Margins are dimensionless, see the mechanism's own.
    """
    limits = _Limits("workspace_map", mech, branch, free)
    where = slice_of(mech, axes, at, ranges)
    d = len(where.axes)
    counts = (NODES[d],) * d if nodes is None else nodes if isinstance(nodes, Sequence) else (nodes,) * d
    if isinstance(counts, str) or len(counts) != d:
        raise ValueError(
            f"nodes must be one number, or one for each of the {d} axes, got {checks.shown(nodes)}"
        )
    counts = [checks.is_count("nodes", count, least=2, most=MOST_NODES) for count in counts]
    checks.fits(
        f"nodes = {nodes}", 8 * (3 * d + 6) * math.prod(counts), "take fewer, or a part of the ranges"
    )
    lines = [np.linspace(*ends) for ends in zip(where.lower, where.upper, counts, strict=True)]
    values = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, d)
    margin, limit = limits.over(where, values)
    shape = tuple(counts)
    return WorkspaceMap(
        where.names,
        where.units,
        where.at,
        tuple(lines),
        margin.reshape(shape),
        limit.reshape(shape),
        limits.names,
    )


class Travel(NamedTuple):
    """How far one coordinate goes, either way, until a margin is used up; batch first."""

    lower: np.ndarray  # NaN where the start is outside
    upper: np.ndarray
    limit_lower: tuple[str, ...] | str  # the margin that ends it; "" where none does
    limit_upper: tuple[str, ...] | str


def travel(
    mech: Mechanism,
    coordinate: str,
    *,
    at: Any = None,
    most: float | None = None,
    branch: Any = None,
    free: Any = None,
    steps: int = 256,
) -> Travel:
    """The range of one coordinate of the pose about `at` within all limits, the others held. By bisection.

    at:      one pose, or a batch; default: home
    most:    how far to look, either way; default: 4 length() or pi
    branch, free:  as for `workspace_map`
    steps:   of the search for the first pose outside; limits that are left for less than a step are missed

    Ends are exact to roundoff. A coordinate that can go on for `most` ends there, with no limit named.
    """
    limits = _Limits("travel", mech, branch, free)
    names = coordinate_names(mech)
    checks.is_word("coordinate", coordinate, names)
    axis = names.index(coordinate)
    pose = home_shapes(mech)[0]
    unit = pose_units(pose, mech.pose_units)[axis]
    most = most if most is not None else 4 * float(mech.length()) if unit else np.pi
    if not (checks.is_number(most) and most > 0):
        raise ValueError(f"most must be positive and finite, got {checks.shown(most)}")
    steps = checks.is_count("steps", steps, most=100_000)
    at, many = rows_of("at", mech.home()[0] if at is None else at, pose)
    starts = jax.tree.map(lambda leaf: leaf if many else leaf[None], at)
    begin = coordinates_of(starts)[:, axis].astype(float)
    look = lambda values: limits.along(starts, axis, values)
    ends = [_end(look, begin, way, most, steps) for way in (-1.0, 1.0)]
    found = [end for end, _ in ends] + [
        tuple(limits.names[k] if k >= 0 else "" for k in which) for _, which in ends
    ]
    return Travel(*found) if many else Travel(*(each[0] for each in found))


def _end(
    look: Callable, begin: np.ndarray, way: float, most: float, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where each row leaves its limits, NaN where it starts outside; and by which, -1 where it does not."""
    is_inside = lambda distance: look(begin + way * distance)[0] >= 0  # NaN compares False
    is_started = is_inside(np.zeros_like(begin))
    low, high = np.zeros_like(begin), np.full_like(begin, np.nan)
    for distance in np.linspace(0, most, steps + 1)[1:]:  # the first step outside
        is_open = np.isnan(high) & is_started
        if not is_open.any():
            break
        is_in = is_inside(np.full_like(begin, distance))
        low, high = np.where(is_open & is_in, distance, low), np.where(is_open & ~is_in, distance, high)
    is_ended = ~np.isnan(high)
    high = np.where(is_ended, high, most)
    for _ in range(60):
        middle = (low + high) / 2
        is_in = is_inside(middle)
        low, high = np.where(is_in, middle, low), np.where(is_in, high, middle)
    end = np.where(is_started, begin + way * np.where(is_ended, low, most), np.nan)
    return end, np.where(is_ended, look(begin + way * high)[1], -1)


# --- the smallest margin of many poses


class _Limits:
    """All margins of a mechanism, with a working mode and the free joints given."""

    def __init__(self, function: str, mech: Mechanism, branch: Any, free: Any) -> None:
        require_mechanism(function, mech)
        if not checks.is_concrete((mech, branch, free)):
            raise ValueError(f"{function} works on known values only")
        self.mech = mech
        if not hasattr(mech, "inverse"):
            raise ValueError(f"{function} needs the closed form `inverse`, {type(mech).__name__} has none")
        self.names = _margin_names(mech)
        if not self.names:
            raise ValueError(f"{type(mech).__name__} has no margins: give it limits (strokes, cones, ...)")
        self.is_any = isinstance(free, str)
        if self.is_any and free != ANY:
            raise ValueError(f'free must be numbers or "any", got {free!r}')
        if self.is_any and mech.free_joints != 1:
            raise ValueError(
                f'free="any" is for one redundant joint, {type(mech).__name__} has {mech.free_joints}'
            )
        self.branch = None if branch is None else np.asarray(branch_rows(mech, branch)[0])
        self.free = None
        if free is not None and not self.is_any:
            self.free, many = free_rows(mech, free)
            if many:
                raise ValueError("free must be one value of each joint, got a batch")

    def over(self, where: Slice, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Smallest margin, and which it is, of coordinates (batch, d) in a slice."""
        return self._found(where.axes, where.at, (values,))

    def along(self, starts: Any, axis: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for one coordinate (batch,), where each row has a pose of its own."""
        return self._found((axis,), None, (values[:, None], jax.tree.map(np.asarray, starts)))

    def _found(self, axes: tuple[int, ...], at: Any, rows: tuple) -> tuple[np.ndarray, np.ndarray]:
        given = (self.mech, at, self.branch, self.free)
        dtype = self.mech.length().dtype
        rows = jax.tree.map(lambda leaf: np.ascontiguousarray(leaf, dtype), rows)
        margin, limit = lane_map(_on_lanes(axes, self.is_any), given, rows)
        return margin, np.where(np.isnan(margin), -1, limit).astype(np.int32)


@lru_cache(maxsize=64)
def _on_lanes(axes: tuple[int, ...], is_any: bool) -> Callable:
    """What `lane_map` runs: smallest margin and its number, of coordinates and a pose that has the others."""

    def free_range(mech):
        return mech.free_range()[0]

    def pose_of(at, values):
        return pose_on(at, axes, values)

    def all_margins(mech, pose, branch, free):
        joints = mech.inverse(pose, branch, free=free)
        margins = [jnp.ravel(margin) for margin in mech.margins(pose, joints).values()]
        return jnp.concatenate(margins), joints

    def with_slopes(mech, pose, branch, free):
        of = lambda free: margins_of(mech, pose, free, branch=branch)
        return jax.jvp(of, (free,), (jnp.ones_like(free),))

    def best_value(mech, pose, branch, like):
        def evaluate(free):
            found = entrywise(with_slopes, mech, pose, branch, Entries((), [free]))
            least = functools.reduce(jnp.minimum, found[0].items)
            slope = jnp.zeros_like(least)
            for margin, rate in zip(*(each.items for each in found), strict=True):
                slope = jnp.where(margin == least, rate, slope)
            return least, slope

        lower, upper = (end + jnp.zeros_like(like) for end in entrywise(free_range, mech).items)
        return greatest(evaluate, lower, upper)

    def smallest(given, values, at=None):
        mech, held, branch, free = given
        pose = entrywise(pose_of, held if at is None else at, values)
        if is_any:
            free = Entries((1,), [best_value(mech, pose, branch, values.items[0])])
        margins, joints = (each.items for each in entrywise(all_margins, mech, pose, branch, free))
        least = functools.reduce(jnp.minimum, margins)  # NaN stays NaN
        which = jnp.zeros_like(least)
        for number, margin in enumerate(margins):
            which = jnp.where(margin == least, number, which)
        is_reached = functools.reduce(jnp.logical_and, [jnp.isfinite(joint) for joint in joints])
        return [jnp.where(is_reached, least, jnp.nan), which]

    return smallest


def _margin_names(mech: Mechanism) -> tuple[str, ...]:
    """A name for every margin, in the order of `mech.margins`, which JAX would sort."""
    names = []

    def look(mech):
        for name, margin in mech.margins(*mech.home()).items():
            names.extend([name] if margin.size == 1 else [f"{name}[{k}]" for k in range(margin.size)])

    jax.eval_shape(look, mech)
    return tuple(names)
