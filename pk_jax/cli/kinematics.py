"""Rows forward and back, Jacobians, all assembly modes: fk, ik, jacobian, modes."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time

from pk_jax.cli import NOT_OK, begin
from pk_jax.cli.options import FREE, MECHANISM, UNIT, Command, image_kind, takes_mechanism, takes_pose

MOST_ROWS = 10_000_000  # at a time


def add_forward(command: Command) -> None:
    sub = command("fk", _forward, "forward kinematics of rows of joints (CSV in, CSV out)")
    _takes_rows(sub, "joints")
    sub.add_argument(
        "--closed-form", action="store_true", help="of nine lengths: no guess, then weighted least squares"
    )
    sub.add_argument("--sigma", metavar="LEG,SENSOR", help="with it: standard deviations of the lengths")
    sub.add_argument("--certify", action="store_true", help="prove how near each pose is to the exact one")
    _takes_chunk(sub)


def _forward(options: argparse.Namespace) -> int:
    if options.sigma and not options.closed_form:
        raise ValueError("--sigma is for --closed-form")
    if options.closed_form and options.certify:
        raise ValueError("--certify is not for --closed-form")
    if options.closed_form:
        return _convert(options, "nine_length_rows", sigma=options.sigma)
    return _convert(options, "forward_rows", certify=options.certify)


def add_inverse(command: Command) -> None:
    sub = command("ik", _inverse, "inverse kinematics of rows of poses (CSV in, CSV out)")
    _takes_rows(sub, "poses")
    sub.add_argument("--free", metavar="VALUE", help=FREE)
    _takes_chunk(sub)


def _inverse(options: argparse.Namespace) -> int:
    return _convert(options, "inverse_rows", free=options.free)


def _takes_rows(sub: argparse.ArgumentParser, rows: str) -> None:
    sub.add_argument("mechanism", help=MECHANISM)
    sub.add_argument(
        "rows", metavar=f"{rows.upper()}.csv", help=f"file of {rows}, - for stdin; angles in rad"
    )
    sub.add_argument("-o", "--out", metavar="FILE", help="where to (default: stdout)")
    sub.add_argument("--strict", action="store_true", help="exit code 3 where a row is not OK")
    sub.add_argument("--columns", metavar="A,B,...", help=f"which columns are the {rows}: names or numbers")
    sub.add_argument("--unit", help=UNIT)


def _takes_chunk(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--chunk", type=int, default=65536, metavar="N", help="rows at a time (default: %(default)s)"
    )


def _convert(options: argparse.Namespace, function: str, **more: str | bool | None) -> int:
    progress = begin()
    from pk_jax.files import stream
    from pk_jax.files.named import named_mechanism

    if options.chunk < 1:
        raise ValueError(f"--chunk must be at least 1, got {options.chunk}")
    if options.chunk > MOST_ROWS:
        raise ValueError(f"--chunk must be at most {MOST_ROWS}, got {options.chunk}")
    begun = time.monotonic()
    named = named_mechanism(options.mechanism, options.unit)
    to_terminal = options.out in (None, "-") and sys.stdout.isatty()  # rows and progress would mix
    try:
        found = getattr(stream, function)(
            named,
            options.rows,
            options.out,
            columns=options.columns,
            chunk=options.chunk,
            **more,
            note=(lambda _: None) if to_terminal else progress.note,
        )
    finally:
        progress.close()
    seconds, count = time.monotonic() - begun, found.total()
    each = ", ".join(f"{n} {name}" for name, n in found.most_common())
    print(f"{count} rows: {each}; {seconds:.1f} s, {count / seconds:.0f} rows/s", file=sys.stderr)
    return NOT_OK if options.strict and found["OK"] < count else 0


def add_jacobian(command: Command) -> None:
    sub = command("jacobian", _jacobian, "A, B and J of a configuration, in metres and radians")
    sub.add_argument("--json", action="store_true", help="machine-readable")
    takes_mechanism(sub)
    takes_pose(sub)


def _jacobian(options: argparse.Namespace) -> int:
    begin()
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.shown import as_json, as_text, jacobians_at

    found = jacobians_at(named_mechanism(options.mechanism, options.unit), options.pose, options.free)
    print(as_json(found._asdict()) if options.json else as_text(found))
    return 0


def add_modes(command: Command) -> None:
    sub = command("modes", _modes, "every pose that fits the joints, and whether these are known to be all")
    takes_mechanism(sub)
    sub.add_argument(
        "--joints", "--lengths", metavar="Q1 Q2 ...", help="as a row of fk, angles in rad (default: home's)"
    )
    sub.add_argument("--rows", metavar="JOINTS.csv", help="file of joints instead, - for stdin; as of fk")
    sub.add_argument("--columns", metavar="A,B,...", help="which columns are the joints: names or numbers")
    sub.add_argument(
        "--connect", action="store_true", help="which modes a way without type II singularity joins to home"
    )
    sub.add_argument("--strict", action="store_true", help="exit code 3 unless they are known to be all")
    sub.add_argument("-o", "--out", "--output", metavar="FILE", help="the modes, a CSV file")
    sub.add_argument("--figure", metavar="FILE", help="the modes side by side, a .png, .svg or .pdf")


def _modes(options: argparse.Namespace) -> int:
    kind = image_kind(options.figure, "--figure") if options.figure else None
    if options.rows and options.joints:
        raise ValueError("--rows and --joints exclude each other")
    if options.rows and options.figure:
        raise ValueError("--figure is for one row of joints, not for --rows")
    if options.columns and not options.rows:
        raise ValueError("--columns is for --rows")
    progress = begin()
    from pk_jax.files import assembled
    from pk_jax.files.atomic import output_file
    from pk_jax.files.named import named_mechanism

    named = named_mechanism(options.mechanism, options.unit)
    if options.rows:
        joints = assembled.joints_in(named, options.rows, options.columns)
    else:
        joints = assembled.joints_of(named, options.joints)
    for path in (options.out, options.figure):
        assembled.refuse_same(path, named, options.rows)
    with contextlib.ExitStack() as stack:
        table = stack.enter_context(output_file(options.out)) if options.out else None
        image = stack.enter_context(output_file(options.figure)) if options.figure else None
        one = assembled.assembled(named, joints, connect=options.connect, report=progress)
        progress.close()
        if table:
            table.write(assembled.modes_csv(one).encode())
        if image:
            from pk_jax.viz.assembly import draw_modes

            draw_modes(named.mechanism, joints[0], one.modes[0]).savefig(image, format=kind, dpi=200)
        print(assembled.modes_text(one))
    return NOT_OK if options.strict and not all(each.is_complete for each in one.modes) else 0
