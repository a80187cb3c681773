"""The Stewart platform: six legs, and sensors if there are any, between a base and a platform in space."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry import rotations, safe
from pk_jax.geometry.matrices import least_direction, small_inverse
from pk_jax.geometry.poses import place
from pk_jax.geometry.se3 import SE3
from pk_jax.mechanisms.base import LegMechanism, Skeleton

LEGS = 6
SINGULAR_BELOW = 1e-6  # least singular value, without units, below which a platform is of no use


class Stewart(LegMechanism):
    """Six leg lengths drive a platform in space (6-UPS); further rows are length sensors.

    Fields: base (k, 3) in the base frame and platform (k, 3) in the platform frame, row i the ends of
    leg i, k >= 6: six legs first, then sensors, legs that carry no force. Optional limits, of
    the six legs only: stroke (2,) or (6, 2), least and greatest length; base_cone and
    platform_cone () or (6,), half-angles in radians of the joints' cones about cone_axes (2, 6, 3),
    unit vectors in the base frame and, pointing from the platform to the base, in the platform
    frame (default: the legs at home). Pose `SE3`, joints the k lengths. One unit of length.

    The six legs of a platform whose joints lie on a conic and are affine copies of the base's (two regular
    hexagons, say) are dependent in every pose, "architecturally singular", and refused.

    Source: Stewart 1965, Proc. IMechE 180; with nine rows both embodiments of Ryu et al., patent
    application KR 10-2000-0073215.
    """

    base: jax.Array
    platform: jax.Array
    stroke: jax.Array | None = None
    base_cone: jax.Array | None = None
    platform_cone: jax.Array | None = None
    cone_axes: jax.Array | None = None

    joints_are_distances = True
    actuated_rows = LEGS

    @classmethod
    def semi_regular(
        cls, base_radius: float, platform_radius: float, base_half_angle: float, platform_half_angle: float
    ) -> Stewart:
        """Joints in pairs on two circles, symmetric under turns by 120 degrees.

        Base pairs about 30, 150 and 270 degrees, platform pairs about 90, 210 and 330 degrees, each
        joint `half_angle` radians off the middle of its pair; leg 1 from the base joint
        at 30 degrees + base_half_angle to the platform joint at 90 degrees - platform_half_angle, and on
        counterclockwise.
        """
        leg = np.arange(LEGS)
        middles = np.deg2rad(30.0 + 120.0 * ((leg + 1) // 2)), np.deg2rad(90.0 + 120.0 * (leg // 2))
        side = np.where(leg % 2 == 0, 1.0, -1.0)
        angles = middles[0] + side * base_half_angle, middles[1] - side * platform_half_angle
        xp = np if checks.is_concrete((base_half_angle, platform_half_angle)) else jnp
        base, platform = (xp.stack([xp.cos(a), xp.sin(a), 0 * a], axis=1) for a in angles)
        return cls(base=base_radius * base, platform=platform_radius * platform)

    def check_shapes(self) -> None:
        checks.has_shape("Stewart.base", self.base, (None, 3))
        rows = self.base.shape[0]
        if rows < LEGS:
            raise ValueError(f"Stewart.base must have six rows (legs) or more (sensors), got {rows}")
        checks.has_shape("Stewart.platform", self.platform, (rows, 3))
        if self.stroke is not None and self.stroke.shape not in ((2,), (LEGS, 2)):
            raise ValueError(f"Stewart.stroke must have shape (2,) or (6, 2), got {self.stroke.shape}")
        for name in ("base_cone", "platform_cone"):
            if (cone := getattr(self, name)) is not None and cone.shape not in ((), (LEGS,)):
                raise ValueError(f"Stewart.{name} must have shape () or (6,), got {cone.shape}")
        if self.cone_axes is not None:
            checks.has_shape("Stewart.cone_axes", self.cone_axes, (2, LEGS, 3))

    def check_values(self) -> None:
        sizes = [
            _check_points(f"Stewart.{name}", np.asarray(getattr(self, name))[:LEGS])
            for name in ("base", "platform")
        ]
        ends = np.concatenate([np.asarray(self.base)[:LEGS], np.asarray(self.platform)[:LEGS]], axis=1)
        for i in range(LEGS):
            for j in range(i):
                if np.allclose(ends[i], ends[j], rtol=0, atol=1e-9 * max(sizes)):
                    raise ValueError(
                        f"Stewart.base and platform must not give the same leg twice, got legs {j} and {i} "
                        f"from {ends[i, :3].tolist()} to {ends[i, 3:].tolist()}"
                    )
        checks.warn_of_units("Stewart: the sizes of base and platform", sizes[0] / sizes[1], stacklevel=4)
        if self.stroke is not None:
            least, greatest = np.moveaxis(np.asarray(self.stroke), -1, 0)
            if not np.all((least > 0) & (least < greatest)):
                raise ValueError(
                    f"Stewart.stroke must be 0 < least < greatest, got {np.asarray(self.stroke).tolist()}"
                )
        for name in ("base_cone", "platform_cone"):
            if (cone := getattr(self, name)) is not None and not np.all((cone > 0) & (cone <= np.pi)):
                raise ValueError(f"Stewart.{name} must be in (0, pi] rad, got {np.asarray(cone).tolist()}")
        if self.cone_axes is not None and not np.allclose(
            jnp.linalg.norm(self.cone_axes, axis=-1), 1, rtol=0, atol=1e-6
        ):
            raise ValueError("Stewart.cone_axes must be unit vectors")
        if not float(_best_home(self)[1]) > SINGULAR_BELOW:
            raise ValueError(
                "Stewart.base and platform are architecturally singular: the six legs are dependent in every "
                "pose (affine copies of one hexagon, for example), got a least singular value below 1e-6"
            )

    def attachments(self) -> jax.Array:
        return self.platform

    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """(|leg|^2 - l^2) / 2."""
        return (jnp.sum((points - self.base) ** 2, axis=-1) - joints**2) / 2

    def home(self) -> tuple[SE3, jax.Array]:
        """The platform above the base, parallel to it, unturned unless that is close to a singularity.

        In the middle of the stroke where a stroke is given.
        """
        pose = _best_home(self)[0]
        return pose, self.inverse(pose)

    def length(self) -> jax.Array:
        """Root mean square distance of the six platform joints from their centroid."""
        joints = self.platform[:LEGS]
        return jnp.sqrt(jnp.mean(jnp.sum((joints - jnp.mean(joints, axis=0)) ** 2, axis=1)))

    def inverse(self, pose: SE3, branch: jax.Array | None = None, *, free=None) -> jax.Array:
        """Leg lengths |t + R b - a|; there is one working mode, lengths being positive. -> (k,)"""
        return safe.norm(place(pose, self.platform) - self.base)

    def margins(self, pose: SE3, joints: jax.Array) -> dict[str, jax.Array]:
        """Strokes over length(); cones as cos(angle) - cos(half-angle). Each (6,)."""
        found = {}
        if self.stroke is not None:
            found["stroke_min"] = (joints[:LEGS] - self.stroke[..., 0]) / self.length()
            found["stroke_max"] = (self.stroke[..., 1] - joints[:LEGS]) / self.length()
        if self.base_cone is not None or self.platform_cone is not None:
            on_base, on_platform = self._axes()
            legs = self._directions(pose)
            if self.base_cone is not None:
                found["base_cone"] = jnp.sum(legs * on_base, axis=1) - jnp.cos(self.base_cone)
            if self.platform_cone is not None:
                seen = -legs @ pose.rotation  # from the platform, in its frame
                found["platform_cone"] = jnp.sum(seen * on_platform, axis=1) - jnp.cos(self.platform_cone)
        return found

    def prepared(self) -> Stewart:
        """With the axes of its cones."""
        if self.cone_axes is not None or (self.base_cone is None and self.platform_cone is None):
            return self
        return dataclasses.replace(self, cone_axes=self._axes())

    def skeleton(self, pose: SE3, joints: jax.Array) -> Skeleton:
        rows = self.base.shape[0]
        points = jnp.concatenate([self.base, place(pose, self.platform)])
        rims = [
            [start + i for i in _around(joints)] for start, joints in ((0, self.base), (rows, self.platform))
        ]
        legs = tuple((i, i + rows) for i in range(rows))
        outline = tuple((rim[i - 1], rim[i]) for rim in rims for i in range(LEGS))
        return Skeleton(points, legs + outline, ground=tuple(range(rows)))

    def _directions(self, pose: SE3) -> jax.Array:
        """Unit vectors along the legs, base to platform. -> (6, 3)"""
        legs = (place(pose, self.platform) - self.base)[:LEGS]
        return legs / safe.norm(legs)[:, None]

    def _axes(self) -> jax.Array:
        if self.cone_axes is not None:
            return self.cone_axes
        pose = self.home()[0]
        legs = self._directions(pose)
        return jnp.stack([legs, -legs @ pose.rotation])


def _check_points(name: str, joints: np.ndarray) -> float:
    """The radius of six joints; ValueError where they lie on a line."""
    sizes = np.linalg.svd(joints - joints.mean(axis=0), compute_uv=False)
    if not sizes[1] > 1e-6 * sizes[0]:
        raise ValueError(f"{name} must not have all six joints on one line, got {joints.tolist()}")
    return float(np.linalg.norm(sizes) / np.sqrt(LEGS))


@jax.jit
def _best_home(mech: Stewart) -> tuple[SE3, jax.Array]:
    """The home pose, and its distance to a singularity (a lower bound of the least singular value)."""
    mech = lax.stop_gradient(mech)
    base, platform = mech.base[:LEGS], mech.platform[:LEGS]
    below, above = jnp.mean(base, axis=0), jnp.mean(platform, axis=0)
    radius = jnp.sqrt(jnp.mean(jnp.sum((base - below) ** 2, axis=1)))
    up = _normal(base - below)
    level = _turn_onto(_normal(platform - above), up)

    def candidate(yaw, height, tilt):
        lean = rotations.from_rotation_vector(tilt * (level @ jnp.asarray([0.8, 0.6, 0.0], base.dtype)))
        rotation = lean @ rotations.from_rotation_vector(yaw * up) @ level
        if mech.stroke is not None:  # the mean of the squared lengths is that of the middle of the strokes
            apart = (platform - above) @ rotation.T - (base - below)
            squared = jnp.mean(jnp.mean(mech.stroke, axis=-1) ** 2) - jnp.mean(jnp.sum(apart**2, axis=1))
            rise = jnp.sqrt(jnp.maximum(squared, (0.1 * radius) ** 2))
        else:
            rise = height * jnp.maximum(radius, mech.length())
        pose = SE3(below + rise * up - rotation @ above, rotation)
        return pose, _clearance(mech, pose)

    poses, clearances = jax.vmap(candidate)(*jnp.asarray(_CANDIDATES, base.dtype).T)
    # the first candidate, level, unturned and as high as the base is wide, unless another is far better
    good = jnp.argmax(clearances > jnp.max(clearances) / 2)
    return jax.tree.map(lambda leaf: leaf[good], poses), clearances[good]


# yaw in rad, height over the greater radius, tilt in rad
_CANDIDATES = [
    (np.deg2rad(15 * turn), height, tilt)
    for tilt in (0.0, 0.4, -0.4)
    for turn in range(24)
    for height in (1.0, 0.7, 1.4, 2.0, 0.5)
]


def _clearance(mech: Stewart, pose: SE3) -> jax.Array:
    """1 / |A^-1|_F of the six legs, lengths over length(), rows of unit norm; 0 where A is singular. -> ()"""
    rows = mech.linearize(pose, mech.inverse(pose))[1][:LEGS]
    rows = rows * jnp.where(jnp.arange(6) < 3, mech.length(), 1)
    rows = rows / jnp.linalg.norm(rows, axis=1, keepdims=True)
    size = jnp.linalg.norm(small_inverse(rows))
    return jnp.where(jnp.isfinite(size), 1 / size, 0)


def _normal(points: jax.Array) -> jax.Array:
    """Unit normal of the plane nearest to centred points, upwards. -> (3,)"""
    normal = least_direction(points)
    steepest = normal[jnp.argmax(jnp.abs(normal))]
    upward = jnp.where(jnp.abs(normal[2]) > 1e-6, normal[2], steepest)
    return normal * jnp.sign(upward)


def _turn_onto(a: jax.Array, b: jax.Array) -> jax.Array:
    """The least rotation that carries the unit vector a onto b, not opposite to it. -> (3, 3)"""
    k = rotations.skew(jnp.cross(a, b))
    return jnp.eye(3, dtype=a.dtype) + k + k @ k / jnp.maximum(1 + a @ b, 1e-3)


def _around(points: jax.Array) -> list[int]:
    """The six joints in the order in which they lie around their centroid."""
    if not checks.is_concrete(points):
        return list(range(LEGS))
    joints = np.asarray(points)[:LEGS]
    centred = joints - joints.mean(axis=0)
    first, second = np.linalg.svd(centred)[2][:2]
    return [int(i) for i in np.argsort(np.arctan2(centred @ second, centred @ first), kind="stable")]
