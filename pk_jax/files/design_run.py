"""A design run on disk: a folder that a killed run leaves ready to go on from, to the same last bit.

    config.toml       the run file as given
    run.json          settings, versions; hosts and dates in a section of their own
    checkpoint.npz    the state of the search, of every start, and the history so far
    history.csv, starts.csv, result.toml, figures; result.json comes last and says that the run is finished

What is computed is a matter of the run file alone: the search goes on in chunks of `CHUNK` evaluations,
whenever it is saved and however often it was interrupted.
"""

from __future__ import annotations

import datetime
import os
import platform
import time
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from pk_jax.design.optimum import OptimizedDesign
from pk_jax.design.search import Search, advance, arrays_of, begin, search_of, start_boxes, summary
from pk_jax.files.checkpoint import packed, read_saved
from pk_jax.files.design_result import HISTORY, RESULT, Draw, history_row, write_results
from pk_jax.files.run_file import RunFile, digest_of, first_difference, settings_of
from pk_jax.files.run_folder import RunFolder, run_folder

CHUNK = 10  # evaluations of every start between two lines of the history
SAVE_EVERY = 5.0  # s, at least, between checkpoints
CHECKPOINT, CONFIG, ABOUT = "checkpoint.npz", "config.toml", "run.json"

Report = Callable[[str], None]
Further = Callable[[Search, int], Search]  # (search, evaluations a start) -> search, on the host


class Part(NamedTuple):
    """Which starts: every `count`-th from the `number`-th on, counted from 1."""

    number: int = 1
    count: int = 1

    def boxes(self, run: RunFile) -> np.ndarray:
        """Its starts in the unit box. -> (starts, n)"""
        every = start_boxes(run.problem, run.starts, seed=run.settings["search"]["seed"])
        return every[self.number - 1 :: self.count]

    def size(self, run: RunFile) -> int:
        """How many starts it has."""
        return len(range(self.number - 1, run.starts, self.count))

    def __str__(self) -> str:
        return f"part-{self.number}-of-{self.count}"


class Progressed(NamedTuple):
    """How far a search is; never changed, so that what is saved fits together."""

    search: Search
    history: np.ndarray  # (chunks, columns) of `HISTORY`
    steps: int  # evaluations that every start could have taken

    def is_over(self, run: RunFile) -> bool:
        return self.steps >= run.steps or bool(np.all(self.search.is_done))


class Finished(NamedTuple):
    """What became of a run."""

    design: OptimizedDesign | None  # None: it had been finished before
    history: np.ndarray | None
    folder: Path


# --- the run


def run_into(
    path: str | os.PathLike,
    run: RunFile,
    *,
    resume: bool = False,
    devices: Sequence[Any] | None = None,
    further: Further | None = None,
    report: Report | None = None,
    draw: Draw | None = None,
) -> Finished:
    """Search the designs of a run file and write all of it into a folder.

    resume:   go on from the checkpoint there is; without one, begin
    devices:  to spread the starts over (default: one); the result is the same
    further:  what advances all starts (default: `advance` on the devices)
    report:   called with a line that says how far it is
    draw:     writes figures into the folder

    ValueError for a folder of another run, for one that holds a checkpoint where `resume` is not asked for,
    and for a damaged checkpoint; OSError where it cannot be written or another process does so.
    KeyboardInterrupt leaves a checkpoint.
    """
    refuse_parts(Path(path).expanduser())
    with run_folder(path) as folder:
        if not is_open(folder.path, run, resume=resume):
            return Finished(None, None, folder.path)
        state = begun_or_saved(folder.path, run, Part())
        state = search_from(state, folder, run, Part(), further or on_devices(run, devices), report)
        if report is not None:
            report("writing the results")
        design = summary(run.problem, state.search)
        write_results(folder, run, design, state.search, state.history, draw)
    return Finished(design, state.history, folder.path)


def is_open(folder: Path, run: RunFile, *, resume: bool, result: Path | None = None) -> bool:
    """Whether the run in a folder has still to be done; ValueError where it is not to be touched."""
    result = result or folder / RESULT
    config, has_checkpoint = folder / CONFIG, (folder / CHECKPOINT).exists()
    if config.exists():
        there = settings_of(config.read_bytes(), config)
        if digest_of(there) != run.digest:
            difference = first_difference(there, run.settings)
            raise ValueError(f"{folder} holds another run: {difference}; choose another folder")
    elif result.exists() or has_checkpoint:
        raise ValueError(f"{folder} holds a run without its {CONFIG}: choose another folder")
    if (result.exists() or has_checkpoint) and not resume:
        what = "a finished run" if result.exists() else "an interrupted run; --resume goes on with it"
        raise ValueError(f"{folder} holds {what}: choose another folder")
    return not result.exists()


def refuse_parts(folder: Path) -> None:
    """ValueError where a folder holds parts of a run, which are merged and not run over."""
    for part in sorted(folder.glob("part-*-of-*")):
        raise ValueError(
            f"{folder} holds {part.name}, part of a run: merge the parts or choose another folder"
        )


def on_devices(run: RunFile, devices: Sequence[Any] | None) -> Further:
    return lambda search, count: advance(run.problem, search, count, devices=devices)


def search_from(
    state: Progressed,
    folder: RunFolder | None,
    run: RunFile,
    part: Part,
    further: Further,
    report: Report | None = None,
) -> Progressed:
    """Search to the end, from a state on; however that ends, the folder has a checkpoint of it.

    folder: None keeps nothing
    """
    if folder is not None:
        write_about(folder, run, part)
    saved = time.monotonic()
    clock = _Clock(run.steps)
    try:
        while not state.is_over(run):
            state = _advanced(state, run, further)
            if report is not None:
                report(_line(run, state, clock))
            if folder is not None and time.monotonic() - saved >= SAVE_EVERY:
                save(folder, run, part, state)
                saved = time.monotonic()
    finally:  # also when interrupted
        if folder is not None and len(state.history):
            save(folder, run, part, state)
    return state


def _advanced(state: Progressed, run: RunFile, further: Further) -> Progressed:
    count = min(CHUNK, run.steps - state.steps)
    search, steps = further(state.search, count), state.steps + count
    return Progressed(search, np.vstack([state.history, history_row(search, steps)]), steps)


class _Clock:
    """Seconds to go, from the chunks done so far; the first one compiles and does not count."""

    def __init__(self, total: int) -> None:
        self.total, self.first = total, None

    def left(self, steps: int) -> float | None:
        now = time.monotonic()
        if self.first is None:
            self.first = steps, now
            return None
        done, seconds = steps - self.first[0], now - self.first[1]
        return seconds / done * (self.total - steps)


def _line(run: RunFile, state: Progressed, clock: _Clock) -> str:
    steps, best, violation, feasible, finished, _ = state.history[-1]
    value = f"best {best:.9g}" if feasible else f"none feasible, violation {violation:.3g}"
    left = clock.left(int(steps))
    eta = "" if left is None else f"  at most {left:.0f} s more after"
    count = len(state.search.is_done)
    return f"{run.problem.name}  {steps:.0f}/{run.steps}  {value}  {finished:.0f}/{count} starts ended{eta}"


# --- checkpoints


def save(folder: RunFolder, run: RunFile, part: Part, state: Progressed) -> None:
    folder.write(CHECKPOINT, packed_state("checkpoint", run, part, state))


def packed_state(kind: str, run: RunFile, part: Part, state: Progressed) -> bytes:
    """A checkpoint or a part, which has its run file with it."""
    header = {"kind": kind, "config": run.digest, "part": list(part), "steps": state.steps}
    header |= {"toml": run.content.decode("utf-8-sig"), "versions": versions()}
    return packed(header, {**arrays_of(state.search), "history": state.history})


def begun_or_saved(folder: Path, run: RunFile, part: Part) -> Progressed:
    """The state of the checkpoint, or that before the first evaluation."""
    if (folder / CHECKPOINT).exists():
        return progressed(folder / CHECKPOINT, "checkpoint", run, part)
    return begun(run, part)


def begun(run: RunFile, part: Part) -> Progressed:
    """The state before the first evaluation."""
    tolerance = run.settings["search"]["tolerance"]
    search = begin(run.problem, part.boxes(run), tolerance=tolerance)
    return Progressed(search, np.zeros((0, len(HISTORY))), 0)


def progressed(path: Path, kind: str, run: RunFile, part: Part) -> Progressed:
    """What a checkpoint or a part holds. ValueError, one line, where it is not of this run and part."""
    header, arrays = read_saved(path)
    wanted = {"kind": kind, "config": run.digest, "part": list(part)}
    for key, value in wanted.items():
        if header.get(key) != value:
            raise ValueError(f"{path} is of another run: its {key} is {header.get(key)!r}, not {value!r}")
    steps = header.get("steps")
    if isinstance(steps, bool) or not isinstance(steps, int) or not 0 <= steps <= run.steps:
        raise ValueError(f"{path} is damaged: steps must be an integer up to {run.steps}, got {steps!r}")
    if header.get("versions") != versions():
        warnings.warn(f"{path} was written by other versions: the last bits may differ", stacklevel=2)
    history, rows = arrays.pop("history", np.zeros(0)), -(-steps // CHUNK)
    try:
        search = search_of(run.problem, arrays)
    except ValueError as error:
        raise ValueError(f"{path} is of another run: {error}") from None
    is_whole = history.shape == (rows, len(HISTORY)) and history.dtype == np.float64
    if not is_whole or len(search.is_done) != part.size(run):
        raise ValueError(
            f"{path} is damaged: it must have {part.size(run)} starts and {rows} rows of history, "
            f"got {len(search.is_done)} and {len(history)}"
        )
    return Progressed(search, history, steps)


# --- what is written


def versions() -> dict[str, str]:
    return {name: version(name) for name in ("pk_jax", "jax", "jaxlib", "optax", "numpy")}


def write_about(folder: RunFolder, run: RunFile, part: Part) -> None:
    """The run file as it came, and what it says, by which versions, where and when."""
    if not (folder.path / CONFIG).exists():
        folder.write(CONFIG, run.content)
    first = jax.local_devices()[0]
    about = {
        "config": run.digest,
        "settings": run.settings,
        "part": list(part),
        "versions": versions(),
        "session": {  # the last one; a result does not depend on it
            "begun": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "host": platform.node(),
            "python": platform.python_version(),
            "device": f"{jax.local_device_count()} x {first.device_kind}",
            "process": os.getpid(),
        },
    }
    folder.write_json(ABOUT, about)
