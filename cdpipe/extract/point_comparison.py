"""The paper's comparison of two clouds: point-to-voxel comparison, outlier removal, clusters."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.model.config import ClusterConfig, ExtractConfig, OutlierConfig

_MAX_DENSE_CELLS = 1 << 22


def new_points_mask(points: Float64Array, reference_points: Float64Array, config: ExtractConfig) -> BoolArray:
    """Mark the points that lie in no occupied voxel of the reference.

    The grid is fixed to the frame: it has a corner at `origin_m` on every axis. A voxel is occupied if it holds at
    least `min_points` reference points.

    Args:
        points: (N, 3) points, metres.
        reference_points: (M, 3) points of the other session, same frame; they should reach a voxel beyond `points`.
        config: Voxel size, `min_points`, origin.

    Returns:
        (N,) mask, True for new points.
    """
    if len(points) == 0 or len(reference_points) == 0:
        return np.ones(len(points), dtype=np.bool_)
    cells = _cells(points, config)
    low = [int(each.min()) for each in cells]
    shape = [int(each.max()) - least + 1 for each, least in zip(cells, low, strict=True)]
    if math.prod(shape) > _MAX_DENSE_CELLS:
        return _new_by_keys(points, reference_points, config)
    return _new_by_grid(cells, _cells(reference_points, config), low, shape, config.min_points)


def is_within(points: Float64Array, others: Float64Array, distance_m: float) -> BoolArray:
    """Mark the (N, 3) points with one of the (M, 3) others within a distance, border included."""
    if len(points) == 0 or len(others) == 0:
        return np.zeros(len(points), dtype=np.bool_)
    # the bound of the search excludes the border, so it is slightly larger
    gaps_m, _ = cKDTree(others).query(points, distance_upper_bound=distance_m * (1 + 1e-6))
    return np.asarray(gaps_m) <= distance_m


def inlier_mask(points: Float64Array, config: OutlierConfig) -> BoolArray:
    """Mark the inliers of the paper's statistical outlier removal (section IV).

    An inlier's mean distance to its k nearest neighbours lies in (mu - lambda sigma, mu + lambda sigma). The paper
    gives neither lambda nor k. All points of a cloud of k or fewer points are inliers.

    Args:
        points: (N, 3) points, metres.
        config: k, and lambda.

    Returns:
        (N,) mask, True for the points to keep.
    """
    if len(points) <= config.neighbours:
        return np.ones(len(points), dtype=np.bool_)
    distances, _ = cKDTree(points).query(points, k=config.neighbours + 1)
    spacing = np.asarray(distances)[:, 1:].mean(axis=1)
    mean = spacing.mean()
    deviation = spacing - mean
    # closed interval with a tolerance for rounding: with sigma = 0 no point is an outlier
    reach = config.sigmas * np.sqrt(np.mean(deviation * deviation)) + 1e-9 * mean
    return np.asarray(np.abs(deviation) <= reach)


def label_clusters(points: Float64Array, config: ClusterConfig) -> Int64Array:
    """Label the clusters: connected components of the points within `radius_m` of each other.

    Returns:
        (N,) labels from 0 by falling size (ties: by first point); -1 for clusters smaller than `min_points`.
    """
    groups, sizes = label_groups(points, config.radius_m)
    first = np.unique(groups, return_index=True)[1]
    order = np.lexsort((first, -sizes))
    labels = np.full(len(sizes), -1, dtype=np.int64)
    big = order[sizes[order] >= config.min_points]
    labels[big] = np.arange(len(big))
    return labels[groups]


def cluster_inliers(
    points: Float64Array, new: Int64Array, outlier: OutlierConfig, cluster: ClusterConfig
) -> list[Int64Array]:
    """Return the indices into (N, 3) points of each cluster of the new ones, without outliers, largest cluster first.

    Args:
        points: (N, 3) points, metres.
        new: (M,) indices of the new points.
        outlier: Of the outlier removal.
        cluster: Of the clusters.
    """
    new = new[inlier_mask(points[new], outlier)]
    labels = label_clusters(points[new], cluster)
    return [new[labels == label] for label in range(labels.max(initial=-1) + 1)]


def _cells(points: Float64Array, config: ExtractConfig) -> list[Float64Array]:
    """Return the (N,) voxel index of each point for each axis; numpy is faster axis by axis."""
    return [np.floor((points[:, axis] - config.origin_m) / config.voxel_m) for axis in range(3)]


def _new_by_grid(
    cells: list[Float64Array], reference: list[Float64Array], low: list[int], shape: list[int], min_points: int
) -> BoolArray:
    """Look the voxels up in a dense table over their bounding box."""
    is_in_box = np.ones(len(reference[0]), dtype=np.bool_)
    for each, least, count in zip(reference, low, shape, strict=True):
        is_in_box &= (each >= least) & (each < least + count)
    inside = _in_table([each[is_in_box] for each in reference], low, shape)
    if min_points == 1:
        is_occupied = np.zeros(math.prod(shape), dtype=np.bool_)
        is_occupied[inside] = True
    else:
        is_occupied = np.bincount(inside, minlength=math.prod(shape)) >= min_points
    return ~is_occupied[_in_table(cells, low, shape)]


def _in_table(cells: list[Float64Array], low: list[int], shape: list[int]) -> Int64Array:
    x, y, z = (each - least for each, least in zip(cells, low, strict=True))
    return np.asarray(((x * shape[1] + y) * shape[2] + z).astype(np.int64))


def _new_by_keys(points: Float64Array, reference_points: Float64Array, config: ExtractConfig) -> BoolArray:
    """Look the points up among sorted voxel keys, for clouds whose bounding box is too large for a table."""
    cells, counts = np.unique(cell_keys(reference_points, config.voxel_m, config.origin_m), return_counts=True)
    occupied = cells[counts >= config.min_points]
    return ~np.isin(cell_keys(points, config.voxel_m, config.origin_m), occupied)
