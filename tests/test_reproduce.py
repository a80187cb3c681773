"""Nam, Lee and Park 2006 from the command line: every cell, every verdict, every file."""

import csv
import json

import pytest

from pk_jax.cli import main
from pk_jax.papers.nam2006_printed import MISPRINTS, TABLES

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
