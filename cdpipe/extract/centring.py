"""Centre the reported regions on their objects: a proposal is a keyframe, and its object may lie at the rim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.extract.objects import PointGroup
from cdpipe.extract.surface_rule import BEYOND_M
from cdpipe.model.report import ChangeRegions

_BALL_STEPS = 200


def centre_regions(
    regions: ChangeRegions, groups: Sequence[PointGroup], *, withdraw: bool = True
) -> tuple[ChangeRegions, list[PointGroup]]:
    """Centre every reported region on the objects in its sphere; withdraw it if better regions contain all of them.

    Regions are centred best first, and each object is used once: an object whose centroid lies in the sphere of a
    better, centred region justifies no other region. The new centre is that of the smallest ball around the centroids
    of the other objects in the sphere, so it is no farther from the farthest of them than the proposed centre was. If
    that ball is larger than the sphere, the objects with the fewest points are left out.

    Of an object the part within 1.5 m of the sphere counts. Scores, order, radius and regions without objects stay as
    they are.

    Args:
        regions: Candidates; the reported ones are centred.
        groups: All objects, at least one.
        withdraw: Withdraw the regions whose objects are all in better ones; otherwise they stay where they are.

    Returns:
        The regions, with the centres at which they were proposed; and the groups, each with the nearest
        reported region that reaches it.
    """
    centres, is_reported = regions.centres_map.copy(), regions.is_reported.copy()
    centred: list[Float64Array] = []
    for region in np.flatnonzero(regions.is_reported).tolist():
        parts = _parts_within(groups, regions.centres_map[region], regions.radius_m)
        own = [part for part in parts if not _is_within(part.mean(axis=0), centred, regions.radius_m)]
        if own:
            own.sort(key=len, reverse=True)
            centres[region] = _enclosing_centre(np.array([part.mean(axis=0) for part in own]), regions.radius_m)
            centred.append(centres[region])
        elif parts and withdraw:
            is_reported[region] = False
    moved = replace(
        regions,
        centres_map=centres,
        is_reported=is_reported,
        is_withdrawn=regions.is_proposed & ~is_reported if withdraw else regions.is_withdrawn,
        proposed_centres_map=regions.centres_map,
    )
    return moved, [_with_nearest_region(group, centres, is_reported, regions.radius_m) for group in groups]


def _with_nearest_region(
    group: PointGroup, centres: Float64Array, is_reported: BoolArray, radius_m: float
) -> PointGroup:
    """Return a group with the reported region nearest to its centroid, if the region reaches it."""
    away_m = np.where(is_reported, np.linalg.norm(centres - group.points_map.mean(axis=0), axis=1), np.inf)
    region = int(np.argmin(away_m))
    return replace(group, region=region) if away_m[region] <= radius_m + BEYOND_M else group


def _parts_within(groups: Sequence[PointGroup], centre: Float64Array, radius_m: float) -> list[Float64Array]:
    """Return the points (P, 3) within `BEYOND_M` of a sphere of each object that has a point in the sphere."""
    parts = []
    for group in groups:
        away_m = np.linalg.norm(group.points_map - centre, axis=1)
        if away_m.min() <= radius_m:
            parts.append(group.points_map[away_m <= radius_m + BEYOND_M])
    return parts


def _is_within(place: Float64Array, centres: Sequence[Float64Array], radius_m: float) -> bool:
    return any(np.linalg.norm(place - centre) <= radius_m for centre in centres)


def _enclosing_centre(places: Float64Array, radius_m: float) -> Float64Array:
    """Return the (3,) centre of the smallest ball around the first of (N, 3) places, as many as a radius allows.

    Each step goes towards the farthest place, by a falling share (Badoiu and Clarkson, 2003).
    """
    centre = places.mean(axis=0)
    for step in range(1, _BALL_STEPS):
        farthest = np.argmax(np.linalg.norm(places - centre, axis=1))
        centre = centre + (places[farthest] - centre) / (step + 1)
    if len(places) > 1 and np.linalg.norm(places - centre, axis=1).max() > radius_m:
        return _enclosing_centre(places[:-1], radius_m)
    return np.asarray(centre)
