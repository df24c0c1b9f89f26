"""A scan as the image the descriptor network reads (3DEG, arXiv 2210.07285, section III)."""

from __future__ import annotations

import numpy as np

from cdpipe.geometry import Float32Array, Float64Array

ROWS = 32
COLUMNS = 256
# Elevation covered by the rows: the nominal OS1-32, +-22.1 deg, and half a beam more on either side.
ELEVATION_RAD = np.deg2rad(22.8)


def range_image(points_sensor: Float64Array) -> Float32Array:
    """Project deskewed returns into a (ROWS, COLUMNS) float32 range image, metres, 0 where nothing returned.

    Rows run from the highest elevation to the lowest, columns counter-clockwise from sensor +x. The nearest return of a
    pixel wins.

    Args:
        points_sensor: (N, 3) returns, sensor frame, metres.
    """
    ranges = np.linalg.norm(points_sensor, axis=1)
    points, ranges = points_sensor[ranges > 0], ranges[ranges > 0]
    elevation = np.arcsin(np.clip(points[:, 2] / ranges, -1.0, 1.0))
    rows = np.floor((ELEVATION_RAD - elevation) / (2 * ELEVATION_RAD) * ROWS).astype(np.int64)
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    columns = np.floor(turn * COLUMNS).astype(np.int64) % COLUMNS
    inside = (rows >= 0) & (rows < ROWS)
    image = np.full(ROWS * COLUMNS, np.inf)
    np.minimum.at(image, rows[inside] * COLUMNS + columns[inside], ranges[inside])
    image[np.isinf(image)] = 0.0
    return image.reshape(ROWS, COLUMNS).astype(np.float32)
