"""Damage to files: functions of a `random.Random` and of what is damaged, so that a seed repeats a case."""

from __future__ import annotations

import contextlib
import io
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any

Damage = Callable[[Random, Any], Any]


def damaged(chance: Random, content: Any, ways: Sequence[Damage], *, most: int = 3) -> Any:
    """One to `most` kinds of damage, one after the other."""
    for _ in range(chance.randint(1, most)):
        content = chance.choice(ways)(chance, content)
    return content


@contextlib.contextmanager
def repeatable(seed: int) -> Iterator[None]:
    """What goes wrong within says the seed."""
    try:
        yield
    except BaseException as error:
        error.add_note(f"of the damage of seed {seed}")
        raise


def _cuts(chance: Random, length: int, count: int, *, longest: int | None = None) -> list[int]:
    """Places in increasing order."""
    if longest is not None:
        first = chance.randint(0, length)
        return [first, min(length, first + chance.randint(0, longest))]
    return sorted(chance.randint(0, length) for _ in range(count))


# ---------------------------------------------------------------- bytes


def flipped(chance: Random, content: bytes) -> bytes:
    """One to eight bits."""
    found = bytearray(content)
    for _ in range(chance.randint(1, 8) if found else 0):
        found[chance.randrange(len(found))] ^= 1 << chance.randrange(8)
    return bytes(found)


def overwritten(chance: Random, content: bytes) -> bytes:
    begin, end = _cuts(chance, len(content), 2, longest=8)
    return content[:begin] + chance.randbytes(end - begin) + content[end:]


def shortened(chance: Random, content: bytes) -> bytes:
    begin, end = _cuts(chance, len(content), 2, longest=40)
    return content[:begin] + content[end:]


def cut_off(chance: Random, content: bytes) -> bytes:
    return content[: chance.randint(0, len(content))]


def beheaded(chance: Random, content: bytes) -> bytes:
    return content[chance.randint(0, len(content)) :]


def lengthened(chance: Random, content: bytes) -> bytes:
    at = chance.randint(0, len(content))
    return content[:at] + chance.randbytes(chance.randint(1, 8)) + content[at:]


def stuttered(chance: Random, content: bytes) -> bytes:
    begin, end = _cuts(chance, len(content), 2, longest=60)
    return content[:end] + content[begin:end] * chance.choice([1, 2, 50]) + content[end:]


def exchanged(chance: Random, content: bytes) -> bytes:
    """Two parts change places."""
    a, b, c, d = _cuts(chance, len(content), 4)
    return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]


BYTES = (flipped, overwritten, shortened, cut_off, lengthened, stuttered, exchanged)


# ---------------------------------------------------------------- text


def _lines(content: bytes) -> list[bytes]:
    return content.splitlines(keepends=True) or [b""]


def line_twice(chance: Random, content: bytes) -> bytes:
    lines = _lines(content)
    line = chance.choice(lines)
    lines.insert(chance.randint(0, len(lines)), line)
    return b"".join(lines)


def line_gone(chance: Random, content: bytes) -> bytes:
    lines = _lines(content)
    del lines[chance.randrange(len(lines))]
    return b"".join(lines)


def lines_shuffled(chance: Random, content: bytes) -> bytes:
    lines = _lines(content)
    chance.shuffle(lines)
    return b"".join(lines)


def other_line_ends(chance: Random, content: bytes) -> bytes:
    ends = chance.choice([(b"\r\n",), (b"\r",), (b"\n", b"\r\n"), (b"\r", b"\n"), (b"\n\n",), (b"\0\n",)])
    return b"".join(line.rstrip(b"\r\n") + chance.choice(ends) for line in _lines(content))


def other_encoding(chance: Random, content: bytes) -> bytes:
    text = content.decode("utf-8", "replace") + "\n# 測試 ä"
    return text.encode(chance.choice(["utf-16", "utf-32", "latin-1", "utf-8-sig", "utf-7"]), "replace")


LINES = (line_twice, line_gone, lines_shuffled, other_line_ends, other_encoding)


# ---------------------------------------------------------------- TOML

_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][+-]?\d+)?")
_KEY = re.compile(rb"(?m)^\s*[A-Za-z_]\w*(?=\s*=)")
_HUGE = b"9" * 400, b"1" * 5000, b"0." + b"3" * 3000, b"1e" + b"9" * 50
VALUES = (
    *(b"0 -0.0 1 -1 1e-320 1e-160 1e-12 1e12 1e153 1e160 1.7e308 1e999 -1e999 nan inf -inf 6e0".split()),
    *(b"0x7f 0o17 0b101 1_000 1__0 01 .5 5. +3 true false 1979-05-27 07:32:00 1979-05-27T07:32:00Z".split()),
    *(b"[] [[]] [1] [1,2] [[1,2],[3]] [1,[2]] {} {a=1} {a={b=[1]}} '' 'mm' \"\\u0000\" \"\\uD800\"".split()),
    *(b"[" * 100 + b"]" * 100, b"[" * 3000 + b"]" * 3000, b'"""\ntwo\nlines"""', "'ü∞٣'".encode(), *_HUGE),
)
KEYS = (
    *(b"family unit name source base platform stroke base_cone proximal distal reach slack".split()),
    *(b'mechanism variables objective search \'a.b\' a.b base.x family.unit "" "\\n" \\u0061'.split()),
    *("größe".encode(), b"x" * 2000, b"[[base]]\nx", b"[search]\nx", b"[a.b.c]\nd", b"[]\nx", b"'''k'''"),
)


def number_replaced(chance: Random, content: bytes) -> bytes:
    """By what TOML has beside numbers, or by numbers that nobody measures."""
    return _replaced(chance, _NUMBER, content, chance.choice(VALUES))


def numbers_moved(chance: Random, content: bytes) -> bytes:
    """One number becomes another one of the file."""
    found = _NUMBER.findall(content)
    return _replaced(chance, _NUMBER, content, chance.choice(found)) if found else content


def number_scaled(chance: Random, content: bytes) -> bytes:
    return _replaced(chance, _NUMBER, content, repr(10.0 ** chance.uniform(-12, 12)).encode())


def key_replaced(chance: Random, content: bytes) -> bytes:
    return _replaced(chance, _KEY, content, b"\n" + chance.choice(KEYS))


def line_inserted(chance: Random, content: bytes) -> bytes:
    lines = _lines(content)
    line = chance.choice(KEYS) + b" = " + chance.choice(VALUES) + b"\n"
    lines.insert(chance.randint(0, len(lines)), line)
    return b"".join(lines)


def _replaced(chance: Random, pattern: re.Pattern[bytes], content: bytes, by: bytes) -> bytes:
    """One place where the pattern stands, drawn at random."""
    found = list(pattern.finditer(content))
    if not found:
        return content + by
    one = chance.choice(found)
    return content[: one.start()] + by + content[one.end() :]


TOML = (*BYTES, *LINES, *2 * (number_replaced, numbers_moved, number_scaled, key_replaced, line_inserted))


# ---------------------------------------------------------------- CSV

FIELDS = (
    *(b'nan NaN inf -inf 1e999 -0 0 1e-320 1e300 abc 1_0 0x1 1,5 \'1\' "1" "1 1" # "" " \\'.split()),
    *(
        "٣".encode(),
        b"\xff",
        b"\0",
        b"1\0",
        b"\r",
        b"\n",
        b'"a\nb"',
        b'""1""',
        b"1" * 400,
        b"=1+1",
        b"\xef\xbb\xbf1",
    ),
)


def field_replaced(chance: Random, content: bytes) -> bytes:
    fields = content.split(b",")
    fields[chance.randrange(len(fields))] = chance.choice(FIELDS)
    return b",".join(fields)


def column_gone(chance: Random, content: bytes) -> bytes:
    at = chance.randrange(8)
    return _each_row(content, lambda fields: fields[:at] + fields[at + 1 :])


def column_more(chance: Random, content: bytes) -> bytes:
    at, field = chance.randrange(8), chance.choice(FIELDS)
    return _each_row(content, lambda fields: [*fields[:at], field, *fields[at:]])


def separated_otherwise(chance: Random, content: bytes) -> bytes:
    return content.replace(b",", chance.choice([b";", b"\t", b" ", b", ", b",,"]))


def many_columns(chance: Random, content: bytes) -> bytes:
    count = chance.choice([100, 10_000, 100_000])
    return _each_row(b"".join(_lines(content)[:2]), lambda fields: fields + fields[:1] * count)


def endless_line(chance: Random, content: bytes) -> bytes:
    lines = _lines(content)
    at = chance.randrange(len(lines))
    lines[at] = chance.choice([b"1", b",", b" ", b'"', b"a"]) * (1 << 21) + lines[at]
    return b"".join(lines)


def _each_row(content: bytes, change: Callable[[list[bytes]], list[bytes]]) -> bytes:
    return b"".join(b",".join(change(line.rstrip(b"\r\n").split(b","))) + b"\n" for line in _lines(content))


CSV = (*BYTES, *LINES, *3 * (field_replaced,), column_gone, column_more, separated_otherwise)
RARE_CSV = (many_columns, endless_line)


# ---------------------------------------------------------------- .npz, member by member

Members = list[tuple[str, bytes]]


def members_of(content: bytes) -> Members:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [(member.filename, archive.read(member)) for member in archive.infolist()]


def zipped(members: Members, compression: int = zipfile.ZIP_STORED) -> bytes:
    """With checksums that are right, so that what is wrong is met farther in."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two members of one name
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, compression)
    return file.getvalue()


def member_gone(chance: Random, members: Members) -> Members:
    at = chance.randrange(len(members)) if members else 0
    return members[:at] + members[at + 1 :]


def member_renamed(chance: Random, members: Members) -> Members:
    name = chance.choice(
        ["header.npy", "x.npy", "x", "", "../x.npy", "/etc/x.npy", "box.npy", "box", "history.npy"]
    )
    return _at_one(chance, members, lambda _, content: (name, content))


def contents_exchanged(chance: Random, members: Members) -> Members:
    contents = [content for _, content in members]
    chance.shuffle(contents)
    return [(name, content) for (name, _), content in zip(members, contents, strict=True)]


def content_damaged(chance: Random, members: Members) -> Members:
    return _at_one(chance, members, lambda name, content: (name, chance.choice(BYTES)(chance, content)))


DTYPES = (
    "'|O'",
    "'O'",
    "'<U4'",
    "'|V8'",
    "'<c16'",
    "'<f4'",
    "'>f8'",
    "'<i8'",
    "[('a', '<f8')]",
    "'|S1'",
    "'<M8[s]'",
    "5",
)
SHAPES = (
    "()",
    "(-1,)",
    "(9223372036854775807,)",
    "(1000000, 1000000)",
    "(0,)",
    "(2, 0)",
    "(True,)",
    "(3.0,)",
    "3",
)


def described_otherwise(chance: Random, members: Members) -> Members:
    """Another dtype, shape or order in the description of an array."""

    def redescribed(name: str, content: bytes) -> tuple[str, bytes]:
        text = (
            f"{{'descr': {chance.choice(DTYPES + ('<f8',) * 4)}, 'fortran_order': {chance.random() < 0.2}, "
        )
        text += f"'shape': {chance.choice(SHAPES)}, }}"
        return name, described(text) + content[128:]

    return _at_one(chance, members, redescribed)


def described(text: str, version: bytes = b"\1\0") -> bytes:
    """The beginning of a .npy file."""
    padded = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY" + version + len(padded).to_bytes(2, "little") + padded


def header_changed(chance: Random, members: Members) -> Members:
    """The JSON of a checkpoint says something else, or is none."""

    def changed(name: str, content: bytes) -> tuple[str, bytes]:
        if name != "header.npy":
            return name, content
        try:
            header = json.loads(content[128:])
        except (ValueError, RecursionError):
            return name, content
        values = (None, True, -1, 0, 1, 10**30, 1.5, "", "x", [], [1, 3], {}, {"x": ["<f8", [3]]}, "NaN" * 99)
        if isinstance(header, dict) and header:
            header[chance.choice([*header, "more"])] = chance.choice(values)
        else:
            header = chance.choice(values)
        text = chance.choice([json.dumps(header), json.dumps(header)[:-1], "[" * 5000, "NaN", ""]).encode()
        shape = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({len(text)},), }}"
        return name, described(shape) + text

    return [changed(*member) for member in members]


def _at_one(chance: Random, members: Members, change: Callable[[str, bytes], tuple[str, bytes]]) -> Members:
    if not members:
        return members
    at = chance.randrange(len(members))
    return [change(*member) if i == at else member for i, member in enumerate(members)]


MEMBERS = (
    member_gone,
    member_renamed,
    contents_exchanged,
    content_damaged,
    described_otherwise,
    header_changed,
)


def archive_damaged(chance: Random, content: bytes) -> bytes:
    """The bytes of the archive, or what its members hold."""
    if chance.random() < 0.5:
        return damaged(chance, content, BYTES)
    members = damaged(chance, members_of(content), MEMBERS, most=2)
    if chance.random() < 0.1 and members:
        members.append(chance.choice(members))
    return zipped(members, chance.choice([zipfile.ZIP_STORED] * 9 + [zipfile.ZIP_DEFLATED]))
