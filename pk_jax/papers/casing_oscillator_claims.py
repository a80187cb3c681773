"""What the paper on the casing oscillator claims, judged by computing it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.singularity import singularity_distance
from pk_jax.analysis.workspace_map import travel
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.kinematics.inverse import inverse_kinematics
from pk_jax.mechanisms.casing_oscillator import LEGS, CasingOscillator
from pk_jax.papers.casing_oscillator import (
    BODIES,
    DEG,
    JOINTS,
    PASSIVE,
    Proof,
    largest_misprint,
    mobility,
    singular_pitch,
    singular_roll,
    statics_matrix,
)

SLIDES = (0.43, 0.48, 0.53)  # m, casing lengths to compare


class Claim(NamedTuple):
    """What the paper says, what is found, and whether that agrees."""

    where: str
    said: str
    found: str
    verdict: str  # "holds", "holds in part", "does not hold"; "open" where a proof failed


def claims(mech: CasingOscillator, proof: Proof) -> list[Claim]:
    """The paper's claims on mobility, workspace and singularities, judged."""
    return [*_of_motion(mech), *_of_workspace(mech), *_of_singularities(mech, proof)]


def _judged(where: str, said: str, found: str, *parts: Any) -> Claim:
    """A claim with the parts of it that hold."""
    right = [bool(part) for part in parts]
    verdict = "holds" if all(right) else "holds in part" if any(right) else "does not hold"
    return Claim(where, said, found, verdict)


def _of_motion(mech: CasingOscillator) -> list[Claim]:
    freedoms = mobility(BODIES, JOINTS, PASSIVE)
    misprint = largest_misprint(mech, AxisPose.from_angles(mech.neutral[0], 15 * DEG))
    return [
        _judged("eq. (9)", "4 degrees of freedom", f"{freedoms}", freedoms == 4),
        _judged(
            "eqs. (16)-(18)",
            "leg rates of z' and w in base axes",
            f"exact for an upright casing; at a roll of 15 deg rates of the slide are {misprint:.0%} off",
            largest_misprint(mech, AxisPose.from_angles(mech.neutral[0], 0, 0, 0.2)) < 1e-12,
            misprint < 0.01,
        ),
    ]


def _of_workspace(mech: CasingOscillator) -> list[Claim]:
    at = AxisPose.from_angles(jnp.asarray(SLIDES))
    neutral = float(mech.neutral[0])
    across = lambda s, ends: 1e3 * s * (np.sin(ends.upper) - np.sin(ends.lower))
    pitch, roll = (across(np.array(SLIDES), travel(mech, name, at=at)) for name in ("pitch", "roll"))
    cones = travel(CasingOscillator(stroke=[[1e-3, 10.0]] * 5), "roll")  # nothing but the cones
    whole = {}
    for name in ("roll", "pitch", "yaw"):
        ends = travel(mech, name)
        whole[name] = float(ends.upper - ends.lower) / DEG
    slides = ", ".join(f"{1e3 * s:.0f}" for s in SLIDES)
    return [
        _judged(
            "sec. 4, Fig. 3",
            "travel by pitch about 100 mm, whatever s",
            f"{', '.join(f'{v:.1f}' for v in pitch)} mm at s = {slides} mm",
            np.all(np.abs(pitch - 100) < 5),
        ),
        _judged(
            "sec. 4, Fig. 3",
            "travel by roll about 300 mm at the neutral s, less beside it",
            f"{', '.join(f'{v:.1f}' for v in roll)} mm at s = {slides} mm; with cones and no strokes "
            f"{float(across(neutral, cones)):.1f} mm, +-{float(cones.upper) / DEG:.2f} deg",
            abs(roll[1] - 300) < 15,
            roll[1] > max(roll[0], roll[2]),
        ),
        _judged(
            "sec. 4, Fig. 4",
            "near neutral 20-25 deg of roll, about 20 deg of yaw",
            f"{whole['roll']:.2f} and {whole['yaw']:.2f} deg in all",
            20 <= whole["roll"] <= 25,
            abs(whole["yaw"] - 20) < 2,
        ),
        _judged(
            "sec. 4, Fig. 5",
            "10-15 deg of pitch, 20-25 deg of yaw",
            f"{whole['pitch']:.2f} and {whole['yaw']:.2f} deg in all",
            10 <= whole["pitch"] <= 15,
            20 <= whole["yaw"] <= 25,
        ),
    ]


def _of_singularities(mech: CasingOscillator, proof: Proof) -> list[Claim]:
    s = float(mech.neutral[0])
    pitch, roll = singular_pitch(mech, s), singular_roll(mech, s)
    distance = lambda *angles: _distance(mech, AxisPose.from_angles(s, *angles))
    loci = np.array([[singular_roll(mech, s), singular_pitch(mech, s)] for s in (0.42, 0.52)]) / DEG
    turned = 30 * DEG
    moments = statics_matrix(mech, *mech.home())[1:]
    safe = f"proved: |det J_ex| / (4 E^2 R r s^3) > {proof.regular.bound:.3f} wherever the strokes allow"
    last = _judged("secs. 6, 8, 9", "no singularity in the workspace", safe, True)
    if not proof.is_proved:
        last = last._replace(found="not proved", verdict="open")
    return [
        _judged(
            "sec. 6, Figs. 6-7",
            "singular at roll +-90 and pitch +-75 deg",
            f"roll +-{roll / DEG:.3f}; pitch +-90, {pitch / DEG:.3f} and {pitch / DEG - 180:.3f} deg "
            "(the two angles fit if they are exchanged; the third is missing)",
            distance(90 * DEG) < 1e-3,
            distance(0, 75 * DEG) < 1e-3,
        ),
        _judged(
            "sec. 6",
            "singular angles hardly depend on yaw",
            f"pitch not at all; roll does (sigma at a yaw of 30 deg: {distance(roll, 0, turned):.2f})",
            distance(0, pitch, turned) < 1e-12,
            distance(roll, 0, turned) < 1e-3,
        ),
        _judged(
            "sec. 6",
            "loci nearly unchanged for s = 420..520 mm",
            f"roll {loci[0, 0]:.1f} to {loci[1, 0]:.1f}, pitch {loci[0, 1]:.1f} to {loci[1, 1]:.1f} deg",
            np.all(np.ptp(loci, axis=0) < 1),
        ),
        _judged(
            "sec. 8",
            "singular where eq. (29) or eq. (32) holds",
            "eq. (29), three equations for four forces, has solutions at every pose; singular is where "
            "one of them solves eq. (32), too",
            jnp.linalg.matrix_rank(moments) == LEGS,
        ),
        last,
    ]


def _distance(mech: CasingOscillator, pose: AxisPose) -> float:
    joints = inverse_kinematics(mech, pose).candidate
    return float(singularity_distance(mech, pose, joints, kind="II"))
