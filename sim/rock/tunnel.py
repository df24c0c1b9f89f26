"""The walls: one signed field for drifts and niches, meshed by marching cubes into one closed surface."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array
from scenarios.schema import Tunnel
from sim.geometry.mesh import Mesh, drop_flat_faces, drop_unused_vertices
from sim.geometry.rows import number_rows, unique_rows
from sim.rock.centreline import STEP_M, Centreline
from sim.rock.field import Field

_BLOCK_CELLS = 48
_MOST_VERTICES = 15_000_000  # as many as a foreign mesh may have
_MOST_CELLS = 500_000_000  # 10 km of a drift of 8 m by 6 m have 140 million of 0.15 m
_MOST_STONES = 500_000
_SMALL_PART = 0.02  # share of the largest piece's faces below which a piece is a bubble or a floating stone


def require_buildable(tunnel: Tunnel, centreline: Centreline) -> None:
    """Raise `ScenarioError` if the walls, or the stones on the floor, would be more than memory holds."""
    floor_m2 = rock_m2 = void_m3 = 0.0
    for line in centreline.drifts:
        length_m, width_m, height_m = len(line.points) * STEP_M, line.section.width_m, line.section.height_m
        floor_m2 += length_m * width_m
        void_m3 += length_m * width_m * height_m
        rock_m2 += 2 * (length_m * (width_m + height_m) + width_m * height_m)
    for niche in centreline.recesses:
        void_m3 += niche.width_m * niche.back_m * niche.height_m
        rock_m2 += 2 * niche.back_m * (niche.width_m + niche.height_m) + niche.width_m * niche.height_m
    finest_m = max((rock_m2 / _MOST_VERTICES) ** 0.5, (void_m3 / _MOST_CELLS) ** (1 / 3))
    if tunnel.mesh is None and tunnel.resolution_m < finest_m:
        raise ScenarioError(
            f"tunnel.resolution_m = {tunnel.resolution_m:g}: too fine for drifts of {rock_m2:.0f} m2 of rock and "
            f"{void_m3:.0f} m3 (nodes, section.width_m, section.height_m, niches): at least {finest_m * 1.01:.2g}"
        )
    stones = tunnel.floor.stones
    if stones is not None and stones.per_m2 * floor_m2 > _MOST_STONES:
        raise ScenarioError(
            f"tunnel.floor.stones.per_m2 = {stones.per_m2:g}: {stones.per_m2 * floor_m2:.2g} stones on {floor_m2:.2g} "
            f"m2 of floor: at most {_MOST_STONES / floor_m2:.2g}"
        )


def count_wall_faces(tunnel: Tunnel, centreline: Centreline) -> float:
    """Return about how many triangles the walls have, niches left out; 0 for a mesh of somebody else."""
    if tunnel.mesh is not None:
        return 0.0
    sizes = [(len(line.points) * STEP_M, line.section) for line in centreline.drifts]
    return sum(4 * metres * (each.width_m + each.height_m) for metres, each in sizes) / tunnel.resolution_m**2


def mesh_tunnel(tunnel: Tunnel, centreline: Centreline, seed: int) -> Mesh:
    """Return the closed wall mesh, facing into the void.

    Raises:
        ScenarioError: The resolution is too coarse for the section.
    """
    narrowest_m = min(min(line.section.width_m, line.section.height_m) for line in centreline.drifts)
    if tunnel.resolution_m > narrowest_m / 4:
        raise ScenarioError(
            f"tunnel.resolution_m = {tunnel.resolution_m:g}: too coarse for a drift {narrowest_m:g} m across; "
            f"at most {narrowest_m / 4:g}"
        )
    pieces = list(_block_meshes(tunnel, centreline, seed))
    keys = np.concatenate([piece[0] for piece in pieces])
    vertices = np.concatenate([piece[1] for piece in pieces])
    counts = np.cumsum([0] + [len(piece[0]) for piece in pieces])
    faces = np.concatenate([piece[2] + start for piece, start in zip(pieces, counts[:-1], strict=True)])
    _, first, inverse = np.unique(number_rows(keys), return_index=True, return_inverse=True)
    return _drop_small_parts(vertices[first], drop_flat_faces(inverse[faces]))


def _block_meshes(
    tunnel: Tunnel, centreline: Centreline, seed: int
) -> Iterator[tuple[Int64Array, Float64Array, Int64Array]]:
    """Yield (edge keys, vertices, faces) of each block of the grid that the surface passes through.

    A vertex of marching cubes lies on a grid edge. The edge's integer coordinates identify it, so that the vertices
    shared by two blocks are matched exactly.
    """
    cell_m = tunnel.resolution_m
    field = Field(tunnel, centreline, seed)
    for block in _blocks_near(centreline, field, cell_m):
        # One node of overlap on the high side; the planes between blocks belong to both.
        ix, iy = (np.arange(start, start + _BLOCK_CELLS + 1) for start in block * _BLOCK_CELLS)
        values, iz = field.evaluate(ix * cell_m, iy * cell_m)
        if values.size == 0 or not (values < 0).any():
            continue
        local, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
        offset = np.array([ix[0], iy[0], iz[0]])
        floor = np.floor(local).astype(np.int64)
        fraction = local - floor
        axis = np.argmax(fraction, axis=1)
        keys = np.concatenate([floor + offset, axis[:, None]], axis=1)
        is_inner = (fraction > 0).sum(axis=1) > 1  # the one extra vertex that Lewiner's cases may put in a cell
        keys[is_inner, 3] = 3
        yield keys, (local.astype(np.float64) + offset) * cell_m, faces.astype(np.int64)


def _blocks_near(centreline: Centreline, field: Field, cell_m: float) -> Int64Array:
    """Grid blocks (B, 2) that a drift's void and margin may reach, in a fixed order."""
    size_m = _BLOCK_CELLS * cell_m
    found = []
    for line, frame in zip(centreline.drifts, field.frames, strict=True):
        reach = int(np.ceil(frame.reach_m / size_m))
        home = unique_rows(np.floor(line.points[:, :2] / size_m).astype(np.int64))
        shifts = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        found.append((home[:, None] + shifts).reshape(-1, 2))
    return unique_rows(np.concatenate(found))


def _drop_small_parts(vertices: Float64Array, faces: Int64Array) -> Mesh:
    """Drop bubbles in the rock and stones hanging in the air, and the vertices only they use."""
    links = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(len(vertices),) * 2)
    _, part_of_vertex = connected_components(graph, directed=False)
    part = part_of_vertex[faces[:, 0]]
    sizes = np.bincount(part)
    return drop_unused_vertices(vertices, faces[sizes[part] > _SMALL_PART * sizes.max()])
