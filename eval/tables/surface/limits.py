"""Detection limits of displacement fields: how large a displacement must be to be found, by the area that moved.

Windows (`eval.scoring.surface.windows`) are means over discs. A method has one threshold for each area: at most 5 % of
the null windows that it covers are beyond it, of those at one end of a long drift and of those anywhere else, each by
themselves: an answer that is silent at the one end is judged by the others. All null windows are then looked at, those
that it hardly covers too. Where more than 15 % of them are beyond the threshold, it rises until 5 % are.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from eval.core.statistics import clustered_interval
from eval.tables.rows import numbers, tunnels_of

FALSE_SHARE = 0.05
# a factor of sqrt 2 to either side of 5, 10, 20, 40, 80 and 160 mm; the last bin also holds all that is larger
MAGNITUDES_M = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16)
EDGES_M = (*(round(float(each / np.sqrt(2)), 6) for each in MAGNITUDES_M), 5.0)
# of 40 independent windows at 5 % each more than 15 % have a chance of 0.3 %, more than 10 % one of 5 %
MOST_FALSE = 0.15
LEAST_CHECKS = 20  # of fewer windows 5 % are less than one
_ROUNDING_M = 1e-9  # means of one value over more or fewer places differ by rounding
_HALF = 0.5
_COVERED = 0.5


def detection_limits(windows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return a row for each area and bin of magnitudes that holds a window of a change.

    Args:
        windows: Rows of surface_windows.csv of one variant.

    Returns:
        `area_m2`; `from_m` to `to_m`, the bin of |true_m|, and `magnitude_m`, the median in it; `threshold_m`, NaN
        where the variant covers no null window; `n_null_windows` and `n_check_windows` that it covers; `false_share`
        of all null windows beyond the threshold; `n_windows`; `found_share` of them with its 95 % bootstrap interval
        over tunnels, the threshold held fixed; `limit_m`, the same in all rows of an area: the smallest magnitude from
        which on at least half are found, between two bins by the logarithm of the magnitude; NaN where half of the
        largest are not found.
    """
    rows: list[dict[str, Any]] = []
    area_m2, is_null = numbers(windows, "area_m2"), windows["is_null"].astype(bool).to_numpy()
    true_m, answered_m = numbers(windows, "true_m"), numbers(windows, "answered_m")
    tunnels, is_covered = tunnels_of(windows), numbers(windows, "cover") >= _COVERED
    is_check = np.zeros(len(windows), dtype=np.bool_)
    if "is_check" in windows:  # an older run has none
        is_check = windows["is_check"].eq(True).to_numpy(dtype=np.bool_)
    for area in np.unique(area_m2):
        is_asked = is_null & (area_m2 == area)
        null_m, check_m = (np.abs(answered_m[is_asked & is_covered & of]) for of in (~is_check, is_check))
        threshold_m, false_share = find_threshold(null_m, check_m, np.abs(answered_m[is_asked]))
        is_found = (np.abs(answered_m) > threshold_m + _ROUNDING_M) & (np.sign(answered_m) == np.sign(true_m))
        own: list[dict[str, Any]] = []
        for low, high in pairwise(EDGES_M):
            inside = (area_m2 == area) & ~is_null & (np.abs(true_m) >= low) & (np.abs(true_m) < high)
            if not inside.any():
                continue
            found = is_found[inside].astype(np.float64)
            found_low, found_high = clustered_interval(found, tunnels[inside])
            own.append(
                {
                    "area_m2": float(area),
                    "from_m": low,
                    "to_m": high,
                    "magnitude_m": float(np.median(np.abs(true_m[inside]))),
                    "threshold_m": threshold_m,
                    "n_null_windows": len(null_m),
                    "n_check_windows": len(check_m),
                    "false_share": false_share,
                    "n_windows": len(found),
                    "found_share": float(found.mean()),
                    "found_share_low": found_low,
                    "found_share_high": found_high,
                }
            )
        limit_m = interpolate_limit(*(np.array([row[name] for row in own]) for name in ("magnitude_m", "found_share")))
        rows += [{**row, "limit_m": limit_m} for row in own]
    return rows


def find_threshold(null_m: Float64Array, check_m: Float64Array, all_m: Float64Array) -> tuple[float, float]:
    """Return the threshold of a method and area, and the share of all null windows beyond it; NaN without a threshold.

    Args:
        null_m: (N,) answered sizes of the null windows that are covered and no check windows, metres.
        check_m: (C,) those of the check windows that are covered.
        all_m: (M,) those of all null windows, 0 where nothing is answered.
    """
    if len(null_m) == 0:
        return float("nan"), float("nan")
    own = [null_m, check_m] if len(check_m) >= LEAST_CHECKS else [null_m]
    threshold_m = max(np.quantile(each, 1.0 - FALSE_SHARE) for each in own)
    if np.mean(all_m > threshold_m + _ROUNDING_M) > MOST_FALSE:
        threshold_m = np.quantile(all_m, 1.0 - FALSE_SHARE)
    return float(threshold_m), float(np.mean(all_m > threshold_m + _ROUNDING_M))


def interpolate_limit(magnitude_m: Float64Array, found_share: Float64Array) -> float:
    """Return the smallest magnitude from which on at least half are found, by (B,) bins in rising order.

    Between the last bin below one half and the next the share is taken as linear in the logarithm of the magnitude. If
    all bins reach one half, it is that of the smallest: the limit lies there or below. NaN if the last bin does not.
    """
    is_half = found_share >= _HALF
    if len(is_half) == 0 or not is_half[-1]:
        return float("nan")
    if is_half.all():
        return float(magnitude_m[0])
    last = int(np.flatnonzero(~is_half)[-1])
    low, high = found_share[last], found_share[last + 1]
    step = (_HALF - low) / (high - low)
    logs = np.log(magnitude_m[last : last + 2])
    return float(np.exp(logs[0] + step * (logs[1] - logs[0])))
