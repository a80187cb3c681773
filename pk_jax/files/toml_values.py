"""Values of a TOML file, and what is said of those that cannot be: one line, with the key."""

from __future__ import annotations

import contextlib
import difflib
import os
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np


@contextlib.contextmanager
def told_of(where: str | os.PathLike) -> Iterator[None]:
    """What is wrong, as one line that starts with the path."""
    try:
        yield
    except RecursionError:
        raise ValueError(f"{where}: values must not be nested that deeply") from None
    except ValueError as error:
        raise ValueError(f"{where}: {cut(' '.join(str(error).split()), 400)}") from None


def known(where: str, table: dict[str, Any], known: Iterable[str]) -> None:
    for key in table:
        if key not in known:
            names = ", ".join(known)
            raise ValueError(f"unknown key {show(where + key)}{nearest(key, known)}; there are {names}")


def choice(key: str, value: Any, choices: Iterable[str]) -> str:
    if not isinstance(value, str) or value not in choices:
        hint = nearest(value, choices)
        raise ValueError(f"{key} must be one of {listed(choices)}, got {show(value)}{hint}")
    return value


def number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key} must be a number, got {show(value)}")
    if (isinstance(value, int) and value.bit_length() > 1023) or not np.isfinite(float(value)):
        raise ValueError(f"{key} must be finite, got {show(value)}")
    return float(value)


def numbers(key: str, value: Any, count: int | None = None) -> list[float]:
    if not isinstance(value, list) or not value or (count is not None and len(value) != count):
        wanted = "an array of numbers" if count is None else f"an array of {count} numbers"
        raise ValueError(f"{key} must be {wanted}, got {show(value)}")
    return [number(f"{key}[{i}]", each) for i, each in enumerate(value)]


def listed(choices: Iterable[str]) -> str:
    return ", ".join(f'"{choice}"' for choice in choices)


def nearest(word: Any, words: Iterable[str]) -> str:
    lowered = {known.lower(): known for known in words}
    close = difflib.get_close_matches(cut(str(word).lower(), 60), lowered, n=1)
    return f" (did you mean {lowered[close[0]]!r}?)" if close else ""


def show(value: Any) -> str:
    return cut(repr(value), 60)


def cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."
