"""AUROC and average precision of a score."""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array


def auroc(scores: Float64Array, is_positive: BoolArray) -> float:
    """Return the probability that a positive scores above a negative; ties count half.

    Args:
        scores: (N,) scores; NaN (a keyframe that was not compared) ranks below every number.
        is_positive: (N,) mask of the positives; the others are negatives.

    Returns:
        A number in [0, 1]; NaN if either class is empty.
    """
    n_positive = int(np.count_nonzero(is_positive))
    n_negative = len(is_positive) - n_positive
    if n_positive == 0 or n_negative == 0:
        return float("nan")
    ranks = rankdata(comparable(scores), method="average")
    return float((ranks[is_positive].sum() - n_positive * (n_positive + 1) / 2) / (n_positive * n_negative))


def average_precision(scores: Float64Array, is_positive: BoolArray) -> float:
    """Return the sum over falling thresholds of precision times gain in recall; equal scores share one threshold.

    Args:
        scores: (N,) scores; NaN ranks below every number.
        is_positive: (N,) mask of the positives.

    Returns:
        A number in (0, 1]; NaN if either class is empty.
    """
    n_positive = int(np.count_nonzero(is_positive))
    if n_positive in (0, len(is_positive)):
        return float("nan")
    falling = comparable(scores)
    order = np.argsort(-falling, kind="stable")
    n_true = np.cumsum(is_positive[order])
    last = last_of_ties(falling[order])
    precision = n_true[last] / (last + 1)
    recall_gain = np.diff(n_true[last], prepend=0) / n_positive
    return float((precision * recall_gain).sum())


def comparable(scores: Float64Array) -> Float64Array:
    """Return (N,) scores that can be ordered: NaN ranks below every number."""
    return np.where(np.isnan(scores), -np.inf, scores)


def last_of_ties(falling: Float64Array) -> Int64Array:
    """Return the places behind which a threshold can lie: the last of each run of equal (N,) scores."""
    if len(falling) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.append(np.flatnonzero(falling[1:] != falling[:-1]), len(falling) - 1)
