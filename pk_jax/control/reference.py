"""What a platform is asked to do: a pose for every time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations
from pk_jax.geometry.poses import retract
from pk_jax.geometry.se3 import SE3
from pk_jax.mechanisms.base import Mechanism, require_mechanism


class Reference(NamedTuple):
    """A motion of the platform."""

    name: str
    pose_at: Callable[[jax.Array], SE3]  # time () s, >= 0, to the desired pose
    start: SE3  # where the platform stands before
    duration: float  # s
    settled_after: float  # s; errors count from here on


def circle_reference(
    mech: Mechanism,
    *,
    radius: float,
    frequency: float = 0.5,
    tilt: float = 0.1,
    centre: Any = None,
    ramp: float = 1.0,
    duration: float = 3.0,
) -> Reference:
    """A horizontal circle about `centre` (default: home), tilting about x by tilt sin(phase).

    radius:     in the unit of the mechanism
    frequency:  Hz
    tilt:       rad
    ramp:       s in which radius and tilt grow from zero, smooth to the second derivative
    duration:   s, more than ramp; errors count from half a second after the ramp on, or from the middle of
                what is left where that is earlier
    """
    start = _home_of(mech, centre)
    for name, value in (("radius", radius), ("frequency", frequency), ("ramp", ramp), ("duration", duration)):
        _is_positive(name, value)
    if not checks.is_number(tilt):
        raise ValueError(f"tilt must be finite, got {checks.shown(tilt)}")
    if not duration > ramp:
        raise ValueError(f"duration must be more than the ramp, {ramp} s, got {duration}")

    def pose_at(time):
        s = jnp.clip(time / ramp, 0, 1)
        grown = s**3 * (10 - 15 * s + 6 * s**2)
        phase = 2 * jnp.pi * frequency * time
        shift = radius * grown * jnp.stack([jnp.cos(phase), jnp.sin(phase), 0 * phase])
        return SE3(
            start.translation + shift, rotations.about(0, tilt * grown * jnp.sin(phase)) @ start.rotation
        )

    return Reference("circle", pose_at, start, float(duration), min(ramp + 0.5, (ramp + duration) / 2))


def step_reference(mech: Mechanism, twist: Any, *, centre: Any = None, duration: float = 0.5) -> Reference:
    """A jump at time 0 from `centre` (default: home) by the tangent `twist` (6,): (v, w), w in rad."""
    start = _home_of(mech, centre)
    twist = checks.real_array("twist", twist).astype(start.translation.dtype)
    checks.has_shape("twist", twist, (6,))
    checks.is_finite("twist", twist)
    if not np.any(np.asarray(twist)):
        raise ValueError("twist must not be zero: there would be nothing to settle")
    _is_positive("duration", duration)
    target = retract(start, twist)
    return Reference("step", lambda time: target, start, float(duration), 0.0)


def _home_of(mech: Mechanism, centre: Any) -> SE3:
    require_mechanism("a reference", mech)
    home = mech.home()[0]
    if not isinstance(home, SE3):
        raise ValueError(f"a reference is for platforms in space, got {type(mech).__name__}")
    if centre is not None and not isinstance(centre, SE3):
        raise ValueError(f"centre must be a pk_jax.SE3, got {type(centre).__name__}")
    if centre is None:
        return home
    numbers = [np.ravel(centre.translation), np.ravel(centre.rotation)]
    if centre.translation.ndim != 1 or not np.all(np.isfinite(np.concatenate(numbers))):
        raise ValueError("centre must be one pose of finite numbers")
    return centre


def _is_positive(name: str, value: Any) -> None:
    if not (checks.is_number(value) and value > 0):
        raise ValueError(f"{name} must be positive and finite, got {checks.shown(value)}")
