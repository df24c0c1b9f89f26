"""From groups of map points to the objects of the answer: their returns, kind and shape, the partners of what moved."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int32Array, Int64Array, invert, require_shape, transform
from cdpipe.core.grid_index import GridIndex
from cdpipe.core.voxel import cell_means
from cdpipe.extract.moves import find_moves
from cdpipe.extract.remains import is_heap, is_part_of_remainder
from cdpipe.extract.shape import ground_heights, measure_shape, upright_box
from cdpipe.model.report import ChangedObject
from cdpipe.model.types import MergedMaps, PointMap, SessionName

_BLOCK_RETURNS = 1 << 22
# An object is measured on the means of its returns in cells of this share of the map's, where there are enough in one:
# single returns are noise, unless there are hardly any others.
_FINE_SHARE = 4
_RETURNS_PER_CELL = 3
_LEAST_FULL_CELLS = 0.2
# How far around an object its surroundings are looked at, and how far the alignment may bend there.
_AROUND_M = 1.0
_BEND_M = 0.5
_ON_OBJECT_M = 0.1
# The ground is the lowest of columns this wide, and a bit more.
_GROUND_M = 0.4
_ABOVE_GROUND_M = 0.06
_SESSIONS: tuple[SessionName, SessionName] = ("before", "after")


@dataclass(frozen=True, slots=True, eq=False)
class PointGroup:
    """Map points that make one object.

    Attributes:
        session: The session whose map they are of.
        indices: (P,) map points.
        points_map: (P, 3) the same points in the map frame, metres.
        region: Index of the region they were found in, -1 without.
        returns: (M,) which returns of the map the object is made of; None: all that its map points stand for. Then
            `points_map` need not be map points.
    """

    session: SessionName
    indices: Int64Array
    points_map: Float64Array
    region: int
    returns: Int64Array | None = None

    def __post_init__(self) -> None:
        require_shape("points_map", self.points_map, (len(self.indices) if self.returns is None else None, 3))


def assemble_objects(merged: MergedMaps, groups: Sequence[PointGroup]) -> tuple[ChangedObject, ...]:
    """Make the objects of an answer out of groups of map points, in the same order.

    Groups of the after map are added, those of the before map removed. Where one of each looks like the other
    (`cdpipe.extract.moves`), both are moved and name each other. What was taken off something that still stands
    (`cdpipe.extract.remains`) is reshaped. An object's score is its number of map points, which compares objects of
    different regions and methods. Shapes and moves are measured on the returns, where the maps know where they are.

    Args:
        merged: Both maps.
        groups: None may be empty, and no return may be in two of them. A map point on the border of two objects may
            stand for returns of both.
    """
    if not groups:
        return ()
    maps = {"before": merged.before, "after": merged.after}
    returns: dict[int, Int32Array] = {}
    points: dict[int, Float64Array] = {}
    for session in _SESSIONS:
        members = [number for number, group in enumerate(groups) if group.session == session]
        pool = ReturnPool(maps[session], [groups[n].indices for n in members if groups[n].returns is None])
        for number in members:
            own = groups[number].returns
            indices = np.sort(pool.of(groups[number].indices) if own is None else own)
            returns[number] = _scan_and_pixel(maps[session], indices)
            points[number] = _measured_points(merged, groups[number], indices)
    surroundings = _Surroundings(merged)
    objects = []
    is_part: dict[int, bool] = {}
    for number, group in enumerate(groups):
        around = surroundings.of(group)
        other = around["after" if group.session == "before" else "before"]
        voxel_m = maps[group.session].voxel_m
        taken, _ = cell_means(group.points_map, voxel_m)  # as dense as its surroundings
        # a rule that takes whole map points leaves an object's foot behind, which would pass for a rest
        may_be_part = group.session == "before" and group.returns is not None
        is_part[number] = may_be_part and is_part_of_remainder(taken, around["before"], other)
        column_m = voxel_m if maps[group.session].return_offsets is None else voxel_m / 2
        objects.append(
            ChangedObject(
                session=group.session,
                kind="added" if group.session == "after" else ("reshaped" if is_part[number] else "removed"),
                region=group.region,
                returns=returns[number],
                points_map=group.points_map,
                score=float(len(group.indices)),
                shape=measure_shape(points[number], other, column_m, voxel_m),
            )
        )
    return _link_moves(objects, points, is_part, surroundings)


def _link_moves(
    objects: list[ChangedObject],
    points: Mapping[int, Float64Array],
    is_part: Mapping[int, bool],
    surroundings: _Surroundings,
) -> tuple[ChangedObject, ...]:
    before = [number for number, item in enumerate(objects) if item.session == "before"]
    removed = [number for number in before if not (is_part[number] and is_heap(points[number]))]
    added = [number for number, item in enumerate(objects) if item.session == "after"]
    may_go_far = [not is_part[number] for number in removed]

    def around(pairs: Sequence[tuple[int, int]]) -> list[tuple[Float64Array, Float64Array]]:
        return surroundings.standing([np.concatenate([points[removed[r]], points[added[a]]]) for r, a in pairs])

    for move in find_moves([points[n] for n in removed], [points[n] for n in added], may_go_far, around):
        start, end = removed[move.removed], added[move.added]
        for number, partner in ((start, end), (end, start)):
            objects[number] = replace(
                objects[number], kind="moved", partner=partner, displacement_map=move.displacement_map
            )
    return tuple(objects)


class ReturnPool:
    """The returns of some map points, found in one pass over all returns of a map."""

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
        """Return the returns of some of the wanted map points, by map point."""
        starts = np.searchsorted(self._owners, indices, side="left")
        ends = np.searchsorted(self._owners, indices, side="right")
        parts = [self._returns[start:end] for start, end in zip(starts.tolist(), ends.tolist(), strict=True)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def _scan_and_pixel(point_map: PointMap, returns: Int64Array) -> Int32Array:
    """Return the (M, 2) scan and pixel of (M,) returns."""
    scans = np.searchsorted(point_map.scan_offsets, returns, side="right") - 1
    return np.column_stack([scans, point_map.return_pixels[returns]]).astype(np.int32)


def _measured_points(merged: MergedMaps, group: PointGroup, returns: Int64Array) -> Float64Array:
    """Return the points (P, 3) that a group is measured on, map frame: finer than the map's, where that is known."""
    point_map = merged.before if group.session == "before" else merged.after
    if point_map.return_offsets is None or len(returns) == 0:
        return group.points_map
    means = _fine_points(point_map, returns)
    return means if group.session == "before" else merged.alignment.to_map(means)


def _fine_points(point_map: PointMap, returns: Int64Array) -> Float64Array:
    """Return the means (P, 3) of some returns in small cells, odometry frame, without the cells of stray ones."""
    if len(returns) == 0:
        return np.zeros((0, 3))
    means, cells = cell_means(point_map.positions_of(returns), point_map.voxel_m / _FINE_SHARE)
    is_full = np.bincount(cells) >= _RETURNS_PER_CELL
    return means[is_full] if is_full.mean() >= _LEAST_FULL_CELLS else means


class _Surroundings:
    """What both sessions saw around objects."""

    def __init__(self, merged: MergedMaps) -> None:
        self._merged = merged
        self._before, self._after = GridIndex(merged.before.points), GridIndex(merged.after.points)

    def of(self, group: PointGroup) -> dict[SessionName, Float64Array]:
        """Return the points (N, 3) of each session, map frame, no farther than `_AROUND_M` beside a group's box.

        Without what the group is made of itself.
        """
        low, high = group.points_map.min(axis=0) - _AROUND_M, group.points_map.max(axis=0) + _AROUND_M
        found = self._within((low + high) / 2, float(np.linalg.norm(high - low)) / 2)
        points = {name: around for name, (_, around) in found.items()}
        # a map point on the object's border may stand for returns of both; what lies off the object is its surroundings
        is_own = np.isin(found[group.session][0], group.indices)
        own = points[group.session]
        is_own[is_own] = cKDTree(group.points_map).query(own[is_own])[0] < _ON_OBJECT_M
        points[group.session] = own[~is_own]
        return {name: around[((around >= low) & (around <= high)).all(axis=1)] for name, around in points.items()}

    def standing(self, places: Sequence[Float64Array]) -> list[tuple[Float64Array, Float64Array]]:
        """Return what either session has above the ground within the upright box around each set of points (P, 3).

        Returns:
            Points (Q, 3) of the before and (R, 3) of the after session, map frame, fine where the maps know that.
        """
        chosen: dict[SessionName, list[Int64Array]] = {"before": [], "after": []}
        for place in places:
            map_T_box, box_m = upright_box(place)
            found = self._within(map_T_box[:3, 3], float(np.linalg.norm(box_m)) / 2 + _AROUND_M)
            ground = np.concatenate([around for _, around in found.values()])
            for session in _SESSIONS:
                indices, around = found[session]
                is_inside = (np.abs(transform(invert(map_T_box), around)) <= box_m / 2 + _ON_OBJECT_M).all(axis=1)
                indices, around = indices[is_inside], around[is_inside]
                is_high = around[:, 2] > ground_heights(ground, around, _GROUND_M) + _ABOVE_GROUND_M
                chosen[session].append(indices[is_high])
        return list(zip(self._finely("before", chosen["before"]), self._finely("after", chosen["after"]), strict=True))

    def _within(self, centre_map: Float64Array, radius_m: float) -> dict[SessionName, tuple[Int64Array, Float64Array]]:
        """Return which map points of each session lie about a place, and where (N, 3), map frame."""
        before = self._before.crop(centre_map, radius_m)
        alignment = self._merged.alignment
        bend_m = 0.0 if alignment.is_rigid else _BEND_M
        after = self._after.crop(alignment.to_odom(centre_map[None])[0], radius_m + bend_m)
        return {
            "before": (before, self._merged.before.points[before]),
            "after": (after, alignment.to_map(self._merged.after.points[after])),
        }

    def _finely(self, session: SessionName, chosen: Sequence[Int64Array]) -> list[Float64Array]:
        """Return the points (P, 3) of sets of map points, map frame: finer than the map's, where that is known."""
        point_map = self._merged.before if session == "before" else self._merged.after
        if point_map.return_offsets is None:
            points = [point_map.points[indices] for indices in chosen]
        else:
            pool = ReturnPool(point_map, chosen)
            points = [_fine_points(point_map, np.sort(pool.of(indices))) for indices in chosen]
        return [self._merged.alignment.to_map(odom) if session == "after" else odom for odom in points]
