"""Nine lengths against six legs and the usual ways; placement of sensors, the loop, calibration.

    make bench        or        python -m benchmarks.nine_lengths [--quick]

Each comparison runs in this process on the same input, one after the other, best of several runs, compile
time apart; what the answers differ by is printed beside.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution, least_squares
from scipy.spatial.transform import Rotation

import pk_jax as pk
from benchmarks.bench_forward_kinematics import best_of
from pk_jax.control.loop import FEEDBACKS
from pk_jax.design.sensor_placement import gain_over
from pk_jax.files.named import named_mechanism
from pk_jax.files.sensed import workspace_of
from pk_jax.papers.nine_lengths import random_poses

NOISE = 1e-5  # m, of every length
FEW = 2000


def main() -> None:
    pk.enable_x64()
    is_quick = "--quick" in sys.argv[1:]
    for name in ("nine-lengths", "nine-lengths-general"):
        poses(name, 50_000 if is_quick else 1_000_000)
    placement()
    loop()
    calibration()


def poses(name: str, count: int) -> None:
    """Time, accuracy and noise gain."""
    robot = named_mechanism(name).mechanism
    rng = np.random.default_rng(1)
    true = jax.tree.map(np.asarray, random_poses(rng, count))
    base, platform = np.asarray(robot.base), np.asarray(robot.platform)
    points = np.einsum("nij,kj->nki", true.rotation, platform) + true.translation[:, None]
    lengths = np.linalg.norm(points - base, axis=2) + NOISE * rng.standard_normal((count, 9))
    gain = lambda pose, n=count: (
        np.median(np.linalg.norm(pose.translation - true.translation[:n], axis=1)) / NOISE
    )

    ours = lambda: jax.block_until_ready(pk.nine_length_pose(robot, lengths))
    begin = time.perf_counter()
    found = ours()
    first = time.perf_counter() - begin
    wrong = int(np.sum(~(np.linalg.norm(found.pose.translation - true.translation, axis=1) < 100 * NOISE)))
    per = best_of(ours, 3)
    print(f"{name}: {count:,} rows of nine lengths, noise 10 um at about 1 m; first call {first:.1f} s")
    print(
        f"  pk.nine_length_pose     {per:9.3f} s  {count / per / 1e6:8.3f} million/s  |dt|/noise "
        f"{gain(found.pose):.2f} (closed form alone {gain(found.closed_form):.2f}), {wrong} wrong"
    )
    estimate = np.asarray(found.pose.translation)

    legs = pk.Stewart(base=base[:6], platform=platform[:6])
    few = count // 20  # most rows are far from home, and what is lost is sought for long
    near = pk.SE3(true.translation[:few] + 1e-3, true.rotation[:few])
    for start, guess in (("home", None), ("1 mm beside", near)):
        six = lambda guess=guess: jax.block_until_ready(pk.forward_kinematics(legs, lengths[:few, :6], guess))
        off = np.linalg.norm(np.asarray(six().pose.translation) - true.translation[:few], axis=1) / NOISE
        is_right, seconds = off < 100, best_of(six, 2)
        print(
            f"  six legs from {start:12}{seconds:7.3f} s {few / seconds / 1e6:8.3f} million/s ({few:,} rows) "
            f"|dt|/noise {np.median(off[is_right]):.2f}, {few - is_right.sum()} wrong or lost"
        )
    if name == "nine-lengths":
        numpy_ = lambda: closed_form_in_numpy(base, platform, lengths)
        compare(
            "closed form in NumPy",
            best_of(numpy_, 2),
            count,
            numpy_(),
            np.asarray(found.closed_form.translation),
            per,
        )
    vmapped = jax.jit(jax.vmap(lambda row: pk.nine_length_pose(robot, row).pose.translation))
    given = jnp.asarray(lengths[:FEW])
    jax.block_until_ready(vmapped(given))
    call = lambda: np.asarray(jax.block_until_ready(vmapped(given)))
    compare("jit(vmap(one row))", best_of(call, 3), FEW, call(), estimate[:FEW], per * FEW / count)
    for method in () if name == "nine-lengths" else ("macaulay", "quintic"):
        call = lambda method=method: pk.nine_length_pose(robot, lengths[:FEW], method=method).pose.translation
        jax.block_until_ready(call())
        compare(
            method,
            best_of(lambda call=call: jax.block_until_ready(call()), 3),
            FEW,
            np.asarray(call()),
            estimate[:FEW],
            per * FEW / count,
        )
    begin = time.perf_counter()
    oracle = np.array([scipy_estimate(base, platform, row) for row in lengths[:100]])
    compare(
        "scipy least_squares", time.perf_counter() - begin, 100, oracle, estimate[:100], per * 100 / count
    )


def compare(name: str, seconds: float, rows: int, theirs: np.ndarray, ours: np.ndarray, own: float) -> None:
    off = np.linalg.norm(theirs - ours, axis=1)
    other = int(np.sum(~(off < 1e-6)))
    gap = np.max(off[off < 1e-6], initial=0)
    print(
        f"  {name:22} {seconds:10.3f} s  {rows / seconds / 1e6:8.3f} million/s ({rows:,} rows) "
        f"{seconds / own:7.1f} times ours; greatest difference {gap:.0e}, {other} rows other"
    )


def closed_form_in_numpy(base: np.ndarray, platform: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Eqs. (22)-(24) of the patent, vectorized, and Kabsch by SVD: no estimate. -> positions (n, 3)"""
    corners, squares = platform[6:], lengths**2
    k = np.linalg.solve(np.c_[corners[:, :2], np.ones(3)].T, np.c_[platform[:6, :2], np.ones(6)].T).T
    side = np.sum((corners[0] - corners[1]) ** 2)
    a, s = base[:6, :2], base[6:, :2]
    matrix = 2 * (k[:, :, None] * (s - a[:, None])).reshape(6, 6)
    pairs = k[:, 0] * k[:, 1] + k[:, 1] * k[:, 2] + k[:, 2] * k[:, 0]
    right = (
        squares[:, :6] - np.sum(a**2, axis=1) - (squares[:, 6:] - np.sum(s**2, axis=1)) @ k.T + side * pairs
    )
    flat = np.linalg.solve(matrix, right.T).T.reshape(-1, 3, 2)
    height = np.sqrt(np.maximum(squares[:, 6:] - np.sum((flat - s) ** 2, axis=2), 0))
    points = np.concatenate([flat, height[:, :, None]], axis=2)
    middle, own = points.mean(axis=1, keepdims=True), corners - corners.mean(axis=0)
    u, _, v = np.linalg.svd(np.swapaxes(points - middle, 1, 2) @ own)
    u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
    return middle[:, 0] - np.einsum("nij,j->ni", u @ v, corners.mean(axis=0))


def scipy_estimate(base: np.ndarray, platform: np.ndarray, row: np.ndarray) -> np.ndarray:
    """From home: what a user without a closed form has."""

    def errors(x):
        return (
            np.linalg.norm(x[:3] + platform @ Rotation.from_rotvec(x[3:]).as_matrix().T - base, axis=1) - row
        )

    return least_squares(errors, [0, 0, 1, 0, 0, 0], xtol=1e-12, ftol=1e-12, gtol=1e-12).x[:3]


def placement() -> None:
    """Three sensors on the base, 64 poses: gradients, and differential evolution of the same objective."""
    robot = named_mechanism("nine-lengths").mechanism
    where = workspace_of(robot)
    begin = time.perf_counter()
    found = pk.place_sensors(robot, where, radius=1.0)
    seconds = time.perf_counter() - begin
    print(
        "sensor placement, S within a square of half-width 1, 64 poses: RMS gain (before: "
        f"{found.gain_before:.4f})"
    )
    print(
        f"  gradients, 16 starts    {found.gain:.6f}   {found.evaluations:6} gradients    {seconds:6.1f} s, "
        "compile included"
    )
    middle = np.asarray(robot.base)[:6].mean(axis=0)

    @jax.jit
    def gain(x):
        feet = jnp.concatenate([x.reshape(3, 2), jnp.zeros((3, 1))], axis=1) + middle
        base = jnp.concatenate([robot.base[:6], feet])
        placed = jax.tree.unflatten(jax.tree.structure(robot), [base, robot.platform])
        return gain_over(placed, where, jnp.ones(9))

    gain(np.ones(6))
    begin = time.perf_counter()
    best = differential_evolution(lambda x: float(gain(x)), [(-1, 1)] * 6, seed=0, tol=1e-8, polish=False)
    seconds = time.perf_counter() - begin
    print(f"  differential evolution  {best.fun:.6f}   {best.nfev:6} values       {seconds:6.1f} s")


def loop() -> None:
    """The circle of 3 s with an encoder bias of 100 um, 20 machines at once."""
    robot = named_mechanism("nine-lengths").mechanism
    reference, plant = pk.circle_reference(robot, radius=0.1), pk.Plant(encoder_bias=1e-4)
    print("control loop, 20 machines, 3000 samples each")
    for feedback in FEEDBACKS:
        run = lambda feedback=feedback: jax.block_until_ready(
            pk.simulate_control(robot, reference, feedback, key=jax.random.key(0), plant=plant, seeds=20)
        )
        begin = time.perf_counter()
        found = run()
        first = time.perf_counter() - begin
        per = best_of(run, 3)
        error = np.sqrt(np.mean(np.asarray(found.rms_position) ** 2)) * 1e6
        print(
            f"  {feedback:8} {per:7.3f} s  {60 / per:7.0f} times real time, first call {first:4.1f} s; "
            f"RMS error {error:6.1f} um"
        )


def calibration() -> None:
    """36 parameters from every sixth row of a hexapod's log."""
    lines = Path(__file__).parents[1].joinpath("examples", "hexapod_log.csv").read_text().splitlines()
    table = [line for line in lines if not line.startswith("#")]
    log = np.genfromtxt(table, delimiter=",", names=True)
    columns = lambda *names: np.stack([log[name] for name in names], axis=1)
    turns = np.deg2rad(columns("tx_deg", "ty_deg", "tz_deg"))
    rotation = Rotation.from_euler("XYZ", turns).as_matrix()
    translation = 1e-3 * columns("x_mm", "y_mm", "z_mm")
    lengths = 1e-3 * columns(*(f"l{i}_mm" for i in range(1, 7)))
    logged = pk.SE3(translation, rotation)

    def ours():
        return pk.calibrate(pk.stewart_from_log(logged, lengths), logged, lengths)

    begin = time.perf_counter()
    found = ours()
    first = time.perf_counter() - begin
    print(f"calibration, {len(lengths)} rows of a log, 36 unknowns, no nominal geometry")
    per = best_of(ours, 3)
    print(f"  pk.calibrate         {per:7.2f} s, first call {first:4.1f} s   RMS {1e3 * found.rms:.6f} mm")

    def errors(x):
        a, b = x.reshape(2, 6, 3)
        points = translation[:, None] + np.einsum("nij,kj->nki", rotation, b)
        return (np.linalg.norm(points - a, axis=2) - lengths).ravel()

    nominal = np.stack(
        [np.round(np.asarray(each), 2) for each in (found.mechanism.base, found.mechanism.platform)]
    )
    begin = time.perf_counter()
    best = least_squares(errors, nominal.ravel(), x_scale=0.1)
    seconds = time.perf_counter() - begin
    rms = 1e3 * np.sqrt(np.mean(best.fun**2))
    print(f"  scipy least_squares  {seconds:7.2f} s, from a geometry right to 1 cm   RMS {rms:.6f} mm")


if __name__ == "__main__":
    main()
