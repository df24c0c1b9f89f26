"""What stands in a robot's way: props beside its line, and the rock around it."""

from __future__ import annotations

import numpy as np

from cdpipe.errors import ScenarioError
from cdpipe.geometry import Float64Array
from scenarios.schema import Scenario
from sim.centreline import left_of, resample
from sim.placing import standing_corners
from sim.scene import World

STEP_M = 0.05  # between the samples of a line
# A quadrotor keeps this much air below it; what is lower is flown over.
_AIR_BELOW_M = 0.5
# The body checked against the walls: the true gap may be this share of the clearance where the wall bulges.
_TIGHTEST_SHARE = 0.5


def obstacles(
    world: World, scenario: Scenario, session: str, line: Float64Array, headings: Float64Array, height_m: float
) -> list[tuple[str, Float64Array, Float64Array]]:
    """Return for each prop in the way its name and the offsets it forbids, (N,) to (N,), NaN where it is far."""
    clearance_m = scenario.platform.clearance_m
    left = left_of(headings)
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


def pass_by(
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


def check_clearance(world: World, scenario: Scenario, session: str, points: Float64Array) -> None:
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
