"""The command line: what it prints, and one clear line with the right exit code for bad input."""

import os
import re
import subprocess
import sys
from types import SimpleNamespace

import pytest

from pk_jax.cli import main
from pk_jax.files.mechanism_file import FAMILIES
from pk_jax.mechanisms.catalogue import CATALOGUE


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory, monkeypatch):
    """No test reads or writes the user's compile cache."""
    monkeypatch.setattr("pk_jax.cli._compile_cache", lambda: None)


def run(capsys, *arguments):
    try:
        code = main(list(arguments))
    except SystemExit as stop:  # argparse
        code = stop.code
    shown = capsys.readouterr()
    return code, shown.out, shown.err


def test_help_does_not_import_jax():
    code = (
        "import sys\nfrom pk_jax.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules), 'imported too early'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "reproduce" in done.stdout and "optimize" in done.stdout


def test_workspace(capsys):
    code, out, _ = run(capsys, "workspace", "2-rrr", "--l-min", "2.08", "--proximal", "1.39")
    values = dict(re.findall(r"^(gii|gri|sui|area) +([\d.]+)", out, re.M))
    assert code == 0
    assert abs(float(values["gii"]) - 0.6897323171) < 1e-8
    assert abs(float(values["gri"]) - 0.8815539900) < 1e-8
    assert abs(float(values["area"]) - 7.280993404) < 1e-8
    code, out, _ = run(capsys, "workspace", "nam-2-rpr", "--rule", "paper")
    assert code == 0 and "gri  0.80423" in out and "+-" not in out


def test_workspace_of_a_file_is_that_of_its_mechanism(capsys, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('family = "TwoRPR"\nunit = "1"\nhalf_base = 1.0\nl_min = 1.0\nl_max = 3.0\n')
    ours, named = (run(capsys, "workspace", each, "--rule", "paper") for each in (str(file), "nam-2-rpr"))
    assert ours == named and named[0] == 0
    code, out, _ = run(
        capsys, "workspace", "2-rpr", "--l-min", "300", "--half-base", "100", "--nodes", "12", "9"
    )
    assert code == 0 and "gri  0.429513854" in out


def test_optimize(capsys):
    code, out, _ = run(capsys, "optimize", "2-rpr", "--weights", "1", "0", "2")
    assert code == 0
    assert "l_min      1\n" in out and "objective  3\n" in out and "active     l_min = R, multiplier" in out


def test_optimize_that_ran_out_of_steps(capsys):
    code, out, _ = run(
        capsys, "optimize", "2-rpr", "--weights", "1", "1", "1", "--steps", "1", "--starts", "1"
    )
    assert ("OK" in out) == (code == 0)


def test_list(capsys):
    code, out, _ = run(capsys, "list")
    entries, families = (part.splitlines() for part in out.split("\n\n"))
    assert code == 0 and [line.split()[0] for line in entries] == list(CATALOGUE)
    assert all(entry.source in line for entry, line in zip(CATALOGUE.values(), entries, strict=True))
    assert [line.split()[0] for line in families[1:]] == list(FAMILIES)
    assert "half_base, proximal, distal, [reach]" in families[1 + list(FAMILIES).index("FiveBar")]


BAD = {
    "no command": [],
    "unknown command": ["fly"],
    "unknown option": ["reproduce", "--outt", "x"],
    "unknown mechanism": ["workspace", "3-rrr"],
    "unknown space": ["optimize", "3-rrr"],
    "missing length": ["workspace", "2-rpr"],
    "not a number": ["workspace", "2-rpr", "--l-min", "one"],
    "nan length": ["workspace", "2-rpr", "--l-min", "nan"],
    "infinite length": ["workspace", "2-rpr", "--l-min", "inf"],
    "negative length": ["workspace", "2-rpr", "--l-min", "-1"],
    "zero base": ["workspace", "2-rpr", "--l-min", "1", "--half-base", "0"],
    "l_min > l_max": ["workspace", "2-rpr", "--l-min", "3", "--l-max", "2"],
    "l_min = l_max": ["workspace", "2-rpr", "--l-min", "3", "--l-max", "3"],
    "outside eq. 20": ["workspace", "2-rpr", "--l-min", "0.5"],
    "outside eq. 20, stroke": ["workspace", "2-rpr", "--l-min", "1", "--l-max", "2.5"],
    "outside eq. 22, proximal": ["workspace", "2-rrr", "--l-min", "2", "--proximal", "0.9"],
    "outside eq. 22, distal": ["workspace", "2-rrr", "--l-min", "2", "--proximal", "1.8"],
    "proximal of a 2-RPR": ["workspace", "2-rpr", "--l-min", "2", "--proximal", "1.2"],
    "lengths of a catalogue entry": ["workspace", "nam-2-rpr", "--l-min", "2"],
    "unknown rule": ["workspace", "nam-2-rpr", "--rule", "simpson"],
    "zero nodes": ["workspace", "nam-2-rpr", "--nodes", "0", "8"],
    "negative nodes": ["workspace", "nam-2-rpr", "--nodes", "8", "-8"],
    "one node count": ["workspace", "nam-2-rpr", "--nodes", "8"],
    "absurd nodes": ["workspace", "nam-2-rpr", "--nodes", "8", "100000000"],
    "fractional nodes": ["workspace", "nam-2-rpr", "--nodes", "8", "8.5"],
    "weights all zero": ["optimize", "2-rpr", "--weights", "0", "0", "0"],
    "negative weight": ["optimize", "2-rpr", "--weights", "1", "-1", "1"],
    "nan weight": ["optimize", "2-rpr", "--weights", "1", "nan", "1"],
    "two weights": ["optimize", "2-rpr", "--weights", "1", "1"],
    "no starts": ["optimize", "2-rpr", "--starts", "0"],
    "negative steps": ["optimize", "2-rpr", "--steps", "-5"],
    "absurd steps": ["optimize", "2-rpr", "--steps", "1000000000000000000000000"],
}


@pytest.mark.parametrize("arguments", BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_exit_code_2(capsys, arguments):
    code, out, err = run(capsys, *arguments)
    told = [line for line in err.splitlines() if not re.match(r"2-r\w+: ", line)]
    assert code == 2 and out == ""
    assert len(told) == 1 and told[0].startswith("pk-jax") and len(told[0]) < 400
    assert "Traceback" not in err


@pytest.mark.parametrize("name", ["file", "file/below", "/proc/no such place/x"])
def test_an_output_folder_that_cannot_be_written(capsys, tmp_path, name):
    (tmp_path / "file").write_text("mine")
    code, out, err = run(capsys, "reproduce", "--out", os.path.join(tmp_path, name))
    assert code == 4 and out == "" and len(err.splitlines()) == 1 and err.startswith("pk-jax: ")
    assert [p.name for p in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "mine"


def test_a_full_disk_leaves_nothing_half_written(capsys, tmp_path, monkeypatch):
    from pk_jax.papers import nam2006_report

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(nam2006_report, "reproduce", lambda report: SimpleNamespace(cells=[]))
    monkeypatch.setattr(nam2006_report, "_figures", lambda found: [])
    monkeypatch.setattr(nam2006_report, "as_csv", full)
    code, _, err = run(capsys, "reproduce", "--out", str(tmp_path / "out"))
    assert code == 4 and "No space left on device" in err
    assert list(tmp_path.iterdir()) == []


def test_interrupted(capsys, monkeypatch, tmp_path):
    from pk_jax.papers import nam2006_report

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(nam2006_report, "reproduce", stop)
    code, out, err = run(capsys, "reproduce", "--out", str(tmp_path / "out"))
    assert code == 130 and out == "" and "interrupted" in err and list(tmp_path.iterdir()) == []


def test_a_reader_that_has_gone_is_no_error():
    done = subprocess.run(
        f"{sys.executable} -m pk_jax.cli list | true", shell=True, capture_output=True, text=True
    )
    assert "Traceback" not in done.stderr
