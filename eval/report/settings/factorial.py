"""Sources of regions against extractions: which of the two a lead comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from eval.core.charts import Axis, Drawing, Heat, Panel, named_ticks
from eval.core.domains import domain_name
from eval.report.drawing.charts import Chart
from eval.report.settings.grids import N_ACROSS, PQ_COLUMN, SHARES
from eval.running.results.grids import split_variant
from eval.running.results.run_data import RunData
from eval.tables.columns import RESULT_COLUMNS, Column, significant
from eval.tables.rows import by_domain, means_with_intervals, numbers, with_domain

_RULE, _SOURCE = "extract.method", "source"
_MEANS = ("region_recall", "object_f1_50", "object_iou_point", "object_pq", "kind_accuracy")
_SECONDS = Column("t_total_paper_s", "query and extraction [s]", "low", significant)
_COLUMNS = {column.key: column for column in (*RESULT_COLUMNS, PQ_COLUMN, _SECONDS)}
_SHOWN = (
    "region_recall", "false_regions_per_100m", "object_f1_50", "object_iou_point", "object_pq", "t_total_paper_s",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Combination:
    """One source of regions with one extraction: the name of the variant, and of its two parts."""

    variant: str
    source: str
    rule: str


def list_combinations(data: RunData) -> list[Combination]:
    """Return the combinations of a run: none unless two sources at least were run with two rules each, each once."""
    found = []
    for variant in dict.fromkeys(str(row["variant"]) for row in data.results):
        preset, settings = split_variant(variant)
        if _RULE in settings:
            found.append(Combination(variant, preset, settings[_RULE]))
    rules: dict[str, set[str]] = {}
    for each in found:
        rules.setdefault(each.source, set()).add(each.rule)
    crossed = [source for source, own in rules.items() if len(own) > 1]
    is_once = len({(each.source, each.rule) for each in found}) == len(found)
    return found if len(crossed) > 1 and is_once else []


def factorial_table(data: RunData) -> pd.DataFrame:
    """Return a row for every domain, source of regions and extraction of a run; empty where nothing is crossed.

    Returns:
        `n_pairs`, `n_failed`; means over pairs of recall, F1, IoU, PQ and kind with their 95 % intervals, a pair
        without an answer counts 0; false regions per 100 m of the whole way; medians of the seconds of query and
        extraction.
    """
    combinations = list_combinations(data)
    rows: list[dict[str, Any]] = []
    for domain, cases in by_domain(with_domain(data.results)) if combinations else ():
        for each in combinations:
            own = cases[cases["variant"] == each.variant]
            names = {"domain": domain, _SOURCE: each.source, "extraction": each.rule, "variant": each.variant}
            rows.append({**names, **_measure(own)} if len(own) else {**names, "n_pairs": 0, "n_failed": 0})
    return pd.DataFrame(rows)


def draw_factorial(table: pd.DataFrame) -> list[Chart]:
    """Return a chart for each domain of `factorial_table`: a heat map of each figure, a row for each source."""
    charts = []
    for domain, own in table.groupby("domain", sort=False) if len(table) else ():
        n_pairs = int(own["n_pairs"].max())
        charts.append(
            Chart(
                f"factorial_{domain}",
                f"Sources of regions and extractions, {domain_name(str(domain))}",
                _drawing(own),
                f"Means over n = {n_pairs} session pairs, false regions over the whole way, median seconds. A column "
                "tells what the source of the regions brings, a row what the extraction does.",
            )
        )
    return charts


def _measure(own: pd.DataFrame) -> dict[str, float]:
    answered = own[own["status"] == "ok"]
    path_m, n_false = numbers(answered, "after_path_m").sum(), numbers(answered, "n_false_regions").sum()
    seconds = numbers(answered, "t_total_paper_s")
    return {
        "n_pairs": len(own),
        "n_failed": len(own) - len(answered),
        **means_with_intervals(own, _MEANS),
        "false_regions_per_100m": 100.0 * n_false / path_m if path_m > 0 else math.nan,
        "t_total_paper_s": float(np.median(seconds)) if len(seconds) else math.nan,
    }


def _drawing(own: pd.DataFrame) -> Drawing:
    sources, rules = (list(dict.fromkeys(own[name])) for name in (_SOURCE, "extraction"))
    every = own.set_index([_SOURCE, "extraction"]).reindex(pd.MultiIndex.from_product([sources, rules]))
    values = {key: numbers(every, key).reshape(len(sources), len(rules)) for key in _SHOWN}
    panels = [_panel(_COLUMNS[key], table, sources, rules) for key, table in values.items() if np.isfinite(table).any()]
    rows = [panels[start : start + N_ACROSS] for start in range(0, len(panels), N_ACROSS)]
    return Drawing(rows, 90 + 22 * len(sources))


def _panel(column: Column, table: Float64Array, sources: list[str], rules: list[str]) -> Panel:
    low, high = (0.0, 1.0) if column.key in SHARES else (float(np.nanmin(table)), float(np.nanmax(table)))
    texts = [[column.shown(value) for value in row] for row in table]
    x = Axis("extraction", (-0.5, len(rules) - 0.5), ticks=named_ticks(rules))
    y = Axis("source", (len(sources) - 0.5, -0.5), ticks=named_ticks(sources))  # the first on top
    return Panel(x, y, [], column.heading, Heat(table, texts, low, high))
