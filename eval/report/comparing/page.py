"""The comparison of two runs, or of the methods of one run, as one offline page and comparison.csv."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from eval.core.charts import BLUE, GREEN, ORANGE, SYMBOLS, Look
from eval.core.domains import domain_name
from eval.core.figures import picture_address
from eval.core.output import make_writable, require_replaceable
from eval.core.statistics import ENOUGH_PAIRS
from eval.core.tablefile import csv_text
from eval.report.comparing.columns import COMPARED
from eval.report.comparing.differences import (
    BETTER,
    COLUMNS,
    NOISE,
    NOT_JUDGED,
    SAME,
    TOO_FEW,
    WORSE,
    compare,
    condition_compared,
)
from eval.report.render import render_page, write_files
from eval.report.settings.effects import effect_chart, signed
from eval.report.tables import Cell, Picture, Table
from eval.running.results.sides import Side, cautions, only_in, short_names, why_no_times
from eval.tables.columns import Column, spaced
from eval.tables.rows import DOMAINS, records

COLOURS = {BETTER: "#d3e7f5", WORSE: "#fbdcc8"}
MOVED = tuple(COLOURS)
_COLUMNS = {column.key: column for column in COMPARED}
_MATRIX = (
    "region_recall", "region_recall_at_k", "recall_at_0.1", "region_auroc", "region_precision",
    "false_regions_per_100m", "object_iou_point", "object_f1_50", "kind_accuracy", "merge_error_m", "t_total_s",
    "bytes_regions_before",
)  # fmt: skip
_DRAWN = ("region_recall_at_k", "region_auroc", "object_iou_point", "object_f1_50")
_MAX_DRAWN = 3
_MAX_LINES = 8


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two sides and their differences.

    Attributes:
        names: What A and B are called.
        table: As `eval.report.comparing.compare` returns it.
        only: The variants, scenarios and pairs of A only, and of B only, one line each.
        cautions: The reasons against the comparison, one sentence each.
    """

    names: tuple[str, str]
    table: pd.DataFrame
    only: tuple[tuple[str, ...], tuple[str, ...]]
    cautions: tuple[str, ...]


def compare_sides(a: Side, b: Side) -> Comparison:
    """Compare two sides.

    Raises:
        InputError: They share no session pair, or their metrics versions differ.
    """
    table = compare(a, b, times_count=not why_no_times(a, b))
    only = (tuple(only_in(a, b)), tuple(only_in(b, a)))
    return Comparison(short_names(a, b), table, only, (*_tell_condition(a), *cautions(a, b)))


def _tell_condition(side: Side) -> list[str]:
    """Return a sentence on the pairs that domains are compared over, where a side's plan tells conditions apart."""
    condition = condition_compared(side)
    if condition is None:
        return []
    return [f"Domains are compared over pairs with {condition.words} alone; scenarios stand with what they have."]


def write_comparison(found: Comparison, folder: Path) -> Path:
    """Write comparison.csv and comparison.html into a folder, which is made where it is missing.

    Returns:
        Path of the page.

    Raises:
        InputError: The folder cannot be written, or has another file of such a name.
    """
    make_writable(folder)
    require_replaceable(folder / "comparison.csv", ",".join(COLUMNS[:2]).encode(), "table of `tunnelcd report A B`")
    require_replaceable(folder / "comparison.html", b"<title>tunnelcd: ", "page of `tunnelcd report A B`")
    table, page = csv_text(found.table), render_page("comparison.html", _content(found))
    write_files({folder / "comparison.html": page, folder / "comparison.csv": table})
    return folder / "comparison.html"


def overview(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows over the widest domain as a terminal shows them: values and differences as texts."""
    rows = []
    for row in _widest(table):
        column = _COLUMNS[row["metric"]]
        rows.append(
            {
                "variant": row["name"], "figure": column.heading, "pairs": row["n_used"],
                "A": column.shown(row["mean_a"]), "B": column.shown(row["mean_b"]),
                "B \u2212 A": _signed(column, row["difference"]), "95 % interval": _interval(column, row),
                "B is": row["verdict"],
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def sentences(found: Comparison) -> list[str]:
    """Return the counts of the verdicts, then the cautions, then what only one side has."""
    rows = _widest(found.table)
    counts = Counter(row["verdict"] for row in rows)
    told = ", ".join(f"{counts[word]} {word}" for word in (BETTER, WORSE, NOISE, SAME, TOO_FEW) if counts[word])
    only = []
    for letter, lines in zip("AB", found.only, strict=True):
        more = [f"and {len(lines) - _MAX_LINES} more"] if len(lines) > _MAX_LINES else []
        only += [f"Only in {letter}: {'; '.join([*lines[:_MAX_LINES], *more])}."] if lines else []
    return [f"{found.names[1]} (B) against {found.names[0]} (A), {len(rows)} figures: {told}.", *found.cautions, *only]


def matrix_table(table: pd.DataFrame) -> Table:
    """Return the difference of every main figure, a row for each variant, grouped by domain."""
    rows = [row for row in _records(table) if row["scope"] == "domain"]
    present = [key for key in _MATRIX if any(row["metric"] == key for row in rows)]
    lines: list[tuple[str, tuple[Cell, ...]]] = []
    for where in dict.fromkeys(row["where"] for row in rows):
        here = [row for row in rows if row["where"] == where]
        for name in dict.fromkeys(row["name"] for row in here):
            own = {row["metric"]: row for row in here if row["name"] == name}
            n_pairs = max(int(row["n_pairs"]) for row in own.values())
            cells = (_difference(own[key]) if key in own else Cell("") for key in present)
            lines.append((domain_name(str(where)), (Cell(spaced(name)), Cell(str(n_pairs)), *cells)))
    headings = ("method", "pairs", *(_COLUMNS[key].heading for key in present))
    return Table(headings, tuple(lines), "Mean difference B \u2212 A over session pairs, with its 95 % interval")


def detail_tables(table: pd.DataFrame) -> list[Table]:
    """Return every compared figure with both means, a table for each domain and each scenario."""
    found = []
    by_part: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in _records(table):
        by_part.setdefault((row["scope"], str(row["where"])), []).append(row)
    for (scope, where), rows in by_part.items():
        lines = []
        for row in rows:
            column = _COLUMNS[row["metric"]]
            uneven = [f"{row[f'n_only_{side}']} in {side.upper()} only" for side in "ab" if row[f"n_only_{side}"]]
            cells = (
                Cell(column.heading), Cell(column.shown(row["mean_a"])), Cell(column.shown(row["mean_b"])),
                Cell(_signed(column, row["difference"]), interval=_interval(column, row)),
                Cell(str(row["n_used"]), interval=", ".join(uneven)),
                Cell(row["verdict"], row["verdict"] in COLOURS, colour=COLOURS.get(row["verdict"], "")),
            )  # fmt: skip
            lines.append((row["name"], cells))
        title = domain_name(where) if scope == "domain" else where
        found.append(Table(("figure", "A", "B", "B \u2212 A", "pairs", "B is"), tuple(lines), title))
    return found


def picture(table: pd.DataFrame) -> Picture | None:
    """Return the differences of up to three main figures with their intervals; None where none of them differs."""
    names = [spaced(row["name"]) for row in _records(table)]
    rows = table.assign(setting=names, variant=table["where"].map(domain_name))
    rows = rows[(rows["scope"] == "domain") & rows["low"].notna()]
    differ = set(rows["metric"][rows["verdict"] != SAME])
    drawn = [key for key in _DRAWN if key in differ][:_MAX_DRAWN]
    if not drawn:
        return None
    panels = {_COLUMNS[key].heading: rows[rows["metric"] == key] for key in drawn}
    caption = "Dots are means of B \u2212 A over session pairs, lines their 95 % intervals; right of 0 B is better."
    return Picture("What moved, and how surely", picture_address(effect_chart(panels, _look_of_domain)), caption)


def _look_of_domain(name: str) -> Look:
    place = list(map(domain_name, DOMAINS)).index(name)
    return Look((BLUE, ORANGE, GREEN)[place], marker=SYMBOLS[place], size=4.5)


def _content(found: Comparison) -> dict[str, Any]:
    details = detail_tables(found.table)
    keys = list(dict.fromkeys(found.table["metric"]))
    return {
        "names": found.names,
        "sentences": sentences(found),
        "only": found.only,
        "matrix": matrix_table(found.table),
        "picture": picture(found.table),
        "details": details,
        "columns": [column for column in COMPARED if column.key in keys],
        "enough_pairs": ENOUGH_PAIRS,
        "colours": COLOURS,
        "not_judged": NOT_JUDGED in set(found.table["verdict"]),
    }


def _difference(row: Mapping[str, Any]) -> Cell:
    column, colour = _COLUMNS[row["metric"]], COLOURS.get(row["verdict"], "")
    return Cell(_signed(column, row["difference"]), bool(colour), _interval(column, row), colour)


def _interval(column: Column, row: Mapping[str, Any]) -> str:
    if math.isnan(row["low"]) or row["verdict"] == SAME:
        return ""
    return f"{_signed(column, row['low'])} to {_signed(column, row['high'])}"


def _widest(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows over all pairs of each variant, or over its only domain."""
    rows = [row for row in _records(table) if row["scope"] == "domain"]
    widest = {row["name"]: row["where"] for row in rows}  # the last one: "all" comes after "in" and "out"
    return [row for row in rows if row["where"] == widest[row["name"]]]


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a whole comparison with `name`: the variant, or that of the side that has several."""
    n_a, n_b = table["variant_a"].nunique(), table["variant_b"].nunique()
    return [
        {**row, "name": f"against {row['variant_a']}" if n_a > 1 == n_b else row["variant_b"]} for row in records(table)
    ]


def _signed(column: Column, value: float) -> str:
    """Write a difference with its sign, and with more digits where the digits of its column would show 0."""
    written = signed(column, value)
    if value == 0.0 or math.isnan(value) or any(digit in written for digit in "123456789"):
        return written
    finer = replace(column, shown=lambda size: np.format_float_positional(size, 1, fractional=False, trim="-"))
    return signed(finer, value)
