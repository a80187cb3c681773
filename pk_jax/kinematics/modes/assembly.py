"""All assembly modes: every pose that fits the joints, with a statement of completeness."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations
from pk_jax.geometry.poses import Turning, features, like, place, pose_units, tangent_size
from pk_jax.geometry.se3 import SE3
from pk_jax.geometry.spread import evenly, quaternions
from pk_jax.kinematics.batching import equations, home_shapes, is_possible, rows_of
from pk_jax.kinematics.certify import certify, check_known
from pk_jax.kinematics.closure import pose_scale
from pk_jax.kinematics.forward import ForwardKinematics, solved_from
from pk_jax.kinematics.modes.monodromy import SOLUTIONS
from pk_jax.kinematics.modes.stewart import layout_of
from pk_jax.kinematics.modes.study import motion_of
from pk_jax.mechanisms.base import LegMechanism, Mechanism, require_mechanism
from pk_jax.mechanisms.stewart import LEGS, Stewart
from pk_jax.status import Status

STARTS = 256  # of a search from many starts
REAL_TO = 1e-6  # imaginary part of x and y, |x| = 1, of a solution that may be real
MULTIPLE_REAL_TO = 1e-3  # the same of a multiple one, where paths stop short of it
SAME_TO = 1e-6  # tangent between two solutions that are one, of the natural size of each coordinate
MOVED_TO = 1e-3  # the same between an end and the real pose that it stands for


class Fate(enum.IntEnum):
    """What became of one path, root or start."""

    FINITE_REAL = 0  # a pose
    FINITE_COMPLEX = 1  # a solution that is no pose
    AT_INFINITY = 2  # or so near it that double precision sees no difference: no pose
    LOST = 3
    DUPLICATE = 4  # ended where an earlier one did: on a multiple solution, or at a search's known mode
    EXCLUDED = 5  # fits some of the joints, but redundant ones (or sensors) do not agree


class AssemblyModes(NamedTuple):
    """All modes of one set of joints, or of many (batch first); one slot a path, real poses first.

    Real poses are in the order of their distance from home.
    """

    poses: Any  # (slots,) NaN where not real
    is_real: np.ndarray  # (slots,)
    count: np.ndarray  # () real poses
    fates: np.ndarray  # (slots,) Fate
    is_complete: np.ndarray  # () every solution that there can be is accounted for
    # () finite solutions at almost all joints, real and complex, of a platform's six legs; -1: not known
    expected: np.ndarray
    # () OK; complete, but no pose: UNREACHABLE, or INCONSISTENT redundant joints; INCOMPLETE; BAD_INPUT
    status: np.ndarray
    residual: np.ndarray  # (slots,) |F|, evaluated afresh
    sigma_min: np.ndarray  # (slots,) as of `forward_kinematics`
    det_sign: np.ndarray  # (slots,) sign of det A over its sign at home; 0 where actuation is redundant
    mirror: np.ndarray  # (slots,) slot of the mirror image, -1: none
    is_certified: np.ndarray  # (slots,) see `certify`
    radius: np.ndarray  # (slots,) m
    retries: np.ndarray  # () further sets of paths that were needed
    method: str  # "homotopy", "closed form" or "search"

    def tally(self) -> dict[str, int]:
        """How many paths of all ended how."""
        return {fate.name: int(np.sum(self.fates == fate)) for fate in Fate if np.any(self.fates == fate)}


class _Found(NamedTuple):
    """One row before it is judged; one slot a path."""

    poses: Any  # (slots,) that may be real, NaN elsewhere
    fates: np.ndarray  # (slots,) where they are not
    is_complete: bool
    expected: int
    retries: int = 0


def assembly_modes(
    mech: Mechanism, joints: Any, *, report: Callable[..., None] | None = None
) -> AssemblyModes:
    """Every pose in which the mechanism has the given joints.

    joints:  (m,) or (batch, m)
    report:  called with (what, done, total)

    - `Stewart`, six rows or more: forty paths of a parameter homotopy; further rows (sensors) choose
      among the poses of the six legs. Complete where every path arrived, went to infinity or met others in a
      multiple solution, and their number is the geometry's (`expected`, itself counted by homotopy at
      random complex lengths: right with probability one).
    - Mechanisms with a closed form `forward`: its poses.
    - Any other: Newton from 256 poses spread around home. Never called complete.

    Every real pose is polished and judged by `forward_kinematics`, and certified by `certify` where
    the poses are regular. `mirror` pairs the modes of which one is the other reflected in a plane (a line).
    The poses carry no derivatives: `forward_kinematics(mech, joints, guess=pose)` does.

    Needs float64 and known values. ValueError for others, and for wrong shapes.
    """
    require_mechanism("assembly_modes", mech)
    checks.is_function("report", report)
    check_known("assembly_modes", mech, joints)
    joints, is_many = rows_of("joints", joints, home_shapes(mech)[1], numpy=True)
    joints = joints if is_many else joints[None]
    if not len(joints):
        raise ValueError("joints must have at least one row, got none")
    method, solve = _method(mech)
    home = jax.device_get(mech.home())
    rows = []
    for row in joints:
        rows.append(_one(mech, home, row, solve))
        if report is not None:
            report("assembly modes: rows", len(rows), len(joints))
    modes = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    is_certified, radius = _certified(mech, modes, joints)
    modes = modes._replace(is_certified=is_certified, radius=radius)
    modes = modes if is_many else jax.tree.map(lambda leaf: leaf[0], modes)
    return modes._replace(poses=jax.tree.map(jnp.asarray, modes.poses), method=method)


def _method(mech: Mechanism) -> tuple[str, Callable[[Mechanism, np.ndarray], _Found]]:
    if isinstance(mech, Stewart):
        return "homotopy", _by_homotopy
    return ("closed form", _by_closed_form) if hasattr(mech, "forward") else ("search", _by_search)


def _one(mech: Mechanism, home: tuple[Any, np.ndarray], joints: np.ndarray, solve: Callable) -> AssemblyModes:
    """One row, yet to be certified."""
    is_given = bool(is_possible(mech, joints))
    found = solve(mech, joints if is_given else home[1])
    if not is_given:
        poses = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), found.poses)
        found = found._replace(poses=poses, fates=np.full_like(found.fates, Fate.LOST), is_complete=False)
    judged, fates = _judged(mech, joints, found)
    is_real = fates == Fate.FINITE_REAL
    from_home = _apart(mech, judged.candidate, jax.tree.map(lambda leaf: leaf[None], home[0]))[:, 0]
    order = np.lexsort((from_home, fates))
    judged, is_real, fates = jax.tree.map(lambda leaf: leaf[order], (judged, is_real, fates))
    masked = lambda leaf: np.where(is_real.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, np.nan)
    poses = jax.tree.map(masked, judged.candidate)
    is_complete = found.is_complete and Fate.LOST not in fates
    none = Status.INCONSISTENT if Fate.EXCLUDED in fates else Status.UNREACHABLE
    status = Status.OK if is_real.any() else none
    status = status if is_complete else Status.INCOMPLETE
    return AssemblyModes(
        poses,
        is_real,
        np.int32(np.sum(is_real)),
        fates,
        np.bool_(is_complete),
        np.int32(found.expected),
        np.int32(status if is_given else Status.BAD_INPUT),
        *map(masked, (judged.residual, judged.sigma_min, judged.det_sign)),
        _mirrors(mech, joints, poses, is_real),
        is_certified=None,
        radius=None,
        retries=np.int32(found.retries),
        method=None,
    )


# --- the three ways


def _by_homotopy(mech: Stewart, joints: np.ndarray) -> _Found:
    layout = layout_of(np.asarray(mech.base)[:LEGS], np.asarray(mech.platform)[:LEGS])
    expected = layout.count()[0]
    found = layout.solve(joints[:LEGS])
    regular, multiple = len(found.regular), len(found.multiple)
    points = np.concatenate([found.regular, found.multiple])
    points = points / np.sqrt(np.sum(points[:, :4] ** 2, axis=1, keepdims=True))
    real_to = np.repeat([REAL_TO, MULTIPLE_REAL_TO], [regular, multiple]) * np.maximum(
        1, np.linalg.norm(points, axis=1)
    )
    is_near = np.linalg.norm(points.imag, axis=1) < real_to
    fates = np.full(SOLUTIONS, Fate.AT_INFINITY, np.int32)
    fates[: regular + found.met] = Fate.DUPLICATE
    fates[: regular + multiple] = np.where(is_near, Fate.LOST, Fate.FINITE_COMPLEX)  # until they close
    fates[SOLUTIONS - found.lost :] = Fate.LOST
    maybe = np.full((SOLUTIONS, 8), np.nan)
    maybe[: len(points)][is_near] = points[is_near].real
    translation, rotation = (np.array(part) for part in _motions(maybe))
    translation = layout.scale * translation + layout.centres[0] - rotation @ layout.centres[1]
    return _Found(SE3(translation, rotation), fates, found.is_complete, expected, found.retries)


_motions = jax.jit(jax.vmap(motion_of))


def _by_closed_form(mech: Mechanism, joints: np.ndarray) -> _Found:
    poses, is_real = jax.device_get(_forward(mech, joints))
    is_square = equations(mech) == tangent_size(home_shapes(mech)[0])
    otherwise = Fate.FINITE_COMPLEX if is_square else Fate.EXCLUDED
    fates = np.where(is_real, Fate.LOST, otherwise).astype(np.int32)
    return _Found(poses, fates, is_complete=True, expected=len(fates) if is_square else -1)


@jax.jit
def _forward(mech: Mechanism, joints: jax.Array) -> tuple[Any, jax.Array]:
    return mech.forward(joints)


def _by_search(mech: Mechanism, joints: np.ndarray) -> _Found:
    found = solved_from(mech, np.broadcast_to(joints, (STARTS, *joints.shape)), _starts(mech))
    fates = np.full(STARTS, Fate.LOST, np.int32)
    return _Found(jax.device_get(found.candidate), fates, is_complete=False, expected=-1)


def _starts(mech: Mechanism) -> Any:
    """Poses around home: every orientation, positions up to twice their natural size away."""
    home = jax.tree.map(np.asarray, mech.home()[0])
    scale = np.asarray(pose_scale(mech, home))
    n = tangent_size(home)
    spread = evenly(STARTS, n)
    if isinstance(home, Turning):
        shift = jax.tree.leaves(home)[0]
        turned = np.asarray(jax.vmap(rotations.from_quaternion)(quaternions(spread[:, n - 3 :])))
        moved = shift + ((4 * spread[:, : n - 3] - 2) * scale[: n - 3]).reshape(STARTS, *shift.shape)
        return like(home, moved, turned)
    reach = np.where(np.asarray(pose_units(home, mech.pose_units)) > 0, 2 * scale, np.pi)
    return home + (2 * spread - 1) * reach


# --- judging


def _judged(mech: Mechanism, joints: np.ndarray, found: _Found) -> tuple[ForwardKinematics, np.ndarray]:
    """The poses of a row polished, and what became of each; real ones are distinct."""
    slots = len(found.fates)
    judged = solved_from(mech, np.broadcast_to(joints, (slots, *joints.shape)), found.poses)
    judged = jax.device_get(judged)
    with np.errstate(invalid="ignore"):
        is_near = np.diagonal(_apart(mech, judged.candidate, found.poses)) < MOVED_TO
        is_closed = np.isin(judged.status, [Status.OK, Status.OTHER_MODE, Status.SINGULAR]) & is_near
        is_same = (_apart(mech, judged.candidate, judged.candidate) < SAME_TO) & is_closed
    fates = found.fates.copy()
    if isinstance(mech, Stewart) and mech.base.shape[0] > LEGS:
        fates[np.isfinite(jax.tree.leaves(found.poses)[0][:, 0])] = Fate.EXCLUDED
    fates[is_closed] = Fate.FINITE_REAL
    fates[is_closed & np.any(np.tril(is_same, -1), axis=1)] = Fate.DUPLICATE
    return judged, fates


def _certified(mech: Mechanism, modes: AssemblyModes, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is proved of the real poses of all rows at once. -> (rows, slots) twice"""
    is_certified, radius = np.zeros(modes.is_real.shape, bool), np.full(modes.is_real.shape, np.nan)
    at = np.nonzero(modes.is_real)
    try:
        found = certify(mech, jax.tree.map(lambda leaf: leaf[at], modes.poses), joints[at[0]])
    except ValueError:  # its residual has no bounds
        return is_certified, radius
    is_certified[at], radius[at] = found.is_certified, found.radius
    return is_certified, radius


def _apart(mech: Mechanism, poses: Any, others: Any) -> np.ndarray:
    """Distances without units: of positions over length(), and of turns. -> (k, l)"""
    of = lambda each: features(each, mech.pose_units, float(mech.length()), come_round=mech.angles_come_round)
    here, there = of(poses), of(others)
    return np.linalg.norm(here[:, None] - there[None], axis=2)


def _mirrors(mech: Mechanism, joints: np.ndarray, poses: Any, is_real: np.ndarray) -> np.ndarray:
    """The slot of the mirror image of each pose, -1 where there is none. -> (slots,)

    Legs that are spheres, g = (|p - a|^2 - l^2) / 2, have their centres a at p - dg/dp. Where all centres lie
    in one plane (a line, for planar mechanisms), the reflection in it carries the platform's points to
    those of another pose, if the platform itself is its own image.
    """
    images = np.full(len(is_real), -1, np.int32)
    if not isinstance(mech, LegMechanism) or np.sum(is_real) < 2:
        return images
    points, centres = (np.asarray(part)[is_real] for part in _ends(mech, joints, poses))
    middle = np.mean(centres[0], axis=0)
    extents, axes = np.linalg.svd(centres[0] - middle)[1:]
    small = SAME_TO * float(mech.length())
    if len(centres[0]) < len(axes) or extents[-1] > small:
        return images
    height = (points - middle) @ axes[-1]
    reflected = points - 2 * height[..., None] * axes[-1]
    off = np.abs(reflected[:, None] - points[None]).max(axis=(2, 3))
    images[: len(points)] = np.where(off.min(axis=1) < small, np.argmin(off, axis=1), -1)
    return images


@jax.jit
def _ends(mech: LegMechanism, joints: jax.Array, poses: Any) -> tuple[jax.Array, jax.Array]:
    """The platform's points, and the centres of the legs, at each pose. -> (slots, k, d) twice"""

    def ends(pose):
        points = place(pose, mech.attachments())
        return points, points - jnp.sum(mech.forces(pose, joints)[1], axis=0)

    return jax.vmap(ends)(poses)
