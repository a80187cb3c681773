"""The nine-length platform of Ryu et al., KR 10-2000-0073215, put to the test.

The patent prints neither a geometry nor a number: what it claims, a pose without iterations from nine
lengths, is tried on random layouts of both embodiments, and its loop (Fig. 4) in a fair experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.sensors import noise_gains
from pk_jax.control.loop import FEEDBACKS, Simulation, simulate_control
from pk_jax.control.plant import IDEAL, Plant
from pk_jax.control.reference import circle_reference, step_reference
from pk_jax.geometry import rotations
from pk_jax.geometry.se3 import SE3
from pk_jax.kinematics.linear_stage import frame_of, matrix_of
from pk_jax.kinematics.nine_lengths import nine_length_pose
from pk_jax.mechanisms.catalogue import catalogued
from pk_jax.mechanisms.stewart import LEGS, Stewart
from pk_jax.status import Status

EMBODIMENTS = (2, 1)
EDGES = np.array([(0, 2), (0, 1), (1, 0), (1, 2), (2, 1), (2, 0)])  # of the joints B_i, Fig. 2
MOST_CONDITION = 1e4
NOISES = (1e-6, 1e-5, 1e-4, 1e-3)  # m
GROSS = 8  # standard deviations
RIGHT = 1e-9  # of the size

Say = Callable[[str, int, int], None]


def random_layout(rng: np.random.Generator, embodiment: int) -> Stewart:
    """Base joints within +-1 m, platform joints on the edges of a triangle; condition at most 1e4."""
    while True:
        base = rng.uniform(-1, 1, (9, 3))
        base[:LEGS, 2] = 0.3 * base[:LEGS, 2] if embodiment == 1 else 0
        base[LEGS:, 2] = 0
        side, k = rng.uniform(0.6, 1.2), rng.uniform(0.6, 0.95)
        turns = np.deg2rad([90, 210, 330])
        corners = side / np.sqrt(3) * np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)
        platform = np.concatenate([k * corners[EDGES[:, 0]] + (1 - k) * corners[EDGES[:, 1]], corners])
        if condition(base, platform) <= MOST_CONDITION:
            return Stewart(base=base, platform=platform)


def random_poses(rng: np.random.Generator, count: int) -> SE3:
    """Tilted up to 40 degrees about any horizontal axis, any yaw, 0.7 to 1.3 m above the base."""
    turn = np.stack([rng.uniform(0, 2 * np.pi, count), rng.uniform(0, np.deg2rad(40), count)], axis=1)
    yaw = rng.uniform(-np.pi, np.pi, count)
    at = np.concatenate([rng.uniform(-0.3, 0.3, (count, 2)), rng.uniform(0.7, 1.3, (count, 1))], axis=1)
    return SE3(at, _turned(*turn.T, yaw))


@jax.jit
@jax.vmap
def _turned(way, tilt, yaw):
    leaning = tilt * jnp.stack([jnp.cos(way), jnp.sin(way), 0 * way])
    return rotations.from_rotation_vector(leaning) @ rotations.about(2, yaw)


@jax.jit
def singular_values(base: jax.Array, platform: jax.Array) -> jax.Array:
    """Of the linear stage of any joints (9, 3), also of those that make no platform. -> (6,)"""
    matrix = matrix_of(base, frame_of(platform).coordinates)
    return jnp.linalg.svd(matrix.reshape(LEGS, 9), compute_uv=False)


def condition(base: np.ndarray, platform: np.ndarray) -> float:
    values = singular_values(base, platform)
    return float(values[0] / values[-1])


def pose_errors(found: SE3, true: SE3) -> np.ndarray:
    """Greatest entry of the difference of position and of rotation. -> (n,)"""
    off = np.abs(np.asarray(found.translation - true.translation)).max(axis=1)
    turned = np.abs(np.asarray(found.rotation - true.rotation)).max(axis=(1, 2))
    return np.maximum(off, turned)


def _distance(found: SE3, true: SE3) -> np.ndarray:
    return np.linalg.norm(found.translation - true.translation, axis=1)


class Exact(NamedTuple):
    embodiment: int
    geometries: int
    poses: int
    right: int  # poses within RIGHT of the truth
    worst: float  # error after the estimate
    worst_closed: float  # of the closed form alone


def exact_lengths(embodiment: int, geometries: int, poses: int, say: Say) -> Exact:
    """Every layout without an initial guess, from its own lengths."""
    rng = np.random.default_rng(10 * embodiment)
    errors, closed = [], []
    for done in range(1, geometries + 1):
        mech, true = random_layout(rng, embodiment), random_poses(rng, poses)
        found = nine_length_pose(mech, lengths_of(mech, true))
        errors.append(pose_errors(found.pose, true))
        closed.append(pose_errors(found.closed_form, true))
        say(f"exact lengths, embodiment {embodiment}", done, geometries)
    errors = np.concatenate(errors)
    right = int(np.sum(errors <= RIGHT))
    return Exact(embodiment, geometries, errors.size, right, float(np.max(errors)), float(np.max(closed)))


class Noisy(NamedTuple):
    embodiment: int
    noise: float  # m
    rows: int
    not_ok: int
    gross: int  # poses off by more than GROSS of their own standard deviations
    median: float  # |dt| over the noise: the estimate
    median_closed: float  # the closed form alone
    median_legs: float  # six legs, by their Jacobian


def noisy_lengths(embodiment: int, layouts: int, seeds: int, say: Say) -> Iterator[Noisy]:
    """Noise of every size on random layouts: wrong roots, and what reaches the pose."""
    rng = np.random.default_rng(10 * embodiment + 1)
    machines = [random_layout(rng, embodiment) for _ in range(layouts)]
    for cell, noise in enumerate(NOISES):
        off, closed, legs, gross, not_ok = [], [], [], 0, 0
        for done, mech in enumerate(machines, 1):
            true = random_poses(rng, seeds)
            error = rng.standard_normal((seeds, 9))
            found = nine_length_pose(mech, lengths_of(mech, true) + noise * error)
            spread = noise * np.sqrt(np.diagonal(np.asarray(found.covariance), axis1=1, axis2=2))
            gross += int(np.sum(~(pose_errors(found.pose, true) <= GROSS * spread.max(axis=1))))
            not_ok += int(np.sum(np.asarray(found.status) != Status.OK))
            off.append(_distance(found.pose, true) / noise)
            closed.append(_distance(found.closed_form, true) / noise)
            legs.append(np.asarray(noise_gains(mech, true).legs.position))
            say(f"noise, embodiment {embodiment}", cell * layouts + done, len(NOISES) * layouts)
        medians = (float(np.median(np.concatenate(each))) for each in (off, closed, legs))
        yield Noisy(embodiment, noise, layouts * seeds, not_ok, gross, *medians)


def lengths_of(mech: Stewart, poses: SE3) -> np.ndarray:
    """Of all rows at a batch of poses. -> (n, k)"""
    points = np.einsum("nij,kj->nki", poses.rotation, mech.platform) + np.asarray(poses.translation)[:, None]
    return np.linalg.norm(points - np.asarray(mech.base), axis=-1)


class Gains(NamedTuple):
    """Medians of RMS position error over that of the lengths, by the derivatives of the pose."""

    embodiment: int
    estimate: float
    closed_form: float
    legs: float


def gains_of(embodiment: int, layouts: int = 200) -> Gains:
    rng = np.random.default_rng(10 * embodiment + 2)
    found = [noise_gains(random_layout(rng, embodiment), random_poses(rng, 5)) for _ in range(layouts)]
    median = lambda name: float(np.median([np.asarray(getattr(each, name).position) for each in found]))
    return Gains(embodiment, median("estimate"), median("closed_form"), median("legs"))


def singular_layouts() -> dict[str, tuple[int, np.ndarray, np.ndarray]]:
    """Layouts whose linear stage is singular in every pose: expected rank, base and platform (9, 3)."""
    ring = lambda radius, degrees: (
        radius
        * np.stack(
            [np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)), 0 * np.asarray(degrees, float)], axis=1
        )
    )
    sixths, corners = 60.0 * np.arange(6), ring(0.5, [90, 210, 330])
    hexagons = np.concatenate([ring(1.0, sixths), ring(0.7, [100, 240, 350])])
    top = np.concatenate([ring(0.5, sixths), corners])
    rng = np.random.default_rng(5)
    any_platform = np.concatenate([rng.uniform(-0.5, 0.5, (9, 2)), np.zeros((9, 1))], axis=1)
    stretched = any_platform @ np.array([[1.7, 0.4, 0], [-0.3, 1.2, 0], [0, 0, 1]]) + [0.1, 0.2, 0]
    feet = ring(1.0, [42, 138, 162, 258, 282, 18])
    pairs = feet.reshape(3, 2, 3)
    between = pairs[:, 0] + np.array([[0.3], [0.5], [0.6]]) * (pairs[:, 1] - pairs[:, 0])
    return {
        "two regular hexagons": (5, hexagons, top),
        "base an affine copy of the platform, sensors included": (3, stretched, any_platform),
        "6-3, sensors on the lines through the feet of the pairs": (
            3,
            np.concatenate([feet, between]),
            np.concatenate([np.repeat(corners, 2, axis=0), corners]),
        ),
    }


PLANTS = {
    "ideal": IDEAL,
    "noise 10 um, steps 1 um": Plant(),
    "and encoder bias 100 um": Plant(encoder_bias=1e-4),
    "and A, B off by 200 um": Plant(geometry_error=2e-4),
    "and both": Plant(encoder_bias=1e-4, geometry_error=2e-4),
}
STEP = (0.03, -0.02, 0.02, 0.05, 0.0, 0.05)  # m, rad


def circle_runs(seeds: int, say: Say) -> dict[str, dict[str, Simulation]]:
    """The circle with every plant and every feedback, the same seeds for all."""
    mech, key = catalogued("nine-lengths"), jax.random.key(0)
    reference = circle_reference(mech, radius=0.1)
    found: dict[str, dict[str, Simulation]] = {}
    for name, plant in PLANTS.items():
        found[name] = {}
        for feedback in FEEDBACKS:
            found[name][feedback] = simulate_control(
                mech, reference, feedback, key=key, plant=plant, seeds=seeds
            )
            say("circle", sum(map(len, found.values())), len(PLANTS) * len(FEEDBACKS))
    return found


def step_runs(seeds: int) -> dict[str, Simulation]:
    """The step, with noise, by every feedback."""
    mech = catalogued("nine-lengths")
    reference = step_reference(mech, STEP, duration=3.0)  # as many samples as the circle: one program
    return {
        feedback: simulate_control(mech, reference, feedback, key=jax.random.key(1), seeds=seeds)
        for feedback in FEEDBACKS
    }


def rms(values: jax.Array) -> float:
    """Root mean square over the seeds."""
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))
