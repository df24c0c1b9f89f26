"""Following an alignment along the after session's path: whether it goes on to fit, and how it bends.

From the place where it was found, sphere after sphere is registered, each from where its neighbour ended, outwards in
both directions. So the alignment follows maps that bend apart by metres, each sphere is independent evidence, and a
wrong alignment is found out where the two tunnels differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.config import MergeConfig
from cdpipe.evidence import SurfaceFit, sampled, surface_fit
from cdpipe.geometry import Float64Array, Int64Array, transform
from cdpipe.registration import MIN_SPHERE_POINTS, IndexedMap, Registration, align_sphere, motion_between

# Places farther from the before path were not driven twice.
SHARED_M = 5.0
# A registration that moves a place farther than this against its neighbour is wrong, not drift.
_JUMP_M, _JUMP_SHARE = 1.0, 0.03
_JUMP_RAD, _JUMP_RAD_PER_M = np.deg2rad(2.0), np.deg2rad(0.03)
# A first try that fits as well as this needs no second.
_CLEAR_FIT = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """How a place is registered while walking.

    Attributes:
        radius_m: Sphere around it.
        gicp_voxel_m: Thinning of the sphere for GICP.
        correspondence_m: Longest correspondence of GICP.
        first_try_m: Longest correspondence of a registration point to plane that is tried first, and taken where it
            fits; None: GICP at once.
    """

    radius_m: float
    gicp_voxel_m: float
    correspondence_m: float
    first_try_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """What was found at A after keyframes, in the order of the path.

    Attributes:
        keyframes: (A,) after keyframes.
        before_T_after: (A, 4, 4) alignment at each; carried over from its neighbour where nothing was registered.
        information: (A, 6, 6) Hessian of each registration, turn then shift in after odom axes; zero where there is
            none.
        fits: (A,) share of inliers, 0 where it did not fit or jumped, NaN where the before session never drove.
        normal_sum: (3, 3) sum of n n^T over the normals of everything that was looked at, map frame.
    """

    keyframes: Int64Array
    before_T_after: Float64Array
    information: Float64Array
    fits: Float64Array
    normal_sum: Float64Array


def walk(
    before: IndexedMap,
    after: IndexedMap,
    keyframes: Int64Array,
    start: int,
    before_T_after: Float64Array,
    step: Step,
    config: MergeConfig,
) -> Walk:
    """Register spheres around some after keyframes, from one of them outwards.

    Args:
        before: The before map, a target.
        after: The after map.
        keyframes: (A,) after keyframes, rising.
        start: Position in `keyframes` of the one where `before_T_after` was found.
        before_T_after: (4, 4) what was found there.
        step: How a place is registered.
        config: `inlier_m`.
    """
    n = len(keyframes)
    found = np.repeat(before_T_after[None], n, axis=0)
    information = np.zeros((n, 6, 6))
    fits = np.full(n, np.nan)
    normal_sum = np.zeros((3, 3))
    for way in (range(start, n), range(start - 1, -1, -1)):
        previous = start
        for place in way:
            centre = after.positions[keyframes[place]]
            found[place] = found[previous]
            if is_shared(before, transform(found[place], centre[None]))[0]:
                apart_m = float(np.linalg.norm(centre - after.positions[keyframes[previous]]))
                fits[place] = 0.0
                registered = _registered(before, after, centre, found[previous], apart_m, step, config)
                if registered is not None:
                    result, fit = registered
                    found[place], information[place] = result.target_T_source, result.information
                    fits[place] = fit.inlier_share(config.inlier_m)
                    normal_sum += fit.normal_sum
            previous = place
    return Walk(keyframes, found, information, fits, normal_sum)


def is_shared(before: IndexedMap, positions_map: Float64Array) -> Float64Array:
    """Return for (N, 3) positions in the map frame whether the before session passed within 5 m."""
    distances_m, _ = before.path.query(positions_map, distance_upper_bound=SHARED_M)
    return np.isfinite(distances_m)


def evenly(n_keyframes: int, n: int, and_also: Sequence[int] = ()) -> Int64Array:
    """Return about n keyframes of a path, evenly spaced, and some others."""
    chosen = np.linspace(0, n_keyframes - 1, min(n, n_keyframes)).round().astype(np.int64)
    return np.unique(np.concatenate([chosen, np.array(and_also, dtype=np.int64)]))


def _registered(
    before: IndexedMap,
    after: IndexedMap,
    centre: Float64Array,
    guess: Float64Array,
    apart_m: float,
    step: Step,
    config: MergeConfig,
) -> tuple[Registration, SurfaceFit] | None:
    """Register one place; None where it has too few points, or ends farther away than odometry can have drifted."""
    points = after.sphere(centre, step.radius_m)
    if len(points) < MIN_SPHERE_POINTS:
        return None
    own = sampled(points)
    if step.first_try_m is not None:
        found = align_sphere(own, centre, before.target, guess, step.first_try_m)
        fit = surface_fit(before, after, found.target_T_source, own, centre, step.radius_m)
        if fit.inlier_share(config.inlier_m) >= _CLEAR_FIT and _is_near(found.target_T_source, guess, centre, apart_m):
            return found, fit
    found = align_sphere(points, centre, before.target, guess, step.correspondence_m, step.gicp_voxel_m)
    if not _is_near(found.target_T_source, guess, centre, apart_m):
        return None
    return found, surface_fit(before, after, found.target_T_source, own, centre, step.radius_m)


def _is_near(pose: Float64Array, guess: Float64Array, centre: Float64Array, apart_m: float) -> bool:
    jump_m, jump_rad = motion_between(pose, guess, centre)
    return jump_m <= _JUMP_M + _JUMP_SHARE * apart_m and jump_rad <= _JUMP_RAD + _JUMP_RAD_PER_M * apart_m
