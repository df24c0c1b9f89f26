"""Normals of a rough surface, smoothed so that roughness moves as a body."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from sim.displacement.refine import TwinWalls


def vertex_normals(places: Float64Array, faces: Int64Array) -> Float64Array:
    """Return the area-weighted normal (N, 3) of each vertex, of length 2 times its area; 0 where it has no face."""
    a, b, c = (places[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    flat = faces.ravel()
    return np.stack(
        [np.bincount(flat, weights=np.repeat(normals[:, axis], 3), minlength=len(places)) for axis in range(3)], axis=1
    )


def smooth_normals(walls: TwinWalls, chosen: Int64Array, length_m: float) -> Float64Array:
    """Return unit normals (V, 3) into the void of some vertices (V,), averaged over a ball of this diameter.

    Gaussian weights of standard deviation a quarter of the diameter, cut off at its surface, times the area.
    """
    radius_m = length_m / 2
    places = walls.before
    low, high = places[chosen].min(axis=0) - radius_m, places[chosen].max(axis=0) + radius_m
    near = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1))
    is_near = np.zeros(len(places), dtype=bool)
    is_near[near] = True
    normals = vertex_normals(places, walls.faces[is_near[walls.faces].any(axis=1)])
    links = weights_within(places[chosen], places[near], radius_m)
    smooth = links @ normals[near]
    return np.asarray(smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12))


def weights_within(places: Float64Array, others: Float64Array, radius_m: float) -> coo_array:
    """Return Gaussian weights (V, K) of the other places within a radius, its half the standard deviation."""
    pairs = cKDTree(places).sparse_distance_matrix(cKDTree(others), radius_m, output_type="coo_matrix")
    return coo_array((np.exp(-2.0 * (pairs.data / radius_m) ** 2), (pairs.row, pairs.col)), shape=pairs.shape)
