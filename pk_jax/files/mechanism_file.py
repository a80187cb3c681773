"""Mechanisms as TOML files: a family, a unit of length and the geometry, and nothing else.

    family = "TwoRPR"
    unit = "mm"
    half_base = 250
    l_min = 250.0
    l_max = 750.0

Beside `family` and `unit` the keys are the fields of the class; `name` and `source` are comments.
Angles are in radians whatever the unit. Numbers are scaled as decimals and rounded once, so that
124.762 in mm and 0.124762 in m are the same float.
"""

from __future__ import annotations

import dataclasses
import math
import os
import tomllib
from decimal import Context, Decimal
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.files.atomic import write_atomically
from pk_jax.files.toml_values import choice, listed, nearest, show, told_of
from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.casing_oscillator import CasingOscillator
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.planar_rpr import PlanarRPR
from pk_jax.mechanisms.planar_rrr import PlanarRRR
from pk_jax.mechanisms.six_link import SixLink
from pk_jax.mechanisms.stewart import Stewart
from pk_jax.mechanisms.two_rpr import TwoRPR

FAMILIES: dict[str, type[Mechanism]] = {
    family.__name__: family
    for family in (Stewart, CasingOscillator, PlanarRRR, PlanarRPR, SixLink, FiveBar, TwoRPR)
}
UNITS = {  # metres; "1" is for lengths over a length of reference
    "m": Decimal(1),
    "mm": Decimal("0.001"),
    "cm": Decimal("0.01"),
    "in": Decimal("0.0254"),
    "um": Decimal("0.000001"),
    "1": Decimal(1),
}
COMMENTS = ("name", "source")
ANGLES = ("base_cone", "platform_cone")  # every field that is no length stands in one of these three
DIRECTIONS = ("cone_axes",)
NOT_IN_FILES = ("slack",)  # follows from the other fields
LARGEST = 5_000_000  # bytes

_READ = Context(prec=50)
_WRITTEN = Context(prec=20)  # three more than a float64 needs to come back the same


class MechanismFile(NamedTuple):
    """What a file says: the mechanism in metres, the name of the file's unit, and metres per unit."""

    mechanism: Mechanism
    unit: str
    metres: float


def load_mechanism(path: str | os.PathLike) -> Mechanism:
    """The mechanism of a TOML file, lengths in metres (unit "1": as they are).

    ValueError, one line that starts with the path, where the file does not say exactly one mechanism;
    OSError where it cannot be read. Arrays are float64 after `enable_x64()`, else float32.
    """
    return read_mechanism_file(path).mechanism


def read_mechanism_file(path: str | os.PathLike) -> MechanismFile:
    """`load_mechanism`, and the unit of the file."""
    path = _path(path)
    with open(path, "rb") as file:
        content = file.read(LARGEST + 1)  # no more than that, also of a pipe or a device
    with told_of(path):
        return _parse(content)


def save_mechanism(mech: Mechanism, path: str | os.PathLike, *, unit: str = "m") -> None:
    """Write a mechanism to a TOML file, atomically; `load_mechanism` gives the same floats back.

    `unit` is the unit of the file ("1" where the mechanism has none). A file that is there is
    replaced, its `name` and `source` with it; `FiveBar.slack` is left out. ValueError, one line that starts
    with the path, for a mechanism that is traced, of no family of the house or not valid.
    """
    path = _path(path)
    with told_of(path):
        content = _compose(mech, unit).encode()
        _parse(content)  # what would be refused is not written
    write_atomically(path, content)


def _path(path: str | os.PathLike) -> Path:
    if not isinstance(path, str | os.PathLike) or not os.fspath(path):
        raise ValueError(f"path must be the name of a file, got {show(path)}")
    return Path(os.path.expanduser(path))  # that of pathlib raises where there is no such user


# Reading


def _parse(content: bytes) -> MechanismFile:
    if len(content) > LARGEST:
        raise ValueError(f"a mechanism file must have at most {LARGEST} bytes, this one has more")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"a mechanism file must be UTF-8 text, {error.reason} at byte {error.start}"
        ) from None
    try:
        table = tomllib.loads(text, parse_float=_literal)
    except ValueError as error:
        raise ValueError(f"invalid TOML: {error}") from None
    classes = list(FAMILIES.values())
    if "family" in table:
        classes = [FAMILIES[choice("family", table["family"], FAMILIES)]]
    fields = {name: is_needed for cls in classes for name, is_needed in keys_of(cls).items()}
    known = ("family", "unit", *COMMENTS, *fields)
    for key in table:
        if key not in known:
            raise ValueError(f"unknown key {show(key)}{nearest(key, known)}; there are {', '.join(known)}")
    for key, choices in (("family", FAMILIES), ("unit", UNITS)):
        if key not in table:
            raise ValueError(f"missing key {key!r}, one of {listed(choices)}")
    unit = choice("unit", table["unit"], UNITS)
    for key in COMMENTS:
        if not isinstance(table.get(key, ""), str):
            raise ValueError(f"{key} must be a string, got {show(table[key])}")
    needed = [name for name, is_needed in fields.items() if is_needed]
    for key in needed:
        if key not in table:
            raise ValueError(f"missing key {key!r}; a {table['family']} needs {', '.join(needed)}")

    found = {name: _array(name, table[name], UNITS[unit]) for name in fields if name in table}
    try:
        mechanism = classes[0](**found)
    except ValueError as error:
        lengths = "" if unit in ("m", "1") else " (lengths in m)"
        raise ValueError(f"{error}{lengths}") from None
    return MechanismFile(mechanism, unit, float(UNITS[unit]))


def keys_of(cls: type[Mechanism]) -> dict[str, bool]:
    """The fields of a family that a file may give, and whether it must."""
    fields = dataclasses.fields(cls)
    return {f.name: f.default is dataclasses.MISSING for f in fields if f.name not in NOT_IN_FILES}


class _Literal(Decimal):
    """A number as it was written, also in messages."""

    __repr__ = Decimal.__str__


def _literal(text: str) -> Decimal | float:
    value = float(text)
    return _Literal(text) if value and math.isfinite(value) else value  # 0e9999999999 is no decimal


def _array(key: str, value: Any, metres: Decimal) -> np.ndarray:
    """The value of a field in metres (angles, directions: as it is), in the precision of the day."""
    scale = Decimal(1) if key in (*ANGLES, *DIRECTIONS) else metres
    numbers = _numbers(key, value, scale)
    try:
        array = np.asarray(numbers, dtype=np.float64)
    except ValueError:
        raise ValueError(f"{key} must have rows of one length, got {show(value)}") from None
    with np.errstate(over="ignore"):  # what float32 cannot hold is refused as not finite
        array = array.astype(jnp.result_type(float))
    if key in ANGLES and np.any(array > array.dtype.type(np.pi)):
        raise ValueError(f"{key} must be at most pi, got {show(value)}: radians, not degrees?")
    return array


def _numbers(key: str, value: Any, scale: Decimal) -> Any:
    if isinstance(value, list):
        return [_numbers(f"{key}[{i}]", item, scale) for i, item in enumerate(value)]
    if isinstance(value, bool) or not isinstance(value, int | float | Decimal):
        wanted = "a number" if "[" in key else "a number or an array of numbers"
        raise ValueError(f"{key} must be {wanted}, got {show(value)}")
    if isinstance(value, int):
        value = Decimal(value) if value.bit_length() <= 1024 else math.inf
    number = float(_READ.multiply(value, scale)) if isinstance(value, Decimal) else value  # 0, inf, nan
    if not math.isfinite(number):
        raise ValueError(f"{key} must be finite, got {number}")
    return number


# Writing


def _compose(mech: Mechanism, unit: str) -> str:
    unit = choice("unit", unit, UNITS)
    family = type(mech).__name__
    if FAMILIES.get(family) is not type(mech):
        raise ValueError(f"only a mechanism of the house can be saved, {', '.join(FAMILIES)}, got {family}")
    if not checks.is_concrete(mech):
        raise ValueError(
            f"only a mechanism of the house with known values can be saved, got a traced {family}"
        )
    lines = [f'family = "{family}"', f'unit = "{unit}"']
    for key in keys_of(type(mech)):
        if (value := getattr(mech, key)) is not None:
            array = np.asarray(checks.real_array(f"{family}.{key}", value))
            checks.is_finite(f"{family}.{key}", array)
            scale = Decimal(1) if key in (*ANGLES, *DIRECTIONS) else UNITS[unit]
            lines.append(f"{key} = {_text(array, scale)}")
    return "\n".join(lines) + "\n"


def _text(array: np.ndarray, scale: Decimal, indent: str = "") -> str:
    """An array in TOML, one row a line."""
    if array.ndim == 0:
        return _digits(array[()], scale)
    inside = [_text(row, scale, indent + "    ") for row in array]
    if array.ndim == 1:
        return f"[{', '.join(inside)}]"
    return "[\n" + "".join(f"{indent}    {row},\n" for row in inside) + f"{indent}]"


def _digits(value: np.floating, scale: Decimal) -> str:
    """The shortest digits that are read back as `value`, in the unit of the file."""
    written = _WRITTEN.divide(Decimal(str(value)), scale)
    plain = repr(float(written))
    return plain if Decimal(plain) == written else str(written)
