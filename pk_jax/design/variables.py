"""Design spaces: how a vector of design variables becomes a mechanism, and what it must satisfy."""

from __future__ import annotations

import abc
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR


class DesignSpace(abc.ABC):
    """The feasible designs of one mechanism family, R = half_base = 1.

    A design is a vector of `variables`. Optimizers move in a unit box instead, in which every
    constraint is a bound: `from_box` maps it onto the feasible set, `to_box` back.
    """

    name: str
    variables: tuple[str, ...]
    bounds: tuple[tuple[float, ...], tuple[float, ...]]  # least and greatest value of each variable
    rough: tuple[int, int] | None = None  # Gauss nodes that are enough to climb by, where all are dear

    @abc.abstractmethod
    def mechanism(self, vector: jax.Array) -> Mechanism:
        """The mechanism of a design, differentiable everywhere. vector (n,)"""

    @abc.abstractmethod
    def constraints(self, vector: jax.Array) -> dict[str, jax.Array]:
        """Slack of every constraint, >= 0 inside, under the name it has where it is active."""

    @abc.abstractmethod
    def from_box(self, box: jax.Array) -> jax.Array:
        """Unit box (n,) -> design vector (n,)."""

    @abc.abstractmethod
    def to_box(self, vector: jax.Array) -> jax.Array:
        """Design vector (n,) -> unit box (n,)."""

    def require(self, name: str, vector: Any) -> jax.Array:
        """`vector` as an array of feasible designs, (n,) or (batch, n); ValueError where it is not."""
        array = checks.real_array(name, vector)
        count = len(self.variables)
        if array.ndim not in (1, 2) or array.shape[-1] != count:
            wanted = ", ".join(self.variables)
            raise ValueError(
                f"{name} must have shape ({count},) or (batch, {count}) = ({wanted}), got {array.shape}"
            )
        checks.is_finite(name, array)
        roundoff = 1e3 * jnp.finfo(array.dtype).eps
        for row in np.atleast_2d(np.asarray(array)):
            for what, slack in self.constraints(row).items():
                if slack < -roundoff:
                    raise ValueError(
                        f"{name} lies outside the {self.name} designs, beyond {what}: {row.tolist()}"
                    )
        return array

    def __repr__(self) -> str:
        return f"design_space({self.name!r})"


class TwoRPRSpace(DesignSpace):
    """2-RPR: l_min in [1, 3], l_max = l_min + 2 (Nam, Lee and Park 2006, eq. 20)."""

    name = "2-rpr"
    variables = ("l_min",)
    bounds = ((1.0,), (3.0,))

    def mechanism(self, vector: jax.Array) -> TwoRPR:
        l_min = vector[0]
        return TwoRPR(half_base=jnp.ones_like(l_min), l_min=l_min, l_max=l_min + 2)

    def constraints(self, vector: jax.Array) -> dict[str, jax.Array]:
        return {"l_min = R": vector[0] - 1, "l_min = 3 R": 3 - vector[0]}

    def from_box(self, box: jax.Array) -> jax.Array:
        return 1 + 2 * box

    def to_box(self, vector: jax.Array) -> jax.Array:
        return (vector - 1) / 2


class TwoRRRSpace(DesignSpace):
    """2-RRR: (l_min, v) with l_min in [1, 5], la = 1 + v^2, lb = l_min + 2 - la (eqs. 20 and 22).

    Eq. (22), R <= la <= (l_min + R) / 2, is 0 <= v <= sqrt((l_min - 1) / 2). The indices are smooth
    in v up to la = R, where their derivative in la is infinite and where most optima lie.
    """

    name = "2-rrr"
    variables = ("l_min", "v")
    bounds = ((1.0, 0.0), (5.0, math.sqrt(2)))
    rough = (8, 8)  # indices to 1e-5, mostly 1e-7, at a ninth of the price

    def mechanism(self, vector: jax.Array) -> FiveBar:
        l_min, v = vector
        return FiveBar(
            half_base=jnp.ones_like(l_min),
            proximal=1 + v**2,
            distal=l_min + 1 - v**2,
            reach=jnp.stack([l_min, l_min + 2]),
            slack=v,
        )

    def constraints(self, vector: jax.Array) -> dict[str, jax.Array]:
        l_min, v = vector
        return {
            "l_min = R": l_min - 1,
            "v = 0": v,
            "lb - la = R": l_min - 1 - 2 * v**2,
            "l_min = 5 R": 5 - l_min,
        }

    def from_box(self, box: jax.Array) -> jax.Array:
        v = box[1] * math.sqrt(2)
        least = 1 + 2 * v**2  # lb - la = R
        return jnp.stack([least + box[0] * (5 - least), v])

    def to_box(self, vector: jax.Array) -> jax.Array:
        l_min, v = vector
        least = 1 + 2 * v**2
        share = safe.divide(l_min - least, 5 - least)
        return jnp.clip(jnp.stack([share, v / math.sqrt(2)]), 0, 1)


_SPACES = {space.name: space for space in (TwoRPRSpace(), TwoRRRSpace())}


def design_space(name: str) -> DesignSpace:
    """The design space of a mechanism family: "2-rpr" or "2-rrr"."""
    return _SPACES[checks.is_word("design space", name, _SPACES)]
