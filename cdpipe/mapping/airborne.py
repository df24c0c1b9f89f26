"""Returns of mist and dust: told by their weakness, and by neighbours that do not lie on one surface with them.

A surface within a few metres sends back tens of photons, the air in front of it a handful; and the places from which
air returns are scattered along the beams, while neighbouring beams meet a surface at ranges that agree or follow a
line. Published filters for snow use either: intensity (LIOR, Park and others 2020) and local density (DROR, Charron and
others 2018).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, transform
from cdpipe.core.geometry.voxel import cell_corners, cell_keys
from cdpipe.model.config import MapConfig
from cdpipe.model.types import PointMap, PosedScan, ScanSource, WrappedScans

# Simulated validation worlds (10001 of six families). A scan is dusty by the first rule: it holds for 0.4 % of a clear
# scan at most, for 94 % and more of the returns of mist and dust. In a dusty scan the second rule drops what it can: in
# mist with 12, 20 and 40 m of visibility 0.8, 0.01 and 0.00 % of what is left are returns of the mist, and 9, 6 and 4 %
# of the surfaces are lost.
_FARTHEST_M = 20.0
# Too dark for a surface: fewer photons than this within such a range. Mist of 12 m of visibility lies so near to the
# sensor that neighbours agree (`dust/mist` 10013): 99 % of its returns within 1 m have 17 photons at most, rock behind
# as much of it 14 and more.
_DARK = ((1.0, 16), (3.0, 10))
_DUSTY_SHARE = 0.01
# What looks airborne is on a surface if it lies this near to the mean of the other returns of a cell, if that and the
# cells around it hold so many of them. In the dust of `dust/narrow` 10001 objects lose two thirds of their returns
# otherwise (object IoU 0.34). Of `dust/mist` 10013 and 10015 and `dust/wide` 10012, 0.94, 0.97 and 0.75 of the dropped
# returns of objects come back with 0.05 to 0.34 % of the mist; with three returns in the cell itself, however near,
# 0.87, 0.79 and 0.50 did with as much. With cells of 0.2 m mist near a floor passes for it.
_SURFACE_CELL_M, _SURFACE_RETURNS, _SURFACE_M = 0.1, 9, 0.08
_BLOCK_RETURNS = 1 << 22


@dataclass(frozen=True, slots=True)
class _Rule:
    """A return is airborne if it is weak and fewer than two of its four neighbours agree with its range."""

    weak_photons: int
    agree_m: float
    agree_share: float
    may_lie_between: bool  # whether it may instead lie on the line between the next two


_IN_ANY_AIR = _Rule(16, 0.1, 0.02, may_lie_between=True)
_IN_DUST = _Rule(24, 0.05, 0.01, may_lie_between=False)


LiesOnSurface = Callable[[PosedScan, Int64Array], BoolArray]


class ClearScans(WrappedScans):
    """A session without the returns of mist and dust; a scan of clear air is as recorded.

    Attributes:
        has_dropped: Whether any scan that was read so far had such returns.
    """

    def __init__(self, source: ScanSource, lies_on_surface: LiesOnSurface | None = None) -> None:
        """Take a session, and what `drop_airborne` takes."""
        super().__init__(source)
        self._lies_on_surface = lies_on_surface
        self._clear: set[int] = set()  # scans of clear air that were read: they are not examined again
        self.has_dropped = False

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""
        return self._cleared(super().scan(index))

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        return map(self._cleared, super().scans())

    def supported_by(self, point_map: PointMap) -> ClearScans:
        """Return the session with the returns that lie where its map, made without them, has a surface.

        Small things a few metres away send back little more light than the air in front of them, and their neighbours
        do not agree: many of their returns look airborne. But some returns of a place are kept in other scans; air is
        not met in one place again.
        """
        supported = ClearScans(self._source, _surface_of(point_map))
        supported._clear = self._clear
        return supported

    def _cleared(self, scan: PosedScan) -> PosedScan:
        if scan.index in self._clear:
            return scan
        cleared = drop_airborne(scan, self._lies_on_surface)
        if cleared is scan:
            self._clear.add(scan.index)
        self.has_dropped |= cleared is not scan
        return cleared


def _surface_of(point_map: PointMap) -> LiesOnSurface:
    """Return what tells the returns that lie on a surface of a map."""
    cells, n_returns, means = _sum_cells(point_map)
    n_around = np.zeros(len(cells))
    for step in product((-1, 0, 1), repeat=3) if len(cells) else ():
        centres = cell_corners(cells, _SURFACE_CELL_M) + (np.array(step) + 0.5) * _SURFACE_CELL_M
        beside = cell_keys(centres, _SURFACE_CELL_M)
        found = np.minimum(np.searchsorted(cells, beside), len(cells) - 1)
        n_around += np.where(cells[found] == beside, n_returns[found], 0)
    surface, poses = cKDTree(means[n_around >= _SURFACE_RETURNS]), point_map.odom_T_sensor

    def lies_on_surface(scan: PosedScan, chosen: Int64Array) -> BoolArray:
        places = transform(poses[scan.index], scan.points_sensor[chosen])
        return np.isfinite(surface.query(places, distance_upper_bound=_SURFACE_M)[0])

    return lies_on_surface


def _sum_cells(point_map: PointMap) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Return the (C,) key of each cell of 0.1 m with returns of a map, rising, their number, and their (C, 3) mean."""
    parts = [(np.zeros(0, dtype=np.int64), np.zeros((0, 4)))]
    for start in range(0, len(point_map.return_points), _BLOCK_RETURNS):  # their file may not fit into memory
        own = point_map.positions_of(slice(start, start + _BLOCK_RETURNS))
        parts.append(_sum_by_key(cell_keys(own, _SURFACE_CELL_M), np.column_stack([np.ones(len(own)), own])))
    cells, sums = _sum_by_key(*map(np.concatenate, zip(*parts, strict=True)))
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
    if np.count_nonzero(_mark(scan, scan.signal, _IN_ANY_AIR)) <= _DUSTY_SHARE * len(scan.pixels):
        return scan
    kept = ~_mark(scan, scan.signal, _IN_DUST)
    if not kept.any():
        return scan
    if lies_on_surface is not None:
        marked = np.flatnonzero(~kept)
        kept[marked[lies_on_surface(scan, marked)]] = True
    return replace(scan.keep(kept), airborne_sensor=scan.points_sensor[~kept])


def _mark(scan: PosedScan, signal: npt.NDArray[np.uint16], rule: _Rule) -> BoolArray:
    """Mark the (N,) returns within 20 m that look airborne by a rule, and those too dark for a surface."""
    squared_m2 = np.einsum("ij,ij->i", scan.points_sensor, scan.points_sensor)
    is_marked: BoolArray = (signal < rule.weak_photons) & (squared_m2 < _FARTHEST_M**2)
    weak = np.flatnonzero(is_marked)
    ranges_m = np.sqrt(squared_m2)
    is_dark = [(ranges_m[weak] < near_m) & (signal[weak] < photons) for near_m, photons in _DARK]
    is_marked[weak] = np.logical_or(*is_dark) | ~_is_on_surface(scan, ranges_m, weak, rule)
    return is_marked


def _is_on_surface(scan: PosedScan, ranges_m: Float64Array, chosen: Int64Array, rule: _Rule) -> BoolArray:
    """Tell which (C,) chosen returns lie on one surface with the two beams on either side in their row.

    Of a beam with two returns either one may agree.
    """
    n_beams = scan.second_from or int(scan.pixels.max(initial=0)) + 1
    images = np.full((1 if scan.second_from is None else 2, n_beams + 4), np.nan)
    number, beam = np.divmod(scan.pixels, n_beams)
    images[number, beam + 2] = ranges_m
    own, at = ranges_m[chosen], beam[chosen] + 2
    tolerance_m = rule.agree_m + rule.agree_share * own
    around = {step: images[:, at + step] for step in (-2, -1, 1, 2)}
    agreeing = np.stack([(np.abs(other - own) < tolerance_m).any(axis=0) for other in around.values()])
    is_on: BoolArray = agreeing.sum(axis=0) >= 2
    if rule.may_lie_between:
        is_on |= (np.abs(around[-1][:, None] + around[1][None] - 2 * own) < tolerance_m).any(axis=(0, 1))
    return is_on
