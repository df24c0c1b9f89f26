"""Removert (Kim, Kim 2020): what the other session's range images see through, at two resolutions.

Removert removes moving objects from a map. It projects a scan and the map around it into range images. A map point is
removed if it is the nearest of its pixel and the scan measured farther there. It is reverted if coarser images do not
confirm it. For two sessions, the scans of one are compared to the map points of the other, in both directions.
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, transform
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.core.geometry.voxel import nearest_image
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import SessionName

# Of the authors' resolutions the first that removes is 2.5 times as fine as the first that reverts.
_COARSER = 2.5
# Farther away a pixel is wider than the objects.
_REACH_M = 20.0


@WholeMap
def removert(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` that scans of `other` see through, in fine and in coarse range images.

    As published one scan suffices; the fine and the coarse image may be of two scans.

    Args:
        maps: Both maps, and the returns of every scan.
        session: The session whose points are marked.
        other: The session whose scans see through them.
        config: `removert` and `query.radius_m` are used. Points farther than that from the other path are not compared;
            they hide nothing either.

    Returns:
        (N,) mask of the points of `session`.
    """
    settings = config.removert
    compared, points_odom = maps.compared_in_odom(session, other)
    index = GridIndex(points_odom)
    is_seen_through = np.zeros((2, len(compared)), dtype=np.bool_)
    for odom_T_sensor, returns_odom in maps.scans(other, settings.every_scan):
        near = index.crop(odom_T_sensor[:3, 3], _REACH_M)
        points, returns = (
            _spherical(transform(invert(odom_T_sensor), cloud)) for cloud in (points_odom[near], returns_odom)
        )
        for level, pixel_deg in enumerate((settings.pixel_deg, settings.pixel_deg * _COARSER)):
            is_seen_through[level, near] |= seen_through_mask(points, returns, pixel_deg, settings.margin)
    is_new = np.zeros(len(maps.points[session]), dtype=np.bool_)
    is_new[compared] = is_seen_through.all(axis=0)
    return is_new


def seen_through_mask(points: Float64Array, returns: Float64Array, pixel_deg: float, margin: float) -> BoolArray:
    """Mark the points that are the nearest of their pixel and in front of the scan.

    Args:
        points: (N, 3) azimuth and polar angle, radians, and range, metres, of map points in the sensor frame.
        returns: (R, 3) the same of the scan.
        pixel_deg: Edge of a pixel, degrees.
        margin: Share of its own range by which the scan must be farther than a point.

    Returns:
        (N,) mask; False also in a pixel without a return.
    """
    shape = int(np.ceil(180.0 / pixel_deg)), int(np.ceil(360.0 / pixel_deg))
    pixels = _pixels(points, pixel_deg, shape)
    scan_m = nearest_image(_pixels(returns, pixel_deg, shape), returns[:, 2], shape).ravel()[pixels]
    nearest_m = nearest_image(pixels, points[:, 2], shape).ravel()[pixels]
    is_nearest = points[:, 2].astype(np.float32) == nearest_m
    return np.asarray(is_nearest & (scan_m - nearest_m > margin * nearest_m))


def _pixels(points: Float64Array, pixel_deg: float, shape: tuple[int, int]) -> Int64Array:
    """Return the (N,) pixel of points given by their angles: row * columns + column."""
    columns, rows = (np.floor(np.rad2deg(points[:, axis]) / pixel_deg).astype(np.int64) for axis in (0, 1))
    return np.asarray(np.minimum(rows, shape[0] - 1) * shape[1] + np.minimum(columns, shape[1] - 1))


def _spherical(points_sensor: Float64Array) -> Float64Array:
    """Return the (N, 3) azimuth (0 to 2 pi), polar angle (0 above the sensor) and range of (N, 3) points."""
    x, y, z = points_sensor.T
    flat_m = np.hypot(x, y)
    return np.column_stack([np.arctan2(-y, -x) + np.pi, np.arctan2(flat_m, z), np.hypot(flat_m, z)])
