"""Named arrays and a JSON header in one .npz file, read back without trust.

A file is taken only whole: sizes, checksums, names, shapes and dtypes must all agree with its header
before an array is made, and nothing is ever unpickled.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

FORMAT = 1
LARGEST = 2**31  # bytes of a file
HEADER = "header"
KINDS = "biuf"  # of dtypes: bools, integers, floats

_DAMAGED = (
    ValueError,
    KeyError,
    EOFError,
    OverflowError,
    RuntimeError,  # of an encrypted or unknown member: NotImplementedError, too
    RecursionError,
    struct.error,
    SyntaxError,  # of the description of an array
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


class Saved(NamedTuple):
    """What a file holds."""

    header: dict[str, Any]
    arrays: dict[str, np.ndarray]


def packed(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """A file: the header, and numeric arrays by their names. Same input, same bytes."""
    shapes = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}
    text = json.dumps({"format": FORMAT, **header, "arrays": shapes}, allow_nan=False)
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{HEADER: np.frombuffer(text.encode(), np.uint8)}, **arrays)
    return file.getvalue()


def read_saved(path: str | os.PathLike) -> Saved:
    """The file that `packed` made. ValueError, one line, where it is none or damaged; OSError unread."""
    path = Path(path)
    with open(path, "rb") as file:
        content = file.read(LARGEST + 1)
    try:
        return _unpacked(content)
    except _DAMAGED as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(f"{path}: no checkpoint, or a damaged one: {said}") from None


def _unpacked(content: bytes) -> Saved:
    if len(content) > LARGEST:
        raise ValueError(f"more than {LARGEST} bytes")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        names = [member.filename.removesuffix(".npy") for member in members]
        if len(set(names)) < len(names) or HEADER not in names:
            raise ValueError("it must hold one header, and every array once")
        is_packed = any(m.compress_type != zipfile.ZIP_STORED for m in members)
        if is_packed or sum(m.file_size for m in members) > len(content):
            raise ValueError("its arrays are said to be larger than the file")
        header = json.loads(_read(archive, HEADER, None).tobytes())
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError(f"its format must be {FORMAT}")
        shapes = header.pop("arrays", None)
        if not isinstance(shapes, dict) or set(shapes) != set(names) - {HEADER}:
            raise ValueError("its arrays are others than its header says")
        return Saved(header, {name: _read(archive, name, shapes[name]) for name in shapes})


def _read(archive: zipfile.ZipFile, name: str, expected: Any) -> np.ndarray:
    """One array, made only after its size was found to be that of the member."""
    content = archive.read(f"{name}.npy")  # as large as the file at most; the checksum is told by zipfile
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} is of another version of the format")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if is_fortran or dtype.kind not in KINDS or dtype.fields is not None:
        raise ValueError(f"{name} must be numbers row by row, got {dtype}")
    if expected is not None and [dtype.str, list(shape)] != expected:
        raise ValueError(f"{name} is {dtype.str} {shape}, its header says {expected}")
    if math.prod(shape) * dtype.itemsize != len(content) - stream.tell() or min(shape, default=0) < 0:
        raise ValueError(f"{name} is not as long as its shape {shape}")
    stream.seek(0)
    return np.load(stream, allow_pickle=False)
