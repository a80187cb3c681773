"""Tables 1 and 2 of Nam, Lee and Park 2006 computed again, judged cell by cell, and beaten.

Four numbers a cell: as printed; by the paper's own discretization ("paper" rule and design grid);
the true integral at the design that the paper's procedure chose; and our gradient optimum.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.analysis.workspace import workspace_indices
from pk_jax.design.objective import IndexBounds, composite_index, index_vector
from pk_jax.design.optimize import (
    DesignResult,
    index_bounds,
    indices_and_slopes,
    maximize,
    optimize_design,
)
from pk_jax.design.variables import DesignSpace, design_space
from pk_jax.papers.nam2006_printed import INDICES, MISPRINTS, TABLES, WEIGHTS, PrintedTable, row_name

AGREES_WITHIN = 1e-5  # relative, and absolute where 0 is printed

Report = Callable[[str, int, int, float | None], None]


class Cell(NamedTuple):
    """One cell of a table, four times, and what is to be said of the printed one."""

    table: int
    row: str
    column: str
    printed: str
    paper: float  # the paper's rule, grid and choice of design
    true: float  # the true integral at that design
    optimum: float  # the same cell of our continuous, area-weighted optimization
    verdict: str  # "agrees", "misprint: ..." or "differs"
    misprint: str  # name of the misprint, or ""


class Claim(NamedTuple):
    """A statement of the text, what was computed for it, and whether it holds."""

    text: str
    found: str
    holds: bool


class Grid(NamedTuple):
    """The paper's design grid, with the indices by the paper's rule."""

    vectors: np.ndarray  # (designs, n) as in the design space
    lengths: np.ndarray  # (designs, columns) as in the table
    indices: np.ndarray  # (designs, 3)
    cpi: np.ndarray  # (designs,) weights (1, 1, 1), normalized as the paper does


class Reproduction(NamedTuple):
    cells: list[Cell]
    claims: list[Claim]
    grids: dict[str, Grid]  # by design space
    optima: dict[str, dict[tuple[int, int, int], DesignResult]]


def reproduce(report: Report | None = None) -> Reproduction:
    """Compute everything of the paper that is a number. float64 must be enabled."""
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError("reproduce needs float64: call pk_jax.enable_x64() first")
    checks.is_function("report", report)
    cells, grids, optima = [], {}, {}
    for table in TABLES:
        space = design_space(table.space)
        if report is not None:
            report(f"{table.space}: the paper's design grid", 1, 1, None)
        grids[space.name] = _grid(table, space)
        bounds = index_bounds(space, report=report)
        optima[space.name] = {w: optimize_design(space, w, bounds=bounds, report=report) for w in WEIGHTS}
        cells += _cells(table, space, grids[space.name], optima[space.name])
    return Reproduction(cells, _claims(cells, optima), grids, optima)


# --- the paper's procedure


def _grid(table: PrintedTable, space: DesignSpace) -> Grid:
    """The design grids of the paper: steps of 0.01 R in l_min; 0.03 R in (l_min, la) inside eq. (22)."""
    if space.name == "2-rpr":
        l_min = np.arange(100, 301) / 100
        vectors = l_min[:, None]
        lengths = np.stack([l_min, l_min + 2], axis=1)
    else:
        l_min, la = np.meshgrid(1 + 0.03 * np.arange(134), 1 + 0.03 * np.arange(68), indexing="ij")
        inside = la <= (l_min + 1) / 2 + 1e-9
        l_min, la = l_min[inside], la[inside]
        la = np.minimum(la, (l_min + 1) / 2)
        vectors = np.stack([l_min, np.sqrt(la - 1)], axis=1)
        lengths = np.stack([l_min, la, l_min + 2 - la], axis=1)
    index = lambda z: index_vector(workspace_indices(space.mechanism(z), "paper"))
    some = lambda rows: jax.lax.map(index, rows, batch_size=64)  # few enough for the cache
    indices = np.asarray(jax.jit(some)(jnp.asarray(vectors)))
    return Grid(vectors, lengths, indices, np.asarray(composite_index(indices, _printed_bounds(table))))


def _corrected(table: PrintedTable, row: str, column: str) -> str | None:
    """What a misprinted cell must be; None where the cell is no misprint."""
    for misprint in MISPRINTS:
        if (misprint.table, misprint.row, misprint.column) == (table.number, row, column):
            return misprint.correct
    return None


def _printed_bounds(table: PrintedTable) -> IndexBounds:
    """The printed extremes, which the paper normalized with: rounded as printed, misprints corrected."""
    extreme = lambda row: np.array(
        [
            float(_corrected(table, row, column) or cell)
            for column, cell in zip(INDICES[:3], table.rows[row], strict=False)
        ]
    )
    return IndexBounds(extreme("Min"), extreme("Max"))


# --- the cells


def _cells(table: PrintedTable, space: DesignSpace, grid: Grid, optima) -> list[Cell]:
    bounds = optima[WEIGHTS[0]].bounds
    true_on_grid = lambda picks: indices_and_slopes(space, grid.vectors[picks])[0]

    cells = []
    # extremes: of the grid by the paper's rule; over the whole space by the true integrals
    extremes = np.concatenate([grid.indices, grid.cpi[:, None]], axis=1)
    slopes = 1 / (np.asarray(bounds.upper) - np.asarray(bounds.lower))
    least_cpi = maximize(space, -slopes[None])[0].vector
    for row, pick in (("Max", extremes.argmax(axis=0)), ("Min", extremes.argmin(axis=0))):
        paper = extremes[pick, np.arange(4)]
        values = true_on_grid(pick)
        true = [*np.diagonal(values[:3]), float(composite_index(values[3], bounds))]
        if row == "Max":
            best = [*np.asarray(bounds.upper), optima[(1, 1, 1)].cpi]
        else:
            least = indices_and_slopes(space, least_cpi[None])[0][0]
            best = [*np.asarray(bounds.lower), float(composite_index(least, bounds))]
        cells += _row(table, row, INDICES, paper, true, best)

    printed = _printed_bounds(table)
    for weights in WEIGHTS:
        pick = int(np.argmax(composite_index(grid.indices, printed, weights)))
        values = true_on_grid([pick])[0]
        optimum = optima[weights]
        cells += _row(
            table,
            row_name(weights),
            (*table.lengths, *INDICES),
            [*grid.lengths[pick], *grid.indices[pick], grid.cpi[pick]],
            [*grid.lengths[pick], *values, float(composite_index(values, bounds))],
            [*_lengths(optimum), *np.asarray(index_vector(optimum.indices)), optimum.cpi],
        )
    return cells


def _lengths(result: DesignResult) -> list[float]:
    mech = result.mechanism
    if hasattr(mech, "l_max"):
        return [float(mech.l_min), float(mech.l_max)]
    return [float(mech.reach[0]), float(mech.proximal), float(mech.distal)]


def _row(table: PrintedTable, row: str, columns, paper, true, optimum) -> list[Cell]:
    cells = []
    for column, text, *values in zip(columns, table.rows[row], paper, true, optimum, strict=True):
        verdict, name = _judge(table, row, column, text, values[0])
        cells.append(Cell(table.number, row, column, text, *map(float, values), verdict, name))
    return cells


def _judge(table: PrintedTable, row: str, column: str, printed: str, paper: float) -> tuple[str, str]:
    """Verdict on a printed cell, and the name of its misprint."""
    if _is_same(printed, paper):
        return "agrees", ""
    for m in MISPRINTS:
        if (m.table, m.row, m.column) == (table.number, row, column) and _is_same(m.correct, paper):
            return f"misprint: {printed} for {m.correct}; {m.why}", m.name
    return "differs", ""


def _is_same(printed: str, value: float) -> bool:
    """Within 1e-5 relative (absolute at 0), or equal when rounded to the printed digits."""
    number = float(printed)
    if abs(value - number) <= AGREES_WITHIN * (abs(number) or 1):
        return True
    places = -Decimal(printed).as_tuple().exponent
    return round(value, places) == number and places > 1


# --- the claims of the text


def _claims(cells: list[Cell], optima) -> list[Claim]:
    value = {(c.table, c.row, c.column): c for c in cells}
    rows = [row_name(w) for w in WEIGHTS]

    def swing(table: int, index: str) -> float:
        """Greatest change of an index with the weights, in percent of its greatest value."""
        column = [value[table, row, index].paper for row in rows]
        return 100 * (max(column) - min(column)) / max(column)

    claims = []
    swings = {index: swing(1, index) for index in INDICES[:3]}
    claims.append(
        Claim(
            "2-RPR: the weights change no index by more than 0.62 %",
            ", ".join(f"{k} {v:.2f} %" for k, v in swings.items()),
            round(max(swings.values()), 2) == 0.62,
        )
    )
    for index, stated in (("GII", 29.16), ("GRI", 67.59), ("SUI", 33.81)):
        found = swing(2, index)
        claims.append(
            Claim(
                f"2-RRR: the weights change {index} by up to {stated} %",
                f"{found:.2f} %",
                round(found, 2) == stated,
            )
        )
    rows_only = [c for c in cells if c.row in rows and c.column in ("GII", "GRI", "SUI")]
    worst = max(rows_only, key=lambda c: abs(c.paper / c.true - 1))
    error = abs(worst.paper / worst.true - 1)
    claims.append(
        Claim(
            "the numerical error is within 3 %",
            f"up to {100 * error:.1f} % (Table {worst.table}, {worst.row}, {worst.column})",
            error <= 0.03,
        )
    )
    for table in (1, 2):
        best = max(rows, key=lambda row: (value[table, row, "CPI"].paper, row == rows[-1]))
        claims.append(
            Claim(
                f"Table {table}: the CPI is greatest when all indices are considered",
                f"greatest at {best}; by construction: the CPI column is the objective of w = (1, 1, 1)",
                best == rows[-1],
            )
        )
    near = [value[2, row_name(w), "CPI"].paper for w in ((0, 1, 0), (1, 1, 1))]
    claims.append(
        Claim(
            "2-RRR: GRI alone gives almost the CPI of all indices",
            f"{near[0]:.5f} of {near[1]:.5f}; true optima {optima['2-rrr'][0, 1, 0].cpi:.5f} of "
            f"{optima['2-rrr'][1, 1, 1].cpi:.5f}",
            near[0] / near[1] > 0.99,
        )
    )
    return claims
