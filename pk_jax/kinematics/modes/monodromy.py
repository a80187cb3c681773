"""The generic Stewart platform that every homotopy starts from, with its forty poses: found by monodromy.

    python -m pk_jax.kinematics.modes.monodromy            writes homotopy_start.json beside this file anew

A random point of P^7 and random joints have legs that reach it: one solution of one complex platform.
Following it around loops in the space of platforms permutes the solutions and so finds the others. There are
forty: Ronga and Vust 1992, Lazard 1993, Mourrain 1993.
"""

from __future__ import annotations

import json
from functools import cache
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.kinematics.modes.homotopy import End, Paths, Pencil, apart, follow
from pk_jax.kinematics.modes.study import NORM, Legs, quadrics

SOLUTIONS = 40
SEED = 2026
FILE = Path(__file__).with_name("homotopy_start.json")


@cache
def generic_start() -> tuple[Legs, np.ndarray]:
    """The platform of the file, and its solutions (40, 8) of unit length."""
    kept = json.loads(FILE.read_text())
    numbers = {name: np.asarray(value) @ [1, 1j] for name, value in kept.items() if name != "made_by"}
    return Legs(numbers["base"], numbers["platform"], numbers["offset"]), numbers["solutions"]


def random_legs(random: np.random.Generator) -> Legs:
    """A complex platform, every number of it normal with variance 1."""
    return Legs(*(_normal(random, *shape) for shape in ((6, 3), (6, 3), (6,))))


@jax.jit
def between(start: Legs, end: Legs, points: jax.Array, is_wanted: jax.Array) -> Paths:
    """Solutions (paths, 8) of `start` followed to `end`, straight in the parameters."""
    middle = jax.tree.map(lambda a, b: (a + b) / 2, start, end)
    pencil = Pencil.through(*map(quadrics, (start, middle, end)))
    return follow(pencil, jnp.asarray(NORM), points, is_wanted)


def by_monodromy(seed: int = SEED) -> tuple[Legs, np.ndarray]:
    """A generic platform and its solutions (40, 8), from nothing but a seed."""
    random = np.random.default_rng(seed)
    legs, point = _one_solution(random)
    found = point[None]
    while len(found) < SOLUTIONS:
        by_way = random_legs(random), random_legs(random)
        ends = _followed((legs, *by_way, legs), found)
        new = ends[apart(found, ends).min(axis=0) > 1e-6]
        for one in new:
            if apart(found, one[None]).min() > 1e-6:
                found = np.concatenate([found, one[None]])
    return legs, found


def _one_solution(random: np.random.Generator) -> tuple[Legs, np.ndarray]:
    x, y = _normal(random, 4), _normal(random, 4)
    point = np.concatenate([x, y - x * (x @ y) / (x @ x)])
    point = point / np.linalg.norm(point)
    legs = random_legs(random)._replace(offset=np.zeros(6, complex))
    value = np.einsum("nij,i,j->n", np.asarray(quadrics(legs))[:6], point, point)
    return legs._replace(offset=-value / np.sum(point[:4] ** 2)), point


def _followed(route: tuple[Legs, ...], points: np.ndarray) -> np.ndarray:
    """Where solutions (k, 8) arrive along a closed route; those lost on the way are left out."""
    wanted = np.arange(SOLUTIONS) < len(points)
    at = np.concatenate([points, np.ones((SOLUTIONS - len(points), 8))])
    for start, end in pairwise(route):
        paths = between(start, end, at, wanted)
        at, wanted = np.asarray(paths.point), wanted & (np.asarray(paths.end) == End.REGULAR)
    return at[wanted]


def _normal(random: np.random.Generator, *shape: int) -> np.ndarray:
    return (random.normal(size=shape) + 1j * random.normal(size=shape)) / np.sqrt(2)


def write(path: Path = FILE, seed: int = SEED) -> None:
    """Make the start anew and keep it."""
    jax.config.update("jax_enable_x64", True)
    legs, points = by_monodromy(seed)
    pairs = lambda array: np.stack([array.real, array.imag], axis=-1).tolist()
    kept = {"made_by": f"python -m pk_jax.kinematics.modes.monodromy (seed {seed})"}
    kept |= {name: pairs(value) for name, value in legs._asdict().items()} | {"solutions": pairs(points)}
    path.write_text(json.dumps(kept, indent=1) + "\n")
    residual = np.abs(np.einsum("nij,ki,kj->kn", np.asarray(quadrics(legs)), points, points)).max()
    print(f"{path.name}: {len(points)} solutions, residual {residual:.1e}")


if __name__ == "__main__":
    write()
