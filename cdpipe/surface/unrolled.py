"""Places of a tunnel by chainage and angle, as surveyors unroll it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array, travelled_m
from cdpipe.core.geometry.path_frames import path_frames

_BIN_M = 1.0
# Where the drift is so much wider than in most of so many metres before and behind, a crosscut or a raise opens.
_AROUND, _BEYOND_M = 8, 1.0


def unroll(points: Float64Array, odom_T_sensor: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return chainage, angle and radius of the rock about the axis of the drift, looking along the path.

    The chainage is that of the nearest pose, plus the way from there along the direction of the path. Where a session
    passes a place twice, the nearer pass counts. In each metre of chainage the axis lies midway between the walls, and
    between roof and floor. Where one of them opens, by a crosscut or a raise, it is taken to be where it mostly is
    in the 8 metres before and behind in which there is rock.

    A wall has one side on both ways past a turn on the spot, as seen on the longer way (`path_frames`); a bend that is
    metres wide turns the direction, and swaps left and right. So does a session that is driven the other way.

    Args:
        points: (Q, 3) places on the rock all around the drift, odom frame, metres.
        odom_T_sensor: (S, 4, 4) poses of the scans of the session.

    Returns:
        (Q,) chainage along the path, metres; (Q,) angle about the axis, degrees: 0 the crown of the roof, 90 the left
        wall, -90 the right wall, 180 and -180 the floor; (Q,) distance from the axis, metres.
    """
    if len(points) == 0:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    frames = path_frames(odom_T_sensor, np.arange(len(odom_T_sensor)))
    nearest = np.asarray(cKDTree(frames[:, :3, 3]).query(points)[1], dtype=np.int64)
    offsets = np.einsum("nji,nj->ni", frames[nearest, :3, :3], points - frames[nearest, :3, 3])
    steps = np.diff(odom_T_sensor[:, :3, 3], axis=0, append=odom_T_sensor[-1:, :3, 3])
    is_backward = np.einsum("ij,ij->i", steps, frames[:, :3, 0]) < 0
    chainage_m = travelled_m(odom_T_sensor)[nearest] + np.where(is_backward[nearest], -offsets[:, 0], offsets[:, 0])
    _, metre = np.unique(np.floor(chainage_m / _BIN_M), return_inverse=True)
    left_m, up_m = (values - _middles(values, metre)[metre] for values in offsets[:, 1:].T)
    return chainage_m, np.rad2deg(np.arctan2(left_m, up_m)), np.hypot(left_m, up_m)


def middle_place(points: Float64Array, chainage_m: Float64Array, angle_deg: Float64Array) -> tuple[float, float]:
    """Return chainage, metres, and angle, degrees, of that of (N, 3) places, N > 0, which is nearest to their mean.

    Places that the path passes twice have two chainages: what lies between names another place.
    """
    nearest = int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    return float(chainage_m[nearest]), float(angle_deg[nearest])


def _middles(values: Float64Array, group: Int64Array) -> Float64Array:
    """Return the middle between the smallest and the largest of the (N,) values of each group, without openings."""
    low, high = np.full(group.max() + 1, np.inf), np.full(group.max() + 1, -np.inf)
    np.minimum.at(low, group, values)
    np.maximum.at(high, group, values)
    around = (median_filter(each, 2 * _AROUND + 1, mode="reflect") for each in (low, high, high - low))
    low_around, high_around, width_around = around
    is_open = high - low > width_around + _BEYOND_M  # a swerve moves both sides
    low = np.where(is_open & (low < low_around - _BEYOND_M), low_around, low)
    high = np.where(is_open & (high > high_around + _BEYOND_M), high_around, high)
    return np.asarray((low + high) / 2)
