"""The rule `clusters`: what the source of the regions cut out itself is the objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.distance import cdist

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.extract.crops import SESSIONS
from cdpipe.extract.objects import PointGroup
from cdpipe.model.config import QueryConfig
from cdpipe.model.report import ChangeRegions, Clusters
from cdpipe.model.types import MergedMaps, SessionName


def take_clusters(merged: MergedMaps, regions: ChangeRegions, config: QueryConfig) -> list[PointGroup]:
    """Return the clusters of the reported regions: their own, and those they suppressed that pass the threshold.

    A suppressed cluster goes to the nearest of the regions that are near enough to suppress it.

    Args:
        merged: Both maps.
        regions: Candidates, with the clusters of their source.
        config: Suppression distance, and threshold, in points.

    Raises:
        InputError: The source has no clusters.
    """
    if regions.clusters is None:
        raise InputError("extract.method = clusters: the source of these regions cut out nothing itself")
    reported = np.flatnonzero(regions.is_reported)
    points = {name: merged.to_map(name, merged.map_of(name).points) for name in SESSIONS}
    groups = cluster_groups(regions.clusters, points)
    if len(reported) == 0 or not groups:
        return []
    gaps_m = cdist(cluster_centroids(groups), regions.centres_map[reported])
    gaps_m[gaps_m >= config.suppression * regions.radii_m[reported]] = np.inf
    min_points = config.threshold if config.n_regions is None else 0.0
    return [
        PointGroup(group.session, group.indices, group.points_map, int(reported[np.argmin(gap_m)]))
        for group, gap_m in zip(groups, gaps_m, strict=True)
        if np.isfinite(gap_m).any() and len(group.indices) >= min_points
    ]


def cluster_groups(clusters: Clusters, points_map: Mapping[SessionName, Float64Array]) -> list[PointGroup]:
    """Return each cluster as a group of points, in no region.

    Args:
        clusters: Groups of map points.
        points_map: (N, 3) map points of each session, map frame, metres.
    """
    groups = []
    for index, is_after in enumerate(clusters.is_after.tolist()):
        session: SessionName = "after" if is_after else "before"
        indices = clusters.points[clusters.starts[index] : clusters.starts[index + 1]]
        groups.append(PointGroup(session, indices, points_map[session][indices], -1))
    return groups


def cluster_centroids(groups: Sequence[PointGroup]) -> Float64Array:
    """Return the (C, 3) centroid of each group, map frame, metres."""
    return np.array([group.points_map.mean(axis=0) for group in groups], dtype=np.float64).reshape(-1, 3)
