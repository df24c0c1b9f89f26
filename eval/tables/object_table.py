"""What a run says about objects: a row for every method, in and out of the training distribution.

Means are over session pairs, as in summary.csv, and a pair without an answer has missed all its objects. What needs an
answered object (displacement, volume, the median over those matched) is over the changes of all pairs together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from eval.core.statistics import clustered_interval, median
from eval.plans.targets import Targets
from eval.scoring.object_sizes import PILE_KIND
from eval.tables.conditions import by_condition, told_apart
from eval.tables.groups import main_changes, objects_by_group
from eval.tables.rows import (
    by_domain,
    by_variant,
    count_failed,
    means_with_intervals,
    numbers,
    of_cases,
    texts,
    tunnels_of,
    with_domain,
)
from eval.tables.targets import judged_targets

FILES = ("objects_table", "objects_by_group", "objects_targets")
ORACLE_VARIANT = "oracle-merge+oracle-regions"
_MEANS = (
    "object_iou_point", "object_iou_voxel", "object_iou_box", "object_f1_25", "object_f1_50", "object_precision_50",
    "object_pq", "kind_accuracy", "object_iou_point_partial", "static_accuracy", "dynamic_accuracy",
    "associated_accuracy", "region_recall_proposed", "region_recall",
)  # fmt: skip
_RATES = ("false_regions_per_100m_proposed", "false_regions_per_100m")


def object_tables(
    results: pd.DataFrame, changes: pd.DataFrame, targets: Targets, *, is_whole: bool = True
) -> dict[str, pd.DataFrame]:
    """Return the tables of a run about objects, by file name.

    Args:
        results: Rows as in results.csv.
        changes: Rows as in changes.csv.
        targets: What the plan of the run asks for.
        is_whole: Whether all that was planned is in them; otherwise nothing is said to be met or not.

    Returns:
        objects_table: a row for every condition (odometry and sensor, where the plan tells them apart), domain and
        variant; objects_by_group: by kind of prop and size of hull; objects_targets: what is asked, and what is found.
    """
    rows: list[dict[str, Any]] = []
    groups: list[dict[str, Any]] = []
    changes_by_variant = by_variant(changes)
    conditions = by_condition(results, targets)
    for condition, is_its in conditions:
        for domain, cases in by_domain(with_domain(results[is_its])):
            for variant, own in cases.groupby("variant", sort=False):
                names = {"domain": domain, "variant": str(variant), **condition.columns}
                own_changes = of_cases(changes_by_variant.get(str(variant), changes[:0]), own)
                rows.append({**names, **_counts(own, own_changes), **_means(own), **_over_changes(own_changes)})
                groups += [{**names, **row} for row in objects_by_group(own_changes)]
    table = pd.DataFrame(rows)
    return {
        "objects_table": table,
        "objects_by_group": pd.DataFrame(groups),
        "objects_targets": judged_targets(targets, "objects", table, results, is_whole=is_whole),
    }


def object_overview(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of objects_table.csv that a terminal has room for, intervals beside the values."""
    names = {
        **told_apart(table),
        "domain": "domain", "variant": "variant", "n_pairs": "n", "n_failed": "failed", "n_changes": "changes",
        "object_iou_point": "iou", "iou_matched_median": "matched", "object_iou_voxel": "voxel",
        "object_f1_25": "f1@25", "object_f1_50": "f1@50", "kind_accuracy": "kind",
        "displacement_error_m": "moved_m", "n_displacements": "of",
        "pile_volume_error": "pile_vol", "n_piles": "of ", "object_iou_point_partial": "partial", "n_partial": "of  ",
        "region_recall_proposed": "recall_prop", "region_recall": "recall",
        "false_regions_per_100m_proposed": "false_prop", "false_regions_per_100m": "false",
        "t_oe_per_region_s": "t_oe/region", "t_returns_per_region_s": "of that returns",
    }  # fmt: skip
    shown = {
        heading: [_with_interval(row, name) for row in table.to_dict("records")]
        if f"{name}_low" in table
        else table[name]
        for name, heading in names.items()
    }
    return pd.DataFrame(shown)


def _with_interval(row: Mapping[Any, Any], name: str) -> str:
    value, low, high = (float(row[f"{name}{end}"]) for end in ("", "_low", "_high"))
    digits = 3 if name.endswith("_m") else 2
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}" + ("" if math.isnan(low) else f" ({low:.{digits}f}-{high:.{digits}f})")


def _counts(own: pd.DataFrame, changes: pd.DataFrame) -> dict[str, Any]:
    return {
        "n_pairs": len(own),
        "n_refused": int((own["status"] == "merge_refused").sum()),
        "n_failed": count_failed(own),
        "n_observable": int(np.nansum(numbers(own, "n_observable"))),
        "n_changes": len(main_changes(changes)),
        "n_partial": int(np.nansum(numbers(own, "n_partial"))),
        "n_matched": int((numbers(main_changes(changes), "matched_object") >= 0).sum()),
        "n_withdrawn": int(np.nansum(numbers(own, "n_withdrawn"))),
    }


def _means(own: pd.DataFrame) -> dict[str, float]:
    """Return means over pairs with their intervals, false regions over the whole way, and the median time."""
    found = means_with_intervals(own, _MEANS)
    path_m = numbers(own, "after_path_m")
    for name in _RATES:
        rate = numbers(own, name)
        is_told = ~np.isnan(rate)
        way_m = float(path_m[is_told].sum())
        found[name] = float((rate * path_m)[is_told].sum()) / way_m if way_m > 0 else math.nan
    answered = own[own["status"] == "ok"]
    per_region_s, whole_s = numbers(answered, "t_oe_per_region_s"), numbers(answered, "t_oe_s")
    found["t_oe_per_region_s"] = median(per_region_s)
    # of an answer without an object both are about 0
    with np.errstate(invalid="ignore", divide="ignore"):
        found["t_returns_per_region_s"] = median(per_region_s * numbers(answered, "t_returns_s") / whole_s)
    return found


def _over_changes(changes: pd.DataFrame) -> dict[str, float]:
    """Return medians over the matched changes of all pairs together, with intervals over pairs."""
    own = main_changes(changes)
    iou = numbers(own, "iou_point")
    piles = changes[texts(changes, "prop_kind") == PILE_KIND]
    n_displaced, displacement = _medians("displacement_error_m", numbers(changes, "displacement_error_m"), changes)
    n_piles, pile_volume = _medians("pile_volume_error", np.abs(numbers(piles, "volume_error_share")), piles)
    return {
        "iou_matched_median": median(iou[numbers(own, "matched_object") >= 0]),
        **displacement,
        "n_displacements": n_displaced,
        **pile_volume,
        "n_piles": n_piles,
    }


def _medians(name: str, values: Float64Array, changes: pd.DataFrame) -> tuple[int, dict[str, float]]:
    is_told = ~np.isnan(values)
    low, high = clustered_interval(values[is_told], tunnels_of(changes[is_told]), "median")
    return int(is_told.sum()), {name: median(values), f"{name}_low": low, f"{name}_high": high}
