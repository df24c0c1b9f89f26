"""Cloud-to-mesh distance (C2M): from each place to a triangle mesh of the after surface.

Usually the mesh is of the reference, here the before surface, and each point of the other cloud has a distance to it.
An answer states one displacement at each place of the before surface, so here the after surface is the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.model.config import PipelineConfig
from cdpipe.surface.cells import NearReturns, SurfaceCells, make_cells
from cdpipe.surface.method import Z95, Measured
from cdpipe.surface.places import SurfacePlaces
from cdpipe.surface.unrolled import unroll

# Triangles with a longer edge, in cells of the mesh, bridge what was not seen.
_LONGEST = 4.0
# The nearest triangle is searched among those at this many nearest vertices.
_VERTICES = 6
_BLOCK = 1 << 12


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) map frame, metres.
        counts: (V,) cells that each vertex is the mean of.
        triangles: (T, 3) vertices of each triangle; no order.
    """

    vertices: Float64Array
    counts: Int64Array
    triangles: Int64Array


def measure_c2m(
    before: SurfaceCells, after: NearReturns, places: SurfacePlaces, chainage_m: Float64Array, config: PipelineConfig
) -> Measured:
    """Measure the distance to the mesh of the after cells, positive if that lies on the void's side of the place.

    C2M has no level of its own. Here it is that of a difference of two noisy surfaces, 1.96 s sqrt(1 + 1 / (2 n)): a
    place is one cell, off its surface by the roughness s; a point of a triangle is a mean of three vertices, each the
    mean of n cells, and the squares of its weights add up to 1/2 on average over the triangle.

    Arguments as of `Method`; `surface.mesh_m` and `surface.reach_m` are used. Places farther than that from every
    triangle are not measured.
    """
    mesh = make_mesh(make_cells(after).points, before.map_T_sensor, config.surface.mesh_m)
    closest, triangle = find_closest(mesh, places.points)
    offsets = closest - places.points
    distance_m = np.linalg.norm(offsets, axis=1)
    towards = np.einsum("ij,ij->i", offsets, places.normals)
    is_near = distance_m <= config.surface.reach_m  # not where there is no triangle: NaN
    displacement_m = np.where(is_near, np.where(towards < 0, -distance_m, distance_m), np.nan)
    level_m = np.full(len(places.points), np.nan)
    n_cells = mesh.counts[mesh.triangles[triangle[is_near]]].mean(axis=1)
    level_m[is_near] = Z95 * places.roughness_m[is_near] * np.sqrt(1 + 0.5 / n_cells)
    return Measured(displacement_m, displacement_m, level_m)


def make_mesh(points: Float64Array, map_T_sensor: Float64Array, mesh_m: float) -> Mesh:
    """Return the mesh of a surface around a path: a Delaunay triangulation of unrolled coordinates.

    They are chainage and angle times the median radius, the seam at the floor closed. Triangles with an edge longer
    than four cells of the mesh are left out.

    Args:
        points: (N, 3) points of the surface, map frame, metres.
        map_T_sensor: (S, 4, 4) poses of the path.
        mesh_m: Edge of the cells whose means are the vertices, metres.
    """
    vertices, cell_of = cell_means(points, mesh_m)
    counts = np.bincount(cell_of, minlength=len(vertices))
    triangles = np.zeros((0, 3), dtype=np.int64)
    if len(vertices) > 0:
        triangles = _triangulate(vertices, map_T_sensor, _LONGEST * mesh_m)
    corners = vertices[triangles]
    edges_m = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return Mesh(vertices, counts, triangles[(edges_m <= _LONGEST * mesh_m).all(axis=1)])


def _triangulate(vertices: Float64Array, map_T_sensor: Float64Array, seam_m: float) -> Int64Array:
    """Return the (T, 3) triangles of unrolled vertices; those within `seam_m` of the seam stand on both sides of it."""
    chainage_m, angle_deg, radius_m = unroll(vertices, map_T_sensor)
    median_m = max(float(np.median(radius_m)), 1e-3)
    around_m = np.deg2rad(angle_deg) * median_m
    copied = np.flatnonzero(around_m < -np.pi * median_m + seam_m)
    flat = np.column_stack([np.append(chainage_m, chainage_m[copied]),
                            np.append(around_m, around_m[copied] + 2 * np.pi * median_m)])  # fmt: skip
    vertex_of = np.append(np.arange(len(vertices)), copied)
    try:
        triangles = np.asarray(vertex_of[Delaunay(flat).simplices], dtype=np.int64)
    except QhullError:  # fewer than three vertices, or all on one line
        return np.zeros((0, 3), dtype=np.int64)
    is_whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)  # not one of a vertex and its own copy
    return np.asarray(triangles[is_whole])


def find_closest(mesh: Mesh, points: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Return the (Q, 3) point of the mesh closest to each of (Q, 3) points, NaN of an empty mesh, and its triangle.

    The triangles at the six nearest vertices of triangles are compared.
    """
    closest, triangle = np.full((len(points), 3), np.nan), np.zeros(len(points), dtype=np.int64)
    if min(len(points), len(mesh.triangles)) == 0:
        return closest, triangle
    corners = mesh.triangles.ravel()
    order = np.argsort(corners, kind="stable")
    used, starts, valence = np.unique(corners[order], return_index=True, return_counts=True)
    tree = cKDTree(mesh.vertices[used])
    for start in range(0, len(points), _BLOCK):
        block = points[start : start + _BLOCK]
        near = np.asarray(tree.query(block, k=min(_VERTICES, len(used)))[1], dtype=np.int64).reshape(len(block), -1)
        counts = valence[near].ravel()
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        candidates = order[np.repeat(starts[near].ravel(), counts) + within] // 3
        owners = np.repeat(np.arange(len(block)), counts.reshape(near.shape).sum(axis=1))
        pairs = np.unique(owners * len(mesh.triangles) + candidates)
        owners, candidates = np.divmod(pairs, len(mesh.triangles))
        found = closest_on_triangles(block[owners], mesh.vertices[mesh.triangles[candidates]])
        squares_m2 = ((found - block[owners]) ** 2).sum(axis=1)
        best = np.lexsort((squares_m2, owners))[np.searchsorted(owners, np.arange(len(block)))]
        closest[start : start + _BLOCK], triangle[start : start + _BLOCK] = found[best], candidates[best]
    return closest, triangle


def closest_on_triangles(points: Float64Array, corners: Float64Array) -> Float64Array:
    """Return the (N, 3) point of each of (N, 3, 3) triangles that is closest to its own of (N, 3) points.

    That is the foot of the perpendicular on the triangle's plane where it lies inside, and else the closest point of
    the three edges.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normals = np.cross(b - a, c - a)
    area2 = np.einsum("ij,ij->i", normals, normals)
    offsets = points - a
    with np.errstate(divide="ignore", invalid="ignore"):  # a triangle without area has edges only
        of_b = np.einsum("ij,ij->i", np.cross(offsets, c - a), normals) / area2
        of_c = np.einsum("ij,ij->i", np.cross(b - a, offsets), normals) / area2
        is_inside = (of_b >= 0) & (of_c >= 0) & (of_b + of_c <= 1)
        inside = a + of_b[:, None] * (b - a) + of_c[:, None] * (c - a)
    on_edges = np.stack([_closest_on_edges(points, *edge) for edge in ((a, b), (b, c), (c, a))], axis=1)
    nearest = ((on_edges - points[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    return np.asarray(np.where(is_inside[:, None], inside, on_edges[np.arange(len(points)), nearest]))


def _closest_on_edges(points: Float64Array, starts: Float64Array, ends: Float64Array) -> Float64Array:
    along = ends - starts
    length2 = np.maximum(np.einsum("ij,ij->i", along, along), 1e-30)
    share = np.clip(np.einsum("ij,ij->i", points - starts, along) / length2, 0.0, 1.0)
    return np.asarray(starts + share[:, None] * along)
