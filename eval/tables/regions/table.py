"""What a run says about regions: a row for every method, in and out of the training distribution.

The unit is the session pair. A pair without an answer counts as missing all its changes, has an AUROC of 0.5, and is
never silent. `n_auroc` counts the pairs with places near a change and far from any, `n_auroc_assumed` those without any
score.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from cdpipe.core.ranking import auroc
from eval.core.statistics import interval_of, mean, median
from eval.plans.targets import Targets
from eval.tables.alarms import count_alarms
from eval.tables.conditions import by_condition, told_apart
from eval.tables.groups import recall_by_size
from eval.tables.regions.budgets import budget_rows
from eval.tables.regions.curves import (
    NEEDED,
    RATES_PER_100M,
    RankedPairs,
    free_response,
    ranked_pairs,
    recall_at,
    resampled_recalls,
    roc_curve,
)
from eval.tables.rows import (
    by_domain,
    by_variant,
    count_failed,
    means_with_intervals,
    numbers,
    of_cases,
    wilson_over_tunnels,
    with_domain,
)
from eval.tables.targets import is_unchanged_pair, judged_targets

FILES = ("regions_table", "regions_targets", "regions_by_size", "budgets", "roc", "froc")
_MEANS = (
    "region_auroc", "region_recall_at_k", "region_recall_at_k_proposed", "region_recall", "region_recall_proposed",
    "region_precision",
)  # fmt: skip
_MEDIANS = ("t_descriptor_per_keyframe_s", "t_cd_per_region_s")


def region_tables(
    results: pd.DataFrame, items: Mapping[str, pd.DataFrame], targets: Targets, *, is_whole: bool = True
) -> dict[str, pd.DataFrame]:
    """Return the tables of a run about regions, by file name.

    Args:
        results: Rows as in results.csv.
        items: `changes`, `regions` and `keyframes`, as in the files of those names.
        targets: What the plan of the run asks for.
        is_whole: Whether all that was planned is in them; otherwise nothing is said to be met or not.

    Returns:
        regions_table: a row for every condition (odometry and sensor, where the plan tells them apart), domain and
        variant; regions_targets: what is asked, and what is found; regions_by_size: recall by size, returns and range
        of the change; budgets: recall by what is looked at, sent or waited for, for each domain and kind of site; roc,
        froc: the curves.
    """
    results = with_domain(results)
    rows: list[dict[str, Any]] = []
    sizes: list[dict[str, Any]] = []
    budgets: list[dict[str, Any]] = []
    curves: dict[str, list[pd.DataFrame]] = {"roc": [], "froc": []}
    ranked: dict[tuple[str, str, bool], RankedPairs] = {}
    items_by_variant = {name: by_variant(items[name]) for name in ("regions", "changes", "keyframes")}
    conditions = by_condition(results, targets)
    of_conditions = [(each, *part) for each, is_its in conditions for part in by_domain(results[is_its])]
    for condition, domain, cases in of_conditions:
        for variant, own in cases.groupby("variant", sort=False):
            names = {"domain": domain, "variant": str(variant), **condition.columns}
            regions, changes, keyframes = (
                of_cases(part.get(str(variant), items[name][:0]), own, NEEDED)
                for name, part in items_by_variant.items()
            )
            each = ranked_pairs(own, regions, changes)
            proposed = ranked_pairs(own, regions, changes, is_proposal=True)
            if condition == conditions[0][0]:
                ranked |= {(domain, str(variant), False): each, (domain, str(variant), True): proposed}
            labelled = keyframes[keyframes["label"] >= 0]
            scores, positive = labelled["score"].to_numpy(dtype=np.float64), labelled["label"].to_numpy() == 1
            rows.append({**names, **_counts(own), "region_auroc_pooled": auroc(scores, positive), **_operating(each)})
            rows[-1] |= _proposed(proposed)
            sizes += [{**names, **row} for row in recall_by_size(each, changes)]
            budgets += [{**names, **row} for row in _budgets_by_site(own, regions, changes)]
            roc, froc = roc_curve(scores, positive), free_response(each)
            curves["roc"].append(_curve(names, roc, ("false_positive_rate", "true_positive_rate")))
            curves["froc"].append(_curve(names, froc, ("false_regions_per_100m", "recall")))
    table = pd.DataFrame(rows)
    return {
        "regions_table": table,
        "regions_targets": judged_targets(targets, "regions", table, results, ranked, is_whole=is_whole),
        "regions_by_size": pd.DataFrame(sizes),
        "budgets": pd.DataFrame(budgets),
        **{name: pd.concat(parts, ignore_index=True) for name, parts in curves.items()},
    }


def region_overview(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of regions_table.csv that a terminal has room for."""
    names = {
        **told_apart(table),
        "domain": "domain", "variant": "variant", "n_pairs": "n", "n_failed": "failed", "region_auroc": "auroc",
        "region_auroc_low": "low", "region_auroc_high": "high", "region_auroc_pooled": "pooled",
        "region_recall_at_k": "recall_at_k", "region_recall": "recall", "region_precision": "precision",
        "false_regions_per_100m": "false/100m", "recall_at_0.1": "recall@0.1", "recall_at_0.1_low": "low ",
        "recall_at_0.1_high": "high ", "silent_share": "silent", "n_unchanged": "of", "km_unchanged": "km",
        "bytes_ratio": "bytes 1/", "t_descriptor_per_keyframe_s": "t_desc/kf", "t_cd_per_region_s": "t_cd/region",
    }  # fmt: skip
    return table[list(names)].rename(columns=names)


def _budgets_by_site(own: pd.DataFrame, regions: pd.DataFrame, changes: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the budgets of a variant at all sites together, and at each kind of site: families of one last name."""
    kinds = own["family"].astype(str).str.rpartition("/")[2] if "family" in own else own["scenario"].astype(str)
    parts = [("all", own)] + [(str(kind), part) for kind, part in own.groupby(kinds, sort=False)]
    rows = []
    for site, part in parts:
        its = of_cases(regions, part, NEEDED), of_cases(changes, part, NEEDED)
        proposed = ranked_pairs(part, *its, is_proposal=True)
        rows += [{"site": site, **row} for row in budget_rows(proposed, part, its[0])]
    return rows


def _curve(names: Mapping[str, str], points: tuple[Any, Any], columns: tuple[str, str]) -> pd.DataFrame:
    return pd.DataFrame(
        {**{key: [value] * len(points[0]) for key, value in names.items()}, **dict(zip(columns, points, strict=True))}
    )


def _counts(own: pd.DataFrame) -> dict[str, Any]:
    answered = own[own["status"] == "ok"]
    path_m, n_false = numbers(answered, "after_path_m").sum(), numbers(answered, "n_false_regions").sum()
    unchanged = own[is_unchanged_pair(own)]
    is_silent, is_answered = count_alarms(unchanged) == 0, ~np.isnan(numbers(unchanged, "is_alarm"))
    n_silent, n_unchanged = int(is_silent.sum()), len(unchanged)
    unchanged_m = numbers(unchanged, "after_path_m")[is_answered].sum()
    n_false_unchanged = np.nansum(numbers(unchanged, "n_false_regions")[is_answered])
    map_bytes, kept_bytes = numbers(answered, "bytes_map_before"), numbers(answered, "bytes_regions_before")
    return {
        "n_pairs": len(own),
        "n_refused": int((own["status"] == "merge_refused").sum()),
        "n_failed": count_failed(own),
        "n_auroc": int(np.count_nonzero(~np.isnan(numbers(own, "region_auroc")))),
        "n_auroc_assumed": int(np.nansum(numbers(own, "is_auroc_assumed"))),
        "n_changed": int(np.count_nonzero(numbers(own, "n_observable") > 0)),
        "n_observable": int(np.nansum(numbers(own, "n_observable"))),
        "n_found": int(np.nansum(numbers(own, "n_found_changes"))),
        **means_with_intervals(own, _MEANS),
        "km": path_m / 1000.0,
        "false_regions_per_100m": 100.0 * n_false / path_m if path_m > 0 else math.nan,
        "n_unchanged": n_unchanged,
        "n_silent": n_silent,
        "silent_share": n_silent / n_unchanged if n_unchanged else math.nan,
        **dict(zip(("silent_low", "silent_high"), wilson_over_tunnels(is_silent, unchanged), strict=True)),
        "km_unchanged": unchanged_m / 1000.0,
        "false_regions_per_100m_unchanged": 100.0 * n_false_unchanged / unchanged_m if unchanged_m > 0 else math.nan,
        "bytes_map_before": _mean_of_all(map_bytes),
        "bytes_regions_before": _mean_of_all(kept_bytes),
        "bytes_ratio": _mean_of_all(map_bytes / np.where(kept_bytes >= 1, kept_bytes, math.nan)),
        **{name: median(numbers(answered, name)) for name in _MEDIANS},
    }


def _mean_of_all(values: Float64Array) -> float:
    """Return the mean over all answers; NaN if one lacks the number: else a method would choose where it is good."""
    return math.nan if np.isnan(values).any() else mean(values)


def _operating(ranked: RankedPairs) -> dict[str, float]:
    """Return recall at each false-alarm rate with its interval."""
    found: dict[str, float] = {}
    is_enough = ranked.has_interval
    for rate in RATES_PER_100M:
        low, high = interval_of(resampled_recalls(ranked, rate)) if is_enough else (math.nan, math.nan)
        name = f"recall_at_{rate:g}"
        found |= {name: recall_at(ranked, rate), f"{name}_low": low, f"{name}_high": high}
    return found


def _proposed(ranked: RankedPairs) -> dict[str, float]:
    """Return recall at each false-alarm rate as if no candidate had been withdrawn."""
    return {f"recall_at_{rate:g}_proposed": recall_at(ranked, rate) for rate in RATES_PER_100M}
