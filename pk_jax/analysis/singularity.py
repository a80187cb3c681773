"""What kind of singularity a configuration is, and how far from one it is: from the residual alone.

Near a configuration the mechanism moves in the null space of [A B], tangents (x', q') with
A x' + B q' = 0. A type I (inverse) singularity has one that moves joints only, a type II (direct) one that
moves the platform only. With the rows of [A B] made orthonormal to [Q_x Q_q], the sines of the angles
between the null space and those two are the least singular values of Q_q and Q_x. They lie in [0, 1], do
not depend on how the closure equations are scaled or combined, and are linear in the distance to the
singularity. Lengths are measured in `length`, angles in radians.
"""

from __future__ import annotations

import enum
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry.poses import is_pose, pose_units
from pk_jax.kinematics.batching import all_finite, configurations, is_possible, over_rows, same_size, where
from pk_jax.kinematics.closure import INCONSISTENT_ABOVE, joint_scale, pose_scale
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.jacobi import lengths, orthogonal_rows
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, joint_jacobian, pose_jacobian, units
from pk_jax.kinematics.lane_map import lane_map
from pk_jax.kinematics.lanes import Entries, Lane, items_of
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status


class SingularityKind(enum.IntEnum):
    """What a configuration is, to a tolerance."""

    UNKNOWN = -1  # no configuration: see the status
    REGULAR = 0
    TYPE_I = 1  # inverse: joints move while the platform stands, output motion is lost
    TYPE_II = 2  # direct: the platform moves while the joints are locked
    TYPE_III = 3  # both
    CONFIGURATION_SPACE = 4  # the closure equations themselves are dependent: paths of motion cross


class Singularity(NamedTuple):
    """One entry a configuration; batch first."""

    kind: jax.Array  # () SingularityKind
    sigma_inverse: jax.Array  # () distance to type I, in [0, 1]
    sigma_direct: jax.Array  # () distance to type II, in [0, 1]
    sigma_configuration: jax.Array  # () least singular value of [A B], rows of unit norm
    length: jax.Array  # () the length that lengths were measured in
    status: jax.Array  # () Status: OK, INCONSISTENT (the loops are not closed) or BAD_INPUT


def classify_singularity(
    mech: Mechanism, pose: Any, joints: Any, *, length: Any = None, tol: float = SINGULAR_BELOW
) -> Singularity:
    """Whether and how configurations are singular, and how far from it they are.

    pose, joints:  one configuration or many, closing the loops to 1e-6
    length:        () what lengths are measured in; default `mech.length()`
    tol:           sigma below this is singular; 1e-6 by default, because a reach limit itself is only
                   known to the root of roundoff. A larger one selects a band around singularities.

    Every value is the sine of an angle between motions that exist and those that a singularity would have;
    at a CONFIGURATION_SPACE singularity of the larger set of first-order motions. NaN where the
    status is not OK: BAD_INPUT for what is not finite, INCONSISTENT for open loops.
    The sigmas are differentiable where exactly one singular value is least.

    Source: Gosselin and Angeles 1990, IEEE Trans. Robotics and Automation 6(3), for the three
    types; Zlatanov, Fenton and Benhabib 1994 for the configuration space.
    """
    require_mechanism("classify_singularity", mech)
    rows, are_batched = configurations(mech, pose, joints)
    checks.has_shape("tol", checks.real_array("tol", tol), ())
    if checks.is_concrete(tol) and not 0 < float(tol) < 1:
        raise ValueError(f"tol must be in (0, 1), got {tol}")
    size = length_or_own(mech, length)
    known = checks.is_concrete((mech, rows, size, tol)) and not checks.is_staged()
    if known and any(are_batched):
        return _known(mech, rows, are_batched, size, tol)
    return _traced(mech, rows, size, tol, are_batched)


def singularity_distance(
    mech: Mechanism, pose: Any, joints: Any, *, kind: str = "any", length: Any = None
) -> jax.Array:
    """Distance of configurations to a singularity, a sine in [0, 1], differentiable in all arguments. -> ()

    kind: "I", "II" or "any", the lesser of the two. Use it as a constraint, or as a term of an
    objective. At a singularity the derivative is that of one side; where two distances are equally small
    it is that of one of them. Conventions of `classify_singularity`; NaN where the loops are open.
    """
    checks.is_word("kind", kind, ("I", "II", "any"))
    require_mechanism("singularity_distance", mech)
    rows, are_batched = configurations(mech, pose, joints)
    found = _traced(mech, rows, length_or_own(mech, length), SINGULAR_BELOW, are_batched)
    inverse, direct = found.sigma_inverse, found.sigma_direct
    return {"I": inverse, "II": direct, "any": jnp.minimum(inverse, direct)}[kind]


def length_or_own(mech: Mechanism, length: Any) -> jax.Array:
    if length is None:
        return mech.length()
    length = checks.real_array("length", length)
    checks.has_shape("length", length, ())
    if checks.is_concrete(length):
        checks.is_finite("length", length)
        checks.is_positive("length", length)
    return length


def scaled_rows(
    mech: Mechanism, pose: Any, joints: jax.Array, length: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A (c, n) and B (c, m) of the rows that carry force: lengths over `length`, [A B] with unit rows."""
    a, b, size = rows_and_sizes(mech, pose, joints, length)
    rows = slice(mech.actuated_rows)  # sensors lock nothing
    return a[rows] / size[rows, None], b[rows] / size[rows, None]


def rows_and_sizes(
    mech: Mechanism, pose: Any, joints: jax.Array, length: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A (c, n) and B (c, m) with lengths over `length`, and the size of each row of [A B] (c,), 1 for 0."""
    a, b = pose_jacobian(mech, pose, joints), joint_jacobian(mech, pose, joints)
    a = a * length ** units(pose_units(pose, mech.pose_units), a.dtype)
    b = b * length ** units(mech.joint_units or (1,) * b.shape[1], b.dtype)
    squared = jnp.sum(a * a, axis=1) + jnp.sum(b * b, axis=1)
    is_zero = squared == 0
    return a, b, jnp.where(is_zero, 1, jnp.sqrt(jnp.where(is_zero, 1, squared)))


def _openness(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """Greatest |F_i| over the size of the terms of equation i. -> ()"""
    value = mech.residual(pose, joints)
    a, b = pose_jacobian(mech, pose, joints), joint_jacobian(mech, pose, joints)
    size = jnp.abs(a) @ pose_scale(mech, pose) + jnp.abs(b) @ joint_scale(mech, joints)
    return jnp.max(jnp.abs(value) / jnp.where(size > 0, size, 1))


# --- traced values, or one configuration: dense and differentiable


@partial(jax.jit, static_argnums=4)
def _traced(mech, rows, length, tol, are_batched):
    return over_rows(lambda pose, joints: _one(mech, pose, joints, length, tol), rows, are_batched)


def _one(mech: Mechanism, pose: Any, joints: jax.Array, length: jax.Array, tol: Any) -> Singularity:
    is_given = all_finite(pose) & is_pose(pose) & is_possible(mech, joints) & all_finite(mech)
    home, home_joints = lax.stop_gradient(mech.home())
    pose, joints = where(is_given, pose, home), jnp.where(is_given, joints, home_joints)
    a, b = scaled_rows(mech, pose, joints, length)
    m = jnp.concatenate([a, b], axis=1)
    sigma = jnp.linalg.svd(m, compute_uv=False)
    rank = jnp.sum(sigma >= tol)
    orthonormal = jnp.where(rank == len(sigma), _orthonormal(m, rank == len(sigma)), _row_space(m, tol))
    values = _sines(orthonormal, a.shape[1], rank)
    is_open = ~(_openness(mech, pose, joints) <= INCONSISTENT_ABOVE)
    return _judged(*values, sigma[-1], length, tol, is_given, is_open)


def _orthonormal(m: jax.Array, is_regular: jax.Array) -> jax.Array:
    """Rows of [A B] made orthonormal; differentiable. -> (c, n + m)"""
    safe = jnp.where(is_regular, m, jnp.eye(*m.shape, dtype=m.dtype))
    return jnp.linalg.qr(safe.T)[0].T


def _row_space(m: jax.Array, tol: Any) -> jax.Array:
    """The same where rows are dependent: rows of zeros in place of those too many."""
    _, sigma, rows = jnp.linalg.svd(lax.stop_gradient(m), full_matrices=False)
    return jnp.where((sigma >= tol)[:, None], rows, 0)


def _sines(orthonormal: jax.Array, n: int, rank: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Least singular values of Q_q, over as many as [A B] has independent rows, and of Q_x."""
    of_joints = jnp.linalg.svd(orthonormal[:, n:], compute_uv=False)
    of_pose = jnp.linalg.svd(orthonormal[:, :n], compute_uv=False)
    inverse = of_joints[jnp.minimum(rank, len(of_joints)) - 1]
    return inverse, jnp.where(rank >= n, of_pose[-1], 0)


def _judged(
    inverse: Lane,
    direct: Lane,
    configuration: Lane,
    length: Any,
    tol: Any,
    is_given: Lane,
    is_open: Lane,
) -> Singularity:
    kind = jnp.where(inverse < tol, SingularityKind.TYPE_I, SingularityKind.REGULAR)
    kind = kind + jnp.where(direct < tol, SingularityKind.TYPE_II, SingularityKind.REGULAR)
    kind = jnp.where(configuration < tol, SingularityKind.CONFIGURATION_SPACE, kind)
    is_good = is_given & ~is_open
    status = jnp.where(is_given, jnp.where(is_open, Status.INCONSISTENT, Status.OK), Status.BAD_INPUT)
    kind = jnp.where(is_good, kind, SingularityKind.UNKNOWN).astype(jnp.int32)
    masked = [jnp.where(is_good, value, jnp.nan) for value in (inverse, direct, configuration)]
    return Singularity(kind, *masked, length, status.astype(jnp.int32))


# --- many known configurations, on lanes


def _known(mech: Mechanism, rows: tuple, are_batched: tuple, length: jax.Array, tol: float) -> Singularity:
    count = same_size(rows, are_batched)
    every = lambda leaf, many: np.asarray(leaf) if many else np.broadcast_to(leaf, (count, *leaf.shape))
    rows = [
        jax.tree.map(lambda leaf, many=many: every(leaf, many), row)
        for row, many in zip(rows, are_batched, strict=True)
    ]
    kind, inverse, direct, configuration, status = lane_map(
        _on_lanes, (mech, length, _as(tol, length)), tuple(rows)
    )
    kind, status = kind.astype(np.int32), status.astype(np.int32)
    return jax.device_put(Singularity(kind, inverse, direct, configuration, np.asarray(length), status))


def _as(number: float, like: jax.Array) -> jax.Array:
    return jnp.asarray(number, like.dtype)


def _on_lanes(given: Any, pose: Any, joints: Entries) -> list[Lane]:
    """`_one` on lanes: kind, sigmas, status."""
    mech, length, tol = given
    tol = tol.items[0]
    like = joints.items[0]
    is_given = reduce(
        jnp.logical_and,
        [jnp.isfinite(item) for item in items_of((pose, joints))]
        + entrywise(is_pose, pose).items
        + entrywise(is_possible, mech, joints).items,
    )
    a, b = entrywise(scaled_rows, mech, pose, joints, length)
    whole = lambda item: jnp.broadcast_to(jnp.asarray(item, like.dtype), like.shape)
    m = [[whole(item) for item in (*left, *right)] for left, right in zip(a.rows(), b.rows(), strict=True)]
    n = a.shape[1]
    rows = orthogonal_rows(m)
    sigmas = lengths(rows)
    is_kept = [sigma >= tol for sigma in sigmas]
    rank = sum(kept.astype(jnp.int32) for kept in is_kept)
    unit = [
        [jnp.where(kept, item / jnp.where(kept, sigma, 1), 0) for item in row]
        for row, sigma, kept in zip(rows, sigmas, is_kept, strict=True)
    ]
    of_joints = [row[n:] for row in unit]
    if b.shape[0] > b.shape[1]:
        of_joints = [list(column) for column in zip(*of_joints, strict=True)]
        of_rows = lengths(orthogonal_rows(of_joints))
    else:  # the zero rows of dependent equations do not count
        of_rows = lengths(orthogonal_rows(of_joints))
    inverse = _least_of_rank(of_rows, rank)
    direct = reduce(jnp.minimum, lengths(orthogonal_rows([list(c) for c in zip(*unit, strict=True)][:n])))
    direct = jnp.where(rank >= n, direct, 0)
    is_open = ~(entrywise(_openness, mech, pose, joints).items[0] <= INCONSISTENT_ABOVE)
    configuration = reduce(jnp.minimum, sigmas)
    found = _judged(inverse, direct, configuration, length.items[0], tol, is_given, is_open)
    return [
        item.astype(like.dtype)
        for item in (
            found.kind,
            found.sigma_inverse,
            found.sigma_direct,
            found.sigma_configuration,
            found.status,
        )
    ]


def _least_of_rank(values: list[Lane], rank: Lane) -> Lane:
    """The rank-th largest of the values."""
    ordered = jnp.sort(jnp.stack(values), axis=0)[::-1]
    return jnp.take_along_axis(ordered, jnp.clip(rank, 1, len(values))[None] - 1, axis=0)[0]
