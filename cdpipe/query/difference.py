"""The sphere difference, a baseline without learning: share of the points around a keyframe that only one map has.

It requires the points of both maps; the learned sphere descriptor stores 64 numbers per keyframe.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.extract.point_comparison import is_within
from cdpipe.model.config import QueryConfig
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName
from cdpipe.query.drift_width import LEAST_RADIUS_M

# 1.5 voxels of a map with 0.2 m voxels; below it, gaps between points count as changes.
NEW_BEYOND_M = 0.3


def sphere_difference(
    merged: MergedMaps,
    before: DescriptorSet,
    after: DescriptorSet,
    config: QueryConfig,
    session: SessionName = "before",
) -> Float64Array:
    """Score every keyframe of a session by the share of points around it that are over 0.3 m from the other map.

    The share is over the points of both maps within `radius_m` of the keyframe and within `radius_m` of a keyframe of
    the other session. Beyond that the other session saw too little to compare. Where the radius of a region follows the
    width of the drift, 4.5 m take its place, so that the same change has the same score everywhere.

    Args:
        merged: Both maps.
        before: Gives the keyframe scans of the before session.
        after: Gives those of the after session.
        config: `radius_m` and `max_pair_m` are used.
        session: The session of the K keyframes.

    Returns:
        (K,) shares in [0, 1]; NaN for a keyframe without points or without one of the other within `max_pair_m`.
    """
    radius_m = LEAST_RADIUS_M if config.radius_m == "width" else config.radius_m
    before_path, after_path = merged.keyframe_positions(before, after)
    seen_before = merged.before.points[is_within(merged.before.points, after_path, radius_m)]
    after_points = merged.alignment.to_map(merged.after.points)
    # after points far from every before keyframe are in no sphere, so they need no distance
    seen_after = after_points[is_within(after_points, before_path, radius_m)]
    # distances are to the full other map: a point at the edge of the shared part has neighbours beyond the edge
    clouds = [
        (seen_before, ~is_within(seen_before, after_points, NEW_BEYOND_M)),
        (seen_after, ~is_within(seen_after, merged.before.points, NEW_BEYOND_M)),
    ]
    path, other_path = (before_path, after_path) if session == "before" else (after_path, before_path)
    scores = marked_share(clouds, path, radius_m)
    scores[~is_within(path, other_path, config.max_pair_m)] = np.nan
    return scores


def marked_share(
    clouds: Sequence[tuple[Float64Array, BoolArray]], centres: Float64Array, radius_m: float
) -> Float64Array:
    """Return the (K,) share of marked points in each sphere, all clouds together; NaN for an empty sphere.

    Args:
        clouds: For each cloud its points (N, 3), metres, and the mask (N,) of the marked ones; one frame.
        centres: (K, 3) sphere centres, same frame, metres.
        radius_m: Sphere radius, border included.
    """
    n_marked, n_all = np.zeros(len(centres)), np.zeros(len(centres))
    for points, is_marked in clouds:
        index = GridIndex(points)
        for row, centre in enumerate(centres):
            inside = index.crop(centre, radius_m)
            n_all[row] += len(inside)
            n_marked[row] += np.count_nonzero(is_marked[inside])
    return np.where(n_all > 0, n_marked / np.maximum(n_all, 1.0), np.nan)
