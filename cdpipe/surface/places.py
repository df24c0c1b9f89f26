"""Places of the before surface at which displacement is measured, with normals and the roughness around them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.core.threads import allowed_threads, in_threads
from cdpipe.surface.cells import CELL_M, SurfaceCells

_NEAREST = 80
_LEAST_CELLS = 8
_BLOCK = 1 << 14
# Radius of the disc that tells the area of a place, in spacings: the area of a tube 5 m wide comes out 2 % too large.
_DISC = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePlaces:
    """Q places on the before surface.

    Attributes:
        points: (Q, 3) map frame, metres.
        normals: (Q, 3) unit normal at each, into the void.
        roughness_m: (Q,) standard deviation of the cells around it, off their plane.
        flatness: (Q,) the same, over the smaller spread within the plane: 0 a plane, 1 no surface at all.
        areas_m2: (Q,) area of the surface that each place stands for.
        seen_from_m: (Q,) distance of each from the path of the before session.
    """

    points: Float64Array
    normals: Float64Array
    roughness_m: Float64Array
    flatness: Float64Array
    areas_m2: Float64Array
    seen_from_m: Float64Array

    def take(self, chosen: Int64Array) -> SurfacePlaces:
        """Return the chosen places, each with its own area."""
        return SurfacePlaces(*(getattr(self, each.name)[chosen] for each in fields(self)))


def choose_places(before: SurfaceCells, path: Float64Array, spacing_m: float, normal_m: float) -> SurfacePlaces:
    """Return the cell nearest to the mean of the cells of each voxel, where there are enough of them for a plane.

    A place stands for the area of a disc about it over the number of places within.

    Args:
        before: Cells of the before session.
        path: (K, 3) positions of the sensor, map frame; normals point towards the nearest.
        spacing_m: Edge of a voxel, metres.
        normal_m: Radius of the cells that the plane is fitted to, metres.
    """
    means, _ = cell_means(before.points, spacing_m)
    chosen = np.unique(before.tree.query(means, workers=allowed_threads())[1])
    points = before.points[chosen]
    blocks = [points[start : start + _BLOCK] for start in range(0, len(points), _BLOCK)]
    parts = in_threads(lambda block: _fit_planes(before, block, normal_m), blocks)
    if not parts:
        none = np.zeros(0)
        return SurfacePlaces(np.zeros((0, 3)), np.zeros((0, 3)), none, none, none, none)
    normals, spreads_m, counts = (np.concatenate(part) for part in zip(*parts, strict=True))
    seen_from_m, nearest = cKDTree(path).query(points)
    seen_from = path[nearest]
    normals *= np.where(np.einsum("ij,ij->i", normals, seen_from - points) < 0, -1.0, 1.0)[:, None]
    kept = np.flatnonzero(counts >= _LEAST_CELLS)
    normals, spreads_m = normals[kept], spreads_m[kept]
    points, radius_m = points[kept], _DISC * spacing_m
    shares = cKDTree(points).query_ball_point(points, radius_m, return_length=True, workers=allowed_threads())
    areas_m2 = np.pi * radius_m**2 / np.asarray(shares, dtype=np.float64)
    flatness = spreads_m[:, 0] / np.maximum(spreads_m[:, 1], CELL_M / 2)
    return SurfacePlaces(points, normals, spreads_m[:, 0], flatness, areas_m2, np.asarray(seen_from_m)[kept])


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
