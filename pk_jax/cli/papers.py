"""Published results, computed again: reproduce."""

from __future__ import annotations

import argparse

from pk_jax.cli import NUMERICAL, begin
from pk_jax.cli.options import Command


def add_reproduce(command: Command) -> None:
    sub = command(
        "reproduce", _reproduce, "a paper's tables and figures: Nam, Lee and Park 2006, with better optima"
    )
    sub.add_argument(
        "paper",
        nargs="?",
        default="nam2006",
        choices=("nam2006", "planar-screws", "casing-oscillator", "nine-lengths"),
        help="default: %(default)s; planar-screws: singular poses and loci of the 5-link, k-RRR and 6-link; "
        "casing-oscillator: its workspace, singularities, and the proof that they do not meet; nine-lengths: "
        "the platform with three sensors, exact and noisy, and its loop",
    )
    sub.add_argument("--out", metavar="DIR", help="run folder (default: runs/PAPER)")


def _reproduce(options: argparse.Namespace) -> int:
    progress = begin()
    if options.paper == "planar-screws":
        from pk_jax.papers.planar_screws_report import report_into

        is_right = report_into(options.out or "runs/planar-screws", say=progress.say, show=print)
        progress.close()
        return 0 if is_right else NUMERICAL
    if options.paper == "casing-oscillator":
        from pk_jax.papers.casing_oscillator_report import report_into as casing_into

        out = options.out or "runs/casing-oscillator"
        is_right = casing_into(out, report=progress, say=progress.say, show=print)
        progress.close()
        return 0 if is_right else NUMERICAL
    if options.paper == "nine-lengths":
        from pk_jax.papers.nine_lengths_report import report_into as nine_lengths_into

        out = options.out or "runs/nine-lengths"
        is_right = nine_lengths_into(out, report=progress, say=progress.say, show=print)
        progress.close()
        return 0 if is_right else NUMERICAL
    from pk_jax.papers.nam2006_report import as_text, reproduce_into

    options.out = options.out or "runs/nam2006"
    found = reproduce_into(options.out, report=progress, say=progress.say)
    progress.close()
    print(as_text(found))
    print(f"\ntables and figures: {options.out}")
    return 0 if all(cell.verdict != "differs" for cell in found.cells) else NUMERICAL
