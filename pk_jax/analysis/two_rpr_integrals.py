"""Isotropy of the 2-RPR averaged over its workspace, to machine precision with a 1-D rule."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pk_jax.analysis.quadrature import gauss
from pk_jax.geometry import safe


def isotropy_integral(l_min: jax.Array, outer: int, inner: int) -> jax.Array:
    """Integral of 1/kappa over the workspace l_min <= l1, l2 <= l_min + 2, R = 1. -> ()

    In leg lengths (l1, l2) = r (sin t, cos t) with dW = dl1 dl2 / sin(beta), beta the angle between
    the legs, and cos(beta) = (r^2 - 4) / (r^2 S), S = sin 2t, the integrand is
    1 / (1 + |cos beta|): its integral over r^2 > 4 has a closed form, that over r^2 < 4 is smooth.
    Singular points lie on y = 0 and leave no trace. Gauss panels in t break where r^2 = 4 meets
    the inner limit, at sin t = l_min / 2.
    """
    l_max = l_min + 2
    low, high = jnp.arctan2(l_min, l_max), jnp.pi / 4  # half of it, by symmetry
    is_split = l_min < jnp.sqrt(2.0)
    split = jnp.where(is_split, safe.arcsin(l_min / 2), (low + high) / 2)
    outer_rule, inner_rule = gauss(outer), gauss(inner)
    fraction = jnp.asarray(outer_rule.nodes, l_min.dtype)
    t = jnp.concatenate([low + (split - low) * fraction, split + (high - split) * fraction])
    weight = jnp.asarray(outer_rule.weights, l_min.dtype)
    weight = jnp.concatenate([(split - low) * weight, (high - split) * weight])

    s = jnp.sin(2 * t)
    nearest, farthest = (l_min / jnp.sin(t)) ** 2, (l_max / jnp.cos(t)) ** 2  # in r^2
    middle = jnp.clip(4.0, nearest, farthest)
    above = farthest - middle
    ratio = (1 + s) * above / ((1 + s) * middle - 4)
    obtuse = s / (1 + s) * (above + 4 / (1 + s) * jnp.log1p(ratio))
    squared = nearest[:, None] + (middle - nearest)[:, None] * jnp.asarray(inner_rule.nodes, t.dtype)
    density = squared * s[:, None] / (4 - (1 - s)[:, None] * squared)
    acute = (middle - nearest) * (density @ jnp.asarray(inner_rule.weights, t.dtype))
    return jnp.sum(weight * (obtuse + acute))
