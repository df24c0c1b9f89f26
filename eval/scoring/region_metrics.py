"""Scores of change regions: found changes, false regions, and the ranking of keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, transform_each
from cdpipe.core.ranking import auroc, average_precision
from cdpipe.model.report import ChangeReport
from eval.scoring.judged_places import carry_scores
from eval.truth.ground_truth import GroundTruth, SessionTruth

Outcome = Literal["true", "duplicate", "false", "ignored", "unreported"]
NEGATIVE_FACTOR = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class RegionMatches:
    """Outcomes of R candidates and C changes.

    Attributes:
        outcomes: R outcomes, in the order of the candidates.
        found: R tuples: indices of the changes within the score radius of each candidate's centre.
        best_region: (C,) int64 best-scored reported region that finds each change, -1 for none.
    """

    outcomes: tuple[Outcome, ...]
    found: tuple[tuple[int, ...], ...]
    best_region: Int64Array

    def count(self, outcome: Outcome) -> int:
        """Return the number of candidates with an outcome."""
        return self.outcomes.count(outcome)


def transform_to_world(centres_map: Float64Array, before: SessionTruth) -> Float64Array:
    """Transform (R, 3) centres from the map frame into the world, each by the true pose of the nearest judged scan.

    The map frame is the before session's odom frame, which drifts against the world, so one transform is not enough.
    """
    _, nearest = cKDTree(before.odom_T_sensor[before.judged_scans, :3, 3]).query(centres_map)
    return before.to_world(centres_map, before.judged_scans[nearest])


def transform_to_map(places_world: Float64Array, before: SessionTruth) -> Float64Array:
    """Transform (N, 3) true places into the map frame, each by the pose of the judged scan truly nearest to it."""
    world_T_judged = before.world_T_sensor[before.judged_scans]
    _, nearest = cKDTree(world_T_judged[:, :3, 3]).query(places_world)
    map_T_world = before.odom_T_sensor[before.judged_scans[nearest]] @ invert(world_T_judged[nearest])
    return transform_each(map_T_world, places_world)


def match_regions(
    centres_world: Float64Array,
    is_reported: BoolArray,
    centroids_world: Float64Array,
    is_observable: BoolArray,
    score_radius_m: float,
) -> RegionMatches:
    """Decide the outcome of every candidate, best first.

    A candidate finds the changes whose centroid lies within `score_radius_m` of its centre. A reported region is true
    if it finds an observable change that no better region found, duplicate if all observable ones it finds were found
    already, ignored if it finds only unobservable ones, and false if it finds none.

    Args:
        centres_world: (R, 3) centres of all candidates, best first.
        is_reported: (R,) mask of the reported ones.
        centroids_world: (C, 3) centroids of the changes.
        is_observable: (C,) mask of the observable changes.
        score_radius_m: The family's distance.
    """
    distances = np.linalg.norm(centres_world[:, None] - centroids_world[None], axis=2)
    is_near = distances <= score_radius_m
    best_region = np.full(len(centroids_world), -1, dtype=np.int64)
    outcomes: list[Outcome] = []
    for region, near in enumerate(is_near):
        if not is_reported[region]:
            outcomes.append("unreported")
            continue
        is_new = near & (best_region < 0)
        best_region[is_new] = region
        if (is_new & is_observable).any():
            outcomes.append("true")
        elif (near & is_observable).any():
            outcomes.append("duplicate")
        else:
            outcomes.append("ignored" if near.any() else "false")
    found = tuple(tuple(int(index) for index in np.flatnonzero(near)) for near in is_near)
    return RegionMatches(tuple(outcomes), found, best_region)


def compute_recall_at_k(found: Sequence[tuple[int, ...]], is_observable: BoolArray) -> float:
    """Return the share of the K observable changes that the first K of `found` find, best first; NaN for K = 0."""
    k = int(np.count_nonzero(is_observable))
    if k == 0:
        return float("nan")
    return len({change for changes in found[:k] for change in changes if is_observable[change]}) / k


def measure_covered_share(
    positions_world: Float64Array, travelled_m: Float64Array, centres_world: Float64Array, radii_m: Float64Array
) -> float:
    """Return the share of a path's length inside spheres; the middle of a step between scans decides for the step.

    Args:
        positions_world: (S, 3) true positions along the path.
        travelled_m: (S,) path length up to each of them.
        centres_world: (R, 3) centres of the spheres.
        radii_m: (R,) radius of each.

    Returns:
        A share in [0, 1], 0 without spheres; NaN for a path without length.
    """
    steps_m = np.diff(travelled_m)
    if steps_m.sum() == 0:
        return float("nan")
    middles = cKDTree((positions_world[1:] + positions_world[:-1]) / 2)
    is_inside = np.zeros(len(steps_m), dtype=np.bool_)
    for centre, radius_m in zip(centres_world, radii_m, strict=True):
        is_inside[middles.query_ball_point(centre, radius_m)] = True
    return float(steps_m[is_inside].sum() / steps_m.sum())


def label_keyframes(
    positions_world: Float64Array, centroids_world: Float64Array, is_observable: BoolArray, score_radius_m: float
) -> Int64Array:
    """Label (K, 3) keyframes: 1 near an observable change, 0 farther than 1.5 radii from all, -1 left out."""
    distances = np.linalg.norm(positions_world[:, None] - centroids_world[None], axis=2)
    is_positive = (distances[:, is_observable] <= score_radius_m).any(axis=1)
    is_negative = (distances > NEGATIVE_FACTOR * score_radius_m).all(axis=1)
    return np.where(is_positive, 1, np.where(is_negative, 0, -1))


@dataclass(frozen=True, slots=True, eq=False)
class RegionScores:
    """Scores of one answer's regions.

    Attributes:
        columns: Its columns of results.csv.
        matches: Outcome of each region and change.
        proposed: The same at the centres at which the regions were proposed, and before any was withdrawn.
        keyframe_scores: (J,) score at each judged place of the before session, NaN where the answer states none.
        keyframe_labels: (J,) 1, 0 or -1 of each.
    """

    columns: dict[str, float]
    matches: RegionMatches
    proposed: RegionMatches
    keyframe_scores: Float64Array
    keyframe_labels: Int64Array


def score_regions(report: ChangeReport, truth: GroundTruth, after_travelled_m: Float64Array) -> RegionScores:
    """Score the regions of an answer.

    Args:
        report: The answer, checked.
        truth: The pair's truth.
        after_travelled_m: (S,) path length of the after session up to each scan.
    """
    regions, radius_m = report.regions, truth.pair.score_radius_m
    centres = transform_to_world(regions.centres_map, truth.before)
    matches = match_regions(centres, regions.is_reported, truth.centroids_world, truth.is_observable, radius_m)
    path_m = float(after_travelled_m[-1])
    is_withdrawn = regions.is_proposed & ~regions.is_reported
    kept = [found for found, is_gone in zip(matches.found, is_withdrawn, strict=True) if not is_gone]
    if regions.proposed_centres_map is not None:
        centres_proposed = transform_to_world(regions.proposed_centres_map, truth.before)
    else:
        centres_proposed = centres
    proposed = match_regions(
        centres_proposed, regions.is_proposed, truth.centroids_world, truth.is_observable, radius_m
    )

    scores, labels, ranking = _rank_keyframes(report, truth)
    columns = {
        **_compute_rates(matches, truth, path_m),
        **{f"{name}_proposed": value for name, value in _compute_rates(proposed, truth, path_m).items()},
        "region_recall_at_k": compute_recall_at_k(kept, truth.is_observable),
        "region_recall_at_k_proposed": compute_recall_at_k(proposed.found, truth.is_observable),
        **ranking,
        "region_coverage": measure_covered_share(
            truth.after.world_T_sensor[:, :3, 3],
            after_travelled_m,
            centres[regions.is_reported],
            regions.radii_m[regions.is_reported],
        ),
        "n_regions": int(np.count_nonzero(regions.is_reported)),
        "n_withdrawn": int(np.count_nonzero(is_withdrawn)),
        "n_true_regions": matches.count("true"),
        "n_false_regions": matches.count("false"),
        "n_duplicate_regions": matches.count("duplicate"),
        "n_ignored_regions": matches.count("ignored"),
        "n_found_changes": _count_found(matches, truth),
        **_rate_movers(centres, matches, truth, path_m),
    }
    return RegionScores(columns, matches, proposed, scores, labels)


def mark_near_movers(centres_world: Float64Array, seen_world: Float64Array, score_radius_m: float) -> BoolArray:
    """Mark the centres (R, 3) within `score_radius_m` (inclusive) of a place (N, 3) where a mover gave returns."""
    if len(seen_world) == 0:
        return np.zeros(len(centres_world), dtype=np.bool_)
    nearest_m, _ = cKDTree(seen_world).query(centres_world)
    return np.asarray(nearest_m <= score_radius_m, dtype=np.bool_)


def _rate_movers(
    centres_world: Float64Array, matches: RegionMatches, truth: GroundTruth, path_m: float
) -> dict[str, float]:
    """Return the false regions on movers of either session, and their rate: NaN where no session saw a mover."""
    seen_world = np.concatenate([session.seen_movers_world for session in truth.sessions.values()])
    is_false = np.array([outcome == "false" for outcome in matches.outcomes], dtype=np.bool_)
    is_near = mark_near_movers(centres_world, seen_world, truth.pair.score_radius_m)
    n_near = int(np.count_nonzero(is_false & is_near))
    is_defined = len(seen_world) > 0 and path_m > 0
    return {
        "false_regions_on_movers_per_100m": 100.0 * n_near / path_m if is_defined else float("nan"),
        "n_false_regions_on_movers": n_near,
    }


def _rank_keyframes(
    report: ChangeReport | None, truth: GroundTruth
) -> tuple[Float64Array, Int64Array, dict[str, float]]:
    """Return scores and labels of the judged places of the before session, and the columns that follow from them.

    Places without a score tie below all others, so a method without any score has an AUROC of 0.5.
    """
    scores = carry_scores(report, truth.before)
    positions = truth.before.world_T_sensor[truth.before.judged_scans, :3, 3]
    labels = label_keyframes(positions, truth.centroids_world, truth.is_observable, truth.pair.score_radius_m)
    used = labels >= 0
    area = auroc(scores[used], labels[used] == 1)
    columns = {
        "region_auroc": area,
        "region_ap": average_precision(scores[used], labels[used] == 1),
        "keyframe_coverage": float(np.mean(~np.isnan(scores))),
        "is_auroc_assumed": float(not np.isnan(area) and np.isnan(scores[used]).all()),
    }
    return scores, labels, columns


def _compute_rates(matches: RegionMatches, truth: GroundTruth, path_m: float) -> dict[str, float]:
    """Return recall, precision and false alarms of the matched regions."""
    n_true, n_false = matches.count("true"), matches.count("false")
    nothing = 0.0 if truth.n_observable else float("nan")
    return {
        "region_recall": _count_found(matches, truth) / truth.n_observable if truth.n_observable else float("nan"),
        "region_precision": n_true / (n_true + n_false) if n_true + n_false else nothing,
        "false_regions_per_100m": 100.0 * n_false / path_m if path_m > 0 else float("nan"),
    }


def _count_found(matches: RegionMatches, truth: GroundTruth) -> int:
    return int(np.count_nonzero(truth.is_observable & (matches.best_region >= 0)))


def score_unanswered_regions(truth: GroundTruth) -> RegionScores:
    """Return the scores of a case without an answer: those of an empty one, and no rates over the path."""
    shares = (
        "region_recall", "region_recall_at_k", "region_precision",
        "region_recall_proposed", "region_recall_at_k_proposed", "region_precision_proposed",
    )  # fmt: skip
    rates = (
        "false_regions_per_100m", "false_regions_per_100m_proposed", "region_coverage",
        "false_regions_on_movers_per_100m",
    )  # fmt: skip
    counts = (
        "n_regions", "n_withdrawn", "n_true_regions", "n_false_regions", "n_duplicate_regions", "n_ignored_regions",
        "n_found_changes", "n_false_regions_on_movers",
    )  # fmt: skip
    share = 0.0 if truth.n_observable else float("nan")
    scores, labels, ranking = _rank_keyframes(None, truth)
    columns = {
        **dict.fromkeys(shares, share),
        **dict.fromkeys(rates, float("nan")),
        **dict.fromkeys(counts, 0),
        **ranking,
    }
    matches = RegionMatches((), (), np.full(len(truth.pair.changes), -1))
    return RegionScores(columns, matches, matches, scores, labels)
