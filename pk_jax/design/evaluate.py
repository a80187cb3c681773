"""Values and slopes of many designs at once: in bounded memory, on all devices, each row by itself."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.design.problem import DesignProblem
from pk_jax.status import Status

BLOCK = 8  # designs that one call of the compiled function takes
FEW = 8  # variables, of which the derivatives are best taken one by one


class DesignValues(NamedTuple):
    """One entry a design; batch first."""

    objective: np.ndarray  # (k, o)
    constraints: np.ndarray  # (k, p) slacks
    objective_slopes: np.ndarray | None  # (k, o, n) derivatives in the variables
    constraint_slopes: np.ndarray | None  # (k, p, n)
    status: (
        np.ndarray
    )  # (k,) Status: OK; NONFINITE: some value or slope is none; BAD_INPUT: the vector is not


def evaluate_designs(
    problem: DesignProblem, vectors: Any, *, slopes: bool = True, devices: Sequence[Any] | None = None
) -> DesignValues:
    """Objective and constraints of designs (k, n), and their derivatives in the variables.

    devices:  blocks of eight designs are dealt out to them; default: one. No bit of a row depends on
              that, nor on how many rows there are.

    Rows that are not OK hold what was found, NaN among it; they change no other row. Variables may lie
    outside their bounds.
    """
    if not isinstance(problem, DesignProblem):
        raise ValueError(f"problem must be a DesignProblem, got {type(problem).__name__}")
    vectors = checks.real_numpy("vectors", vectors).astype(jnp.zeros(()).dtype)
    checks.has_shape("vectors", vectors, (None, len(problem.entries)))
    devices, slopes = checks.are_devices("devices", devices), checks.is_flag("slopes", slopes)
    if not len(vectors):
        raise ValueError("vectors must hold at least one design")
    answers = problem.objective_count + len(problem.constraint_names)
    size = 8 * 2 * answers * (1 + len(problem.entries) if slopes else 1) * len(vectors)
    checks.fits(f"answers for {len(vectors)} vectors", size, "take fewer at a time")
    is_given = np.isfinite(vectors).all(axis=1)
    middle = (problem.lower + problem.upper) / 2
    filled = np.concatenate([vectors, np.tile(middle, (-len(vectors) % BLOCK, 1))])
    filled = np.where(np.isfinite(filled).all(axis=1, keepdims=True), filled, middle)

    def block(number: int) -> Any:
        rows = filled[number * BLOCK : (number + 1) * BLOCK]
        placed = jax.device_put(rows, devices[number % len(devices)])
        return jax.device_get(_block(problem, slopes, placed))

    with ThreadPoolExecutor(len(devices)) as pool:
        parts = list(pool.map(block, range(len(filled) // BLOCK)))
    found = [
        None if part[0] is None else np.concatenate(part)[: len(vectors)] for part in zip(*parts, strict=True)
    ]
    finite = lambda values: np.isfinite(values.reshape(len(vectors), -1)).all(axis=1)
    is_finite = np.logical_and.reduce([finite(values) for values in found if values is not None])
    status = np.where(is_given, np.where(is_finite, Status.OK, Status.NONFINITE), Status.BAD_INPUT)
    mask = lambda values: None if values is None else _nan_where(~is_given, values)
    return DesignValues(*map(mask, found), status.astype(np.int32))


def _nan_where(is_lost: np.ndarray, values: np.ndarray) -> np.ndarray:
    values = np.array(values)
    values[is_lost] = np.nan
    return values


@partial(jax.jit, static_argnums=(0, 1))
def _block(problem: DesignProblem, slopes: bool, vectors: jax.Array) -> Any:
    """Of one design after the other: memory is that of one."""
    if not slopes:
        return (*jax.lax.map(problem.measure, vectors), None, None)

    def one(vector):
        twice = lambda vector: (problem.measure(vector),) * 2
        answers = problem.objective_count + len(problem.constraint_names)
        by_columns = len(vector) <= max(FEW, 2 * answers)
        jacobian = jax.jacfwd if by_columns else jax.jacrev
        derivatives, values = jacobian(twice, has_aux=True)(vector)
        return (*values, *derivatives)

    return jax.lax.map(one, vectors)
