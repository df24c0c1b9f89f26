"""Putting both maps into one frame, with evidence, or refusing to.

After FRAME (Stathoulopoulos et al., arXiv 2301.09213), re-implemented from its text: place vectors give pairs of
places, orientation vectors the yaw between them, and the spheres around a pair are registered. Ours, because FRAME has
none of it: several candidates that vote for one another (cdpipe/candidates.py), maps indexed once
(cdpipe/registration.py), a walk along the whole path (cdpipe/walk.py) whose evidence decides (cdpipe/evidence.py), a
second method where nothing was accepted (cdpipe/coarse.py), and an alignment that follows maps which bend apart
(cdpipe/refine.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from cdpipe.alignment import PathAlignment
from cdpipe.candidates import Candidate, closest_pair, voted_candidates
from cdpipe.coarse import coarse_pose, is_kiss_matcher_installed
from cdpipe.config import MergeConfig
from cdpipe.evidence import sampled, surface_fit, why_refused
from cdpipe.geometry import Float64Array, transform
from cdpipe.refine import refined
from cdpipe.registration import (
    MIN_SPHERE_POINTS,
    IndexedMap,
    align_sphere,
    eigenvalue_ratio,
    near_points,
    register,
    rigid_fit,
)
from cdpipe.types import MappedSession, MergedMaps
from cdpipe.walk import Step, Walk, evenly, is_shared, walk

# Spheres along the path on which an alignment is judged, and their radius: walls 5 m away must be inside.
_CHECKS = 8
_CHECK_RADIUS_M = 8.0
_TOO_FEW = "no pair of similar places had enough points to be registered"
# A hypothesis is ranked where it is only coarsely registered.
_RANK_INLIER_M = 0.2
_RANK_STEPS = 10
_RANK_SAMPLES = 150
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
    `descriptor_distance` of the pair, `n_hypotheses` judged along the path, `is_fallback`.

    Returns:
        The best hypothesis, accepted or not and why; identity where nothing could be registered.
    """
    if min(len(near_points(session.map, config)) for session in (before, after)) < MIN_SPHERE_POINTS:
        return MergedMaps(before.map, after.map, np.eye(4), {"n_hypotheses": 0.0}, False, _TOO_FEW)
    start = perf_counter()
    maps = (IndexedMap(before.map, config, is_target=True), IndexedMap(after.map, config, is_target=False))
    indexed = perf_counter()
    best, n_hypotheses = _hypothesis(before, after, maps, config)
    reason = _TOO_FEW
    evidence: dict[str, float] = {"n_hypotheses": float(n_hypotheses)}
    if best is not None:
        reason = "" if config.accept_all else why_refused(best.evidence, config)
        if reason and config.fallback and not is_kiss_matcher_installed():
            reason += " (KISS-Matcher could not be asked: pip install 'tunnelcd[kiss]')"
        evidence = {**best.evidence, **evidence}
    merged = perf_counter()
    before_T_after, local = np.eye(4), None
    if best is not None:
        before_T_after = best.before_T_after
        if not reason and config.refine == "local":
            local, measured = refined(*maps, best.walk, config)
            evidence |= measured
            if local is not None:
                before_T_after = rigid_fit(local.anchors_odom, local.before_T_after)
    seconds = {
        "t_index_s": indexed - start,
        "t_merge_s": merged - indexed,
        "t_refine_s": perf_counter() - merged,
    }
    return MergedMaps(before.map, after.map, before_T_after, evidence, not reason, reason, local, seconds)


def _hypothesis(
    before: MappedSession, after: MappedSession, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[_Hypothesis | None, int]:
    """Return the first hypothesis that is accepted, or else the best, and how many were tried."""
    if config.method == "frame":
        return _first_accepted(_by_frame(closest_pair(before, after), maps, config), maps, config)
    best: _Hypothesis | None = None
    n_tried = 0
    if config.method == "voting":
        starts = _ranked(voted_candidates(before, after, config), maps, config)
        best, n_tried = _first_accepted(starts, maps, config)
        is_accepted = best is not None and not why_refused(best.evidence, config)
        if is_accepted or not (config.fallback and is_kiss_matcher_installed()):
            return best, n_tried
    other, n_other = _first_accepted(_by_kiss_matcher(maps, config), maps, config)
    if other is not None and (best is None or not why_refused(other.evidence, config)):
        best = other
    return best, n_tried + n_other


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """An alignment found around one after keyframe, before the rest of the path was asked."""

    keyframe: int
    before_T_after: Float64Array
    evidence: Mapping[str, float]


def _ranked(candidates: Iterable[Candidate], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> list[_Start]:
    """Register every candidate coarsely and return those that could be, the best fit first."""
    before, after = maps
    found = []
    for candidate in candidates:
        centre = after.positions[candidate.after_keyframe]
        points = after.sphere(centre, config.sphere_radius_m)
        if len(points) < MIN_SPHERE_POINTS:
            continue
        pose = align_sphere(
            points,
            centre,
            before.coarse_target,
            candidate.before_T_after,
            config.gicp_correspondence_m,
            config.coarse_voxel_m,
            _RANK_STEPS,
        ).target_T_source
        fit = surface_fit(before, after, pose, sampled(points, _RANK_SAMPLES), centre, config.sphere_radius_m)
        share = fit.inlier_share(_RANK_INLIER_M)
        distance = {"descriptor_distance": candidate.descriptor_distance, "is_fallback": 0.0}
        found.append((share, _Start(candidate.after_keyframe, pose, distance)))
    return [start for _, start in sorted(found, key=lambda pair: -pair[0])]


def _by_frame(
    candidates: Iterable[Candidate], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> list[_Start]:
    """FRAME: the spheres around both keyframes of a pair, GICP, then VGICP."""
    before, after = maps
    found = []
    for candidate in candidates:
        source = after.sphere(after.positions[candidate.after_keyframe], config.sphere_radius_m)
        target = before.sphere(before.positions[candidate.before_keyframe], config.sphere_radius_m)
        if min(len(source), len(target)) >= MIN_SPHERE_POINTS:
            pose = register(source, target, candidate.before_T_after, config).target_T_source
            distance = {"descriptor_distance": candidate.descriptor_distance, "is_fallback": 0.0}
            found.append(_Start(candidate.after_keyframe, pose, distance))
    return found


def _by_kiss_matcher(maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> list[_Start]:
    """KISS-Matcher on the whole maps; its answer is walked from the after keyframe nearest to the before path."""
    before, after = maps
    found = coarse_pose(before.map.points, after.map.points, config.kiss_voxel_m)
    if found is None:
        return []
    distances_m, _ = before.path.query(transform(found.before_T_after, after.positions))
    return [_Start(int(np.argmin(distances_m)), found.before_T_after, {"is_fallback": 1.0})]


def _first_accepted(
    starts: Iterable[_Start], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> tuple[_Hypothesis | None, int]:
    """Judge one start after the other until one is accepted; otherwise return the one that agrees best."""
    best: _Hypothesis | None = None
    n_tried = 0
    for start in starts:
        n_tried += 1
        hypothesis = _judged(start, maps, config)
        if best is None or hypothesis.evidence["agreement"] > best.evidence["agreement"]:
            best = hypothesis
        if not why_refused(hypothesis.evidence, config):
            return hypothesis, n_tried
    return best, n_tried


def _judged(start: _Start, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> _Hypothesis:
    """Register a start finely and follow it along the path."""
    before, after = maps
    centre = after.positions[start.keyframe]
    pose = start.before_T_after
    points = after.sphere(centre, _CHECK_RADIUS_M)
    if config.method != "frame" and len(points) >= MIN_SPHERE_POINTS:
        found = align_sphere(points, centre, before.target, pose, config.vgicp_correspondence_m, config.voxel_m)
        pose = found.target_T_source
    fit = surface_fit(before, after, pose, sampled(points), centre, _CHECK_RADIUS_M)
    keyframes = evenly(len(after.positions), _CHECKS, [start.keyframe])
    first = int(np.searchsorted(keyframes, start.keyframe))
    step = Step(_CHECK_RADIUS_M, config.voxel_m, _CHECK_REACH_M, first_try_m=_FIRST_TRY_M)
    walked = walk(before, after, keyframes, first, pose, step, config)
    asked = walked.fits[np.isin(walked.keyframes, keyframes)]
    evidence = {
        **start.evidence,
        "overlap": _overlap(walked, before, after),
        "inlier_share": fit.inlier_share(config.inlier_m),
        "residual_m": fit.residual_m,
        "hessian_ratio": eigenvalue_ratio(walked.normal_sum),
        "agreement": float(np.nanmean(asked)) if np.isfinite(asked).any() else 0.0,
    }
    is_common = walked.fits > 0
    if config.method != "frame" and is_common.any():
        pose = rigid_fit(after.positions[walked.keyframes[is_common]], walked.before_T_after[is_common])
    return _Hypothesis(pose, walked, evidence)


def _overlap(walked: Walk, before: IndexedMap, after: IndexedMap) -> float:
    """Return the share of the shorter path's keyframes that lie within 5 m of the other path."""
    alignment = PathAlignment(after.positions[walked.keyframes], walked.before_T_after)
    positions_map = alignment.to_map(after.positions)
    n_shared = int(np.count_nonzero(is_shared(before, positions_map)))
    return min(1.0, n_shared / min(len(before.positions), len(after.positions)))
