"""Design at scale: workspace integrals against reference values, many designs in one call, and optimizers.

    make bench        or        python -m benchmarks.design [--quick]

Optimizers get the same problem, the same wall time and the same seeds in this process, one after the other;
compile time is apart. What has its own memory or cores runs in a process of its own.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pk_jax as pk
from benchmarks._design_peers import GLOBAL_PEERS, GRADIENTS, METHODS, STARTS, Found, prepare
from pk_jax.analysis.measures import clearance
from pk_jax.design.optimize import indices_and_slopes
from pk_jax.design.search import advance, begin, start_boxes
from pk_jax.geometry.spread import evenly

THIRDS = np.deg2rad([90.0, 210.0, 330.0])
LIMIT_GB = 1.0
MOST_SECONDS = 600  # for a part in a process of its own
SHORTFALL = 0.002  # of the best global peer's value, that gradients may stay below


def main() -> None:
    pk.enable_x64()
    words = sys.argv[1:]
    quick = "--quick" in words
    parts = [word.removeprefix("--part=") for word in words if word.startswith("--part=")]
    for part in parts:
        PARTS[part](quick)
    if parts:
        return
    print(f"{os.cpu_count()} cores, jax {jax.__version__}, device {jax.devices()[0].device_kind}, float64")
    references(quick)
    for part in ("many_cpi", "many_integrals", *(CASES if not quick else ["five_bar"])):
        sys.stdout.flush()
        try:
            subprocess.run(command(part, quick), check=True, timeout=MOST_SECONDS)
        except subprocess.TimeoutExpired:
            print(f"  {part}: NO ANSWER within {MOST_SECONDS} s")
    two_devices(quick)


def command(part: str, quick: bool) -> list[str]:
    """This file, for one part of it, in a process of its own."""
    return [sys.executable, "-m", "benchmarks.design", f"--part={part}", *(["--quick"] if quick else [])]


def timed(call):
    """(first call with its compilation, seconds; best of three further ones, seconds; answer)"""
    began = time.perf_counter()
    found = jax.block_until_ready(call())
    first = time.perf_counter() - began
    times = []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return first, min(times), found


# --- reference values


def five_bar(v: jax.Array) -> pk.FiveBar:
    """Of (l_min, la, lb), with half_base 1 and a reach of (l_min, l_min + 2)."""
    reach = jnp.stack([v[0], v[0] + 2])
    return pk.FiveBar(half_base=jnp.ones(()), proximal=v[1], distal=v[2], reach=reach)


def planar_rrr(v: jax.Array) -> pk.PlanarRRR:
    """Of (base radius, platform radius, la, lb), symmetric."""
    circle = np.stack([np.cos(THIRDS), np.sin(THIRDS)], axis=1)
    return pk.PlanarRRR(base=v[0] * circle, platform=v[1] * circle, proximal=v[2], distal=v[3])


def stewart(v: jax.Array) -> pk.Stewart:
    """Of (base radius, platform radius, both half-angles), leg lengths 1.042 to 1.326."""
    bare = pk.Stewart.semi_regular(v[0], v[1], v[2], v[3])
    return pk.Stewart(base=bare.base, platform=bare.platform, stroke=jnp.array([1.0422217097, 1.3264639942]))


def references(quick: bool) -> None:
    """Volumes of workspaces and their gradients, against values that were computed independently."""
    print("\nworkspace volumes against independent values; gradients over their greatest entry\n")
    print(f"{'':34}{'value':>9}{'figure':>9}{'gradient':>10}{'figure':>9}{'seconds':>9}{'first':>7}")
    slope = [-2.93618393892, 2.90900028883, 3.04582588925, 3.04582588925]
    slope_3 = [-3.3433138044454, 3.0088131663660, 3.4852986881443, 3.4852986881443]
    slope_6 = np.array([-0.00379018, -0.0165156, 0.00861058, 0.00854663]) * 0.6**3
    reduced = (five_bar_along, [2.08, 1.39, 2.69])
    platform = (planar_rrr, [1.0, 0.3, 0.55, 0.55])
    rays = {"rule": "rays", "rays": 8192, "replicates": 4}
    cases = [
        ("2-RRR, panels", *reduced, {}, 7.280993404, [2.17622729, 0.0], (1e-9, 1e-6)),
        (
            "3-RRR at phi = 0.1, panels",
            *platform,
            {"axes": ("x", "y"), "about": [0.0, 0.0, 0.1]},
            0.6434623129506,
            slope,
            (1e-9, 1e-7),
        ),
        (
            f"3-RRR, |phi| <= 0.6, 4 x {rays['rays']} rays",
            *platform,
            {"within": {"phi": (-0.6, 0.6)}, **rays},
            0.69657935121157,
            slope_3,
            (2e-5, 5e-4),
        ),
        (
            "6-6 Stewart, strokes",
            stewart,
            [1.0, 0.6, 0.2, 0.2],
            {"rule": "strokes"},
            0.002809379 * 0.6**3,
            slope_6,
            (1e-6, 1e-4),
        ),
    ]
    for name, mechanism, vector, options, value, slopes, figures in cases[:: 3 if quick else 1]:
        call = lambda: pk.integral_gradient(mechanism, jnp.array(vector), (), **options)  # noqa: B023
        first, seconds, found = timed(call)
        slopes = np.array(slopes)
        of_value = abs(float(found.value.volume) / value - 1)
        of_slopes = np.max(np.abs(np.asarray(found.volume)[: len(slopes)] - slopes)) / np.max(np.abs(slopes))
        print(f"{name:34}{of_value:9.1e}{figures[0]:9.0e}{of_slopes:10.1e}{figures[1]:9.0e}", end="")
        print(f"{seconds:9.3f}{first:7.1f}", flush=True)


def five_bar_along(v: jax.Array) -> pk.FiveBar:
    """The five-bar whose links always reach all of its reach: lb = l_min + 2 - la."""
    return five_bar(jnp.stack([v[0], v[1], v[0] + 2 - v[1]]))


# --- many designs in one call


def seconds_of(call, repeats: int = 3) -> float:
    """Best of some."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return min(times)


def peak_memory() -> float:
    """Of this process so far, GB. On Linux since it began: ru_maxrss counts its parent's pages too."""
    if os.path.exists("/proc/self/status"):
        with open("/proc/self/status") as lines:
            peak = next(line for line in lines if line.startswith("VmHWM"))
        return int(peak.split()[1]) / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e9 if sys.platform == "darwin" else 1e6)


def many_cpi(quick: bool) -> None:
    """Many designs of the 2-RRR at once against one at a time, and an optimization from as many starts."""
    space, count, few = pk.design_space("2-rrr"), 250 if quick else 1000, 100 if quick else 1000
    before = peak_memory()
    began = time.perf_counter()
    indices_and_slopes(space, [[2.0, 0.3]])
    compile_many = time.perf_counter() - began
    bounds = pk.index_bounds(space)
    began = time.perf_counter()
    found = pk.optimize_design(space, bounds=bounds, starts=count)
    seconds = time.perf_counter() - began
    memory = within_limit(peak_memory())
    boxes = 0.02 + 0.96 * evenly(count, len(space.variables))
    vectors = np.asarray(jax.vmap(space.from_box)(boxes))

    def with_slopes(vector):
        def twice(vector):
            found = pk.workspace_indices(space.mechanism(vector))
            found = jnp.stack([found.gii, found.gri, found.sui])
            return found, found

        return jax.jacfwd(twice, has_aux=True)(vector)

    one, repeats = jax.jit(with_slopes), 1 if quick else 3
    loop = lambda: [jax.device_get(one(vector)) for vector in vectors[:few]]
    began = time.perf_counter()
    jax.block_until_ready(one(vectors[0]))
    compile_one = time.perf_counter() - began
    at_once = seconds_of(lambda: indices_and_slopes(space, vectors), repeats) / count
    alone = seconds_of(loop, repeats) / few
    indices, slopes = indices_and_slopes(space, vectors)
    expected = np.stack([row[1] for row in loop()])
    gap = np.max(np.abs(indices[:few] - expected))
    finite = np.isfinite(indices).all() and np.isfinite(slopes).all()
    print(
        f"\n2-RRR, GII, GRI and SUI with gradients of {count} designs in one call: {1e3 * at_once:.3f} ms a ",
        end="",
    )
    print(f"design; one at a time in a Python loop {1e3 * alone:.3f} ms: {verdict(alone / at_once, 2)}")
    print(
        f"  greatest difference {gap:.0e}, all finite: {finite}, compiled in {compile_many:.1f} and ", end=""
    )
    print(f"{compile_one:.1f} s")

    each = found.evaluations_in_all / count
    print(f"2-RRR, greatest CPI from {count} starts in one call: {found.objective:.9f}, ", end="")
    print(f"{found.status.name}, KKT {found.kkt:.0e},")
    print(f"  {each:.1f} values and gradients a start, {seconds:.1f} s")
    space.rough = None
    alike = pk.optimize_design(space, bounds=bounds, starts=few // 10)
    del space.rough
    each = 10 * alike.evaluations_in_all / few
    print(
        f"  by the true rule alone {alike.objective:.9f}, {each:.1f} a start; the loop above needs ", end=""
    )
    print(f"{count * each * alone:.1f} s for them: {verdict(count * each * alone / seconds, 2)}")
    print(f"  peak memory of the process {memory}, {before:.2f} GB before the first call")


def verdict(factor: float, wanted: float) -> str:
    """A factor and whether it is what is wanted."""
    return f"{factor:.2f} times (at least {wanted}: {'yes' if factor >= wanted else 'NO'})"


def within_limit(peak: float) -> str:
    return f"{peak:.2f} GB (less than {LIMIT_GB:.0f}: {'yes' if peak < LIMIT_GB else 'NO'})"


def family_problem(name: str, objective, constraints=None) -> pk.DesignProblem:
    """Designs of a family within its own bounds."""
    family = pk.design_family(name)
    return pk.DesignProblem(
        lambda values: family.mechanism(family.defaults | values),
        family.bounds,
        objective,
        constraints,
        name=name,
    )


def many_integrals(quick: bool) -> None:
    """Mean isotropy of many designs of a 3-RRR over their workspaces, with gradients, in one call."""
    rays, before = 16 if quick else 64, peak_memory()
    detail = {"within": {"phi": (-0.5, 0.5)}, "rule": "rays", "rays": rays, "replicates": 4}
    detail |= {"cells": 32, "nodes": 4}
    problem = family_problem("3-rrr", pk.over_workspace("frobenius_isotropy", **detail))
    vectors = problem.vector(start_boxes(problem, 64 if quick else 200))
    began = time.perf_counter()
    found = pk.evaluate_designs(problem, vectors)
    first = time.perf_counter() - began
    began = time.perf_counter()
    pk.evaluate_designs(problem, vectors)
    seconds = time.perf_counter() - began
    values, slopes = np.asarray(found.objective)[:, 0], np.asarray(found.objective_slopes)[:, 0]
    status = np.asarray(found.status)
    finite = np.isfinite(values) & np.isfinite(slopes).all(axis=1)
    told = finite == (status == pk.Status.OK)
    names = ", ".join(f"{np.sum(status == s)} {pk.Status(int(s)).name}" for s in np.unique(status))
    print(
        f"\n3-RRR, mean isotropy over the workspace (|phi| <= 0.5, 4 x {rays} rays) with gradients of ",
        end="",
    )
    print(
        f"{len(values)} designs in one call:\n  {seconds:.1f} s, with compilation {first:.1f} s; {names}; ",
        end="",
    )
    print(f"every row finite or flagged: {'yes' if told.all() else 'NO'}")
    print(
        f"  peak memory of the process {within_limit(peak_memory())}, {before:.2f} GB before the first call"
    )


# --- optimizers at equal wall time


def five_bar_rectangle() -> pk.DesignProblem:
    """Greatest least 1/kappa over 25 poses of a rectangle."""
    poses = pk.rectangle([-0.5, 1.0], [0.5, 1.8], 5)
    return family_problem("five-bar", pk.least_over(poses, "isotropy"), pk.margins_over(poses))


def planar_disc() -> pk.DesignProblem:
    """Greatest least clearance from type II over a disc, at three orientations, on the side of home."""
    index = lambda mech, pose, joints: -clearance(mech, pose, joints)  # det A < 0 at home
    angle = 2 * np.pi * np.arange(8) / 8
    disc = np.concatenate([np.zeros((1, 2)), 0.15 * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    poses = np.array([[*point, phi] for point in disc for phi in (-0.2, 0.0, 0.2)])
    return family_problem("3-rrr", pk.least_over(poses, index), pk.margins_over(poses))


def stewart_workspace() -> pk.DesignProblem:
    """Greatest integral of the isotropy over the workspace that strokes and cones leave; few rays."""
    detail = {"rule": "rays", "rays": 16, "replicates": 4, "cells": 16, "nodes": 4}
    return family_problem("stewart", pk.over_workspace("frobenius_isotropy", measure="integral", **detail))


class Case(NamedTuple):
    """A problem that all methods get."""

    name: str
    problem: Callable[[], pk.DesignProblem]
    population: int  # of those that have one
    chunk: int  # steps of the gradients between two looks at the clock
    seconds: float  # for each method and seed


CASES = {
    "five_bar": Case("five-bar, least 1/kappa over a rectangle", five_bar_rectangle, 45, 5, 3.0),
    "planar": Case("3-RRR, least clearance over a disc", planar_disc, 45, 5, 3.0),
    "stewart": Case("Stewart, isotropy integrated over the workspace", stewart_workspace, 24, 5, 25.0),
}


def optimizers(name: str, quick: bool) -> None:
    """What each method reaches in the same time, medians over seeds."""
    case, seeds = CASES[name], range(2 if quick else 5)
    program = prepare(case.problem(), population=case.population, chunk=case.chunk)
    print(f"\n{case.name}: {', '.join(program.problem.entries)}; {case.seconds:g} s each, {len(seeds)} seeds")
    print("  compiled in ", end="")
    print(", ".join(f"{s:.1f} s ({what})" for what, s in program.compile_seconds.items()))
    print(f"  {'medians':26}{'value':>14}{'worst seed':>14}{'evaluations':>13} {'seconds':>9}{'reached':>9}")
    medians = {}
    for method, run in METHODS.items():
        found = [run(program, case.seconds, seed) for seed in seeds]
        medians[method] = np.median([f.value for f in found])
        print_line(method, found)
    best = max(np.nan_to_num([medians[peer] for peer in GLOBAL_PEERS], nan=-np.inf))
    ours = medians[GRADIENTS]
    share = f" ({100 * (ours / best - 1):+.3f} %)" if np.isfinite(best) else ""
    is_level = ours >= best - SHORTFALL * abs(best)
    print(f"  gradients against the best global peer{share}: {'not worse' if is_level else 'WORSE'}")
    beyond = [m for m, value in medians.items() if m != GRADIENTS and value > ours + 1e-9 * abs(ours)]
    if beyond:
        print(f"  a greater value than the gradients: {', '.join(beyond)}")
    print(
        "  * values with gradients; reached: seconds until the value was within 1e-6 of the last", flush=True
    )


def print_line(method: str, found: list[Found]) -> None:
    values = np.array([f.value for f in found])
    evaluations, seconds, reached = (
        np.median([getattr(f, what) for f in found]) for what in ("evaluations", "seconds", "reached")
    )
    worst = np.min(np.nan_to_num(values, nan=-np.inf))
    mark = "*" if found[0].is_gradient else " "
    print(f"  {method:26}{np.median(values):14.9f}{worst:14.9f}{evaluations:12.0f}{mark}", end="")
    print(f"{seconds:9.2f}{reached:9.2f}", flush=True)


# --- two devices


def sweep(quick: bool) -> None:
    """A search from many starts on all devices of this process; prints its seconds and its bits."""
    problem = five_bar_rectangle()
    boxes = start_boxes(problem, 16 * STARTS)
    search, devices = begin(problem, boxes), jax.devices()
    advance(problem, search, 1, devices=devices)
    times = []
    for _ in range(1 if quick else 3):
        began = time.perf_counter()
        found = advance(problem, search, 40, devices=devices)
        times.append(time.perf_counter() - began)
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(found):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    print(json.dumps({"seconds": min(times), "digest": digest.hexdigest(), "devices": len(devices)}))


def two_devices(quick: bool) -> None:
    """The same sweep on one device with one core, one device with all cores, and two devices."""
    if not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2:
        print("\ntwo devices: not measured, there is one core, or it cannot be chosen")
        return
    all_cores = os.sched_getaffinity(0)
    two = set(sorted(all_cores)[:2])
    cases = {
        "one device, one core": (1, {min(two)}),
        "one device, two cores": (1, two),
        "two devices": (2, two),
    }
    if quick:
        del cases["one device, two cores"]
    print(f"\nfive-bar over a rectangle, {16 * STARTS} starts, 40 evaluations each")
    found = {}
    for name, (devices, cores) in cases.items():
        done = subprocess.run(
            command("sweep", quick),
            env=os.environ | {"JAX_NUM_CPU_DEVICES": str(devices), "JAX_PLATFORMS": "cpu"},
            preexec_fn=lambda: os.sched_setaffinity(0, cores),  # noqa: B023
            capture_output=True,
            text=True,
            check=True,
        )
        found[name] = json.loads(done.stdout.splitlines()[-1])
        assert found[name]["devices"] == devices
        print(f"  {name:24}{found[name]['seconds']:8.2f} s", flush=True)
    first, last = found["one device, one core"], found["two devices"]
    same = len({case["digest"] for case in found.values()}) == 1
    print(f"  two devices against one: {verdict(first['seconds'] / last['seconds'], 1.4)}; ", end="")
    print(f"the same bits: {'yes' if same else 'NO'}")


PARTS = {
    "references": references,
    "many_cpi": many_cpi,
    "many_integrals": many_integrals,
    **{name: functools.partial(optimizers, name) for name in CASES},
    "sweep": sweep,
    "two_devices": two_devices,
}


if __name__ == "__main__":
    main()
