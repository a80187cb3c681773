"""A mechanism out of a user's Python file: FILE.py:NAME. Reading the file runs it."""

from __future__ import annotations

import importlib.util
import os
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

from pk_jax.mechanisms.base import Mechanism

_run: set[str] = set()  # files that were run, as their frames name them


def is_python(name: str | None) -> bool:
    """Whether a mechanism is named by a Python file: FILE.py:NAME, or FILE.py."""
    return name is not None and (name.endswith(".py") or ".py:" in name)


def split(name: str) -> tuple[str, str]:
    """FILE.py:NAME as the path and the name, "" where there is none."""
    path, _, inside = (name, "", "") if name.endswith(".py") else name.rpartition(":")
    return os.path.expanduser(path), inside


def read_python_file(name: str) -> Mechanism:
    """The mechanism FILE.py:NAME: an instance, or what a callable without arguments gives.

    ValueError, one line with the path, for anything else and for what the file itself raises; OSError where
    it cannot be read.
    """
    path, inside = split(name)
    with open(path, "rb"):
        pass  # a missing file is no fault of Python's
    module = _told(path, _executed, path)
    if not hasattr(module, inside):
        there = [key for key, value in vars(module).items() if isinstance(value, Mechanism)]
        hint = f"there are {', '.join(there)}" if there else "it has no mechanism"
        what = f"no name {inside!r} in it" if inside else "which mechanism? Write FILE.py:NAME"
        raise ValueError(f"{path}: {what}; {hint}")
    found = getattr(module, inside)
    if callable(found):
        found = _told(path, found)
    if not isinstance(found, Mechanism):
        raise ValueError(f"{path}: {inside} must be a pk_jax.Mechanism, got {type(found).__name__}")
    return found


def fault_in(error: BaseException, path: str | None = None) -> str | None:
    """What a user's file did wrong, and where; None if it was not that file. `path`: it was, line unknown."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename in _run]
    at = [f"{frames[-1].filename}: line {frames[-1].lineno}"] if frames else [path] if path else []
    if isinstance(error, SyntaxError) and error.filename in _run:
        at = [f"{error.filename}: line {error.lineno}"]
    said = str(error.msg if isinstance(error, SyntaxError) else error).strip().partition("\n")[0]
    return ": ".join([*at, type(error).__name__, said]) if at else None


def _told(path: str, function: Any, *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:
        raise ValueError(fault_in(error, path)) from None


def _executed(path: str) -> ModuleType:
    """The file as a module that finds its neighbours, as a script does."""
    path = str(Path(path))
    spec = importlib.util.spec_from_file_location(f"_mechanism_in_{Path(path).stem}", path)
    module = importlib.util.module_from_spec(spec)
    _run.add(path)
    sys.modules[spec.name] = module  # dataclasses look their module up
    sys.path.insert(0, str(Path(path).parent))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.pop(0)
    return module
