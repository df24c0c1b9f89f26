"""The truth of rock that moved: the displacement of every return on the walls, and what each change amounts to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from sim.displacement.displace import MOVED_M, Displacement
from sim.displacement.measure import FARTHEST_M, SignedDistance
from sim.geometry.mesh import Mesh, cut_triangles
from sim.geometry.raycast import Caster
from sim.scene import WALL_GEOM, World
from sim.sensor.lidar import Scan
from sim.sensor.rays import Rays
from sim.session.truth import Int16Array, SessionName, SurfaceChangeTruth

# Rock that only rises, or is taken away again: folded walls under its edge cannot turn the sign.
_RISING = ("rubble", "fill")
_SLACK_M = 0.05
_SAME_M = 1e-3  # between the middle ray of a beam and the ray that gave the return
_PIECE_M = 0.2


class MovedRock:
    """The walls of one session near the changes, and an index of the other session's walls there."""

    def __init__(self, world: World, displacement: Displacement, session: SessionName) -> None:
        own, other = (world.before, world.after) if session == "before" else (world.after, world.before)
        self.label, self._is_moved = displacement.label, displacement.is_moved
        self._caster: Caster = own.caster
        self._turn = 1.0 if session == "after" else -1.0
        owner = displacement.walls.owner[displacement.walls.faces].max(axis=1)
        self._rise = np.zeros(len(owner))  # of each face: 1 where it only rises, -1 where it only sinks
        for patch in displacement.patches:
            if patch.kind in _RISING:
                self._rise[owner == patch.number] = -1.0 if patch.is_undone else 1.0
        wall, far = own.meshes[WALL_GEOM], other.meshes[WALL_GEOM]
        # the before surface is the same in its first triangles, which are fewer
        looked_up = displacement.original if session == "after" else far
        self._boxes: list[tuple[Float64Array, Float64Array]] = []
        chosen = np.zeros(len(looked_up.faces), dtype=bool)
        for patch in displacement.patches:
            moved = Mesh(wall.vertices, wall.faces[self._is_moved & (owner == patch.number)])
            corners = wall.vertices[moved.faces].reshape(-1, 3)
            self._boxes.append((corners.min(axis=0) - _SLACK_M, corners.max(axis=0) + _SLACK_M))
            shift_m = np.linalg.norm(wall.vertices[moved.faces] - far.vertices[moved.faces], axis=2).max(initial=0.0)
            chosen |= _near_box(looked_up, corners, min(float(shift_m), FARTHEST_M) + _SLACK_M)
        self._index = SignedDistance(Mesh(looked_up.vertices, looked_up.faces[chosen]))

    def measure(self, points: Float64Array, faces: Int64Array) -> Float64Array:
        """Return the displacement (N,) at places (N, 3) on faces (N,) of this session's walls, after minus before."""
        moved_m = np.zeros(len(points))
        searched = np.flatnonzero(self._is_moved[faces])
        found_m = self._index.measure(points[searched])
        rise = self._rise[faces[searched]]
        moved_m[searched] = np.where(rise != 0.0, rise * np.abs(found_m), self._turn * found_m)
        return moved_m

    def _nearest_m(self, origins: Float64Array) -> Float32Array:
        """Return the distance (W,) of places (W, 3) to the nearest of the boxes, a little less for rounding."""
        nearest_m = np.full(len(origins), np.inf)
        for low, high in self._boxes:
            off = np.maximum(np.maximum(low - origins, origins - high), 0.0)
            np.minimum(nearest_m, np.sqrt((off**2).sum(axis=1)), out=nearest_m)
        return (nearest_m - _SAME_M).astype(np.float32)

    def mark(self, rays: Rays, result: Scan, reach_m: Float32Array) -> tuple[Float32Array, Int16Array]:
        """Return displacement and surface change (R, W) of the returns of a revolution.

        Args:
            rays: Its rays.
            result: What the sensor reports.
            reach_m: (R, W) length of each ray to its hit.
        """
        is_rock = (result.geom == WALL_GEOM) & ~result.is_mixed
        displacement = np.where(is_rock, np.float32(0.0), np.float32(np.nan))
        change = np.zeros(is_rock.shape, np.int16)
        height = rays.directions.shape[1]
        # most returns end before the nearest box
        row, column = np.nonzero(is_rock & (reach_m > self._nearest_m(rays.origins)))
        points = rays.points(row % height, column, reach_m[row, column])
        is_near = np.zeros(len(row), dtype=bool)
        for low, high in self._boxes:
            is_near |= ((points > low) & (points < high)).all(axis=1)
        row, column, points = row[is_near], column[is_near], points[is_near]
        if not len(row):
            return displacement, change
        middle_m, geom, face = self._caster.faces(rays.origins[column], rays.directions[column, row % height])
        # The place of a return that came from beside the middle of its beam is not known to 0.1 mm.
        is_middle = (geom == WALL_GEOM) & (np.abs(middle_m - reach_m[row, column]) < _SAME_M)
        displacement[row[~is_middle], column[~is_middle]] = np.nan
        row, column, points, face = row[is_middle], column[is_middle], points[is_middle], face[is_middle]
        displacement[row, column] = self.measure(points, face.astype(np.int64))
        change[row, column] = self.label[face]
        return displacement, change


def list_surface_changes(world: World, displacement: Displacement, before: MovedRock) -> tuple[SurfaceChangeTruth, ...]:
    """Return what each change of the walls amounts to, measured on the before surface."""
    wall = world.before.meshes[WALL_GEOM]
    found = []
    for patch in displacement.patches:
        faces = np.flatnonzero(displacement.label == patch.number)
        if not len(faces):  # crept by less than 1 mm
            continue
        told = measure_faces(wall, faces, before.measure)
        volume_m3 = displacement.volume_m3(patch.number)
        named = patch.number, patch.name, patch.kind, patch.partner
        found.append(SurfaceChangeTruth(*named, volume_m3=volume_m3, **told))
    return tuple(found)


def measure_faces(
    wall: Mesh, faces: Int64Array, measure: Callable[[Float64Array, Int64Array], Float64Array]
) -> dict[str, Any]:
    """Return what a change of some faces (K,) amounts to: `area_m2`, `largest_m`, `mean_m` and `centre_world`.

    Args:
        wall: The before surface.
        faces: Those that belong to the change.
        measure: Gives the displacement (N,) at places (N, 3) on faces (N,) of this surface.
    """
    pieces, owners = cut_triangles(wall.vertices[wall.faces[faces]], _PIECE_M)
    moved_m = measure(pieces.mean(axis=1), faces[owners])
    area_m2 = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1) / 2
    corners = np.unique(wall.faces[faces])
    corner_m = measure(wall.vertices[corners], _face_of(wall, faces, corners))
    is_moved = np.abs(moved_m) > MOVED_M
    total_m2 = float(area_m2[is_moved].sum())
    every_m = np.concatenate([moved_m[np.isfinite(moved_m)], corner_m[np.isfinite(corner_m)], [0.0]])
    mean_m = float((moved_m * area_m2)[is_moved].sum() / total_m2) if total_m2 else 0.0
    centre = (pieces.mean(axis=1) * area_m2[:, None]).sum(axis=0) / area_m2.sum()
    largest_m = float(every_m[np.argmax(np.abs(every_m))])
    return {"area_m2": total_m2, "largest_m": largest_m, "mean_m": mean_m, "centre_world": centre.tolist()}


def _near_box(mesh: Mesh, corners: Float64Array, within_m: float) -> BoolArray:
    """Mark the faces (M,) of which the box comes within a distance of the box of some places (N, 3)."""
    low, high = corners.min(axis=0) - within_m, corners.max(axis=0) + within_m
    a, b, c = mesh.faces.T
    is_off = np.zeros(len(mesh.faces), dtype=bool)
    for axis in range(3):
        for is_beyond in (mesh.vertices[:, axis] < low[axis], mesh.vertices[:, axis] > high[axis]):
            is_off |= is_beyond[a] & is_beyond[b] & is_beyond[c]
    return ~is_off


def _face_of(mesh: Mesh, faces: Int64Array, corners: Int32Array) -> Int64Array:
    """Return a face (K,), of some faces, that has each of these corners (K,)."""
    of_corner = np.zeros(len(mesh.vertices), np.int64)
    for column in range(3):
        of_corner[mesh.faces[faces, column]] = faces
    return np.asarray(of_corner[corners])
