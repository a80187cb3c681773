"""Mechanisms as a user would write them, by nothing but the public contract."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

import pk_jax as pk


class Delta(pk.Mechanism):
    """Three driven arms and three rods hold a platform that only translates. No closed form."""

    base_radius: jax.Array
    platform_radius: jax.Array
    arm: jax.Array
    rod: jax.Array

    joint_units = (0, 0, 0)

    def radial(self):
        """Horizontal direction of every arm. -> (3, 3)"""
        angles = 2 * jnp.pi / 3 * jnp.arange(3)
        return jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros(3)], axis=1)

    def elbows(self, joints):
        out = self.base_radius + self.arm * jnp.cos(joints)
        down = jnp.zeros((3, 3)).at[:, 2].set(self.arm * jnp.sin(joints))
        return out[:, None] * self.radial() - down

    def residual(self, pose, joints):
        rods = pose + self.platform_radius * self.radial() - self.elbows(joints)
        return jnp.sum(rods**2, axis=1) - self.rod**2

    def home(self):
        across = self.base_radius + self.arm - self.platform_radius
        depth = jnp.sqrt(self.rod**2 - across**2)
        return lax.stop_gradient(jnp.array([0.0, 0.0, -1.0]) * depth), jnp.zeros(3)

    def length(self):
        return self.rod

    def margins(self, pose, joints):
        return {"arms": 1 - jnp.abs(joints) / (jnp.pi / 2)}

    def skeleton(self, pose, joints):
        base, platform = self.base_radius * self.radial(), pose + self.platform_radius * self.radial()
        points = jnp.concatenate([base, self.elbows(joints), platform])
        bars = tuple((i, i + 3) for i in range(6))
        return pk.Skeleton(points, bars, ground=(0, 1, 2))


class ThreeRPR(pk.LegMechanism):
    """A planar platform (x, y, phi) on three telescopic legs, with a closed-form inverse."""

    base: jax.Array  # (3, 2)
    platform: jax.Array  # (3, 2) in the platform frame

    pose_units = (1, 1, 0)

    def attachments(self):
        return self.platform

    def legs(self, points, joints):
        return (jnp.sum((points - self.base) ** 2, axis=1) - joints**2) / 2

    def inverse(self, pose, branch=None, *, free=None):
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        turned = self.platform @ jnp.array([[c, s], [-s, c]])
        return jnp.linalg.norm(pose[:2] + turned - self.base, axis=1)

    def home(self):
        """Above the centre of the base, turned to where the legs are farthest from a singularity."""
        angles = jnp.linspace(-jnp.pi, jnp.pi, 24, endpoint=False)
        centre = jnp.mean(self.base, axis=0)
        poses = jnp.stack([jnp.append(centre, angle) for angle in angles])

        def clearance(pose):
            a = self.linearize(pose, self.inverse(pose))[1] * jnp.stack([1, 1, 1 / self.length()])
            return jnp.abs(jnp.linalg.det(a / jnp.linalg.norm(a, axis=1, keepdims=True)))

        pose = lax.stop_gradient(poses[jnp.nanargmax(jax.vmap(clearance)(poses))])
        return pose, self.inverse(pose)

    def length(self):
        return jnp.linalg.norm(self.base[1] - self.base[0])

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        points = pose[:2] + self.platform @ jnp.array([[c, s], [-s, c]])
        bars = ((0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3))
        return pk.Skeleton(jnp.concatenate([self.base, points]), bars, ground=(0, 1, 2))


class ThreeLegs(pk.LegMechanism):
    """Three lengths hold a point in the plane: one more than needed."""

    base: jax.Array  # (3, 2)

    def attachments(self):
        return jnp.zeros((3, 2))

    def legs(self, points, joints):
        return (jnp.sum((points - self.base) ** 2, axis=1) - joints**2) / 2

    def inverse(self, pose, branch=None, *, free=None):
        return jnp.linalg.norm(pose - self.base, axis=1)

    def home(self):
        pose = lax.stop_gradient(jnp.mean(self.base, axis=0))
        return pose, self.inverse(pose)

    def length(self):
        return jnp.linalg.norm(self.base[1] - self.base[0])

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        return pk.Skeleton(jnp.concatenate([self.base, pose[None]]), ((0, 3), (1, 3), (2, 3)), (0, 1, 2))


def delta() -> Delta:
    return Delta(base_radius=0.2, platform_radius=0.05, arm=0.35, rod=0.8)


def three_rpr() -> ThreeRPR:
    return ThreeRPR(
        base=[[0.0, 0.0], [1.2, 0.1], [0.4, 1.1]], platform=[[-0.2, -0.15], [0.25, -0.1], [0.02, 0.3]]
    )


def three_legs() -> ThreeLegs:
    return ThreeLegs(base=[[0.0, 0.0], [2.0, 0.1], [0.8, 1.9]])
