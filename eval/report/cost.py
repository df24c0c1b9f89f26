"""Quality against cost: the Pareto front of the methods, as a table and as charts.

Cost is the median time of a pair, or the mean of the bytes kept of the before session. A method is on the front if no
other method is at least as good and as cheap, and better in one of the two. A method competes if it is not told the
truth, finds something, ran as many pairs as any other, and states its cost for each of its answers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Float64Array
from eval.core.charts import BLACK, BLUE, Axis, Drawing, Look, Panel, Series, log_span
from eval.core.domains import domain_name
from eval.core.statistics import mean, median
from eval.core.terminal.printing import count_pairs
from eval.report.drawing.charts import Chart
from eval.report.drawing.looks import look_of
from eval.report.pooled import pooled_recalls
from eval.running.results.cases import comparable
from eval.running.results.run_data import RunData
from eval.tables.rows import ALL_DOMAINS, DOMAINS, is_told_the_truth, means_with_intervals, numbers, records

_RECALL_AT_RATE, _RECALL_AT_K, _F1 = "recall_at_0.1", "region_recall_at_k", "object_f1_50"
_TIME, _BYTES = "t_total_s", "bytes_regions_before"
COLUMNS = (
    "quality", "cost", "domain", "variant", "n_pairs", "n_quality", "quality_value", "low", "high", "n_cost",
    "cost_value", "is_on_front",
)  # fmt: skip
_QUALITIES = {
    "regions": {_RECALL_AT_RATE: "recall at 0.1 false regions per 100 m", _RECALL_AT_K: "recall at K"},
    "objects": {_F1: "F1 of objects at IoU 0.5"},
}
_NOTHING = {_TIME: 1e-6, _BYTES: 1.0}
_COSTS = {_TIME: ("time of a pair [s], median", 1.0), _BYTES: ("kept of the before map [kB], mean", 1000.0)}
_GREY = "#8a8a8a"
_FRONT = Look(BLUE, 1.6)
_MAX_IN_LEGEND = 24
_MOST_NAMES = 8


def front(cost: Float64Array, quality: Float64Array) -> BoolArray:
    """Return (N,) which points no other dominates; equal points are both on the front, NaN is never.

    Args:
        cost: (N,) the lower the better.
        quality: (N,) the higher the better.
    """
    is_defined = ~np.isnan(cost) & ~np.isnan(quality)
    as_good = (cost[None] <= cost[:, None]) & (quality[None] >= quality[:, None])
    beats = as_good & ((cost[None] < cost[:, None]) | (quality[None] > quality[:, None]))
    return np.asarray(is_defined & ~beats.any(axis=1), dtype=np.bool_)


def pareto_table(data: RunData) -> pd.DataFrame:
    """Return every method's quality and cost over the pairs of each domain.

    Of regions the quality is recall at 0.1 false regions per 100 m where regions_table.csv is in the run folder, recall
    at K elsewhere; of objects their F1 at an IoU of 0.5.

    Returns:
        A row for each quality, cost, domain and variant: `n_pairs`, of which `n_quality` and `n_cost` have the number;
        `quality_value` with its 95 % interval `low` to `high` over tunnels; `cost_value` (seconds, bytes);
        `is_on_front`. No row where fewer than two methods have both.
    """
    results = comparable(data)
    pooled = pooled_recalls(data, results)
    found: list[pd.DataFrame] = []
    for domain in [name for name in DOMAINS if name != ALL_DOMAINS and len(results)]:
        methods = results[results["domain"] == domain].groupby("variant", sort=False)
        is_known = pooled.loc[pooled["domain"] == domain, _RECALL_AT_RATE].notna().any()
        for quality in (_RECALL_AT_RATE if is_known else _RECALL_AT_K, _F1):
            values = {name: _quality(own, quality, pooled) for name, own in methods}
            for cost in (_TIME, _BYTES):
                rows = [
                    {"quality": quality, "cost": cost, "domain": domain, "variant": name, "n_pairs": len(own),
                     **values[name], **_cost(own, cost)}
                    for name, own in methods
                ]  # fmt: skip
                found.append(_marked(pd.DataFrame(rows, columns=list(COLUMNS[:-1]))))
    return pd.DataFrame([row for table in found for row in records(table)], columns=list(COLUMNS))


def _quality(own: pd.DataFrame, quality: str, pooled: pd.DataFrame) -> dict[str, float]:
    """Return value, interval and number of pairs; recall at a rate is looked up, everything else is a mean."""
    if quality != _RECALL_AT_RATE:
        found = means_with_intervals(own, (quality,))
        n = int(np.count_nonzero(~np.isnan(numbers(own, quality))))
        values = (*(found[f"{quality}{end}"] for end in ("", "_low", "_high")), n)
    else:
        row = pooled.merge(own[["domain", "variant"]].drop_duplicates(), on=["domain", "variant"])
        value, low, high = (mean(numbers(row, f"{quality}{end}")) for end in ("", "_low", "_high"))
        values = (value, low, high, int(np.count_nonzero(numbers(own, "n_observable") > 0)))
    return dict(zip(("quality_value", "low", "high", "n_quality"), values, strict=True))


def _cost(own: pd.DataFrame, cost: str) -> dict[str, float]:
    """Return the cost over all answers of a method; NaN if one lacks it: else a method would choose where it is low."""
    values = numbers(own[own["status"] == "ok"], cost)
    n_cost = int(np.count_nonzero(~np.isnan(values)))
    value = (median if cost == _TIME else mean)(values) if n_cost == len(values) else math.nan
    return {"n_cost": n_cost, "cost_value": value}


def _marked(table: pd.DataFrame) -> pd.DataFrame:
    """Return the methods that have both numbers, with what is on the front; none where fewer than two compete."""
    table = table[table["quality_value"].notna() & table["cost_value"].notna()]
    competes = _competes(table)
    if competes.sum() < 2:
        return table[:0]
    # what finds nothing is beaten by doing nothing, at no cost
    own = table[competes & (table["quality_value"] > 0.0)]
    best = own["variant"][front(numbers(own, "cost_value"), numbers(own, "quality_value"))]
    return table.assign(is_on_front=table["variant"].isin(best))


def _competes(table: pd.DataFrame) -> BoolArray:
    """Return (N,) which methods compete: those that are not told the truth and ran as many pairs as any of them."""
    is_fair = ~table["variant"].map(is_told_the_truth).to_numpy(dtype=np.bool_)
    return np.asarray(is_fair & (table["n_pairs"] == table["n_pairs"][is_fair].max()), dtype=np.bool_)


def draw_pareto(table: pd.DataFrame, *, is_contended: bool = False) -> list[Chart]:
    """Return the charts `pareto_regions` and `pareto_objects`, of those that `pareto_table` has rows for.

    A quality that is 0 for every method is left out.

    Args:
        table: As `pareto_table` returns it.
        is_contended: Whether other work ran on the machine while times were measured: said in the caption.
    """
    found = []
    more = " Times were measured beside other work." if is_contended else ""
    for subject, names in _QUALITIES.items():
        own = table[table["quality"].isin(names)]
        if len(own) and own["quality_value"].max() > 0:
            words = names[str(own["quality"].iloc[0])]
            title = f"{words[0].upper()}{words[1:]}, against its cost"
            found.append(Chart(f"pareto_{subject}", title, _drawing(own, words), _caption(own) + more, has_png=True))
    return found


def _drawing(own: pd.DataFrame, words: str) -> Drawing:
    """Return a row of panels for each domain and a column for each cost, of the rows of one quality."""
    names = [str(name) for name in own["variant"].unique()]
    rows = []
    for domain, of_domain in own.groupby("domain", sort=False):
        row: list[Panel] = []
        for cost, (title, unit) in _COSTS.items():
            if not (own["cost"] == cost).any():
                continue
            points = of_domain[of_domain["cost"] == cost]
            # less than any program costs: like 0 it has no place on the axis, which all other methods need
            is_nothing = points["cost_value"] < _NOTHING[cost]
            x_values = (points["cost_value"] / unit).mask(is_nothing, 0.0)
            points = points.assign(x=x_values, competes=_competes(points))
            best = points[points["is_on_front"].astype(bool)].sort_values("x", kind="stable")
            n_pairs = int(points["n_pairs"].max()) if len(points) else 0
            # room for names at the left; a cost of 0 has no place on the axis
            x = Axis(title, log_span(points["x"], 4.0, 1.6), is_log=True)
            y = Axis("" if row else words, (-0.06, 1.12))
            line = Series(best["x"], best["quality_value"], _FRONT, style="steps")
            labels = _name_best(records(best), has_legend=len(names) <= _MAX_IN_LEGEND)
            named = [(point, labels.get(str(point["variant"]), "")) for point in records(points)]
            series = [line, *(_series(point, label, names, title) for point, label in named)]
            row.append(Panel(x, y, series, f"{domain_name(str(domain))}, {count_pairs(n_pairs)}"))
        rows.append(row)
    return Drawing(rows, 300)


def _name_best(best: Sequence[dict[str, Any]], *, has_legend: bool) -> dict[str, str]:
    """Return the label of each method on the front; methods at one place share that of the first."""
    places: dict[tuple[float, float], list[str]] = {}
    for point in best:
        # a name with settings is as long as the panel is wide; the legend has it
        if not (has_legend and "[" in str(point["variant"])):
            places.setdefault((point["x"], point["quality_value"]), []).append(str(point["variant"]))
    return {together[0]: _join_some(together) for together in places.values()}


def _join_some(names: Sequence[str]) -> str:
    """Return some names in a line; of a grid hundreds can be equal, and pareto.csv has all."""
    more = len(names) - _MOST_NAMES
    return f"{', '.join(names[:_MOST_NAMES])}{f' and {more} more' if more > 0 else ''}"


def _series(point: dict[str, Any], label: str, names: Sequence[str], title: str) -> Series:
    """Return one method with its label, and with a legend where that has room; without one the front is black."""
    name, is_best = str(point["variant"]), bool(point["is_on_front"])
    has_legend = len(names) <= _MAX_IN_LEGEND
    colour = look_of(name).colour if has_legend else BLACK if is_best else _GREY
    marker = look_of(name).marker if has_legend else "circle"
    interval = f"95 %: {point['low']:.3f} to {point['high']:.3f}, n {point['n_quality']}"
    return Series(
        [point["x"]], [point["quality_value"]], Look(colour, 0.0, marker=marker, is_hollow=not point["competes"]),
        name if has_legend else "", low=[point["low"]], high=[point["high"]], labels=[label],
        hover=[f"{name}: {point['quality_value']:.3f} ({interval}); {point['x']:.3g}, {title}"],
    )  # fmt: skip


def _caption(own: pd.DataFrame) -> str:
    best = own[own["is_on_front"].astype(bool)]
    told = [
        f"{words.partition(' [')[0]}, {domain_name(domain)}: {_join_some(names)}"
        for cost, (words, _) in _COSTS.items()
        for domain in best["domain"].unique()
        if (names := list(best[(best["cost"] == cost) & (best["domain"] == domain)]["variant"]))
    ]
    return (
        "Higher is better, farther left is cheaper. The line joins the methods that no other method beats in both. "
        "Bars: 95 % interval of the quality, tunnels drawn. Hollow: the method is given the truth, or ran fewer "
        f"pairs, and does not compete. On the front: {'; '.join(told)}."
    )
