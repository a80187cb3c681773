"""Global indices of the 2-RPR and the 2-RRR: GII, GRI and SUI over the workspace.

Both mechanisms reach W = {l_min <= l_i <= l_min + 2 R, y > 0} (Nam, Lee and Park 2006, sec. 3),
l_i the distance of the end point from base joint i. Everything is computed at R = 1 and scaled.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.analysis import two_rpr_integrals, two_rrr_integrals
from pk_jax.analysis.chunks import forward_mode
from pk_jax.analysis.indices import indices_at
from pk_jax.geometry import safe
from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR
from pk_jax.status import Status

# per direction: bounds the memory of gauss; nodes of the others must resolve the workspace's tips
MOST_NODES = {"gauss": 512, "midpoint": 2000, "paper": 2000}


class IndexErrors(NamedTuple):
    """Estimated absolute errors; NaN where a rule has none to offer."""

    gii: jax.Array
    gri: jax.Array
    sui: jax.Array
    area: jax.Array


class WorkspaceIndices(NamedTuple):
    """Global indices of one design."""

    gii: jax.Array  # () global isotropy index, mean of 1/kappa, eq. (23)
    gri: jax.Array  # () global resistivity index, mean of 1/|det J|, eq. (25); 2-RRR: 1/length^2
    sui: jax.Array  # () space utilization index, area over that of the enclosing box, eq. (26)
    area: jax.Array  # () of the workspace, eq. (24)
    error: IndexErrors
    status: jax.Array  # () Status


def workspace_indices(
    mech: Mechanism, rule: str = "gauss", nodes: tuple[int, int] | None = None
) -> WorkspaceIndices:
    """GII, GRI and SUI of a `TwoRPR` or a `FiveBar` (Nam, Lee and Park 2006, eqs. 23-26).

    The design must satisfy eq. (20), l_max = l_min + 2 R with l_min >= R, and the five-bar eq. (22)
    too: R <= la, R <= lb - la, la + lb = l_max, where `reach` = (l_min, l_max). Others are refused:
    ValueError, or NaN with Status.BAD_INPUT where the values are not known yet (under jit).

    rule:   "gauss": the area-weighted integrals, with an error estimate;
            "midpoint": eq. (29) taken literally, mid-point rings, converging like nodes^-1/2 (float64);
            "paper": the discretization behind the printed tables, recovered from them: interior
            radii only, all radii of a sector weighing the same, no node within 3.6 degrees of y = 0
    nodes:  (outer, inner). gauss: Gauss nodes in each of 3 x 3 panels, default (24, 24), for the
            2-RPR in each of 2 panels, default (10, 8); midpoint: eq. (29)'s (M, N), radial and
            angular, default (200, 300); paper: divisions of the radius and of the half-turn,
            default (50, 100)

    Gradients are exact in the geometry along the designs of eqs. (20) and (22), as a function of
    half_base, l_min and, for the five-bar, proximal. In `proximal` the derivative is infinite at
    la = R; a design space offers the variable v, la = R (1 + v^2), in which it is not.
    `jax.vmap` over designs runs in chunks of bounded memory.
    """
    checks.is_word("rule", rule, _RULES)
    if not isinstance(mech, TwoRPR | FiveBar):
        raise ValueError(f"workspace_indices takes a TwoRPR or a FiveBar, got {type(mech).__name__}")
    if mech.half_base.ndim:
        raise ValueError("workspace_indices takes one design; for a batch: jax.vmap(pk.workspace_indices)")
    if nodes is None:
        nodes = {"midpoint": (200, 300), "paper": (50, 100)}.get(rule, _GAUSS_NODES[type(mech)])
    if not isinstance(nodes, tuple | list) or len(nodes) != 2:
        raise ValueError(f"nodes must be two integers (outer, inner), got {checks.shown(nodes)}")
    least = 4 if rule == "paper" else 2
    nodes = tuple(checks.is_count("nodes", count, least=least, most=MOST_NODES[rule]) for count in nodes)
    if rule == "midpoint" and mech.half_base.dtype != jnp.float64:
        raise ValueError(
            "rule 'midpoint' needs float64, whose digits resolve its nodes at the tips of the workspace: "
            "call pk_jax.enable_x64() first"
        )
    if checks.is_concrete(mech):
        with jax.ensure_compile_time_eval():
            _require_admissible(mech)
    return _indices(mech, rule, nodes)


@functools.partial(jax.jit, static_argnums=(1, 2))
def _indices(mech: Mechanism, rule: str, nodes: tuple[int, int]) -> WorkspaceIndices:
    is_ok = functools.reduce(jnp.logical_and, [slack >= 0 for _, slack in _slacks(mech)])
    substitute = _some_design(mech)  # a refused design works on this one and is masked after
    mech = jax.tree.map(lambda own, other: jnp.where(is_ok, own, other), mech, substitute)
    found = _RULES[rule](mech, nodes)
    found = jax.tree.map(lambda value: jnp.where(is_ok, value, jnp.nan), found)
    status = jnp.where(is_ok, Status.OK, Status.BAD_INPUT).astype(jnp.int32)
    return WorkspaceIndices(*found, status)


# --- which designs


def _stroke(mech: Mechanism) -> tuple[jax.Array, jax.Array]:
    """Least and greatest distance of the end point from a base joint."""
    return (mech.l_min, mech.l_max) if isinstance(mech, TwoRPR) else mech.limits()


def _slacks(mech: Mechanism) -> list[tuple[str, jax.Array]]:
    """The conditions of eqs. (20) and (22), as (what must hold, value >= 0), in units of R."""
    r = mech.half_base
    l_min, l_max = (limit / r for limit in _stroke(mech))
    roundoff = jnp.sqrt(jnp.finfo(r.dtype).eps)
    slacks = [
        ("l_max = l_min + 2 half_base, eq. (20)", -jnp.abs(l_max - l_min - 2)),
        ("l_min >= half_base, eq. (20)", l_min - 1),
    ]
    if isinstance(mech, FiveBar):
        la, lb = mech.proximal / r, mech.distal / r
        slacks += [
            ("proximal + distal = l_max, eq. (22)", -jnp.abs(la + lb - l_max)),
            ("proximal >= half_base, eq. (22)", la - 1),
            ("distal - proximal >= half_base, eq. (22)", lb - la - 1),
        ]
    return [(what, slack + roundoff) for what, slack in slacks]


def _require_admissible(mech: Mechanism) -> None:
    for what, slack in _slacks(mech):
        if not slack >= 0:
            l_min, l_max = _stroke(mech)
            raise ValueError(
                f"workspace_indices needs {what}; got {mech!r}, l_min {l_min:.9g}, l_max {l_max:.9g}"
            )


def _some_design(mech: Mechanism) -> Mechanism:
    """An admissible design with the same fields, l_min = 2 R."""
    if isinstance(mech, TwoRPR):
        return TwoRPR(half_base=1.0, l_min=2.0, l_max=4.0)
    return FiveBar(
        half_base=1.0,
        proximal=1.25,
        distal=2.75,
        reach=None if mech.reach is None else (2.0, 4.0),
        slack=None if mech.slack is None else 0.5,
    )


def _coordinates(mech: Mechanism) -> tuple[jax.Array, jax.Array]:
    """(l_min, v) at R = 1. Roundoff outside the admissible designs is brought back in."""
    l_min = _stroke(mech)[0] / mech.half_base
    l_min = jnp.where(l_min >= 1, l_min, 1)  # jnp.maximum would halve the derivative at 1
    if isinstance(mech, TwoRPR):
        return l_min, jnp.zeros_like(l_min)
    if mech.slack is not None:
        return l_min, mech.slack
    excess = mech.proximal / mech.half_base - 1
    return l_min, jnp.where(excess > 0, jnp.sqrt(jnp.where(excess > 0, excess, 1)), 0)


# --- the rules: mechanism, nodes -> gii, gri, sui, area, errors


def _gauss(mech: Mechanism, nodes: tuple[int, int]):
    l_min, v = _coordinates(mech)
    size = workspace_area(l_min)
    means = _mean_indices(mech, l_min, v, nodes)
    coarse = tuple(max(1, count - max(2, count // 3)) for count in nodes)
    other = lax.stop_gradient(_mean_indices(mech, l_min, v, coarse))
    gii, gri = means
    sui, area = size / enclosing_box(l_min), size * mech.half_base**2
    roundoff = 256 * jnp.finfo(gii.dtype).eps
    # the difference to a coarser rule is that rule's error; both may share a part of theirs
    errors = [4 * jnp.abs(a - b) + roundoff * jnp.abs(a) for a, b in zip(means, other, strict=True)]
    return gii, gri, sui, area, IndexErrors(*errors, roundoff * sui, roundoff * area)


_GAUSS_NODES = {TwoRPR: (10, 8), FiveBar: (24, 24)}


def _mean_indices(mech: Mechanism, l_min, v, nodes: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
    """GII and GRI by Gauss panels. The resistivity of the 2-RPR integrates to (l_max - l_min)^2."""
    size = workspace_area(l_min)
    if isinstance(mech, TwoRPR):
        return two_rpr_integrals.isotropy_integral(l_min, *nodes) / size, 4 / size
    isotropy, resistivity, _ = _two_rrr(*nodes)(jnp.stack([l_min, v]))
    return isotropy / size, resistivity / size / mech.half_base**2


@functools.lru_cache
def _two_rrr(outer: int, inner: int):
    return forward_mode(lambda p: jnp.stack(two_rrr_integrals.integrals(p[0], p[1], outer, inner)))


def _midpoint(mech: Mechanism, nodes: tuple[int, int]):
    """Eq. (29): rings of equal width, the integrand at their middle, on equal sectors."""
    rings, sectors = nodes
    theta = (np.arange(sectors) + 0.5) / sectors * np.pi - np.pi / 2
    fraction = (np.arange(rings) + 0.5) / rings

    def weigh(inner, outer):
        edges = inner + jnp.arange(rings + 1) / rings * (outer - inner)
        return edges[1:] ** 2 - edges[:-1] ** 2

    l_min = _coordinates(mech)[0]
    gii, gri, weight, _ = _sum_sectors(mech, theta, fraction, weigh)
    return _summed(mech, gii, gri, weight / 2 * jnp.pi / sectors, enclosing_box(l_min))


def _paper(mech: Mechanism, nodes: tuple[int, int]):
    """What the printed tables were computed with; eta = sum (M^2 - m^2) mean_j I / sum (M^2 - m^2)."""
    rings, sectors = nodes
    theta = np.arange(2, sectors - 1) / sectors * np.pi - np.pi / 2
    fraction = np.arange(1, rings) / rings

    def weigh(inner, outer):
        return jnp.broadcast_to((outer**2 - inner**2) / (rings - 1), (rings - 1,))

    l_min = _coordinates(mech)[0]
    gii, gri, weight, reach = _sum_sectors(mech, theta, fraction, weigh)
    width = l_min + 1 if isinstance(mech, TwoRPR) else reach
    box = 2 * width * jnp.sqrt((l_min + 2) ** 2 - 1)
    return _summed(mech, gii, gri, weight / 2 * jnp.pi / sectors, box)


def _sum_sectors(mech: Mechanism, theta, fraction, weigh):
    """Weighted means of both indices, the total weight, and the greatest x of a sector's end.

    Radii at `fraction` between the limits of eq. (17); lengths in R, theta from the y axis, spread
    symmetrically: sectors of x >= 0 are computed and those beside the y axis count twice.
    """
    l_min = _coordinates(mech)[0]
    dtype = l_min.dtype
    theta, fraction = jnp.asarray(theta, dtype), jnp.asarray(fraction, dtype)
    half = theta[: -(-len(theta) // 2)]
    times = jnp.where(jnp.arange(len(half)) < len(theta) // 2, 2, 1).astype(dtype)

    def sector(theta):
        sine, cosine = jnp.abs(jnp.sin(theta)), jnp.cos(theta)
        outer = -sine + safe.sqrt((l_min + 2) ** 2 - cosine**2)
        inner = sine + safe.sqrt(l_min**2 - cosine**2)
        radius = (inner + fraction * (outer - inner)) * mech.half_base
        poses = radius[:, None] * jnp.stack([-jnp.sin(theta), cosine])
        isotropy, resistivity = jax.vmap(lambda x: indices_at(mech, x, mech.inverse(x)))(poses)
        weight = weigh(inner, outer).astype(dtype)
        return weight @ isotropy, weight @ resistivity, jnp.sum(weight), outer

    isotropy, resistivity, weight, outer = lax.map(sector, half)
    total = times @ weight
    return (
        times @ isotropy / total,
        times @ resistivity / total,
        total,
        jnp.max(outer * jnp.abs(jnp.sin(half))),
    )


def _summed(mech: Mechanism, gii, gri, area, box):
    unknown = jnp.full_like(gii, jnp.nan)
    return gii, gri, area / box, area * mech.half_base**2, IndexErrors(*[unknown] * 4)


_RULES = {"gauss": _gauss, "midpoint": _midpoint, "paper": _paper}


# --- eqs. (24) and (26) in closed form, R = 1


@jax.custom_jvp
def workspace_area(l_min: jax.Array) -> jax.Array:
    """Area of {l_min <= l_i <= l_min + 2, y > 0}, the integral of eq. (24). -> ()

    The upper half of the lens of both outer circles less that of the union of both inner ones.
    Its derivative is written out: term by term it would be infinite at l_min = 1.
    """
    l_max = l_min + 2
    lens = l_max**2 * _half_angle(l_max) - _height(l_max)
    union = jnp.pi * l_min**2 - l_min**2 * _half_angle(l_min) + _height(l_min)
    return lens - union


@workspace_area.defjvp
def _workspace_area_jvp(primals, tangents):
    (l_min,), (dl_min,) = primals, tangents
    l_max = l_min + 2
    slope = 2 * (l_max * _half_angle(l_max) + l_min * _half_angle(l_min) - jnp.pi * l_min)
    return workspace_area(l_min), slope * dl_min


def enclosing_box(l_min: jax.Array) -> jax.Array:
    """Area of the least rectangle around the workspace, S of eq. (26). -> ()"""
    return 2 * (l_min + 1) * _height(l_min + 2)


def _height(radius: jax.Array) -> jax.Array:
    """Where a circle about a base joint meets the y axis."""
    return safe.sqrt((radius - 1) * (radius + 1))


def _half_angle(radius: jax.Array) -> jax.Array:
    """arccos(1 / radius), accurate near radius = 1."""
    return jnp.arctan2(_height(radius), jnp.ones_like(radius))
