"""The reproduction of Nam, Lee and Park 2006 as text, JSON, CSV and figures."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.workspace import workspace_indices
from pk_jax.design.objective import composite_index, index_vector
from pk_jax.design.variables import design_space
from pk_jax.files.run_folder import run_folder
from pk_jax.papers.nam2006 import Cell, Reproduction, reproduce
from pk_jax.papers.nam2006_printed import MISPRINTS, TABLES

SAY = Callable[[str], None]


def reproduce_into(path: str | os.PathLike, *, report: Any = None, say: SAY = lambda _: None) -> Reproduction:
    """Reproduce the paper and write tables.json, tables.csv and the figures into a folder.

    The folder is opened first, so that one that cannot be written costs no computing (OSError).
    report: progress callback of `reproduce`; say: called with what begins now
    """
    with run_folder(path) as folder:
        found = reproduce(report)
        say("figures")
        figures = dict(_figures(found))
        folder.write_text("tables.csv", as_csv(found.cells))
        for name, figure in figures.items():
            folder.write_figure(name, figure)
        folder.write_json("tables.json", as_json(found))
    return found


# --- text


def as_text(found: Reproduction) -> str:
    """Both tables, four numbers a cell, the misprints and the claims of the text."""
    lines = []
    for table in TABLES:
        lines += ["", f"Table {table.number}: {table.space.upper()} (lengths over R)", ""]
        lines.append(
            f"{'':16}{'':7}{'printed':>11}{'paper rule':>12}{'true':>12}{'our optimum':>13}  verdict"
        )
        previous = None
        for cell in (c for c in found.cells if c.table == table.number):
            row = cell.row if cell.row != previous else ""
            previous = cell.row
            numbers = f"{_round(cell.paper):>12}{_round(cell.true):>12}{_round(cell.optimum):>13}"
            verdict = (
                f"MISPRINT, read {cell.verdict.split(' for ')[1].split(';')[0]}"
                if cell.misprint
                else cell.verdict
            )
            lines.append(f"{row:16}{cell.column:7}{cell.printed:>11}{numbers}  {verdict}")
    lines += ["", "Misprints:"]
    for name in dict.fromkeys(cell.misprint for cell in found.cells if cell.misprint):
        cells = [cell for cell in found.cells if cell.misprint == name]
        why = next(m.why for m in MISPRINTS if m.name == name)
        lines.append(f"  {name} ({len(cells)} cell{'s' * (len(cells) > 1)}): {why}")
    differing = [cell for cell in found.cells if cell.verdict == "differs"]
    agreeing = sum(cell.verdict == "agrees" for cell in found.cells)
    misprinted = len(found.cells) - agreeing - len(differing)
    lines += ["", "Claims of the text:"]
    lines += [f"  {'holds' if c.holds else 'FALSE':6} {c.text}: {c.found}" for c in found.claims]
    lines += ["", "Our optima (true integrals; multipliers of the active constraints):"]
    for space, results in found.optima.items():
        for weights, r in results.items():
            at = ", ".join(
                f"{name} {value:.8f}"
                for name, value in zip(design_space(space).variables, r.vector, strict=True)
            )
            active = "; ".join(f"{name}: {r.multipliers[name]:.8f}" for name in r.active) or "none active"
            lines.append(
                f"  {space} w = {weights}: {at}  objective {r.objective:.9f}  [{active}]  "
                f"KKT {r.kkt:.0e}  {r.status.name}"
            )
    lines += [
        "",
        f"{agreeing} of {len(found.cells)} cells agree with the paper's rule to 1e-5 or to the printed "
        f"digit, {misprinted} are misprinted, {len(differing)} differ.",
    ]
    return "\n".join(lines[1:])


def _round(value: float) -> str:
    return f"{value + 0.0:.6f}".replace("-0.000000", "0.000000")


# --- files


def as_csv(cells: list[Cell]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Cell._fields)
    writer.writerows(cells)
    return text.getvalue()


def as_json(found: Reproduction) -> dict[str, Any]:
    """Everything that was computed, in plain types."""
    return {
        "source": "Nam, Lee and Park 2006, Trans. KSME A 30(11), Tables 1 and 2",
        "units": "lengths over R",
        "versions": {name: version(name) for name in ("pk_jax", "jax", "optax", "numpy")},
        "cells": [cell._asdict() for cell in found.cells],
        "claims": [claim._asdict() | {"holds": bool(claim.holds)} for claim in found.claims],
        "optima": [
            {
                "space": space,
                "weights": list(weights),
                "design": dict(zip(design_space(space).variables, map(float, r.vector), strict=True)),
                "indices": dict(zip(("gii", "gri", "sui"), map(float, index_vector(r.indices)), strict=True)),
                "objective": r.objective,
                "cpi": r.cpi,
                "bounds": {side: [float(x) for x in bound] for side, bound in r.bounds._asdict().items()},
                "active": r.multipliers,
                "kkt": r.kkt,
                "evaluations": r.evaluations,
                "evaluations_in_all": r.evaluations_in_all,
                "status": r.status.name,
            }
            for space, results in found.optima.items()
            for weights, r in results.items()
        ],
    }


def _figures(found: Reproduction):
    """Yield (file name, figure) for Figs. 1 to 7."""
    from pk_jax.viz import two_dof

    first, second = (results[1, 1, 1] for results in found.optima.values())
    yield "fig1_mechanisms.png", two_dof.mechanism_figure()
    yield "fig2_joint_space.png", two_dof.joint_space_figure()

    l_min = np.linspace(1, 3, 201)
    curve = _cpi("2-rpr", l_min[:, None], first)
    yield "fig3a_cpi_2rpr.png", two_dof.cpi_curve(l_min, curve, (*first.vector, first.cpi)).figure
    fraction, l_min = np.meshgrid(np.linspace(0, 1, 31), np.linspace(1, 5, 81))
    v = fraction * np.sqrt((l_min - 1) / 2)
    surface = _cpi("2-rrr", np.stack([l_min.ravel(), v.ravel()], axis=1), second).reshape(v.shape)
    best = (float(second.vector[0]), float(second.mechanism.proximal), second.cpi)
    yield "fig3b_cpi_2rrr.png", two_dof.cpi_surface(l_min, 1 + v**2, surface, best).figure

    for letter, result in (("2rpr", first), ("2rrr", second)):
        mech = result.mechanism
        yield (
            f"fig{4 if letter == '2rpr' else 5}_local_indices_{letter}.png",
            two_dof.local_index_figure(mech),
        )
        yield f"fig6_workspace_{letter}.png", two_dof.panoramic_figure(mech)
        yield f"fig7_actuators_{letter}.png", two_dof.actuator_figure(mech)


def _cpi(name: str, vectors: np.ndarray, optimum) -> np.ndarray:
    """True composite index of many designs. vectors (batch, n) -> (batch,)"""
    space, nodes = design_space(name), (10, 10)  # to 1e-6: enough for a picture
    index = lambda vector: index_vector(workspace_indices(space.mechanism(vector), nodes=nodes))
    indices = jax.jit(jax.vmap(index))(jnp.asarray(vectors))
    return np.asarray(composite_index(indices, optimum.bounds))
