"""The 2-RPR mechanism: two telescopic legs that meet in one point (Nam, Lee and Park 2006)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.mechanisms.base import LegMechanism, Skeleton


class TwoRPR(LegMechanism):
    """Two lengths drive a point (x, y). Leg 1 stands at (+half_base, 0), leg 2 at (-half_base, 0).

    Fields: half_base R > 0, l_min > 0 and l_max > l_min, the stroke of both legs, all () in one unit of
    length. The legs must be able to meet: l_max > half_base. Pose (x, y), joints (l1, l2).
    Source: Nam, Lee and Park 2006, Fig. 1(a), eqs. (1)-(2), (9)-(12), (18)-(20).
    """

    half_base: jax.Array
    l_min: jax.Array
    l_max: jax.Array

    joint_units = (1, 1)
    joints_are_distances = True

    def check_shapes(self) -> None:
        for name in ("half_base", "l_min", "l_max"):
            checks.has_shape(f"TwoRPR.{name}", getattr(self, name), ())

    def check_values(self) -> None:
        checks.is_positive("TwoRPR.half_base", self.half_base)
        checks.is_positive("TwoRPR.l_min", self.l_min)
        if not self.l_max > self.l_min:
            raise ValueError(f"TwoRPR.l_max must exceed l_min = {self.l_min:.6g}, got {self.l_max:.6g}")
        if not self.l_max > self.half_base:
            raise ValueError(
                f"TwoRPR.l_max must exceed half_base = {self.half_base:.6g} (the legs must meet), "
                f"got {self.l_max:.6g}"
            )

    def base(self) -> jax.Array:
        """Where the legs stand. -> (2, 2)"""
        zero = jnp.zeros_like(self.half_base)
        return jnp.stack([jnp.stack([self.half_base, zero]), jnp.stack([-self.half_base, zero])])

    def attachments(self) -> jax.Array:
        return jnp.zeros((2, 2), self.half_base.dtype)

    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """(|leg|^2 - l^2) / 2, eq. (1)."""
        return (jnp.sum((points - self.base()) ** 2, axis=-1) - joints**2) / 2

    def home(self) -> tuple[jax.Array, jax.Array]:
        length = (jnp.maximum(self.l_min, self.half_base) + self.l_max) / 2
        height = safe.sqrt((length - self.half_base) * (length + self.half_base))
        pose = lax.stop_gradient(jnp.stack([jnp.zeros_like(height), height]))
        return pose, self.inverse(pose)

    def length(self) -> jax.Array:
        return self.half_base

    def margins(self, pose: jax.Array, joints: jax.Array) -> dict[str, jax.Array]:
        return {
            "stroke_min": (joints - self.l_min) / self.length(),
            "stroke_max": (self.l_max - joints) / self.length(),
            "side": pose[1] / self.length(),
        }

    def skeleton(self, pose: jax.Array, joints: jax.Array) -> Skeleton:
        return Skeleton(jnp.concatenate([self.base(), pose[None]]), ((0, 2), (1, 2)), ground=(0, 1))

    def inverse(self, pose: jax.Array, branch: jax.Array | None = None, *, free=None) -> jax.Array:
        """Leg lengths of a pose, eq. (2); there is one working mode, lengths being positive. -> (2,)"""
        return safe.norm(pose - self.base())

    def forward(self, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Both assembly modes, y > 0 first, eqs. (18)-(19). -> poses (2, 2), is_real (2,)

        Real where the triangle with sides l1, l2 and 2 R closes; NaN elsewhere.
        """
        l1, l2 = joints
        base = 2 * self.half_base
        total, difference = l1 + l2, l1 - l2
        squared = (total - base) * (total + base) * (base - difference) * (base + difference)
        is_real = (squared >= 0) & (total >= base)
        x = -difference * total / (2 * base)
        y = safe.sqrt(squared) / (2 * base)
        poses = jnp.stack([jnp.stack([x, y]), jnp.stack([x, -y])])
        return jnp.where(is_real, poses, jnp.nan), jnp.broadcast_to(is_real, (2,))
