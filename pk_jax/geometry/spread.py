"""Points spread evenly over a box, or over all rotations, the same every time."""

from __future__ import annotations

import numpy as np


def evenly(count: int, dimension: int) -> np.ndarray:
    """The first points of an additive sequence in [0, 1)^dimension. -> (count, dimension)

    Its steps are powers of 1 / g, g the root of g^(d + 1) = g + 1: the golden ratio and its kin.
    """
    root = 2.0
    for _ in range(30):
        root = (1 + root) ** (1 / (dimension + 1))
    steps = root ** -np.arange(1.0, dimension + 1)
    return (0.5 + np.arange(count)[:, None] * steps) % 1


def quaternions(spread: np.ndarray) -> np.ndarray:
    """Points of [0, 1)^3, (k, 3), as unit quaternions of equal measure. -> (k, 4)

    Source: Shoemake 1992, Graphics Gems III, 124-132.
    """
    u, v, w = spread[:, 0], 2 * np.pi * spread[:, 1], 2 * np.pi * spread[:, 2]
    circles = np.stack([np.sin(v), np.cos(v), np.sin(w), np.cos(w)], axis=1)
    return circles * np.sqrt(np.stack([1 - u, 1 - u, u, u], axis=1))


def directions(spread: np.ndarray) -> np.ndarray:
    """Points of [0, 1)^(n - 1), (k, n - 1), as unit vectors of equal measure. -> (k, n)

    Circles on whose radii the measure is uniform, and for odd n one height (Archimedes for n = 3).
    """
    n = spread.shape[1] + 1
    pairs = n // 2
    angles, rest = 2 * np.pi * spread[:, :pairs], spread[:, pairs:]
    if n == 3:
        heights = 2 * rest[:, :1] - 1
        squared = 1 - heights**2
    elif n % 2 == 0:  # squared radii of the circles are uniform on a simplex
        ends = np.sort(rest, axis=1)
        squared = np.diff(ends, axis=1, prepend=0.0, append=1.0)
        heights = np.zeros((len(spread), 0))
    else:
        raise ValueError(f"directions are for 2, 3 or an even number of dimensions, got {n}")
    circles = np.sqrt(squared)[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([circles.reshape(len(spread), -1), heights], axis=1)
