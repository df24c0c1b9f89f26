"""Deskewing: a spinning sensor moves during a revolution, so every column has its own pose."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, require_shape


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
