"""The line a robot drives: along the route's centrelines, on its own side, round props, clear of the walls.

All of it is done in the frame of a reference line (the route with its corners rounded): bounds on the sideways offset
are collected along it, and a smooth offset is found between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float64Array
from scenarios.schema import Scenario, SessionPlan
from sim.centreline import headings_of, resample
from sim.placing import PROBE_UP_M, floor_heights, free_width, standing_corners
from sim.scene import World

STEP_M = 0.05
_SHARPEST_DEG = 150.0
_FLOOR_SMOOTHING_M = 0.5
# A quadrotor keeps this much air below it; what is lower is flown over.
_AIR_BELOW_M = 0.5
# The body checked against the walls: the true gap may be this share of the clearance where the wall bulges.
_TIGHTEST_SHARE = 0.5
# Corners of the route are rounded over this share of the drift's width to either side.
_CORNER_SHARE = 0.55
# Inside a bend the line stays this share of the way to the centre of curvature, so that the turn does not tighten.
_INSIDE_SHARE = 0.35
# Half lengths tried for a swerve, the gentlest first.
_SWERVES_M = (2.0, 1.5, 1.0, 0.7, 0.5, 0.25)


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A driven line, sampled about every 0.05 m.

    Attributes:
        distance_m: (N,) horizontal distance travelled.
        points: (N, 3) world position of the sensor, metres.
        yaw_rad: (N,) heading, unwrapped.
        slope: (N,) rise of the floor per metre.
    """

    distance_m: Float64Array
    points: Float64Array
    yaw_rad: Float64Array
    slope: Float64Array


def plan_path(world: World, scenario: Scenario, session: str) -> Path:
    """Return the line of one session.

    Raises:
        ScenarioError: The route turns back on itself, nothing is left of it, or the walls and props leave no room.
    """
    plan: SessionPlan = getattr(scenario, session)
    line, width_m = _reference(world, plan, session)
    offset_m = _offsets(world, scenario, session, line, width_m)
    left = _left(headings_of(line))
    shifted = resample(np.column_stack([line[:, :2] + offset_m[:, None] * left, line[:, 2]]), STEP_M)
    xy, level_m = shifted[:, :2], shifted[:, 2]
    floor_m = floor_heights(world.walls, np.column_stack([xy, level_m + PROBE_UP_M]))
    floor_m = smoothed(np.where(np.isnan(floor_m), level_m, floor_m), _FLOOR_SMOOTHING_M)
    height_m = plan.height_m or scenario.platform.sensor_height_m
    points = np.column_stack([xy, floor_m + height_m])
    _check_clearance(world, scenario, session, points)
    headings = headings_of(xy)
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    yaw = smoothed(np.unwrap(np.arctan2(headings[:, 1], headings[:, 0])), 4 * STEP_M)
    return Path(distance_m, points, yaw, np.gradient(floor_m, distance_m))


def smoothed(values: Float64Array, half_m: float) -> Float64Array:
    """Return (N,) or (N, D) samples 0.05 m apart averaged with a Hann window of this half width, ends kept."""
    half = round(half_m / STEP_M)
    if half < 1 or len(values) < 2:
        return values
    window = np.hanning(2 * half + 3)[1:-1]
    window /= window.sum()
    padded = np.pad(values, [(half, half)] + [(0, 0)] * (values.ndim - 1), mode="reflect", reflect_type="odd")
    if values.ndim == 1:
        return np.convolve(padded, window, mode="valid")
    return np.stack([np.convolve(column, window, mode="valid") for column in padded.T], axis=1)


def _reference(world: World, plan: SessionPlan, session: str) -> tuple[Float64Array, Float64Array]:
    """Return the route (N, 3) with rounded corners, trimmed, and the section's width (N,) along it."""
    pieces: list[Float64Array] = []
    widths: list[Float64Array] = []
    for a, b in pairwise(plan.route):
        points, section = world.centreline.edge(a, b)
        pieces.append(points if not pieces else points[1:])
        widths.append(np.full(len(pieces[-1]), section.width_m))
        if len(pieces) > 1:
            turn = _turn_deg(pieces[-2], pieces[-1])
            if turn > _SHARPEST_DEG:
                raise ScenarioError(f"{session}.route turns back at node {a!r}: a route may not reverse")
    points = resample(np.concatenate(pieces), STEP_M)
    share = np.linspace(0.0, 1.0, len(points))
    all_widths = np.concatenate(widths)
    width_m = np.interp(share, np.linspace(0.0, 1.0, len(all_widths)), all_widths)
    line = smoothed(points, _CORNER_SHARE * float(all_widths.min()))
    first, last = round(plan.start_m / STEP_M), len(line) - round(plan.end_m / STEP_M)
    if last - first < 2 / STEP_M:
        raise ScenarioError(
            f"{session}: the route is {len(line) * STEP_M:.1f} m long and start_m + end_m leave less than 2 m of it"
        )
    return line[first:last], width_m[first:last]


def _turn_deg(before: Float64Array, after: Float64Array) -> float:
    incoming = before[-1, :2] - before[max(-8, -len(before)), :2]
    outgoing = after[min(7, len(after) - 1), :2] - before[-1, :2]
    cosine = incoming @ outgoing / max(float(np.linalg.norm(incoming) * np.linalg.norm(outgoing)), 1e-9)
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _offsets(world: World, scenario: Scenario, session: str, line: Float64Array, width_m: Float64Array) -> Float64Array:
    """Sideways offset (N,) from the reference line, positive to the left."""
    plan: SessionPlan = getattr(scenario, session)
    clearance_m = scenario.platform.clearance_m
    headings = headings_of(line)
    height_m = plan.height_m or scenario.platform.sensor_height_m
    heights = np.array([height_m] if scenario.platform.kind == "quadrotor" else [0.35, max(height_m, 0.4)])
    right_m, left_m = free_width(world.walls, line, _left(headings), heights, float(width_m.max()))
    room_m = np.maximum(width_m / 2 - clearance_m, 0.0)
    low = np.maximum(clearance_m - right_m, -room_m)
    high = np.minimum(left_m - clearance_m, room_m)
    turn = smoothed(np.gradient(np.unwrap(np.arctan2(headings[:, 1], headings[:, 0]))) / STEP_M, 0.25)
    high = np.where(turn > 1e-3, np.minimum(high, _INSIDE_SHARE / np.maximum(turn, 1e-3)), high)
    low = np.where(turn < -1e-3, np.maximum(low, -_INSIDE_SHARE / np.maximum(-turn, 1e-3)), low)
    wanted = plan.lateral * room_m
    _refuse_narrow(scenario, session, low, high, "the walls leave")
    for name, near_low, near_high in _obstacles(world, scenario, session, line, headings, height_m):
        _pass_by(session, name, wanted, low, high, near_low, near_high)
    for half_m in _SWERVES_M:
        inner_low, inner_high = _strictest(low, half_m, np.max), _strictest(high, half_m, np.min)
        if (inner_low <= inner_high).all():
            break
    _refuse_narrow(scenario, session, inner_low, inner_high, "walls and props leave")
    return smoothed(np.clip(wanted, inner_low, inner_high), half_m)


def _strictest(bound: Float64Array, half_m: float, of: Callable[..., Any]) -> Float64Array:
    """Take the strictest bound within `half_m` of each sample: a Hann average over that window then keeps the bound."""
    half = round(half_m / STEP_M)
    padded = np.pad(bound, half, mode="edge")
    return np.asarray(of(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1), axis=1))


def _obstacles(
    world: World, scenario: Scenario, session: str, line: Float64Array, headings: Float64Array, height_m: float
) -> list[tuple[str, Float64Array, Float64Array]]:
    """Return for each prop in the way its name and the offsets it forbids, (N,) to (N,), NaN where it is far."""
    clearance_m = scenario.platform.clearance_m
    left = _left(headings)
    found = []
    for item in world.standing:
        is_low = scenario.platform.kind == "quadrotor" and item.prop.size_m[2] + _AIR_BELOW_M < height_m
        if session not in item.sessions or is_low:
            continue
        outline = resample(np.concatenate([(corners := standing_corners(item)), corners[:1]]), 0.1)
        reach = float(np.linalg.norm(outline - outline.mean(axis=0), axis=1).max()) + clearance_m
        near = np.flatnonzero(np.linalg.norm(line[:, :2] - outline.mean(axis=0), axis=1) < reach + 10.0)
        delta = outline[None] - line[near, None, :2]
        along = (delta * headings[near, None]).sum(axis=2)
        across = (delta * left[near, None]).sum(axis=2)
        reach_m = np.sqrt(np.maximum(clearance_m**2 - along**2, 0.0))
        is_abreast = np.abs(along) < clearance_m
        low, high = np.full(len(line), np.nan), np.full(len(line), np.nan)
        low[near] = np.where(is_abreast, across - reach_m, np.inf).min(axis=1)
        high[near] = np.where(is_abreast, across + reach_m, -np.inf).max(axis=1)
        away = ~(low < high)
        low[away] = high[away] = np.nan
        found.append((item.prop.name, low, high))
    return found


def _pass_by(
    session: str,
    name: str,
    wanted: Float64Array,
    low: Float64Array,
    high: Float64Array,
    near_low: Float64Array,
    near_high: Float64Array,
) -> None:
    """Narrow the bounds `low`, `high` in place so that the line passes a prop on one side, each time it comes by."""
    stations = np.flatnonzero(np.isfinite(near_low))
    for visit in np.split(stations, np.flatnonzero(np.diff(stations) > 1 / STEP_M) + 1):
        if len(visit) == 0 or (near_low[visit] > high[visit]).all() or (near_high[visit] < low[visit]).all():
            continue
        shift_left = np.maximum(near_high[visit] - wanted[visit], 0.0).max()
        shift_right = np.maximum(wanted[visit] - near_low[visit], 0.0).max()
        fits_left = (near_high[visit] <= high[visit]).all()
        fits_right = (near_low[visit] >= low[visit]).all()
        if fits_left and (shift_left <= shift_right or not fits_right):
            low[visit] = np.maximum(low[visit], near_high[visit])
        elif fits_right:
            high[visit] = np.minimum(high[visit], near_low[visit])
        else:
            raise ScenarioError(
                f"{session}: prop {name!r} bars the way {visit[0] * STEP_M:.1f} m along the route: "
                "move it to a side, make it smaller, or lower platform.clearance_m"
            )


def _refuse_narrow(scenario: Scenario, session: str, low: Float64Array, high: Float64Array, what: str) -> None:
    gap = high - low
    worst = int(np.argmin(gap))
    if gap[worst] < 0:
        raise ScenarioError(
            f"{session}: {what} {gap[worst] + 2 * scenario.platform.clearance_m:.2f} m at {worst * STEP_M:.1f} m along "
            f"the route: {2 * scenario.platform.clearance_m:.2f} m are needed for platform.clearance_m"
        )


def _check_clearance(world: World, scenario: Scenario, session: str, points: Float64Array) -> None:
    """Cast level rays all round and one up from every tenth sample: the line must keep off the walls."""
    clearance_m = scenario.platform.clearance_m
    angle = np.arange(24) * (2 * np.pi / 24)
    level = np.stack([np.cos(angle), np.sin(angle), np.zeros(24)], axis=1)
    directions = np.concatenate([level, [[0.0, 0.0, 1.0]]])
    stations = points[:: round(0.5 / STEP_M)]
    ranges_m, _, normals = world.walls.hits(
        np.repeat(stations, len(directions), axis=0), np.tile(directions, (len(stations), 1))
    )
    facing = -(normals * np.tile(directions, (len(stations), 1))).sum(axis=1)
    gap_m = np.where(facing > 0, ranges_m, 0.0).reshape(len(stations), -1)
    worst = int(np.argmin(gap_m.min(axis=1)))
    if gap_m[worst].min() < _TIGHTEST_SHARE * clearance_m:
        x, y, z = stations[worst]
        raise ScenarioError(
            f"{session}: the sensor comes within {gap_m[worst].min():.2f} m of rock at ({x:.1f}, {y:.1f}, {z:.1f}): "
            "choose another lateral, start_m, end_m or height"
        )


def _left(headings: Float64Array) -> Float64Array:
    return np.stack([-headings[:, 1], headings[:, 0]], axis=1)
