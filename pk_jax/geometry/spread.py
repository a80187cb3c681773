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
