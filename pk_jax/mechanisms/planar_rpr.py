"""Planar platforms on telescopic legs: 3-RPR, and more legs than needed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.geometry.circles import platforms_on_circles
from pk_jax.geometry.poses import place
from pk_jax.mechanisms import planar_platform
from pk_jax.mechanisms.base import Skeleton


class PlanarRPR(planar_platform.PlanarPlatform):
    """k leg lengths drive a platform (x, y, phi): the 3-RPR, the planar Stewart platform, and k > 3.

    Fields, in one unit of length: base (k, 2); platform (k, 2) in the platform frame; optional stroke
    (2,) or (k, 2), least and greatest length. Pose (x, y, phi) of the platform frame, joints the k
    lengths; there is one working mode.

    Source: Gosselin, Sefrioui and Richard 1992, Trans. ASME J. Mech. Des. 114(4), for the polynomial of
    degree 6 of its assembly modes.
    """

    stroke: jax.Array | None = None

    joints_are_distances = True

    def check_shapes(self) -> None:
        checks.has_shape("PlanarRPR.base", self.base, (None, 2))
        rows = self.base.shape[0]
        if rows < 3:
            raise ValueError(f"PlanarRPR.base must have three rows (legs) or more, got {rows}")
        checks.has_shape("PlanarRPR.platform", self.platform, (rows, 2))
        if self.stroke is not None and self.stroke.shape not in ((2,), (rows, 2)):
            raise ValueError(f"PlanarRPR.stroke must have shape (2,) or ({rows}, 2), got {self.stroke.shape}")

    def check_values(self) -> None:
        planar_platform.check_ends("PlanarRPR", self.base, self.platform)
        if self.stroke is not None:
            least, greatest = np.moveaxis(np.asarray(self.stroke), -1, 0)
            if not np.all((least > 0) & (least < greatest)):
                raise ValueError(
                    f"PlanarRPR.stroke must be 0 < least < greatest, got {np.asarray(self.stroke).tolist()}"
                )
        planar_platform.check_home("PlanarRPR", _best_home(self)[1], "stroke")

    def limits(self) -> tuple[jax.Array, jax.Array]:
        """Least and greatest length of each leg; without a stroke, where a home is sought. -> (k,), (k,)"""
        each = jnp.zeros(self.base.shape[0], self.base.dtype)
        if self.stroke is None:
            size = planar_platform.platform_radius(self.base) + self.length()
            return each + 0.1 * size, each + 2 * size
        return each + self.stroke[..., 0], each + self.stroke[..., 1]

    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """(|leg|^2 - l^2) / 2."""
        return (jnp.sum((points - self.base) ** 2, axis=-1) - joints**2) / 2

    def home(self) -> tuple[jax.Array, jax.Array]:
        """Over the middle of the base and unturned, unless that is far closer to a singularity."""
        pose = _best_home(self)[0]
        return pose, self.inverse(pose)

    def margins(self, pose: jax.Array, joints: jax.Array) -> dict[str, jax.Array]:
        """Strokes over length(), where they are given. Each (k,)."""
        if self.stroke is None:
            return {}
        least, greatest = self.limits()
        return {
            "stroke_min": (joints - least) / self.length(),
            "stroke_max": (greatest - joints) / self.length(),
        }

    def skeleton(self, pose: jax.Array, joints: jax.Array) -> Skeleton:
        k = self.base.shape[0]
        legs = tuple((i, i + k) for i in range(k))
        rim = tuple((k + i, k + (i + 1) % k) for i in range(k))
        points = jnp.concatenate([self.base, place(pose, self.platform)])
        return Skeleton(points, legs + rim, ground=tuple(range(k)))

    def inverse(self, pose: jax.Array, branch: jax.Array | None = None, *, free=None) -> jax.Array:
        """Leg lengths of a pose. -> (k,)"""
        return safe.norm(place(pose, self.platform) - self.base)

    def forward(self, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Every assembly mode; of redundant legs those of the first three that close all. -> (6, 3), (6,)"""
        poses, is_real = platforms_on_circles(self.platform[:3], self.base[:3], joints[:3])
        return planar_platform.closing_all(self, poses, is_real, joints)


@jax.jit
def _best_home(mech: PlanarRPR) -> tuple[jax.Array, jax.Array]:
    """The home pose, and how far it is from a type II singularity."""
    mech = lax.stop_gradient(mech)
    nearest, farthest = mech.limits()

    def clearance(pose):
        joints = mech.inverse(pose)
        turning = planar_platform.least_sigma(mech.linearize(pose, joints)[1], mech.length())
        return jnp.where(jnp.all((joints >= nearest) & (joints <= farthest)), turning, jnp.nan)

    return planar_platform.best_home(
        mech.base, mech.platform, jnp.mean(mech.base, axis=0), (nearest, farthest), clearance
    )
