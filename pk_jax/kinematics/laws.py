"""The laws that every mechanism obeys, ours and yours: `check_mechanism`."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pk_jax.geometry.poses import Turning, difference, pose_units, retract, tangent_size, tangent_zero
from pk_jax.geometry.spread import evenly
from pk_jax.kinematics.closure import INCONSISTENT_ABOVE, is_closed, joint_scale, pose_scale
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.forward import forward_kinematics
from pk_jax.kinematics.inverse import inverse_kinematics
from pk_jax.kinematics.jacobian import joint_jacobian, pose_jacobian, scaled_jacobians
from pk_jax.kinematics.lanes import split, stack
from pk_jax.mechanisms.base import Mechanism, Skeleton, require_mechanism
from pk_jax.status import Status

SAMPLES = 12
SPREAD = 0.02  # of the natural size of each coordinate: how far from home the laws are tried
REGULAR_ABOVE = 0.02  # least singular value at home, of the scaled Jacobian


class Law(NamedTuple):
    """One law, how far it was missed, and what is allowed."""

    name: str
    error: float
    tolerance: float

    @property
    def holds(self) -> bool:
        return self.error <= self.tolerance  # NaN compares False


class LawReport(tuple):
    """The laws in the order they were checked; prints as a table."""

    def __str__(self) -> str:
        return "\n".join(f"{law.name:<58} {law.error:9.2e} <= {law.tolerance:7.1e}" for law in self)


def check_mechanism(mech: Mechanism) -> LawReport:
    """Check the contract and the laws of kinematics on a mechanism, near its home.

    Returns the report of all laws; raises ValueError, one line that names the first broken law,
    its error and the tolerance, or the contract method whose answer has the wrong shape. Call it
    with float64 enabled: the tolerances come from the precision in use.
    """
    require_mechanism("check_mechanism", mech)
    name = type(mech).__name__
    _check_contract(mech, name)
    laws = LawReport(Law(what, float(error), float(allowed)) for what, error, allowed in _laws(mech))
    for law in laws:
        if not law.holds:
            raise ValueError(
                f"{name} breaks a law: {law.name}; error {law.error:.3g}, allowed {law.tolerance:.3g}"
            )
    return laws


def _check_contract(mech: Mechanism, name: str) -> None:
    home = mech.home()
    if not isinstance(home, tuple) or len(home) != 2:
        raise ValueError(f"{name}.home must be (pose, joints), got {type(home).__name__}")
    pose, joints = home
    _arrays(f"{name}.home", *jax.tree.leaves((pose, joints)))
    (value,) = _arrays(f"{name}.residual", mech.residual(pose, joints))
    _arrays(f"{name}.length", mech.length())
    n, m, c = tangent_size(pose), joints.shape[0], value.shape[0] if value.ndim else 0
    if value.ndim != 1 or c < n:
        raise ValueError(f"{name}.residual must have shape (c,) with c >= n = {n}, got {value.shape}")
    for units, count, attribute in ((mech.joint_units, m, "joint_units"), (mech.pose_units, n, "pose_units")):
        if units is not None and (len(units) != count or set(units) - {0, 1}):
            raise ValueError(
                f"{name}.{attribute} must be {count} numbers, 1 = length and 0 = angle, got {units}"
            )
    if m - mech.free_joints > c:
        raise ValueError(
            f"{name} has {m} joints in {c} closure equations: the last {m - c} must be its free_joints"
        )
    if mech.free_joints and m - mech.free_joints < c:
        raise ValueError(
            f"{name} has free_joints = {mech.free_joints}, but its {c} closure equations bind "
            f"{min(m, c)} of the {m} joints"
        )
    if mech.free_joints and (shape := mech.free_range().shape) != (mech.free_joints, 2):
        raise ValueError(f"{name}.free_range must have shape {(mech.free_joints, 2)}, got {shape}")
    if m - mech.free_joints < n:
        raise ValueError(
            f"{name} has {m - mech.free_joints} joints for a pose of {n} coordinates: let the pose have the "
            "platform's own freedoms and no constraint (as in examples/three_rps.py)"
        )
    if (which := _not_round(mech, pose, joints)) is not None:
        raise ValueError(
            f"{name} closes no more after a full turn of coordinate {which + 1} of its pose: say "
            "angles_come_round = False"
        )
    f, a = jax.eval_shape(mech.linearize, pose, joints)  # shapes alone: op by op it would be slow
    if f.shape != (c,) or a.shape != (c, n):
        raise ValueError(
            f"{name}.linearize must give shapes {(c,)} and {(c, n)}, got {f.shape} and {a.shape}"
        )
    if not (mech.length().shape == () and mech.length() > 0):
        raise ValueError(f"{name}.length must be one positive number, got {mech.length()}")
    margins = mech.margins(pose, joints)
    if not isinstance(margins, dict):
        raise ValueError(f"{name}.margins must be a dict of named arrays, got {type(margins).__name__}")
    for which, margin in margins.items():
        _arrays(f"{name}.margins[{which!r}]", margin)
    skeleton = mech.skeleton(pose, joints)
    if not isinstance(skeleton, Skeleton):
        raise ValueError(f"{name}.skeleton must be a pk_jax.Skeleton, got {type(skeleton).__name__}")
    points, segments, ground = skeleton
    _arrays(f"{name}.skeleton points", points)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"{name}.skeleton points must have shape (p, 2) or (p, 3), got {points.shape}")
    indices = {index for segment in segments for index in segment} | set(ground)
    if not indices <= set(range(points.shape[0])):
        raise ValueError(f"{name}.skeleton names points that it does not have: {sorted(indices)}")
    if hasattr(mech, "inverse") and (shape := jax.eval_shape(mech.inverse, pose).shape) != (m,):
        raise ValueError(f"{name}.inverse must have shape {(m,)}, got {shape}")
    if hasattr(mech, "forward"):
        poses, is_real = jax.eval_shape(mech.forward, joints)
        wanted = [leaf.shape for leaf in jax.tree.leaves(pose)]
        shapes = [leaf.shape for leaf in jax.tree.leaves(poses)]
        if is_real.ndim != 1 or shapes != [(is_real.size, *shape) for shape in wanted]:
            raise ValueError(
                f"{name}.forward must give poses (modes, *{wanted}) and is_real (modes,), "
                f"got {shapes} and {is_real.shape}"
            )


def _not_round(mech: Mechanism, pose: Any, joints: jax.Array) -> int | None:
    """The first angle of the pose that claims to come round after a full turn, and does not."""
    angles = np.flatnonzero(np.equal(pose_units(pose, mech.pose_units), 0))
    if isinstance(pose, Turning) or not mech.angles_come_round or not len(angles):
        return None
    turns = np.zeros((len(angles) + 1, len(pose)))  # none, and one of each
    turns[np.arange(len(angles)) + 1, angles] = 2 * np.pi
    closes = _close(mech, pose + jnp.asarray(turns, joints.dtype), joints)
    return int(angles[np.argmin(closes[1:])]) if closes[0] and not np.all(closes) else None


@jax.jit
def _close(mech: Mechanism, poses: Any, joints: jax.Array) -> jax.Array:
    return jax.vmap(lambda pose: is_closed(mech, pose, joints))(poses)


def _arrays(name: str, *values: Any) -> tuple[Any, ...]:
    if not all(isinstance(value, jax.Array | np.ndarray) for value in values):
        kinds = " and ".join(type(value).__name__ for value in values)
        raise ValueError(f"{name} must be made of jax arrays, got {kinds}")
    return values


def _laws(mech: Mechanism):
    """Yield (law, error, tolerance); the errors are dimensionless."""
    eps = float(jnp.finfo(mech.length().dtype).eps)
    exact, differences = 1e4 * eps, 2e2 * eps ** (2 / 3)
    tolerances = {
        "home is regular: 0.02 / least singular value of A": 1.0,
        "home is inside every margin": exact,
        "a batch equals a loop: inverse kinematics": exact,
        "forward kinematics of inverse kinematics is the identity": exact,
        "a batch equals a loop: forward kinematics": exact,
        "the closed-form modes contain the pose": 1e2 * exact,
        "every closed-form mode closes the loops": 1e2 * exact,
        "every closed-form mode closes redundant loops": 10 * INCONSISTENT_ABOVE,
        "linearize gives dF/dx of the residual": exact,
        "entry by entry: the same A": exact,
        "A against central differences": differences,
        "B against central differences": differences,
        "velocities: A x' + B q' = 0": exact,
        "the derivatives of FK and IK are inverses": exact,
        "power balance": exact,
        "dF/d(geometry) against central differences": differences,
        "geometry: dF + B dq = 0": exact,
    }
    for name, error in _errors(mech).items():
        yield name, error, tolerances.get(name, 0.0)  # the others are counts: none is allowed


def _errors(mech: Mechanism) -> dict[str, jax.Array]:
    pose, joints = mech.home()
    leaves, tree = jax.tree.flatten(mech)
    rebuilt = jax.tree.unflatten(tree, leaves)  # outside of jit, which would rebuild both
    same = rebuilt.residual(pose, joints) == mech.residual(pose, joints)
    errors = {"a pytree: flatten and unflatten change nothing": jnp.sum(~same)}
    values = _measured(mech)
    return errors | dict(zip(_names[tree], values, strict=True))


_names: dict[Any, tuple[str, ...]] = {}  # of the laws, by class: jit would sort a dict


@jax.jit  # one compilation for all laws and for all mechanisms of a class
def _measured(mech: Mechanism) -> list[jax.Array]:
    found = dict(_measure(mech))
    _names[jax.tree.structure(mech)] = tuple(found)
    return list(found.values())


def _measure(mech: Mechanism):
    """Yield (law, error); traced once."""
    home, home_joints = mech.home()
    eps = float(jnp.finfo(home_joints.dtype).eps)
    dx, dq = pose_scale(mech, home), joint_scale(mech, home_joints)
    n, dtype = tangent_size(home), dx.dtype

    yield "home closes every loop", ~is_closed(mech, home, home_joints)
    least = jnp.linalg.svd(scaled_jacobians(mech, home, home_joints).pose, compute_uv=False)[-1]
    yield "home is regular: 0.02 / least singular value of A", REGULAR_ABOVE / least
    margins = [jnp.min(v) for v in mech.margins(home, home_joints).values()]
    yield "home is inside every margin", -jnp.min(jnp.stack([*margins, jnp.zeros_like(least)]))

    jacobians = scaled_jacobians(mech, home, home_joints)
    sigmas = [jnp.linalg.svd(j, compute_uv=False)[-1] for j in jacobians]
    spread = SPREAD * jnp.minimum(1, jnp.minimum(*sigmas))  # a singularity is about this far, or more
    poses = jax.vmap(lambda twist: retract(home, twist))(spread * dx * _spread(SAMPLES, n, dtype))
    row = lambda i: jax.tree.map(lambda leaf: leaf[i], poses)
    # through one program, so that bits compare
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf.at[1].set(jnp.nan)]), poses)
    rows = lax.map(lambda poses: inverse_kinematics(mech, poses), both)
    solved, poisoned = (jax.tree.map(lambda leaf, i=i: leaf[i], rows) for i in range(2))
    joints = solved.joints
    yield "inverse kinematics is OK near home (rows lost)", _lost(solved.status)
    closed = jax.vmap(lambda x, q: is_closed(mech, x, q))(poses, joints)
    yield "inverse kinematics closes every loop (rows open)", jnp.sum(~closed)
    looped = lax.map(lambda x: inverse_kinematics(mech, x).joints, poses)
    yield "a batch equals a loop: inverse kinematics", _gap(joints, looped, dq)

    found = forward_kinematics(mech, joints)
    yield "forward kinematics is OK near home (rows lost)", _lost(found.status)
    yield "forward kinematics of inverse kinematics is the identity", _pose_gap(found.pose, poses, dx)
    looped = lax.map(lambda q: forward_kinematics(mech, q).pose, joints)
    yield "a batch equals a loop: forward kinematics", _pose_gap(found.pose, looped, dx)

    pose, q = row(0), joints[0]
    a, b = pose_jacobian(mech, pose, q), joint_jacobian(mech, pose, q)
    size = (jnp.abs(a) @ dx)[:, None]  # of each closure equation
    if hasattr(mech, "forward"):
        modes, is_real = jax.vmap(mech.forward)(joints)
        gap = lambda pose, modes: jax.vmap(lambda mode: jnp.max(jnp.abs(difference(pose, mode)) / dx))(modes)
        gaps = jax.vmap(gap)(poses, modes)
        yield "the closed-form modes contain the pose", jnp.max(jnp.min(jnp.where(is_real, gaps, jnp.inf), 1))
        assembled = jax.vmap(lambda xs, q: jax.vmap(lambda x: mech.residual(x, q))(xs))(modes, joints)
        off = jnp.where(is_real[..., None], jnp.abs(assembled) / size[:, 0], 0)
        loops = "the loops" if a.shape[0] == n else "redundant loops"
        yield f"every closed-form mode closes {loops}", jnp.max(off)

    zero = tangent_zero(pose)
    plain = jax.jacfwd(lambda twist: mech.residual(retract(pose, twist), q))(zero)
    yield "linearize gives dF/dx of the residual", _gap(a * dx, plain * dx, size)
    entries = entrywise(lambda m, x, q: m.linearize(x, q), *jax.tree.map(split, (mech, pose, q)))
    by_entries = stack(entries[1])
    yield "entry by entry: the same A", _gap(by_entries * dx, a * dx, size)
    central = _central(lambda t: mech.residual(retract(pose, t * dx), q), n, eps ** (1 / 3), dtype)
    yield "A against central differences", _gap(a * dx, central, size)
    central = _central(lambda t: mech.residual(pose, q + t * dq), q.shape[0], eps ** (1 / 3), dtype)
    yield "B against central differences", _gap(b * dq, central, size)

    rate = jax.jacfwd(lambda twist: inverse_kinematics(mech, retract(pose, twist)).joints)(zero)
    yield "velocities: A x' + B q' = 0", jnp.max(jnp.abs((a + b @ rate) * dx) / size)
    back = jax.jacfwd(lambda q: difference(pose, forward_kinematics(mech, q).pose))(q)
    yield "the derivatives of FK and IK are inverses", _gap(back @ rate * dx / dx[:, None], jnp.eye(n), 1)
    load, velocity = _spread(2, n, dtype)
    load, velocity = load / dx, velocity * dx
    torques = back.T @ load  # virtual work: torques . q' = load . x'
    yield "power balance", jnp.abs(torques @ (rate @ velocity) - load @ velocity)

    gradient = jax.grad(lambda g: jnp.sum(inverse_kinematics(g, pose).joints / dq))(mech)
    infinite = [jnp.sum(~jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient)]
    yield "derivatives in the geometry are finite (entries lost)", sum(infinite)

    tangent = jax.tree.map(lambda leaf: leaf * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), mech)
    moved = lambda h: jax.tree.map(lambda leaf, rate: leaf + h[0] * rate, mech, tangent)
    of_residual = jax.jvp(lambda g: g.residual(pose, q), (mech,), (tangent,))[1]
    central = _central(lambda h: moved(h).residual(pose, q), 1, eps ** (1 / 3), dtype)
    yield "dF/d(geometry) against central differences", _gap(of_residual[:, None], central, size)
    of_inverse = jax.jvp(lambda g: inverse_kinematics(g, pose).joints, (mech,), (tangent,))[1]
    yield "geometry: dF + B dq = 0", jnp.max(jnp.abs(of_residual + b @ of_inverse) / size[:, 0])

    yield "a NaN row is told", poisoned.status[1] != Status.BAD_INPUT
    others = np.delete(np.arange(SAMPLES), 1)
    yield "a NaN row changes no other row", jnp.sum(poisoned.joints[others] != joints[others])


def _central(function, count: int, step: float, dtype) -> jax.Array:
    """Central differences of `function` (count,) -> (c,) at zero. -> (c, count)"""
    units = step * jnp.eye(count, dtype=dtype)
    return jnp.stack([(function(u) - function(-u)) / (2 * step) for u in units], axis=1)


def _spread(rows: int, columns: int, dtype) -> jax.Array:
    """Evenly spread points in [-1, 1]^columns. -> (rows, columns)"""
    return jnp.asarray(2 * evenly(rows + 1, columns)[1:] - 1, dtype)  # the first is the centre


def _gap(a, b, scale) -> jax.Array:
    return jnp.max(jnp.abs(a - b) / scale)


def _pose_gap(a: Any, b: Any, scale: jax.Array) -> jax.Array:
    return jnp.max(jnp.abs(jax.vmap(difference)(a, b)) / scale)


def _lost(status: jax.Array) -> jax.Array:
    return jnp.sum(status != Status.OK)
