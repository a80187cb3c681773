"""Parts of a design run: by processes that know nothing of each other, or by hosts that work together.

Starts do not depend on each other, so whoever searches some of them finds the same bits as who searches
all. Part i of n has the starts i, i + n, ...; it runs in a folder of its own, part-i-of-n/, and leaves the
file part-i-of-n.npz beside it. `merge` makes of all parts what an undivided run would have written.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from pk_jax.design.search import summary
from pk_jax.files.checkpoint import read_saved
from pk_jax.files.design_result import RESULT, Draw, write_results
from pk_jax.files.design_run import (
    CHECKPOINT,
    Finished,
    Further,
    Part,
    Progressed,
    Report,
    begun,
    begun_or_saved,
    is_open,
    on_devices,
    packed_state,
    progressed,
    refuse_parts,
    search_from,
    write_about,
)
from pk_jax.files.run_file import RunFile, digest_of, first_difference, parse_run, settings_of
from pk_jax.files.run_folder import run_folder

PART = re.compile(r"part-([1-9]\d{0,5})-of-([1-9]\d{0,5})\.npz")
CONNECT_WITHIN = 60  # s, all hosts

_REFUSED, _OPEN, _FINISHED = range(3)


# --- one part after another, or side by side


def part_into(
    path: str | os.PathLike,
    run: RunFile,
    part: Part,
    *,
    resume: bool = False,
    devices: Sequence[Any] | None = None,
    further: Further | None = None,
    report: Report | None = None,
) -> Path | None:
    """Search the starts of one part. -> its file in the folder; None where it had been finished before

    As `run_into`; parts of a run may be at work at the same time. ValueError where the folder holds an
    undivided run or other parts than of so many.
    """
    if part.count > run.starts:
        raise ValueError(f"--shard: {run.starts} starts make at most {run.starts} parts, got {part.count}")
    base = Path(path).expanduser()
    for name in (CHECKPOINT, RESULT):
        if (base / name).exists():
            raise ValueError(f"{base} holds a run that is not in parts ({name}): choose another folder")
    for other in base.glob("part-*-of-*"):
        if not re.fullmatch(rf"part-\d+-of-{part.count}(\.npz)?", other.name):
            raise ValueError(f"{base} holds {other.name}, not a part of {part.count}: choose another folder")
    target = base / f"{part}.npz"
    with run_folder(base / str(part)) as folder:
        if not is_open(folder.path, run, resume=resume, result=target):
            return None
        state = begun_or_saved(folder.path, run, part)
        state = search_from(state, folder, run, part, further or on_devices(run, devices), report)
        written = folder.write(target.name, packed_state("part", run, part, state))
        os.replace(written, target)
    return target


def merge(
    path: str | os.PathLike, *, figures: Callable[[RunFile], Draw] | None = None
) -> tuple[RunFile, Finished]:
    """The result of all parts in a folder, written as an undivided run would have written it.

    figures: of a run what draws them, see `run_into`

    ValueError, one line, that names the part which is missing, damaged, or of another run; then nothing is
    written. OSError where the folder cannot be written.
    """
    base = Path(path).expanduser()
    run, states = _parts(base)
    with run_folder(base) as folder:
        if not is_open(folder.path, run, resume=True):
            return run, Finished(None, None, folder.path)
        state = merged(states)
        write_about(folder, run, Part())
        design = summary(run.problem, state.search)
        draw = None if figures is None else figures(run)
        write_results(folder, run, design, state.search, state.history, draw)
    return run, Finished(design, state.history, folder.path)


def merged(states: Sequence[Progressed]) -> Progressed:
    """Parts 1 to n as one search."""
    search = jax.tree.map(lambda *leaves: _woven(leaves), *(state.search for state in states))
    longest = max(states, key=lambda state: state.steps)
    rows = len(longest.history)
    # a part that ended early stays as it was
    history = np.stack([s.history[np.minimum(np.arange(rows), len(s.history) - 1)] for s in states])
    steps, best, violation = longest.history[:, 0], history[..., 1].max(axis=0), history[..., 2].min(axis=0)
    counts = history[..., 3:].sum(axis=0)
    return Progressed(search, np.column_stack([steps, best, violation, counts]), longest.steps)


def _woven(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Entries i, i + n, ... from part i of n."""
    whole = np.empty((sum(map(len, parts)), *parts[0].shape[1:]), parts[0].dtype)
    for i, part in enumerate(parts):
        whole[i :: len(parts)] = part
    return whole


def _parts(base: Path) -> tuple[RunFile, list[Progressed]]:
    if not base.is_dir():
        raise FileNotFoundError(2, "No such folder", str(base))
    found = [match for match in map(PART.fullmatch, sorted(os.listdir(base))) if match]
    counts = {int(match[2]) for match in found}
    if len(counts) != 1:
        names = ", ".join(match[0] for match in found) or "none"
        raise ValueError(f"{base} must hold the parts of one run, part-1-of-n.npz and so on, got {names}")
    count = counts.pop()
    paths = [base / f"{Part(number, count)}.npz" for number in range(1, count + 1)]
    if missing := [path.name for path in paths if not path.exists()]:
        raise ValueError(f"{base}: {_some(missing)} missing")
    texts = [_text_of(path) for path in paths]
    settings = [settings_of(text, path) for text, path in zip(texts, paths, strict=True)]
    for path, own in zip(paths, settings, strict=True):
        if digest_of(own) != digest_of(settings[0]):
            difference = first_difference(settings[0], own)
            raise ValueError(f"{path} is of another run than {paths[0].name}: {difference}")
    run = parse_run(texts[0], paths[0])
    return run, [_state_of(run, path, Part(i, count)) for i, path in enumerate(paths, 1)]


def _some(names: list[str]) -> str:
    return f"{names[0]} is" if len(names) == 1 else f"{names[0]} and {len(names) - 1} more are"


def _text_of(path: Path) -> bytes:
    """The run file that a part has with it."""
    text = read_saved(path).header.get("toml")
    if not isinstance(text, str):
        raise ValueError(f"{path} is damaged: it must have its run file with it")
    return text.encode()


def _state_of(run: RunFile, path: Path, part: Part) -> Progressed:
    state = progressed(path, "part", run, part)
    if not state.is_over(run):
        raise ValueError(f"{path} is damaged: its search has not ended")
    return state


# --- hosts that work together


def connect(coordinator: str, process: Part) -> None:
    """Make this process the `number`-th of `count`; before anything is computed. ValueError if it fails."""
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"--coordinator must be HOST:PORT, got {coordinator!r}")
    try:
        jax.distributed.initialize(
            coordinator, process.count, process.number - 1, initialization_timeout=CONNECT_WITHIN
        )
    except RuntimeError as error:
        raise ValueError(f"--coordinator {coordinator}: {error}") from None


def together_into(
    path: str | os.PathLike,
    run: RunFile,
    *,
    resume: bool = False,
    report: Report | None = None,
    draw: Draw | None = None,
) -> Finished:
    """`run_into` by all processes that are connected, each on its devices; the first one writes the folder.

    -> a design in the first one only
    """
    base, is_first = Path(path).expanduser(), jax.process_index() == 0
    folder, start, refusal = None, begun(run, Part()), None
    with contextlib.ExitStack() as stack:
        verdict = _OPEN
        if is_first:
            try:
                refuse_parts(base)
                folder = stack.enter_context(run_folder(base))
                verdict = _OPEN if is_open(folder.path, run, resume=resume) else _FINISHED
                start = begun_or_saved(folder.path, run, Part())
            except (ValueError, OSError) as error:  # the others wait to hear of it
                verdict, refusal = _REFUSED, error
        verdict = int(multihost_utils.broadcast_one_to_all(np.int32(verdict)))
        if verdict == _REFUSED:
            raise refusal or ValueError("the first process has refused the run")
        if verdict == _FINISHED:
            return Finished(None, None, base)
        search, steps = multihost_utils.broadcast_one_to_all((start.search, np.int32(start.steps)))
        start = start._replace(search=jax.device_get(search), steps=int(steps))
        further = on_devices(run, jax.devices())  # of all processes
        state = search_from(start, folder, run, Part(), further, report if is_first else None)
        if folder is None:
            return Finished(None, None, base)
        design = summary(run.problem, state.search)
        write_results(folder, run, design, state.search, state.history, draw)
    return Finished(design, state.history, base)
