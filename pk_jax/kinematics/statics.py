"""Screws and statics: the wrench line of every actuator, and forces at the joints and on the platform.

With A x' + B q' = 0 and the power balance W . x' = tau . q', the wrench that joint forces tau exert on the
platform is W = -A^T lambda with tau = B^T lambda. The rows of G = -B^-1 A = J_F^T, q' = G x', are the
wrenches of unit joint forces, and the one Jacobian gives statics and kinematics (eqs. 20-27 of the
screw analysis of planar parallel robots: J = J_F^-T).
"""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry import safe
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import pose_units, tangent_size
from pk_jax.kinematics.batching import all_finite, configurations, home_shapes, over_rows, rows_of
from pk_jax.kinematics.blocks import joint_blocks
from pk_jax.kinematics.closure import INCONSISTENT_ABOVE
from pk_jax.kinematics.jacobian import (
    SINGULAR_BELOW,
    joint_jacobian,
    pose_jacobian,
    scaled_jacobians,
    self_motions,
    units,
)
from pk_jax.mechanisms.base import LegMechanism, Mechanism, require_mechanism
from pk_jax.status import Status

A_COUPLE = 1e-9  # force over moment / length() below which a wrench is a pure couple
MOST_PRELOADS = 3  # degrees of redundancy that bounds are distributed over


class Screws(NamedTuple):
    """Wrenches of actuators and constraints, batch first; see `joint_forces` for what a wrench is."""

    lines: jax.Array  # (m, n) unit wrench of each actuator: direction, and moment about the platform's origin
    arms: jax.Array  # (m,) joint force (torque) per unit of that wrench, signed: tau_i = arm_i f_i
    constraints: jax.Array  # (c, n) the rows of A, as they are


def screws(mech: Mechanism, pose: Any, joints: Any) -> Screws:
    """The line of action of every actuator and its moment arm: row i of J_F^T is line_i / arm_i.

    pose, joints: one configuration or many. A line's wrench is (fx, fy, moment), or (force, moment) in
    space, the moment taken about the platform's origin; its force is a unit vector, and a pure couple
    has moment length(). Each is reciprocal to every joint but its own, the other motors of its leg
    included. The arm of a telescopic leg is 1, that of a driven revolute joint its distance
    from the line, la sin(psi). NaN where the line is none (the tip of a 6-link's arm on its first joint).

    Kinematically redundant joints stand in series with others, here as if they were locked, and add no
    wrench: their lines and arms are 0.

    Where a leg is stretched or folded (type I) its arms are 0 and its lines what they tend to.
    The sign: a line points from the base to the platform in legs whose equation grows with the distance
    from the base, as all of the house do; legs with several motors likewise.

    Source: eqs. (20)-(24), (29)-(31), (34) of the screw analysis of planar parallel robots. ValueError for a
    mechanism with more joints than closure equations.
    """
    return _over("screws", _screws, mech, pose, joints)


def joint_forces(mech: Mechanism, pose: Any, joints: Any, wrench: Any) -> jax.Array:
    """Joint forces (torques at angles) with which the actuators exert `wrench` on the platform. -> (m,)

    wrench: (n,), power-conjugate to the tangent of the pose: (fx, fy), (fx, fy, moment) or (force, moment),
    moments about the platform's origin; for an `AxisPose` the force along the axis and the moment about
    the base's origin (the rest is borne by the guide); or (batch, n). Kinematically redundant joints
    bear what the others load them with. Redundant actuation: those of least norm,
    (m,) = J_F^+ W (a joint force counts times length() beside torques, where joints are of both kinds).
    Sensors carry no force. NaN at a type II singularity, where some wrench has no forces, and for
    redundant actuation where the closure equations are dependent; zero at a joint of a type I singularity.
    """
    return _over("joint_forces", _joint_forces, mech, pose, joints, wrench=wrench)


def platform_wrench(mech: Mechanism, pose: Any, joints: Any, forces: Any) -> jax.Array:
    """The wrench that joint forces (m,) exert on the platform, W = J_F tau. -> (n,)

    Conventions of `joint_forces`. NaN at a type I singularity, where a leg can exert any force, and where
    the forces of kinematically redundant joints are not those that the others load them with (to 1e-6).
    """
    return _over("platform_wrench", _platform_wrench, mech, pose, joints, forces=forces)


def preloads(mech: Mechanism, pose: Any, joints: Any) -> jax.Array:
    """Joint forces that balance one another: an orthonormal basis of the null space of J_F. -> (c - n, m)

    Empty where actuation is not redundant. Sensors carry no force. NaN where the closure equations are
    dependent.
    """
    return _over("preloads", _preloads, mech, pose, joints)


def stiffness(mech: Mechanism, pose: Any, joints: Any, k: Any) -> jax.Array:
    """Stiffness of the platform, K = J_F diag(k) J_F^T, for joints of stiffness k () or (m,). -> (n, n)

    Actuators without preload; sensors count nothing; a kinematically redundant joint gives way in series
    with the others, as much as costs least energy. NaN at a type I singularity.
    Source: Gosselin 1990, IEEE Trans. Robotics and Automation 6(3).
    """
    require_mechanism("stiffness", mech)
    _, joints_like = home_shapes(mech)
    if not isinstance(k, jax.core.Tracer):
        k = checks.real_numpy("k", k)
        if k.ndim > 1 or k.shape not in ((), joints_like.shape):
            raise ValueError(f"k must have shape () or {joints_like.shape}, got {k.shape}")
        if not np.all(k >= 0) or not np.all(np.isfinite(k)):
            raise ValueError(f"k must be finite and at least 0, got {k.tolist()}")
    k = jnp.broadcast_to(jnp.asarray(k, joints_like.dtype), joints_like.shape)
    return _over("stiffness", _stiffness, mech, pose, joints, k=k)


class BoundedForces(NamedTuple):
    """Joint forces within bounds, batch first."""

    forces: jax.Array  # (m,) NaN unless the status is OK
    status: jax.Array  # () Status: OK; UNREACHABLE: no forces within the bounds do it; SINGULAR; BAD_INPUT


def bounded_joint_forces(
    mech: Mechanism, pose: Any, joints: Any, wrench: Any, lower: Any, upper: Any
) -> BoundedForces:
    """The joint forces of least norm within bounds that exert `wrench` on the platform.

    lower, upper: () or (m,), -inf and inf allowed. Exact: the least-norm forces on each set of at most c - n
    bounds are compared, which is every face that can hold the optimum of a strictly convex
    quadratic program. At most three degrees of redundancy.
    """
    require_mechanism("bounded_joint_forces", mech)
    _, joints_like = home_shapes(mech)
    bounds = []
    for name, bound in (("lower", lower), ("upper", upper)):
        bound = checks.real_array(name, bound)
        if bound.shape not in ((), joints_like.shape):
            raise ValueError(f"{name} must have shape () or {joints_like.shape}, got {bound.shape}")
        bounds.append(jnp.broadcast_to(bound.astype(joints_like.dtype), joints_like.shape))
    if checks.is_concrete(bounds) and not np.all(np.asarray(bounds[0]) <= np.asarray(bounds[1])):  # NaN, too
        raise ValueError(f"lower must be at most upper, got {np.asarray(lower)} and {np.asarray(upper)}")
    return _over(
        "bounded_joint_forces", _bounded, mech, pose, joints, wrench=wrench, lower=bounds[0], upper=bounds[1]
    )


# --- one configuration


def _over(name: str, function: Any, mech: Mechanism, pose: Any, joints: Any, **more: Any) -> Any:
    """`function` of one configuration or of many; `more` are vectors, one or one a row."""
    require_mechanism(name, mech)
    arguments, are_batched = configurations(mech, pose, joints)
    pose_like, joints_like = home_shapes(mech)
    sizes = {"wrench": tangent_size(pose_like)}
    for what, value in more.items():
        like = jax.ShapeDtypeStruct((sizes.get(what, joints_like.shape[0]),), joints_like.dtype)
        value, many = rows_of(what, value, like)
        arguments, are_batched = (*arguments, value), (*are_batched, many)
    return _rows(mech, arguments, function, are_batched)


@partial(jax.jit, static_argnums=(2, 3))
def _rows(mech, arguments, function, are_batched):
    return over_rows(partial(function, mech), arguments, are_batched)


def _screws(mech: Mechanism, pose: Any, joints: jax.Array) -> Screws:
    a, b = pose_jacobian(mech, pose, joints), joint_jacobian(mech, pose, joints)
    unit = units(pose_units(pose, mech.pose_units), a.dtype)
    forces = _equation_forces(mech, pose, joints, a * unit)
    lines, arms = jnp.zeros((b.shape[1], a.shape[1]), a.dtype), jnp.zeros(b.shape[1], b.dtype)
    for block in joint_blocks(mech, pose, joints, b.shape[1] - mech.free_joints):
        rows, columns = np.array(block.equations), np.array(block.joints, int)
        if len(rows) != len(columns):
            raise ValueError(
                f"screws need as many joints as closure equations, {type(mech).__name__} has "
                f"{len(columns)} joints in {len(rows)} of them"
            )
        adjugate, det = _adjugate(b[rows][:, columns])
        outward = jnp.asarray((-1.0) ** np.arange(len(rows) - 1, -1, -1), b.dtype)
        wrenches = outward[:, None] * (adjugate @ a[rows])
        force, moment = safe.norm(adjugate @ forces[rows]), safe.norm(wrenches * (1 - unit))
        couple = moment / mech.length()
        size = jnp.where(force > A_COUPLE * couple, force, couple)
        lines = lines.at[columns].set(wrenches / size[:, None])
        arms = arms.at[columns].set(-outward * det / size)
    return Screws(lines, arms, a)


def _equation_forces(mech: Mechanism, pose: Any, joints: jax.Array, of_pose: jax.Array) -> jax.Array:
    """The force vector of every closure equation: what A has of translations, or of its leg. -> (c, d)"""
    if isinstance(pose, AxisPose) and isinstance(mech, LegMechanism):
        forces = mech.forces(pose, joints)[1]
        return forces.transpose(1, 0, 2).reshape(of_pose.shape[0], -1)
    return of_pose


def _adjugate(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """det(A) A^-1, which exists at a singular matrix, too, and det(A). -> (e, e), ()"""
    if len(matrix) == 1:
        return jnp.ones_like(matrix), matrix[0, 0]
    if len(matrix) == 2:
        (a, b), (c, d) = matrix
        return jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]), a * d - b * c
    u, sigma, vt = jnp.linalg.svd(matrix)
    sign = jnp.linalg.det(u) * jnp.linalg.det(vt)
    others = jnp.stack([jnp.prod(jnp.delete(sigma, i)) for i in range(len(matrix))])
    return sign * (vt.T * others) @ u.T, sign * jnp.prod(sigma)


def _actuated(mech: Mechanism, pose: Any, joints: jax.Array) -> tuple[jax.Array, ...]:
    """A and B of the rows that carry force, and the units that make a wrench and forces fit them."""
    scaled = scaled_jacobians(mech, pose, joints)
    rows = slice(mech.actuated_rows)
    of_pose = mech.length() ** units(pose_units(pose, mech.pose_units), scaled.pose.dtype)
    of_joints = mech.length() ** units(mech.joint_units or (1,) * joints.shape[0], scaled.pose.dtype)
    return scaled.pose[rows], scaled.joints[rows], of_pose, of_joints


def _joint_forces(mech: Mechanism, pose: Any, joints: jax.Array, wrench: jax.Array) -> jax.Array:
    a, b, of_pose, of_joints = _actuated(mech, pose, joints)
    c, n = a.shape
    singular = jnp.linalg.svd(a, compute_uv=False)[-1] < SINGULAR_BELOW
    a = jnp.where(singular, jnp.eye(c, n, dtype=a.dtype), a)
    q, r = jnp.linalg.qr(a)
    lagrange = -q @ jnp.linalg.solve(r.T, wrench * of_pose)  # A^T lambda = -W
    if c > n:  # and of all such the one with the least |B^T lambda|
        rest = b.T - (b.T @ q) @ q.T
        singular = singular | _is_dependent(rest, c - n)
        preload = jnp.linalg.pinv(rest, rtol=SINGULAR_BELOW / 1e3) @ (b.T @ lagrange)
        lagrange = lagrange - preload + q @ (q.T @ preload)
    return jnp.where(singular, jnp.nan, b.T @ lagrange / of_joints)


def _is_dependent(rest: jax.Array, degrees: int) -> jax.Array:
    """Whether some preload does not reach the joints: [A B] has dependent rows."""
    sigma = jnp.linalg.svd(rest, compute_uv=False)
    return ~(sigma[degrees - 1] > SINGULAR_BELOW * jnp.maximum(sigma[0], 1))


def _wrenches(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    """Wrenches of unit joint forces, J_F^T: none of sensors, NaN of a leg at type I. -> (m, n)"""
    lines, arms, _ = _screws(mech, pose, joints)
    unit = units(mech.joint_units or (1,) * joints.shape[0], arms.dtype)
    is_singular = jnp.abs(arms) < SINGULAR_BELOW * mech.length() ** (1 - unit)
    carries = np.arange(joints.shape[0]) < (mech.actuated_rows or joints.shape[0] - mech.free_joints)
    per_force = lines / jnp.where(is_singular, jnp.nan, arms)[:, None]
    return jnp.where(carries[:, None], per_force, 0)


def _platform_wrench(mech: Mechanism, pose: Any, joints: jax.Array, forces: jax.Array) -> jax.Array:
    wrench = _wrenches(mech, pose, joints).T @ forces
    if mech.free_joints:
        borne = self_motions(mech, pose, joints) @ forces
        size = jnp.max(jnp.abs(forces))
        wrench = jnp.where(jnp.max(jnp.abs(borne)) <= INCONSISTENT_ABOVE * size, wrench, jnp.nan)
    return wrench


def _preloads(mech: Mechanism, pose: Any, joints: jax.Array) -> jax.Array:
    a, b, _, of_joints = _actuated(mech, pose, joints)
    degrees = a.shape[0] - a.shape[1]
    balanced = jnp.linalg.svd(a)[0][:, a.shape[1] :]  # A^T lambda = 0
    if not degrees:
        return jnp.zeros((0, b.shape[1]), b.dtype)
    is_dependent = _is_dependent(b.T @ balanced, degrees)
    return jnp.where(is_dependent, jnp.nan, jnp.linalg.qr((b / of_joints).T @ balanced)[0].T)


def _stiffness(mech: Mechanism, pose: Any, joints: jax.Array, k: jax.Array) -> jax.Array:
    wrenches = _wrenches(mech, pose, joints)
    stiff = k[:, None] * wrenches
    if mech.free_joints:  # their rates are those of least energy
        series = self_motions(mech, pose, joints).T
        stiff = stiff - k[:, None] * (
            series @ jnp.linalg.solve(series.T @ (k[:, None] * series), series.T @ stiff)
        )
    return wrenches.T @ stiff


def _bounded(
    mech: Mechanism, pose: Any, joints: jax.Array, wrench: jax.Array, lower: jax.Array, upper: jax.Array
) -> BoundedForces:
    free, basis = _joint_forces(mech, pose, joints, wrench), _preloads(mech, pose, joints)
    degrees, m = basis.shape
    if degrees > MOST_PRELOADS:
        raise ValueError(f"bounds are distributed over at most {MOST_PRELOADS} preloads, got {degrees}")
    singular = ~jnp.all(jnp.isfinite(free))
    free = jnp.where(singular, 0, free)
    free = free - basis.T @ (basis @ free)  # least norm, in the plain sense
    candidates = [free[None]]
    for count in range(1, degrees + 1):
        held = np.array(list(itertools.combinations(range(m), count)))
        sides = np.array(list(itertools.product((0, 1), repeat=count)))
        held, sides = np.repeat(held, len(sides), axis=0), np.tile(sides, (len(held), 1))
        at = jnp.where(sides == 0, lower[held], upper[held])
        amount = jax.vmap(lambda j, to: jnp.linalg.pinv(basis[:, j].T) @ (to - free[j]))(held, at)
        candidates.append(free + amount @ basis)
    tried = jnp.concatenate(candidates)
    size = jnp.max(jnp.abs(free)) + jnp.max(jnp.where(jnp.isfinite(tried), jnp.abs(tried), 0), axis=1)
    slack = 64 * jnp.finfo(tried.dtype).eps * size[:, None]
    fits = jnp.all((tried >= lower - slack) & (tried <= upper + slack), axis=1)  # NaN compares False
    best = jnp.argmin(jnp.where(fits, jnp.sum(tried**2, axis=1), jnp.inf))
    is_good = jnp.any(fits) & ~singular
    status = jnp.where(singular, Status.SINGULAR, jnp.where(is_good, Status.OK, Status.UNREACHABLE))
    is_given = all_finite(pose, joints, wrench) & ~jnp.any(jnp.isnan(lower) | jnp.isnan(upper))
    status = jnp.where(is_given, status, Status.BAD_INPUT)
    forces = jnp.where(is_good, jnp.clip(tried[best], lower, upper), jnp.nan)
    return BoundedForces(forces, status.astype(jnp.int32))
