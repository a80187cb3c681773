"""The workspace of the 2-RPR and the 2-RRR as numbers to draw: outline, fitted grid, actuators.

Both reach {l_min <= l_i <= l_max, y >= 0}, l_i the distance of the end point from base joint i
(Nam, Lee and Park 2006, sec. 3). Rays leave O at the angle theta from the y axis, positive to the
left: x = -l_C sin(theta), y = l_C cos(theta).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.geometry import safe
from pk_jax.kinematics.inverse import inverse_kinematics
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR

TwoDof = TwoRPR | FiveBar


class Boundary(NamedTuple):
    """Where rays enter and leave the workspace."""

    inner: np.ndarray  # (k, 2)
    outer: np.ndarray  # (k, 2)


def leg_limits(mech: TwoDof) -> tuple[jax.Array, jax.Array]:
    """Least and greatest distance of the end point from a base joint. -> (), ()"""
    if isinstance(mech, FiveBar):
        nearest, farthest = mech.limits()
    elif isinstance(mech, TwoRPR):
        nearest, farthest = mech.l_min, mech.l_max
    else:
        raise ValueError(f"mech must be a TwoRPR or a FiveBar, got {type(mech).__name__}")
    roundoff = 8 * jnp.finfo(nearest.dtype).eps * farthest
    if not nearest >= mech.half_base - roundoff:
        raise ValueError(
            f"eq. (17) needs a least leg length >= half_base = {mech.half_base:.6g}, got {nearest:.6g}"
        )
    return nearest, farthest


def boundary_angles(mech: TwoDof, count: int) -> np.ndarray:
    """Equal steps over the theta that the workspace spans; an odd count has theta = 0. -> (count,) rad

    That is the half turn where l_max >= l_min + 2 R; with a shorter stroke the workspace ends in
    the corner where one leg is at l_max and the other at l_min.
    """
    nearest, farthest = leg_limits(mech)
    x = (farthest - nearest) * (farthest + nearest) / (4 * mech.half_base)  # eq. (18)
    y = safe.sqrt((nearest - x + mech.half_base) * (nearest + x - mech.half_base))
    end = float(jnp.arctan2(x, y))
    return np.linspace(-end, end, count)


def boundary(mech: TwoDof, theta: np.ndarray) -> Boundary:
    """The boundary on the rays theta (k,), eq. (17)."""
    radii = _radii(mech.half_base, *leg_limits(mech), jnp.asarray(theta, mech.half_base.dtype))
    ray = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    return Boundary(*(np.asarray(radius)[:, None] * ray for radius in radii))


@jax.jit
def _radii(r, nearest, farthest, theta):
    sine, cosine = jnp.abs(jnp.sin(theta)), jnp.cos(theta)
    chord = lambda length: safe.sqrt((length - r * cosine) * (length + r * cosine))
    inner = r * sine + chord(nearest)
    return inner, jnp.maximum(-r * sine + chord(farthest), inner)  # equal in a corner


def outline(mech: TwoDof, count: int = 401) -> np.ndarray:
    """Around the workspace: along the outer boundary and back along the inner one. -> (2 count + 1, 2)"""
    inner, outer = boundary(mech, boundary_angles(mech, count))
    return np.concatenate([outer, inner[::-1], outer[:1]])


def fitted_grid(mech: TwoDof, rays: int = 241, rings: int = 81) -> np.ndarray:
    """Poses on rays, from the inner to the outer boundary, denser towards both. -> (rays, rings, 2)"""
    inner, outer = boundary(mech, boundary_angles(mech, rays))
    fraction = (1 - np.cos(np.linspace(0, np.pi, rings))) / 2
    return inner[:, None] + fraction[:, None] * (outer - inner)[:, None]


def actuators(mech: TwoDof, poses: np.ndarray) -> np.ndarray:
    """Leg lengths, or driven angles in degrees, continuous along every axis of poses. (..., 2) -> (..., 2)

    On the boundary a leg of the five-bar is stretched or folded, so these are the `candidate`s.
    Of the angles that differ by full turns, the middle pose gets -180 <= phi1 < 180 and 0 <= phi2 < 360.
    """
    rows = jnp.asarray(poses.reshape(-1, 2), mech.half_base.dtype)
    values = np.asarray(inverse_kinematics(mech, rows).candidate).reshape(poses.shape)
    if isinstance(mech, TwoRPR):
        return values
    for axis in range(values.ndim - 1):
        values = np.unwrap(values, axis=axis)
    middle = values[tuple(size // 2 for size in values.shape[:-1])]
    turns = np.floor((middle + np.array([np.pi, 0.0])) / (2 * np.pi))
    return np.degrees(values - 2 * np.pi * turns)
