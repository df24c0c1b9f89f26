"""From groups of map points to the objects of the answer: returns, kind, shape, and partners of moved objects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int32Array, Int64Array, invert, require_shape, transform
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.extract.crops import SESSIONS, Crops
from cdpipe.extract.moves import find_moves
from cdpipe.extract.remains import is_heap, is_part_of_remainder
from cdpipe.extract.shape import column_volume_m3, ground_heights, upright_box
from cdpipe.mapping.reach import FINE_SHARE
from cdpipe.model.report import ChangedObject, ObjectShape
from cdpipe.model.types import MergedMaps, PointMap, SessionName

_BLOCK_RETURNS = 1 << 22
# Shapes use the means of the returns in cells of 1/4 voxel. Cells with fewer returns are dropped as noise, unless less
# than this share of the cells would remain.
_RETURNS_PER_CELL = 3
_LEAST_FULL_CELLS = 0.2
# Margin of an object's surroundings, and distance that still is the object.
_AROUND_M = 1.0
_ON_OBJECT_M = 0.1
# Column width of the ground, and height above it that is not ground.
_GROUND_M = 0.4
_ABOVE_GROUND_M = 0.06


@dataclass(frozen=True, slots=True, eq=False)
class PointGroup:
    """The points of one extracted object.

    Attributes:
        session: The session whose map holds them.
        indices: (P,) map points.
        points_map: (P, 3) their positions, map frame, metres; any (N, 3) points of the object if `returns` is given.
        region: Index of their region, -1 without one.
        returns: (M,) returns of the map that form the object; None: all returns of its map points.
    """

    session: SessionName
    indices: Int64Array
    points_map: Float64Array
    region: int
    returns: Int64Array | None = None

    def __post_init__(self) -> None:
        require_shape("points_map", self.points_map, (len(self.indices) if self.returns is None else None, 3))


def assemble_objects(merged: MergedMaps, groups: Sequence[PointGroup]) -> tuple[ChangedObject, ...]:
    """Return the objects of an answer, one for each group of map points, in the same order.

    A group of the after map is added, a group of the before map removed. A matching pair is moved
    (`cdpipe.extract.moves`). A removed part of a heap that remains is reshaped (`cdpipe.extract.remains`). The score
    of an object is its number of map points. Shapes and moves are measured on the returns if the maps store them.

    Args:
        merged: Both maps.
        groups: Not empty; no return may be in two groups. Two objects may share a map point on their border.
    """
    if not groups:
        return ()
    returns: dict[int, Int32Array] = {}
    points: dict[int, Float64Array] = {}
    for session in SESSIONS:
        members = [number for number, group in enumerate(groups) if group.session == session]
        point_map = merged.map_of(session)
        pool = ReturnPool(point_map, [groups[n].indices for n in members if groups[n].returns is None])
        for number in members:
            own = groups[number].returns
            indices = np.sort(pool.of(groups[number].indices) if own is None else own)
            scans_and_pixels = np.column_stack([point_map.scans_of(indices), point_map.return_pixels[indices]])
            returns[number] = scans_and_pixels.astype(np.int32)
            points[number] = _measured_points(merged, groups[number], indices)
    surroundings = _Surroundings(merged)
    objects = []
    is_part: dict[int, bool] = {}
    for number, group in enumerate(groups):
        around = surroundings.of(group)
        other = around["after" if group.session == "before" else "before"]
        point_map = merged.map_of(group.session)
        voxel_m = point_map.voxel_m
        taken, _ = cell_means(group.points_map, voxel_m)  # the density of its surroundings
        # groups of whole map points leave the foot of an object behind, which would look like a remainder
        may_be_part = group.session == "before" and group.returns is not None
        is_part[number] = (
            may_be_part and is_part_of_remainder(taken, around["before"], other) and is_heap(points[number])
        )
        column_m = voxel_m if point_map.return_offsets is None else voxel_m / 2
        volume_m3 = column_volume_m3(points[number], other, column_m, voxel_m)
        objects.append(
            ChangedObject(
                session=group.session,
                kind="added" if group.session == "after" else ("reshaped" if is_part[number] else "removed"),
                region=group.region,
                returns=returns[number],
                points_map=group.points_map,
                score=float(len(group.indices)),
                shape=ObjectShape(*upright_box(points[number]), volume_m3),
            )
        )
    is_cut_finely = all(group.returns is not None for group in groups)
    return _link_moves(objects, points, is_part, surroundings, nearest_twins=is_cut_finely)


def _link_moves(
    objects: list[ChangedObject],
    points: Mapping[int, Float64Array],
    is_part: Mapping[int, bool],
    surroundings: _Surroundings,
    *,
    nearest_twins: bool,
) -> tuple[ChangedObject, ...]:
    before = [number for number, item in enumerate(objects) if item.session == "before"]
    removed = [number for number in before if not is_part[number]]
    added = [number for number, item in enumerate(objects) if item.session == "after"]

    def around(pairs: Sequence[tuple[int, int]]) -> list[tuple[Float64Array, Float64Array]]:
        return surroundings.standing([np.concatenate([points[removed[r]], points[added[a]]]) for r, a in pairs])

    ends = [points[n] for n in removed], [points[n] for n in added]
    for move in find_moves(*ends, around, nearest_twins=nearest_twins):
        start, end = removed[move.removed], added[move.added]
        for number, partner in ((start, end), (end, start)):
            objects[number] = replace(
                objects[number], kind="moved", partner=partner, displacement_map=move.displacement_map
            )
    return tuple(objects)


class ReturnPool:
    """The returns of chosen map points, collected in one pass over all returns of a map."""

    def __init__(self, point_map: PointMap, wanted: Iterable[Int64Array]) -> None:
        is_wanted = np.zeros(len(point_map.points), dtype=np.bool_)
        for indices in wanted:
            is_wanted[indices] = True
        owners = point_map.return_points
        chosen = [
            start + np.flatnonzero(is_wanted[owners[start : start + _BLOCK_RETURNS]])
            for start in range(0, len(owners) if is_wanted.any() else 0, _BLOCK_RETURNS)
        ]
        returns = np.concatenate(chosen) if chosen else np.zeros(0, dtype=np.int64)
        self._returns = returns[np.argsort(owners[returns], kind="stable")]
        self._owners = owners[self._returns]

    def of(self, indices: Int64Array) -> Int64Array:
        """Return the indices of the returns of some of the chosen map points, ordered by map point."""
        starts = np.searchsorted(self._owners, indices, side="left")
        ends = np.searchsorted(self._owners, indices, side="right")
        parts = [self._returns[start:end] for start, end in zip(starts.tolist(), ends.tolist(), strict=True)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def _measured_points(merged: MergedMaps, group: PointGroup, returns: Int64Array) -> Float64Array:
    """Return the (P, 3) points that measure a group, map frame: means of returns if the map stores their positions."""
    point_map = merged.map_of(group.session)
    if point_map.return_offsets is None or len(returns) == 0:
        return group.points_map
    return merged.to_map(group.session, _fine_points(point_map, returns))


def _fine_points(point_map: PointMap, returns: Int64Array) -> Float64Array:
    """Return the (P, 3) means of returns in cells of 1/4 voxel, odom frame, without sparse cells."""
    if len(returns) == 0:
        return np.zeros((0, 3))
    means, cells = cell_means(point_map.positions_of(returns), point_map.voxel_m / FINE_SHARE)
    is_full = np.bincount(cells) >= _RETURNS_PER_CELL
    return means[is_full] if is_full.mean() >= _LEAST_FULL_CELLS else means


class _Surroundings:
    """The map points of both sessions around objects."""

    def __init__(self, merged: MergedMaps) -> None:
        self._merged = merged
        self._crops = Crops(merged, margin_m=0.0)

    def of(self, group: PointGroup) -> dict[SessionName, Float64Array]:
        """Return the (N, 3) points of each session within `_AROUND_M` of a group's box, without the group's own.

        Map frame, metres.
        """
        low, high = group.points_map.min(axis=0) - _AROUND_M, group.points_map.max(axis=0) + _AROUND_M
        found = self._within((low + high) / 2, float(np.linalg.norm(high - low)) / 2)
        points = {name: around for name, (_, around) in found.items()}
        # a map point on the border may hold returns of object and surroundings; its distance to the object decides
        is_own = np.isin(found[group.session][0], group.indices)
        own = points[group.session]
        is_own[is_own] = cKDTree(group.points_map).query(own[is_own])[0] < _ON_OBJECT_M
        points[group.session] = own[~is_own]
        return {name: around[((around >= low) & (around <= high)).all(axis=1)] for name, around in points.items()}

    def standing(self, places: Sequence[Float64Array]) -> list[tuple[Float64Array, Float64Array]]:
        """Return the points of both sessions above the ground in the upright box around each set of (P, 3) points.

        Returns:
            Points (Q, 3) of the before and (R, 3) of the after session, map frame; means of returns if stored.
        """
        chosen: dict[SessionName, list[Int64Array]] = {"before": [], "after": []}
        for place in places:
            map_T_box, box_m = upright_box(place)
            found = self._within(map_T_box[:3, 3], float(np.linalg.norm(box_m)) / 2 + _AROUND_M)
            ground = np.concatenate([around for _, around in found.values()])
            for session in SESSIONS:
                indices, around = found[session]
                is_inside = (np.abs(transform(invert(map_T_box), around)) <= box_m / 2 + _ON_OBJECT_M).all(axis=1)
                indices, around = indices[is_inside], around[is_inside]
                is_high = around[:, 2] > ground_heights(ground, around, _GROUND_M) + _ABOVE_GROUND_M
                chosen[session].append(indices[is_high])
        return list(zip(*(self._finely(session, chosen[session]) for session in SESSIONS), strict=True))

    def _within(self, centre_map: Float64Array, radius_m: float) -> dict[SessionName, tuple[Int64Array, Float64Array]]:
        """Return the map points of each session in a sphere and somewhat beyond, and their (N, 3) map positions."""
        return {session: self._crops.crop_roughly(session, centre_map, radius_m) for session in SESSIONS}

    def _finely(self, session: SessionName, chosen: Sequence[Int64Array]) -> list[Float64Array]:
        """Return the (P, 3) points of sets of map points, map frame: means of returns if the map stores them."""
        point_map = self._merged.map_of(session)
        if point_map.return_offsets is None:
            points = [point_map.points[indices] for indices in chosen]
        else:
            pool = ReturnPool(point_map, chosen)
            points = [_fine_points(point_map, np.sort(pool.of(indices))) for indices in chosen]
        return [self._merged.to_map(session, odom) for odom in points]
