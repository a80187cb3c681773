"""Workspace indices and design of the 2-RRR: pk_jax against what a user would write or pick instead.

    make bench        or        python -m benchmarks.two_dof

Every peer runs in this process, on this machine, one after the other; errors are printed beside the
times, compile time apart. Errors are relative, against the gauss rule with (44, 52) nodes.
"""

from __future__ import annotations

import math
import os
import platform
import statistics
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution

import pk_jax as pk

DESIGNS = 256
NODES = (8, 8)  # of the timed gauss rule: more accurate than eq. (29) in every index
START = [2.0, 0.3]  # (l_min, v) of the single-start optimization


def main() -> None:
    pk.enable_x64()
    print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}, ",
        end="",
    )
    print(f"device {jax.devices()[0].device_kind}, float64")
    indices_of_one_design()
    memory()
    optimum()


# --- eq. (29) as the paper's user runs it, and as a NumPy user would


def python_loop(l_min: float, la: float, rings: int = 200, sectors: int = 300) -> tuple[float, float, float]:
    """Eq. (29) in a Python loop over the nodes, eqs. (6), (14), (15), closed-form 2 x 2."""
    lb = l_min + 2 - la
    gii = gri = total = 0.0
    for k in range(sectors):
        theta = -math.pi / 2 + (k + 0.5) * math.pi / sectors
        s, c = math.sin(theta), math.cos(theta)
        inner = abs(s) + math.sqrt(l_min**2 - c**2)
        outer = -abs(s) + math.sqrt((l_min + 2) ** 2 - c**2)
        step = (outer - inner) / rings
        for j in range(rings):
            near = inner + j * step
            middle = near + step / 2
            x, y = -middle * s, middle * c
            rows, rates = [], []
            for base, bend in ((1.0, 1.0), (-1.0, -1.0)):
                dx = x - base
                leg = math.hypot(dx, y)
                cosine = (leg**2 + la**2 - lb**2) / (2 * la * leg)
                phi = math.atan2(y, dx) - bend * math.acos(min(1.0, max(-1.0, cosine)))
                across, up = dx - la * math.cos(phi), y - la * math.sin(phi)
                rows.append((across, up))
                rates.append(-la * (across * math.sin(phi) - up * math.cos(phi)))
            (a, b), (d, e) = rows
            m = (e * rates[0], -b * rates[1], -d * rates[0], a * rates[1])  # det(Jx) J
            square, product = sum(z * z for z in m), abs(m[0] * m[3] - m[1] * m[2])
            ring = (near + step) ** 2 - near**2
            gii += ring * 2 * product / (square + math.sqrt(max(square**2 - 4 * product**2, 0.0)))
            gri += ring * abs((a * e - b * d) / (rates[0] * rates[1]))
            total += ring
    box = 2 * (l_min + 1) * math.sqrt((l_min + 2) ** 2 - 1)
    return gii / total, gri / total, total / 2 * math.pi / sectors / box


def vectorised_numpy(
    l_min: float, la: float, rings: int = 200, sectors: int = 300
) -> tuple[float, float, float]:
    """The same on arrays, without a loop."""
    lb = l_min + 2 - la
    theta = -np.pi / 2 + (np.arange(sectors) + 0.5) * np.pi / sectors
    s, c = np.sin(theta), np.cos(theta)
    inner = np.abs(s) + np.sqrt(l_min**2 - c**2)
    outer = -np.abs(s) + np.sqrt((l_min + 2) ** 2 - c**2)
    edges = inner + np.arange(rings + 1)[:, None] / rings * (outer - inner)
    middle, ring = (edges[1:] + edges[:-1]) / 2, edges[1:] ** 2 - edges[:-1] ** 2
    x, y = -middle * s, middle * c
    rows, rates = [], []
    for base, bend in ((1.0, 1.0), (-1.0, -1.0)):
        dx = x - base
        leg = np.hypot(dx, y)
        cosine = (leg**2 + la**2 - lb**2) / (2 * la * leg)
        phi = np.arctan2(y, dx) - bend * np.arccos(np.clip(cosine, -1, 1))
        sine, cosine = np.sin(phi), np.cos(phi)
        across, up = dx - la * cosine, y - la * sine
        rows.append((across, up))
        rates.append(-la * (across * sine - up * cosine))
    (a, b), (d, e) = rows
    square = (e**2 + d**2) * rates[0] ** 2 + (a**2 + b**2) * rates[1] ** 2
    det = a * e - b * d
    product = np.abs(det * rates[0] * rates[1])
    isotropy = 2 * product / (square + np.sqrt(np.maximum(square**2 - 4 * product**2, 0)))
    resistivity = np.abs(det / (rates[0] * rates[1]))
    total = ring.sum()
    box = 2 * (l_min + 1) * np.sqrt((l_min + 2) ** 2 - 1)
    return (
        (ring * isotropy).sum() / total,
        (ring * resistivity).sum() / total,
        total / 2 * np.pi / sectors / box,
    )


# --- the library


def indices(nodes):
    """vector (2,) -> gii, gri, sui"""
    space = pk.design_space("2-rrr")

    def one(vector):
        found = pk.workspace_indices(space.mechanism(vector), nodes=nodes)
        return jnp.stack([found.gii, found.gri, found.sui])

    return one


def with_gradient(one):
    """vector (2,) -> gii, gri, sui and their Jacobian"""

    def twice(vector):
        found = one(vector)
        return found, found

    return jax.jacfwd(twice, has_aux=True)


def compiled(function, *arguments):
    """The compiled function, and the seconds that took."""
    started = time.perf_counter()
    call = jax.jit(function).lower(*arguments).compile()
    return call, time.perf_counter() - started


def best_of(call, *arguments, repeats: int = 7) -> float:
    """Median seconds of a call."""
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def designs(count: int) -> np.ndarray:
    """Designs spread over eq. (22), seed 0. -> (count, 2) of (l_min, v)"""
    rng = np.random.default_rng(0)
    l_min = rng.uniform(1, 5, count)
    return np.stack([l_min, rng.uniform(0, 1, count) * np.sqrt((l_min - 1) / 2)], axis=1)


def indices_of_one_design() -> None:
    vectors = designs(DESIGNS)
    reference = np.asarray(jax.jit(jax.vmap(indices((44, 52))))(vectors[:32]))
    print(f"\nGII, GRI and SUI of one 2-RRR design ({DESIGNS} designs in a batch, eq. (29) at 200 x 300)\n")
    print(f"{'':44}{'ms/design':>10}{'worst relative error':>34}{'compile':>9}")
    print(f"{'':44}{'':>10}{'GII':>12}{'GRI':>11}{'SUI':>11}{'s':>9}")

    def line(name, seconds, found, compile_seconds=None):
        errors = np.max(np.abs(np.asarray(found) / reference[: len(found)] - 1), axis=0)
        shown = "" if compile_seconds is None else f"{compile_seconds:9.1f}"
        print(f"{name:44}{1e3 * seconds:10.4f} {errors[0]:11.1e}{errors[1]:11.1e}{errors[2]:11.1e}{shown}")
        return errors

    arguments = [(float(l_min), float(1 + v * v)) for l_min, v in vectors[:32]]
    started = time.perf_counter()
    found = [python_loop(*a) for a in arguments[:3]]
    loop = (time.perf_counter() - started) / 3
    line("eq. (29), Python loop", loop, found)
    started = time.perf_counter()
    found = [vectorised_numpy(*a) for a in arguments]
    arrays = (time.perf_counter() - started) / len(arguments)
    of_29 = line("eq. (29), vectorised NumPy", arrays, found)

    times = {}
    for nodes in (NODES, (24, 24)):
        value, value_compile = compiled(jax.vmap(indices(nodes)), vectors)
        both, both_compile = compiled(jax.vmap(with_gradient(indices(nodes))), vectors)
        times[nodes] = best_of(value, vectors) / DESIGNS, best_of(both, vectors) / DESIGNS
        errors = line(f"pk_jax, gauss {nodes}", times[nodes][0], value(vectors)[:32], value_compile)
        line(f"pk_jax, gauss {nodes}, with gradient", times[nodes][1], both(vectors)[1][:32], both_compile)
        assert np.all(errors <= of_29), "the rule must be at least as accurate as eq. (29)"
    value, gradient = times[NODES]
    print(f"\nat {NODES}: {loop / value:,.0f} times faster than the loop, ", end="")
    print(f"{arrays / value:,.0f} times than NumPy; ", end="")
    print(f"value + gradient = {gradient / value:.1f} values")
    value, gradient = times[24, 24]
    print(f"at (24, 24): {loop / value:,.0f} and {arrays / value:,.0f} times; ", end="")
    print(f"value + gradient = {gradient / value:.1f} values")


def memory() -> None:
    """Peak memory of 1000 designs in one call, in a process of its own (Linux)."""
    if not os.path.exists("/proc/self/status"):
        return
    print("\n1000 designs in one call, whole-process peak memory (24 x 24 nodes)")
    for what in ("nothing", "values", "values and gradients"):
        code = (
            "import re, jax, pk_jax as pk; pk.enable_x64()\n"
            "from benchmarks.two_dof import designs, indices, with_gradient\n"
            f"what, one = {what!r}, indices((24, 24))\n"
            "one = one if what == 'values' else with_gradient(one)\n"
            "if what != 'nothing': jax.block_until_ready(jax.jit(jax.vmap(one))(designs(1000)))\n"
            "print(int(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1]) / 1024)"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        print(f"  {what:22}{float(done.stdout):8.0f} MB")


def optimum() -> None:
    """Index evaluations to the (1, 1, 1) optimum: gradients against differential evolution."""
    space, bounds = pk.design_space("2-rrr"), pk.index_bounds(pk.design_space("2-rrr"))
    started = time.perf_counter()
    result = pk.optimize_design(space, (1, 1, 1), starts=START)
    seconds = time.perf_counter() - started
    goal = result.objective - 1e-6
    ours = 3 * (int(np.argmax(result.history.objective >= goal)) + 1)
    multi = pk.optimize_design(space, (1, 1, 1))
    print(f"\nindex evaluations to within 1e-6 of the greatest CPI, {result.objective:.9f}")
    print("(value + gradient counts as 3; every method moves in the same box)")
    print(f"  pk_jax from (l_min, v) = {tuple(START)}: {ours}, ", end="")
    print(f"{3 * result.evaluations} until it stops ({seconds:.1f} s with compile)")
    print(f"  pk_jax, multi-start of 12: {3 * multi.evaluations_in_all} until every start stops")

    one = indices((24, 24))
    cpi = jax.jit(lambda box: pk.composite_index(one(space.from_box(box)), bounds))
    counts = []
    for seed in range(5):
        history = []

        def objective(box, history=history):
            history.append(float(cpi(jnp.asarray(box))))
            return -history[-1]

        answer = differential_evolution(objective, [(0, 1)] * 2, seed=seed, tol=1e-10, polish=False)
        counts.append(int(np.argmax(np.array(history) >= goal)) + 1 if max(history) >= goal else math.inf)
        print(f"  scipy differential_evolution, seed {seed}: {counts[-1]}, {answer.nfev} until it stops")
    print(f"  ratio: {min(counts) / ours:.1f} to {max(counts) / ours:.1f} times fewer")


if __name__ == "__main__":
    main()
