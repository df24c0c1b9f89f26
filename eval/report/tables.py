"""The tables of the page, from rows to cells."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from eval.core.domains import domain_name
from eval.core.statistics import ENOUGH_PAIRS
from eval.core.tablefile import csv_text
from eval.report.drawing.charts import Chart
from eval.running.results.cases import BEST_POINTS, named_variants, scenarios, shows_best_points
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, defined, interval_over_pairs, over_pairs, select_rows, text
from eval.tables.alarms import count_alarms
from eval.tables.columns import (
    EN_DASH,
    RESULT_COLUMNS,
    THIN_SPACE,
    UNCHANGED_COLUMNS,
    UNDEFINED,
    Column,
    significant,
    spaced,
)
from eval.tables.conditions import condition_of_row, told_apart
from eval.tables.rows import ALL_DOMAINS, PAIR, is_told_the_truth, numbers, records


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
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    caption: str = ""

    def groups(self) -> list[tuple[str, list[tuple[Cell, ...]]]]:
        """Return the rows by group, in order."""
        found: dict[str, list[tuple[Cell, ...]]] = {}
        for group, cells in self.rows:
            found.setdefault(group, []).append(cells)
        return list(found.items())


def with_rows(tables: Iterable[Table]) -> tuple[Table, ...]:
    """Return the tables that are not empty."""
    return tuple(table for table in tables if table.rows)


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture with its title and caption; `address` holds it."""

    title: str
    address: str
    caption: str


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """What the page shows of one subject.

    Attributes:
        tables: Over all pairs.
        plots: Over all pairs.
        cases: Tables of single cases.
        pictures: Of single cases.
        notes: What was left out for space.
        missing: What could not be shown.
    """

    tables: tuple[Table, ...] = ()
    plots: tuple[Picture | Chart, ...] = ()
    cases: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


def results_table(data: RunData) -> Table:
    """Return every preset on every scenario with changes: means over its pairs.

    The best of each scenario that is not told the truth is marked.
    """
    headings = ("preset", *(column.heading for column in RESULT_COLUMNS), "status")
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for scenario in scenarios(data, unchanged=False):
        variants = named_variants(data, scenario)
        groups = [select_rows(data.results, scenario=scenario, variant=name) for name in variants]
        columns = [_column_cells(variants, groups, column) for column in RESULT_COLUMNS]
        rows += [
            (scenario, (Cell(spaced(name)), *(column[index] for column in columns), Cell(status_text(groups[index]))))
            for index, name in enumerate(variants)
        ]
    return Table(headings, tuple(rows), _captioned("Every preset on every scenario", data))


def unchanged_table(data: RunData) -> Table:
    """Return every preset on the pairs in which nothing changed, and whether it raises an alarm."""
    headings = ("preset", "alarm", *(column.heading for column in UNCHANGED_COLUMNS), "status")
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for scenario in scenarios(data, unchanged=True):
        for name in named_variants(data, scenario):
            group = select_rows(data.results, scenario=scenario, variant=name)
            values = (Cell(column.shown(over_pairs(group, column.key))) for column in UNCHANGED_COLUMNS)
            rows.append((scenario, (Cell(spaced(name)), Cell(alarm_text(group)), *values, Cell(status_text(group)))))
    return Table(headings, tuple(rows), _captioned("Pairs in which nothing changed", data))


def _captioned(words: str, data: RunData) -> str:
    return f"{words}; {BEST_POINTS}" if shows_best_points(data) else words


def alarm_text(group: Sequence[Row]) -> str:
    """Return "alarm", "silent" or "refused" of one pair, or how many of several."""
    rows = pd.DataFrame(list(group))
    alarms = count_alarms(rows) if "is_alarm" in rows else np.zeros(len(rows))
    return _counted(
        "refused" if text(row, "status") != "ok" else "alarm" if alarm == 1 else "silent"
        for row, alarm in zip(group, alarms, strict=True)
    )


def status_text(group: Sequence[Row]) -> str:
    """Return the status of one pair, or how many pairs have which."""
    return _counted(text(row, "status").replace("_", " ") for row in group)


def best(values: Sequence[float], column: Column, n_used: Sequence[int] | None = None) -> list[bool]:
    """Mark the best values of a column as written; none where all are equal or fewer than two are defined.

    Args:
        values: One for each row.
        column: Which direction wins, and how values are written.
        n_used: Over how many pairs each is. One over fewer than six takes no part where another is over more: a method
            that hardly ever answers is not the best of those that do. Nobody is best where the best value is over
            fewer pairs than another: a method would only have to leave out the hard ones.
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
    is_winner = [word != UNDEFINED and float(word) == winner for word in written]
    return [is_best and n == max(counts) for is_best, n in zip(is_winner, counts, strict=True)]


def used_pairs(cases: pd.DataFrame, variants: Sequence[str], key: str) -> list[tuple[int, int]]:
    """Return over how many pairs each method has a number in a column of results.csv, and of how many that could have.

    Those that no method has (a pair without changes has no precision) could not. A figure that is no column of
    results.csv is over all.
    """
    has_number = np.ones(len(cases), dtype=np.bool_)
    if key in cases:
        has_number = ~np.isnan(numbers(cases, key))
    pair = cases.groupby(PAIR, sort=False).ngroup().to_numpy()
    could = np.isin(pair, pair[has_number])
    variant = cases["variant"].to_numpy()
    return [
        (int(np.count_nonzero(has_number & is_own)), int(np.count_nonzero(could & is_own)))
        for is_own in (variant == name for name in variants)
    ]


def beside(interval: str, n_used: int, n: int) -> str:
    """Return what stands under a mean: its interval, and over how many pairs it is where that is not all of them."""
    return "\n".join(filter(None, (interval, f"{n_used} of {n} pairs" if 0 < n_used < n else "")))


def _column_cells(variants: Sequence[str], groups: Sequence[Sequence[Row]], column: Column) -> list[Cell]:
    values = [over_pairs(group, column.key) for group in groups]
    counts = [len(defined(group, column.key)) for group in groups]
    marks = best_fair(variants, values, column, counts)
    cells = []
    for group, value, n, is_best in zip(groups, values, counts, marks, strict=True):
        interval = written_interval(*interval_over_pairs(group, column.key), column.shown)
        cells.append(Cell(column.shown(value), is_best, beside(interval, n, len(group))))
    return cells


def _counted(words: Iterable[str]) -> str:
    counts = Counter(words)
    if counts.total() == 1:
        return next(iter(counts))
    return ", ".join(f"{n} {word}" for word, n in counts.items())


def to_csv(table: Table) -> str:
    """Return a table as CSV, the group as its first column; "–" is left empty, numbers hold no thin spaces."""
    rows = [(group, *(cell.text for cell in cells)) for group, cells in table.rows]
    frame = pd.DataFrame(rows, columns=["scenario", *table.headings])
    return csv_text(frame.map(lambda word: "" if word == UNDEFINED else word.replace(THIN_SPACE, "")))


def methods_table(
    table: pd.DataFrame,
    columns: Sequence[Column],
    cases: pd.DataFrame,
    caption: str = "",
    *,
    counts: Mapping[str, str] | None = None,
) -> Table:
    """Return a row for each method in each domain; the best that is not told the truth is marked.

    Args:
        table: Rows with `domain`, `variant`, `n_pairs`, and for each column its value and perhaps `_low`, `_high`.
        columns: The columns; newer ones that the table lacks are left out.
        cases: Rows of results.csv with their `domain`, which tell over how many pairs a mean is.
        caption: What stands above the table.
        counts: Columns that are over items of all pairs together, and the column that counts these items.
    """
    columns = _held(columns, table)
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for domain, own in table.groupby("domain", sort=False):
        of_domain = cases if domain == ALL_DOMAINS else cases[cases["domain"] == domain]
        group = records(own)
        of_columns = [_cells(group, column, of_domain, (counts or {}).get(column.key)) for column in columns]
        for index, row in enumerate(group):
            failed = f"{row['n_failed']} failed" if row.get("n_failed") else ""
            cells = (Cell(spaced(str(row["variant"]))), Cell(str(row["n_pairs"]), interval=failed))
            rows.append((group_name(str(domain), group), (*cells, *(column[index] for column in of_columns))))
    return Table(("method", "pairs", *(column.heading for column in columns)), tuple(rows), caption)


def conditions_table(table: pd.DataFrame, columns: Sequence[Column], caption: str) -> Table:
    """Return the rows of every method under each odometry and sensor, side by side; no row where a plan has but one.

    Args:
        table: As `methods_table` takes it, with the columns of `eval.tables.conditions`.
        columns: The columns; newer ones that the table lacks are left out.
        caption: What stands above the table.
    """
    columns = _held(columns, table)
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    own = table[table["domain"] != ALL_DOMAINS] if told_apart(table) else table[:0]
    for (domain, variant), group in own.groupby(["domain", "variant"], sort=False):
        for row in records(group):
            values = (
                Cell(column.shown(float(row[column.key])), interval=interval_of_row(row, column.key, column.shown))
                for column in columns
            )
            cells = (Cell(condition_of_row(row).words), Cell(str(row["n_pairs"])), *values)
            rows.append((f"{spaced(str(variant))}, {domain_name(str(domain))}", cells))
    return Table(("odometry, sensor", "pairs", *(column.heading for column in columns)), tuple(rows), caption)


def _held(columns: Sequence[Column], table: pd.DataFrame) -> list[Column]:
    return [column for column in columns if column.key in table or not column.is_newer]


def group_name(domain: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a domain, and over how many pairs and observable changes the rows of its methods are."""
    n_pairs = max(int(row["n_pairs"]) for row in rows)
    n_changes = max(int(row.get("n_observable", row.get("n_changes", 0))) for row in rows)
    found = f", {n_changes} observable changes" if n_changes else ""
    return f"{domain_name(domain)}: {n_pairs} {'pair' if n_pairs == 1 else 'pairs'}{found}"


def best_rows(rows: Sequence[Mapping[str, Any]], column: Column, n_used: Sequence[int]) -> list[bool]:
    """Mark the best of the rows that are not told the truth; over how many pairs each is says `n_used`."""
    variants, values = [str(row["variant"]) for row in rows], [float(row[column.key]) for row in rows]
    return best_fair(variants, values, column, n_used)


def best_fair(variants: Sequence[str], values: Sequence[float], column: Column, n_used: Sequence[int]) -> list[bool]:
    """Mark the best values as `best` does, of the variants that are not told the truth."""
    fair = [place for place, name in enumerate(variants) if not is_told_the_truth(name)]
    marks = best([values[place] for place in fair], column, [n_used[place] for place in fair])
    winners = {place for place, is_best in zip(fair, marks, strict=True) if is_best}
    return [place in winners for place in range(len(variants))]


def interval_of_row(row: Mapping[str, Any], key: str, shown: Callable[[float], str]) -> str:
    """Return the interval of a column of a row, "" where it has none."""
    low, high = (float(row.get(f"{key}_{end}", math.nan)) for end in ("low", "high"))
    return written_interval(low, high, shown)


def written_interval(low: float, high: float, shown: Callable[[float], str]) -> str:
    """Return an interval as text, "" for NaN."""
    return "" if math.isnan(low) else f"{shown(low)}{EN_DASH}{shown(high)}"


def targets_table(targets: pd.DataFrame) -> Table:
    """Return what the plan asks for and whether it is met; what is missed is bold."""
    rows = []
    for row in records(targets):
        word = UNDEFINED if pd.isna(row["is_met"]) else "met" if bool(row["is_met"]) else "missed"
        interval = "" if math.isnan(row["low"]) else f"{significant(row['low'])} to {significant(row['high'])}"
        cells = (
            Cell(f"{row['target']} ({row['variant']})"), Cell(domain_name(str(row["domain"]))), Cell(str(row["asked"])),
            Cell(significant(row["value"]), interval=interval), Cell(str(row["n"])), Cell(word, word == "missed"),
        )  # fmt: skip
        rows.append(("", cells))
    caption = "Targets of the plan: one row is one target of one method"
    return Table(("target", "where", "asked", "found", "pairs", ""), tuple(rows), caption)


def _cells(
    rows: Sequence[Mapping[str, Any]], column: Column, cases: pd.DataFrame, count_column: str | None
) -> list[Cell]:
    if count_column is not None:
        used = [(int(row[count_column]), int(row[count_column])) for row in rows]
    else:
        used = used_pairs(cases, [str(row["variant"]) for row in rows], column.key)
    cells = []
    for row, n, is_best in zip(rows, used, best_rows(rows, column, [n for n, _ in used]), strict=True):
        below = beside(interval_of_row(row, column.key, column.shown), *n)
        if count_column is not None:
            below = "\n".join(filter(None, (below, f"n {n[0]}")))
        cells.append(Cell(column.shown(float(row[column.key])), is_best, below))
    return cells
