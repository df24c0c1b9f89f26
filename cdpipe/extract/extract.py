"""Object extraction: cut the changed objects out of the reported regions, in both directions.

Points that only the after map has are added, points that only the before map has are removed. `extract.method` chooses
the comparison: the paper's point-to-voxel comparison (`voxel`), the distance to the nearest point (`nearest`), the
distance to the surface together with free space (`surface`, `cdpipe.extract.surface_rule`), or what the source of the
regions cut out itself (`clusters`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from cdpipe.core.geometry import Float64Array
from cdpipe.extract.centring import centre_regions
from cdpipe.extract.clusters import take_clusters
from cdpipe.extract.crops import DIRECTIONS, SESSIONS, Crops
from cdpipe.extract.objects import PointGroup, assemble_objects
from cdpipe.extract.point_comparison import cluster_inliers, is_within, new_points_mask
from cdpipe.extract.surface_rule import cut_by_surface
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps

FIGURES = ("v_sphere_m3", "v_oe_m3", "s_points", "oe_points")
# Points of the before map in the sphere of a candidate as it was proposed: who looks at it has to be sent these.
ASKED_POINTS = "asked_points"


def cut_objects(merged: MergedMaps, regions: ChangeRegions, config: PipelineConfig) -> list[PointGroup]:
    """Return the groups of points that only one map has inside the reported regions, best region first.

    `voxel` and `nearest` compare map points region by region, as in the paper: an object across two regions becomes two
    objects, and the best region takes a point that lies in several.

    Args:
        merged: Both maps.
        regions: Candidates; only the reported ones are used.
        config: `extract` is used, and for `voxel` and `nearest` also `outlier` and `cluster`.
    """
    if config.extract.method == "clusters":
        return take_clusters(merged, regions, config.query)
    if config.extract.method == "surface":
        return cut_by_surface(merged, regions, config.extract)
    is_voxel, extract = config.extract.method == "voxel", config.extract
    # a voxel that intersects the sphere extends at most its diagonal beyond it
    reach_m = np.sqrt(3.0) * extract.voxel_m if is_voxel else extract.distance_m
    crops = Crops(merged, reach_m)
    is_taken = {name: np.zeros(len(merged.map_of(name).points), np.bool_) for name in SESSIONS}
    groups: list[PointGroup] = []
    for region in np.flatnonzero(regions.is_reported).tolist():
        spheres = crops.around(regions.centres_map[region], regions.radii_m[region])
        for session, other in DIRECTIONS:
            indices, points = spheres[session].inside
            others = spheres[other].points
            is_old = ~new_points_mask(points, others, extract) if is_voxel else is_within(points, others, reach_m)
            new = np.flatnonzero(~is_old & ~is_taken[session][indices])
            for members in cluster_inliers(points, new, config.outlier, config.cluster):
                groups.append(PointGroup(session, indices[members], points[members], region))
                is_taken[session][indices[members]] = True
    return groups


def withdraw_empty_regions(
    regions: ChangeRegions, groups: Sequence[PointGroup], config: PipelineConfig
) -> ChangeRegions:
    """Withdraw the reported regions whose sphere holds no extracted point, if `extract.withdraw` is set.

    With `extract.method: clusters` none is: a region is a cluster, and a large one may lie around its own sphere.
    """
    if not config.extract.withdraw or config.extract.method == "clusters":
        return regions
    is_empty = regions.is_reported.copy()
    if groups:
        tree = cKDTree(np.concatenate([group.points_map for group in groups]))
        gaps_m, _ = tree.query(regions.centres_map[is_empty])
        is_empty[is_empty] = np.asarray(gaps_m) > regions.radii_m[is_empty]
    return replace(regions, is_reported=regions.is_reported & ~is_empty, is_withdrawn=is_empty)


def measure_regions(
    regions: ChangeRegions,
    groups: Sequence[PointGroup],
    after_within: Callable[[Float64Array, float], Float64Array],
) -> dict[str, Float64Array]:
    """Return the figures of the paper's Table II, all of the after map: (R,) by name, NaN if not reported.

    `v_sphere_m3` is the volume of the convex hull of the map points in the sphere, `v_oe_m3` the sum of the hull
    volumes of the region's objects, `s_points` and `oe_points` the numbers of points. An object counts as a whole, in
    the best region that it lies in.

    Args:
        regions: Candidates; the reported ones are measured.
        groups: Points of all objects.
        after_within: Returns the (N, 3) after map points within a radius of a centre (3,), map frame, metres.
    """
    figures = {name: np.full(len(regions.scores), np.nan) for name in FIGURES}
    for region in np.flatnonzero(regions.is_reported).tolist():
        points = after_within(regions.centres_map[region], regions.radii_m[region])
        added = [group for group in groups if group.session == "after" and group.region == region]
        figures["v_sphere_m3"][region] = hull_volume_m3(points)
        figures["v_oe_m3"][region] = sum(hull_volume_m3(group.points_map) for group in added)
        figures["s_points"][region] = len(points)
        figures["oe_points"][region] = sum(len(group.indices) for group in added)
    return figures


def count_asked_points(regions: ChangeRegions, crops: Crops) -> Float64Array:
    """Return (R,) the points of the before map in the sphere of each candidate as it was proposed."""
    centres = regions.centres_map if regions.proposed_centres_map is None else regions.proposed_centres_map
    spheres = zip(centres, regions.radii_m, strict=True)
    return np.array([len(crops.crop("before", centre, radius_m)[0]) for centre, radius_m in spheres], dtype=np.float64)


def extract_changes(
    merged: MergedMaps,
    regions: ChangeRegions,
    described: tuple[DescriptorSet, DescriptorSet],
    t_cd_s: float,
    config: PipelineConfig,
) -> ChangeReport:
    """Extract the objects of the reported regions, withdraw the regions without an object, and centre the others.

    Args:
        merged: Both maps.
        regions: Candidates, of any method.
        described: Descriptors of the before and of the after session; only the scans of their keyframes are used.
        t_cd_s: Seconds that it took to find the regions.
        config: All settings.
    """
    start = perf_counter()
    groups = cut_objects(merged, regions, config)
    regions = withdraw_empty_regions(regions, groups, config)
    if groups and config.extract.method == "surface" and config.extract.recentre:
        regions, groups = centre_regions(regions, groups, withdraw=config.extract.withdraw, most=config.query.n_regions)
    grouped = perf_counter()
    objects = assemble_objects(merged, groups)
    end = perf_counter()
    seconds = {"t_cd_s": t_cd_s, "t_oe_s": end - start, "t_returns_s": end - grouped}
    crops = Crops(merged, margin_m=0.0)
    regions = replace(regions, clusters=None)
    figures = measure_regions(regions, groups, lambda centre, radius_m: crops.crop("after", centre, radius_m)[1])
    figures[ASKED_POINTS] = count_asked_points(regions, crops)
    return make_report(merged, described, regions, objects, figures, seconds, config)


def make_report(
    merged: MergedMaps,
    described: tuple[DescriptorSet, DescriptorSet],
    regions: ChangeRegions,
    objects: Sequence[ChangedObject],
    figures: Mapping[str, Float64Array],
    seconds: Mapping[str, float],
    config: PipelineConfig,
) -> ChangeReport:
    """Return the report on two merged maps; `described` gives the keyframe scans of both sessions."""
    local = None
    if merged.local is not None:
        local = merged.local.at(merged.after.odom_T_sensor[described[1].keyframe_scans, :3, 3])
    return ChangeReport(
        before_T_after=merged.before_T_after,
        evidence=merged.evidence,
        regions=regions,
        objects=tuple(objects),
        seconds=seconds,
        figures=figures,
        keyframe_scans=(described[0].keyframe_scans, described[1].keyframe_scans),
        config=config.model_dump(),
        local_before_T_after=local,
    )


def hull_volume_m3(points: Float64Array) -> float:
    """Return the volume of the convex hull of (N, 3) points; 0 for fewer than four points and flat clouds."""
    if len(points) < 4:
        return 0.0
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return 0.0
