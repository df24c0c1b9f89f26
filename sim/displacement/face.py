"""A face that advanced: the dead end of a drift moves on along its axis, between new walls of broken rock."""

from __future__ import annotations

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream
from scenarios.schema import SurfaceChange, Tunnel
from sim.displacement.deform import Moved
from sim.displacement.normals import vertex_normals
from sim.displacement.refine import TwinWalls, refine
from sim.displacement.zone import Zone
from sim.geometry.noise import noise_at
from sim.geometry.raycast import Caster

_BAND_M = 0.4  # of the old walls before the face that is drawn out into the new ones
_STEEP = -0.7  # the cosine between axis and normal of what is the face
_SEEN_M = 12.0  # from the node to the face
_AROUND_M = 2.5  # along the axis, in which the rock belongs to the face
_EDGE_M = 0.15
_SHELL_M = 1.0  # rock that must be left before the next drift
_PLAIN = ((0.06, 0.8),)  # roughness of the new walls of a tunnel that has none: standard deviation, length, metres
_LIMIT_SIGMA = 2.5
_FLOOR_NORMAL = 0.6
_OVERBREAK_SIGMA = 1.0  # by which the new walls lie outside the old section on average


def advance(walls: TwinWalls, zone: Zone, change: SurfaceChange, seed: int, tunnel: Tunnel) -> Moved:
    """Move the face on by `advance_m`; the new walls have the roughness of the tunnel, drawn anew.

    Args:
        walls: The walls.
        zone: Its sample is that of the blind node.
        change: The face.
        seed: Draws the new rock.
        tunnel: Says how rough rock is.

    Raises:
        ScenarioError: There is no face at the node, or another drift behind it.
    """
    assert change.advance_m is not None
    line, at = zone.line, zone.sample
    sign = -1.0 if at == line.node_samples[0] else 1.0
    axis = sign * np.append(line.headings[at], 0.0)
    node = line.points[at] + [0.0, 0.0, line.height_m[at] / 2]
    to_face_m = _distance(walls, node, axis, change, zone, change.advance_m)
    aside = np.array([-axis[1], axis[0], 0.0])

    def place(places: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return how far ahead of the node places (N, 3) lie, and which (N,) belong to this end of the drift."""
        away = places - node
        is_here = (np.abs(away @ aside) < 0.9 * line.width_m[at]) & (np.abs(away[:, 2]) < 0.9 * line.height_m[at])
        ahead_m = away @ axis
        return ahead_m, is_here & (np.abs(ahead_m - to_face_m) < _AROUND_M)

    corners = walls.before[walls.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ahead_m, is_here = place(corners.mean(axis=1))
    is_face = is_here & (normals @ axis < _STEEP * np.linalg.norm(normals, axis=1))
    if not is_face.any():
        raise ScenarioError(f"surface {change.name!r}: there is no face {zone.where}")
    start_m = float(np.percentile(ahead_m[is_face], 5)) - _BAND_M
    step_m = min(_EDGE_M, tunnel.resolution_m)

    def stretch(places: Float64Array) -> Float64Array:
        ahead_m, is_here = place(places)
        return np.where(is_here, np.clip((ahead_m - start_m) / _BAND_M, 0.0, 1.0), 0.0)

    # Finer along the axis alone at first: the band is cut before it is drawn out, and again afterwards.
    drawn = walls.moved(*_drawn_out(walls, stretch(walls.before), change.advance_m * axis))
    drawn = refine(drawn, lambda places: np.where(stretch(places) > 0, step_m, np.inf))
    share = stretch(drawn.before)
    chosen = np.flatnonzero(share > 0)
    places = drawn.before[chosen] + (change.advance_m * share[chosen])[:, None] * axis
    whole = drawn.after.copy()
    whole[chosen] = places
    ways = vertex_normals(whole, drawn.faces)[chosen]
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    rough = np.zeros(len(chosen))
    octaves = [(each.amplitude_m, each.length_m) for each in tunnel.roughness] or list(_PLAIN)
    for (sigma_m, length_m), key in zip(
        octaves, stream(seed, "surface", change.name, "face").integers(2**63, size=len(octaves)).tolist(), strict=True
    ):
        rough += sigma_m * np.clip(noise_at(places, length_m, key), -_LIMIT_SIGMA, _LIMIT_SIGMA)
    # Holes are drilled outwards: a new round never leaves rock inside the old section.
    rough = np.minimum(rough - _OVERBREAK_SIGMA * float(np.hypot.reduce([sigma_m for sigma_m, _ in octaves])), 0.0)
    rough *= np.where(ways[:, 2] > _FLOOR_NORMAL, tunnel.floor.roughness, 1.0) * np.minimum(4.0 * share[chosen], 1.0)
    before = TwinWalls(
        drawn.before, np.where((share > 0)[:, None], drawn.before, drawn.after), drawn.faces, drawn.owner
    )
    owner = np.where(share > 0, 0, before.owner)
    return Moved(TwinWalls(before.before, before.after, before.faces, owner), chosen, places + rough[:, None] * ways)


def _drawn_out(walls: TwinWalls, share: Float64Array, way: Float64Array) -> tuple[np.ndarray, Float64Array, int]:
    chosen = np.flatnonzero(share > 0)
    return chosen, walls.before[chosen] + share[chosen, None] * way, -1


def _distance(
    walls: TwinWalls, node: Float64Array, axis: Float64Array, change: SurfaceChange, zone: Zone, advance_m: float
) -> float:
    """Return the distance from the node to the face, and refuse a drift behind it."""
    caster = Caster([walls.mesh("before")])
    ranges_m, _, _ = caster.hits(node[None], axis)
    if not ranges_m[0] <= _SEEN_M:
        raise ScenarioError(f"surface {change.name!r}: there is no face within {_SEEN_M:g} m {zone.where}")
    aside = np.array([-axis[1], axis[0], 0.0])
    side, up = np.meshgrid([-0.4, 0.0, 0.4], [-0.4, 0.0, 0.4])
    behind = node + (float(ranges_m[0]) + 0.8) * axis
    origins = behind + zone.line.width_m[zone.sample] * side.reshape(-1, 1) * aside
    origins[:, 2] += zone.line.height_m[zone.sample] * up.ravel()
    ahead_m, _, normals = caster.hits(origins, axis)
    is_other = (normals @ axis > 0) & (ahead_m < advance_m + _SHELL_M)
    if is_other.any():
        raise ScenarioError(f"surface {change.name!r}: another drift is in the way of the face {zone.where}")
    return float(ranges_m[0])
