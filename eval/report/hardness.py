"""What breaks whom, and where: the first section of the page of a plan with axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from eval.core.charts import Axis, Drawing, Look, Panel, Series, named_ticks
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.report.tables import Cell, Table
from eval.running.results.run_data import RunData, stored_table
from eval.tables.columns import UNDEFINED, share, spaced
from eval.tables.hardness import BROKEN_BELOW
from eval.tables.rows import records

_N_ACROSS = 4
_HOLDS = "holds"


@dataclass(frozen=True, slots=True)
class Hardness:
    """The table of breaking points, and the slopes."""

    table: Table
    plots: tuple[Chart, ...]


def draw_hardness(data: RunData) -> Hardness | None:
    """Return the section; None where the run has no hard.csv, as its plan has no axes."""
    steps, points = stored_table(data, "hard"), stored_table(data, "breaking_points")
    if len(steps) == 0 or len(points) == 0:
        return None
    steps, points = (_with_texts(table) for table in (steps, points))
    return Hardness(_table(points), (_slopes(steps),))


def _with_texts(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with "" where a unit or a value is empty."""
    texts = {name: table[name].astype(object).where(table[name].notna(), "") for name in ("unit", "value")}
    return table.assign(**texts)


def _ranked(points: pd.DataFrame) -> list[str]:
    """Return the methods, those that hold on most axes first."""
    holds = points.assign(holds=points["step"] == 0).groupby("variant", sort=False)["holds"].sum()
    return [str(name) for name in holds.sort_values(ascending=False, kind="stable").index]


def count_held(points: pd.DataFrame) -> dict[str, int]:
    """Return on how many axes each method holds, of those that it was run on at every step, most first.

    Args:
        points: Rows of breaking_points.csv.
    """
    measured = points[points["is_measured"]]
    return {name: int((measured["step"][measured["variant"] == name] == 0).sum()) for name in _ranked(measured)}


def name_breaks(points: pd.DataFrame, variant: str) -> str:
    """Return the axes on which a method breaks, with the values, or that it breaks nowhere.

    Args:
        points: Rows of breaking_points.csv.
        variant: The method.
    """
    its = points[points["variant"] == variant]
    own = records(_with_texts(its[its["is_measured"]]))
    broken = [f"{row['axis']} ({_at(row)})" for row in own if row["step"]]
    if broken:
        return f"{variant} breaks at {', '.join(broken)}"
    n_left = len(its) - len(own)
    return f"{variant} breaks nowhere" + (f" so far ({len(own)} of {len(its)} axes measured)" if n_left else "")


def _at(row: Mapping[str, Any]) -> str:
    value = row["value"]
    number = f"{value:g}" if isinstance(value, int | float) else str(value)
    return f"{number} {row['unit']}".strip()


def _table(points: pd.DataFrame) -> Table:
    """Return a row for each method, best first, and a column for each axis."""
    axes = list(dict.fromkeys(points["axis"].astype(str)))
    cell = {(row["variant"], row["axis"]): row for row in records(points)}
    rows = [("", (Cell(spaced(name)), *(_cell(cell[name, axis]) for axis in axes))) for name in _ranked(points)]
    caption = (
        "Breaking points: the first step at which a method finds fewer than half of the changes at 0.1 false regions "
        "per 100 m; below it the recall there, or that of the hardest step"
    )
    return Table(("method", *axes), tuple(rows), caption)


def _cell(row: Mapping[str, Any]) -> Cell:
    if not row["is_measured"]:
        return Cell(UNDEFINED)
    holds = row["step"] == 0
    return Cell(_HOLDS if holds else _at(row), holds, interval=share(row["recall"]))


def _slopes(steps: pd.DataFrame) -> Chart:
    """Return recall against the steps of each axis: a panel for each, a line for each method."""
    names = [str(name) for name in dict.fromkeys(steps["variant"])]
    panels: list[Panel] = []
    for axis, own in steps.groupby("axis", sort=False):
        values = own.drop_duplicates("step")
        ticks = [_at({"value": value, "unit": ""}) for value in values["value"]]
        shifts = np.arange(len(names)) - (len(names) - 1) / 2
        lines = [_line(own[own["variant"] == name], name, shift) for name, shift in zip(names, shifts, strict=True)]
        limit = Series([-0.4, len(ticks) - 0.6], [BROKEN_BELOW] * 2, Look("#c4c4c4", 0.8))
        title = f"{axis}{f' [{unit}]' if (unit := str(values['unit'].iloc[0])) else ''}"
        x_axis = Axis(title, (-0.4, len(ticks) - 0.6), ticks=named_ticks(ticks))
        y_axis = Axis("recall" if len(panels) % _N_ACROSS == 0 else "", (-0.03, 1.05))
        panels.append(Panel(x_axis, y_axis, [limit, *lines]))
    rows = [panels[start : start + _N_ACROSS] for start in range(0, len(panels), _N_ACROSS)]
    n_pairs = int(steps["n_judged"].max())
    caption = (
        f"Recall at 0.1 false regions per 100 m over up to n = {n_pairs} pairs a step, easiest step on the left; a "
        "pair without an answer is lost, and of a few short ones loses the step. The grey line is one half. hard.csv "
        "has the 95 % intervals."
    )
    return Chart("hard", "What breaks whom, and where", Drawing(rows, 210), caption, has_png=True)


def _line(own: pd.DataFrame, name: str, shift: float) -> Series:
    # side by side, so that equal values do not hide each other
    x = own["step"].to_numpy(dtype=np.float64) - 1 + 0.05 * shift
    return Series(x, own["recall_at_0.1"], look_of(name), name, hover="recall {y:.2f}")
