"""Map merging: align both maps with evidence, or refuse.

The method follows FRAME (Stathoulopoulos et al., arXiv 2301.09213), re-implemented from its text: place vectors give
correspondences of keyframes, orientation vectors give the yaw between them, and the spheres around a pair are
registered. FRAME has no acceptance test. These parts are ours: a vote among candidates (`candidates`), maps that are
indexed once (`registration`), hypotheses (`hypotheses`) that a walk along the path (`walk`) gives their evidence
(`evidence`), a global registration as fallback (`global_registration`), and a local refinement (`refine`,
`pose_graph`).
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from time import perf_counter

import numpy as np

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, fit_rigid, transform, transform_each, travelled_m
from cdpipe.core.geometry.voxel import FINEST_CELL_M, max_coordinate_m
from cdpipe.mapping.poses.recorded_frames import merge_as_mapped
from cdpipe.merge.candidates import find_candidates, find_closest_pair, list_tries
from cdpipe.merge.evidence import explain_refusal
from cdpipe.merge.global_registration import is_kiss_matcher_installed
from cdpipe.merge.hypotheses import (
    Hypothesis,
    Start,
    choose_hypothesis,
    judge,
    rank_starts,
    start_by_frame,
    start_by_kiss_matcher,
)
from cdpipe.merge.refine import refine
from cdpipe.merge.registration import (
    MIN_SPHERE_POINTS,
    IndexedMap,
    motion_between,
)
from cdpipe.merge.rings import explain_rings, measure_rings
from cdpipe.merge.walk import SHARED_M
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import MappedSession, MergedMaps, PointMap

_TOO_FEW = "no pair of similar places had enough points to be registered"
# Largest displacement of a place by which a checked refinement may change a known alignment: a constant, or a share of
# the path, which is what odometry drifts.
_KNOWN_M, _KNOWN_SHARE = 1.0, 0.01
# Share of the places that may fit farther away than that.
_FAR_SHARE = 0.1
# A path from which on its map is indexed around the places of the walk alone: these are half of it.
_LONG_M = 400.0


def merge_maps(before: MappedSession, after: MappedSession, config: MergeConfig) -> MergedMaps:
    """Align the after session with the before session from their descriptors and maps.

    Evidence: `overlap` (share of the shorter path within 5 m of the other), `inlier_share` and `residual_m` (share of
    points within `inlier_m` of the other surface, and median distance, around the start; the share of the median place
    of the walk if that is higher), `hessian_ratio` (smallest to largest eigenvalue of the translation's Hessian, whole
    path), `agreement` (mean inlier share along the path), `distinctness` (residual of the best rival alignment divided
    by this one's; 10 without a rival), `line_share` of a short path (`rings`), `descriptor_distance`, `n_hypotheses`
    walked, `is_fallback`, and `kiss_matcher`: 1 if KISS-Matcher was asked, 0 if it was wanted and is not installed.

    Returns:
        The best hypothesis with the reason of a refusal; the identity if nothing could be registered.
    """
    if not _have_points(before, after, config):
        none = {"t_index_s": 0.0, "t_merge_s": 0.0, "t_refine_s": 0.0}
        return MergedMaps(before.map, after.map, np.eye(4), {"n_hypotheses": 0.0}, False, _TOO_FEW, seconds=none)
    start = perf_counter()
    is_local = [config.first_every > 1 and _path_m(each.map) > _LONG_M for each in (before, after)]
    maps = (
        IndexedMap(before.map, config, is_target=True, is_local=is_local[0]),
        IndexedMap(after.map, config, is_target=False, is_local=is_local[1]),
    )
    indexed = perf_counter()
    best, n_hypotheses, asks_kiss_matcher = _find_hypothesis(before, after, maps, config)
    evidence: dict[str, float] = {"n_hypotheses": float(n_hypotheses)}
    if asks_kiss_matcher:
        evidence["kiss_matcher"] = float(is_kiss_matcher_installed())
    local_s = maps[0].local_s + maps[1].local_s  # indexing, too, which a robot does while it maps
    merge_s = perf_counter() - indexed - local_s
    seconds = {"t_index_s": indexed - start + local_s, "t_merge_s": merge_s, "t_refine_s": 0.0}
    if best is None:
        return MergedMaps(before.map, after.map, np.eye(4), evidence, False, _TOO_FEW, seconds=seconds)
    evidence = {**best.evidence, **evidence, **measure_rings(before, after, config.seen_within_m)}
    reason = "" if config.accept_all else explain_refusal(evidence, config) or explain_rings(evidence)
    if reason and config.fallback and not is_kiss_matcher_installed():
        reason += " (KISS-Matcher could not be asked: pip install 'tunnelcd[kiss]')"
    before_T_after, local = best.before_T_after, None
    if not reason and config.refine != "none" and "both_ways_m" not in evidence:  # one place is one registration
        refining = perf_counter()
        del maps  # the refinement indexes both maps anew: at no time are there two indices of one map
        local, measured = refine(before.map, after.map, best.walk, before_T_after, config)
        evidence |= measured
        if local is not None:
            before_T_after = fit_rigid(local.anchors_odom, local.before_T_after)
        seconds["t_refine_s"] = perf_counter() - refining
    return MergedMaps(before.map, after.map, before_T_after, evidence, not reason, reason, local, seconds)


def take_known_merge(
    before: MappedSession, after: MappedSession, before_T_after: Float64Array, config: MergeConfig
) -> MergedMaps:
    """Return both maps with an alignment that the user knows; no gate is asked.

    Evidence: `is_known` is 1; the other measurements are those of a walk that starts at the known alignment. With
    `config.refine` the alignment is refined along the path, and stays as it is where the refinement does not fit, or
    where both maps are rings that lie apart (`rings`). A
    checked refinement moves no place by more than 1 m or 1 % of the after path, if that is more. A warning tells where
    the scans fit farther away than that or nowhere, or cannot tell.

    Args:
        before: The before session.
        after: The after session.
        before_T_after: (4, 4) the known alignment, between the frames of the recorded odometries.
        config: Settings of the merge.

    Raises:
        InputError: The alignment takes the after session farther than its cells can be numbered.
    """
    start = perf_counter()
    seconds = {"t_index_s": 0.0, "t_merge_s": 0.0, "t_refine_s": 0.0}
    known = {"n_hypotheses": 0.0, "is_known": 1.0}
    by_user = merge_as_mapped(before_T_after, before.map, after.map)
    known_local = None if by_user.is_rigid else by_user
    if known_local is not None:
        before_T_after = fit_rigid(by_user.anchors_odom, by_user.before_T_after)
    _require_reachable(before_T_after, before.map, after.map)
    merged = MergedMaps(before.map, after.map, before_T_after, known, True, local=known_local, seconds=seconds)
    if not _have_points(before, after, config):
        return merged
    maps = (IndexedMap(before.map, config, is_target=True), IndexedMap(after.map, config, is_target=False))
    indexed = perf_counter()
    distances_m, _ = maps[0].path.query(transform(before_T_after, maps[1].positions))
    found = judge(Start(int(np.argmin(distances_m)), before_T_after, known), maps, config)
    evidence = {**found.evidence, **measure_rings(before, after, config.seen_within_m)}
    local, refined = known_local, before_T_after
    walked = perf_counter()
    near_m = max(_KNOWN_M, _KNOWN_SHARE * float(travelled_m(after.map.odom_T_keyframe)[-1]))
    within_m = near_m if config.refine == "checked" else np.inf
    is_told = _warn_of_misfit(
        found, by_user.at(maps[1].positions[found.walk.keyframes]), maps[1].positions, near_m, config
    )
    has_refinement = config.refine != "none" and not explain_rings(evidence)
    if has_refinement and "both_ways_m" in evidence:
        place = maps[1].positions[found.walk.keyframes[0]]
        is_near = motion_between(found.before_T_after, before_T_after, place)[0] <= within_m
        if is_near and not explain_refusal(evidence, config):
            local, refined = None, found.before_T_after
    elif has_refinement:
        del maps
        given = before_T_after if known_local is None else known_local.at(after.map.odom_T_keyframe[:, :3, 3])
        fitted, measured = refine(before.map, after.map, found.walk, given, config, within_m)
        evidence |= measured
        n_beyond = int(measured.get("n_beyond", 0))
        if n_beyond and not is_told:
            text = (
                f"known merge: {n_beyond} of {int(measured['n_judged'])} places fit more than {within_m:.1f} m beside "
                "it, too far for drift: it holds there, and what is found there may be false"
            )
            warnings.warn(text, InputWarning, stacklevel=2)
        if fitted is not None:
            local, refined = fitted, fit_rigid(fitted.anchors_odom, fitted.before_T_after)
    seconds = {
        "t_index_s": indexed - start,
        "t_merge_s": walked - indexed,
        "t_refine_s": perf_counter() - walked if has_refinement else 0.0,
    }
    return replace(merged, before_T_after=refined, evidence=evidence, local=local, seconds=seconds)


def _warn_of_misfit(
    found: Hypothesis, known: Float64Array, positions: Float64Array, near_m: float, config: MergeConfig
) -> bool:
    """Warn where the scans fit elsewhere than a known merge puts them, do not fit around it, or cannot tell.

    True where nothing is left to tell: a warning was given, or the scans slide along a smooth drift.

    Args:
        found: The walk that started at the known merge.
        known: (A, 4, 4) the known `before_T_after` at each keyframe of the walk.
        positions: (K, 3) positions of all after keyframes, after odom frame, metres.
        near_m: What odometry may drift, metres.
        config: Settings of the merge.
    """
    fits, places = found.walk.fits, positions[found.walk.keyframes]
    share, ratio = (found.evidence.get(name, np.nan) for name in ("inlier_share", "hessian_ratio"))
    if not np.isfinite(fits).any():
        told = f"the paths do not come within {SHARED_M:g} m of each other under it, so it was not checked"
    elif not share >= config.min_inlier_share:
        told = f"{'nothing fits' if np.isnan(share) else f'only {share:.0%} of the points fit'} the other map near it"
    else:
        moved_m = np.linalg.norm(
            transform_each(found.walk.before_T_after, places) - transform_each(known, places), axis=1
        )[fits >= config.min_inlier_share]
        far_m = moved_m[moved_m > near_m]
        slides = not ratio >= config.min_hessian_ratio  # along a smooth drift
        if slides or len(far_m) == 0 or len(far_m) < max(min(2, len(moved_m)), _FAR_SHARE * len(moved_m)):
            return slides
        told = f"the scans fit {np.median(far_m):.1f} m beside it, at {len(far_m)} of {len(moved_m)} places"
    text = f"known merge: {told}: are both sessions in one frame? Without a known merge, it is searched for"
    warnings.warn(text, InputWarning, stacklevel=2)
    return True


def _require_reachable(before_T_after: Float64Array, before: PointMap, after: PointMap) -> None:
    farthest_m = float(np.abs(transform(before_T_after, after.points)).max(initial=0.0))
    limit_m = max_coordinate_m(min(FINEST_CELL_M, before.voxel_m / 2))  # columns of objects are half as wide as cells
    if not farthest_m < limit_m:
        raise InputError(
            f"the known merge takes the after session to {farthest_m:.0f} m in the before session's odom frame, where "
            f"cells can be numbered up to {limit_m:.0f} m: expected the transform between both odom frames as they "
            "were read: subtract from it what was subtracted from the trajectories, or from both what is common"
        )


def _path_m(point_map: PointMap) -> float:
    return float(travelled_m(point_map.odom_T_keyframe)[-1]) if len(point_map.keyframe_scans) else 0.0


def _have_points(before: MappedSession, after: MappedSession, config: MergeConfig) -> bool:
    """Return whether both maps hold enough points, seen from near, for one registration."""
    n_near = [np.count_nonzero(session.map.nearest_m <= config.seen_within_m) for session in (before, after)]
    return bool(min(n_near) >= MIN_SPHERE_POINTS)


def _find_hypothesis(
    before: MappedSession, after: MappedSession, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[Hypothesis | None, int, bool]:
    """Return the accepted hypothesis or else the best one, how many were walked, and if KISS-Matcher was wanted."""
    if config.method == "frame":
        starts = start_by_frame(find_closest_pair(before, after), maps, config)
        best, judged = choose_hypothesis(starts, maps, config)
        return best, len(judged), False
    best, judged = None, []
    if config.method == "voting":
        for every in list_tries(before, after, config):
            if every == 1:
                before, after = before.described(), after.described()
            starts = rank_starts(find_candidates(before, after, config, every), maps, config)
            best, judged = choose_hypothesis(starts, maps, config, judged)
            if best is not None and not explain_refusal(best.evidence, config):
                return best, len(judged), False
        if not (config.fallback and is_kiss_matcher_installed()):
            return best, len(judged), config.fallback
    other, judged = choose_hypothesis(start_by_kiss_matcher(maps, config), maps, config, judged)
    if best is None or (other is not None and not explain_refusal(other.evidence, config)):
        best = other
    return best, len(judged), True
