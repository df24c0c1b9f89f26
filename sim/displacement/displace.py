"""The walls of both sessions: every surface change of a scenario at its place, on one topology."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from scenarios.schema import Scenario, SurfaceChange
from sim.displacement.breakage import break_out, fill_up, pile_up, plan_heap
from sim.displacement.deform import Moved, converge, heave, spray, vertices_near
from sim.displacement.face import advance
from sim.displacement.refine import TwinWalls, refine_ball, swept_volume_m3, twin_walls
from sim.displacement.zone import Zone, sector_offset
from sim.geometry.mesh import Mesh
from sim.placement.fitting import Spot
from sim.placement.stations import draw_areas, drawn_spots, spot_between, way
from sim.rock.centreline import Centreline

PatchKind = Literal["convergence", "heave", "shotcrete", "scar", "rubble", "fill", "face"]
MOVED_M = 1e-3  # less is no change of the surface
_STILL_M = 1e-7
_COARSEST_M = 0.6  # longest edge where rock changes; those of marching cubes are shorter
_APART_M = 0.3  # of rock that stays between two changes


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One change of the walls.

    Attributes:
        number: 1-based, in the order of the scenario; the rubble of a scar has a number of its own.
        name: That of the scenario.
        kind: What it is.
        partner: Number of the rubble of a scar, and of the scar of rubble.
        zone: Where it is.
        is_undone: Whether the before session is the later state: what came is gone, and what fell is there.
    """

    number: int
    name: str
    kind: PatchKind
    partner: int | None
    zone: Zone
    is_undone: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """The walls of both sessions and what makes them differ.

    Attributes:
        walls: The walls.
        patches: The changes, by number.
        label: (M,) int16 number of the change to which each face belongs, 0 for faces of which no corner moves by 1 mm.
        is_moved: (M,) faces of which any corner moves at all.
        original: The before surface in the triangles that it had before any of them was cut.
    """

    walls: TwinWalls
    patches: tuple[Patch, ...]
    label: np.ndarray
    is_moved: BoolArray
    original: Mesh

    def volume_m3(self, number: int) -> float:
        """Return the volume swept by one change, positive where rock came into the void."""
        return swept_volume_m3(self.walls, np.flatnonzero(self._owner_of_faces() == number))

    def shift(self) -> Float64Array:
        """Return how each vertex moves (N, 3)."""
        return np.asarray(self.walls.after - self.walls.before)

    def owned_by(self, kinds: set[str]) -> BoolArray:
        """Mark the vertices (N,) that a change of one of these kinds moves."""
        numbers = [patch.number for patch in self.patches if patch.kind in kinds]
        return np.isin(self.walls.owner, numbers)

    def _owner_of_faces(self) -> Int64Array:
        return np.asarray(self.walls.owner[self.walls.faces].max(axis=1))


def displace(scenario: Scenario, centreline: Centreline, wall: Mesh, seed: int) -> Displacement | None:
    """Make every surface change of a scenario; None where it has none.

    A change with a given place stands there. A drawn place is drawn again, up to 80 times, until the change meets no
    other one and its rubble has room.

    Args:
        scenario: Its `surface`.
        centreline: The drifts.
        wall: The walls of the before session, from the field or from a file.
        seed: Draws places, outlines and broken rock.

    Raises:
        ScenarioError: A change finds no place.
    """
    if not scenario.surface:
        return None
    walls = twin_walls(wall)
    patches: tuple[Patch, ...] = ()
    # given places first, as with props, so that no drawn change takes one
    for change in sorted(scenario.surface, key=lambda each: each.place.between is None and each.place.node is None):
        walls, patches = _find_place(scenario, centreline, walls, patches, change, seed)
    order = {change.name: number for number, change in enumerate(scenario.surface)}
    wanted = sorted(patches, key=lambda patch: (order[patch.name], patch.kind == "rubble"))
    renumbered = np.zeros(len(patches) + 1, np.int64)
    for number, patch in enumerate(wanted, start=1):
        renumbered[patch.number] = number
    patches = tuple(
        replace(patch, number=number, partner=None if patch.partner is None else int(renumbered[patch.partner]))
        for number, patch in enumerate(wanted, start=1)
    )
    walls = replace(walls, owner=renumbered[walls.owner])
    moved_m = np.linalg.norm(walls.after - walls.before, axis=1)[walls.faces].max(axis=1)
    owner = walls.owner[walls.faces].max(axis=1)
    return Displacement(walls, patches, np.where(moved_m > MOVED_M, owner, 0).astype(np.int16), moved_m > 0, wall)


def _find_place(
    scenario: Scenario,
    centreline: Centreline,
    walls: TwinWalls,
    patches: tuple[Patch, ...],
    change: SurfaceChange,
    seed: int,
) -> tuple[TwinWalls, tuple[Patch, ...]]:
    why, tries = "no station is free of junctions", 0
    is_given = change.place.between is not None or change.place.node is not None
    for zone in _zones(scenario, centreline, change, seed):
        tries += 1
        try:
            _refuse_taken(walls, patches, zone, change)
            return _make(scenario, walls, patches, zone, change, seed)
        except ScenarioError as error:
            why = str(error).removeprefix(f"surface {change.name!r}: ")
            if is_given:
                raise
    raise ScenarioError(
        f"surface {change.name!r} finds no place in {tries} tries, at the last because {why}: make it smaller, or give "
        "between and fraction"
    )


def _make(
    scenario: Scenario, walls: TwinWalls, patches: tuple[Patch, ...], zone: Zone, change: SurfaceChange, seed: int
) -> tuple[TwinWalls, tuple[Patch, ...]]:
    number = len(patches) + 1
    walls = refine_ball(walls, zone.middle, zone.reach_m, _COARSEST_M)
    if change.kind == "face":
        moved = advance(walls, zone, change, seed, scenario.tunnel)
    elif change.kind == "fill":
        moved = fill_up(walls, zone, change, seed, change.place.node is not None)
    else:
        make = {"convergence": converge, "heave": heave, "shotcrete": spray, "scar": break_out}[change.kind]
        moved = make(walls, zone, change, seed)
    done = _move(walls, moved, change, zone, number)
    patch = Patch(number, change.name, change.kind, None, zone)
    if change.kind != "scar":
        return done, (*patches, patch)
    assert change.swell is not None
    faces = np.flatnonzero((done.owner[done.faces] == number).any(axis=1))
    volume_m3 = -change.swell * swept_volume_m3(done, faces)
    heap = plan_heap(moved.walls, moved, zone, volume_m3)
    rubble = pile_up(done, heap, zone, change, volume_m3, seed)
    done = _move(done, rubble, change, zone, number + 1)
    patches = (*patches, replace(patch, partner=number + 1), Patch(number + 1, change.name, "rubble", number, zone))
    return done, patches


def _move(walls: TwinWalls, moved: Moved, change: SurfaceChange, zone: Zone, number: int) -> TwinWalls:
    """Return the walls after a move; refuse one of nothing, or of rock that another change moved or touches."""
    is_new = np.linalg.norm(moved.places - moved.walls.before[moved.vertices], axis=1) > _STILL_M
    vertices = moved.vertices[is_new]
    if not len(vertices):
        raise ScenarioError(f"surface {change.name!r}: it moves no rock {zone.where}")
    is_mine = np.zeros(len(moved.walls.before), dtype=bool)
    is_mine[vertices] = True
    is_others = moved.walls.owner > 0
    faces = moved.walls.faces
    if (is_mine & is_others).any() or (is_mine[faces].any(axis=1) & is_others[faces].any(axis=1)).any():
        raise ScenarioError(f"surface {change.name!r}: it meets another surface change {zone.where}")
    return moved.walls.moved(vertices, moved.places[is_new], number)


def _refuse_taken(walls: TwinWalls, patches: tuple[Patch, ...], zone: Zone, change: SurfaceChange) -> None:
    """Refuse a zone that another change lies in, before anything is meshed."""
    if not patches:
        return
    near = vertices_near(walls, zone)
    taken = near[walls.owner[near] > 0]
    if not len(taken):
        return
    around = zone.around(walls.before[taken])
    is_in = np.abs(around.along_m) < zone.length_m / 2 + _APART_M
    if change.sector_deg is not None and change.kind != "scar":  # below a scar lies its rubble
        is_in &= np.abs(sector_offset(around.angle_deg, change.sector_deg)) < 1.1
    if is_in.any():
        raise ScenarioError(f"surface {change.name!r}: it meets another surface change {zone.where}")


def _zones(scenario: Scenario, centreline: Centreline, change: SurfaceChange, seed: int) -> Iterator[Zone]:
    """Yield the zone that a change names, or those that the seed draws."""
    place, length_m = change.place, change.length_m or 1.0
    if place.node is not None:
        yield _at_end(scenario, centreline, change, place.node)
        return
    if change.kind == "face":
        pairs = zip(scenario.tunnel.drifts, centreline.drifts, strict=True)
        ends = [drift.nodes[end] for drift, line in pairs for end in (0, -1) if line.is_blind[end]]
        for index in stream(seed, "surface", change.name, "place").permutation(len(ends)).tolist():
            yield _at_end(scenario, centreline, change, ends[index])
        return
    if place.between is not None and place.fraction is not None:
        spots: Iterator[Spot] = iter([spot_between(place.between, place.fraction, centreline, over_humps=True)])
    else:
        stations = way(scenario, centreline)
        if place.area is not None:
            stations = draw_areas(scenario, centreline, seed)[place.area][0]
        generator = stream(seed, "surface", change.name, "place")
        spots = drawn_spots(generator, stations, scenario, centreline, over_humps=True)
    for spot in spots:
        drift, sample = _nearest(centreline, spot.point)
        yield Zone(centreline.drifts[drift], sample, length_m, spot.where)


def _at_end(scenario: Scenario, centreline: Centreline, change: SurfaceChange, node: str) -> Zone:
    for drift, line in zip(scenario.tunnel.drifts, centreline.drifts, strict=True):
        for end, last in ((0, 0), (-1, len(line.points) - 1)):
            if drift.nodes[end] == node and line.is_blind[end]:
                where = f"at the end {node!r}"
                if change.kind == "face":
                    return Zone(line, line.node_samples[end], 2.0, where)
                # the zone of fill reaches from its front to behind the face
                length_m = float(change.length_m or 1.0)
                stations_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line.points, axis=0), axis=1))])
                if length_m >= stations_m[-1]:
                    raise ScenarioError(
                        f"surface {change.name!r}: length_m = {length_m:g}: its drift is {stations_m[-1]:.1f} m long "
                        f"{where}: give a shorter one"
                    )
                middle_m = stations_m[last] + (length_m / 2 if end == 0 else -length_m / 2)
                return Zone(line, int(np.argmin(np.abs(stations_m - middle_m))), length_m, where)
    raise ScenarioError(f"surface {change.name!r}: {node!r} is no blind end of a drift")


def _nearest(centreline: Centreline, point: Float64Array) -> tuple[int, int]:
    """Return the drift and the sample of it that is nearest to a point (3,)."""
    apart_m = [np.linalg.norm(line.points - point, axis=1) for line in centreline.drifts]
    drift = int(np.argmin([each.min() for each in apart_m]))
    return drift, int(np.argmin(apart_m[drift]))
