"""Frames by path and gravity: where a sensor was, whichever way it was mounted, held or turned.

The origin is the sensor. x points along the path and follows its slopes, y is horizontal, z completes the frame. The
odom frame's z is up. The direction of the path is the slope of a straight line that is fitted to the positions over a
few metres, so that gait and wander do not count.

The direction has no jumps: along the path its sign is that of the direction before, so it does not flip where the robot
reverses or turns on the spot. One sign holds for the session: most of the path is travelled along x. Where the path
tells no direction (the robot stands, turns back or climbs a shaft) the directions before and after it are interpolated.
A session that stands has the sensor's own heading, levelled.
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry.arrays import Float64Array, Int64Array
from cdpipe.core.geometry.poses import make_pose, require_poses

# Name of these frames in what is stored of them: descriptors and training data of other frames are not the same.
FRAMES = "path and gravity 1"
# The line is fitted to the path this far to either side: half the length of a sphere image.
REACH_M = 2.0
# Positions nearer to the last one that counted do not count: a standing sensor jitters by centimetres.
_STEP_M = 0.5
# A fitted line of a lower slope (metres of displacement per metre of path) tells no direction: the path turns back.
_MIN_SLOPE = 0.5
# A direction, of length 1, whose horizontal part is shorter is a shaft's.
_MIN_HORIZONTAL = 0.3
_UP = np.array([0.0, 0.0, 1.0])


def path_frames(odom_T_sensor: Float64Array, scans: Int64Array) -> Float64Array:
    """Return the (K, 4, 4) frames by path and gravity, odom_T_frame, at K scans.

    Args:
        odom_T_sensor: (S, 4, 4) poses of all scans of the session.
        scans: (K,) scans at which frames are asked for.
    """
    require_poses("odom_T_sensor", odom_T_sensor)
    positions = odom_T_sensor[scans, :3, 3]
    directions = _find_directions(odom_T_sensor[:, :3, 3])
    ahead = _level_headings(odom_T_sensor[scans, :3, :3]) if directions is None else directions[scans]
    across = np.cross(_UP, ahead)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return make_pose(np.stack([ahead, across, np.cross(ahead, across)], axis=-1), positions)


def _find_directions(positions: Float64Array) -> Float64Array | None:
    """Return the (S, 3) unit direction of the path at each position, None if the path tells none."""
    counted = [0]
    for index, position in enumerate(positions):
        if np.linalg.norm(position - positions[counted[-1]]) >= _STEP_M:
            counted.append(index)
    path = positions[counted]
    steps = np.diff(path, axis=0)
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    if path_m[-1] < REACH_M:
        return None
    slopes = np.array([_fit_slope(path, path_m, index) for index in range(len(path))])
    lengths = np.linalg.norm(slopes, axis=1)
    known = np.flatnonzero((lengths >= _MIN_SLOPE) & (np.hypot(*slopes.T[:2]) >= _MIN_HORIZONTAL * lengths))
    if len(known) == 0:
        return None
    directions = slopes[known] / lengths[known, None]
    # by their horizontal parts, so that none vanishes between two neighbours
    flips = np.einsum("ij,ij->i", directions[1:, :2], directions[:-1, :2]) < 0
    signs = np.where(np.cumsum(np.concatenate([[False], flips])) % 2, -1.0, 1.0)
    directions *= signs[:, None] * (1.0 if signs.sum() >= 0 else -1.0)
    last = np.searchsorted(counted, np.arange(len(positions)), side="right") - 1
    here_m = path_m[last] + np.linalg.norm(positions - path[last], axis=1)
    found = np.column_stack([np.interp(here_m, path_m[known], axis) for axis in directions.T])
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _fit_slope(path: Float64Array, path_m: Float64Array, index: int) -> Float64Array:
    """Return the (3,) slope, per metre of path, of the straight line that fits it within `REACH_M` of one position.

    Both neighbours of the position belong to the line, however far they are.
    """
    first, end = np.searchsorted(path_m, [path_m[index] - REACH_M, path_m[index] + REACH_M])
    near = slice(max(min(first, index - 1), 0), max(end, index + 2))
    offset_m = path_m[near] - path_m[near].mean()
    return np.asarray(offset_m @ path[near] / (offset_m @ offset_m))


def _level_headings(rotations: Float64Array) -> Float64Array:
    """Return the (K, 3) horizontal headings of K sensors; of one whose x axis is upright, the heading of its z axis."""
    axes = rotations[:, :, 0] * [1.0, 1.0, 0.0]
    upright = np.linalg.norm(axes, axis=1) < _MIN_HORIZONTAL
    axes[upright] = rotations[upright, :, 2] * [1.0, 1.0, 0.0]
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))
