"""Casing oscillator: a workspace map of a million poses, forward kinematics, the proof, and the usual ways.

    make bench        or        python -m benchmarks.casing_oscillator [--quick]

Each comparison runs in this process on the same input, one after the other, best of several runs, compile
time apart; what the answers differ by is printed beside.
"""

from __future__ import annotations

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import pk_jax as pk
from benchmarks.bench_forward_kinematics import best_of, naive
from pk_jax.geometry import rotations
from pk_jax.papers.casing_oscillator import BOX, prove_regular_workspace

WIDE = np.deg2rad(20.0)
ROWS = 16_384


def main() -> None:
    pk.enable_x64()
    machine = pk.CasingOscillator()
    nodes = 300 if "--quick" in sys.argv[1:] else 1000
    workspace(machine, nodes)
    anywhere(machine, nodes)
    forward_kinematics(machine)
    proof(machine, 100_000 if nodes == 300 else 1_000_000)


def workspace(machine: pk.CasingOscillator, nodes: int) -> None:
    """Smallest margin over roll and yaw at neutral s and E."""
    count = nodes**2
    ours = lambda: pk.workspace_map(machine, "roll,yaw", ranges=[(-WIDE, WIDE)] * 2, nodes=nodes)
    begin = time.perf_counter()
    found = ours()
    first = time.perf_counter() - begin
    lines = np.meshgrid(*found.nodes, indexing="ij")
    roll, yaw = (np.ravel(each) for each in lines)
    print(f"workspace map, {count:,} poses, 5 strokes and 8 cones each; first call {first:.1f} s")
    per = best_of(ours)
    print(f"  pk.workspace_map     {per:8.3f} s   {count / per / 1e6:8.2f} million poses a second")

    vmapped = jax.jit(jax.vmap(lambda roll, yaw: smallest_margin(machine, roll, yaw)))
    given = jnp.asarray(roll), jnp.asarray(yaw)
    jax.block_until_ready(vmapped(*given))
    peers = {
        "jit(vmap(...)) JAX": lambda: np.asarray(jax.block_until_ready(vmapped(*given))),
        "NumPy, vectorized": lambda: numpy_margins(machine, roll, yaw),
    }
    for name, call in peers.items():
        compare(name, call(), found.margin.ravel(), best_of(call, 3), per)
    few = np.random.default_rng(0).choice(count, 2000, replace=False)
    begin = time.perf_counter()
    looped = np.array([numpy_margins(machine, roll[i : i + 1], yaw[i : i + 1])[0] for i in few])
    compare(
        "NumPy, pose by pose",
        looped,
        found.margin.ravel()[few],
        (time.perf_counter() - begin) / 2000 * count,
        per,
    )


def compare(name: str, theirs: np.ndarray, ours: np.ndarray, seconds: float, own: float) -> None:
    apart = int(np.sum((theirs >= 0) != (ours >= 0)))
    gap = np.max(np.abs(theirs - ours))
    print(
        f"  {name:20} {seconds:8.3f} s   {seconds / own:8.1f} times ours; greatest difference {gap:.0e}, "
        f"{apart} poses judged otherwise"
    )


def smallest_margin(machine: pk.CasingOscillator, roll: jax.Array, yaw: jax.Array) -> jax.Array:
    pose = pk.AxisPose(
        machine.neutral[0], rotations.from_angles(jnp.stack([roll, jnp.zeros_like(roll), yaw]))
    )
    margins = machine.margins(pose, machine.inverse(pose)).values()
    return jnp.min(jnp.concatenate([jnp.ravel(each) for each in margins]))


def numpy_margins(machine: pk.CasingOscillator, roll: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """The smallest margin, as one would write it in NumPy. -> (poses,)"""
    r, base = float(machine.platform_radius), float(machine.base_radius)
    s, carriage = np.asarray(machine.neutral)
    stroke = np.asarray(machine.stroke)
    (cr, sr), (cy, sy) = (np.cos(roll), np.sin(roll)), (np.cos(yaw), np.sin(yaw))
    zero = np.zeros_like(roll)
    turn = np.stack([[cy, -sy * cr, sy * sr], [sy, cy * cr, -cy * sr], [zero, sr, cr]]).transpose(2, 0, 1)
    joints = np.array([[r, r, s], [0, r, s], [0, -r, s], [r, -r, s]])
    feet = np.array([[carriage, 0, 0], [0, base, 0], [0, -base, 0], [carriage, 0, 0]])
    legs = np.einsum("kij,lj->kli", turn, joints) - feet
    lengths = np.linalg.norm(legs, axis=2)
    units = legs / lengths[:, :, None]
    neutral = joints - feet
    neutral = neutral / np.linalg.norm(neutral, axis=1, keepdims=True)
    cones = [np.einsum("kli,li->kl", u, neutral) for u in (units, np.einsum("kij,kli->klj", turn, units))]
    strokes = np.concatenate([lengths, np.full((len(roll), 1), carriage)], axis=1)
    every = [
        (strokes - stroke[:, 0]) / r,
        (stroke[:, 1] - strokes) / r,
        cones[0] - np.cos(float(machine.base_cone)),
        cones[1] - np.cos(float(machine.platform_cone)),
    ]
    return np.min(np.concatenate(every, axis=1), axis=1)


def anywhere(machine: pk.CasingOscillator, nodes: int) -> None:
    """The same with the carriage, for each pose, where the smallest margin is greatest."""
    count = nodes**2
    options = {"ranges": [(-WIDE, WIDE)] * 2, "nodes": nodes, "free": "any"}
    begin = time.perf_counter()
    found = pk.workspace_map(machine, "roll,yaw", **options)
    first = time.perf_counter() - begin
    per = best_of(lambda: pk.workspace_map(machine, "roll,yaw", **options), 2)
    scan = np.full(found.margin.shape, -np.inf)
    begin = time.perf_counter()
    values = np.linspace(*np.asarray(machine.free_range()[0]), 101)
    for value in values:
        one = pk.workspace_map(machine, "roll,yaw", **options | {"free": value})
        scan = np.maximum(scan, one.margin)
    scanned = time.perf_counter() - begin
    least = np.min(found.margin - scan)
    print(
        f"\nwith the carriage anywhere: {per:.2f} s, {count / per / 1e6:.2f} million poses a second, "
        f"first call {first:.1f} s\n  101 maps, each with another carriage: {scanned:.2f} s; "
        f"best of them less ours: {-least:.0e} at most, {np.max(found.margin - scan):.0e} at least"
    )


def forward_kinematics(machine: pk.CasingOscillator) -> None:
    """Poses in the workspace, from home."""
    rng = np.random.default_rng(0)
    ends = np.array([BOX[name] for name in ("s", "roll", "pitch", "yaw")])
    s, *angles = ends[:, :1] + np.diff(ends, axis=1) * rng.random((4, ROWS))
    poses = pk.AxisPose.from_angles(s, *angles)
    carriage = rng.uniform(*np.asarray(machine.free_range()[0]), ROWS)
    joints = np.asarray(pk.inverse_kinematics(machine, poses, free=carriage).joints)
    given = jnp.asarray(joints)
    begin = time.perf_counter()
    found = jax.block_until_ready(pk.forward_kinematics(machine, joints))
    first = time.perf_counter() - begin
    expected = naive(machine, given)
    gap = np.max(np.abs(np.asarray(found.pose.rotation) - np.asarray(expected.rotation)))
    error = np.max(np.abs(np.asarray(found.pose.rotation) - np.asarray(poses.rotation)))
    lost = int(np.sum(np.asarray(found.status) != pk.Status.OK))
    calls = (lambda: pk.forward_kinematics(machine, joints), lambda: naive(machine, given))
    ours, theirs = (best_of(call) / ROWS * 1e9 for call in calls)
    print(
        f"\nforward kinematics, {ROWS:,} rows: {ours:.0f} ns a row with verdict, naive {theirs:.0f}: "
        f"{theirs / ours:.1f} times\n  greatest difference of the rotations {gap:.0e}, to those "
        f"that were meant {error:.0e}; {lost} rows not OK, first call {first:.1f} s"
    )


def proof(machine: pk.CasingOscillator, count: int) -> None:
    """A rigorous bound of the determinant over the workspace's box, and the least of random samples."""
    begin = time.perf_counter()
    found = prove_regular_workspace(machine)
    seconds = time.perf_counter() - begin
    ends = np.array([*BOX.values(), np.asarray(machine.free_range()[0])])
    s, roll, pitch, yaw, e = ends[:, :1] + np.diff(ends, axis=1) * np.random.default_rng(1).random((5, count))
    begin = time.perf_counter()
    poses = pk.AxisPose.from_angles(s, roll, pitch, yaw)
    joints = pk.inverse_kinematics(machine, poses, free=e).joints
    a = jax.vmap(lambda pose, q: pk.pose_jacobian(machine, pose, q))(poses, joints)
    unit = 4 * float(machine.base_radius) * float(machine.platform_radius) * e**2 * s**3
    least = float(np.min(np.abs(np.linalg.det(np.asarray(a))) / unit))
    sampled = time.perf_counter() - begin
    print(
        f"\n|det J_ex| / (4 E^2 R r s^3) over the box: proved > {found.regular.bound:.4f} "
        f"({found.regular.boxes:,} boxes), the box cannot be left: {found.confined.is_proved} "
        f"({found.confined.boxes:,} boxes); {seconds:.1f} s in all\n  least of {count:,} random samples "
        f"{least:.4f}, which proves nothing: {sampled:.1f} s"
    )


if __name__ == "__main__":
    main()
