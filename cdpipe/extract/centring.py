"""Centre the reported regions on their objects: a proposal is a keyframe, and its object may lie at the rim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cdpipe.core.geometry import Float64Array
from cdpipe.extract.objects import PointGroup
from cdpipe.extract.surface_rule import BEYOND_M
from cdpipe.model.report import ChangeRegions

_BALL_STEPS = 200
_ROUNDING_M = 1e-6


def centre_regions(
    regions: ChangeRegions, groups: Sequence[PointGroup], *, withdraw: bool = True, most: int | None = None
) -> tuple[ChangeRegions, list[PointGroup]]:
    """Centre every reported region on the objects in its sphere; withdraw it if better regions contain all of them.

    Regions are centred best first, and each object is used once: an object whose centroid lies in the sphere of a
    better, centred region justifies no other region. The new centre is that of the smallest ball around the centroids
    of the other objects in the sphere, so it is no farther from the farthest of them than the proposed centre was.
    Objects whose centroids come into the sphere with it justify no other region either: the centre is that of the
    smallest ball around them, too. If a ball is larger than the sphere, the objects with the fewest points are left
    out.

    An object is followed out of the spheres, so it may lie in none that is reported. The best candidate whose sphere
    holds its centroid is then reported, too, and centred on it, whatever its score.

    Of an object the part within 1.5 m of the sphere counts. Scores, order, radius and regions without objects stay as
    they are.

    Args:
        regions: Candidates; the reported ones are centred.
        groups: All objects, at least one.
        withdraw: Withdraw the regions with objects that are all in better ones; otherwise they stay where they are.
        most: Largest number of regions to report; None for any.

    Returns:
        The regions, with the centres at which they were proposed; and the groups, each with the nearest
        reported region that reaches it.
    """
    centres, is_reported, objects = regions.centres_map.copy(), regions.is_reported.copy(), _Objects(groups)
    centred: list[int] = []
    for region, radius_m in enumerate(regions.radii_m.tolist()):
        if not regions.is_reported[region]:
            continue
        taken = centres[centred], regions.radii_m[centred]
        parts = objects.parts_within(regions.centres_map[region], radius_m)
        own = [index for index, part in parts.items() if not _is_within(part.mean(axis=0), *taken)]
        if own:
            places = [parts[index].mean(axis=0) for index in own]
            centre = _enclosing_centre(np.array(places), radius_m)
            reached = objects.parts_within(centre, radius_m)
            more = [part.mean(axis=0) for index, part in reached.items() if index not in own]
            here = centre[None], np.array([radius_m])
            places += [place for place in more if _is_within(place, *here) and not _is_within(place, *taken)]
            centres[region] = _enclosing_centre(np.array(places), radius_m)
            centred.append(region)
        elif parts and withdraw:
            is_reported[region] = False
    for place in objects.middles:
        is_full = most is not None and np.count_nonzero(is_reported) >= most
        if is_full or _is_within(place, centres[is_reported], regions.radii_m[is_reported]):
            continue
        holding = np.linalg.norm(regions.centres_map - place, axis=1) <= regions.radii_m
        if len(found := np.flatnonzero(holding & ~is_reported)):
            centres[found[0]], is_reported[found[0]] = place, True
    moved = replace(
        regions,
        centres_map=centres,
        is_reported=is_reported,
        is_withdrawn=regions.is_proposed & ~is_reported if withdraw else regions.is_withdrawn,
        proposed_centres_map=regions.centres_map,
    )
    return moved, [_with_nearest_region(group, moved) for group in groups]


def _with_nearest_region(group: PointGroup, regions: ChangeRegions) -> PointGroup:
    """Return a group with the nearest of the reported regions that reach its centroid, if one does."""
    away_m = np.linalg.norm(regions.centres_map - group.points_map.mean(axis=0), axis=1)
    away_m[~regions.is_reported | (away_m > regions.radii_m + BEYOND_M)] = np.inf
    region = int(np.argmin(away_m))
    return replace(group, region=region) if np.isfinite(away_m[region]) else group


class _Objects:
    """Objects, each in a ball around its centroid: only those of which the ball reaches a sphere are measured."""

    def __init__(self, groups: Sequence[PointGroup]) -> None:
        self._points = [group.points_map for group in groups]
        self.middles = np.array([points.mean(axis=0) for points in self._points])
        self._reach_m = np.array(
            [np.linalg.norm(p - middle, axis=1).max() for p, middle in zip(self._points, self.middles, strict=True)]
        )

    def parts_within(self, centre: Float64Array, radius_m: float) -> dict[int, Float64Array]:
        """Return the points (P, 3) within `BEYOND_M` of a sphere of each object, by index, that has a point in it.

        The objects with the most points come first.
        """
        parts = {}
        is_near = np.linalg.norm(self.middles - centre, axis=1) <= radius_m + self._reach_m + _ROUNDING_M
        for index in np.flatnonzero(is_near).tolist():
            away_m = np.linalg.norm(self._points[index] - centre, axis=1)
            if away_m.min() <= radius_m:
                parts[index] = self._points[index][away_m <= radius_m + BEYOND_M]
        return dict(sorted(parts.items(), key=lambda item: -len(item[1])))


def _is_within(place: Float64Array, centres: Float64Array, radii_m: Float64Array) -> bool:
    return bool((np.linalg.norm(place - centres, axis=1) <= radii_m).any())


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
