"""Every solution, real or complex, of the leg equations of a Stewart platform: parameter homotopy.

Paths run from the forty solutions of a generic complex platform to the geometry at hand with random
complex lengths, which says how many solutions this geometry has at all, and from those to the lengths that
were asked for. The first part is done once a geometry.

Source: parameter homotopy, Morgan and Sommese 1989, Appl. Math. Comput. 29, 123-160; for this platform
Raghavan 1993, J. Mech. Des. 115, 277-282 (forty solutions).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np

from pk_jax.kinematics.modes.homotopy import End, apart
from pk_jax.kinematics.modes.monodromy import SEED, SOLUTIONS, between, generic_start, random_legs
from pk_jax.kinematics.modes.study import Legs

SAME = 1e-8  # distance in P^7 of two regular ends that are one solution
NEAR = 1e-3  # the same of ends on a singular solution, where paths stop short of it
ATTEMPTS = 5


class Start(NamedTuple):
    """A geometry at random complex lengths, and its solutions."""

    legs: Legs
    points: np.ndarray  # (k, 8)
    is_clean: bool  # every path arrived or went to infinity, no two at one solution


class Solutions(NamedTuple):
    """What the paths to one set of lengths found."""

    regular: np.ndarray  # (k, 8) distinct solutions, each of multiplicity one
    multiple: np.ndarray  # (l, 8) where several paths met
    met: int  # paths that ended at `multiple`
    at_infinity: int
    lost: int
    retries: int  # further sets of paths that were needed
    is_complete: bool


class Layout:
    """One geometry of six legs: what its poses are counted with. Any unit, any frames."""

    def __init__(self, base: np.ndarray, platform: np.ndarray) -> None:
        self.centres = base.mean(axis=0), platform.mean(axis=0)
        size = np.sum((base - self.centres[0]) ** 2) + np.sum((platform - self.centres[1]) ** 2)
        self.scale = float(np.sqrt(size / 12))
        self.ends = [
            (points - centre) / self.scale
            for points, centre in zip((base, platform), self.centres, strict=True)
        ]
        self._starts: list[Start] = []
        self._count: tuple[int, bool] | None = None

    def count(self) -> tuple[int, bool]:
        """How many finite solutions the geometry has at almost all lengths, and whether that is sure.

        Forty without a path lost are sure, there cannot be more; fewer are counted twice, from other
        starts to other lengths.
        """
        if self._count is None:
            seen = []
            for attempt in range(ATTEMPTS):
                start = self.start(attempt)
                if start.is_clean:
                    if len(start.points) == SOLUTIONS or len(start.points) in seen:
                        break
                    seen.append(len(start.points))
            self._starts.sort(key=lambda start: (-start.is_clean, -len(start.points)))
            best = self._starts[0]
            sizes = [len(start.points) for start in self._starts if start.is_clean]
            is_sure = sizes[:1] == [SOLUTIONS] or len(set(sizes)) < len(sizes)
            self._count = len(best.points), is_sure and max(sizes) == len(best.points)
        return self._count

    def start(self, attempt: int) -> Start:
        """The solutions at the random lengths of one attempt, the first straight from the generic start."""
        while len(self._starts) <= attempt:
            self._starts.append(self._made(len(self._starts)))
        return self._starts[attempt]

    def _made(self, attempt: int) -> Start:
        random = np.random.default_rng([SEED, attempt])
        legs, points = generic_start()
        if attempt:
            by_way = random_legs(random)
            paths = between(legs, by_way, points, np.ones(SOLUTIONS, bool))
            legs, points = by_way, np.asarray(paths.point)[np.asarray(paths.end) == End.REGULAR]
        here = Legs(*map(np.asarray, (*self.ends, 4 * random_legs(random).offset)))
        found = _followed(legs, here, points)
        is_clean = not found.lost and not found.met and len(points) == SOLUTIONS
        return Start(here, found.regular, is_clean)

    def solve(self, lengths: np.ndarray) -> Solutions:
        """All solutions at given lengths (6,), again from other starts until none is missing."""
        expected, is_sure = self.count()
        squared = (lengths / self.scale) ** 2
        here = Legs(*self.ends, sum(np.sum(ends**2, axis=1) for ends in self.ends) - squared)
        every = np.zeros((0, 8), complex)
        for attempt in range(ATTEMPTS):
            start = self.start(attempt)
            found = _followed(start.legs, here, start.points)._replace(retries=attempt)
            if start.is_clean and len(start.points) == expected and not found.lost:
                if self._are_isolated(found, attempt, here):
                    return found._replace(is_complete=is_sure)
                break
            # a real system: what solves it, its conjugate does
            every = _distinct(np.concatenate([every, found.regular, found.regular.conj()]), SAME)
            if len(every) == expected:
                return Solutions(every, every[:0], 0, 0, 0, attempt, is_sure)
        regular = found.regular if len(found.regular) > len(every) else every
        lost = max(expected - len(regular) - found.at_infinity, 0)
        return Solutions(regular, regular[:0], 0, found.at_infinity, lost, attempt, is_complete=False)

    def _are_isolated(self, found: Solutions, attempt: int, here: Legs) -> bool:
        """Whether paths from another start meet in the same places: on a self-motion they would in others."""
        if not found.met:
            return True
        start = self.start(attempt + 1)
        other = _followed(start.legs, here, start.points)
        off = apart(found.multiple, other.multiple)
        is_same = off.shape[0] == off.shape[1] and np.all(off.min(axis=1) < NEAR)
        return bool(is_same) and other.met == found.met


@lru_cache(maxsize=128)
def _layout(shape: tuple[int, int], base: bytes, platform: bytes) -> Layout:
    return Layout(*(np.frombuffer(points).reshape(shape) for points in (base, platform)))


def layout_of(base: np.ndarray, platform: np.ndarray) -> Layout:
    """The layout of six legs (6, 3), (6, 3); those met before are remembered."""
    return _layout(
        base.shape, *(np.ascontiguousarray(points, float).tobytes() for points in (base, platform))
    )


def _followed(start: Legs, end: Legs, points: np.ndarray) -> Solutions:
    wanted = np.arange(SOLUTIONS) < len(points)
    padded = np.concatenate([points, np.ones((SOLUTIONS - len(points), 8))])
    complex_legs = lambda legs: Legs(*(np.asarray(part, complex) for part in legs))
    paths = jax.device_get(between(complex_legs(start), complex_legs(end), padded, wanted))
    ends = paths.end[wanted]
    at = lambda which: paths.point[wanted][ends == which]
    regular = _distinct(at(End.REGULAR), SAME)
    multiple, met = _met(at(End.SINGULAR))
    at_infinity = int(np.sum(ends == End.AT_INFINITY))
    lost = len(points) - len(regular) - met - at_infinity
    return Solutions(regular, multiple, met, at_infinity, lost, retries=0, is_complete=False)


def _distinct(points: np.ndarray, same: float) -> np.ndarray:
    """Points (k, 8) without those that repeat an earlier one."""
    is_near = apart(points, points) < same
    return points[~np.any(np.tril(is_near, -1), axis=1)]


def _met(points: np.ndarray) -> tuple[np.ndarray, int]:
    """Where two singular ends or more are near each other, one of each group, and how many there are.

    A path that ends alone on a singular solution has met a curve of solutions, or was misled.
    """
    is_near = apart(points, points) < NEAR
    is_met = is_near.sum(axis=1) > 1
    return _distinct(points[is_met], NEAR), int(np.sum(is_met))
