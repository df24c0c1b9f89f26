"""The evidence for an alignment of two maps, and the acceptance gates.

The fit is measured by point-to-plane distances: a point of one map against the plane of the nearest point of the other.
In a straight drift the distance to the nearest point is small at any shift along the axis. The point-to-plane distance
is not, because the wall has relief of decimetres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float64Array, invert, plane_jacobian, transform
from cdpipe.mapping.free_space import is_veiled
from cdpipe.merge.registration import IndexedMap, search_nearest
from cdpipe.model.config import MergeConfig

# Name of the evidence, and the setting of `merge` that is its lower limit.
GATES = (
    ("overlap", "min_overlap"),
    ("inlier_share", "min_inlier_share"),
    ("hessian_ratio", "min_hessian_ratio"),
    ("agreement", "min_agreement"),
    ("distinctness", "min_distinctness"),
)
# Largest motion between the registration of one place from after to before and the one from before to after.
BOTH_WAYS_M, BOTH_WAYS_DEG = 0.05, 0.5
# Points sampled from a sphere, and the longest correspondence.
_SAMPLES = 300
_COUNTERPART_M = 0.5
# Distance up to which a point holds the alignment.
_FITS_M = 0.1
# Shares of points without a counterpart at which a session is asked whether mist hid them from it.
_MISSING = (0.02, 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """The fit of two maps in a sphere around one place.

    Attributes:
        forward_m: (N,) point-to-plane distances of after points to the before map, metres; inf if the nearest point
            is over 0.5 m away.
        backward_m: (M,) the same for before points to the after map.
            Points that mist or dust hid from the other session are in neither.
        information: (6, 6) Hessian of the forward distances within 0.1 m: rotation, then translation, after odom axes
            about the place. If all normals are orthogonal to one direction, the translation along it is unconstrained.
            What does not fit constrains nothing: objects or niches that one session alone has.
    """

    forward_m: Float64Array
    backward_m: Float64Array
    information: Float64Array

    def inlier_share(self, inlier_m: float) -> float:
        """Return the share of points within `inlier_m` of the other surface, the smaller of both directions."""
        return min(float(np.mean(d < inlier_m)) if len(d) else 0.0 for d in (self.forward_m, self.backward_m))

    @property
    def residual_m(self) -> float:
        """Median distance of both directions together, metres; NaN without correspondences."""
        median_m = float(np.median(np.concatenate([self.forward_m, self.backward_m])))
        return median_m if np.isfinite(median_m) else float("nan")


def measure_fit(
    before: IndexedMap,
    after: IndexedMap,
    before_T_after: Float64Array,
    own: Float64Array,
    centre_after: Float64Array,
    radius_m: float,
) -> SurfaceFit:
    """Measure the point-to-plane distances of both maps around one place.

    Both directions use the normals of the before map, which are estimated while the first session is mapped.

    Args:
        before: The before map, indexed as a target.
        after: The after map.
        before_T_after: (4, 4) the alignment to judge.
        own: (N, 3) `sample_evenly` after points of the place, after odom frame.
        centre_after: (3,) the place, after odom frame.
        radius_m: Radius of the sphere of before points, metres.
    """
    centre_before = transform(before_T_after, centre_after[None])[0]
    fine, rows = before.target_near(centre_before, radius_m + _COUNTERPART_M)
    moved = transform(before_T_after, own)
    found, squared_m2 = search_nearest(fine.tree, moved)
    normals = fine.normals[found]
    forward_m = plane_distances(moved, fine.points[found], normals, squared_m2)
    is_fit = forward_m <= _FITS_M
    jacobian = plane_jacobian(own[is_fit] - centre_after, normals[is_fit] @ before_T_after[:3, :3])
    information = jacobian.T @ jacobian

    chosen = sample_evenly(before.columns.crop(centre_before, radius_m))
    theirs = transform(invert(before_T_after), before.points[chosen])
    nearest, squared_m2 = after.nearest_near(centre_after, radius_m + _COUNTERPART_M, theirs)
    turned = fine.normals[chosen if rows is None else np.searchsorted(rows, chosen)] @ before_T_after[:3, :3]
    backward_m = plane_distances(theirs, nearest, turned, squared_m2)
    return SurfaceFit(
        _without_veiled(forward_m, moved, before), _without_veiled(backward_m, theirs, after), information
    )


def _without_veiled(distances_m: Float64Array, points: Float64Array, other: IndexedMap) -> Float64Array:
    """Return the distances without those of (N, 3) points that the other session could not see for mist or dust.

    Nothing is left out where more than half of the points have no counterpart, because then the alignment is wrong, or
    where so few have none that they do not matter.
    """
    is_missing, views = np.isinf(distances_m), other.map.views
    least, most = (share * len(distances_m) for share in _MISSING)
    if views is None or not least < np.count_nonzero(is_missing) < most or not other.has_mist:
        return distances_m
    is_missing[is_missing] = is_veiled(points[is_missing], views)
    return distances_m[~is_missing]


def sample_evenly(of_map: npt.NDArray[Any], n: int = _SAMPLES) -> npt.NDArray[Any]:
    """Return every k-th of the points of a map, about n; map points are ordered by place, so this is even coverage."""
    return of_map[:: max(1, len(of_map) // n)]


def explain_refusal(evidence: Mapping[str, float], config: MergeConfig) -> str:
    """Return the first gate that fails and what the user can do about it, or "" if all pass."""
    for name, setting in GATES:
        value, least = evidence.get(name, np.nan), getattr(config, setting)
        # this form also refuses NaN, a value that could not be measured
        if not value >= least:
            if np.isnan(value):
                told = _UNMEASURED.get(name, f"{name} could not be measured")
                return f"{told}: {_RECORD}; merge.{setting} asks for it"
            is_share = name not in ("hessian_ratio", "distinctness")
            said, asked = (f"{value:.0%}", f"{least:.0%}") if is_share else (f"{value:.4g}", f"{least:g}")
            reasons = _REASONS | (_OF_ONE_PLACE if "both_ways_m" in evidence else {})
            return f"{reasons[name].format(value=said)}; merge.{setting} asks for {asked}"
    return _explain_both_ways(evidence)


def _explain_both_ways(evidence: Mapping[str, float]) -> str:
    """Return why the registrations of one place in both directions are refused, "" if they agree or there are none."""
    apart_m, apart_deg = evidence.get("both_ways_m", 0.0), evidence.get("both_ways_deg", 0.0)
    if apart_m <= BOTH_WAYS_M and apart_deg <= BOTH_WAYS_DEG:
        return ""
    return (
        f"the registrations from after to before and from before to after differ by {apart_m:.2g} m and "
        f"{apart_deg:.2g} deg (both_ways): {_RECORD}; at most {BOTH_WAYS_M:g} m and {BOTH_WAYS_DEG:g} deg are accepted"
    )


def plane_distances(
    points: Float64Array, nearest: Float64Array, normals: Float64Array, squared_m2: Float64Array
) -> Float64Array:
    """Return the (N,) point-to-plane distances, metres; inf if the nearest point is over 0.5 m away.

    Args:
        points: (N, 3) points.
        nearest: (N, 3) nearest point of the surface to each.
        normals: (N, 3) their unit normals.
        squared_m2: (N,) squared distances of both.
    """
    distances = np.abs(np.einsum("ij,ij->i", points - nearest, normals))
    return np.where(squared_m2 < _COUNTERPART_M**2, distances, np.inf)


_REASONS = {
    "overlap": "the paths meet along only {value} of the shorter one: the sessions may not overlap, or more of the way "
    "must be driven twice",
    "inlier_share": "only {value} of the points around the best pair of places fit the other map: the sessions may "
    "not overlap, or the tunnel has changed too much there",
    "hessian_ratio": "the alignment can slide (degenerate): its Hessian's eigenvalue ratio is {value}, the tunnel is "
    "too smooth and straight to tell where along it the robot was; drive on to a bend, a branch or a niche",
    "agreement": "the best pair of places fits, but along both paths only {value} of the points do: two places that "
    "look alike, or odometry that drifts by more than a few percent",
    "distinctness": "another alignment fits nearly as well (its residual is {value} times this one's): the tunnel "
    "repeats itself; drive on to where it does not",
}

_RECORD = "record a path of ten metres or more through the place, in both sessions"
# One place shows less than a path: what to record instead.
_OF_ONE_PLACE = {
    "overlap": "after the best registration {value} of the shorter recording lies within 5 m of the other: they are of "
    f"other places; {_RECORD}",
    "inlier_share": "only {value} of the points around the place fit the other map: the recordings may be of other "
    f"places, or too much has changed; {_RECORD}",
    "hessian_ratio": "the alignment can slide (degenerate): its Hessian's eigenvalue ratio is {value}, one place of a "
    f"smooth drift does not tell where along it the sensor stood; {_RECORD}, up to a bend, a branch or a niche",
    "agreement": "only {value} of all points near the place fit the other map, in the worse of both directions: the "
    f"recordings see too little of one another, or are of other places; {_RECORD}",
}
_UNMEASURED = {"agreement": "the best pair of places fits, and fewer than three further places could be compared"}
