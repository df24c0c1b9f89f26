"""Quality against what it costs: which methods no other beats in both.

Cost is the median time of a pair, or the mean of the bytes kept of the before session. A method is on the front where
no other is as cheap and as good, and cheaper or better. Only methods that ran the same number of pairs and find
anything compete, and none that is told the truth does.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Float64Array
from eval.core.statistics import mean_with_interval
from eval.running.run_data import RunData, comparable, stored_table
from eval.tables.rows import ALL_DOMAINS, DOMAINS, is_told_the_truth, numbers

RECALL_AT_RATE, RECALL_AT_K, F1 = "recall_at_0.1", "region_recall_at_k", "object_f1_50"
TIME, BYTES = "t_total_s", "bytes_regions_before"
COLUMNS = (
    "quality", "cost", "domain", "variant", "n_pairs", "n_quality", "quality_value", "low", "high", "n_cost",
    "cost_value", "is_on_front",
)  # fmt: skip


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
        `quality_value` with its 95 % interval `low` to `high` over session pairs; `cost_value` (seconds, bytes);
        `is_on_front`. No row where fewer than two methods have both.
    """
    results = comparable(data)
    stored = stored_table(data, "regions_table")
    found: list[dict[str, Any]] = []
    for domain in [name for name in DOMAINS if name != ALL_DOMAINS]:
        cases = results[results["domain"] == domain] if len(results) else results
        methods = {str(name): own for name, own in cases.groupby("variant", sort=False)} if len(cases) else {}
        regions = RECALL_AT_RATE if len(stored) else RECALL_AT_K
        for quality in (regions, F1):
            values = {name: _quality(own, quality, stored, domain, name) for name, own in methods.items()}
            for cost in (TIME, BYTES):
                names = {"quality": quality, "cost": cost, "domain": domain}
                rows: list[dict[str, Any]] = [
                    {**names, "variant": name, "n_pairs": len(own), **values[name], **_cost(own, cost)}
                    for name, own in methods.items()
                ]
                found += _marked([row for row in rows if not math.isnan(row["quality_value"] + row["cost_value"])])
    return pd.DataFrame(found, columns=list(COLUMNS))


def _quality(own: pd.DataFrame, quality: str, stored: pd.DataFrame, domain: str, variant: str) -> dict[str, float]:
    """Return value, interval and number of pairs; recall at a rate is looked up, everything else is a mean."""
    if quality != RECALL_AT_RATE:
        values = mean_with_interval(numbers(own, quality))
    else:
        row = stored[(stored["domain"] == domain) & (stored["variant"] == variant)]
        told = numbers(row, quality), numbers(row, f"{quality}_low"), numbers(row, f"{quality}_high")
        value, low, high = (float(each[0]) if len(each) else math.nan for each in told)
        values = (value, low, high, int(np.count_nonzero(numbers(own, "n_observable") > 0)))
    return dict(zip(("quality_value", "low", "high", "n_quality"), values, strict=True))


def _cost(own: pd.DataFrame, cost: str) -> dict[str, float]:
    values = numbers(own[own["status"] == "ok"], cost)
    values = values[~np.isnan(values)]
    value = (np.median(values) if cost == TIME else values.mean()) if len(values) else math.nan
    return {"n_cost": len(values), "cost_value": float(value)}


def _marked(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mark what is on the front, among fair methods with as many pairs as any."""
    fair = [row for row in rows if not is_told_the_truth(row["variant"])]
    most = max((row["n_pairs"] for row in fair), default=0)
    fair = [row for row in fair if row["n_pairs"] == most]
    if len(fair) < 2:
        return []
    cost, quality = (
        np.array([row[name] for row in fair], dtype=np.float64) for name in ("cost_value", "quality_value")
    )
    # what finds nothing is beaten by doing nothing, at no cost
    is_best = front(cost, quality) & (quality > 0.0)
    best = {row["variant"] for row, is_on_front in zip(fair, is_best, strict=True) if is_on_front}
    return [{**row, "is_on_front": row["variant"] in best} for row in rows]
