"""Where a mechanism is singular: curves of type I and II over coordinates of its pose.

Least distances to a singularity, on a grid of every working mode, are polished to roundoff and followed along
the curve that they lie on (`continuation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.continuation import EXACT, Follower, Piece, Report
from pk_jax.analysis.singularity import SingularityKind, classify_singularity, length_or_own
from pk_jax.analysis.slices import BLOCK, joints_of, poses_on, slice_of
from pk_jax.kinematics.batching import home_shapes
from pk_jax.kinematics.inverse import branch_rows, free_rows, working_modes
from pk_jax.kinematics.jacobian import pose_jacobian
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status

NODES = {2: 101, 3: 25}  # of the grid, along each axis
SINGULAR_NODES = 0.2  # of all nodes of a mode: so many are no curve, but the whole slice
SAME_MODE = 1e-4  # rad or length: at a reach limit two modes differ by the root of roundoff


class LocusCurve(NamedTuple):
    """A connected piece of a locus: k points in order (k = 1: an isolated point)."""

    kind: SingularityKind  # TYPE_I or TYPE_II; single points may be of both
    coordinates: np.ndarray  # (k, d) values of the axes
    pose: Any  # (k, ...)
    joints: np.ndarray  # (k, m)
    branch: np.ndarray  # (k, s) signs of the working mode; 0: an arm between two modes
    motion: np.ndarray  # (k, n) twist of the platform (type II), or (k, m) joint rates, that is left free
    sigma: np.ndarray  # (k,) distance to the singularity: zero to roundoff
    is_closed: bool


class SingularityLocus(NamedTuple):
    """The loci over a slice of the workspace, and the grid that they were found on."""

    axes: tuple[str, ...]
    units: tuple[int, ...]  # of the axes: 1 = length, 0 = angle
    at: Any  # the pose that has the other coordinates
    nodes: tuple[np.ndarray, ...]  # of the grid
    branches: np.ndarray  # (modes, s)
    sigma_inverse: np.ndarray  # (modes, *grid) NaN out of reach
    sigma_direct: np.ndarray
    curves: tuple[LocusCurve, ...]
    everywhere: tuple[tuple[SingularityKind, np.ndarray], ...]  # kinds and modes singular all over the slice

    def of(self, kind: SingularityKind) -> tuple[LocusCurve, ...]:
        """The curves of one type."""
        return tuple(curve for curve in self.curves if curve.kind == kind)


def singularity_locus(
    mech: Mechanism,
    axes: Sequence[str] | str | None = None,
    *,
    at: Any = None,
    ranges: Any = None,
    branch: Any = None,
    free: Any = None,
    kinds: Sequence[str] = ("I", "II"),
    nodes: int | None = None,
    length: Any = None,
    report: Report | None = None,
) -> SingularityLocus:
    """The type I and type II loci of a mechanism over two coordinates of its pose, in all working modes.

    axes:    two of x, y, z, rx, ry, rz or phi; default: the first two. Three for a type II locus of a
             redundantly actuated robot, which has codimension c - n + 1: curves in a box (c = n + 1)
             and single points in a plane.
    at:      pose with the other coordinates; default: home
    ranges:  ((lower, upper), ...) of the axes; default: what the mechanism reaches
    branch:  one working mode; default: all of them
    free:    values (k,) of the kinematically redundant joints, where the mechanism has some; default: as
             at home
    kinds:   which of "I", "II"; I is not sought where joints are kinematically redundant
    nodes:   of the grid, along each axis: features smaller than its cells may be missed
    length:  what lengths are measured in; default `mech.length()`
    report:  called with (what, done, total)

    Points satisfy their equations to 1e-10 or better. Where determinants touch zero without changing
    sign, the points are found too: the search looks for least singular values, not for signs.
    """
    require_mechanism("singularity_locus", mech)
    checks.is_function("report", report)
    if not checks.is_concrete((mech, at, branch, free, length)):
        raise ValueError("singularity_locus works on known values only; see singularity_distance")
    if mech.length().dtype != jnp.float64:
        raise ValueError(
            "singularity_locus needs float64: call pk_jax.enable_x64() before making the mechanism"
        )
    kinds = checks.are_words("kinds", kinds)
    if not kinds or set(kinds) - {"I", "II"}:
        raise ValueError(f'kinds must be of "I", "II", got {kinds}')
    if free is not None:
        free, many = free_rows(mech, free)
        if many:
            raise ValueError("free must be one value of each joint, got a batch")
    kinds = _curves_of(mech, 2 if axes is None else len(checks.are_words("axes", axes)), kinds)
    where = slice_of(mech, axes, at, ranges)
    nodes = checks.is_count("nodes", NODES[len(where.axes)] if nodes is None else nodes, least=3, most=2001)
    length = length_or_own(mech, length)
    modes = working_modes(mech)
    if branch is not None:
        modes = np.asarray(branch_rows(mech, branch)[0]).reshape(1, -1)
    numbers = 30 + len(modes) * (4 + home_shapes(mech)[1].shape[0])  # a node: poses, and of each mode joints
    checks.fits(f"nodes = {nodes}", 8 * numbers * nodes ** len(where.axes), "take fewer")
    say = report or (lambda *_: None)

    lines, poses = where.grid(nodes)
    shape = (nodes,) * len(lines)
    inverse, direct, joints = [], [], []
    for number, mode in enumerate(modes):
        say("grid, working mode", number, len(modes))
        q = joints_of(mech, poses, mode, free)
        found = classify_singularity(mech, poses, q, length=length)
        is_there = np.asarray(found.status) == Status.OK
        inverse.append(np.where(is_there, found.sigma_inverse, np.nan).reshape(shape))
        direct.append(np.where(is_there, found.sigma_direct, np.nan).reshape(shape))
        joints.append(q)
    sigmas = {"I": np.stack(inverse), "II": np.stack(direct)}

    values = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    curves: list[LocusCurve] = []
    everywhere = []
    for kind in kinds:
        starts = []
        for mode, sigma, q in zip(modes, sigmas[kind], joints, strict=True):
            there = sigma[np.isfinite(sigma)]
            if there.size and np.mean(there < EXACT) > SINGULAR_NODES:
                everywhere.append((_KINDS[kind], mode))
                continue
            seeds = np.flatnonzero(_seeds(sigma, kind))
            starts.append(np.concatenate([values[seeds], q[seeds]], axis=1))
        if starts and sum(map(len, starts)):
            follower = Follower(mech, where, kind, length, nodes, free)
            found = _curves(follower, follower.pieces(np.concatenate(starts), say))
            if branch is not None and modes.size:
                found = [part for curve in found for part in _in_mode(curve, modes[0])]
            curves += found
    say("done", 1, 1)
    return SingularityLocus(
        where.names,
        where.units,
        where.at,
        tuple(lines),
        modes,
        sigmas["I"],
        sigmas["II"],
        tuple(curves),
        tuple(everywhere),
    )


_KINDS = {"I": SingularityKind.TYPE_I, "II": SingularityKind.TYPE_II}


def _curves_of(mech: Mechanism, d: int, kinds: tuple[str, ...]) -> tuple[str, ...]:
    """The kinds whose locus is made of curves or points over d axes; ValueError where none is."""
    pose, joints = home_shapes(mech)
    a = jax.eval_shape(pose_jacobian, mech, pose, joints)
    equations, n = a.shape[0] if mech.actuated_rows is None else mech.actuated_rows, a.shape[1]
    codimension = {"I": 1, "II": equations - n + 1}
    if mech.free_joints:  # joints always move while the platform stands
        kinds = tuple(kind for kind in kinds if kind != "I")
        if not kinds:
            raise ValueError(
                f"{type(mech).__name__} has kinematically redundant joints: there is no type I locus"
            )
    found = tuple(kind for kind in kinds if codimension[kind] >= d - 1)
    if not found:
        raise ValueError(
            f"axes must be two here: the loci of {type(mech).__name__} over {d} axes are no curves"
        )
    return tuple(kind for kind in found if codimension[kind] <= d)


def _seeds(sigma: np.ndarray, kind: str) -> np.ndarray:
    """Nodes from which a locus may be near: least along a line of the grid, and small beside its changes."""
    padded = np.pad(sigma, 1, constant_values=np.nan)
    inner = tuple(slice(1, -1) for _ in sigma.shape)
    found = np.zeros(sigma.shape, bool)
    for axis in range(sigma.ndim):
        before, after = (
            padded[tuple(slice(1 + s, -1 + s or None) if k == axis else i for k, i in enumerate(inner))]
            for s in (-1, 1)
        )
        low = np.where(np.isnan(before), np.inf, before), np.where(np.isnan(after), np.inf, after)
        is_least = (sigma <= low[0]) & (sigma <= low[1])  # NaN compares False
        changes = np.fmax(np.abs(before - sigma), np.abs(after - sigma))
        found |= is_least & ~(sigma > 2 * changes)
        if kind == "I":  # the end of the reach, where sigma falls like a root
            found |= np.isfinite(sigma) & (np.isnan(before) | np.isnan(after))
    return found


def _curves(follower: Follower, pieces: list[Piece]) -> list[LocusCurve]:
    """The pieces with all that is known of their points."""
    if not pieces:
        return []
    mech, where, kind = follower.mech, follower.where, follower.kind
    points = np.concatenate([piece.track for piece in pieces])
    points = np.resize(points, (-(-len(points) // BLOCK) * BLOCK, points.shape[1]))  # few shapes are compiled
    values, joints, motion = follower.parts(points)
    pose = poses_on(where.at, where.axes, jnp.asarray(values))
    found = classify_singularity(mech, pose, joints, length=follower.length)
    sigma = np.asarray(found.sigma_inverse if kind == "I" else found.sigma_direct)
    branch = _branches(mech, pose, joints, follower.joint_units)
    whole = LocusCurve(_KINDS[kind], values, pose, joints, branch, motion, sigma, False)
    cuts = np.cumsum([0] + [len(piece.track) for piece in pieces])
    return [
        _part(whole, slice(first, last))._replace(is_closed=piece.is_closed)
        for piece, first, last in zip(pieces, cuts, cuts[1:], strict=False)
    ]


def _branches(mech: Mechanism, pose: Any, joints: np.ndarray, joint_units: np.ndarray) -> np.ndarray:
    """The working mode of every configuration; 0 for the arms that two modes share. -> (k, s)"""
    every = working_modes(mech)
    if not every.size:
        return np.zeros((len(joints), 0))
    gaps = []
    for mode in every:
        gap = joints_of(mech, pose, mode) - joints
        gap = np.where(joint_units > 0, gap, 2 * np.sin(gap / 2))
        # an arm that is out of reach by a rounding is as good in either mode
        gaps.append(np.max(np.nan_to_num(np.abs(gap)), axis=1))
    gaps = np.array(gaps)
    fits = gaps <= np.maximum(2 * np.min(gaps, axis=0), SAME_MODE)
    signs = np.einsum("jk,js->ks", fits, every)
    return np.sign(np.where(np.abs(signs) == fits.sum(axis=0)[:, None], signs, 0))


def _part(curve: LocusCurve, rows: Any) -> LocusCurve:
    fields = jax.tree.map(lambda leaf: leaf[rows], tuple(curve[1:7]))
    return LocusCurve(curve.kind, *fields, False)


def _in_mode(curve: LocusCurve, mode: np.ndarray) -> list[LocusCurve]:
    """The runs of points that one working mode has."""
    is_wanted = np.all((curve.branch == mode) | (curve.branch == 0), axis=1)
    if is_wanted.all():
        return [curve]
    if curve.is_closed and is_wanted.any():  # begin where a run does
        first = int(np.flatnonzero(is_wanted & ~np.roll(is_wanted, 1))[0])
        is_wanted = np.roll(is_wanted, -first)
        turned = np.roll(np.arange(len(is_wanted)), -first)
        curve = _part(curve, turned)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_wanted.astype(int), [0]])))
    return [_part(curve, slice(a, b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
