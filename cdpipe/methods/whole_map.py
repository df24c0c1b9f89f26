"""Whole-map comparisons as sources of regions: what is new in either map is filtered and clustered.

Each cluster is a region. The sources differ only in their `NewMask`, which decides whether a point is new. Regions,
clusters and scores are computed in the same way for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.extract.clusters import cluster_centroids, cluster_groups
from cdpipe.extract.crops import DIRECTIONS, SESSIONS
from cdpipe.extract.point_comparison import cluster_inliers, is_within
from cdpipe.model.config import ClusterConfig, PipelineConfig
from cdpipe.model.report import ChangeRegions, Clusters
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName
from cdpipe.query.difference import marked_share
from cdpipe.query.drift_width import LEAST_RADIUS_M, keyframe_radii
from cdpipe.query.query import query_nearest, rank_regions, score_keyframes_by_share

_STATION_M = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMaps:
    """Both maps and their keyframe positions in the map frame.

    Attributes:
        merged: The merged maps, with the returns and poses of every scan, each session in its own odom frame.
        points: (N, 3) float64 map points of each session, map frame, metres.
        path: (K, 3) float64 position of the sensor at each keyframe, map frame, metres.
        radii_m: (K,) float64 radius of a region at each keyframe, metres.
    """

    merged: MergedMaps
    points: dict[SessionName, Float64Array]
    path: dict[SessionName, Float64Array]
    radii_m: dict[SessionName, Float64Array]

    def is_compared(self, session: SessionName, other: SessionName) -> BoolArray:
        """Mark the (N,) map points of `session` that lie within a region's radius of the path of `other`."""
        radii_m = self.radii_m[other]
        if len(radii_m) == 0:
            return np.zeros(len(self.points[session]), dtype=np.bool_)
        # the bound of the search excludes the border, so it is slightly larger
        gaps_m, nearest = cKDTree(self.path[other]).query(
            self.points[session], distance_upper_bound=radii_m.max() * (1 + 1e-6)
        )
        return np.asarray(gaps_m <= np.append(radii_m, -1.0)[nearest])

    def compared_in_odom(self, session: SessionName, other: SessionName) -> tuple[Int64Array, Float64Array]:
        """Return the (C,) compared map points of `session` and their (C, 3) positions in the odom frame of `other`."""
        compared = np.flatnonzero(self.is_compared(session, other))
        return compared, self.merged.to_odom(other, self.points[session][compared])

    def scans(self, session: SessionName, every_scan: int) -> Iterator[tuple[Float64Array, Float64Array]]:
        """Return the (4, 4) odom_T_sensor and the (R, 3) returns, odom frame, of the `choose_scans` of a session."""
        point_map = self.merged.map_of(session)
        for scan in choose_scans(point_map.odom_T_sensor, every_scan).tolist():
            returns = np.arange(*point_map.scan_offsets[scan : scan + 2])
            yield point_map.odom_T_sensor[scan], point_map.positions_of(returns)


def choose_scans(odom_T_sensor: Float64Array, every_scan: int) -> Int64Array:
    """Return every n-th of (S, 4, 4) scans, and each that lies more than 3 m from its neighbours.

    A drive at 10 Hz sees a place in many scans; a station of a survey is the only scan of its place.
    """
    is_far = np.linalg.norm(np.diff(odom_T_sensor[:, :3, 3], axis=0), axis=1) > _STATION_M
    is_station = np.append(True, is_far) & np.append(is_far, True)
    return np.flatnonzero((np.arange(len(odom_T_sensor)) % every_scan == 0) | is_station)


NewMask = Callable[[PlacedMaps, SessionName, SessionName, PipelineConfig], BoolArray]
"""`new_mask(maps, session, other, config)` returns the (N,) mask of the map points of `session` that `other` lacks."""


class WholeMap:
    """A registered source of regions that compares both maps at once; decorates a `NewMask`.

    Only points within a region's radius of the other session's path are compared; beyond that the other session saw
    too little for an empty place to be evidence. A region is the centroid of a cluster, its score is the cluster's
    number of map points, and `query.threshold` is in points. With `extract.method: clusters` the clusters are the
    objects; one that is suppressed by a larger one is an object of that one's region. The score of a keyframe is the
    share of new points among the points of both maps within `query.radius_m` (`width`: 4.5 m).

    Attributes:
        new_mask: Decides which points are new.
    """

    has_clusters = True

    def __init__(self, new_mask: NewMask) -> None:
        self.new_mask = new_mask

    def propose(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeRegions:
        """Compare, filter and cluster.

        Args:
            merged: Both maps, in one frame.
            before: Gives the keyframe scans of the before session.
            after: Gives those of the after session.
            config: `outlier`, `cluster.radius_m`, `regions.min_points` and `query` are used, and whatever `new_mask`
                uses.
        """
        maps = _place(merged, before, after, config)
        clusters_of = ClusterConfig(radius_m=config.cluster.radius_m, min_points=config.regions.min_points)
        found: list[Int64Array] = []
        is_after: list[bool] = []
        is_changed: dict[SessionName, BoolArray] = {}
        for session, other in DIRECTIONS:
            points = maps.points[session]
            new = np.flatnonzero(self.new_mask(maps, session, other, config) & maps.is_compared(session, other))
            of_session = cluster_inliers(points, new, config.outlier, clusters_of)
            found += of_session
            is_after += [session == "after"] * len(of_session)
            is_changed[session] = np.zeros(len(points), dtype=np.bool_)
            is_changed[session][np.concatenate([np.zeros(0, dtype=np.int64), *of_session])] = True
        clusters = Clusters(
            is_after=np.array(is_after, dtype=np.bool_),
            points=np.concatenate([np.zeros(0, dtype=np.int64), *found]),
            starts=np.cumsum([0, *map(len, found)], dtype=np.int64),
        )
        marked = [(points, is_changed[session]) for session, points in maps.points.items()]
        radius_m = LEAST_RADIUS_M if config.query.radius_m == "width" else config.query.radius_m
        shares = marked_share(marked, maps.path["before"], radius_m)
        shares[~is_within(maps.path["before"], maps.path["after"], config.query.max_pair_m)] = np.nan
        keyframe_scores = score_keyframes_by_share(shares, merged, before, after, config.query)
        return replace(_rank_clusters(clusters, maps, keyframe_scores, config), clusters=clusters)


def _place(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> PlacedMaps:
    paths = merged.keyframe_positions(before, after)
    radii_m = [
        keyframe_radii(merged.map_of(name), described.keyframe_scans, config.query)
        for name, described in zip(SESSIONS, (before, after), strict=True)
    ]
    points = {name: merged.to_map(name, merged.map_of(name).points) for name in SESSIONS}
    return PlacedMaps(
        merged, points, dict(zip(SESSIONS, paths, strict=True)), dict(zip(SESSIONS, radii_m, strict=True))
    )


def _rank_clusters(
    clusters: Clusters, maps: PlacedMaps, keyframe_scores: Float64Array, config: PipelineConfig
) -> ChangeRegions:
    groups = cluster_groups(clusters, maps.points)
    centres = cluster_centroids(groups)
    nearest = {name: query_nearest(centres, maps.path[name])[1] for name in SESSIONS}
    scores = np.array([len(group.indices) for group in groups], dtype=np.float64)
    pairs = np.column_stack([nearest["before"], nearest["after"]])
    radii_m = maps.radii_m["before"][nearest["before"]] if len(maps.radii_m["before"]) else np.zeros(len(scores))
    return rank_regions(centres, scores, pairs, keyframe_scores, config.query, radii_m=radii_m)
