"""Designs and geometries: optimize, calibrate, sensors."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shlex
import sys
from pathlib import Path

from pk_jax.cli import INTERRUPTED, NUMERICAL, begin
from pk_jax.cli.options import MECHANISM, UNIT, Command, takes_mechanism

_OF_SPACES = {"weights": (1.0, 1.0, 1.0), "starts": 12, "steps": 100}
_OF_RUNS = ("out", "resume", "shard", "devices", "quiet", "coordinator", "process")


def add_optimize(command: Command) -> None:
    sub = command(
        "optimize", _optimize, "maximize the composite index of a design space by gradients; or a run"
    )
    sub.add_argument("space", help="2-rpr or 2-rrr; or RUN.toml, a design run of any family")
    sub.add_argument("--weights", type=float, nargs=3, metavar=("GII", "GRI", "SUI"), help="(default: 1 1 1)")
    sub.add_argument("--starts", type=int, help="number of starts (default: 12)")
    sub.add_argument("--steps", type=int, help="most evaluations a start (default: 100)")
    run = sub.add_argument_group("of RUN.toml")
    run.add_argument("--out", metavar="DIR", help="run folder (default: runs/RUN)")
    run.add_argument("--resume", action="store_true", help="go on from the checkpoint in the folder")
    run.add_argument("--shard", metavar="I/N", help="every N-th start from the I-th on; see merge")
    run.add_argument("--devices", type=int, metavar="K", help="to spread the starts over (default: 1)")
    run.add_argument("--quiet", action="store_true", help="no progress line")
    run.add_argument(
        "--coordinator", metavar="HOST:PORT", help="of several hosts: where the first one listens"
    )
    run.add_argument("--process", metavar="I/N", help="of several hosts: which one this is")


def _optimize(options: argparse.Namespace) -> int:
    if options.space.endswith(".toml"):
        return _run_file(options)
    for name in _OF_RUNS:
        if (given := getattr(options, name)) is not None and given is not False:
            raise ValueError(f"--{name} is for a RUN.toml, got {options.space}")
    for name, value in _OF_SPACES.items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    return _space(options)


def _space(options: argparse.Namespace) -> int:
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


def _run_file(options: argparse.Namespace) -> int:
    for name in _OF_SPACES:
        if getattr(options, name) is not None:
            raise ValueError(f"--{name} is for 2-rpr and 2-rrr; a run file says it itself")
    if (options.coordinator is None) != (options.process is None):
        raise ValueError("--coordinator and --process go together")
    if options.shard and options.process:
        raise ValueError("--shard and --process exclude each other")
    shard, process = (_share(name, getattr(options, name)) for name in ("shard", "process"))
    progress = begin()
    from pk_jax.files import design_run, shards
    from pk_jax.files.run_file import read_run

    _make_devices(options.devices)
    if process:
        shards.connect(options.coordinator, design_run.Part(*process))
    out = options.out or str(Path("runs") / Path(options.space).stem)
    words = {"resume": options.resume, "report": None if options.quiet else progress.note}
    try:
        run = read_run(options.space)
        if shard:
            part = design_run.Part(*shard)
            file = shards.part_into(out, run, part, devices=_devices(options.devices), **words)
            print(f"{file}: to be merged with the others" if file else f"{part} in {out} is finished")
            return 0
        words["draw"] = _figures(run)
        if process:
            found = shards.together_into(out, run, **words)
        else:
            found = design_run.run_into(out, run, devices=_devices(options.devices), **words)
    except KeyboardInterrupt:
        progress.close()
        _say_how_to_resume(options, out)
        if process:
            os._exit(INTERRUPTED)  # leaving in order would wait for the other hosts, which wait for this one
        return INTERRUPTED
    finally:
        progress.close()
    return _shown(run, found)


def _share(name: str, text: str | None) -> tuple[int, int] | None:
    """I/N, which of how many."""
    if text is None:
        return None
    if not (found := re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)):
        raise ValueError(f"--{name} must be I/N, like 1/4, got {text!r}")
    number, count = int(found[1]), int(found[2])
    if not 1 <= number <= count:
        raise ValueError(f"--{name} must be I/N with 1 <= I <= N, got {text!r}")
    return number, count


def _make_devices(count: int | None) -> None:
    """Cores count as devices where there are no others; too late once anything was computed."""
    if count is None:
        return
    if not 1 <= count <= 4096:
        raise ValueError(f"--devices must be from 1 to 4096, got {count}")
    import jax

    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", count)


def _devices(count: int | None) -> list | None:
    if count is None:
        return None
    import jax

    if count > len(there := jax.local_devices()):
        raise ValueError(f"--devices: there are {len(there)}, got {count}")
    return there[:count]


def _say_how_to_resume(options: argparse.Namespace, out: str) -> None:
    given = {"--shard": options.shard, "--coordinator": options.coordinator, "--process": options.process}
    more = [word for option, value in given.items() if value for word in (option, value)]
    again = shlex.join(["pk-jax", "optimize", options.space, "--out", out, "--resume", *more])
    print(f"pk-jax: interrupted; go on with: {again}", file=sys.stderr, flush=True)


def _figures(run):
    """What draws the figures of a run into its folder."""
    from pk_jax.files.run_problem import branch_of
    from pk_jax.viz.design import draw_design, draw_history

    goal = run.settings["objective"]
    rectangle = (goal["lower"], goal["upper"]) if goal["over"] == "rectangle" else None

    def draw(folder, design, history):
        if design.value == design.value:  # not NaN: there is one
            axes = draw_design(design.mechanism, rectangle, branch=branch_of(run.settings))
            axes.set_title(f"{run.problem.name}: {goal['index']} {design.value:.6g}")
            folder.write_figure("design.png", axes.figure)
        folder.write_figure("history.png", draw_history(history).figure)

    return draw


def _shown(run, found) -> int:
    from pk_jax.files.design_result import result_text
    from pk_jax.status import Status

    if found.design is None:
        print(f"{found.folder}: the run is finished")
        return 0
    print(f"{result_text(run, found.design)}\nfolder     {found.folder}")
    return 0 if found.design.status == Status.OK else NUMERICAL


def add_merge(command: Command) -> None:
    sub = command("merge", _merge, "make one result of the parts that optimize --shard has left in a folder")
    sub.add_argument("folder", metavar="DIR", help="run folder with part-1-of-N.npz to part-N-of-N.npz")


def _merge(options: argparse.Namespace) -> int:
    begin()
    from pk_jax.files import shards

    run, found = shards.merge(options.folder, figures=_figures)
    return _shown(run, found)


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
