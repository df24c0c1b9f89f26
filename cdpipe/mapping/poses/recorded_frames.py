"""Between the frames of consistent maps and those of the recorded odometries, in which answers are given.

`map.consistency` gives the scans of a session other poses than those that were recorded. Whoever reads an answer has
the recorded ones. What lies at a keyframe moves with the keyframe: the transform between both frames at a place is that
of the nearest keyframe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, fit_rigid, invert, transform_each
from cdpipe.mapping.poses.scan_registration import moved_m
from cdpipe.model.aligned import LEAP_M
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, SurfaceField
from cdpipe.model.types import PointMap

# Both sessions were in one place where their paths come this near to one another, as evidence `overlap` has it.
_SHARED_M = 5.0


def report_as_recorded(report: ChangeReport, before: PointMap, after: PointMap) -> ChangeReport:
    """Return a report with its places in the frames of the recorded odometries.

    The report is returned unchanged where both maps have these frames. An object moves as a whole, by the motion of its
    middle, and keeps its size and its upright axis. The alignment at an after keyframe takes what the sensor saw there
    to the place where it was found. The frames differ from place to place: `before_T_after` is the rigid transform that
    best fits the alignment at the after keyframes beside the before path, at all of them if none is. Where an odometry
    lost its way, it fits the longest stretch between. It stays as it was found where no pose was made another one.

    Args:
        report: In the frames of the maps.
        before: The before map.
        after: The after map.
    """
    if before.recorded_T_sensor is None and after.recorded_T_sensor is None:
        return report
    local = report.local_before_T_after
    scans = report.keyframe_scans[1]
    odom_T_keyframe = after.odom_T_sensor[scans]
    if local is None:
        local = np.repeat(report.before_T_after[None], len(scans), axis=0)
    map_T_keyframe = local @ odom_T_keyframe
    recorded = recorded_T_map(before, map_T_keyframe[:, :3, 3])
    recorded_T_keyframe = odom_T_keyframe if after.recorded_T_sensor is None else after.recorded_T_sensor[scans]
    recorded_local = recorded @ map_T_keyframe @ invert(recorded_T_keyframe)
    before_T_after = report.before_T_after
    if len(scans) and not (_is_as_recorded(before) and _is_as_recorded(after)):
        of_before = _stretches(_recorded_T_keyframe(before), before.odom_T_keyframe)
        of_after = _stretches(recorded_T_keyframe, odom_T_keyframe)
        places = before.odom_T_keyframe[:, :3, 3], map_T_keyframe[:, :3, 3]
        _, shared = _where_they_met(of_before, of_after, *places)
        before_T_after = fit_rigid(recorded_T_keyframe[shared, :3, 3], recorded_local[shared])
    return replace(
        report,
        before_T_after=before_T_after,
        regions=_move_regions(report.regions, partial(recorded_T_map, before)),
        objects=tuple(_move_objects(report.objects, before)),
        local_before_T_after=recorded_local,
        surface=None if report.surface is None else _move_surface(report.surface, before),
    )


def _stretches(recorded_T_keyframe: Float64Array, odom_T_keyframe: Float64Array) -> Int64Array:
    """Return which stretch each of (K,) keyframes is in; one ends where the recorded odometry lost its way."""
    recorded, mapped = (invert(each[:-1]) @ each[1:] for each in (recorded_T_keyframe, odom_T_keyframe))
    return np.append(0, np.cumsum(moved_m(recorded, mapped) > LEAP_M))


def _where_they_met(
    of_before: Int64Array, of_after: Int64Array, before_places: Float64Array, after_places: Float64Array
) -> tuple[Int64Array, BoolArray]:
    """Return where both sessions were in one place, by keyframes that are aligned with one another.

    Args:
        of_before: (Kb,) stretch of each before keyframe.
        of_after: (Ka,) stretch of each after keyframe.
        before_places: (Kb, 3) positions of the before keyframes.
        after_places: (Ka, 3) positions of the after keyframes.

    Returns:
        (Ka,) nearest before keyframe of each after keyframe, and (Ka,) whether it lies within 5 m (all do if none does)
        in the two stretches of which most do, the first ones of several.
    """
    gaps_m, nearest = map(np.asarray, cKDTree(before_places).query(after_places))
    shared = gaps_m <= _SHARED_M if gaps_m.min() <= _SHARED_M else np.ones(len(gaps_m), dtype=np.bool_)
    both = np.column_stack([of_before[nearest], of_after])
    _, stretch, n_shared = np.unique(both[shared], axis=0, return_inverse=True, return_counts=True)
    shared[shared] = stretch.ravel() == np.argmax(n_shared)
    return nearest, shared


def regions_as_mapped(regions: ChangeRegions, before: PointMap) -> ChangeRegions:
    """Return regions in the frame of a before map from those in the frame of its recorded odometry."""
    if before.recorded_T_sensor is None:
        return regions
    return _move_regions(
        regions, lambda places: _transforms_at(places, _recorded_T_keyframe(before), before.odom_T_keyframe)
    )


def merge_as_mapped(before_T_after: Float64Array, before: PointMap, after: PointMap) -> PathAlignment:
    """Return a (4, 4) merge of the recorded frames as an alignment of two maps with consistent poses.

    What an after keyframe saw lands where the merge puts it. The alignment is the merge itself where both maps have the
    recorded poses. Where an odometry lost its way, the merge is that of the longest stretch under which both sessions
    were in one place, and what lies outside of it has the alignment of its end.
    """
    if _is_as_recorded(before) and _is_as_recorded(after):
        return PathAlignment.rigid(before_T_after)
    recorded_T_keyframe, odom_T_keyframe = before_T_after @ _recorded_T_keyframe(after), after.odom_T_keyframe
    places = _recorded_T_keyframe(before)[:, :3, 3], recorded_T_keyframe[:, :3, 3]
    of_before, of_after = (_stretches(_recorded_T_keyframe(each), each.odom_T_keyframe) for each in (before, after))
    nearest, shared = _where_they_met(of_before, of_after, *places)
    known, kept = of_before == of_before[nearest[shared][0]], np.flatnonzero(of_after == of_after[shared][0])
    map_T_recorded = _transforms_at(places[1], _recorded_T_keyframe(before)[known], before.odom_T_keyframe[known])
    local = map_T_recorded @ recorded_T_keyframe @ invert(odom_T_keyframe)
    own = kept[np.searchsorted((kept[1:] + kept[:-1]) / 2, np.arange(len(local)))]
    return PathAlignment(odom_T_keyframe[:, :3, 3], local[own])


def recorded_T_map(point_map: PointMap, places_odom: Float64Array) -> Float64Array:
    """Return the (N, 4, 4) transforms from a map's frame into that of its recorded odometry at (N, 3) places."""
    if point_map.recorded_T_sensor is None:
        return np.repeat(np.eye(4)[None], len(places_odom), axis=0)
    return _transforms_at(places_odom, point_map.odom_T_keyframe, _recorded_T_keyframe(point_map))


def _is_as_recorded(point_map: PointMap) -> bool:
    return np.array_equal(_recorded_T_keyframe(point_map), point_map.odom_T_keyframe)


def _recorded_T_keyframe(point_map: PointMap) -> Float64Array:
    """Return the (K, 4, 4) recorded pose of each keyframe."""
    if point_map.recorded_T_sensor is None:
        return point_map.odom_T_keyframe
    return point_map.recorded_T_sensor[point_map.keyframe_scans]


def _transforms_at(places: Float64Array, src_T_keyframe: Float64Array, dst_T_keyframe: Float64Array) -> Float64Array:
    """Return the (N, 4, 4) dst_T_src at (N, 3) places of frame src."""
    nearest = np.asarray(cKDTree(src_T_keyframe[:, :3, 3]).query(places.reshape(-1, 3))[1], dtype=np.int64)
    return np.asarray(dst_T_keyframe[nearest] @ invert(src_T_keyframe[nearest]))


def _move_regions(regions: ChangeRegions, transforms_at: Callable[[Float64Array], Float64Array]) -> ChangeRegions:
    """Return regions with their centres, and those at which they were proposed, moved each as it holds at its place."""
    proposed = regions.proposed_centres_map
    return replace(
        regions,
        centres_map=transform_each(transforms_at(regions.centres_map), regions.centres_map),
        proposed_centres_map=None if proposed is None else transform_each(transforms_at(proposed), proposed),
    )


def _move_surface(surface: SurfaceField, before: PointMap) -> SurfaceField:
    """Return a field in the frame of the recorded odometry; each point moves with its nearest keyframe."""
    centres = np.array([each.centre_map for each in surface.regions]).reshape(-1, 3)
    moved = transform_each(recorded_T_map(before, centres), centres)
    recorded = recorded_T_map(before, surface.points_map)
    return replace(
        surface,
        points_map=transform_each(recorded, surface.points_map),
        normals_map=np.einsum("nij,nj->ni", recorded[:, :3, :3], surface.normals_map),
        regions=tuple(replace(each, centre_map=at) for each, at in zip(surface.regions, moved, strict=True)),
    )


def _move_objects(objects: tuple[ChangedObject, ...], before: PointMap) -> list[ChangedObject]:
    middles = np.array([each.points_map.mean(axis=0) for each in objects]).reshape(-1, 3)
    shifts = transform_each(recorded_T_map(before, middles), middles) - middles
    moved = []
    for item, shift in zip(objects, shifts, strict=True):
        shape, displacement = item.shape, item.displacement_map
        if shape is not None:
            map_T_box = shape.map_T_box.copy()
            map_T_box[:3, 3] += shift
            shape = replace(shape, map_T_box=map_T_box)
        if displacement is not None:
            to_after = shifts[item.partner] - shift
            displacement = displacement + (to_after if item.session == "before" else -to_after)
        moved.append(replace(item, points_map=item.points_map + shift, shape=shape, displacement_map=displacement))
    return moved
