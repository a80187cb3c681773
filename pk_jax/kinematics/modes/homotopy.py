"""Homotopy continuation of systems of quadrics: every solution of one system followed to another.

Knows no mechanism. The systems are z . Q_i(s) z = 0 in P^n, as many quadrics as n, with matrices quadratic in
s; paths start at s = 1 and are wanted at s = 0.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

RUNGE_KUTTA = (0, 1 / 2, 1 / 2, 1), (1 / 6, 1 / 3, 1 / 3, 1 / 6)  # of fourth order: shares of a step, weights
FIRST_STEP = 0.05
CLOSE = 1e-4  # |first Newton correction| that steps aim at, z being of unit length
ENDED = 1e-9  # |last Newton correction| of an accepted step
STEPS = 1500
TOGETHER = (16,)  # paths that are left when they go on by themselves: all in one loop wait for the slowest
SINGULAR_BEFORE = 1e-10  # a path that still runs here ends on a singular solution
NEAR_END = 1e-2  # before it nothing is said of a path
INFINITY, START_OF_INFINITY = 1e-12, 1e-3  # |z . M z| of a point at infinity, and where paths there may begin
STABLE, IN_A_ROW = 0.05, 3  # a valuation that changes by less, for so many steps
STEEP = 5.0  # a greater one passes a zero of z . M z by chance


class End(enum.IntEnum):
    """Where a path ended."""

    RUNNING = 0
    REGULAR = 1  # on a solution with an invertible Jacobian
    AT_INFINITY = 2
    SINGULAR = 3  # on, or close to, a solution that is not regular
    LOST = 4


class Pencil(NamedTuple):
    """Matrices Q(s) = constant + s (linear + s square), each (k, n, n)."""

    constant: jax.Array
    linear: jax.Array
    square: jax.Array

    @classmethod
    def through(cls, start: jax.Array, middle: jax.Array, end: jax.Array) -> Pencil:
        """From its values at s = 1, 1/2 and 0."""
        square = 2 * (start + end - 2 * middle)
        return cls(end, start - end - square, square)

    def at(self, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Q and dQ/ds."""
        return self.constant + s * (self.linear + s * self.square), self.linear + 2 * s * self.square


class Paths(NamedTuple):
    """One entry a path."""

    point: jax.Array  # (n,) complex, of unit length
    s: jax.Array  # () reached
    step: jax.Array  # () next
    end: jax.Array  # () End
    steps: jax.Array  # () tried
    valuation: jax.Array  # () k where z . M z behaves like s^k: 0 for finite ends
    in_a_row: jax.Array  # () steps with a steady valuation


@jax.jit
def follow(pencil: Pencil, infinity: jax.Array, starts: jax.Array, is_wanted: jax.Array) -> Paths:
    """Follow solutions (paths, n + 1) of the system at s = 1 to s = 0.

    infinity:  a symmetric matrix M; points with z . M z = 0 are at infinity
    is_wanted: (paths,) others stay where they are, RUNNING

    Runge-Kutta steps of fourth order and three Newton corrections, in the affine patch conj(z) . dz = 0 that
    moves along; the step is so long that the first correction is `CLOSE`. Paths at infinity are known by the
    valuation of z . M z, how it vanishes with s; ends where it is below 1e-12 count as such.
    """
    count, dtype = len(starts), starts.real.dtype
    length = jnp.sqrt(jnp.sum(jnp.abs(starts) ** 2, axis=1, keepdims=True))
    fill = lambda value, dtype=dtype: jnp.full(count, value, dtype)
    paths = Paths(
        jnp.where(is_wanted[:, None], starts / length, 0),
        fill(1.0),
        fill(FIRST_STEP),
        jnp.where(is_wanted, End.RUNNING, End.LOST).astype(jnp.int32),
        fill(0, jnp.int32),
        fill(0.0),
        fill(0, jnp.int32),
    )
    paths = _advanced(pencil, infinity, paths, (*(few for few in TOGETHER if few < count), 0))
    end = jnp.where(is_wanted & (paths.end == End.RUNNING), End.LOST, paths.end)
    return paths._replace(end=jnp.where(is_wanted, end, End.RUNNING))


def _advanced(pencil: Pencil, infinity: jax.Array, paths: Paths, until: tuple[int, ...]) -> Paths:
    """Paths run in lockstep until no more than so many are left, which then run by themselves."""
    is_running = lambda paths: (paths.end == End.RUNNING) & (paths.steps < STEPS)

    def advance(paths):
        def chosen(new, old):
            return jnp.where(jnp.reshape(runs, (-1,) + (1,) * (old.ndim - 1)), new, old)

        runs = is_running(paths)
        return jax.tree.map(chosen, jax.vmap(lambda path: _step(pencil, infinity, path))(paths), paths)

    few, *fewer = until
    paths = lax.while_loop(lambda paths: jnp.sum(is_running(paths)) > few, advance, paths)
    if not few:
        return paths
    count = len(paths.end)
    left = jnp.nonzero(is_running(paths), size=few, fill_value=count)[0]
    others = jax.tree.map(lambda leaf: leaf.at[left].get(mode="fill", fill_value=End.LOST), paths)
    others = _advanced(pencil, infinity, others, tuple(fewer))
    return jax.tree.map(lambda leaf, part: leaf.at[left].set(part, mode="drop"), paths, others)


def _step(pencil: Pencil, infinity: jax.Array, path: Paths) -> Paths:
    z, s = path.point, path.s
    patch = jnp.conj(z)
    step = jnp.where(path.step > 0.999 * s, s, path.step)  # the last one lands on 0 exactly
    h = -step

    def system(z, s):
        """J, the values of the system and their slopes along s; the last row keeps z in the patch."""
        matrices, slopes = pencil.at(s)
        image = matrices @ z
        return (
            jnp.concatenate([2 * image, patch[None]]),
            jnp.append(image @ z, patch @ z - 1),
            jnp.append((slopes @ z) @ z, 0),
        )

    def stage(velocity, share):
        jacobian, _, slope = system(z + share * h * velocity, s + share * h)
        velocity = -jnp.linalg.solve(jacobian, slope)
        return velocity, velocity

    def correct(point, _):
        jacobian, value, _ = system(point, ahead)
        correction = jnp.linalg.solve(jacobian, value)
        return point - correction, _length(correction)

    ahead = jnp.where(step == s, 0, s + h)
    shares, weights = (jnp.asarray(each, s.dtype) for each in RUNGE_KUTTA)
    velocities = lax.scan(stage, jnp.zeros_like(z), shares)[1]
    point, (first, second, third) = lax.scan(correct, z + h * weights @ velocities, length=3)
    is_good = (first < 10 * CLOSE) & (second < 0.1 * first + ENDED) & (third < 10 * ENDED)
    is_good &= jnp.all(jnp.isfinite(point))
    factor = jnp.clip(0.9 * (CLOSE / jnp.clip(first, 1e-16, 1)) ** 0.2, 0.15, 4)  # NaN: below
    longer = jnp.where(is_good, factor, jnp.where(factor < 0.5, factor, 0.5))

    # how z . M z vanishes, and how much of it would be left at s = 0 if it goes with a whole power of s
    norm, rate = z @ infinity @ z, 2 * (z @ infinity @ velocities[0])
    size = jnp.abs(norm)
    valuation = jnp.real(s * rate / norm)
    power = jnp.maximum(jnp.round(valuation), 1)
    left = jnp.where(size < START_OF_INFINITY, size * jnp.abs(1 - valuation / power), size)
    is_steady = jnp.abs(valuation - path.valuation) < STABLE * valuation
    is_leaving = (s < NEAR_END) & is_steady & (valuation < STEEP) & ((size < INFINITY) | (left < INFINITY))
    in_a_row = jnp.where(is_good, jnp.where(is_leaving, path.in_a_row + 1, 0), path.in_a_row)
    point = jnp.where(is_good, point / _length(point), z)
    reached = jnp.where(is_good, ahead, s)
    return Paths(
        point,
        reached,
        step * longer,
        _end(reached, step * longer, in_a_row, jnp.abs(point @ infinity @ point), valuation),
        path.steps + 1,
        valuation,
        in_a_row,
    )


def _end(s, step, in_a_row, size, valuation):
    """What has become of a path that reached s and would make a step."""
    is_stuck = step < 1e-6 * s
    is_vanishing = (size < INFINITY) | ((size < START_OF_INFINITY) & (valuation > 0.2) & (valuation < STEEP))
    cases = [
        ((in_a_row >= IN_A_ROW) | ((s == 0) & (size < INFINITY)), End.AT_INFINITY),
        (s == 0, End.REGULAR),
        (is_stuck & (s < NEAR_END) & is_vanishing, End.AT_INFINITY),
        ((is_stuck & (s < NEAR_END)) | (s < SINGULAR_BEFORE), End.SINGULAR),
        (is_stuck, End.LOST),
    ]
    conditions, ends = zip(*cases, strict=True)
    return jnp.select(list(conditions), [jnp.int32(end) for end in ends], jnp.int32(End.RUNNING))


def _length(z: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.abs(z) ** 2))


def apart(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distances of points of unit length in P^n, the sine of the angle. (k, n), (l, n) -> (k, l)

    From the difference, not from the cosine, so that small distances are exact.
    """
    overlap = points.conj() @ others.T
    return np.linalg.norm(others[None] - overlap[:, :, None] * points[:, None], axis=2)
