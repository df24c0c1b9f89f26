"""What a run says about rock that moved: a row for every method, and its detection limits.

Means are over session pairs. A pair without an answer, or whose answer has no displacement field, counts as a field
without a point.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray
from eval.core.statistics import median
from eval.plans.targets import Targets
from eval.scoring.surface.metrics import SURFACE_GROUP
from eval.scoring.surface.windows import AREAS_M2
from eval.tables.conditions import by_condition
from eval.tables.rows import by_domain, by_variant, means_with_intervals, numbers, of_cases, texts, with_domain
from eval.tables.surface.limits import detection_limits
from eval.tables.targets import judged_targets

FILES = ("surface_table", "surface_targets", "detection_limits")
MEANS = (
    "surface_cover", "surface_error_median_m", "surface_error_p95_m",
    "surface_error_median_changed_m", "surface_error_p95_changed_m", "surface_bias_changed_m",
    "surface_error_median_unchanged_m", "surface_error_p95_unchanged_m", "surface_bias_unchanged_m",
    "surface_level_inside", "surface_level_median_m", "surface_recall", "surface_region_precision",
    "surface_false_regions_per_100m", "surface_volume_error_share",
)  # fmt: skip


def surface_tables(
    results: pd.DataFrame, windows: pd.DataFrame, targets: Targets, *, is_whole: bool = True
) -> dict[str, pd.DataFrame]:
    """Return the tables of a run about rock that moved, by file name; empty ones where no pair asks for it.

    Args:
        results: Rows as in results.csv. Where a pair asks for a displacement field, those that ask for none are left
            out: an answer might give a field at the easy ones alone.
        windows: Rows as in surface_windows.csv.
        targets: What the plan of the run asks for.
        is_whole: Whether all that was planned is in the tables; otherwise no target is said to be met or missed.

    Returns:
        surface_table: a row for every condition (odometry and sensor, where the plan tells them apart), domain and
        variant, with the detection limit of each area of windows; surface_targets: what is asked, and what is found;
        detection_limits: a row for each of them, area and bin of magnitudes.
    """
    rows: list[dict[str, Any]] = []
    limits: list[dict[str, Any]] = []
    is_asked = _mark_asked(results)
    windows_by_variant = by_variant(windows)
    for condition, is_its in by_condition(results, targets):
        own_results = results[is_its & is_asked]
        if len(own_results) == 0:
            continue
        for domain, cases in by_domain(with_domain(own_results)):
            for variant, own in cases.groupby("variant", sort=False):
                names = {"domain": domain, "variant": str(variant), **condition.columns}
                own_windows = of_cases(windows_by_variant.get(str(variant), windows[:0]), own)
                of_windows = detection_limits(own_windows) if len(own_windows) else []
                limits += [{**names, **row} for row in of_windows]
                by_area = {row["area_m2"]: row["limit_m"] for row in of_windows}
                rows.append(
                    {
                        **names,
                        "n_pairs": len(own),
                        "n_failed": int((own["status"] != "ok").sum()),
                        "n_surface_changes": int(np.nansum(numbers(own, "n_surface_changes"))),
                        **means_with_intervals(own, MEANS),
                        **{limit_column(area): by_area.get(area, float("nan")) for area in AREAS_M2},
                        "t_surface_s": median(numbers(own, "t_surface_s")),
                    }
                )
    table = pd.DataFrame(rows)
    judged = judged_targets(targets, "surface", table, results, is_whole=is_whole) if rows else pd.DataFrame()
    return {"surface_table": table, "surface_targets": judged, "detection_limits": pd.DataFrame(limits)}


def _mark_asked(results: pd.DataFrame) -> BoolArray:
    """Mark the rows with scores of a field on pairs that ask for one; where no pair asks, all rows with such scores."""
    is_scored = ~np.isnan(numbers(results, "surface_cover"))
    is_surface = np.array([name.partition("/")[0] == SURFACE_GROUP for name in texts(results, "family")], np.bool_)
    is_asked = is_scored & (is_surface | ~np.isnan(numbers(results, "n_surface_changes")))
    return is_asked if is_asked.any() else is_scored


def limit_column(area_m2: float) -> str:
    """Return the column of surface_table.csv with the detection limit of windows of an area."""
    return f"surface_limit_{area_m2:g}m2_m"
