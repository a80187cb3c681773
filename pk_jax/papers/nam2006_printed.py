"""The numbers printed in Nam, Lee and Park 2006, Tables 1 and 2, and what is misprinted in them.

Y.-J. Nam, Y.-H. Lee and M.-K. Park, "Comparison Study of 2-DOF Parallel Mechanisms: Workspace
Optimization and Kinematic Performance", Trans. KSME A 30(11), 2006. Lengths over R; numbers are
kept as the strings that were printed, because their digits are what is checked.
"""

from __future__ import annotations

from typing import NamedTuple

INDICES = ("GII", "GRI", "SUI", "CPI")
WEIGHTS = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1), (1, 1, 1))


class Misprint(NamedTuple):
    """A printed cell that cannot be right, what it must be, and why."""

    name: str  # cells of one name are one misprint
    table: int
    row: str
    column: str
    correct: str
    why: str


class PrintedTable(NamedTuple):
    number: int
    space: str  # design space
    lengths: tuple[str, ...]  # columns before the indices
    rows: dict[str, tuple[str, ...]]  # extremes first (indices only), then one row for each weighting


def row_name(weights: tuple[int, int, int]) -> str:
    return "w = ({}, {}, {})".format(*weights)


def _rows(maxima: str, minima: str, *rows: str) -> dict[str, tuple[str, ...]]:
    named = {"Max": maxima, "Min": minima} | dict(zip(map(row_name, WEIGHTS), rows, strict=True))
    return {name: tuple(cells.split()) for name, cells in named.items()}


TABLE_1 = PrintedTable(
    1,
    "2-rpr",
    ("l_min", "l_max"),
    _rows(
        "0.55592 0.80577 0.45157 2.99388",
        "0.22991 0.437 0.23765 0.0",
        "1.01 3.01 0.55592 0.80577 0.44876 2.98687",
        "1.01 3.01 0.55592 0.80577 0.44876 2.98687",
        "1.0 3.0 0.55527 0.80423 0.45157 2.99388",
        "1.01 3.01 0.55592 0.80577 0.44876 2.98687",
        "1.0 3.0 0.55527 0.80423 0.45157 2.99388",
        "1.0 3.0 0.55527 0.80423 0.45157 2.99388",
        "1.0 3.0 0.55527 0.80423 0.45157 2.99388",
    ),
)

TABLE_2 = PrintedTable(
    2,
    "2-rrr",
    ("l_min", "la", "lb"),
    _rows(
        "0.7078 2.42518 0.45216 2.58808",
        "0.25832 0.19528 0.1607 0.33213",
        "2.08 1.39 2.69 0.7078 0.78609 0.29929 1.72942",
        "1.12 1.0 2.12 0.5669 2.42518 0.42356 2.58634",
        "1.0 1.0 1.0 0.50139 2.38451 0.45216 2.52255",
        "1.36 1.0 2.36 0.62059 2.36238 0.38094 2.52834",
        "1.3 1.06 2.24 0.63349 1.63565 0.39044 2.26439",
        "1 1.0 1.0 0.50139 2.38451 0.45216 2.52255",
        "1.15 1.0 2.15 0.57756 2.424 0.41744 2.58808",
    ),
)

TABLES = (TABLE_1, TABLE_2)

_LINKS = "la + lb = l_max = l_min + 2 R = 3 R"
_SWAP = "rows (0, 1, 1) and (1, 0, 1) are interchanged"


def _interchanged() -> tuple[Misprint, ...]:
    """Each of the two rows must hold what is printed in the other, its lb corrected too."""
    first, second = row_name((0, 1, 1)), row_name((1, 0, 1))
    found = []
    for here, there in ((first, second), (second, first)):
        for column, cell, other in zip(
            (*TABLE_2.lengths, *INDICES), TABLE_2.rows[here], TABLE_2.rows[there], strict=True
        ):
            if (there, column) == (second, "lb"):
                found.append(
                    Misprint("Table 2, interchanged rows", 2, here, column, "2.0", f"{_SWAP}; {_LINKS}")
                )
            elif float(cell) != float(other):
                found.append(Misprint("Table 2, interchanged rows", 2, here, column, other, _SWAP))
    return tuple(found)


MISPRINTS = (
    Misprint(
        "Table 1, least GRI",
        1,
        "Min",
        "GRI",
        "0.434",
        "omega = 2 k / (1 + k^2) with k = 1/kappa at every pose of the 2-RPR, so GRI <= 2 GII / (1 + GII^2)",
    ),
    Misprint("Table 2, least SUI", 2, "Min", "SUI", "0.1667", "a digit: SUI depends on l_min alone"),
    Misprint("Table 2, lb at l_min = 1", 2, row_name((0, 0, 1)), "lb", "2.0", _LINKS),
    *_interchanged(),
)
