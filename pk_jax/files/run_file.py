"""Design runs as TOML files: a family, its variables, an objective, constraints and the search.

    mechanism = "five-bar"

    [variables]                # bounds; default: all variables of the family
    proximal = [0.5, 2.0]
    distal = [0.5, 2.5]

    [fixed]                    # other parameters; default: those of the family
    half_base = 0.3

    [objective]
    index = "isotropy"
    over = "rectangle"         # of poses, from lower to upper; or "workspace", see below
    measure = "least"          # or "mean"
    lower = [-0.5, 0.8]
    upper = [0.5, 1.6]
    nodes = [5, 5]
    mode = "+-"                # working mode; default: the mechanism's own
    length = 0.3               # what lengths are measured in; default: the mechanism's own

    [constraints]              # at every pose of the rectangle
    margins = true             # within the limits of the joints
    clearance = 0.1            # an index by its name: at least so much

    [search]
    starts = 64
    steps = 300                # evaluations of value and gradient a start
    seed = 0
    tolerance = 1e-8           # see `pk_jax.design.search.begin`

Over the workspace the measure is "mean", "integral" or "volume", and the options are those of
`workspace_integral`, which for more than two freedoms takes rays unless the rule is named:

    [objective]
    index = "frobenius_isotropy"
    over = "workspace"
    measure = "integral"
    rays = 64                  # and rule, nodes, cells, replicates, seed, clearance, length, mode
    within = { yaw = [-0.2, 0.2] }

    [constraints]
    volume = 0.5               # of the workspace, at least

`name` and `source` are comments; `unit` is "m", or "1" (the default) for lengths over a length of reference.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pk_jax import checks
from pk_jax.analysis.integral import RULES
from pk_jax.analysis.measures import INDICES
from pk_jax.design.families import Family, design_family
from pk_jax.design.problem import DesignProblem
from pk_jax.files.run_problem import problem_of
from pk_jax.files.toml_values import choice, known, listed, number, numbers, show, told_of

LARGEST = 1_000_000  # bytes
MOST_STARTS, MOST_STEPS, MOST_POSES = 100_000, 100_000, 100_000
COMMENTS = ("name", "source")
TABLES = ("variables", "fixed", "objective", "constraints", "search")
MEASURES = {"rectangle": ("least", "mean"), "workspace": ("mean", "integral", "volume")}
OF_RECTANGLE = ("lower", "upper", "nodes")
COUNTS = {
    "nodes": (2, 64),
    "rays": (8, 10**6),
    "replicates": (4, 16),
    "cells": (8, 4096),
    "seed": (0, 2**32 - 1),
}
OF_WORKSPACE = ("rule", *COUNTS, "clearance", "within")


class RunFile(NamedTuple):
    """A design run: what is searched, and how."""

    problem: DesignProblem
    settings: dict[str, Any]  # all that decides the result, defaults filled in, in plain types
    content: bytes  # of the file

    @property
    def digest(self) -> str:
        return digest_of(self.settings)

    @property
    def starts(self) -> int:
        return self.settings["search"]["starts"]

    @property
    def steps(self) -> int:
        return self.settings["search"]["steps"]


def is_run_file(path: str | os.PathLike) -> bool:
    """Whether a TOML file says a design run and no mechanism. False where it cannot be read."""
    path = os.path.expanduser(path)
    with contextlib.suppress(OSError, ValueError, RecursionError):
        if os.path.isfile(path):  # a pipe can be read but once
            with open(path, "rb") as file:
                table = tomllib.loads(file.read(LARGEST).decode("utf-8-sig"))
            return "family" not in table and any(key in table for key in ("mechanism", *TABLES))
    return False


def read_run(path: str | os.PathLike) -> RunFile:
    """The design run of a TOML file.

    ValueError, one line that starts with the path, where it does not say exactly one run; OSError where it
    cannot be read.
    """
    path = Path(os.path.expanduser(path))
    with open(path, "rb") as file:
        content = file.read(LARGEST + 1)
    return parse_run(content, path)


def parse_run(content: bytes, where: str | os.PathLike) -> RunFile:
    """`read_run` of a content that lies `where`."""
    settings = settings_of(content, where)
    with told_of(where):
        return RunFile(problem_of(settings), settings, content)


def settings_of(content: bytes, where: str | os.PathLike) -> dict[str, Any]:
    """What a run file says, in plain types, without its problem."""
    with told_of(where):
        return _settings(content)


def digest_of(settings: dict[str, Any]) -> str:
    """The same where the settings are, whatever the comments. SHA-256, hexadecimal."""
    ordered = {**settings, "variables": list(settings["variables"].items())}
    return hashlib.sha256(json.dumps(ordered, sort_keys=True).encode()).hexdigest()


def first_difference(one: dict[str, Any], other: dict[str, Any], where: str = "") -> str | None:
    """The first key at which settings differ, with both values; None where they do not."""
    for key in [*one, *(key for key in other if key not in one)]:
        left, right = one.get(key), other.get(key)
        if isinstance(left, dict) and isinstance(right, dict):
            if (found := first_difference(left, right, f"{where}{key}.")) is not None:
                return found
        elif left != right:
            return f"{where}{key} = {show(left)} there, {show(right)} here"
    return None if list(one) == list(other) else f"the order of {where.rstrip('.') or 'the keys'}"


# --- what the file says


def _settings(content: bytes) -> dict[str, Any]:
    if len(content) > LARGEST:
        raise ValueError(f"a run file must have at most {LARGEST} bytes, this one has more")
    try:
        table = tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"a run file must be UTF-8 text, {error.reason} at byte {error.start}") from None
    except ValueError as error:
        raise ValueError(f"invalid TOML: {error}") from None
    known("", table, ("mechanism", "unit", *COMMENTS, *TABLES))
    for key in COMMENTS:
        if not isinstance(table.get(key, ""), str):
            raise ValueError(f"{key} must be a string, got {show(table[key])}")
    for key in TABLES:
        if not isinstance(table.get(key, {}), dict):
            raise ValueError(f"{key} must be a table, [{key}], got {show(table[key])}")
    for key in ("mechanism", "objective"):
        if key not in table:
            raise ValueError(f"missing key {key!r}")
    if not isinstance(table["mechanism"], str):
        raise ValueError(f"mechanism must be the name of a family, got {show(table['mechanism'])}")
    family = design_family(table["mechanism"])
    variables, fixed = _parameters(family, table.get("variables"), table.get("fixed", {}))
    objective = _objective(table["objective"])
    return {
        "mechanism": table["mechanism"],
        "unit": choice("unit", table.get("unit", "1"), ("1", "m")),
        "variables": variables,
        "fixed": fixed,
        "objective": objective,
        "constraints": _constraints(table.get("constraints", {}), objective),
        "search": _search(table.get("search", {})),
    }


def _parameters(family: Family, variables: Any, fixed: dict[str, Any]) -> tuple[dict, dict]:
    if variables is None:
        variables = {name: list(bounds) for name, bounds in family.bounds.items() if name not in fixed}
    known("variables.", variables, family.defaults)
    known("fixed.", fixed, family.defaults)
    if not variables:
        raise ValueError(f"variables must hold one of {listed(family.defaults)} or more")
    for name in fixed:
        if name in variables:
            raise ValueError(f"fixed.{name} is a variable, too: it must be one of both")
    bounds = {name: _bounds(f"variables.{name}", value) for name, value in variables.items()}
    given = {name: number(f"fixed.{name}", value) for name, value in fixed.items()}
    others = {name: float(value) for name, value in family.defaults.items() if name not in bounds}
    return bounds, others | given


def _bounds(key: str, value: Any) -> list[float]:
    lower, upper = numbers(key, value, 2)
    if not lower < upper:
        raise ValueError(f"{key} must be [lower, upper] with lower < upper, got {show(value)}")
    return [lower, upper]


def _objective(table: dict[str, Any]) -> dict[str, Any]:
    options = (*OF_RECTANGLE, *(key for key in OF_WORKSPACE if key not in OF_RECTANGLE))
    known("objective.", table, ("index", "over", "measure", "mode", "length", *options))
    for key in ("index", "over"):
        if key not in table:
            raise ValueError(f"missing key 'objective.{key}'")
    over = choice("objective.over", table["over"], MEASURES)
    own, other = (OF_RECTANGLE, "workspace") if over == "rectangle" else (OF_WORKSPACE, "rectangle")
    for key in options:
        if key in table and key not in own:
            raise ValueError(f'objective.{key} is for over = "{other}", over is "{over}"')
    found = {
        "index": choice("objective.index", table["index"], INDICES),
        "over": over,
        "measure": choice("objective.measure", table.get("measure", MEASURES[over][0]), MEASURES[over]),
        "mode": _mode(table.get("mode")),
    }
    if "length" in table:
        found["length"] = number("objective.length", table["length"])
        if found["length"] <= 0:
            raise ValueError(f"objective.length must be positive, got {show(table['length'])}")
    return found | (_of_rectangle(table) if over == "rectangle" else _of_workspace(table))


def _of_rectangle(table: dict[str, Any]) -> dict[str, Any]:
    for key in OF_RECTANGLE:
        if key not in table:
            raise ValueError(f"missing key 'objective.{key}', over is \"rectangle\"")
    lower = numbers("objective.lower", table["lower"])
    upper = numbers("objective.upper", table["upper"], len(lower))
    if not all(low <= high for low, high in zip(lower, upper, strict=True)):
        raise ValueError(f"objective.upper must not be below lower = {lower}, got {upper}")
    return {"lower": lower, "upper": upper, "nodes": _nodes(table["nodes"], len(lower))}


def _of_workspace(table: dict[str, Any]) -> dict[str, Any]:
    """The options that are given; the others are those of `workspace_integral`."""
    found: dict[str, Any] = {}
    if "rule" in table:
        found["rule"] = choice("objective.rule", table["rule"], RULES)
    for key, (least, most) in COUNTS.items():
        if key in table:
            found[key] = checks.is_count(f"objective.{key}", table[key], least=least, most=most)
    if "clearance" in table:
        found["clearance"] = number("objective.clearance", table["clearance"])
    if "within" in table:
        if not isinstance(within := table["within"], dict) or not within:
            raise ValueError(f"objective.within must be a table, x = [least, greatest], got {show(within)}")
        found["within"] = {name: _bounds(f"objective.within.{name}", ends) for name, ends in within.items()}
    return found


def _nodes(value: Any, count: int) -> list[int]:
    nodes = value if isinstance(value, list) else [value] * count
    nodes = [checks.is_count("objective.nodes", each, most=MOST_POSES) for each in nodes]
    if len(nodes) != count:
        raise ValueError(f"objective.nodes must be an integer or {count} of them, got {show(value)}")
    if np.prod(nodes, dtype=float) > MOST_POSES:
        raise ValueError(f"objective.nodes must make at most {MOST_POSES} poses, got {show(value)}")
    return nodes


def _mode(value: Any) -> str | None:
    if value is not None and not (isinstance(value, str) and value and not set(value) - set("+-")):
        raise ValueError(f'objective.mode must be signs, like "+-", got {show(value)}')
    return value


def _constraints(table: dict[str, Any], objective: dict[str, Any]) -> dict[str, Any]:
    known("constraints.", table, ("margins", "volume", *INDICES))
    over = objective["over"]
    for key in table:
        if (key == "volume") != (over == "workspace"):
            other = "workspace" if key == "volume" else "rectangle"
            raise ValueError(f'constraints.{key} is for objective.over = "{other}", over is "{over}"')
    if not isinstance(table.get("margins", False), bool):
        raise ValueError(f"constraints.margins must be true or false, got {show(table['margins'])}")
    least = {key: number(f"constraints.{key}", value) for key, value in table.items() if key != "margins"}
    if least.get("volume", 1) <= 0:
        raise ValueError(f"constraints.volume must be positive, got {show(table['volume'])}")
    return {"margins": table.get("margins", False), **least}


def _search(table: dict[str, Any]) -> dict[str, Any]:
    default = {"starts": 16, "steps": 200, "seed": 0, "tolerance": 1e-8}
    known("search.", table, default)
    found = default | table
    checks.is_count("search.starts", found["starts"], most=MOST_STARTS)
    checks.is_count("search.steps", found["steps"], most=MOST_STEPS)
    checks.is_count("search.seed", found["seed"], least=0, most=2**32 - 1)
    if not 0 < number("search.tolerance", found["tolerance"]) < 1:
        raise ValueError(f"search.tolerance must be between 0 and 1, got {found['tolerance']}")
    return found
