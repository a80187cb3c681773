"""Curves of singular configurations, without determinants: found to roundoff and followed.

A singular configuration comes with the motion that makes it so: a twist v with A v = 0 (type II), or
joint rates with B v = 0 (type I). Together with the closure equations,

    F(x(a), q) = 0,  A v = 0 (or B v = 0),  |v| = 1,

is a system for square and redundant mechanisms alike, and it has no signs to change: zeros that a determinant
only touches are found like all others.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax.analysis.singularity import rows_and_sizes, scaled_rows
from pk_jax.analysis.slices import BLOCK, Slice, pose_on
from pk_jax.geometry.poses import pose_units
from pk_jax.kinematics.batching import home_shapes
from pk_jax.kinematics.closure import joint_scale
from pk_jax.kinematics.jacobian import pose_jacobian
from pk_jax.mechanisms.base import Mechanism

POLISHED = 40  # steps of Gauss-Newton at most: they halve the distance where two zeros fall together
EXACT = 1e-10  # |system| of a point of a locus
STEP = 0.012  # of the box, 3 rad or a unit vector: distance of the points of a curve
LEAST_STEP = 1e-5
ASIDE = STEP / 8  # from the polygon of a curve: what is farther is on another one
AT_A_TIME = 1000  # points of a curve
MOST_TRIES = 100_000  # steps along a curve, one way
CORRECTED = 6  # Gauss-Newton steps after each step along the curve

Report = Callable[..., None]


class Piece(NamedTuple):
    """Configurations along a curve, in scaled variables (k, unknowns)."""

    track: np.ndarray
    is_closed: bool


class Follower:
    """Finds and follows the curves of one kind over one slice."""

    def __init__(
        self, mech: Mechanism, where: Slice, kind: str, length: jax.Array, nodes: int, free: jax.Array | None
    ) -> None:
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
        self.scale = jnp.asarray(np.concatenate([box, of_joints, np.ones(motions)]), dtype)
        self.cell = 1 / (nodes - 1)
        at_home = mech.home()[1][self.m - mech.free_joints :]
        self.given = mech, Held(where.at, at_home if free is None else free), length, self.scale
        self.problem = Problem(where.axes, kind, self.m)

    def pieces(self, starts: np.ndarray, say: Report) -> list[Piece]:
        """Every curve and isolated point near nodes of the grid (batch, d + m), each once."""
        points = self._polished(starts, say)
        found: list[Piece] = []
        whole = len(points)
        while len(points):
            say(f"type {self.kind} curves, points left", whole - len(points), whole)
            found.append(self._followed(points[0]))
            points = points[1:]
            points = points[self._distances(points, found[-1]) > ASIDE]
        return self._without_repeats(found)

    def parts(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates (k, d), joints (k, m) and free motions of scaled points."""
        values, joints, motion = np.split(points * np.asarray(self.scale), (self.d, self.d + self.m), axis=1)
        joints = np.where(self.joint_units > 0, joints, np.arctan2(np.sin(joints), np.cos(joints)))
        if self.mech.joints_are_distances:
            joints = np.abs(joints)
        of_pose = np.asarray(pose_units(self.where.at, self.mech.pose_units))
        powers = self.joint_units[: motion.shape[1]] if self.kind == "I" else of_pose
        return values, joints, motion * float(self.length) ** powers

    def _polished(self, starts: np.ndarray, say: Report) -> np.ndarray:
        """Points of the locus near the starts, (points, unknowns) in scaled variables."""
        found = []
        scale = np.asarray(self.scale)
        for first in range(0, len(starts), BLOCK):
            say(f"type {self.kind} points", first, len(starts))
            rows = starts[first : first + BLOCK]
            padded = np.resize(rows, (BLOCK, rows.shape[1])) if len(rows) < BLOCK else rows
            start, y, off = _polish(*self.given, jnp.asarray(padded), self.problem)
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
        begin = jnp.asarray(start)
        ways = []
        for way in (1.0, -1.0):
            walk, parts = _begun(*self.given, begin, way, self.problem), [np.zeros((0, len(start)))]
            while not walk.is_over and walk.tries < MOST_TRIES:
                track, count, walk = _follow(*self.given, lower, upper, begin, walk, self.problem)
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


class Held(NamedTuple):
    """What does not vary: the other coordinates of the pose, and kinematically redundant joints."""

    pose: Any
    free: jax.Array


class Problem(NamedTuple):
    """What is solved, known when compiling: the axes that vary, "I" or "II", the number of joints."""

    axes: tuple[int, ...]
    kind: str
    joints: int


def _matrix(mech: Mechanism, pose: Any, joints: jax.Array, length: jax.Array, kind: str) -> jax.Array:
    """A or B, the columns of actuators, whose null space the singularity has."""
    a, b = scaled_rows(mech, pose, joints, length)
    return a if kind == "II" else b[:, : mech.actuated_rows]


def _system(
    mech: Mechanism, held: Held, length: jax.Array, scale: jax.Array, problem: Problem, y: jax.Array
) -> jax.Array:
    """What a singular configuration fulfils; y = (coordinates, joints, motion) / scale."""
    d, m = len(problem.axes), problem.joints
    values, joints, motion = jnp.split(y * scale, (d, d + m))
    pose = pose_on(held.pose, problem.axes, values)
    size = lax.stop_gradient(rows_and_sizes(mech, pose, joints, length)[2])
    free = _matrix(mech, pose, joints, length, problem.kind) @ motion
    count = held.free.shape[0]
    locked = (joints[m - count :] - held.free) / scale[d + m - count : d + m]
    return jnp.concatenate(
        [mech.residual(pose, joints) / size, free, (motion @ motion - 1)[None] / 2, locked]
    )


@partial(jax.jit, static_argnums=5)
def _polish(mech, held, length, scale, starts, problem):
    """Gauss-Newton from nodes (batch, d + m): starts and ends in scaled variables, and |system| there."""
    system = partial(_system, mech, held, length, scale, problem)

    def one(start):
        values, joints = jnp.split(start, (len(problem.axes),))
        matrix = _matrix(mech, pose_on(held.pose, problem.axes, values), joints, length, problem.kind)
        y = jnp.concatenate([start, jnp.linalg.svd(matrix)[2][-1]]) / scale

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


@partial(jax.jit, static_argnums=6)
def _begun(mech, held, length, scale, start, way, problem):
    """The walk that leaves a point of a curve one way, or that is over where there is no curve."""
    jacobian = jax.jacfwd(partial(_system, mech, held, length, scale, problem))(start)
    _, sigma, rows = jnp.linalg.svd(jacobian)
    is_curve = sigma[-1] > 1e-7 * sigma[0] if sigma.shape[0] < start.shape[0] else jnp.asarray(False)
    zero, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    return _Walk(start, way * rows[-1], jnp.asarray(STEP / 4, start.dtype), zero, ~is_curve, no, zero)


@partial(jax.jit, static_argnums=8)
def _follow(mech, held, length, scale, lower, upper, start, walk, problem):
    """Along the curve that passes `start` until the box ends or it closes: points, how many, the walk."""
    d, m = len(problem.axes), problem.joints
    system = partial(_system, mech, held, length, scale, problem)
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
