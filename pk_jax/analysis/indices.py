"""Local performance indices of a pose: isotropy and resistivity."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.geometry import safe
from pk_jax.geometry.poses import pose_units
from pk_jax.kinematics.batching import home_shapes, over_rows, rows_of, where
from pk_jax.kinematics.inverse import branch_rows, inverse_kinematics
from pk_jax.kinematics.jacobi import least_singular_value
from pk_jax.kinematics.jacobian import SINGULAR_BELOW, ScaledJacobians, scaled_jacobians
from pk_jax.mechanisms.base import Mechanism, require_mechanism
from pk_jax.status import Status


class LocalIndices(NamedTuple):
    """One entry a row; batch first."""

    isotropy: jax.Array  # () 1/kappa of J, 0 at a singularity, 1 where J is a scaled rotation
    resistivity: jax.Array  # () omega = 1/|det J|: 0 at a type II singularity, inf at type I
    status: jax.Array  # () Status


def local_indices(mech: Mechanism, pose: Any, branch: Any = None) -> LocalIndices:
    """Isotropy 1/kappa(J) and resistivity 1/|det J| at a pose (Nam, Lee and Park 2006, sec. 4.1).

    pose:    like the mechanism's, or batched on a leading axis
    branch:  working mode, as for `inverse_kinematics`

    The singular values are those of J with lengths over `mech.length()`; where all coordinates are
    lengths, or all joints angles, that changes nothing. Resistivity keeps its unit: for the 2-RRR
    1/length^2. For non-square J it is 1/sqrt(det(J J^T)).

    Status: OK; SINGULAR: the limits above are given; UNREACHABLE or BAD_INPUT: NaN is given. The
    derivatives are finite everywhere; at an exactly isotropic pose, where 1/kappa has a conical
    point, the derivative of the isotropy is the mean of the directional ones, 0.
    """
    require_mechanism("local_indices", mech)
    pose, many = rows_of("pose", pose, home_shapes(mech)[0])
    if branch is None:
        return _local(mech, (pose,), (many,))
    branch, branches = branch_rows(mech, branch)
    return _local(mech, (pose, branch), (many, branches))


@partial(jax.jit, static_argnums=2)
def _local(mech, pose_and_branch, are_batched):
    return over_rows(lambda *row: _one(mech, *row), pose_and_branch, are_batched)


def _one(mech: Mechanism, pose: jax.Array, branch: jax.Array | None = None) -> LocalIndices:
    solved = inverse_kinematics(mech, pose, branch)
    is_ok = solved.status == Status.OK
    home_pose, home_joints = mech.home()  # lost rows work at home and are masked after
    pose = where(is_ok, pose, home_pose)
    joints = jnp.where(is_ok, solved.joints, home_joints)
    isotropy, resistivity = indices_at(mech, pose, joints)
    jacobian = jax.lax.stop_gradient(scaled_jacobians(mech, pose, joints).pose)
    sigma = least_singular_value(jacobian)
    is_type_one = solved.status == Status.SINGULAR
    is_type_two = is_ok & (sigma < SINGULAR_BELOW)
    limit = lambda value, type_one: jnp.where(is_ok, value, jnp.where(is_type_one, type_one, jnp.nan))
    status = jnp.where(is_type_two, Status.SINGULAR, solved.status).astype(jnp.int32)
    return LocalIndices(limit(isotropy, 0.0), limit(resistivity, jnp.inf), status)


def indices_at(mech: Mechanism, pose: jax.Array, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Isotropy and resistivity of a configuration, unguarded. -> (), ()"""
    jacobians = scaled_jacobians(mech, pose, joints)
    isotropy, resistivity = indices_of(jacobians)
    # det J has the units of the pose over those of the joints
    of_pose = pose_units(pose, mech.pose_units)
    power = sum(of_pose) - len(of_pose) * np.mean(mech.joint_units or (1,) * joints.shape[0])
    return isotropy, resistivity / mech.length() ** power


def indices_of(jacobians: ScaledJacobians) -> tuple[jax.Array, jax.Array]:
    """1/kappa and 1/|det J| of J = -A^-1 B. -> (), ()

    Two by two they come from adj(A) B, which is J up to a factor and exists on a type II
    singularity too, without a square root of a difference.
    """
    a, b = jacobians
    if a.shape == b.shape == (2, 2):
        adjugate = jnp.stack([jnp.stack([a[1, 1], -a[0, 1]]), jnp.stack([-a[1, 0], a[0, 0]])])
        det_a = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        det_b = b[0, 0] * b[1, 1] - b[0, 1] * b[1, 0]
        return isotropy_2x2(adjugate @ b), safe.divide(jnp.abs(det_a), jnp.abs(det_b))
    if a.shape[0] == a.shape[1]:
        j = jnp.linalg.solve(a, b)
    else:
        j = jnp.linalg.pinv(jnp.linalg.solve(b, a))
    sigma = jnp.linalg.svd(j, compute_uv=False)
    return sigma[-1] / sigma[0], 1 / jnp.prod(sigma)


def isotropy_2x2(m: jax.Array) -> jax.Array:
    """sigma_min / sigma_max of a 2 x 2 matrix, cancellation-free. -> ()

    m is a scaled rotation (p, q) plus a scaled reflection (r, s); sigma = |(p, q)| +- |(r, s)|.
    """
    rotation = safe.norm(jnp.stack([m[0, 0] + m[1, 1], m[1, 0] - m[0, 1]]))
    reflection = safe.norm(jnp.stack([m[0, 0] - m[1, 1], m[1, 0] + m[0, 1]]))
    det = jnp.abs(m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0])
    return safe.divide(4 * det, (rotation + reflection) ** 2)
