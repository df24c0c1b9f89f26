"""Whole-map methods: the points that are new in either map are filtered and clustered; each cluster is an object.

The methods differ only in their `NewMask`, which decides whether a point is new. Regions, objects, scores and times are
computed in the same way for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.grid_index import GridIndex
from cdpipe.extract.crops import DIRECTIONS, SESSIONS
from cdpipe.extract.extract import make_report, measure_regions
from cdpipe.extract.objects import PointGroup, assemble_objects
from cdpipe.extract.point_comparison import cluster_inliers, is_within
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName
from cdpipe.query.difference import marked_share
from cdpipe.query.query import query_nearest, rank_regions


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMaps:
    """Both maps and their keyframe positions in the map frame.

    Attributes:
        merged: The merged maps, with the returns and poses of every scan, each session in its own odom frame.
        points: (N, 3) float64 map points of each session, map frame, metres.
        path: (K, 3) float64 position of the sensor at each keyframe, map frame, metres.
    """

    merged: MergedMaps
    points: dict[SessionName, Float64Array]
    path: dict[SessionName, Float64Array]


NewMask = Callable[[PlacedMaps, SessionName, SessionName, PipelineConfig], BoolArray]
"""`new_mask(maps, session, other, config)` returns the (N,) mask of the map points of `session` that `other` lacks."""


class WholeMap:
    """A registered method that compares both maps at once; decorates a `NewMask`.

    Only points within `query.radius_m` of the other session's path are compared; beyond that the other session saw too
    little for an empty place to be evidence. A region is the centroid of a cluster, its score is the cluster's number
    of map points, and `query.threshold` is in points. A cluster that is suppressed by a larger one is an object of that
    one's region. The score of a keyframe is the share of new points among the points of both maps within
    `query.radius_m`.

    Attributes:
        new_mask: Decides which points are new.
    """

    def __init__(self, new_mask: NewMask) -> None:
        self.new_mask = new_mask

    def detect(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeReport:
        """Compare, filter and cluster.

        Args:
            merged: Both maps, in one frame.
            before: Gives the keyframe scans of the before session.
            after: Gives those of the after session.
            config: `outlier`, `cluster` and `query` are used, and whatever `new_mask` uses.
        """
        start = perf_counter()
        before_path, after_path = merged.keyframe_positions(before, after)
        clouds = {name: merged.to_map(name, merged.map_of(name).points) for name in SESSIONS}
        maps = PlacedMaps(merged, clouds, {"before": before_path, "after": after_path})
        radius_m = config.query.fixed_radius_m
        groups: list[PointGroup] = []
        is_changed: dict[SessionName, BoolArray] = {}
        for session, other in DIRECTIONS:
            points = maps.points[session]
            new = np.flatnonzero(self.new_mask(maps, session, other, config))
            new = new[is_within(points[new], maps.path[other], radius_m)]
            found = cluster_inliers(points, new, config)
            groups += [PointGroup(session, indices, points[indices], -1) for indices in found]
            is_changed[session] = np.zeros(len(points), dtype=np.bool_)
            is_changed[session][np.concatenate([np.zeros(0, dtype=np.int64), *found])] = True
        regions = _cluster_regions(groups, maps, config)
        compared = perf_counter()
        answered = _in_reported_regions(groups, regions, config)
        grouped = perf_counter()
        objects = assemble_objects(merged, answered)
        end = perf_counter()
        seconds = {"t_cd_s": compared - start, "t_oe_s": end - compared, "t_returns_s": end - grouped}
        marked = [(points, is_changed[session]) for session, points in maps.points.items()]
        scores = marked_share(marked, before_path, radius_m)
        scores[~is_within(before_path, after_path, config.query.max_pair_m)] = np.nan
        regions = replace(regions, keyframe_scores=scores)
        index = GridIndex(maps.points["after"])
        figures = measure_regions(regions, answered, index.points_within)
        return make_report(merged, (before, after), regions, objects, figures, seconds, config)


def _cluster_regions(groups: Sequence[PointGroup], maps: PlacedMaps, config: PipelineConfig) -> ChangeRegions:
    centres = _centroids(groups)
    pairs = np.column_stack(
        [query_nearest(centres, maps.path["before"])[1], query_nearest(centres, maps.path["after"])[1]]
    )
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
    gaps_m, nearest = query_nearest(_centroids(groups), regions.centres_map[reported])
    reach_m = config.query.suppression * config.query.fixed_radius_m
    min_points = config.query.threshold if config.query.n_regions is None else 0.0
    return [
        PointGroup(group.session, group.indices, group.points_map, int(reported[region]))
        for group, gap_m, region in zip(groups, gaps_m, nearest, strict=True)
        if gap_m < reach_m and len(group.indices) >= min_points
    ]


def _centroids(groups: Sequence[PointGroup]) -> Float64Array:
    return np.array([group.points_map.mean(axis=0) for group in groups], dtype=np.float64).reshape(-1, 3)
