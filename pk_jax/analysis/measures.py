"""Local indices by name: what workspaces are judged by, in the form that gradients want.

J maps joint rates onto the platform's twist, lengths measured in a stated length, so that no index adds
metres to radians. Sensors carry no force and do not count; kinematically redundant joints count like all
others.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.singularity import singularity_distance
from pk_jax.geometry import safe
from pk_jax.geometry.matrices import small_det, small_inverse
from pk_jax.geometry.poses import pose_units
from pk_jax.kinematics.blocks import has_one_joint_an_equation, joint_blocks
from pk_jax.kinematics.jacobian import joint_jacobian, pose_jacobian, units
from pk_jax.mechanisms.base import Mechanism

Measure = Callable[[Mechanism, Any, jax.Array], jax.Array]  # of one configuration -> ()


class Maps(NamedTuple):
    """J and its (pseudo-)inverse, and A with rows of unit norm, all without units."""

    forward: jax.Array  # (n, m)
    inverse: jax.Array  # (m, n)
    rows: jax.Array  # (c, n)


def maps_of(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> Maps:
    """J, its inverse and the rows of A, lengths over `length` (default: `mech.length()`)."""
    length = mech.length() if length is None else length
    a, b = pose_jacobian(mech, pose, joints), joint_jacobian(mech, pose, joints)
    a = a * length ** units(pose_units(pose, mech.pose_units), a.dtype)
    b = b * length ** units(mech.joint_units or (1,) * joints.shape[0], b.dtype)
    rows = mech.actuated_rows or a.shape[0]
    count = rows + mech.free_joints  # of the joints that move the platform
    is_simple = has_one_joint_an_equation(joint_blocks(mech, pose, joints))
    a, b = a[:rows], b[:rows, :count]
    unit = a / safe.norm(a)[:, None]
    if mech.free_joints:  # (n, m) with m > n
        j = -small_inverse(a) @ b
        return Maps(j, j.T @ small_inverse(j @ j.T), unit)
    g = -(a / jnp.diagonal(b)[:, None] if is_simple else small_inverse(b) @ a)
    if a.shape[0] == a.shape[1]:
        return Maps(-small_inverse(a) @ b, g, unit)
    return Maps(small_inverse(g.T @ g) @ g.T, g, unit)


def frobenius_isotropy(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> jax.Array:
    """n / (|J| |J^-1|), Frobenius norms: 1 where J is a scaled rotation, 0 at a singularity. Smooth. -> ()"""
    maps = maps_of(mech, pose, joints, length)
    return maps.inverse.shape[1] / jnp.sqrt(jnp.sum(maps.forward**2) * jnp.sum(maps.inverse**2))


def isotropy(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> jax.Array:
    """1/kappa(J), 2-norm (Nam, Lee and Park 2006, sec. 4.1). Conical points where J is isotropic. -> ()"""
    maps = maps_of(mech, pose, joints, length)
    n = maps.inverse.shape[1]
    if n == 2:
        gram = maps.inverse.T @ maps.inverse
        half = (gram[0, 0] + gram[1, 1]) / 2
        apart = safe.norm(jnp.stack([(gram[0, 0] - gram[1, 1]) / 2, gram[0, 1]]))
        det = gram[0, 0] * gram[1, 1] - gram[0, 1] ** 2
        return jnp.sqrt(jnp.maximum(det, 0)) / (half + apart)
    sigma = jnp.linalg.svd(maps.inverse, compute_uv=False)
    return sigma[-1] / sigma[0]


def manipulability(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> jax.Array:
    """sqrt(det(J J^T)) (Yoshikawa 1985): inf at type II, 0 at type I singularities. -> ()"""
    return 1 / resistivity(mech, pose, joints, length)


def resistivity(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> jax.Array:
    """1 / sqrt(det(J J^T)), of a square J 1 / |det J|: 0 at a type II singularity. -> ()"""
    inverse = maps_of(mech, pose, joints, length).inverse
    if inverse.shape[0] == inverse.shape[1]:
        return jnp.abs(small_det(inverse))
    return jnp.sqrt(small_det(inverse.T @ inverse))


def stiffness_index(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> jax.Array:
    """n / |J|^2, the reciprocal of the platform's mean compliance with actuators of unit stiffness. -> ()

    0 at a type II singularity; of unit joint stiffness in the unit of force over `length`.
    """
    maps = maps_of(mech, pose, joints, length)
    return maps.inverse.shape[1] / jnp.sum(maps.forward**2)


def clearance(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> jax.Array:
    """1 / |A^+|, A with unit rows: how far from type II, a lower bound of its least singular value. -> ()

    Of a square A with the sign of det A, so that it is smooth and negative beyond a singularity.
    """
    rows = maps_of(mech, pose, joints, length).rows
    if rows.shape[0] == rows.shape[1]:
        inverse = small_inverse(rows)
        sign = jnp.sign(small_det(rows))
    else:
        inverse = small_inverse(rows.T @ rows) @ rows.T
        sign = 1.0
    return sign / jnp.sqrt(jnp.sum(inverse**2))


def to_singularity(mech: Mechanism, pose: Any, joints: jax.Array, length: Any = None) -> jax.Array:
    """`singularity_distance` of either type, a sine in [0, 1]. -> ()"""
    return singularity_distance(mech, pose, joints, length=length)


INDICES: dict[str, Measure] = {
    "frobenius_isotropy": frobenius_isotropy,
    "isotropy": isotropy,
    "resistivity": resistivity,
    "manipulability": manipulability,
    "stiffness": stiffness_index,
    "clearance": clearance,
    "singularity_distance": to_singularity,
}


def measure_of(index: Any, length: float | None = None) -> Measure:
    """A local index by name, lengths over `length`; a function of (mech, pose, joints) as it is.

    ValueError for others.
    """
    if callable(index):
        return index
    if not isinstance(index, str) or index not in INDICES:
        raise ValueError(
            f"index must be a function or one of {', '.join(INDICES)}, got {checks.shown(index)}"
        )
    return INDICES[index] if length is None else partial(INDICES[index], length=length)


def names_of(indices: Any) -> tuple[Any, ...]:
    """One index or several, each a name or a function."""
    several = tuple(indices) if isinstance(indices, tuple | list) else (indices,)
    for index in several:
        measure_of(index)
    return several


def length_of(value: Any) -> float | None:
    """A length that was given, positive and finite, or None."""
    if value is not None and not (checks.is_number(value) and value > 0):
        raise ValueError(f"length must be a positive number, got {checks.shown(value)}")
    return None if value is None else float(np.float64(value))
