"""Reshaped objects: whether a removed object is only a part of one that remains, such as a load off a muck pile."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.core.geometry.voxel import cell_keys, cell_means
from cdpipe.extract.shape import ground_heights

# Largest distance of a neighbour of the object, and to the other session for a point that stayed.
_BESIDE_M = 0.35
_STAYED_M = 0.15
# Column width of the ground, and height above it that may be a foot or a rut.
_GROUND_M = 0.8
_ABOVE_GROUND_M = 0.15
# The plane of the floor: column width, least vertical component of the normal (25 degrees; muck lies at 34 and more),
# height above the plane from which a point is something on the floor, fewest points, and most rounds of the fit.
_FLOOR_COLUMN_M, _FLOOR_UPWARD, _ON_FLOOR_M, _FEWEST_FLOOR, _FLOOR_ROUNDS = 0.4, 0.9, 0.1, 8, 10
# Least vertical component of the normal: a muck slope is at most 53 degrees steep, a wall is steeper.
_MIN_UPWARD = 0.6
_NEIGHBOURS = 10
_NORMAL_RADIUS_M = 0.4
_MIN_NEIGHBOURS = 4
# Least length of the seam. On validation pairs whole objects reach 0.23, parts of piles start at 0.49.
_LEAST_SEAM = 0.36
# Vertical component of a slope's normal, and least share of slope in a heap. On validation pairs every pile has at
# least 0.49, 10 of 11 parts of other objects at most 0.32.
_SLOPE_CELL_M = 0.1
_SLOPE = (0.45, 0.93)
_LEAST_SLOPE = 0.4


def is_part_of_remainder(taken_map: Float64Array, rest_map: Float64Array, other_map: Float64Array) -> bool:
    """Return whether the surface of a removed object continued in an object that stayed.

    The seam is the set of the object's points with a neighbour that stayed, lies above the ground and is on a slope. A
    whole object touches only the floor or a wall. Heights are measured from the plane of the floor, which may slope.
    The length of a seam grows with the square root of the number of points, so the seam is compared with that.

    Args:
        taken_map: (P, 3) points of the object, map frame, metres.
        rest_map: (Q, 3) other points of its session around it, map frame.
        other_map: (R, 3) points of the other session around it, map frame.
    """
    if min(len(taken_map), len(rest_map), len(other_map)) == 0:
        return False
    beside_m, _ = cKDTree(taken_map[:, :2]).query(rest_map[:, :2])
    beside = rest_map[beside_m < _BESIDE_M]
    stayed_m, _ = cKDTree(other_map).query(beside)
    surface = np.concatenate([rest_map, other_map])
    # the lower of both: on a ramp the plane's is right, where few points tell the plane the level one's
    frames = [np.zeros(2), _fit_floor(surface)]
    placed = [(_above_plane(beside, slope), _above_plane(surface, slope)) for slope in frames]
    heights = np.min([of[:, 2] - ground_heights(on, of, _GROUND_M) for of, on in placed], axis=0)
    rest = beside[(stayed_m < _STAYED_M) & (heights > _ABOVE_GROUND_M)]
    upward, is_known = _upward(rest, rest_map)
    rest = rest[is_known & (upward > _MIN_UPWARD)]
    found = cKDTree(taken_map).query(rest)
    apart_m, at = np.asarray(found[0]), np.asarray(found[1])
    seam = np.unique(at[apart_m < _BESIDE_M])
    return bool(len(seam) >= _LEAST_SEAM * np.sqrt(len(taken_map)))


def is_heap(points_map: Float64Array) -> bool:
    """Return whether a large share of the surface of (P, 3) points is slope, as of a heap of muck."""
    surface, _ = cell_means(points_map, _SLOPE_CELL_M)
    upward, is_known = _upward(surface, surface)
    is_slope = (upward > _SLOPE[0]) & (upward < _SLOPE[1])
    return bool(is_known.any() and is_slope[is_known].mean() >= _LEAST_SLOPE)


def _fit_floor(surface: Float64Array) -> Float64Array:
    """Return the slope (2,) of the floor, its rise along x and y, from a (Q, 3) surface; zeros without enough floor.

    A plane is fitted to the lowest points of columns that lie flat. Points above it are left out, and it is fitted
    again.
    """
    lowest = surface[np.argsort(surface[:, 2], kind="stable")]
    lowest = lowest[np.unique(cell_keys(lowest * (1.0, 1.0, 0.0), _FLOOR_COLUMN_M), return_index=True)[1]]
    upward, is_known = _upward(lowest, surface)
    floor = lowest[is_known & (upward > _FLOOR_UPWARD)]
    for _ in range(_FLOOR_ROUNDS):
        if len(floor) < _FEWEST_FLOOR:
            return np.zeros(2)
        design = np.column_stack([floor[:, :2] - floor[:, :2].mean(axis=0), np.ones(len(floor))])
        plane = np.linalg.lstsq(design, floor[:, 2], rcond=None)[0]
        is_floor = floor[:, 2] - design @ plane < _ON_FLOOR_M
        if is_floor.all():
            break
        floor = floor[is_floor]
    return np.asarray(plane[:2])


def _above_plane(points: Float64Array, slope: Float64Array) -> Float64Array:
    """Return (N, 3) points with their distances from a plane through the origin, of a slope (2,), as heights."""
    return np.column_stack([points[:, :2], (points[:, 2] - points[:, :2] @ slope) / np.sqrt(1.0 + slope @ slope)])


def _upward(places: Float64Array, surface: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Return the (N,) absolute vertical component of the normals of a (Q, 3) surface at (N, 3) places, and if known."""
    wanted = [*range(1, min(_NEIGHBOURS, len(surface)) + 1)]
    found = cKDTree(surface).query(places, k=wanted)
    around, is_near = np.asarray(found[1]), np.asarray(found[0]) < _NORMAL_RADIUS_M
    counts = is_near.sum(axis=1)
    offsets = surface[around] - places[:, None]
    means = (offsets * is_near[:, :, None]).sum(axis=1) / np.maximum(counts, 1)[:, None]
    offsets = (offsets - means[:, None]) * is_near[:, :, None]
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]
    return np.abs(normals[:, 2]), np.asarray(counts >= _MIN_NEIGHBOURS)
