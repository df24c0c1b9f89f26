"""Places of the before surface at which displacement is measured, with normals and the roughness around them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array, travelled_m
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.core.threads import allowed_threads, in_threads
from cdpipe.surface.cells import CELL_M, NearReturns, SurfaceCells

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
        seen_from_m: (Q,) distance of each from the path of the before session; where its nearest position lies behind
            the rock, from the nearest one that saw the place.
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


def choose_places(before: SurfaceCells, returns: NearReturns, spacing_m: float, normal_m: float) -> SurfacePlaces:
    """Return the cell nearest to the mean of the cells of each voxel, where there are enough of them for a plane.

    A place stands for the area of a disc about it over the number of places within.

    Args:
        before: Cells of the before session.
        returns: What the cells were made from. Normals point towards the nearest position that saw the place: another
            drift may be nearer, behind the rock.
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
    views = _nearest_views(before, returns, chosen) - points
    normals *= np.where(np.einsum("ij,ij->i", normals, views) < 0, -1.0, 1.0)[:, None]
    path = before.map_T_sensor[:, :3, 3]
    from_path_m, nearest = cKDTree(path).query(points)
    is_behind = np.einsum("ij,ij->i", normals, path[nearest] - points) < 0
    seen_from_m = np.where(is_behind, np.linalg.norm(views, axis=1), from_path_m)
    kept = np.flatnonzero(counts >= _LEAST_CELLS)
    normals, spreads_m = normals[kept], spreads_m[kept]
    points, radius_m = points[kept], _DISC * spacing_m
    shares = cKDTree(points).query_ball_point(points, radius_m, return_length=True, workers=allowed_threads())
    areas_m2 = np.pi * radius_m**2 / np.asarray(shares, dtype=np.float64)
    flatness = spreads_m[:, 0] / np.maximum(spreads_m[:, 1], CELL_M / 2)
    return SurfacePlaces(points, normals, spreads_m[:, 0], flatness, areas_m2, seen_from_m[kept])


def _nearest_views(before: SurfaceCells, returns: NearReturns, chosen: Int64Array) -> Float64Array:
    """Return the (Q, 3) position of the sensor nearest to each of the chosen cells, of those that saw it."""
    place_of = np.full(int(returns.cell_of.max(initial=-1)) + 1, -1)
    place_of[before.numbers[chosen]] = np.arange(len(chosen))
    own = np.flatnonzero(place_of[returns.cell_of] >= 0)
    place, path = place_of[returns.cell_of[own]], returns.map_T_sensor[:, :3, 3]
    path_m = travelled_m(returns.map_T_sensor)
    sensors = np.stack([np.interp(returns.path_m[own], path_m, each) for each in path.T], axis=1)
    order = np.lexsort((np.linalg.norm(sensors - before.points[chosen[place]], axis=1), place))
    return np.asarray(sensors[order[np.unique(place[order], return_index=True)[1]]])


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
