"""The input image of the sphere descriptor: the tunnel wall around a keyframe, unrolled on a cylinder.

The anchor frame is the sensor's own, or it stands on path and gravity (`sphere.frames`,
`cdpipe.core.geometry.path_frames`). In the latter the image does not depend on how the sensor is mounted, held or
turned. Rows are metres along its x axis, columns are the angle about it, and a pixel is the distance of its nearest
point from the axis. Keyframes are a metre apart, so an image covers only 2 m of tunnel before and behind.
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, invert, transform
from cdpipe.core.geometry.grid_index import GridIndex
from cdpipe.core.geometry.voxel import nearest_image

ROWS = 16
COLUMNS = 96
HALF_LENGTH_M = 2.0
REACH_M = 12.0
# Radius of the sphere around a keyframe that contains its image.
CROP_M = float(np.hypot(HALF_LENGTH_M, REACH_M))


def pixels(points_anchor: Float64Array) -> Int64Array:
    """Return the (N,) pixel of each point, row * COLUMNS + column; -1 outside the image.

    Args:
        points_anchor: (N, 3) points in the keyframe's anchor frame, metres.
    """
    x, y, z = points_anchor.T
    row = np.floor((x + HALF_LENGTH_M) * (ROWS / (2 * HALF_LENGTH_M))).astype(np.int64)
    column = np.floor(np.arctan2(z, y) * (COLUMNS / (2 * np.pi))).astype(np.int64) % COLUMNS
    is_inside = (row >= 0) & (row < ROWS) & (y * y + z * z <= REACH_M * REACH_M)
    return np.where(is_inside, row * COLUMNS + column, -1)


def sphere_image(points_anchor: Float64Array) -> Float32Array:
    """Return the (ROWS, COLUMNS) float32 image: distance of the nearest point from the axis, metres, 0 without one.

    Args:
        points_anchor: (N, 3) points in the keyframe's anchor frame, metres.
    """
    pixel = pixels(points_anchor)
    is_inside = pixel >= 0
    distances_m = np.hypot(points_anchor[is_inside, 1], points_anchor[is_inside, 2])
    return nearest_image(pixel[is_inside], distances_m, (ROWS, COLUMNS))


def render(index: GridIndex, map_T_anchor: Float64Array) -> Float32Array:
    """Return the (K, ROWS, COLUMNS) float32 images of a map at K poses.

    Args:
        index: The points of the map.
        map_T_anchor: (K, 4, 4) anchor frames in the map's frame.
    """
    images = [
        sphere_image(transform(anchor_T_map, index.points_within(map_T_here[:3, 3], CROP_M)))
        for map_T_here, anchor_T_map in zip(map_T_anchor, invert(map_T_anchor), strict=True)
    ]
    return np.stack(images) if images else sphere_image(np.zeros((0, 3)))[None][:0]
