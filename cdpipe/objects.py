"""From groups of map points to the objects of the answer: their returns, their kind, the partners of what was moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from cdpipe.geometry import Float64Array, Int32Array, Int64Array, require_shape
from cdpipe.types import ChangedObject, MergedMaps, PointMap, SessionName

# Two objects may be the same one, moved, when each of their extents agrees within this factor.
_SIZE_FACTOR = 1.35
_BLOCK_RETURNS = 1 << 22


@dataclass(frozen=True, slots=True, eq=False)
class PointGroup:
    """Map points that make one object.

    Attributes:
        session: The session whose map they are of.
        indices: (P,) map points.
        points_map: (P, 3) the same points in the map frame, metres.
        region: Index of the region they were found in, -1 without.
    """

    session: SessionName
    indices: Int64Array
    points_map: Float64Array
    region: int

    def __post_init__(self) -> None:
        require_shape("points_map", self.points_map, (len(self.indices), 3))


def assemble_objects(merged: MergedMaps, groups: Sequence[PointGroup]) -> tuple[ChangedObject, ...]:
    """Make the objects of an answer out of groups of map points, in the same order.

    An object's score is its number of map points, which compares objects of different regions and methods. Groups of
    the after map are added, those of the before map removed; where one of each has about the same extents (best
    one-to-one assignment over all), both are moved and name each other.

    Args:
        merged: Both maps.
        groups: No map point may be in two of them.
    """
    returns: dict[int, Int32Array] = {}
    for session, point_map in (("before", merged.before), ("after", merged.after)):
        members = [number for number, group in enumerate(groups) if group.session == session]
        found = _returns_of_groups(point_map, [groups[number].indices for number in members])
        returns.update(zip(members, found, strict=True))
    objects = [
        ChangedObject(
            session=group.session,
            kind="added" if group.session == "after" else "removed",
            region=group.region,
            returns=returns[number],
            points_map=group.points_map,
            score=float(len(group.indices)),
        )
        for number, group in enumerate(groups)
    ]
    for removed, added in _moves(objects, max(merged.before.voxel_m, merged.after.voxel_m)):
        objects[removed] = replace(objects[removed], kind="moved", partner=added)
        objects[added] = replace(objects[added], kind="moved", partner=removed)
    return tuple(objects)


def _returns_of_groups(point_map: PointMap, groups: Sequence[Int64Array]) -> list[Int32Array]:
    """Return the (M, 2) (scan, pixel) of each group's returns, in one pass over the returns of the map."""
    if not groups:
        return []
    group_of_point = np.full(len(point_map.points), -1, dtype=np.int32)
    for number, indices in enumerate(groups):
        group_of_point[indices] = number
    is_wanted = group_of_point >= 0
    chosen = np.concatenate(
        [
            start + np.flatnonzero(is_wanted[point_map.return_points[start : start + _BLOCK_RETURNS]])
            for start in range(0, max(1, len(point_map.return_points)), _BLOCK_RETURNS)
        ]
    )
    group = group_of_point[point_map.return_points[chosen]]
    scans = np.searchsorted(point_map.scan_offsets, chosen, side="right") - 1
    table = np.column_stack([scans, point_map.return_pixels[chosen]]).astype(np.int32)
    table = table[np.argsort(group, kind="stable")]
    return np.split(table, np.cumsum(np.bincount(group, minlength=len(groups)))[:-1])


def _moves(objects: Sequence[ChangedObject], voxel_m: float) -> list[tuple[int, int]]:
    """Return (removed, added) index pairs that look like one object, each object in at most one pair."""
    removed = [index for index, item in enumerate(objects) if item.session == "before"]
    added = [index for index, item in enumerate(objects) if item.session == "after"]
    if not removed or not added:
        return []
    sizes_r = np.log([_extents_m(objects[index].points_map) + voxel_m for index in removed])
    sizes_a = np.log([_extents_m(objects[index].points_map) + voxel_m for index in added])
    misfit = np.abs(sizes_r[:, None] - sizes_a[None]).max(axis=2)
    limit = np.log(_SIZE_FACTOR)
    # pairs beyond the limit cost more than all allowed pairs together, so as many as possible are allowed ones
    cost = np.where(misfit <= limit, misfit, limit * (1 + len(objects)))
    rows, columns = linear_sum_assignment(cost)
    return [(removed[r], added[a]) for r, a in zip(rows, columns, strict=True) if misfit[r, a] <= limit]


def _extents_m(points: Float64Array) -> Float64Array:
    """Return the sorted edges (3,) of the evenly filled box with the same spread as the points.

    Unlike the edges of the bounding box they do not change when the object is turned, nor with a stray point.
    """
    covariance = np.cov(points.T, bias=True) if len(points) > 1 else np.zeros((3, 3))
    return np.sqrt(12.0 * np.linalg.eigvalsh(covariance).clip(min=0.0))
