"""Integrals of local indices over the workspace of any mechanism, with error estimates and gradients."""

from __future__ import annotations

import math
from collections.abc import Hashable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.analysis import stroke_rule
from pk_jax.analysis.measures import length_of, names_of
from pk_jax.analysis.ray_rules import Counts, Problem, direction_sets, many_rays, panels
from pk_jax.analysis.rays import Detail
from pk_jax.analysis.region import MOST_BROKEN, Given, Region, count_limits, given_of
from pk_jax.analysis.slices import coordinate_names
from pk_jax.geometry.poses import Turning, tangent_size
from pk_jax.kinematics.batching import home_shapes, rows_of
from pk_jax.kinematics.inverse import branch_rows, free_rows
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

_CELLS = {2: 64, 3: 64}
_DETAIL = {2: (16, 6, 24), 3: (12, 6, 12)}  # slots, intervals, halvings
RULES = ("strokes", "panels", "rays")
SAFETY = 4.0  # times the difference to a coarser rule
DOUBTFUL = 0.1  # error of a derivative over the greatest one, from which on derivatives are refused
MOST_GRAZING = 0.05  # share of tangent rays beyond which a rule of many rays is not believed
# Student's factors for a two-sided 95 % of the mean of r values, r - 1 = 1 .. 15
_STUDENT = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18, 2.16, 2.14, 2.13)


class Errors(NamedTuple):
    """Estimated absolute errors."""

    volume: jax.Array
    integral: jax.Array
    mean: jax.Array


class WorkspaceIntegral(NamedTuple):
    """Of one design. Everything is NaN unless the status is OK."""

    volume: jax.Array  # () of the workspace: unit of length and radian, as many as there are coordinates
    integral: jax.Array  # () of the index over the workspace; (f,) of several
    mean: jax.Array  # () or (f,) integral / volume
    error: Errors
    counts: Counts  # of rays; of the stroke rule: nodes, and those that the strokes alone do not bound
    replicates: jax.Array  # (r, 1 + f) volume and integrals by each of the rules that the errors come from
    status: jax.Array  # () Status


class _Plan(NamedTuple):
    """Everything static about an integral."""

    problem: Problem
    rule: str
    nodes: int
    replicates: int
    is_single: bool
    devices: tuple = ()  # that share the rays


def workspace_integral(
    mech: Mechanism,
    index: Any = "frobenius_isotropy",
    *,
    axes: Any = None,
    within: Any = None,
    clearance: float | None = None,
    margins: Any = None,
    about: Any = None,
    branch: Any = None,
    free: Any = None,
    length: float | None = None,
    rule: str | None = None,
    nodes: int | None = None,
    rays: int | None = None,
    replicates: int = 8,
    cells: int | None = None,
    seed: int = 0,
    devices: Any = None,
) -> WorkspaceIntegral:
    """Volume of the workspace, and integral and mean of local indices over it. Differentiable in `mech`.

    The workspace is every pose with all margins >= 0, in one working mode, connected to home or not; by the
    rule "strokes" those of home's assembly mode.
    Volumes are in the mechanism's unit of length and radians; rotations in space by Haar's measure.

    index:      "frobenius_isotropy" (smooth, for optimization), "isotropy" (1/kappa), "resistivity",
                "manipulability", "stiffness", "clearance" (of type II), "singularity_distance", or a
                function of (mech, pose, joints); or several, or none: ()
    axes:       names of the coordinates that vary, the others staying as in `about`; default: all
    within:     {coordinate: (least, greatest)}, limits of coordinates named as by `singularity_locus`
    clearance:  least "clearance" of the poses that count, on the side of singularities where home is
    margins:    function of (mech, pose, joints) with further limits, >= 0 inside, smooth in reach
    about:      pose from which rays start; default: home. Best is the middle of the workspace. It stays put
                when designs move
    branch, free:  working mode, and values of kinematically redundant joints; default: the mechanism's own
    length:     what lengths are measured in, in the indices; default: `mech.length()`
    rule:       "strokes": Gauss nodes on the box of strokes, where strokes alone bound the workspace, as many
                as there are freedoms; "panels" (planar positions); "rays". Default: panels for two
                freedoms; otherwise strokes if they do, tried on known values, else rays
    nodes:      Gauss nodes: along each stroke (default 16, 10, 6, 4 for 2, 3, 4, 6 freedoms), each panel (16)
                or each interval of a ray (8)
    rays:       panels: angles looked at for changes (256); rays: directions in each of the replicates
                (2048, for more than three freedoms 1024)
    replicates: sets of rays, from whose spread the error is estimated (at least 4)
    cells:      of the scan along each ray (64, for more than three freedoms 32)
    devices:    rays are shared out to them (`jax.devices()`); sums then differ by roundoff; default: one
    seed:       which turns the sets of rays get; the same seed gives the same numbers

    Errors: panels and strokes: against a coarser rule, rays: 95 % of the spread over replicates. Gradients
    of `replicates` have their spread, see `integral_gradient`.

    Status: OK; INCOMPLETE: rays that do not end, more crossings than there is room for, many tangent rays,
    or strokes that do not bound the workspace; UNREACHABLE: no pose is inside; NONFINITE: an
    integrand has no finite value; BAD_INPUT: the geometry is not finite. Answers are then NaN.
    ValueError for a mechanism without margins or without a closed form `inverse`.
    """
    require_mechanism("workspace_integral", mech)
    given = _given(mech, about, branch, free)
    region = _region(given, axes, within, clearance, margins, length)
    plan = _plan(given, region, index, rule, nodes, rays, replicates, cells)
    if rule is None and plan.rule == "strokes":
        found = _integral(plan, given, None) if checks.is_concrete(given) and not checks.is_staged() else None
        if found is not None and int(found.status) == Status.OK:
            return found
        plan = _plan(given, region, index, "rays", nodes, rays, replicates, cells)
    unit = None
    if plan.rule == "rays":
        n = region.size(given.centre)
        plan = plan._replace(devices=tuple(checks.are_devices("devices", devices)))
        unit = jnp.asarray(
            direction_sets(n, _rays(rays, n), plan.replicates, checks.is_count("seed", seed, least=0)),
            jax.tree.leaves(given.centre)[0].dtype,
        )
    return _integral(plan, given, unit)


class IntegralGradient(NamedTuple):
    """Derivatives of a workspace's volume and of its indices in the design variables, with their errors."""

    value: WorkspaceIntegral
    volume: jax.Array  # (n,)
    integral: jax.Array  # (n,), or (f, n)
    mean: jax.Array
    error: Errors  # of these
    status: jax.Array  # () Status: that of the value, or INCOMPLETE: errors too large, some derivatives NaN


def integral_gradient(mechanism: Any, vector: Any, index: Any = "frobenius_isotropy", **options: Any):
    """`workspace_integral` of mechanism(vector) and its derivatives in vector (n,). -> IntegralGradient

    mechanism:  function (n,) -> Mechanism, traceable
    options:    of `workspace_integral`; without a rule panels for two freedoms, else rays

    The errors are those of the derivatives, estimated as those of the values are, and apart from them.
    Those of a quantity are refused (NaN) where an error exceeds a tenth of its greatest one. A `clearance`
    meets limits of reach at cusps, next to which derivatives converge slowly: their errors say so.
    """
    vector = checks.real_array("vector", vector)
    checks.has_shape("vector", vector, (None,))
    if not callable(mechanism):
        raise ValueError(f"mechanism must be a function of a vector, got {type(mechanism).__name__}")
    is_single = not isinstance(index, tuple | list)
    several = names_of(index)
    index = several[0] if is_single else several
    slopes, found = _replicate_slopes(mechanism, vector, index, _Options(options))
    values = found.replicates
    means = values[:, 1:] / values[:, :1]
    mean_slopes = (slopes[:, 1:] - means[..., None] * slopes[:, :1]) / values[:, :1, None]
    is_spread = len(values) > 2  # by sets of rays
    parts = [slopes[:, 0], slopes[:, 1:], mean_slopes]
    best, errors = zip(*(_judged(part, is_spread) for part in parts), strict=True)
    is_sure = [(found.status == Status.OK) & _is_sure(*each) for each in zip(best, errors, strict=True)]
    best = [jnp.where(sure[..., None], each, jnp.nan) for sure, each in zip(is_sure, best, strict=True)]
    is_good = jnp.all(jnp.concatenate([jnp.ravel(sure) for sure in is_sure]))
    status = jnp.where(is_good | (found.status != Status.OK), found.status, Status.INCOMPLETE)
    flat = (lambda x: x[0]) if is_single else (lambda x: x)
    return IntegralGradient(
        found,
        best[0],
        flat(best[1]),
        flat(best[2]),
        Errors(errors[0], flat(errors[1]), flat(errors[2])),
        status,
    )


def _is_sure(slopes: jax.Array, errors: jax.Array) -> jax.Array:
    """Whether derivatives (..., n) are known well enough; they are where all are zero. -> (...)"""
    greatest = jnp.max(jnp.abs(slopes), axis=-1, initial=0)
    tiny = 1e3 * jnp.finfo(slopes.dtype).eps
    return jnp.max(errors, axis=-1, initial=0) <= DOUBTFUL * greatest + tiny  # NaN compares False


class _Options:
    """Options of `workspace_integral` as one static argument, compared by all their digits."""

    def __init__(self, options: dict[str, Any]) -> None:
        self.options = options
        leaves, tree = jax.tree.flatten(options)
        self.key = (tree, *(_frozen(leaf) for leaf in leaves))

    def __eq__(self, other: Any) -> bool:
        return self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def _frozen(leaf: Any) -> Any:
    """An array by its bytes, anything else as it is (what cannot be hashed is refused later)."""
    if isinstance(leaf, jax.Array | np.ndarray):
        array = np.asarray(leaf)
        return array.shape, array.dtype.str, array.tobytes()
    return type(leaf), leaf if isinstance(leaf, Hashable) else repr(leaf)


@partial(jax.jit, static_argnums=(0, 2, 3))
def _replicate_slopes(mechanism: Any, vector: jax.Array, index: Any, options: _Options):
    def of(vector):
        found = workspace_integral(mechanism(vector), index, **options.options)
        return found.replicates, found

    return jax.jacrev(of, has_aux=True)(vector)  # (r, 1 + f, n)


# --- the question, put in order


def _given(mech: Mechanism, about: Any, branch: Any, free: Any) -> Given:
    if not hasattr(mech, "inverse"):
        raise ValueError(
            f"workspace_integral needs the closed form `inverse`, {type(mech).__name__} has none"
        )
    pose = home_shapes(mech)[0]
    if about is not None:
        about, many = rows_of("about", about, pose)
        if many:
            raise ValueError("about must be one pose, got a batch")
    branch = None if branch is None else branch_rows(mech, branch)[0]
    free = None if free is None else free_rows(mech, free)[0]
    return given_of(mech, about, branch, free)


def _region(given, axes, within, clearance, margins, length) -> Region:
    if clearance is not None and not checks.is_number(clearance):
        raise ValueError(f"clearance must be a finite number, got {checks.shown(clearance)}")
    if margins is not None and not callable(margins):
        raise ValueError(f"margins must be a function of (mech, pose, joints), got {checks.shown(margins)}")
    region = Region(_within(given.mech, within), clearance, margins, length_of(length), _axes(given, axes))
    n = region.size(given.centre)
    if n not in (2, 3, 4, 6):
        raise ValueError(f"workspace_integral is for 2, 3, 4 or 6 coordinates that vary, got {n}")
    if not sum(count_limits(region, given)):
        raise ValueError(f"{type(given.mech).__name__} has no margins: give it limits (strokes, cones, ...)")
    return region


def _axes(given: Given, axes: Any) -> tuple[int, ...] | None:
    if axes is None:
        return None
    names = coordinate_names(given.mech)
    axes = checks.are_words("axes", axes)
    if len(set(axes)) != len(axes) or not set(axes) <= set(names):
        raise ValueError(f"axes must be different ones of {', '.join(names)}, got {axes}")
    found = tuple(sorted(names.index(name) for name in axes))
    turns = {names.index(name) for name in names[-3:]} if isinstance(given.centre, Turning) else set()
    if turns & set(found) not in (set(), turns):
        raise ValueError(f"axes must hold all of {', '.join(names[-3:])} or none, got {axes}")
    return None if len(found) == len(names) else found


def _plan(given, region, index, rule, nodes, rays, replicates, cells) -> _Plan:
    n, kind = region.size(given.centre), type(given.mech).__name__
    if rule is not None:
        checks.is_word("rule", rule, RULES)
    strokes = stroke_rule.count_strokes(given) if region.axes is None else 0
    if rule is None:
        is_box = strokes == n and given.mech.joints_are_distances
        rule = "panels" if n == 2 else "strokes" if is_box else "rays"
    if rule == "panels" and n != 2:
        raise ValueError(f"rule 'panels' is for two coordinates that vary, got {n}")
    if rule == "strokes" and strokes != n:
        raise ValueError(
            f"rule 'strokes' needs as many strokes as freedoms, {kind} has {strokes} strokes for {n}"
        )
    several = names_of(index)
    default = {"strokes": {2: 16, 3: 10, 4: 6}.get(n, 4), "panels": 16, "rays": 8}[rule]
    nodes = default if nodes is None else checks.is_count("nodes", nodes, least=2, most=64)
    is_broken = bool(several) and _is_square(given) and rule != "strokes"
    cells = _CELLS.get(n, 32) if cells is None else checks.is_count("cells", cells, least=8, most=4096)
    detail = Detail(cells, *_DETAIL.get(n, (8, 4, 12)))
    problem = Problem(region._replace(is_broken=is_broken), several, detail, nodes)
    replicates = checks.is_count("replicates", replicates, least=4, most=16) if rule == "rays" else 2
    if rule == "panels":
        nodes = _rays(rays, n)
    _must_fit(rule, n, nodes, _rays(rays, n), replicates)
    return _Plan(problem, rule, nodes, replicates, not isinstance(index, tuple | list))


def _is_square(given: Given) -> bool:
    """Whether det A is known, and cheap."""
    size = tangent_size(given.centre)
    mech = given.mech
    rows = jax.eval_shape(lambda mech: mech.residual(*mech.home()), mech).shape[0]
    return (mech.actuated_rows or rows) == size <= MOST_BROKEN


def _must_fit(rule: str, n: int, nodes: int, rays: int, replicates: int) -> None:
    """ValueError where the nodes or rays of a rule do not fit into memory."""
    if rule == "strokes":
        checks.fits(f"nodes = {nodes} along each of {n} strokes", 8 * (3 * n + 4) * nodes**n, "take fewer")
    elif rule == "rays":
        size = 8 * (4 * n + 3 * replicates + 32) * rays * replicates  # each ray with its intervals
        checks.fits(f"{replicates} replicates of rays = {rays}", size, "take fewer")


def _rays(rays: int | None, n: int) -> int:
    if rays is None:
        return {2: 256, 3: 2048}.get(n, 1024)
    return checks.is_count("rays", rays, least=8, most=1_000_000)


def _within(mech: Mechanism, within: Any) -> tuple[tuple[int, float, float], ...]:
    if within is None:
        return ()
    names = coordinate_names(mech)
    found = []
    for name, limits in checks.is_dict("within", within).items():
        if name not in names:
            raise ValueError(f"within must name coordinates, of {', '.join(names)}, got {name!r}")
        ends = checks.real_numpy(f"within[{name!r}]", limits)
        if ends.shape != (2,) or not ends[0] < ends[1] or not np.all(np.isfinite(ends)):
            raise ValueError(f"within[{name!r}] must be (least, greatest), got {checks.shown(limits)}")
        found.append((names.index(name), float(ends[0]), float(ends[1])))
    return tuple(found)


# --- the answer


@partial(jax.jit, static_argnums=0)
def _integral(plan: _Plan, given: Given, unit: jax.Array | None) -> WorkspaceIntegral:
    is_given = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(given)]))
    replicates, counts = _replicates(plan, given, unit)
    volumes, means = replicates[:, :1], replicates[:, 1:] / replicates[:, :1]
    is_spread = plan.rule == "rays"
    (volume, integral, mean), errors = zip(
        *(_judged(part, is_spread) for part in (volumes[:, 0], replicates[:, 1:], means)), strict=True
    )
    grazing = counts.grazing > MOST_GRAZING * counts.rays if is_spread else False
    is_lost = (counts.open > 0) | (counts.crowded > 0) | grazing
    status = jnp.where(is_lost, Status.INCOMPLETE, Status.OK)
    status = jnp.where(volume > 0, status, Status.UNREACHABLE)
    status = jnp.where(jnp.all(jnp.isfinite(replicates)), status, Status.NONFINITE)
    status = jnp.where(is_given, status, Status.BAD_INPUT).astype(jnp.int32)
    flat = (lambda x: x[0]) if plan.is_single and mean.shape == (1,) else (lambda x: x)
    mask = lambda value: jnp.where(status == Status.OK, value, jnp.nan)
    errors = Errors(*map(lax.stop_gradient, (errors[0], flat(errors[1]), flat(errors[2]))))
    answers = jax.tree.map(mask, (volume, flat(integral), flat(mean), errors))
    return WorkspaceIntegral(*answers, counts, mask(replicates), status)


def _replicates(plan: _Plan, given: Given, unit: jax.Array | None) -> tuple[jax.Array, Counts]:
    """The integrals by every rule that is compared. -> (r, 1 + f), Counts"""
    if plan.rule == "rays":
        return many_rays(plan.problem, given, unit, plan.replicates, plan.devices)
    if plan.rule == "panels":
        return panels(plan.problem, given, plan.nodes)
    fine, validity = stroke_rule.box(plan.problem, given, plan.nodes)
    coarse, _ = stroke_rule.box(plan.problem, given, plan.nodes - 1)
    nodes = jnp.asarray(plan.nodes ** tangent_size(given.centre))
    lost = validity.lost + validity.turned
    return jnp.stack([fine, coarse]), Counts(nodes, validity.limited, lost, jnp.zeros_like(lost))


def _judged(values: jax.Array, is_spread: bool) -> tuple[jax.Array, jax.Array]:
    """The best of values (r, ...) by several rules, and its error. -> (...), (...)"""
    roundoff = 256 * jnp.finfo(values.dtype).eps
    if is_spread:
        count = values.shape[0]
        best = jnp.mean(values, axis=0)
        spread = jnp.std(lax.stop_gradient(values), axis=0, ddof=1)
        return best, _STUDENT[count - 2] * spread / math.sqrt(count) + roundoff * jnp.abs(best)
    best = values[0]  # where convergence is slow, the difference is only a part of the error
    difference = jnp.abs(lax.stop_gradient(values[0] - values[1]))
    return best, SAFETY * difference + roundoff * jnp.abs(best)
