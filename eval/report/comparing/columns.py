"""The figures that two runs, or two methods, are compared by: where each comes from, and which direction is better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from eval.report.pooled import POOLED
from eval.tables.alarms import count_alarms, may_be_refused
from eval.tables.columns import RESULT_COLUMNS, Column, select, share, significant
from eval.tables.merge_table import RULES, is_within_target, kinds
from eval.tables.rows import numbers, with_domain, without_costs_of_failures

_P95 = replace(*select(RESULT_COLUMNS, "merge_error_m"), key="merge_error_m_p95",
               heading="merge error, 95th percentile [m]")  # fmt: skip
COMPARED = (
    Column("is_answered", "answered", "high", share,
           "Share of the pairs with an answer, where refusing the merge is never right."),
    Column("is_within_target", "merge within target", "high", share,
           "Share of the pairs whose merge does what their kind asks."),
    *select(RESULT_COLUMNS, "region_recall", "region_precision", "region_recall_at_k"),
    Column(POOLED, "recall at 0.1 false / 100 m", "high", share,
           "Changes of all pairs together found at the lowest threshold with at most 0.1 false regions per 100 m, set "
           "anew in every draw of pairs.", "Undefined without regions.csv and changes.csv."),
    *select(RESULT_COLUMNS, "region_auroc", "false_regions_per_100m"),
    Column("is_alarm", "alarm or no answer where nothing changed", "low", share,
           "Share of the unchanged pairs with a reported region or object, or without an answer where refusing is "
           "never right."),
    *select(RESULT_COLUMNS, "object_iou_point"),
    Column("object_iou_voxel", "object voxel IoU", "high", share, "The same with 0.1 m voxels, mean over 8 grids."),
    *select(RESULT_COLUMNS, "object_f1_50", "kind_accuracy", "merge_error_m", "merge_error_deg"),
    _P95,
    *select(RESULT_COLUMNS, "t_total_s"),
    Column("t_total_with_merge_s", "time with merge [s]", "low", significant,
           "The same and indexing, merge, refinement."),
    Column("bytes_regions_before", "kept of the before map [kB]", "low", lambda size: significant(size / 1000.0),
           "What a method keeps of the before session to find regions."),
)  # fmt: skip


def figures_of(results: pd.DataFrame) -> pd.DataFrame:
    """Return the compared figures of every row of results.csv, without the pooled one.

    Args:
        results: Rows as in results.csv.

    Returns:
        The same rows with `scenario`, `seed`, `variant`, `domain` and a number for each compared column that is there.
    """
    kind = kinds(results)
    answered = np.where(may_be_refused(results), np.nan, (results["status"] == "ok").to_numpy(dtype=np.float64))
    within = np.where(np.isin(kind, list(RULES)), is_within_target(results).astype(np.float64), np.nan)
    columns = {
        "scenario": results["scenario"].astype(str).to_numpy(),
        "seed": results["seed"].to_numpy().astype(np.int64),
        "variant": results["variant"].astype(str).to_numpy(),
        "domain": with_domain(results)["domain"].to_numpy(),
        "is_answered": answered,
        "is_within_target": within,
    }
    results = without_costs_of_failures(results)
    stored = [column.key for column in COMPARED if column.key not in (*columns, POOLED) and column.key in results]
    figures = {**columns, **{key: _as_numbers(results, key) for key in stored}}
    if "is_alarm" in stored:
        figures["is_alarm"] = count_alarms(results)
    return pd.DataFrame(figures)


def is_time(key: str) -> bool:
    """Tell whether a column is a time, which says as much about the machine as about the method."""
    return key.startswith("t_")


def _as_numbers(results: pd.DataFrame, key: str) -> Float64Array:
    """Return a column as numbers; truth values that a table held beside empty cells are read back as texts."""
    words = {"true": 1.0, "false": 0.0}
    return numbers(results.assign(**{key: results[key].map(lambda value: words.get(str(value).lower(), value))}), key)
