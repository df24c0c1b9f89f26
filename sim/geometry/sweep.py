"""Meshes of long thin objects: profiles swept along lines, and straight bars."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float64Array, Int64Array
from sim.geometry.mesh import Mesh

_UP = np.array([0.0, 0.0, 1.0])
EMPTY = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))


def circle(radius_m: float, sides: int) -> Float64Array:
    """Return a regular polygon (sides, 2) whose area is that of the circle, counter-clockwise."""
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    # A polygon with its corners on the circle would be thinner than the pipe.
    corner_m = radius_m * np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    return np.asarray(corner_m * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def sweep(path: Float64Array, profile: Float64Array, scale: Float64Array | None = None, is_capped: bool = True) -> Mesh:
    """Return a profile swept along a path, upright and facing outwards.

    Args:
        path: (N, 3) points, nowhere vertical, metres.
        profile: (K, 2) closed outline, counter-clockwise: to the left of the path, and up.
        scale: (N,) factor on the profile at each point.
        is_capped: Whether both ends are closed; the profile must then be convex.
    """
    left, up = frames_along(path)
    across = profile[None, :, :, None] * (1.0 if scale is None else scale[:, None, None, None])
    vertices = path[:, None] + across[:, :, 0] * left[:, None] + across[:, :, 1] * up[:, None]
    faces = _tube_faces(len(path), len(profile), is_capped)
    return Mesh(vertices.reshape(-1, 3), faces.astype(np.int32))


def frames_along(path: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the unit directions to the left (N, 3), level, and up (N, 3), at right angles to the path."""
    tangents = np.gradient(path, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    left = np.cross(_UP, tangents)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-12)
    return left, np.cross(tangents, left)


def bars(starts: Float64Array, ends: Float64Array, width_m: float) -> Mesh:
    """Return straight square bars, closed, facing outwards; starts and ends are (N, 3)."""
    if len(starts) == 0:
        return EMPTY
    along = ends - starts
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    aside = np.cross(np.where(np.abs(along[:, 2:]) > 0.9, (1.0, 0.0, 0.0), _UP), along)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    above = np.cross(along, aside)
    corners = 0.5 * width_m * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    offsets = corners[None, :, :1] * aside[:, None] + corners[None, :, 1:] * above[:, None]
    vertices = np.concatenate([starts[:, None] + offsets, ends[:, None] + offsets], axis=1)
    return repeat_body(vertices, _BAR_FACES)


def repeat_body(vertices: Float64Array, faces: npt.NDArray[np.integer]) -> Mesh:
    """Return N copies of one body as one mesh: vertices (N, V, 3), faces (F, 3) of the body."""
    starts = np.arange(len(vertices)) * vertices.shape[1]
    return Mesh(vertices.reshape(-1, 3), (starts[:, None, None] + faces).reshape(-1, 3).astype(np.int32))


def _tube_faces(n: int, k: int, is_capped: bool) -> Int64Array:
    """Return the faces of a tube of n rings of k counter-clockwise corners each, numbered ring by ring."""
    ring = np.arange(n - 1)[:, None] * k
    here, there = np.arange(k)[None], np.roll(np.arange(k), -1)[None]
    a, b, c, d = ring + here, ring + there, ring + k + there, ring + k + here
    faces = [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    if is_capped:
        fan = np.stack([np.zeros(k - 2, np.int64), np.arange(1, k - 1), np.arange(2, k)], axis=1)
        faces += [fan[:, ::-1], fan + (n - 1) * k]
    return np.concatenate(faces)


_BAR_FACES = _tube_faces(2, 4, is_capped=True)
