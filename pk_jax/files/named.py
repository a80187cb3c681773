"""A mechanism as the command line names it: a catalogue entry, a TOML file or FILE.py:NAME; and its unit."""

from __future__ import annotations

import difflib
import inspect
import os
import tomllib
from pathlib import Path
from typing import NamedTuple

from pk_jax.files.mechanism_file import UNITS, read_mechanism_file
from pk_jax.files.python_file import is_python, read_python_file, split
from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.catalogue import CATALOGUE


class Named(NamedTuple):
    """The mechanism in metres, its name, and the unit of lengths that go in and out."""

    mechanism: Mechanism
    name: str
    unit: str  # "1": lengths have none
    metres: float  # a unit
    path: str | None  # of the file


def named_mechanism(name: str, unit: str | None = None) -> Named:
    """The catalogue entry of that name, else the mechanism of that file. A Python file, FILE.py:NAME, is run.

    `unit`: other than the file's own (m of a catalogue entry and of a Python file). ValueError where there
    is no such mechanism or unit, OSError where the file cannot be read.
    """
    if unit is not None and (unit not in UNITS or unit == "1"):
        raise ValueError(f"--unit must be one of {', '.join(u for u in UNITS if u != '1')}, got {unit!r}")
    if name in CATALOGUE:
        mechanism, own, path = CATALOGUE[name].make(), "m", None
    elif is_python(name):
        mechanism, own, path = read_python_file(name), "m", split(name)[0]
    elif name.endswith(".toml") or os.path.exists(os.path.expanduser(name)):
        (mechanism, own, _), path = read_mechanism_file(name), os.path.expanduser(name)
    else:
        close = difflib.get_close_matches(name.lower(), CATALOGUE, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"the catalogue has {', '.join(CATALOGUE)}"
        raise ValueError(f"no mechanism {name!r} in the catalogue, and no such file; {hint}")
    if own == "1" and unit is not None:
        raise ValueError(f"--unit {unit}: the lengths of {name} have no unit")
    unit = unit or own
    return Named(mechanism, name, unit, float(UNITS[unit]), path)


def source_of(named: Named) -> str:
    """Where the design comes from, as the catalogue, the file or the class says it; else empty."""
    if named.path is None:
        return CATALOGUE[named.name].source
    if is_python(named.path):
        return (inspect.getdoc(type(named.mechanism)) or "").partition("\n")[0]
    table = tomllib.loads(Path(named.path).read_text("utf-8-sig"))
    return ": ".join(table[key] for key in ("name", "source") if table.get(key))
