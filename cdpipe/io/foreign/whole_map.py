"""One cloud of a whole map without its scans: stations on its floor stand for the scans that made it.

A station stands where a sensor could have stood, in the middle of a drift, 1 m above the floor; each point belongs to
the nearest station. Nothing tells what was looked at, so free space means nothing in such a map.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.io.foreign.clouds import Cloud
from cdpipe.io.foreign.trajectory import Trajectory

_THIN_M, _COLUMN_M = 0.2, 0.5
# Cells of the level grid, 17 bytes each: 2 km by 2 km, and more for a map with more points.
_MOST_CELLS, _CELLS_A_POINT = 16_000_000, 8
# A thinned point with no more others than this within that distance is no surface.
_STRAY_M, _LEAST_AROUND = 0.6, 6
# So the points of a surface lie at most so far apart.
_LARGEST_SPACING_M = 0.4
# A map that reaches no farther about its middle, which itself lies farther from the origin, has coordinates of a grid.
_SITE_M = 50_000.0
# Free height that a sensor needs, and its height in it.
_FREE_M, _SENSOR_M = 1.2, 1.0
# Free distance to the walls of a station, distances between stations, and the least share of the free distance of the
# neighbouring station: others stand at the side of a wide drift.
_CLEAR_M, _APART_M, _SIDE_SHARE = 0.75, (1.0, 1.5), 0.6


class MapStations:
    """A whole map as `Clouds`: one of each station, in its own frame.

    Attributes:
        name: The file.
        stamps_s: None: a map has no times.
        own: The stations as poses.
        lacks: Why there are none.
        is_stream: Points are read at once.
    """

    stamps_s: Float64Array | None = None
    lacks = "no scans in it"
    is_stream = False

    def __init__(self, path: Path, cloud: Cloud) -> None:
        """Find the stations of a map.

        Raises:
            InputError: The map has no point, or no floor with room for a sensor, or is too large.
        """
        self.name = str(path)
        is_finite = np.isfinite(cloud.points).all(axis=1)
        points = cloud.points[is_finite]
        try:
            stations = find_stations(points)
        except ValueError as error:
            way_out = _suggest_offset(points) or "are lengths metres? Else cut far points away"
            raise InputError(f"{path}: one cloud, a map without its scans, and {error}: {way_out}") from error
        if len(stations) == 0:
            way_out = "z is up and lengths are metres? Else name a folder with one file per scan and a trajectory"
            if (apart_m := _spacing_m(points)) > _LARGEST_SPACING_M:
                way_out = (
                    f"its points lie {apart_m:.2g} m apart, and a surface needs one every {_LARGEST_SPACING_M} m: name "
                    "a denser map; if lengths are not metres, scale it"
                )
            raise InputError(
                f"{path}: one cloud, a map without its scans, and no floor with {_FREE_M} m of free height in it: "
                f"{way_out}"
            )
        station = np.asarray(cKDTree(stations).query(points)[1], dtype=np.int64)
        used, station = np.unique(station, return_inverse=True)
        self._stations = stations[used]
        order = np.argsort(station, kind="stable")
        self._points = points[order]
        self._intensity = None if cloud.intensity is None else cloud.intensity[is_finite][order]
        self._ends = np.cumsum([0, *np.bincount(station)])
        poses = np.tile(np.eye(4), (len(used), 1, 1))
        poses[:, :3, 3] = self._stations
        self.own: Trajectory | None = Trajectory("stations on the floor of the map", poses)

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self._stations)

    def where(self, index: int) -> str:
        """Name a station in messages."""
        return f"{self.name}: station {index}"

    def read(self, index: int) -> Cloud:
        """Return the points of a station, in its frame, with their intensities where the map has some."""
        own = slice(*self._ends[index : index + 2])
        shone = None if self._intensity is None else self._intensity[own]
        return Cloud(self._points[own] - self._stations[index], intensity=shone)

    def read_all(self) -> Iterator[Cloud]:
        """Return the points of all stations in order."""
        return (self.read(index) for index in range(len(self)))


def _suggest_offset(points: Float64Array) -> str:
    """Return what to subtract where a map is small and far from the origin, as in a national grid; else ""."""
    middle = np.median(points, axis=0)
    if np.abs(points - middle).max() > _SITE_M or np.abs(middle).max() < _SITE_M:
        return ""
    offset = ",".join(f"{value:.0f}" for value in np.round(middle, -3) + 0.0)
    return f"coordinates of a map grid (UTM)? Subtract an origin from both maps: --origin {offset}"


def _spacing_m(points: Float64Array) -> float:
    """Return the median distance from a point to the next one, 0 without two points."""
    if len(points) < 2:
        return 0.0
    return float(np.median(np.asarray(cKDTree(points).query(points[:10_000], k=[2])[0])))


def find_stations(points: Float64Array) -> Float64Array:
    """Return (S, 3) places on the middle lines of a map's drifts, as a path from one end on, metres.

    Args:
        points: (N, 3) points of the map, z up, metres.

    Raises:
        ValueError: A point lies farther away than cells can be numbered, or floors lie so far apart that a grid over
            all of them would be larger than a map of so many points.
    """
    if len(points) == 0:
        return np.zeros((0, 3))
    places = _free_places(_without_strays(cell_means(points, _THIN_M)[0]))
    clear_m = _clear(places, _MOST_CELLS + _CELLS_A_POINT * len(points))
    chosen: list[int] = []
    tree = cKDTree(places) if len(places) else None
    is_open = clear_m >= _CLEAR_M
    for place in np.argsort(-clear_m, kind="stable"):
        if not is_open[place] or tree is None:
            continue
        chosen.append(int(place))
        around = np.array(tree.query_ball_point(places[place], float(np.clip(2 * clear_m[place], *_APART_M))))
        is_open[around] = False
        aside = np.array(tree.query_ball_point(places[place], 4 * _APART_M[1]))
        is_open[aside[clear_m[aside] < _SIDE_SHARE * clear_m[place]]] = False
    return _as_path(places[chosen])


def _without_strays(points: Float64Array) -> Float64Array:
    """Return the points of a thinned map that have neighbours: false returns lie alone, in the rock as well."""
    around = cKDTree(points).query_ball_point(points, _STRAY_M, return_length=True)
    return points[np.asarray(around) > _LEAST_AROUND]


def _free_places(points: Float64Array) -> Float64Array:
    """Return (P, 3) places at a sensor's height above a floor, one or more of each column of the map.

    A column with a roof is free between floor and roof. The rock above a roof holds no points, and is not free. A
    column without a roof is free above its highest point, unless its points are a wall.
    """
    if len(points) == 0:
        return np.zeros((0, 3))
    cells = np.floor(points[:, :2] / _COLUMN_M).astype(np.int64)
    order = np.lexsort((points[:, 2], cells[:, 1], cells[:, 0]))
    cells, z_m = cells[order], points[order, 2]
    is_last = np.append((cells[1:] != cells[:-1]).any(axis=1), True)
    gap_m = np.append(np.diff(z_m), np.inf)
    gap_m[is_last] = np.inf
    column = np.cumsum(np.append(0, is_last[:-1]))
    is_roofed = np.bincount(column[~is_last & (gap_m >= _FREE_M)], minlength=column[-1] + 1) > 0
    first_z_m = np.minimum.reduceat(z_m, np.flatnonzero(np.append(True, is_last[:-1])))
    is_flat = z_m - first_z_m[column] < _FREE_M / 2
    is_floor = (gap_m >= _FREE_M) & (~is_last | (~is_roofed[column] & is_flat))
    above_m = np.minimum(_SENSOR_M, gap_m[is_floor] / 2)
    return np.column_stack([(cells[is_floor] + 0.5) * _COLUMN_M, z_m[is_floor] + above_m])


def _clear(places: Float64Array, most_cells: int) -> Float64Array:
    """Return the (P,) level distance of each place from columns that are not free, metres.

    Raises:
        ValueError: The grid over all places has more than `most_cells` cells.
    """
    if len(places) == 0:
        return np.zeros(0)
    cells: Int64Array = np.floor(places[:, :2] / _COLUMN_M).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    shape = [int(n) for n in cells.max(axis=0) + 2]
    if shape[0] * shape[1] > most_cells:
        extent = " x ".join(f"{n * _COLUMN_M:.0f}" for n in shape)
        raise ValueError(f"its floors reach over {extent} m, more than {most_cells * _COLUMN_M**2:.0f} square metres")
    is_free: BoolArray = np.zeros(shape, dtype=np.bool_)
    is_free[tuple(cells.T)] = True
    return np.asarray(distance_transform_edt(is_free)[tuple(cells.T)] * _COLUMN_M, dtype=np.float64)


def _as_path(places: Float64Array) -> Float64Array:
    """Return places in the order of a walk from the one farthest from their mean to the nearest that is left."""
    if len(places) < 2:
        return places
    left = np.ones(len(places), dtype=np.bool_)
    here = int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    order = [here]
    for _ in range(len(places) - 1):
        left[here] = False
        distance_m = np.linalg.norm(places - places[here], axis=1)
        here = int(np.argmin(np.where(left, distance_m, np.inf)))
        order.append(here)
    return places[order]
