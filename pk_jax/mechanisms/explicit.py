"""Mechanisms of one motor a leg, whose inverse kinematics follows from the residual in closed form."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.mechanisms.base import Mechanism


class ExplicitMechanism(Mechanism):
    """A mechanism that needs no `inverse` of its own: closure equation i holds joint i, and no other.

    As a + b q + c q^2 where the joint is a length, as a + b cos(q) + c sin(q) where it is an angle: squared
    distances between points of two links are of that form. Three values of the residual then give the
    joints in closed form. A working mode is the sign of every dF_i/dq_i; `home` may ask for the joints of a
    pose with `self.inverse(pose, signs)`. `joint_units` must be given. ValueError for a geometry whose
    residual is not like that.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.joint_units is None:
            raise ValueError(
                f"{type(self).__name__}.joint_units must say which joints are lengths (1), angles (0)"
            )
        pose, joints = jax.eval_shape(lambda mech: mech.home(), self)
        found = jax.eval_shape(lambda mech, *home: mech.residual(*home), self, pose, joints).shape
        if not found == joints.shape == (len(self.joint_units),) or self.free_joints:
            raise ValueError(
                f"{type(self).__name__}.residual must have shape {(len(self.joint_units),)}, one equation "
                f"for each joint, none of them free, got {found}, {self.free_joints} free: use pk.Mechanism"
            )
        if checks.is_concrete(self):
            with checks.known_values():
                misses = [float(value) for value in _explicit_misses(self)]
            if not np.all(np.isfinite(misses)):
                raise ValueError(f"{type(self).__name__} has no home: with this geometry it is not finite")
            for what, miss in zip(("alone", f"as {_EXPLICIT}"), misses, strict=True):
                if not miss <= _EXPLICIT_TO:
                    raise ValueError(
                        f"{type(self).__name__}.residual must hold joint i in equation i {what}, "
                        f"but is {miss:.1e} off at home; use pk.Mechanism instead"
                    )

    def default_branch(self) -> jax.Array | None:
        """The signs at home; None where joints are distances, which have home's signs only. -> (m,)"""
        return None if self.joints_are_distances else self._signs()

    def _signs(self) -> jax.Array:
        pose, joints = self.home()
        rates = jax.jvp(lambda q: self.residual(pose, q), (joints,), (jnp.ones_like(joints),))[1]
        return jnp.sign(rates)

    def inverse(self, pose: Any, branch: jax.Array | None = None, *, free: Any = None) -> jax.Array:
        """Joints of a pose in one working mode; NaN where there are none. -> (m,)"""
        branch = self._signs() if branch is None else jnp.asarray(branch)
        turns = self._turns
        rows = (branch, *self.terms(pose))
        roots = [_angle(*(row[turns] for row in rows)), _distance(*(row[~turns] for row in rows))]
        order = np.argsort(np.concatenate([np.flatnonzero(turns), np.flatnonzero(~turns)]))
        joints = jnp.concatenate(roots)[order]
        return jnp.where(joints > 0, joints, jnp.nan) if self.joints_are_distances else joints

    def reach(self, pose: Any) -> jax.Array:
        """A margin of every leg: positive where it has joints, 0 where it is stretched or folded. -> (m,)

        Smooth, and known out of reach, too: what a workspace needs that ends where the legs end.
        """
        a, b, c = self.terms(pose)
        of_angle, of_distance = 1 - a**2 / (b**2 + c**2), (b**2 - 4 * a * c) / (b**2 + 4 * jnp.abs(a * c))
        return jnp.where(self._turns, of_angle, of_distance)

    def terms(self, pose: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        """a, b and c of every equation at a pose. -> (m,) three times"""
        turns = self._turns
        step = jnp.where(turns, 2 * jnp.pi / 3, self.length())
        zero = jnp.zeros_like(step)
        at, up, down = (self.residual(pose, q) for q in (zero, zero + step, zero - step))
        even, odd = (up + down) / 2, (up - down) / 2
        roundoff = 16 * jnp.finfo(at.dtype).eps * (jnp.abs(at) + jnp.abs(up) + jnp.abs(down))
        even = jnp.where(~turns & (jnp.abs(even - at) <= roundoff), at, even)  # a line is no wide parabola
        cosine = (at - even) * (2 / 3)
        a = jnp.where(turns, at - cosine, at)
        return (
            a,
            jnp.where(turns, cosine, odd / step),
            jnp.where(turns, odd * 3**-0.5 * 2, (even - at) / step**2),
        )

    @property
    def _turns(self) -> np.ndarray:
        """Which joints are angles. -> (m,)"""
        return np.equal(self.joint_units, 0)


def _angle(sign: Any, a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
    """Root of F = a + b cos(q) + c sin(q) where dF/dq has that sign; NaN for none."""
    slope = sign * jnp.sqrt(b**2 + c**2 - a**2)
    return jnp.arctan2(-a * c - slope * b, slope * c - a * b)


def _distance(sign: Any, a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
    """Root of F = a + b q + c q^2 where dF/dq has that sign; NaN for none."""
    slope = sign * jnp.sqrt(b**2 - 4 * a * c)
    adds = b * slope > 0  # of the two ways to write the root, the one that does not cancel
    root = jnp.where(adds, -2 * a, slope - b) / jnp.where(adds, b + slope, 2 * c)
    return jnp.where(adds | (c != 0), root, jnp.nan)  # a line crosses zero one way


_EXPLICIT = "a + b q + c q^2 (a length) or a + b cos(q) + c sin(q) (an angle)"
_EXPLICIT_TO = 1e-4  # of the terms of an equation: float32 is far better, another function far worse


@jax.jit
def _explicit_misses(mech: ExplicitMechanism) -> tuple[jax.Array, jax.Array]:
    """What other joints add to an equation, and what its form misses, over its terms at home. -> (), ()"""
    pose, joints = mech.home()
    a, b, c = mech.terms(pose)
    turns = mech._turns
    size = jnp.where(turns, 1.0, mech.length())
    off, others = [], []
    for joint in (joints, joints + 0.7 * size, joints - 1.3 * size):
        x, y = jnp.where(turns, jnp.cos(joint), joint), jnp.where(turns, jnp.sin(joint), joint**2)
        terms = jnp.abs(a) + jnp.abs(b * x) + jnp.abs(c * y)
        off.append(jnp.abs(a + b * x + c * y - mech.residual(pose, joint)) / terms)
        rates = jnp.abs(jax.jacfwd(lambda q: mech.residual(pose, q))(joint)) * size
        others.append((jnp.sum(rates, axis=1) - jnp.diagonal(rates)) / terms)
    return jnp.max(jnp.stack(others)), jnp.max(jnp.stack(off))
