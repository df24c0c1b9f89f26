"""The truth about changes: which returns belong to one, and whether the other session could have noticed it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from cdpipe.geometry import BoolArray, Float32Array, Float64Array, Int64Array
from scenarios.schema import Scenario
from sim.lidar import Rays
from sim.mesh import Mesh, is_near_surface, joined, near_part
from sim.placing import Standing
from sim.raycast import Caster
from sim.scene import World
from sim.truth import Change

CELL_M = 0.1
NEAR_OLD_SURFACE_M = 0.1
MIN_CELLS = 10
MIN_GHOST_RAYS = 10
GHOST_REACH_M = 50.0


class Ghost:
    """An object alone, at the pose it has in one session, against which the other session's rays are cast."""

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
        if np.linalg.norm(rays.origins[0, 0] - self._centre) > GHOST_REACH_M:
            return 0
        delta = self._centre - rays.origins
        along = np.einsum("ijk,ijk->ij", delta, rays.directions)
        off_axis = np.einsum("ijk,ijk->ij", delta, delta) - along**2
        near = (off_axis <= self._radius_m**2) & (along > -self._radius_m) & (ranges_m > 0)
        if not near.any():
            return 0
        ghost_m, _, _ = self._caster.cast(rays.origins[near], rays.directions[near])
        # A millimetre: a ray that ends on the very same surface counts.
        return int((ghost_m <= ranges_m[near] + 1e-3).sum())


@dataclass(slots=True, eq=False)
class Tally:
    """One change while the sessions are being simulated.

    Attributes:
        change: The change, its counts still zero.
        ghost: The object alone, for the rays of the other session.
        other_surface: For a partial change, what stands near it in the other session; else None.
        n_returns: Returns that belong to it so far.
        cells: Keys of the cells they fill, in the odom frame of its session.
        n_ghost_rays: Rays of the other session that meet its ghost so far.
    """

    change: Change
    ghost: Ghost
    other_surface: Mesh | None
    n_returns: int = 0
    cells: set[int] = field(default_factory=set)
    n_ghost_rays: int = 0

    def finished(self) -> Change:
        """Return the change with its counts and whether it is observable."""
        reasons = []
        if len(self.cells) < MIN_CELLS:
            reasons.append(f"{len(self.cells)} cells of {CELL_M:g} m filled, {MIN_CELLS} needed")
        if self.n_ghost_rays < MIN_GHOST_RAYS:
            reasons.append(f"{self.n_ghost_rays} rays of the other session reach it, {MIN_GHOST_RAYS} needed")
        return replace(
            self.change,
            n_returns=self.n_returns,
            n_cells=len(self.cells),
            n_ghost_rays=self.n_ghost_rays,
            is_observable=not reasons,
            why_not="; ".join(reasons),
        )


def list_changes(scenario: Scenario, world: World) -> list[Tally]:
    """Return every change of a pair, in the order of the props; a moved prop is a removal and an addition, linked."""
    tallies: list[Tally] = []
    for instance, prop in enumerate(scenario.props, start=1):
        if prop.change == "none":
            continue
        places = [item for item in world.standing if item.prop.name == prop.name]
        group: Literal["full", "partial"] = "partial" if _is_short_move(places) else "full"
        first_id = len(tallies) + 1
        for place, item in enumerate(places):
            partner = first_id + 1 - place if len(places) == 2 else None
            tallies.append(_tally(first_id + place, instance, item, world, group, partner))
    return tallies


def claim_returns(tally: Tally, points_world: Float64Array, points_odom: Float64Array) -> BoolArray:
    """Add returns on a changed prop to its tally.

    Args:
        tally: The change; its counts grow.
        points_world: (N, 3) true places of the returns.
        points_odom: (N, 3) the same returns as the session measured them, in its odom frame.

    Returns:
        (N,) which of them belong to the change.
    """
    belongs = np.ones(len(points_world), dtype=bool)
    if tally.other_surface is not None:
        belongs = ~is_near_surface(points_world, tally.other_surface, NEAR_OLD_SURFACE_M)
    tally.n_returns += int(belongs.sum())
    tally.cells.update(cell_keys(points_odom[belongs]).tolist())
    return belongs


def cell_keys(points: Float64Array) -> Int64Array:
    """Return a number for each 0.1 m cell that points (N, 3) fill."""
    cells = np.floor(points / CELL_M).astype(np.int64) + (1 << 20)
    return np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2])


def _tally(
    change_id: int,
    instance: int,
    item: Standing,
    world: World,
    group: Literal["full", "partial"],
    partner: int | None,
) -> Tally:
    session: Literal["before", "after"] = "before" if "before" in item.sessions else "after"
    scene, other = (world.before, world.after) if session == "before" else (world.after, world.before)
    surface = joined([mesh for mesh, owner in zip(scene.meshes, scene.instance, strict=True) if owner == instance])
    kind: Literal["added", "removed", "moved"] = "added" if session == "after" else "removed"
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
        hull_volume_m3=world.shapes[item.prop.name].hull_volume_m3,
        n_returns=0,
        n_cells=0,
        n_ghost_rays=0,
        is_observable=False,
        why_not="",
    )
    old = near_part(joined(list(other.meshes)), surface, 2 * NEAR_OLD_SURFACE_M) if group == "partial" else None
    return Tally(change, Ghost(surface), old)


def _is_short_move(places: list[Standing]) -> bool:
    """Tell whether a prop moved by less than its own length, the longer side of its footprint."""
    if len(places) < 2:
        return False
    start, end = (item.world_T_object[:3, 3] for item in places)
    return bool(np.linalg.norm(end - start) < max(places[0].prop.size_m[:2]))
