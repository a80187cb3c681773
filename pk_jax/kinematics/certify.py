"""Proofs that a pose closes the loops: Krawczyk's test, in intervals with outward rounding."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import rotations
from pk_jax.geometry.poses import Turning, like, pose_units, retract, settle
from pk_jax.geometry.se3 import ORTHONORMAL_TO
from pk_jax.kinematics.batching import home_shapes, rows_of, same_size
from pk_jax.kinematics.entrywise import UnknownPrimitive
from pk_jax.kinematics.in_blocks import padded
from pk_jax.kinematics.intervals import (
    Interval,
    absolute,
    enclosure,
    matrix_product,
    minus,
    over,
    plus,
    root,
    square,
    thin,
    times,
    total,
)
from pk_jax.mechanisms.base import Mechanism, require_mechanism

HALVES = 2.0 ** np.array(
    [*range(-40, -8, 4), *range(-8, 1)]
)  # half-widths of the boxes; lengths over length()
ROWS = 256  # at a time
SWEEPS = 16
LEAST = 2.0**-100  # of a half-width


class Certified(NamedTuple):
    """What is proved, one entry a row; distances as in `certify`."""

    is_certified: jax.Array  # () a solution exists near the pose, and is the only one there
    radius: jax.Array  # () m, it is no farther from the pose than this; NaN where none is certified
    unique_within: jax.Array  # () m >= radius, no other is as near as this; NaN where none is certified


def certify(mech: Mechanism, pose: Any, joints: Any) -> Certified:
    """Prove that near a pose there is a solution for given joints, and only one, and tell how near.

    pose:    one, or one a row
    joints:  (m,) or (batch, m)

    The solution is one of the closure equations F = 0 with exactly the float64 numbers of joints and
    geometry; where there are more equations than freedoms, a stationary point of |F|^2, which is what
    `forward_kinematics` finds. It differs from the pose by a translation v (a slide, of an
    `AxisPose`) and a turn by some angle, distance sqrt(|v|^2 + (L angle)^2), L = mech.length(). In an array
    pose, angles are the coordinates that `pose_units` declares. A matrix that is not quite a rotation
    stands for the rotation nearest to it, and `radius` counts how far that may be off.

    Not certified is no proof of the contrary: it may be NaN, no rotation (as `SE3` says it), an
    impossible joint, a pose too far from a solution, or one too close to a singularity. ValueError for
    values that are traced or float32, and where the residual has primitives that intervals have no rule for.

    With increments of the pose, lengths over L, and Y close to the inverse of F'(0): N = -Y F(0), and
    M = 1 - Y F'(box). |N| + |M| h < h, bounded with outward rounding, proves one zero in the box of
    half-widths h, and |M| h < h that F takes no value twice there. Krawczyk 1969, Computing 4, 187-201;
    Neumaier 1990, Interval Methods for Systems of Equations.
    """
    require_mechanism("certify", mech)
    check_known("certify", mech, pose, joints)
    home_pose, home_joints = home_shapes(mech)
    pose, poses = rows_of("pose", pose, home_pose, numpy=True)
    joints, many = rows_of("joints", joints, home_joints, numpy=True)
    is_batch = poses or many
    count = same_size((pose, joints), (poses, many)) if is_batch else 1
    spread = lambda leaf, batched: leaf if batched else np.broadcast_to(leaf, (count, *leaf.shape))
    pose, joints = jax.tree.map(partial(spread, batched=poses), pose), spread(joints, many)
    prove = partial(_certified, mech, float(mech.length()), pose_units(home_pose, mech.pose_units))
    found = [Certified(np.zeros(0, bool), np.zeros(0), np.zeros(0))]
    for first in range(0, count, ROWS):
        part = jax.tree.map(lambda leaf, first=first: leaf[first : first + ROWS], (pose, joints))
        with np.errstate(all="ignore"):  # NaN is what is not known
            found.append(prove(*part))
    joined = map(np.concatenate, zip(*found, strict=True))
    return Certified(*(jnp.asarray(each if is_batch else each[0]) for each in joined))


def check_known(function: str, mech: Mechanism, *values: Any) -> None:
    """ValueError, naming the function, for values that are traced or a mechanism in float32."""
    if not checks.is_concrete((mech, *values)) or checks.is_staged():
        raise ValueError(f"{function} needs known values: call it outside of jit, grad and vmap")
    if home_shapes(mech)[1].dtype != jnp.float64:
        raise ValueError(f"{function} needs float64: call pk_jax.enable_x64() first")


def _certified(
    mech: Mechanism, length: float, units: tuple[int, ...], pose: Any, joints: np.ndarray
) -> Certified:
    """Some rows: poses, and joints (k, m)."""
    centre, angle = _centred(pose)
    scale = np.where(units, length, 1.0)
    value, slopes = _enclosed(mech, centre, joints, scale)  # at the centre, then over the boxes
    inverse, is_regular = _inverse(slopes.lower[:, 0] / 2 + slopes.upper[:, 0] / 2)
    start = absolute(matrix_product(thin(inverse), Interval(value.lower[:, 0], value.upper[:, 0]))).upper
    off = _off(inverse, slopes) + _unknown(value)  # slopes do not tell of jumps
    is_inside, moved = _contained(start, off)
    radius = times(plus(root(total(square(thin(moved)), axis=1)), thin(angle)), length).upper
    within = times(minus(_inscribed(_injective(off), units), thin(angle)), length).lower
    is_possible = np.all((joints > 0) | (not mech.joints_are_distances), axis=1)
    is_certified = is_possible & is_regular & is_inside & (radius <= within)
    return Certified(is_certified, *(np.where(is_certified, each, np.nan) for each in (radius, within)))


# --- the centre of the boxes: a rotation, which a matrix of float64 numbers is not


def _centred(pose: Any) -> tuple[Any, np.ndarray]:
    """Bounds of poses that turn exactly, and of the angles from those given. -> .., (k,) rad, NaN: no pose

    The rotation of a quaternion close to the matrix is bounded entry by entry. The rotation nearest to the
    matrix is at least as near to it, so that both are at most 2 |difference|_F apart, and by an angle
    of at most 2 |difference|_F / sqrt 2, but for the arc over its chord.
    """
    if not isinstance(pose, Turning):
        return thin(pose), np.zeros(len(pose))
    shift, rotation = jax.tree.leaves(pose)
    given = jax.tree.map(lambda leaf: padded(leaf, ROWS), pose)
    quaternion = np.asarray(_quaternions(given))[: len(rotation)]
    exact = enclosure(_rotation_of, thin(quaternion))
    apart = root(total(total(square(minus(thin(rotation), exact)), axis=2), axis=1)).upper
    angle = times(thin(apart), 1.4143).upper  # sqrt 2, and the arc
    return like(pose, thin(shift), exact), np.where(apart <= 2 * ORTHONORMAL_TO, angle, np.nan)


@jax.jit
def _quaternions(poses: Any) -> jax.Array:
    return jax.vmap(lambda pose: rotations.to_quaternion(settle(pose).rotation))(poses)


def _rotation_of(q: jax.Array) -> jax.Array:
    """The rotation of a quaternion of any length, a rational function. -> (3, 3)"""
    k = rotations.skew(q[1:])
    return jnp.eye(3) + 2 * (q[0] * k + k @ k) / jnp.sum(q * q)


# --- equations and slopes over boxes


def _enclosed(
    mech: Mechanism, centre: Any, joints: np.ndarray, scale: np.ndarray
) -> tuple[Interval, Interval]:
    """Equations and slopes at the centre and over the boxes. -> (k, 1 + boxes, n), (k, 1 + boxes, n, n)"""
    halves = np.append(0.0, HALVES)
    count, lanes, n = len(joints), len(halves), len(scale)
    repeat = lambda box: Interval(*(np.repeat(end, lanes, axis=0) for end in (box.lower, box.upper)))
    is_box = lambda leaf: isinstance(leaf, Interval)
    centre, joints = jax.tree.map(repeat, (centre, thin(joints)), is_leaf=is_box)
    half = np.tile(halves, count)[:, None] * np.ones(n)
    try:
        found = enclosure(_equations, mech, centre, joints, scale, Interval(-half, half), is_sure=True)
    except UnknownPrimitive as error:
        what = f"{type(mech).__name__}: there are no bounds of the primitive {error}"
        raise ValueError(f"no certificate for {what}") from None
    rows = lambda end: end.reshape(count, lanes, *end.shape[1:])
    return tuple(Interval(rows(box.lower), rows(box.upper)) for box in found)


@jax.jit
def _equations(mech: Mechanism, centre: Any, joints: jax.Array, scale: jax.Array, eta: jax.Array) -> Any:
    """As many equations as freedoms, and their slopes in increments without units. -> (n,), (n, n)"""

    def closure(eta):
        return mech.residual(retract(centre, scale * eta), joints)

    is_square = jax.eval_shape(closure, eta).shape == eta.shape
    equations = closure if is_square else jax.grad(lambda eta: jnp.sum(closure(eta) ** 2) / 2)
    slopes, value = jax.jacfwd(lambda eta: (equations(eta),) * 2, has_aux=True)(eta)
    return value, slopes


def _unknown(value: Interval) -> np.ndarray:
    """NaN for equations that may jump in a box, else 0. (k, 1 + boxes, n) -> (k, boxes, n, 1)"""
    return np.where(np.isnan(value.lower + value.upper), np.nan, 0.0)[:, 1:, :, None]


def _inverse(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearly the inverses of (k, n, n), and whether there are any (k,)."""
    is_regular = np.abs(np.linalg.det(matrices)) > 0
    return np.linalg.inv(
        np.where(is_regular[:, None, None], matrices, np.eye(matrices.shape[-1]))
    ), is_regular


def _off(inverse: np.ndarray, slopes: Interval) -> np.ndarray:
    """|1 - Y F'| over the boxes at most. -> (k, boxes, n, n)"""
    boxes, n = slopes.lower.shape[1] - 1, inverse.shape[-1]
    flat = Interval(*(end[:, 1:].reshape(-1, n, n) for end in (slopes.lower, slopes.upper)))
    off = minus(thin(np.eye(n)), matrix_product(thin(np.repeat(inverse, boxes, axis=0)), flat))
    return absolute(off).upper.reshape(-1, boxes, n, n)


# --- what boxes prove


def _contained(start: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether |N| + |M| h < h for some h within a box, and how far the zero is at most. -> (k,), (k, n)"""
    h = _swept(off, np.broadcast_to((1.1 * start + LEAST)[:, None], off.shape[:-1]))
    reached = plus(thin(start[:, None]), thin(_product(off, h))).upper
    is_inside = np.all((reached < h) & (h <= HALVES[:, None]), axis=2)
    return is_inside.any(axis=1), reached[np.arange(len(off)), np.argmax(is_inside, axis=1)]


def _injective(off: np.ndarray) -> np.ndarray:
    """Half-width of the largest box with |M| h < h for some h > 0; 0: in none. -> (k,)"""
    h = _swept(off, np.ones(off.shape[:-1]))
    return np.max(np.where(np.all(_product(off, h) < h, axis=2), HALVES, 0.0), axis=1)


def _swept(off: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Nearly (1 - M)^-1 times a vector. -> (k, boxes, n)"""
    h = start
    for _ in range(SWEEPS):
        h = start + np.einsum("kbij,kbj->kbi", off, h)
    return h


def _product(off: np.ndarray, h: np.ndarray) -> np.ndarray:
    """M h at most. -> (k, boxes, n)"""
    return total(times(thin(off), thin(h[:, :, None])), axis=3).upper


def _inscribed(half: np.ndarray, units: tuple[int, ...]) -> Interval:
    """The ball of poses inside of boxes. A turn by Cayley's 2 tan(angle / 2) <= h is one by
    2 arctan(h / 2) > h - h^3 / 12. -> (k,)"""
    half = thin(half)
    return half if all(units) else minus(half, over(times(square(half), half), 12.0))
