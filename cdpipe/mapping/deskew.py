"""Deskewing: a spinning sensor moves during a revolution, so every column has its own pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose, require_shape
from cdpipe.core.geometry.motion import Motion
from cdpipe.model.types import PosedScan

# Points are deskewed in steps of this time: 0.3 mm at 3 m/s.
_STEP_S = 1e-4
# What an odometry that spins led astray moves back by up to 100 m/s.
_FINE_STEP_S = 1e-5


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


def deskew_points(points: Float64Array, offset_s: Float64Array, stamp_s: float, motion: Motion) -> Float64Array:
    """Return points (N, 3), each in the sensor frame at its own time, in the sensor frame at the stamp of the scan.

    Args:
        points: (N, 3) points, metres.
        offset_s: (N,) time of each after the stamp.
        stamp_s: The stamp, of the clock of the motion.
        motion: `odom_T_sensor` over time.
    """
    then_s, which = _round_times(offset_s, _STEP_S)
    return _moved(_sensor_T_then(then_s, stamp_s, motion), which, points)


def deskew_anew(scan: PosedScan, recorded: Motion, motion: Motion) -> PosedScan:
    """Return a scan that was deskewed by one motion as another deskews it; the scan itself where none did.

    Args:
        scan: The scan.
        recorded: The motion `odom_T_sensor` that deskewed it, over the time of the session.
        motion: The other one, over the same time.
    """
    if scan.pose_ns is None:
        return scan
    pose_s = scan.pose_ns / 1e9
    then_s, which = _round_times((scan.stamps_ns - scan.pose_ns) / 1e9, _FINE_STEP_S)
    recorded_T_then, sensor_T_then = (_sensor_T_then(then_s, pose_s, each) for each in (recorded, motion))
    return replace(scan, points_sensor=_moved(sensor_T_then @ invert(recorded_T_then), which, scan.points_sensor))


def _round_times(offset_s: Float64Array, step_s: float) -> tuple[Float64Array, Int64Array]:
    """Return the (M,) different times, rounded to a step, and which of them is that of each of (N,)."""
    steps, which = np.unique(np.round(offset_s / step_s).astype(np.int64), return_inverse=True)
    return steps.astype(np.float64) * step_s, which


def _sensor_T_then(then_s: Float64Array, stamp_s: float, motion: Motion) -> Float64Array:
    """Return the (M, 4, 4) poses of the sensor some time after a stamp, in its frame at the stamp."""
    places, quaternions = motion.sample(stamp_s + then_s)
    (at,), (turn,) = motion.sample(np.array([stamp_s]))
    sensor_R_odom = Rotation.from_quat(turn).inv()
    return make_pose((sensor_R_odom * Rotation.from_quat(quaternions)).as_matrix(), sensor_R_odom.apply(places - at))


def _moved(dst_T_src: Float64Array, which: Int64Array, points: Float64Array) -> Float64Array:
    """Return (N, 3) points, each transformed by one of (M, 4, 4) poses."""
    turned: Float64Array = np.einsum("nij,nj->ni", dst_T_src[which, :3, :3], points)
    return turned + dst_T_src[which, :3, 3]
