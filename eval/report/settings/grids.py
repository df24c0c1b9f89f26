"""Grids of two settings of a method, as heat maps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from eval.core.figures import BLACK
from eval.report.charts import Chart, add_heading, axes_of, layout, set_axis
from eval.running.run_data import GridOf, RunData, grids, of, over_pairs
from eval.tables.columns import RESULT_COLUMNS, Column, share

_GRID_KEYS = (
    "region_recall",
    "region_auroc",
    "object_iou_point",
    "object_f1_50",
    "object_pq",
    "false_regions_per_100m",
    "t_total_s",
)
SHARES = ("region_recall", "region_recall_at_k", "region_auroc", "object_iou_point", "object_f1_50", "object_pq")
_WHITE_TO_BLUE = [[0, "#ffffff"], [1, "#6baed6"]]
# by which settings are chosen: it asks for objects that are whole and for none that are false
PQ_COLUMN = Column(
    "object_pq", "object PQ", "high", share,
    "Panoptic quality: the sum of the IoU of the objects right at 0.5, over these and half of what is false or missed.",
    "As F1.",
)  # fmt: skip
_COLUMNS = {column.key: column for column in (*RESULT_COLUMNS, PQ_COLUMN)}
N_ACROSS = 3


def draw_grids(data: RunData) -> list[Chart]:
    """Return a chart for every grid of two settings: a heat map of each figure that differs on it."""
    found = []
    for place, grid in enumerate(grids(data), start=1):
        values = {key: _values(data, grid, key) for key in _GRID_KEYS}
        shown = [key for key, table in values.items() if len(np.unique(table[~np.isnan(table)])) > 1]
        if shown:
            names = set(grid.points.values())
            seeds = {row["seed"] for row in of(data.results, scenario=grid.scenario) if row["variant"] in names}
            found.append(
                Chart(
                    f"grid_{place}",
                    f"{grid.preset} on {grid.scenario}: {grid.keys[0]} and {grid.keys[1]}",
                    _heat_maps(grid, {_COLUMNS[key]: values[key] for key in shown}),
                    f"Means over n = {len(seeds)} session pair{'s' if len(seeds) > 1 else ''}, medians for times; the "
                    "best cell has a frame.",
                )
            )
    return found


def _heat_maps(grid: GridOf, tables: Mapping[Column, Any]) -> dict[str, Any]:
    n_across = min(N_ACROSS, len(tables))
    n_rows = math.ceil(len(tables) / n_across)
    found = layout(n_across, n_rows, 90 + 26 * len(grid.values[0]))
    data: list[dict[str, Any]] = []
    found["shapes"] = []
    for index, (column, table) in enumerate(tables.items()):
        add_heading(found, index, column.heading)
        set_axis(found, "x", index, grid.keys[1], type="category", showgrid=False)
        set_axis(found, "y", index, "" if index % n_across else grid.keys[0], type="category", showgrid=False)
        is_share = column.key in SHARES
        low, high = (0.0, 1.0) if is_share else (float(np.nanmin(table)), float(np.nanmax(table)))
        written = [[column.shown(value) for value in row] for row in table]
        data.append(
            {"type": "heatmap", "x": list(grid.values[1]), "y": list(grid.values[0]), "z": table, "text": written,
             "texttemplate": "%{text}", "zmin": low, "zmax": high, "colorscale": _WHITE_TO_BLUE, "showscale": False,
             "xgap": 1, "ygap": 1, "textfont": {"size": 11, "color": BLACK},
             "hovertemplate": f"{grid.keys[0]} %{{y}}, {grid.keys[1]} %{{x}}: %{{text}}<extra></extra>",
             **axes_of(index)}
        )  # fmt: skip
        found["shapes"] += _frames(table, column, index)
    for index in range(len(tables), n_across * n_rows):
        found[f"xaxis{index + 1}"]["visible"] = found[f"yaxis{index + 1}"]["visible"] = False
    return {"data": data, "layout": found}


def _frames(table: Any, column: Column, index: int) -> list[dict[str, Any]]:
    """Return a frame around the best cells, as written."""
    written = np.array([[float(column.shown(value)) if not math.isnan(value) else math.nan for value in row]
                        for row in table])  # fmt: skip
    top = np.nanmax(written) if column.better == "high" else np.nanmin(written)
    axes = axes_of(index)
    return [
        {"type": "rect", "xref": axes["xaxis"], "yref": axes["yaxis"], "x0": x - 0.48, "x1": x + 0.48, "y0": y - 0.48,
         "y1": y + 0.48, "line": {"color": BLACK, "width": 2}}
        for y, x in zip(*np.nonzero(written == top), strict=True)
    ]  # fmt: skip


def _values(data: RunData, grid: GridOf, key: str) -> Any:
    """Return (rows, columns) of a figure's means on a grid, NaN where a point was not run."""
    own = of(data.results, scenario=grid.scenario)
    return np.array([
        [over_pairs(of(own, variant=grid.points.get((a, b))), key) for b in grid.values[1]] for a in grid.values[0]
    ], dtype=np.float64)  # fmt: skip
