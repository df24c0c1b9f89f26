"""A session without the returns of mist and dust (`cdpipe.sensor.air` tells them), but for those on its surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, transform
from cdpipe.core.geometry.voxel import cell_corners, cell_keys
from cdpipe.model.config import MapConfig
from cdpipe.model.types import PointMap, PosedScan, ScanSource, WrappedScans, as_stored
from cdpipe.sensor.air import find_airborne

# What looks airborne is on a surface if it lies this near to the mean of the other returns of a cell, if that and the
# cells around it hold so many of them. In the dust of `dust/narrow` 10001 objects lose two thirds of their returns
# otherwise (object IoU 0.34). Of `dust/mist` 10013 and 10015 and `dust/wide` 10012, 0.94, 0.97 and 0.75 of the dropped
# returns of objects come back with 0.05 to 0.34 % of the mist; with three returns in the cell itself, however near,
# 0.87, 0.79 and 0.50 did with as much. With cells of 0.2 m mist near a floor passes for it.
_SURFACE_CELL_M, _SURFACE_RETURNS, _SURFACE_M = 0.1, 9, 0.08
_BLOCK_RETURNS = 1 << 22
# What tells a surface lies nearer than this to the return: its mean, the cell of that and the cells around it.
_AROUND_M = 0.5
# Where fewer scans than this are dusty, only what lies around their dropped returns is looked at. In clear air one scan
# in some hundreds looks dusty: 1 and 2 of 640 in `paper/site1` 10000.
FEW_SCANS = 0.1

LiesOnSurface = Callable[[PosedScan, Int64Array], BoolArray]


class ClearScans(WrappedScans):
    """A session without the returns of mist and dust; a scan of clear air is as recorded."""

    def __init__(self, source: ScanSource, lies_on_surface: LiesOnSurface | None = None) -> None:
        """Take a session, and what `drop_airborne` takes."""
        super().__init__(source)
        self._lies_on_surface = lies_on_surface
        self._clear: set[int] = set()  # scans of clear air that were read: they are not examined again
        self._dusty: set[int] = set()  # the other ones that were read

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""
        return self._cleared(super().scan(index))

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        return map(self._cleared, super().scans())

    def find_dusty(self) -> Int64Array:
        """Return the (D,) rising indices of the scans with returns of mist or dust; those not read so far are read."""
        for index in range(len(self.odom_T_sensor)):
            if index not in self._clear and index not in self._dusty:
                self.scan(index)
        return np.array(sorted(self._dusty), dtype=np.int64)

    def supported_by(self, returns: Iterable[Float64Array], odom_T_sensor: Float64Array) -> ClearScans:
        """Return the session with the returns that lie where its map, made without them, has a surface.

        Small things a few metres away send back little more light than the air in front of them, and their neighbours
        do not agree: many of their returns look airborne. But some returns of a place are kept in other scans; air is
        not met in one place again.

        Args:
            returns: (N, 3) positions of returns of the map in an odom frame, block by block: `returns_of` it, or those
                `returns_around` what was dropped.
            odom_T_sensor: (S, 4, 4) pose of each scan in that frame.
        """
        supported = ClearScans(self._source, _surface_of(returns, odom_T_sensor))
        supported._clear = self._clear
        return supported

    def _cleared(self, scan: PosedScan) -> PosedScan:
        if scan.index in self._clear:
            return scan
        cleared = drop_airborne(scan, self._lies_on_surface)
        (self._clear if cleared is scan else self._dusty).add(scan.index)
        return cleared


def returns_of(point_map: PointMap) -> Iterator[Float64Array]:
    """Yield the (N, 3) positions of all returns of a map, block by block: their file may not fit into memory."""
    for start in range(0, len(point_map.return_points), _BLOCK_RETURNS):
        yield point_map.positions_of(slice(start, start + _BLOCK_RETURNS))


def returns_around(
    cleared: ClearScans, dusty: Int64Array, posed: ScanSource, config: MapConfig
) -> Iterator[Float64Array]:
    """Yield, scan by scan, those (N, 3) of the returns of a session's map by which one tells what lies on a surface.

    Args:
        cleared: The session.
        dusty: (D,) its scans with returns of mist or dust.
        posed: Its scans as they are mapped.
        config: Cells and longest range of the map.
    """
    poses = posed.odom_T_sensor
    seen = [(poses[index], cleared.scan(index).airborne_sensor) for index in dusty.tolist()]
    places = np.concatenate([transform(pose, dropped) for pose, dropped in seen if dropped is not None])
    steps = _AROUND_M * np.array(list(product((-1, 0, 1), repeat=3)))
    middles = cell_corners(np.unique(cell_keys(places, _AROUND_M)), _AROUND_M) + _AROUND_M / 2
    around = np.unique(np.concatenate([cell_keys(middles + step, _AROUND_M) for step in steps]))
    reach_m = config.max_range_m + _AROUND_M * 3
    near, _ = cKDTree(middles).query(poses[:, :3, 3], distance_upper_bound=reach_m)
    for index in np.flatnonzero(np.isfinite(near)).tolist():
        scan = posed.scan(index)
        is_within = np.einsum("ij,ij->i", scan.points_sensor, scan.points_sensor) <= config.max_range_m**2
        points = transform(scan.odom_T_sensor, scan.points_sensor[is_within])
        keys = cell_keys(points, _AROUND_M)
        is_near = around[np.minimum(np.searchsorted(around, keys), len(around) - 1)] == keys
        yield as_stored(points[is_near], config.voxel_m)


def _surface_of(returns: Iterable[Float64Array], odom_T_sensor: Float64Array) -> LiesOnSurface:
    """Return what tells the returns that lie on a surface."""
    cells, n_returns, means = _sum_cells(returns)
    n_around = np.zeros(len(cells))
    for step in product((-1, 0, 1), repeat=3) if len(cells) else ():
        centres = cell_corners(cells, _SURFACE_CELL_M) + (np.array(step) + 0.5) * _SURFACE_CELL_M
        beside = cell_keys(centres, _SURFACE_CELL_M)
        found = np.minimum(np.searchsorted(cells, beside), len(cells) - 1)
        n_around += np.where(cells[found] == beside, n_returns[found], 0)
    surface = cKDTree(means[n_around >= _SURFACE_RETURNS])

    def lies_on_surface(scan: PosedScan, chosen: Int64Array) -> BoolArray:
        places = transform(odom_T_sensor[scan.index], scan.points_sensor[chosen])
        return np.isfinite(surface.query(places, distance_upper_bound=_SURFACE_M)[0])

    return lies_on_surface


def _sum_cells(returns: Iterable[Float64Array]) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Return the (C,) key of each cell of 0.1 m with returns, rising, their number, and their (C, 3) mean."""
    none = np.zeros(0, dtype=np.int64), np.zeros((0, 4))
    parts = (_sum_by_key(cell_keys(own, _SURFACE_CELL_M), np.column_stack([np.ones(len(own)), own])) for own in returns)
    cells, sums = _sum_by_key(*map(np.concatenate, zip(none, *parts, strict=True)))
    return cells, sums[:, 0], sums[:, 1:] / sums[:, :1]


def _sum_by_key(keys: Int64Array, columns: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the (C,) different keys, rising, and the (C, 4) sums of the rows of each."""
    found, place = np.unique(keys, return_inverse=True)
    return found, np.stack([np.bincount(place, column, len(found)) for column in columns.T], axis=1)


def clear_air(source: ScanSource, config: MapConfig) -> ScanSource:
    """Return a session without the returns of mist and dust, or as it is where `map.airborne` keeps them."""
    return ClearScans(source) if config.airborne == "drop" else source


def drop_airborne(scan: PosedScan, lies_on_surface: LiesOnSurface | None = None) -> PosedScan:
    """Return a scan without the returns of mist and dust, if it is dusty; else the scan.

    It is dusty if more than one return in a hundred looks airborne. Without the sensor's signal nobody can tell.

    Args:
        scan: The scan.
        lies_on_surface: Tells which (C,) returns, of the (C,) that look airborne, stay all the same.
    """
    if scan.signal is None:
        return scan
    ranges_m = np.sqrt(np.einsum("ij,ij->i", scan.points_sensor, scan.points_sensor))
    is_airborne = find_airborne(ranges_m, scan.signal, scan.pixels, scan.second_from)
    if is_airborne is None:
        return scan
    kept = ~is_airborne
    if lies_on_surface is not None:
        marked = np.flatnonzero(is_airborne)
        kept[marked[lies_on_surface(scan, marked)]] = True
    return replace(scan.keep(kept), airborne_sensor=scan.points_sensor[~kept])
