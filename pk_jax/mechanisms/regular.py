"""Whether a mechanism is regular at home, without units as the solvers will judge it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.geometry.poses import pose_units
from pk_jax.mechanisms.base import Mechanism

LEAST_SIGMA = 2.5e-6  # sqrt(6) times what a solver calls singular, which it judges by a lower bound


class ScaledJacobians(NamedTuple):
    """A and B without units: lengths over length(), rows of A of unit norm."""

    pose: jax.Array  # (c, n)
    joints: jax.Array  # (c, m)


def without_units(mech: Mechanism, pose: Any, a: jax.Array, b: jax.Array) -> ScaledJacobians:
    """A and B with lengths measured in `mech.length()` and each equation scaled to |A row| = 1."""
    a = a * mech.length() ** units(pose_units(pose, mech.pose_units), a.dtype)
    b = b * mech.length() ** units(mech.joint_units or (1,) * b.shape[1], b.dtype)
    size = jnp.linalg.norm(a, axis=1, keepdims=True)
    size = jnp.where(size > 0, size, 1)
    return ScaledJacobians(a / size, b / size)


def units(powers: tuple[int, ...], dtype: Any) -> jax.Array:
    """Powers of length of the coordinates: 1 = length, 0 = angle."""
    return jnp.asarray(powers, dtype)


def require_regular_home(mech: Mechanism) -> None:
    """ValueError where a geometry that passed all else has no home to start from."""
    sigmas = np.asarray(_at_home(mech))
    if not np.all(sigmas > LEAST_SIGMA):  # NaN, too
        a, b = sigmas
        raise ValueError(
            f"{type(mech).__name__} must be regular at home, its lengths differ too much or it hardly moves, "
            f"got least singular values {a:.2g} of A and {b:.2g} of B without units"
        )


@jax.jit
def _at_home(mech: Mechanism) -> jax.Array:
    """Least singular values of A and B. -> (2,)"""
    mech = jax.lax.stop_gradient(mech)
    pose, joints = mech.home()
    a, b = Mechanism.linearize(mech, pose, joints)[1], jax.jacfwd(lambda q: mech.residual(pose, q))(joints)
    return jnp.stack([jnp.linalg.svd(m, compute_uv=False)[-1] for m in without_units(mech, pose, a, b)])
