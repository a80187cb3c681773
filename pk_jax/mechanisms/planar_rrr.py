"""Planar platforms on arms of two links whose first joints are driven: 3-RRR, and more arms than needed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax import checks
from pk_jax.geometry.circles import platforms_on_circles
from pk_jax.geometry.planar import arm_angles, cross, direction
from pk_jax.geometry.poses import place
from pk_jax.mechanisms import planar_platform
from pk_jax.mechanisms.base import Skeleton


class PlanarRRR(planar_platform.ArmedPlatform):
    """k angles drive a platform (x, y, phi): 3-RRR with k = 3, redundantly actuated with more (4-RRR).

    Fields, in one unit of length: base (k, 2) the driven joints; platform (k, 2) the platform joints in
    the platform frame; proximal and distal, () or (k,), the links from the base and to the platform.
    Pose (x, y, phi) of the platform frame, joints the absolute angles (k,) of the proximal links.

    Working mode: branch_i = sign(sin psi_i), psi_i the angle from the proximal to the distal link of
    arm i; default +1 for all.

    Source: the 3-RRR and the redundant 4-RRR of the screw analysis of planar parallel robots, eqs.
    (29)-(31); the screw of arm i is the line through its distal link, its moment arm about the
    driven joint la sin psi_i.
    """

    joint_units = property(lambda self: (0,) * self.base.shape[0])

    def check_shapes(self) -> None:
        checks.has_shape("PlanarRRR.base", self.base, (None, 2))
        rows = self.base.shape[0]
        if rows < 3:
            raise ValueError(f"PlanarRRR.base must have three rows (arms) or more, got {rows}")
        checks.has_shape("PlanarRRR.platform", self.platform, (rows, 2))
        planar_platform.check_lengths("PlanarRRR", self.links(), rows)

    def check_values(self) -> None:
        planar_platform.check_positive("PlanarRRR", self.links())
        planar_platform.check_ends("PlanarRRR", self.base, self.platform)
        planar_platform.check_home("PlanarRRR", _best_home(self)[1], "proximal and distal")

    def default_branch(self) -> jax.Array:
        return jnp.ones(self.base.shape[0], self.base.dtype)

    def elbows(self, joints: jax.Array) -> jax.Array:
        """Where the proximal links end. -> (k, 2)"""
        return self.base + (self.proximal * direction(joints).T).T

    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """(|distal link|^2 - lb^2) / 2."""
        return (jnp.sum((points - self.elbows(joints)) ** 2, axis=-1) - self.distal**2) / 2

    def home(self) -> tuple[jax.Array, jax.Array]:
        """Over the middle of the base and unturned, unless that is far closer to a singularity."""
        pose = _best_home(self)[0]
        return pose, self.inverse(pose)

    def skeleton(self, pose: jax.Array, joints: jax.Array) -> Skeleton:
        k = self.base.shape[0]
        points = jnp.concatenate([self.base, self.elbows(joints), place(pose, self.platform)])
        arms = tuple((i, i + k) for i in range(2 * k))
        rim = tuple((2 * k + i, 2 * k + (i + 1) % k) for i in range(k))
        return Skeleton(points, arms + rim, ground=tuple(range(k)))

    def inverse(self, pose: jax.Array, branch: jax.Array | None = None, *, free=None) -> jax.Array:
        """Driven angles of a pose in one working mode; NaN for an arm that is out of reach. -> (k,)"""
        branch = self.default_branch() if branch is None else jnp.asarray(branch, pose.dtype)
        return arm_angles(place(pose, self.platform) - self.base, self.proximal, self.distal, branch)

    def forward(self, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Every assembly mode: with the elbows fixed, a 3-RPR whose lengths are known. -> (6, 3), (6,)

        Redundant arms choose among the modes of the first three: real are those that close all.
        """
        radii = jnp.broadcast_to(self.distal, self.base.shape[:1])
        poses, is_real = platforms_on_circles(self.platform[:3], self.elbows(joints)[:3], radii[:3])
        return planar_platform.closing_all(self, poses, is_real, joints)


@jax.jit
def _best_home(mech: PlanarRRR) -> tuple[jax.Array, jax.Array]:
    """The home pose, and how far it is from a singularity of either kind."""
    mech = lax.stop_gradient(mech)

    def clearance(pose):
        joints = mech.inverse(pose)
        distal = place(pose, mech.platform) - mech.elbows(joints)
        bent = jnp.min(jnp.abs(cross(direction(joints), distal) / mech.distal))
        turning = planar_platform.least_sigma(mech.linearize(pose, joints)[1], mech.length())
        return jnp.minimum(turning, bent)

    return planar_platform.best_home(
        mech.base, mech.platform, jnp.mean(mech.base, axis=0), mech.limits(), clearance
    )
