"""From descriptors to change regions: the paper's inverted k-d-tree query, threshold and suppression.

The paper selects the keyframes with the largest descriptor distance, `argmax f(Q_t,i, Q_t+1,j)`. It does not say how i
and j are paired. Reading A ("nearest") pairs each keyframe with its nearest neighbour in descriptor space, as FRAME
does; the two may be different places. Reading B ("paired") pairs it with the nearest keyframe in space after alignment.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.descriptors.sphere import change_log_odds
from cdpipe.model.config import PipelineConfig, QueryConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName, UInt8Array
from cdpipe.query.difference import sphere_difference
from cdpipe.query.drift_width import keyframe_radii, score_radii

# Values of `ChangeRegions.direction`: the session whose keyframe is queried in the other session.
BEFORE, AFTER = 0, 1
# Keyframes of a tripod survey lie so far apart, and what lies between them is in no sphere.
_GAP_M = 3.0
_GAP_SHARE = 0.75  # of their distance, within which a keyframe of the robot is near one of them
# Keyframe scores, in log-odds: what is surer than this (0.95) counts as this, so that a sure change some metres away is
# not above a doubtful one here; and the fall per metre, which ranks keyframes near one change by their distance. Mean
# AUROC and AP of 16 validation pairs (3 narrow, 7 caves, 6 wide): 0.999 and 0.994; without both 0.992 and 0.90.
_SURE = 3.0
_FALL_PER_M = 0.1
# The fall of shares: the sphere difference reaches 0.958 and 0.81 there; with a radius by the site 0.965 and 0.79.
_SHARE_FALL_PER_M = 0.03
_MUCH_SPARSER = 1.5


def find_regions(
    merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
) -> ChangeRegions:
    """Score the keyframes as `regions.source` says, and rank them as regions.

    Args:
        merged: Both maps and their alignment; with a fixed radius, `scan` and `every-keyframe` use only the poses.
        before: Descriptors of the before session; `pairs[:, 0]` indexes its keyframes.
        after: Descriptors of the after session; `pairs[:, 1]` indexes its keyframes.
        config: `regions.source`: scan, sphere, sphere-difference or every-keyframe; `query`; for sphere its weights.
    """
    query = config.query
    places = _Places(merged, before, after, query)
    if config.regions.source == "scan":
        return _score_by_scans(merged, places, before, after, query)
    session: SessionName = "before"
    if places.gap_m > _GAP_M:
        # asked at the keyframes of the robot; those between two stations count as near them
        session = "after"
        query = query.model_copy(update={"max_pair_m": max(query.max_pair_m, _GAP_SHARE * places.gap_m)})
        places = _Places(merged, before, after, query)
    described = before if session == "before" else after
    radii_m = keyframe_radii(merged.map_of(session), described.keyframe_scans, query)
    is_forced: BoolArray | None = None
    match config.regions.source:
        case "sphere":
            # a sphere descriptor covers 2 m of tunnel before and behind its keyframe
            scores = change_log_odds(merged, described, places.is_covered(session), config.sphere, session)
            if query.n_regions is None:
                ends = _find_ends(places.of(session), places.of("after" if session == "before" else "before"), query)
                is_forced = np.isin(np.arange(len(scores)), ends)
            keyframe_scores = _score_surroundings(
                places,
                session,
                score_radii(merged.before, before.keyframe_scans, query),
                lambda near, away_m: np.minimum(scores[near], _SURE) - _FALL_PER_M * away_m,
            )
        case "sphere-difference":
            scores = sphere_difference(merged, before, after, query, session)
            keyframe_scores = score_keyframes_by_share(scores, merged, before, after, query, session)
        case "every-keyframe":
            scores = np.where(places.is_covered(session), 0.0, np.nan)
            keyframe_scores = np.where(places.is_covered("before"), 0.0, np.nan)
        case other:
            raise ValueError(f"{other} is no source of regions at keyframes")
    direction = _from(BEFORE if session == "before" else AFTER, scores)
    pairs, centres_map = places.pairs(session), places.of(session)
    return rank_regions(
        centres_map, scores, pairs, keyframe_scores, query, direction, radii_m=radii_m, is_forced=is_forced
    )


def _find_ends(positions: Float64Array, others: Float64Array, config: QueryConfig) -> Int64Array:
    """Return which of (K, 3) keyframes, their first or last, the other session with its (L, 3) came near.

    A sphere descriptor sees 2 m beyond such a keyframe, its region reaches farther, and no other keyframe does. So it
    is always looked at, whatever its score.
    """
    if not len(positions) or not len(others):
        return np.zeros(0, dtype=np.int64)
    outer = np.unique([0, len(positions) - 1])
    apart_m = np.linalg.norm(positions[outer, None] - others, axis=2).min(axis=1)
    return np.asarray(outer[apart_m <= config.max_pair_m], dtype=np.int64)


def score_keyframes_by_share(
    shares: Float64Array,
    merged: MergedMaps,
    before: DescriptorSet,
    after: DescriptorSet,
    config: QueryConfig,
    session: SessionName = "before",
) -> Float64Array:
    """Return the (Kb,) scores of the before keyframes from the (K,) shares of new points around those of a session.

    A share counts where it was measured; where the radius follows the width of the drift, also for the keyframes
    around, less 3 % per metre.
    """
    if config.radius_m != "width" and session == "before":
        return shares
    return _score_surroundings(
        _Places(merged, before, after, config),
        session,
        score_radii(merged.before, before.keyframe_scans, config),
        lambda near, away_m: shares[near] * (1.0 - _SHARE_FALL_PER_M * away_m),
    )


class _Places:
    """Map positions of all keyframes, and the spatially nearest keyframe of the other session."""

    def __init__(self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: QueryConfig) -> None:
        self.before, self.after = merged.keyframe_positions(before, after)
        gap_b, self.near_a = query_nearest(self.before, self.after)
        gap_a, self.near_b = query_nearest(self.after, self.before)
        self.is_covered_b, self.is_covered_a = gap_b <= config.max_pair_m, gap_a <= config.max_pair_m

    @property
    def gap_m(self) -> float:
        """Usual distance of two before keyframes, if the after keyframes lie much closer together; else 0."""
        step_b, step_a = (_usual_step_m(each) for each in (self.before, self.after))
        return step_b if step_b > _MUCH_SPARSER * step_a else 0.0

    def of(self, session: SessionName) -> Float64Array:
        """(K, 3) positions of the keyframes of a session."""
        return self.before if session == "before" else self.after

    def is_covered(self, session: SessionName) -> BoolArray:
        """(K,) whether the other session came near each keyframe of a session."""
        return self.is_covered_b if session == "before" else self.is_covered_a

    def pairs(self, session: SessionName) -> Int64Array:
        """(K, 2) before and after keyframe: each of a session and the nearest of the other."""
        if session == "before":
            return np.column_stack([np.arange(len(self.near_a)), self.near_a])
        return np.column_stack([self.near_b, np.arange(len(self.near_b))])


def _usual_step_m(positions: Float64Array) -> float:
    """Return the median distance from each of (K, 3) positions to the next; 0 of a single one."""
    return float(np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))) if len(positions) > 1 else 0.0


def _score_by_scans(
    merged: MergedMaps, places: _Places, before: DescriptorSet, after: DescriptorSet, config: QueryConfig
) -> ChangeRegions:
    """Score every keyframe of both sessions by the descriptor distance to its partner.

    Every keyframe is a candidate at its own position. After keyframes are queried among the before descriptors and,
    inverted, before keyframes among the after descriptors. In reading B a candidate needs a partner within
    `max_pair_m`.
    """
    is_covered_b, is_covered_a = places.is_covered_b, places.is_covered_a
    if config.reading == "nearest":
        score_b, partner_of_b = query_nearest(before.q, after.q)
        score_a, partner_of_a = query_nearest(after.q, before.q)
        is_candidate_b, is_candidate_a = np.isfinite(score_b), np.isfinite(score_a)
    else:
        partner_of_b, partner_of_a = places.near_a, places.near_b
        is_candidate_b, is_candidate_a = is_covered_b, is_covered_a
        score_b = _distances(before, after, partner_of_b, is_candidate_b)
        score_a = _distances(after, before, partner_of_a, is_candidate_a)

    keyframe_scores = np.where(is_covered_b, score_b, np.nan)
    np.maximum.at(keyframe_scores, places.near_b[is_covered_a], score_a[is_covered_a])

    pairs_a = np.column_stack([partner_of_a, np.arange(len(score_a))])
    pairs_b = np.column_stack([np.arange(len(score_b)), partner_of_b])
    return rank_regions(
        centres_map=np.concatenate([places.after[is_candidate_a], places.before[is_candidate_b]]),
        scores=np.concatenate([score_a[is_candidate_a], score_b[is_candidate_b]]),
        pairs=np.concatenate([pairs_a[is_candidate_a], pairs_b[is_candidate_b]]),
        keyframe_scores=keyframe_scores,
        config=config,
        direction=np.concatenate([_from(AFTER, pairs_a[is_candidate_a]), _from(BEFORE, pairs_b[is_candidate_b])]),
        radii_m=np.concatenate(
            [
                keyframe_radii(merged.after, after.keyframe_scans, config)[is_candidate_a],
                keyframe_radii(merged.before, before.keyframe_scans, config)[is_candidate_b],
            ]
        ),
    )


def _score_surroundings(
    places: _Places,
    session: SessionName,
    score_m: Float64Array,
    score_from: Callable[[Int64Array, Float64Array], Float64Array],
) -> Float64Array:
    """Return the (K,) score of every before keyframe: the largest of those that its surroundings have from there.

    Args:
        places: Positions of the keyframes.
        session: The session that was asked.
        score_m: (K,) radius of the surroundings.
        score_from: Returns the (N,) scores of (N,) keyframes of that session as seen from (N,) metres away.
    """
    keyframe_scores = np.full(len(places.before), np.nan)
    positions, asked = places.of(session), np.flatnonzero(places.is_covered(session))
    tree = cKDTree(positions[asked])
    for keyframe in np.flatnonzero(places.is_covered_b):
        near = asked[tree.query_ball_point(places.before[keyframe], score_m[keyframe])]
        away_m = np.linalg.norm(positions[near] - places.before[keyframe], axis=1)
        keyframe_scores[keyframe] = np.fmax.reduce(score_from(near, away_m), initial=np.nan)
    return keyframe_scores


def rank_regions(
    centres_map: Float64Array,
    scores: Float64Array,
    pairs: Int64Array,
    keyframe_scores: Float64Array,
    config: QueryConfig,
    direction: UInt8Array | None = None,
    *,
    radii_m: Float64Array,
    is_forced: BoolArray | None = None,
) -> ChangeRegions:
    """Sort candidates by score, suppress those near a better one, and mark the reported ones.

    Of two candidates of different radius, that of the better one decides what is near. A candidate below the threshold
    suppresses no forced one: it is not looked at itself.

    Args:
        centres_map: (N, 3) sphere centres, map frame, metres.
        scores: (N,) larger is more surely changed; NaN is no candidate. Ties keep their order.
        pairs: (N, 2) before and after keyframe of each candidate.
        keyframe_scores: (K,) copied into the result.
        config: Radius, suppression distance, and threshold or number of regions.
        direction: (N,) as in `ChangeRegions`; None if no keyframes are queried.
        radii_m: (N,) radius of each candidate.
        is_forced: (N,) which candidates are reported whatever the threshold, unless a better reported one is near; None
            for none. They keep their scores.
    """
    is_looked_at = np.zeros(len(scores), np.bool_) if is_forced is None else is_forced
    if config.n_regions is None:
        is_looked_at = is_looked_at | (scores >= config.threshold)
    order = np.argsort(-scores, kind="stable")
    order = order[~np.isnan(scores[order])]
    kept = order[_suppress_neighbours(centres_map[order], config.suppression * radii_m[order], is_looked_at[order])]
    is_reported = is_looked_at[kept] if config.n_regions is None else np.arange(len(kept)) < config.n_regions
    return ChangeRegions(
        centres_map=centres_map[kept],
        radius_m=radii_m[kept] if config.radius_m == "width" else config.radius_m,
        scores=scores[kept],
        pairs=pairs[kept].astype(np.int64),
        is_reported=is_reported,
        keyframe_scores=keyframe_scores,
        direction=None if direction is None else direction[kept],
        is_forced=None if is_forced is None else is_forced[kept],
    )


def _from(session: int, candidates: npt.NDArray[Any]) -> UInt8Array:
    """Return the direction of candidates that are all keyframes of one session."""
    return np.full(len(candidates), session, dtype=np.uint8)


def _suppress_neighbours(centres: Float64Array, distances_m: Float64Array, is_looked_at: BoolArray) -> BoolArray:
    """Mark, from best to worst, every (N, 3) centre that is at least their distance, (N,), from all marked before.

    One that is looked at, (N,), needs to be so far only from others that are.
    """
    is_kept = np.ones(len(centres), dtype=np.bool_)
    for index, centre in enumerate(centres):
        if is_kept[index]:
            is_apart = np.linalg.norm(centres[index + 1 :] - centre, axis=1) >= distances_m[index]
            is_kept[index + 1 :] &= is_apart | (is_looked_at[index + 1 :] & ~is_looked_at[index])
    return is_kept


def query_nearest(points: npt.NDArray[Any], others: npt.NDArray[Any]) -> tuple[Float64Array, Int64Array]:
    """Return distance and index of the nearest of `others` for each point; infinity and 0 if there are none."""
    if len(others) == 0 or len(points) == 0:
        return np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    distances, indices = cKDTree(others.astype(np.float64)).query(points.astype(np.float64))
    return np.asarray(distances, dtype=np.float64), np.asarray(indices, dtype=np.int64)


def _distances(
    queries: DescriptorSet, others: DescriptorSet, partners: Int64Array, is_paired: BoolArray
) -> Float64Array:
    """Return the (N,) descriptor distance of each query to its partner; NaN without a partner."""
    distances = np.full(len(queries.q), np.nan)
    chosen = queries.q[is_paired].astype(np.float64) - others.q[partners[is_paired]]
    distances[is_paired] = np.linalg.norm(chosen, axis=1)
    return distances
