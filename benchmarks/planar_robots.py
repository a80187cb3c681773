"""Planar robots: forward kinematics, a million classifications and a singularity locus, and the usual ways.

    make bench        or        python -m benchmarks.planar_robots [--quick]

Each comparison runs in this process on the same input, one after the other, best of several runs, compile
time apart; what the answers differ by is printed beside.
"""

from __future__ import annotations

import resource
import sys
import time

import contourpy
import jax
import jax.numpy as jnp
import numpy as np

import pk_jax as pk
from benchmarks.bench_forward_kinematics import best_of, naive

ROWS = 16_384


def main() -> None:
    pk.enable_x64()
    quick = "--quick" in sys.argv[1:]
    forward_kinematics()
    classification(100_000 if quick else 1_000_000)
    locus(101)


def forward_kinematics() -> None:
    """Batches of poses near home, from home."""
    print(f"forward kinematics, {ROWS:,} rows, ns a row with verdict; naive: Newton by jacfwd, vmapped")
    for name in ("3-rrr", "4-rrr", "6-link", "arte-3-rpr"):
        robot = pk.catalogued(name)
        joints = np.asarray(pk.inverse_kinematics(robot, poses_near(robot, ROWS, 0.35)).joints)
        joints = joints[np.isfinite(joints).all(axis=1)]
        given = jnp.asarray(joints)
        begin = time.perf_counter()
        found = jax.block_until_ready(pk.forward_kinematics(robot, joints))
        first = time.perf_counter() - begin
        expected = naive(robot, given)
        gap = np.nanmax(np.abs(np.asarray(found.pose) - np.asarray(expected)))
        lost = int(np.sum(np.asarray(found.status) != pk.Status.OK))
        calls = (lambda: pk.forward_kinematics(robot, joints), lambda: naive(robot, given))  # noqa: B023
        ours, theirs = (best_of(call) / len(joints) * 1e9 for call in calls)
        print(
            f"  {name:12}{ours:8.0f}, naive {theirs:8.0f}: {theirs / ours:5.1f} times;  greatest difference "
            f"{gap:.0e}, {lost} rows not OK, first call {first:.1f} s"
        )


def poses_near(robot: pk.Mechanism, count: int, spread: float) -> np.ndarray:
    """(x, y, phi) within `spread` lengths and radians of home."""
    offsets = np.random.default_rng(0).uniform(-spread, spread, (count, 3))
    return np.asarray(robot.home()[0]) + offsets * [float(robot.length()), float(robot.length()), 1.0]


def classification(count: int) -> None:
    """Kind and both distances of poses of the 3-RRR: one call, and a loop of NumPy SVDs."""
    robot = pk.catalogued("3-rrr")
    poses = poses_near(robot, count, 0.5)
    joints = np.asarray(pk.inverse_kinematics(robot, poses).candidate)
    begin = time.perf_counter()
    found = jax.block_until_ready(pk.classify_singularity(robot, poses, joints))
    first = time.perf_counter() - begin
    ours = best_of(lambda: pk.classify_singularity(robot, poses, joints)) / count
    few = min(count, 2000)
    begin = time.perf_counter()
    sines = np.array(
        [numpy_sines(robot_of(robot), *row) for row in zip(poses[:few], joints[:few], strict=True)]
    )
    theirs = (time.perf_counter() - begin) / few
    mine = np.stack([np.asarray(found.sigma_inverse), np.asarray(found.sigma_direct)], axis=1)[:few]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"\nclassify {count:,} poses of the 3-RRR: {1 / ours:,.0f} a second, one call; NumPy loop "
        f"{1 / theirs:,.0f} a second: {theirs / ours:.0f} times\n  greatest difference of the distances "
        f"{np.abs(mine - sines).max():.0e}, first call {first:.1f} s, peak memory {peak:.2f} GB"
    )


def robot_of(robot: pk.PlanarRRR) -> tuple[np.ndarray, ...]:
    return tuple(
        np.asarray(f) for f in (robot.base, robot.platform, robot.proximal, robot.distal, robot.length())
    )


def numpy_sines(robot: tuple[np.ndarray, ...], pose: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Distances to type I and II of a 3-RRR, by hand: two SVDs of the null space of [A B]. -> (2,)"""
    base, platform, la, _, length = robot
    c, s = np.cos(pose[2]), np.sin(pose[2])
    arm = platform @ np.array([[c, s], [-s, c]])
    link = la * np.stack([np.cos(joints), np.sin(joints)], axis=1)
    force = pose[:2] + arm - base - link
    turn = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
    rate = force[:, 0] * link[:, 1] - force[:, 1] * link[:, 0]
    m = np.concatenate([force * length, turn[:, None], np.diag(rate)], axis=1)
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    null = np.linalg.svd(m)[2][3:].T
    parts = null[:3], null[3:]
    return np.array([np.linalg.svd(part, compute_uv=False)[-1] for part in parts])


def locus(nodes: int) -> None:
    """The type II locus of the 3-RRR over x and y, all working modes: its points, and how exact they are."""
    robot = pk.catalogued("3-rrr")
    begin = time.perf_counter()
    found = pk.singularity_locus(robot, kinds="II", nodes=nodes)
    first = time.perf_counter() - begin
    ours = best_of(lambda: pk.singularity_locus(robot, kinds="II", nodes=nodes))
    points = sum(len(curve.sigma) for curve in found.curves)
    worst = max(curve.sigma.max() for curve in found.curves)
    print(f"\ntype II locus of the 3-RRR over x, y at phi 0, {len(found.branches)} working modes")
    print(
        f"  pk_jax, grid of {nodes}^2: {ours:.2f} s, {points} points in order, largest sigma {worst:.0e}, "
        f"first call {first:.1f} s"
    )
    lines = [line[[0, -1]] for line in found.nodes]
    for size in (nodes, 10 * nodes):
        begin = time.perf_counter()
        vertices = numpy_contours(robot, lines, size)
        seconds = time.perf_counter() - begin
        sigma = exactness(robot, vertices)
        print(
            f"  NumPy determinants and contours, {size}^2: {seconds:.2f} s, "
            f"{sum(map(len, vertices))} points, sigma {np.median(sigma):.0e}, largest {sigma.max():.0e}"
        )


def numpy_contours(robot: pk.PlanarRRR, lines: list[np.ndarray], nodes: int) -> list[np.ndarray]:
    """Zero contours of the determinant of the three screws, by working mode. -> (points, 2) each"""
    base, platform, la, lb, length = robot_of(robot)
    x, y = (np.linspace(*line, nodes) for line in lines)
    found = []
    with np.errstate(invalid="ignore"):
        at = np.stack(np.meshgrid(x, y), axis=-1)[..., None, :]
        leg = at + platform - base
        squared = np.sum(leg**2, axis=-1)
        bend = np.arccos((squared - la**2 - lb**2) / (2 * la * lb))  # psi, NaN out of reach
        for mode in pk.working_modes(robot):
            psi = mode * bend
            joints = np.arctan2(leg[..., 1], leg[..., 0]) - np.arctan2(
                lb * np.sin(psi), la + lb * np.cos(psi)
            )
            alpha = joints + psi
            u = np.stack([np.cos(alpha), np.sin(alpha)], axis=-1)
            moment = platform[:, 0] * u[..., 1] - platform[:, 1] * u[..., 0]
            det = np.linalg.det(np.concatenate([u, moment[..., None] / length], axis=-1))
            pieces = contourpy.contour_generator(x, y, np.ma.masked_invalid(det)).lines(0.0)
            found.append(np.concatenate([np.zeros((0, 2)), *pieces]))
    return found


def exactness(robot: pk.PlanarRRR, vertices: list[np.ndarray]) -> np.ndarray:
    """sigma of the points of a contour that are in reach."""
    found = []
    for mode, points in zip(pk.working_modes(robot), vertices, strict=True):
        if len(points):
            poses = np.column_stack([points, np.zeros(len(points))])
            joints = pk.inverse_kinematics(robot, poses, mode).candidate
            found.append(np.asarray(pk.classify_singularity(robot, poses, joints).sigma_direct))
    sigma = np.concatenate(found)
    return sigma[np.isfinite(sigma)]


if __name__ == "__main__":
    main()
