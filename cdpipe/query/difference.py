"""The sphere difference: how much of what stands around a keyframe is in one map only, counted by hand.

What a learned descriptor of spheres has to beat. It needs the points of both maps, not 64 numbers a keyframe.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.grid_index import GridIndex
from cdpipe.extract.point_comparison import is_within
from cdpipe.model.config import QueryConfig
from cdpipe.model.types import DescriptorSet, MergedMaps

# One and a half cells of a map thinned at 0.2 m: nearer, the gaps between the points pass for changes.
NEW_BEYOND_M = 0.3


def sphere_difference(
    merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: QueryConfig
) -> Float64Array:
    """Score every before keyframe by the share of the points around it that are farther than 0.3 m from the other map.

    Counted are the points of both maps within `radius_m` of the keyframe; of these only what lies within `radius_m` of
    a keyframe of the other session too, since farther off the other session saw too little to tell.

    Args:
        merged: Both maps.
        before: Says which scans of the before session are keyframes.
        after: Likewise.
        config: `radius_m` and `max_pair_m` are used.

    Returns:
        (Kb,) shares in [0, 1]; NaN for a keyframe that the after session never came within `max_pair_m` of, or that
        nothing comparable stands around.
    """
    before_path = merged.before.odom_T_sensor[before.keyframe_scans, :3, 3]
    after_path = merged.alignment.to_map(merged.after.odom_T_sensor[after.keyframe_scans, :3, 3])
    seen_before = merged.before.points[is_within(merged.before.points, after_path, config.radius_m)]
    after_points = merged.alignment.to_map(merged.after.points)
    # of the after map what is left out stands around no keyframe anyway, and need not be asked for its distance
    seen_after = after_points[is_within(after_points, before_path, config.radius_m)]
    # against the whole other map: what stands at the edge of the comparable part has its neighbours beyond it
    clouds = [
        (seen_before, ~is_within(seen_before, after_points, NEW_BEYOND_M)),
        (seen_after, ~is_within(seen_after, merged.before.points, NEW_BEYOND_M)),
    ]
    scores = marked_share(clouds, before_path, config.radius_m)
    scores[~is_within(before_path, after_path, config.max_pair_m)] = np.nan
    return scores


def marked_share(
    clouds: Sequence[tuple[Float64Array, BoolArray]], centres: Float64Array, radius_m: float
) -> Float64Array:
    """Return the (K,) share of marked points among those of all clouds within `radius_m` of each of (K, 3) centres.

    NaN where there is none.

    Args:
        clouds: Points (N, 3) and the mask (N,) of the marked ones, of each cloud; one frame, metres.
        centres: (K, 3) same frame.
        radius_m: The border counts as inside.
    """
    n_marked, n_all = np.zeros(len(centres)), np.zeros(len(centres))
    for points, is_marked in clouds:
        index = GridIndex(points)
        for row, centre in enumerate(centres):
            inside = index.crop(centre, radius_m)
            n_all[row] += len(inside)
            n_marked[row] += np.count_nonzero(is_marked[inside])
    return np.where(n_all > 0, n_marked / np.maximum(n_all, 1.0), np.nan)
