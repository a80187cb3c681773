"""The result of a design run as files: the mechanism, every start, the history, and all of it in one."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from typing import Any

import numpy as np

from pk_jax.design.optimum import OptimizedDesign
from pk_jax.design.search import Search
from pk_jax.files.mechanism_file import save_mechanism
from pk_jax.files.rows_file import format_rows
from pk_jax.files.run_file import RunFile
from pk_jax.files.run_folder import RunFolder

RESULT = "result.json"
HISTORY = ("steps", "best", "violation", "feasible", "finished", "evaluations")

Draw = Callable[[RunFolder, OptimizedDesign, np.ndarray], None]  # figures of a result and its history


def history_row(search: Search, steps: int) -> np.ndarray:
    """Of all starts after so many steps; best -inf where none is feasible. -> (columns,) of `HISTORY`"""
    is_feasible = search.violation <= search.tolerance
    best = np.max(search.value, where=is_feasible, initial=-np.inf)
    violation = np.min(search.violation, initial=np.inf)
    counts = is_feasible.sum(), np.sum(search.is_done), np.sum(search.evaluations)
    return np.array([steps, best, violation, *counts], float)


def write_results(
    folder: RunFolder,
    run: RunFile,
    design: OptimizedDesign,
    search: Search,
    history: np.ndarray,
    draw: Draw | None = None,
) -> None:
    """All files of a result, the one that says that it is finished last."""
    if np.isfinite(design.value):
        save_mechanism(design.mechanism, folder.path / "result.toml", unit=run.settings["unit"])
    folder.write_text("starts.csv", starts_csv(run, design, search))
    folder.write_text("history.csv", history_csv(history))
    if draw is not None:
        draw(folder, design, history)
    folder.write_json(RESULT, as_json(run, design, history))


def result_text(run: RunFile, design: OptimizedDesign) -> str:
    """The best design, what holds it, and how the starts ended."""
    goal = run.settings["objective"]
    feasible = int(np.isfinite(design.values).sum())
    lines = [f"{run.problem.name}: {goal['measure']} {goal['index']} over the {goal['over']}"]
    for name, value in zip(run.problem.entries, design.vector, strict=True):
        lines.append(f"{name:22}{value:.9g}")
    lines.append(f"value      {design.value:.9g}")
    for name in design.active:
        lines.append(f"active     {name}, multiplier {design.multipliers[name]:.9g}")
    lines += [
        f"kkt        {design.kkt:.1e}",
        f"violation  {design.violation:.1e}",
        f"starts     {len(design.values)}, {feasible} feasible",
        f"evaluations of value and gradient: {design.evaluations}",
        f"status     {design.status.name}",
    ]
    return "\n".join(lines)


def history_csv(history: np.ndarray) -> str:
    """Of all starts together, after every chunk. -inf: no start is feasible yet."""
    columns = [_column(name, values) for name, values in zip(HISTORY, history.T, strict=True)]
    return ",".join(HISTORY) + "\n" + format_rows(columns)


def _column(name: str, values: np.ndarray) -> np.ndarray:
    return values if name in ("best", "violation") else values.astype(int)


def starts_csv(run: RunFile, design: OptimizedDesign, search: Search) -> str:
    """Where every start ended; value NaN where no design was feasible."""
    header = io.StringIO()
    names = ("start", "value", "violation", "evaluations", "finished", "solved", *run.problem.entries)
    csv.writer(header, lineterminator="\n").writerow(names)
    columns = [
        np.arange(1, len(design.values) + 1),
        design.values,
        search.violation,
        search.evaluations,
        search.is_done.astype(int),
        search.is_solved.astype(int),
        *design.vectors.T,
    ]
    return header.getvalue() + format_rows(columns)


def as_json(run: RunFile, design: OptimizedDesign, history: np.ndarray) -> dict[str, Any]:
    """Everything that was found, in plain types; null where it is not finite."""
    return {
        "config": run.digest,
        "mechanism": run.settings["mechanism"],
        "status": design.status.name,
        "value": _plain(design.value),
        "variables": _plain(design.variables),
        "active": list(design.active),
        "multipliers": _plain(design.multipliers),
        "kkt": _plain(design.kkt),
        "violation": _plain(design.violation),
        "evaluations": int(design.evaluations),
        "starts": len(design.values),
        "feasible_starts": int(np.isfinite(design.values).sum()),
        "steps": int(history[-1, 0]),
        "objective": _plain(design.objective),
        "constraints": _plain(design.constraints),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    if isinstance(value, float | int):
        return float(value) if np.isfinite(value) else None
    return _plain(np.asarray(value, float).tolist())
