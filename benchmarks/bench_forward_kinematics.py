"""Forward kinematics of a general 6-6 Stewart platform, against what a user would pick instead.

    make bench        or        python -m benchmarks.bench_forward_kinematics [--quick]

Every tool solves the same rows in this process, one tool after the other: random poses within 25 degrees
of tilt, 25 of yaw and 0.2 base radii of home, from home. Times are the best of several runs, compile time
apart; a row is wrong if its pose is more than 1e-6 off. pk_jax's time includes the verdict on every row
(fresh residual, sign of det A, bound of sigma_min); nobody else gives one.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.spatial.transform import Rotation

import pk_jax as pk
from benchmarks import _peers
from examples.delta import Delta
from pk_jax.geometry.poses import retract, tangent_size
from pk_jax.kinematics import compiled, lane_newton, rows

ROBOT = "semi-regular-stewart"
BATCHES = (1, 100, 10_000, 1_000_000)
MOST_ROWS = {"scipy_root": 100, "numpy_batched": 10_000, "optimistix_newton": 10_000}


def main() -> None:
    pk.enable_x64()
    if "--latency" in sys.argv[1:]:
        robot = pk.catalogued(ROBOT)
        return latency(np.asarray(robot.home()[1]) + 0.01, robot)
    quick = "--quick" in sys.argv[1:]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    print(f"{_processor()}, {cores} cores, jax {jax.__version__}, {jax.devices()[0].device_kind}, float64\n")
    batches = BATCHES[:-1] if quick else BATCHES
    robot = pk.catalogued(ROBOT)
    poses, lengths = random_rows(robot, batches[-1])
    best = throughput(robot, poses, lengths, batches)
    print(f"\nratios at {batches[-1]:,} rows, verdict included:")
    ours = {name: value for name, value in best.items() if name.startswith("pk_jax")}
    for name, value in ours.items():
        others = {peer: value / other for peer, other in best.items() if peer not in ours}
        print(f"  {name:32}" + "  ".join(f"{ratio:.3g} x {peer}" for peer, ratio in others.items()))
    verdict_cost(robot, lengths[: min(len(lengths), 200_000)])
    print("\nlatency of one solve, NumPy in and out, quantiles 5, 50 and 95 %:")
    for dispatch in ("true", "false"):
        print(f"  JAX_CPU_ENABLE_ASYNC_DISPATCH={dispatch:6}", end="", flush=True)
        command = [sys.executable, "-m", "benchmarks.bench_forward_kinematics", "--latency"]
        subprocess.run(command, env=os.environ | {"JAX_CPU_ENABLE_ASYNC_DISPATCH": dispatch}, check=True)
    other_mechanisms()


def random_rows(robot: pk.Stewart, count: int) -> tuple[pk.SE3, np.ndarray]:
    """Poses near home and their leg lengths."""
    rng = np.random.default_rng(0)
    heading, tilt, yaw = rng.uniform(0, 2 * np.pi, count), *np.deg2rad(rng.uniform(-25, 25, (2, count)))
    tilted = Rotation.from_rotvec(
        tilt[:, None] * np.stack([np.cos(heading), np.sin(heading), 0 * heading], 1)
    )
    turned = tilted * Rotation.from_rotvec(yaw[:, None] * [0, 0, 1.0])
    offset = rng.uniform(-0.2, 0.2, (count, 3))
    poses = pk.SE3(np.asarray(robot.home()[0].translation) + offset, turned.as_matrix())
    return poses, np.asarray(jax.jit(jax.vmap(robot.inverse))(poses))


# --- solves a second


def throughput(
    robot: pk.Stewart, poses: pk.SE3, lengths: np.ndarray, batches: tuple[int, ...]
) -> dict[str, float]:
    """Print the table. -> solves a second of the largest batch each tool was given, by tool"""
    head = "".join(f"{f'{count:,} rows':>15}" for count in batches)
    print(f"solves a second{'':20}{head}   compile   length error  wrong rows")
    found = {}
    one_core = {min(os.sched_getaffinity(0))} if hasattr(os, "sched_getaffinity") else None
    variants = [
        ("pk_jax", compiled.FULL, False),
        ("pk_jax, vector width only", compiled.WIDE, False),
        ("pk_jax, default flags, one core", compiled.PLAIN, True),
    ]
    for name, options, is_alone in variants:
        workers = 1 if is_alone else None
        prepare = lambda q, given=(options, workers): lambda: pk_solve(robot, q, *given)
        with affinity(one_core if is_alone else None):
            found[name] = line(name, robot, poses, lengths, batches, prepare)
    start = robot.home()[0]
    base, joints, *home = map(np.array, (robot.base, robot.platform, start.translation, start.rotation))
    for peer in _peers.PEERS:
        problem = lambda q, peer=peer: _peers.prepare(peer, base, joints, q, *home)
        fitting = tuple(n for n in batches if n <= MOST_ROWS.get(peer.__name__, batches[-1]))
        try:
            found[peer.__name__] = line(peer.__name__, robot, poses, lengths, fitting, problem)
        except _peers.NotAvailable as missing:
            print(f"{peer.__name__:35}{missing}")
    return found


def line(name, robot, poses, lengths, batches, prepare) -> float:
    """One line of the table: every batch, the best of several runs."""
    rates, compile_time = [], 0.0
    for count in batches:
        q = lengths[:count]
        begin = time.perf_counter()
        ready = prepare(q)
        answer = ready()
        first = time.perf_counter() - begin
        seconds = best_of(ready)
        compile_time = max(compile_time, first - seconds)
        rates.append(count / seconds)
    translation, rotation = (np.asarray(part) for part in answer)
    count = batches[-1]
    placed = translation[:, None] + np.einsum("nij,kj->nki", rotation, np.asarray(robot.platform))
    length_error = np.abs(np.linalg.norm(placed - np.asarray(robot.base), axis=2) - lengths[:count]).max(
        axis=1
    )
    off = np.abs(translation - np.asarray(poses.translation)[:count]).max(axis=1)
    wrong = np.sum(~(off < 1e-6))
    cells = "".join(f"{rate:15,.0f}" for rate in rates) + " " * 15 * (len(BATCHES[: len(rates)]) - len(rates))
    print(
        f"{name:35}{cells:{15 * len(BATCHES)}}{compile_time:8.1f} s {np.nanmax(length_error):11.1e} {wrong:8}"
    )
    return rates[-1]


def pk_solve(robot: pk.Stewart, lengths: np.ndarray, options: compiled.Options, workers: int | None):
    """`pk.forward_kinematics`, or the same with other options of the compiler."""
    if options is compiled.FULL:
        pose = pk.forward_kinematics(robot, lengths).pose
    else:
        pose = rows.solve(robot, lengths, None, one_guess=True, options=options, workers=workers).pose
    return pose.translation, pose.rotation


class affinity:
    """Within it, the process runs on some of its cores only."""

    def __init__(self, cores: set[int] | None) -> None:
        self.cores = cores

    def __enter__(self) -> None:
        if self.cores:
            self.before = os.sched_getaffinity(0)
            os.sched_setaffinity(0, self.cores)

    def __exit__(self, *_) -> None:
        if self.cores:
            os.sched_setaffinity(0, self.before)


def best_of(call: Callable[[], object], seconds: float = 3.0) -> float:
    """Seconds of the fastest of up to 30 runs, for about three seconds."""
    times, until = [], time.perf_counter() + seconds
    while len(times) < 30 and (time.perf_counter() < until or not times):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - begin)
    return min(times)


# --- what the verdict costs, and one solve


def verdict_cost(robot: pk.Stewart, lengths: np.ndarray) -> None:
    """The same program without the verdict, in turns with the one with it."""
    judged = lane_newton.judge

    def unjudged(mech, joints, pose, by, actuated):
        none = 0 * joints.items[0]
        return lane_newton.Judged(none, none == 0, none + 1, none + 1)

    def solve():
        return rows.solve(robot, lengths, None, one_guess=True)

    times: dict[str, list[float]] = {"with": [], "without": []}
    for name, judge in (("with", judged), ("without", unjudged)) * 4:
        lane_newton.judge = judge
        rows.program.cache_clear()
        solve()
        times[name] += [best_of(solve, 1.0)]
    lane_newton.judge = judged
    rows.program.cache_clear()
    alone, whole = min(times["without"]), min(times["with"])
    print(
        f"\nverdict: {whole / len(lengths) * 1e9:.0f} ns a row with it, {alone / len(lengths) * 1e9:.0f} ns ",
        end="",
    )
    print(f"without: {100 * (whole / alone - 1):.0f} % of the solve")


def latency(lengths: np.ndarray, robot: pk.Stewart) -> None:
    """One row of NumPy in, the pose as NumPy out, in a process of its own."""

    def solve():
        pose = pk.forward_kinematics(robot, lengths).pose
        return np.asarray(pose.translation), np.asarray(pose.rotation)

    begin = time.perf_counter()
    solve()
    compile_time = time.perf_counter() - begin
    times = []
    for _ in range(2000):
        begin = time.perf_counter()
        solve()
        times.append(time.perf_counter() - begin)
    low, middle, high = np.quantile(times, [0.05, 0.5, 0.95]) * 1e6
    print(f"{low:5.0f} {middle:5.0f} {high:5.0f} us; first call {compile_time:.1f} s")


# --- other mechanisms, an outsider's among them


def other_mechanisms(count: int = 16_384) -> None:
    print(f"\n{count:,} forward solves, nanoseconds a row, against naive vmap of the same residual")
    delta = Delta(base_radius=0.2, platform_radius=0.05, arm=0.35, rod=0.8)
    for robot in (pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15), delta, pk.catalogued(ROBOT)):
        joints = robot.home()[1]
        rng = np.random.default_rng(1)
        q = np.asarray(joints) + rng.uniform(-0.1, 0.1, (count, joints.size))
        fast = lambda robot=robot, q=q: pk.forward_kinematics(robot, q)
        given = jnp.asarray(q)
        slow = lambda robot=robot, q=given: naive(robot, q)
        begin = time.perf_counter()
        found = fast()
        compile_time = time.perf_counter() - begin
        expected = slow()
        gap = max(
            float(np.nanmax(np.abs(np.asarray(a) - np.asarray(b))))
            for a, b in zip(jax.tree.leaves(found.pose), jax.tree.leaves(expected), strict=True)
        )
        ours, theirs = (best_of(call) / count * 1e9 for call in (fast, slow))
        lost = int(np.sum(np.asarray(found.status) != pk.Status.OK))
        print(
            f"  {type(robot).__name__:10}{ours:8.0f}, naive {theirs:8.0f}: {theirs / ours:5.1f} times;  "
            f"greatest difference {gap:.0e}, {lost} rows not OK, first call {compile_time:.1f} s"
        )


@jax.jit
def naive(robot: pk.Mechanism, joints: jax.Array):
    """What one writes first: Newton by jacfwd and solve until the step is small, vmapped."""
    home = robot.home()[0]
    size = tangent_size(home)

    def one(q):
        def step(state):
            pose, _, k = state
            moved = lambda twist: robot.residual(retract(pose, twist), q)
            zero = jnp.zeros(size)
            jacobian, value = jax.jacfwd(moved)(zero), moved(zero)
            is_square = value.size == size
            twist = jnp.linalg.solve(jacobian, -value) if is_square else jnp.linalg.lstsq(jacobian, -value)[0]
            return retract(pose, twist), jnp.max(jnp.abs(twist)), k + 1

        return lax.while_loop(lambda s: (s[1] > 1e-12) & (s[2] < 20), step, (home, jnp.inf, 0))[0]

    return jax.vmap(one)(joints)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
