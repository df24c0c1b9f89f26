"""Map merging: align both maps with evidence, or refuse.

The method follows FRAME (Stathoulopoulos et al., arXiv 2301.09213), re-implemented from its text: place vectors give
correspondences of keyframes, orientation vectors give the yaw between them, and the spheres around a pair are
registered. FRAME has no acceptance test. These parts are ours: a vote among candidates (`candidates`), maps that are
indexed once (`registration`), a walk along the path (`walk`) that measures the evidence (`evidence`), a global
registration as fallback (`global_registration`), and a local refinement (`refine`, `pose_graph`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array, invert, transform, travelled_m
from cdpipe.mapping.recorded_frames import merge_as_mapped
from cdpipe.merge.candidates import Candidate, find_candidates, find_closest_pair, list_tries
from cdpipe.merge.evidence import SurfaceFit, explain_refusal, measure_fit, sample_evenly
from cdpipe.merge.global_registration import is_kiss_matcher_installed, register_globally
from cdpipe.merge.refine import refine
from cdpipe.merge.registration import (
    MIN_SPHERE_POINTS,
    IndexedMap,
    align_by_gicp,
    fit_rigid,
    motion_between,
    register,
)
from cdpipe.merge.rings import explain_rings, measure_rings
from cdpipe.merge.walk import Step, Walk, choose_evenly, is_shared, walk
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import MappedSession, MergedMaps, PointMap

# Number of spheres along the path that measure the evidence, and their radius: walls 5 m away must be inside.
_CHECKS = 8
_CHECK_RADIUS_M = 8.0
_TOO_FEW = "no pair of similar places had enough points to be registered"
# Coarse registration that ranks the candidates.
_RANK_INLIER_M = 0.2
_RANK_STEPS = 10
_RANK_SAMPLES = 150
# After an acceptance, a start is still tested if its inlier share is at least this share of the best one's.
_RIVAL_SHARE = 0.95
_OTHER_MOTION_M = 1.0
# Distinctness without a rival.
_DISTINCT = 10.0
# Fewest places besides the start that make evidence; lowest fit of a place that contributes to the alignment.
_MIN_PLACES, _GOOD_FIT = 3, 0.7
# A recording of one place: voxel size, correspondences one after the other, and points that measure the fit.
_FINE_M, _FINE_REACHES_M, _ALL_SAMPLES = 0.2, (1.0, 0.5, 0.25, 0.25), 2000
# Cosine of 15 degrees, the largest tilt between the two maps.
_UPRIGHT = 0.966
# Largest displacement of a place by which a checked refinement may change a known alignment: a constant, or a share of
# the path, which is what odometry drifts.
_KNOWN_M, _KNOWN_SHARE = 1.0, 0.01
# A path from which on its map is indexed around the places of the walk alone: these are half of it.
_LONG_M = 400.0
# Longest correspondences of the walk, metres: above the drift between two stops, below the width of a narrow drift.
_FIRST_TRY_M, _CHECK_REACH_M = 1.0, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """An alignment, its walk along the path, and the evidence."""

    before_T_after: Float64Array
    walk: Walk
    evidence: Mapping[str, float]


def merge_maps(before: MappedSession, after: MappedSession, config: MergeConfig) -> MergedMaps:
    """Align the after session with the before session from their descriptors and maps.

    Evidence: `overlap` (share of the shorter path within 5 m of the other), `inlier_share` and `residual_m` (share of
    points within `inlier_m` of the other surface, and median distance, around the start), `hessian_ratio` (smallest to
    largest eigenvalue of the translation's Hessian, whole path), `agreement` (mean inlier share along the path),
    `distinctness` (residual of the best rival alignment divided by this one's; 10 without a rival),
    `line_share` of a short path (`rings`), `descriptor_distance`, `n_hypotheses` walked, `is_fallback`, and
    `kiss_matcher`: 1 if KISS-Matcher was asked, 0 if it was wanted and is not installed.

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
    checked refinement moves no place by more than 1 m or 1 % of the after path, if that is more.

    Args:
        before: The before session.
        after: The after session.
        before_T_after: (4, 4) the known alignment, between the frames of the recorded odometries.
        config: Settings of the merge.
    """
    start = perf_counter()
    seconds = {"t_index_s": 0.0, "t_merge_s": 0.0, "t_refine_s": 0.0}
    known = {"n_hypotheses": 0.0, "is_known": 1.0}
    by_user = merge_as_mapped(before_T_after, before.map, after.map)
    known_local = None if by_user.is_rigid else by_user
    if known_local is not None:
        before_T_after = fit_rigid(by_user.anchors_odom, by_user.before_T_after)
    merged = MergedMaps(before.map, after.map, before_T_after, known, True, local=known_local, seconds=seconds)
    if not _have_points(before, after, config):
        return merged
    maps = (IndexedMap(before.map, config, is_target=True), IndexedMap(after.map, config, is_target=False))
    indexed = perf_counter()
    distances_m, _ = maps[0].path.query(transform(before_T_after, maps[1].positions))
    found = _judge(_Start(int(np.argmin(distances_m)), before_T_after, known), maps, config)
    evidence = {**found.evidence, **measure_rings(before, after, config.seen_within_m)}
    local, refined = known_local, before_T_after
    walked = perf_counter()
    within_m = np.inf
    if config.refine == "checked":
        within_m = max(_KNOWN_M, _KNOWN_SHARE * float(travelled_m(after.map.odom_T_keyframe)[-1]))
    has_refinement = config.refine != "none" and not explain_rings(evidence)
    if has_refinement and "both_ways_m" in evidence:
        place = maps[1].positions[found.walk.keyframes[0]]
        is_near = motion_between(found.before_T_after, before_T_after, place)[0] <= within_m
        if is_near and not explain_refusal(evidence, config):
            local, refined = None, found.before_T_after
    elif has_refinement:
        del maps
        fitted, measured = refine(before.map, after.map, found.walk, before_T_after, config, within_m)
        evidence |= measured
        if fitted is not None:
            local, refined = fitted, fit_rigid(fitted.anchors_odom, fitted.before_T_after)
    seconds = {
        "t_index_s": indexed - start,
        "t_merge_s": walked - indexed,
        "t_refine_s": perf_counter() - walked if has_refinement else 0.0,
    }
    return replace(merged, before_T_after=refined, evidence=evidence, local=local, seconds=seconds)


def _path_m(point_map: PointMap) -> float:
    return float(travelled_m(point_map.odom_T_keyframe)[-1]) if len(point_map.keyframe_scans) else 0.0


def _have_points(before: MappedSession, after: MappedSession, config: MergeConfig) -> bool:
    """Return whether both maps hold enough points, seen from near, for one registration."""
    n_near = [np.count_nonzero(session.map.nearest_m <= config.seen_within_m) for session in (before, after)]
    return bool(min(n_near) >= MIN_SPHERE_POINTS)


def _find_hypothesis(
    before: MappedSession, after: MappedSession, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[_Hypothesis | None, int, bool]:
    """Return the accepted hypothesis or else the best one, how many were walked, and if KISS-Matcher was wanted."""
    if config.method == "frame":
        starts = _start_by_frame(find_closest_pair(before, after), maps, config)
        return *_choose_hypothesis(starts, maps, config), False
    best: _Hypothesis | None = None
    n_tried = 0
    if config.method == "voting":
        for every in list_tries(before, after, config):
            if every == 1:
                before, after = before.described(), after.described()
            starts = _rank_starts(find_candidates(before, after, config, every), maps, config)
            found, n_found = _choose_hypothesis(starts, maps, config)
            best, n_tried = found or best, n_tried + n_found
            if best is not None and not explain_refusal(best.evidence, config):
                return best, n_tried, False
        if not (config.fallback and is_kiss_matcher_installed()):
            return best, n_tried, config.fallback
    other, n_other = _choose_hypothesis(_start_by_kiss_matcher(maps, config), maps, config)
    if other is not None and (best is None or not explain_refusal(other.evidence, config)):
        best = other
    return best, n_tried + n_other, True


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """An alignment found at one after keyframe, its evidence so far, and its inlier share there."""

    keyframe: int
    before_T_after: Float64Array
    evidence: Mapping[str, float]
    share: float = 1.0


def _rank_starts(
    candidates: Iterable[Candidate], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> list[_Start]:
    """Register every candidate coarsely; return them by falling inlier share, without those of too few points."""
    before, after = maps
    found = []
    for candidate in candidates:
        centre = after.positions[candidate.after_keyframe]
        points = after.sphere(centre, config.sphere_radius_m)
        if len(points) < MIN_SPHERE_POINTS:
            continue
        there = transform(candidate.before_T_after, centre[None])[0]
        pose = align_by_gicp(
            points,
            centre,
            before.coarse_target_near(there, config.sphere_radius_m + config.gicp_correspondence_m),
            candidate.before_T_after,
            config.gicp_correspondence_m,
            config.coarse_voxel_m,
            _RANK_STEPS,
        )
        fit = measure_fit(before, after, pose, sample_evenly(points, _RANK_SAMPLES), centre, config.sphere_radius_m)
        share = fit.inlier_share(_RANK_INLIER_M)
        distance = {"descriptor_distance": candidate.descriptor_distance, "is_fallback": 0.0}
        found.append(_Start(candidate.after_keyframe, pose, distance, share))
    return sorted(found, key=lambda start: -start.share)


def _start_by_frame(
    candidates: Iterable[Candidate], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> list[_Start]:
    """Register the spheres around both keyframes of a pair by GICP, then VGICP, as FRAME does."""
    before, after = maps
    found = []
    for candidate in candidates:
        source = after.sphere(after.positions[candidate.after_keyframe], config.sphere_radius_m)
        target = before.sphere(before.positions[candidate.before_keyframe], config.sphere_radius_m)
        if min(len(source), len(target)) >= MIN_SPHERE_POINTS:
            pose = register(source, target, candidate.before_T_after, config)
            distance = {"descriptor_distance": candidate.descriptor_distance, "is_fallback": 0.0}
            found.append(_Start(candidate.after_keyframe, pose, distance))
    return found


def _start_by_kiss_matcher(maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> list[_Start]:
    """Register the full maps by KISS-Matcher; the start is the after keyframe nearest to the before path.

    Odometry observes gravity, so a pose that tilts the after map is rejected.
    """
    before, after = maps
    pose = register_globally(before.map.points, after.map.points, config.kiss_voxel_m)
    if pose is None or pose[2, 2] < _UPRIGHT:
        return []
    distances_m, _ = before.path.query(transform(pose, after.positions))
    return [_Start(int(np.argmin(distances_m)), pose, {"is_fallback": 1.0})]


def _choose_hypothesis(
    starts: Iterable[_Start], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[_Hypothesis | None, int]:
    """Walk the starts in order until one is accepted, then the remaining starts that fit about as well.

    In a repetitive tunnel several alignments pass all gates. The one with the smallest residual along the path is
    chosen; `distinctness` is the ratio to the next one.
    """
    judged: list[_Hypothesis] = []
    accepted: list[_Hypothesis] = []
    best_share = 0.0
    for start in starts:
        best_share = max(best_share, start.share)
        if accepted and (start.share < _RIVAL_SHARE * best_share or not _is_rival(start, accepted, maps, config)):
            continue
        judged.append(_judge(start, maps, config))
        if not explain_refusal(judged[-1].evidence, config):
            accepted.append(judged[-1])
    if not accepted:
        return max(judged, key=lambda each: np.nan_to_num(each.evidence["agreement"]), default=None), len(judged)
    best, *others = sorted(accepted, key=_path_residual_m)
    place = maps[1].positions[best.walk.keyframes[0]]
    rivals = [o for o in others if motion_between(o.before_T_after, best.before_T_after, place)[0] > _OTHER_MOTION_M]
    if rivals:
        ratio = min(_path_residual_m(rivals[0]) / _path_residual_m(best), _DISTINCT)
        best = replace(best, evidence={**best.evidence, "distinctness": ratio})
    return best, len(judged)


def _is_rival(
    start: _Start, accepted: Iterable[_Hypothesis], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> bool:
    """Return whether a start differs from every accepted motion and passes the inlier gate at its place."""
    after = maps[1]
    centre = after.positions[start.keyframe]
    known = [
        PathAlignment(after.positions[other.walk.keyframes], other.walk.before_T_after).at(centre[None])[0]
        for other in accepted
    ]

    def is_other(pose: Float64Array) -> bool:
        return all(motion_between(pose, other, centre)[0] >= _OTHER_MOTION_M for other in known)

    if not is_other(start.before_T_after):  # cheap test first: the fine registration is slow
        return False
    pose, fit = _register_start(start, maps, config)
    return is_other(pose) and fit.inlier_share(config.inlier_m) >= config.min_inlier_share


def _path_residual_m(hypothesis: _Hypothesis) -> float:
    return float(np.nanmean(hypothesis.walk.residuals_m))


def _judge(start: _Start, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> _Hypothesis:
    """Register a start finely and walk it along the path; walk again over the shared part if that is short."""
    before, after = maps
    pose, fit = _register_start(start, maps, config)
    step = Step(_CHECK_RADIUS_M, config.voxel_m, _CHECK_REACH_M, first_try_m=_FIRST_TRY_M)

    def along(keyframes: Int64Array) -> tuple[Walk, Float64Array]:
        """Return the walk, and the fits at the requested keyframes without the start, which was chosen for its fit."""
        walked = walk(before, after, keyframes, int(np.searchsorted(keyframes, start.keyframe)), pose, step, config)
        fits = walked.fits[np.isin(walked.keyframes, keyframes) & (walked.keyframes != start.keyframe)]
        return walked, fits[np.isfinite(fits)]

    everywhere = np.arange(len(after.positions))
    walked, fits = along(choose_evenly(everywhere, _CHECKS, start.keyframe))
    alignment = PathAlignment(after.positions[walked.keyframes], walked.before_T_after)
    shared = everywhere[is_shared(before, alignment.to_map(after.positions))]
    if len(fits) < _CHECKS // 2 < len(shared):
        walked, fits = along(choose_evenly(shared, _CHECKS, start.keyframe))
    evidence = {
        **start.evidence,
        "overlap": min(1.0, len(shared) / min(len(before.positions), len(after.positions))),
        "inlier_share": fit.inlier_share(config.inlier_m),
        "residual_m": fit.residual_m,
        "hessian_ratio": _hessian_ratio(walked),
        "agreement": float(fits.mean()) if len(fits) >= _MIN_PLACES else float("nan"),
        "distinctness": _DISTINCT,
    }
    if config.method != "frame" and min(len(before.positions), len(after.positions)) <= _MIN_PLACES:
        pose, of_place = _judge_one_place(start, pose, maps, config)
        evidence |= of_place
        walked = replace(walked, before_T_after=np.repeat(pose[None], len(walked.keyframes), axis=0))
    is_good = walked.fits >= _GOOD_FIT
    if config.method != "frame" and is_good.any():
        pose = fit_rigid(after.positions[walked.keyframes[is_good]], walked.before_T_after[is_good])
    return _Hypothesis(pose, walked, evidence)


def _judge_one_place(
    start: _Start, pose: Float64Array, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[Float64Array, dict[str, float]]:
    """Register all that both sessions saw of one place, in both directions, and judge it.

    A recording too short for further places has this evidence instead: `agreement` (share of inliers among all points
    of both maps, the lower of both directions), `both_ways_m` and `both_ways_deg` (how far the registrations from after
    to before and from before to after differ).
    """
    finer = config.model_copy(update={"target_voxel_m": _FINE_M})
    before, after = (IndexedMap(each.map, finer, is_target=True, has_coarse_target=False) for each in maps)
    centre = after.positions[start.keyframe]
    forward, backward = pose, invert(pose)
    there = transform(pose, centre[None])[0]
    own, theirs = after.sphere(centre, config.seen_within_m), before.sphere(there, config.seen_within_m)
    if min(len(own), len(theirs)) < MIN_SPHERE_POINTS:
        return pose, {"agreement": 0.0, "both_ways_m": 0.0, "both_ways_deg": 0.0}
    for reach_m in _FINE_REACHES_M:
        forward = align_by_gicp(own, centre, before.target, forward, reach_m, _FINE_M)
        backward = align_by_gicp(theirs, there, after.target, backward, reach_m, _FINE_M)
    apart_m, apart_rad = motion_between(forward, invert(backward), centre)
    fit = measure_fit(before, after, forward, sample_evenly(own, _ALL_SAMPLES), centre, config.seen_within_m)
    return forward, {
        "agreement": fit.inlier_share(config.inlier_m),
        "both_ways_m": apart_m,
        "both_ways_deg": float(np.degrees(apart_rad)),
    }


def _register_start(
    start: _Start, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[Float64Array, SurfaceFit]:
    """Register a start finely (FRAME's result is kept as it is) and measure the surface fit."""
    before, after = maps
    centre = after.positions[start.keyframe]
    pose = start.before_T_after
    points = after.sphere(centre, _CHECK_RADIUS_M)
    if config.method != "frame" and len(points) >= MIN_SPHERE_POINTS:
        there = transform(pose, centre[None])[0]
        target, _ = before.target_near(there, _CHECK_RADIUS_M + config.vgicp_correspondence_m)
        pose = align_by_gicp(points, centre, target, pose, config.vgicp_correspondence_m, config.voxel_m)
    return pose, measure_fit(before, after, pose, sample_evenly(points), centre, _CHECK_RADIUS_M)


def _hessian_ratio(walked: Walk) -> float:
    """Return the eigenvalue ratio of the translation's Hessian, summed over all places: one bend constrains all."""
    rotations = walked.before_T_after[:, :3, :3]
    hessians = rotations @ walked.information[:, 3:, 3:] @ rotations.transpose(0, 2, 1)
    eigenvalues = np.linalg.eigvalsh(hessians.sum(axis=0))
    # the smallest one of a singular matrix may be computed as -1e-17
    return float(max(eigenvalues[0], 0.0) / eigenvalues[-1]) if eigenvalues[-1] > 0 else 0.0
