"""The verb `check`: a mechanism with its laws, a design run without running it."""

import os
import re
import threading

import numpy as np
import pytest
import small_runs
from small_runs import TEXT

import pk_jax as pk

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

ROBOT = 'family = "TwoRPR"\nunit = "mm"\nhalf_base = 250\nl_min = 250\nl_max = 750\n'


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return path


def test_a_sound_mechanism_in_its_unit(run, robot):
    code, out, _ = run("check", robot)
    laws = pk.check_mechanism(pk.load_mechanism(robot))
    first, about, counts, _, _, *table = out.splitlines()
    assert code == 0 and first == f"{robot}: sound, all {len(laws)} laws hold"
    assert about == "family TwoRPR, unit mm, size 250 mm"
    assert counts == "freedoms 2, joints 2, closure equations 2"
    for law, line in zip(laws, table, strict=True):
        error, allowed = map(float, re.search(r"(\S+) <= +(\S+)$", line).groups())
        assert line.startswith(law.name) and error <= allowed


def test_another_unit_and_a_pipe(run, robot, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_text(ROBOT))
    writer.start()
    code, out, _ = run("check", tmp_path / "pipe", "--unit", "cm")
    writer.join()
    assert code == 0 and "unit cm, size 25 cm" in out


def test_a_broken_law(run, robot, monkeypatch):
    def broken(mech):
        raise ValueError(f"{type(mech).__name__} breaks a law: power balance; error 1, allowed 1e-12")

    monkeypatch.setattr("pk_jax.files.checked.check_mechanism", broken)
    code, out, err = run("check", robot)
    assert (
        code == 2
        and out == ""
        and err.splitlines()[-1]
        == (f"pk-jax: {robot}: TwoRPR breaks a law: power balance; error 1, allowed 1e-12")
    )


@pytest.fixture
def design(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(TEXT + "seed = 5\n[constraints]\nmargins = true\n")
    return path


def test_a_design_run_is_not_run(run, design, tmp_path, monkeypatch):
    monkeypatch.setattr("pk_jax.files.run_file.problem_of", small_runs.small_problem)
    code, out, _ = run("check", design)
    lines = dict(line.split(None, 1) for line in out.splitlines()[1:] if not line.startswith("variable"))
    assert code == 0 and out.splitlines()[0] == f"{design}: fine, can be run"
    assert re.findall(r"^variable +(.*)$", out, re.M) == ["proximal in 0.5 .. 2", "distal in 1 .. 2.5"]
    assert lines["problem"] == "five-bar: least isotropy over the rectangle"
    assert lines["search"] == "7 starts, 60 steps each, seed 5" and lines["constraints"] == "1"
    # at proximal = 1.25, distal = 1.75: the least of sin(5 p) + d and 4 - d^2; 3 - p - d
    assert lines["middle"] == "OK, objective 0.9375, least slack 0"
    assert [path.name for path in tmp_path.iterdir()] == ["run.toml"]


@pytest.mark.soak
def test_the_middle_of_a_design_run(run, design):
    out = run("check", design)[1]
    x, y = np.meshgrid([-0.5, 0, 0.5], [0.8, 1.2, 1.6])
    poses = np.stack([x.ravel(), y.ravel()], axis=1)
    mech = pk.FiveBar(half_base=0.3, proximal=1.25, distal=1.75)
    least = float(np.min(pk.local_indices(mech, poses).isotropy))
    joints = pk.inverse_kinematics(mech, poses).joints
    slacks = [mech.margins(*row) for row in zip(poses, joints, strict=True)]
    slack = min(float(np.min(each)) for row in slacks for each in row.values())
    value, margin = re.search(r"^middle +OK, objective (\S+), least slack (\S+)$", out, re.M).groups()
    np.testing.assert_allclose([float(value), float(margin)], [least, slack], rtol=1e-5)
    count = sum(np.size(each) for row in slacks for each in row.values())
    assert f"constraints  {count}\n" in out


@pytest.mark.parametrize(
    ("change", "arguments", "expected"),
    [
        (("[0.5, 2.0]", "[2.0, 0.5]"), [], "run.toml: variables.proximal must be [lower, upper]"),
        (("five-bar", "five-baar"), [], "run.toml: design family must be one of five-bar, 2-rpr"),
        (("[objective]", "[objektive]"), [], "run.toml: unknown key 'objektive' (did you mean 'objective'?)"),
        (("mechanism =", 'family = "FiveBar"\nmechanism ='), [], "run.toml: unknown key 'mechanism'"),
        (("", ""), ["--unit", "mm"], "--unit is for a mechanism, a run file says its own"),
    ],
)
def test_a_run_file_that_is_none(run, design, change, arguments, expected):
    design.write_text(design.read_text().replace(*change))
    code, out, err = run("check", design, *arguments)
    assert code == 2 and out == "" and err.count("\n") == 1 and expected in err
