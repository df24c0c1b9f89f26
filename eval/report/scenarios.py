"""The methods of a run on each of its scenarios, as bars with their intervals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from eval.core.charts import Axis, Drawing, Panel, Series, named_ticks
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.running.results.cases import named_variants, scenarios
from eval.running.results.grids import split_variant
from eval.running.results.run_data import RunData
from eval.running.results.values import interval_over_pairs, over_pairs, select_rows
from eval.tables.columns import RESULT_COLUMNS, select

_COLUMNS = select(RESULT_COLUMNS, "region_recall_at_k", "region_auroc", "object_iou_point", "object_f1_50")
_MAX_METHODS = 14


def draw_scenarios(data: RunData) -> list[Chart]:
    """Return the chart of every method on every scenario with changes; none where no scenario has two pairs."""
    worlds = scenarios(data, unchanged=False)
    methods = list(dict.fromkeys(name for world in worlds for name in named_variants(data, world)))
    # what is set over a method belongs to the charts of settings
    methods = [name for name in methods if not split_variant(name)[1]]
    n_methods, methods = len(methods), _best(data, methods)
    sizes = {world: len({row["seed"] for row in select_rows(data.results, scenario=world)}) for world in worlds}
    if len(methods) < 2 or max(sizes.values(), default=0) < 2:
        return []
    ticks = named_ticks([f"{world.replace('/', '/' + chr(10))}\nn {sizes[world]}" for world in worlds])
    values: dict[tuple[str, str], list[Any]] = {
        (world, name): select_rows(data.results, scenario=world, variant=name) for world in worlds for name in methods
    }
    rows = []
    for column in _COLUMNS:
        series = []
        for name in methods:
            groups = [values[world, name] for world in worlds]
            means = [over_pairs(group, column.key) for group in groups]
            low, high = np.array([interval_over_pairs(group, column.key) for group in groups]).T
            look = look_of(name)
            series.append(Series(list(ticks), means, look, name, "bars", low=low, high=high, hover="{y:.3f}"))
        is_last = column is _COLUMNS[-1]
        x = Axis(ticks=ticks if is_last else dict.fromkeys(ticks, ""))
        rows.append([Panel(x, Axis(column.heading, (0.0, 1.05)), series)])
    caption = (
        "Means over the n session pairs of each scenario, 0 for a pair without an answer (AUROC: 0.5); bars: 95 % "
        "interval over tunnels. A click on a name hides a method, two show it alone."
    )
    if n_methods > len(methods):
        caption += f" The {len(methods)} best by F1 of {n_methods} methods; results.csv has all."
    return [Chart("by_scenario", "Every method on every scenario", Drawing(rows, 190), caption)]


def _best(data: RunData, methods: list[str]) -> list[str]:
    """Return the methods of highest F1 that the chart has room for, in their order."""
    means = {name: over_pairs(select_rows(data.results, variant=name), "object_f1_50") for name in methods}
    falling = sorted(methods, key=lambda name: -math.inf if math.isnan(means[name]) else means[name], reverse=True)
    kept = set(falling[:_MAX_METHODS])
    return [name for name in methods if name in kept]
