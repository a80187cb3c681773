"""The control loop: simulate."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from pk_jax.cli import NUMERICAL, begin
from pk_jax.cli.options import Command, image_kind, takes_mechanism


def add_simulate(command: Command) -> None:
    sub = command("simulate", _simulate, "the control loop of a nine-length platform, by every feedback")
    takes_mechanism(sub)
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


def _simulate(options: argparse.Namespace) -> int:
    kind = image_kind(options.out) if options.out else None
    progress = begin()
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
        if table:
            table.write(simulated.samples_csv(one, runs).encode())
        if image:
            axes = draw_tracking(runs, scale=named.metres, unit="" if named.unit == "1" else named.unit)
            axes.set_title(f"{Path(named.name).name}: {one.reference.name}")
            axes.figure.savefig(image, format=kind, dpi=150)
        print(as_json(simulated.table_of(one, runs)) if options.json else simulated.table_text(one, runs))
    is_ok = not any(row["not_ok"] for row in simulated.table_of(one, runs)["feedback"].values())
    return 0 if is_ok else NUMERICAL
