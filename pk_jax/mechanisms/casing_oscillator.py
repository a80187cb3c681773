"""The casing oscillator: four legs and a carriage turn and lift a casing (Nam, Bae and Park)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import place
from pk_jax.mechanisms.base import LegMechanism, Skeleton

LEGS = 4


class CasingOscillator(LegMechanism):
    """Four leg lengths and a carriage hold a platform that turns about O and slides along its own axis.

    The platform carries a casing whose axis passes through the origin O of the base: pose
    `AxisPose` (s, rotation), s the length of the casing from O to the platform's centre. Joints
    (l1, l2, l3, l4, E): legs 1 and 4 start from one carriage at (E, 0, 0), legs 2 and 3 from
    (0, +-R, 0); they end at (r, r, 0), (0, r, 0), (0, -r, 0), (r, -r, 0) of the platform. E is
    kinematically redundant: a pose leaves it free.

    Fields, in one unit of length: base_radius R and platform_radius r (); neutral (2,), slide s and
    carriage E of the neutral configuration, unturned; stroke (5, 2), least and greatest of each joint;
    base_cone and platform_cone () or (4,), half-angles in radians of the joints' cones about the
    legs of the neutral configuration, in the base frame and in the platform frame. The defaults are the
    machine of the paper in metres.

    Source: the singularity analysis of the casing oscillator by Nam, Bae and Park, eqs. (1)-(11) and
    Table 1. There l5 = E - 180 mm, an offset that is inferred: it puts the neutral legs 1 and 4 at the
    middle of their strokes, which the printed A = 250 mm does not.
    """

    base_radius: jax.Array = 0.25
    platform_radius: jax.Array = 0.25
    neutral: jax.Array = (0.48, 0.73)
    stroke: jax.Array = (
        (0.6733, 0.7733),
        (0.4175, 0.5425),
        (0.4175, 0.5425),
        (0.6733, 0.7733),
        (0.6675, 0.7922),
    )
    base_cone: jax.Array = np.pi / 9
    platform_cone: jax.Array = np.pi / 9

    joint_units = (1, 1, 1, 1, 1)
    joint_names = ("l1", "l2", "l3", "l4", "E")
    joints_are_distances = True
    free_joints = 1

    def check_shapes(self) -> None:
        for name, shape in (
            ("base_radius", ()),
            ("platform_radius", ()),
            ("neutral", (2,)),
            ("stroke", (5, 2)),
        ):
            checks.has_shape(f"CasingOscillator.{name}", getattr(self, name), shape)
        for name in ("base_cone", "platform_cone"):
            if (cone := getattr(self, name)).shape not in ((), (LEGS,)):
                raise ValueError(f"CasingOscillator.{name} must have shape () or (4,), got {cone.shape}")

    def check_values(self) -> None:
        for name in ("base_radius", "platform_radius", "neutral"):
            checks.is_positive(f"CasingOscillator.{name}", getattr(self, name))
        least, greatest = np.asarray(self.stroke).T
        if not np.all((least > 0) & (least < greatest)):
            raise ValueError(
                "CasingOscillator.stroke must be 0 < least < greatest, "
                f"got {np.asarray(self.stroke).tolist()}"
            )
        for name in ("base_cone", "platform_cone"):
            if not np.all(((cone := np.asarray(getattr(self, name))) > 0) & (cone <= np.pi)):
                raise ValueError(f"CasingOscillator.{name} must be in (0, pi] rad, got {cone.tolist()}")
        joints = np.asarray(self.home()[1])
        if not np.all((joints >= least) & (joints <= greatest)):
            raise ValueError(
                "CasingOscillator.neutral must lie inside the stroke, got joints "
                f"{', '.join(f'{name} = {q:.6g}' for name, q in zip(self.joint_names, joints, strict=True))}"
            )

    def attachments(self) -> jax.Array:
        r, zero = self.platform_radius, jnp.zeros_like(self.platform_radius)
        rows = [[r, r, zero], [zero, r, zero], [zero, -r, zero], [r, -r, zero]]
        return jnp.stack([jnp.stack(row) for row in rows])

    def base(self, carriage: jax.Array) -> jax.Array:
        """Where the legs start. -> (4, 3)"""
        zero = jnp.zeros_like(self.base_radius)
        on_carriage = jnp.stack([carriage, zero, zero])
        left = jnp.stack([zero, self.base_radius, zero])
        return jnp.stack([on_carriage, left, -left, on_carriage])

    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """(|leg|^2 - l^2) / 2, eq. (10)."""
        return (jnp.sum((points - self.base(joints[LEGS])) ** 2, axis=-1) - joints[:LEGS] ** 2) / 2

    def home(self) -> tuple[AxisPose, jax.Array]:
        """The neutral configuration."""
        pose = AxisPose(lax.stop_gradient(self.neutral[0]), jnp.eye(3, dtype=self.neutral.dtype))
        return pose, self.inverse(pose)

    def length(self) -> jax.Array:
        return self.platform_radius

    def free_range(self) -> jax.Array:
        """The stroke of the carriage. -> (1, 2)"""
        return self.stroke[LEGS:]

    def inverse(self, pose: AxisPose, branch: jax.Array | None = None, *, free=None) -> jax.Array:
        """Leg lengths, eq. (10), and the carriage: `free`, () or (1,), by default the neutral one. -> (5,)"""
        carriage = self.neutral[1] if free is None else jnp.reshape(free, ())
        lengths = safe.norm(place(pose, self.attachments()) - self.base(carriage))
        return jnp.append(lengths, carriage)

    def margins(self, pose: AxisPose, joints: jax.Array) -> dict[str, jax.Array]:
        """Strokes (5,) over length(); cones (4,) as cos(angle) - cos(half-angle)."""
        legs, neutral = self._directions(pose, joints), self._directions(*self.home())
        turned = legs @ pose.rotation  # in the platform frame
        return {
            "stroke_min": (joints - self.stroke[:, 0]) / self.length(),
            "stroke_max": (self.stroke[:, 1] - joints) / self.length(),
            "base_cone": jnp.sum(legs * neutral, axis=1) - jnp.cos(self.base_cone),
            "platform_cone": jnp.sum(turned * neutral, axis=1) - jnp.cos(self.platform_cone),
        }

    def skeleton(self, pose: AxisPose, joints: jax.Array) -> Skeleton:
        """Legs, platform, the casing's axis from O to the platform's centre, and the rail of the carriage."""
        zero = jnp.zeros(3, self.stroke.dtype)
        rail = jnp.stack([self.stroke[LEGS], *jnp.zeros((2, 2), self.stroke.dtype)], axis=1)
        centre = place(pose, zero[None])
        base = self.base(joints[LEGS])[:3]
        points = jnp.concatenate([base, place(pose, self.attachments()), zero[None], centre, rail])
        legs = ((0, 3), (1, 4), (2, 5), (0, 6))
        platform = ((3, 4), (4, 5), (5, 6), (6, 3))
        return Skeleton(points, (*legs, *platform, (7, 8), (9, 10)), ground=(1, 2, 7, 9, 10))

    def _directions(self, pose: AxisPose, joints: jax.Array) -> jax.Array:
        """Unit vectors along the legs, base to platform. -> (4, 3)"""
        legs = place(pose, self.attachments()) - self.base(joints[LEGS])
        return legs / safe.norm(legs)[:, None]
