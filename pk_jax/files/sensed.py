"""The sensors of a nine-length platform, as the command line says and places them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.sensors import NoiseGains, SensorLayout, noise_gains, sensor_layout
from pk_jax.design.sensor_placement import SensorPlacement, place_sensors
from pk_jax.files.named import Named
from pk_jax.geometry.poses import retract
from pk_jax.geometry.se3 import SE3
from pk_jax.geometry.spread import evenly
from pk_jax.mechanisms.stewart import LEGS, Stewart

POSES = 64
REACH = 0.4  # of length(): how far the poses go from home
TURN = 0.35  # rad


class Sensed(NamedTuple):
    """A layout, what it makes of noise, and how it was found."""

    mechanism: Stewart
    layout: SensorLayout
    gains: NoiseGains | None  # (poses,); None where the layout is singular
    placement: SensorPlacement | None


def sensed(
    named: Named, radius: float | None, platform_radius: float | None, starts: int, report: Any
) -> Sensed:
    """The layout as it is, or placed anew within squares of these half-widths, in the unit of the user."""
    mech, placement = named.mechanism, None
    if not isinstance(mech, Stewart):
        raise ValueError(f"sensors takes a Stewart, got {type(mech).__name__}")
    poses = workspace_of(mech)
    if radius is not None:
        own = None if platform_radius is None else platform_radius * named.metres
        placement = place_sensors(
            mech, poses, radius=radius * named.metres, platform_radius=own, starts=starts, report=report
        )
        mech = placement.stewart
    elif platform_radius is not None:
        raise ValueError("--place-platform needs --place")
    layout = sensor_layout(mech)
    return Sensed(mech, layout, None if layout.reason else noise_gains(mech, poses), placement)


def workspace_of(mech: Stewart) -> SE3:
    """Poses spread evenly about home. -> (64,)"""
    home, size = mech.home()[0], mech.length()
    spans = jnp.concatenate([jnp.full(3, REACH * size), jnp.full(3, TURN)])
    twists = (2 * jnp.asarray(evenly(POSES, 6), size.dtype) - 1) * spans
    return jax.jit(jax.vmap(lambda twist: retract(home, twist)))(twists)


def sensed_text(named: Named, one: Sensed) -> str:
    layout, unit = one.layout, "" if named.unit == "1" else f" {named.unit}"
    lines = [
        f"{named.name}: {layout.kind}, linear stage of rank {layout.rank} of {LEGS}, "
        f"condition {layout.condition:.4g}"
    ]
    if layout.reason:
        return "\n".join([*lines, f"REFUSED: {layout.reason}"])
    lines.append(f"\nerror of the pose per error of the lengths, RMS, over {POSES} poses about home")
    turns = f"rotation (rad/{named.unit}): median"
    lines.append(f"{'':14}{'position: median':>18}{'worst':>10}{turns:>32}{'worst':>10}")
    for name, title in (("estimate", "nine, weighted"), ("closed_form", "closed form"), ("legs", "six legs")):
        gain = getattr(one.gains, name)
        position, rotation = np.asarray(gain.position), np.asarray(gain.rotation) * named.metres
        lines.append(
            f"{title:14}{np.median(position):18.4g}{position.max():10.4g}"
            f"{np.median(rotation):32.4g}{rotation.max():10.4g}"
        )
    if one.placement is not None:
        before = one.placement.gain_before
        came = f", {before:.4g} with the sensors it came with" if np.isfinite(before) else ""
        lines.append(
            f"\nplaced: RMS gain {one.placement.gain:.4g}{came}; {one.placement.evaluations} gradients, "
            f"status {one.placement.status.name}"
        )
        for name, joints in (("S", one.mechanism.base[LEGS:]), ("T", one.mechanism.platform[LEGS:])):
            for i, at in enumerate(np.asarray(joints) / named.metres, 1):
                lines.append(f"  {name}{i}  {', '.join(f'{x:.6g}' for x in at)}{unit}")
    return "\n".join(lines)
