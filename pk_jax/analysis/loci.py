"""Where a mechanism is singular: curves of type I and II over coordinates of its pose.

A singular configuration comes with the motion that makes it so: a twist v with A v = 0 (type II), or
joint rates with B v = 0 (type I). Together with the closure equations,

    F(x(a), q) = 0,  A v = 0 (or B v = 0),  |v| = 1,

is a system without determinants, for square and redundant mechanisms alike, and regular where a
determinant only touches zero in one of its factors. Least values of sigma on a grid of every working mode
are polished on it to roundoff, then followed along the curve that they lie on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.analysis.singularity import SingularityKind, classify_singularity, scaled_rows
from pk_jax.analysis.slices import BLOCK, Slice, joints_of, pose_on, poses_on, slice_of
from pk_jax.geometry.poses import pose_units
from pk_jax.kinematics.batching import home_shapes
from pk_jax.kinematics.closure import joint_scale
from pk_jax.kinematics.inverse import branch_rows, working_modes
from pk_jax.kinematics.jacobian import joint_jacobian, pose_jacobian, units
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

NODES = {2: 101, 3: 25}  # of the grid, along each axis
POLISHED = 40  # steps of Gauss-Newton at most: they halve the distance where two zeros fall together
EXACT = 1e-10  # |system| of a point of a locus
SINGULAR_NODES = 0.2  # of all nodes of a mode: so many are no curve, but the whole slice
STEP = 0.012  # of the box, 3 rad or a unit vector: distance of the points of a curve
ASIDE = STEP / 8  # from the polygon of a curve: what is farther is on another one
LEAST_STEP = 1e-5
AT_A_TIME = 1000  # points of a curve
MOST_TRIES = 100_000  # steps along a curve, one way
CORRECTED = 6  # Gauss-Newton steps after each step along the curve

Report = Callable[..., None]


class LocusCurve(NamedTuple):
    """A connected piece of a locus: k points in order (k = 1: an isolated point)."""

    kind: SingularityKind  # TYPE_I or TYPE_II; single points may be of both
    coordinates: np.ndarray  # (k, d) values of the axes
    pose: Any  # (k, ...)
    joints: np.ndarray  # (k, m)
    branch: np.ndarray  # (k, s) signs of the working mode; 0: an arm between two modes
    motion: np.ndarray  # (k, n) twist of the platform (type II), or (k, m) joint rates, that is left free
    sigma: np.ndarray  # (k,) distance to the singularity: zero to roundoff
    is_closed: bool


class SingularityLocus(NamedTuple):
    """The loci over a slice of the workspace, and the grid that they were found on."""

    axes: tuple[str, ...]
    units: tuple[int, ...]  # of the axes: 1 = length, 0 = angle
    at: Any  # the pose that has the other coordinates
    nodes: tuple[np.ndarray, ...]  # of the grid
    branches: np.ndarray  # (modes, s)
    sigma_inverse: np.ndarray  # (modes, *grid) NaN out of reach
    sigma_direct: np.ndarray
    curves: tuple[LocusCurve, ...]
    everywhere: tuple[tuple[SingularityKind, np.ndarray], ...]  # kinds and modes singular all over the slice

    def of(self, kind: SingularityKind) -> tuple[LocusCurve, ...]:
        """The curves of one type."""
        return tuple(curve for curve in self.curves if curve.kind == kind)


def singularity_locus(
    mech: Mechanism,
    axes: Sequence[str] | str | None = None,
    *,
    at: Any = None,
    ranges: Any = None,
    branch: Any = None,
    kinds: Sequence[str] = ("I", "II"),
    nodes: int | None = None,
    length: Any = None,
    report: Report | None = None,
) -> SingularityLocus:
    """The type I and type II loci of a mechanism over two coordinates of its pose, in all working modes.

    axes:    two of x, y, z, rx, ry, rz or phi; default: the first two. Three for a type II locus of a
             redundantly actuated robot, which has codimension c - n + 1: curves in a box (c = n + 1)
             and single points in a plane.
    at:      pose with the other coordinates; default: home
    ranges:  ((lower, upper), ...) of the axes; default: what the mechanism reaches
    branch:  one working mode; default: all of them
    kinds:   which of "I", "II"
    nodes:   of the grid, along each axis: features smaller than its cells may be missed
    length:  what lengths are measured in; default `mech.length()`
    report:  called with (what, done, total)

    Points satisfy their equations to 1e-10 or better. Where determinants touch zero without changing
    sign, the points are found too: the search looks for least singular values, not for signs.
    """
    require_mechanism("singularity_locus", mech)
    if not checks.is_concrete((mech, at, branch, length)):
        raise ValueError("singularity_locus works on known values only; see singularity_distance")
    kinds = tuple(kinds) if not isinstance(kinds, str) else (kinds,)
    if not kinds or set(kinds) - {"I", "II"}:
        raise ValueError(f'kinds must be of "I", "II", got {kinds}')
    axes = tuple(axes.split(",")) if isinstance(axes, str) else axes
    kinds = _curves_of(mech, 2 if axes is None else len(axes), kinds)
    where = slice_of(mech, axes, at, ranges)
    nodes = checks.is_count("nodes", NODES[len(where.axes)] if nodes is None else nodes, least=3, most=2001)
    length = mech.length() if length is None else checks.real_array("length", length)
    modes = working_modes(mech)
    if branch is not None:
        modes = np.asarray(branch_rows(mech, branch)[0]).reshape(1, -1)
    say = report or (lambda *_: None)

    lines, poses = where.grid(nodes)
    shape = (nodes,) * len(lines)
    inverse, direct, joints = [], [], []
    for number, mode in enumerate(modes):
        say("grid, working mode", number, len(modes))
        q = joints_of(mech, poses, mode)
        found = classify_singularity(mech, poses, q, length=length)
        is_there = np.asarray(found.status) == Status.OK
        inverse.append(np.where(is_there, found.sigma_inverse, np.nan).reshape(shape))
        direct.append(np.where(is_there, found.sigma_direct, np.nan).reshape(shape))
        joints.append(q)
    sigmas = {"I": np.stack(inverse), "II": np.stack(direct)}

    values = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    curves: list[LocusCurve] = []
    everywhere = []
    for kind in kinds:
        starts = []
        for mode, sigma, q in zip(modes, sigmas[kind], joints, strict=True):
            there = sigma[np.isfinite(sigma)]
            if there.size and np.mean(there < EXACT) > SINGULAR_NODES:
                everywhere.append((_KINDS[kind], mode))
                continue
            seeds = np.flatnonzero(_seeds(sigma, kind))
            starts.append(np.concatenate([values[seeds], q[seeds]], axis=1))
        if starts and sum(map(len, starts)):
            follow = _Follower(mech, where, kind, length, nodes)
            curves += follow.all_curves(np.concatenate(starts), modes, branch is not None, say)
    say("done", 1, 1)
    return SingularityLocus(
        where.names,
        where.units,
        where.at,
        tuple(lines),
        modes,
        sigmas["I"],
        sigmas["II"],
        tuple(curves),
        tuple(everywhere),
    )


_KINDS = {"I": SingularityKind.TYPE_I, "II": SingularityKind.TYPE_II}


def _curves_of(mech: Mechanism, d: int, kinds: tuple[str, ...]) -> tuple[str, ...]:
    """The kinds whose locus is made of curves or points over d axes; ValueError where none is."""
    pose, joints = home_shapes(mech)
    a = jax.eval_shape(pose_jacobian, mech, pose, joints)
    equations, n = a.shape[0] if mech.actuated_rows is None else mech.actuated_rows, a.shape[1]
    codimension = {"I": 1, "II": equations - n + 1}
    found = tuple(kind for kind in kinds if codimension[kind] >= d - 1)
    if not found:
        raise ValueError(
            f"axes must be two here: the loci of {type(mech).__name__} over {d} axes are no curves"
        )
    return tuple(kind for kind in found if codimension[kind] <= d)


def _seeds(sigma: np.ndarray, kind: str) -> np.ndarray:
    """Nodes from which a locus may be near: least along a line of the grid, and small beside its changes."""
    padded = np.pad(sigma, 1, constant_values=np.nan)
    inner = tuple(slice(1, -1) for _ in sigma.shape)
    found = np.zeros(sigma.shape, bool)
    for axis in range(sigma.ndim):
        before, after = (
            padded[tuple(slice(1 + s, -1 + s or None) if k == axis else i for k, i in enumerate(inner))]
            for s in (-1, 1)
        )
        low = np.where(np.isnan(before), np.inf, before), np.where(np.isnan(after), np.inf, after)
        is_least = (sigma <= low[0]) & (sigma <= low[1])  # NaN compares False
        changes = np.fmax(np.abs(before - sigma), np.abs(after - sigma))
        found |= is_least & ~(sigma > 2 * changes)
        if kind == "I":  # the end of the reach, where sigma falls like a root
            found |= np.isfinite(sigma) & (np.isnan(before) | np.isnan(after))
    return found


class Piece(NamedTuple):
    """Configurations along a curve, in scaled variables (k, unknowns)."""

    track: np.ndarray
    is_closed: bool


class _Follower:
    """Finds and follows the curves of one kind over one slice."""

    def __init__(self, mech: Mechanism, where: Slice, kind: str, length: jax.Array, nodes: int) -> None:
        self.mech, self.where, self.kind, self.length = mech, where, kind, length
        self.d = len(where.axes)
        pose, joints = home_shapes(mech)
        self.m = joints.shape[0]
        dtype = joints.dtype
        box = where.upper - where.lower
        at_home = np.asarray(joint_scale(mech, mech.home()[1]))
        self.joint_units = np.asarray(mech.joint_units or (1,) * self.m)
        of_joints = np.where(self.joint_units > 0, at_home, 3.0)
        motions = self.m if kind == "I" else jax.eval_shape(pose_jacobian, mech, pose, joints).shape[1]
        if kind == "I" and mech.actuated_rows is not None:
            motions = mech.actuated_rows
        self.motions = motions
        self.scale = jnp.asarray(np.concatenate([box, of_joints, np.ones(motions)]), dtype)
        self.cell = 1 / (nodes - 1)
        self.given = mech, where.at, length, self.scale

    def all_curves(
        self, starts: np.ndarray, modes: np.ndarray, one_mode: bool, say: Report
    ) -> list[LocusCurve]:
        points = self._polished(starts, say)
        pieces: list[Piece] = []
        whole = len(points)
        while len(points):
            say(f"type {self.kind} curves, points left", whole - len(points), whole)
            pieces.append(self._followed(points[0]))
            points = points[1:]
            points = points[self._distances(points, pieces[-1]) > ASIDE]
        return self._curves(self._without_repeats(pieces), modes, one_mode)

    def _polished(self, starts: np.ndarray, say: Report) -> np.ndarray:
        """Points of the locus near the starts, (points, unknowns) in scaled variables."""
        found = []
        scale = np.asarray(self.scale)
        for first in range(0, len(starts), BLOCK):
            say(f"type {self.kind} points", first, len(starts))
            rows = starts[first : first + BLOCK]
            padded = np.resize(rows, (BLOCK, rows.shape[1])) if len(rows) < BLOCK else rows
            start, y, off = _polish(*self.given, jnp.asarray(padded), self.where.axes, self.kind)
            start, y, off = (np.asarray(each)[: len(rows)] for each in (start, y, off))
            moved = np.max(np.abs(y - start)[:, : self.d], axis=1)
            found.append(y[(off <= EXACT) & (moved <= 3 * self.cell)])  # farther ones are others' neighbours
        points = np.concatenate(found)
        lower, upper = (np.asarray(edge) / scale[: self.d] for edge in (self.where.lower, self.where.upper))
        inside = np.all((points[:, : self.d] >= lower) & (points[:, : self.d] <= upper), axis=1)
        return points[inside]

    def _followed(self, start: np.ndarray) -> Piece:
        """The curve through a point, both ways; the point itself where there is none."""
        lower, upper = (
            jnp.asarray(edge) / self.scale[: self.d] for edge in (self.where.lower, self.where.upper)
        )
        of, begin = (self.where.axes, self.kind), jnp.asarray(start)
        ways = []
        for way in (1.0, -1.0):
            walk, parts = _begun(*self.given, begin, way, *of), [np.zeros((0, len(start)))]
            while not walk.is_over and walk.tries < MOST_TRIES:
                track, count, walk = _follow(*self.given, lower, upper, begin, walk, *of)
                parts.append(np.asarray(track)[: int(count)])
            ways.append(np.concatenate(parts))
            if walk.is_closed:
                return self._piece(np.concatenate([start[None], ways[0]]), True)
        return self._piece(np.concatenate([ways[1][::-1], start[None], ways[0]]), False)

    def _piece(self, track: np.ndarray, is_closed: bool) -> Piece:
        """A curve, or one point where only the motion turns: a pose with more than one free motion."""
        features = self._features(track)
        if np.max(np.linalg.norm(features - features[0], axis=1)) < STEP / 4:
            return Piece(track[:1], False)
        return Piece(track, is_closed)

    def _features(self, points: np.ndarray) -> np.ndarray:
        """Configurations as vectors whose distance is that along the curve: angles on their circle."""
        scale = np.asarray(self.scale)
        coordinates, joints = points[:, : self.d], points[:, self.d : self.d + self.m]
        angles = (joints * scale[self.d : self.d + self.m])[:, self.joint_units == 0]
        turns = [np.cos(angles) / 3, np.sin(angles) / 3]
        lengths = joints[:, self.joint_units > 0]
        lengths = np.abs(lengths) if self.mech.joints_are_distances else lengths  # only squares are known
        return np.concatenate([coordinates, lengths, *turns], axis=1)

    def _distances(self, points: np.ndarray, piece: Piece) -> np.ndarray:
        """From each point to the polygon of a curve. -> (points,)"""
        features, corners = self._features(points), self._features(piece.track)
        if piece.is_closed or len(corners) == 1:
            corners = np.concatenate([corners, corners[:1]])
        least = np.full(len(features), np.inf)
        for begin, side in zip(corners, np.diff(corners, axis=0), strict=False):
            offset = features - begin
            along = np.clip(offset @ side / max(side @ side, 1e-300), 0, 1)
            least = np.minimum(least, np.linalg.norm(offset - along[:, None] * side, axis=1))
        return least

    def _without_repeats(self, pieces: list[Piece]) -> list[Piece]:
        """Single points that lie on a curve are dropped, and all but one of those that coincide."""
        kept = [piece for piece in pieces if len(piece.track) > 1]
        for piece in pieces:
            if len(piece.track) == 1 and all(
                self._distances(piece.track, other)[0] > ASIDE for other in kept
            ):
                kept.append(piece)
        return kept

    def _curves(self, pieces: list[Piece], modes: np.ndarray, one_mode: bool) -> list[LocusCurve]:
        """The pieces with all that is known of their points."""
        if not pieces:
            return []
        points = np.concatenate([piece.track for piece in pieces])
        count = len(points)
        points = np.resize(points, (-(-count // BLOCK) * BLOCK, points.shape[1]))  # few shapes are compiled
        values, joints, motion = np.split(points * np.asarray(self.scale), (self.d, self.d + self.m), axis=1)
        joints = np.where(self.joint_units > 0, joints, np.arctan2(np.sin(joints), np.cos(joints)))
        if self.mech.joints_are_distances:
            joints = np.abs(joints)
        pose = poses_on(self.where.at, self.where.axes, jnp.asarray(values))
        found = classify_singularity(self.mech, pose, joints, length=self.length)
        sigma = np.asarray(found.sigma_inverse if self.kind == "I" else found.sigma_direct)
        branch = self._branches(pose, joints)
        of_pose = np.asarray(pose_units(self.where.at, self.mech.pose_units))
        powers = self.joint_units[: self.motions] if self.kind == "I" else of_pose
        motion = motion * float(self.length) ** powers
        whole = LocusCurve(_KINDS[self.kind], values, pose, joints, branch, motion, sigma, False)
        cuts = np.cumsum([0] + [len(piece.track) for piece in pieces])
        curves = [
            _part(whole, slice(first, last))._replace(is_closed=piece.is_closed)
            for piece, first, last in zip(pieces, cuts, cuts[1:], strict=False)
        ]
        if not one_mode or not modes.size:
            return curves
        return [part for curve in curves for part in _in_mode(curve, modes[0])]

    def _branches(self, pose: Any, joints: np.ndarray) -> np.ndarray:
        """The working mode of every configuration; 0 for the arms that two modes share. -> (k, s)"""
        every = working_modes(self.mech)
        if not every.size:
            return np.zeros((len(joints), 0))
        gaps = []
        for mode in every:
            gap = joints_of(self.mech, pose, mode) - joints
            gap = np.where(self.joint_units > 0, gap, 2 * np.sin(gap / 2))
            # an arm that is out of reach by a rounding is as good in either mode
            gaps.append(np.max(np.nan_to_num(np.abs(gap)), axis=1))
        gaps = np.array(gaps)
        best = np.min(gaps, axis=0)
        fits = gaps <= np.maximum(2 * best, 1e-4)  # at a reach limit two modes differ by the root of roundoff
        signs = np.einsum("jk,js->ks", fits, every)
        return np.sign(np.where(np.abs(signs) == fits.sum(axis=0)[:, None], signs, 0))


def _part(curve: LocusCurve, rows: Any) -> LocusCurve:
    fields = jax.tree.map(lambda leaf: leaf[rows], tuple(curve[1:7]))
    return LocusCurve(curve.kind, *fields, False)


def _in_mode(curve: LocusCurve, mode: np.ndarray) -> list[LocusCurve]:
    """The runs of points that one working mode has."""
    is_wanted = np.all((curve.branch == mode) | (curve.branch == 0), axis=1)
    if is_wanted.all():
        return [curve]
    if curve.is_closed and is_wanted.any():  # begin where a run does
        first = int(np.flatnonzero(is_wanted & ~np.roll(is_wanted, 1))[0])
        is_wanted = np.roll(is_wanted, -first)
        turned = np.roll(np.arange(len(is_wanted)), -first)
        curve = _part(curve, turned)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_wanted.astype(int), [0]])))
    return [_part(curve, slice(a, b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


# --- the system, in scaled variables y = (coordinates, joints, motion) / scale


def _system(
    mech: Mechanism, at: Any, length: jax.Array, scale: jax.Array, y: jax.Array, axes: tuple, kind: str
) -> jax.Array:
    d, m = len(axes), _joint_count(mech)
    z = y * scale
    pose, joints, motion = pose_on(at, axes, z[:d]), z[d : d + m], z[d + m :]
    a, b = scaled_rows(mech, pose, joints, length)
    size = lax.stop_gradient(_sizes(mech, pose, joints, length))
    matrix = a if kind == "II" else b[:, : motion.shape[0]]
    return jnp.concatenate(
        [mech.residual(pose, joints) / size, matrix @ motion, (motion @ motion - 1)[None] / 2]
    )


def _joint_count(mech: Mechanism) -> int:
    """The number of joints."""
    return jax.eval_shape(lambda mech: mech.home(), mech)[1].shape[0]


def _sizes(mech: Mechanism, pose: Any, joints: jax.Array, length: jax.Array) -> jax.Array:
    """Length of every row of [A B], lengths over `length`. -> (c,)"""
    a, b = pose_jacobian(mech, pose, joints), joint_jacobian(mech, pose, joints)
    a = a * length ** units(pose_units(pose, mech.pose_units), a.dtype)
    b = b * length ** units(mech.joint_units or (1,) * b.shape[1], b.dtype)
    size = jnp.sqrt(jnp.sum(a * a, axis=1) + jnp.sum(b * b, axis=1))
    return jnp.where(size > 0, size, 1)


@partial(jax.jit, static_argnums=(5, 6))
def _polish(mech, at, length, scale, starts, axes, kind):
    """Gauss-Newton from nodes (batch, d + m): starts and ends in scaled variables, and |system| there."""
    d = len(axes)

    def one(start):
        pose, joints = pose_on(at, axes, start[:d]), start[d:]
        a, b = scaled_rows(mech, pose, joints, length)
        matrix = a if kind == "II" else b[:, : scale.shape[0] - start.shape[0]]
        motion = jnp.linalg.svd(matrix)[2][-1]
        y = jnp.concatenate([start, motion]) / scale
        system = lambda y: _system(mech, at, length, scale, y, axes, kind)

        def is_off(state):
            return (state[0] < POLISHED) & ~(state[2] <= EXACT * 1e-3)

        def step(state):
            k, y, _ = state
            y = y - _toward(system, y)
            return k + 1, y, jnp.max(jnp.abs(system(y)))

        _, end, off = lax.while_loop(is_off, step, (0, y, jnp.inf))
        return y, end, off

    return jax.vmap(one)(starts)


def _toward(system: Callable, y: jax.Array) -> jax.Array:
    """The shortest Gauss-Newton step, at most a tenth."""
    step = jnp.linalg.pinv(jax.jacfwd(system)(y), rtol=1e-9) @ system(y)
    longest = jnp.max(jnp.abs(step))
    return step * jnp.minimum(1, 0.1 / jnp.where(longest > 0, longest, 1))


class _Walk(NamedTuple):
    """Where on a curve, and where to."""

    y: jax.Array
    tangent: jax.Array
    step: jax.Array
    count: jax.Array  # points so far
    is_over: jax.Array
    is_closed: jax.Array
    tries: jax.Array


@partial(jax.jit, static_argnums=(6, 7))
def _begun(mech, at, length, scale, start, way, axes, kind):
    """The walk that leaves a point of a curve one way, or that is over where there is no curve."""
    _, sigma, rows = jnp.linalg.svd(
        jax.jacfwd(partial(_system, mech, at, length, scale, axes=axes, kind=kind))(start)
    )
    is_curve = sigma[-1] > 1e-7 * sigma[0] if sigma.shape[0] < start.shape[0] else jnp.asarray(False)
    zero, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    return _Walk(start, way * rows[-1], jnp.asarray(STEP / 4, start.dtype), zero, ~is_curve, no, zero)


@partial(jax.jit, static_argnums=(8, 9))
def _follow(mech, at, length, scale, lower, upper, start, walk, axes, kind):
    """Along the curve that passes `start` until the box ends or it closes: points, how many, the walk."""
    d, m = len(axes), _joint_count(mech)
    system = partial(_system, mech, at, length, scale, axes=axes, kind=kind)
    is_angle = np.asarray(mech.joint_units or (1,) * m) == 0
    sized = jnp.abs if mech.joints_are_distances else lambda q: q

    def gap(y):
        """Distance from the start: angles have no turns, motions no sign, distances neither."""
        apart = y[d : d + m] - start[d : d + m]
        turned = 2 * jnp.sin(apart * scale[d : d + m] / 2) / scale[d : d + m]
        joints = jnp.where(is_angle, turned, sized(y[d : d + m]) - sized(start[d : d + m]))
        v, w = y[d + m :], start[d + m :]
        motions = jnp.where(v @ w < 0, v + w, v - w)
        return jnp.linalg.norm(jnp.concatenate([y[:d] - start[:d], joints, motions]))

    def advance(state):
        walk, track, begin = state
        predicted = walk.y + walk.step * walk.tangent
        y = lax.fori_loop(0, CORRECTED, lambda _, y: y - _toward(system, y), predicted)
        tangent = jnp.linalg.svd(jax.jacfwd(system)(y))[2][-1]
        along = tangent @ walk.tangent
        is_good = (jnp.max(jnp.abs(system(y))) <= EXACT * 1e-2) & (jnp.abs(along) > 0.9)
        is_good &= jnp.linalg.norm(y - predicted) <= 0.5 * walk.step
        is_good &= jnp.all((y[:d] >= lower) & (y[:d] <= upper))
        is_closed = is_good & (walk.count > 3) & (gap(y) < 0.8 * walk.step)
        place = walk.count - begin
        track = track.at[place].set(jnp.where(is_good & ~is_closed, y, track[place]))
        step = jnp.where(is_good, jnp.minimum(1.4 * walk.step, STEP), walk.step / 2)
        onward = _Walk(
            jnp.where(is_good, y, walk.y),
            jnp.where(is_good, tangent * jnp.where(along < 0, -1, 1), walk.tangent),
            step,
            walk.count + (is_good & ~is_closed),
            is_closed | (step < LEAST_STEP),
            is_closed,
            walk.tries + 1,
        )
        return onward, track, begin

    def goes_on(state):
        walk, _, begin = state
        return ~walk.is_over & (walk.count - begin < AT_A_TIME) & (walk.tries < MOST_TRIES)

    track = jnp.zeros((AT_A_TIME, start.shape[0]), start.dtype)
    walk, track, begin = lax.while_loop(goes_on, advance, (walk, track, walk.count))
    return track, walk.count - begin, walk
