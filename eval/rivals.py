"""What the pipeline is measured against: comparisons of whole maps without regions, and regions drawn at random.

Every method takes two merged maps and gives the same report, so that `METHODS` can be run side by side. Their clocks
favour the rivals: what is computed for the tables only (figures, keyframe scores) is not counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.config import ExtractConfig, PipelineConfig
from cdpipe.detect import Comparison, compare, extracted, local_alignment
from cdpipe.difference import marked_share
from cdpipe.extract import (
    FIGURES,
    PointGroup,
    assemble_objects,
    hull_volume_m3,
)
from cdpipe.geometry import BoolArray, Float64Array, Int64Array, stream
from cdpipe.novelty import cluster_labels, far_points_mask, inlier_mask, new_points_mask
from cdpipe.query import rank_regions
from cdpipe.sphere import MapIndex
from cdpipe.types import ChangedObject, ChangeRegions, ChangeReport, DescriptorSet, MergedMaps, SessionName

NewMask = Callable[[Float64Array, Float64Array, ExtractConfig], BoolArray]

_DIRECTIONS: tuple[tuple[SessionName, SessionName], ...] = (("after", "before"), ("before", "after"))


@dataclass(frozen=True, slots=True, eq=False)
class _Maps:
    """Both maps and the places their keyframes were taken at, all in the map frame."""

    points: dict[SessionName, Float64Array]
    path: dict[SessionName, Float64Array]


def voxel_diff(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps as a whole: voxels in both directions, outlier filter, clusters; no descriptor is asked.

    Only points within `query.radius_m` of the other session's path are compared: farther off, the other session saw
    too little for an empty voxel to mean anything. A region is the centroid of a cluster, its score the cluster's
    number of map points, and `query.threshold` is in points. A cluster too near to a larger one is an object of that
    one's region.
    A keyframe's score is the changed share of the map points (both maps) within `query.radius_m`.

    Args:
        merged: Both maps, in one frame.
        before: Says which scans of the before session are keyframes.
        after: Likewise.
        config: `extract`, `outlier`, `cluster` and `query` are used.
    """
    return _whole_map(merged, before, after, config, new_points_mask)


def c2c(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps as `voxel_diff` does, but new is what is farther than `extract.distance_m` from the other map.

    The distance to the nearest point, cloud to cloud (C2C), as CloudCompare and others measure it.
    """
    return _whole_map(merged, before, after, config, far_points_mask)


def random_regions(
    merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
) -> ChangeReport:
    """Give every before keyframe that the after session came near to a random score; extract as the pipeline does.

    The draw depends on `config.seed` and on the sizes of the maps, so that different pairs get independent draws.
    """
    start = perf_counter()
    maps = _in_map_frame(merged, before, after)
    sizes = f"{len(merged.before.points)} {len(merged.after.points)}"
    gaps_m, partners = _nearest(maps.path["before"], maps.path["after"])
    scores = stream(config.seed, "random-regions", sizes).random(len(gaps_m))
    scores[gaps_m > config.query.max_pair_m] = np.nan
    pairs = np.column_stack([np.arange(len(scores)), partners])
    regions = rank_regions(maps.path["before"], scores, pairs, scores, config.query)
    return extracted(merged, regions, (before, after), perf_counter() - start, config)


METHODS: dict[str, Comparison] = {
    "descriptor": compare,
    "voxel-diff": voxel_diff,
    "c2c": c2c,
    "random-regions": random_regions,
}
USES_DESCRIPTORS = frozenset({"descriptor"})


def _whole_map(
    merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig, new_mask: NewMask
) -> ChangeReport:
    """Compare, filter and cluster; `new_mask` says which points of a cloud are not in another."""
    start = perf_counter()
    maps = _in_map_frame(merged, before, after)
    groups: list[PointGroup] = []
    is_changed: dict[SessionName, BoolArray] = {}
    for session, other in _DIRECTIONS:
        found = _changed_clusters(maps, session, other, config, new_mask)
        groups += [PointGroup(session, indices, maps.points[session][indices], -1) for indices in found]
        is_changed[session] = np.zeros(len(maps.points[session]), dtype=np.bool_)
        is_changed[session][np.concatenate([np.zeros(0, dtype=np.int64), *found])] = True
    regions = _cluster_regions(groups, maps, config)
    compared = perf_counter()
    answered = _in_reported_regions(groups, regions, config)
    grouped = perf_counter()
    objects = assemble_objects(merged, answered)
    seconds = _seconds(start, compared, grouped, perf_counter())
    regions = replace(regions, keyframe_scores=_changed_share(maps, is_changed, config))
    return _report(merged, (before, after), regions, objects, _figures(maps, regions, objects), seconds, config)


def _in_map_frame(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet) -> _Maps:
    after_path = merged.after.odom_T_sensor[after.keyframe_scans, :3, 3]
    return _Maps(
        points={"before": merged.before.points, "after": merged.alignment.to_map(merged.after.points)},
        path={
            "before": merged.before.odom_T_sensor[before.keyframe_scans, :3, 3],
            "after": merged.alignment.to_map(after_path),
        },
    )


def _changed_clusters(
    maps: _Maps, session: SessionName, other: SessionName, config: PipelineConfig, new_mask: NewMask
) -> list[Int64Array]:
    """Return the map point indices of every cluster that is in one map only, largest first."""
    points = maps.points[session]
    new = np.flatnonzero(new_mask(points, maps.points[other], config.extract))
    gaps_m, _ = _nearest(points[new], maps.path[other])
    new = new[gaps_m <= config.query.radius_m]
    new = new[inlier_mask(points[new], config.outlier)]
    labels = cluster_labels(points[new], config.cluster)
    return [new[labels == label] for label in range(labels.max(initial=-1) + 1)]


def _cluster_regions(groups: Sequence[PointGroup], maps: _Maps, config: PipelineConfig) -> ChangeRegions:
    centres = _centroids(groups)
    pairs = np.column_stack([_nearest(centres, maps.path["before"])[1], _nearest(centres, maps.path["after"])[1]])
    scores = np.array([len(group.indices) for group in groups], dtype=np.float64)
    no_scores = np.full(len(maps.path["before"]), np.nan)
    return rank_regions(centres, scores, pairs, no_scores, config.query)


def _in_reported_regions(
    groups: Sequence[PointGroup], regions: ChangeRegions, config: PipelineConfig
) -> list[PointGroup]:
    """Return the clusters of the reported regions: their own, and those they suppressed that pass the threshold."""
    reported = np.flatnonzero(regions.is_reported)
    if len(reported) == 0 or not groups:
        return []
    gaps_m, nearest = _nearest(_centroids(groups), regions.centres_map[reported])
    reach_m = config.query.suppression * config.query.radius_m
    min_points = config.query.threshold if config.query.n_regions is None else 0.0
    return [
        PointGroup(group.session, group.indices, group.points_map, int(reported[region]))
        for group, gap_m, region in zip(groups, gaps_m, nearest, strict=True)
        if gap_m < reach_m and len(group.indices) >= min_points
    ]


def _nearest(points: Float64Array, others: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Return the distance and the index of the nearest of `others` for each point."""
    gaps_m, indices = cKDTree(others).query(points)
    return np.asarray(gaps_m, dtype=np.float64), np.asarray(indices, dtype=np.int64)


def _centroids(groups: Sequence[PointGroup]) -> Float64Array:
    return np.array([group.points_map.mean(axis=0) for group in groups], dtype=np.float64).reshape(-1, 3)


def _changed_share(maps: _Maps, is_changed: dict[SessionName, BoolArray], config: PipelineConfig) -> Float64Array:
    """Return the (K,) changed share around each before keyframe; NaN where the after session never came near."""
    clouds = [(points, is_changed[session]) for session, points in maps.points.items()]
    scores = marked_share(clouds, maps.path["before"], config.query.radius_m)
    gaps_m, _ = _nearest(maps.path["before"], maps.path["after"])
    return np.where(gaps_m <= config.query.max_pair_m, scores, np.nan)


def _figures(maps: _Maps, regions: ChangeRegions, objects: Sequence[ChangedObject]) -> dict[str, Float64Array]:
    """Return the volume table by the definition of `cut_out`: all four figures are of the after map."""
    figures = {name: np.full(len(regions.scores), np.nan) for name in FIGURES}
    index = MapIndex(maps.points["after"])
    for region in np.flatnonzero(regions.is_reported).tolist():
        sphere = maps.points["after"][index.crop(regions.centres_map[region], regions.radius_m)]
        own = [item.points_map for item in objects if item.region == region and item.session == "after"]
        figures["v_sphere_m3"][region] = hull_volume_m3(sphere)
        figures["v_oe_m3"][region] = sum(hull_volume_m3(points) for points in own)
        figures["s_points"][region] = len(sphere)
        figures["oe_points"][region] = sum(len(points) for points in own)
    return figures


def _seconds(start: float, compared: float, grouped: float, end: float) -> dict[str, float]:
    """Return the times as `cdpipe.detect.compare` names them: `t_returns_s` is a part of `t_oe_s`."""
    return {"t_cd_s": compared - start, "t_oe_s": end - compared, "t_returns_s": end - grouped}


def _report(
    merged: MergedMaps,
    described: tuple[DescriptorSet, DescriptorSet],
    regions: ChangeRegions,
    objects: tuple[ChangedObject, ...],
    figures: dict[str, Float64Array],
    seconds: dict[str, float],
    config: PipelineConfig,
) -> ChangeReport:
    return ChangeReport(
        before_T_after=merged.before_T_after,
        evidence=merged.evidence,
        regions=regions,
        objects=objects,
        seconds=seconds,
        figures=figures,
        keyframe_scans=(described[0].keyframe_scans, described[1].keyframe_scans),
        config=config.model_dump(),
        local_before_T_after=local_alignment(merged, described[1]),
    )
