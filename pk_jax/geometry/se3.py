"""Poses of a platform in space."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations

ORTHONORMAL_TO = 1e-5  # entries of R R^T - I: what a rotation printed with six digits keeps


@dataclasses.dataclass(frozen=True)
class SE3:
    """Position (3,) and rotation matrix (3, 3) of a platform frame in the base frame, or a batch of them.

    p = translation + rotation @ b carries a platform point b into the base frame. The tangent
    (v, w), (6,), moves it to (translation + v, cayley(w) rotation), w in base axes. ValueError
    where a finite rotation is not orthonormal to 1e-5 or is a reflection.
    """

    translation: jax.Array
    rotation: jax.Array

    def __post_init__(self) -> None:
        for name in ("translation", "rotation"):
            object.__setattr__(self, name, checks.real_array(f"SE3.{name}", getattr(self, name)))
        batch = self.translation.shape[:-1]
        checks.has_shape("SE3.translation", self.translation, (*[None] * min(len(batch), 1), 3))
        checks.has_shape("SE3.rotation", self.rotation, (*batch, 3, 3))
        if checks.is_concrete(self):
            check_rotations("SE3.rotation", np.asarray(self.rotation))

    @classmethod
    def from_quaternion(cls, translation: Any, quaternion: Any) -> SE3:
        """From positions (..., 3) and quaternions (..., 4) in the order (w, x, y, z), of any length but 0."""
        q = checks.real_array("quaternion", quaternion)
        checks.has_shape("quaternion", q, (*[None] * (q.ndim - 1), 4))
        if checks.is_concrete(q) and not np.all(np.any(np.asarray(q) != 0, axis=-1)):
            raise ValueError("quaternion must not be zero")
        return cls(translation, jnp.vectorize(rotations.from_quaternion, signature="(4)->(3,3)")(q))

    @classmethod
    def from_rotation_vector(cls, translation: Any, vector: Any) -> SE3:
        """From positions (..., 3) and rotation vectors (..., 3): axis times angle in radians."""
        v = checks.real_array("rotation vector", vector)
        checks.has_shape("rotation vector", v, (*[None] * (v.ndim - 1), 3))
        return cls(translation, jnp.vectorize(rotations.from_rotation_vector, signature="(3)->(3,3)")(v))

    def quaternion(self) -> jax.Array:
        """Unit quaternion (w, x, y, z), its largest entry positive. -> (..., 4)"""
        return jnp.vectorize(rotations.to_quaternion, signature="(3,3)->(4)")(self.rotation)

    def rotation_vector(self) -> jax.Array:
        """Axis times angle, at most pi long. -> (..., 3) rad"""
        return jnp.vectorize(rotations.to_rotation_vector, signature="(3,3)->(3)")(self.rotation)

    def __getitem__(self, row: Any) -> SE3:
        """Rows of a batch."""
        return jax.tree.map(lambda leaf: leaf[row], self)

    def __iter__(self) -> Iterator[SE3]:
        """The poses of a batch."""
        return poses_of(self)


def register(cls: type) -> None:
    """Make a pose class a pytree. JAX rebuilds it with tracers, and only callers meet __post_init__."""
    names = tuple(field.name for field in dataclasses.fields(cls))
    keys = tuple(map(jax.tree_util.GetAttrKey, names))

    def flatten(pose):
        return tuple(getattr(pose, name) for name in names), None

    def flatten_with_keys(pose):
        return tuple(zip(keys, flatten(pose)[0], strict=True)), None

    def unflatten(_, leaves):
        pose = object.__new__(cls)
        for name, leaf in zip(names, leaves, strict=True):
            object.__setattr__(pose, name, leaf)
        return pose

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def poses_of(batch: Any) -> Iterator[Any]:
    """One pose after the other; without it `for` would ask for rows without end, which JAX has."""
    if batch.rotation.ndim != 3:
        raise TypeError(f"one {type(batch).__name__} is no batch")
    return (batch[row] for row in range(len(batch.rotation)))


register(SE3)


def check_rotations(name: str, rotation: np.ndarray) -> None:
    """ValueError for the first finite rotation that is none; NaN rows are the solvers' business."""
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    finite = np.isfinite(rotation).all(axis=(-2, -1))
    for wrong, what in (
        (
            finite & ~(off <= ORTHONORMAL_TO),
            "must be orthonormal: rotation @ rotation.T is off the identity by",
        ),
        (
            finite & (np.linalg.det(np.where(finite[..., None, None], rotation, np.eye(3))) < 0),
            "is a reflection:",
        ),
    ):
        if np.any(wrong):
            row = tuple(int(i) for i in np.argwhere(np.atleast_1d(wrong))[0]) if wrong.ndim else ()
            where = f"[{row[0]}]" if row else ""
            value = f"{off[row]:.3g}" if "orthonormal" in what else "det = -1"
            raise ValueError(f"{name}{where} {what} {value}")
