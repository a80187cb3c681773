"""What `check` finds out of a file, as text: that its mechanism is sound, or that its run can be run."""

from __future__ import annotations

import os

import numpy as np

from pk_jax.design.evaluate import evaluate_designs
from pk_jax.files.named import Named
from pk_jax.files.run_file import RunFile
from pk_jax.files.toml_values import told_of
from pk_jax.geometry.poses import tangent_size
from pk_jax.kinematics.batching import equations, home_shapes
from pk_jax.kinematics.laws import check_mechanism
from pk_jax.status import Status


def mechanism_text(named: Named) -> str:
    """Family, unit and size, and every law with its error and what is allowed. ValueError: one is broken."""
    mech, unit = named.mechanism, "" if named.unit == "1" else f" {named.unit}"
    size = float(mech.length()) / named.metres
    with told_of(named.name):
        laws = check_mechanism(mech)
    pose, joints = home_shapes(mech)
    return "\n".join(
        [
            f"{named.name}: sound, all {len(laws)} laws hold",
            f"family {type(mech).__name__}, unit {named.unit}, size {size:.6g}{unit}",
            f"freedoms {tangent_size(pose)}, joints {joints.shape[0]}, closure equations {equations(mech)}",
            f"\n{'law':58} {'error':>9}    allowed",
            str(laws),
        ]
    )


def run_text(path: str | os.PathLike, run: RunFile) -> str:
    """What is searched and how, and the design in the middle of the bounds."""
    problem, goal, search = run.problem, run.settings["objective"], run.settings["search"]
    bounds = zip(problem.entries, problem.lower, problem.upper, strict=True)
    with told_of(path):
        middle = evaluate_designs(problem, (problem.lower + problem.upper)[None] / 2, slopes=False)
    value, slacks = float(np.min(middle.objective)), middle.constraints[0]
    least = f", least slack {np.min(slacks):.6g}" if len(slacks) else ""
    return "\n".join(
        [
            f"{path}: fine, can be run",
            f"problem      {problem.name}: {goal['measure']} {goal['index']} over the {goal['over']}",
            *(f"variable     {name} in {lower:.6g} .. {upper:.6g}" for name, lower, upper in bounds),
            f"constraints  {len(slacks)}",
            f"search       {search['starts']} starts, {search['steps']} steps each, seed {search['seed']}",
            f"middle       {Status(int(middle.status[0])).name}, objective {value:.6g}{least}",
        ]
    )
