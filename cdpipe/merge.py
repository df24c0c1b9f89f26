"""Putting both maps into one frame: FRAME (Stathoulopoulos et al., arXiv 2301.09213), re-implemented from its text.

A k-d tree on the place vectors gives the closest descriptor pairs, the orientation vectors the yaw between them, and
the spheres around a pair are registered with GICP, then VGICP. Ours, because the paper has none of it: pairs are ranked
by how many others agree with them, several are tried, every alignment is measured (cdpipe/evidence.py), and one without
enough evidence is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from cdpipe.config import MergeConfig
from cdpipe.descriptor import relative_yaws_rad
from cdpipe.evidence import MIN_SPHERE_POINTS, MapCheck, Place, sphere_fit, why_refused
from cdpipe.geometry import Float64Array, Int64Array, invert, make_pose, transform, yaw_pose
from cdpipe.sphere import MapIndex
from cdpipe.types import DescriptorSet, MappedSession, MergedMaps, PointMap

_N_YAWS = 2
# Without orientation vectors: GICP recovers from about 60 degrees, so quarter turns cover the circle.
_BLIND_YAWS_RAD = np.array([0.0, np.pi, np.pi / 2, -np.pi / 2])
# Keyframes paired at most; pair by pair they are compared, so that twice as many cost four times the time.
_MAX_PAIRS = 1500
_SUPPORT_M = 2.0
_SUPPORT_SHARE = 0.01
# A hypothesis this good ends the search: right places reach 0.99 in the sphere and along both paths.
_CLEAR_INLIER_SHARE = 0.97
_CLEAR_AGREEMENT = 0.97
_REFINE_CELL_M = 1.0
# Gaussian voxels of half the correspondence distance: twice as accurate as 1 m on a real pair of 32-beam scans.
_VGICP_CELLS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Result of aligning two clouds.

    Attributes:
        target_T_source: (4, 4) pose of the source cloud in the target's frame.
        hessian_ratio: Smallest to largest eigenvalue of the translational Hessian; near 0 where the clouds can slide.
    """

    target_T_source: Float64Array
    hessian_ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    before_T_after: Float64Array
    evidence: Mapping[str, float]


def merge_maps(before: MappedSession, after: MappedSession, config: MergeConfig) -> MergedMaps:
    """Align the after session with the before session from their descriptors and maps alone.

    Evidence: `inlier_share` (share of both spheres' common points nearer than `inlier_m` to the other map),
    `residual_m` (their median distance), `hessian_ratio`, `agreement` (share of fitting points along both paths),
    `overlap` (share of the whole after map within 1 m of the before map), `descriptor_distance` of the pair,
    `n_hypotheses` tried.

    Returns:
        The best hypothesis, accepted or not and why; identity where nothing could be registered. Hypotheses that fit in
        their sphere are ranked by agreement, the others by inlier share.
    """
    check = MapCheck(before.map, after.map)
    best: _Hypothesis | None = None
    n_hypotheses = 0
    for place, guess in _guesses(before, after, config):
        n_hypotheses += 1
        found = _try(place, guess, check, config)
        if best is None or _rank(found) > _rank(best):
            best = found
        if _is_clear(best, config):
            break
    if best is None:
        reason = "no pair of similar places had enough points to be registered"
        return MergedMaps(before.map, after.map, np.eye(4), {"n_hypotheses": float(n_hypotheses)}, False, reason)
    before_T_after = best.before_T_after
    overlap = check.overlap(before_T_after)
    evidence = {**best.evidence, "overlap": overlap, "n_hypotheses": float(n_hypotheses)}
    reason = why_refused(best.evidence, config)
    if config.refine_map and not reason:
        before_T_after, evidence = _refined(before.map, after.map, before_T_after, evidence, check)
    return MergedMaps(before.map, after.map, before_T_after, evidence, not reason, reason)


def register(
    source_points: Float64Array, target_points: Float64Array, initial_guess: Float64Array, config: MergeConfig
) -> Registration:
    """Align two clouds by GICP and then VGICP.

    Args:
        source_points: (N, 3) points, metres.
        target_points: (M, 3) points, metres.
        initial_guess: (4, 4) `target_T_source` to start from.
        config: Thinning and correspondence distances.
    """
    # Registered about the target's centre: small_gicp solves for a turn about the origin, which may be far away.
    centre_T_target = make_pose(translation=-target_points.mean(axis=0))
    target = transform(centre_T_target, target_points)
    source = transform(centre_T_target @ initial_guess, source_points)
    target_cloud, target_tree = small_gicp.preprocess_points(target, config.voxel_m, num_threads=1)
    source_cloud, _ = small_gicp.preprocess_points(source, config.voxel_m, num_threads=1)
    coarse = small_gicp.align(
        target_cloud,
        source_cloud,
        target_tree,
        registration_type="GICP",
        max_correspondence_distance=config.gicp_correspondence_m,
        num_threads=1,
    )
    voxels = small_gicp.GaussianVoxelMap(config.vgicp_correspondence_m / _VGICP_CELLS)
    voxels.insert(target_cloud)
    fine = small_gicp.align(
        voxels,
        source_cloud,
        coarse.T_target_source,
        max_correspondence_distance=config.vgicp_correspondence_m,
        num_threads=1,
    )
    target_T_source = invert(centre_T_target) @ fine.T_target_source @ centre_T_target @ initial_guess
    eigenvalues = np.linalg.eigvalsh(fine.H[3:, 3:])
    ratio = float(eigenvalues[0] / eigenvalues[-1]) if eigenvalues[-1] > 0 else 0.0
    return Registration(target_T_source, ratio)


def closest_pairs(before: MappedSession, after: MappedSession, config: MergeConfig) -> list[tuple[int, int, float]]:
    """Return up to `n_candidates` (before keyframe, after keyframe, descriptor distance), most supported first.

    Every after keyframe is paired with its nearest before keyframe in descriptor space. In a mine of equal drifts most
    of these pairs are wrong, the closest ones too, but only right ones agree with one another; see `pair_support`. Of
    equal support the closest comes first. A pair whose two keyframes both lie within half a sphere of an already chosen
    pair's would repeat that trial and is left out.
    """
    if len(before.descriptors.q) == 0 or len(after.descriptors.q) == 0:
        return []
    n_after = len(after.descriptors.q)
    queried = np.unique(np.linspace(0, n_after - 1, min(n_after, _MAX_PAIRS)).round().astype(np.int64))
    found = cKDTree(before.descriptors.q).query(after.descriptors.q[queried])
    distances, nearest = np.asarray(found[0]), np.asarray(found[1])
    before_positions = keyframe_poses(before.map, before.descriptors)[nearest, :3, 3]
    after_positions = keyframe_poses(after.map, after.descriptors)[queried, :3, 3]
    support = pair_support(before_positions, after_positions)
    chosen: list[int] = []
    for pair in np.lexsort((distances, -support)).tolist():
        is_repeated = any(
            np.linalg.norm(before_positions[pair] - before_positions[other]) < config.sphere_radius_m / 2
            and np.linalg.norm(after_positions[pair] - after_positions[other]) < config.sphere_radius_m / 2
            for other in chosen
        )
        if not is_repeated:
            chosen.append(pair)
        if len(chosen) == config.n_candidates:
            break
    return [(int(nearest[pair]), int(queried[pair]), float(distances[pair])) for pair in chosen]


def pair_support(before_positions: Float64Array, after_positions: Float64Array) -> Int64Array:
    """Return for each of P pairs how many are as far from it in the before as in the after session, itself included.

    A rigid motion keeps distances: any two right pairs pass, whatever the motion is. The tolerance is 2 m, for two
    keyframes of one place that are a metre apart, and 1 % of the distance, for drift.

    Args:
        before_positions: (P, 3) before keyframe of each pair, its session's odom frame, metres.
        after_positions: (P, 3) after keyframe of each pair, likewise.
    """
    apart_m = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (before_positions, after_positions)]
    is_consistent = np.abs(apart_m[0] - apart_m[1]) < _SUPPORT_M + _SUPPORT_SHARE * apart_m[1]
    return np.asarray(np.count_nonzero(is_consistent, axis=1))


def keyframe_poses(point_map: PointMap, descriptors: DescriptorSet) -> Float64Array:
    """Return the (K, 4, 4) `odom_T_sensor` of the keyframes that were described."""
    return point_map.odom_T_sensor[descriptors.keyframe_scans]


def _guesses(before: MappedSession, after: MappedSession, config: MergeConfig) -> Iterator[tuple[Place, Float64Array]]:
    """Yield places, and `before_T_after` as if both keyframes were at the same point, for each candidate yaw."""
    before_index, after_index = MapIndex(before.map.points), MapIndex(after.map.points)
    before_poses = keyframe_poses(before.map, before.descriptors)
    after_poses = keyframe_poses(after.map, after.descriptors)
    w_before, w_after = before.descriptors.w, after.descriptors.w
    for i, j, distance in closest_pairs(before, after, config):
        before_centre, after_centre = before_poses[i, :3, 3], after_poses[j, :3, 3]
        before_points = before.map.points[before_index.crop(before_centre, config.sphere_radius_m)]
        after_points = after.map.points[after_index.crop(after_centre, config.sphere_radius_m)]
        if min(len(before_points), len(after_points)) < MIN_SPHERE_POINTS:
            continue
        place = Place(before_points, after_points, before_centre, after_centre, distance)
        yaws_rad = _BLIND_YAWS_RAD
        if w_before is not None and w_after is not None:
            yaws_rad = relative_yaws_rad(w_before[i], w_after[j], _N_YAWS)
        for yaw_rad in yaws_rad:
            yield place, before_poses[i] @ yaw_pose(float(yaw_rad)) @ invert(after_poses[j])


def _try(place: Place, guess: Float64Array, check: MapCheck, config: MergeConfig) -> _Hypothesis:
    found = register(place.after_points, place.before_points, guess, config)
    inlier_share, residual_m = sphere_fit(place, found.target_T_source, config)
    evidence = {
        "inlier_share": inlier_share,
        "residual_m": residual_m,
        "hessian_ratio": found.hessian_ratio,
        "descriptor_distance": place.descriptor_distance,
    }
    if not why_refused(evidence, config):
        evidence["agreement"] = check.agreement(found.target_T_source)
    return _Hypothesis(found.target_T_source, evidence)


def _rank(hypothesis: _Hypothesis) -> tuple[float, float]:
    return hypothesis.evidence.get("agreement", -1.0), hypothesis.evidence["inlier_share"]


def _is_clear(hypothesis: _Hypothesis, config: MergeConfig) -> bool:
    evidence = hypothesis.evidence
    return (
        not why_refused(evidence, config)
        and evidence["inlier_share"] >= _CLEAR_INLIER_SHARE
        and evidence["agreement"] >= _CLEAR_AGREEMENT
    )


def _refined(
    before: PointMap,
    after: PointMap,
    before_T_after: Float64Array,
    evidence: Mapping[str, float],
    check: MapCheck,
) -> tuple[Float64Array, dict[str, float]]:
    """Register the whole maps coarsely; kept unless they then overlap less."""
    centre = before.points.mean(axis=0)
    found = small_gicp.align(
        before.points - centre,
        transform(before_T_after, after.points) - centre,
        registration_type="GICP",
        downsampling_resolution=_REFINE_CELL_M,
        max_correspondence_distance=2 * _REFINE_CELL_M,
        num_threads=1,
    )
    shift = make_pose(translation=centre)
    refined = shift @ found.T_target_source @ invert(shift) @ before_T_after
    share = check.overlap(refined)
    if share < evidence["overlap"]:
        return before_T_after, dict(evidence)
    return refined, {**evidence, "overlap": share, "overlap_before_refinement": evidence["overlap"]}
