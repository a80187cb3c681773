"""The singularity analysis of the casing oscillator as a folder of tables, figures and a proof."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.loci import singularity_locus
from pk_jax.analysis.singularity import SingularityKind, classify_singularity
from pk_jax.analysis.workspace_map import travel, workspace_map
from pk_jax.files.run_folder import run_folder
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.mechanisms.casing_oscillator import CasingOscillator
from pk_jax.papers.casing_oscillator import (
    DEG,
    Case,
    as_dict,
    determinants,
    prove_regular_workspace,
    singular_cases,
)
from pk_jax.papers.casing_oscillator_claims import claims
from pk_jax.viz import casing_oscillator as viz
from pk_jax.viz.singularity import draw_locus, singular_configurations
from pk_jax.viz.style import GREEN
from pk_jax.viz.workspace_map import draw_boundary

SLIDES = (0.43, 0.455, 0.48, 0.505, 0.53)  # m
WIDE = 20 * DEG
CLAIMED = {"pitch": 100.0, "roll": 300.0}  # mm


def report_into(
    path: str | os.PathLike,
    *,
    report: Callable[..., None] | None = None,
    say: Callable[[str], None] = lambda _: None,
    show: Callable[[str], Any] = print,
) -> bool:
    """Write tables, proof and figures; whether the proof is one and all poses are what they should be."""
    mech = CasingOscillator()
    with run_folder(path) as folder:
        proof = prove_regular_workspace(mech, report)
        folder.write_json(
            "proof.json", {"regular": as_dict(proof.regular), "confined": as_dict(proof.confined)}
        )
        say("claims")
        found = claims(mech, proof)
        folder.write_json("claims.json", [each._asdict() for each in found])
        for each in found:
            show(f"{each.where:18} {each.said}\n{'':18} {each.verdict.upper()}: {each.found}")
        say("singular configurations")
        cases = singular_cases(mech)
        rows = [_judged(case) for case in cases]
        titles = f"{'numerical':>15}{'geometric':>15}{'closed form':>15}"
        show(f"\n{'pose':28}{'found':12}{'sigma II':>9}{titles}  (det over that at neutral)")
        for title, kind, _, sigma, *dets in rows:
            show(f"{title:28}{kind:12}{sigma:9.1e}{dets[0]:15.6e}{dets[1]:15.6e}{dets[2]:15.6e}")
        _show_proof(proof, show)
        header = "title,found,expected,sigma_direct,det_numerical,det_geometric,det_closed"
        folder.write_text("singular.csv", "\n".join([header, *(",".join(map(str, row)) for row in rows), ""]))

        say("figures")
        folder.write_figure("fig2_model.png", viz.model(mech, *mech.home()).figure)
        folder.write_figure("fig3_travel.png", _travels(mech))
        for number, other in ((4, "roll"), (5, "pitch")):
            folder.write_figure(f"fig{number}_{other}_yaw.png", _orientations(mech, other))
        for number, other in ((6, "roll"), (7, "pitch")):
            say(f"locus over {other} and yaw")
            folder.write_figure(f"fig{number}_locus_{other}_yaw.png", _locus(mech, other))
        folder.write_figure("fig8_fig9_singular.png", singular_configurations(cases, 3))
        show(f"\ntables and figures: {folder.path}")
    return proof.is_proved and all(kind == expected for _, kind, expected, *_ in rows)


def _judged(case: Case) -> tuple[Any, ...]:
    """Title, kind found and expected, distance, and the determinants by three ways over those at home."""
    found = classify_singularity(case.mechanism, case.pose, case.joints)
    here, home = (
        determinants(case.mechanism, *at) for at in ((case.pose, case.joints), case.mechanism.home())
    )
    dets = [float(f"{float(a / b):.6g}") for a, b in zip(here, home, strict=True)]
    kind = SingularityKind(int(found.kind)).name
    return case.title, kind, case.kind.name, float(f"{float(found.sigma_direct):.3g}"), *dets


def _show_proof(proof: Any, show: Callable[[str], Any]) -> None:
    box = zip(proof.regular.names, proof.regular.lower, proof.regular.upper, strict=True)
    lengths = ("s", "E")
    spans = [
        f"{name} {low * 1e3:.1f}..{high * 1e3:.1f} mm"
        if name in lengths
        else f"{name} {low / DEG:.1f}..{high / DEG:.1f} deg"
        for name, low, high in box
    ]
    show(f"\nproof, by intervals with outward rounding, over {', '.join(spans)}")
    regular, confined = proof
    show(f"  |det J_ex| / (4 E^2 R r s^3) > {regular.bound:.6g}: {regular.is_proved}, {regular.boxes} boxes")
    show(
        "  the strokes do not let the machine out of it, from the neutral pose: "
        f"{confined.is_proved}, {confined.boxes} boxes"
    )


def _travels(mech: CasingOscillator) -> Any:
    slides = np.linspace(0.4176, 0.5424, 61)
    at = AxisPose.from_angles(jnp.asarray(slides))
    spans = {
        name: tuple(travel(mech, name, at=at, free=free, steps=128) for free in (None, "any"))
        for name in ("pitch", "roll")
    }
    return viz.positional_workspace(slides, spans, CLAIMED)


def _locus(mech: CasingOscillator, other: str) -> Any:
    """The singularities and, small in the middle, what the strokes and cones let the machine reach."""
    figure = draw_locus(mech, singularity_locus(mech, f"{other},yaw"))
    found = workspace_map(mech, (other, "yaw"), ranges=[(-WIDE, WIDE)] * 2, free="any")
    draw_boundary(found, figure.axes[0], color=GREEN, linewidth=2.0)
    return figure


def _orientations(mech: CasingOscillator, other: str) -> Any:
    maps = []
    for s in SLIDES:
        at = AxisPose(jnp.asarray(s), jnp.eye(3))
        maps.append(workspace_map(mech, (other, "yaw"), at=at, ranges=[(-WIDE, WIDE)] * 2, nodes=301))
    return viz.orientation_workspace(maps, SLIDES, len(SLIDES) // 2)
