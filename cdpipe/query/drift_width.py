"""The width of the drift along a path, measured on the session's own map, and the radius of a region that follows it.

At a keyframe the walls are looked for in all horizontal directions, at the height of the sensor. The width is the
shortest straight line from wall to wall through the sensor. This line crosses the drift whichever way the sensor is
turned. At the mouth of a crosscut, and where the sensor stands still, it needs no direction of the path. The median
over neighbouring keyframes leaves out single places: a parked vehicle, a niche, a junction.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.model.config import QueryConfig
from cdpipe.model.types import PointMap

# Walls are looked for up to this distance: of a drift of the larger width below, also from beside one of its walls.
_REACH_M = 11.0
# Points count up to this height above and below the sensor; a 32-beam sensor sees both walls of a 2 m drift there.
_HALF_HEIGHT_M = 0.5
# Directions are 5 degrees apart: a step off the perpendicular lengthens a line by 0.4 %.
_SECTORS = 72
# The median is over the keyframes within this distance: longer than a junction or a vehicle to either side.
_SMOOTHED_M = 8.0
# Radii of the paper: 4.5 m in narrow drifts (site 1) and 10 m in drifts 10 m wide (site 2). They apply up to the first
# width and from the second one on; between them the radius grows linearly. Validation tunnels of `narrow` and `network`
# measure 4 to 6.6 m, of `cave` 6.5 to 11 m, of `wide` 8 to 12.6 m.
LEAST_RADIUS_M = 4.5
_RADII_M = (LEAST_RADIUS_M, 10.0)
# Regions: a sphere of 4.5 m holds a drift 8 m wide from wall to wall, and of 16 validation pairs none has a duplicate.
_REGION_WIDTHS_M = (8.0, 10.5)
# Scores of keyframes: between what `narrow` and `wide` measure.
_SCORE_WIDTHS_M = (7.0, 8.5)


def keyframe_radii(point_map: PointMap, scans: Int64Array, config: QueryConfig) -> Float64Array:
    """Return the (K,) radius of a region at each keyframe, metres.

    Args:
        point_map: The session's own map.
        scans: (K,) scans of the keyframes.
        config: `radius_m` is used.
    """
    return _find_radii(point_map, scans, config, _REGION_WIDTHS_M)


def score_radii(point_map: PointMap, scans: Int64Array, config: QueryConfig) -> Float64Array:
    """Return the (K,) distance up to which a change counts for the score of each keyframe; arguments as above."""
    return _find_radii(point_map, scans, config, _SCORE_WIDTHS_M)


def measure_widths(points: Float64Array, positions: Float64Array) -> Float64Array:
    """Return the (K,) width of the drift at each keyframe, metres.

    A wall beyond 11 m counts as infinitely far. The width is NaN where neither the keyframe nor any within 8 m of it
    has a map point in reach.

    Args:
        points: (N, 3) map points, in a frame whose z is up, metres.
        positions: (K, 3) positions of the sensor, same frame.
    """
    if len(positions) == 0:
        return np.zeros(0)
    index = GridIndex(points)
    widths_m = np.array([_measure_width(index.points_within(each, _REACH_M) - each) for each in positions])
    near = cKDTree(positions).query_ball_point(positions, _SMOOTHED_M)
    known = [widths_m[members][~np.isnan(widths_m[members])] for members in near]
    return np.array([np.median(each) if len(each) else np.nan for each in known])


def _find_radii(
    point_map: PointMap, scans: Int64Array, config: QueryConfig, between_m: tuple[float, float]
) -> Float64Array:
    if config.radius_m != "width":
        return np.full(len(scans), config.radius_m)
    widths_m = measure_widths(point_map.points, point_map.odom_T_sensor[scans, :3, 3])
    # where nothing is in reach there is no width: the smaller sphere suppresses less
    return np.interp(np.where(np.isnan(widths_m), 0.0, widths_m), between_m, _RADII_M)


def _measure_width(points: Float64Array) -> float:
    """Return the length of the shortest horizontal line through the origin between two walls; NaN without points."""
    if len(points) == 0:
        return float("nan")
    x, y, _ = points[np.abs(points[:, 2]) <= _HALF_HEIGHT_M].T
    sectors = np.floor(np.arctan2(y, x) / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS
    wall_m = np.zeros(_SECTORS)
    np.maximum.at(wall_m, sectors, np.hypot(x, y))
    wall_m[wall_m == 0] = np.inf  # nothing in reach
    return float((wall_m[: _SECTORS // 2] + wall_m[_SECTORS // 2 :]).min())
