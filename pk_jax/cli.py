"""pk-jax: parse, call one function, print or save.

Exit codes: 0 good, 2 bad input, 3 rows that are not OK (--strict), 4 file system, 5 numerical stop,
130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

BAD_INPUT, NOT_OK, FILE_SYSTEM, NUMERICAL, INTERRUPTED = 2, 3, 4, 5, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = _parser()
    options = parser.parse_args(_with_pose_joined(sys.argv[1:] if arguments is None else arguments))
    try:
        with _plain_warnings(), _stopped_by_signals():
            return options.run(options)
    except ValueError as error:
        return _fail(BAD_INPUT, str(error))
    except BrokenPipeError:  # the reader of our output has gone, e.g. `| head`
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f": {error.filename}" if error.filename else ""
        return _fail(FILE_SYSTEM, f"{error.strerror or error}{where}")
    except FloatingPointError as error:
        return _fail(NUMERICAL, str(error))
    except KeyboardInterrupt:
        return _fail(INTERRUPTED, "interrupted")


def _fail(code: int, message: str) -> int:
    print(f"pk-jax: {' '.join(message.split())}", file=sys.stderr)
    return code


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings in one line, each kind once."""
    said = set()

    def show(message, category, filename, lineno, *_):
        if (filename, lineno) not in said:
            said.add((filename, lineno))
            print(f"pk-jax: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextlib.contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """What ends the process otherwise ends it as Ctrl-C does: temporary files are taken away."""

    def stop(*_):
        raise KeyboardInterrupt

    before = {}
    with contextlib.suppress(ValueError):  # signals belong to the main thread
        for each in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(each) == signal.SIG_DFL:  # `nohup` ignores SIGHUP
                before[each] = signal.signal(each, stop)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


# --- the commands; jax is imported only when one runs


def _forward(options: argparse.Namespace) -> int:
    if options.sigma and not options.closed_form:
        raise ValueError("--sigma is for --closed-form")
    if options.closed_form:
        return _convert(options, "nine_length_rows", sigma=options.sigma)
    return _convert(options, "forward_rows")


def _inverse(options: argparse.Namespace) -> int:
    return _convert(options, "inverse_rows", free=options.free)


def _convert(options: argparse.Namespace, function: str, **more: str | None) -> int:
    progress = _begin()
    from pk_jax.files import stream
    from pk_jax.files.named import named_mechanism

    if options.chunk < 1:
        raise ValueError(f"--chunk must be at least 1, got {options.chunk}")
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


def _jacobian(options: argparse.Namespace) -> int:
    _begin()
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.shown import as_json, as_text, jacobians_at

    found = jacobians_at(named_mechanism(options.mechanism, options.unit), options.pose, options.free)
    print(as_json(found._asdict()) if options.json else as_text(found))
    return 0


def _draw(options: argparse.Namespace) -> int:
    kind = _image_kind(options.out)
    _begin()
    from pk_jax.files.atomic import output_file
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.shown import configuration_at
    from pk_jax.viz.skeleton import draw

    named = named_mechanism(options.mechanism, options.unit)
    with output_file(options.out) as file:
        pose, joints, _ = configuration_at(named, options.pose, free=options.free)
        axes = draw(named.mechanism, pose, joints)
        axes.set_title(Path(named.name).name)
        if named.path and named.unit != "1":  # those of the catalogue are over a length of reference
            for name in "xyz":
                if hasattr(axes, f"set_{name}label"):
                    getattr(axes, f"set_{name}label")(f"${name}$ (m)")
        axes.figure.savefig(file, format=kind, dpi=150)
    return 0


def _singularity(options: argparse.Namespace) -> int:
    kind = _image_kind(options.out) if options.out else None
    progress = _begin()
    from pk_jax.files import singular
    from pk_jax.files.atomic import output_file
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.options import signs_of
    from pk_jax.files.shown import as_json, configuration_at
    from pk_jax.files.stream import pose_of
    from pk_jax.viz import singularity as viz

    named = named_mechanism(options.mechanism, options.unit)
    with contextlib.ExitStack() as stack:
        image = stack.enter_context(output_file(options.out)) if options.out else None
        if options.pose is not None:
            signs = signs_of(options.mode)
            pose, joints, _ = configuration_at(named, options.pose, signs, options.free)
            found = singular.classified(named, pose, joints, options.tol)
            print(as_json(found) if options.json else singular.classified_text(found))
            if image:
                axes = viz.draw_screws(named.mechanism, pose, joints)
                axes.set_title(f"{Path(named.name).name}: {found['kind']}")
                axes.figure.savefig(image, format=kind, dpi=150)
            return 0
        table = stack.enter_context(output_file(options.csv)) if options.csv else None
        at = None if options.at is None else pose_of(named, options.at, "--at")
        locus = singular.locus_of(
            named,
            options.axes,
            at,
            options.range,
            options.mode,
            options.kind or ("I", "II"),
            options.nodes,
            progress,
            options.free,
        )
        progress.close()
        print(singular.locus_text(named, locus))
        if table:
            table.write(singular.locus_rows(named, locus).encode())
        if image:
            unit = named.unit if (named.path or options.unit) and named.unit != "1" else ""
            figure = viz.draw_locus(named.mechanism, locus, unit=unit, scale=named.metres)
            figure.savefig(image, format=kind, dpi=150)
    return 0


def _map(options: argparse.Namespace) -> int:
    kind = _image_kind(options.out) if options.out else None
    _begin()
    from pk_jax.files import limits
    from pk_jax.files.atomic import output_file
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.stream import pose_of
    from pk_jax.viz.workspace_map import draw_map

    named = named_mechanism(options.mechanism, options.unit)
    with contextlib.ExitStack() as stack:
        image = stack.enter_context(output_file(options.out)) if options.out else None
        table = stack.enter_context(output_file(options.csv)) if options.csv else None
        at = None if options.at is None else pose_of(named, options.at, "--at")
        found, travels = limits.map_of(
            named, options.axes, at, options.range, options.mode, options.free, options.nodes
        )
        print(limits.map_text(named, found, travels))
        if table:
            table.write(limits.map_rows(named, found).encode())
        if image:
            unit = "" if named.unit == "1" else named.unit
            axes = draw_map(found, unit=unit, scale=named.metres)
            axes.set_title(Path(named.name).name)
            axes.figure.savefig(image, format=kind, dpi=150)
    return 0


def _certify(options: argparse.Namespace) -> int:
    progress = _begin()
    from pk_jax.files import limits
    from pk_jax.files.named import named_mechanism

    named = named_mechanism(options.mechanism, options.unit)
    found = limits.certificates_of(
        named, options.range, options.at_least, options.within, options.most, progress
    )
    progress.close()
    print(limits.certificates_text(named, found, options.at_least))
    return 0 if all(each.is_proved for each in found.values()) else NUMERICAL


def _calibrate(options: argparse.Namespace) -> int:
    if options.out and Path(options.out).suffix.lower() != ".toml":
        raise ValueError(f"-o must end in .toml, got {options.out!r}")
    progress = _begin()
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


def _simulate(options: argparse.Namespace) -> int:
    kind = _image_kind(options.out) if options.out else None
    progress = _begin()
    from pk_jax.files import simulated
    from pk_jax.files.atomic import output_file
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.shown import as_json
    from pk_jax.viz.nine_lengths import draw_tracking

    named = named_mechanism(options.mechanism, options.unit)
    feedbacks = simulated.feedbacks_of(options.feedback)
    one = simulated.experiment_of(
        named,
        options.reference,
        options.plant,
        options.gain,
        radius=options.radius,
        frequency=options.frequency,
        twist=options.twist,
        duration=options.duration,
    )
    with contextlib.ExitStack() as stack:
        image = stack.enter_context(output_file(options.out)) if options.out else None
        table = stack.enter_context(output_file(options.csv)) if options.csv else None
        runs = simulated.runs_of(one, feedbacks, options.seeds, options.seed, progress.say)
        progress.close()
        print(as_json(simulated.table_of(one, runs)) if options.json else simulated.table_text(one, runs))
        if table:
            table.write(simulated.samples_csv(one, runs).encode())
        if image:
            axes = draw_tracking(runs, scale=named.metres, unit="" if named.unit == "1" else named.unit)
            axes.set_title(f"{Path(named.name).name}: {one.reference.name}")
            axes.figure.savefig(image, format=kind, dpi=150)
    is_ok = not any(row["not_ok"] for row in simulated.table_of(one, runs)["feedback"].values())
    return 0 if is_ok else NUMERICAL


def _sensors(options: argparse.Namespace) -> int:
    if options.out and Path(options.out).suffix.lower() != ".toml":
        raise ValueError(f"-o must end in .toml, got {options.out!r}")
    progress = _begin()
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


def _image_kind(path: str) -> str:
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in ("png", "svg", "pdf"):
        raise ValueError(f"-o must end in .png, .svg or .pdf, got {path!r}")
    return kind


def _show(options: argparse.Namespace) -> int:
    _begin()
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.shown import describe

    print(describe(named_mechanism(options.mechanism, options.unit)))
    return 0


def _reproduce(options: argparse.Namespace) -> int:
    progress = _begin()
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


def _workspace(options: argparse.Namespace) -> int:
    _begin()
    import pk_jax as pk

    mech = _mechanism(options)
    nodes = None if options.nodes is None else tuple(options.nodes)
    found = pk.workspace_indices(mech, options.rule, nodes)
    print(f"{mech!r}\nrule {options.rule}")
    for name in ("gii", "gri", "sui", "area"):
        error = float(getattr(found.error, name))
        estimate = f"  +- {error:.1e}" if error == error else ""
        print(f"{name:5}{float(getattr(found, name)):.12g}{estimate}")
    return 0


def _optimize(options: argparse.Namespace) -> int:
    progress = _begin()
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


def _mechanism(options: argparse.Namespace):
    """The 2-RPR or 2-RRR that the options describe, eqs. (20) and (22) filled in."""
    import pk_jax as pk
    from pk_jax.files.named import named_mechanism

    if options.mechanism in ("2-rpr", "2-rrr"):
        if options.l_min is None:
            raise ValueError(f"--l-min is needed for {options.mechanism}")
        r, l_min = options.half_base, options.l_min
        l_max = l_min + 2 * r if options.l_max is None else options.l_max
        if options.mechanism == "2-rpr":
            if options.proximal is not None:
                raise ValueError("--proximal is for 2-rrr only")
            return pk.TwoRPR(half_base=r, l_min=l_min, l_max=l_max)
        proximal = r if options.proximal is None else options.proximal
        return pk.FiveBar(half_base=r, proximal=proximal, distal=l_max - proximal, reach=(l_min, l_max))
    if options.l_min is not None or options.l_max is not None or options.proximal is not None:
        raise ValueError(f"{options.mechanism} has its own lengths and takes no others")
    return named_mechanism(options.mechanism).mechanism


def _list(options: argparse.Namespace) -> int:
    from pk_jax.mechanisms.catalogue import CATALOGUE

    width = max(map(len, CATALOGUE)) + 2
    for name, entry in CATALOGUE.items():
        print(f"{name:{width}}{entry.source}")
    return 0


def _begin():
    """What every computing command needs: float64, a compile cache of its own, a progress line."""
    from pk_jax.files.progress import Progress
    from pk_jax.precision import enable_x64

    enable_x64()
    _compile_cache()
    return Progress()


def _compile_cache() -> None:
    """Keep compiled functions between runs, where only the user can write: a cache is code."""
    import jax

    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pk_jax"
    with contextlib.suppress(OSError, RuntimeError):
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        if (state := cache.stat()).st_uid == os.getuid() and not state.st_mode & 0o077:
            jax.config.update("jax_compilation_cache_dir", str(cache))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


# --- the command line


class _Parser(argparse.ArgumentParser):
    """Errors in one line, like all others."""

    def error(self, message: str):
        self.exit(BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def _with_pose_joined(arguments: Sequence[str]) -> list[str]:
    """`--pose -1,2` as `--pose=-1,2`: argparse would take the value for an option."""
    rest, joined = iter(arguments), []
    for each in rest:
        value = next(rest, None) if each in ("--pose", "--at", "--mode", "--range", "--twist") else None
        joined.append(each if value is None else f"{each}={value}")
    return joined


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="pk-jax", description="Differentiable kinematics of parallel mechanisms.", allow_abbrev=False
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name, run, text):
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        sub.set_defaults(run=run)
        return sub

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

    sub = command("workspace", _workspace, "GII, GRI and SUI of a 2-RPR or 2-RRR")
    sub.add_argument("mechanism", help="2-rpr, 2-rrr, a catalogue entry (see: pk-jax list) or a TOML file")
    sub.add_argument("--half-base", type=float, default=1.0, help="R (default: 1)")
    sub.add_argument("--l-min", type=float, help="least distance from a base joint to the end point")
    sub.add_argument("--l-max", type=float, help="greatest distance (default: l_min + 2 R, eq. 20)")
    sub.add_argument("--proximal", type=float, help="driven link of the 2-rrr (default: R)")
    sub.add_argument("--rule", default="gauss", help="gauss, midpoint or paper (default: gauss)")
    sub.add_argument("--nodes", type=int, nargs=2, metavar=("OUTER", "INNER"), help="nodes of the rule")

    sub = command("optimize", _optimize, "maximize the composite index of a design space by gradients")
    sub.add_argument("space", help="2-rpr or 2-rrr")
    sub.add_argument("--weights", type=float, nargs=3, default=(1.0, 1.0, 1.0), metavar=("GII", "GRI", "SUI"))
    sub.add_argument("--starts", type=int, default=12, help="number of starts (default: %(default)s)")
    sub.add_argument("--steps", type=int, default=100, help="most evaluations a start (default: %(default)s)")

    named = "a catalogue entry (see: pk-jax list) or a TOML file"
    unit = "of lengths: m, mm, cm, in or um (default: the file's own, m for a catalogue entry)"
    free = "redundant joint, or margin, conditioning or middle: what to choose it by (default: as at home)"
    for name, run, rows, text in (
        ("fk", _forward, "joints", "forward kinematics of rows of joints (CSV in, CSV out)"),
        ("ik", _inverse, "poses", "inverse kinematics of rows of poses (CSV in, CSV out)"),
    ):
        sub = command(name, run, text)
        sub.add_argument("mechanism", help=named)
        sub.add_argument(
            "rows", metavar=f"{rows.upper()}.csv", help=f"file of {rows}, - for stdin; angles in rad"
        )
        sub.add_argument("-o", "--out", metavar="FILE", help="where to (default: stdout)")
        sub.add_argument("--strict", action="store_true", help="exit code 3 where a row is not OK")
        sub.add_argument(
            "--columns", metavar="A,B,...", help=f"which columns are the {rows}: names or numbers"
        )
        sub.add_argument("--unit", help=unit)
        if rows == "joints":
            sub.add_argument(
                "--closed-form",
                action="store_true",
                help="of nine lengths: no guess, then weighted least squares",
            )
            sub.add_argument(
                "--sigma", metavar="LEG,SENSOR", help="with it: standard deviations of the lengths"
            )
        else:
            sub.add_argument("--free", metavar="VALUE", help=free)
        sub.add_argument(
            "--chunk", type=int, default=65536, metavar="N", help="rows at a time (default: %(default)s)"
        )

    printed = command("jacobian", _jacobian, "A, B and J of a configuration, in metres and radians")
    printed.add_argument("--json", action="store_true", help="machine-readable")
    drawn = command("draw", _draw, "draw a configuration")
    drawn.add_argument("-o", "--out", required=True, metavar="FILE", help="a .png, .svg or .pdf")
    shown = command("show", _show, "a mechanism: its fields, home, size and margins")
    for sub in (printed, drawn, shown):
        sub.add_argument("mechanism", help=named)
        sub.add_argument("--unit", help=unit)
        if sub is not shown:
            sub.add_argument("--pose", metavar="X,Y,...", help="as a row of ik (default: home)")
            sub.add_argument("--free", metavar="VALUE", help=free)

    sub = command("singularity", _singularity, "where a mechanism is singular, and how far from it a pose is")
    sub.add_argument("mechanism", help=named)
    sub.add_argument("--unit", help=unit)
    sub.add_argument("--pose", metavar="X,Y,...", help="classify this pose instead of seeking the loci")
    sub.add_argument("--tol", type=float, default=1e-6, help="sigma below this is singular (default: 1e-6)")
    sub.add_argument("--json", action="store_true", help="with --pose: machine-readable")
    sub.add_argument(
        "--axes",
        metavar="A,B",
        help="coordinates of the map, of x, y, z, rx, ry, rz, phi; s, roll, pitch, yaw (default: first two)",
    )
    sub.add_argument("--at", metavar="X,Y,...", help="pose with the other coordinates (default: home)")
    span = "range of an axis, angles in rad"
    sub.add_argument("--range", action="append", default=[], metavar="A=LO:HI", help=span)
    sub.add_argument("--free", metavar="VALUE", help=f"{free}; for loci a value")
    sub.add_argument(
        "--mode", metavar="+-+", help="one working mode (default: all; with --pose: the mechanism's own)"
    )
    sub.add_argument("--kind", action="append", choices=("I", "II"), help="only this type (default: both)")
    sub.add_argument(
        "--nodes", type=int, help="of the grid, along each axis (default: 101; 25 for three axes)"
    )
    sub.add_argument("-o", "--out", metavar="FILE", help="the map with its loci, a .png, .svg or .pdf")
    sub.add_argument("--csv", metavar="FILE", help="every point of the loci")

    sub = command("map", _map, "the workspace within the limits of all joints: smallest margin, and travels")
    sub.add_argument("mechanism", help=named)
    sub.add_argument("--unit", help=unit)
    sub.add_argument("--axes", metavar="A,B", help="coordinates of the map (default: the first two)")
    sub.add_argument("--at", metavar="X,Y,...", help="pose with the other coordinates (default: home)")
    sub.add_argument("--range", action="append", default=[], metavar="A=LO:HI", help=span)
    sub.add_argument("--mode", metavar="+-+", help="working mode (default: the mechanism's own)")
    sub.add_argument(
        "--free", metavar="VALUE", help="kinematically redundant joints, or any (default: home's)"
    )
    sub.add_argument("--nodes", type=int, help="of the grid, along each axis (default: 201)")
    sub.add_argument("-o", "--out", metavar="FILE", help="the map, a .png, .svg or .pdf")
    sub.add_argument("--csv", metavar="FILE", help="every node of the map")

    sub = command(
        "certify",
        _certify,
        "prove that a box of poses has no singularity, and that limits don't let it be left",
    )
    sub.add_argument("mechanism", help=named)
    sub.add_argument("--unit", help=unit)
    sub.add_argument(
        "--range", action="append", default=[], metavar="A=LO:HI", help="of a coordinate or free joint; rad"
    )
    sub.add_argument("--at-least", type=float, default=0.0, help="what |det A| over that at home must exceed")
    sub.add_argument("--within", metavar="A,B", help="margins that limit the poses (default: all)")
    sub.add_argument(
        "--most", type=int, default=1_000_000, metavar="N", help="boxes to examine (default: %(default)s)"
    )

    sub = command(
        "calibrate", _calibrate, "identify a geometry from logged poses and joints, with standard deviations"
    )
    sub.add_argument("log", metavar="LOG.csv", help="poses and joints in one file, - for stdin")
    sub.add_argument(
        "--nominal",
        metavar="GEOMETRY",
        help=f"what to start from, {named} (default: a Stewart platform of six legs, from the log alone)",
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
    sub.add_argument("--unit", help=unit)
    sub.add_argument(
        "-o", "--out", metavar="FILE", help="the geometry, a .toml; kept unless the search stopped"
    )
    sub.add_argument("--json", action="store_true", help="machine-readable")

    sub = command("simulate", _simulate, "the control loop of a nine-length platform, by every feedback")
    sub.add_argument("mechanism", help=named)
    sub.add_argument("--unit", help=unit)
    sub.add_argument("--reference", choices=("circle", "step"), default="circle", help="default: %(default)s")
    sub.add_argument("--radius", type=float, help="of the circle (default: a fifth of the platform's size)")
    sub.add_argument("--frequency", type=float, default=0.5, help="of the circle, Hz (default: %(default)s)")
    sub.add_argument("--twist", metavar="X,Y,Z,RX,RY,RZ", help="of the step, rad (default: small)")
    sub.add_argument("--duration", type=float, help="s (default: 3; step: 0.5)")
    sub.add_argument(
        "--feedback", action="append", default=[], help="joint, legs, closed, nine or learned (default: all)"
    )
    sub.add_argument(
        "--plant",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="period, delay, lag, rate_limit, noise, quantum, encoder_bias, sensor_bias, geometry_error or "
        "sensor_geometry_error; s and the unit of lengths",
    )
    sub.add_argument(
        "--gain",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="kp, ki, kd, feed_forward or anti_windup",
    )
    sub.add_argument("--seeds", type=int, default=20, help="machines (default: %(default)s)")
    sub.add_argument("--seed", type=int, default=0, help="of the random numbers (default: %(default)s)")
    sub.add_argument("--json", action="store_true", help="machine-readable")
    sub.add_argument("-o", "--out", metavar="FILE", help="errors over time, a .png, .svg or .pdf")
    sub.add_argument("--csv", metavar="FILE", help="every sample")

    sub = command("sensors", _sensors, "rank, condition and noise gains of three length sensors; place them")
    sub.add_argument("mechanism", help=f"{named}, with nine rows, or six to place sensors on")
    sub.add_argument("--unit", help=unit)
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

    command("list", _list, "the catalogue of published designs")
    return parser


if __name__ == "__main__":
    sys.exit(main())
