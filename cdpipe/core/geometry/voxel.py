"""Grids: integer keys of voxels, means per voxel, the distinct voxels of a stream of points, and images of ranges."""

from __future__ import annotations

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry.arrays import Float32Array, Float64Array, Int64Array

FINEST_CELL_M = 0.05
"""Edge of the finest cells of the extraction and of the surface, which decides how far away places may be."""
_BITS = 21
_HALF = 1 << (_BITS - 1)


def max_coordinate_m(cell_m: float) -> float:
    """Return the largest coordinate for which `cell_keys` can number cells of this size, metres."""
    return (_HALF - 1) * cell_m


def require_reachable(where: str, farthest_m: float, cell_m: float, setting: str = "") -> None:
    """Refuse places that `cell_keys` cannot number.

    Args:
        where: The recording, for the message.
        farthest_m: Its largest coordinate, metres.
        cell_m: Edge of a cell, metres.
        setting: The setting that says so, "map.voxel_m = ".

    Raises:
        InputError: They are too far away, or not finite.
    """
    if not farthest_m < max_coordinate_m(cell_m):
        raise InputError(
            f"{where}: positions reach {farthest_m:.0f} m, cells of {setting}{cell_m} m can be numbered up to "
            f"{max_coordinate_m(cell_m):.0f} m: subtract a common offset from the trajectory "
            "(of a recording: --origin X,Y,Z)"
        )


def cell_keys(points: Float64Array, cell_m: float, origin_m: float = 0.0) -> Int64Array:
    """Return the key of the grid cell of each point; keys sort by x, then y, then z.

    Args:
        points: (N, 3) points, metres.
        cell_m: Edge of a cell, metres.
        origin_m: Coordinate of a grid corner, the same on every axis, metres.

    Returns:
        (N,) int64 keys.

    Raises:
        ValueError: A point is not finite or farther than `max_coordinate_m` from the origin.
    """
    keys = np.zeros(len(points), dtype=np.int64)
    for axis in range(3):
        cells = np.floor((points[:, axis] - origin_m) / cell_m)
        # this form also rejects NaN
        if len(cells) and not (cells.min() >= -_HALF and cells.max() < _HALF):
            raise ValueError(
                f"points must be finite and within {max_coordinate_m(cell_m):.0f} m for cells of {cell_m} m"
            )
        keys <<= _BITS
        keys += cells.astype(np.int64) + _HALF
    return keys


def cell_corners(keys: Int64Array, cell_m: float) -> Float64Array:
    """Return the (N, 3) lower corner of the cell of each key, metres relative to `origin_m`."""
    shifts = np.array([2 * _BITS, _BITS, 0])
    return np.asarray((((keys[:, None] >> shifts) & ((1 << _BITS) - 1)) - _HALF) * cell_m)


def thin(points: Float64Array, cell_m: float) -> Float64Array:
    """Return the (C, 3) first point of each occupied cell, in the order of the keys."""
    _, first = np.unique(cell_keys(points, cell_m), return_index=True)
    return points[first]


def cell_means(points: Float64Array, cell_m: float) -> tuple[Float64Array, Int64Array]:
    """Return the (C, 3) mean of the points of each occupied cell, and the (N,) cell of each point."""
    _, cells = np.unique(cell_keys(points, cell_m), return_inverse=True)
    counts = np.bincount(cells)
    means = np.column_stack([np.bincount(cells, points[:, axis]) / counts for axis in range(3)])
    return means, cells.astype(np.int64)


def nearest_image(pixels: Int64Array, values_m: Float64Array, shape: tuple[int, int]) -> Float32Array:
    """Return the float32 image of a shape with the smallest value of each pixel, 0 in a pixel without one.

    Args:
        pixels: (N,) pixel of each value, row * columns + column; negative ones are outside the image.
        values_m: (N,) ranges or distances, metres.
        shape: Rows and columns.
    """
    is_inside = pixels >= 0
    image = np.full(shape[0] * shape[1], np.inf, dtype=np.float32)
    # `minimum.at` is much faster without a type conversion
    np.minimum.at(image, pixels[is_inside], values_m[is_inside].astype(np.float32))
    image[np.isinf(image)] = 0.0
    return image.reshape(shape)


class UniqueCells:
    """The distinct keys of a stream, numbered by first appearance; memory grows with the number of distinct keys.

    New cells of one batch are numbered in the order of their keys.
    """

    def __init__(self) -> None:
        self._sorted_keys = np.zeros(0, dtype=np.int64)
        self._sorted_ids = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._sorted_keys)

    def add(self, keys: Int64Array) -> Int64Array:
        """Add the next (N,) keys of the stream and return the (N,) number of the cell of each."""
        # neighbours in a scan mostly share a cell, so sorting one key per run is faster
        starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1])[: len(keys)])
        lengths = np.diff(starts, append=len(keys))
        cells, run_cell = np.unique(keys[starts], return_inverse=True)
        place = np.searchsorted(self._sorted_keys, cells)
        is_known = np.zeros(len(cells), dtype=np.bool_)
        inside = place < len(self)
        is_known[inside] = self._sorted_keys[place[inside]] == cells[inside]
        is_new = ~is_known

        ids = np.empty(len(cells), dtype=np.int64)
        ids[is_known] = self._sorted_ids[place[is_known]]
        ids[is_new] = len(self) + np.arange(np.count_nonzero(is_new))

        self._sorted_keys = np.insert(self._sorted_keys, place[is_new], cells[is_new])
        self._sorted_ids = np.insert(self._sorted_ids, place[is_new], ids[is_new])
        return np.repeat(ids[run_cell], lengths)

    @property
    def keys(self) -> Int64Array:
        """(C,) key of each cell, indexed by its number."""
        keys = np.empty(len(self), dtype=np.int64)
        keys[self._sorted_ids] = self._sorted_keys
        return keys
