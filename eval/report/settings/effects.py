"""What each setting of the world does to every variant: a table of paired differences and a picture of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from eval.core.charts import BLACK, Axis, Drawing, Look, Panel, Series
from eval.core.statistics import ENOUGH_PAIRS
from eval.plans.worlds import get_group
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.report.tables import Cell, Table, beside
from eval.running.results.run_data import RunData
from eval.running.results.values import over_pairs, select_rows
from eval.tables.columns import RESULT_COLUMNS, UNDEFINED, Column, count, select, share
from eval.tables.effects import effects
from eval.tables.rows import records

COLUMNS = (
    Column("n_observable", "observable changes", None, count),
    *select(RESULT_COLUMNS, "region_recall", "region_recall_at_k", "region_auroc", "false_regions_per_100m"),
    Column("n_false_regions_on_movers", "false regions on movers", "low", share),
    *select(RESULT_COLUMNS, "object_iou_point", "object_f1_50", "merge_error_m"),
)  # fmt: skip
_DRAWN = ("region_recall_at_k", "object_iou_point", "object_f1_50")
_MINUS = "\u2212"
_ROW_PX, _LINES_PER_ROW, _MARGIN_PX = 30, 0.45, 50
_ZERO = Look(BLACK, 0.8)


@dataclass(frozen=True, slots=True)
class EffectsOn:
    """What the settings over one world do; no chart where neither recall nor IoU is defined."""

    reference: str
    table: Table
    chart: Chart | None


def draw_effects(data: RunData) -> list[EffectsOn]:
    """Return table and picture for every world that others repeat with something set otherwise."""
    results = pd.DataFrame(list(data.every_result))
    known = [name for name in ("scenario", "seed", "variant", *(column.key for column in COLUMNS)) if name in results]
    found = effects(results[known]).groupby("reference", sort=False)
    return [_effects_on(data, str(reference), own, place) for place, (reference, own) in enumerate(found, 1)]


def signed(column: Column, value: float) -> str:
    """Write a difference as its column writes values, with its sign; one that is written as 0 has none."""
    if math.isnan(value):
        return UNDEFINED
    written = column.shown(abs(value))
    sign = "" if not any(digit in written for digit in "123456789") else "+" if value > 0 else _MINUS
    return f"{sign}{written}"


def shorten(settings: Sequence[str]) -> tuple[str, list[str]]:
    """Return the group that all settings belong to, "" if there is none, and the settings without it."""
    groups = {get_group(part) for text in settings for part in text.split(",")}
    group = groups.pop() if len(groups) == 1 else ""
    return group, [", ".join(part.removeprefix(f"{group}.") for part in text.split(",")) for text in settings]


def effect_chart(panels: Mapping[str, pd.DataFrame], look: Callable[[str], Look] = look_of) -> Drawing:
    """Draw one panel for each figure: settings from top to bottom, a dot and a line for each variant.

    Args:
        panels: By the name of the figure, a row for each effect on it: `setting`, `variant`, `difference` and its
            interval `low` to `high`, NaN where undefined; settings and variants in the order in which they come.
        look: How a variant is drawn.
    """
    every = pd.concat(panels.values())
    settings, variants = (list(every[name].unique()) for name in ("setting", "variant"))
    names = [setting.replace(", ", ",\n") for setting in settings]
    # a row is as high as its name needs
    heights = np.maximum(1.0, _LINES_PER_ROW * np.array([1 + name.count("\n") for name in names]))
    middles = dict(zip(settings, (np.cumsum(heights) - heights / 2).tolist(), strict=True))
    bottom = float(heights.sum())
    step = 0.6 / max(len(variants), 2)
    row: list[Panel] = []
    for figure, table in panels.items():
        series = [Series([0.0, 0.0], [0.0, bottom], _ZERO)]
        for order, variant in enumerate(variants):
            own = table[table["variant"] == variant]
            places = own["setting"].map(middles).astype(float) + (order - (len(variants) - 1) / 2) * step
            dots = replace(look(variant), width=0.0)
            ends = {"low": own["low"], "high": own["high"]}
            series.append(Series(own["difference"], places.tolist(), dots, variant, is_across=True, **ends))
        ticks = {place: "" if row else text for place, text in zip(middles.values(), names, strict=True)}
        row.append(Panel(Axis(f"difference of {figure}"), Axis(span=(bottom, 0.0), ticks=ticks), series))
    return Drawing([row], round(_MARGIN_PX + _ROW_PX * bottom))


def _effects_on(data: RunData, reference: str, table: pd.DataFrame, place: int) -> EffectsOn:
    columns = [column for column in COLUMNS if column.key in set(table["metric"][table["n"] > 0])]
    settings = list(table["settings"].unique())
    group, short = shorten(settings)
    title = f"{reference}: what each setting of its {group} does" if group else f"{reference}: what each setting does"
    table = table.assign(setting=table["settings"].map(dict(zip(settings, short, strict=True))))
    drawn = [column for column in columns if column.key in _DRAWN]
    headings = ("setting", "pairs", *(column.heading for column in columns))
    lines = Table(headings, tuple(_lines(data, table, columns, short)), f"{title}, on average")
    return EffectsOn(reference, lines, _chart(f"effects_{place}", title, table, drawn) if drawn else None)


def _lines(
    data: RunData, table: pd.DataFrame, columns: Sequence[Column], settings: Sequence[str]
) -> Iterator[tuple[str, tuple[Cell, ...]]]:
    """Yield the rows of the table: for each variant the world's own means, then every setting."""
    for variant, own in table.groupby("variant", sort=False):
        plain = select_rows(data.every_result, scenario=table["reference"].iloc[0], variant=variant)
        means = (Cell(column.shown(over_pairs(plain, column.key))) for column in columns)
        yield str(variant), (Cell("as it is: mean"), Cell(str(len(plain))), *means)
        for setting in settings:
            by_key = {row["metric"]: row for row in records(own[own["setting"] == setting])}
            found = [(column, by_key.get(column.key)) for column in columns]
            n = max((row["n"] for _, row in found if row is not None), default=0)
            cells = (Cell(UNDEFINED) if row is None else _cell(column, row, n) for column, row in found)
            yield str(variant), (Cell(setting), Cell(str(n)), *cells)


def _cell(column: Column, row: Mapping[str, Any], n_pairs: int) -> Cell:
    is_clear = row["n"] >= ENOUGH_PAIRS and (row["low"] > 0 or row["high"] < 0)
    low, high = (signed(column, row[end]) for end in ("low", "high"))
    interval = "" if math.isnan(row["low"]) else f"{low} to {high}"
    return Cell(signed(column, row["difference"]), is_clear, beside(interval, int(row["n"]), int(n_pairs)))


def _chart(name: str, title: str, table: pd.DataFrame, columns: Sequence[Column]) -> Chart:
    panels = {column.heading: table[table["metric"] == column.key] for column in columns}
    counts = sorted(set(table["n"][table["metric"].isin(_DRAWN)]))
    n = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    pairs = "pair" if n == "1" else "pairs"
    caption = f"Dots are means over {n} session {pairs}, lines their 95 % intervals; right of 0 is better."
    return Chart(name, title, effect_chart(panels), caption)
