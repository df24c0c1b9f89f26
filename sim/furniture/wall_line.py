"""The lines of pipes, trays and ducts: their stand-off to the measured wall or roof, and their path at openings.

A line on a wall spans short openings in a straight line. At a longer opening (branch, niche, crossing) it climbs to a
passing height within 1.5 m, crosses, and descends. If the roof is too low for that, or if the line would hang too low
over the middle of a drift, it ends before the opening and starts again behind it. Where two drifts cross, only the
lines of the drift that the scenario names first continue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from sim.rock.axis import STATION_M, Axis, bridge_openings, find_nearest, find_runs, is_opening, lower_envelope

PASSING_M = 2.1  # clear height under whatever crosses an opening, or in a high drift ...
PASSING_SHARE = 0.6  # ... this share of its height
_WAY_SHARE = 0.3  # of the width, to both sides of the centreline
_SHORT_OPENING = round(1.5 / STATION_M)
_RAMP = round(1.5 / STATION_M)
_SHOULDER = round(0.75 / STATION_M)
_SHORTEST_RUN = round(2.0 / STATION_M)
_STIFFNESS = round(1.0 / STATION_M)
_DUCT_STIFFNESS = round(1.75 / STATION_M)
_STACK_GAP_M = 0.08


@dataclass(frozen=True, slots=True)
class Cross:
    """The cross-section of a line: half its width, half its height, and its gap to the rock."""

    half_width_m: float
    half_height_m: float
    standoff_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One unbroken piece of a line.

    Attributes:
        path: (N, 3) its middle, a quarter of a metre apart, world frame, metres.
        stations: (N,) the stations of the axis it was laid out from.
        left: (N, 3) unit direction to the left of the drift.
    """

    path: Float64Array
    stations: Int64Array
    left: Float64Array


@dataclass(frozen=True, slots=True)
class WallPlan:
    """A line wanted on a wall: side 1 left, -1 right; height as a share of the drift's."""

    side: float
    height_share: float
    cross: Cross
    above_passing_m: float = 0.0  # of its axis, where it crosses an opening


def stack_plans(plans: Sequence[WallPlan]) -> list[WallPlan]:
    """Set the heights at which the lines of each wall cross openings, in their order on the wall."""
    answer = list(plans)
    for side in (1.0, -1.0):
        free_m = 0.0
        for index in sorted(range(len(plans)), key=lambda i: plans[i].height_share):
            if plans[index].side == side:
                half_m = plans[index].cross.half_height_m
                answer[index] = replace(plans[index], above_passing_m=free_m + half_m)
                free_m += 2 * half_m + _STACK_GAP_M
    return answer


def wall_lines(axis: Axis, plan: WallPlan) -> list[Line]:
    """Return the pieces of a line along one wall of a drift."""
    cross = plan.cross
    base_m = plan.height_share * axis.height_m
    wall_m = _nearest(axis, base_m, plan)
    is_open = is_opening(wall_m) & axis.is_inside
    if is_open.all():
        return []
    usual_m = bridge_openings(wall_m, is_open)
    passing_m = max(PASSING_M, PASSING_SHARE * axis.section.height_m)
    over_m = np.maximum(base_m, passing_m + plan.above_passing_m)
    can_pass = (_nearest(axis, over_m, plan) > 0.6 * usual_m) & (
        axis.clear_m > over_m + cross.half_height_m + cross.standoff_m
    )
    up_m, is_usable = base_m.copy(), axis.is_inside & ~axis.gives_way
    is_end = _touches_end(is_open | ~is_usable)
    for first, end in _openings(is_open):
        reach = slice(max(first - _SHOULDER - _RAMP, 0), end + _SHOULDER + _RAMP)
        if is_end[first:end].any() or axis.gives_way[first:end].any() or not can_pass[reach].all():
            is_usable[max(first - 1, 0) : end + 1] = False
        else:
            stations = np.arange(len(up_m))
            away = np.maximum(np.maximum(first - stations, stations - end + 1) - _SHOULDER, 0)
            up_m = np.maximum(up_m, base_m + (over_m - base_m) * np.clip(1 - away / _RAMP, 0, 1))
    up_m = np.convolve(np.pad(up_m, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    wall_m = _nearest(axis, up_m, plan)
    is_open = binary_dilation(is_opening(wall_m), iterations=2) & axis.is_inside
    limit_m = bridge_openings(wall_m, is_open) - cross.half_width_m - cross.standoff_m
    across_m = _inside_only(limit_m, axis.is_inside)
    is_low = up_m - cross.half_height_m < PASSING_M - 0.05
    is_usable &= ~(is_low & _is_on_a_way(axis, axis.at(plan.side * across_m, up_m)))
    is_usable &= across_m < axis.section.width_m  # a farther hit lies in another drift
    return _pieces(axis, plan.side * across_m, up_m, is_usable)


def roof_lines(axis: Axis, lateral: float, cross: Cross, lowest_m: float) -> list[Line]:
    """Return the pieces of a line below the roof.

    Args:
        axis: The drift.
        lateral: Share of the half width that is free at the line's height, -1 right, +1 left.
        cross: Half sizes of the line, and its gap to rock.
        lowest_m: The line breaks off where its underside would hang lower than this above the floor.
    """
    side = 1.0 if lateral >= 0 else -1.0
    up_m = 0.6 * axis.height_m
    is_mouth = is_opening(axis.to_side(up_m, 1.0)) | is_opening(axis.to_side(up_m, -1.0))
    is_usable = axis.is_inside & ~axis.gives_way
    is_usable &= ~_touches_end(is_mouth | ~is_usable)
    across_m = np.zeros(len(up_m))
    for _ in range(3):
        reach_m = [_reach(axis, up_m + share * cross.half_height_m, side, cross, share) for share in (0.0, 0.7)]
        free_m = _inside_only(np.maximum(np.minimum(*reach_m), 0.0), axis.is_inside, _DUCT_STIFFNESS)
        across_m = side * abs(lateral) * free_m
        up_m = _inside_only(_below_roof(axis, across_m, cross), axis.is_inside, _DUCT_STIFFNESS)
    is_usable &= up_m - cross.half_height_m > lowest_m
    return _pieces(axis, across_m, up_m, is_usable)


def _is_on_a_way(axis: Axis, points: Float64Array) -> BoolArray:
    """Mark the points (S, 3) in the middle of any drift, where a robot passes."""
    widest_m = float(axis.ways[:, 3].max())
    distance_m, which = find_nearest(axis.ways[:, :2], points[:, :2], _WAY_SHARE * widest_m)
    which = np.minimum(which, len(axis.ways) - 1)
    is_level = np.abs(points[:, 2] - axis.ways[which, 2]) < 1.5 * axis.section.height_m
    return np.asarray((distance_m < _WAY_SHARE * axis.ways[which, 3]) & is_level)


def _nearest(axis: Axis, up_m: Float64Array, plan: WallPlan) -> Float64Array:
    """Smallest distance (S,) to the wall over the height of the line."""
    half_m = plan.cross.half_height_m + 0.02
    return np.asarray(np.min([axis.to_side(up_m + shift, plan.side) for shift in (-half_m, 0.0, half_m)], axis=0))


def _reach(axis: Axis, up_m: Float64Array, side: float, cross: Cross, share: float) -> Float64Array:
    """Return how far sideways (S,) a round line may lie, limited by the wall at `share` of its half height."""
    wall_m = axis.to_side(up_m, side)
    wall_m = bridge_openings(wall_m, is_opening(wall_m))
    return np.asarray(wall_m - np.sqrt(1 - share**2) * cross.half_width_m - cross.standoff_m)


def _below_roof(axis: Axis, across_m: Float64Array, cross: Cross) -> Float64Array:
    """Return the greatest height (S,) of the axis of a round line."""
    heights = []
    for share in (-1.0, -0.7, 0.0, 0.7, 1.0):
        roof_m = axis.to_roof(across_m + share * cross.half_width_m)
        heights.append(np.minimum(roof_m, axis.clear_m + 1.0) - np.sqrt(1 - share**2) * cross.half_height_m)
    return np.asarray(np.min(heights, axis=0) - cross.standoff_m)


def _openings(is_open: BoolArray) -> list[tuple[int, int]]:
    """Return the openings too long to span, those less than a metre apart taken as one."""
    closed = is_open.copy()
    for first, end in find_runs(~is_open):
        if end - first < 1.0 / STATION_M and first > 0 and end < len(is_open):
            closed[first:end] = True
    return list(find_runs(closed, _SHORT_OPENING))


def _touches_end(is_barred: BoolArray) -> BoolArray:
    """Mark the stations (S,) of the barred stretches at both ends."""
    touches = np.zeros(len(is_barred), dtype=bool)
    for first, end in find_runs(is_barred):
        touches[first:end] = first == 0 or end == len(is_barred)
    return touches


def _inside_only(values: Float64Array, is_inside: BoolArray, reach: int = _STIFFNESS) -> Float64Array:
    """Return the lower envelope (S,) of the values at the stations in the void."""
    stations = np.arange(len(values))
    return lower_envelope(np.interp(stations, stations[is_inside], values[is_inside]), reach)


def _pieces(axis: Axis, across_m: Float64Array, up_m: Float64Array, is_usable: BoolArray) -> list[Line]:
    points = axis.at(across_m, up_m)
    left = np.column_stack([axis.left, np.zeros(len(points))])
    pieces = []
    for first, end in find_runs(is_usable, _SHORTEST_RUN):
        path, stations = points[first:end], np.arange(first, end)
        # On the inner side of a sharp corner the offset line would run backwards.
        progress = (np.diff(path[:, :2], axis=0) * axis.forward[first : end - 1]).sum(axis=1)
        keep = np.concatenate([[True], progress > 0.2 * STATION_M])
        if keep.sum() >= _SHORTEST_RUN // 2:
            pieces.append(Line(path[keep], stations[keep], left[first:end][keep]))
    return pieces
