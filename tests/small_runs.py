"""Design runs that compile at once: lengths themselves are judged. As a program: pk-jax with such runs."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import pk_jax
from pk_jax import cli
from pk_jax.cli import design, main
from pk_jax.design.problem import DesignProblem
from pk_jax.files import design_run, run_file
from pk_jax.mechanisms.five_bar import FiveBar

TEXT = """mechanism = "five-bar"
[variables]
proximal = [0.5, 2.0]
distal = [1.0, 2.5]
[fixed]
half_base = 0.3
[objective]
index = "isotropy"
over = "rectangle"
lower = [-0.5, 0.8]
upper = [0.5, 1.6]
nodes = [3, 3]
[search]
starts = 7
steps = 60
"""
CHUNK = 1  # many chunks, though the search is short
RESULTS = ("result.json", "result.toml", "starts.csv", "history.csv")

_made = {}


def small_problem(settings):
    """Instead of `run_file.problem_of`. Wavy, so that starts take different ways; below p + d = 3."""
    key = run_file.digest_of({**settings, "search": {}})
    if key not in _made:
        fixed = settings["fixed"]
        least = settings["constraints"].get("clearance", 0.0)  # beyond 3 no design is feasible
        _made[key] = DesignProblem(
            lambda values: FiveBar(**{**fixed, **values}),
            {name: tuple(bounds) for name, bounds in settings["variables"].items()},
            lambda mech: jnp.stack([jnp.sin(5 * mech.proximal) + mech.distal, 4 - mech.distal**2]),
            lambda mech: {"room": 3 - least - mech.proximal - mech.distal},
            name=settings["mechanism"],
        )
    return _made[key]


def stopping(run, chunks, stop=None, on_devices=design_run.on_devices):
    """What advances all starts so often, and is interrupted then."""
    left, further = [chunks], on_devices(run, None)

    def advance(search, steps):
        if left[0] == 0:
            stop() if stop else None
            raise KeyboardInterrupt
        left[0] -= 1
        return further(search, steps)

    return advance


def bytes_of(folder, names=RESULTS):
    return {name: (folder / name).read_bytes() for name in names}


def started(cache: Path, *arguments) -> subprocess.Popen:
    """This program in a process of its own, which keeps in `cache` what it compiles."""
    path = os.pathsep.join([str(Path(pk_jax.__file__).parents[1]), *sys.path])
    return subprocess.Popen(
        [sys.executable, __file__, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(cache)},
    )


def ended(process: subprocess.Popen) -> tuple[int, str, str]:
    """Its exit code, and what it said."""
    with process:
        try:
            out, err = process.communicate(timeout=1200)
        finally:
            process.kill()
    return process.returncode, out, err


def killed_runs(file: str, base: str, kills: int, seed: int) -> int:
    """Resume a run until so many of its processes were killed, then to its end. -> finished folders

    Half of the processes die just before or after one of their files gets its name, the others at any time.
    Whenever one is finished nevertheless, another folder is begun: base/1, base/2, ...
    """
    chance, folder = random.Random(seed), 1
    while kills >= 0:
        at_file = chance.randrange(1, 9) if kills % 2 else None
        before, seconds = chance.random() < 0.5, chance.uniform(0, 2.5)
        if (child := os.fork()) == 0:
            if kills and at_file:
                _die_at_file(at_file, before=before)
            os._exit(main(["optimize", file, "--out", f"{base}/{folder}", "--resume", "--quiet"]))
        if kills and not at_file:
            time.sleep(seconds)
            os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
        if os.WIFSIGNALED(status):
            kills -= 1
        elif os.WEXITSTATUS(status):
            raise RuntimeError(f"exit code {os.WEXITSTATUS(status)}")
        elif kills:
            folder += 1
        else:
            return folder
    raise AssertionError("not reached")


def _die_at_file(number: int, *, before: bool) -> None:
    replace, left = os.replace, [number]

    def replace_and_die(*paths):
        left[0] -= 1
        if left[0] == 0 and before:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(*paths)
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = replace_and_die


def _cache_everything() -> None:
    """Runs that follow each other compile once."""
    jax.config.update("jax_compilation_cache_dir", os.environ["XDG_CACHE_HOME"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


if __name__ == "__main__":
    cli._compile_cache = _cache_everything
    jax.config.update("jax_disable_most_optimizations", True)
    run_file.problem_of = small_problem
    design_run.SAVE_EVERY, design_run.CHUNK = 0.0, CHUNK
    design._figures = lambda run: None
    if sys.argv[1] == "--kills":
        print("folders", killed_runs(*sys.argv[4:], int(sys.argv[2]), int(sys.argv[3])))
    else:
        sys.exit(main(sys.argv[1:]))
