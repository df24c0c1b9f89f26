"""The line of a mover on the floor: along a stretch of a drift, at its place across it, with the floor below it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from scenarios.schema import Platform
from sim.drive.path import Path
from sim.drive.ride import follow_floor
from sim.geometry.line import STEP_M, smooth_between, smooth_line
from sim.geometry.raycast import Caster
from sim.movers.body import Extent
from sim.movers.course import Course
from sim.placement.lanes import side_bounds
from sim.placement.placing import PROBE_UP_M, floor_heights
from sim.rock.centreline import Centreline, headings_of, left_of, resample

WALL_GAP_M = 0.1  # between a mover and rock or fixtures
_BESIDE_M = 0.35  # walls are looked for from this height on, as for a robot: the foot of a wall is rounded
_SWERVE_M = 1.5
_SOFT_M = 0.4
_STEP_LENGTH_M = 0.6  # who walks follows the floor as averaged over this half width, as a robot on legs does
# Axles and track of a machine as shares of its length and width.
_WHEELBASE, _TRACK = 0.38, 0.8
_HANG_M, _OFF_FLOOR_M = 0.15, 0.25  # of a curtain below the lowest roof over it, and of its edge above the floor


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """A stretch of an edge of the tunnel: its two nodes, and the shares of the way between which a mover goes."""

    edge: tuple[str, str]
    start: float
    end: float


def lay_line(
    stand: Stand, lateral: float, half_m: float, height_m: float, centreline: Centreline, fixed: Caster
) -> Path:
    """Return the line of a mover on the floor, in the direction from the stretch's start to its end.

    Args:
        stand: The stretch; of no length for a mover that stays.
        lateral: Place across the free width, -1 right, +1 left.
        half_m: Half of the mover's width.
        height_m: Its height.
        centreline: The drifts.
        fixed: Rock and fixtures.

    Raises:
        ScenarioError: The walls leave it no room, or there is no floor.
    """
    points, section = centreline.edge(*stand.edge)
    whole = resample(points, STEP_M)
    low, high = sorted((stand.start, stand.end))
    first, last = round(low * (len(whole) - 1)), round(high * (len(whole) - 1))
    rows = slice(max(0, first - 1), max(first, last) + 2)  # two samples at least, so that there is a direction
    line, headings = whole[rows], headings_of(whole)[rows]
    zero, width_m = np.zeros(len(line)), np.full(len(line), section.width_m)
    heights_m = np.array([_BESIDE_M, height_m / 2, height_m])
    bounds = side_bounds(fixed, line, headings, zero, heights_m, width_m, half_m + WALL_GAP_M)
    if (bounds[0] > bounds[1]).any():
        room_m = float((bounds[1] - bounds[0]).min()) + 2 * half_m
        raise ScenarioError(f"the walls leave it {room_m:.2f} m, and it needs {2 * half_m:.2f} m")
    share = (lateral + 1.0) / 2.0
    offset_m = smooth_between(
        (1.0 - share) * bounds[0] + share * bounds[1], *bounds, min(_SWERVE_M, len(line) * STEP_M / 4)
    )
    xy = smooth_line(line[:, :2] + offset_m[:, None] * left_of(headings), min(_SOFT_M, len(line) * STEP_M / 4))
    xy = xy[:: -1 if stand.end < stand.start else 1]
    level_m = line[:: -1 if stand.end < stand.start else 1, 2]
    return _on_floor(xy, level_m, fixed)


def _on_floor(xy: Float64Array, level_m: Float64Array, fixed: Caster) -> Path:
    """Return a line (N, 2) as a path on the floor that is looked for below a level (N,) and 1.2 m."""
    floor_m = floor_heights(fixed, np.column_stack([xy, level_m + PROBE_UP_M]))
    if not np.isfinite(floor_m).all() or (np.abs(floor_m - level_m) > PROBE_UP_M).any():
        raise ScenarioError("there is no floor below its line")
    headings = headings_of(xy)
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    yaw_rad = smooth_line(np.unwrap(np.arctan2(headings[:, 1], headings[:, 0])), 4 * STEP_M)
    return Path(distance_m, np.column_stack([xy, floor_m]), yaw_rad)


def walk_along(path: Path, speed_mps: float, pause_s: float) -> Course:
    """Return the course of a person along a path, upright on the floor as averaged over a step."""
    floor_m = smooth_line(path.points[:, 2], min(_STEP_LENGTH_M, path.distance_m[-1] / 4))
    return _course(path, floor_m, None, speed_mps, pause_s)


def drive_along(path: Path, speed_mps: float, pause_s: float, extent: Extent, fixed: Caster) -> Course:
    """Return the course of a machine along a path, on four wheels."""
    length_m, width_m, _ = extent.high - extent.low
    chassis = Platform(wheelbase_m=float(_WHEELBASE * length_m), track_m=float(_TRACK * width_m))
    floor_m, pitch, roll = follow_floor(path, fixed, chassis)
    return _course(path, floor_m, (pitch, roll), speed_mps, pause_s)


def _course(
    path: Path, floor_m: Float64Array, tilt: tuple[Float64Array, Float64Array] | None, speed_mps: float, pause_s: float
) -> Course:
    zero = np.zeros(len(floor_m))
    step_m = path.distance_m
    pitch, roll = tilt or (zero, zero)
    slope = np.gradient(floor_m, step_m) if tilt is None else zero
    points = np.column_stack([path.points[:, :2], floor_m])
    bend = np.gradient(smooth_line(path.yaw_rad, min(1.0, step_m[-1] / 4)), step_m)
    return Course(step_m, points, path.yaw_rad, pitch, roll, slope, bend, speed_mps, pause_s, 0.0, tilt is None)


def hang(path: Path, half_m: float, fixed: Caster) -> tuple[Float64Array, float]:
    """Return the middle (3,) of the upper edge of a curtain across a line's first place, and how far it hangs down.

    Raises:
        ScenarioError: There is no roof above it, or less than 1 m between roof and floor.
    """
    left = left_of(headings_of(path.points))[0]
    across = np.linspace(-half_m, half_m, 9)
    origins = np.repeat(path.points[:1], 9, axis=0) + np.column_stack([across[:, None] * left, np.full(9, 1.0)])
    up_m, _, _ = fixed.cast(origins, (0.0, 0.0, 1.0))
    down_m, _, _ = fixed.cast(origins, (0.0, 0.0, -1.0))
    top_m, low_m = origins[:, 2] + up_m - _HANG_M, origins[:, 2] - down_m + _OFF_FLOOR_M
    hang_m = float(top_m.min() - low_m.max())
    if not np.isfinite(hang_m) or hang_m < 1.0:
        raise ScenarioError("it has less than 1 m between roof and floor")
    return np.array([*path.points[0, :2], float(top_m.min())]), hang_m
