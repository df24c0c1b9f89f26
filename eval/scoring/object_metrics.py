"""Scores of changed objects: overlap of each change with the extracted returns, and accuracy of the kind."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.model.report import ChangedObject
from eval.core.statistics import mean
from eval.scoring.twins import is_kind_right, label_changes
from eval.truth.ground_truth import SESSIONS, GroundTruth
from eval.truth.scoring_points import CELL_M
from sim.session.truth import MIXED

Outcome = Literal["match", "false", "ignored"]
_PHASES = tuple(itertools.product((0.0, 0.5), repeat=3))


@dataclass(frozen=True, slots=True, eq=False)
class ObjectMatches:
    """One-to-one matching of objects and changes.

    Attributes:
        matched_object: (C,) int64 object of each change, -1 for none.
        matched_change: (O,) int64 change of each object, -1 for none.
        iou_point: (C,) IoU of the point sets, 0 where unmatched, NaN for unobservable changes.
        iou_voxel: (C,) likewise for 0.1 m voxels, mean over 8 grid phases.
        iou_box: (C,) likewise for axis-aligned boxes.
        is_excused: (O,) objects with more than half of their rows on changes outside of the main group (unobservable or
            partial), or with mixed rows only; these cannot be false.
        n_cells: (O,) int64 rows of each object without mixed ones.
    """

    matched_object: Int64Array
    matched_change: Int64Array
    iou_point: Float64Array
    iou_voxel: Float64Array
    iou_box: Float64Array
    is_excused: BoolArray
    n_cells: Int64Array

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """Outcome of each object."""
        return tuple(
            "match" if change >= 0 else "ignored" if excused else "false"
            for change, excused in zip(self.matched_change, self.is_excused, strict=True)
        )


def match_best(iou: Float64Array) -> list[tuple[int, int]]:
    """Return the one-to-one pairs (row, column) of an (A, B) matrix with the largest sum; zeros make no pair."""
    rows, columns = linear_sum_assignment(iou, maximize=True)
    return [(int(row), int(column)) for row, column in zip(rows, columns, strict=True) if iou[row, column] > 0]


def compute_voxel_iou(points_a: Float64Array, points_b: Float64Array, voxel_m: float = CELL_M) -> float:
    """Return the IoU of the voxels that two sets of points fill, mean over 8 grids half a voxel apart.

    A single grid would favour answers whose edges lie on cell walls. NaN for two empty sets.
    """
    if len(points_a) + len(points_b) == 0:
        return float("nan")
    values = []
    for phase in _PHASES:
        shift = np.array(phase) * voxel_m
        cells_a, cells_b = (np.unique(cell_keys(points + shift, voxel_m)) for points in (points_a, points_b))
        shared = len(np.intersect1d(cells_a, cells_b, assume_unique=True))
        values.append(shared / (len(cells_a) + len(cells_b) - shared))
    return float(np.mean(values))


def compute_box_iou(points_a: Float64Array, points_b: Float64Array, cell_m: float = CELL_M) -> float:
    """Return the IoU of the axis-aligned boxes around two sets of points; 0 if either is empty.

    Each point stands for a cell: boxes reach half a cell beyond their points, so that a flat object has a volume.
    """
    if len(points_a) == 0 or len(points_b) == 0:
        return 0.0
    low_a, high_a = points_a.min(axis=0) - cell_m / 2, points_a.max(axis=0) + cell_m / 2
    low_b, high_b = points_b.min(axis=0) - cell_m / 2, points_b.max(axis=0) + cell_m / 2
    shared = np.prod(np.maximum(np.minimum(high_a, high_b) - np.maximum(low_a, low_b), 0.0))
    return float(shared / (np.prod(high_a - low_a) + np.prod(high_b - low_b) - shared))


def match_objects(objects: Sequence[ChangedObject], rows: Sequence[Int64Array], truth: GroundTruth) -> ObjectMatches:
    """Match the objects of an answer to the observable changes of their session, by the largest sum of point IoU.

    Rows of mixed returns are left out.

    Args:
        objects: The answer's O objects.
        rows: Per object, the rows of its session's scoring points.
        truth: The pair's truth, C changes.
    """
    changes = truth.pair.changes
    ids = np.array([change.id for change in changes], dtype=np.int64)
    by_id = np.argsort(ids)
    n_shared = np.zeros((len(changes), len(objects)), dtype=np.int64)
    scored: list[Int64Array] = []
    for column, (item, of_object) in enumerate(zip(objects, rows, strict=True)):
        labels = truth.sessions[item.session].scoring_points.change[of_object]
        scored.append(of_object[labels != MIXED])
        found, counts = np.unique(labels[np.isin(labels, ids)], return_counts=True)
        n_shared[by_id[np.searchsorted(ids, found, sorter=by_id)], column] = counts  # ids are unique in the pair
    n_cells = np.array([len(of_change) for of_change in truth.change_rows], dtype=np.int64)
    n_rows = np.array([len(of_object) for of_object in scored], dtype=np.int64)
    is_all_mixed = np.array([len(of_object) > 0 for of_object in rows], dtype=np.bool_) & (n_rows == 0)
    iou = n_shared / np.maximum(n_cells[:, None] + n_rows - n_shared, 1)

    matched_object = np.full(len(changes), -1, dtype=np.int64)
    matched_change = np.full(len(objects), -1, dtype=np.int64)
    ious = {name: np.where(truth.is_observable, 0.0, np.nan) for name in ("point", "voxel", "box")}
    for session in SESSIONS:
        of_session = np.array([change.session == session for change in changes], dtype=np.bool_)
        candidates = np.flatnonzero(truth.is_observable & of_session)
        for index, column in match_best(iou[candidates]):
            row = candidates[index]
            matched_object[row], matched_change[column] = column, row
            points = truth.sessions[session].scoring_points.points_odom
            true, answered = (points[of].astype(np.float64) for of in (truth.change_rows[row], scored[column]))
            ious["point"][row] = iou[row, column]
            ious["voxel"][row] = compute_voxel_iou(true, answered)
            ious["box"][row] = compute_box_iou(true, answered)
    is_main = truth.is_observable & ~truth.is_partial
    is_excused = (2 * n_shared[~is_main].sum(axis=0) > n_rows) | is_all_mixed
    return ObjectMatches(matched_object, matched_change, ious["point"], ious["voxel"], ious["box"], is_excused, n_rows)


def judge_kinds(objects: Sequence[ChangedObject], matches: ObjectMatches, truth: GroundTruth) -> Float64Array:
    """Return (C,) whether each matched change has the right kind: 1, 0, or NaN where nothing matched.

    Among twins, props that nothing tells apart, the labels that suit the answer best count (`eval.scoring.twins`).
    """
    matched_object = matches.matched_object
    labels = label_changes(objects, matched_object, truth)
    return np.array(
        [
            float(is_kind_right(objects, matched_object, truth, index, label)) if matched >= 0 else np.nan
            for index, (matched, label) in enumerate(zip(matched_object, labels, strict=True))
        ]
    )


def summarise_objects(matches: ObjectMatches, right: Float64Array, truth: GroundTruth) -> dict[str, float]:
    """Return the object columns of results.csv; averages are over the observable changes of the main group."""
    is_main = truth.is_observable & ~truth.is_partial
    is_partial = truth.is_observable & truth.is_partial
    n_main = int(np.count_nonzero(is_main))
    columns = {
        f"object_iou_{name}": mean(values[is_main])
        for name, values in (("point", matches.iou_point), ("voxel", matches.iou_voxel), ("box", matches.iou_box))
    }
    f1_25, _, _ = _score_instances(matches, is_main, 0.25)
    f1_50, precision_50, quality = _score_instances(matches, is_main, 0.5)
    return {
        **columns,
        "object_f1_25": f1_25 if n_main else float("nan"),
        "object_f1_50": f1_50 if n_main else float("nan"),
        "object_precision_50": 0.0 if n_main and np.isnan(precision_50) else precision_50,
        "object_pq": quality if n_main else float("nan"),
        "kind_accuracy": 0.0 if truth.n_observable and np.isnan(right).all() else mean(right[~np.isnan(right)]),
        "n_objects": len(matches.matched_change),
        "n_matched": int(np.count_nonzero(matches.matched_object >= 0)),
        "n_ignored_objects": matches.outcomes.count("ignored"),
        "n_partial": int(np.count_nonzero(is_partial)),
        "object_iou_point_partial": mean(matches.iou_point[is_partial]),
    }


def score_unanswered_objects(truth: GroundTruth) -> tuple[ObjectMatches, dict[str, float]]:
    """Return the scores of a case without an answer, those of an empty one: 0 where observable changes exist."""
    matches = match_objects((), (), truth)
    return matches, summarise_objects(matches, np.full(len(truth.pair.changes), np.nan), truth)


def _score_instances(matches: ObjectMatches, is_main: BoolArray, min_iou: float) -> tuple[float, float, float]:
    """Return F1, precision and panoptic quality at an IoU; NaN without changes and without objects."""
    is_hit = is_main & (matches.iou_point >= min_iou)
    n_hit = int(np.count_nonzero(is_hit))
    n_missed = int(np.count_nonzero(is_main)) - n_hit
    is_false = ~matches.is_excused
    is_false[matches.matched_object[is_hit]] = False
    n_false = int(np.count_nonzero(is_false))
    weight = n_hit + (n_false + n_missed) / 2
    return (
        n_hit / weight if weight else float("nan"),
        n_hit / (n_hit + n_false) if n_hit + n_false else float("nan"),
        float(matches.iou_point[is_hit].sum()) / weight if weight else float("nan"),
    )
