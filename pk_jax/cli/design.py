"""Designs and geometries: optimize, calibrate, sensors."""

from __future__ import annotations

import argparse
from pathlib import Path

from pk_jax.cli import NUMERICAL, begin
from pk_jax.cli.options import MECHANISM, UNIT, Command, takes_mechanism


def add_optimize(command: Command) -> None:
    sub = command("optimize", _optimize, "maximize the composite index of a design space by gradients")
    sub.add_argument("space", help="2-rpr or 2-rrr")
    sub.add_argument("--weights", type=float, nargs=3, default=(1.0, 1.0, 1.0), metavar=("GII", "GRI", "SUI"))
    sub.add_argument("--starts", type=int, default=12, help="number of starts (default: %(default)s)")
    sub.add_argument("--steps", type=int, default=100, help="most evaluations a start (default: %(default)s)")


def _optimize(options: argparse.Namespace) -> int:
    progress = begin()
    import pk_jax as pk

    space = pk.design_space(options.space)
    result = pk.optimize_design(
        space, options.weights, starts=options.starts, steps=options.steps, report=progress
    )
    progress.close()
    print(result.mechanism)
    for name, value in zip(space.variables, result.vector, strict=True):
        print(f"{name:11}{value:.9g}")
    for name in ("gii", "gri", "sui"):
        print(f"{name:11}{float(getattr(result.indices, name)):.9g}")
    print(f"objective  {result.objective:.9g}\ncpi        {result.cpi:.9g}")
    for name in result.active:
        print(f"active     {name}, multiplier {result.multipliers[name]:.9g}")
    print(f"kkt        {result.kkt:.1e}")
    print(f"evaluations of value and gradient: {result.evaluations}, all starts {result.evaluations_in_all}")
    print(f"status     {result.status.name}")
    return 0 if result.status == pk.Status.OK else NUMERICAL


def add_calibrate(command: Command) -> None:
    sub = command(
        "calibrate", _calibrate, "identify a geometry from logged poses and joints, with standard deviations"
    )
    sub.add_argument("log", metavar="LOG.csv", help="poses and joints in one file, - for stdin")
    sub.add_argument(
        "--nominal",
        metavar="GEOMETRY",
        help=f"what to start from, {MECHANISM} (default: a Stewart platform of six legs, from the log alone)",
    )
    sub.add_argument(
        "--offsets", action="store_true", help="a constant of each joint, too; it is only printed"
    )
    sub.add_argument(
        "--columns", metavar="A,B,...", help="which columns are the pose, then the joints: names or numbers"
    )
    sub.add_argument(
        "--angles",
        choices=("xyz", "xzy", "yxz", "yzx", "zxy", "zyx"),
        help="poses are x,y,z,tx,ty,tz in degrees, turns multiplied in this order "
        "(default: xyz, Rx Ry Rz, where columns are called so)",
    )
    sub.add_argument("--unit", help=UNIT)
    sub.add_argument(
        "-o", "--out", metavar="FILE", help="the geometry, a .toml; kept unless the search stopped"
    )
    sub.add_argument("--json", action="store_true", help="machine-readable")


def _calibrate(options: argparse.Namespace) -> int:
    if options.out and Path(options.out).suffix.lower() != ".toml":
        raise ValueError(f"-o must end in .toml, got {options.out!r}")
    progress = begin()
    from pk_jax.files import calibrated
    from pk_jax.files.shown import as_json
    from pk_jax.status import Status

    progress.say("identifying")
    one = calibrated.identified(
        options.log,
        options.nominal,
        options.unit,
        offsets=options.offsets,
        columns=options.columns,
        angles=options.angles,
    )
    progress.close()
    print(as_json(calibrated.identified_table(one)) if options.json else calibrated.identified_text(one))
    if one.found.status not in (Status.OK, Status.SINGULAR):
        return NUMERICAL  # it is on its way, and no geometry to keep
    if options.out:
        calibrated.save(options.out, one)
    return 0 if one.found.status == Status.OK else NUMERICAL


def add_sensors(command: Command) -> None:
    sub = command("sensors", _sensors, "rank, condition and noise gains of three length sensors; place them")
    takes_mechanism(sub, f"{MECHANISM}, with nine rows, or six to place sensors on")
    sub.add_argument(
        "--place", type=float, metavar="RADIUS", help="best base joints, within a square of this half-width"
    )
    sub.add_argument(
        "--place-platform",
        type=float,
        metavar="RADIUS",
        help="best platform joints, too, within such a square",
    )
    sub.add_argument("--starts", type=int, default=16, help="number of starts (default: %(default)s)")
    sub.add_argument("-o", "--out", metavar="FILE", help="the platform with its sensors, a .toml")


def _sensors(options: argparse.Namespace) -> int:
    if options.out and Path(options.out).suffix.lower() != ".toml":
        raise ValueError(f"-o must end in .toml, got {options.out!r}")
    progress = begin()
    from pk_jax.files.mechanism_file import save_mechanism
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.sensed import sensed, sensed_text

    named = named_mechanism(options.mechanism, options.unit)
    one = sensed(named, options.place, options.place_platform, options.starts, progress)
    progress.close()
    print(sensed_text(named, one))
    if one.layout.reason:
        return NUMERICAL
    if options.out:
        save_mechanism(one.mechanism, options.out, unit=named.unit)
    return 0
