"""The surface rule over all reported regions: candidates per sphere, sites across spheres, objects from returns.

Sites span regions, so an object across two regions is one object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, transform
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.geometry.voxel import cell_means
from cdpipe.extract.crops import DIRECTIONS, SESSIONS, Crops, Sphere
from cdpipe.extract.objects import PointGroup, ReturnPool
from cdpipe.extract.presence import keep_what_stands
from cdpipe.extract.surface import (
    MIN_SCANS_PAST,
    RIM_M,
    SITE_M,
    SURFACE_CELL_M,
    PlaneTable,
    Site,
    add_low_objects,
    compare_site,
    find_candidates,
    find_nearest,
    grow_objects,
    measure_noise_m,
    unassigned_cells,
)
from cdpipe.mapping.free_space import free_space_votes, grazing_ray_count, views_of_one
from cdpipe.merge.registration import MIN_SPHERE_POINTS, Surface, align_to_planes
from cdpipe.model.config import ExtractConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import MergedMaps, PointMap, SessionName

# Margin of a sphere: an object that starts inside the sphere is followed this far beyond it.
BEYOND_M = 1.5
# Longest correspondence of each round of re-alignment, and the largest correction that is accepted.
_ROUNDS_M = (0.5, 0.25)
_MAX_SHIFT_M = 0.4
# Least number of telling candidates of a site; fewer cannot be an object of 0.1 m^3.
_MIN_TELLING = 2
# Sites that are longer are cut at the regions. In mist the gaps of a map make candidates all along a drift.
_LONG_SITE_M = 30.0
# Share of `min_views` that a session is asked for if it met mist or dust. On 30 validation pairs of `dust/*` it finds
# one change more of 80 (a pile that 2.1 keyframes saw through, 9.0 in clear air), and nothing that is none.
_MISTY_SHARE = 0.6
# Height above the surface below which a range image cannot show free space.
_LOW_M = 0.3
_UNKNOWN_VIEWS = np.int64(1 << 20)


# End points (M, 3) and origins (M, 3), both in the re-aligned map frame, and scans (M,) of M returns.
Rays = tuple[Float64Array, Float64Array, Int64Array]


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Candidates of one session in one region: (N,) map points and the mask (N,) of the telling ones.

    A candidate is telling if it is inside the sphere, and was seen through by the other session or is low.
    """

    session: SessionName
    region: int
    indices: Int64Array
    is_telling: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Agreement:
    """The agreement of two spheres: (4, 4) correction of the after sphere, and the remaining median distance."""

    correction: Float64Array
    noise_m: float


def cut_by_surface(merged: MergedMaps, regions: ChangeRegions, config: ExtractConfig) -> list[PointGroup]:
    """Return the objects of the surface rule in the reported regions, best region first."""
    crops = Crops(merged, margin_m=BEYOND_M)
    found: list[_Candidates] = []
    agreements: dict[int, _Agreement] = {}
    for region in np.flatnonzero(regions.is_reported).tolist():
        spheres = crops.around(regions.centres_map[region], regions.radii_m[region])
        if min(len(sphere.indices) for sphere in spheres.values()) == 0:
            continue
        agreements[region], of_region = _compare_region(merged, spheres, regions.centres_map[region], region, config)
        found += of_region
    return keep_what_stands(merged, _cut_sites(merged, _find_sites(merged, crops, found, agreements), config), config)


def _compare_region(
    merged: MergedMaps,
    spheres: dict[SessionName, Sphere],
    centre: Float64Array,
    region: int,
    config: ExtractConfig,
) -> tuple[_Agreement, list[_Candidates]]:
    """Return the agreement of the two spheres, and the candidates of both sessions."""
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
    """Return the (4, 4) correction, map frame, that registers a sphere of the after map with the before surface.

    The identity if there are too few points or the correction is larger than 0.4 m.
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
    """Map points of both sessions around connected candidates, and the region and agreement that apply there."""

    session: SessionName
    region: int
    own: Int64Array
    others: Int64Array
    agreement: _Agreement


def _find_sites(
    merged: MergedMaps, crops: Crops, found: Iterable[_Candidates], agreements: dict[int, _Agreement]
) -> list[_Site]:
    """Group the candidates of all regions into sites, per session; return them by region, best first.

    A long site is one for each region: the correction of one sphere does not hold far from it.
    """
    sites = []
    for session, other in DIRECTIONS:
        of_session = [each for each in found if each.session == session and len(each.indices)]
        if not of_session:
            continue
        indices = np.concatenate([each.indices for each in of_session])
        is_telling = np.concatenate([each.is_telling for each in of_session])
        region = np.concatenate([np.full(len(each.indices), each.region) for each in of_session])
        order = np.lexsort((region, ~is_telling, indices))  # a point takes its best region in which it is telling
        first = order[np.unique(indices[order], return_index=True)[1]]
        indices, is_telling, region = indices[first], is_telling[first], region[first]
        points = merged.to_map(session, merged.map_of(session).points.take(indices, axis=0))
        labels, sizes = label_groups(points, 2 * SITE_M)  # closer sites would share returns
        for label in np.flatnonzero(np.bincount(labels, is_telling, len(sizes)) >= _MIN_TELLING):
            members = np.flatnonzero(labels == label)
            own = crops.near(session, points[members], SITE_M)
            parts = [(int(region[members[is_telling[members]]].min()), members, own)]
            if np.ptp(points[members], axis=0).max() > _LONG_SITE_M:
                own_points = merged.to_map(session, merged.map_of(session).points.take(own, axis=0))
                region_of_own = region[members[cKDTree(points[members]).query(own_points)[1]]]
                n_telling = np.bincount(region[members], is_telling[members])
                parts = [
                    (each, members[region[members] == each], own[region_of_own == each])
                    for each in np.flatnonzero(n_telling >= _MIN_TELLING).tolist()
                ]
            for best, candidates, own_part in parts:
                others = crops.near(other, points[candidates], SITE_M + RIM_M)
                sites.append(_Site(session, best, own_part, others, agreements[best]))
    return sorted(sites, key=lambda site: site.region)


def _cut_sites(merged: MergedMaps, sites: list[_Site], config: ExtractConfig) -> list[PointGroup]:
    pools = {
        name: ReturnPool(merged.map_of(name), [site.own if site.session == name else site.others for site in sites])
        for name in SESSIONS
    }
    asked = {name: _ask_for_views(merged.map_of(name), config) for name in SESSIONS}
    result = []
    for site in sites:
        other: SessionName = "before" if site.session == "after" else "after"
        own_map = merged.map_of(site.session)
        correction = site.agreement.correction
        returns = {site.session: pools[site.session].of(site.own), other: pools[other].of(site.others)}
        after_map = merged.alignment.to_map(merged.after.positions_of(returns["after"]))
        points = {"before": merged.before.positions_of(returns["before"]), "after": transform(correction, after_map)}
        compared = compare_site(points[site.session], points[other])
        n_views = _free_space_votes(compared.points, merged, other, correction)
        rays = partial(collect_rays, merged, other, returns[other], points[other], correction)
        noise_m = measure_noise_m(compared, site.agreement.noise_m)
        for cells in find_object_cells(compared, n_views, rays, noise_m, *asked[other]):
            is_member = np.zeros(len(compared.points), dtype=np.bool_)
            is_member[cells] = True
            of_object = is_member[compared.cell_of_return]
            chosen = returns[site.session][of_object]
            # the answer uses the merge's map frame, without the correction
            in_map = (points["before"] if site.session == "before" else after_map)[of_object]
            indices = np.unique(own_map.return_points[chosen]).astype(np.int64)
            thinned, _ = cell_means(in_map, SURFACE_CELL_M)
            result.append(PointGroup(site.session, indices, thinned, site.region, chosen))
    return result


def _ask_for_views(point_map: PointMap, config: ExtractConfig) -> tuple[ExtractConfig, int]:
    """Return the settings, and the least scans past a low object, of which a session can have the evidence.

    A tripod that stands every 10 m looks at a place from there alone, where a robot passes it with 25 keyframes. In
    mist fewer of them see so far.
    """
    scans, keyframes = point_map.odom_T_sensor, point_map.odom_T_sensor[point_map.keyframe_scans]
    min_views = config.min_views / views_of_one(keyframes)
    if point_map.views is not None and point_map.views.has_mist():
        min_views *= _MISTY_SHARE
    return config.model_copy(update={"min_views": min_views}), round(MIN_SCANS_PAST / views_of_one(scans))


def find_object_cells(
    site: Site,
    n_views: Int64Array,
    rays: Callable[[], Rays],
    noise_m: float,
    config: ExtractConfig,
    min_scans: int = MIN_SCANS_PAST,
) -> list[Int64Array]:
    """Return the cells of each object of a site: objects found by range images, then low objects by grazing rays.

    Args:
        site: The cells.
        n_views: (N,) keyframes of the other session that saw through each cell, minus those that hit it.
        rays: Returns the rays of the other session; called only if cells are left for low objects.
        noise_m: Median distance of the two surfaces in the region, metres.
        config: Thresholds.
        min_scans: Least number of scans of the other session with a grazing ray through a cell of a low object.
    """
    objects = grow_objects(site, n_views, noise_m, config)
    left = unassigned_cells(site, objects, noise_m, config)
    if len(left) == 0:
        return objects
    is_passed = grazing_ray_count(site.points[left], *rays()) >= min_scans
    return add_low_objects(site, left, is_passed, objects, noise_m, config)


def _free_space_votes(
    points_map: Float64Array, merged: MergedMaps, other: SessionName, correction: Float64Array
) -> Int64Array:
    """Return the (N,) free-space votes of the other session for (N, 3) places in the re-aligned map frame.

    A map without range images gives a number above every threshold.
    """
    views = merged.map_of(other).views
    if views is None:
        return np.full(len(points_map), _UNKNOWN_VIEWS)
    if other == "after":
        points_map = merged.alignment.to_odom(transform(invert(correction), points_map))
    return free_space_votes(points_map, views)


def collect_rays(
    merged: MergedMaps, session: SessionName, returns: Int64Array, ends: Float64Array, correction: Float64Array
) -> Rays:
    """Return the rays of M returns: end points (M, 3) as given, sensor positions (M, 3), and scans (M,)."""
    point_map = merged.map_of(session)
    scans = point_map.scans_of(returns)
    seen, scan_of_return = np.unique(scans, return_inverse=True)
    origins = point_map.odom_T_sensor[seen, :3, 3]
    if session == "after":
        origins = transform(correction, merged.alignment.to_map(origins))
    return ends, origins[scan_of_return], scans
