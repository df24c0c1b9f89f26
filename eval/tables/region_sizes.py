"""Recall by what a change is like: volume of its hull, returns it sent, range it was seen from."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import BoolArray, Float64Array, stream
from eval.core.statistics import N_RESAMPLES
from eval.tables.region_curves import RankedPairs, found_at, interval_of

RATE_PER_100M = 0.1
EDGES: Mapping[str, tuple[float, ...]] = {
    "hull_volume_m3": (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, np.inf),
    "n_returns": (0.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0, np.inf),
    "range_m": (0.0, 1.0, 1.5, 2.0, 3.0, 5.0, np.inf),
}


def recall_by_size(ranked: RankedPairs, changes: pd.DataFrame) -> list[dict[str, Any]]:
    """Return a row for every measure and bin that holds a change.

    Args:
        ranked: One variant's candidates and changes.
        changes: The table that `ranked.change_rows` index.

    Returns:
        `measure`, `low` and `high` of the bin (low included), `n_changes`, `n_pairs`, and three recalls: `recall_at_k`
        over the K best candidates of each pair, `recall_reported` at the method's own threshold, `recall_at_rate` at
        0.1 false regions per 100 m with its 95 % interval over session pairs, `interval_low` to `interval_high`.
    """
    own = changes.iloc[ranked.change_rows]
    found = {
        "recall_at_k": ranked.change_rank < ranked.n_observable[ranked.change_pair],
        "recall_reported": own["is_found"].astype(bool).to_numpy(),
        "recall_at_rate": found_at(ranked, RATE_PER_100M),
    }
    rows: list[dict[str, Any]] = []
    for measure, edges in EDGES.items():
        if measure not in own:
            continue
        values = pd.to_numeric(own[measure], errors="coerce").to_numpy(dtype=np.float64)
        for low, high in pairwise(edges):
            inside = (values >= low) & (values < high)
            if not inside.any():
                continue
            interval = share_interval(found["recall_at_rate"][inside], ranked.change_pair[inside])
            rows.append(
                {
                    "measure": measure,
                    "low": low,
                    "high": high,
                    "n_changes": int(inside.sum()),
                    "n_pairs": len(np.unique(ranked.change_pair[inside])),
                    **{name: float(hits[inside].mean()) for name, hits in found.items()},
                    "interval_low": interval[0],
                    "interval_high": interval[1],
                }
            )
    return rows


def share_interval(is_hit: BoolArray, pair: np.ndarray[Any, np.dtype[np.int64]]) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the share of (N,) hits whose unit is the pair; NaN for fewer than two."""
    _, place = np.unique(pair, return_inverse=True)
    n_pairs = int(place.max(initial=-1)) + 1
    if n_pairs < 2:
        return float("nan"), float("nan")
    hits, counts = np.bincount(place, is_hit), np.bincount(place)
    draws = stream(0, "bootstrap").integers(n_pairs, size=(N_RESAMPLES, n_pairs))
    samples: Float64Array = hits[draws].sum(axis=1) / counts[draws].sum(axis=1)
    return interval_of(samples)
