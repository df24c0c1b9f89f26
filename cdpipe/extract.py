"""Cutting the changed objects out of the reported regions by point-to-voxel comparison, in both directions.

Added is what the after map has in voxels the before map leaves empty; removed is the reverse; an added and a removed
object of about the same size are one moved object.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from cdpipe.config import PipelineConfig
from cdpipe.geometry import BoolArray, Float64Array, Int64Array, invert, transform
from cdpipe.novelty import cluster_labels, inlier_mask, new_points_mask
from cdpipe.objects import PointGroup, assemble_objects
from cdpipe.sphere import MapIndex
from cdpipe.types import ChangeRegions, MergedMaps, SessionName

__all__ = [
    "FIGURES",
    "PointGroup",
    "assemble_objects",
    "cluster_labels",
    "cut_out",
    "hull_volume_m3",
    "inlier_mask",
    "new_points_mask",
]

FIGURES = ("v_sphere_m3", "v_oe_m3", "s_points", "oe_points")


def cut_out(
    merged: MergedMaps, regions: ChangeRegions, config: PipelineConfig
) -> tuple[list[PointGroup], dict[str, Float64Array]]:
    """Compare both maps inside every reported region and group the map points that are in one of them only.

    A map point belongs to at most one object: the better region takes it first. The figures are the paper's Table II
    by our definition, all of the after map: `v_sphere_m3` volume of the convex hull of its points in the sphere,
    `v_oe_m3` sum of the volumes of the convex hulls of its objects in the region, `s_points` its points in the sphere,
    `oe_points` those of them on the objects.

    Args:
        merged: Both maps.
        regions: Candidates; only the reported ones are looked at.
        config: `extract`, `outlier` and `cluster` are used.

    Returns:
        The groups, best region first, and (R,) figures by name, NaN for regions that are not reported.
    """
    crops = _Crops(merged, config.extract.voxel_m)
    is_taken = {
        "before": np.zeros(len(merged.before.points), np.bool_),
        "after": np.zeros(len(merged.after.points), np.bool_),
    }
    figures = {name: np.full(len(regions.scores), np.nan) for name in FIGURES}
    groups: list[PointGroup] = []
    for region in np.flatnonzero(regions.is_reported).tolist():
        centre_map = regions.centres_map[region]
        found: list[PointGroup] = []
        sphere: dict[SessionName, Float64Array] = {}
        for session, other in _DIRECTIONS:
            indices, points = crops.inside(session, centre_map, regions.radius_m)
            _, reference = crops.reaching(other, centre_map, regions.radius_m)
            sphere[session] = points
            for members in _new_clusters(points, reference, is_taken[session][indices], config):
                found.append(PointGroup(session, indices[members], points[members], region))
                is_taken[session][indices[members]] = True
        figures["v_sphere_m3"][region] = hull_volume_m3(sphere["after"])
        added = [group.points_map for group in found if group.session == "after"]
        figures["v_oe_m3"][region] = sum(hull_volume_m3(points) for points in added)
        figures["s_points"][region] = len(sphere["after"])
        figures["oe_points"][region] = sum(len(points) for points in added)
        groups += found
    return groups, figures


def hull_volume_m3(points: Float64Array) -> float:
    """Return the volume of the convex hull, 0 for fewer than four points and for flat clouds."""
    if len(points) < 4:
        return 0.0
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return 0.0


_DIRECTIONS: tuple[tuple[SessionName, SessionName], ...] = (("after", "before"), ("before", "after"))


class _Crops:
    """Spheres out of both maps, in the map frame; the after map itself is never transformed as a whole."""

    def __init__(self, merged: MergedMaps, voxel_m: float) -> None:
        self._poses = {"before": np.eye(4), "after": merged.before_T_after}
        self._points = {"before": merged.before.points, "after": merged.after.points}
        self._indices = {name: MapIndex(points) for name, points in self._points.items()}
        # a voxel that reaches into the sphere reaches at most its diagonal out of it
        self._border_m = np.sqrt(3.0) * voxel_m

    def inside(
        self, session: SessionName, centre_map: Float64Array, radius_m: float
    ) -> tuple[Int64Array, Float64Array]:
        """Return map point indices (N,) and points (N, 3) of the sphere."""
        map_T_odom = self._poses[session]
        centre_odom = transform(invert(map_T_odom), centre_map[None])[0]
        indices = self._indices[session].crop(centre_odom, radius_m)
        return indices, transform(map_T_odom, self._points[session][indices])

    def reaching(
        self, session: SessionName, centre_map: Float64Array, radius_m: float
    ) -> tuple[Int64Array, Float64Array]:
        """Return the same with every point of the voxels that the sphere touches."""
        return self.inside(session, centre_map, radius_m + self._border_m)


def _new_clusters(
    points: Float64Array, reference: Float64Array, is_taken: BoolArray, config: PipelineConfig
) -> list[Int64Array]:
    """Return the indices into `points` of each object."""
    new = np.flatnonzero(new_points_mask(points, reference, config.extract) & ~is_taken)
    new = new[inlier_mask(points[new], config.outlier)]
    labels = cluster_labels(points[new], config.cluster)
    return [new[labels == label] for label in range(labels.max(initial=-1) + 1)]
