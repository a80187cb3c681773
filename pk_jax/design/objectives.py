"""What designs are judged by: local indices over given poses, or over the whole workspace."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.integral import workspace_integral
from pk_jax.analysis.measures import length_of, measure_of
from pk_jax.geometry.poses import Turning
from pk_jax.kinematics.batching import all_finite, where
from pk_jax.mechanisms.base import Mechanism

MEASURES = ("mean", "integral", "volume")


def rectangle(lower: Any, upper: Any, nodes: Any) -> jax.Array:
    """Poses on a grid over a box of coordinates, for mechanisms whose poses are arrays. -> (k, d)

    lower, upper (d,): where they are equal, the coordinate is held and needs one node; nodes () or (d,)
    """
    lower, upper = checks.real_numpy("lower", lower), checks.real_numpy("upper", upper)
    if lower.ndim != 1 or lower.shape != upper.shape:
        raise ValueError(f"lower and upper must have shape (d,), got {lower.shape} and {upper.shape}")
    checks.is_finite("lower", lower)
    checks.is_finite("upper", upper)
    if not np.all(lower <= upper):
        raise ValueError(f"lower must be at most upper, got {lower.tolist()} and {upper.tolist()}")
    counts = nodes if isinstance(nodes, list | tuple | np.ndarray) else [nodes] * len(lower)
    if len(counts) != len(lower):
        raise ValueError(f"nodes must be one number, or {len(lower)} of them, got {checks.shown(nodes)}")
    counts = [checks.is_count("nodes", count, most=10**9) for count in counts]
    checks.fits(f"nodes = {nodes}", 8 * (3 * len(counts) + 3) * math.prod(counts), "take fewer")
    lines = [np.linspace(*ends) for ends in zip(lower, upper, counts, strict=True)]
    return jnp.asarray(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lower)))


def least_over(
    poses: Any, index: Any = "frobenius_isotropy", branch: Any = None, *, length: float | None = None
) -> Callable[[Mechanism], jax.Array]:
    """A local index at every one of `poses`, as an objective: its least entry is maximized.

    poses:   batch first
    index:   as for `workspace_integral`
    branch:  working mode; default: the mechanism's own
    -> function Mechanism -> (k,), 0 with derivative 0 at poses out of reach: keep them in by `margins_over`
    """
    measure = measure_of(index, length_of(length))
    poses = _batch(poses)

    def objective(mech: Mechanism) -> jax.Array:
        _require_inverse("least_over", mech)
        home, at_home = jax.lax.stop_gradient(mech.home())

        def one(pose):
            found = jax.lax.stop_gradient(mech.inverse(pose, branch))
            is_reached = all_finite(found)
            pose = where(is_reached, pose, home)  # what is differentiated never sees a limit
            joints = jnp.where(is_reached, mech.inverse(pose, branch), at_home)
            return jnp.where(is_reached, measure(mech, pose, joints), 0)

        return jax.vmap(one)(poses)

    return objective


def margins_over(poses: Any, branch: Any = None) -> Callable[[Mechanism], dict[str, jax.Array]]:
    """The mechanism's margins at every one of `poses`, as constraints: name -> (k, ...)."""
    poses = _batch(poses)

    def margins(mech: Mechanism) -> dict[str, jax.Array]:
        _require_inverse("margins_over", mech)
        return jax.vmap(lambda pose: mech.margins(pose, mech.inverse(pose, branch)))(poses)

    return margins


def over_workspace(
    index: Any = "frobenius_isotropy", *, measure: str = "mean", **options: Any
) -> Callable[[Mechanism], jax.Array]:
    """The mean or the integral of a local index over the workspace, or its volume, as an objective.

    options: of `workspace_integral`; for more than two freedoms name the rule: it is chosen before the values
    are known. NaN where the integral is not to be trusted: an optimizer steps back.
    -> function Mechanism -> ()
    """
    checks.is_word("measure", measure, MEASURES)
    measure_of(index)
    asked = () if measure == "volume" else index
    return lambda mech: getattr(workspace_integral(mech, asked, **options), measure)


def _require_inverse(function: str, mech: Mechanism) -> None:
    if not hasattr(mech, "inverse"):
        raise ValueError(f"{function} needs the closed form `inverse`, {type(mech).__name__} has none")


def _batch(poses: Any) -> Any:
    if isinstance(poses, Turning):
        if poses.rotation.ndim != 3:
            raise ValueError(f"poses must be a batch, got one {type(poses).__name__}")
        return poses
    poses = checks.real_array("poses", poses)
    if poses.ndim != 2:
        raise ValueError(f"poses must have shape (k, n), got {poses.shape}")
    return poses
