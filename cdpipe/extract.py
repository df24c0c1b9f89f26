"""Cutting the changed objects out of the reported regions by point-to-voxel comparison, in both directions.

Added is what the after map has in voxels the before map leaves empty; removed is the reverse; an added and a removed
object of about the same size are one moved object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from cdpipe.config import PipelineConfig
from cdpipe.geometry import BoolArray, Float64Array, Int64Array
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

# How far the alignment may bend between the centre of a sphere and its border: 1 % drift makes 0.1 m of 10 m.
_BEND_M = 0.5
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
        spheres = crops.around(regions.centres_map[region], regions.radius_m)
        found: list[PointGroup] = []
        for session, other in _DIRECTIONS:
            indices, points = spheres[session].inside
            for members in _new_clusters(points, spheres[other].points, is_taken[session][indices], config):
                found.append(PointGroup(session, indices[members], points[members], region))
                is_taken[session][indices[members]] = True
        _, after_points = spheres["after"].inside
        figures["v_sphere_m3"][region] = hull_volume_m3(after_points)
        added = [group.points_map for group in found if group.session == "after"]
        figures["v_oe_m3"][region] = sum(hull_volume_m3(points) for points in added)
        figures["s_points"][region] = len(after_points)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Sphere:
    """Map points (N,) of one session, where they lie in the map frame (N, 3), and which of them the sphere holds.

    The others are in voxels that the sphere touches.
    """

    indices: Int64Array
    points: Float64Array
    is_inside: BoolArray

    @property
    def inside(self) -> tuple[Int64Array, Float64Array]:
        return self.indices[self.is_inside], self.points[self.is_inside]


class _Crops:
    """Spheres out of both maps, in the map frame; the after map itself is never moved as a whole."""

    def __init__(self, merged: MergedMaps, voxel_m: float) -> None:
        self._alignment = merged.alignment
        self._before, self._after = merged.before.points, merged.after.points
        self._before_index, self._after_index = MapIndex(self._before), MapIndex(self._after)
        # a voxel that reaches into the sphere reaches at most its diagonal out of it
        self._border_m = np.sqrt(3.0) * voxel_m

    def around(self, centre_map: Float64Array, radius_m: float) -> dict[SessionName, _Sphere]:
        """Return the spheres of both sessions about (3,) a centre."""
        reach_m = radius_m + self._border_m
        indices = self._before_index.crop(centre_map, reach_m)
        points = self._before[indices]
        before = _Sphere(indices, points, _is_within(points, centre_map, radius_m))
        return {"before": before, "after": self._after_sphere(centre_map, radius_m, reach_m)}

    def _after_sphere(self, centre_map: Float64Array, radius_m: float, reach_m: float) -> _Sphere:
        centre_odom = self._alignment.to_odom(centre_map[None])[0]
        if self._alignment.is_rigid:
            indices = self._after_index.crop(centre_odom, reach_m)
            points = self._after[indices]
            return _Sphere(indices, self._alignment.to_map(points), _is_within(points, centre_odom, radius_m))
        # what is a sphere in the map frame is a slightly bent one in the after session's
        indices = self._after_index.crop(centre_odom, reach_m + _BEND_M)
        points = self._alignment.to_map(self._after[indices])
        is_near = _is_within(points, centre_map, reach_m)
        points = points[is_near]
        return _Sphere(indices[is_near], points, _is_within(points, centre_map, radius_m))


def _is_within(points: Float64Array, centre: Float64Array, radius_m: float) -> BoolArray:
    offsets = points - centre
    return np.asarray(np.einsum("ij,ij->i", offsets, offsets) <= radius_m * radius_m)


def _new_clusters(
    points: Float64Array, reference: Float64Array, is_taken: BoolArray, config: PipelineConfig
) -> list[Int64Array]:
    """Return the indices into `points` of each object."""
    new = np.flatnonzero(new_points_mask(points, reference, config.extract) & ~is_taken)
    new = new[inlier_mask(points[new], config.outlier)]
    labels = cluster_labels(points[new], config.cluster)
    return [new[labels == label] for label in range(labels.max(initial=-1) + 1)]
