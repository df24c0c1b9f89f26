"""The surface rule over all reported regions: candidates by sphere, sites over all of them, objects by their returns.

An object between two regions is one site, and so one object; two objects in one region are two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, transform, travelled_m
from cdpipe.core.voxel import cell_means
from cdpipe.extract.crops import DIRECTIONS, Crops, Sphere
from cdpipe.extract.objects import PointGroup, ReturnPool
from cdpipe.extract.point_comparison import label_groups
from cdpipe.extract.surface import (
    CELL_M,
    RIM_M,
    SITE_M,
    SURFACE_CELL_M,
    PlaneTable,
    Site,
    compare_site,
    find_candidates,
    find_nearest,
    grow_low_objects,
    grow_objects,
    unassigned_cells,
)
from cdpipe.mapping.free_space import REACH_M, count_through_and_hit, free_space_votes, grazing_ray_count
from cdpipe.merge.registration import MIN_SPHERE_POINTS, Surface, align_to_planes
from cdpipe.model.config import ExtractConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import MergedMaps, PointMap, SessionName

# An object that begins inside of a sphere is followed this far out of it.
BEYOND_M = 1.5
# Correspondences of the rounds of re-alignment, and how far it may carry a sphere: more is no correction.
_ROUNDS_M = (0.5, 0.25)
_MAX_SHIFT_M = 0.4
# A site with fewer such candidates holds no object of a tenth of a cubic metre.
_MIN_TELLING = 2
# What is nearer to the other map than this may be too low for a view to tell whether it was seen through.
_LOW_M = 0.3
# Seen through by keyframes of its own session so many times as often as hit: a wall that drift has doubled.
_DOUBLED = 3.0
# What keyframes looked at from here is seen by their scans, most of all: half of the reach of views.
_NEAR_M = REACH_M / 2
_UNKNOWN_VIEWS = np.int64(1 << 20)


# Ends, origins (both re-aligned map frame) and scans of some returns.
Rays = tuple[Float64Array, Float64Array, Int64Array]


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Candidates of one session in one region: map points, and whether they make a site worth a closer look.

    They do inside of the sphere, where the other session saw through them or they are low.
    """

    session: SessionName
    region: int
    indices: Int64Array
    is_telling: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Agreement:
    """How the surfaces of two spheres agree: (4, 4) the correction of the after one, and what distance is left."""

    correction: Float64Array
    noise_m: float


def cut_by_surface(merged: MergedMaps, regions: ChangeRegions, config: ExtractConfig) -> list[PointGroup]:
    """Return the objects that stand out of the other session's surface in the reported regions, best region first."""
    crops = Crops(merged, margin_m=BEYOND_M)
    found: list[_Candidates] = []
    agreements: dict[int, _Agreement] = {}
    for region in np.flatnonzero(regions.is_reported).tolist():
        spheres = crops.around(regions.centres_map[region], regions.radius_m)
        if min(len(sphere.indices) for sphere in spheres.values()) == 0:
            continue
        agreements[region], of_region = _compare_region(merged, spheres, regions.centres_map[region], region, config)
        found += of_region
    sites = _find_sites(crops, found, agreements)
    return _cut_sites(merged, sites, config)


def _compare_region(
    merged: MergedMaps,
    spheres: dict[SessionName, Sphere],
    centre: Float64Array,
    region: int,
    config: ExtractConfig,
) -> tuple[_Agreement, list[_Candidates]]:
    """Return how the two spheres fit, and the candidates of both sessions."""
    before, after = spheres["before"].points, spheres["after"].points
    surface = Surface(before)
    correction = realign(after, centre, surface) if config.realign else np.eye(4)
    after = transform(correction, after)
    compared = {"after": (after, PlaneTable(surface)), "before": (before, PlaneTable(Surface(after)))}
    found, noise_m = [], {}
    for session, other in DIRECTIONS:
        points, reference = compared[session]
        chosen, noise_m[session] = find_candidates(points, reference)
        sphere = spheres[session]
        is_low = find_nearest(points[chosen], reference.surface)[1] < _LOW_M
        is_telling = sphere.is_inside[chosen] & (
            is_low | (_free_space_votes(points[chosen], merged, other, correction) > 0)
        )
        found.append(_Candidates(session, region, sphere.indices[chosen], is_telling))
    return _Agreement(correction, max(noise_m.values())), found


def realign(after: Float64Array, centre: Float64Array, surface: Surface) -> Float64Array:
    """Return the (4, 4) correction, map frame, that brings a sphere of the after map onto the before map's surface.

    The identity where there is too little to align or where it would carry the sphere farther than a correction may.
    """
    correction = np.eye(4)
    if min(len(after), len(surface.points)) < MIN_SPHERE_POINTS:
        return correction
    for correspondence_m in _ROUNDS_M:
        correction = align_to_planes(after, centre, surface, correction, correspondence_m)
    shift_m = np.linalg.norm(transform(correction, centre[None])[0] - centre)
    return correction if shift_m <= _MAX_SHIFT_M else np.eye(4)


@dataclass(frozen=True, slots=True, eq=False)
class _Site:
    """Map points of both sessions around candidates of one, and the region whose correction holds there."""

    session: SessionName
    region: int
    own: Int64Array
    others: Int64Array
    agreement: _Agreement


def _find_sites(crops: Crops, found: Iterable[_Candidates], agreements: dict[int, _Agreement]) -> list[_Site]:
    """Put the candidates of all regions together, session by session; best region first."""
    sites = []
    for session, other in DIRECTIONS:
        of_session = [each for each in found if each.session == session and len(each.indices)]
        if not of_session:
            continue
        indices = np.concatenate([each.indices for each in of_session])
        is_telling = np.concatenate([each.is_telling for each in of_session])
        region = np.concatenate([np.full(len(each.indices), each.region) for each in of_session])
        order = np.lexsort((region, ~is_telling, indices))  # of a point's regions the best in which it tells
        first = order[np.unique(indices[order], return_index=True)[1]]
        indices, is_telling, region = indices[first], is_telling[first], region[first]
        points = crops.points_map(session, indices)
        labels, sizes = label_groups(points, 2 * SITE_M)  # nearer ones would look at the same returns
        for label in np.flatnonzero(np.bincount(labels, is_telling, len(sizes)) >= _MIN_TELLING):
            members = labels == label
            best = int(region[members & is_telling].min())
            own = crops.near(session, points[members], SITE_M)
            others = crops.near(other, points[members], SITE_M + RIM_M)
            sites.append(_Site(session, best, own, others, agreements[best]))
    return sorted(sites, key=lambda site: site.region)


def _cut_sites(merged: MergedMaps, sites: list[_Site], config: ExtractConfig) -> list[PointGroup]:
    maps = {"before": merged.before, "after": merged.after}
    pools = {
        name: ReturnPool(
            maps[name],
            [site.own if site.session == name else site.others for site in sites],
        )
        for name in maps
    }
    result = []
    for site in sites:
        other: SessionName = "before" if site.session == "after" else "after"
        correction = site.agreement.correction
        returns = {site.session: pools[site.session].of(site.own), other: pools[other].of(site.others)}
        after_map = merged.alignment.to_map(merged.after.positions_of(returns["after"]))
        points = {
            "before": merged.before.positions_of(returns["before"]),
            "after": transform(correction, after_map),
        }
        compared = compare_site(points[site.session], points[other])
        n_views = _free_space_votes(compared.points, merged, other, correction)
        rays = partial(collect_rays, merged, other, returns[other], points[other], correction)
        for cells in find_object_cells(compared, n_views, rays, site.agreement.noise_m, config):
            is_member = np.zeros(len(compared.points), dtype=np.bool_)
            is_member[cells] = True
            of_object = is_member[compared.cell_of_return]
            chosen = returns[site.session][of_object]
            if _is_out_of_place(maps[site.session], chosen):
                continue
            # the answer is in the map frame of the merge
            in_map = (points["before"] if site.session == "before" else after_map)[of_object]
            indices = np.unique(maps[site.session].return_points[chosen]).astype(np.int64)
            thinned, _ = cell_means(in_map, SURFACE_CELL_M)
            result.append(PointGroup(site.session, indices, thinned, site.region, chosen))
    return result


def _is_out_of_place(point_map: PointMap, returns: Int64Array) -> bool:
    """Tell whether some returns of a session stand where there was nothing, by the word of the session itself.

    Where a session came by twice and its odometry drifted in between, or where it saw a wall from far down another
    drift, the wall stands twice in its map: the map is wrong there, and nothing changed. Either of two things tells:

    - the session saw through them, far more often than it hit them. What stands is hit again and again;
    - it looked at the place from near, and yet most of them, by the way driven, came from afar: from near, something
      else was there.

    A thing that stands twice because of drift is seen from near on either pass, and hit by one about as often as the
    other sees through it; so it stays.
    """
    if point_map.views is None:
        return False
    points = point_map.positions_of(returns)
    places, _ = cell_means(points, CELL_M)
    n_through, n_hit = count_through_and_hit(places, point_map.views)
    if n_through.sum() > _DOUBLED * n_hit.sum():
        return True
    scans = np.searchsorted(point_map.scan_offsets, returns, side="right") - 1
    ranges_m = np.linalg.norm(points - point_map.odom_T_sensor[scans, :3, 3], axis=1)
    # of a robot that waits, a thousand scans tell what one tells
    way_m = np.diff(travelled_m(point_map.odom_T_sensor), prepend=0.0)[scans]
    if way_m[ranges_m > REACH_M].sum() <= way_m[ranges_m <= REACH_M].sum():
        return False
    n_looked = sum(count_through_and_hit(places, point_map.views, within_m=_NEAR_M))
    return bool(np.mean(n_looked > 0) > 0.5)


def find_object_cells(
    site: Site, n_views: Int64Array, rays: Callable[[], Rays], noise_m: float, config: ExtractConfig
) -> list[Int64Array]:
    """Return the cells of each object of a site: what the views tell of, then the low ones, of which only rays do.

    Args:
        site: Its cells.
        n_views: (N,) keyframes of the other session that saw through each cell, less those that hit it.
        rays: The other session's, called where they are needed.
        noise_m: Median distance of the two maps' surfaces around here.
        config: Thresholds.
    """
    objects = grow_objects(site, n_views, noise_m, config)
    left = unassigned_cells(site, objects, noise_m, config)
    if len(left) == 0:
        return objects
    return objects + grow_low_objects(
        site, left, grazing_ray_count(site.points[left], *rays()), objects, noise_m, config
    )


def _free_space_votes(
    points_map: Float64Array, merged: MergedMaps, other: SessionName, correction: Float64Array
) -> Int64Array:
    """Return how often the other session saw through (N, 3) places in the re-aligned map frame, less how often it hit.

    Of a map that kept no views that is unknown, and more than any number asked for.
    """
    views = (merged.before if other == "before" else merged.after).views
    if views is None:
        return np.full(len(points_map), _UNKNOWN_VIEWS)
    if other == "after":
        points_map = merged.alignment.to_odom(transform(invert(correction), points_map))
    return free_space_votes(points_map, views)


def collect_rays(
    merged: MergedMaps, session: SessionName, returns: Int64Array, ends: Float64Array, correction: Float64Array
) -> Rays:
    """Return the (M, 3) ends of some returns as given, where the sensor was (M, 3), and the (M,) scan of each."""
    point_map = merged.before if session == "before" else merged.after
    scans = np.searchsorted(point_map.scan_offsets, returns, side="right") - 1
    seen, scan_of_return = np.unique(scans, return_inverse=True)
    origins = point_map.odom_T_sensor[seen, :3, 3]
    if session == "after":
        origins = transform(correction, merged.alignment.to_map(origins))
    return ends, origins[scan_of_return], scans
