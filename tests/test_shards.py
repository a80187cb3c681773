"""Parts of a design run: merged they are the undivided run, byte for byte; what is missing is named."""

import os
import socket

import numpy as np
import pytest
import small_runs
from small_runs import TEXT, bytes_of, ended, started

from pk_jax.files import checkpoint, design_run, run_file, shards
from pk_jax.files.design_run import Part, run_into
from pk_jax.files.run_file import parse_run
from pk_jax.files.run_folder import run_folder

pytestmark = pytest.mark.usefixtures("compiled_in_haste")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(run_file, "problem_of", small_runs.small_problem)
    monkeypatch.setattr(design_run, "SAVE_EVERY", 0.0)
    monkeypatch.setattr(design_run, "CHUNK", small_runs.CHUNK)
    monkeypatch.setattr("pk_jax.cli.design._figures", lambda run: None)


def parsed(text=TEXT):
    return parse_run(text.encode(), "mine.toml")


@pytest.fixture
def parts(tmp_path):
    """A folder with three parts of seven starts."""
    for number in (2, 3, 1):
        shards.part_into(tmp_path / "parts", parsed(), Part(number, 3))
    return tmp_path / "parts"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of the undivided run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_file, "problem_of", small_runs.small_problem)
        patch.setattr(design_run, "CHUNK", small_runs.CHUNK)
        return bytes_of(run_into(tmp_path_factory.mktemp("whole"), parsed()).folder)


def test_parts_make_the_undivided_run(run, tmp_path, whole):
    (tmp_path / "mine.toml").write_text(TEXT)
    folder = tmp_path / "parts"
    for number in (3, 1, 2):
        code, out, _ = run("optimize", tmp_path / "mine.toml", "--out", folder, "--shard", f"{number}/3")
        assert code == 0 and out == f"{folder / f'part-{number}-of-3.npz'}: to be merged with the others\n"
    names = [f"part-{number}-of-3{end}" for number in (1, 2, 3) for end in ("", ".npz")]
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    assert len({len(path.read_bytes()) for path in folder.glob("*.npz")}) > 1  # of 3, 2 and 2 starts
    code, out, _ = run("merge", folder)
    assert code == 0 and "7 feasible" in out and "status     OK" in out
    assert bytes_of(folder) == whole
    code, out, _ = run("merge", folder)
    assert code == 0 and out == f"{folder}: the run is finished\n" and bytes_of(folder) == whole


def test_a_part_for_each_start(tmp_path, whole):
    for number in range(1, 8):
        shards.part_into(tmp_path, parsed(), Part(number, 7))
    assert bytes_of(shards.merge(tmp_path)[1].folder) == whole


def test_a_killed_part_goes_on_by_itself(run, tmp_path, parts, whole):
    mine, part = parsed(), Part(2, 3)
    before = bytes_of(parts, ["part-1-of-3.npz", "part-3-of-3.npz"])
    (parts / "part-2-of-3.npz").unlink()
    for path in (parts / "part-2-of-3").iterdir():
        path.unlink()
    with pytest.raises(KeyboardInterrupt):
        shards.part_into(parts, mine, part, further=small_runs.stopping(mine, 3))
    code, _, err = run("merge", parts)
    assert code == 2 and err == f"pk-jax: {parts}: part-2-of-3.npz is missing\n"
    with pytest.raises(ValueError, match="--resume goes on with it"):
        shards.part_into(parts, mine, part)
    assert shards.part_into(parts, mine, part, resume=True) == parts / "part-2-of-3.npz"
    assert bytes_of(parts, ["part-1-of-3.npz", "part-3-of-3.npz"]) == before
    assert bytes_of(shards.merge(parts)[1].folder) == whole
    (tmp_path / "mine.toml").write_text(TEXT)


def test_a_finished_part_is_left_alone(run, tmp_path, parts):
    (tmp_path / "mine.toml").write_text(TEXT)
    before = (parts / "part-2-of-3.npz").read_bytes()
    words = ("optimize", tmp_path / "mine.toml", "--out", parts, "--shard", "2/3")
    code, out, err = run(*words)
    assert code == 2 and out == "" and "holds a finished run" in err
    code, out, _ = run(*words, "--resume")
    assert code == 0 and out == f"part-2-of-3 in {parts} is finished\n"
    assert (parts / "part-2-of-3.npz").read_bytes() == before


def of_another_run(folder):
    (folder / "x").mkdir()
    shards.part_into(folder / "x", parsed(TEXT + "seed = 3\n"), Part(2, 3))
    os.replace(folder / "x" / "part-2-of-3.npz", folder / "part-2-of-3.npz")
    return "part-2-of-3.npz is of another run than part-1-of-3.npz: search.seed = 0 there, 3 here"


def under_another_name(folder):
    os.replace(folder / "part-3-of-3.npz", folder / "part-2-of-3.npz")
    os.link(folder / "part-2-of-3.npz", folder / "part-3-of-3.npz")
    return "part-2-of-3.npz is of another run: its part is [3, 3], not [2, 3]"


def torn(folder):
    path = folder / "part-2-of-3.npz"
    path.write_bytes(path.read_bytes()[:-300])
    return "part-2-of-3.npz: no checkpoint, or a damaged one"


def not_at_its_end(folder):
    path = folder / "part-2-of-3.npz"
    header, arrays = checkpoint.read_saved(path)
    arrays = {**arrays, "is_done": np.zeros_like(arrays["is_done"])}
    path.write_bytes(checkpoint.packed(header, arrays))
    return "part-2-of-3.npz is damaged: its search has not ended"


def a_checkpoint(folder):
    os.replace(folder / "part-2-of-3" / "checkpoint.npz", folder / "part-2-of-3.npz")
    return "part-2-of-3.npz is of another run: its kind is 'checkpoint', not 'part'"


def without_its_run_file(folder):
    path = folder / "part-2-of-3.npz"
    header, arrays = checkpoint.read_saved(path)
    path.write_bytes(checkpoint.packed({**header, "toml": None}, arrays))
    return "part-2-of-3.npz is damaged: it must have its run file with it"


def two_missing(folder):
    for number in (1, 3):
        (folder / f"part-{number}-of-3.npz").unlink()
    return "part-1-of-3.npz and 1 more are missing"


def none_at_all(folder):
    for path in folder.glob("*.npz"):
        path.unlink()
    return "must hold the parts of one run, part-1-of-n.npz and so on, got none"


def of_two_divisions(folder):
    (folder / "part-1-of-2.npz").write_bytes(b"")
    return "must hold the parts of one run, part-1-of-n.npz and so on, got part-1-of-2.npz, part-1-of-3.npz"


@pytest.mark.parametrize(
    "spoil",
    [
        of_another_run,
        under_another_name,
        torn,
        not_at_its_end,
        a_checkpoint,
        without_its_run_file,
        two_missing,
        none_at_all,
        of_two_divisions,
    ],
    ids=lambda spoil: spoil.__name__,
)
def test_what_cannot_be_merged_is_named(run, parts, spoil):
    expected = spoil(parts)
    before = sorted(parts.iterdir())
    code, out, err = run("merge", parts)
    assert code == 2 and out == "" and err.count("\n") == 1 and expected in err, err
    assert sorted(parts.iterdir()) == before


def test_folders_that_cannot_be_merged(run, tmp_path, parts):
    code, _, err = run("merge", tmp_path / "none")
    assert code == 4 and "No such folder" in err and err.count("\n") == 1
    with run_folder(parts):
        code, _, err = run("merge", parts)
    assert code == 4 and "written by another process" in err


def test_whole_and_divided_runs_do_not_share_a_folder(run, tmp_path, parts):
    (tmp_path / "mine.toml").write_text(TEXT)
    again = lambda folder, *more: run("optimize", tmp_path / "mine.toml", "--out", folder, "--resume", *more)
    code, _, err = again(parts)
    assert code == 2 and "holds part-1-of-3, part of a run: merge the parts" in err
    code, _, err = again(parts, "--shard", "1/2")
    assert code == 2 and "not a part of 2: choose another folder" in err
    run_into(tmp_path / "whole", parsed())
    code, _, err = again(tmp_path / "whole", "--shard", "1/2")
    assert code == 2 and "holds a run that is not in parts (checkpoint.npz)" in err


def test_each_part_has_one_writer(tmp_path):
    mine = parsed()
    with run_folder(tmp_path / "part-1-of-3"):
        with pytest.raises(BlockingIOError, match="written by another process"):
            shards.part_into(tmp_path, mine, Part(1, 3))
        assert shards.part_into(tmp_path, mine, Part(2, 3))


@pytest.mark.soak
def test_two_hosts_find_what_one_does(tmp_path):
    """Two processes of two devices each, and one of three."""
    (tmp_path / "mine.toml").write_text(TEXT.replace("starts = 7", "starts = 37"))
    words = ["optimize", tmp_path / "mine.toml", "--quiet", "--out"]
    assert ended(started(tmp_path, *words, tmp_path / "one"))[0] == 0
    whole = bytes_of(tmp_path / "one")

    def together(folder, *more):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        options = ["--coordinator", f"127.0.0.1:{port}", "--devices", 2, "--process"]
        hosts = [started(tmp_path, *words, folder, *more, *options, f"{i}/2") for i in (1, 2)]
        return [ended(host) for host in hosts]

    (first, out, err), (second, *_) = together(tmp_path / "two")
    assert first == second == 0 and "status     OK" in out, err
    assert bytes_of(tmp_path / "two") == whole
    (first, out, _), (second, *_) = together(tmp_path / "two", "--resume")
    assert first == second == 0 and "the run is finished" in out
    (first, _, err), (second, _, other) = together(tmp_path / "two")
    assert first == second == 2 and "holds a finished run" in err
    assert "the first process has refused the run" in other
    assert ended(started(tmp_path, *words, tmp_path / "three", "--devices", 3))[0] == 0
    assert bytes_of(tmp_path / "three") == whole
