"""Putting both maps into one frame, with evidence, or refusing to.

After FRAME (Stathoulopoulos et al., arXiv 2301.09213), re-implemented from its text: place vectors give pairs of
places, orientation vectors the yaw between them, and the spheres around a pair are registered. Ours, because FRAME has
none of it: several candidates that vote for one another (cdpipe/merge/candidates.py), maps indexed once
(cdpipe/merge/registration.py), a walk along the whole path (cdpipe/merge/walk.py) whose evidence decides
(cdpipe/merge/evidence.py), a second method where nothing was accepted (cdpipe/merge/global_registration.py), and an
alignment that follows maps which bend apart (cdpipe/merge/refine.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, transform
from cdpipe.merge.candidates import Candidate, find_candidates, find_closest_pair
from cdpipe.merge.evidence import SurfaceFit, explain_refusal, measure_fit, sample_evenly
from cdpipe.merge.global_registration import is_kiss_matcher_installed, register_globally
from cdpipe.merge.refine import refine
from cdpipe.merge.registration import (
    MIN_SPHERE_POINTS,
    IndexedMap,
    align_by_gicp,
    eigenvalue_ratio,
    fit_rigid,
    motion_between,
    register,
)
from cdpipe.merge.walk import Step, Walk, choose_evenly, is_shared, walk
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import MappedSession, MergedMaps

# Spheres along the path on which an alignment is judged, and their radius: walls 5 m away must be inside.
_CHECKS = 8
_CHECK_RADIUS_M = 8.0
_TOO_FEW = "no pair of similar places had enough points to be registered"
# A hypothesis is ranked where it is only coarsely registered.
_RANK_INLIER_M = 0.2
_RANK_STEPS = 10
_RANK_SAMPLES = 150
# A start that fits its place this well, against the best one, is followed too.
_RIVAL_SHARE = 0.95
_OTHER_MOTION_M = 1.0
# What distinctness says where nothing else fits.
_DISTINCT = 10.0
# Fewer places than this, the start left out, are no evidence of a path; worse fits than that do not shape the answer.
_MIN_PLACES, _GOOD_FIT = 3, 0.7
# Cosine of 15 degrees, the most that an answer may tip the after map.
_UPRIGHT = 0.966
# Longest correspondences while walking: what may have drifted since the last stop, less than a narrow drift is wide.
_FIRST_TRY_M, _CHECK_REACH_M = 1.0, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """An alignment found at one place, and what was measured of it along the path."""

    before_T_after: Float64Array
    walk: Walk
    evidence: Mapping[str, float]


def merge_maps(before: MappedSession, after: MappedSession, config: MergeConfig) -> MergedMaps:
    """Align the after session with the before session from their descriptors and maps alone.

    Evidence: `overlap` (share of the shorter path that lies beside the other), `inlier_share` and `residual_m` (share
    of points within `inlier_m` of the other map's surface, and their median distance, around the pair),
    `hessian_ratio` (of a shift, along the whole path), `agreement` (mean share of inliers along the path),
    `distinctness` (residual of the best other alignment that passes, against this one's; 10 where there is none),
    `descriptor_distance` of the pair, `n_hypotheses` judged along the path, `is_fallback`.

    Returns:
        The best hypothesis, accepted or not and why; identity where nothing could be registered.
    """
    n_near = [np.count_nonzero(session.map.nearest_m <= config.seen_within_m) for session in (before, after)]
    if min(n_near) < MIN_SPHERE_POINTS:
        none = {"t_index_s": 0.0, "t_merge_s": 0.0, "t_refine_s": 0.0}
        return MergedMaps(before.map, after.map, np.eye(4), {"n_hypotheses": 0.0}, False, _TOO_FEW, seconds=none)
    start = perf_counter()
    maps = (IndexedMap(before.map, config, is_target=True), IndexedMap(after.map, config, is_target=False))
    indexed = perf_counter()
    best, n_hypotheses = _find_hypothesis(before, after, maps, config)
    reason = _TOO_FEW
    evidence: dict[str, float] = {"n_hypotheses": float(n_hypotheses)}
    if best is not None:
        reason = "" if config.accept_all else explain_refusal(best.evidence, config)
        if reason and config.fallback and not is_kiss_matcher_installed():
            reason += " (KISS-Matcher could not be asked: pip install 'tunnelcd[kiss]')"
        evidence = {**best.evidence, **evidence}
    seconds = {"t_index_s": indexed - start, "t_merge_s": perf_counter() - indexed, "t_refine_s": 0.0}
    before_T_after, local = np.eye(4), None
    if best is not None:
        before_T_after = best.before_T_after
        if not reason and config.refine == "local":
            refining = perf_counter()
            local, measured = refine(*maps, best.walk, config)
            evidence |= measured
            if local is not None:
                before_T_after = fit_rigid(local.anchors_odom, local.before_T_after)
            seconds["t_refine_s"] = perf_counter() - refining
    return MergedMaps(before.map, after.map, before_T_after, evidence, not reason, reason, local, seconds)


def _find_hypothesis(
    before: MappedSession, after: MappedSession, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[_Hypothesis | None, int]:
    """Return the hypothesis that is accepted, or else the best, and how many were followed along the path."""
    if config.method == "frame":
        return _choose_hypothesis(_start_by_frame(find_closest_pair(before, after), maps, config), maps, config)
    best: _Hypothesis | None = None
    n_tried = 0
    if config.method == "voting":
        starts = _rank_starts(find_candidates(before, after, config), maps, config)
        best, n_tried = _choose_hypothesis(starts, maps, config)
        is_accepted = best is not None and not explain_refusal(best.evidence, config)
        if is_accepted or not (config.fallback and is_kiss_matcher_installed()):
            return best, n_tried
    other, n_other = _choose_hypothesis(_start_by_kiss_matcher(maps, config), maps, config)
    if other is not None and (best is None or not explain_refusal(other.evidence, config)):
        best = other
    return best, n_tried + n_other


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """An alignment found around one after keyframe, how well it fits there, and what is known of it so far."""

    keyframe: int
    before_T_after: Float64Array
    evidence: Mapping[str, float]
    share: float = 1.0


def _rank_starts(
    candidates: Iterable[Candidate], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> list[_Start]:
    """Register every candidate coarsely and return them, the best fit first; too small spheres are left out."""
    before, after = maps
    found = []
    for candidate in candidates:
        centre = after.positions[candidate.after_keyframe]
        points = after.sphere(centre, config.sphere_radius_m)
        if len(points) < MIN_SPHERE_POINTS:
            continue
        pose = align_by_gicp(
            points,
            centre,
            before.coarse_target,
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
    """FRAME: the spheres around both keyframes of a pair, GICP, then VGICP."""
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
    """KISS-Matcher on the whole maps; its answer is walked from the after keyframe nearest to the before path.

    Odometry knows what is up: an answer that tips the maps is none.
    """
    before, after = maps
    found = register_globally(before.map.points, after.map.points, config.kiss_voxel_m)
    if found is None or found.before_T_after[2, 2] < _UPRIGHT:
        return []
    distances_m, _ = before.path.query(transform(found.before_T_after, after.positions))
    return [_Start(int(np.argmin(distances_m)), found.before_T_after, {"is_fallback": 1.0})]


def _choose_hypothesis(
    starts: Iterable[_Start], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[_Hypothesis | None, int]:
    """Follow one start after the other until one is accepted, and every other that fits its place about as well.

    A tunnel that repeats itself has several alignments that pass all gates. The one with the smallest residual along
    the path is taken; `distinctness` says how much smaller it is.
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
    """Tell whether a start is another motion than the accepted ones, and fits its place well enough to be one."""
    after = maps[1]
    centre = after.positions[start.keyframe]
    known = [
        PathAlignment(after.positions[other.walk.keyframes], other.walk.before_T_after).at(centre[None])[0]
        for other in accepted
    ]

    def is_other(pose: Float64Array) -> bool:
        return all(motion_between(pose, other, centre)[0] >= _OTHER_MOTION_M for other in known)

    if not is_other(start.before_T_after):  # most are not, and registering finely takes as long as all the votes
        return False
    pose, fit = _register_start(start, maps, config)
    return is_other(pose) and fit.inlier_share(config.inlier_m) >= config.min_inlier_share


def _path_residual_m(hypothesis: _Hypothesis) -> float:
    return float(np.nanmean(hypothesis.walk.residuals_m))


def _judge(start: _Start, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> _Hypothesis:
    """Register a start finely and follow it along the path, and again along the shared part where that is short."""
    before, after = maps
    pose, fit = _register_start(start, maps, config)
    step = Step(_CHECK_RADIUS_M, config.voxel_m, _CHECK_REACH_M, first_try_m=_FIRST_TRY_M)

    def along(keyframes: Int64Array) -> tuple[Walk, Float64Array]:
        """Return the walk, and the fits of the places asked for but the start, which was chosen for its fit."""
        walked = walk(before, after, keyframes, int(np.searchsorted(keyframes, start.keyframe)), pose, step, config)
        fits = walked.fits[np.isin(walked.keyframes, keyframes) & (walked.keyframes != start.keyframe)]
        return walked, fits[np.isfinite(fits)]

    everywhere = np.arange(len(after.positions))
    walked, fits = along(choose_evenly(everywhere, _CHECKS, start.keyframe))
    shared = everywhere[_is_shared_keyframe(walked, before, after)]
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
    is_good = walked.fits >= _GOOD_FIT
    if config.method != "frame" and is_good.any():
        pose = fit_rigid(after.positions[walked.keyframes[is_good]], walked.before_T_after[is_good])
    return _Hypothesis(pose, walked, evidence)


def _register_start(
    start: _Start, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[Float64Array, SurfaceFit]:
    """Register a start finely, but FRAME's own answer, and hold it against the surface."""
    before, after = maps
    centre = after.positions[start.keyframe]
    pose = start.before_T_after
    points = after.sphere(centre, _CHECK_RADIUS_M)
    if config.method != "frame" and len(points) >= MIN_SPHERE_POINTS:
        pose = align_by_gicp(points, centre, before.target, pose, config.vgicp_correspondence_m, config.voxel_m)
    return pose, measure_fit(before, after, pose, sample_evenly(points), centre, _CHECK_RADIUS_M)


def _is_shared_keyframe(walked: Walk, before: IndexedMap, after: IndexedMap) -> BoolArray:
    """Return for each after keyframe whether the before session passed within 5 m of it."""
    alignment = PathAlignment(after.positions[walked.keyframes], walked.before_T_after)
    return is_shared(before, alignment.to_map(after.positions))


def _hessian_ratio(walked: Walk) -> float:
    """Return the eigenvalue ratio of the shift's Hessian, all places together: one bend holds the whole path."""
    rotations = walked.before_T_after[:, :3, :3]
    hessians = rotations @ walked.information[:, 3:, 3:] @ rotations.transpose(0, 2, 1)
    return eigenvalue_ratio(hessians.sum(axis=0))
