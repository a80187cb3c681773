"""Mechanisms as a user would write them, by nothing but the public contract."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import lax

import pk_jax as pk

EXAMPLES = Path(__file__).parent.parent / "examples"


def _example(stem):
    spec = importlib.util.spec_from_file_location(f"{stem}_example", EXAMPLES / f"{stem}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


Delta = _example("delta").Delta
ThreeRPS = _example("three_rps").ThreeRPS


class ImplicitDelta(pk.Mechanism):
    """The Delta without its closed-form inverse: no more than the five methods."""

    base_radius: jax.Array
    platform_radius: jax.Array
    arm: jax.Array
    rod: jax.Array

    joint_units = (0, 0, 0)
    rings, residual, home = Delta.rings, Delta.residual, Delta.home
    length, skeleton = Delta.length, Delta.skeleton

    def margins(self, pose, joints):
        return {"arms": 1 - jnp.abs(joints) / (jnp.pi / 2)}


class ConstrainedRPS(pk.Mechanism):
    """The 3-RPS as a body in space: six equations, three lengths and three planes, for six coordinates."""

    base_radius: jax.Array
    platform_radius: jax.Array

    joints_are_distances = True
    length = ThreeRPS.length
    out = ThreeRPS.out

    def residual(self, pose, joints):
        tips = pose.translation + self.platform_radius * self.out() @ pose.rotation.T
        apart = tips - self.base_radius * self.out()
        across = jnp.cross(jnp.array([0.0, 0.0, 1.0]), self.out())
        return jnp.concatenate([jnp.sum(apart**2, axis=1) - joints**2, jnp.sum(across * tips, axis=1)])

    def home(self):
        pose = lax.stop_gradient(pk.SE3(jnp.array([0, 0, 2.0]) * self.base_radius, jnp.eye(3)))
        tips = pose.translation + (self.platform_radius - self.base_radius) * self.out()
        return pose, jnp.linalg.norm(tips, axis=1)

    def margins(self, pose, joints):
        return {}

    def skeleton(self, pose, joints):
        tips = pose.translation + self.platform_radius * self.out() @ pose.rotation.T
        points = jnp.concatenate([self.base_radius * self.out(), tips])
        return pk.Skeleton(points, ((0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3)), ground=(0, 1, 2))


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


def implicit_delta() -> ImplicitDelta:
    return ImplicitDelta(base_radius=0.2, platform_radius=0.05, arm=0.35, rod=0.8)


def three_rps() -> ThreeRPS:
    return ThreeRPS(base_radius=0.3, platform_radius=0.2, stroke=[0.5, 0.8], most_tilt=0.7)


def constrained_rps() -> ConstrainedRPS:
    return ConstrainedRPS(base_radius=0.3, platform_radius=0.2)


def three_rpr() -> ThreeRPR:
    return ThreeRPR(
        base=[[0.0, 0.0], [1.2, 0.1], [0.4, 1.1]], platform=[[-0.2, -0.15], [0.25, -0.1], [0.02, 0.3]]
    )


def three_legs() -> ThreeLegs:
    return ThreeLegs(base=[[0.0, 0.0], [2.0, 0.1], [0.8, 1.9]])
