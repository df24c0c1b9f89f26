"""From scans to a voxel map in one pass; memory grows with the map and by eleven bytes per return."""

from __future__ import annotations

from itertools import islice

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int32Array, Int64Array, invert, transform, travelled_m
from cdpipe.core.grid_index import column_keys
from cdpipe.core.voxel import UniqueCells, cell_corners, cell_keys, max_coordinate_m
from cdpipe.mapping.free_space import render_view
from cdpipe.model.config import MapConfig
from cdpipe.model.types import PLACES, Float16Array, KeyframeViews, PointMap, PosedScan, ScanSource, UInt8Array

_BATCH_SCANS = 64
# Lower limit of the range in a return's weight.
_MIN_RANGE_M = 1.0
# Distance from the border, as a share of the cell, of a mean that rounding moved out of its cell.
_INSIDE = 1e-6


def build_map(source: ScanSource, config: MapConfig, batch_scans: int = _BATCH_SCANS) -> PointMap:
    """Build the map of a session, one point per occupied voxel of its odom frame, and choose keyframes.

    A map point is the mean of the returns in its voxel, weighted by the inverse square of their range, because near
    returns have the smallest error. Points are ordered by 2 m columns and then by voxel, as `GridIndex` needs. The
    order does not depend on `batch_scans`.

    Args:
        source: The session, read once in order.
        config: Voxel size, longest range, keyframe spacing.
        batch_scans: Scans held in memory at a time.

    Raises:
        InputError: A position is too large for this voxel size, or no return is within range.
    """
    _require_reachable(source, config)
    keyframe_scans = choose_keyframes(source.odom_T_sensor, config.keyframe_spacing_m)
    accumulator = _MapAccumulator(config, frozenset(keyframe_scans.tolist()))
    scans = iter(source.scans())
    while batch := list(islice(scans, batch_scans)):
        accumulator.add(batch)
    return accumulator.finish(source, keyframe_scans)


def choose_keyframes(odom_T_sensor: Float64Array, spacing_m: float) -> Int64Array:
    """Return the (K,) indices of the scans that are keyframes: the first, and one per `spacing_m` of path."""
    travelled = travelled_m(odom_T_sensor)
    chosen = [0]
    for index, path_m in enumerate(travelled):
        # a relative slack of 1e-6 for the rounding of summed steps
        if path_m - travelled[chosen[-1]] >= spacing_m * (1 - 1e-6):
            chosen.append(index)
    return np.array(chosen, dtype=np.int64)


class _MapAccumulator:
    """Weighted sums of the returns per voxel, batch by batch, and the range images of the keyframes."""

    def __init__(self, config: MapConfig, keyframe_scans: frozenset[int]) -> None:
        self._config = config
        self._keyframe_scans = keyframe_scans
        self._views: list[Float16Array] = []
        self._cells = UniqueCells()
        self._batch_cells: list[Int64Array] = []
        self._batch_sums: list[Float64Array] = []
        self._nearest_m2: Float64Array = np.zeros(0)
        self._return_cells: list[Int32Array] = []
        self._return_pixels: list[Int32Array] = []
        self._return_offsets: list[UInt8Array] = []
        self._n_returns: list[int] = []

    def add(self, scans: list[PosedScan]) -> None:
        clouds, ranges_m2, n_near = [], [], []
        for scan in scans:
            squared_m2 = np.einsum("ij,ij->i", scan.points_sensor, scan.points_sensor)
            is_near = squared_m2 <= self._config.max_range_m**2
            ranges_m2.append(np.maximum(squared_m2[is_near], _MIN_RANGE_M**2))
            clouds.append(transform(scan.odom_T_sensor, scan.points_sensor[is_near]))
            self._return_pixels.append(scan.pixels[is_near])
            n_near.append(len(clouds[-1]))
            if scan.index in self._keyframe_scans:
                self._views.append(render_view(scan.points_sensor))
        self._n_returns += n_near
        points = np.concatenate(clouds)
        sensors = np.array([scan.odom_T_sensor[:3, 3] for scan in scans])
        ids = self._cells.add(cell_keys(points, self._config.voxel_m))
        self._return_cells.append(ids.astype(np.int32))
        in_cells = points / self._config.voxel_m
        # just below a border the fraction rounds to 1
        places = np.minimum((in_cells - np.floor(in_cells)) * PLACES, PLACES - 1)
        self._return_offsets.append(places.astype(np.uint8))
        n_cells, squared_m2 = len(self._cells), np.concatenate(ranges_m2)
        weights = 1 / squared_m2
        parts = [np.bincount(ids, points[:, axis] * weights, n_cells) for axis in range(3)]
        parts += [np.bincount(ids, np.repeat(sensors[:, axis], n_near) * weights, n_cells) for axis in range(3)]
        sums: Float64Array = np.column_stack([*parts, np.bincount(ids, weights, n_cells)])
        self._nearest_m2 = np.append(self._nearest_m2, np.full(n_cells - len(self._nearest_m2), np.inf))
        np.minimum.at(self._nearest_m2, ids, squared_m2)
        is_touched = np.bincount(ids, minlength=n_cells) > 0
        self._batch_cells.append(np.flatnonzero(is_touched))
        self._batch_sums.append(sums[is_touched])

    def finish(self, source: ScanSource, keyframe_scans: Int64Array) -> PointMap:
        if len(self._cells) == 0:
            raise InputError(f"{source.name}: no return within map.max_range_m = {self._config.max_range_m} m")
        cells, sums = np.concatenate(self._batch_cells), np.concatenate(self._batch_sums)
        totals = np.column_stack([np.bincount(cells, column, len(self._cells)) for column in sums.T])
        points, seen_from = totals[:, :3] / totals[:, 6:], totals[:, 3:6] / totals[:, 6:]
        points = _clip_to_cells(points, self._cells.keys, self._config.voxel_m)
        order = np.lexsort((self._cells.keys, column_keys(points)))
        rank = np.empty(len(order), dtype=np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        return_points = np.concatenate([rank[part] for part in self._return_cells])
        return PointMap(
            points=points[order],
            nearest_m=np.sqrt(self._nearest_m2[order]).astype(np.float32),
            voxel_m=self._config.voxel_m,
            odom_T_sensor=source.odom_T_sensor,
            keyframe_scans=keyframe_scans,
            return_points=return_points,
            return_pixels=np.concatenate(self._return_pixels),
            scan_offsets=np.concatenate([[0], np.cumsum(self._n_returns)]).astype(np.int64),
            seen_from=seen_from[order].astype(np.float32),
            return_offsets=np.concatenate(self._return_offsets),
            views=KeyframeViews(np.stack(self._views), invert(source.odom_T_sensor[keyframe_scans])),
        )


def _clip_to_cells(points: Float64Array, keys: Int64Array, voxel_m: float) -> Float64Array:
    """Return the (N, 3) means, each clipped to its own cell: rounding can move a mean over the border."""
    tipped = np.flatnonzero(cell_keys(points, voxel_m) != keys)
    low = cell_corners(keys[tipped], voxel_m)
    points[tipped] = np.clip(points[tipped], low + _INSIDE * voxel_m, low + (1 - _INSIDE) * voxel_m)
    return points


def _require_reachable(source: ScanSource, config: MapConfig) -> None:
    farthest_m = float(np.abs(source.odom_T_sensor[:, :3, 3]).max(initial=0.0)) + config.max_range_m
    if farthest_m >= max_coordinate_m(config.voxel_m):
        raise InputError(
            f"{source.name}: positions reach {farthest_m:.0f} m, cells of map.voxel_m = {config.voxel_m} m can be "
            f"numbered up to {max_coordinate_m(config.voxel_m):.0f} m: subtract a common offset from the trajectory"
        )
