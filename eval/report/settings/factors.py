"""Single settings of a method: what each value does, a line for each domain, all else as it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.model.config import load_config
from eval.core.charts import COLOURS, Axis, Drawing, Look, Panel, Series, named_ticks
from eval.core.domains import domain_name
from eval.report.drawing.charts import Chart
from eval.report.settings.grids import N_ACROSS, SHARES
from eval.running.results.cases import find_repeats
from eval.running.results.grids import grid_points, sorted_values, split_variant
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, defined, interval_over_pairs, over_pairs, select_rows, text
from eval.tables.columns import RESULT_COLUMNS
from eval.tables.rows import with_domain

_KEYS = ("region_recall_at_k", "region_auroc", "object_iou_point", "object_f1_50", "t_total_s")
_COLUMNS = {column.key: column for column in RESULT_COLUMNS}


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """One setting of one preset, all else as it is.

    Attributes:
        preset: The preset, and what else was set to one value.
        key: The setting.
        points: Its values, as texts in rising order, and the variant that has it.
        own: The value that the preset itself has, "" where it was not run or is not known.
    """

    preset: str
    key: str
    points: Mapping[str, str]
    own: str


def factors(data: RunData) -> list[Factor]:
    """Find the settings that were run with two values or more, the preset's own among them, nothing else differing."""
    held = find_repeats(data)
    cases = ((str(row["scenario"]), str(row["variant"])) for row in data.results)
    variants = list(dict.fromkeys(name for world, name in cases if (world, name) not in held))
    on_grid = {name for _, name in grid_points(data)}
    found: dict[tuple[str, str], dict[str, str]] = {}
    for name in variants:
        preset, settings = split_variant(name)
        if len(settings) == 1 and name not in on_grid:
            ((key, value),) = settings.items()
            found.setdefault((preset, key), {})[value] = name
    result = []
    for (preset, key), points in found.items():
        own = _setting_of(preset, key) if preset in variants else ""
        every = {**points, own: preset} if own else points
        if len(every) >= 2:
            result.append(Factor(preset, key, {value: every[value] for value in sorted_values(every)}, own))
    return result


def draw_factors(data: RunData) -> list[Chart]:
    """Return a chart for every such setting: a panel for each figure, a line for each domain, with 95 % intervals."""
    results = with_domain(data.results).to_dict("records")
    rows = [{str(key): value for key, value in row.items()} for row in results]
    charts = []
    for place, factor in enumerate(factors(data), start=1):
        own = _shared(factor, rows)
        drawing = _drawing(factor, own)
        if drawing is None:
            continue
        n = len({(row["scenario"], row["seed"]) for row in own})
        star = f" The star is the preset's own value, {factor.own}." if factor.own else ""
        charts.append(
            Chart(
                f"factor_{place}",
                f"{factor.preset}: {factor.key}",
                drawing,
                f"Means over the n = {n} session pairs that every value was run on (times: medians), bars: 95 % "
                f"interval over tunnels.{star}",
            )
        )
    return charts


def _shared(factor: Factor, rows: Sequence[Row]) -> list[Row]:
    """Return the rows of a setting's variants on the pairs that all of them were run on."""
    groups = [select_rows(rows, variant=name) for name in factor.points.values()]
    shared = set.intersection(*({(row["scenario"], row["seed"]) for row in group} for group in groups))
    return [row for group in groups for row in group if (row["scenario"], row["seed"]) in shared]


def _drawing(factor: Factor, rows: Sequence[Row]) -> Drawing | None:
    """Return a panel for each figure; None where no figure has two values."""
    shown = [key for key in _KEYS if len(set(np.round(defined(rows, key), 9))) > 1]
    if not shown:
        return None
    domains = list(dict.fromkeys(text(row, "domain") for row in rows))
    ticks = named_ticks(list(factor.points))
    panels = []
    for key in shown:
        series = [
            each
            for place, domain in enumerate(domains)
            for each in _series(factor, select_rows(rows, domain=domain), key, COLOURS[place % len(COLOURS)], domain)
        ]
        ends = [np.append(each.y, 0.0 if each.high is None else each.high) for each in series]
        span = (-0.03, 1.05) if key in SHARES else (0.0, 1.05 * float(np.nanmax(np.concatenate(ends))))
        panels.append(Panel(Axis(factor.key, ticks=ticks), Axis(_COLUMNS[key].heading, span), series))
    return Drawing([panels[start : start + N_ACROSS] for start in range(0, len(panels), N_ACROSS)], 230)


def _series(factor: Factor, rows: Sequence[Row], key: str, colour: str, domain: str) -> list[Series]:
    """Return the line of a domain, and a star at the value that the preset itself has."""
    groups = [select_rows(rows, variant=name) for name in factor.points.values()]
    means = np.array([over_pairs(group, key) for group in groups])
    low, high = np.array([interval_over_pairs(group, key) for group in groups]).T
    hover = [
        f"{value}: {mean:.3g}, n {len(defined(group, key))}"
        for value, mean, group in zip(factor.points, means, groups, strict=True)
    ]
    places, name = np.arange(len(means)), domain_name(domain)
    line = Series(places, means, Look(colour, 1.6, marker="circle"), name, low=low, high=high, hover=hover)
    own = [place for place, value in enumerate(factor.points) if value == factor.own]
    return [line, Series(own, means[own], Look(colour, 0.0, marker="star", size=8.0), name)]


def _setting_of(preset: str, key: str) -> str:
    """Return the value that a preset has, as a variant's name writes it; "" for what is no preset or setting of one."""
    try:
        value: Any = load_config(preset).model_dump(mode="json")
    except InputError:
        return ""
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
