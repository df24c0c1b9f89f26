"""Deskewing: a spinning sensor moves during a revolution, so every column has its own pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, require_shape
from cdpipe.core.geometry.motion import Motion
from cdpipe.model.types import PosedScan


def deskew(points_column: Float64Array, column_poses: Float64Array) -> Float64Array:
    """Transform each column's points into the frame of its revolution by the session's own odometry.

    Args:
        points_column: (H, W, 3) points, each column in the sensor frame at its own time, metres.
        column_poses: (W, 7) `sensor_T_column` as x, y, z, qx, qy, qz, qw.

    Returns:
        (H, W, 3) points in the sensor frame at the pose of the revolution, metres.
    """
    require_shape("points_column", points_column, (None, None, 3))
    require_shape("column_poses", column_poses, (points_column.shape[1], 7))
    rotations = Rotation.from_quat(column_poses[:, 3:]).as_matrix()
    # (W, H, 3) @ (W, 3, 3): one small product per column
    turned = points_column.swapaxes(0, 1) @ rotations.swapaxes(1, 2)
    turned += column_poses[:, None, :3]
    return turned.swapaxes(0, 1)


def deskew_anew(scan: PosedScan, recorded: Motion, motion: Motion) -> PosedScan:
    """Return a scan that was deskewed by one motion as another deskews it; the scan itself where none did.

    Args:
        scan: The scan.
        recorded: The motion `odom_T_sensor` that deskewed it, over the time of the session.
        motion: The other one, over the same time.
    """
    if scan.pose_ns is None:
        return scan
    at_s = np.array([scan.pose_ns / 1e9])
    stamps_ns, column = np.unique(scan.stamps_ns, return_inverse=True)
    time_s = stamps_ns / 1e9
    recorded_T_column, sensor_T_column = (invert(each.poses(at_s)) @ each.poses(time_s) for each in (recorded, motion))
    turns = sensor_T_column @ invert(recorded_T_column)
    points = np.einsum("nij,nj->ni", turns[column, :3, :3], scan.points_sensor) + turns[column, :3, 3]
    return replace(scan, points_sensor=points)
