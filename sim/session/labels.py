"""The truth of each change: the returns that belong to it, and whether the other session could observe it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from cdpipe.core.geometry.voxel import cell_keys
from scenarios.schema import Scenario
from sim.geometry.mesh import Mesh, NearSurface, crop_near, drop_unused_vertices, join_meshes, split_triangles
from sim.geometry.raycast import Caster
from sim.placement.contact import standing_surface
from sim.placement.placing import Standing, standing_corners, standing_middle
from sim.sensor.rays import Rays
from sim.session.truth import SESSIONS, Change, Group, Kind, SessionName

CELL_M = 0.1
NEAR_OLD_SURFACE_M = 0.1
MIN_CELLS = 10
MIN_GHOST_RAYS = 10
GHOST_REACH_M = 50.0
UNMOVED_M = 1e-3
_SAME_SURFACE_M = 0.02  # parts of a reshaped prop's surface nearer than this to its other surface have not changed
_SAMPLE_M = 0.03
_SLACK_M = 0.01  # added to the radius of the ball around a ghost, so that rounding loses no ray


class Surfaces(Protocol):
    """The surfaces of a session that changes are compared on, such as `sim.scene.Scene`: meshes and their instance."""

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """Surface of every geom, world frame."""

    @property
    def instance(self) -> Int32Array:
        """(G,) number of the prop that each geom belongs to, 0 for all else."""


class Compared(Protocol):
    """The props of a pair and the surfaces of its two sessions, such as `sim.scene.World`."""

    @property
    def standing(self) -> Sequence[Standing]:
        """Every prop at each of its places."""

    @property
    def before(self) -> Surfaces:
        """What the before session shows."""

    @property
    def after(self) -> Surfaces:
        """What the after session shows."""


class Ghost:
    """An object at its pose in one session, without its surroundings; the other session's rays are cast against it."""

    def __init__(self, surface: Mesh) -> None:
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        self._centre = (low + high) / 2
        self._radius_m = float(np.linalg.norm(surface.vertices - self._centre, axis=1).max())
        self._caster = Caster([surface])

    def count(self, rays: Rays, ranges_m: Float32Array) -> int:
        """Count the rays that end in the object or pass through it.

        Args:
            rays: A revolution's rays, world frame.
            ranges_m: (W, H) distance from the ray's origin to what it hit, 0 where nothing was recorded.
        """
        if np.linalg.norm(rays.origins[0] - self._centre) > GHOST_REACH_M:
            return 0
        column, row = self._near(rays, ranges_m)
        if not len(column):
            return 0
        ghost_m, _, _ = self._caster.cast(rays.origins[column], rays.directions[column, row])
        # One millimetre of tolerance: a ray that ends on the same surface counts.
        return int((ghost_m <= ranges_m[column, row] + 1e-3).sum())

    def _near(self, rays: Rays, ranges_m: Float32Array) -> tuple[Int64Array, Int64Array]:
        """Return columns and rows of all rays that can meet the ball around the object, and of a few others.

        A ray that starts within `spread` of the middle column's origin and meets the ball has the direction of a ray
        that starts at that origin and meets the ball grown by `spread`.
        """
        middle = rays.origins[len(rays.origins) // 2]
        spread_m = float(np.sqrt(((rays.origins - middle) ** 2).sum(axis=1).max()))
        radius_m = self._radius_m + spread_m + _SLACK_M
        towards = self._centre - middle
        distance_m = float(np.linalg.norm(towards))
        width, height, _ = rays.directions.shape
        near = np.arange(width * height)
        if distance_m > radius_m:
            # The rounding of this product does not matter: the slack covers it, and extra rays only cost time.
            along = rays.directions.reshape(-1, 3) @ (towards / distance_m).astype(np.float32)
            near = np.flatnonzero(along > np.sqrt(1.0 - (radius_m / distance_m) ** 2) - 1e-6)
        column, row = np.divmod(near, height)
        is_within = ranges_m[column, row] > max(0.0, distance_m - radius_m)
        return column[is_within], row[is_within]


@dataclass(slots=True, eq=False)
class Returns:
    """The number of returns counted so far, and the keys of the 0.1 m cells they fill in their session's odom frame."""

    n: int = 0
    cells: set[int] = field(default_factory=set)

    def add(self, points_odom: Float64Array) -> None:
        """Count returns (N, 3), as measured, odom frame, metres."""
        self.n += len(points_odom)
        self.cells.update(np.unique(cell_keys(points_odom, CELL_M)).tolist())


@dataclass(slots=True, eq=False)
class Tally:
    """The running counts of one change while the sessions are simulated.

    Attributes:
        change: The change, its counts still zero.
        ghost: The object that the rays of the other session are cast against.
        other_surface: For a partial change, the surfaces near it in the other session; else None.
        own: Returns that belong to the change.
        other: Returns of the other session on the same prop.
        n_ghost_rays: Rays of the other session that meet the ghost so far.
    """

    change: Change
    ghost: Ghost
    other_surface: NearSurface | None
    own: Returns = field(default_factory=Returns)
    other: Returns = field(default_factory=Returns)
    n_ghost_rays: int = 0

    def finished(self) -> Change:
        """Return the change with its counts and whether it is observable."""
        reasons = []
        if len(self.own.cells) < MIN_CELLS:
            reasons.append(f"{len(self.own.cells)} cells of {CELL_M:g} m filled, {MIN_CELLS} needed")
        if self.n_ghost_rays < MIN_GHOST_RAYS:
            reasons.append(f"{self.n_ghost_rays} rays of the other session reach it, {MIN_GHOST_RAYS} needed")
        return replace(
            self.change,
            n_returns=self.own.n,
            n_cells=len(self.own.cells),
            n_ghost_rays=self.n_ghost_rays,
            is_observable=not reasons,
            why_not="; ".join(reasons),
            n_returns_other=self.other.n,
            n_cells_other=len(self.other.cells),
        )


def list_changes(scenario: Scenario, world: Compared) -> list[Tally]:
    """Compare the props of both scenes and return every change of the pair, in the order of the props.

    A prop that stands in one session only was added or removed. A prop of the same shape was moved if any of its
    corners differs by more than one millimetre; a move is a removal and an addition, linked. A prop whose surface
    differs was reshaped; its change is the removed part. A prop that aged, or that a
    heaving floor carries, has not changed.
    """
    tallies: list[Tally] = []
    for instance, prop in enumerate(scenario.props, start=1):
        placed = [item for item in world.standing if item.prop.name == prop.name]
        items = [item for session in SESSIONS for item in placed if session in item.sessions]
        if len(items) < 2:
            tallies.extend(_tally(len(tallies) + 1, instance, item, world, "full", None) for item in items)
            continue
        start, end = items
        is_carried = (start.is_carried or end.is_carried) and prop.change == "none"
        if prop.aged is not None or is_carried or _is_same(start, end):
            continue
        if prop.loaded_share is not None:
            tallies.append(_tally_reshaped(len(tallies) + 1, instance, start, end, world))
            continue
        group: Group = "partial" if _is_short_move(start, end) else "full"
        first_id = len(tallies) + 1
        tallies.append(_tally(first_id, instance, start, world, group, first_id + 1))
        tallies.append(_tally(first_id + 1, instance, end, world, group, first_id))
    return tallies


def _is_short_move(start: Standing, end: Standing) -> bool:
    """Tell whether a prop moved by less than the longer side of its footprint, as it lies or stands."""
    if start.posture == end.posture == "upright":
        moved_m = np.linalg.norm(end.world_T_object[:3, 3] - start.world_T_object[:3, 3])
        return bool(moved_m < max(start.shape.size_m[:2]))
    moved_m = np.linalg.norm((standing_middle(end) - standing_middle(start))[:2])
    return bool(moved_m < np.linalg.norm(np.diff(standing_corners(start), axis=0), axis=1).max())


def mark_belonging(tally: Tally, points_world: Float64Array) -> BoolArray:
    """Mark the returns on a changed prop, given by their true positions (N, 3), that belong to its change."""
    if tally.other_surface is None:
        return np.ones(len(points_world), dtype=bool)
    return ~tally.other_surface.marks(points_world)


def _is_same(start: Standing, end: Standing) -> bool:
    """Tell whether two surfaces have the same corners to a millimetre."""
    if start is end:
        return True
    a, b = standing_surface(start).vertices, standing_surface(end).vertices
    return a.shape == b.shape and bool((np.linalg.norm(a - b, axis=1) <= UNMOVED_M).all())


def _tally(change_id: int, instance: int, item: Standing, world: Compared, group: Group, partner: int | None) -> Tally:
    session: SessionName = "before" if "before" in item.sessions else "after"
    scene, other = (world.before, world.after) if session == "before" else (world.after, world.before)
    surface = _surface_in(scene, instance)
    kind: Kind = "added" if session == "after" else "removed"
    change = Change(
        id=change_id,
        name=item.prop.name,
        prop_kind=item.prop.kind,
        kind=kind if partner is None else "moved",
        session=session,
        partner=partner,
        group=group,
        instance=instance,
        world_T_object=item.world_T_object.tolist(),
        hull_volume_m3=item.shape.hull_volume_m3,
        n_returns=0,
        n_cells=0,
        n_ghost_rays=0,
        is_observable=False,
        why_not="",
        mesh_volume_m3=item.shape.mesh_volume_m3,
    )
    return Tally(change, Ghost(surface), _near(other, surface) if group == "partial" else None)


def _tally_reshaped(change_id: int, instance: int, start: Standing, end: Standing, world: Compared) -> Tally:
    """Return the change of a pile that was partly loaded away.

    Its ghost is the missing part of the old surface. This surface is open, which is enough: a ray that would have met
    the removed part comes from outside and meets it, because the rest of the pile still stands behind its rim.
    """
    full, rest = (_compact(_surface_in(scene, instance)) for scene in (world.before, world.after))
    near_full, near_rest = SampledSurface(full), SampledSurface(rest)
    is_gone = near_rest.lies_off(full.vertices[full.faces].mean(axis=1), NEAR_OLD_SURFACE_M)
    skin = drop_unused_vertices(full.vertices, full.faces[is_gone])
    # The part removed lies between the old skin and the new face below it.
    floor_m = start.world_T_object[2, 3]
    ends = np.concatenate([_corners_off(full, near_rest, floor_m), _corners_off(rest, near_full, floor_m)])
    whole_m3, rest_m3 = start.shape.mesh_volume_m3, end.shape.mesh_volume_m3
    tally = _tally(change_id, instance, start, world, "partial", None)
    tally.ghost = Ghost(skin if len(skin.faces) else full)
    tally.change = replace(
        tally.change,
        kind="reshaped",
        hull_volume_m3=float(ConvexHull(ends).volume) if len(ends) > 3 else 0.0,
        mesh_volume_m3=None if whole_m3 is None or rest_m3 is None else whole_m3 - rest_m3,
    )
    return tally


def _corners_off(mesh: Mesh, other: SampledSurface, floor_m: float) -> Float64Array:
    """Return the corners (N, 3) of a surface above the floor that lie off the samples of another one."""
    corners = mesh.vertices[mesh.vertices[:, 2] >= floor_m]
    return corners[other.lies_off(corners, _SAME_SURFACE_M)]


class SampledSurface:
    """Samples of a surface: its corners, and others so that every place on it has one within 1.8 cm.

    Distances of 0.1 m are exact to 2 mm. Only the parts near points that lie off all corners are ever sampled.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._corners = _tree(mesh.vertices)
        self._triangles = mesh.vertices[mesh.faces]
        self._middles = self._triangles.mean(axis=1)
        self._reach_m = np.linalg.norm(self._triangles - self._middles[:, None], axis=2).max(axis=1)

    def lies_off(self, points: Float64Array, limit_m: float) -> BoolArray:
        """Mark the points (N, 3) that are farther than `limit_m` from every sample."""
        nearest_m, _ = self._corners.query(points, distance_upper_bound=2 * limit_m)
        is_off = np.logical_not(np.asarray(nearest_m) <= limit_m)
        unsure = np.flatnonzero(is_off)
        if not len(unsure):
            return is_off
        # No sample of a triangle is farther from its middle than a corner is.
        apart_m, _ = _tree(points[unsure]).query(self._middles)
        near = self._triangles[apart_m <= self._reach_m + limit_m + _SLACK_M]
        a, b, c = split_triangles(near, _SAMPLE_M).transpose(1, 0, 2)
        if len(a):
            nearest_m, _ = _tree((a + b + c) / 3).query(points[unsure], distance_upper_bound=2 * limit_m)
            is_off[unsure] = np.logical_not(np.asarray(nearest_m) <= limit_m)
        return is_off


def _tree(points: Float64Array) -> cKDTree:
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _surface_in(scene: Surfaces, instance: int) -> Mesh:
    return join_meshes([mesh for mesh, owner in zip(scene.meshes, scene.instance, strict=True) if owner == instance])


def _near(scene: Surfaces, surface: Mesh) -> NearSurface:
    """Return the surfaces of a scene that lie near a surface."""
    parts = (crop_near(mesh, surface, 2 * NEAR_OLD_SURFACE_M) for mesh in scene.meshes)
    return NearSurface(join_meshes([_compact(part) for part in parts if len(part.faces)]), NEAR_OLD_SURFACE_M)


def _compact(mesh: Mesh) -> Mesh:
    return drop_unused_vertices(mesh.vertices, mesh.faces)
