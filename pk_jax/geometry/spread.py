"""Points spread evenly over a box, the same every time."""

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
