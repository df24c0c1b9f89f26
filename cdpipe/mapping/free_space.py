"""Free space: a place is free if rays of a session passed through it.

A difference between the maps is a change only if the other session observed the place. Each keyframe keeps a range
image of its scan. A point in front of the returns of its pixel and of the four neighbouring pixels was seen through; a
point at their range was hit; a point behind them was occluded (`free_space_votes`). A low object is not higher than a
pixel. For it the single rays decide that returned from the floor just behind it (`grazing_ray_count`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, travelled_m
from cdpipe.core.geometry.voxel import cell_keys, nearest_image
from cdpipe.model.types import Float16Array, KeyframeViews

ROWS = 64
COLUMNS = 512
# Highest elevation of the image: covers a sensor with a vertical field of view of 90 degrees.
_ELEVATION_RAD = np.deg2rad(45.6)
PIXEL_WIDTH_RAD, PIXEL_HEIGHT_RAD = 2 * np.pi / COLUMNS, 2 * _ELEVATION_RAD / ROWS
# A return farther behind a point than this passed it; a return within this distance may be from it.
_MARGIN_M = 0.2
_NEAREST_M = 0.5
# Beyond this range a pixel is wider than the objects.
REACH_M = 15.0
# Keyframes and scans of a tripod that lie farther apart than this stand for several.
_VIEW_M, _MOST_VIEWS = 3.0, 3.0
# Grazing rays are traced backwards from their return: cell size, nearest and farthest distance from the return.
_CELL_M = 0.1
_PAST_M = (0.1, 1.0)


def render_view(points_sensor: Float64Array, airborne_sensor: Float64Array | None = None) -> Float16Array:
    """Return the (ROWS, COLUMNS) float16 range image: nearest return of each pixel, metres, 0 without one.

    A pixel that holds returns of mist or dust alone has the nearest of them, with a minus sign. Some are of dark rock,
    and what the rays beside it see is no sign that they passed it.

    Args:
        points_sensor: (N, 3) returns of a scan, sensor frame, metres.
        airborne_sensor: (D, 3) those that were left out as mist or dust.
    """
    view = nearest_image(*_pixels(points_sensor), (ROWS, COLUMNS))
    if airborne_sensor is not None:
        air = nearest_image(*_pixels(airborne_sensor), (ROWS, COLUMNS))
        view = np.where(view == 0, 0.0 - air, view)  # no -0 where nothing returned
    return view.astype(np.float16)


def free_space_votes(points_odom: Float64Array, views: KeyframeViews) -> Int64Array:
    """Return for each place the number of keyframes that saw through it minus the number that hit it.

    Args:
        points_odom: (N, 3) places, odom frame of the observing session, metres.
        views: Range images of its keyframes.

    Returns:
        (N,) votes; 0 also for a place that no keyframe observed.
    """
    n_through, n_hit = count_through_and_hit(points_odom, views)
    return n_through - n_hit


def count_through_and_hit(points_odom: Float64Array, views: KeyframeViews) -> tuple[Int64Array, Int64Array]:
    """Return the (N,) number of keyframes that saw through each place, and the (N,) number that hit it.

    Arguments as of `free_space_votes`; keyframes farther than 15 m from a place are ignored.
    """
    n_through, n_hit = np.zeros((2, len(points_odom)), dtype=np.int64)
    for look in _look(points_odom, views, REACH_M):
        n_through[look.places] += look.is_through
        n_hit[look.places] += look.is_hit
    return n_through, n_hit


def is_veiled(points_odom: Float64Array, views: KeyframeViews) -> BoolArray:
    """Mark the (N,) places that mist or dust hid from a session.

    No keyframe saw through them or hit them, and in the pixel of some keyframe air alone returned.

    Arguments as of `free_space_votes`.
    """
    is_seen, is_air = np.zeros((2, len(points_odom)), dtype=np.bool_)
    for look in _look(points_odom, views, REACH_M):
        is_seen[look.places] |= look.is_through | look.is_hit
        is_air[look.places] |= look.pixel_m < 0
    return is_air & ~is_seen


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """How often each keyframe saw through some of (N, 3) places, and how often it hit them.

    Attributes:
        n_through, n_hit: (K,) places, as for `free_space_votes`.
        n_pixel_through, n_pixel_hit: (K,) places by the pixel alone, without those around it. A return of mist is no
            hit.
    """

    n_through: Int64Array
    n_hit: Int64Array
    n_pixel_through: Int64Array
    n_pixel_hit: Int64Array


def look_by_keyframe(points_odom: Float64Array, views: KeyframeViews, reach_m: float = REACH_M) -> Looks:
    """Return how many of (N, 3) places each of the (K,) keyframes saw through, and how many it hit.

    Args:
        points_odom: (N, 3) places, odom frame of the observing session, metres.
        views: Range images of its keyframes.
        reach_m: Places farther from a keyframe are ignored; beyond 15 m a pixel is wider than small objects.
    """
    counts = np.zeros((4, len(views.ranges_m)), dtype=np.int64)
    for look in _look(points_odom, views, reach_m):
        marks = (
            look.is_through,
            look.is_hit,
            np.abs(look.pixel_m) > look.ranges_m + _MARGIN_M,
            np.abs(look.pixel_m - look.ranges_m) <= _MARGIN_M,
        )
        counts[:, look.keyframe] = [np.count_nonzero(mark) for mark in marks]
    return Looks(*counts)


class _Look(NamedTuple):
    """One keyframe and the (M,) of (N, 3) places in its view, their ranges, and whether it saw through or hit them.

    `pixel_m` (M,) is the range in the pixel of each, as `render_view` writes it.
    """

    keyframe: int
    places: Int64Array
    ranges_m: Float64Array
    pixel_m: Float64Array
    is_through: BoolArray
    is_hit: BoolArray


def _look(points_odom: Float64Array, views: KeyframeViews, reach_m: float) -> Iterator[_Look]:
    """Yield each keyframe that can see some of (N, 3) places."""
    if len(points_odom) == 0 or len(views.ranges_m) == 0:
        return
    centre = points_odom.mean(axis=0)
    spread_m = float(np.linalg.norm(points_odom - centre, axis=1).max())
    rotations, shifts = views.sensor_T_odom[:, :3, :3], views.sensor_T_odom[:, :3, 3]
    distances_m = np.linalg.norm(rotations @ centre + shifts, axis=1)
    for keyframe in np.flatnonzero(distances_m <= reach_m + spread_m).tolist():
        pixel, ranges_m = _pixels(points_odom @ rotations[keyframe].T + shifts[keyframe])
        in_view = np.flatnonzero((pixel >= 0) & (ranges_m >= _NEAREST_M) & (ranges_m <= reach_m))
        pixel, ranges_m = pixel[in_view], ranges_m[in_view]
        pixel_m, first_m, is_hit = _look_up(views.ranges_m[keyframe], pixel, ranges_m)
        is_through = np.isfinite(first_m) & (first_m > ranges_m + _MARGIN_M)
        yield _Look(keyframe, in_view, ranges_m, pixel_m, is_through, is_hit)


def views_of_one(odom_T_sensor: Float64Array) -> float:
    """Return how many views one of (K, 4, 4) poses stands for: one for every 3 m to the next, 1 to 3."""
    step_m = np.diff(travelled_m(odom_T_sensor))
    return float(np.clip(np.median(step_m) / _VIEW_M, 1.0, _MOST_VIEWS)) if len(step_m) else 1.0


def grazing_ray_count(points: Float64Array, ends: Float64Array, origins: Float64Array, scans: Int64Array) -> Int64Array:
    """Return for each place the number of scans with a ray through its cell just before its return, minus hits.

    Args:
        points: (N, 3) places, at least one, metres.
        ends: (M, 3) returns of the observing session near the places, same frame.
        origins: (M, 3) sensor position of each return.
        scans: (M,) scan of each return.

    Returns:
        (N,) scans that passed the cell minus scans with a return in it.
    """
    cells = _Cells(points)
    is_near = cells.is_within(ends, _PAST_M[1])
    ends, origins, scans = ends[is_near], origins[is_near], scans[is_near]
    ranges_m = np.linalg.norm(origins - ends, axis=1)
    back = (origins - ends) / np.maximum(ranges_m, _NEAREST_M)[:, None]
    passed = [np.zeros(0, dtype=np.int64)]
    for step_m in np.arange(_PAST_M[0], _PAST_M[1], _CELL_M / 2):
        is_long = ranges_m > step_m + _NEAREST_M
        passed.append(cells.met((ends + step_m * back)[is_long], scans[is_long]))
    return cells.n_scans(np.concatenate(passed)) - cells.n_scans(cells.met(ends, scans))


class _Cells:
    """The cells that hold (N, 3) places, to be looked up by point and scan."""

    def __init__(self, points: Float64Array) -> None:
        self._low, self._high = points.min(axis=0) - _CELL_M, points.max(axis=0) + _CELL_M
        self._keys, self._cell_of_point = np.unique(self._keys_of(points), return_inverse=True)

    def is_within(self, points: Float64Array, margin_m: float) -> BoolArray:
        """Mark the points within a margin of the bounding box of all cells."""
        is_within = np.ones(len(points), dtype=np.bool_)
        for axis in range(3):  # faster than `all(axis=1)` over rows of three
            is_within &= points[:, axis] > self._low[axis] - margin_m
            is_within &= points[:, axis] < self._high[axis] + margin_m
        return is_within

    def met(self, points: Float64Array, scans: Int64Array) -> Int64Array:
        """Return the key of cell and scan of each point that lies in one of the cells."""
        is_near = self.is_within(points, 0.0)
        keys = self._keys_of(points[is_near])
        cells = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        is_met = self._keys[cells] == keys
        return np.asarray(scans[is_near][is_met] * len(self._keys) + cells[is_met], dtype=np.int64)

    def n_scans(self, keys: Int64Array) -> Int64Array:
        """Return the (N,) number of different scans with a key in the cell of each place."""
        n_cells = len(self._keys)
        found = np.bincount(np.unique(keys) % n_cells, minlength=n_cells)
        return np.asarray(found[self._cell_of_point], dtype=np.int64)

    def _keys_of(self, points: Float64Array) -> Int64Array:
        return cell_keys(points - self._low, _CELL_M)


def _look_up(
    image: Float16Array, pixel: Int64Array, ranges_m: Float64Array
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return the range in each pixel, the shortest one in its neighbourhood, and whether any equals the point's.

    The neighbourhood is the pixel and the four around it. Few beams leave rows empty, and for the range the next row
    counts. The range is infinite where nothing returned, and 0 where the pixel and the one above or below it are empty:
    what is there may lie between two beams.
    """
    column, row_start = pixel % COLUMNS, pixel - pixel % COLUMNS
    flat = image.ravel()
    rows = [flat.take(_move(pixel, step)) for step in (0, -1, 1)]
    sides = [flat.take(row_start + (column + step) % COLUMNS) for step in (1, -1)]
    pixel_m = rows[0].astype(np.float64)
    seen_m = np.abs(np.stack([*rows, *sides]).astype(np.float64))
    is_hit = np.asarray(np.any(np.abs(seen_m - ranges_m) <= _MARGIN_M, axis=0))
    is_between = (seen_m[0] == 0) & ((seen_m[1] == 0) | (seen_m[2] == 0))
    for row, step in ((1, -2), (2, 2)):
        is_empty = np.flatnonzero(seen_m[row] == 0)
        seen_m[row, is_empty] = np.abs(flat.take(_move(pixel[is_empty], step)))
    seen_m[seen_m == 0] = np.inf
    return pixel_m, np.where(is_between, 0.0, seen_m.min(axis=0)), is_hit


def _move(pixel: Int64Array, rows: int) -> Int64Array:
    """Return the pixels that lie so many rows below; those at the edge of the image stay."""
    moved = pixel + rows * COLUMNS
    return np.where((moved >= 0) & (moved < ROWS * COLUMNS), moved, pixel)


def _pixels(points_sensor: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the (N,) pixel of each point, -1 above or below the image, and its (N,) range, metres."""
    x, y, z = points_sensor.T
    ranges_m = np.sqrt(x * x + y * y + z * z)
    elevation = np.arctan2(z, np.hypot(x, y))
    rows = np.floor((_ELEVATION_RAD - elevation) / (2 * _ELEVATION_RAD) * ROWS).astype(np.int64)
    columns = np.floor(np.arctan2(y, x) / (2 * np.pi) * COLUMNS).astype(np.int64) % COLUMNS
    is_inside = (rows >= 0) & (rows < ROWS) & (ranges_m > 0)
    return np.where(is_inside, rows * COLUMNS + columns, -1), ranges_m
