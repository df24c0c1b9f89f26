"""The range image of a scan, input of the scan descriptor (3DEG, arXiv 2210.07285, section III)."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array
from cdpipe.core.geometry.voxel import nearest_image

ROWS = 32
COLUMNS = 256
# Highest elevation of the rows: 22.1 degrees of a nominal OS1-32 and half a beam.
ELEVATION_RAD = np.deg2rad(22.8)


def range_image(points_sensor: Float64Array) -> Float32Array:
    """Project deskewed returns into a (ROWS, COLUMNS) float32 range image, metres, 0 where nothing returned.

    Rows run from the highest elevation to the lowest, columns counter-clockwise from sensor +x. A pixel holds its
    nearest return.

    Args:
        points_sensor: (N, 3) returns, sensor frame, metres.
    """
    x, y, z = np.ascontiguousarray(points_sensor.T)
    ranges = np.sqrt(x * x + y * y + z * z)
    is_return = ranges > 0
    elevation = np.arcsin(np.clip(z / np.where(is_return, ranges, 1.0), -1.0, 1.0))
    rows = np.floor((ELEVATION_RAD - elevation) / (2 * ELEVATION_RAD) * ROWS).astype(np.int64)
    turn = np.arctan2(y, x) / (2 * np.pi)
    columns = np.floor(turn * COLUMNS).astype(np.int64) % COLUMNS
    is_inside = (rows >= 0) & (rows < ROWS) & is_return
    return nearest_image(np.where(is_inside, rows * COLUMNS + columns, -1), ranges, (ROWS, COLUMNS))
