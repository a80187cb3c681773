"""The 6-link: a coupler between two arms of two links, all four of their joints driven."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.geometry.planar import arm_angles, cross, direction, quarter_turn
from pk_jax.geometry.poses import place
from pk_jax.mechanisms import planar_platform
from pk_jax.mechanisms.base import Skeleton

ELBOWS_OUT = (-1.0, 1.0)  # with the first arm on the left


class SixLink(planar_platform.ArmedPlatform):
    """Four angles drive a platform (x, y, phi) of three freedoms: the redundant 6-link A-B-C-D-E-F.

    Fields, in one unit of length, row 1 the arm A-B-C, row 2 the arm F-E-D: base (2, 2) the joints A and
    F; platform (2, 2) the joints C and D in the platform frame; proximal and distal, () or (2,), the
    links AB, FE and BC, ED. Pose (x, y, phi) of the platform frame. Joints (4,): A absolute, B relative to
    the proximal link, F absolute, E relative.

    Working mode: one sign an arm, that of sin of the relative angle; default (-1, +1).

    Source: the redundant 6-link of the screw analysis of planar parallel robots, eq. (34). The screw of
    motor A is the line BC, that of motor B the line AC: each meets every joint of its arm but its own. The
    paper's direct singularity, all screws on one line, is none: locked motors hold C and D.
    """

    joint_units = (0, 0, 0, 0)

    def check_shapes(self) -> None:
        for name in ("base", "platform"):
            checks.has_shape(f"SixLink.{name}", getattr(self, name), (2, 2))
        planar_platform.check_lengths("SixLink", self.links(), 2)

    def check_values(self) -> None:
        planar_platform.check_positive("SixLink", self.links())
        planar_platform.check_ends("SixLink", self.base, self.platform)
        planar_platform.check_home("SixLink", _best_home(self)[1], "proximal and distal")

    def default_branch(self) -> jax.Array:
        return jnp.asarray(ELBOWS_OUT, self.base.dtype)

    def elbows(self, joints: jax.Array) -> jax.Array:
        """B and E. -> (2, 2)"""
        return self.base + (self.proximal * direction(joints[::2]).T).T

    def tips(self, joints: jax.Array) -> jax.Array:
        """Where the motors hold C and D. -> (2, 2)"""
        return self.elbows(joints) + (self.distal * direction(joints[::2] + joints[1::2]).T).T

    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """Platform joint less the tip of its arm. -> (2, 2)"""
        return points - self.tips(joints)

    def home(self) -> tuple[jax.Array, jax.Array]:
        """On the left of the way from A to F and unturned, unless other poses bend the arms far better."""
        pose = _best_home(self)[0]
        return pose, self.inverse(pose)

    def skeleton(self, pose: jax.Array, joints: jax.Array) -> Skeleton:
        points = [self.base, self.elbows(joints), place(pose, self.platform), pose[None, :2]]
        bars = ((0, 2), (2, 4), (1, 3), (3, 5), (4, 5), (4, 6), (6, 5))
        return Skeleton(jnp.concatenate(points), bars, ground=(0, 1))

    def inverse(self, pose: jax.Array, branch: jax.Array | None = None, *, free=None) -> jax.Array:
        """Both angles of both arms in one working mode; NaN for an arm that is out of reach. -> (4,)"""
        branch = self.default_branch() if branch is None else jnp.asarray(branch, pose.dtype)
        points = place(pose, self.platform)
        first = arm_angles(points - self.base, self.proximal, self.distal, branch)
        link = direction(first)
        rest = points - self.base - (self.proximal * link.T).T
        relative = jnp.arctan2(cross(link, rest), jnp.sum(link * rest, axis=-1))
        return jnp.stack([first, relative], axis=1).reshape(-1)

    def forward(self, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The pose nearest to putting C and D where the motors hold them; there is but one. -> (1, 3), (1,)

        Real where their distance is that on the platform, to 1e-6.
        """
        tips = self.tips(joints)
        on_platform, held = self.platform[1] - self.platform[0], tips[1] - tips[0]
        turn = jnp.arctan2(cross(on_platform, held), jnp.sum(on_platform * held))
        pose = jnp.append(jnp.zeros(2, tips.dtype), turn)
        pose = pose.at[:2].set(jnp.mean(tips - place(pose, self.platform), axis=0))
        apart = 2 * self.length()
        is_real = jnp.abs(safe.norm(held) - apart) <= 1e-6 * apart
        return jnp.where(is_real, pose, jnp.nan)[None], is_real[None]


@jax.jit
def _best_home(mech: SixLink) -> tuple[jax.Array, jax.Array]:
    """The home pose, and the sine of the arm that is bent least."""
    mech = lax.stop_gradient(mech)
    apart = mech.base[1] - mech.base[0]
    above = -quarter_turn(apart) / safe.norm(apart) * jnp.mean(sum(mech.limits())) / 2
    middle = jnp.mean(mech.base, axis=0) + above
    bend = lambda pose: jnp.min(jnp.abs(jnp.sin(mech.inverse(pose)[1::2])))
    return planar_platform.best_home(mech.base, mech.platform, middle, mech.limits(), bend)
