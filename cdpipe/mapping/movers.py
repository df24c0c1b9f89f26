"""What moved while a session was recorded: places that the session itself saw through, before or after it hit them.

A thing that stands is hit by most keyframes that see its place. A person who walks is hit there by a few; the others
see the rock behind. So a map point is a mover's if more keyframes of its own session saw through it than hit it, and if
many such points lie together. Removert and DUFOMap (`cdpipe/methods/RIVALS.md`) clean maps by the same evidence.

Water mirrors: a scan that sees the roof in a puddle sees through the floor. So points that lie on one level sheet are
no mover's. Where floor is dropped with something else, it is not said to have moved: nothing beside it is part of a
machine.

What stands still for as long as the robot looks at it is not told.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.geometry.planes import is_level_sheet
from cdpipe.core.spooled import SpooledArray
from cdpipe.mapping.free_space import count_through_and_hit
from cdpipe.model.types import KeyframeViews, PointMap

# Simulated validation tunnels (`dynamic/null` 10001, `dynamic/narrow` 10006; `narrow` 10020 and 10021 with KISS-ICP's
# poses), map points of 0.2 m. A person who walks 4 to 12 m leaves 410 to 920 points of the stricter kind together, bars
# of railings and legs of chairs 27 at most. So maps of sessions in which nothing moves stay as they are.
_LEAST_POINTS, _OF_CELLS_M = 60, 0.2
_LINK_CELLS = 2.0
# The stricter kind was seen through by so many keyframes, and so many times as many as hit it; the other by more.
_STRICT_THROUGH, _STRICT_FACTOR, _LEAST_THROUGH = 3, 2, 2
# Thickness of a sheet. Floors under water (`water/null` 10005 and 10006) are 0.07 to 0.12 m thick.
_SHEET_M = 0.3
# Of what is dropped beside things that stand in a puddle (`water/narrow` 10011) the middle 80 % are 0.13 m high within
# 2.5 m, of trucks (`dust/haul` 10012 and 10013) 0.5 to 1.9 m.
_COLUMN_M = 2.5
# Points are held against the keyframes around their block.
_BLOCK_M = 8.0
_BLOCK_RETURNS = 1 << 22


def drop_movers(point_map: PointMap) -> PointMap:
    """Return a map without the points of movers and their returns, which says what was left out of which scan.

    It is the same map where there are none.

    Args:
        point_map: The map of one session, with range images of its keyframes.

    Raises:
        ValueError: The map has no range images.
    """
    if point_map.views is None:
        raise ValueError("views is None: movers are told by the range images of the keyframes")
    is_kept = ~find_movers(point_map.points, point_map.views, point_map.voxel_m)
    if is_kept.all() or not is_kept.any():
        return point_map
    dropped = np.flatnonzero(~is_kept)
    is_body = np.zeros_like(is_kept)
    is_body[dropped] = _stand_up(point_map.points[dropped], point_map.voxel_m)
    points, scans = _list_hits(point_map, is_body)
    return replace(_keep(point_map, is_kept), mover_points=points, mover_scans=scans)


def find_movers(points_odom: Float64Array, views: KeyframeViews, voxel_m: float) -> BoolArray:
    """Mark the (N,) points of movers.

    Args:
        points_odom: (N, 3) points of a session's map, its odom frame, metres.
        views: Range images of its keyframes.
        voxel_m: Cell of the map, metres: smaller cells hold a surface in more points.
    """
    n_through, n_hit = _count(points_odom, views)
    is_mover = (n_through >= _LEAST_THROUGH) & (n_through > n_hit)
    is_strict = is_mover & (n_through >= _STRICT_THROUGH) & (n_through > _STRICT_FACTOR * n_hit)
    found = np.flatnonzero(is_mover)
    labels, sizes = label_groups(points_odom[found], _LINK_CELLS * voxel_m)
    n_strict = np.bincount(labels, is_strict[found], len(sizes))
    is_group = n_strict >= _LEAST_POINTS * (_OF_CELLS_M / voxel_m) ** 2
    for label in np.flatnonzero(is_group):
        is_group[label] = not is_level_sheet(points_odom[found[(labels == label) & is_strict[found]]], _SHEET_M)
    is_mover[found] = is_group[labels]
    return is_mover


def _stand_up(points_odom: Float64Array, voxel_m: float) -> BoolArray:
    """Return which of (N, 3) points are of a group most of which, by columns of 2.5 m, is higher than a floor."""
    columns = np.unique(np.floor(points_odom[:, :2] / _COLUMN_M), axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(columns, kind="stable")
    is_upright = np.zeros(len(points_odom), dtype=np.bool_)
    for own in np.split(order, np.flatnonzero(np.diff(columns[order])) + 1):
        low_m, high_m = np.quantile(points_odom[own, 2], (0.1, 0.9)) if len(own) else (0.0, 0.0)
        is_upright[own] = high_m - low_m > _SHEET_M
    labels, sizes = label_groups(points_odom, _LINK_CELLS * voxel_m)
    return np.asarray((np.bincount(labels, is_upright, len(sizes)) > sizes / 2)[labels], dtype=np.bool_)


def _count(points_odom: Float64Array, views: KeyframeViews) -> tuple[Int64Array, Int64Array]:
    """Return how many keyframes saw through each of (N, 3) points, and how many hit it, block by block of the plan."""
    n_through, n_hit = np.zeros((2, len(points_odom)), dtype=np.int64)
    _, blocks = np.unique(np.floor(points_odom[:, :2] / _BLOCK_M), axis=0, return_inverse=True)
    order = np.argsort(blocks, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(blocks[order])) + 1):
        n_through[own], n_hit[own] = count_through_and_hit(points_odom[own], views)
    return n_through, n_hit


def _list_hits(point_map: PointMap, is_chosen: BoolArray) -> tuple[Float32Array, Int32Array]:
    """Return (D, 3) chosen ones of the (N,) points, each once for every scan that hit it, and (D,) that scan."""
    returns = np.flatnonzero(is_chosen[point_map.return_points])
    hits = point_map.scans_of(returns) * np.int64(len(is_chosen)) + point_map.return_points[returns]
    scans, points = np.divmod(np.unique(hits), len(is_chosen))
    return point_map.points[points].astype(np.float32), scans.astype(np.int32)


def _keep(point_map: PointMap, is_kept: BoolArray) -> PointMap:
    """Return a map with the (N,) kept points alone, and with their returns."""
    rank = np.cumsum(is_kept, dtype=np.int32) - 1
    points, pixels, offsets = SpooledArray(np.int32), SpooledArray(np.int32), SpooledArray(np.uint8, (3,))
    scan_offsets, n_kept = np.zeros_like(point_map.scan_offsets), 0
    for start in range(0, len(point_map.return_points), _BLOCK_RETURNS):
        own = slice(start, start + _BLOCK_RETURNS)
        stays = is_kept[point_map.return_points[own]]
        points.append(rank[point_map.return_points[own][stays]])
        pixels.append(point_map.return_pixels[own][stays])
        if point_map.return_offsets is not None:
            offsets.append(point_map.return_offsets[own][stays])
        before = n_kept + np.concatenate([[0], np.cumsum(stays)])  # kept returns before each return
        is_inside = (point_map.scan_offsets > start) & (point_map.scan_offsets <= start + len(stays))
        scan_offsets[is_inside] = before[point_map.scan_offsets[is_inside] - start]
        n_kept = int(before[-1])
    return replace(
        point_map,
        points=point_map.points[is_kept],
        nearest_m=point_map.nearest_m[is_kept],
        seen_from=None if point_map.seen_from is None else point_map.seen_from[is_kept],
        return_points=points.finish(),
        return_pixels=pixels.finish(),
        return_offsets=None if point_map.return_offsets is None else offsets.finish(),
        scan_offsets=scan_offsets,
    )
