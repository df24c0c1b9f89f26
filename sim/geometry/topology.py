"""Topology of a triangle surface: open edges, holes, orientation, enclosed volume and winding number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cdpipe.core.geometry import Float64Array, Int64Array
from sim.geometry.mesh import Mesh

_SAMPLES = (8, 64)
_SOLID_ANGLES = 20_000_000
_CHUNK = 200_000
_STEP_SHARE = 1e-3  # of a face's size, from the face to the place where the winding number is asked for


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """The edges of a surface.

    Attributes:
        pairs: (E, 2) vertices, the lower number first.
        counts: (E,) how many faces have it.
        balance: (E,) how many more of them run along it from the first vertex to the second than back.
    """

    pairs: Int64Array
    counts: Int64Array
    balance: Int64Array

    @property
    def boundary(self) -> Int64Array:
        """(E, 2) edges that belong to one face only."""
        return np.asarray(self.pairs[self.counts == 1])

    @property
    def disagreeing(self) -> Int64Array:
        """(E, 2) edges of two faces that run along them in the same direction."""
        return np.asarray(self.pairs[(self.counts == 2) & (self.balance != 0)])

    @property
    def is_closed(self) -> bool:
        """Whether every face meets another at every edge, facing the same way."""
        return len(self.pairs) > 0 and not (self.balance != 0).any()


def edges_of(mesh: Mesh) -> Edges:
    """Return the edges of a surface."""
    directed = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    is_forward = directed[:, 0] < directed[:, 1]
    keys = directed.min(axis=1) * len(mesh.vertices) + directed.max(axis=1)
    unique, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    balance = np.bincount(inverse.reshape(-1), weights=np.where(is_forward, 1.0, -1.0), minlength=len(unique))
    pairs = np.column_stack([unique // len(mesh.vertices), unique % len(mesh.vertices)])
    return Edges(pairs, counts, balance.astype(np.int64))


def closed_volume_m3(mesh: Mesh, edges: Edges | None = None) -> float | None:
    """Return the volume that a surface encloses, negative where it faces inwards; None if it is not closed."""
    if not (edges or edges_of(mesh)).is_closed:
        return None
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] - mesh.vertices.mean(axis=0) for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def largest_hole(mesh: Mesh, edges: Int64Array) -> tuple[float, Float64Array]:
    """Return the length around the longest connected run of boundary edges (E, 2), metres, and its middle (3,)."""
    used, ends = np.unique(edges, return_inverse=True)
    ends = ends.reshape(-1, 2)
    links = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(used), len(used)))
    _, labels = connected_components(links, directed=False)
    of_edge = labels[ends[:, 0]]
    corners = mesh.vertices[edges]
    lengths_m = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
    around_m = np.bincount(of_edge, weights=lengths_m)
    longest = int(np.argmax(around_m))
    return float(around_m[longest]), corners[of_edge == longest].reshape(-1, 3).mean(axis=0)


def void_winding(mesh: Mesh) -> Float64Array:
    """Return the (S,) winding number of a surface just in front of faces spread evenly over its area.

    -1 in front of a face that faces into what the surface encloses, 0 in front of one that faces away from it; in
    between near the holes of an open surface (Jacobson et al. 2013, robust inside-outside segmentation).
    """
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    n_samples = int(np.clip(_SOLID_ANGLES // len(corners), *_SAMPLES))
    summed = np.cumsum(double_area)
    picked = np.searchsorted(summed, (np.arange(n_samples) + 0.5) / n_samples * summed[-1])
    step_m = np.minimum(_STEP_SHARE * np.sqrt(double_area[picked]), 1e-3)
    normals = cross[picked] / double_area[picked, None]
    points = corners[picked].mean(axis=1) + step_m[:, None] * normals
    return np.array([winding_number(point, corners) for point in points])


def winding_number(point: Float64Array, triangles: Float64Array) -> float:
    """Return how often triangles (M, 3, 3) that face outwards enclose a point (3,).

    Solid angles by Van Oosterom and Strackee (1983).
    """
    total = 0.0
    for start in range(0, len(triangles), _CHUNK):
        a, b, c = (triangles[start : start + _CHUNK, corner] - point for corner in range(3))
        la, lb, lc = (np.sqrt(np.einsum("ij,ij->i", side, side)) for side in (a, b, c))
        above = np.einsum("ij,ij->i", a, np.cross(b, c))
        below = la * lb * lc + sum(
            np.einsum("ij,ij->i", one, other) * length for one, other, length in ((a, b, lc), (b, c, la), (c, a, lb))
        )
        total += float(np.arctan2(above, below).sum())
    return total / (2 * np.pi)
