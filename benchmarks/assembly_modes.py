"""All poses of a Stewart platform: homotopy against Newton from many starts, on one core; certificates.

    make bench        or        python -m benchmarks.assembly_modes [--quick]

One process pinned to one core, compile time apart. The peers start from random poses and cannot know when
they have found every mode: here they are told the number, and stop there or when 60 times our time is spent.
"""

from __future__ import annotations

import os
import sys
import time

if hasattr(os, "sched_setaffinity"):  # before XLA makes its threads
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import numpy as np
from scipy.optimize import root
from scipy.spatial.transform import Rotation

import pk_jax as pk
from pk_jax.mechanisms.catalogue import catalogued

DIETMAIER = np.array([1, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071])
PATIENCE = 60  # times our own time
TOGETHER = 1024  # starts of one batch


def main() -> None:
    pk.enable_x64()
    is_quick = "--quick" in sys.argv[1:]
    general(20 if is_quick else 200)
    against_many_starts(3 if is_quick else 10)
    layouts()
    certificates(2_000 if is_quick else 10_000)


def random_problem(rng: np.random.Generator) -> tuple[pk.Stewart, pk.SE3, np.ndarray]:
    stewart = pk.Stewart(base=rng.normal(size=(6, 3)), platform=0.6 * rng.normal(size=(6, 3)))
    pose = pk.SE3(rng.normal(size=3), Rotation.random(rng=rng).as_matrix())
    return stewart, pose, lengths_at(stewart, pose)


def lengths_at(stewart: pk.Stewart, pose: pk.SE3) -> np.ndarray:
    ends = np.asarray(stewart.platform) @ np.asarray(pose.rotation).T + np.asarray(pose.translation)
    return np.linalg.norm(ends - np.asarray(stewart.base), axis=1)


def timed(call):
    begin = time.perf_counter()
    found = call()
    return found, time.perf_counter() - begin


def general(count: int) -> None:
    rng = np.random.default_rng(0)
    stewart, _, lengths = random_problem(rng)
    _, first = timed(lambda: pk.assembly_modes(stewart, lengths))
    complete, own, retried, certified, again, seconds, real = 0, 0, 0, 0, [], [], []
    for _ in range(count):
        stewart, pose, lengths = random_problem(rng)
        modes, took = timed(lambda s=stewart, q=lengths: pk.assembly_modes(s, q))
        seconds.append(took)
        again.append(timed(lambda s=stewart, q=lengths: pk.assembly_modes(s, 1.001 * q))[1])
        complete += bool(modes.is_complete) and int(modes.expected) == 40
        off = np.abs(np.asarray(modes.poses.rotation) - np.asarray(pose.rotation)).max(axis=(1, 2))
        own += bool(np.nanmin(off) < 1e-8)
        retried += int(modes.retries) > 0
        certified += int(np.sum(modes.is_certified))
        real.append(int(modes.count))
    print(f"general platforms, {count} random ones; first call, with compiling, {first:.1f} s")
    print(f"  40 distinct solutions and complete {complete}, own pose among them {own}, retried {retried}")
    print(f"  real poses {sum(real)}, certified {certified}")
    print(f"  a new platform: median {np.median(seconds):.3f} s, slowest {np.max(seconds):.3f} s")
    print(f"  other lengths of one that was met: median {np.median(again):.3f} s")
    numbers, platforms = np.unique(real, return_counts=True)
    spread = ", ".join(f"{n}: {p}" for n, p in zip(numbers, platforms, strict=True))
    print(f"  platforms with so many real modes: {spread}")


def against_many_starts(count: int) -> None:
    """How many of the real modes others find, and in what time."""
    rng = np.random.default_rng(1)
    problems = [random_problem(rng)[::2] for _ in range(count)]
    named = [("random platforms", problems), ("Dietmaier's 40", [(catalogued("dietmaier-40"), DIETMAIER)])]
    for name, some in named:
        ours = [timed(lambda s=s, q=q: pk.assembly_modes(s, q)) for s, q in some]
        total = sum(int(modes.count) for modes, _ in ours)
        print(f"{name}: {total} real modes of {len(some)}; found, and the time of one platform")
        took = [took for _, took in ours]
        row = "  {:24} {:4d} of {}, {:9} median {:7.3f} s, slowest {:7.3f} s"
        print(row.format("pk.assembly_modes", total, total, "complete", np.median(took), max(took)))
        for peer in (scipy_root, newton_batches):
            peer(*some[0], 0.01, np.random.default_rng(0), 1)  # compiles
            found = [
                peer(s, q, PATIENCE * took, np.random.default_rng(2), int(modes.count))
                for (s, q), (modes, took) in zip(some, ours, strict=True)
            ]
            took = [took for _, took in found]
            each = sum(len(poses) for poses, _ in found), total, "not sure", np.median(took), max(took)
            print(row.format(peer.__doc__, *each))


def random_starts(stewart: pk.Stewart, lengths: np.ndarray, rng: np.random.Generator, count: int) -> pk.SE3:
    size = np.max(lengths) + float(stewart.length())
    return pk.SE3(rng.uniform(-size, size, (count, 3)), Rotation.random(count, rng=rng).as_matrix())


def scipy_root(stewart, lengths, seconds, rng, wanted):
    """scipy.optimize.root"""
    base, platform, found = np.asarray(stewart.base), np.asarray(stewart.platform), []

    def residual(x):
        ends = platform @ Rotation.from_rotvec(x[3:]).as_matrix().T + x[:3]
        return np.sum((ends - base) ** 2, axis=1) - lengths**2

    begin = time.perf_counter()
    while time.perf_counter() - begin < seconds and len(found) < wanted:
        start = random_starts(stewart, lengths, rng, 1)
        turn = Rotation.from_matrix(np.asarray(start.rotation)).as_rotvec()[0]
        x = root(residual, np.append(np.asarray(start.translation)[0], turn)).x
        if np.abs(residual(x)).max() < 1e-9:
            keep(found, x[:3], Rotation.from_rotvec(x[3:]).as_matrix())
    return found, time.perf_counter() - begin


def newton_batches(stewart, lengths, seconds, rng, wanted):
    """Newton on 1024 lanes"""
    found, begin = [], time.perf_counter()
    rows = np.broadcast_to(lengths, (TOGETHER, 6))
    while time.perf_counter() - begin < seconds and len(found) < wanted:
        starts = random_starts(stewart, lengths, rng, TOGETHER)
        solved = jax.device_get(pk.forward_kinematics(stewart, rows, starts))
        is_closed = np.isin(solved.status, [pk.Status.OK, pk.Status.OTHER_MODE])
        for k in np.flatnonzero(is_closed):
            keep(found, solved.candidate.translation[k], solved.candidate.rotation[k])
    return found, time.perf_counter() - begin


def keep(found: list, translation: np.ndarray, rotation: np.ndarray) -> None:
    """Add a pose that is not there yet."""
    here = np.append(translation, rotation)
    if not found or np.abs(np.stack(found) - here).max(axis=1).min() > 1e-4:
        found.append(here)


def layouts() -> None:
    print("finite solutions of known layouts")
    rng = np.random.default_rng(3)
    flat, pairs = np.array([1, 1, 0]), [0, 0, 1, 1, 2, 2]
    points = lambda n: rng.normal(size=(n, 3))
    semi_regular = catalogued("semi-regular-stewart")
    for name, stewart in (
        ("planar base and platform", pk.Stewart(base=flat * points(6), platform=0.6 * flat * points(6))),
        ("6-3", pk.Stewart(base=points(6), platform=0.6 * points(3)[pairs])),
        ("3-6", pk.Stewart(base=points(3)[pairs], platform=0.6 * points(6))),
        ("semi-regular", semi_regular),
    ):
        pose = pk.SE3.from_rotation_vector([0.1, 0.2, 1.0], [0.3, -0.2, 0.25])
        modes, took = timed(lambda s=stewart, p=pose: pk.assembly_modes(s, lengths_at(s, p)))
        print(
            f"  {name:26} {int(modes.expected):3d} finite, {int(modes.count):2d} real, "
            f"{'complete' if modes.is_complete else 'INCOMPLETE'}, {took:.3f} s"
        )


def certificates(count: int) -> None:
    stewart = catalogued("semi-regular-stewart")
    rng = np.random.default_rng(4)
    turns = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (count, 3))).as_matrix()
    poses = pk.SE3(rng.uniform(-0.3, 0.3, (count, 3)) + [0, 0, 1], turns)
    lengths = np.asarray(pk.inverse_kinematics(stewart, poses).joints)
    solved = pk.forward_kinematics(stewart, lengths)
    ok = np.asarray(solved.status) == pk.Status.OK
    regular = jax.tree.map(lambda leaf: np.asarray(leaf)[ok], solved.pose)
    pk.certify(stewart, regular[:1], lengths[ok][:1])
    found, took = timed(lambda: jax.device_get(pk.certify(stewart, regular, lengths[ok])))
    print(f"certificates of {ok.sum():,} poses in {took:.2f} s ({1e3 * took / ok.sum():.2f} ms a pose)")
    print(
        f"  certified {found.is_certified.sum():,}, radius median {np.nanmedian(found.radius):.1e}, greatest "
        f"{np.nanmax(found.radius):.1e}, unique within (median) {np.nanmedian(found.unique_within):.2g}"
    )


if __name__ == "__main__":
    main()
