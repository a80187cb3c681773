"""How large a region is in every direction, so that rays look at it where it is."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax.analysis import charts
from pk_jax.analysis.region import Given, Region, limits_at
from pk_jax.geometry.matrices import orthonormal

PROBES = 40  # of a region along an axis, each nearer by 2 ** 0.5
LONGEST = 4  # axis of a region that no axis meets, over its shortest one


def whitening(region: Region, given: Given) -> tuple[jax.Array, jax.Array]:
    """A linear map that makes the region about as wide in every direction, and its volume. -> (n, n), ()

    Its ellipsoid is that of Dikin: the Hessian of the logarithmic barrier of all limits at the centre.
    """
    n = region.size(given.centre)
    zero = jnp.zeros(n, jax.tree.leaves(given.centre)[0].dtype)
    of = lambda y: limits_at(region, given, y)
    value, slope = of(zero), jax.jacfwd(of)(zero)
    is_known = jnp.isfinite(value) & jnp.all(jnp.isfinite(slope), axis=1)
    away = jnp.maximum(jnp.abs(jnp.where(is_known, value, 1)), 1e-2)
    rows = jnp.where(is_known[:, None], slope, 0) / away[:, None]
    scale, axes = given.scale, region.axes
    own = 1e-2 * jnp.diag(1 / (scale if axes is None else scale[np.array(axes)]))
    _, lower, sizes = orthonormal(jnp.concatenate([rows, own]).T)
    wide = lower.T
    extents = _extents(region, given, wide)
    return lax.stop_gradient((wide * extents, jnp.prod(extents) / jnp.prod(sizes)))


def _extents(region: Region, given: Given, wide: jax.Array) -> jax.Array:
    """How far the region goes along each column of `wide`, to a few tenths. -> (n,)

    The barrier alone knows nothing of directions in which no limit rises or falls at the centre. An axis
    that does not meet the region is taken to be no longer than those that do.
    """
    far = jax.vmap(partial(farthest, region, given), in_axes=-1)(wide)
    t = far * 2.0 ** (-0.5 * jnp.arange(PROBES, dtype=far.dtype))[:, None]
    y = jnp.stack([t, -t])[..., None] * wide.T
    limits = jax.vmap(partial(limits_at, region, given))(y.reshape(-1, len(wide)))
    is_inside = jnp.all(limits >= 0, axis=1).reshape(2, *t.shape)  # NaN compares False
    found = jnp.max(jnp.where(is_inside, t, 0), axis=(0, 1))
    axes, scale = region.axes, given.scale
    shares = jnp.linalg.norm(wide / (scale if axes is None else scale[np.array(axes)])[:, None], axis=0)
    longest = jnp.max(found * shares)
    longest = jnp.where(longest > 0, longest, LONGEST * jnp.min(shares))
    return jnp.where(found > 0, found, jnp.minimum(1, longest / shares))


def farthest(region: Region, given: Given, direction: jax.Array) -> jax.Array:
    """Where a ray y = t direction ends. -> ()"""
    whole = region.whole(given.centre, direction)
    return charts.farthest(given.mech, given.centre, given.scale, whole)
