"""Changes by what they are and how large: recall, IoU, volume and displacement of each kind of prop and size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Int64Array
from eval.core.statistics import clustered_interval, mean, median
from eval.tables.conditions import told_apart
from eval.tables.regions.curves import RankedPairs, found_at
from eval.tables.rows import PAIR, numbers, texts, tunnels_of

RATE_PER_100M = 0.1
EDGES: Mapping[str, tuple[float, ...]] = {
    "hull_volume_m3": (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, np.inf),
    "n_returns": (0.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0, np.inf),
    "range_m": (0.0, 1.0, 1.5, 2.0, 3.0, 5.0, np.inf),
}
_HIT_IOU = 0.5
_MEASURE = "hull_volume_m3"


def main_changes(changes: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of changes.csv that the main object columns are over: observable, of the group `full`."""
    is_main = ~np.isnan(numbers(changes, "iou_point")) & (texts(changes, "group") == "full")
    return pd.DataFrame(changes[is_main])


def pair_numbers(items: pd.DataFrame) -> Int64Array:
    """Return (N,) a number for the session pair of each row."""
    return np.asarray(items.groupby(list(PAIR), sort=False).ngroup(), dtype=np.int64)


def objects_by_group(changes: pd.DataFrame) -> list[dict[str, Any]]:
    """Return a row for every kind of prop and every size of hull that one variant's main changes hold.

    Args:
        changes: Rows of changes.csv of one variant.

    Returns:
        `measure` (prop_kind or hull_volume_m3), `value` (the kind), `low` and `high` of the bin (low included),
        `n_changes`, `n_pairs`; `iou_point`, missed ones 0, with its 95 % bootstrap interval over tunnels;
        `iou_matched_median`; `share_50`, with an IoU of at least 0.5; `share_found`, with a region that finds them;
        `kind_accuracy`, `displacement_error_m` and `volume_error` (medians; absolute share) over those matched.
    """
    own = main_changes(changes)
    pair, tunnels = pair_numbers(own), tunnels_of(own)
    rows = []
    for names, inside in _groups(own):
        part, of_pair = own[inside], pair[inside]
        iou = numbers(part, "iou_point")
        low, high = clustered_interval(iou, tunnels[inside])
        rows.append(
            {
                **names,
                "n_changes": len(part),
                "n_pairs": len(np.unique(of_pair)),
                "iou_point": float(iou.mean()),
                "iou_point_low": low,
                "iou_point_high": high,
                "iou_matched_median": median(iou[numbers(part, "matched_object") >= 0]),
                "share_50": float(np.mean(iou >= _HIT_IOU)),
                "share_found": float(part["is_found"].astype(bool).mean()),
                "kind_accuracy": mean(numbers(part, "is_kind_right")),
                "displacement_error_m": median(numbers(part, "displacement_error_m")),
                "volume_error": median(np.abs(numbers(part, "volume_error_share"))),
            }
        )
    return rows


def recall_by_size(ranked: RankedPairs, changes: pd.DataFrame) -> list[dict[str, Any]]:
    """Return a row for every measure and bin that holds a change.

    Args:
        ranked: One variant's candidates and changes.
        changes: The table that `ranked.change_rows` index.

    Returns:
        `measure`, `low` and `high` of the bin (low included), `n_changes`, `n_pairs`, and three recalls: `recall_at_k`
        over the K best candidates of each pair, `recall_reported` at the method's own threshold, `recall_at_rate` at
        0.1 false regions per 100 m with its 95 % interval over tunnels, the threshold held fixed, `interval_low` to
        `interval_high`.
    """
    own = changes.iloc[ranked.change_rows]
    found = {
        "recall_at_k": np.isfinite(ranked.change_score)
        & (ranked.change_rank < ranked.n_observable[ranked.change_pair]),
        "recall_reported": own["is_found"].astype(bool).to_numpy(),
        "recall_at_rate": found_at(ranked, RATE_PER_100M),
    }
    rows: list[dict[str, Any]] = []
    for measure in EDGES:
        for low, high, inside in _bins(own, measure):
            of_pair = ranked.change_pair[inside]
            hits = found["recall_at_rate"][inside].astype(np.float64)
            interval = clustered_interval(hits, ranked.tunnels[of_pair])
            rows.append(
                {
                    "measure": measure,
                    "low": low,
                    "high": high,
                    "n_changes": int(inside.sum()),
                    "n_pairs": len(np.unique(of_pair)),
                    **{name: float(is_hit[inside].mean()) for name, is_hit in found.items()},
                    "interval_low": interval[0],
                    "interval_high": interval[1],
                }
            )
    return rows


def group_overview(groups: pd.DataFrame, variant: str) -> pd.DataFrame:
    """Return the columns of objects_by_group.csv that a terminal has room for, of one variant."""
    names = {
        **told_apart(groups),
        "domain": "domain", "object": "object", "n_changes": "n", "n_pairs": "pairs", "iou_point": "iou",
        "iou_point_low": "low", "iou_point_high": "high", "iou_matched_median": "matched", "share_50": "iou>=0.5",
        "share_found": "found", "kind_accuracy": "kind", "displacement_error_m": "moved_m", "volume_error": "volume",
    }  # fmt: skip
    own = groups[groups["variant"] == variant]
    objects = [
        str(row.value) if row.measure == "prop_kind" else f"{row.low:g} to {row.high:g} m3"
        for row in own[["measure", "value", "low", "high"]].itertuples(index=False)
    ]
    return pd.DataFrame(own.assign(object=objects)[list(names)].rename(columns=names))


def _groups(changes: pd.DataFrame) -> Iterator[tuple[dict[str, Any], BoolArray]]:
    """Yield the name of each group that holds a change, and (N,) which it holds."""
    kinds = texts(changes, "prop_kind")
    for kind in sorted(set(kinds)):
        yield {"measure": "prop_kind", "value": kind, "low": np.nan, "high": np.nan}, np.asarray(kinds == kind)
    for low, high, inside in _bins(changes, _MEASURE):
        yield {"measure": _MEASURE, "value": "", "low": low, "high": high}, inside


def _bins(changes: pd.DataFrame, measure: str) -> Iterator[tuple[float, float, BoolArray]]:
    """Yield the ends of each bin of a measure that holds a change (low included), and (N,) which it holds."""
    values = numbers(changes, measure)
    for low, high in pairwise(EDGES[measure]):
        inside = (values >= low) & (values < high)
        if inside.any():
            yield low, high, inside
