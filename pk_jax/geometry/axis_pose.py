"""Poses of a platform that turns about a fixed point and slides along its own axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations
from pk_jax.geometry.se3 import check_rotations, poses_of, register


@dataclasses.dataclass(frozen=True)
class AxisPose:
    """Slide s () and rotation matrix (3, 3) of a platform frame in the base frame, or a batch of them.

    The platform turns about the origin of the base frame and slides along its own z axis, n = rotation e3:
    p = rotation @ (b + s e3) carries a platform point b into the base frame. Four degrees of freedom; the
    tangent (s', w), (4,), moves it to (s + s', cayley(w) rotation), w in base axes. ValueError
    where a finite rotation is not orthonormal to 1e-5 or is a reflection.
    """

    s: jax.Array
    rotation: jax.Array

    def __post_init__(self) -> None:
        for name in ("s", "rotation"):
            object.__setattr__(self, name, checks.real_array(f"AxisPose.{name}", getattr(self, name)))
        batch = self.s.shape
        checks.has_shape("AxisPose.s", self.s, (None,) * min(len(batch), 1))
        checks.has_shape("AxisPose.rotation", self.rotation, (*batch, 3, 3))
        if checks.is_concrete(self):
            check_rotations("AxisPose.rotation", np.asarray(self.rotation))

    @classmethod
    def from_angles(cls, s: Any, roll: Any = 0.0, pitch: Any = 0.0, yaw: Any = 0.0) -> AxisPose:
        """From slides (...) and angles (...) in rad that broadcast: Rz(yaw) Ry(pitch) Rx(roll)."""
        given = {"s": s, "roll": roll, "pitch": pitch, "yaw": yaw}
        values = [checks.real_array(name, value) for name, value in given.items()]
        s, *angles = jnp.broadcast_arrays(*(value.astype(jnp.result_type(*values)) for value in values))
        return cls(
            s, jnp.vectorize(rotations.from_angles, signature="(3)->(3,3)")(jnp.stack(angles, axis=-1))
        )

    def angles(self) -> jax.Array:
        """Roll, pitch and yaw, |pitch| <= pi/2. -> (..., 3) rad"""
        return jnp.vectorize(rotations.to_angles, signature="(3,3)->(3)")(self.rotation)

    def __getitem__(self, row: Any) -> AxisPose:
        """Rows of a batch."""
        return jax.tree.map(lambda leaf: leaf[row], self)

    def __iter__(self) -> Iterator[AxisPose]:
        """The poses of a batch."""
        return poses_of(self)


register(AxisPose)
