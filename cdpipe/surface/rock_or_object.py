"""Which of the extracted objects are rock: an object is no change of the rock, and rock is no object.

What came or went looks alike to the extraction. Two things tell them apart. Rock that fell was flush with the rock
around it, and an object stood out of it. Rubble lies below the place that it fell from. And no object rises as gently
over a wide floor as a heave or the ramp of fill does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.extract.extract import FIGURES
from cdpipe.model.config import ExtractConfig
from cdpipe.model.report import ChangedObject, ChangeReport
from cdpipe.surface.places import SurfacePlaces

# A place, or the surface that was found there, belongs to an object this near to one of its points.
_NEAR_M = 0.15
# The rock around an object: still places within this way of it.
_AROUND_M, _STILL_M, _LEAST_AROUND = 0.7, 0.03, 5
# Rock was flush if it stood out by less than this share of the depth that is missing now.
_FLUSH = 0.4
_LEAST_DEPTH_M = 0.05
# Rubble lies no farther than this from below the place that it fell from, no deeper than the last, and that place has
# so many places at least.
_BELOW_M, _LEAST_FALLEN, _ROOF_M = 1.0, 4, 10.0
_HIGH_SHARE = 90
# Floor that heaved, sank or was filled covers at least the first area. Its displacement, over places this far apart in
# plan, rises by less than this per metre nearly everywhere, and over more than the second area, that of the largest
# vehicle, on most of it: the edge of fill may be steep. Muck lies at 0.7 and more, the side of an object is upright.
_WIDE_M2, _WIDEST_M2 = 3.0, 15.0
_APART_M, _GENTLE, _NEARLY, _MOSTLY = (0.2, 0.6), 0.5, 95, 70
_RAMP_M = 0.5


def split_rock(
    objects: Sequence[ChangedObject], places: SurfacePlaces, along_m: Float64Array, level_m: Float64Array
) -> tuple[BoolArray, BoolArray]:
    """Tell rock from objects.

    Args:
        objects: What the extraction cut out, map frame.
        places: Where displacement was measured.
        along_m: (Q,) displacement along the normal, NaN where there is none.
        level_m: (Q,) its level of detection, NaN where it is not known: only rock that surely fell explains an object.

    Returns:
        (O,) whether each object is rock, and (Q,) whether the displacement of a place is that of an object that is not.
    """
    is_rock = np.zeros(len(objects), dtype=np.bool_)
    is_of_object = np.zeros(len(places.points), dtype=np.bool_)
    hits = places.points + np.nan_to_num(along_m)[:, None] * places.normals
    still = np.flatnonzero(np.abs(along_m) < _STILL_M)
    members = []
    for item in objects:
        where = places.points if item.session == "before" else hits
        members.append(_find_near(where, item.points_map))
    for number, (item, own) in enumerate(zip(objects, members, strict=True)):
        if item.session == "before":
            is_rock[number] = _was_flush(places, along_m, own, still) or _is_floor(places, along_m, own)
            is_of_object[own] |= not is_rock[number]
    least_m = np.fmax(np.where(np.isfinite(level_m), level_m, np.inf), _LEAST_DEPTH_M)
    fallen = np.flatnonzero((along_m < -least_m) & ~is_of_object)
    for number, (item, own) in enumerate(zip(objects, members, strict=True)):
        if item.session == "after":
            is_floor = _is_floor(places, along_m, own)
            is_rock[number] = is_floor or _is_below(item.points_map, places.points[fallen])
            is_of_object[own] |= not is_rock[number]
    return is_rock, is_of_object


def leave_out_rock(report: ChangeReport, is_rock: BoolArray, config: ExtractConfig) -> ChangeReport:
    """Return a report without the objects that are rock; a region whose objects are all rock is withdrawn.

    Where regions are never withdrawn, they stay.
    """
    if not is_rock.any():
        return report
    kept = np.flatnonzero(~is_rock)
    number = np.full(len(is_rock) + 1, -1)
    number[kept] = np.arange(len(kept))
    objects = tuple(_pair_anew(report.objects[index], int(number[report.objects[index].partner])) for index in kept)
    held = {item.region for item in report.objects} - {item.region for item in objects}
    regions = report.regions
    is_lost = np.isin(np.arange(len(regions.scores)), list(held)) & regions.is_reported
    is_lost &= config.withdraw and config.method != "clusters"
    is_withdrawn = is_lost if regions.is_withdrawn is None else regions.is_withdrawn | is_lost
    regions = replace(regions, is_reported=regions.is_reported & ~is_lost, is_withdrawn=is_withdrawn)
    blank = {name: np.where(is_lost, np.nan, report.figures[name]) for name in FIGURES if name in report.figures}
    figures = {**report.figures, **blank}
    return replace(report, objects=objects, regions=regions, figures=figures)


def _pair_anew(item: ChangedObject, partner: int) -> ChangedObject:
    """Return an object with another partner; one that lost it has not moved but came or went."""
    if item.partner < 0 or partner >= 0:
        return replace(item, partner=partner)
    return replace(item, partner=-1, kind="added" if item.session == "after" else "removed", displacement_map=None)


def _find_near(where: Float64Array, points: Float64Array) -> Int64Array:
    """Return which of (Q, 3) positions are near one of (P, 3) points."""
    if len(points) == 0 or len(where) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(np.isfinite(cKDTree(points).query(where, distance_upper_bound=_NEAR_M)[0]))


def _was_flush(places: SurfacePlaces, along_m: Float64Array, own: Int64Array, still: Int64Array) -> bool:
    """Tell whether what stood at some places was in line with the rock around them, which is still there."""
    depths_m = -along_m[own][along_m[own] < -_LEAST_DEPTH_M]
    around = np.setdiff1d(still, own)
    if len(depths_m) == 0 or len(around) < _LEAST_AROUND:
        return False
    middle = places.points[own].mean(axis=0)
    reach_m = float(np.linalg.norm(places.points[own] - middle, axis=1).max()) + _AROUND_M
    around = around[np.linalg.norm(places.points[around] - middle, axis=1) < reach_m]
    if len(around) < _LEAST_AROUND:
        return False
    nearest = around[np.asarray(cKDTree(places.points[around]).query(places.points[own])[1], dtype=np.int64)]
    offsets = places.points[own] - places.points[nearest]
    stood_out_m = np.einsum("ij,ij->i", offsets, places.normals[nearest])
    return float(np.percentile(stood_out_m, _HIGH_SHARE)) < _FLUSH * float(np.percentile(depths_m, _HIGH_SHARE))


def _is_floor(places: SurfacePlaces, along_m: Float64Array, own: Int64Array) -> bool:
    """Tell whether what came or went at some places is too wide and too gentle for an object."""
    area_m2 = float(places.areas_m2[own].sum())
    if area_m2 <= _WIDE_M2:
        return False
    known = np.flatnonzero(np.isfinite(along_m))
    near = known[np.isfinite(cKDTree(places.points[own]).query(places.points[known], distance_upper_bound=_RAMP_M)[0])]
    one, other = cKDTree(places.points[near]).query_pairs(_APART_M[1], output_type="ndarray").T
    apart_m = np.linalg.norm(places.points[near[one], :2] - places.points[near[other], :2], axis=1)
    rise = np.abs(along_m[near[one]] - along_m[near[other]])[apart_m > _APART_M[0]] / apart_m[apart_m > _APART_M[0]]
    share = _NEARLY if area_m2 < _WIDEST_M2 else _MOSTLY
    return len(rise) > 0 and float(np.percentile(rise, share)) < _GENTLE


def _is_below(points: Float64Array, fallen: Float64Array) -> bool:
    """Tell whether an object lies below places that rock fell from."""
    if len(fallen) < _LEAST_FALLEN or len(points) == 0:
        return False
    found = cKDTree(points[:, :2]).query(fallen[:, :2], distance_upper_bound=_BELOW_M)
    top_m = float(points[:, 2].max())
    is_above = np.isfinite(found[0]) & (fallen[:, 2] > top_m) & (fallen[:, 2] < top_m + _ROOF_M)
    return int(np.count_nonzero(is_above)) >= _LEAST_FALLEN
