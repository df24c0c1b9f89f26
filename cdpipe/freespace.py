"""What a session saw through: a place is free where rays from its keyframes went on behind it.

What one session has and the other has not is a change only if the other one looked there. Each keyframe keeps one image
of its scan, the range of the nearest return of every pixel; a point well before all returns of its pixel and of the
four beside it was seen through, one at their range was hit, and one behind them was hidden.
"""

from __future__ import annotations

import numpy as np

from cdpipe.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.types import Float16Array, KeyframeViews

ROWS = 64
COLUMNS = 512
# Elevations beyond are not kept: enough for lenses of 90 degrees.
_ELEVATION_RAD = np.deg2rad(45.6)
# A return this much behind a point went past it, at any range; one this near to it may have come from it.
_MARGIN_M = 0.2
_NEAREST_M = 0.5
# Farther off, pixels are wider than what is looked for.
_REACH_M = 15.0
_CROSS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))


def view(points_sensor: Float64Array) -> Float16Array:
    """Return the (ROWS, COLUMNS) float16 range of the nearest return of each pixel, metres, 0 without.

    Args:
        points_sensor: (N, 3) returns of a scan, sensor frame, metres.
    """
    pixel, ranges_m = _pixels(points_sensor)
    is_kept = pixel >= 0
    image = np.full(ROWS * COLUMNS, np.inf, dtype=np.float32)
    np.minimum.at(image, pixel[is_kept], ranges_m[is_kept].astype(np.float32))
    image[np.isinf(image)] = 0.0
    return image.reshape(ROWS, COLUMNS).astype(np.float16)


def seen_through(points_odom: Float64Array, views: KeyframeViews) -> BoolArray:
    """Mark the (N,) places that more keyframes saw through than hit (`net_views`)."""
    return net_views(points_odom, views) > 0


def net_views(points_odom: Float64Array, views: KeyframeViews) -> Int64Array:
    """Return how many more keyframes saw through each of (N,) places than hit it.

    It is 0 of what no keyframe looked at, or was hidden from all.

    Args:
        points_odom: (N, 3) points in the odom frame of the session that looked, metres.
        views: What its keyframes saw.
    """
    balance = np.zeros(len(points_odom), dtype=np.int64)
    if len(points_odom) == 0 or len(views.ranges_m) == 0:
        return balance
    centre = points_odom.mean(axis=0)
    spread_m = float(np.linalg.norm(points_odom - centre, axis=1).max())
    rotations, shifts = views.sensor_T_odom[:, :3, :3], views.sensor_T_odom[:, :3, 3]
    distances_m = np.linalg.norm(rotations @ centre + shifts, axis=1)
    for keyframe in np.flatnonzero(distances_m <= _REACH_M + spread_m):
        pixel, ranges_m = _pixels(points_odom @ rotations[keyframe].T + shifts[keyframe])
        in_view = np.flatnonzero((pixel >= 0) & (ranges_m >= _NEAREST_M) & (ranges_m <= _REACH_M))
        first_m, is_hit = _looked_up(views.ranges_m[keyframe], pixel[in_view], ranges_m[in_view])
        balance[in_view] += np.isfinite(first_m) & (first_m > ranges_m[in_view] + _MARGIN_M)
        balance[in_view] -= is_hit
    return balance


def _looked_up(image: Float16Array, pixel: Int64Array, ranges_m: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Return the shortest range of the cross about each pixel, infinite without, and whether any is the point's own."""
    rows, columns = np.divmod(pixel, COLUMNS)
    first_m, is_hit = np.full(len(pixel), np.inf), np.zeros(len(pixel), dtype=np.bool_)
    for down, along in _CROSS:
        seen_m = image[np.clip(rows + down, 0, ROWS - 1), (columns + along) % COLUMNS].astype(np.float64)
        np.minimum(first_m, np.where(seen_m == 0, np.inf, seen_m), out=first_m)
        is_hit |= np.abs(seen_m - ranges_m) <= _MARGIN_M
    return first_m, is_hit


def _pixels(points_sensor: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the (N,) pixel of each point, -1 for those above or below the image, and its range."""
    x, y, z = points_sensor.T
    ranges_m = np.sqrt(x * x + y * y + z * z)
    elevation = np.arctan2(z, np.hypot(x, y))
    rows = np.floor((_ELEVATION_RAD - elevation) / (2 * _ELEVATION_RAD) * ROWS).astype(np.int64)
    columns = np.floor(np.arctan2(y, x) / (2 * np.pi) * COLUMNS).astype(np.int64) % COLUMNS
    is_inside = (rows >= 0) & (rows < ROWS) & (ranges_m > 0)
    return np.where(is_inside, rows * COLUMNS + columns, -1), ranges_m
