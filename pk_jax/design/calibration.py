"""Identify the geometry of a mechanism from logged poses and joints (kinematic calibration)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax import checks
from pk_jax.geometry.poses import is_pose, settle
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.batching import all_finite, home_shapes, is_possible, rows_of, same_size
from pk_jax.kinematics.closure import joint_scale
from pk_jax.kinematics.inverse import least_joint_sigma
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, joint_jacobian
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.mechanisms.stewart import LEGS, Stewart
from pk_jax.status import Status

BLOCK = 1024  # rows linearized at a time: memory does not grow with the log
LONGEST = 0.5  # step of an unknown, over its scale
RANK_POWER = 0.6  # of the machine epsilon: the least singular value that counts, over the greatest
ROUNDOFFS = 64  # of the joints: what the unknowns may explain of the errors at the end
MOST_DAMPING = 1e8  # of the greatest singular value
NEGLIGIBLE = 1e-6  # part of an unknown in a direction of unit size
TERMS = 6  # of a combination that are spelt out
LINEAR_RANK = 1e-6  # least singular value of the linear start's columns of unit norm


class Calibration(NamedTuple):
    """The geometry that a log says, and how well it says it.

    k unknowns: the entries of the fields, then the offsets, in the order of `unknowns`; c errors a row,
    one a joint that a pose does not leave free.
    """

    mechanism: Mechanism  # of the class that came in
    offsets: np.ndarray  # (m,) what is added to the logged joints; zeros where they were not asked for
    rms: float  # of the errors of the rows used, in the unit of the joints
    errors: np.ndarray  # (rows, c) joint that the pose says less logged joint and offset; NaN where not used
    rank: int  # unknowns, or combinations of them, that the log determines
    unknowns: tuple[str, ...]  # (k,) names
    singular_values: np.ndarray  # (k,) lengths over mech.length(), errors as they are weighted; descending
    covariance: np.ndarray  # (k, k); of what is not determined inf, and NaN with the others
    deviations: dict[str, np.ndarray]  # standard deviations, as the fields and "offsets" are shaped; or inf
    unidentified: tuple[str, ...]  # (k - rank,) combinations the log doesn't see: nothing moved along them
    rows: int  # used
    row_status: np.ndarray  # (rows,) Status: OK are used, BAD_INPUT and SINGULAR (type I) are left out
    status: Status  # OK, SINGULAR (rank < k), STALLED, STEP_LIMIT or NONFINITE
    steps: int


def calibrate(
    mech: Mechanism,
    poses: Any,
    joints: Any,
    *,
    fields: Iterable[str] | None = None,
    offsets: bool = False,
    sigma: Any = None,
    steps: int = 50,
) -> Calibration:
    """The geometry whose joints at the logged poses are nearest to the logged joints, from `mech` on.

    poses:    (rows, ...), like the mechanism's, taken as exact
    joints:   (rows, m), whose errors are independent and of one size
    fields:   names of the fields to identify, () for the offsets alone; default: all that the residual
              depends on, hence no limits
    offsets:  identify one constant a joint, too: joint = logged joint + offset
    sigma:    standard deviation of the logged joints, () or (m,). It weighs them, and the covariance follows
              from it; default: from the errors that remain, lengths over mech.length() beside angles
    steps:    Levenberg-Marquardt steps that may be taken

    Minimized are the Newton corrections e = -B^-1 F(pose, joints + offset) of the joints, equal to their
    errors to first order; the residual is all that is asked of a mechanism. Every step is the least one,
    lengths over mech.length(), so what the log does not determine stays as it came; status SINGULAR then
    says so. Rows with NaN, infinity or a distance that is not positive harm no other.

    Errors of the poses come out as errors of the joints; the covariance then holds as far as those are of
    one size. ValueError where no row can be used, where the geometry found is none of the class, for a
    mechanism that has not one closure equation a joint (`free_joints` aside), and within `jit`.
    """
    require_mechanism("calibrate", mech)
    if not checks.is_concrete((mech, poses, joints, sigma)):
        raise ValueError(
            "calibrate takes known values: it chooses rows and unknowns by them, call it outside of jit"
        )
    checks.is_count("steps", steps, most=100_000)
    offsets = checks.is_flag("offsets", offsets)
    poses, joints = _log(poses, joints, *home_shapes(mech))
    length, joint_units = np.asarray(_length(mech)), mech.joint_units or (1,) * joints.shape[1]
    joint_size = length ** np.array(joint_units, joints.dtype)
    count = _equations(mech, poses, joints)
    weights = _weights(sigma, joint_size)[:count]
    names = None if fields is None else _named(mech, fields, offsets)
    row_status = np.asarray(_row_status(mech, poses, joints))
    used = np.flatnonzero(row_status == Status.OK)
    if not len(used):
        first = Status(row_status[0]).name
        raise ValueError(f"calibrate: none of the {len(joints)} rows can be used, the first is {first}")
    if names is None:
        names = _seen(mech, jax.tree.map(lambda leaf: leaf[used[0]], (poses, joints)))
    shapes = tuple(getattr(mech, name).shape for name in names)
    unknowns = _Unknowns(names, shapes, joints.shape[1] if offsets else 0)
    scale = np.r_[np.full(unknowns.entries, length), joint_size[: unknowns.offsets]]

    state = _fit(mech, _in_blocks((poses, joints), used), weights, scale, steps, unknowns)
    end = jax.tree.map(np.asarray, state.best)
    values, shift = unknowns.split(end.vector * scale)
    try:
        found = dataclasses.replace(mech, **values)
    except ValueError as error:
        raise ValueError(f"calibrate: the geometry found is refused: {error}") from None
    shift = shift if offsets else np.zeros(joints.shape[1], joints.dtype)
    errors = np.where((row_status == Status.OK)[:, None], _errors(found, joints + shift, poses), np.nan)

    rank = int(np.sum(end.known))
    freedom = len(used) * count - rank
    variance = 1.0 if sigma is not None else float(end.cost) ** 2 / freedom if freedom else np.nan
    covariance = _covariance(end, variance) * np.outer(scale, scale)
    deviations, of_offsets = unknowns.split(np.sqrt(np.diagonal(covariance)))
    return Calibration(
        mechanism=found,
        offsets=shift,
        rms=float(np.sqrt(np.mean(errors[used] ** 2))),
        errors=errors,
        rank=rank,
        unknowns=unknowns.labels(),
        singular_values=end.sizes,
        covariance=covariance,
        deviations=deviations | ({"offsets": of_offsets} if offsets else {}),
        unidentified=_combinations(unknowns.labels(), end.directions[~end.known] * scale),
        rows=len(used),
        row_status=row_status,
        status=_verdict(state),
        steps=int(state.steps),
    )


def stewart_from_log(poses: Any, lengths: Any, *, offsets: bool = False) -> Stewart:
    """A Stewart platform from logged poses and leg lengths alone, in closed form: a start for `calibrate`.

    poses:    `SE3` (rows,), which must move and turn in all directions; lengths: (rows, k), k >= 6
    offsets:  the lengths are known up to one constant each

    With the mean pose (t0, R0), r = t - t0, T = R R0^T - I, u = R0 b and v = t0 + u - a, each leg's
    length^2 = |r + v + T u|^2 = |r|^2 + |v|^2 + 2 r.v + 2 T:((t0 - a) u^T) + 2 (T^T r).u, linear in
    |v|^2, v, (t0 - a) u^T and u; an offset adds the length itself as a column. Rows with NaN, infinity or
    a length that is not positive are left out. ValueError where the others do not determine the
    platform, and where what comes out is none (`Stewart`).
    """
    if not checks.is_concrete((poses, lengths)):
        raise ValueError("stewart_from_log takes known values, call it outside of jit")
    offsets = checks.is_flag("offsets", offsets)
    lengths = checks.real_array("lengths", lengths)
    checks.has_shape("lengths", lengths, (None, None))
    if lengths.shape[1] < LEGS:
        raise ValueError(f"lengths must have six columns (legs) or more (sensors), got {lengths.shape[1]}")
    one = SE3(np.zeros(3, lengths.dtype), np.eye(3, dtype=lengths.dtype))
    leg = jax.ShapeDtypeStruct(lengths.shape[1:], lengths.dtype)
    poses, lengths = _log(poses, lengths, one, leg, "lengths")
    t, rotation, lengths = (
        np.asarray(each, np.float64) for each in (poses.translation, poses.rotation, lengths)
    )
    used = (
        np.isfinite(t).all(1)
        & np.isfinite(rotation).all((1, 2))
        & (np.isfinite(lengths) & (lengths > 0)).all(1)
    )
    t, rotation, lengths = t[used], rotation[used], lengths[used]
    needed = 17 if offsets else 16
    if len(t) < needed:
        raise ValueError(f"stewart_from_log needs {needed} rows or more, got {len(t)} that can be used")

    middle, turned = t.mean(axis=0), _mean_rotation(rotation)
    moved, turn = t - middle, rotation @ turned.T - np.eye(3)
    columns = np.concatenate(
        [np.ones((len(t), 1)), 2 * moved, 2 * np.einsum("nij,ni->nj", turn, moved), 2 * turn.reshape(-1, 9)],
        axis=1,
    )
    squares = lengths**2 - np.sum(moved**2, axis=1, keepdims=True)
    if offsets:
        ends = [
            _least_squares(np.c_[columns, lengths.mean() - leg], y)
            for leg, y in zip(lengths.T, squares.T, strict=True)
        ]
    else:
        ends = _least_squares(columns, squares).T
    legs, points = np.array([x[1:4] for x in ends]), np.array([x[4:7] for x in ends])
    dtype = poses.translation.dtype
    try:
        return Stewart(base=(middle + points - legs).astype(dtype), platform=(points @ turned).astype(dtype))
    except ValueError as error:
        raise ValueError(f"stewart_from_log: what the log says is refused: {error}") from None


# The log


def _log(poses: Any, joints: Any, pose: Any, joint: Any, name: str = "joints") -> tuple[Any, np.ndarray]:
    """Both as arrays, of as many rows."""
    found = rows_of("poses", poses, pose), rows_of(name, joints, joint)
    for what, (_, is_batch) in zip(("poses", name), found, strict=True):
        if not is_batch:
            raise ValueError(f"{what} must be a batch, one row a measurement, got a single one")
    poses, joints = (value for value, _ in found)
    same_size((poses, joints), (True, True))
    if not len(joints):
        raise ValueError(f"{name} must have at least one row, got none")
    return jax.tree.map(np.asarray, (_settled(poses), joints))


_settled = jax.jit(jax.vmap(settle))
_length = jax.jit(lambda mech: mech.length())


@jax.jit
def _row_status(mech: Mechanism, poses: Any, joints: jax.Array) -> jax.Array:
    """BAD_INPUT, SINGULAR where a leg is stretched or folded, OK. -> (rows,)"""

    def one(pose, joints):
        is_given = is_possible(mech, joints) & all_finite(pose) & is_pose(pose)
        is_regular = least_joint_sigma(mech, pose, joints) >= SINGULAR_BELOW
        return jnp.where(is_given, jnp.where(is_regular, Status.OK, Status.SINGULAR), Status.BAD_INPUT)

    return jax.vmap(one)(poses, joints)


def _in_blocks(log: Any, used: np.ndarray) -> tuple[Any, np.ndarray]:
    """The rows used, (blocks, rows, ...), and 1 for each, 0 for those that fill the last block."""
    size = min(BLOCK, 1 << (len(used) - 1).bit_length())
    fill = -len(used) % size
    index = np.concatenate([used, np.repeat(used[:1], fill)]).reshape(-1, size)
    is_row = (np.arange(index.size) < len(used)).reshape(index.shape)
    return jax.tree.map(lambda leaf: leaf[index], log), is_row


def _mean_rotation(rotation: np.ndarray) -> np.ndarray:
    u, _, v = np.linalg.svd(rotation.mean(axis=0))
    return u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v


def _least_squares(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """By columns of unit norm; ValueError where they are dependent."""
    norms = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(norms > 0, norms, 1)
    found, _, _, sizes = np.linalg.lstsq(scaled, values, rcond=None)
    if not sizes[-1] > LINEAR_RANK * sizes[0]:
        raise ValueError(
            "stewart_from_log: the poses must move and turn in all directions, "
            f"got rank {np.sum(sizes > LINEAR_RANK * sizes[0])} of {len(norms)}"
        )
    return (found.T / norms).T


# The unknowns


class _Unknowns(NamedTuple):
    """Which numbers are sought."""

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]
    offsets: int  # how many

    @property
    def entries(self) -> int:
        """Of the fields."""
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def split(self, vector: Any) -> tuple[dict[str, Any], Any]:
        """The fields in their shapes, and the offsets."""
        found, at = {}, 0
        for name, shape in zip(self.names, self.shapes, strict=True):
            size = int(np.prod(shape))
            found[name] = vector[at : at + size].reshape(shape)
            at += size
        return found, vector[at:]

    def labels(self) -> tuple[str, ...]:
        entries = [*zip(self.names, self.shapes, strict=True), ("offsets", (self.offsets,))]
        where = lambda index: f"[{','.join(map(str, index))}]" if index else ""
        return tuple(name + where(index) for name, shape in entries for index in np.ndindex(*shape))


def _known(mech: Mechanism) -> list[str]:
    return [field.name for field in dataclasses.fields(mech) if getattr(mech, field.name) is not None]


def _named(mech: Mechanism, fields: Any, offsets: bool) -> tuple[str, ...]:
    name, known = type(mech).__name__, _known(mech)
    fields = checks.are_words("fields", fields)
    for field in fields:
        if field not in known:
            raise ValueError(f"fields must be among {', '.join(known)} of this {name}, got {field!r}")
    if len(set(fields)) < len(fields) or not (fields or offsets):
        raise ValueError(f"fields must name at least one field of {name}, and none twice, got {fields}")
    return fields


def _seen(mech: Mechanism, row: Any) -> tuple[str, ...]:
    """The fields that the residual depends on."""
    slopes = _slopes(mech, *row)
    return tuple(name for name in _known(mech) if np.asarray(getattr(slopes, name)) != 0)


@jax.jit
def _slopes(mech: Mechanism, pose: Any, joints: jax.Array) -> Mechanism:
    """The greatest derivative of the residual, in the shape of the mechanism."""
    return jax.tree.map(
        lambda leaf: jnp.max(jnp.abs(leaf)), jax.jacrev(lambda mech: mech.residual(pose, joints))(mech)
    )


def _equations(mech: Mechanism, poses: Any, joints: jax.Array) -> int:
    """c; ValueError where it is not the number of joints that a pose determines."""
    row = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), (poses, joints))
    count, bound = jax.eval_shape(mech.residual, *row).shape[0], joints.shape[1] - mech.free_joints
    if count != bound:
        raise ValueError(
            "calibrate takes a mechanism with one closure equation a joint, "
            f"{type(mech).__name__} has {count} for {bound}"
        )
    return count


def _weights(sigma: Any, joint_size: np.ndarray) -> np.ndarray:
    """What the error of each joint is multiplied by. -> (m,)"""
    if sigma is None:
        return 1 / joint_size
    sigma = checks.real_numpy("sigma", sigma).astype(joint_size.dtype)
    if sigma.shape not in ((), joint_size.shape):
        raise ValueError(f"sigma must have shape () or {joint_size.shape}, got {sigma.shape}")
    checks.is_finite("sigma", sigma)
    checks.is_positive("sigma", sigma)
    return np.broadcast_to(1 / sigma, joint_size.shape)


# Levenberg-Marquardt


class _Linear(NamedTuple):
    """The errors about scaled unknowns, and the singular value decomposition of their Jacobian."""

    vector: jax.Array  # (k,)
    cost: jax.Array  # () norm of the weighted errors
    explained: jax.Array  # (k,) the errors along each left singular vector that counts
    sizes: jax.Array  # (k,) singular values
    directions: jax.Array  # (k, k) right singular vectors, one a row
    known: jax.Array  # (k,) whether the log says anything along it


class _State(NamedTuple):
    best: _Linear
    trial: jax.Array
    damping: jax.Array
    steps: jax.Array
    is_done: jax.Array


def _error(mech: Mechanism, joints: jax.Array, pose: Any) -> tuple[jax.Array, jax.Array]:
    """e = -B^-1 F, what Newton adds to the joints, the free ones held, and B. -> (c,), (c, c)"""
    value = mech.residual(pose, joints)
    b = joint_jacobian(mech, pose, joints)[:, : value.shape[0]]
    return -jnp.linalg.solve(b, value), b


@jax.jit
def _errors(mech: Mechanism, joints: jax.Array, poses: Any) -> jax.Array:
    return jax.vmap(lambda q, pose: _error(mech, q, pose)[0])(joints, poses)


@partial(jax.jit, static_argnums=5)
def _fit(
    mech: Mechanism, log: Any, weights: jax.Array, scale: jax.Array, steps: int, unknowns: _Unknowns
) -> _State:
    linearize = partial(_linearize, mech, log, weights, scale, unknowns)
    (_, joints), is_row = log
    eps = jnp.finfo(scale.dtype).eps
    size = weights * joint_scale(mech, jnp.max(jnp.abs(joints), axis=(0, 1)))[: len(weights)]
    roundoff = ROUNDOFFS * eps * jnp.sqrt(jnp.sum(is_row) * jnp.sum(size**2))

    def is_running(state: _State) -> jax.Array:
        is_good = jnp.isfinite(state.best.cost) & (state.damping < MOST_DAMPING)
        return (state.steps < 0) | (~state.is_done & (state.steps < steps) & is_good)

    def advance(state: _State) -> _State:
        new = linearize(state.trial)
        is_better = new.cost < state.best.cost
        is_exact = (jnp.linalg.norm(state.best.explained) <= roundoff) & ~(new.cost < state.best.cost / 2)
        best = jax.tree.map(partial(jnp.where, is_better), new, state.best)
        damping = jnp.where(is_better, state.damping / 10, jnp.maximum(4 * state.damping, 1e-4))
        is_done = is_exact | (jnp.linalg.norm(best.explained) <= 10 * jnp.sqrt(eps) * best.cost)
        return _State(best, best.vector + _step(best, damping), damping, state.steps + 1, is_done)

    start = [jnp.ravel(getattr(mech, name)) for name in unknowns.names]
    start = jnp.concatenate([*start, jnp.zeros(unknowns.offsets, scale.dtype)]) / scale
    zeros = jnp.zeros_like(start)
    nothing = _Linear(start, jnp.inf * size[0], zeros, zeros, jnp.diag(zeros), zeros > 0)
    begin = _State(nothing, start, zeros[0], jnp.asarray(-1), jnp.asarray(False))
    return lax.while_loop(is_running, advance, begin)


def _step(at: _Linear, damping: jax.Array) -> jax.Array:
    """The least one, where the log says something. -> (k,)"""
    damping = jnp.where(damping < 1e-6, 0, damping) * at.sizes[0]
    gain = jnp.where(at.known, at.sizes / (at.sizes**2 + damping**2), 0)
    step = -(gain * at.explained) @ at.directions
    return step * jnp.minimum(1, LONGEST / jnp.maximum(jnp.max(jnp.abs(step)), LONGEST))


def _linearize(
    mech: Mechanism, log: Any, weights: jax.Array, scale: jax.Array, unknowns: _Unknowns, vector: jax.Array
) -> _Linear:
    """Errors and Jacobian of the log, reduced block by block to one triangle of all rows."""

    def row(pose, joints):
        def at(vector):
            values, shift = unknowns.split(vector * scale)
            return dataclasses.replace(mech, **values), joints + (shift if unknowns.offsets else 0)

        def linear(vector):  # F + B e, whose derivative at a constant e is -B times that of e
            other, q = at(vector)
            value, change = jax.jvp(partial(other.residual, pose), (q,), (held,))
            return value + change

        e, b = _error(*at(vector), pose)
        held = jnp.zeros_like(joints).at[: len(e)].set(e)
        return jnp.c_[-jnp.linalg.solve(b, jax.jacfwd(linear)(vector)), e] * weights[:, None]

    def triangle(block):
        log, is_row = block
        rows = jnp.where(is_row[:, None, None], jax.vmap(row)(*log), 0)
        return jnp.linalg.qr(rows.reshape(-1, rows.shape[-1]), mode="r")

    count = len(vector)
    triangles = lax.map(triangle, log).reshape(-1, count + 1)
    fill = jnp.zeros((count + 1, count + 1), vector.dtype)  # there may be fewer rows than unknowns
    r = jnp.linalg.qr(jnp.concatenate([triangles, fill]), mode="r")
    left, sizes, directions = jnp.linalg.svd(r[:, :-1], full_matrices=False)
    known = sizes > jnp.finfo(vector.dtype).eps ** RANK_POWER * sizes[0]
    explained = jnp.where(known, r[:, -1] @ left, 0)
    return _Linear(vector, jnp.linalg.norm(r[:, -1]), explained, sizes, directions, known)


# What came of it


def _verdict(end: _State) -> Status:
    if not np.isfinite(end.best.cost):
        return Status.NONFINITE
    if not end.is_done:
        return Status.STALLED if end.damping >= MOST_DAMPING else Status.STEP_LIMIT
    return Status.OK if np.all(end.best.known) else Status.SINGULAR


def _covariance(end: _Linear, variance: float) -> np.ndarray:
    """Of the scaled unknowns. -> (k, k)"""
    known, directions = end.known, end.directions
    spread = directions[known] / end.sizes[known, None]
    covariance = variance * spread.T @ spread
    lost = np.linalg.norm(directions[~known], axis=0) > NEGLIGIBLE
    covariance[lost] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return covariance


def _combinations(labels: tuple[str, ...], null: np.ndarray) -> tuple[str, ...]:
    """A basis (any, k) in echelon form, by words: each row has an unknown that no other row has."""
    rows = null.copy()
    for i in range(len(rows)):
        j, pivot = np.unravel_index(np.argmax(np.abs(rows[i:])), rows[i:].shape)
        rows[[i, i + j]] = rows[[i + j, i]]
        rows[i] /= rows[i, pivot]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, pivot], rows[i])
    first = np.argmax(np.abs(rows) > NEGLIGIBLE, axis=1)
    return tuple(_combination(labels, row) for row in rows[np.argsort(first, kind="stable")])


def _combination(labels: tuple[str, ...], row: np.ndarray) -> str:
    terms = [
        ("- " if value < 0 else "+ ") + ("" if abs(abs(value) - 1) < 1e-5 else f"{abs(value):.3g} ") + label
        for label, value in zip(labels, row, strict=True)
        if abs(value) > NEGLIGIBLE
    ]
    shown = " ".join([*terms[:TERMS], f"and {len(terms) - TERMS} more"] if len(terms) > TERMS else terms)
    return shown.removeprefix("+ ")
