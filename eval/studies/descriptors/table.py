"""The rows of `eval.studies.descriptors.compare` as tables: means over session pairs, with 95 % intervals by pair.

Each table has a group of rows for each family, and one for the families in and one for those out of distribution.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from eval.core.domains import domain_of
from eval.core.statistics import bootstrap_interval, mean_with_interval
from eval.studies.descriptors.rows import SPHERE

_PAIR = ["family", "seed"]


def places_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return what each descriptor of scans recognises, by group.

    Returns:
        `place_recall_at_1` and `yaw_flip_share`, means over pairs, and `yaw_error_deg`, the median over pairs of each
        pair's median, all with `_low` and `_high`; `n_pairs`, `n_places` that were asked for; `bytes_per_keyframe`,
        the pose included; `ms_per_keyframe`, the median over pairs.
    """
    table = []
    for group, own in _groups(rows[rows["descriptor"] != SPHERE]):
        for (descriptor, precision), cases in own.groupby(["descriptor", "precision"], sort=False):
            yaws_deg = _numbers(cases, "yaw_error_deg")
            low, high = bootstrap_interval(yaws_deg, "median")
            table.append(
                {
                    "group": group,
                    "descriptor": descriptor,
                    "precision": precision,
                    **_mean(cases, "place_recall_at_1"),
                    "yaw_error_deg": float(np.nanmedian(yaws_deg)) if not np.isnan(yaws_deg).all() else float("nan"),
                    "yaw_error_deg_low": low,
                    "yaw_error_deg_high": high,
                    **_mean(cases, "yaw_flip_share"),
                    "n_pairs": len(cases),
                    "n_places": int(cases["n_places"].sum()),
                    **_price(cases),
                }
            )
    return pd.DataFrame(table)


def spheres_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return what `sphere` finds in each precision, by group.

    Returns:
        `region_auroc`, mean over the pairs that have one (`n_used` of `n_pairs`), with `_low` and `_high`;
        `auroc_loss` against float32, mean over the same pairs, with `_low` and `_high`, and the largest of any pair;
        `n_refused` pairs whose merge was; `map_over_kept`, the bytes of the thinned before map over those kept of it,
        median over pairs, and `map_over_kept_least`; price as in `places_table`.
    """
    table = []
    for group, own in _groups(rows[rows["descriptor"] == SPHERE]):
        exact = own[own["precision"] == "float32"].set_index(_PAIR)["region_auroc"]
        for precision, cases in own.groupby("precision", sort=False):
            loss = exact - cases.set_index(_PAIR)["region_auroc"]
            ratio = _numbers(cases, "map_bytes_per_keyframe") / _numbers(cases, "bytes_per_keyframe")
            table.append(
                {
                    "group": group,
                    "precision": precision,
                    **_mean(cases, "region_auroc"),
                    **_mean(loss.to_frame("auroc_loss"), "auroc_loss"),
                    "auroc_loss_most": float(loss.max()),
                    "n_pairs": len(cases),
                    "n_used": int(cases["region_auroc"].notna().sum()),
                    "n_refused": int((cases["status"] != "ok").sum()),
                    "map_over_kept": float(np.median(ratio)),
                    "map_over_kept_least": float(ratio.min()),
                    **_price(cases),
                }
            )
    return pd.DataFrame(table)


def _groups(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    for family, own in rows.groupby("family", sort=False):
        yield str(family), own
    domains = rows["family"].map(domain_of)
    for domain in ("in", "out"):
        own = rows[domains == domain]
        if own["family"].nunique() > 1:
            yield f"all {domain} of distribution" if domain == "out" else "all in distribution", own


def _mean(cases: pd.DataFrame, column: str) -> dict[str, float]:
    value, low, high, _ = mean_with_interval(_numbers(cases, column))
    return {column: value, f"{column}_low": low, f"{column}_high": high}


def _price(cases: pd.DataFrame) -> dict[str, Any]:
    return {
        "bytes_per_keyframe": int(cases["bytes_per_keyframe"].iloc[0]),
        "ms_per_keyframe": float(np.median(_numbers(cases, "ms_per_keyframe"))),
    }


def _numbers(cases: pd.DataFrame, column: str) -> Float64Array:
    return cases[column].to_numpy(dtype=np.float64)
