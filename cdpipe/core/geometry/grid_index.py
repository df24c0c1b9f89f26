"""Grid index: points sorted by 2 m columns, so that cropping a sphere reads about a dozen contiguous slices."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry.arrays import BoolArray, Float64Array, Int64Array, require_shape

_COLUMN_M = 2.0
_SHIFT = 31
_HALF = 1 << 30


def column_keys(points: Float64Array) -> Int64Array:
    """Return the (N,) key of the 2 m column of each of (N, 3) points; keys sort by x, then y."""
    cells = np.floor(points[:, :2] / _COLUMN_M).astype(np.int64)
    return _key(cells[:, 0], cells[:, 1])


class GridIndex:
    """The points of a map, sorted for cropping. Points that are already sorted, as by `build_map`, are not copied."""

    def __init__(self, points: Float64Array) -> None:
        require_shape("points", points, (None, 3))
        keys = column_keys(points)
        self._order: Int64Array | None = None
        if (np.diff(keys) < 0).any():
            self._order = np.argsort(keys, kind="stable")
            points, keys = points[self._order], keys[self._order]
        self._points = points
        self._keys = keys

    def crop(self, centre: Float64Array, radius_m: float) -> Int64Array:
        """Return the indices of the points within `radius_m` of `centre` (3,), the border included.

        They index the array that the index was built from, and are ordered by column.
        """
        points, starts, lengths = self._around(centre, radius_m)
        inside = np.flatnonzero(is_in_sphere(points, centre, radius_m))
        # offset from a position in the concatenated slices to an index into all points
        skipped = starts - np.cumsum(lengths) + lengths
        indices: Int64Array = inside + np.repeat(skipped, lengths).take(inside)
        return indices if self._order is None else self._order[indices]

    def points_within(self, centre: Float64Array, radius_m: float) -> Float64Array:
        """Return the (N, 3) points within `radius_m` of `centre` (3,); faster than indexing by `crop`."""
        points, _, _ = self._around(centre, radius_m)
        return points[is_in_sphere(points, centre, radius_m)]

    def _around(self, centre: Float64Array, radius_m: float) -> tuple[Float64Array, Int64Array, Int64Array]:
        """Return the points of the slices that contain a sphere, and start and length of each slice."""
        low = np.floor((centre[:2] - radius_m) / _COLUMN_M).astype(np.int64)
        high = np.floor((centre[:2] + radius_m) / _COLUMN_M).astype(np.int64)
        rows = np.arange(low[0], high[0] + 1)
        starts = np.searchsorted(self._keys, _key(rows, low[1]), side="left")
        ends = np.searchsorted(self._keys, _key(rows, high[1]), side="right")
        slices = [self._points[start:end] for start, end in zip(starts.tolist(), ends.tolist(), strict=True)]
        return np.concatenate(slices), starts, ends - starts


def is_in_sphere(points: Float64Array, centre: Float64Array, radius_m: float) -> BoolArray:
    """Mark the (N, 3) points within `radius_m` of `centre` (3,), the border included."""
    # axis by axis: numpy is slow at sums over rows of three
    x, y, z = (points[:, axis] - centre[axis] for axis in range(3))
    return np.asarray(x * x + y * y + z * z <= radius_m * radius_m)


def _key(row: Int64Array, column: Int64Array) -> Int64Array:
    return ((row + _HALF) << _SHIFT) + (column + _HALF)
