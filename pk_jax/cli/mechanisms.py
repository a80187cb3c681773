"""What a mechanism is: show, check, draw, list."""

from __future__ import annotations

import argparse
from pathlib import Path

from pk_jax.cli import begin
from pk_jax.cli.options import MECHANISM, Command, image_kind, takes_mechanism, takes_pose


def add_show(command: Command) -> None:
    takes_mechanism(command("show", _show, "a mechanism: its fields, home, size and margins"))


def _show(options: argparse.Namespace) -> int:
    begin()
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.shown import describe

    print(describe(named_mechanism(options.mechanism, options.unit)))
    return 0


def add_check(command: Command) -> None:
    sub = command(
        "check", _check, "whether a mechanism keeps the laws of kinematics, or a design run can be run"
    )
    takes_mechanism(sub, f"{MECHANISM}, or a RUN.toml of optimize")


def _check(options: argparse.Namespace) -> int:
    progress = begin()
    from pk_jax.files import checked
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.run_file import is_run_file, read_run

    if is_run_file(options.mechanism):
        if options.unit is not None:
            raise ValueError("--unit is for a mechanism, a run file says its own")
        text = checked.run_text(options.mechanism, read_run(options.mechanism))
    else:
        named = named_mechanism(options.mechanism, options.unit)
        progress.say("checking the laws")
        text = checked.mechanism_text(named)
    progress.close()
    print(text)
    return 0


def add_draw(command: Command) -> None:
    sub = command("draw", _draw, "draw a configuration")
    sub.add_argument("-o", "--out", required=True, metavar="FILE", help="a .png, .svg or .pdf")
    takes_mechanism(sub)
    takes_pose(sub)


def _draw(options: argparse.Namespace) -> int:
    kind = image_kind(options.out)
    begin()
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


def add_list(command: Command) -> None:
    command("list", _list, "the catalogue of published designs, and the families of a mechanism file")


def _list(options: argparse.Namespace) -> int:
    from pk_jax.files.mechanism_file import FAMILIES, keys_of
    from pk_jax.mechanisms.catalogue import CATALOGUE

    width = max(map(len, CATALOGUE)) + 2
    for name, entry in CATALOGUE.items():
        print(f"{name:{width}}{entry.source}")
    print("\nfamilies of a mechanism file: their keys beside family and unit; [key] may be left out")
    for name, family in FAMILIES.items():
        keys = (key if needed else f"[{key}]" for key, needed in keys_of(family).items())
        print(f"{name:{width}}{', '.join(keys)}")
    return 0
