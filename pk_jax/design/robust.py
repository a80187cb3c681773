"""Designs that stay good where their dimensions scatter: manufacturing tolerances."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.design.problem import DesignProblem
from pk_jax.geometry import safe
from pk_jax.geometry.spread import evenly

MEASURES = ("mean", "worst")


def robust(
    problem: DesignProblem,
    tolerances: Mapping[str, Any],
    *,
    samples: int = 16,
    seed: int = 0,
    measure: str = "mean",
    deviations: float = 0.0,
) -> DesignProblem:
    """The problem for variables that are made with normal errors, as another problem.

    tolerances:  variable -> standard deviation, a number or an array of the variable's shape, >= 0
    samples:     even number of errors, the same for every design: quasi-random, each with its opposite
    seed:        shifts them
    measure:     "mean": of the objective over the samples; "worst": its least entry over all samples
    deviations:  of "mean": so many standard deviations are subtracted from it

    Every constraint must hold for every sample, "reach_min[3] of sample 5". The bounds hold for what is
    ordered, not for what is made. From samples >= 2 n on, n variables with errors, the errors have
    exactly the covariance asked for, so that the mean of a quadratic objective is exact.
    """
    if not isinstance(problem, DesignProblem):
        raise ValueError(f"problem must be a DesignProblem, got {type(problem).__name__}")
    checks.is_word("measure", measure, MEASURES)
    if not (checks.is_number(deviations) and deviations >= 0) or (measure == "worst" and deviations):
        raise ValueError(f"deviations must be a number >= 0, of 'mean' only, got {checks.shown(deviations)}")
    samples = checks.is_count("samples", samples, least=2, most=10_000)
    if samples % 2:
        raise ValueError(f"samples must be even, got {samples}")
    seed = checks.is_count("seed", seed, least=0, most=2**32 - 1)
    size = 100 * samples * (problem.objective_count + len(problem.constraint_names))  # with their names
    checks.fits(f"samples = {samples} of {problem.name}", size, "take fewer")
    spread = _deviations_of(problem, tolerances)
    errors = np.zeros((samples, len(spread)))
    errors[:, spread > 0] = normal_pairs(samples, np.count_nonzero(spread), seed) * spread[spread > 0]
    return _Robust(problem, errors, measure, float(deviations))


def normal_pairs(samples: int, dimension: int, seed: int = 0) -> np.ndarray:
    """Quasi-random standard normal vectors, each followed by its opposite half the rows on. -> (samples, d)

    Their mean is 0, and from samples >= 2 d on their covariance the unit matrix.
    """
    half = samples // 2
    shift = np.random.default_rng(seed).uniform(size=dimension) if seed else 0
    uniform = np.clip((evenly(half, dimension) + shift) % 1, 1e-9, 1 - 1e-9)
    normal = np.vectorize(NormalDist().inv_cdf, otypes=[float])(uniform)
    covariance = normal.T @ normal / half
    if half >= dimension and np.linalg.cond(covariance) < 1e6:
        normal = np.linalg.solve(np.linalg.cholesky(covariance), normal.T).T
    return np.concatenate([normal, -normal])


def _deviations_of(problem: DesignProblem, tolerances: Any) -> np.ndarray:
    """Standard deviation of every entry; ValueError where one is none. -> (n,)"""
    if not isinstance(tolerances, Mapping) or not tolerances:
        raise ValueError(
            f"tolerances must be a dict, variable -> standard deviation, got {type(tolerances).__name__}"
        )
    unknown = [name for name in tolerances if name not in problem.shapes]
    if unknown:
        names = ", ".join(problem.shapes)
        raise ValueError(f"tolerances must be of the variables {names}, got {checks.shown(unknown[0])}")
    parts = []
    for name, shape in problem.shapes.items():
        field = f"tolerances[{name!r}]"
        value = checks.real_numpy(field, tolerances.get(name, 0.0))
        if value.shape not in ((), shape):
            raise ValueError(f"{field} must be a number or have shape {shape}, got {value.shape}")
        checks.is_finite(field, value)
        if np.any(value < 0):
            raise ValueError(f"{field} must be >= 0, got {value.tolist()}")
        parts.append(np.broadcast_to(value, shape).ravel())
    spread = np.concatenate(parts).astype(float)
    if not np.any(spread > 0):
        raise ValueError("tolerances must be positive for at least one variable")
    return spread


class _Robust(DesignProblem):
    """A problem judged over scattered vectors."""

    def __init__(self, problem: DesignProblem, errors: np.ndarray, measure: str, deviations: float) -> None:
        self.__dict__.update(vars(problem))
        self.of, self.errors, self.by, self.deviations = problem, errors, measure, deviations
        self.name = f"robust {problem.name}"
        count = len(errors)
        self.objective_count = problem.objective_count * (count if measure == "worst" else 1)
        self.constraint_names = tuple(
            f"{name} of sample {sample}" for sample in range(count) for name in problem.constraint_names
        )

    def measure(self, vector: jax.Array) -> tuple[jax.Array, jax.Array]:
        objectives, slacks = jax.vmap(self.of.measure)(vector + jnp.asarray(self.errors, vector.dtype))
        if self.by == "worst":
            return objectives.ravel(), slacks.ravel()
        mean = jnp.mean(objectives, axis=0)
        if self.deviations:
            mean = mean - self.deviations * safe.sqrt(jnp.mean((objectives - mean) ** 2, axis=0))
        return mean, slacks.ravel()
