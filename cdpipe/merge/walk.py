"""The walk: register sphere after sphere along the after path, outwards from where the alignment was found.

Each registration starts from the result of its neighbour, so the alignment follows maps that drift apart by metres.
Each sphere is independent evidence: a wrong alignment stops fitting where the two tunnels differ.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, make_pose, transform
from cdpipe.merge.evidence import SurfaceFit, measure_fit, sample_evenly
from cdpipe.merge.registration import MIN_SPHERE_POINTS, IndexedMap, align_by_gicp, align_to_planes, motion_between
from cdpipe.model.config import MergeConfig

# A place is shared by both sessions within this distance of the before path.
SHARED_M = 5.0
# Largest change between neighbouring registrations that drift explains: a constant, and a rate over their distance.
_JUMP_M, _JUMP_SHARE = 1.0, 0.03
_JUMP_RAD, _JUMP_RAD_PER_M = np.deg2rad(2.0), np.deg2rad(0.03)
# Below this fit the walk is lost; it retries with half the step, down to this many keyframes.
_LOST_FIT = 0.7
_SHORTEST_STEP = 3
# A point-to-plane registration with this fit needs no GICP.
_CLEAR_FIT = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Registration settings of one place.

    Attributes:
        radius_m: Radius of the sphere.
        gicp_voxel_m: Voxel size of the sphere for GICP.
        correspondence_m: Longest correspondence of GICP.
        first_try_m: Longest correspondence of the point-to-plane registration that is tried first; None: GICP only.
    """

    radius_m: float
    gicp_voxel_m: float
    correspondence_m: float
    first_try_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """The registrations at A after keyframes, in path order.

    Attributes:
        keyframes: (A,) after keyframes: the requested ones, and further ones where the step was halved.
        before_T_after: (A, 4, 4) alignment at each; the neighbour's if nothing was registered.
        information: (A, 6, 6) Hessian of each, rotation then translation, after odom axes; zero without one.
        fits: (A,) inlier share; 0 if the registration failed, NaN if the before session never came near.
        residuals_m: (A,) median point-to-plane distance, metres; NaN if nothing was registered.
    """

    keyframes: Int64Array
    before_T_after: Float64Array
    information: Float64Array
    fits: Float64Array
    residuals_m: Float64Array


def walk(
    before: IndexedMap,
    after: IndexedMap,
    keyframes: Int64Array,
    start: int,
    before_T_after: Float64Array,
    step: Step,
    config: MergeConfig,
) -> Walk:
    """Register spheres around the given after keyframes, outwards from one of them.

    Args:
        before: The before map, indexed as a target.
        after: The after map.
        keyframes: (A,) after keyframes, rising.
        start: Index into `keyframes` of the place where `before_T_after` was found.
        before_T_after: (4, 4) alignment at the start.
        step: Registration settings.
        config: `inlier_m` is used.
    """
    first = _Stop(int(keyframes[start]), before_T_after)
    first = _register_stop(before, after, first, first.keyframe, step, config)
    stops = [first]
    for way in (keyframes[start + 1 :], keyframes[:start][::-1]):
        previous = first
        for keyframe in way.tolist():
            reached = _advance(before, after, previous, keyframe, step, config)
            stops += reached
            previous = reached[-1]
    stops.sort(key=lambda stop: stop.keyframe)
    return Walk(
        keyframes=np.array([stop.keyframe for stop in stops], dtype=np.int64),
        before_T_after=np.array([stop.before_T_after for stop in stops]),
        information=np.array([stop.information for stop in stops]),
        fits=np.array([stop.fit for stop in stops]),
        residuals_m=np.array([stop.residual_m for stop in stops]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Stop:
    """The registration at one after keyframe; fields as in `Walk`."""

    keyframe: int
    before_T_after: Float64Array
    information: Float64Array = field(default_factory=lambda: np.zeros((6, 6)))
    fit: float = np.nan
    residual_m: float = np.nan


def _advance(
    before: IndexedMap, after: IndexedMap, previous: _Stop, keyframe: int, step: Step, config: MergeConfig
) -> list[_Stop]:
    """Register a keyframe from the previous stop; if the fit is lost, halve the step and retry."""
    stop = _register_stop(before, after, previous, keyframe, step, config)
    middle = (previous.keyframe + keyframe) // 2
    is_short = abs(keyframe - previous.keyframe) <= _SHORTEST_STEP
    if not stop.fit < _LOST_FIT or not previous.fit >= _CLEAR_FIT or is_short:
        return [stop]
    halfway = _advance(before, after, previous, middle, step, config)
    return [*halfway, *_advance(before, after, halfway[-1], keyframe, step, config)]


def _register_stop(
    before: IndexedMap, after: IndexedMap, previous: _Stop, keyframe: int, step: Step, config: MergeConfig
) -> _Stop:
    centre = after.positions[keyframe]
    guess = previous.before_T_after
    if not is_shared(before, transform(guess, centre[None]))[0]:
        return _Stop(keyframe, guess)
    apart_m = float(np.linalg.norm(centre - after.positions[previous.keyframe]))
    registered = _register_place(before, after, centre, guess, apart_m, step, config)
    if registered is None:
        return _Stop(keyframe, guess, fit=0.0)
    pose, fit, information = registered
    return _Stop(keyframe, pose, information, fit.inlier_share(config.inlier_m), fit.residual_m)


def is_shared(before: IndexedMap, positions_map: Float64Array) -> BoolArray:
    """Return the (N,) mask of the (N, 3) positions, map frame, within 5 m of the before path."""
    distances_m, _ = before.path.query(positions_map, distance_upper_bound=SHARED_M)
    return np.isfinite(distances_m)


def choose_evenly(keyframes: Int64Array, n: int, and_also: int) -> Int64Array:
    """Return about n evenly spaced keyframes, and `and_also`, rising."""
    chosen = np.linspace(0, len(keyframes) - 1, min(n, len(keyframes))).round().astype(np.int64)
    return np.unique(np.append(keyframes[chosen], and_also))


def _register_place(
    before: IndexedMap,
    after: IndexedMap,
    centre: Float64Array,
    guess: Float64Array,
    apart_m: float,
    step: Step,
    config: MergeConfig,
) -> tuple[Float64Array, SurfaceFit, Float64Array] | None:
    """Register one place; return pose, fit and information.

    None if it has too few points, or if the pose changed by more than drift explains.
    """
    points = after.sphere(centre, step.radius_m)
    if len(points) < MIN_SPHERE_POINTS:
        return None
    own = sample_evenly(points)
    target, _ = before.target_near(transform(guess, centre[None])[0], step.radius_m + step.correspondence_m)

    def judge(found: Float64Array) -> tuple[Float64Array, SurfaceFit, Float64Array] | None:
        held = _limit_motion(found, guess, centre, apart_m)
        if held is None:
            return None
        fit = measure_fit(before, after, held, own, centre, step.radius_m)
        information = fit.information
        if held is not found:
            # the rotation is the neighbour's and was not measured
            information = information.copy()
            information[:3] = information[:, :3] = 0.0
        return held, fit, information

    if step.first_try_m is not None:
        first = judge(align_to_planes(own, centre, target, guess, step.first_try_m))
        if first is not None and first[1].inlier_share(config.inlier_m) >= _CLEAR_FIT:
            return first
    return judge(align_by_gicp(points, centre, target, guess, step.correspondence_m, step.gicp_voxel_m))


def _limit_motion(
    found: Float64Array, guess: Float64Array, centre: Float64Array, apart_m: float
) -> Float64Array | None:
    """Return a pose whose change from the guess drift explains, with the guess's rotation if only that is too large.

    The cross-section of a narrow drift is nearly round, so near a dead end the roll is poorly constrained.
    """
    jump_m, jump_rad = motion_between(found, guess, centre)
    if jump_m > _JUMP_M + _JUMP_SHARE * apart_m:
        return None
    if jump_rad <= _JUMP_RAD + _JUMP_RAD_PER_M * apart_m:
        return found
    return make_pose(guess[:3, :3], transform(found, centre[None])[0] - guess[:3, :3] @ centre)
