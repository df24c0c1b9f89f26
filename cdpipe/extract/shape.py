"""Shape of an object: its upright box, and the volume between it and the ground that the other session saw.

The volume is the integral of the height over the convex footprint. The height in each column of a horizontal grid is
that of the uppermost points above the lowest points of the other session; it is interpolated linearly between columns.
For a removed pile the other session saw the floor; for a removed part of a pile it saw the remainder.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from cdpipe.core.geometry import Float64Array, yaw_pose
from cdpipe.core.geometry.voxel import cell_keys

# The ground at a place is the median over this many nearest columns, robust against a false return below the floor.
_GROUND_COLUMNS = 5
# Height from which an object was seen with its sides, and largest gap below one that stands. A cut of the upper 0.24 m
# of what stands on the floor (`paper-topn`, `paper/site1` 10010) is lower.
_SIDES_M, _FOOT_M = 0.35, 0.3


def upright_box(points: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the smallest box with a vertical axis around (P, 3) points.

    The smallest rectangle around a footprint has an edge on an edge of the convex hull, so all hull edges are tried.

    Returns:
        The (4, 4) pose, x along the longer horizontal edge, yaw in [-90, 90) degrees; and the (3,) edges: longer
        horizontal, shorter horizontal, height, metres.
    """
    outline = _outline(points[:, :2])
    edges = np.roll(outline, -1, axis=0) - outline
    yaws = np.arctan2(edges[:, 1], edges[:, 0])
    axes = np.stack([np.column_stack([np.cos(yaws), np.sin(yaws)]), np.column_stack([-np.sin(yaws), np.cos(yaws)])])
    along = np.einsum("kai,pi->kap", axes, outline)
    low, high = along.min(axis=2), along.max(axis=2)
    best = int(np.argmin((high - low).prod(axis=0)))
    size, middle, yaw = (high - low)[:, best], (high + low)[:, best] / 2, float(yaws[best])
    centre_xy = middle @ axes[:, best]
    if size[1] > size[0]:
        size, yaw = size[::-1], yaw + np.pi / 2
    bottom_m, top_m = float(points[:, 2].min()), float(points[:, 2].max())
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    return yaw_pose(yaw, (*centre_xy, (bottom_m + top_m) / 2)), np.array([*size, top_m - bottom_m])


def column_volume_m3(
    points_map: Float64Array, other_map: Float64Array, column_m: float = 0.1, ground_m: float = 0.2
) -> float:
    """Return the volume between an object and the ground, or the roof that it hangs from; 0 without a footprint.

    An object with sides, farther above the ground than it is high, hangs free or on a wall: the volume is measured down
    to its own lowest point. Of a surface without sides nobody knows how deep it reaches.

    Args:
        points_map: (P, 3) points of the object, map frame, metres; P is at least 1.
        other_map: (Q, 3) points of the other session below and around it; if empty, the floor is level at the
            object's lowest point.
        column_m: Column width of the object, at least its point spacing, metres.
        ground_m: Column width of the ground, metres.
    """
    columns = _columns(points_map, column_m)
    if np.median(ground_heights(other_map, columns, ground_m) - columns[:, 2]) > 0:  # upside down
        points_map, other_map = points_map * _UPSIDE_DOWN, other_map * _UPSIDE_DOWN
        columns = _columns(points_map, column_m)
    lowest_m, high_m = points_map[:, 2].min(), np.ptp(points_map[:, 2])
    ground = ground_heights(other_map, columns, ground_m) if len(other_map) else np.full(len(columns), lowest_m)
    if high_m >= _SIDES_M and lowest_m - np.median(ground) > max(high_m, _FOOT_M):
        ground = np.full(len(columns), lowest_m)
    heights = np.maximum(columns[:, 2] - ground, 0.0)
    try:
        triangles = Delaunay(columns[:, :2]).simplices
    except (QhullError, ValueError):
        return 0.0
    a, b, c = (columns[triangles[:, k], :2] for k in range(3))
    doubled = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return float((doubled / 2 * heights[triangles].mean(axis=1)).sum())


def ground_heights(surface: Float64Array, places: Float64Array, ground_m: float = 0.2) -> Float64Array:
    """Return the (N,) height of the ground at (N, 2 or more) places, from the lowest points of a (Q, 3) surface.

    Without any surface the ground is at the lowest of the places, which must then be (N, 3).
    """
    if len(surface) == 0:
        return np.full(len(places), places[:, 2].min(initial=np.inf))
    lowest = surface[np.argsort(surface[:, 2], kind="stable")]
    flat = lowest * (1.0, 1.0, 0.0)
    _, first = np.unique(cell_keys(flat, ground_m), return_index=True)
    lowest = lowest[first]
    n_columns = min(_GROUND_COLUMNS, len(lowest))
    _, nearest = cKDTree(lowest[:, :2]).query(places[:, :2], k=[*range(1, n_columns + 1)])
    return np.asarray(np.median(lowest[nearest, 2], axis=1))


_UPSIDE_DOWN = np.array([1.0, 1.0, -1.0])


def _columns(points: Float64Array, column_m: float) -> Float64Array:
    """Return the (C, 3) mean of the upper points of each column, those within `column_m` of its top.

    Lower points belong to a vertical side.
    """
    _, column = np.unique(cell_keys(points * (1.0, 1.0, 0.0), column_m), return_inverse=True)
    highest = np.full(column.max(initial=-1) + 1, -np.inf)
    np.maximum.at(highest, column, points[:, 2])
    is_upper = points[:, 2] >= highest[column] - column_m
    upper, column = points[is_upper], column[is_upper]
    counts = np.bincount(column)
    return np.column_stack([np.bincount(column, upper[:, axis]) / counts for axis in range(3)])


def _outline(xy: Float64Array) -> Float64Array:
    """Return the (C, 2) corners of the convex hull, in order; the two ends for collinear points."""
    try:
        return np.asarray(xy[ConvexHull(xy).vertices])
    except (QhullError, ValueError):
        offsets = xy - xy.mean(axis=0)
        along = offsets @ np.linalg.svd(offsets, full_matrices=False)[2][0]
        return xy[[int(np.argmin(along)), int(np.argmax(along))]]
