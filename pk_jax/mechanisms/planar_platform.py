"""What platforms with three freedoms in the plane share: their home, their checks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.geometry.planar import rotation
from pk_jax.geometry.poses import place, place_jacobian
from pk_jax.mechanisms.base import LegMechanism

SINGULAR_BELOW = 1e-6  # clearance below which a mechanism is of no use
_TURNS = np.deg2rad([15.0 * (-1) ** k * ((k + 1) // 2) for k in range(24)])  # 0, -15, 15, -30, ...
_ASIDE = np.array([[0.0, 0.0], [0.5, 0.3], [-0.4, 0.5], [0.1, -0.6]])  # of the length


class PlanarPlatform(LegMechanism):
    """A platform (x, y, phi) held at `platform` (k, 2), in its frame, by legs that stand at `base` (k, 2)."""

    base: jax.Array
    platform: jax.Array

    pose_units = (1, 1, 0)

    def attachments(self) -> jax.Array:
        return self.platform

    def length(self) -> jax.Array:
        """Root mean square distance of the platform joints from their centroid."""
        return platform_radius(self.platform)


class ArmedPlatform(PlanarPlatform):
    """Its legs are arms of two links, `proximal` and `distal`, () or (k,)."""

    proximal: jax.Array
    distal: jax.Array

    def limits(self) -> tuple[jax.Array, jax.Array]:
        """Least and greatest distance from the base joint to the platform joint of each arm. -> (k,), (k,)"""
        each = jnp.zeros(self.base.shape[0], self.base.dtype)
        return each + jnp.abs(self.distal - self.proximal), each + self.proximal + self.distal

    def links(self) -> dict[str, jax.Array]:
        return {"proximal": self.proximal, "distal": self.distal}

    def margins(self, pose: jax.Array, joints: jax.Array) -> dict[str, jax.Array]:
        """How far the arms are from folded and from stretched, over length(). Each (k,)."""
        nearest, farthest = self.limits()
        distance = safe.norm(place(pose, self.platform) - self.base)
        return {
            "reach_min": (distance - nearest) / self.length(),
            "reach_max": (farthest - distance) / self.length(),
        }


def best_home(
    base: jax.Array,
    platform: jax.Array,
    middle: jax.Array,
    limits: tuple[jax.Array, jax.Array],
    clearance: Callable[[jax.Array], jax.Array],
) -> tuple[jax.Array, jax.Array]:
    """The pose of a fixed set with the greatest clearance, and that clearance (NaN: none is in reach).

    base, platform:  (k, 2) the ends of the legs
    middle:          (2,) where the platform's centre is best
    limits:          (k,), (k,) least and greatest distance of the ends; their root mean square is best
    clearance:       pose (3,) -> (), NaN where out of reach

    The first pose, at `middle` and unturned, unless another is far better.
    """
    nearest, farthest = limits
    best = jnp.sqrt((nearest**2 + farthest**2) / 2)
    slack = 0.05 * (farthest - nearest)
    radius = platform_radius(platform)
    centre = jnp.mean(platform, axis=0)
    turns = jnp.repeat(jnp.asarray(_TURNS, base.dtype), len(_ASIDE))
    aside = jnp.tile(jnp.asarray(_ASIDE, base.dtype), (len(_TURNS), 1)) * radius
    over = lambda turn, aside: jnp.append(middle + aside - rotation(turn) @ centre, turn)
    starts = jax.vmap(over)(turns, aside)
    units = jnp.stack([1, 1, 1 / radius])

    def toward(step, pose):
        """One step of least squares: first to the best distances, then just to what is in reach."""
        legs = place(pose, platform) - base
        distance = safe.norm(legs)
        wanted = jnp.where(step < 8, best, jnp.clip(distance, nearest + slack, farthest - slack))
        rates = jnp.einsum("kd,kdn->kn", legs, place_jacobian(pose, platform))
        rates = rates / jnp.maximum(distance, 1e-9 * radius)[:, None] * units
        normal = rates.T @ rates + 1e-3 * jnp.eye(3, dtype=pose.dtype)
        return pose - units * (_adjugate(normal) @ (rates.T @ (distance - wanted))) / _det(normal)

    reached = lax.fori_loop(0, 24, lambda k, poses: jax.vmap(lambda x: toward(k, x))(poses), starts)
    poses = jnp.concatenate([starts, reached])
    clearances = jax.vmap(clearance)(poses)
    clearances = jnp.where(jnp.isfinite(clearances), clearances, -1)
    chosen = jnp.argmax(clearances > jnp.max(clearances) / 2)
    found = clearances[chosen]
    return poses[chosen], jnp.where(found >= 0, found, jnp.nan)


def least_sigma(rows: jax.Array, length: jax.Array) -> jax.Array:
    """1 / |A^+|_F of rows (c, 3) of A, turns over length, each row of unit norm. -> ()"""
    rows = rows * jnp.stack([1, 1, 1 / length])
    rows = rows / jnp.maximum(safe.norm(rows), jnp.finfo(rows.dtype).tiny)[:, None]
    normal = rows.T @ rows
    return safe.sqrt(_det(normal) / jnp.trace(_adjugate(normal)))


def _adjugate(matrix: jax.Array) -> jax.Array:
    """det(A) A^-1 of a symmetric matrix (3, 3)."""
    return jnp.cross(jnp.roll(matrix, -1, axis=0), jnp.roll(matrix, -2, axis=0))


def _det(matrix: jax.Array) -> jax.Array:
    return jnp.dot(matrix[0], jnp.cross(matrix[1], matrix[2]))


def platform_radius(platform: jax.Array) -> jax.Array:
    """Root mean square distance of the platform's points from their centroid. -> ()"""
    return jnp.sqrt(jnp.mean(jnp.sum((platform - jnp.mean(platform, axis=0)) ** 2, axis=1)))


def closing_all(
    mech: LegMechanism, poses: jax.Array, is_real: jax.Array, joints: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The modes of the first three legs that close the others, too, to 1e-6. -> (6, 3), (6,)"""
    tried = jnp.where(is_real[:, None], poses, 0)
    off = jax.vmap(lambda pose: jnp.abs(mech.residual(pose, joints)[3:]))(tried)
    reach = jnp.max(jnp.abs(mech.base - mech.base[0])) + platform_radius(mech.platform)
    is_real = is_real & jnp.all(off <= 1e-6 * reach**2, axis=1)
    order = jnp.argsort(~is_real, stable=True)
    return jnp.where(is_real[order, None], poses[order], jnp.nan), is_real[order]


def check_ends(name: str, base: Any, platform: Any) -> None:
    """ValueError where two base joints coincide, or all platform joints do."""
    base, platform = np.asarray(base), np.asarray(platform)
    size = max(np.max(np.abs(base - base[0])), np.max(np.abs(platform - platform[0])))
    for i in range(len(base)):
        for j in range(i):
            if np.allclose(base[i], base[j], rtol=0, atol=1e-9 * size):
                raise ValueError(
                    f"{name}.base must hold distinct joints, got {base[i].tolist()} in rows {j} and {i}"
                )
    if np.allclose(platform, platform[0], rtol=0, atol=1e-9 * size):
        raise ValueError(f"{name}.platform must not have all joints in one point, got {platform[0].tolist()}")


def check_home(name: str, clearance: Any, links: str) -> None:
    """ValueError where no home was found: nothing closes, or all that closes is singular."""
    clearance = float(clearance)
    if np.isnan(clearance):
        raise ValueError(f"{name}.{links} cannot close all legs in any pose that was tried")
    if not clearance > SINGULAR_BELOW:
        raise ValueError(
            f"{name} is singular in every pose that was tried: its legs are dependent, got a least singular "
            f"value of {clearance:.2g}"
        )


def check_lengths(name: str, values: dict[str, Any], rows: int) -> None:
    """Shapes () or (rows,), one length for all or one each."""
    for field, value in values.items():
        if value.shape not in ((), (rows,)):
            raise ValueError(f"{name}.{field} must have shape () or ({rows},), got {value.shape}")


def check_positive(name: str, values: dict[str, Any]) -> None:
    for field, value in values.items():
        checks.is_positive(f"{name}.{field}", value)
