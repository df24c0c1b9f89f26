"""The walls: one signed distance field for all drifts, meshed by marching cubes into one closed surface.

The field is negative in the void and positive in rock: the smallest of the drifts' section functions, each in the frame
of its nearest centreline sample, plus smooth noise. Junctions need no special care, and no face lies inside the void.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from cdpipe.errors import ScenarioError
from cdpipe.geometry import BoolArray, Float32Array, Float64Array, Int64Array, stream
from scenarios.schema import Section, Tunnel
from sim.centreline import Centreline, DriftLine
from sim.mesh import Mesh
from sim.noise import smooth_noise

_BLOCK_CELLS = 48
_NOISE_LIMIT_SIGMA = 4.0
_SMALL_PART = 0.02  # share of the largest piece's faces below which a piece is a bubble or a floating stone


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
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    has_area = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return _without_small_parts(vertices[first], faces[has_area])


def section_distance(section: Section, across_m: Float64Array, up_m: Float64Array) -> Float64Array:
    """Distance to walls and roof (not the floor): negative inside, exact on the surface.

    Args:
        section: Horseshoe (upright walls under an elliptic arch) or rectangle.
        across_m: Distance from the centreline in the x-y plane.
        up_m: Height above the floor, broadcastable against `across_m`.
    """
    half_m = section.width_m / 2
    if section.shape == "rectangle":
        return np.maximum(across_m - half_m, up_m - section.height_m)
    spring_m = max(section.height_m - half_m, 0.35 * section.height_m)
    arch_m = section.height_m - spring_m
    above_m = np.maximum(up_m - spring_m, 0.0)
    level = np.sqrt((across_m / half_m) ** 2 + (above_m / arch_m) ** 2)
    steepness = np.sqrt((across_m / half_m**2) ** 2 + (above_m / arch_m**2) ** 2)
    return np.where(above_m > 0, (level - 1.0) * level / np.maximum(steepness, 1e-9), across_m - half_m)


def _block_meshes(
    tunnel: Tunnel, centreline: Centreline, seed: int
) -> Iterator[tuple[Int64Array, Float64Array, Int64Array]]:
    """Yield (edge keys, vertices, faces) of each block of the grid that the surface passes through.

    A vertex of marching cubes lies on a grid edge; the edge's integer coordinates name it, so that the vertices two
    blocks share are found exactly.
    """
    cell_m = tunnel.resolution_m
    sigma_m = float(np.sqrt(sum(octave.amplitude_m**2 for octave in tunnel.roughness)))
    margin_m = _NOISE_LIMIT_SIGMA * sigma_m + 3 * cell_m
    trees = [cKDTree(line.points[:, :2]) for line in centreline.drifts]
    for block in _blocks_near(centreline, margin_m, cell_m):
        # One node of overlap on the high side; the planes between blocks belong to both.
        ix, iy = (np.arange(start, start + _BLOCK_CELLS + 1) for start in block * _BLOCK_CELLS)
        field = _Field(tunnel, centreline, trees, margin_m, sigma_m, seed)
        values, iz = field.evaluate(ix * cell_m, iy * cell_m, cell_m)
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


def _blocks_near(centreline: Centreline, margin_m: float, cell_m: float) -> Int64Array:
    """Grid blocks (B, 2) that a drift's void and margin may reach, in a fixed order."""
    size_m = _BLOCK_CELLS * cell_m
    found = []
    for line in centreline.drifts:
        reach = int(np.ceil((line.section.width_m / 2 + margin_m) / size_m))
        home = np.unique(np.floor(line.points[:, :2] / size_m).astype(np.int64), axis=0)
        shifts = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        found.append((home[:, None] + shifts).reshape(-1, 2))
    return np.unique(np.concatenate(found), axis=0)


class _Field:
    """The signed distance field, evaluated block by block."""

    def __init__(
        self,
        tunnel: Tunnel,
        centreline: Centreline,
        trees: Sequence[cKDTree],
        margin_m: float,
        sigma_m: float,
        seed: int,
    ) -> None:
        self._tunnel = tunnel
        self._drifts = list(zip(centreline.drifts, trees, strict=True))
        self._margin_m = margin_m
        self._limit_m = _NOISE_LIMIT_SIGMA * sigma_m
        self._keys = stream(seed, "tunnel", "roughness").integers(2**63, size=(len(tunnel.roughness), 2)).tolist()

    def evaluate(self, x_m: Float64Array, y_m: Float64Array, cell_m: float) -> tuple[Float32Array, Int64Array]:
        """Return the field (len(x), len(y), K) and the K grid heights it was taken at, in cells."""
        columns = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
        near = [frame for line, tree in self._drifts if (frame := self._frame(line, tree, columns)) is not None]
        if not near:
            return np.empty((0, 0, 0), np.float32), np.empty(0, np.int64)
        low_m = min(frame.floor_m[frame.is_near].min() for frame in near)
        high_m = max((frame.floor_m[frame.is_near] + frame.line.section.height_m).max() for frame in near)
        iz = np.arange(np.floor((low_m - self._margin_m) / cell_m), np.ceil((high_m + self._margin_m) / cell_m) + 1)
        z_m = iz * cell_m
        shape = (len(x_m), len(y_m), len(z_m))
        wall_noise, floor_noise = self._noise(x_m, y_m, z_m)
        field = np.full(shape, self._margin_m)
        for frame in near:
            up_m = z_m[None, :] - frame.floor_m[:, None]
            wall_m = section_distance(frame.line.section, frame.across_m[:, None], up_m)
            wall_m = np.maximum(wall_m, frame.beyond_m[:, None]).reshape(shape) + wall_noise
            floor_m = floor_noise[:, :, None] - up_m.reshape(shape)
            rock_m = np.maximum(wall_m, floor_m)
            rock_m[~frame.is_near.reshape(shape[:2])] = self._margin_m
            np.minimum(field, rock_m, out=field)
        # A zero on a grid node would put one vertex on several edges.
        smallest_m = 1e-3 * cell_m
        field = np.clip(field, -2 * cell_m, 2 * cell_m)
        field[np.abs(field) < smallest_m] = smallest_m
        return field.astype(np.float32), iz.astype(np.int64)

    def _frame(self, line: DriftLine, tree: cKDTree, columns: Float64Array) -> _Frame | None:
        """Place of each (x, y) column in the frame of a drift, or None if the drift is far from all of them."""
        reach_m = line.section.width_m / 2 + self._margin_m
        distance_m, nearest = tree.query(columns, distance_upper_bound=reach_m)
        is_near = np.isfinite(distance_m)
        if not is_near.any():
            return None
        nearest = np.where(is_near, nearest, 0)
        delta = columns - line.points[nearest, :2]
        heading = line.headings[nearest]
        along_m = (delta * heading).sum(axis=1)
        floor_m = line.points[nearest, 2] + line.slopes[nearest] * along_m
        across_m = np.where(is_near, distance_m, reach_m)
        beyond_m = np.full(len(columns), -np.inf)
        for blind, end, sign in zip(line.is_blind, (0, len(line.points) - 1), (-1.0, 1.0), strict=True):
            at_end = is_near & (nearest == end)
            if blind:
                side_m = np.abs(delta[:, 1] * heading[:, 0] - delta[:, 0] * heading[:, 1])
                across_m = np.where(at_end, side_m, across_m)
                beyond_m = np.where(at_end, sign * along_m, beyond_m)
        return _Frame(line, is_near, across_m, beyond_m, floor_m)

    def _noise(self, x_m: Float64Array, y_m: Float64Array, z_m: Float64Array) -> tuple[Float64Array, Float64Array]:
        wall = np.zeros((len(x_m), len(y_m), len(z_m)))
        floor = np.zeros((len(x_m), len(y_m)))
        for octave, (wall_key, floor_key) in zip(self._tunnel.roughness, self._keys, strict=True):
            if octave.amplitude_m > 0:
                wall += octave.amplitude_m * smooth_noise((x_m, y_m, z_m), octave.length_m, wall_key)
                floor += octave.amplitude_m * smooth_noise((x_m, y_m), octave.length_m, floor_key)
        limit = self._limit_m
        return np.clip(wall, -limit, limit), self._tunnel.floor_roughness * np.clip(floor, -limit, limit)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    line: DriftLine
    is_near: BoolArray
    across_m: Float64Array
    beyond_m: Float64Array
    floor_m: Float64Array


def _without_small_parts(vertices: Float64Array, faces: Int64Array) -> Mesh:
    """Drop bubbles in the rock and stones hanging in the air, and the vertices only they use."""
    links = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(len(vertices),) * 2)
    _, part_of_vertex = connected_components(graph, directed=False)
    part = part_of_vertex[faces[:, 0]]
    sizes = np.bincount(part)
    faces = faces[sizes[part] > _SMALL_PART * sizes.max()]
    used: npt.NDArray[np.int64] = np.unique(faces)
    renumber = np.zeros(len(vertices), np.int32)
    renumber[used] = np.arange(len(used), dtype=np.int32)
    return Mesh(vertices[used], renumber[faces])
