"""What a pose must keep to belong to a workspace: the mechanism's margins, and what a user adds to them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.charts import pose_at, scale_of
from pk_jax.analysis.measures import clearance
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.matrices import small_det
from pk_jax.geometry.poses import tangent_size
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.jacobian import pose_jacobian
from pk_jax.mechanisms.base import Mechanism

MOST_BROKEN = 3  # coordinates up to which rays are broken where they cross a singularity


class Region(NamedTuple):
    """Which poses count: those with all margins >= 0. Static, so that programs are shared."""

    coordinates: tuple[tuple[int, float, float], ...] = ()  # (which, least, greatest)
    clearance: float | None = None
    margins: Callable[[Mechanism, Any, jax.Array], Any] | None = None
    length: float | None = None
    axes: tuple[int, ...] | None = None  # the coordinates that vary; None: all
    is_broken: bool = False  # at det A = 0, too, where integrands have kinks

    def whole(self, centre: Any, y: jax.Array) -> jax.Array:
        """All coordinates, those that are held being 0. -> (n,)"""
        if self.axes is None:
            return y
        return jnp.zeros(tangent_size(centre), y.dtype).at[np.array(self.axes)].set(y)

    def size(self, centre: Any) -> int:
        """How many coordinates vary."""
        return tangent_size(centre) if self.axes is None else len(self.axes)


class Given(NamedTuple):
    """What the functions of a region depend on, traced."""

    mech: Mechanism
    centre: Any  # pose from which coordinates are counted
    branch: jax.Array | None
    free: jax.Array | None
    home: tuple[Any, jax.Array]  # a regular pose and its joints
    scale: jax.Array  # (n,) how large coordinates can be


def given_of(mech: Mechanism, centre: Any = None, branch: Any = None, free: Any = None) -> Given:
    """With everything that need not be computed again; a constant beside the mechanism."""
    mech = mech.prepared()
    home = mech.home()
    centre = home[0] if centre is None else centre
    fixed = jax.lax.stop_gradient((centre, home))
    return Given(mech, fixed[0], branch, free, fixed[1], scale_of(mech, centre, home[1]))


def joints_at(given: Given, pose: Any) -> jax.Array:
    """NaN where the pose is out of reach. -> (m,)"""
    if given.mech.free_joints:
        return given.mech.inverse(pose, given.branch, free=given.free)
    return given.mech.inverse(pose, given.branch)


def limits_at(region: Region, given: Given, y: jax.Array) -> jax.Array:
    """Every limit at coordinates y, >= 0 inside, NaN where it has no value. -> (k,)"""
    return jnp.concatenate([plain_limits_at(region, given, y), added_limits_at(region, given, y)])


def plain_limits_at(region: Region, given: Given, y: jax.Array) -> jax.Array:
    """The mechanism's margins and the limits of coordinates."""
    y = region.whole(given.centre, y)
    pose = pose_at(given.centre, y)
    margins = given.mech.margins(pose, joints_at(given, pose))
    found = [jnp.ravel(value) for _, value in sorted(margins.items())]
    values = _coordinates(pose, y)
    for which, least, greatest in region.coordinates:
        width = greatest - least
        found.append(jnp.stack([values[which] - least, greatest - values[which]]) / width)
    return jnp.concatenate(found) if found else jnp.zeros(0, y.dtype)


def added_limits_at(region: Region, given: Given, y: jax.Array) -> jax.Array:
    """What a user adds to them. Its slopes may be infinite where a leg is stretched or folded."""
    pose = pose_at(given.centre, region.whole(given.centre, y))
    joints, found = joints_at(given, pose), [jnp.zeros(0, y.dtype)]
    if region.clearance is not None:
        kept = clearance(given.mech, pose, joints, region.length)
        home = clearance(given.mech, *given.home, region.length)
        side = jax.lax.stop_gradient(jnp.where(home < 0, -1.0, 1.0))  # square A: the side where home is
        found.append((side * kept - region.clearance)[None])
    if region.margins is not None:
        added = region.margins(given.mech, pose, joints)
        found.extend(jnp.ravel(jnp.asarray(value)) for value in jax.tree.leaves(added))
    return jnp.concatenate(found)


def functions_at(region: Region, given: Given, y: jax.Array) -> jax.Array:
    """The limits, and last what else breaks a ray. -> (k,) or (k + 1,)"""
    found = limits_at(region, given, y)
    if region.is_broken:
        pose = pose_at(given.centre, region.whole(given.centre, y))
        a = pose_jacobian(given.mech, pose, joints_at(given, pose))
        size = jnp.prod(jnp.sqrt(jnp.sum(a * a, axis=1)))
        found = jnp.append(found, small_det(a) / size)
    return found


def count_limits(region: Region, given: Given) -> tuple[int, int]:
    """Numbers of the mechanism's own limits, and of those added."""
    n = region.size(given.centre)
    zero = jnp.zeros(n, jax.tree.leaves(given.centre)[0].dtype)
    of = lambda given: (plain_limits_at(region, given, zero), added_limits_at(region, given, zero))
    plain, added = jax.eval_shape(of, given)
    return plain.shape[0], added.shape[0]


def _coordinates(pose: Any, y: jax.Array) -> jax.Array:
    """Coordinates as `coordinate_names` names them; turns of an `SE3` are counted from the centre. -> (n,)"""
    if isinstance(pose, SE3):
        return jnp.concatenate([pose.translation, y[3:]])
    if isinstance(pose, AxisPose):
        return jnp.append(pose.s, pose.angles())
    return pose
