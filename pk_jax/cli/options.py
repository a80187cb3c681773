"""Options that several verbs have, and how they are called."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

Command = Callable[..., argparse.ArgumentParser]  # (name, run, text) -> its parser

MECHANISM = "a catalogue entry (see: pk-jax list), a TOML file, or FILE.py:NAME, which runs that file"
UNIT = "of lengths: m, mm, cm, in or um (default: that of the TOML file, otherwise m)"
FREE = "redundant joint, or margin, conditioning or middle: what to choose it by (default: as at home)"


def takes_mechanism(sub: argparse.ArgumentParser, text: str = MECHANISM) -> None:
    sub.add_argument("mechanism", help=text)
    sub.add_argument("--unit", help=UNIT)


def takes_pose(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--pose", metavar="X,Y,...", help="as a row of ik (default: home)")
    sub.add_argument("--free", metavar="VALUE", help=FREE)


def takes_slice(sub: argparse.ArgumentParser, axes: str) -> None:
    """Which coordinates vary, where the others are held, and how far."""
    sub.add_argument("--axes", metavar="A,B", help=axes)
    sub.add_argument("--at", metavar="X,Y,...", help="pose with the other coordinates (default: home)")
    sub.add_argument(
        "--range", action="append", default=[], metavar="A=LO:HI", help="range of an axis, angles in rad"
    )


def image_kind(path: str, option: str = "-o") -> str:
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in ("png", "svg", "pdf"):
        raise ValueError(f"{option} must end in .png, .svg or .pdf, got {path!r}")
    return kind
