"""Nam, Lee and Park 2006 from the command line: every cell, every verdict, every file.

Then its optima, and the README's ten lines, which end in one: all of them share what is compiled.
"""

import csv
import json
import re
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import pk_jax as pk
from pk_jax.cli import main
from pk_jax.design.optimize import indices_and_slopes, maximize
from pk_jax.papers.nam2006_printed import MISPRINTS, TABLES

pytestmark = pytest.mark.usefixtures("compiled_well")

README = (Path(__file__).parent.parent / "README.md").read_text()
RPR, RRR = pk.design_space("2-rpr"), pk.design_space("2-rrr")

FIGURES = {
    "fig1_mechanisms.png",
    "fig2_joint_space.png",
    "fig3a_cpi_2rpr.png",
    "fig3b_cpi_2rrr.png",
    "fig4_local_indices_2rpr.png",
    "fig5_local_indices_2rrr.png",
    "fig6_workspace_2rpr.png",
    "fig6_workspace_2rrr.png",
    "fig7_actuators_2rpr.png",
    "fig7_actuators_2rrr.png",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(folder, what was printed) of one run"""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pk_jax.cli._compile_cache", lambda: None)
        printed = []
        patch.setattr("builtins.print", lambda *words, **_: printed.append(" ".join(map(str, words))))
        folder = tmp_path_factory.mktemp("runs") / "nam 2006"
        assert main(["reproduce", "--out", str(folder)]) == 0
    return folder, "\n".join(printed)


@pytest.fixture(scope="module")
def tables(run):
    return json.loads((run[0] / "tables.json").read_text())


def test_the_run_folder_is_complete(run):
    assert {p.name for p in run[0].iterdir()} == FIGURES | {"tables.json", "tables.csv"}
    for name in FIGURES:
        content = (run[0] / name).read_bytes()
        assert content[:8] == b"\x89PNG\r\n\x1a\n" and len(content) > 10_000


def test_every_cell_is_there_once(tables):
    expected = sum(len(cells) for table in TABLES for cells in table.rows.values())
    keys = {(c["table"], c["row"], c["column"]) for c in tables["cells"]}
    assert len(keys) == len(tables["cells"]) == expected == 8 + 7 * 6 + 8 + 7 * 7


def test_four_misprints_and_nothing_else(tables):
    misprinted = {(c["table"], c["row"], c["column"]): c for c in tables["cells"] if c["misprint"]}
    assert {c["misprint"] for c in misprinted.values()} == {
        "Table 1, least GRI",
        "Table 2, least SUI",
        "Table 2, lb at l_min = 1",
        "Table 2, interchanged rows",
    }
    assert set(misprinted) == {(m.table, m.row, m.column) for m in MISPRINTS}
    assert all(c["verdict"] == "agrees" for c in tables["cells"] if not c["misprint"])


def test_the_paper_rule_gives_every_printed_cell(tables):
    """1e-5 relative, 1e-5 absolute for CPI 0, or the printed digits; misprints by their correction."""
    correct = {(m.table, m.row, m.column): m.correct for m in MISPRINTS}
    for c in tables["cells"]:
        text = correct.get((c["table"], c["row"], c["column"]), c["printed"])
        number, digits = float(text), len(text.partition(".")[2])
        close = abs(c["paper"] - number) <= 1e-5 * (abs(number) or 1)
        assert close or f"{c['paper']:.{digits}f}" == text, c


def test_true_integrals_and_optima_are_what_they_claim(tables):
    cells = {(c["table"], c["row"], c["column"]): c for c in tables["cells"]}
    true = cells[2, "w = (1, 0, 0)", "GRI"]["true"]
    assert abs(true - 0.8815539900) < 1e-7
    assert abs(cells[1, "w = (1, 1, 1)", "GII"]["true"] - 0.5213190204) < 1e-9
    assert abs(cells[2, "w = (1, 1, 1)", "CPI"]["optimum"] - 2.672582579) < 1e-8
    for name in ("GII", "GRI", "SUI", "CPI"):  # no grid point can beat the continuous optimum
        for table in (1, 2):
            best = cells[table, "Max", name]
            assert best["optimum"] >= best["true"] - 1e-9
            least = cells[table, "Min", name]
            assert least["optimum"] <= least["true"] + 1e-9


def test_claims_of_the_text(tables):
    verdicts = {claim["text"]: claim["holds"] for claim in tables["claims"]}
    assert verdicts.pop("the numerical error is within 3 %") is False
    assert len(verdicts) == 7 and all(verdicts.values())
    found = " ".join(claim["found"] for claim in tables["claims"])
    assert all(number in found for number in ("0.62 %", "29.16 %", "67.59 %", "33.81 %", "10.8 %"))


def test_optima_are_optimal(tables):
    assert len(tables["optima"]) == 14
    for entry in tables["optima"]:
        assert entry["status"] == "OK" and entry["kkt"] < 1e-5
        assert all(multiplier >= 0 for multiplier in entry["active"].values())


def test_csv_holds_the_same_cells(run, tables):
    rows = list(csv.DictReader((run[0] / "tables.csv").read_text().splitlines()))
    assert [(r["row"], r["column"], float(r["paper"])) for r in rows] == [
        (c["row"], c["column"], c["paper"]) for c in tables["cells"]
    ]


def test_what_is_printed(run):
    text = run[1]
    assert text.count("MISPRINT") == len(MISPRINTS)
    assert "90 of 107 cells agree" in text and "17 are misprinted, 0 differ" in text
    assert "FALSE  the numerical error is within 3 %" in text
    assert str(run[0]) in text


# --- the optima of the paper's problem, continuous and area-weighted


@cache
def optimum(name, weights):
    return pk.optimize_design(pk.design_space(name), weights)


R_OPTIMA = {  # weights: (l_min, la, objective, active), computed by three other programs
    (1, 0, 0): (1.98232198, 1.35146183, 1, ()),
    (0, 1, 0): (1.19238043, 1, 1, ("v = 0",)),
    (0, 0, 1): (1, 1, 1, ("l_min = R", "v = 0")),
    (1, 1, 0): (1.32694973, 1, 1.834588003, ("v = 0",)),
    (0, 1, 1): (1.00185049, 1, 1.954222344, ("v = 0",)),
    (1, 0, 1): (1.03898633, 1.01949317, 1.693850175, ("lb - la = R",)),
    (1, 1, 1): (1.10068246, 1, 2.672582579, ("v = 0",)),
}


@pytest.mark.parametrize("weights", R_OPTIMA)
def test_optima_of_the_2rrr(weights):
    l_min, la, objective, active = R_OPTIMA[weights]
    found = optimum("2-rrr", weights)
    assert found.status == pk.Status.OK
    assert abs(found.vector[0] - l_min) < 1e-5 and abs(found.mechanism.proximal - la) < 1e-5
    assert abs(found.objective - objective) < 1e-8
    assert found.active == active
    assert found.kkt < 1e-5 and all(value >= 0 for value in found.multipliers.values())
    assert found.history.objective[-1] == pytest.approx(found.objective, abs=1e-12)
    assert np.all(np.diff(found.history.objective) >= 0)
    assert len(found.history.objective) == found.evaluations < found.evaluations_in_all
    indices = indices_and_slopes(RRR, found.history.vector)[0]  # by the true rule, also of the first steps
    ranges = found.bounds.upper - found.bounds.lower
    worth = (indices - found.bounds.lower) / ranges @ np.array(weights)
    np.testing.assert_allclose(found.history.objective, worth, atol=1e-4)
    np.testing.assert_allclose(found.history.objective[-3:], worth[-3:], atol=1e-12)


@pytest.mark.parametrize("weights", R_OPTIMA)
def test_optima_of_the_2rpr(weights):
    """All three indices fall with l_min."""
    found = optimum("2-rpr", weights)
    assert found.vector == [1.0] and found.active == ("l_min = R",)
    assert abs(found.objective - sum(weights)) < 1e-8 and abs(found.cpi - 3) < 1e-8


def test_multiplier_of_the_2rpr():
    assert abs(optimum("2-rpr", (1, 1, 1)).multipliers["l_min = R"] - 2.60927310) < 1e-7


def test_extremes_of_the_indices():
    lower, upper = pk.index_bounds(RRR)
    np.testing.assert_allclose(lower, [0.253247347815, 0.215713843017, 0.166155997594], rtol=1e-8)
    np.testing.assert_allclose(upper, [0.690361746908, 2.571289817603, 0.451542036653], rtol=1e-8)
    lower, upper = pk.index_bounds(RPR)
    np.testing.assert_allclose(lower, [0.2272008754, 0.4295138550, 0.2376223059], rtol=1e-9)
    np.testing.assert_allclose(upper, [0.5213190204, 0.7829910881, 0.4515420367], rtol=1e-9)


@pytest.mark.soak
def test_another_optimizer_finds_nothing_better():
    bounds = pk.index_bounds(RRR)
    value = jax.jit(
        jax.value_and_grad(
            lambda box: (
                -pk.composite_index(
                    pk.workspace_indices(RRR.mechanism(RRR.from_box(box)), nodes=(10, 10)), bounds, (1, 1, 1)
                )
            )
        )
    )
    for start in ((0.5, 0.5), (0.1, 0.8)):
        answer = minimize(value, start, jac=True, bounds=[(0, 1)] * 2, method="L-BFGS-B")
        assert -answer.fun < optimum("2-rrr", (1, 1, 1)).objective + 1e-6


def test_a_given_start_and_the_step_limit():
    found = pk.optimize_design(RRR, starts=[2.0, 0.3])
    assert abs(found.objective - 2.672582579) < 1e-8
    assert found.evaluations == found.evaluations_in_all <= 16
    stopped = pk.optimize_design(RRR, starts=[2.0, 0.3], steps=3)
    assert stopped.status == pk.Status.STEP_LIMIT and stopped.evaluations == 3
    assert stopped.kkt > 1e-3


def test_the_same_call_gives_the_same_bits():
    first, second = (maximize(RRR, jnp.ones((1, 3)), starts=4)[0] for _ in range(2))
    np.testing.assert_array_equal(first.vector, second.vector)


def test_progress_is_reported():
    lines = []
    pk.optimize_design(RPR, report=lambda *line: lines.append(line))
    assert [what for what, *_ in lines] == ["2-rpr"] * len(lines) and len(lines) > 0
    assert all(0 < done <= 100 == total and np.isfinite(best) for _, done, total, best in lines)


# --- the README's code does what its comments say


def test_the_ten_lines(capsys):
    code = re.search(r"```python\n(.*?)```", README, re.S)[1]
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 12
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    promised = re.findall(r"print\(.*\)\s+# ([\['].*)$", code, re.M)
    assert len(promised) == 2
    assert printed[0] == promised[0]
    assert [float(x) for x in printed[1].strip("[]").split()] == [0.3, 2.2]
    assert any(line.startswith("FiveBar(half_base=1.0, proximal=1.0, distal=2.1006") for line in printed)
    assert "('v = 0',)" in printed[-1]
