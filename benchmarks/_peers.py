"""Forward kinematics of general 6-6 Stewart platforms as other tools do it, for the benchmark.

    peer(base, platform, lengths, home_translation, home_rotation) -> translations (N, 3), rotations (N, 3, 3)

finds the poses with |t + R b_i - a_i| = l_i for a_i in base (6, 3), b_i in platform (6, 3) and every row l
of lengths (N, 6); each row starts from the home pose. `prepare` does beforehand what is done once, so that
it is not timed.
"""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.optimize import root
from scipy.spatial.transform import Rotation

SOURCE = Path(__file__).with_name("newton_avx.cpp")
FLAGS = ["-std=c++17", "-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-shared", "-fPIC"]


class NotAvailable(Exception):
    """A peer cannot run here; the message says what is missing."""


def prepare(peer: Callable, base, platform, lengths, home_translation, home_rotation) -> Callable[[], tuple]:
    """Builds, traces and compiles for this problem. -> a call without arguments that solves it and waits

    Raises NotAvailable without a C++ compiler (cpp_newton) or without optimistix.
    """
    problem = (base, platform, lengths, home_translation, home_rotation)
    if peer is cpp_newton:
        return cpp_prepared(*problem)
    if hasattr(peer, "lower"):
        if not jax.config.jax_enable_x64:
            raise ValueError("the peers in JAX need jax_enable_x64")
        arguments = [jnp.asarray(part, float) for part in problem]
        compiled = peer.lower(*arguments).compile()
        return lambda: jax.block_until_ready(compiled(*arguments))
    return lambda: peer(*problem)


# --- C++


@functools.cache
def library() -> ctypes.CDLL:
    """newton_avx.cpp, compiled for this machine by $CXX or g++; once per process."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        raise NotAvailable("no C++ compiler")
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder, "newton_avx.so")
        done = subprocess.run([compiler, *FLAGS, "-o", built, SOURCE], capture_output=True, text=True)
        if done.returncode:
            raise NotAvailable(f"{compiler} failed: {done.stderr.strip()}")
        return ctypes.CDLL(str(built))


def cpp_prepared(
    base, platform, lengths, home_translation, home_rotation, *, steps: int = 6, errors=None
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """cpp_newton as a call without arguments, which returns the same two arrays every time.

    errors, a float64 array (N,), is filled with the largest error in length of each row.
    """
    solve, count = library().newton, len(lengths)
    if steps < 1:
        raise ValueError("steps must be at least 1")
    if errors is not None and not (
        errors.shape == (count,) and errors.dtype == np.float64 and errors.flags.c_contiguous
    ):
        raise ValueError("errors must be a contiguous float64 array (N,)")
    _, jacobian = legs(base, platform, home_translation, home_rotation)
    rows, columns = complete_pivoting(jacobian)
    inverse = np.linalg.inv(jacobian[rows][:, columns])
    given = [base, platform, lengths, home_translation, home_rotation, rows, columns, inverse]
    kinds = [float] * 5 + [np.int32] * 2 + [float]
    given = [np.ascontiguousarray(array, kind) for array, kind in zip(given, kinds, strict=True)]
    found = np.zeros((count, 3)), np.zeros((count, 3, 3))

    def pointer(array):
        return None if array is None else ctypes.c_void_p(array.ctypes.data)

    def call():
        outputs = map(pointer, (*found, errors))
        solve(ctypes.c_int64(count), *map(pointer, given), ctypes.c_int32(steps), *outputs)
        return found

    return call


def cpp_newton(base, platform, lengths, home_translation, home_rotation, *, steps: int = 6, errors=None):
    """Hand-written C++ with SIMD over the poses, one thread, a fixed number of Newton steps."""
    return cpp_prepared(
        base, platform, lengths, home_translation, home_rotation, steps=steps, errors=errors
    )()


def complete_pivoting(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orders of rows and columns under Gauss elimination with complete pivoting. (n, n) -> (n,), (n,)"""
    matrix, n = np.array(matrix, float), len(matrix)
    rows, columns = np.arange(n), np.arange(n)
    for k in range(n):
        i, j = np.unravel_index(np.abs(matrix[k:, k:]).argmax(), (n - k, n - k))
        swap_rows, swap_columns = [k, k + i], [k, k + j]
        matrix[swap_rows], rows[swap_rows] = matrix[swap_rows[::-1]], rows[swap_rows[::-1]]
        matrix[:, swap_columns], columns[swap_columns] = (
            matrix[:, swap_columns[::-1]],
            columns[swap_columns[::-1]],
        )
        matrix[k + 1 :] -= np.outer(matrix[k + 1 :, k] / matrix[k, k], matrix[k])
    return rows, columns


# --- NumPy and SciPy


def legs(base, platform, translations, rotations) -> tuple[np.ndarray, np.ndarray]:
    """Leg vectors (..., 6, 3), Jacobian (..., 6, 6) of half their squares by (v, w), R = cayley(w) R."""
    arms = platform @ np.swapaxes(rotations, -1, -2)
    vectors = translations[..., None, :] + arms - base
    return vectors, np.concatenate([vectors, np.cross(arms, vectors)], axis=-1)


def numpy_batched(base, platform, lengths, home_translation, home_rotation) -> tuple[np.ndarray, np.ndarray]:
    """Newton on whole arrays with np.linalg.solve, until the worst row has converged."""
    t = np.tile(home_translation, (len(lengths), 1))
    r = np.tile(home_rotation, (len(lengths), 1, 1))
    for _ in range(20):
        vectors, jacobian = legs(base, platform, t, r)
        residual = (np.sum(vectors**2, axis=-1) - lengths**2) / 2
        if np.max(np.abs(residual)) < 1e-12:
            break
        step = np.linalg.solve(jacobian, -residual[..., None])[..., 0]
        t = t + step[:, :3]
        h = step[:, 3:] / 2
        turned = r + np.cross(h[:, :, None], r, axis=1)
        r = r + np.cross(2 / (1 + np.sum(h**2, axis=1))[:, None, None] * h[:, :, None], turned, axis=1)
    return t, r


def scipy_root(base, platform, lengths, home_translation, home_rotation) -> tuple[np.ndarray, np.ndarray]:
    """A loop over the rows with scipy.optimize.root as it comes: hybr, finite differences, to about 1e-8."""
    home = Rotation.from_matrix(home_rotation)

    def residual(x, l):
        vectors = x[:3] + (Rotation.from_rotvec(x[3:]) * home).apply(platform) - base
        return (np.sum(vectors**2, axis=1) - l**2) / 2

    start = np.concatenate([home_translation, np.zeros(3)])
    x = np.array([root(residual, start, args=(l,)).x for l in lengths])
    return x[:, :3], (Rotation.from_rotvec(x[:, 3:]) * home).as_matrix()


# --- JAX


def pose(x, home_rotation):
    """(translation, rotation vector from home) (6,) -> translation (3,), rotation (3, 3)"""
    w = x[3:]
    angle = jnp.sqrt(w @ w + 1e-30)  # a root with a derivative at home
    cross = jnp.cross(jnp.eye(3), w)
    rotation = jnp.eye(3) + jnp.sin(angle) / angle * cross + (1 - jnp.cos(angle)) / angle**2 * cross @ cross
    return x[:3], rotation @ home_rotation


def residual(x, problem):
    """(|t + R b_i - a_i|^2 - l_i^2) / 2, (6,)"""
    base, platform, lengths, home_rotation = problem
    translation, rotation = pose(x, home_rotation)
    return (jnp.sum((translation + platform @ rotation.T - base) ** 2, axis=1) - lengths**2) / 2


@jax.jit
def naive_jax(base, platform, lengths, home_translation, home_rotation):
    """jit(vmap(while_loop)) of Newton steps with jacfwd and jnp.linalg.solve, until the step is small."""

    def one(l):
        def improve(state):
            x, _, count = state
            problem = (base, platform, l, home_rotation)
            step = jnp.linalg.solve(jax.jacfwd(residual)(x, problem), residual(x, problem))
            return x - step, jnp.max(jnp.abs(step)), count + 1

        start = jnp.concatenate([home_translation, jnp.zeros(3)])
        x, *_ = lax.while_loop(
            lambda state: (state[1] > 1e-9) & (state[2] < 50), improve, (start, jnp.inf, 0)
        )
        return pose(x, home_rotation)

    return jax.vmap(one)(lengths)


@jax.jit
def optimistix_newton(base, platform, lengths, home_translation, home_rotation):
    """jit(vmap(optimistix.root_find)) with optimistix.Newton."""
    try:
        import optimistix
    except ImportError:
        raise NotAvailable("optimistix is not installed") from None
    solver = optimistix.Newton(rtol=1e-9, atol=1e-9)

    def one(l):
        start = jnp.concatenate([home_translation, jnp.zeros(3)])
        problem = (base, platform, l, home_rotation)
        return pose(optimistix.root_find(residual, solver, start, args=problem).value, home_rotation)

    return jax.vmap(one)(lengths)


PEERS = (cpp_newton, numpy_batched, scipy_root, naive_jax, optimistix_newton)
