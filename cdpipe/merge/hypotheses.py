"""Hypotheses of the alignment of two maps: where a search starts, what a walk along the path says, and the choice.

A start is an alignment at one after keyframe: of a candidate, of FRAME's closest pair, or of KISS-Matcher. It is
registered finely and walked along the path (`walk`), which measures its evidence (`evidence`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array, fit_rigid, invert, transform
from cdpipe.merge.candidates import Candidate
from cdpipe.merge.evidence import SurfaceFit, explain_refusal, measure_fit, sample_evenly
from cdpipe.merge.global_registration import register_globally
from cdpipe.merge.registration import (
    MIN_SPHERE_POINTS,
    IndexedMap,
    align_by_gicp,
    motion_between,
    register,
)
from cdpipe.merge.walk import Step, Walk, choose_evenly, is_shared, walk
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import MergeConfig

# Number of spheres along the path that measure the evidence, and their radius: walls 5 m away must be inside.
_CHECKS = 8
_CHECK_RADIUS_M = 8.0
# Longest correspondences of the walk, metres: above the drift between two stops, below the width of a narrow drift.
_FIRST_TRY_M, _CHECK_REACH_M = 1.0, 1.5
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
# Largest extent of a recording of one place.
_ONE_PLACE_M = 2.5
# A recording of one place: voxel size, correspondences one after the other, and points that measure the fit.
_FINE_M, _FINE_REACHES_M, _ALL_SAMPLES = 0.2, (1.0, 0.5, 0.25, 0.25), 2000
# Cosine of 15 degrees, the largest tilt between the two maps.
_UPRIGHT = 0.966


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """An alignment, its walk along the path, and the evidence."""

    before_T_after: Float64Array
    walk: Walk
    evidence: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """An alignment found at one after keyframe, its evidence so far, and its inlier share there."""

    keyframe: int
    before_T_after: Float64Array
    evidence: Mapping[str, float]
    share: float = 1.0


def rank_starts(
    candidates: Iterable[Candidate], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> list[Start]:
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
        found.append(Start(candidate.after_keyframe, pose, distance, share))
    return sorted(found, key=lambda start: -start.share)


def start_by_frame(
    candidates: Iterable[Candidate], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
) -> list[Start]:
    """Register the spheres around both keyframes of a pair by GICP, then VGICP, as FRAME does."""
    before, after = maps
    found = []
    for candidate in candidates:
        source = after.sphere(after.positions[candidate.after_keyframe], config.sphere_radius_m)
        target = before.sphere(before.positions[candidate.before_keyframe], config.sphere_radius_m)
        if min(len(source), len(target)) >= MIN_SPHERE_POINTS:
            pose = register(source, target, candidate.before_T_after, config)
            distance = {"descriptor_distance": candidate.descriptor_distance, "is_fallback": 0.0}
            found.append(Start(candidate.after_keyframe, pose, distance))
    return found


def start_by_kiss_matcher(maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> list[Start]:
    """Register the full maps by KISS-Matcher; the start is the after keyframe nearest to the before path.

    Odometry observes gravity, so a pose that tilts the after map is rejected.
    """
    before, after = maps
    pose = register_globally(before.map.points, after.map.points, config.kiss_voxel_m)
    if pose is None or pose[2, 2] < _UPRIGHT:
        return []
    distances_m, _ = before.path.query(transform(pose, after.positions))
    return [Start(int(np.argmin(distances_m)), pose, {"is_fallback": 1.0})]


def choose_hypothesis(
    starts: Iterable[Start],
    maps: tuple[IndexedMap, IndexedMap],
    config: MergeConfig,
    earlier: Sequence[Hypothesis] = (),
) -> tuple[Hypothesis | None, list[Hypothesis]]:
    """Walk the starts in order until one is accepted, then the remaining starts that fit about as well.

    In a repetitive tunnel several alignments pass all gates. The one with the smallest residual along the path is
    chosen; `distinctness` is the ratio to the next one. What was accepted of earlier starts stays a rival.

    Returns:
        The choice, None without hypotheses; and all of them, the earlier ones first.
    """
    judged = list(earlier)
    accepted = [each for each in judged if not explain_refusal(each.evidence, config)]
    best_share = 0.0
    for start in starts:
        best_share = max(best_share, start.share)
        if accepted and (start.share < _RIVAL_SHARE * best_share or not _is_rival(start, accepted, maps, config)):
            continue
        judged.append(judge(start, maps, config))
        if not explain_refusal(judged[-1].evidence, config):
            accepted.append(judged[-1])
    if not accepted:
        return max(judged, key=lambda each: np.nan_to_num(each.evidence["agreement"]), default=None), judged
    best, *others = sorted(accepted, key=_path_residual_m)
    place = maps[1].positions[best.walk.keyframes[0]]
    rivals = [o for o in others if motion_between(o.before_T_after, best.before_T_after, place)[0] > _OTHER_MOTION_M]
    if rivals:
        ratio = min(_path_residual_m(rivals[0]) / _path_residual_m(best), _DISTINCT)
        best = replace(best, evidence={**best.evidence, "distinctness": ratio})
    return best, judged


def _is_rival(
    start: Start, accepted: Iterable[Hypothesis], maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
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


def _path_residual_m(hypothesis: Hypothesis) -> float:
    return float(np.nanmean(hypothesis.walk.residuals_m))


def judge(start: Start, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig) -> Hypothesis:
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
        "inlier_share": _usual_share(fit.inlier_share(config.inlier_m), fits),
        "residual_m": fit.residual_m,
        "hessian_ratio": _hessian_ratio(walked),
        "agreement": float(fits.mean()) if len(fits) >= _MIN_PLACES else float("nan"),
        "distinctness": _DISTINCT,
    }
    if config.method != "frame" and (_is_one_place(before) or _is_one_place(after)):
        pose, of_place = _judge_one_place(start, pose, maps, config)
        evidence |= of_place
        walked = replace(walked, before_T_after=np.repeat(pose[None], len(walked.keyframes), axis=0))
    is_good = walked.fits >= _GOOD_FIT
    if config.method != "frame" and is_good.any():
        pose = fit_rigid(after.positions[walked.keyframes[is_good]], walked.before_T_after[is_good])
    return Hypothesis(pose, walked, evidence)


def _is_one_place(indexed: IndexedMap) -> bool:
    """Tell whether a session has no further places; the odometry of a sensor that stands may jitter for a long way."""
    positions = indexed.positions
    return len(positions) <= _MIN_PLACES or bool(np.ptp(positions, axis=0).max() < _ONE_PLACE_M)


def _judge_one_place(
    start: Start, pose: Float64Array, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
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
    start: Start, maps: tuple[IndexedMap, IndexedMap], config: MergeConfig
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


def _usual_share(at_start: float, along: Float64Array) -> float:
    """Return the inlier share at the start, or the median over all places of the walk if that is higher.

    The tunnel may have changed at the start: fill or a pile that covers its floor leaves half of the points without a
    counterpart, and says nothing about the alignment.
    """
    return max(at_start, float(np.median([at_start, *along]))) if len(along) >= _MIN_PLACES else at_start


def _hessian_ratio(walked: Walk) -> float:
    """Return the eigenvalue ratio of the translation's Hessian, summed over all places: one bend constrains all."""
    rotations = walked.before_T_after[:, :3, :3]
    hessians = rotations @ walked.information[:, 3:, 3:] @ rotations.transpose(0, 2, 1)
    eigenvalues = np.linalg.eigvalsh(hessians.sum(axis=0))
    # the smallest one of a singular matrix may be computed as -1e-17
    return float(max(eigenvalues[0], 0.0) / eigenvalues[-1]) if eigenvalues[-1] > 0 else 0.0
