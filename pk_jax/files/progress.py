"""A line on stderr that says how far a long computation is."""

from __future__ import annotations

import sys
import time
from typing import TextIO


class Progress:
    """Rewrites one line on a terminal; elsewhere prints a line at most every few seconds."""

    def __init__(self, stream: TextIO | None = None, *, every: float = 2.0) -> None:
        self.stream = sys.stderr if stream is None else stream
        self.every = every if not self.stream.isatty() else 0.1
        self.started = self.shown = time.monotonic()
        self.width = 0

    def __call__(self, what: str, done: int, total: int, best: float | None = None) -> None:
        """Say that `done` of at most `total` steps of `what` are done; `best` is the value so far."""
        value = "" if best is None else f"  best {best:.9g}"
        self.note(f"{what}  {done}/{total}{value}", is_last=done >= total)

    def note(self, what: str, *, is_last: bool = False) -> None:
        """Say how far it is, unless something was said just now."""
        if is_last or time.monotonic() - self.shown >= self.every:
            self.say(what)

    def say(self, what: str) -> None:
        """Say what begins now."""
        self.shown = time.monotonic()
        self._line(f"{what}  {self.shown - self.started:.1f} s")

    def close(self) -> None:
        """End the line."""
        if self.stream.isatty() and self.width:
            self.stream.write("\n")
            self.stream.flush()
            self.width = 0

    def _line(self, text: str) -> None:
        if self.stream.isatty():
            self.stream.write("\r" + text.ljust(self.width))
            self.width = len(text)
        else:
            self.stream.write(text + "\n")
        self.stream.flush()
