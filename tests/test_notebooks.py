"""The notebooks run as scripts, and the stored .ipynb is the executed copy of each of them."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted((ROOT / "notebooks").glob("*.py"))
LARGEST = 1_500_000  # bytes of an .ipynb
CELL = re.compile(r"^# %%(?P<markdown> \[markdown\])?$", re.MULTILINE)

EVERY = pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)


def cells_of(text):
    """The cells of a percent script, as (cell_type, source); its header is skipped."""
    marks = list(CELL.finditer(text))
    ends = [*(mark.start() for mark in marks[1:]), len(text)]
    for mark, end in zip(marks, ends, strict=True):
        source = text[mark.end() : end].strip("\n")
        if mark["markdown"]:
            yield "markdown", re.sub(r"^# ?", "", source, flags=re.MULTILINE)
        else:
            yield "code", re.sub(r"^# (?=%\w)", "", source, flags=re.MULTILINE)  # a magic line


def notebook_of(script):
    return json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))


def code_cells(script):
    return [cell for cell in notebook_of(script)["cells"] if cell["cell_type"] == "code"]


def test_a_percent_script_is_parsed():
    header, title = "# ---\n# header\n# ---\n\n", "# %% [markdown]\n# # Title\n#\n# text\n\n"
    text = header + title + "# %%\n# %matplotlib inline\nx = 1  # %%\n"
    assert list(cells_of(text)) == [
        ("markdown", "# Title\n\ntext"),
        ("code", "%matplotlib inline\nx = 1  # %%"),
    ]


def test_there_are_notebooks():
    assert SCRIPTS
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} == {path.stem for path in SCRIPTS}


@pytest.mark.soak  # a minute each
@EVERY
def test_it_runs_as_a_script_without_warnings(script, tmp_path):
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    settings = {"JAX_PLATFORMS": "cpu", "MPLBACKEND": "Agg", "PYTHONPATH": os.pathsep.join(paths)}
    settings["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # they compile for longer than they run
    run = subprocess.run(
        [sys.executable, "-W", "error", str(script)],
        cwd=tmp_path,
        env=os.environ | settings,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
    assert "nan" not in re.sub(r"\[nan nan\]", "", run.stdout)  # only lost rows, which come whole
    assert not list(tmp_path.iterdir())  # it leaves nothing behind


@EVERY
def test_the_stored_cells_are_those_of_the_script(script):
    stored = [(cell["cell_type"], "".join(cell["source"])) for cell in notebook_of(script)["cells"]]
    assert stored == list(cells_of(script.read_text(encoding="utf-8")))


@EVERY
def test_every_code_cell_was_executed_in_order(script):
    cells = code_cells(script)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))


@EVERY
def test_no_output_is_an_error_or_a_warning(script):
    for cell in code_cells(script):
        for output in cell["outputs"]:
            assert output["output_type"] != "error", output.get("evalue")
            assert output.get("name") != "stderr", output["text"]


@EVERY
def test_a_cell_that_ends_in_a_figure_shows_it(script):
    shown = 0
    for cell in code_cells(script):
        last = ast.parse(re.sub(r"^%.*", "", "".join(cell["source"]), flags=re.MULTILINE)).body[-1]
        is_figure = isinstance(last, ast.Expr) and not re.match(r"print\(|pk\.enable_x64", ast.unparse(last))
        kinds = [kind for output in cell["outputs"] for kind in output.get("data", {})]
        assert kinds.count("image/png") == is_figure, ast.unparse(last)
        shown += is_figure
    assert shown


@EVERY
def test_the_stored_file_is_small_and_names_no_machine(script):
    text = script.with_suffix(".ipynb").read_text(encoding="utf-8")
    assert len(text.encode()) < LARGEST
    outputs = json.dumps([cell["outputs"] for cell in code_cells(script)])
    for place in (str(ROOT), str(Path.home()), "site-packages", "/home/", "/Users/", "/tmp/"):
        assert place not in outputs
