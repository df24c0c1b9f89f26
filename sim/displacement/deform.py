"""Convergence, heave and shotcrete: rock that keeps its place in the mesh and comes into the void."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array, stream
from scenarios.schema import SurfaceChange
from sim.displacement.normals import smooth_normals, weights_within
from sim.displacement.refine import TwinWalls, refine
from sim.displacement.zone import Around, Zone, sector_offset, window
from sim.geometry.noise import noise_at

BODY_M = 1.0  # normals are smoothed over this diameter: roughness moves as a body
_SKIN_M = 0.5
_STEPS = 12  # triangles across a window
_FINEST_M = 0.05
_EDGE_M = 0.06  # over which the thickness of shotcrete runs out
_WAVY_M, _WAVY_LENGTH_M = 0.08, 0.6  # of its edge
_UNEVEN, _UNEVEN_LENGTH_M = 0.15, 0.5  # share of the thickness
_LEVELLED_M = 0.3  # shotcrete fills what is rougher than this
_LEAST = 0.4  # of its thickness, on the tips of the rock


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """What a change did to the walls.

    Attributes:
        walls: The walls, refined but not yet moved.
        vertices: (V,) those that move.
        places: (V, 3) where they are in the after session.
    """

    walls: TwinWalls
    vertices: Int64Array
    places: Float64Array


def vertices_near(walls: TwinWalls, zone: Zone) -> Int64Array:
    """Return the vertices (V,) within reach of a zone."""
    return np.flatnonzero(((walls.before - zone.middle) ** 2).sum(axis=1) < zone.reach_m**2)


def refine_zone(walls: TwinWalls, zone: Zone, edge_m: Callable[[Around, Float64Array], Float64Array]) -> TwinWalls:
    """Refine walls where a function of the places (K, 3) in a zone asks for edges (K,) so long at most."""

    def limit_m(places: Float64Array) -> Float64Array:
        limits = np.full(len(places), np.inf)
        near = np.flatnonzero(((places - zone.middle) ** 2).sum(axis=1) < zone.reach_m**2)
        if len(near):
            around = zone.around(places[near])
            limits[near] = np.where(around.share > 0, edge_m(around, places[near]), np.inf)
        return limits

    return refine(walls, limit_m)


def converge(walls: TwinWalls, zone: Zone, change: SurfaceChange, seed: int) -> Moved:
    """Move rock into the void along its smoothed normals by `depth_m` times a smooth window."""
    return _move_smoothly(walls, zone, change, None)


def heave(walls: TwinWalls, zone: Zone, change: SurfaceChange, seed: int) -> Moved:
    """Lift the floor by `depth_m` times a smooth window."""
    return _move_smoothly(walls, zone, change, np.array([0.0, 0.0, 1.0]))


def _move_smoothly(walls: TwinWalls, zone: Zone, change: SurfaceChange, way: Float64Array | None) -> Moved:
    assert change.depth_m is not None and change.sector_deg is not None
    arc_m = np.deg2rad(change.sector_deg[1] - change.sector_deg[0]) * radius_m(zone)
    step_m = max(_FINEST_M, min(zone.length_m, arc_m) / _STEPS)

    def weight(around: Around) -> Float64Array:
        assert change.sector_deg is not None
        over = window(sector_offset(around.angle_deg, change.sector_deg))
        return np.asarray(window(around.along_m / (zone.length_m / 2)) * over * around.share)

    walls = refine_zone(walls, zone, lambda around, _: np.where(weight(around) > 0, step_m, np.inf))
    near = vertices_near(walls, zone)
    weights = weight(zone.around(walls.before[near]))
    chosen, weights = near[weights > 0], weights[weights > 0]
    ways = way if way is not None else smooth_normals(walls, chosen, BODY_M) if len(chosen) else np.zeros(3)
    return Moved(walls, chosen, walls.before[chosen] + change.depth_m * weights[:, None] * ways)


def spray(walls: TwinWalls, zone: Zone, change: SurfaceChange, seed: int) -> Moved:
    """Put a layer of shotcrete on the rock, which fills hollows and ends in an edge of 6 cm."""
    assert change.thickness_m is not None and change.sector_deg is not None
    sector_deg, thickness_m, reach_m = change.sector_deg, change.thickness_m, radius_m(zone)
    edge_key, uneven_key = stream(seed, "surface", change.name, "shotcrete").integers(2**63, size=2).tolist()

    def inside_m(around: Around, places: Float64Array) -> Float64Array:
        along_m = zone.length_m / 2 - np.abs(around.along_m)
        half_deg = (sector_deg[1] - sector_deg[0]) / 2
        over_m = np.deg2rad(half_deg) * (1.0 - np.abs(sector_offset(around.angle_deg, sector_deg))) * reach_m
        deep_m = np.minimum(along_m, over_m) if half_deg < 180 else along_m
        close = np.flatnonzero(np.abs(deep_m) < 4 * _WAVY_M)  # elsewhere the edge is out of reach
        deep_m[close] += _WAVY_M * np.clip(noise_at(places[close], _WAVY_LENGTH_M, edge_key), -2, 2)
        return deep_m

    walls = refine_zone(
        walls, zone, lambda around, places: np.where(np.abs(inside_m(around, places) - 0.03) < 0.1, _FINEST_M, np.inf)
    )
    near = vertices_near(walls, zone)
    around = zone.around(walls.before[near])
    weights = np.clip(inside_m(around, walls.before[near]) / _EDGE_M, 0.0, 1.0) * around.share
    chosen, weights = near[weights > 0], weights[weights > 0]
    if not len(chosen):
        return Moved(walls, chosen, walls.before[chosen])
    ways = smooth_normals(walls, chosen, _SKIN_M)
    places = walls.before[chosen]
    links = weights_within(places, places, _LEVELLED_M / 2)
    middle = (links @ places) / np.asarray(links.sum(axis=1))[:, None]
    filled_m = ((middle - places) * ways).sum(axis=1)
    uneven = 1.0 + _UNEVEN * np.clip(noise_at(places, _UNEVEN_LENGTH_M, uneven_key), -2, 2)
    layer_m = np.maximum(thickness_m * uneven + np.clip(filled_m, -thickness_m, thickness_m), _LEAST * thickness_m)
    return Moved(walls, chosen, places + (weights * layer_m)[:, None] * ways)


def radius_m(zone: Zone) -> float:
    """Return the mean distance of a zone's rock from the axis, by which angles become lengths."""
    return float(zone.line.width_m[zone.sample] + zone.line.height_m[zone.sample]) / 4
