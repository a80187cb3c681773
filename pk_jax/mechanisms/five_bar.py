"""The five-bar: two driven arms that meet in one point. 2-RRR of Nam, Lee and Park 2006."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.geometry.planar import arm_angles, cross, direction, quarter_turn
from pk_jax.mechanisms.base import LegMechanism, Skeleton

ELBOWS_OUT = (1.0, -1.0)  # eq. (6): "+" for leg 1, "-" for leg 2


class FiveBar(LegMechanism):
    """Two angles drive a point (x, y). Leg 1 stands at (+half_base, 0), leg 2 at (-half_base, 0).

    Fields, all > 0 and in one unit of length: half_base R () (0: a coaxial five-bar), proximal la () the
    driven links, distal lb () the links that meet, reach (2,) the least and greatest distance from a base
    joint to the end point that may be used (default: |lb - la| and la + lb, all that the links reach).
    Pose (x, y), joints (phi1, phi2), absolute angles of the driven links.

    It is also the 5-link of the screw analysis of planar parallel robots, which counts the leg at
    -half_base first: its screws are the lines through the distal links (eqs. 20-24 there).

    Working mode: branch_i = sign(sin psi_i), psi_i the angle from the proximal to the distal link
    of leg i; the default (+1, -1) has both elbows outside.

    `slack` is sqrt(la / R - 1), the coordinate in which the workspace indices are smooth at la = R
    (in la itself their derivative is infinite there). Design spaces pass it so that gradients
    survive that boundary; everybody else leaves it out.

    Source: Nam, Lee and Park 2006, Fig. 1(b), eqs. (3)-(6), (13)-(16), (21)-(22). Two misprints of
    the paper: the degenerate branch of eq. (6) is phi = 2 arctan(-(gamma + alpha) / (2 beta)), and
    the text after eq. (16) interchanges its two singularities: X1 Y2 - X2 Y1 = 0 is where the distal
    links are parallel, X sin(phi) - Y cos(phi) = 0 where a leg is stretched or folded.
    """

    half_base: jax.Array
    proximal: jax.Array
    distal: jax.Array
    reach: jax.Array | None = None
    slack: jax.Array | None = None

    joint_units = (0, 0)

    def check_shapes(self) -> None:
        for name in ("half_base", "proximal", "distal"):
            checks.has_shape(f"FiveBar.{name}", getattr(self, name), ())
        if self.reach is not None:
            checks.has_shape("FiveBar.reach", self.reach, (2,))
        if self.slack is not None:
            checks.has_shape("FiveBar.slack", self.slack, ())

    def check_values(self) -> None:
        for name in ("proximal", "distal"):
            checks.is_positive(f"FiveBar.{name}", getattr(self, name))
        if not self.half_base >= 0:
            raise ValueError(f"FiveBar.half_base must be positive, or 0 (coaxial), got {self.half_base:.6g}")
        nearest, farthest = self.limits()
        roundoff = 1e-6 * (self.proximal + self.distal)
        folded, stretched = abs(self.distal - self.proximal), self.proximal + self.distal
        if not (folded - roundoff <= nearest < farthest <= stretched + roundoff):
            raise ValueError(
                "FiveBar.reach must increase within [|distal - proximal|, distal + proximal] = "
                f"[{folded:.6g}, {stretched:.6g}], got [{nearest:.6g}, {farthest:.6g}]"
            )
        if not farthest > self.half_base:
            raise ValueError(
                f"FiveBar.reach must exceed half_base = {self.half_base:.6g} (the legs must meet), "
                f"got {farthest:.6g}"
            )
        if self.slack is not None and not abs(1 + self.slack**2 - self.proximal / self.half_base) < 1e-6:
            raise ValueError(
                "FiveBar.slack must be sqrt(proximal / half_base - 1) or left out, "
                f"got {self.slack:.6g} with proximal / half_base = {self.proximal / self.half_base:.6g}"
            )

    def default_branch(self) -> jax.Array:
        return jnp.asarray(ELBOWS_OUT, self.half_base.dtype)

    def base(self) -> jax.Array:
        """Where the legs stand. -> (2, 2)"""
        zero = jnp.zeros_like(self.half_base)
        return jnp.stack([jnp.stack([self.half_base, zero]), jnp.stack([-self.half_base, zero])])

    def limits(self) -> tuple[jax.Array, jax.Array]:
        """Least and greatest usable distance from a base joint to the end point. -> (), ()"""
        if self.reach is not None:
            return self.reach[0], self.reach[1]
        return jnp.abs(self.distal - self.proximal), self.proximal + self.distal

    def elbows(self, joints: jax.Array) -> jax.Array:
        """Where the driven links end. -> (2, 2)"""
        return self.base() + self.proximal * direction(joints)

    def elbow_angles(self, pose: jax.Array) -> jax.Array:
        """Passive angles between the links of each leg, eq. (21): pi stretched, 0 folded. -> (2,)

        NaN for a leg that the pose is out of reach of.
        """
        squared = jnp.sum((pose - self.base()) ** 2, axis=-1)
        cosine = (self.proximal**2 + self.distal**2 - squared) / (2 * self.proximal * self.distal)
        roundoff = 8 * jnp.finfo(pose.dtype).eps
        return jnp.where(jnp.abs(cosine) <= 1 + roundoff, safe.arccos(cosine), jnp.nan)

    def attachments(self) -> jax.Array:
        return jnp.zeros((2, 2), self.half_base.dtype)

    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """(|distal link|^2 - lb^2) / 2, eq. (3)."""
        return (jnp.sum((points - self.elbows(joints)) ** 2, axis=-1) - self.distal**2) / 2

    def home(self) -> tuple[jax.Array, jax.Array]:
        """On the axis of symmetry, where the links are farthest from both kinds of singularity."""
        nearest, farthest = self.limits()
        nearest = jnp.maximum(nearest, self.half_base)
        lengths = nearest + jnp.arange(1, 16, dtype=nearest.dtype) / 16 * (farthest - nearest)
        heights = safe.sqrt((lengths - self.half_base) * (lengths + self.half_base))
        candidates = jnp.stack([jnp.zeros_like(heights), heights], axis=-1)

        def clearance(pose):
            joints = self.inverse(pose)
            distal = (pose - self.elbows(joints)) / self.distal
            elbow = jnp.abs(cross(direction(joints), distal))
            return jnp.min(jnp.append(elbow, jnp.abs(cross(distal[0], distal[1]))))

        best = jnp.nanargmax(jax.vmap(clearance)(candidates))
        pose = lax.stop_gradient(candidates[best])
        return pose, self.inverse(pose)

    def length(self) -> jax.Array:
        """R; of a coaxial five-bar the driven link."""
        return jnp.where(self.half_base > 0, self.half_base, self.proximal)

    def margins(self, pose: jax.Array, joints: jax.Array) -> dict[str, jax.Array]:
        nearest, farthest = self.limits()
        distance = safe.norm(pose - self.base())
        return {
            "reach_min": (distance - nearest) / self.length(),
            "reach_max": (farthest - distance) / self.length(),
            "side": pose[1] / self.length(),
        }

    def skeleton(self, pose: jax.Array, joints: jax.Array) -> Skeleton:
        points = jnp.concatenate([self.base(), self.elbows(joints), pose[None]])
        return Skeleton(points, ((0, 2), (2, 4), (1, 3), (3, 4)), ground=(0, 1))

    def inverse(self, pose: jax.Array, branch: jax.Array | None = None, *, free=None) -> jax.Array:
        """Driven angles of a pose in one working mode, eqs. (5)-(6) without their half-angle. -> (2,)

        NaN for a leg that the pose is out of reach of.
        """
        branch = self.default_branch() if branch is None else jnp.asarray(branch, pose.dtype)
        return arm_angles(pose - self.base(), self.proximal, self.distal, branch)

    def forward(self, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Both assembly modes, the end point above the elbows first. -> poses (2, 2), is_real (2,)

        Two circles of radius lb about the elbows: real where they meet, NaN elsewhere.
        """
        first, second = self.elbows(joints)
        apart = second - first
        squared = jnp.sum(apart * apart)
        rise = self.distal**2 - squared / 4
        is_real = (rise >= 0) & (squared > 0)
        offset = quarter_turn(apart) * safe.sqrt(safe.divide(rise, squared))
        middle = (first + second) / 2
        poses = jnp.stack([middle + offset, middle - offset])
        return jnp.where(is_real, poses, jnp.nan), jnp.broadcast_to(is_real, (2,))
