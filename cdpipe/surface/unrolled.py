"""Places of a tunnel by chainage and angle, as surveyors unroll it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, travelled_m
from cdpipe.core.path_frames import path_frames


def unroll(points: Float64Array, odom_T_sensor: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return chainage, angle and distance of (Q, 3) points about the path of a session, in its odom frame.

    The chainage is that of the nearest pose, plus the way from there along the direction of the path. Where a session
    passes a place twice, the nearer pass counts.

    Args:
        points: (Q, 3) points, odom frame, metres.
        odom_T_sensor: (S, 4, 4) poses of the scans.

    Returns:
        (Q,) chainage along the path, metres; (Q,) angle about it, degrees: 0 the crown of the roof, 90 the left wall,
        -90 the right wall, 180 the floor; (Q,) distance from it, metres.
    """
    frames = path_frames(odom_T_sensor, np.arange(len(odom_T_sensor)))
    nearest = np.asarray(cKDTree(frames[:, :3, 3]).query(points)[1], dtype=np.int64)
    offsets = np.einsum("nji,nj->ni", frames[nearest, :3, :3], points - frames[nearest, :3, 3])
    steps = np.diff(odom_T_sensor[:, :3, 3], axis=0, append=odom_T_sensor[-1:, :3, 3])
    is_backward = np.einsum("ij,ij->i", steps, frames[:, :3, 0]) < 0
    along_m = np.where(is_backward[nearest], -offsets[:, 0], offsets[:, 0])
    chainage_m = travelled_m(odom_T_sensor)[nearest] + along_m
    angle_deg = np.rad2deg(np.arctan2(offsets[:, 1], offsets[:, 2]))
    return chainage_m, angle_deg, np.hypot(offsets[:, 1], offsets[:, 2])
