"""ERASOR (Lim, Hwang, Myung 2021): what stands in columns that the other session's scans found flat.

ERASOR removes moving objects from a map. Around the sensor it divides the plane into rings and sectors. The height of a
column is that from its lowest to its highest point. Where the column of the scan is much lower than that of the map,
the map's points are removed, except for the ground, to which a plane is fitted. For two sessions, the scans of one are
compared to the map points of the other, in both directions. Under a roof and between walls all columns are high, so
that the test finds next to nothing there (RIVALS.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.methods.whole_map import PlacedMaps, WholeMap, choose_scans
from cdpipe.model.config import ErasorConfig, PipelineConfig
from cdpipe.model.types import SessionName

# The authors' values: rings and sectors; the lowest point of a column, from the floor; the fewest points of a scan's
# column; the height above the floor that an object reaches.
_RINGS, _SECTORS = 20, 108
_LOWEST_M = -1.3
_LEAST_POINTS = 6
_LEAST_HEIGHT_M = 0.2
# The ground of a column: seeds lie within 0.5 m of the mean of its 20 lowest points; three planes are fitted, each to
# what lies less than 0.15 m above the one before.
_N_LOWEST = 20
_SEED_M = 0.5
_N_PLANES = 3
_GROUND_M = 0.15
# The floor under the sensor is the lowest twentieth of the map points within 3 m in plan.
_FLOOR_SHARE = 0.05
_FLOOR_M = 3.0


@WholeMap
def erasor(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` above the ground of a column that a scan of `other` found flat.

    As published one scan suffices. The points of a scan are the cells of its own map that it hit.

    Args:
        maps: Both maps, and the cells that every scan hit.
        session: The session whose points are marked.
        other: The session whose scans are compared to them.
        config: `erasor` and `query.radius_m` are used. Points farther than that from the other path may make a column
            high, but are not compared.

    Returns:
        (N,) mask of the points of `session`.
    """
    settings, point_map = config.erasor, maps.merged.map_of(other)
    points_odom = maps.merged.to_odom(other, maps.points[session])
    scans = choose_scans(point_map.odom_T_sensor, settings.every_scan)
    positions = point_map.odom_T_sensor[scans, :3, 3]
    floors_m = _floor_heights(positions, point_map.points)
    is_new = np.zeros(len(points_odom), dtype=np.bool_)
    if not len(points_odom):
        return is_new
    plan = cKDTree(points_odom[:, :2])
    for scan, position, floor_m in zip(scans.tolist(), positions, floors_m, strict=True):
        near = np.sort(plan.query_ball_point(position[:2], settings.max_range_m * (1 + 1e-6))).astype(np.int64)
        hit = np.unique(point_map.return_points[slice(*point_map.scan_offsets[scan : scan + 2])])
        origin = np.array([position[0], position[1], floor_m])
        is_new[near] |= flat_column_mask(points_odom[near] - origin, point_map.points[hit] - origin, settings)
    return is_new


def flat_column_mask(points: Float64Array, scan_points: Float64Array, settings: ErasorConfig) -> BoolArray:
    """Mark the points above the ground of columns that are high in the map and flat in the scan.

    Args:
        points: (N, 3) map points, from the floor under the sensor, z up, metres.
        scan_points: (R, 3) points of the scan, the same frame.
        settings: Range, height and ratio of heights.

    Returns:
        (N,) mask of the map points.
    """
    own, scan = (_columns(cloud, settings) for cloud in (points, scan_points))
    is_lower = (scan.heights_m <= own.heights_m) & (scan.heights_m < settings.scan_ratio * own.heights_m)
    is_flat = is_lower & (scan.counts >= _LEAST_POINTS) & (own.tops_m > _LEAST_HEIGHT_M)
    inside = np.flatnonzero(own.column_of_point >= 0)
    found = inside[is_flat[own.column_of_point[inside]]]
    is_new = np.zeros(len(points), dtype=np.bool_)
    is_new[found] = ~ground_mask(points[found], own.column_of_point[found])
    return is_new


def ground_mask(points: Float64Array, columns: Int64Array) -> BoolArray:
    """Mark the (N, 3) points of the ground of their (N,) columns: region-wise ground plane fitting.

    Args:
        points: (N, 3) points, z up, metres.
        columns: (N,) column of each point.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.bool_)
    _, columns, counts = np.unique(columns, return_inverse=True, return_counts=True)
    by_height = np.lexsort((points[:, 2], columns))
    ranks = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
    lowest = by_height[ranks < _N_LOWEST]
    base_m = np.bincount(columns[lowest], points[lowest, 2]) / np.bincount(columns[lowest])
    is_ground = points[:, 2] < base_m[columns] + _SEED_M
    for _ in range(_N_PLANES):
        is_ground = points[:, 2] - _plane_heights(points, columns, is_ground) < _GROUND_M
    return is_ground


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """The columns around a sensor: (N,) that of each point, -1 outside; (C,) points, height and top of each."""

    column_of_point: Int64Array
    counts: Int64Array
    heights_m: Float64Array
    tops_m: Float64Array


def _columns(points: Float64Array, settings: ErasorConfig) -> _Columns:
    x, y, z = points.T
    distances_m = np.hypot(x, y)
    rings = np.floor(distances_m / settings.max_range_m * _RINGS).astype(np.int64)
    sectors = np.floor((np.arctan2(-y, -x) / (2 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
    is_inside = (rings < _RINGS) & (z > _LOWEST_M) & (z < settings.max_height_m)
    columns = np.where(is_inside, rings * _SECTORS + sectors, -1)
    tops_m, bottoms_m = np.full(_RINGS * _SECTORS, -np.inf), np.full(_RINGS * _SECTORS, np.inf)
    np.maximum.at(tops_m, columns[is_inside], z[is_inside])
    np.minimum.at(bottoms_m, columns[is_inside], z[is_inside])
    counts = np.bincount(columns[is_inside], minlength=_RINGS * _SECTORS)
    return _Columns(columns, counts, np.where(counts > 0, tops_m - bottoms_m, 0.0), tops_m)


def _plane_heights(points: Float64Array, columns: Int64Array, is_ground: BoolArray) -> Float64Array:
    """Return the (N,) height at each point of the plane z = a x + b y + c that fits the ground of its column best.

    The authors take the smallest principal axis of the ground as normal. It lies across a column that is narrower than
    its objects are high.
    """
    ground, column_of = points[is_ground], columns[is_ground]
    counts = np.maximum(np.bincount(column_of, minlength=columns.max() + 1), 1)
    centres = np.column_stack([np.bincount(column_of, axis, len(counts)) for axis in ground.T]) / counts[:, None]
    off = ground - centres[column_of]
    products = [np.bincount(column_of, off[:, i] * off[:, j], len(counts)) for i in (0, 1) for j in (0, 1, 2)]
    sums = np.stack(products, axis=1).reshape(-1, 2, 3)
    slopes = np.einsum("cij,cj->ci", np.linalg.pinv(sums[:, :, :2], hermitian=True), sums[:, :, 2])
    aside = points[:, :2] - centres[columns, :2]
    return np.asarray(centres[columns, 2] + np.einsum("ni,ni->n", aside, slopes[columns]))


def _floor_heights(positions: Float64Array, points: Float64Array) -> Float64Array:
    """Return the (S,) height of the floor under (S, 3) positions, from the map points around each, metres."""
    around = cKDTree(points[:, :2]).query_ball_point(positions[:, :2], _FLOOR_M)
    heights_m = (points[indices, 2] for indices in around)
    return np.array([np.quantile(each, _FLOOR_SHARE) if len(each) else np.nan for each in heights_m])
