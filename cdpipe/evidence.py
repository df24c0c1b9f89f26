"""What speaks for an alignment of two maps: how well a pair of spheres fits, and how much of the maps overlaps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.config import MergeConfig
from cdpipe.geometry import Float64Array, transform
from cdpipe.types import PointMap
from cdpipe.voxel import thinned

MIN_SPHERE_POINTS = 100
_OVERLAP_M = 1.0
_OVERLAP_CELL_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """The spheres around a before and an after keyframe that may be the same place, each in its own odom frame."""

    before_points: Float64Array
    after_points: Float64Array
    before_centre: Float64Array
    after_centre: Float64Array
    descriptor_distance: float


def sphere_fit(place: Place, before_T_after: Float64Array, config: MergeConfig) -> tuple[float, float]:
    """Return inlier share and median distance over the points that lie in both spheres, both ways."""
    after_points = transform(before_T_after, place.after_points)
    after_centre = transform(before_T_after, place.after_centre[None])[0]
    # a point nearer to the other sphere's border than an inlier may have its neighbour outside
    reach_m = config.sphere_radius_m - config.inlier_m
    distances_m = []
    for points, other, centre in (
        (after_points, place.before_points, place.before_centre),
        (place.before_points, after_points, after_centre),
    ):
        common = points[np.linalg.norm(points - centre, axis=1) <= reach_m]
        if len(common) < MIN_SPHERE_POINTS:
            return 0.0, np.inf
        nearest_m, _ = cKDTree(other).query(thinned(common, config.voxel_m))
        distances_m.append(nearest_m)
    is_inlier = [np.mean(distances < config.inlier_m) for distances in distances_m]
    return float(np.mean(is_inlier)), float(np.median(np.concatenate(distances_m)))


class OverlapCheck:
    """How much of the whole after map lies near the before map; the thinned maps are made when first needed."""

    def __init__(self, before: PointMap, after: PointMap) -> None:
        self._before, self._after = before, after

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(thinned(self._before.points, _OVERLAP_CELL_M))

    @cached_property
    def _points(self) -> Float64Array:
        return thinned(self._after.points, _OVERLAP_M)

    def share(self, before_T_after: Float64Array) -> float:
        """Return the share of the after map within 1 m of the before map."""
        distances_m, _ = self._tree.query(transform(before_T_after, self._points), distance_upper_bound=_OVERLAP_M)
        return float(np.isfinite(distances_m).mean())


def why_refused(evidence: Mapping[str, float], config: MergeConfig) -> str:
    """Return in plain words which acceptance test fails, or ""."""
    share, ratio = evidence["inlier_share"], evidence["hessian_ratio"]
    if share < config.min_inlier_share:
        return (
            f"only {share:.0%} of the points of the best pair of places fit within {config.inlier_m} m, "
            f"merge.min_inlier_share asks for {config.min_inlier_share:.0%}: the sessions may not overlap"
        )
    if ratio < config.min_hessian_ratio:
        return (
            f"the best alignment can slide: its Hessian's eigenvalue ratio is {ratio:.4f}, merge.min_hessian_ratio "
            f"asks for {config.min_hessian_ratio}: the place is too smooth and straight to be located along the tunnel"
        )
    return ""
