"""Places of the before surface at which displacement is measured, with normals and the roughness around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array
from cdpipe.core.voxel import cell_means
from cdpipe.surface.cells import CELL_M, SurfaceCells

_NEAREST = 80
_LEAST_CELLS = 8
_BLOCK = 1 << 14


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePlaces:
    """Q places on the before surface.

    Attributes:
        points: (Q, 3) map frame, metres.
        normals: (Q, 3) unit normal at each, into the void.
        roughness_m: (Q,) standard deviation of the cells around it, off their plane.
        flatness: (Q,) the same, over the smaller spread within the plane: 0 a plane, 1 no surface at all.
        areas_m2: (Q,) area of the surface that each place stands for.
    """

    points: Float64Array
    normals: Float64Array
    roughness_m: Float64Array
    flatness: Float64Array
    areas_m2: Float64Array


def choose_places(before: SurfaceCells, path: Float64Array, spacing_m: float, normal_m: float) -> SurfacePlaces:
    """Return the cell nearest to the mean of the cells of each voxel, where there are enough of them for a plane.

    A voxel grid of edge h meets a plane of unit normal n in (|n_x| + |n_y| + |n_z|) / h^2 voxels per unit of area
    (Crofton), so each place stands for h^2 / (|n_x| + |n_y| + |n_z|).

    Args:
        before: Cells of the before session.
        path: (K, 3) positions of the sensor, map frame; normals point towards the nearest.
        spacing_m: Edge of a voxel, metres.
        normal_m: Radius of the cells that the plane is fitted to, metres.
    """
    means, _ = cell_means(before.points, spacing_m)
    chosen = np.unique(before.tree.query(means)[1])
    points = before.points[chosen]
    parts = [_fit_planes(before, points[start : start + _BLOCK], normal_m) for start in range(0, len(points), _BLOCK)]
    if not parts:
        none = np.zeros(0)
        return SurfacePlaces(np.zeros((0, 3)), np.zeros((0, 3)), none, none, none)
    normals, spreads_m, counts = (np.concatenate(part) for part in zip(*parts, strict=True))
    seen_from = path[cKDTree(path).query(points)[1]]
    normals *= np.where(np.einsum("ij,ij->i", normals, seen_from - points) < 0, -1.0, 1.0)[:, None]
    kept = np.flatnonzero(counts >= _LEAST_CELLS)
    normals, spreads_m = normals[kept], spreads_m[kept]
    areas_m2 = spacing_m**2 / np.abs(normals).sum(axis=1)
    flatness = spreads_m[:, 0] / np.maximum(spreads_m[:, 1], CELL_M / 2)
    return SurfacePlaces(points[kept], normals, spreads_m[:, 0], flatness, areas_m2)


def _fit_planes(
    cells: SurfaceCells, points: Float64Array, normal_m: float
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the (N, 3) normal, the (N, 3) standard deviations along the axes, and the (N,) number of cells."""
    distance_m, index = cells.tree.query(points, k=_NEAREST, distance_upper_bound=normal_m)
    is_found = np.isfinite(distance_m)
    around = cells.points.take(np.where(is_found, index, 0), axis=0) - points[:, None]
    counts = is_found.sum(axis=1)
    around *= is_found[:, :, None]
    around -= (around.sum(axis=1) / np.maximum(counts, 1)[:, None])[:, None]
    around *= is_found[:, :, None]
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / np.maximum(counts, 1)[:, None, None])
    return axes[:, :, 0], np.sqrt(np.maximum(values, 0.0)), counts.astype(np.float64)
