"""From scans to a voxel map in one pass, in two where the air was dusty; memory grows with the map.

Returns and range images go to a temporary file where they are large: eleven bytes per return, twice that while movers
are taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int32Array, Int64Array, invert, transform, travelled_m
from cdpipe.core.geometry.grid_index import column_keys
from cdpipe.core.geometry.voxel import FINEST_CELL_M, UniqueCells, cell_corners, cell_keys, require_reachable
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.core.spooled import SpooledArray
from cdpipe.mapping.airborne import FEW_SCANS, ClearScans, returns_around, returns_of
from cdpipe.mapping.free_space import COLUMNS, ROWS, render_view
from cdpipe.mapping.movers import drop_movers
from cdpipe.mapping.poses.consistency import make_consistent
from cdpipe.model.config import MapConfig
from cdpipe.model.types import KeyframeViews, PointMap, PosedScan, ScanSource, offsets_in_cells

_BATCH_SCANS = 64
_BLOCK_RETURNS = 1 << 22
# Lower limit of the range in a return's weight.
_MIN_RANGE_M = 1.0
# Distance from the border, as a share of the cell, of a mean that rounding moved out of its cell.
_INSIDE = 1e-6


def build_map(
    source: ScanSource,
    config: MapConfig,
    batch_scans: int = _BATCH_SCANS,
    on_step: Progress = report_nothing,
) -> PointMap:
    """Build the map of a session, one point per occupied voxel of its odom frame, and choose keyframes.

    A map point is the mean of the returns in its voxel, weighted by the inverse square of their range, because near
    returns have the smallest error. Points are ordered by 2 m columns and then by voxel, as `GridIndex` needs. The
    order does not depend on `batch_scans`.

    Args:
        source: The session, read in order: once as it is; before, where poses are made consistent; again, where
            returns of mist or dust were left out (`ClearScans`) of many scans, or poses stay as they are.
        config: Voxel size, longest range, keyframe spacing, and what is made consistent and left out.
        batch_scans: Scans held in memory at a time.
        on_step: Told how many scans were registered while poses are made consistent.

    Raises:
        InputError: A position is too large for this voxel size, or no return is within range.
    """
    _require_reachable(source, config)
    recorded_T_sensor = None if config.consistency == "none" else source.odom_T_sensor
    keyframe_scans = choose_keyframes(source.odom_T_sensor, config.keyframe_spacing_m)
    cleared, consistent = source, None
    if config.consistency != "none":
        source = consistent = make_consistent(source, has_loops=config.consistency == "graph", on_step=on_step)
    # dusty scans are known once all were read: to make poses consistent, or for a first map
    point_map = _accumulate(source, keyframe_scans, config, batch_scans) if consistent is None else None
    if isinstance(cleared, ClearScans) and len(dusty := cleared.find_dusty()):
        if len(dusty) <= FEW_SCANS * len(source.odom_T_sensor):
            returns = returns_around(cleared, dusty, source, config)
        else:
            returns = returns_of(point_map or _accumulate(source, keyframe_scans, config, batch_scans))
        supported, point_map = cleared.supported_by(returns, source.odom_T_sensor), None
        source = supported if consistent is None else consistent.over(supported)
    if point_map is None:
        point_map = _accumulate(source, keyframe_scans, config, batch_scans)
    point_map = replace(point_map, recorded_T_sensor=recorded_T_sensor)
    return drop_movers(point_map) if config.movers == "drop" else point_map


def _accumulate(source: ScanSource, keyframe_scans: Int64Array, config: MapConfig, batch_scans: int) -> PointMap:
    """Return the map of all scans, read once in order."""
    accumulator = _MapAccumulator(config, frozenset(keyframe_scans.tolist()))
    scans = iter(source.scans())
    while batch := list(islice(scans, batch_scans)):
        accumulator.add(batch)
    return accumulator.finish(source, keyframe_scans)


def choose_keyframes(odom_T_sensor: Float64Array, spacing_m: float) -> Int64Array:
    """Return the (K,) indices of the scans that are keyframes: the first, and one per `spacing_m` of path.

    A standing sensor jitters, which makes path: no keyframe is nearer to the one before it than half the spacing.
    """
    travelled, positions = travelled_m(odom_T_sensor), odom_T_sensor[:, :3, 3]
    chosen = [0]
    for index, path_m in enumerate(travelled):
        # a relative slack of 1e-6 for the rounding of summed steps
        if path_m - travelled[chosen[-1]] < spacing_m * (1 - 1e-6):
            continue
        if np.linalg.norm(positions[index] - positions[chosen[-1]]) >= spacing_m / 2:
            chosen.append(index)
    return np.array(chosen, dtype=np.int64)


class _MapAccumulator:
    """Weighted sums of the returns per voxel, batch by batch, and the range images of the keyframes."""

    def __init__(self, config: MapConfig, keyframe_scans: frozenset[int]) -> None:
        self._config = config
        self._keyframe_scans = keyframe_scans
        self._cells = UniqueCells()
        # for each cell the weighted sums of the returns and of the sensor positions, and the sum of the weights
        self._sums: Float64Array = np.zeros((0, 7))
        self._nearest_m2: Float64Array = np.zeros(0)
        self._views = SpooledArray(np.float16, (ROWS, COLUMNS))
        self._return_cells = SpooledArray(np.int32)
        self._return_pixels = SpooledArray(np.int32)
        self._return_offsets = SpooledArray(np.uint8, (3,))
        self._n_returns: list[int] = []

    def add(self, scans: list[PosedScan]) -> None:
        # scan by scan, as long as arrays fit into the cache; the sums are those of the whole batch
        parts = [self._add_scan(scan) for scan in scans]
        keys, squared_m2, weights = (np.concatenate([part[k] for part in parts]) for k in range(3))
        ids = self._cells.add(keys)
        self._return_cells.append(ids)
        weighted = np.concatenate([part[3] for part in parts], axis=1)
        self._add_sums(ids, [*weighted, weights], squared_m2)

    def _add_scan(self, scan: PosedScan) -> tuple[Int64Array, Float64Array, Float64Array, Float64Array]:
        """Return of (N,) returns within range the cells, squared ranges, weights, and (6, N) weighted sums' terms."""
        voxel_m = self._config.voxel_m
        squared_m2 = np.einsum("ij,ij->i", scan.points_sensor, scan.points_sensor)
        near = np.flatnonzero(squared_m2 <= self._config.max_range_m**2)
        squared_m2 = np.maximum(squared_m2.take(near), _MIN_RANGE_M**2)
        points = transform(scan.odom_T_sensor, scan.points_sensor.take(near, axis=0))
        self._return_pixels.append(scan.pixels.take(near))
        self._n_returns.append(len(near))
        if scan.index in self._keyframe_scans:
            self._views.append(render_view(scan.points_sensor, scan.airborne_sensor))
        self._return_offsets.append(offsets_in_cells(points, voxel_m))
        weights = 1 / squared_m2
        terms = np.empty((6, len(near)))
        np.multiply(points.T, weights, out=terms[:3])
        np.multiply(scan.odom_T_sensor[:3, 3, None], weights, out=terms[3:])
        return cell_keys(points, voxel_m), squared_m2, weights, terms

    def _add_sums(self, ids: Int64Array, columns: Sequence[Float64Array], squared_m2: Float64Array) -> None:
        n_known, n_cells = len(self._sums), len(self._cells)
        self._sums.resize((n_cells, 7), refcheck=False)  # in place: the map is not copied for each batch
        self._nearest_m2.resize(n_cells, refcheck=False)
        self._nearest_m2[n_known:] = np.inf
        np.minimum.at(self._nearest_m2, ids, squared_m2)
        is_touched = np.zeros(n_cells, dtype=np.bool_)
        is_touched[ids] = True
        touched = np.flatnonzero(is_touched)
        place = np.empty(n_cells, dtype=np.int32)
        place[touched] = np.arange(len(touched), dtype=np.int32)
        in_batch = place[ids]
        self._sums[touched] += np.column_stack([np.bincount(in_batch, column, len(touched)) for column in columns])

    def finish(self, source: ScanSource, keyframe_scans: Int64Array) -> PointMap:
        if len(self._cells) == 0:
            raise InputError(f"{source.name}: no return within map.max_range_m = {self._config.max_range_m} m")
        means = self._sums
        means[:, :6] /= means[:, 6:]
        keys = self._cells.keys
        points = _clip_to_cells(means[:, :3].copy(), keys, self._config.voxel_m)
        order = np.lexsort((keys, column_keys(points)))
        return PointMap(
            points=points[order],
            nearest_m=np.sqrt(self._nearest_m2[order]).astype(np.float32),
            voxel_m=self._config.voxel_m,
            odom_T_sensor=source.odom_T_sensor,
            keyframe_scans=keyframe_scans,
            return_points=self._rank_returns(order),
            return_pixels=self._return_pixels.finish(),
            scan_offsets=np.concatenate([[0], np.cumsum(self._n_returns)]).astype(np.int64),
            seen_from=means[:, 3:6].astype(np.float32)[order],
            return_offsets=self._return_offsets.finish(),
            views=KeyframeViews(self._views.finish(), invert(source.odom_T_sensor[keyframe_scans])),
        )

    def _rank_returns(self, order: Int64Array) -> Int32Array:
        """Return the (M,) map point of each return, the map points being the (N,) cells in an order."""
        rank = np.empty(len(order), dtype=np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        cells, ranked = self._return_cells.finish(), SpooledArray(np.int32)
        for start in range(0, len(cells), _BLOCK_RETURNS):
            ranked.append(rank[cells[start : start + _BLOCK_RETURNS]])
        return ranked.finish()


def _clip_to_cells(points: Float64Array, keys: Int64Array, voxel_m: float) -> Float64Array:
    """Return the (N, 3) means, each clipped to its own cell: rounding can move a mean over the border."""
    tipped = np.flatnonzero(cell_keys(points, voxel_m) != keys)
    low = cell_corners(keys[tipped], voxel_m)
    points[tipped] = np.clip(points[tipped], low + _INSIDE * voxel_m, low + (1 - _INSIDE) * voxel_m)
    return points


def _require_reachable(source: ScanSource, config: MapConfig) -> None:
    farthest_m = float(np.abs(source.odom_T_sensor[:, :3, 3]).max(initial=0.0)) + config.max_range_m
    if config.voxel_m < FINEST_CELL_M:
        require_reachable(source.name, farthest_m, config.voxel_m, "map.voxel_m = ")
    require_reachable(source.name, farthest_m, FINEST_CELL_M)
