"""The exact signed displacement of places on one surface to another surface of the same topology."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from sim.geometry.mesh import Mesh, split_triangles

FARTHEST_M = 5.0  # a closest place beyond this says nothing of the same rock
_PIECE_M = 0.3  # longest edge of the pieces that are looked up
_TIE_M = 1e-9
_BATCH = 2048
_CHILDREN = 8
_NOWHERE_M = 1e9  # where the boxes are that only fill up a node


class SignedDistance:
    """An index of a surface, built once and shared by all threads.

    A hierarchy of boxes with eight children each, in the order of a k-d tree over the centres of the triangles. The
    search keeps the boxes that come as close as the triangle with the nearest centre does, level by level.

    Args:
        mesh: The surface; its faces look into the void.
    """

    def __init__(self, mesh: Mesh) -> None:
        triangles = split_triangles(mesh.vertices[mesh.faces], _PIECE_M)
        a, b, c = (triangles[:, corner] for corner in range(3))
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1)
        triangles, normals = triangles[lengths > 1e-14], normals[lengths > 1e-14]
        self._tree = cKDTree(triangles.mean(axis=1))
        order = np.asarray(self._tree.indices)
        self._position = np.argsort(order)
        self._triangles = triangles[order]
        self._normals = normals[order] / np.linalg.norm(normals[order], axis=1, keepdims=True)
        self._centres = self._triangles.mean(axis=1)
        self._radii_m = np.linalg.norm(self._triangles - self._centres[:, None], axis=2).max(axis=1)
        self._levels = _box_levels(self._triangles)

    def measure(self, points: Float64Array) -> Float64Array:
        """Return the distance (N,) of points (N, 3) to the surface, positive in the void, NaN beyond 5 m.

        The closest place is found over all triangles. Where it lies on an edge or a corner, the triangle whose normal
        is nearest to the way from the place to the point tells the side.
        """
        signed = np.full(len(points), np.nan)
        if not len(self._triangles):
            return signed
        for start in range(0, len(points), _BATCH):
            part = points[start : start + _BATCH]
            rows, which = self._candidates(part)
            way = part[rows] - closest_places(part[rows], self._triangles[which])
            distance_m = np.linalg.norm(way, axis=1)
            best_m = np.full(len(part), np.inf)
            np.minimum.at(best_m, rows, distance_m)
            is_tie = distance_m <= best_m[rows] + _TIE_M
            rows, way, which = rows[is_tie], way[is_tie], which[is_tie]
            facing = np.einsum("ij,ij->i", way, self._normals[which])
            order = np.lexsort((np.abs(facing), rows))  # the steepest last
            signs = np.ones(len(part))
            signs[rows[order]] = np.where(facing[order] >= 0, 1.0, -1.0)
            signed[start : start + len(part)] = np.where(best_m <= FARTHEST_M, signs * best_m, np.nan)
        return signed

    def _candidates(self, points: Float64Array) -> tuple[Int64Array, Int64Array]:
        """Return pairs (P,) of point and triangle: of every point (N, 3) all that may be the closest, within 5 m."""
        nearest = self._position[np.asarray(self._tree.query(points)[1])]
        upper_m = np.linalg.norm(points - closest_places(points, self._triangles[nearest]), axis=1)
        bound = (np.minimum(upper_m, FARTHEST_M) + _TIE_M) ** 2 + _TIE_M
        rows, which = np.arange(len(points)), np.zeros(len(points), np.int64)
        for middles, halves in self._levels:
            off = np.abs(points[rows, None] - middles[which]) - halves[which]
            np.maximum(off, 0.0, out=off)
            pair, child = np.nonzero(np.einsum("ijk,ijk->ij", off, off) <= bound[rows, None])
            rows, which = rows[pair], which[pair] * _CHILDREN + child
        # a triangle lies in its plane, and in a circle about its centre
        way = points[rows] - self._centres[which]
        above2 = np.einsum("ij,ij->i", way, self._normals[which]) ** 2
        aside_m = np.sqrt(np.maximum(np.einsum("ij,ij->i", way, way) - above2, 0.0)) - self._radii_m[which]
        is_hope = above2 + np.maximum(aside_m, 0.0) ** 2 <= bound[rows]
        return rows[is_hope], which[is_hope]


def _box_levels(triangles: Float64Array) -> list[tuple[Float64Array, Float64Array]]:
    """Return middles and half sizes (K, 8, 3) of the boxes of each level: the children of its K nodes, largest first.

    Child j of node i is node 8 i + j of the next level, and triangle 8 i + j after the last.
    """
    levels: list[tuple[Float64Array, Float64Array]] = []
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    while not levels or len(low) > 1:
        spare = np.zeros((-len(low) % _CHILDREN, 3))
        middles = np.concatenate([(low + high) / 2, spare + _NOWHERE_M]).reshape(-1, _CHILDREN, 3)
        halves = np.concatenate([(high - low) / 2, spare]).reshape(-1, _CHILDREN, 3)
        levels.append((middles, halves))
        low = np.concatenate([low, spare + np.inf]).reshape(-1, _CHILDREN, 3).min(axis=1)
        high = np.concatenate([high, spare - np.inf]).reshape(-1, _CHILDREN, 3).max(axis=1)
    return levels[::-1]


def closest_places(points: Float64Array, triangles: Float64Array) -> Float64Array:
    """Return the closest place (P, 3) to each point (P, 3) on its own triangle (P, 3, 3).

    By the regions of Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    """
    a, b, c = (triangles[:, corner] for corner in range(3))
    ab, ac, ap = b - a, c - a, points - a
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    bp, cp = points - b, points - c
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    with np.errstate(divide="ignore", invalid="ignore"):
        total = va + vb + vc
        v, w = vb / total, vc / total
        on_ab, on_ac = d1 / (d1 - d3), d2 / (d2 - d6)
        on_bc = (d4 - d3) / ((d4 - d3) + (d5 - d6))
    zero, one = np.zeros_like(d1), np.ones_like(d1)
    # the later of these rules wins
    for region, rv, rw in (
        ((va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0), 1.0 - on_bc, on_bc),
        ((vb <= 0) & (d2 >= 0) & (d6 <= 0), zero, on_ac),
        ((vc <= 0) & (d1 >= 0) & (d3 <= 0), on_ab, zero),
        ((d6 >= 0) & (d5 <= d6), zero, one),
        ((d3 >= 0) & (d4 <= d3), one, zero),
        ((d1 <= 0) & (d2 <= 0), zero, zero),
    ):
        v, w = np.where(region, rv, v), np.where(region, rw, w)
    return np.asarray(a + v[:, None] * ab + w[:, None] * ac)


def _dot(one: Float64Array, other: Float64Array) -> Float64Array:
    return np.asarray(one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1] + one[:, 2] * other[:, 2])
