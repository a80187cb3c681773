"""Damaged files: each is refused in one line that starts with its path, or what it holds is whole."""

import contextlib
import json
import os
import warnings
from pathlib import Path
from random import Random

import fuzzing
import jax
import numpy as np
import pytest
import small_runs
from fuzzing import damaged, repeatable
from test_mechanism_file import MECHANISMS, assert_same

import pk_jax as pk
from pk_jax.files import design_run, run_file, shards
from pk_jax.files.checkpoint import packed, read_saved
from pk_jax.files.columns import Column
from pk_jax.files.design_run import Part, begun, packed_state, progressed
from pk_jax.files.mechanism_file import load_mechanism, read_mechanism_file, save_mechanism
from pk_jax.files.rows_file import open_rows
from pk_jax.files.run_file import digest_of, parse_run, settings_of

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

EXAMPLES = Path(__file__).parent.parent / "examples"


def files(few, many):
    """So many seeds in the normal suite, and in make soak."""
    return pytest.mark.parametrize("count", [few, pytest.param(many, marks=pytest.mark.soak)])


@contextlib.contextmanager
def mere_remarks():
    """Two warnings say nothing of damage."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*are they in one unit|.*by other versions")
        yield


def accepted(read, path):
    """What is read; None where it is refused as every file must be."""
    with mere_remarks():
        try:
            return read(path)
        except ValueError as error:
            refusal = error
    said = str(refusal)
    assert type(refusal) is ValueError and said.startswith(str(path)), repr(refusal)
    assert "\n" not in said and "\r" not in said and len(said) <= len(str(path)) + 800
    return None


def report(what, count, read):
    print(f"{what}: {count} damaged, {read} of them whole, {count - read} refused")


# ---------------------------------------------------------------- mechanisms in TOML

HOUSE = MECHANISMS | {"CasingOscillator": pk.CasingOscillator()}


QUICK = ("FiveBar full", "FiveBar coaxial", "TwoRPR")  # to build


def robots(folder, names):
    """Files of mechanisms, one in each unit, and the one that a user would write."""
    for unit, name in zip(["m", "mm", "cm", "in", "um", "1"] * 2, names, strict=False):
        save_mechanism(HOUSE[name], folder / f"{name}.toml", unit=unit)
    return [path.read_bytes() for path in (*sorted(folder.glob("*.toml")), EXAMPLES / "hexapod.toml")]


@files(300, 100_000)
def test_mechanism_files(tmp_path, count):
    """What is accepted is a mechanism that can be saved, and comes back to the same bits."""
    originals = robots(tmp_path, QUICK if count < 1000 else HOUSE)
    path, again, read = tmp_path / "robot.toml", tmp_path / "again.toml", 0
    for seed in range(count):
        with repeatable(seed):
            path.write_bytes(damaged(Random(seed), originals[seed % len(originals)], fuzzing.TOML))
            found = accepted(read_mechanism_file, path)
            if found is None:
                continue
            read += 1
            with mere_remarks():
                save_mechanism(found.mechanism, again, unit=found.unit)
                assert_same(load_mechanism(again), found.mechanism)
    report("mechanism files", count, read)
    assert count / 100 < read < count / 2


# ---------------------------------------------------------------- design runs in TOML


@files(300, 100_000)
def test_run_files(tmp_path, count):
    runs = [path.read_bytes() for path in sorted(EXAMPLES.glob("design_*.toml"))]
    path, read = tmp_path / "run.toml", 0
    for seed in range(count):
        with repeatable(seed):
            path.write_bytes(damaged(Random(seed), runs[seed % len(runs)], fuzzing.TOML))
            settings = accepted(lambda path: settings_of(path.read_bytes(), path), path)
            if settings is None:
                continue
            read += 1
            assert json.loads(json.dumps(settings, allow_nan=False)) == settings
            assert len(digest_of(settings)) == 64
            if read % 100 == 1:  # the problem itself takes its time
                accepted(run_file.read_run, path)
    report("run files", count, read)
    assert count / 100 < read < count / 2


# ---------------------------------------------------------------- checkpoints


@pytest.fixture
def small(monkeypatch):
    """A design run that computes next to nothing."""
    monkeypatch.setattr(run_file, "problem_of", small_runs.small_problem)
    monkeypatch.setattr(design_run, "SAVE_EVERY", 0.0)
    return parse_run(small_runs.TEXT.encode(), "small.toml")


def same_bits(one, other):
    leaves = [jax.tree.leaves(each) for each in (one, other)]
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in zip(*leaves, strict=True))


@files(300, 10_000)
def test_checkpoints(tmp_path, small, count):
    """The bytes damaged: nothing or all is there. The content damaged, checksums right: fit for this run."""
    start, path, read = begun(small, Part()), tmp_path / "checkpoint.npz", 0
    content = packed_state("checkpoint", small, Part(), start)
    for seed in range(count):
        with repeatable(seed):
            chance = Random(seed)
            is_of_bytes = chance.random() < 0.5
            ways = fuzzing.BYTES if is_of_bytes else (fuzzing.archive_damaged,)
            path.write_bytes(damaged(chance, content, ways, most=3 if is_of_bytes else 1))
            state = accepted(lambda path: progressed(path, "checkpoint", small, Part()), path)
            if state is None:
                continue
            read += 1
            assert not is_of_bytes or same_bits(state, start)
            for mine, theirs in zip(
                jax.tree.leaves(state.search), jax.tree.leaves(start.search), strict=True
            ):
                assert (mine.shape, mine.dtype) == (theirs.shape, theirs.dtype)
            assert 0 <= state.steps <= small.steps
    report("checkpoints", count, read)
    assert read < count / 2


@files(60, 10_000)
def test_parts_of_a_run(tmp_path, small, count):
    for number in (1, 2):
        shards.part_into(tmp_path, small, Part(number, 2))
    shards.merge(tmp_path)
    part, read = tmp_path / "part-2-of-2.npz", 0
    content = part.read_bytes()
    for seed in range(count):
        with repeatable(seed):
            part.write_bytes(fuzzing.archive_damaged(Random(seed), content))
            read += accepted(lambda _: shards.merge(tmp_path), part) is not None
    report("parts", count, read)


class Payload:
    """Unpickled, it makes a folder."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def test_nothing_is_unpickled(tmp_path):
    folder, path = tmp_path / "made", tmp_path / "checkpoint.npz"
    np.save(tmp_path / "payload.npy", np.array([Payload(folder)], dtype=object), allow_pickle=True)
    pickled = (tmp_path / "payload.npy").read_bytes()
    members = dict(fuzzing.members_of(packed({}, {"box": np.zeros(1)})))
    as_floats = fuzzing.described("{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }") + pickled[128:]
    for name in members:
        for content in (pickled, pickled[128:], as_floats):
            path.write_bytes(fuzzing.zipped([*(members | {name: content}).items()]))
            assert accepted(read_saved, path) is None
    path.write_bytes(pickled)
    assert accepted(read_saved, path) is None and not folder.exists()
    np.load(path, allow_pickle=True)  # it would have
    assert folder.exists()


# ---------------------------------------------------------------- rows in CSV

LENGTHS = tuple(Column(f"l{i}", "length") for i in (1, 2))
POINT = (Column("x", "length"), Column("y", "length"))
TABLES = (
    b"l1,l2\n2.0,2.5\n1.5,2.25\n3.0,2.75\n",
    b"2.0,2.5\n1.5,2.25\n\n# a comment\n3.0,2.75\n",
    b't,l2_m,"what, when",l1_m\r\n0,2.5,"a ""b""",2.0\r\n1,2.25,,1.5\r\n2,2.75,#,3.0\r\n',
    b"\xef\xbb\xbfx,y\n0.25,2.0\n-0.5,1.75\n",
)


def rows_in(path, chunk):
    with open_rows(str(path), (LENGTHS, POINT), unit="m", chunk=chunk) as reader:
        return np.concatenate(list(reader))


def some_table(chance, *, rare):
    ways = fuzzing.RARE_CSV if rare else fuzzing.CSV
    return damaged(chance, chance.choice(TABLES), ways, most=1 if rare else 3)


@files(300, 10_000)
def test_rows(tmp_path, count):
    """In one chunk or line by line: the same rows, or both refused."""
    path, read = tmp_path / "rows.csv", 0
    for seed in range(count):
        with repeatable(seed):
            path.write_bytes(some_table(Random(seed), rare=seed % 50 == 49))
            whole, by_line = (accepted(lambda path, n=n: rows_in(path, n), path) for n in (65_536, 1))
            assert (whole is None) == (by_line is None)
            if whole is not None:
                read += 1
                assert whole.dtype == np.float64 and whole.shape[1] == 2 and len(whole)
                np.testing.assert_array_equal(whole, by_line)
    report("tables", count, read)
    assert count / 100 < read < count / 2


@files(20, 1000)
def test_rows_at_the_command_line(run, tmp_path, count):
    """Good, with a row of answers for each row; or exit code 2, one line and no file."""
    path, out, read = tmp_path / "rows.csv", tmp_path / "out.csv", 0
    for seed in range(count):
        with repeatable(seed):
            path.write_bytes(some_table(Random(seed), rare=seed % 50 == 49))
            code, _, err = run("ik" if seed % 2 else "fk", "nam-2-rpr", path, "-o", out)
            lines = [line for line in err.splitlines() if not line.startswith("pk-jax: warning")]
            assert code in (0, 2), err
            if code == 2:
                assert len(lines) == 1 and lines[0].startswith(f"pk-jax: {path}") and not out.exists()
                continue
            read += 1
            answers = out.read_text().splitlines()[1:]
            assert f"{len(answers)} rows" in lines[-1]
            for answer in answers:
                *numbers, status = answer.split(",")[:3]
                assert ("nan" in numbers) == (status != "OK")
            out.unlink()
    report("tables at the command line", count, read)
