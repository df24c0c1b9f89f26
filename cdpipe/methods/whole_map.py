"""A comparison of whole maps without regions: what is new in either map, filtered and clustered, becomes the answer.

Only what calls a point new differs from method to method: a `NewMask`. Regions, objects, scores and times are found in
the same way for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.grid_index import GridIndex
from cdpipe.extract.extract import FIGURES, hull_volume_m3, make_report
from cdpipe.extract.objects import PointGroup, assemble_objects
from cdpipe.extract.point_comparison import inlier_mask, label_clusters
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName
from cdpipe.query.difference import marked_share
from cdpipe.query.query import rank_regions

_DIRECTIONS: tuple[tuple[SessionName, SessionName], ...] = (("after", "before"), ("before", "after"))


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMaps:
    """Both maps and the places their keyframes were taken at.

    Attributes:
        merged: What they were made from: returns and poses of every scan, each session in its own odom frame.
        points: (N, 3) float64 map points of each session, map frame, metres.
        path: (K, 3) float64 position of the sensor at each keyframe, map frame, metres.
    """

    merged: MergedMaps
    points: dict[SessionName, Float64Array]
    path: dict[SessionName, Float64Array]

    def is_comparable(self, points: Float64Array, other: SessionName, radius_m: float) -> BoolArray:
        """(N,) whether the session `other` passed within `radius_m` of each of (N, 3) points, map frame."""
        return nearest_of(points, self.path[other])[0] <= radius_m


NewMask = Callable[[PlacedMaps, SessionName, SessionName, PipelineConfig], BoolArray]
"""`new_mask(maps, session, other, config)`: (N,) which map points of `session` are not in `other`."""


def whole_map(
    merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig, new_mask: NewMask
) -> ChangeReport:
    """Compare, filter and cluster; `new_mask` says which points of a map are not in the other.

    Only points within `query.radius_m` of the other session's path are compared: farther off, the other session saw
    too little for an empty place to mean anything. A region is the centroid of a cluster, its score the cluster's
    number of map points, and `query.threshold` is in points. A cluster too near to a larger one is an object of that
    one's region.
    A keyframe's score is the changed share of the map points (both maps) within `query.radius_m`.

    Args:
        merged: Both maps, in one frame.
        before: Says which scans of the before session are keyframes.
        after: Likewise.
        config: `outlier`, `cluster` and `query` are used, and whatever `new_mask` uses.
        new_mask: What tells the methods apart.
    """
    start = perf_counter()
    maps = placed_maps(merged, before, after)
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
    end = perf_counter()
    seconds = {"t_cd_s": compared - start, "t_oe_s": end - compared, "t_returns_s": end - grouped}
    regions = replace(regions, keyframe_scores=_changed_share(maps, is_changed, config))
    return make_report(merged, (before, after), regions, objects, _figures(maps, regions, objects), seconds, config)


def placed_maps(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet) -> PlacedMaps:
    """Put both maps and the positions of the keyframes into the map frame."""
    after_path = merged.after.odom_T_sensor[after.keyframe_scans, :3, 3]
    return PlacedMaps(
        merged=merged,
        points={"before": merged.before.points, "after": merged.alignment.to_map(merged.after.points)},
        path={
            "before": merged.before.odom_T_sensor[before.keyframe_scans, :3, 3],
            "after": merged.alignment.to_map(after_path),
        },
    )


def _changed_clusters(
    maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig, new_mask: NewMask
) -> list[Int64Array]:
    """Return the map point indices of every cluster that is in one map only, largest first."""
    points = maps.points[session]
    new = np.flatnonzero(new_mask(maps, session, other, config))
    new = new[maps.is_comparable(points[new], other, config.query.radius_m)]
    new = new[inlier_mask(points[new], config.outlier)]
    labels = label_clusters(points[new], config.cluster)
    return [new[labels == label] for label in range(labels.max(initial=-1) + 1)]


def _cluster_regions(groups: Sequence[PointGroup], maps: PlacedMaps, config: PipelineConfig) -> ChangeRegions:
    centres = _centroids(groups)
    pairs = np.column_stack([nearest_of(centres, maps.path["before"])[1], nearest_of(centres, maps.path["after"])[1]])
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
    gaps_m, nearest = nearest_of(_centroids(groups), regions.centres_map[reported])
    reach_m = config.query.suppression * config.query.radius_m
    min_points = config.query.threshold if config.query.n_regions is None else 0.0
    return [
        PointGroup(group.session, group.indices, group.points_map, int(reported[region]))
        for group, gap_m, region in zip(groups, gaps_m, nearest, strict=True)
        if gap_m < reach_m and len(group.indices) >= min_points
    ]


def nearest_of(points: Float64Array, others: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Return the distance and the index of the nearest of `others` for each point."""
    gaps_m, indices = cKDTree(others).query(points)
    return np.asarray(gaps_m, dtype=np.float64), np.asarray(indices, dtype=np.int64)


def _centroids(groups: Sequence[PointGroup]) -> Float64Array:
    return np.array([group.points_map.mean(axis=0) for group in groups], dtype=np.float64).reshape(-1, 3)


def _changed_share(maps: PlacedMaps, is_changed: dict[SessionName, BoolArray], config: PipelineConfig) -> Float64Array:
    """Return the (K,) changed share around each before keyframe; NaN where the after session never came near."""
    clouds = [(points, is_changed[session]) for session, points in maps.points.items()]
    scores = marked_share(clouds, maps.path["before"], config.query.radius_m)
    gaps_m, _ = nearest_of(maps.path["before"], maps.path["after"])
    return np.where(gaps_m <= config.query.max_pair_m, scores, np.nan)


def _figures(maps: PlacedMaps, regions: ChangeRegions, objects: Sequence[ChangedObject]) -> dict[str, Float64Array]:
    """Return the volume table by the definition of `measure_regions`: all four figures are of the after map."""
    figures = {name: np.full(len(regions.scores), np.nan) for name in FIGURES}
    index = GridIndex(maps.points["after"])
    for region in np.flatnonzero(regions.is_reported).tolist():
        sphere = maps.points["after"][index.crop(regions.centres_map[region], regions.radius_m)]
        own = [item.points_map for item in objects if item.region == region and item.session == "after"]
        figures["v_sphere_m3"][region] = hull_volume_m3(sphere)
        figures["v_oe_m3"][region] = sum(hull_volume_m3(points) for points in own)
        figures["s_points"][region] = len(sphere)
        figures["oe_points"][region] = sum(len(points) for points in own)
    return figures
