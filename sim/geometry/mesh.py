"""Triangle surfaces: the type, the primitives, and the exact distance from points to a surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int32Array, Int64Array, require_shape, transform

_REMEMBERED = 256  # cylinders of sizes that are asked for again and again


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle surface.

    Attributes:
        vertices: (N, 3) float64, metres.
        faces: (M, 3) int32; seen from the side they face, corners run counter-clockwise.
    """

    vertices: Float64Array
    faces: Int32Array

    def __post_init__(self) -> None:
        require_shape("vertices", self.vertices, (None, 3))
        require_shape("faces", self.faces, (None, 3))


def move_mesh(mesh: Mesh, dst_T_src: Float64Array) -> Mesh:
    """Return the mesh of frame src in frame dst."""
    return Mesh(transform(dst_T_src, mesh.vertices), mesh.faces)


def join_meshes(meshes: list[Mesh]) -> Mesh:
    """Return several meshes as one; of none, one without triangles."""
    if not meshes:
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.int32))


def drop_unused_vertices(vertices: Float64Array, faces: npt.NDArray[np.integer]) -> Mesh:
    """Return faces (M, 3) as a mesh that holds only the vertices (N, 3) they use."""
    is_used = np.zeros(len(vertices), dtype=bool)
    is_used[faces] = True
    renumbered = (np.cumsum(is_used) - 1).astype(np.int32)
    return Mesh(vertices[is_used], renumbered[faces])


def box_mesh(half_size_m: npt.ArrayLike) -> Mesh:
    """Return a box about the origin, facing outwards, from its half edges (3,)."""
    return Mesh(_UNIT_BOX.vertices * (2.0 * np.asarray(half_size_m)), _UNIT_BOX.faces.copy())


@lru_cache(maxsize=_REMEMBERED)
def cylinder_mesh(radius_m: float, half_height_m: float, segments: int) -> Mesh:
    """Return a closed cylinder about the z axis, facing outwards; its arrays cannot be written."""
    mesh = _from_trimesh(trimesh.creation.cylinder(radius=radius_m, height=2.0 * half_height_m, sections=segments))
    for array in (mesh.vertices, mesh.faces):
        array.setflags(write=False)
    return mesh


def drop_flat_faces(faces: Int64Array) -> Int64Array:
    """Return the faces (M, 3) whose three corners differ."""
    a, b, c = faces.T
    return np.asarray(faces[(a != b) & (b != c) & (c != a)])


def crop_near(mesh: Mesh, target: Mesh, within_m: float) -> Mesh:
    """Return the triangles of a mesh whose bounding box comes within `within_m` of the bounding box of another."""
    low, high = target.vertices.min(axis=0) - within_m, target.vertices.max(axis=0) + within_m
    if (mesh.vertices.max(axis=0) < low).any() or (mesh.vertices.min(axis=0) > high).any():
        return Mesh(mesh.vertices, mesh.faces[:0])
    # Compares corners and not triangles: a screen has millions of triangles. One bit for each side of the box.
    sides = np.zeros(len(mesh.vertices), np.uint8)
    for axis, column in enumerate(mesh.vertices.T):
        sides |= (column < low[axis]).view(np.uint8) << np.uint8(axis)
        sides |= (column > high[axis]).view(np.uint8) << np.uint8(3 + axis)
    a, b, c = mesh.faces.T
    return Mesh(mesh.vertices, mesh.faces[(sides[a] & sides[b] & sides[c]) == 0])


class NearSurface:
    """An index that marks the points near a surface; built once and shared by all threads."""

    def __init__(self, mesh: Mesh, within_m: float) -> None:
        # Small pieces have small bounding spheres, so that each point has few candidates.
        self._triangles = split_triangles(mesh.vertices[mesh.faces], within_m)
        self._within_m = within_m
        centres = self._triangles.mean(axis=1)
        spread_m = np.linalg.norm(self._triangles - centres[:, None], axis=2).max(initial=0.0)
        self._reach_m = within_m + float(spread_m)
        self._tree = cKDTree(centres)

    def marks(self, points: Float64Array) -> BoolArray:
        """Mark the points (N, 3) whose exact distance to the surface is at most `within_m`."""
        is_near = np.zeros(len(points), dtype=bool)
        if len(points) == 0 or len(self._triangles) == 0:
            return is_near
        nearest_m, _ = self._tree.query(points, distance_upper_bound=self._reach_m)
        is_near |= nearest_m <= self._within_m  # a centre lies on the surface
        unsure = np.flatnonzero(~is_near & np.isfinite(nearest_m))
        for rows in np.split(unsure, range(4096, len(unsure), 4096)):
            near = np.asarray(self._tree.query_ball_point(points[rows], self._reach_m), dtype=object)
            counts = np.fromiter((len(found) for found in near), np.int64, len(rows))
            owner = np.repeat(rows, counts)
            candidate = np.fromiter((index for found in near for index in found), np.int64, counts.sum())
            distance_m = point_triangle_distance(points[owner], self._triangles[candidate])
            is_near[owner[distance_m <= self._within_m]] = True
        return is_near


def point_triangle_distance(points: Float64Array, triangles: Float64Array) -> Float64Array:
    """Return the (N,) distance of each point (N, 3) to its own triangle (N, 3, 3), metres."""
    return np.asarray(np.linalg.norm(points - trimesh.triangles.closest_point(triangles, points), axis=1))


def _from_trimesh(solid: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(solid.vertices, dtype=np.float64), np.asarray(solid.faces, dtype=np.int32))


def split_triangles(triangles: Float64Array, edge_m: float) -> Float64Array:
    """Halve triangles at their longest edge until none is longer than `edge_m`; the surface stays the same."""
    return cut_triangles(triangles, edge_m)[0]


def cut_triangles(triangles: Float64Array, edge_m: float) -> tuple[Float64Array, Int64Array]:
    """Return the pieces (K, 3, 3) of `split_triangles`, and the triangle (K,) that each was a part of."""
    owners = np.arange(len(triangles))
    done, done_owners = [triangles[:0]], [owners[:0]]
    while len(triangles):
        longest_m, longest = _longest_edges(triangles)
        is_long = longest_m > edge_m
        done.append(triangles[~is_long])
        done_owners.append(owners[~is_long])
        triangles, owners, longest = triangles[is_long], owners[is_long], longest[is_long]
        corners, first = triangles.reshape(-1, 3), 3 * np.arange(len(triangles))
        a, b, c = (corners.take(first + (longest + shift) % 3, axis=0) for shift in range(3))
        middle = (a + b) / 2
        triangles = np.empty((2, len(first), 3, 3))
        triangles[0, :, 0], triangles[0, :, 1], triangles[1, :, 0], triangles[1, :, 1] = a, middle, middle, b
        triangles[:, :, 2] = c
        triangles, owners = triangles.reshape(-1, 3, 3), np.concatenate([owners, owners])
    return np.concatenate(done), np.concatenate(done_owners)


def _longest_edges(triangles: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Return the length (N,) of each triangle's longest edge, and the number (N,) of the first corner of that edge.

    Written out by component, because numpy is slow on rows of three.
    """
    x, y, z = (np.ascontiguousarray(triangles[:, :, axis].T) for axis in range(3))
    lengths_m = []
    for corner in range(3):
        squares = (x[corner] - x[corner - 2]) ** 2
        squares += (y[corner] - y[corner - 2]) ** 2
        squares += (z[corner] - z[corner - 2]) ** 2
        lengths_m.append(np.sqrt(squares))
    longest_m, longest = lengths_m[0], np.zeros(len(triangles), np.int64)
    for corner in (1, 2):
        longest[lengths_m[corner] > longest_m] = corner
        longest_m = np.maximum(longest_m, lengths_m[corner])
    return longest_m, longest


_UNIT_BOX = _from_trimesh(trimesh.creation.box())
