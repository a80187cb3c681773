"""One row or many: the shape of the input decides, and every public solver decides alike."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry.poses import Turning
from pk_jax.mechanisms.base import Mechanism


def home_shapes(mech: Mechanism) -> tuple[Any, jax.ShapeDtypeStruct]:
    """Shapes and dtypes of a pose and of the joints."""
    leaves, tree = jax.tree.flatten(mech)
    return _home_shapes(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves))


@lru_cache(maxsize=256)
def _home_shapes(tree: Any, leaves: tuple) -> tuple[Any, jax.ShapeDtypeStruct]:
    mech = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    return jax.eval_shape(lambda mech: mech.home(), mech)


def equations(mech: Mechanism) -> int:
    """c, the number of closure equations."""
    return jax.eval_shape(lambda mech: mech.residual(*mech.home()), mech).shape[0]


def rows_of(name: str, value: Any, one: Any, *, numpy: bool = False) -> tuple[Any, bool]:
    """`value` with the leaves of `one`, or with one leading batch axis more; and whether it has that axis."""
    if isinstance(one, Turning):
        if type(value) is not type(one):
            raise ValueError(f"{name} must be a pk_jax.{type(one).__name__}, got {type(value).__name__}")
        parts = [field.name for field in dataclasses.fields(one)]
        rows = [
            rows_of(f"{name}.{part}", getattr(value, part), getattr(one, part), numpy=numpy) for part in parts
        ]
        return jax.tree.unflatten(jax.tree.structure(one), [row for row, _ in rows]), rows[0][1]
    if isinstance(value, Turning):
        raise ValueError(f"{name} must be an array of shape {one.shape}, got an {type(value).__name__}")
    array = (checks.real_numpy if numpy else checks.real_array)(name, value)
    array = array if array.dtype == one.dtype else array.astype(one.dtype)
    if array.ndim == one.ndim + 1:
        checks.has_shape(name, array, (None, *one.shape))
    elif array.ndim == one.ndim:
        checks.has_shape(name, array, one.shape)
    else:
        raise ValueError(f"{name} must have shape {one.shape} or (batch, ...), got {array.shape}")
    return array, array.ndim > one.ndim


def configurations(mech: Mechanism, pose: Any, joints: Any) -> tuple[tuple[Any, Any], tuple[bool, bool]]:
    """Pose and joints as arrays, one or many, and which of them are batched."""
    pose_like, joints_like = home_shapes(mech)
    pose, poses = rows_of("pose", pose, pose_like)
    joints, many = rows_of("joints", joints, joints_like)
    return (pose, joints), (poses, many)


def over_rows(function: Callable, arguments: tuple, are_batched: tuple[bool, ...]) -> Any:
    """`function(*arguments)`, vmapped over those arguments that are batched."""
    if not any(are_batched):
        return function(*arguments)
    same_size(arguments, are_batched)
    return jax.vmap(function, in_axes=tuple(0 if batched else None for batched in are_batched))(*arguments)


def same_size(arguments: tuple, are_batched: tuple[bool, ...]) -> int:
    """The number of rows of all batched arguments; ValueError where they differ."""
    sizes = {
        jax.tree.leaves(a)[0].shape[0] for a, batched in zip(arguments, are_batched, strict=True) if batched
    }
    if len(sizes) != 1:
        raise ValueError(f"batched arguments must have the same number of rows, got {sorted(sizes)}")
    return sizes.pop()


def all_finite(*trees: Any) -> jax.Array:
    """() True where no entry is NaN or infinite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(trees)]))


def is_possible(mech: Mechanism, joints: jax.Array) -> jax.Array:
    """() False for NaN, infinity, and distances that are not positive."""
    positive = jnp.all(joints > 0) if mech.joints_are_distances else True
    return all_finite(joints) & positive


def where(condition: jax.Array, chosen: Any, other: Any) -> Any:
    """`jnp.where` for one row's pose of any kind; `other` may be one number."""
    if isinstance(other, float | int):
        return jax.tree.map(lambda leaf: jnp.where(condition, leaf, other), chosen)
    return jax.tree.map(lambda *leaves: jnp.where(condition, *leaves), chosen, other)


def without_derivatives(function: Callable) -> Callable:
    """`function` as a constant to differentiation, of whatever order and mode, and whatever it is made of."""

    @jax.custom_jvp
    def constant(*arguments):
        return function(*arguments)

    @constant.defjvp
    def _(arguments, _):
        found = constant(*arguments)
        return found, jax.tree.map(_zero_tangent, found)

    return constant


def _zero_tangent(leaf: jax.Array) -> Any:
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)
