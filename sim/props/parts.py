"""The primitives of props: boxes, rods, beams, prisms, convex hulls and surfaces of revolution. Lengths in metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from cdpipe.core.geometry import Float64Array, make_pose
from sim.geometry.mesh import Mesh, drop_unused_vertices
from sim.props.shapes import Solid

Point = tuple[float, float, float]


def block(low: Point, high: Point, material: str) -> Solid:
    """Return an axis-aligned box between two corners."""
    low_m, high_m = np.array(low), np.array(high)
    half = (high_m - low_m) / 2
    pose = make_pose(translation=(low_m + high_m) / 2)
    return Solid("box", (float(half[0]), float(half[1]), float(half[2])), pose, material=material)


def rod(start: Point, end: Point, radius_m: float, material: str) -> Solid:
    """Return a cylinder between two points."""
    a, b = np.array(start), np.array(end)
    length_m = float(np.linalg.norm(b - a))
    return Solid("cylinder", (radius_m, length_m / 2, 0.0), make_pose(_along(b - a), (a + b) / 2), material=material)


def beam(start: Point, end: Point, width_m: float, depth_m: float, material: str) -> Solid:
    """Return a rectangular bar between two points; its width is horizontal unless the bar is upright."""
    a, b = np.array(start), np.array(end)
    half = (width_m / 2, depth_m / 2, float(np.linalg.norm(b - a)) / 2)
    return Solid("box", half, make_pose(_along(b - a), (a + b) / 2), material=material)


def surface(mesh: Mesh, material: str) -> Solid:
    """Return a mesh in the object frame as a primitive."""
    return Solid("mesh", (0.0, 0.0, 0.0), np.eye(4), mesh, material)


def hull_mesh(points: npt.ArrayLike) -> Mesh:
    """Return the convex hull of points (N, 3), facing outwards, without the points inside it."""
    cloud = np.asarray(points, dtype=np.float64)
    hull = drop_unused_vertices(cloud, ConvexHull(cloud).simplices)
    vertices, faces = hull.vertices, hull.faces
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    is_inward = (np.cross(b - a, c - a) * (a - vertices.mean(axis=0))).sum(axis=1) < 0
    return Mesh(vertices, np.where(is_inward[:, None], faces[:, ::-1], faces))


def prism(outline: Sequence[tuple[float, float]], half_width: float, material: str) -> Solid:
    """Return the prism from y = -half_width to +half_width over a convex outline in x and z."""
    ends = [(x, side * half_width, z) for side in (-1, 1) for x, z in outline]
    return surface(hull_mesh(ends), material)


def revolve(profile: Sequence[tuple[float, float]], length: float, width: float, segments: int = 40) -> Mesh:
    """Return the closed surface of revolution about the z axis of a profile of (radius, z).

    The profile runs from the axis at the bottom, up the outside, to the axis at the top. Radii are shares of the half
    length and half width.
    """
    angle = np.arange(segments) * (2 * np.pi / segments)
    circle = np.column_stack([np.cos(angle) * length / 2, np.sin(angle) * width / 2])
    rings = [np.column_stack([radius * circle, np.full(segments, z)]) for radius, z in profile[1:-1]]
    poles = [[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]]
    here = np.arange(segments)
    after = (here + 1) % segments
    faces = [np.column_stack([np.full(segments, len(rings) * segments), after, here])]
    for ring in range(len(rings) - 1):
        low, high = ring * segments, (ring + 1) * segments
        faces.append(np.column_stack([low + here, low + after, high + after]))
        faces.append(np.column_stack([low + here, high + after, high + here]))
    top = (len(rings) - 1) * segments
    faces.append(np.column_stack([top + here, top + after, np.full(segments, len(rings) * segments + 1)]))
    return Mesh(np.concatenate([*rings, poles]), np.concatenate(faces).astype(np.int32))


def _along(axis: Float64Array) -> Float64Array:
    """Rotation whose z lies along an axis and whose x is level (or forward, for an upright axis)."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 0.0, 1.0], z) if abs(z[2]) < 0.99 else np.array([1.0, 0.0, 0.0]) - z * z[0]
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
