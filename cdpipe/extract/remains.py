"""Whether something was taken off what still stands, like a load off a muck pile, or removed as a whole."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.voxel import cell_means
from cdpipe.extract.shape import ground_heights

# How near a point must be to be the object's neighbour, and how near the other session's to have stayed.
_BESIDE_M = 0.35
_STAYED_M = 0.15
# The ground is the lowest of columns this wide; the foot of an object and a rut are no farther above it.
_GROUND_M = 0.8
_ABOVE_GROUND_M = 0.15
# A flank of muck is not steeper than 57 deg, a wall is.
_MIN_UPWARD = 0.6
_NEIGHBOURS = 10
_NORMAL_RADIUS_M = 0.4
_MIN_NEIGHBOURS = 4
# Found on validation pairs, out of what the pipeline cut: whole objects reach 0.23, what was loaded off begins at 0.49.
_LEAST_SEAM = 0.36
# A slope is neither level nor upright: so far its normal points up. On validation pairs 0.49 and more of the surface of
# every pile is slope, 0.32 at most of 10 of 11 parts of other objects.
_SLOPE_CELL_M = 0.1
_SLOPE = (0.45, 0.93)
_LEAST_SLOPE = 0.4


def is_part_of_remainder(taken_map: Float64Array, rest_map: Float64Array, other_map: Float64Array) -> bool:
    """Tell whether a removed object was only a part: whether its surface went on in something that has stayed.

    The seam is the object's points that have a neighbour which stayed, lies above the ground and on a slope. A whole
    object meets only the floor, and perhaps a wall. The number of points on the seam is compared with the square root
    of the number of all, as the length of a seam grows with that.

    Args:
        taken_map: (P, 3) the object's points, map frame, metres.
        rest_map: (Q, 3) the other points of its session around it.
        other_map: (R, 3) the points of the other session around it.
    """
    if min(len(taken_map), len(rest_map), len(other_map)) == 0:
        return False
    beside_m, _ = cKDTree(taken_map[:, :2]).query(rest_map[:, :2])
    beside = rest_map[beside_m < _BESIDE_M]
    stayed_m, _ = cKDTree(other_map).query(beside)
    heights = beside[:, 2] - ground_heights(np.concatenate([rest_map, other_map]), beside, _GROUND_M)
    rest = beside[(stayed_m < _STAYED_M) & (heights > _ABOVE_GROUND_M)]
    upward, is_known = _upward(rest, rest_map)
    rest = rest[is_known & (upward > _MIN_UPWARD)]
    found = cKDTree(taken_map).query(rest)
    apart_m, at = np.asarray(found[0]), np.asarray(found[1])
    seam = np.unique(at[apart_m < _BESIDE_M])
    return bool(len(seam) >= _LEAST_SEAM * np.sqrt(len(taken_map)))


def is_heap(points_map: Float64Array) -> bool:
    """Tell whether much of a surface (P, 3) is slope: that of a heap, not of what could be carried elsewhere."""
    surface, _ = cell_means(points_map, _SLOPE_CELL_M)
    upward, is_known = _upward(surface, surface)
    is_slope = (upward > _SLOPE[0]) & (upward < _SLOPE[1])
    return bool(is_known.any() and is_slope[is_known].mean() >= _LEAST_SLOPE)


def _upward(places: Float64Array, surface: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Return how far a surface (Q, 3) faces up or down at (N, 3) of its points, 0 to 1, and where that is known."""
    wanted = [*range(1, min(_NEIGHBOURS, len(surface)) + 1)]
    found = cKDTree(surface).query(places, k=wanted)
    around, is_near = np.asarray(found[1]), np.asarray(found[0]) < _NORMAL_RADIUS_M
    counts = is_near.sum(axis=1)
    offsets = surface[around] - places[:, None]
    means = (offsets * is_near[:, :, None]).sum(axis=1) / np.maximum(counts, 1)[:, None]
    offsets = (offsets - means[:, None]) * is_near[:, :, None]
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]
    return np.abs(normals[:, 2]), np.asarray(counts >= _MIN_NEIGHBOURS)
