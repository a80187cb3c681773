"""A design problem: variables with bounds, the mechanism they make, what it is judged by and must satisfy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.mechanisms.base import Mechanism

LARGEST = 1e30  # bound: squares of it are still numbers


class DesignProblem:
    """Maximize the least entry of `objective` over the variables, every constraint being >= 0.

    mechanism:    dict of the variables, name -> array -> `Mechanism`, traceable
    variables:    name -> (lower, upper), numbers or arrays of one shape, lower < upper, finite
    objective:    `Mechanism` -> () or (k,); of several entries the least is maximized
    constraints:  `Mechanism` -> dict, name -> array of slacks, >= 0 inside; dimensionless and of order
                  one, like margins. None: only the bounds

    `entries` names each of the n scalar variables ("proximal", "base[0,1]"), `constraint_names` each of
    the p slacks ("reach_min[3]"), sorted by their names in the dict. Where a design has no value, give
    NaN: the optimizer takes it as "not there". Hashed by identity. ValueError for what is no such problem.
    """

    def __init__(
        self,
        mechanism: Callable[[dict[str, jax.Array]], Mechanism],
        variables: Mapping[str, Any],
        objective: Callable[[Mechanism], jax.Array],
        constraints: Callable[[Mechanism], dict[str, jax.Array]] | None = None,
        *,
        name: str = "design",
    ) -> None:
        for what, function in (("mechanism", mechanism), ("objective", objective)):
            if not callable(function):
                raise ValueError(f"{what} must be a function, got {type(function).__name__}")
        checks.is_function("constraints", constraints)
        if not isinstance(name, str):
            raise ValueError(f"name must be a string, got {checks.shown(name)}")
        self.name = name
        self._mechanism, self._objective, self._constraints = mechanism, objective, constraints
        bounds = _bounds(variables)
        self.shapes = {variable: lower.shape for variable, (lower, _) in bounds.items()}
        self.lower = np.concatenate([lower.ravel() for lower, _ in bounds.values()])
        self.upper = np.concatenate([upper.ravel() for _, upper in bounds.values()])
        self.entries = _entry_names(self.shapes)
        middle = jax.ShapeDtypeStruct(self.lower.shape, jnp.zeros(()).dtype)
        self.objective_count, self.constraint_names = self._look(middle)

    def _look(self, vector: jax.ShapeDtypeStruct) -> tuple[int, tuple[str, ...]]:
        """Number of objective entries, and the names of the slacks. Nothing is computed."""
        mechanism = jax.eval_shape(self.design, vector)
        if not isinstance(mechanism, Mechanism):
            raise ValueError(f"mechanism must return a Mechanism, got {type(mechanism).__name__}")
        objective = jax.eval_shape(self._objective, mechanism)
        _require_real("objective", objective)
        if len(objective.shape) > 1 or objective.shape == (0,):
            raise ValueError(f"objective must return a number or an array (k,), got shape {objective.shape}")
        slacks = {} if self._constraints is None else jax.eval_shape(self._constraints, mechanism)
        if not isinstance(slacks, dict) or not all(isinstance(name, str) for name in slacks):
            raise ValueError(f"constraints must return a dict of arrays, got {type(slacks).__name__}")
        for name, slack in slacks.items():
            _require_real(f"constraints[{name!r}]", slack)
        shapes = {name: slacks[name].shape for name in sorted(slacks)}
        return math.prod(objective.shape), _entry_names(shapes)

    def design(self, vector: jax.Array) -> Mechanism:
        """The mechanism of a vector (n,); traceable."""
        vector = checks.real_array("vector", vector)
        checks.has_shape("vector", vector, self.lower.shape)
        return self._mechanism(self._split(vector))

    def variables_of(self, vector: Any) -> dict[str, np.ndarray]:
        """A vector (n,) as the variables by name."""
        vector = checks.real_numpy("vector", vector)
        checks.has_shape("vector", vector, self.lower.shape)
        return self._split(vector)

    def vector(self, box: jax.Array) -> jax.Array:
        """Unit box (..., n) -> vector (..., n); affine, and exactly the bounds at 0 and 1."""
        lower, upper = self._bounds_as(box)
        return jnp.where(box < 0.5, lower + box * (upper - lower), upper - (1 - box) * (upper - lower))

    def box(self, vector: jax.Array) -> jax.Array:
        """Vector (..., n) -> unit box (..., n)."""
        lower, upper = self._bounds_as(vector)
        return (vector - lower) / (upper - lower)

    def measure(self, vector: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Objective (k,) and slacks (p,) of a vector (n,); traceable."""
        mechanism = self.design(vector)
        objective = jnp.ravel(jnp.asarray(self._objective(mechanism)))
        slacks = {} if self._constraints is None else self._constraints(mechanism)
        parts = [jnp.ravel(slacks[name]) for name in sorted(slacks)]
        return objective, jnp.concatenate(parts) if parts else jnp.zeros(0, objective.dtype)

    def _bounds_as(self, like: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = jnp.asarray(like).dtype
        dtype = found if jnp.issubdtype(found, jnp.floating) else jnp.zeros(()).dtype
        return jnp.asarray(self.lower, dtype), jnp.asarray(self.upper, dtype)

    def _split(self, vector: Any) -> dict[str, Any]:
        ends = np.cumsum([math.prod(shape) for shape in self.shapes.values()])
        starts = ends - [math.prod(shape) for shape in self.shapes.values()]
        return {
            name: vector[start:end].reshape(shape)
            for (name, shape), start, end in zip(self.shapes.items(), starts, ends, strict=True)
        }

    def __repr__(self) -> str:
        return f"DesignProblem({self.name!r}: {', '.join(self.entries)})"


def _bounds(variables: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Lower and upper bounds by name; ValueError unless lower < upper, finite and of one shape."""
    if not isinstance(variables, Mapping) or not variables:
        raise ValueError(f"variables must be a dict, name -> (lower, upper), got {checks.shown(variables)}")
    found = {}
    for name, pair in variables.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"variables must be named by strings, got {checks.shown(name)}")
        field = f"variables[{name!r}]"
        if not isinstance(pair, tuple | list | np.ndarray) or len(pair) != 2:
            raise ValueError(f"{field} must be (lower, upper), got {checks.shown(pair)}")
        lower, upper = (checks.real_numpy(field, bound).astype(float) for bound in pair)
        if lower.shape != upper.shape or lower.size == 0:
            raise ValueError(
                f"{field} must have bounds of one shape, not empty, got {lower.shape} and {upper.shape}"
            )
        for bound in (lower, upper):
            checks.is_finite(field, bound)
        if not np.all(lower < upper) or np.max(np.abs([lower, upper])) > LARGEST:
            raise ValueError(
                f"{field} must have lower < upper, both within +-{LARGEST:g}, "
                f"got {lower.tolist()}, {upper.tolist()}"
            )
        found[name] = lower, upper
    return found


def _entry_names(shapes: dict[str, tuple[int, ...]]) -> tuple[str, ...]:
    """Names of all scalars of arrays: "proximal", "base[0,1]"."""
    return tuple(
        f"{name}[{','.join(map(str, index))}]" if index else name
        for name, shape in shapes.items()
        for index in np.ndindex(shape)
    )


def _require_real(name: str, value: Any) -> None:
    if not hasattr(value, "dtype") or not jnp.issubdtype(value.dtype, jnp.floating):
        got = getattr(value, "dtype", type(value).__name__)
        raise ValueError(f"{name} must be real numbers, got {got}")
