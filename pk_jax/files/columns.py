"""Which columns of a CSV file are meant: found by name, by unit, by number or by their count."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pk_jax.files.mechanism_file import UNITS


class Column(NamedTuple):
    """What is looked for: a name, and what its numbers are, "length", "angle", "degree" or "number"."""

    name: str
    kind: str


Layout = tuple[Column, ...]


def arrange(
    where: str, fields: list[str], layouts: Sequence[Layout], unit: str, chosen: list[str] | None
) -> tuple[Layout, list[int]]:
    """The layout that the first line has, and the place of each of its columns."""
    has_names = not any(map(is_number, fields))
    names = [field.strip() for field in fields]
    if chosen is not None:
        layout = _of_length(f"{where}: --columns", len(chosen), layouts)
        at = [_place(where, key, names, column, unit) for key, column in zip(chosen, layout, strict=True)]
        if len(set(at)) < len(at):
            raise ValueError(
                f"{where}: --columns: must not name a column twice, got {short(','.join(chosen))}"
            )
        return layout, at
    for layout in layouts:
        found = [
            [i for i, name in enumerate(names) if _stem(name, column) == column.name] for column in layout
        ]
        if all(found):
            for column, places in zip(layout, found, strict=True):
                if len(places) > 1:
                    raise ValueError(
                        f"{where}: {' and '.join(short(names[i]) for i in places[:2])} are both {column.name}"
                    )
                _check_unit(where, names[places[0]], column, unit)
            return layout, [places[0] for places in found]
    if has_names:
        wanted = " or ".join(",".join(column.name for column in layout) for layout in layouts)
        raise ValueError(f"{where}: no columns {wanted} among {short(','.join(names))}; see --columns")
    for i, field in enumerate(fields):
        if not is_number(field):
            raise ValueError(f"{where}: field {i + 1} must be a number, got {short(field)}")
    return (layout := _of_length(where, len(fields), layouts)), list(range(len(layout)))


def _of_length(where: str, count: int, layouts: Sequence[Layout]) -> Layout:
    sizes = {len(layout): layout for layout in reversed(layouts)}
    if count in sizes:
        return sizes[count]
    wanted = " or ".join(f"{n} ({','.join(c.name for c in layout)})" for n, layout in sizes.items())
    raise ValueError(f"{where}: there must be {wanted} columns, got {count}")


def _place(where: str, key: str, names: list[str], column: Column, unit: str) -> int:
    """Where a column stands that was chosen by its name or its number, counted from 1."""
    if key.isascii() and key.isdigit():  # never a name: it may be a number of the first row
        if not 1 <= int(key) <= len(names):
            raise ValueError(f"{where}: --columns: there are columns 1 to {len(names)}, got {key}")
        return int(key) - 1
    if key in names:
        if names.count(key) > 1:
            raise ValueError(
                f"{where}: {names.count(key)} columns are called {key!r}; choose one by its number"
            )
        _check_unit(where, key, column, unit)
        return names.index(key)
    raise ValueError(f"{where}: --columns: no column {key!r} among {short(','.join(names))}")


def _stem(name: str, column: Column) -> str:
    """The name without a unit at its end."""
    stem, _, suffix = name.rpartition("_")
    return stem if stem and column.kind != "number" and suffix in _SUFFIXES else name


_SUFFIXES = (*(unit for unit in UNITS if unit != "1"), "rad", "deg")


def _check_unit(where: str, name: str, column: Column, unit: str) -> None:
    suffix = name.rpartition("_")[2] if "_" in name else ""
    if column.kind == "number" or suffix not in _SUFFIXES:
        return
    in_use = {"angle": "rad", "degree": "deg"}.get(column.kind, unit)
    if suffix != in_use:
        what = "lengths" if column.kind == "length" else "angles"
        said = "lengths without a unit" if in_use == "1" else f"{what} in {in_use}"
        hint = " (see --unit)" if column.kind == "length" else ""
        raise ValueError(f"{where}: column {name!r} is in {suffix}, but what is read are {said}{hint}")


def numbers(fields: list[str]) -> np.ndarray:
    """Numbers of one column; ValueError where one is none."""
    together = "".join(fields)
    if "_" in together or not together.isascii():  # float() would take 1_000 and other scripts' digits
        raise ValueError
    return np.fromiter(map(float, fields), np.float64, len(fields))


def is_number(field: str) -> bool:
    try:
        return len(numbers([field])) == 1
    except ValueError:
        return False


def short(text: str) -> str:
    shown = repr(text)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
