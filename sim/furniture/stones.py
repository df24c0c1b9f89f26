"""Loose stones on the floor of every drift, partly buried, denser near the walls.

The draws of a stone depend on its cell alone, so a prop that displaces some stones changes no others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from scenarios.schema import Stones, Tunnel
from sim.furniture.furniture import Fixture
from sim.geometry.mesh import Mesh, join_meshes
from sim.geometry.noise import lattice_values
from sim.geometry.raycast import Caster
from sim.geometry.rows import unique_rows
from sim.geometry.sweep import repeat_body
from sim.props.rocks import passing_share, rock_mesh
from sim.rock.axis import UP, Axis, find_nearest, measure_axes, wall_distances
from sim.rock.centreline import Centreline

SMALLEST_SHARE = 1 / 3  # of the characteristic size; smaller ones are part of the floor
_CELL_M = 0.5
_N_SHAPES = 24
_AT_MIDDLE, _AT_WALL = 0.6, 1.8  # density against the mean; grows with the square of the way to the wall
_DRAWS = ("x", "y", "is-there", "stays", "size", "shape", "yaw", "roll", "pitch", "depth")


@dataclass(frozen=True, slots=True, eq=False)
class _Spots:
    """Places for stones.

    Attributes:
        cell: (N, 3) cell of the grid, and slot in it.
        floor: (N, 3) point on the floor, world frame, metres.
        eye_z: (N,) height from which the floor was looked for.
        from_axis_m: (N,) distance from the axis of the drift.
    """

    cell: Int64Array
    floor: Float64Array
    eye_z: Float64Array
    from_axis_m: Float64Array

    def part(self, chosen: BoolArray | Int64Array) -> _Spots:
        return _Spots(self.cell[chosen], self.floor[chosen], self.eye_z[chosen], self.from_axis_m[chosen])


def strew_stones(
    tunnel: Tunnel, centreline: Centreline, walls: Caster, outlines: Sequence[Float64Array], seed: int
) -> Fixture | None:
    """Return the stones of all drifts as one fixture, or None where there are none.

    Args:
        tunnel: The tunnel with its `floor.stones`; a stone's size is the largest distance between two of its corners.
        centreline: Its drifts.
        walls: Caster of the bare rock, facing into the void.
        outlines: (K, 2) polygons, world frame, metres, that no stone may touch.
        seed: Seed of all draws.
    """
    stones = tunnel.floor.stones
    if stones is None or stones.per_m2 == 0 or not centreline.drifts:
        return None
    draws = stream(seed, "furniture", "stones").integers(2**63, size=len(_DRAWS)).tolist()
    keys = dict(zip(_DRAWS, draws, strict=True))
    niche_m = max((niche.depth_m for niche in tunnel.niches), default=0.0)
    found = [_spots_of(axis, stones, niche_m, keys) for axis in measure_axes(centreline, walls)]
    if not found:
        return None
    spots = _drop_repeats(found)
    size_m = draw_stone_sizes(_uniform(spots.cell, keys["size"]), stones)
    keep = ~_touches_any(spots.floor[:, :2], size_m / 2, outlines)
    if not keep.any():
        return None
    return Fixture("stones", "rock", _lay_stones(spots.part(keep), size_m[keep], walls, keys, seed))


def draw_stone_sizes(uniform: Float64Array, stones: Stones) -> Float64Array:
    """Return stone sizes (N,) from uniform numbers (N,): Rosin-Rammler between a third of `size_m` and `max_size_m`."""
    smallest_m = min(SMALLEST_SHARE * stones.size_m, 0.5 * stones.max_size_m)
    grid_m = np.geomspace(smallest_m, stones.max_size_m, 512)
    passing = passing_share(grid_m, stones.size_m)
    return np.asarray(np.interp(passing[0] + uniform * (passing[-1] - passing[0]), passing, grid_m))


def _spots_of(axis: Axis, stones: Stones, niche_m: float, keys: dict[str, int]) -> _Spots:
    """Return the places of stones in one drift, those inside outlines included."""
    stations = axis.points[axis.is_inside]
    reach_m = 0.75 * axis.section.width_m + niche_m + 1.0
    reach = int(np.ceil(reach_m / _CELL_M))
    around = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    home = unique_rows(np.floor(stations[:, :2] / _CELL_M).astype(np.int64))
    cells = unique_rows((home[:, None] + around).reshape(-1, 2))
    expected = _AT_WALL * stones.per_m2 * _CELL_M**2
    n_slots = int(np.ceil(2 * expected))
    slots = np.tile(np.arange(n_slots), len(cells))
    cell = np.column_stack([np.repeat(cells, n_slots, axis=0), slots])
    cell = cell[_uniform(cell, keys["is-there"]) < expected / n_slots]
    xy = _CELL_M * (cell[:, :2] + np.stack([_uniform(cell, keys["x"]), _uniform(cell, keys["y"])], axis=1))
    from_axis_m, nearest = find_nearest(stations[:, :2], xy, reach_m)
    near = np.isfinite(from_axis_m)
    cell, xy, from_axis_m, nearest = cell[near], xy[near], from_axis_m[near], nearest[near]
    eye = stations[nearest] + 0.5 * axis.height_m[axis.is_inside][nearest][:, None] * UP
    towards = np.column_stack([xy - eye[:, :2], np.zeros(len(xy))]) / np.maximum(from_axis_m, 1e-9)[:, None]
    share = from_axis_m / wall_distances(axis.walls, eye, towards)
    wanted = _AT_MIDDLE + 3 * (1 - _AT_MIDDLE) * share**2
    stays = (share < 1.0) & (_uniform(cell, keys["stays"]) < wanted / _AT_WALL)
    above = np.column_stack([xy, eye[:, 2]])[stays]
    ranges_m, _, normals = axis.walls.hits(above, -UP)
    floor = above - np.where(np.isfinite(ranges_m), ranges_m, 0.0)[:, None] * UP
    level = np.abs(floor[:, 2] - stations[nearest[stays], 2]) < 0.8
    is_floor = np.isfinite(ranges_m) & (normals[:, 2] > 0.5) & level
    return _Spots(cell[stays], floor, above[:, 2], from_axis_m[stays]).part(is_floor)


def _drop_repeats(found: Sequence[_Spots]) -> _Spots:
    """Join the drifts' spots; a cell that two drifts share on one level counts for the nearer of them."""
    names = ("cell", "floor", "eye_z", "from_axis_m")
    spots = _Spots(*(np.concatenate([getattr(each, name) for each in found]) for name in names))
    spots = spots.part(np.lexsort((spots.from_axis_m, *spots.cell.T)))
    is_repeat = np.zeros(len(spots.cell), dtype=bool)
    for back in range(1, len(found)):
        is_level = np.abs(spots.floor[back:, 2] - spots.floor[:-back, 2]) < 1.0
        is_repeat[back:] |= (spots.cell[back:] == spots.cell[:-back]).all(axis=1) & is_level
    return spots.part(~is_repeat)


def _lay_stones(spots: _Spots, size_m: Float64Array, walls: Caster, keys: dict[str, int], seed: int) -> Mesh:
    """Turn, scale and bury one of a few shapes at every spot."""
    shapes = _shapes(seed)
    shape = (_uniform(spots.cell, keys["shape"]) * _N_SHAPES).astype(np.int64)
    # A fragment at rest lies roughly on its flat side.
    tilts = [np.deg2rad(50.0) * (_uniform(spots.cell, keys[name]) - 0.5) for name in ("roll", "pitch")]
    angles = np.stack([2 * np.pi * _uniform(spots.cell, keys["yaw"]), *tilts], axis=1)
    turns = Rotation.from_euler("ZXY", angles).as_matrix()
    depth_share = 0.1 + 0.3 * _uniform(spots.cell, keys["depth"])
    lowest_z = _lowest_floor(spots, size_m, walls)
    parts = []
    for number, mesh in enumerate(shapes):
        chosen = np.flatnonzero(shape == number)
        vertices = np.einsum("nij,vj->nvi", turns[chosen], mesh.vertices) * size_m[chosen, None, None]
        bottom, height_m = vertices[..., 2].min(axis=1), np.ptp(vertices[..., 2], axis=1)
        # On uneven floor a stone sinks until no edge floats, but at least 30 % of its height stays visible.
        sunk_m = np.minimum(spots.floor[chosen, 2] - lowest_z[chosen] + depth_share[chosen] * height_m, 0.7 * height_m)
        vertices += spots.floor[chosen, None]
        vertices[..., 2] -= (bottom + sunk_m)[:, None]
        parts.append(repeat_body(vertices, mesh.faces))
    return join_meshes(parts)


def _lowest_floor(spots: _Spots, size_m: Float64Array, walls: Caster) -> Float64Array:
    """Return the lowest height (N,) of the floor below the middle and four edges of each stone."""
    sides = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    above = np.column_stack([spots.floor[:, :2], spots.eye_z])[:, None].repeat(4, axis=1)
    above[..., :2] += 0.4 * size_m[:, None, None] * sides
    flat = above.reshape(-1, 3)
    floor_z = (flat[:, 2] - wall_distances(walls, flat, -UP)).reshape(-1, 4)
    # Near a wall a ray may start in the rock; its hit is not the floor.
    floor_z = np.where(np.abs(floor_z - spots.floor[:, 2:]) < size_m[:, None], floor_z, spots.floor[:, 2:])
    return np.asarray(np.minimum(floor_z.min(axis=1), spots.floor[:, 2]))


def _shapes(seed: int) -> list[Mesh]:
    """Return fragments whose largest diameter is 1, flatter than long."""
    generator = stream(seed, "furniture", "stones", "shapes")
    shapes = []
    for key in generator.integers(2**31, size=_N_SHAPES).tolist():
        mesh = rock_mesh((1.0, float(generator.uniform(0.6, 0.95)), float(generator.uniform(0.4, 0.75))), key)
        shapes.append(Mesh(mesh.vertices / pdist(mesh.vertices).max(), mesh.faces))
    return shapes


def _touches_any(xy: Float64Array, radius_m: Float64Array, outlines: Sequence[Float64Array]) -> BoolArray:
    """Mark the discs (N,) that lie in a polygon or reach its edge."""
    touches = np.zeros(len(xy), dtype=bool)
    for outline in outlines:
        start, end = outline, np.roll(outline, -1, axis=0)
        edge = end - start
        away = xy[:, None] - start
        share = np.clip((away * edge).sum(axis=2) / np.maximum((edge**2).sum(axis=1), 1e-12), 0.0, 1.0)
        distance_m = np.linalg.norm(away - share[..., None] * edge, axis=2).min(axis=1)
        crosses = (start[:, 1] > xy[:, None, 1]) != (end[:, 1] > xy[:, None, 1])
        rise = np.where(edge[:, 1] == 0, 1.0, edge[:, 1])
        is_left = away[..., 0] < edge[:, 0] * away[..., 1] / rise
        touches |= (distance_m <= radius_m) | ((crosses & is_left).sum(axis=1) % 2 == 1)
    return touches


def _uniform(cell: Int64Array, key: int) -> Float64Array:
    """Return one number (N,) between 0 and 1 for each cell and slot (N, 3)."""
    return np.asarray(np.clip(lattice_values(list(cell.T), key) / np.sqrt(12.0) + 0.5, 0.0, 1.0 - 1e-12))
