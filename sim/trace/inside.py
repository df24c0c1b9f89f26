"""The inside of a surface as a grid of cells, by rays along the three axes that vote.

A ray that comes to the front of a wall leaves the void, one that comes to its back enters it. Between an entry and the
next exit a ray says inside, between an exit and the next entry outside; where a wall is missing it says nothing. A cell
is inside where more of its three rays say inside than outside (after Nooruddin and Turk 2003, simplification and repair
of polygonal models using volumetric techniques). So holes, open ends and a missing roof are bridged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster

Votes = npt.NDArray[np.int8]
_STEP_M = 1e-3  # behind a hit, where the ray goes on
_MOST_HITS = 400  # of one ray
# Columns of rays lie off the middle of their cells, so that they miss the edges of surfaces drawn on a grid.
_ASKEW = np.array([0.0137, 0.0071, -0.0113])


@dataclass(frozen=True, slots=True, eq=False)
class Void:
    """The inside of a surface.

    Attributes:
        is_inside: (X, Y, Z) cells.
        low_m: (3,) middle of the first cell, world frame.
        cell_m: Edge of a cell.
    """

    is_inside: BoolArray
    low_m: Float64Array
    cell_m: float

    def holds(self, points: Float64Array) -> BoolArray:
        """Mark the points (N, 3) whose cell is inside."""
        cells = np.rint((points - self.low_m) / self.cell_m).astype(np.int64)
        within = ((cells >= 0) & (cells < self.is_inside.shape)).all(axis=1)
        held = np.zeros(len(points), dtype=bool)
        held[within] = self.is_inside[tuple(cells[within].T)]
        return held


def count_cells(mesh: Mesh, cell_m: float) -> float:
    """Return how many cells the grid about a surface has."""
    return float(np.prod(np.ptp(mesh.vertices, axis=0) / cell_m + 5))


def find_inside(mesh: Mesh, caster: Caster, cell_m: float) -> Void:
    """Return the inside of a surface that faces its void; it may be open."""
    low_m = mesh.vertices.min(axis=0) - 2 * cell_m + _ASKEW * cell_m
    shape = np.ceil(np.ptp(mesh.vertices, axis=0) / cell_m).astype(np.int64) + 5
    votes = np.zeros(shape, dtype=np.int8)
    for axis in range(3):
        along = np.moveaxis(votes, axis, -1)  # a view
        along += _votes_along(caster, low_m, shape, axis, cell_m)
    # The majority of 27 cells: single cells are the noise of the surface.
    share = ndimage.uniform_filter((votes > 0).astype(np.float32), 3, mode="constant")
    return Void(ndimage.binary_fill_holes(share > 0.5), low_m, cell_m)


def _votes_along(caster: Caster, low_m: Float64Array, shape: Int64Array, axis: int, cell_m: float) -> Votes:
    """Return what the rays along one axis say of each cell, that axis last: 1 inside, -1 outside, 0 nothing."""
    across = [other for other in range(3) if other != axis]
    columns = np.stack(np.meshgrid(*(np.arange(shape[other]) for other in across), indexing="ij"), axis=-1)
    starts = np.empty((columns[..., 0].size, 3))
    starts[:, across] = low_m[across] + columns.reshape(-1, 2) * cell_m
    starts[:, axis] = low_m[axis] - cell_m
    ray, at_m, is_entry = _all_hits(caster, starts, axis)
    # The cells between two hits of one ray begin at the first cell behind the former.
    first = np.clip(np.ceil((at_m - low_m[axis]) / cell_m), 0, shape[axis]).astype(np.int64)
    steps = np.zeros((len(starts), int(shape[axis]) + 1), dtype=np.int8)
    is_last = np.append(ray[1:] != ray[:-1], True)
    is_first = np.append(True, ray[1:] != ray[:-1])[: len(ray)]
    follows = np.flatnonzero(~is_last[: len(ray)])
    before, after = is_entry[follows], is_entry[follows + 1]
    said = np.where(before & ~after, 1, np.where(~before & after, -1, 0)).astype(np.int8)
    np.add.at(steps, (ray[follows], first[follows]), said)
    np.add.at(steps, (ray[follows], first[follows + 1]), -said)
    opening, closing = np.flatnonzero(is_first & is_entry), np.flatnonzero(is_last[: len(ray)] & ~is_entry)
    np.add.at(steps, (ray[opening], np.zeros_like(opening)), np.int8(-1))
    np.add.at(steps, (ray[opening], first[opening]), np.int8(1))
    np.add.at(steps, (ray[closing], first[closing]), np.int8(-1))
    votes = np.cumsum(steps[:, :-1], axis=1, dtype=np.int8)
    return votes.reshape(*(int(shape[other]) for other in across), int(shape[axis]))


def _all_hits(caster: Caster, starts: Float64Array, axis: int) -> tuple[Int64Array, Float64Array, BoolArray]:
    """Return every hit of rays along an axis: ray (H,), coordinate (H,), whether the void begins; sorted by both."""
    way = np.eye(3)[axis]
    rays, at_m, origins = np.arange(len(starts)), starts[:, axis].copy(), starts.copy()
    found: list[tuple[Int64Array, Float64Array, BoolArray]] = []
    for _ in range(_MOST_HITS):
        ranges_m, _, normals = caster.hits(origins, way)
        hit = np.flatnonzero(np.isfinite(ranges_m))
        rays, origins, at_m = rays[hit], origins[hit], at_m[hit] + ranges_m[hit]
        if len(rays) == 0:
            break
        found.append((rays, at_m.copy(), normals[hit, axis] > 0))
        at_m = at_m + _STEP_M
        origins[:, axis] = at_m
    if not found:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0, dtype=bool)
    ray, place_m, is_entry = (np.concatenate([each[column] for each in found]) for column in range(3))
    order = np.lexsort((place_m, ray))
    return ray[order], place_m[order], is_entry[order]
