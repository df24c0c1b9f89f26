"""The tables of the page, from rows to cells, and the same tables as CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from eval.core.statistics import ENOUGH_PAIRS, bootstrap_interval
from eval.running.run_data import (
    GridOf,
    Row,
    RunData,
    defined,
    flag,
    grids,
    named_variants,
    number,
    of,
    over_pairs,
    scenarios,
    text,
)
from eval.tables.columns import (
    EN_DASH,
    RESULT_COLUMNS,
    THIN_SPACE,
    UNCHANGED_COLUMNS,
    UNDEFINED,
    Column,
    share,
    spaced,
)
from eval.tables.merge_table import numbers
from eval.tables.region_curves import PAIR

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", EN_DASH: "--", THIN_SPACE: r"\,", "³": r"$^3$",
    "↓": r"$\downarrow$", "→": r"$\rightarrow$",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell: its text, whether it is the best of its group, its interval and background colour ("" for none)."""

    text: str
    is_best: bool = False
    interval: str = ""
    colour: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table; rows with the same group stand together under its name.

    Attributes:
        headings: One per column.
        rows: (group, cells) of each row.
        caption: What stands above it.
        n_text: How many columns at the left hold text.
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    caption: str = ""
    n_text: int = 1

    def groups(self) -> list[tuple[str, list[tuple[Cell, ...]]]]:
        """Return the rows by group, in order."""
        found: dict[str, list[tuple[Cell, ...]]] = {}
        for group, cells in self.rows:
            found.setdefault(group, []).append(cells)
        return list(found.items())


def results_table(data: RunData) -> Table:
    """Return every preset on every scenario with changes: means over its pairs, the best of each scenario marked."""
    headings = ("preset", *(column.heading for column in RESULT_COLUMNS), "status")
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for scenario in scenarios(data, unchanged=False):
        variants = named_variants(data, scenario)
        groups = [of(data.results, scenario=scenario, variant=name) for name in variants]
        columns = [_column_cells(groups, column) for column in RESULT_COLUMNS]
        rows += [
            (scenario, (Cell(spaced(name)), *(column[index] for column in columns), Cell(status_text(groups[index]))))
            for index, name in enumerate(variants)
        ]
    return Table(headings, tuple(rows), "Every preset on every scenario")


def unchanged_table(data: RunData) -> Table:
    """Return every preset on the pairs in which nothing changed, and whether it raises an alarm."""
    headings = ("preset", "alarm", *(column.heading for column in UNCHANGED_COLUMNS), "status")
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for scenario in scenarios(data, unchanged=True):
        for name in named_variants(data, scenario):
            group = of(data.results, scenario=scenario, variant=name)
            values = (Cell(column.shown(over_pairs(group, column.key))) for column in UNCHANGED_COLUMNS)
            rows.append((scenario, (Cell(spaced(name)), Cell(alarm_text(group)), *values, Cell(status_text(group)))))
    return Table(headings, tuple(rows), "Pairs in which nothing changed")


def alarm_text(group: Sequence[Row]) -> str:
    """Return "alarm", "silent" or "refused" of one pair, or how many of several."""
    counts: dict[str, int] = {}
    for row in group:
        refused = text(row, "status") != "ok"
        word = "refused" if refused else "alarm" if flag(row, "is_alarm") else "silent"
        counts[word] = counts.get(word, 0) + 1
    return _counted(counts)


def status_text(group: Sequence[Row]) -> str:
    """Return the status of one pair, or how many pairs have which."""
    counts: dict[str, int] = {}
    for row in group:
        word = text(row, "status").replace("_", " ")
        counts[word] = counts.get(word, 0) + 1
    return _counted(counts)


def best(values: Sequence[float], column: Column, n_used: Sequence[int] | None = None) -> list[bool]:
    """Mark the best values of a column as written; none where all are equal or fewer than two are defined.

    Args:
        values: One for each row.
        column: Which direction wins, and how values are written.
        n_used: Over how many pairs each is. One over fewer than six takes no part where another is over more: a method
            that hardly ever answers is not the best of those that do.
    """
    counts = n_used or [0] * len(values)
    enough = min(ENOUGH_PAIRS, max(counts, default=0))
    written = [
        UNDEFINED if math.isnan(value) or n < enough else column.shown(value).replace(THIN_SPACE, "")
        for value, n in zip(values, counts, strict=True)
    ]
    known = [float(word) for word in written if word != UNDEFINED]
    if column.better is None or len(set(known)) < 2:
        return [False] * len(values)
    winner = max(known) if column.better == "high" else min(known)
    return [word != UNDEFINED and float(word) == winner for word in written]


def used_pairs(cases: pd.DataFrame, variant: str, key: str) -> tuple[int, int]:
    """Return over how many pairs a method has a number in a column of results.csv, and of how many that could have.

    Those that no method has (a pair without changes has no precision) could not. A figure that is no column of
    results.csv is over all.
    """
    own = cases[cases["variant"] == variant]
    if key not in cases:
        return len(own), len(own)
    pairs = pd.MultiIndex.from_frame(own[PAIR])
    could = pd.MultiIndex.from_frame(cases.loc[~np.isnan(numbers(cases, key)), PAIR])
    return int((~np.isnan(numbers(own, key))).sum()), int(pairs.isin(could).sum())


def beside(interval: str, n_used: int, n: int) -> str:
    """Return what stands under a mean: its interval, and over how many pairs it is where that is not all of them."""
    return "\n".join(filter(None, (interval, f"{n_used} of {n} pairs" if 0 < n_used < n else "")))


def interval_text(group: Sequence[Row], column: Column) -> str:
    """Return the 95 % bootstrap interval over session pairs, "" for fewer than two defined values."""
    values = np.array([number(row, column.key) for row in group], dtype=np.float64)
    low, high = bootstrap_interval(values, "median" if column.key.startswith("t_") else "mean")
    return "" if math.isnan(low) else f"{column.shown(low)}{EN_DASH}{column.shown(high)}"


def _column_cells(groups: Sequence[Sequence[Row]], column: Column) -> list[Cell]:
    values = [over_pairs(group, column.key) for group in groups]
    counts = [len(defined(group, column.key)) for group in groups]
    return [
        Cell(column.shown(value), is_best, beside(interval_text(group, column), n, len(group)))
        for group, value, n, is_best in zip(groups, values, counts, best(values, column, counts), strict=True)
    ]


def _counted(counts: dict[str, int]) -> str:
    if sum(counts.values()) == 1:
        return next(iter(counts))
    return ", ".join(f"{n} {word}" for word, n in counts.items())


def grid_tables(data: RunData) -> list[Table]:
    """Return a table of object IoU and one of region recall for every grid of two settings."""
    return [
        _grid_table(data, grid, column)
        for grid in grids(data)
        for column in RESULT_COLUMNS
        if column.key in ("object_iou_point", "region_recall")
    ]


def _grid_table(data: RunData, grid: GridOf, column: Column) -> Table:
    values = {
        point: over_pairs(of(data.results, scenario=grid.scenario, variant=name), column.key)
        for point, name in grid.points.items()
    }
    marks = dict(zip(values, best(list(values.values()), column), strict=True))
    rows = []
    for a in grid.values[0]:
        cells = [Cell(a)]
        for b in grid.values[1]:
            value = values.get((a, b), math.nan)
            cells.append(Cell(share(value), marks.get((a, b), False), colour=heat_colour(value)))
        rows.append(("", tuple(cells)))
    caption = f"{column.heading} of {grid.preset} on {grid.scenario}"
    return Table((f"{grid.keys[0]} ↓  {grid.keys[1]} →", *grid.values[1]), tuple(rows), caption)


def heat_colour(value: float) -> str:
    """Return the background of a share: white at 0, blue at 1, "" where undefined."""
    if math.isnan(value):
        return ""
    weight = min(max(value, 0.0), 1.0)
    red, green, blue = (round(255 + weight * (end - 255)) for end in (107, 174, 214))
    return f"#{red:02x}{green:02x}{blue:02x}"


def to_csv(table: Table) -> str:
    """Return a table as CSV, the group as its first column; "–" is left empty, numbers hold no thin spaces."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("scenario", *table.headings))
    for group, cells in table.rows:
        texts = (cell.text.replace(THIN_SPACE, "") for cell in cells)
        writer.writerow((group, *("" if word == UNDEFINED else word for word in texts)))
    return stream.getvalue()


def to_latex(table: Table) -> str:
    """Return a table as a LaTeX tabular in the style of booktabs, best values in bold."""
    width = len(table.headings)
    lines = [
        "% needs \\usepackage{booktabs}",
        f"\\begin{{tabular}}{{{'l' * table.n_text}{'r' * (width - table.n_text)}}}",
        "\\toprule",
        " & ".join(escape_latex(heading) for heading in table.headings) + r" \\",
    ]
    for group, rows in table.groups():
        lines += ["\\midrule", f"\\multicolumn{{{width}}}{{l}}{{\\textit{{{escape_latex(group)}}}}} \\\\"]
        lines += [" & ".join(_latex_cell(cell) for cell in cells) + r" \\" for cells in rows]
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def escape_latex(words: str) -> str:
    """Return text with the characters that LaTeX treats as commands escaped."""
    return "".join(_LATEX.get(letter, letter) for letter in words)


def _latex_cell(cell: Cell) -> str:
    return f"\\textbf{{{escape_latex(cell.text)}}}" if cell.is_best else escape_latex(cell.text)
