"""Lanes: the free width along the path of each session, and the part of it that props block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from scenarios.schema import Scenario, SessionPlan
from sim.geometry.raycast import Caster
from sim.placement.placing import Standing, free_width, standing_corners, standing_height_m
from sim.placement.recorded import read_drive
from sim.rock.centreline import Centreline, headings_of, left_of, resample

LANE_STEP_M = 0.25
# Spare width that props must leave beyond the need of the platform.
SPARE_M = 0.15
# The line changes sides over this distance, so props count this far before and behind where they stand.
_SWERVE_M = 1.5
# A quadrotor keeps this vertical distance to what it flies over.
AIR_BELOW_M = 0.5
# Inside a bend the line goes at most this share of the way to the centre of curvature, so that the turn stays gentle.
_INSIDE_SHARE = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """Free width for one session's line, every 0.25 m along its route.

    Attributes:
        session: "before" or "after".
        points: (N, 2) centreline.
        headings: (N, 2) direction of travel.
        low_m, high_m: (N,) offsets to the left between which the rock leaves the platform its clearance.
        clearance_m: Kept to props.
        flown_over_m: Props lower than this are flown over.
    """

    session: str
    points: Float64Array
    headings: Float64Array
    low_m: Float64Array
    high_m: Float64Array
    clearance_m: float
    flown_over_m: float

    def taken_by(self, standing: Standing) -> Float64Array:
        """Return the offsets (N, 2) that a prop bars, low and high, NaN where it is far or not in the way."""
        span = np.full((len(self.points), 2), np.nan)
        if self.session not in standing.sessions or standing_height_m(standing) < self.flown_over_m:
            return span
        near, along, across = project_prop(standing, self.points, self.headings, (self.clearance_m, _SWERVE_M, 8.0))
        is_abreast = np.abs(along) < self.clearance_m + _SWERVE_M
        rows = is_abreast.any(axis=1)
        span[near[rows], 0] = np.where(is_abreast, across, np.inf)[rows].min(axis=1) - self.clearance_m
        span[near[rows], 1] = np.where(is_abreast, across, -np.inf)[rows].max(axis=1) + self.clearance_m
        return span

    def is_open(self, taken: Sequence[Float64Array]) -> bool:
        """Tell whether the offsets (N, 2) that the last prop blocks beside all others leave a gap everywhere."""
        # The last prop is the new one; it can have closed the lane only where it blocks something.
        return not taken or bool((self.gaps_m(taken, np.isfinite(taken[-1][:, 0])) >= SPARE_M).all())

    def gaps_m(self, taken: Sequence[Float64Array], rows: BoolArray) -> Float64Array:
        """Return the widest gap (R,) between the sides of the drift and blocked offsets (N, 2) at some rows (N,)."""
        low, high = np.stack([each[rows] for each in taken], axis=2).transpose(1, 0, 2)
        low, high = np.where(np.isnan(low), np.inf, low), np.where(np.isnan(high), -np.inf, high)
        order = np.argsort(low, axis=1)
        ends = np.minimum(np.take_along_axis(low, order, 1), self.high_m[rows, None])
        edges = np.maximum(np.take_along_axis(high, order, 1), self.low_m[rows, None])
        edges = np.column_stack([self.low_m[rows], np.maximum.accumulate(edges, axis=1)])
        return np.asarray((np.column_stack([ends, self.high_m[rows]]) - edges).max(axis=1))


def build_lanes(
    scenario: Scenario, centreline: Centreline, fixed: Caster, after: tuple[Centreline, Caster] | None = None
) -> tuple[Lane, ...]:
    """Return the lane of each session.

    Args:
        scenario: Its drives.
        centreline: The drifts.
        fixed: Rock and furniture.
        after: Both as they are in the after session, where they differ.

    Raises:
        InputError: A recorded trajectory cannot be read.
    """
    lanes = []
    for session, plan in (("before", scenario.before), ("after", scenario.after)):
        if plan.trajectory is None:
            here = after if session == "after" and after is not None else (centreline, fixed)
            lanes.append(_route_lane(scenario.of(session), session, plan, *here))
        else:
            lanes.append(_recorded_lane(scenario.of(session), session, Path(plan.trajectory)))
    return tuple(lanes)


def _recorded_lane(scenario: Scenario, session: str, trajectory: Path) -> Lane:
    """Return the lane of a recorded trajectory, which avoids no obstacle and may have any height."""
    line = resample(read_drive(trajectory)[0].points[:, :2], LANE_STEP_M)
    room_m = np.full(len(line), SPARE_M / 2)
    return Lane(session, line, headings_of(line), -room_m, room_m, scenario.platform.clearance_m, 0.0)


def project_prop(
    standing: Standing, points: Float64Array, headings: Float64Array, margins_m: tuple[float, ...]
) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Return where a prop's outline lies as seen from the places of a line that are near it.

    Args:
        standing: The prop.
        points: (N, 2) places of the line.
        headings: (N, 2) direction of travel there.
        margins_m: A place is near that lies within the sum of these of the prop.

    Returns:
        (M,) numbers of the near places; (M, K) how far ahead of each every point of the outline lies, metres; (M, K)
        how far to the left.
    """
    corners = standing_corners(standing)
    outline = resample(np.concatenate([corners, corners[:1]]), 0.1)
    middle = outline.mean(axis=0)
    reach_m = sum(margins_m, float(np.linalg.norm(outline - middle, axis=1).max()))
    near = np.flatnonzero(np.linalg.norm(points - middle, axis=1) < reach_m)
    delta = outline[None] - points[near, None]
    along = (delta * headings[near, None]).sum(axis=2)
    return near, along, (delta * left_of(headings)[near, None]).sum(axis=2)


def body_heights_m(scenario: Scenario, plan: SessionPlan) -> Float64Array:
    """Return the heights (H,) above the floor at which a session's platform needs free room to its sides."""
    height_m = plan.height_m or scenario.platform.sensor_height_m
    return np.array([height_m] if scenario.platform.kind == "quadrotor" else [0.35, max(height_m, 0.4)])


def side_bounds(
    fixed: Caster,
    line: Float64Array,
    headings: Float64Array,
    turn_per_m: Float64Array,
    heights_m: Float64Array,
    width_m: Float64Array,
    clearance_m: float,
) -> tuple[Float64Array, Float64Array]:
    """Return the offsets to the left (N,), lowest and highest, at which a platform keeps its clearance to the sides.

    Args:
        fixed: Rock and furniture.
        line: (N, 3) reference line.
        headings: (N, 2) direction of travel.
        turn_per_m: (N,) curvature of the line, radians per metre, to the left positive.
        heights_m: Heights at which the sides are looked for.
        width_m: (N,) nominal width of the drift.
        clearance_m: Kept to the sides.
    """
    right_m, left_m = free_width(fixed, line, left_of(headings), heights_m, float(width_m.max()))
    room_m = np.maximum(width_m / 2 - clearance_m, 0.0)
    low = np.maximum(clearance_m - right_m, -room_m)
    high = np.minimum(left_m - clearance_m, room_m)
    high = np.where(turn_per_m > 1e-3, np.minimum(high, _INSIDE_SHARE / np.maximum(turn_per_m, 1e-3)), high)
    low = np.where(turn_per_m < -1e-3, np.maximum(low, -_INSIDE_SHARE / np.maximum(-turn_per_m, 1e-3)), low)
    return low, high


def _route_lane(scenario: Scenario, session: str, plan: SessionPlan, centreline: Centreline, fixed: Caster) -> Lane:
    platform = scenario.platform
    pieces = [centreline.edge(a, b) for a, b in pairwise(plan.route)]
    widths = np.concatenate([np.full(len(points), section.width_m) for points, section in pieces])
    line = np.concatenate([points for points, _ in pieces])
    dense = resample(line, LANE_STEP_M)
    width_m = np.interp(np.linspace(0, 1, len(dense)), np.linspace(0, 1, len(line)), widths)
    headings = headings_of(dense)
    turn = np.gradient(np.unwrap(np.arctan2(headings[:, 1], headings[:, 0]))) / LANE_STEP_M
    low, high = side_bounds(fixed, dense, headings, turn, body_heights_m(scenario, plan), width_m, platform.clearance_m)
    flown_over_m = body_heights_m(scenario, plan)[0] - AIR_BELOW_M if platform.kind == "quadrotor" else 0.0
    return Lane(session, dense[:, :2], headings, low, high, platform.clearance_m, flown_over_m)
