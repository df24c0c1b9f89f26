"""Finer triangles for two surfaces of one topology, without T-junctions, and their exact swept volume."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from sim.geometry.mesh import Mesh

_ROUNDS = 12
_NONE = -1


@dataclass(frozen=True, slots=True, eq=False)
class TwinWalls:
    """The walls of both sessions: the same faces over vertices at two places.

    Attributes:
        before: (N, 3) float64 vertices in the before session, world frame, metres.
        after: (N, 3) float64 vertices in the after session.
        faces: (M, 3) int64.
        owner: (N,) int64 number of the surface change that moved a vertex, 0 for none.
    """

    before: Float64Array
    after: Float64Array
    faces: Int64Array
    owner: Int64Array

    def mesh(self, session: str) -> Mesh:
        """Return the walls of "before" or "after"."""
        return Mesh(self.before if session == "before" else self.after, self.faces.astype(np.int32))

    def moved(self, vertices: Int64Array, after: Float64Array, number: int) -> TwinWalls:
        """Return the walls with some vertices (V,) at new places (V, 3) in the after session, owned by a change."""
        places, owner = self.after.copy(), self.owner.copy()
        places[vertices], owner[vertices] = after, number
        return replace(self, after=places, owner=owner)


def twin_walls(mesh: Mesh) -> TwinWalls:
    """Return walls that are the same in both sessions."""
    return TwinWalls(mesh.vertices, mesh.vertices, mesh.faces.astype(np.int64), np.zeros(len(mesh.vertices), np.int64))


def refine(walls: TwinWalls, edge_m: Callable[[Float64Array], Float64Array]) -> TwinWalls:
    """Halve edges that are too long in either session until none is left; the two surfaces stay where they are.

    A face with one, two or three halved edges becomes two, three or four faces (red-green refinement), so that no
    vertex lies inside an edge of its neighbour.

    Args:
        walls: The walls.
        edge_m: Gives the longest edge (K,) allowed at places (K, 3) of the before session, metres; infinite for any.
    """
    is_finite, n_known = np.zeros(0, dtype=bool), 0
    for _ in range(_ROUNDS):
        is_finite = np.concatenate([is_finite, np.isfinite(edge_m(walls.before[n_known:]))])
        # an edge that was short enough once stays so: only faces with a new vertex are looked at again
        is_new = np.arange(len(walls.before)) >= n_known
        n_known = len(walls.before)
        near = np.flatnonzero(_has_any(is_finite, walls.faces) & _has_any(is_new, walls.faces))
        pairs = _edges(walls.faces[near], n_known)
        middle = walls.before[pairs].mean(axis=1)
        longest_m = np.maximum(
            *(
                np.linalg.norm(places[pairs[:, 1]] - places[pairs[:, 0]], axis=1)
                for places in (walls.before, walls.after)
            )
        )
        pairs = pairs[longest_m > edge_m(middle)]
        if not len(pairs):
            break
        walls = _halve(walls, pairs)
    return walls


def refine_ball(walls: TwinWalls, middle: Float64Array, reach_m: float, edge_m: float) -> TwinWalls:
    """Halve edges longer than `edge_m` of every face that may meet a ball, given by its middle (3,) and radius.

    Large triangles of foreign meshes have no vertex in the place that changes.
    """
    for _ in range(_ROUNDS):
        corners = walls.before[walls.faces]
        centres = corners.mean(axis=1)
        radii_m = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
        near = np.flatnonzero(np.linalg.norm(centres - middle, axis=1) < reach_m + radii_m)
        pairs = _edges(walls.faces[near], len(walls.before))
        pairs = pairs[_length(walls.before, pairs[:, 0], pairs[:, 1]) > edge_m]
        if not len(pairs):
            break
        walls = _halve(walls, pairs)
    return walls


def swept_volume_m3(walls: TwinWalls, faces: Int64Array) -> float:
    """Return the volume between the two surfaces over some faces (K,), positive where rock came into the void.

    The difference of the signed volumes that the faces enclose with one point, which is exact for a closed surface of
    which only these faces moved. Walls face into the void, so the volume that they enclose counts negative.
    """
    return _signed_volume_m3(walls, faces, walls.after) - _signed_volume_m3(walls, faces, walls.before)


def _signed_volume_m3(walls: TwinWalls, faces: Int64Array, places: Float64Array) -> float:
    if not len(faces):
        return 0.0
    centre = walls.before[walls.faces[faces]].mean(axis=(0, 1))
    a, b, c = (places[walls.faces[faces, corner]] - centre for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _halve(walls: TwinWalls, pairs: Int64Array) -> TwinWalls:
    """Return the walls with a vertex in the middle of some edges (E, 2), the lower vertex first, sorted."""
    n = len(walls.before)
    keys = pairs[:, 0] * n + pairs[:, 1]
    one, other = walls.owner[pairs.T]
    owner = np.where(one == other, one, np.maximum(one, other))
    before, after = (np.concatenate([each, each[pairs].mean(axis=1)]) for each in (walls.before, walls.after))
    is_end = np.zeros(n, dtype=bool)
    is_end[pairs] = True
    a, b, c = walls.faces.T
    is_touched = (is_end[a] & (is_end[b] | is_end[c])) | (is_end[b] & is_end[c])
    touched = walls.faces[is_touched]
    wanted = _edge_keys(touched, n)
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    middles = np.where(keys[at] == wanted, n + at, _NONE).reshape(-1, 3)
    is_cut = (middles != _NONE).any(axis=1)
    is_touched[is_touched] = is_cut
    faces = np.concatenate([walls.faces[~is_touched], _split(touched[is_cut], middles[is_cut], before)])
    return TwinWalls(before, after, faces, np.concatenate([walls.owner, owner]))


def _has_any(mask: BoolArray, faces: Int64Array) -> BoolArray:
    """Mark the faces (M, 3) of which any vertex is marked in (N,)."""
    a, b, c = faces.T
    return np.asarray(mask[a] | mask[b] | mask[c])


def _edges(faces: Int64Array, n_vertices: int) -> Int64Array:
    """Return the edges (E, 2) of faces (M, 3), each once, the lower vertex first, sorted."""
    return np.stack(np.divmod(np.unique(_edge_keys(faces, n_vertices)), n_vertices), axis=1)


def _edge_keys(faces: Int64Array, n_vertices: int) -> Int64Array:
    """Return a number (3 M,) for each edge ab, bc, ca of faces (M, 3) that orders edges by their lower vertex first."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return np.asarray(ends.min(axis=1) * n_vertices + ends.max(axis=1))


def _split(faces: Int64Array, middles: Int64Array, places: Float64Array) -> Int64Array:
    """Split faces (M, 3) at the middles (M, 3) of their edges ab, bc, ca, -1 where an edge stays whole.

    Every face has one edge at least that is cut.
    """
    is_cut = middles != _NONE
    count = is_cut.sum(axis=1)
    done = []
    # turned so that the first edge is the one that is cut, or the third the one that is not
    turn = np.where(count == 1, is_cut.argmax(axis=1), np.where(count == 2, (~is_cut).argmax(axis=1) + 1, 0))
    order = (np.arange(3) + turn[:, None]) % 3
    corners, cuts = np.take_along_axis(faces, order, axis=1), np.take_along_axis(middles, order, axis=1)
    (a, b, c), (ab, _, _) = corners[count == 1].T, cuts[count == 1].T
    done += _stack((a, ab, c), (ab, b, c))
    (a, b, c), (ab, bc, _) = corners[count == 2].T, cuts[count == 2].T
    done += _stack((ab, b, bc))
    is_first = _length(places, a, bc) <= _length(places, ab, c)
    done += _stack((a, ab, bc), (a, bc, c), chosen=is_first) + _stack((a, ab, c), (ab, bc, c), chosen=~is_first)
    (a, b, c), (ab, bc, ca) = corners[count == 3].T, cuts[count == 3].T
    done += _stack((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate(done)


def _stack(*triangles: tuple[Int64Array, Int64Array, Int64Array], chosen: BoolArray | None = None) -> list[Int64Array]:
    stacked = [np.stack(each, axis=1) for each in triangles]
    return stacked if chosen is None else [each[chosen] for each in stacked]


def _length(places: Float64Array, a: Int64Array, b: Int64Array) -> Float64Array:
    return np.asarray(np.linalg.norm(places[a] - places[b], axis=1))
