"""Rows of numbers as CSV, read and written in chunks, strictly: no row is guessed, dropped or cut.

Read: UTF-8, commas, a header line or none, empty lines and lines that start with # skipped. A first
line that names the columns is the header; the columns wanted are found in it by name, which may carry
the unit (`l1_mm`), and the others are ignored.
"""

from __future__ import annotations

import contextlib
import csv
import os
import stat
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from typing import BinaryIO

import numpy as np

from pk_jax.files.columns import Layout, arrange, is_number, numbers, short

CHUNK = 65_536  # rows
LONGEST = 1 << 20  # bytes of a line
_BOM = b"\xef\xbb\xbf"


@contextlib.contextmanager
def open_rows(
    path: str, layouts: Sequence[Layout], *, unit: str, columns: str | None = None, chunk: int = CHUNK
) -> Iterator[RowReader]:
    """A reader of the rows of a file ("-": of stdin), in the first layout that fits. ValueError, OSError."""
    if path == "-":
        yield RowReader(sys.stdin.buffer, "stdin", layouts, unit, columns, chunk)
        return
    with open(os.path.expanduser(path), "rb") as file:
        yield RowReader(file, path, layouts, unit, columns, chunk)


class RowReader:
    """Iterates over chunks of rows, float64 (rows, columns of `layout`); `layout` is known before."""

    def __init__(
        self,
        file: BinaryIO,
        name: str,
        layouts: Sequence[Layout],
        unit: str,
        columns: str | None,
        chunk: int,
    ) -> None:
        self.name, self.chunk, self.line, self.seen = name, chunk, 0, 0
        self.size = _size(file)
        self._lines = iter(partial(file.readline, LONGEST + 1), b"")
        first = self._first()
        self._waiting = [first]  # read, and not yet handed out
        fields = self._split(first, self.line)
        chosen = None if columns is None else [each.strip() for each in columns.split(",")]
        self.width = len(fields)
        self.layout, self.at = arrange(f"{name}:{self.line}", fields, layouts, unit, chosen)
        if self._is_header(fields):
            self._waiting = []

    @property
    def fraction(self) -> float | None:
        """How much of the file is read, where its size is known."""
        return min(self.seen / self.size, 1.0) if self.size else None

    def __iter__(self) -> Iterator[np.ndarray]:
        is_empty = True
        while lines := self._take():
            rows = self._parse(lines)
            if len(rows):
                is_empty = False
                yield rows
        if is_empty:
            raise ValueError(f"{self.name}: there are no rows of numbers")

    def _first(self) -> bytes:
        """The first line that says something."""
        for line in self._lines:
            self.line, self.seen = self.line + 1, self.seen + len(line)
            line = line.removeprefix(_BOM) if self.line == 1 else line
            if not _is_skipped(line):
                return line
        raise ValueError(f"{self.name}: there are no rows of numbers")

    def _is_header(self, fields: list[str]) -> bool:
        """Whether the first line names its columns; ValueError where it does half of it."""
        found = [is_number(fields[i]) for i in self.at]
        if any(found):
            for i in self.at:  # names and numbers: the row is wrong, and not to be skipped
                self._number(fields[i], i, self.line)
        return not all(found)

    def _take(self) -> list[bytes]:
        lines = self._waiting
        self._first_line = self.line + 1 - len(lines)
        more = list(islice(self._lines, self.chunk - len(lines)))
        self._waiting = []
        if max(map(len, more), default=0) > LONGEST:
            for number, line in enumerate(more, self.line + 1):  # pragma: no branch: the line is told
                self._split(line, number)
        self.line += len(more)
        self.seen += sum(map(len, more))
        return lines + more

    def _parse(self, lines: list[bytes]) -> np.ndarray:
        """All rows at once where nothing is unusual; else row by row, where what is wrong is told."""
        with contextlib.suppress(ValueError):
            text = b"".join(lines).decode().replace("\r\n", "\n")
            rows = [row for row in text.split("\n") if row]
            is_plain = not any(mark in text for mark in '"#\r')
            if is_plain and {row.count(",") for row in rows} == {self.width - 1}:
                fields = ",".join(rows).split(",")
                return np.stack([numbers(fields[i :: self.width]) for i in self.at], axis=1)
        found = [
            self._row(line, number)
            for number, line in enumerate(lines, self._first_line)
            if not _is_skipped(line)
        ]
        return np.array(found, dtype=np.float64).reshape(-1, len(self.at))

    def _row(self, line: bytes, number: int) -> list[float]:
        fields = self._split(line, number)
        if len(fields) != self.width:
            raise ValueError(
                f"{self.name}:{number}: {len(fields)} fields where the first line has {self.width}: "
                f"{short(','.join(fields))}"
            )
        return [self._number(fields[i], i, number) for i in self.at]

    def _number(self, field: str, i: int, number: int) -> float:
        if is_number(field):
            return float(field)
        name = self.layout[self.at.index(i)].name
        raise ValueError(f"{self.name}:{number}: field {i + 1} ({name}) must be a number, got {short(field)}")

    def _split(self, line: bytes, number: int) -> list[str]:
        if len(line) > LONGEST:
            raise ValueError(f"{self.name}:{number}: a line must have at most {LONGEST} bytes")
        try:
            text = line.decode().rstrip("\r\n")
            return next(csv.reader([text], strict=True, skipinitialspace=True))
        except UnicodeDecodeError as error:
            raise ValueError(f"{self.name}:{number}: must be UTF-8 text, {error.reason}") from None
        except csv.Error as error:
            raise ValueError(f"{self.name}:{number}: {error}: {short(text)}") from None


def parse_row(name: str, text: str, layouts: Sequence[Layout]) -> tuple[Layout, np.ndarray]:
    """One row of numbers without a header, as on a command line. -> (layout, (columns,))"""
    fields = text.split(",")
    layout, at = arrange(name, fields, layouts, "", None)
    for field in fields:
        if not is_number(field):
            raise ValueError(f"{name}: {short(field)} must be a number")
    return layout, np.array([float(fields[i]) for i in at])


def format_rows(columns: Sequence[np.ndarray | Sequence[str]]) -> str:
    """CSV of columns of one length, a line a row: floats with all their digits, the rest as it is."""
    as_text = [list(map(_show, c.tolist())) if isinstance(c, np.ndarray) else c for c in columns]
    return "\n".join([*map(",".join, zip(*as_text, strict=True)), ""])


_show = repr  # of a Python number: the shortest digits that are read back the same; nan, inf


def _is_skipped(line: bytes) -> bool:
    return not (stripped := line.strip()) or stripped.startswith(b"#")


def _size(file: BinaryIO) -> int | None:
    """Bytes of a regular file."""
    try:
        status = os.fstat(file.fileno())
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None
