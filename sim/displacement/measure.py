"""The exact signed displacement of places on one surface to another surface of the same topology."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from sim.geometry.mesh import Mesh, split_triangles

FARTHEST_M = 5.0  # a closest place beyond this says nothing of the same rock
_PIECE_M = 0.1  # longest edge of the pieces that are looked up
_FEW = 8
_TIE_M = 1e-9
_BATCH = 4096


class SignedDistance:
    """An index of a surface, built once and shared by all threads.

    Args:
        mesh: The surface; its faces look into the void.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._triangles = split_triangles(mesh.vertices[mesh.faces], _PIECE_M)
        a, b, c = (self._triangles[:, corner] for corner in range(3))
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1)
        self._triangles, normals = self._triangles[lengths > 1e-14], normals[lengths > 1e-14]
        self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._centres = self._triangles.mean(axis=1)
        self._radii_m = np.linalg.norm(self._triangles - self._centres[:, None], axis=2).max(axis=1)
        self._largest_m = float(self._radii_m.max(initial=0.0))
        self._tree = cKDTree(self._centres)

    def measure(self, points: Float64Array) -> Float64Array:
        """Return the distance (N,) of points (N, 3) to the surface, positive in the void, NaN beyond 5 m.

        The closest place is found over all triangles. Where it lies on an edge or a corner, the triangle whose normal
        is nearest to the way from the place to the point tells the side.
        """
        signed = np.full(len(points), np.nan)
        few = min(_FEW, len(self._centres))
        if not few:
            return signed
        for start in range(0, len(points), _BATCH):
            part = points[start : start + _BATCH]
            apart_m, nearest = (np.asarray(each) for each in self._tree.query(part, k=few))
            apart_m, nearest = apart_m.reshape(len(part), few), nearest.reshape(len(part), few)
            best_m = np.full(len(part), np.inf)
            signs = np.ones(len(part))
            rows = np.repeat(np.arange(len(part)), few)
            self._closest(part, rows, nearest.ravel(), best_m, signs)
            # a triangle farther down the list could only be nearer if its ball reached so far
            open_rows = np.flatnonzero((apart_m[:, -1] < best_m + self._largest_m) & (few < len(self._centres)))
            if len(open_rows):
                lists = self._tree.query_ball_point(
                    part[open_rows], np.minimum(best_m[open_rows], FARTHEST_M) + self._largest_m
                )
                counts = np.fromiter((len(each) for each in lists), np.int64, len(lists))
                found = np.concatenate([np.asarray(each, np.int64) for each in lists])
                self._closest(part, np.repeat(open_rows, counts), found, best_m, signs)
            signed[start : start + len(part)] = np.where(best_m <= FARTHEST_M, signs * best_m, np.nan)
        return signed

    def _closest(
        self, points: Float64Array, rows: Int64Array, which: Int64Array, best_m: Float64Array, signs: Float64Array
    ) -> None:
        """Improve the distance (N,) and side (N,) of points in place by candidate triangles: pairs (P,) of both."""
        reach_m = np.linalg.norm(points[rows] - self._centres[which], axis=1) - self._radii_m[which]
        bound_m = np.full(len(points), np.inf)
        np.minimum.at(bound_m, rows, reach_m + 2 * self._radii_m[which])
        is_hope = reach_m <= np.minimum(bound_m, best_m)[rows] + _TIE_M
        rows, which = rows[is_hope], which[is_hope]
        way = points[rows] - closest_places(points[rows], self._triangles[which])
        distance_m = np.linalg.norm(way, axis=1)
        nearest_m = best_m.copy()
        np.minimum.at(nearest_m, rows, distance_m)
        is_tie = distance_m <= nearest_m[rows] + _TIE_M
        rows, way, which = rows[is_tie], way[is_tie], which[is_tie]
        facing = np.einsum("ij,ij->i", way, self._normals[which])
        order = np.lexsort((np.abs(facing), rows))  # the steepest last
        signs[rows[order]] = np.where(facing[order] >= 0, 1.0, -1.0)
        best_m[:] = nearest_m


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
