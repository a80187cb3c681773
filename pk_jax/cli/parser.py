"""The command line: which verbs there are. None of them imports jax before it runs."""

from __future__ import annotations

import argparse
import itertools
import re
import sys
from collections.abc import Sequence

from pk_jax.cli import BAD_INPUT, analysis, control, design, kinematics, mechanisms, papers

_VERBS = (  # in the order of --help
    papers.add_reproduce,
    analysis.add_workspace,
    design.add_optimize,
    design.add_merge,
    kinematics.add_forward,
    kinematics.add_inverse,
    kinematics.add_modes,
    kinematics.add_jacobian,
    mechanisms.add_draw,
    mechanisms.add_show,
    mechanisms.add_check,
    analysis.add_singularity,
    analysis.add_map,
    analysis.add_certify,
    design.add_calibrate,
    control.add_simulate,
    design.add_sensors,
    mechanisms.add_list,
)


def parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """The options, with the function that runs them as `run`."""
    parser = _Parser(
        prog="pk-jax", description="Differentiable kinematics of parallel mechanisms.", allow_abbrev=False
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name, run, text):
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        sub.set_defaults(run=run)
        return sub

    for add in _VERBS:
        add(command)
    for argument in arguments:
        if not argument or "\0" in argument:  # an empty variable of a script; what no file can be called
            parser.error(f"an argument must not be empty or hold a null character, got {argument!r}")
    return parser.parse_args(_with_values_joined(arguments))


class _Parser(argparse.ArgumentParser):
    """Errors in one line, like all others."""

    def error(self, message: str):
        self.exit(BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def _with_values_joined(arguments: Sequence[str]) -> list[str]:
    """`--pose -1,2` as `--pose=-1,2`, `--joints -1 2` too: argparse would take the values for options."""
    rest, joined = list(arguments), []
    while rest:
        option = rest.pop(0)
        most = _VALUES.get(option, 0)
        values = list(itertools.takewhile(_is_value, rest)) if most > 1 else rest[:most]
        del rest[: len(values)]
        joined.append(f"{option}={','.join(values)}" if values else option)
    return joined


_VALUES = dict.fromkeys(("--pose", "--at", "--mode", "--range", "--twist"), 1)
_VALUES |= dict.fromkeys(("--joints", "--lengths"), sys.maxsize)


def _is_value(argument: str) -> bool:
    """Not an option: -1 and -.5 are numbers."""
    return re.match(r"-+[a-z]", argument) is None
