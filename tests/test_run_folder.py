"""Run folders: whole files or none, one writer, nothing left behind."""

import os
import signal
import subprocess
import sys
import time

import pytest

from pk_jax.files.progress import Progress
from pk_jax.files.run_folder import run_folder


def test_files_are_written_and_nothing_else_stays(tmp_path):
    with run_folder(tmp_path / "a" / "b ü") as folder:
        folder.write_text("x.txt", "ä")
        folder.write_json("y.json", {"one": 1.5})
    assert sorted(p.name for p in (tmp_path / "a" / "b ü").iterdir()) == ["x.txt", "y.json"]
    assert (tmp_path / "a" / "b ü" / "x.txt").read_text(encoding="utf-8") == "ä"


def test_permissions_follow_the_umask(tmp_path):
    with run_folder(tmp_path) as folder:
        path = folder.write_text("x", "")
    mask = os.umask(0)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask


def test_a_failed_write_keeps_the_old_file(tmp_path):
    with run_folder(tmp_path) as folder:
        folder.write_json("y.json", [1])
        with pytest.raises(ValueError, match="Out of range"):
            folder.write_json("y.json", [float("nan")])
        with pytest.raises(OSError):
            folder.write("missing/y.json", b"")
    assert (tmp_path / "y.json").read_text() == "[\n  1\n]\n"
    assert [p.name for p in tmp_path.iterdir()] == ["y.json"]


def test_an_interrupted_rename_leaves_no_temporary_file(tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with run_folder(tmp_path) as folder:
        monkeypatch.setattr(os, "replace", stop)
        with pytest.raises(KeyboardInterrupt):
            folder.write_text("x", "content")
        monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_a_second_writer_is_refused_while_the_first_works(tmp_path):
    with (
        run_folder(tmp_path),
        pytest.raises(BlockingIOError, match="written by another process"),
        run_folder(tmp_path),
    ):
        raise AssertionError("not reached")
    with run_folder(tmp_path) as folder:
        folder.write_text("x", "free again")


def test_a_killed_writer_blocks_nobody_and_its_leftovers_go(tmp_path):
    code = (
        "import sys, time; from pk_jax.files.run_folder import run_folder\n"
        f"with run_folder({str(tmp_path)!r}) as f:\n"
        f"    open({str(tmp_path / '.x.abc.part')!r}, 'w').write('half')\n"
        "    print('ready', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout.readline() == "ready\n"
        with pytest.raises(BlockingIOError), run_folder(tmp_path):
            pass
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    with run_folder(tmp_path) as folder:
        folder.write_text("x", "whole")
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_a_folder_made_for_nothing_is_taken_back(tmp_path):
    with pytest.raises(RuntimeError), run_folder(tmp_path / "new" / "deep"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_way(tmp_path):
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError), run_folder(path):
            pass
    assert (tmp_path / "file").read_text() == "mine"


class _Terminal:
    def __init__(self, is_a_tty):
        self.text, self.tty = "", is_a_tty

    def isatty(self):
        return self.tty

    def write(self, text):
        self.text += text

    def flush(self):
        pass


def test_progress_lines():
    log = _Terminal(False)
    progress = Progress(log, every=0.05)
    progress("work", 1, 3, 0.5)
    assert log.text == ""  # too early to say anything
    time.sleep(0.06)
    progress("work", 2, 3, 0.5)
    progress("work", 3, 3)
    assert [line.split("  ")[:2] for line in log.text.splitlines()] == [["work", "2/3"], ["work", "3/3"]]
    assert "best 0.5" in log.text.splitlines()[0] and "best" not in log.text.splitlines()[1]
    terminal = _Terminal(True)
    progress = Progress(terminal)
    progress.say("a long title")
    progress.say("short")
    progress.close()
    shown = terminal.text.split("\r")
    assert len(shown[1].rstrip("\n")) <= len(shown[2].rstrip("\n")) and terminal.text.endswith("\n")
