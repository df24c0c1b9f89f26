"""Scars in wall or roof, the rubble that fell from them, and fill: broken rock that raises the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array, stream
from scenarios.schema import SurfaceChange
from sim.displacement.deform import Moved, refine_zone, vertices_near
from sim.displacement.normals import smooth_normals
from sim.displacement.refine import TwinWalls, refine, swept_volume_m3
from sim.displacement.zone import Around, Zone, sector_offset
from sim.geometry.noise import noise_at
from sim.geometry.raycast import Caster

REPOSE_DEG = 37.0  # of blasted rock: sim/props/MUCK_PILES.md
_FINE_M = 0.06
_RIM = 0.12  # share of the half size over which a scar reaches its depth
_RAGGED, _RAGGED_LENGTH_M = 0.12, 0.5  # of its outline
_BODY_M = 1.5
# Broken rock: amplitude as a share of the depth, and correlation length, of two octaves.
_BROKEN = ((0.25, 0.45), (0.12, 0.15))
_LEAST = 0.35  # of the depth, behind the rim
# Covered rock keeps this share of its distance below the new surface, so that no two places become one.
_SQUEEZED = 1e-3
_FOOT_SHARE = 0.12  # how much the outline of a heap wanders
_FRAGMENT_M = (0.08, 0.35)
_PER_M2 = 14.0
_BESIDE_M = 0.22  # fragments lie where the flank would be at most so far below the floor
_FILL_SLOPE = 1 / 3  # a ramp that a robot climbs
_FILL_ROUGH = ((0.03, 1.2), (0.012, 0.25))  # standard deviation and correlation length, metres
_FILL_EDGE_M = 0.12
_HALVINGS = 40
_BEHIND_M = 0.05


def break_out(walls: TwinWalls, zone: Zone, change: SurfaceChange, seed: int) -> Moved:
    """Take rock out of wall or roof: `depth_m` deep about the middle, irregular, with a sharp rim.

    Raises:
        ScenarioError: It would break into another drift.
    """
    assert change.depth_m is not None and change.sector_deg is not None
    sector_deg, depth_m = change.sector_deg, change.depth_m
    rim_key, *keys = stream(seed, "surface", change.name, "scar").integers(2**63, size=1 + len(_BROKEN)).tolist()

    def out(around: Around, places: Float64Array) -> Float64Array:
        middle = np.hypot(around.along_m / (zone.length_m / 2), sector_offset(around.angle_deg, sector_deg))
        return np.asarray(middle * (1.0 + _RAGGED * np.clip(noise_at(places, _RAGGED_LENGTH_M, rim_key), -2, 2)))

    walls = refine_zone(walls, zone, lambda around, places: np.where(out(around, places) < 1.1, _FINE_M, np.inf))
    near = vertices_near(walls, zone)
    around = zone.around(walls.before[near])
    inside = 1.0 - out(around, walls.before[near])
    chosen, inside = near[(inside > 0) & (around.share > 0.5)], inside[(inside > 0) & (around.share > 0.5)]
    if not len(chosen):
        return Moved(walls, chosen, walls.before[chosen])
    places = walls.before[chosen]
    broken = sum(
        share * np.clip(noise_at(places, length_m, key), -2, 2)
        for (share, length_m), key in zip(_BROKEN, keys, strict=True)
    )
    hollow = np.maximum(1.0 - 0.4 * (1.0 - np.clip(inside, 0, 1)) ** 2 + broken, _LEAST)
    depths_m = depth_m * np.clip(inside / _RIM, 0.0, 1.0) * hollow
    outward = -smooth_normals(walls, chosen, _BODY_M)
    ahead_m, _, normals = Caster([walls.mesh("before")]).hits(places + _BEHIND_M * outward, outward)
    # a wall that is met from behind is another drift's
    if (((normals * outward).sum(axis=1) > 0) & (ahead_m + _BEHIND_M < depths_m)).any():
        raise ScenarioError(f"surface {change.name!r}: another drift lies behind the rock that falls out {zone.where}")
    return Moved(walls, chosen, places + depths_m[:, None] * outward)


@dataclass(frozen=True, slots=True, eq=False)
class Heap:
    """Where a heap lies: its middle on the floor (3,), and how far from it the heap may reach."""

    middle: Float64Array
    reach_m: float


def plan_heap(walls: TwinWalls, scar: Moved, zone: Zone, volume_m3: float) -> Heap:
    """Return where the rubble of a scar lies: below it, against the wall where the scar is in the wall."""
    around = zone.around(walls.before[scar.vertices])
    steep = float(np.tan(np.deg2rad(REPOSE_DEG)))
    reach_m = float((6 * volume_m3 / np.pi / steep) ** (1 / 3))  # half a cone, against a wall
    left_m = float(around.left_m.mean())
    line, at = zone.line, zone.sample
    side_m = line.width_m[at] / 2 - 0.3 * reach_m
    left_m = float(np.clip(left_m, -side_m, side_m))
    heading = line.headings[at]
    middle = line.points[at].copy()
    middle[:2] += left_m * np.array([-heading[1], heading[0]])
    return Heap(middle, 1.4 * reach_m + 0.3)


def pile_up(walls: TwinWalls, heap: Heap, zone: Zone, change: SurfaceChange, volume_m3: float, seed: int) -> Moved:
    """Raise the floor to a heap of broken rock with flanks of 37 degrees that holds a volume to a thousandth.

    Raises:
        ScenarioError: The place has no room for so much rubble.
    """
    generator = stream(seed, "surface", change.name, "rubble")
    outline_key, _ = generator.integers(2**63, size=2).tolist()  # one more is drawn: heaps keep their bytes
    steep = float(np.tan(np.deg2rad(REPOSE_DEG)))

    def edge_m(places: Float64Array) -> Float64Array:
        off_m = np.linalg.norm(places[:, :2] - heap.middle[:2], axis=1)
        up_m = places[:, 2] - heap.middle[2]
        return np.where((off_m < heap.reach_m) & (np.abs(up_m) < 0.7 * heap.reach_m), _FINE_M, np.inf)

    walls = refine(walls, edge_m)
    near = np.flatnonzero(np.isfinite(edge_m(walls.before)))
    places = walls.before[near]
    off = places[:, :2] - heap.middle[:2]

    def below_peak_m(off: Float64Array) -> Float64Array:
        wander = 1.0 + _FOOT_SHARE * np.clip(noise_at(off + heap.middle[:2], 0.9, outline_key), -2, 2)
        return np.asarray(steep * np.linalg.norm(off, axis=1) * wander)

    fall_m = below_peak_m(off)
    bumps = _Fragments.draw(heap, generator)
    bump_fall_m, covered = below_peak_m(bumps.centres), bumps.lie_over(off)
    faces = np.flatnonzero(np.isin(walls.faces, near).any(axis=1))
    low_m, high_m = 0.0, heap.reach_m
    moved = Moved(walls, near[:0], places[:0])
    for _ in range(_HALVINGS):
        peak_m = (low_m + high_m) / 2
        smooth = heap.middle[2] + peak_m - fall_m
        level = np.maximum(smooth, bumps.tops(covered, len(off), heap.middle[2], peak_m - bump_fall_m))
        is_under = level > places[:, 2]
        moved = Moved(walls, near[is_under], raise_to(places[is_under], level[is_under]))
        held_m3 = swept_volume_m3(walls.moved(moved.vertices, moved.places, 1), faces)
        if abs(held_m3 / volume_m3 - 1.0) < 1e-3:
            return moved
        low_m, high_m = (peak_m, high_m) if held_m3 < volume_m3 else (low_m, peak_m)
    raise ScenarioError(
        f"surface {change.name!r}: there is no room for {volume_m3:.2f} m3 of rubble {zone.where}: "
        "make the scar smaller"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fragments:
    """Fragments on a heap: pyramids of five facets each.

    Attributes:
        centres: (F, 2) from the middle of the heap.
        sizes_m: (F,) across.
        slopes: (F, 5, 2) of the facets.
    """

    centres: Float64Array
    sizes_m: Float64Array
    slopes: Float64Array

    @classmethod
    def draw(cls, heap: Heap, generator: np.random.Generator) -> _Fragments:
        count = int(_PER_M2 * np.pi * heap.reach_m**2) + 8
        radius = heap.reach_m * 0.9 * np.sqrt(generator.random(count))
        turn = 2 * np.pi * generator.random(count)
        largest_m = min(_FRAGMENT_M[1], heap.reach_m / 4)
        sizes_m = _FRAGMENT_M[0] + (largest_m - _FRAGMENT_M[0]) * generator.random(count) ** 3
        facing = turn[:, None] + 2 * np.pi * (np.arange(5) + 0.6 * generator.random((count, 5))) / 5
        steep = generator.uniform(0.5, 1.8, (count, 5))
        slopes = steep[..., None] * np.stack([np.cos(facing), np.sin(facing)], axis=-1)
        return cls(np.column_stack([radius * np.cos(turn), radius * np.sin(turn)]), sizes_m, slopes)

    def lie_over(self, off: Float64Array) -> list[tuple[Int64Array, Float64Array]]:
        """Return which places (N, 2) from the middle each fragment covers, and how far below its tip it is there."""
        x, y = np.ascontiguousarray(off.T)
        covered = []
        for (centre_x, centre_y), size_m, slopes in zip(self.centres, self.sizes_m, self.slopes, strict=True):
            near = np.flatnonzero((np.abs(x - centre_x) < size_m) & (np.abs(y - centre_y) < size_m))
            drop_m = ((off[near] - (centre_x, centre_y)) @ slopes.T).max(axis=1)
            is_on = drop_m < 0.6 * size_m
            covered.append((near[is_on], drop_m[is_on]))
        return covered

    def tops(
        self, covered: list[tuple[Int64Array, Float64Array]], n_places: int, floor_z: float, under_m: Float64Array
    ) -> Float64Array:
        """Return the height (N,) of the highest fragment over each place, -inf where there is none.

        A fragment lies on the flank, `under_m` (F,) above the floor, or on the floor beside the foot.

        Args:
            covered: What `lie_over` found.
            n_places: Number of places.
            floor_z: Height of the floor.
            under_m: (F,) height of the flank at each fragment.
        """
        tops = np.full(n_places, -np.inf)
        for (places, drop_m), size_m, flank_m in zip(covered, self.sizes_m, under_m, strict=True):
            if flank_m >= -_BESIDE_M:
                height = floor_z + max(flank_m, 0.0) + 0.35 * size_m - drop_m
                tops[places] = np.maximum(tops[places], height)
        return tops


def fill_up(walls: TwinWalls, zone: Zone, change: SurfaceChange, seed: int, is_at_end: bool) -> Moved:
    """Raise the floor by `height_m` over the whole width; the ends are ramps of one in three.

    Args:
        walls: The walls.
        zone: Its middle is that of the fill.
        change: The fill.
        seed: Draws its surface.
        is_at_end: Whether it reaches to the face of a blind drift, which the zone's direction says, and has one ramp.

    Raises:
        ScenarioError: The fill leaves less than a third of the drift's height free.
    """
    assert change.height_m is not None
    height_m = change.height_m
    if height_m > zone.line.height_m[zone.sample] / 3:
        raise ScenarioError(
            f"surface {change.name!r}: height_m = {height_m:g}: more than a third of the drift's height {zone.where}"
        )
    keys = stream(seed, "surface", change.name, "fill").integers(2**63, size=len(_FILL_ROUGH)).tolist()
    ahead = 1.0 if zone.sample > len(zone.line.points) / 2 else -1.0  # to the face

    def ramp(around: Around) -> Float64Array:
        ends_m = zone.length_m / 2 + (ahead * around.along_m if is_at_end else -np.abs(around.along_m))
        return np.asarray(np.clip(ends_m * _FILL_SLOPE / height_m, 0.0, 1.0) * around.share)

    def level(around: Around, places: Float64Array) -> Float64Array:
        rough = sum(
            sigma_m * np.clip(noise_at(places[:, :2], length_m, key), -2, 2)
            for (sigma_m, length_m), key in zip(_FILL_ROUGH, keys, strict=True)
        )
        part = ramp(around)
        return np.asarray(places[:, 2] - around.up_m + height_m * part + rough * np.minimum(4 * part, 1.0))

    def edge_m(around: Around, places: Float64Array) -> Float64Array:
        is_near = (ramp(around) > 0) & (around.up_m < height_m + 0.25) & (around.up_m > -1.5)
        return np.where(is_near, _FILL_EDGE_M, np.inf)

    walls = refine_zone(walls, zone, edge_m)
    near = vertices_near(walls, zone)
    places = walls.before[near]
    around = zone.around(places)
    levels = level(around, places)
    is_under = (levels > places[:, 2]) & (ramp(around) > 0) & (around.up_m > -1.5)
    return Moved(walls, near[is_under], raise_to(places[is_under], levels[is_under]))


def raise_to(places: Float64Array, level: Float64Array) -> Float64Array:
    """Return places (N, 3) raised to a level (N,) above them, but for a thousandth of their distance below it.

    Covered walls become a thin sheet under the edge of the new surface, in the order in which they stood.
    """
    raised = places.copy()
    raised[:, 2] = level - _SQUEEZED * (level - places[:, 2])
    return raised
