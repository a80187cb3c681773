"""A run folder: one writer, whole files or none."""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pk_jax.files.atomic import write_atomically


class RunFolder:
    """A folder that one process at a time writes into, each file atomically."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, name: str, content: bytes) -> Path:
        """Write a file whole, see `write_atomically`."""
        target = self.path / name
        write_atomically(target, content)
        return target

    def write_text(self, name: str, content: str) -> Path:
        return self.write(name, content.encode())

    def write_figure(self, name: str, figure: Any) -> Path:
        """A matplotlib figure as PNG."""
        image = io.BytesIO()
        figure.savefig(image, format="png", dpi=150, metadata={"Software": None})
        return self.write(name, image.getvalue())

    def write_json(self, name: str, content: Any) -> Path:
        """Strict JSON: NaN and infinity are refused, keys keep their order."""
        return self.write_text(name, json.dumps(content, indent=2, allow_nan=False) + "\n")


@contextlib.contextmanager
def run_folder(path: str | os.PathLike) -> Iterator[RunFolder]:
    """Open `path` for writing, made where it is missing. OSError where it cannot be written.

    A second writer is refused while the first one is at work (BlockingIOError).
    """
    folder = Path(path).expanduser()
    missing = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = os.open(folder / ".lock", os.O_CREAT | os.O_RDWR, 0o666)
    except OSError:
        _remove_empty(missing)
        raise
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_ours = os.path.samestat(os.fstat(lock), os.stat(folder / ".lock"))
        except OSError:
            is_ours = False
        if not is_ours:  # held, or taken away between opening and locking it
            raise BlockingIOError(f"{folder} is being written by another process")
        for leftover in folder.glob(".*.part"):  # of a writer that was killed
            leftover.unlink(missing_ok=True)
        try:
            yield RunFolder(folder)
        finally:
            os.unlink(folder / ".lock")
    finally:
        os.close(lock)
        _remove_empty(missing)


def _remove_empty(folders: list[Path]) -> None:
    """Take back folders that were made and never filled, innermost first."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
