"""The shape of a prop: its primitives, their surfaces, and the size and volume of the part above the floor.

Object frame: origin on the floor in the middle of the footprint, x along the length, y across, z up.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from cdpipe.core.geometry import Float64Array
from sim.geometry.mesh import Mesh, box_mesh, cylinder_mesh, join_meshes, move_mesh

# Posts of a railing and the foot of a pile reach this far below the floor, so that rough floor leaves no gap.
BELOW_FLOOR_M = 0.6

Size = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """One primitive of a prop, in the object frame.

    Attributes:
        kind: "box" (half edges), "cylinder" (radius, half height, unused; along its own z) or "mesh".
        size_m: (3,) as the kind says; zeros for a mesh.
        object_T_solid: (4, 4) pose.
        mesh: The surface of a "mesh".
        material: What it is made of, a key of `sim.materials.REFLECTIVITY`.
    """

    kind: str
    size_m: tuple[float, float, float]
    object_T_solid: Float64Array
    mesh: Mesh | None = None
    material: str = "paint"


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """The primitives and measures of a prop.

    Attributes:
        solids: Its primitives.
        size_m: Length, width and height above the floor of its bounding box; a pile that was partly loaded away keeps
            the length and width of the whole one.
        is_settled: Whether physics drops it on the floor; heaps and railings are set into the floor instead.
        hull_volume_m3: Volume of the convex hull of what is above the floor.
        mesh_volume_m3: Volume of what is above the floor, for a box, a rock, a pile and a watertight mesh; None for
            other props.
    """

    solids: tuple[Solid, ...]
    size_m: tuple[float, float, float]
    is_settled: bool
    hull_volume_m3: float
    mesh_volume_m3: float | None = None


def solid_mesh(solid: Solid) -> Mesh:
    """Return a primitive's surface in the object frame."""
    if solid.mesh is not None:
        return move_mesh(solid.mesh, solid.object_T_solid)
    local = box_mesh(solid.size_m) if solid.kind == "box" else cylinder_mesh(solid.size_m[0], solid.size_m[1], 32)
    return move_mesh(local, solid.object_T_solid)


def shape_mesh(shape: Shape) -> Mesh:
    """Return the surfaces of all of a shape's primitives as one mesh, object frame."""
    return join_meshes([solid_mesh(solid) for solid in shape.solids])


def footprint_corners(size_m: tuple[float, float, float]) -> Float64Array:
    """Return the four corners (4, 2) of a prop's bounding rectangle, object frame, counter-clockwise."""
    half = np.array([size_m[0], size_m[1]]) / 2
    return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half


def visible_part(mesh: Mesh, back_y_m: float = np.inf) -> Float64Array:
    """Return the triangles (N, 3, 3) of a surface above the floor and in front of the plane y = `back_y_m`."""
    triangles = _cut(mesh.vertices[mesh.faces], np.array([0.0, 0.0, 1.0]), 0.0)
    return _cut(triangles, np.array([0.0, -1.0, 0.0]), back_y_m) if np.isfinite(back_y_m) else triangles


def hull_volume_m3(solids: Iterable[Solid], back_y_m: float = np.inf) -> float:
    """Return the convex hull's volume of the part above the floor and in front of the plane y = `back_y_m`."""
    part = visible_part(join_meshes([solid_mesh(solid) for solid in solids]), back_y_m)
    return float(ConvexHull(part.reshape(-1, 3)).volume)


def signed_volume_m3(mesh: Mesh) -> float:
    """Return the volume inside a closed surface that faces outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def _cut(triangles: Float64Array, inward: Float64Array, offset_m: float) -> Float64Array:
    """Return the part of triangles (N, 3, 3) where `inward @ point + offset_m >= 0`, cut exactly."""
    inside_m = triangles @ inward + offset_m
    n_inside = (inside_m >= 0).sum(axis=1)
    parts = [triangles[n_inside == 3]]
    for n in (1, 2):
        odd = np.argmax((inside_m[n_inside == n] >= 0) == (n == 1), axis=1)
        rows = np.arange(len(odd))[:, None]
        order = (odd[:, None] + np.arange(3)) % 3  # the corner that is alone on its side comes first
        corner, depth = triangles[n_inside == n][rows, order], inside_m[n_inside == n][rows, order]
        share = depth[:, :1] / (depth[:, :1] - depth[:, 1:])
        crossing = corner[:, :1] + share[..., None] * (corner[:, 1:] - corner[:, :1])
        if n == 1:
            parts.append(np.stack([corner[:, 0], crossing[:, 0], crossing[:, 1]], axis=1))
        else:
            parts.append(np.stack([crossing[:, 0], corner[:, 1], corner[:, 2]], axis=1))
            parts.append(np.stack([crossing[:, 0], corner[:, 2], crossing[:, 1]], axis=1))
    return np.concatenate(parts)
