"""What speaks for an alignment of two maps: how well a pair of spheres fits, and whether the rest of the maps agrees.

Two tunnels can look alike for ten metres: on validation seeds (51 right pairs of sessions, 24 of different tunnels) a
wrong merge reached an inlier share of 0.951. Along the whole path the maps then differ: right merges agreed in at least
0.989 of the points, wrong ones in at most 0.941, where only a short stretch met, and 0.72 otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.config import MergeConfig
from cdpipe.geometry import Float64Array, invert, transform
from cdpipe.sphere import MapIndex
from cdpipe.types import PointMap
from cdpipe.voxel import thinned

# What is measured, and the setting of `merge` that it must reach.
GATES = (
    ("overlap", "min_overlap"),
    ("inlier_share", "min_inlier_share"),
    ("hessian_ratio", "min_hessian_ratio"),
    ("agreement", "min_agreement"),
)
MIN_SPHERE_POINTS = 100
_OVERLAP_M = 1.0
_OVERLAP_CELL_M = 0.5
_AGREEMENT_M = 0.5
_AGREEMENT_RADIUS_M = 5.0
_AGREEMENT_SPHERES = 24


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


class MapCheck:
    """What the whole maps say about an alignment; what it needs of them is made when first asked for."""

    def __init__(self, before: PointMap, after: PointMap) -> None:
        self._before, self._after = before, after

    def agreement(self, before_T_after: Float64Array) -> float:
        """Return the share of one map's points that fit the other, wherever both sessions should have seen the same.

        Along either path, evenly spaced, spheres of 5 m: what the other map has there must lie within 0.5 m of the own
        map, because the own session passed by. Where the other map has nothing nobody disagrees, so sessions that
        overlap in part are not punished. The lower of both directions; 0 where the maps never meet.
        """
        shares = []
        for own, other, other_T_own in (
            (self._before, self._after, invert(before_T_after)),
            (self._after, self._before, before_T_after),
        ):
            n_points = n_fitting = 0
            chosen = np.linspace(0, len(own.keyframe_scans) - 1, _AGREEMENT_SPHERES).round().astype(np.int64)
            for centre in own.odom_T_keyframe[np.unique(chosen), :3, 3]:
                centre_other = transform(other_T_own, centre[None])[0]
                seen = other.points[self._index(other).crop(centre_other, _AGREEMENT_RADIUS_M)]
                reference = own.points[self._index(own).crop(centre, _AGREEMENT_RADIUS_M + _AGREEMENT_M)]
                if len(seen) and len(reference):
                    points = transform(invert(other_T_own), thinned(seen, _OVERLAP_CELL_M))
                    distances_m, _ = cKDTree(reference).query(points)
                    n_points += len(points)
                    n_fitting += int(np.count_nonzero(distances_m < _AGREEMENT_M))
            shares.append(n_fitting / n_points if n_points else 0.0)
        return min(shares)

    def _index(self, which: PointMap) -> MapIndex:
        return self._before_index if which is self._before else self._after_index

    @cached_property
    def _before_index(self) -> MapIndex:
        return MapIndex(self._before.points)

    @cached_property
    def _after_index(self) -> MapIndex:
        return MapIndex(self._after.points)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(thinned(self._before.points, _OVERLAP_CELL_M))

    @cached_property
    def _points(self) -> Float64Array:
        return thinned(self._after.points, _OVERLAP_M)

    def overlap(self, before_T_after: Float64Array) -> float:
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
    agreement = evidence.get("agreement", np.nan)
    if agreement < config.min_agreement:
        return (
            f"the best pair of places fits, but along the rest of both paths only {agreement:.0%} of the points do, "
            f"merge.min_agreement asks for {config.min_agreement:.0%}: two places that look alike"
        )
    return ""
