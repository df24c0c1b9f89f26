"""The methods of a run on each of its scenarios, as bars with their intervals."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.core.statistics import bootstrap_interval
from eval.report.charts import Chart, axes_of, error_bars, in_legend, layout, line_of, set_axis
from eval.running.run_data import RunData, named_variants, number, of, over_pairs, scenarios, split_variant
from eval.tables.columns import RESULT_COLUMNS

_KEYS = ("region_recall_at_k", "region_auroc", "object_iou_point")
_MAX_METHODS = 14
_COLUMNS = [column for key in _KEYS for column in RESULT_COLUMNS if column.key == key]


def draw_scenarios(data: RunData) -> list[Chart]:
    """Return the chart of every method on every scenario with changes; none where no scenario has two pairs."""
    worlds = scenarios(data, unchanged=False)
    methods = list(dict.fromkeys(name for world in worlds for name in named_variants(data, world)))
    # what is set over a method belongs to the charts of settings
    methods = [name for name in methods if not split_variant(name)[1]][:_MAX_METHODS]
    sizes = {world: len({row["seed"] for row in of(data.results, scenario=world)}) for world in worlds}
    if len(methods) < 2 or max(sizes.values(), default=0) < 2:
        return []
    places = [f"{world.replace('/', '/<br>')}<br>n {sizes[world]}" for world in worlds]
    found = layout(1, len(_COLUMNS), 190, methods, barmode="group", bargap=0.25)
    values: dict[tuple[str, str], list[Any]] = {
        (world, name): of(data.results, scenario=world, variant=name) for world in worlds for name in methods
    }
    traces: list[dict[str, Any]] = []
    seen: set[str] = set()
    for index, column in enumerate(_COLUMNS):
        set_axis(found, "x", index, type="category", tickangle=0, showticklabels=index == len(_COLUMNS) - 1)
        set_axis(found, "y", index, column.heading, range=[0, 1.05])
        for name in methods:
            groups = [values[world, name] for world in worlds]
            means = [over_pairs(group, column.key) for group in groups]
            ends = [bootstrap_interval(np.array([number(row, column.key) for row in group])) for group in groups]
            low, high = (np.array([end[side] for end in ends]) for side in (0, 1))
            look = line_of(name, methods)
            shape = "" if look["dash"] == "solid" else "/"
            marker = {"color": look["color"], "pattern": {"shape": shape, "solidity": 0.4}}
            traces.append(
                {"type": "bar", "x": places, "y": means, "marker": marker, "hovertemplate": "%{x}: %{y:.3f}",
                 "error_y": error_bars(means, low, high, "#444"), **axes_of(index), **in_legend(name, seen)}
            )  # fmt: skip
    caption = (
        "Means over the n session pairs of each scenario, 0 for a pair without an answer (AUROC: left out); bars: 95 % "
        "interval over pairs. A click on a name hides a method, two show it alone."
    )
    return [Chart("by_scenario", "Every method on every scenario", {"data": traces, "layout": found}, caption)]
