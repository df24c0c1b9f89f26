"""The path of a robot: along the centrelines of its route, on its side, around props, clear of the walls.

The reference line is the route with rounded corners. Bounds on the sideways offset from it are collected along the
route, and a smooth offset is found between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream
from scenarios.schema import Scenario, SessionPlan
from sim.drive.obstacles import Span, find_boulders, find_obstacles, pass_obstacles, sidestep
from sim.geometry.line import STEP_M, smooth_between, smooth_line, tighten_bound
from sim.geometry.noise import smooth_noise
from sim.placement.lanes import body_heights_m, side_bounds
from sim.rock.centreline import headings_of, left_of, resample
from sim.scene import World

_SHARPEST_DEG = 150.0
_WANDER_LENGTH_M = 8.0  # correlation length of the line's way from side to side
# Softens turns where bend and swerve meet; it moves the line by a few centimetres at most.
_LAST_SMOOTHING_M = 0.7
# Corners of the route are rounded over this share of the drift's width to either side.
_CORNER_SHARE = 0.55
# Half lengths tried for a swerve, the gentlest first; a sharper one only where it is needed.
_SWERVES_M = (2.0, 1.4, 1.0, 0.7, 0.5)
# Rather than swerve sharply between props on both sides, this share of the clearance is given up.
_CHICANE_SHARE = 0.3
# Where no smooth line exists, the robot drives over the stones within this distance.
_STONE_REACH_M = 4.0
# Between the heights at which a wary line looks for walls: no pipe is thinner.
_WARY_STEP_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A driven line, sampled about every 0.05 m.

    Attributes:
        distance_m: (N,) horizontal distance travelled.
        points: (N, 3) world position, metres; z is the centreline's, near the floor.
        yaw_rad: (N,) heading, unwrapped.
    """

    distance_m: Float64Array
    points: Float64Array
    yaw_rad: Float64Array


def plan_path(world: World, scenario: Scenario, seed: int, session: str, is_wary: bool = False) -> Path:
    """Return the line of one session; the seed draws its wander.

    Args:
        world: The world.
        scenario: Its platform and its sessions.
        seed: Seed of the wander.
        session: "before" or "after".
        is_wary: Also keep clear of obstacles within the clearance above and below the sensor, not only at its height.

    Raises:
        ScenarioError: The route turns back on itself, nothing is left of it, or the walls and props leave no room.
    """
    plan = scenario.plan(session)
    line, width_m = _reference_line(world, plan, session)
    offset_m = _plan_offsets(world, scenario, seed, session, line, width_m, is_wary)
    left = left_of(headings_of(line))
    shifted = resample(np.column_stack([line[:, :2] + offset_m[:, None] * left, line[:, 2]]), STEP_M)
    xy = smooth_line(shifted[:, :2], _LAST_SMOOTHING_M)
    headings = headings_of(xy)
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    yaw = smooth_line(np.unwrap(np.arctan2(headings[:, 1], headings[:, 0])), 4 * STEP_M)
    return Path(distance_m, np.column_stack([xy, shifted[:, 2]]), yaw)


def _reference_line(world: World, plan: SessionPlan, session: str) -> tuple[Float64Array, Float64Array]:
    """Return the route (N, 3) with rounded corners, trimmed, and the section's width (N,) along it."""
    pieces: list[Float64Array] = []
    widths: list[Float64Array] = []
    for a, b in pairwise(plan.route):
        points, section = world.centreline.edge(a, b)
        pieces.append(points if not pieces else points[1:])
        widths.append(np.full(len(pieces[-1]), section.width_m))
        if len(pieces) > 1 and _turn_deg(pieces[-2], pieces[-1]) > _SHARPEST_DEG:
            raise ScenarioError(f"{session}.route turns back at node {a!r}: a route may not reverse")
    points = resample(np.concatenate(pieces), STEP_M)
    share = np.linspace(0.0, 1.0, len(points))
    all_widths = np.concatenate(widths)
    width_m = np.interp(share, np.linspace(0.0, 1.0, len(all_widths)), all_widths)
    line = smooth_line(points, _CORNER_SHARE * float(all_widths.min()))
    first, last = round(plan.start_m / STEP_M), len(line) - round(plan.end_m / STEP_M)
    if last - first < 2 / STEP_M:
        raise ScenarioError(
            f"{session}: the route is {(len(line) - 1) * STEP_M:.1f} m long and start_m + end_m leave less than 2 m "
            "of it: shorten them"
        )
    return line[first:last], width_m[first:last]


def _turn_deg(before: Float64Array, after: Float64Array) -> float:
    incoming = before[-1, :2] - before[max(-8, -len(before)), :2]
    outgoing = after[min(7, len(after) - 1), :2] - before[-1, :2]
    cosine = incoming @ outgoing / max(float(np.linalg.norm(incoming) * np.linalg.norm(outgoing)), 1e-9)
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _heights_m(scenario: Scenario, plan: SessionPlan, is_wary: bool) -> Float64Array:
    """Heights (H,) above the floor at which the line looks for walls."""
    heights_m = body_heights_m(scenario, plan)
    if not is_wary:
        return heights_m
    reach_m = scenario.platform.clearance_m
    low_m = max(heights_m[0] - reach_m, 0.35) if scenario.platform.kind == "quadrotor" else 0.35
    return np.arange(low_m, heights_m[-1] + reach_m, _WARY_STEP_M)


def _plan_offsets(
    world: World, scenario: Scenario, seed: int, session: str, line: Float64Array, width_m: Float64Array, is_wary: bool
) -> Float64Array:
    """Return the sideways offset (N,) from the reference line, positive to the left."""
    plan = scenario.plan(session)
    heights_m = _heights_m(scenario, plan, is_wary)
    clearance_m = scenario.platform.clearance_m
    headings = headings_of(line)
    height_m = plan.height_m or scenario.platform.sensor_height_m
    room_m = np.maximum(width_m / 2 - clearance_m, 0.0)
    turn = smooth_line(np.gradient(np.unwrap(np.arctan2(headings[:, 1], headings[:, 0]))) / STEP_M, 0.25)
    low, high = side_bounds(world.fixed, line, headings, turn, heights_m, width_m, clearance_m)
    along_m: Float64Array = np.arange(len(line), dtype=np.float64) * STEP_M
    key = int(stream(seed, session, "wander").integers(2**63))
    wanted = plan.lateral * room_m + scenario.platform.wander_m * smooth_noise((along_m,), _WANDER_LENGTH_M, key)
    _refuse_narrow(scenario, session, low, high)
    obstacles = find_obstacles(world, scenario, session, line, headings, height_m)
    barred = pass_obstacles(wanted, low, high, [(near_low, near_high) for _, near_low, near_high in obstacles])
    if barred is not None:
        number, sample = barred
        raise ScenarioError(
            f"{session}: {obstacles[number][0]} bars the way {sample * STEP_M:.1f} m along the route: "
            "move it to a side, make it smaller, or lower platform.clearance_m"
        )
    stones = find_boulders(world, scenario, line, headings, float(width_m.max()))
    return _swerve_between(session, wanted, low, high, stones, _CHICANE_SHARE * clearance_m)


def _swerve_between(
    session: str, wanted: Float64Array, low: Float64Array, high: Float64Array, stones: list[Span], give_m: float
) -> Float64Array:
    """Return a smooth offset (N,) at most `give_m` beyond the bounds; it drives over stones where it must."""
    while True:
        inner_low, inner_high = low.copy(), high.copy()
        for near_low, near_high in stones:
            sidestep(wanted, inner_low, inner_high, near_low, near_high)
        offset_m, excess_m = _find_smoothest(wanted, inner_low, inner_high, give_m)
        worst = int(np.argmax(excess_m))
        if excess_m[worst] <= give_m:
            return offset_m
        near = slice(max(0, worst - round(_STONE_REACH_M / STEP_M)), worst + round(_STONE_REACH_M / STEP_M))
        kept = [stone for stone in stones if np.isnan(stone[0][near]).all()]
        if len(kept) == len(stones):
            raise ScenarioError(
                f"{session}: props on both sides leave no smooth way {worst * STEP_M:.1f} m along the route: "
                "set them farther apart, or lower platform.clearance_m"
            )
        stones = kept


def _find_smoothest(
    wanted: Float64Array, low: Float64Array, high: Float64Array, give_m: float
) -> tuple[Float64Array, Float64Array]:
    """Return the gentlest offset (N,) found, and how far it lies beyond the bounds (N,)."""
    offset_m = smooth_between(wanted, low, high, _SWERVES_M[0])
    for half_m in _SWERVES_M[1:]:
        is_bad = np.maximum(low - offset_m, offset_m - high) > give_m
        if is_bad.any():
            share = np.clip(smooth_line(tighten_bound(is_bad.astype(np.float64), 2.0, np.max), 2.0), 0.0, 1.0)
            offset_m = share * smooth_between(wanted, low, high, half_m) + (1.0 - share) * offset_m
    return offset_m, np.maximum(low - offset_m, offset_m - high)


def _refuse_narrow(scenario: Scenario, session: str, low: Float64Array, high: Float64Array) -> None:
    gap = high - low
    worst = int(np.argmin(gap))
    if gap[worst] < 0:
        needed_m = 2 * scenario.platform.clearance_m
        raise ScenarioError(
            f"{session}: the walls leave {gap[worst] + needed_m:.2f} m at {worst * STEP_M:.1f} m along the route: "
            f"{needed_m:.2f} m are needed for platform.clearance_m"
        )
