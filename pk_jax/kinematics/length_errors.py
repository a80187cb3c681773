"""Errors of measured lengths as a residual, and what a least-squares pose is worth."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics import elimination
from pk_jax.kinematics.entrywise import entrywise
from pk_jax.kinematics.lanes import Entries, times, total
from pk_jax.kinematics.linear_stage import ROWS
from pk_jax.mechanisms.stewart import Stewart


class LengthErrors(Stewart):
    """Errors of the nine lengths, each over its standard deviation, as a mechanism's residual."""

    roots: jax.Array  # (k,) of the weights

    @classmethod
    def of(cls, stewart: Stewart, roots: Any) -> LengthErrors:
        """Without another look at a platform that is good; leaves may be `Entries`."""
        made = object.__new__(cls)
        for field in dataclasses.fields(stewart):
            object.__setattr__(made, field.name, getattr(stewart, field.name))
        object.__setattr__(made, "roots", roots)
        return made

    def residual(self, pose: SE3, joints: jax.Array) -> jax.Array:
        return self.roots * (self.inverse(pose) - joints)

    def linearize(self, pose: SE3, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        rows, legs = super().linearize(pose, joints)[1], self.inverse(pose)
        return self.roots * (legs - joints), (self.roots / legs)[:, None] * rows


class Judged(NamedTuple):
    """What an estimate is worth."""

    residual: Any  # weighted RMS error
    share: Any  # of the mean length
    sigma_min: Any
    covariance: Any  # (6, 6)


def judge(errors: LengthErrors, pose: SE3, lengths: jax.Array) -> Judged:
    """The nine errors evaluated afresh at `pose`."""
    value, jacobian, weight, size = _judged_by(errors, pose, lengths)
    covariance = jnp.linalg.inv(jacobian.T @ jacobian)
    return _worth(jnp.sum(value**2), jnp.diagonal(covariance), weight, size, jnp.sum(lengths), covariance)


def judge_on_lanes(errors: Any, pose: Any, lengths: Entries) -> Judged:
    """The same, everything made of `Entries`."""
    value, jacobian, weight, size = entrywise(_judged_by, errors, pose, lengths)
    factors = elimination.factor_symmetric(elimination.normal(jacobian.rows()))
    rows = elimination.inverse_symmetric(factors)
    variances = [rows[i][i] for i in range(6)]
    squares = total([times(f, f) for f in value.items])
    covariance = Entries((6, 6), [item for row in rows for item in row])
    return _worth(squares, variances, weight.items[0], size.items[0], total(lengths.items), covariance)


def _judged_by(errors: LengthErrors, pose: SE3, lengths: jax.Array) -> tuple:
    return *errors.linearize(pose, lengths), jnp.sum(errors.roots**2), errors.length()


def _worth(squares: Any, variances: Any, weight: Any, size: Any, lengths: Any, covariance: Any) -> Judged:
    residual = jnp.sqrt(squares / weight)
    spread = sum(variances[:3]) + size * size * sum(variances[3:])
    sigma = jnp.sqrt(ROWS / (weight * spread))
    return Judged(residual, ROWS * residual / lengths, jnp.where(jnp.isfinite(sigma), sigma, 0), covariance)
