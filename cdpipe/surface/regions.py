"""Regions of rock that moved: neighbouring places whose smoothed displacement is beyond its level of detection."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int32Array
from cdpipe.core.geometry.groups import label_groups
from cdpipe.model.report import SurfaceRegion
from cdpipe.surface.places import SurfacePlaces

# A place is judged with its neighbours, of which that many count as one: they err together.
_SMOOTHED_M, _ALIKE = 0.6, 4.0
_NEIGHBOURS = 24
# A place that moved by less than this share of the mean about it is not of the region: it lies beside the region, or
# beside a single place that is off, as on the edge of a box.
_OWN = 0.3
# Places of one region are no farther apart than this many spacings.
_LINK = 1.8


def group_regions(
    places: SurfacePlaces,
    along_m: Float64Array,
    level_m: Float64Array,
    spacing_m: float,
    least_m: float,
    least_area_m2: float,
    shared_m: Float64Array | float = 0.0,
) -> tuple[Int32Array, tuple[SurfaceRegion, ...]]:
    """Return the (Q,) region of each place, -1 for none, and the regions, largest volume first.

    Args:
        places: Where displacement was measured.
        along_m: (Q,) displacement along the normal, NaN where there is none.
        level_m: (Q,) its 95 % level of detection, NaN where unknown.
        spacing_m: Edge of the voxels of the places.
        least_m: Least displacement of a region's place, smoothed.
        least_area_m2: Least area of a region.
        shared_m: (Q,) part of the level that neighbours share, or one for all.
    """
    region = np.full(len(along_m), -1, dtype=np.int32)
    known = np.flatnonzero(np.isfinite(along_m) & np.isfinite(level_m) & (level_m > 0))
    if len(known) == 0:
        return region, ()
    own_m = np.minimum(np.broadcast_to(shared_m, level_m.shape)[known], level_m[known])
    smoothed_m, smoothed_level_m = _smooth(places.points[known], along_m[known], level_m[known], own_m)
    beyond_m = np.maximum(smoothed_level_m, least_m)
    found: list[SurfaceRegion] = []
    is_own = along_m[known] * smoothed_m > _OWN * smoothed_m**2
    for own in (known[is_own & (smoothed_m > beyond_m)], known[is_own & (smoothed_m < -beyond_m)]):
        labels, sizes = label_groups(places.points[own], _LINK * spacing_m)
        for label in range(len(sizes)):
            members = own[labels == label]
            areas_m2 = places.areas_m2[members]
            if areas_m2.sum() >= least_area_m2:
                region[members] = len(found)
                found.append(_describe(places.points[members], areas_m2, along_m[members]))
    return sort_regions(region, found)


def sort_regions(region: Int32Array, regions: Sequence[SurfaceRegion]) -> tuple[Int32Array, tuple[SurfaceRegion, ...]]:
    """Return the (Q,) region of each place and the regions, largest volume first."""
    order = sorted(range(len(regions)), key=lambda index: -abs(regions[index].volume_m3))
    number = np.full(len(regions) + 1, -1, dtype=np.int32)  # the last one is that of no region
    number[order] = np.arange(len(regions))
    return number[region], tuple(regions[index] for index in order)


def _smooth(
    points: Float64Array, along_m: Float64Array, level_m: Float64Array, shared_m: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the (N,) mean displacement of each place and its neighbours, weighted by their levels, and its level."""
    found = cKDTree(points).query(points, k=[*range(1, _NEIGHBOURS + 1)], distance_upper_bound=_SMOOTHED_M)
    is_found = np.isfinite(np.asarray(found[0]))
    index = np.where(is_found, np.asarray(found[1], dtype=np.int64), 0)
    weights = is_found / level_m[index] ** 2
    total = weights.sum(axis=1)
    mean_m = (weights * along_m[index]).sum(axis=1) / total
    # the rest of the level is that of a mean of independent groups of neighbours, and no worse than that of one place
    rest_m2 = (level_m**2 - shared_m**2)[index]
    rest_m2 = (weights * rest_m2).sum(axis=1) / total * np.minimum(_ALIKE / is_found.sum(axis=1), 1.0)
    return mean_m, np.sqrt(rest_m2 + shared_m**2)


def _describe(points: Float64Array, areas_m2: Float64Array, along_m: Float64Array) -> SurfaceRegion:
    area_m2, volume_m3 = float(areas_m2.sum()), float(areas_m2 @ along_m)
    centre = areas_m2 @ points / area_m2
    mean_m = float(np.clip(volume_m3 / area_m2, along_m.min(), along_m.max()))  # rounding goes beyond equal ones
    return SurfaceRegion(centre, area_m2, volume_m3, mean_m, float(along_m[np.argmax(np.abs(along_m))]))
