"""What a plan asks of regions, objects and rock that moved, and what its run found.

One table each: regions_targets.csv, objects_targets.csv and surface_targets.csv.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pandas as pd

from eval.core.statistics import interval_over_tunnels, mean_with_interval, median
from eval.plans.targets import PROPOSED, RATE_COLUMN, Target, Targets
from eval.tables.conditions import ANY, by_condition, odometry_of, of_condition
from eval.tables.regions.curves import RankedPairs, recall_difference
from eval.tables.rows import numbers, records, texts, tunnel_numbers, tunnels_of

COLUMNS = ("target", "domain", "variant", "value", "low", "high", "asked", "n", "is_met")
# what a column is over, where that is not every pair of its row
_COUNTS = {
    "region_auroc": "n_auroc", "region_recall_at_k": "n_changed", "silent_share": "n_unchanged",
    "false_regions_per_100m_unchanged": "n_unchanged", "displacement_error_m": "n_displacements",
    "pile_volume_error": "n_piles", "object_iou_point_partial": "n_partial",
}  # fmt: skip
# what an answer gains by leaving rock out: nothing is met where fewer of the judged places than these are measured
_MEASURED = ("surface_error_", "surface_level_")
_LEAST_COVER = 0.5
_LIMIT = "surface_limit_"
_ENDS = {"silent_share": ("silent_low", "silent_high")}


def judged_targets(
    targets: Targets,
    subject: Literal["regions", "objects", "surface"],
    table: pd.DataFrame,
    results: pd.DataFrame,
    ranked: Mapping[tuple[str, str, bool], RankedPairs] | None = None,
    *,
    is_whole: bool = True,
) -> pd.DataFrame:
    """Return what is asked and whether it is met; no row for a figure that is undefined.

    A detection limit is undefined where half of the largest changes are not found: the target is missed. An error or a
    level of the rock is no merit of an answer that measures less than half of it.

    Args:
        targets: What the plan asks for.
        subject: Of which part of it.
        table: regions_table, objects_table or surface_table.
        results: Rows as in results.csv; judged are those of the odometry and the sensor that the plan's figures are of,
            but for a target that names another odometry.
        ranked: Candidates and changes of each domain and variant, for targets against a rival; as reported (False), and
            as proposed (True).
        is_whole: Whether all that was planned is in the tables; otherwise nothing is said to be met or not.

    Returns:
        `target`, its name; `domain` (or site, or sensor), `variant`, `value` with `low` and `high` where there is an
        interval, `asked` ("at least 0.97"), `n` pairs (changes, where the figure is a median over changes), and
        `is_met`: None where no verdict is passed.
    """
    rows = []
    main, is_its = by_condition(results, targets)[0]
    own = results[is_its]
    for target in getattr(targets, subject):
        variant = target.method or targets.method
        figures = of_condition(table, replace(main, odometry=target.odometry or main.odometry))
        found: dict[str, Any] | None
        if target.site:
            found = _on_site(target, variant, own)
        elif target.sensor:
            found = _with_sensor(target, variant, results, main.odometry)
        elif target.less and target.column.startswith(RATE_COLUMN):
            found = _against(target, variant, ranked or {})
        elif target.less:
            found = _less_rival(target, variant, figures)
        else:
            found = _of_table(target, variant, figures)
        if found is None:
            continue
        is_long, is_missed = found.pop("km", math.inf) >= target.least_km, found.pop("is_missed", False)
        if is_missed or not math.isnan(found["value"]):
            verdict = target.is_met_by(found["value"]) and not is_missed if is_whole and is_long else None
            rows.append({"target": target.name, "variant": variant, "asked": target.asked, **found, "is_met": verdict})
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype({"is_met": object})


def _of_table(target: Target, variant: str, table: pd.DataFrame) -> dict[str, Any] | None:
    """Return the figure of a row of the table; the last row of a variant is that over all of its pairs."""
    own = table[table["variant"] == variant]
    rows = records(own if target.domain is None else own[own["domain"] == target.domain])
    if not rows or target.column not in rows[-1]:
        return None
    row = rows[-1]
    low, high = _ENDS.get(target.column, (f"{target.column}_low", f"{target.column}_high"))
    return {
        "domain": str(row["domain"]), "value": float(row[target.column]), "low": float(row.get(low, math.nan)),
        "high": float(row.get(high, math.nan)), "n": int(row[_COUNTS.get(target.column, "n_pairs")]),
        "km": float(row.get("km_unchanged", math.inf)), "is_missed": _is_missed(target.column, row),
    }  # fmt: skip


def _is_missed(column: str, row: Mapping[str, Any]) -> bool:
    """Tell whether a figure of surface_table.csv meets no bound, whatever its value."""
    if column.startswith(_LIMIT) and math.isnan(row[column]):
        return bool(row["n_surface_changes"] > 0)
    if not column.startswith(_MEASURED):
        return False
    # a field of zeros has small errors; it finds none of what moved
    limits = [value for name, value in row.items() if str(name).startswith(_LIMIT)]
    is_blind = row.get("n_surface_changes", 0) > 0 and bool(limits) and all(math.isnan(value) for value in limits)
    return bool(is_blind or row.get("surface_cover", math.nan) < _LEAST_COVER)


def _against(
    target: Target, variant: str, ranked: Mapping[tuple[str, str, bool], RankedPairs]
) -> dict[str, Any] | None:
    """Return the recall of a variant at a rate of false regions less that of a rival, with its paired interval."""
    is_proposal = target.column.endswith(PROPOSED)
    ours, theirs = (ranked.get((str(target.domain), name, is_proposal)) for name in (variant, target.less))
    if ours is None or theirs is None:
        return None
    rate = float(target.column.removeprefix(RATE_COLUMN).removesuffix(PROPOSED))
    difference, low, high = recall_difference(theirs, ours, rate)
    return {"domain": target.domain, "value": difference, "low": low, "high": high, "n": len(ours.pairs)}


def _less_rival(target: Target, variant: str, table: pd.DataFrame) -> dict[str, Any] | None:
    """Return the figure of a row of the table less that of a rival; they share pairs, so no interval stands for it."""
    ours, theirs = (_of_table(target, name, table) for name in (variant, target.less))
    if ours is None or theirs is None:
        return None
    # who misses whatever its value is behind: a limit that is undefined, errors of a field that measures nothing
    theirs_value = math.inf if theirs["is_missed"] else theirs["value"]
    return {**ours, "value": ours["value"] - theirs_value, "low": math.nan, "high": math.nan}


def _on_site(target: Target, variant: str, results: pd.DataFrame) -> dict[str, Any]:
    """Return the mean over the changed pairs of a site with its interval; of a time the median, without one."""
    is_there = np.array([family.rpartition("/")[2] == target.site for family in texts(results, "family")], np.bool_)
    own = results[is_there & (results["variant"] == variant).to_numpy() & ~is_unchanged_pair(results)]
    if target.column == "bytes_ratio":
        values = numbers(own, "bytes_map_before") / numbers(own, "bytes_regions_before")
    else:
        values = numbers(own, target.column)
    value, _, _, n = mean_with_interval(values)
    low, high = interval_over_tunnels(values, tunnels_of(own))
    if target.column.startswith("t_"):
        value, low, high = median(values), math.nan, math.nan
    return {"domain": target.site, "value": value, "low": low, "high": high, "n": n}


def _with_sensor(target: Target, variant: str, results: pd.DataFrame, odometry: str) -> dict[str, Any]:
    """Return the mean over the pairs with a sensor, less that of another sensor over the same pairs where asked."""
    is_its = (odometry_of(results) == odometry) | (odometry == ANY)
    own = results[is_its & (results["variant"] == variant).to_numpy()]

    def of_pairs(sensor: str) -> pd.Series[float]:
        rows = own[texts(own, "sensor_profile") == sensor]
        pairs = pd.MultiIndex.from_arrays([texts(rows, "family"), numbers(rows, "seed")])
        return pd.Series(numbers(rows, target.column), index=pairs).groupby(level=[0, 1]).mean()

    values = of_pairs(target.sensor)
    if target.less_sensor:
        values = (values - of_pairs(target.less_sensor)).dropna()
    figures = np.asarray(values, dtype=np.float64)
    value, _, _, n = mean_with_interval(figures)
    tunnels = tunnel_numbers(values.index.get_level_values(0), values.index.get_level_values(1))
    low, high = interval_over_tunnels(figures, tunnels)
    return {"domain": target.sensor, "value": value, "low": low, "high": high, "n": n}


def is_unchanged_pair(results: pd.DataFrame) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return (N,) whether nothing changed in each pair of results.csv."""
    return results["is_unchanged_pair"].astype("boolean").fillna(value=False).to_numpy(dtype=bool)
