"""Scores of single points as DynamicMap_Benchmark (Zhang et al., ITSC 2023) has them, so that its users can compare.

There a method divides the points of a map into static and dynamic ones. Here dynamic is what belongs to a change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cdpipe.core.geometry import Int64Array
from cdpipe.model.report import ChangedObject
from eval.truth.ground_truth import SESSIONS, GroundTruth


def score_points(objects: Sequence[ChangedObject], rows: Sequence[Int64Array], truth: GroundTruth) -> dict[str, float]:
    """Return the static, the dynamic and the associated accuracy over the scoring points of both sessions together.

    Static are the points of no change, dynamic those of the observable changes of the main group. Mixed returns and
    the points of all other changes are left out.

    Args:
        objects: The answer's objects; of none, every point is called static.
        rows: Per object, the rows of its session's scoring points.
        truth: The pair's truth.

    Returns:
        `static_accuracy`, the share of the static points that no object holds; `dynamic_accuracy`, the share of the
        dynamic points that an object holds, NaN where nothing changed; `associated_accuracy`, the root of their
        product.
    """
    is_main = truth.is_observable & ~truth.is_partial
    n_right, n_points = np.zeros(2), np.zeros(2)
    for session in SESSIONS:
        labels = truth.sessions[session].scoring_points.change
        is_answered = np.zeros(len(labels), dtype=np.bool_)
        for item, of_object in zip(objects, rows, strict=True):
            is_answered[of_object if item.session == session else []] = True
        main = [truth.pair.changes[index] for index in np.flatnonzero(is_main)]
        of_session = [change.id for change in main if change.session == session]
        is_static, is_dynamic = labels == 0, np.isin(labels, of_session)
        n_points += (np.count_nonzero(is_static), np.count_nonzero(is_dynamic))
        n_right += (np.count_nonzero(is_static & ~is_answered), np.count_nonzero(is_dynamic & is_answered))
    static, dynamic = (n_right[k] / n_points[k] if n_points[k] else math.nan for k in range(2))
    return {
        "static_accuracy": float(static),
        "dynamic_accuracy": float(dynamic),
        "associated_accuracy": math.sqrt(static * dynamic),
    }


def score_unanswered_points(truth: GroundTruth) -> dict[str, float]:
    """Return the scores of a case without an answer: 0; NaN where nothing changed and none is asked."""
    empty = score_points((), (), truth)
    return {name: math.nan if math.isnan(value) else 0.0 for name, value in empty.items()}
