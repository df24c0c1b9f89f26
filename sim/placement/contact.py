"""Penetration of a standing prop into rock or another prop, measured on the true surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, transform
from cdpipe.core.geometry.voxel import thin
from sim.geometry.mesh import Mesh, join_meshes, move_mesh, split_triangles
from sim.geometry.raycast import Caster
from sim.placement.placing import Standing, standing_points
from sim.props.shapes import Shape, shape_mesh, solid_mesh

_STEP_M = 0.06  # between the sample points of a surface
_CELL_M = 0.03  # one sample point per cell is kept
_TELLTALES = np.array([[0.1, 0.2, 1], [0.9, 0.3, 0.5], [-0.7, 0.6, 0.4], [0.2, -0.9, 0.3], [-0.4, -0.5, 0.8]])


@lru_cache(maxsize=32)
def surface_points(shape: Shape) -> Float64Array:
    """Return points (N, 3) on a prop's surface, object frame: its corners (to 1 cm) and others at most 6 cm apart."""
    mesh = shape_mesh(shape)
    pieces = split_triangles(mesh.vertices[mesh.faces], _STEP_M).reshape(-1, 3)
    return np.concatenate([thin(mesh.vertices, _CELL_M / 3), thin(pieces, _CELL_M)])


def interpenetration_m(standing: Standing, walls: Caster, others: Sequence[Standing] = ()) -> float:
    """Return the largest depth of a prop's surface in the rock, in another prop, or of another prop's surface in it.

    Piles and railings are set into floor and wall on purpose; for them only the depth in other props counts.

    Args:
        standing: The prop.
        walls: Ray caster of the tunnel's true surface.
        others: Props that stand there at the same time.
    """
    deepest = 0.0
    if standing.shape.is_settled:
        deepest = float(find_way_out(_points(standing), walls)[0].max(initial=0.0))
    own = standing_points(standing)
    low, high = own.min(axis=0), own.max(axis=0)
    for other in others:
        theirs = standing_points(other)
        if (theirs.min(axis=0) > high).any() or (theirs.max(axis=0) < low).any():
            continue
        for inner, outer in ((standing, other), (other, standing)):
            depth_m, _ = find_way_out(_points(inner), Caster([standing_surface(outer)]), is_solid_inside=True)
            deepest = max(deepest, float(depth_m.max(initial=0.0)))
    return deepest


def _points(standing: Standing) -> Float64Array:
    return transform(standing.world_T_object, surface_points(standing.shape))


def standing_surface(standing: Standing) -> Mesh:
    """Return all of a standing prop's surface as one mesh, world frame."""
    return join_meshes([move_mesh(solid_mesh(solid), standing.world_T_object) for solid in standing.shape.solids])


def find_way_out(
    points: Float64Array, caster: Caster, is_solid_inside: bool = False
) -> tuple[Float64Array, Float64Array]:
    """Return how deep points (N, 3) are inside the solid, 0 outside, and the direction (N, 3) of the shortest way out.

    A point is in the rock when most rays from it meet no surface that faces them, and in a closed solid when most
    meet one from behind. The depth is the shortest of 92 rays to a surface seen from behind, at most 4 % too long.
    """
    depth_m, direction = np.zeros(len(points)), np.zeros((len(points), 3))
    inside = np.flatnonzero(_is_inside(points, caster, is_solid_inside))
    if len(inside) == 0:
        return depth_m, direction
    rays = _directions()
    origins = np.repeat(points[inside], len(rays), axis=0)
    directions = np.tile(rays, (len(inside), 1))
    ranges_m, _, normals = caster.hits(origins, directions)
    ranges_m = np.where((normals * directions).sum(axis=1) > 0, ranges_m, np.inf).reshape(len(inside), -1)
    best = ranges_m.argmin(axis=1)
    depth_m[inside] = ranges_m[np.arange(len(inside)), best]
    direction[inside] = rays[best]
    return depth_m, direction


def _is_inside(points: Float64Array, caster: Caster, is_solid_inside: bool) -> BoolArray:
    tells = _TELLTALES / np.linalg.norm(_TELLTALES, axis=1, keepdims=True)
    majority = len(tells) // 2 + 1
    votes = _count_votes(points, tells[:majority], caster, is_solid_inside)
    # Where these agree, the others change nothing; that is nearly everywhere.
    unsure = np.flatnonzero((votes > 0) & (votes < majority))
    if len(unsure):
        votes[unsure] += _count_votes(points[unsure], tells[majority:], caster, is_solid_inside)
    return np.asarray(votes >= majority)


def _count_votes(points: Float64Array, tells: Float64Array, caster: Caster, is_solid_inside: bool) -> Int64Array:
    """Return how many of the rays (K, 3) from each point (N, 3) tell that it is inside."""
    directions = np.repeat(tells, len(points), axis=0)
    _, _, normals = caster.hits(np.tile(points, (len(tells), 1)), directions)
    facing = (normals * directions).sum(axis=1).reshape(len(tells), -1)
    return np.asarray((facing > 0 if is_solid_inside else facing >= 0).sum(axis=0))


def _directions() -> Float64Array:
    """Return 92 unit vectors: 86 spread evenly over the sphere (a Fibonacci lattice), and the six axes."""
    number = np.arange(86) + 0.5
    z = 1.0 - 2.0 * number / 86
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    spread = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    return np.concatenate([spread, np.eye(3), -np.eye(3)])
