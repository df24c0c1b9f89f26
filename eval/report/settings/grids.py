"""Grids of two settings of a method, as heat maps."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array
from eval.core.charts import BLACK, Axis, Drawing, Heat, Look, Panel, Series, named_ticks
from eval.report.drawing.charts import Chart
from eval.running.results.grids import GridOf, find_grids
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, defined, over_pairs, select_rows
from eval.tables.columns import RESULT_COLUMNS, Column, share

_GRID_KEYS = (
    "region_recall", "region_auroc", "object_iou_point", "object_f1_50", "object_pq", "false_regions_per_100m",
    "t_total_s",
)  # fmt: skip
SHARES = ("region_recall", "region_recall_at_k", "region_auroc", "object_iou_point", "object_f1_50", "object_pq")
# by which settings are chosen: it asks for objects that are whole and for none that are false
PQ_COLUMN = Column(
    "object_pq", "object PQ", "high", share,
    "Panoptic quality: the sum of the IoU of the objects right at 0.5, over these and half of what is false or missed.",
    "As F1.",
)  # fmt: skip
_COLUMNS = {column.key: column for column in (*RESULT_COLUMNS, PQ_COLUMN)}
N_ACROSS = 3


def draw_grids(data: RunData) -> list[Chart]:
    """Return a chart for every grid of two settings: a heat map of each figure that differs on it as written."""
    found = []
    for place, grid in enumerate(find_grids(data), start=1):
        tables = _differing(data, grid)
        if tables:
            names = set(grid.points.values())
            seeds = {
                row["seed"] for row in select_rows(data.results, scenario=grid.scenario) if row["variant"] in names
            }
            found.append(
                Chart(
                    f"grid_{place}",
                    _title(grid),
                    _drawing(data, grid, tables),
                    f"Means over n = {len(seeds)} session pair{'s' if len(seeds) > 1 else ''}, medians for times; the "
                    "best cell over as many pairs as any has a frame.",
                )
            )
    return found


def name_equal_grids(data: RunData) -> list[str]:
    """Return a sentence for every grid that has no chart."""
    return [f"No figure differs on the grid {_title(grid)}." for grid in find_grids(data) if not _differing(data, grid)]


def _title(grid: GridOf) -> str:
    return f"{grid.preset} on {grid.scenario}: {grid.keys[0]} and {grid.keys[1]}"


def _differing(data: RunData, grid: GridOf) -> dict[Column, Float64Array]:
    """Return (rows, columns) of each figure that differs on a grid as written: what a digit hides has no colour."""
    tables = {_COLUMNS[key]: _values(data, grid, key) for key in _GRID_KEYS}
    return {column: table for column, table in tables.items() if len(np.unique(table[~np.isnan(table)])) > 1}


def _drawing(data: RunData, grid: GridOf, tables: Mapping[Column, Float64Array]) -> Drawing:
    x, y = (named_ticks(list(grid.values[place])) for place in (1, 0))
    panels = []
    for column, table in tables.items():
        low, high = (0.0, 1.0) if column.key in SHARES else (float(np.nanmin(table)), float(np.nanmax(table)))
        texts = [[column.shown(value) for value in row] for row in table]
        axes = Axis(grid.keys[1], (-0.5, len(x) - 0.5), ticks=x), Axis(grid.keys[0], (-0.5, len(y) - 0.5), ticks=y)
        n_pairs = _counts(data, grid, column.key)
        fair = np.where(n_pairs == n_pairs.max(), table, np.nan)  # over fewer pairs it may be the easy ones
        panels.append(Panel(*axes, _frames(fair, column), column.heading, Heat(table, texts, low, high)))
    rows = [panels[start : start + N_ACROSS] for start in range(0, len(panels), N_ACROSS)]
    return Drawing(rows, 90 + 26 * len(y))


def _frames(written: Float64Array, column: Column) -> list[Series]:
    """Return a frame around each of the best cells."""
    top = np.nanmax(written) if column.better == "high" else np.nanmin(written)
    around_x, around_y = 0.48 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
    return [
        Series(x + around_x, y + around_y, Look(BLACK, 2.0)) for y, x in zip(*np.nonzero(written == top), strict=True)
    ]


def _values(data: RunData, grid: GridOf, key: str) -> Float64Array:
    """Return (rows, columns) of a figure's means on a grid as written, NaN where it is undefined or was not run."""
    means, shown = [[over_pairs(cell, key) for cell in row] for row in _cells(data, grid)], _COLUMNS[key].shown
    return np.array([[math.nan if math.isnan(mean) else float(shown(mean)) for mean in row] for row in means])


def _counts(data: RunData, grid: GridOf, key: str) -> Int64Array:
    """Return (rows, columns) over how many session pairs a figure's means on a grid are."""
    return np.array([[len(defined(cell, key)) for cell in row] for row in _cells(data, grid)], dtype=np.int64)


def _cells(data: RunData, grid: GridOf) -> list[list[list[Row]]]:
    """Return the rows of results.csv of every point of a grid."""
    own = select_rows(data.results, scenario=grid.scenario)
    return [[select_rows(own, variant=grid.points.get((a, b))) for b in grid.values[1]] for a in grid.values[0]]
