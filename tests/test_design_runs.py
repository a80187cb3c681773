"""Design runs on disk: strict run files, and folders that a killed run goes on from to the same last bit."""

import io
import json
import os
import random
import signal
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest
import small_runs
from refusals import said_by
from small_runs import RESULTS, TEXT, bytes_of, ended, started

import pk_jax as pk
from pk_jax.design.search import optimize_problem
from pk_jax.files import checkpoint, design_run, run_file, run_problem
from pk_jax.files.design_run import run_into
from pk_jax.files.run_file import parse_run, settings_of
from pk_jax.files.run_folder import run_folder
from pk_jax.viz.design import draw_design, draw_history

pytestmark = pytest.mark.usefixtures("compiled_in_haste")


@pytest.fixture
def small(monkeypatch):
    """Runs that compile at once, and save after every chunk."""
    monkeypatch.setattr(run_file, "problem_of", small_runs.small_problem)
    monkeypatch.setattr(design_run, "SAVE_EVERY", 0.0)
    monkeypatch.setattr(design_run, "CHUNK", small_runs.CHUNK)
    monkeypatch.setattr("pk_jax.cli.design._figures", lambda run: None)


@pytest.fixture
def file(small, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TEXT)
    return path


def parsed(text=TEXT):
    return parse_run(text.encode(), "mine.toml")


# --- run files


def with_line(table, line):
    return (
        TEXT.replace(f"[{table}]\n", f"[{table}]\n{line}\n")
        if table in TEXT
        else f"{TEXT}[{table}]\n{line}\n"
    )


def of_workspace(line, constraint=""):
    """The run file of an integral over the workspace, with one more line."""
    inside = TEXT[TEXT.index("over =") : TEXT.index("[search]")]
    return TEXT.replace(inside, f'over = "workspace"\n{line}\n[constraints]\n{constraint}\n')


BAD = {
    "no TOML": ("mechanism =", "invalid TOML"),
    "not UTF-8": (b"name = '\xff'", "must be UTF-8 text"),
    "nothing": ("", "missing key 'mechanism'"),
    "no objective": ('mechanism = "five-bar"', "missing key 'objective'"),
    "misspelt family": (TEXT.replace("five-bar", "five-baar"), "'five-baar'"),
    "family no string": (TEXT.replace('"five-bar"', "5"), "mechanism must be"),
    "misspelt table": (TEXT.replace("[search]", "[serach]"), "'serach' (did you mean 'search'?)"),
    "table no table": (f"search = 3\n{TEXT.split('[search]')[0]}", "search must be a table, [search], got 3"),
    "comment no string": (f"name = 3\n{TEXT}", "name must be a string, got 3"),
    "unknown unit": (f'unit = "mm"\n{TEXT}', 'unit must be one of "1", "m", got \'mm\''),
    "misspelt variable": (
        TEXT.replace("proximal", "proximla"),
        "'variables.proximla' (did you mean 'proximal'?)",
    ),
    "no variable": (
        TEXT.replace("proximal = [0.5, 2.0]\ndistal = [1.0, 2.5]\n", ""),
        "variables must hold one",
    ),
    "bounds no array": (
        TEXT.replace("[0.5, 2.0]", "0.5"),
        "variables.proximal must be an array of 2 numbers",
    ),
    "three bounds": (TEXT.replace("[0.5, 2.0]", "[0.5, 2, 3]"), "variables.proximal must be an array of 2"),
    "bounds in the wrong order": (
        TEXT.replace("[0.5, 2.0]", "[2.0, 0.5]"),
        "with lower < upper, got [2.0, 0.5]",
    ),
    "equal bounds": (TEXT.replace("[0.5, 2.0]", "[2, 2]"), "with lower < upper, got [2, 2]"),
    "bound nan": (TEXT.replace("[0.5, 2.0]", "[0.5, nan]"), "variables.proximal[1] must be finite, got nan"),
    "bound huge": (TEXT.replace("[0.5, 2.0]", f"[0.5, {10**400}]"), "variables.proximal[1] must be finite"),
    "bound a string": (TEXT.replace("[0.5, 2.0]", '["0.5", 2]'), "variables.proximal[0] must be a number"),
    "bound a bool": (TEXT.replace("[0.5, 2.0]", "[false, 2]"), "variables.proximal[0] must be a number"),
    "misspelt parameter": (
        TEXT.replace("half_base", "halfbase"),
        "'fixed.halfbase' (did you mean 'half_base'?)",
    ),
    "fixed infinite": (TEXT.replace("0.3", "inf"), "fixed.half_base must be finite, got inf"),
    "fixed and variable": (with_line("fixed", "distal = 1.0"), "fixed.distal is a variable, too"),
    "no index": (TEXT.replace('index = "isotropy"\n', ""), "missing key 'objective.index'"),
    "misspelt index": (TEXT.replace("isotropy", "isotrpy"), "(did you mean 'isotropy'?)"),
    "over nothing": (TEXT.replace('over = "rectangle"\n', ""), "missing key 'objective.over'"),
    "over what": (TEXT.replace("rectangle", "circle"), "objective.over must be one of"),
    "measure of the other": (
        with_line("objective", 'measure = "volume"'),
        "objective.measure must be one of",
    ),
    "workspace with nodes": (TEXT.replace('"rectangle"', '"workspace"'), "objective.lower is for over ="),
    "misspelt option": (of_workspace("ray = 16"), "'objective.ray' (did you mean 'rays'?)"),
    "rays of a rectangle": (with_line("objective", "rays = 16"), 'objective.rays is for over = "workspace"'),
    "rule": (of_workspace('rule = "ray"'), "objective.rule must be one of"),
    "few rays": (of_workspace("rays = 7"), "objective.rays must be an integer from 8 to"),
    "rays a float": (of_workspace("rays = 16.0"), "objective.rays must be an integer"),
    "nodes an array": (of_workspace("nodes = [4, 4]"), "objective.nodes must be an integer from 2 to 64"),
    "many cells": (of_workspace("cells = 5000"), "objective.cells must be an integer from 8 to 4096"),
    "two replicates": (of_workspace("replicates = 2"), "objective.replicates must be an integer from 4"),
    "seed of the rays": (of_workspace("seed = -1"), "objective.seed must be an integer from 0"),
    "clearance nan": (of_workspace("clearance = nan"), "objective.clearance must be finite, got nan"),
    "within no table": (of_workspace("within = [0, 1]"), "objective.within must be a table"),
    "within nothing": (of_workspace("within = {}"), "objective.within must be a table"),
    "within wrong way": (of_workspace("within = {x = [1, 0]}"), "objective.within.x must be [lower, upper]"),
    "no length": (with_line("objective", "length = 0"), "objective.length must be positive, got 0"),
    "length of no kind": (of_workspace('length = "m"'), "objective.length must be a number"),
    "volume of a rectangle": (
        with_line("constraints", "volume = 1.0"),
        'is for objective.over = "workspace"',
    ),
    "no volume": (of_workspace("", "volume = 0"), "constraints.volume must be positive, got 0"),
    "margins of a workspace": (of_workspace("", "margins = true"), 'is for objective.over = "rectangle"'),
    "no nodes": (TEXT.replace("nodes = [3, 3]\n", ""), "missing key 'objective.nodes'"),
    "one node": (TEXT.replace("[3, 3]", "[3]"), "objective.nodes must be an integer or 2 of them, got [3]"),
    "zero nodes": (TEXT.replace("[3, 3]", "[3, 0]"), "objective.nodes must be an integer from 1 to"),
    "many nodes": (TEXT.replace("[3, 3]", "[1000, 1000]"), "objective.nodes must make at most"),
    "corner of another size": (TEXT.replace("[0.5, 1.6]", "[0.5]"), "objective.upper must be an array of 2"),
    "corners the wrong way": (
        TEXT.replace("[0.5, 1.6]", "[0.5, 0.6]"),
        "objective.upper must not be below lower",
    ),
    "mode": (with_line("objective", 'mode = "+0"'), "objective.mode must be signs, like \"+-\", got '+0'"),
    "misspelt constraint": (
        with_line("constraints", "margin = true"),
        "'constraints.margin' (did you mean 'margins'?)",
    ),
    "margins no bool": (
        with_line("constraints", "margins = 1"),
        "constraints.margins must be true or false, got 1",
    ),
    "clearance a bool": (
        with_line("constraints", "clearance = true"),
        "constraints.clearance must be a number",
    ),
    "misspelt setting": (with_line("search", "sead = 1"), "'search.sead' (did you mean 'seed'?)"),
    "no starts": (
        TEXT.replace("starts = 7", "starts = 0"),
        "search.starts must be an integer from 1 to 100000, got 0",
    ),
    "starts a float": (TEXT.replace("starts = 7", "starts = 7.0"), "search.starts must be an integer"),
    "many steps": (
        TEXT.replace("steps = 60", "steps = 100001"),
        "search.steps must be an integer from 1 to 100000",
    ),
    "negative seed": (with_line("search", "seed = -1"), "search.seed must be an integer from 0 to"),
    "tolerance": (
        with_line("search", "tolerance = 1.0"),
        "search.tolerance must be between 0 and 1, got 1.0",
    ),
    "tolerance nan": (with_line("search", "tolerance = nan"), "search.tolerance must be finite, got nan"),
    "deep": (f"name = {'[' * 3000}", "mine.toml: "),
    "long": ("#" * 1_000_001, "at most 1000000 bytes"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_told_in_one_line(name):
    text, expected = BAD[name]
    said = said_by(settings_of, text if isinstance(text, bytes) else text.encode(), "mine.toml")
    assert said.startswith("mine.toml: ") and expected in said and len(said) < 420, said


def test_what_is_left_out_is_filled_in():
    found = settings_of(TEXT.encode(), "mine.toml")
    assert found["search"] == {"starts": 7, "steps": 60, "seed": 0, "tolerance": 1e-8}
    assert found["objective"]["measure"] == "least" and found["constraints"] == {"margins": False}
    assert found["fixed"] == {"half_base": 0.3}
    short = settings_of(TEXT.replace("[3, 3]", "3").encode(), "mine.toml")
    assert short == found
    free = TEXT.replace("[variables]\nproximal = [0.5, 2.0]\ndistal = [1.0, 2.5]\n", "")
    assert set(settings_of(free.encode(), "mine.toml")["variables"]) == {"proximal", "distal"}


def test_what_a_search_is_without_settings():
    short = TEXT.split("[search]")[0].encode()
    assert settings_of(short, "mine.toml")["search"] == dict(starts=16, steps=200, seed=0, tolerance=1e-8)


COUNTED = {
    "nodes": (2, 64),
    "rays": (8, 10**6),
    "replicates": (4, 16),
    "cells": (8, 4096),
    "seed": (0, 2**32 - 1),
}


@pytest.mark.parametrize("name", COUNTED)
def test_counts_have_a_least_and_a_greatest(name):
    text = lambda count: of_workspace(f"{name} = {count}").encode()
    least, greatest = COUNTED[name]
    for good in (least, greatest):
        assert settings_of(text(good), "mine.toml")["objective"][name] == good
    for bad in (least - 1, greatest + 1):
        assert f"objective.{name} must be an integer from" in said_by(settings_of, text(bad), "mine.toml")


def test_a_rectangle_has_a_greatest_number_of_poses():
    text = lambda nodes: TEXT.replace("[3, 3]", nodes).encode()
    assert settings_of(text("[400, 250]"), "mine.toml")["objective"]["nodes"] == [400, 250]
    assert "must make at most 100000 poses" in said_by(settings_of, text("[401, 250]"), "mine.toml")


def test_the_digest_is_that_of_the_meaning():
    digest = lambda text: run_file.digest_of(settings_of(text.encode(), "mine.toml"))
    same = f"# a comment\nname = 'mine'\n{TEXT.replace('[3, 3]', '3').replace('2.0', '2')}"
    assert digest(same) == digest(TEXT)
    swapped = TEXT.replace(
        "proximal = [0.5, 2.0]\ndistal = [1.0, 2.5]", "distal = [1.0, 2.5]\nproximal = [0.5, 2.0]"
    )
    others = [swapped, TEXT.replace("0.3", "0.4"), TEXT + "seed = 1\n", with_line("objective", 'mode = "+-"')]
    assert len({digest(text) for text in (TEXT, *others)}) == 5


def test_a_run_file_makes_its_problem():
    text = TEXT.replace("[3, 3]", "[2, 1]").replace("[search]", "[constraints]\n{}\n[search]")
    problem = parsed(text.format("margins = true\nclearance = 0.1")).problem
    assert problem.entries == ("proximal", "distal") and problem.name == "five-bar"
    assert problem.objective_count == 2
    clearances = [name for name in problem.constraint_names if name.startswith("clearance")]
    assert len(clearances) == 2 < len(problem.constraint_names)
    np.testing.assert_array_equal(problem.lower, [0.5, 1.0])
    mech = problem.design(np.array([1.5, 1.2]))
    assert isinstance(mech, pk.FiveBar) and float(mech.half_base) == 0.3
    mean = parsed(
        text.format("clearance = 0.3").replace("[objective]", '[objective]\nmeasure = "mean"')
    ).problem
    both = jax.jit(lambda vector: (problem.measure(vector), mean.measure(vector)))
    (objective, slacks), (only, more) = both(np.array([1.5, 1.2]))
    assert only.shape == (1,) and float(only[0]) == pytest.approx(float(objective.mean()), rel=1e-12)
    np.testing.assert_allclose(slacks[: len(clearances)] - more, 0.2, atol=1e-12)


def test_the_clearance_counts_on_either_side_of_a_singularity():
    """The mirror image of a working mode has det A of the other sign."""
    text = TEXT.replace('"isotropy"', '"clearance"').replace("nodes = [3, 3]", 'nodes = [1, 3]\nmode = "{}"')
    text = text.replace("lower = [-0.5, 0.8]", "lower = [0, {}]").replace(
        "upper = [0.5, 1.6]", "upper = [0, {}]"
    )
    above, below = (parsed(text.format(*words)).problem for words in ((1.4, 2.0, "+-"), (-2.0, -1.4, "-+")))
    both = jax.jit(lambda vector: (above.measure(vector)[0], below.measure(vector)[0]))
    above, below = both(np.array([1.5, 1.2]))
    assert np.all(above > 0.05)
    np.testing.assert_allclose(below[::-1], above, rtol=1e-12)


def test_a_workspace_takes_the_options_of_its_integral(monkeypatch):
    asked = []

    def over_workspace(index=None, **options):
        asked.append((index, options))
        return lambda mech: 2 * mech.distal

    monkeypatch.setattr(run_problem, "over_workspace", over_workspace)
    options = 'measure = "integral"\nrule = "rays"\nrays = 16\nnodes = 4\ncells = 9\nreplicates = 5\nseed = 3'
    limits = 'mode = "-+"\nclearance = 0.1\nlength = 0.5\nwithin = {y = [0, 1.5]}'
    problem = parsed(of_workspace(f"{options}\n{limits}", "volume = 0.5")).problem
    (index, found), (none, others) = asked
    np.testing.assert_array_equal(found.pop("branch"), [-1, 1])
    words = {"rule": "rays", "rays": 16, "nodes": 4, "cells": 9, "replicates": 5, "seed": 3}
    words |= {"clearance": 0.1, "length": 0.5, "within": {"y": [0.0, 1.5]}}
    assert (index, found) == ("isotropy", {"measure": "integral", **words})
    assert none is None and others.pop("branch") is not None and others == {"measure": "volume", **words}
    objective, slacks = problem.measure(np.array([1.5, 1.2]))
    assert problem.constraint_names == ("volume",) and float(objective[0]) == 2.4
    np.testing.assert_allclose(slacks, [2.4 / 0.5 - 1])


def test_what_the_integral_refuses_is_told_with_the_file():
    assert said_by(parsed, of_workspace("within = {phi = [0, 1]}")).startswith("mine.toml: within must name")


# --- run folders


def test_a_run_writes_all_there_is(run, file, tmp_path):
    code, out, _ = run("optimize", file, "--out", tmp_path / "a")
    assert code == 0 and "status     OK" in out
    folder = tmp_path / "a"
    names = {"config.toml", "run.json", "checkpoint.npz", *RESULTS}
    assert {path.name for path in folder.iterdir()} == names
    assert (folder / "config.toml").read_text() == TEXT
    found = json.loads((folder / "result.json").read_text())
    best = optimize_problem(parsed().problem, starts=7, steps=60, tolerance=1e-8, chunk=3)
    assert found["value"] == best.value and found["status"] == "OK"
    assert list(found["variables"].values()) == best.vector.tolist()
    assert found["constraints"] == best.constraints and found["evaluations"] == best.evaluations
    mech = pk.load_mechanism(folder / "result.toml")
    assert float(mech.proximal) == float(best.mechanism.proximal) and float(mech.half_base) == 0.3
    starts = np.genfromtxt(folder / "starts.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(starts["value"], best.values)
    np.testing.assert_array_equal(np.stack([starts["proximal"], starts["distal"]], axis=1), best.vectors)
    history = np.genfromtxt(folder / "history.csv", delimiter=",", names=True)
    assert history["best"][-1] == np.nanmax(best.values) and np.all(np.diff(history["best"]) >= 0)
    assert history["evaluations"][-1] == best.evaluations and history["finished"][-1] == 7
    about = json.loads((folder / "run.json").read_text())
    assert (
        about["settings"]["search"]["seed"] == 0 and "jax" in about["versions"] and about["session"]["host"]
    )


def test_an_interrupted_run_goes_on_to_the_same_bits(run, file, tmp_path):
    whole, broken, mine = tmp_path / "whole", tmp_path / "broken", parsed()
    run_into(whole, mine)
    for chunks in (0, 3, 1):  # before there is a checkpoint, and twice after
        with pytest.raises(KeyboardInterrupt):
            run_into(broken, mine, resume=True, further=small_runs.stopping(mine, chunks))
        assert not (broken / "result.json").exists()
    header, arrays = checkpoint.read_saved(broken / "checkpoint.npz")
    assert header["steps"] == 4 and len(arrays["history"]) == 4
    assert bytes_of(whole) == bytes_of(run_into(broken, mine, resume=True).folder)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_says_how_to_go_on(run, file, tmp_path, monkeypatch, number):
    on_devices, stop = design_run.on_devices, lambda: signal.raise_signal(number)
    monkeypatch.setattr(design_run, "SAVE_EVERY", 1e9)  # only what the signal lets it save
    monkeypatch.setattr(design_run, "on_devices", lambda run, devices: small_runs.stopping(run, 2, stop))
    code, out, err = run("optimize", file, "--out", tmp_path / "a b")
    assert code == 130 and out == ""
    assert err.splitlines()[-1] == (
        f"pk-jax: interrupted; go on with: pk-jax optimize {file} --out '{tmp_path / 'a b'}' --resume"
    )
    assert checkpoint.read_saved(tmp_path / "a b" / "checkpoint.npz").header["steps"] == 2
    monkeypatch.setattr(design_run, "on_devices", on_devices)
    code, out, err = run("optimize", file, "--out", tmp_path / "a b")
    assert code == 2 and out == "" and "an interrupted run; --resume goes on with it" in err


def test_a_run_that_dies_between_its_results_writes_them_again(small, tmp_path, monkeypatch):
    whole = bytes_of(run_into(tmp_path / "whole", parsed()).folder)
    replace = os.replace

    def die_at(name):
        def replace_or_die(temporary, target):
            if Path(target).name == name:
                raise KeyboardInterrupt
            replace(temporary, target)

        return replace_or_die

    for name in RESULTS:
        monkeypatch.setattr(os, "replace", die_at(name))
        with pytest.raises(KeyboardInterrupt):
            run_into(tmp_path / name, parsed())
        monkeypatch.setattr(os, "replace", replace)
        assert not (tmp_path / name / "result.json").exists()
        assert bytes_of(run_into(tmp_path / name, parsed(), resume=True).folder) == whole


def test_a_finished_run_is_left_alone(run, file, tmp_path):
    folder = run_into(tmp_path / "a", parsed()).folder
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()}
    code, out, err = run("optimize", file, "--out", folder)
    assert code == 2 and out == "" and err.count("\n") == 1 and "holds a finished run" in err
    code, out, err = run("optimize", file, "--out", folder, "--resume")
    assert code == 0 and out == f"{folder}: the run is finished\n"
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()} == before


@pytest.mark.parametrize("resume", [[], ["--resume"]])
def test_a_folder_of_another_run_is_refused(run, file, tmp_path, resume):
    folder = run_into(tmp_path / "a", parsed()).folder
    before = bytes_of(folder)
    file.write_text(TEXT.replace("[1.0, 2.5]", "[1.0, 2.4]"))
    code, out, err = run("optimize", file, "--out", folder, *resume)
    assert code == 2 and out == "" and err.count("\n") == 1
    assert "another run: variables.distal = [1.0, 2.5] there, [1.0, 2.4] here" in err
    assert bytes_of(folder) == before


def test_a_second_writer_is_refused(run, file, tmp_path):
    with run_folder(tmp_path / "a"):
        code, out, err = run("optimize", file, "--out", tmp_path / "a", "--quiet")
    assert code == 4 and out == "" and "written by another process" in err and err.count("\n") == 1
    assert not (tmp_path / "a").exists()


def test_no_feasible_design_is_said(run, file, tmp_path):
    file.write_text(with_line("constraints", "clearance = 9.0").replace("steps = 60", "steps = 3"))
    code, out, _ = run("optimize", file, "--out", tmp_path / "a", "--quiet")
    assert code == 5 and "0 feasible" in out
    assert not (tmp_path / "a" / "result.toml").exists()
    found = json.loads((tmp_path / "a" / "result.json").read_text())
    assert found["status"] == "UNREACHABLE" and found["value"] is None and found["feasible_starts"] == 0
    assert (tmp_path / "a" / "history.csv").read_text().splitlines()[-1].startswith("3,-inf,")


def test_quiet(run, file, tmp_path, monkeypatch):
    monkeypatch.setattr("pk_jax.files.progress.Progress.note", lambda self, line, **_: self.say(line))
    assert run("optimize", file, "--out", tmp_path / "a", "--quiet")[2] == ""
    lines = run("optimize", file, "--out", tmp_path / "b")[2].splitlines()
    assert lines[0].startswith("five-bar  1/60  best ") and "0/7 starts ended" in lines[0]
    assert "more" not in lines[0] and "s more after" in lines[1]


OPTIONS = {
    "weights of a run": (["mine.toml", "--weights", "1", "1", "1"], "--weights is for 2-rpr and 2-rrr"),
    "steps of a run": (["mine.toml", "--steps", "3"], "--steps is for 2-rpr and 2-rrr"),
    "folder of a space": (["2-rpr", "--out", "a"], "--out is for a RUN.toml"),
    "resume a space": (["2-rpr", "--resume"], "--resume is for a RUN.toml"),
    "devices of a space": (["2-rpr", "--devices", "0"], "--devices is for a RUN.toml"),
    "shard of a space": (["2-rpr", "--shard", "1/2"], "--shard is for a RUN.toml"),
    "shard": (["mine.toml", "--shard", "2"], "--shard must be I/N, like 1/4, got '2'"),
    "shard 0": (["mine.toml", "--shard", "0/4"], "1 <= I <= N, got '0/4'"),
    "shard 5": (["mine.toml", "--shard", "5/4"], "1 <= I <= N, got '5/4'"),
    "eight shards": (["mine.toml", "--shard", "1/8"], "7 starts make at most 7 parts, got 8"),
    "no device": (["mine.toml", "--devices", "0"], "--devices must be from 1 to 4096, got 0"),
    "many devices": (["mine.toml", "--devices", "4096"], "--devices: there are"),
    "no process": (["mine.toml", "--coordinator", "localhost:1"], "--coordinator and --process go together"),
    "shard and process": (
        ["mine.toml", "--coordinator", "a:1", "--process", "1/2", "--shard", "1/2"],
        "--shard and --process exclude each other",
    ),
    "no port": (
        ["mine.toml", "--coordinator", "host", "--process", "1/2"],
        "--coordinator must be HOST:PORT",
    ),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_that_do_not_fit(run, file, name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    arguments, expected = OPTIONS[name]
    code, out, err = run("optimize", *arguments)
    assert code == 2 and out == "" and err.count("\n") == 1 and expected in err, err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


def test_trouble_with_the_run_file(run, tmp_path):
    code, _, err = run("optimize", tmp_path / "none.toml", "--out", tmp_path / "a")
    assert code == 4 and "No such file" in err and err.count("\n") == 1
    (tmp_path / "bad.toml").write_text(TEXT.replace("[0.5, 2.0]", "[2.0, 0.5]"))
    code, _, err = run("optimize", tmp_path / "bad.toml", "--out", tmp_path / "a")
    assert code == 2 and "bad.toml: variables.proximal must be" in err and err.count("\n") == 1
    assert not (tmp_path / "a").exists()


# --- checkpoints


@pytest.fixture
def saved(small, tmp_path):
    """A checkpoint, and its run."""
    mine = parsed()
    with pytest.raises(KeyboardInterrupt):
        run_into(tmp_path / "a", mine, further=small_runs.stopping(mine, 2))
    return tmp_path / "a" / "checkpoint.npz", mine


def test_a_damaged_checkpoint_is_refused_and_kept(saved, run, file):
    path, _ = saved
    whole = path.read_bytes()
    chance = random.Random(0)
    damaged = [whole[: chance.randrange(len(whole))] for _ in range(8)] + [b"", b"PK"]
    for _ in range(60):
        at, bit = chance.randrange(len(whole)), 1 << chance.randrange(8)
        damaged.append(whole[:at] + bytes([whole[at] ^ bit]) + whole[at + 1 :])
    told, expected = 0, checkpoint.read_saved(path)
    for content in damaged:
        path.write_bytes(content)
        try:
            found = checkpoint.read_saved(path)
        except ValueError:
            said = said_by(checkpoint.read_saved, path)
            assert said.startswith(f"{path}: no checkpoint, or a damaged one: ") and len(said) < 400
            told += 1
            continue
        assert found.header == expected.header  # a bit that says nothing may be another one
        for name, array in expected.arrays.items():
            np.testing.assert_array_equal(found.arrays[name], array)
    assert told > 50
    path.write_bytes(damaged[0])
    code, out, err = run("optimize", file, "--out", path.parent, "--resume")
    assert code == 2 and out == "" and err.count("\n") == 1 and path.read_bytes() == damaged[0]


def test_a_checkpoint_never_unpickles_and_never_allocates_what_it_says(tmp_path):
    path, run_as_code = tmp_path / "x.npz", tmp_path / "seen"

    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(run_as_code),)

    header = np.frombuffer(json.dumps({"format": 1, "arrays": {"x": ["|O", [1]]}}).encode(), np.uint8)
    np.savez(path, header=header, x=np.array([Bomb()], object))
    assert "must be numbers" in said_by(checkpoint.read_saved, path) and not run_as_code.exists()

    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": (10**12,), "fortran_order": False, "descr": "<f8"})
    header = np.frombuffer(json.dumps({"format": 1, "arrays": {"x": ["<f8", [10**12]]}}).encode(), np.uint8)
    np.savez(path, header=header)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("x.npy", stream.getvalue())
    assert "not as long as its shape" in said_by(checkpoint.read_saved, path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("header.npy", b"0" * 10**6)
    assert "larger than the file" in said_by(checkpoint.read_saved, path)


def test_checkpoints_of_others_are_refused(saved):
    path, mine = saved
    header, arrays = checkpoint.read_saved(path)
    said = lambda header, arrays: (
        path.write_bytes(checkpoint.packed(header, arrays))
        and said_by(run_into, path.parent, mine, resume=True)
    )
    assert "its config is" in said({**header, "config": "0" * 64}, arrays)
    assert "its kind is 'part'" in said({**header, "kind": "part"}, arrays)
    assert "its part is [1, 2]" in said({**header, "part": [1, 2]}, arrays)
    assert "steps must be an integer up to 60, got 61" in said({**header, "steps": 61}, arrays)
    assert "2 rows of history" in said(header, {**arrays, "history": arrays["history"][:1]})
    assert "array box must be" in said(header, {**arrays, "box": arrays["box"][:, :1]})
    fewer = {name: array if name == "history" else array[:5] for name, array in arrays.items()}
    assert "it must have 7 starts" in said(header, fewer)
    assert not (path.parent / "result.json").exists()


def test_a_checkpoint_holds_the_arrays_of_its_header_and_numbers_only(tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes(checkpoint.packed({}, {"x": np.ones(2), "y": np.ones(3)}))
    assert set(checkpoint.read_saved(path).arrays) == {"x", "y"}
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    without = {name: data for name, data in members.items() if name != "y.npy"}
    for wrong in (without, {**members, "z.npy": members["x.npy"]}, {**without, "z.npy": members["y.npy"]}):
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in wrong.items():
                archive.writestr(name, data)
        assert "its arrays are others than its header says" in said_by(checkpoint.read_saved, path)
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        checkpoint.packed({}, {"x": np.array([object()])})


def test_a_checkpoint_of_other_versions_is_warned_of(saved):
    path, mine = saved
    header, arrays = checkpoint.read_saved(path)
    path.write_bytes(checkpoint.packed({**header, "versions": {}}, arrays))
    with pytest.warns(UserWarning, match="by other versions"):
        run_into(path.parent, mine, resume=True)


# --- killed


@pytest.mark.parametrize(
    ("kills", "seed"), [(1, 0), *(pytest.param(20, seed, marks=pytest.mark.soak) for seed in range(1, 6))]
)
def test_a_killed_run_goes_on_to_the_same_bits(small, tmp_path, kills, seed):
    (tmp_path / "mine.toml").write_text(TEXT)
    arguments = "--kills", kills, seed, tmp_path / "mine.toml", tmp_path / "k"
    code, out, err = ended(started(tmp_path / "cache", *arguments))
    assert code == 0, err
    folders = sorted((tmp_path / "k").iterdir())
    assert out.splitlines()[-1] == f"folders {len(folders)}"
    whole = bytes_of(run_into(tmp_path / "whole", parsed()).folder)
    for folder in folders:
        assert bytes_of(folder) == whole
        assert not list(folder.glob(".*.part"))


# --- figures


def test_the_figures():
    mech = pk.FiveBar(half_base=0.3, proximal=1.5, distal=1.2)
    axes = draw_design(mech, ([-0.5, 0.8], [0.5, 1.6]))
    tinted = axes.collections[0].get_paths()[0].get_extents()
    np.testing.assert_allclose([tinted.min, tinted.max], [[-0.5, 0.8], [0.5, 1.6]])
    point = lambda axes: axes.lines[-1].get_xydata()  # the joints that move
    assert np.isclose(point(axes), [0, 1.2]).all(axis=1).any()
    far = draw_design(mech, ([8.0, 8.0], [9.0, 9.0]))  # out of reach: at home
    home = np.asarray(mech.skeleton(*mech.home()).points)
    assert np.isclose(point(far), home[-1]).all(axis=1).any()
    history = np.array([[10, -np.inf, 0.5, 0, 0, 7], [20, 1.5, 0, 2, 1, 12.0]])
    axes = draw_history(history)
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [np.nan, 1.5])


def test_the_examples_are_run_files():
    examples = sorted((Path(__file__).parent.parent / "examples").glob("design_*.toml"))
    assert examples
    for path in examples:
        assert settings_of(path.read_bytes(), path)["search"]["starts"] <= 64
