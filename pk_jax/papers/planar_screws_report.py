"""The screw analysis of planar parallel robots as a folder of figures and a table of its singular poses."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from pk_jax.analysis.loci import singularity_locus
from pk_jax.analysis.singularity import SingularityKind, classify_singularity
from pk_jax.files.run_folder import run_folder
from pk_jax.kinematics.statics import screws
from pk_jax.mechanisms.catalogue import catalogued
from pk_jax.papers.planar_screws import Case, geometric_screws, singular_cases
from pk_jax.viz.singularity import draw_locus, singular_configurations

ROBOTS = ("5-link", "3-rrr", "4-rrr", "6-link")
HEADER = "figure,title,expected,found,sigma_inverse,sigma_direct,sigma_configuration,screws_differ"


def report_into(
    path: str | os.PathLike,
    *,
    say: Callable[[str], None] = lambda _: None,
    show: Callable[[str], Any] = print,
) -> bool:
    """Write singular.csv and the figures into a folder; whether every pose is what it was built to be."""
    with run_folder(path) as folder:
        say("singular configurations")
        cases = singular_cases()
        rows = [_judged(case) for case in cases]
        is_right = all(row[2] == row[3] for row in rows)
        folder.write_text("singular.csv", "\n".join([HEADER, *(",".join(map(str, row)) for row in rows), ""]))
        show(f"{'figure':8}{'pose':34}{'expected':21}{'found':21}{'sigma I':>9}{'sigma II':>10}  screws")
        for figure, title, expected, found, inverse, direct, _, off in rows:
            figure, title = figure or "-", title.replace(";", ",")
            show(f"{figure:8}{title:34}{expected:21}{found:21}{inverse:9.1e}{direct:10.1e}  {off:.0e}")
        folder.write_figure("singular_configurations.png", singular_configurations(cases))
        for name in ROBOTS:
            say(f"locus of the {name}")
            mech = catalogued(name)
            folder.write_figure(f"locus_{name}.png", draw_locus(mech, singularity_locus(mech)))
        say("locus of the 4-rrr over x, y, phi")
        mech = catalogued("4-rrr")
        folder.write_figure("locus_4-rrr_space.png", draw_locus(mech, singularity_locus(mech, "x,y,phi")))
        show(f"\ntable and figures: {folder.path}")
    return is_right


def _judged(case: Case) -> tuple[Any, ...]:
    """A row of the table; last, how far the constructed screws are from those of the residual."""
    found = classify_singularity(case.mechanism, case.pose, case.joints)
    drawn, derived = (f(case.mechanism, case.pose, case.joints) for f in (geometric_screws, screws))
    off = np.max(np.abs(np.asarray(drawn.lines) - np.asarray(derived.lines)))
    sigmas = [float(f"{float(value):.3g}") for value in found[1:4]]
    title = case.title.replace(",", ";")
    return (
        case.figure,
        title,
        case.kind.name,
        SingularityKind(int(found.kind)).name,
        *sigmas,
        float(f"{off:.1g}"),
    )
