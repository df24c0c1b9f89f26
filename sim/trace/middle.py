"""The middle of a drift: a branch of the skeleton moved between the walls and set down on the floor, by rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cdpipe.core.geometry import Float64Array
from sim.geometry.raycast import Caster
from sim.rock.axis import STATION_M, bridge_openings, is_opening
from sim.rock.centreline import headings_of, left_of, resample
from sim.trace.inside import Void
from sim.trace.rays import fill_gaps, floor_below, roof_above, to_sides
from sim.trace.skeleton import Branch

DRIVE_M = 0.8  # height above the floor at which walls are looked for, less in a low drift
_DRIVE_SHARE = 0.4  # of the height
_ROUNDS = 3  # in which the line moves to the middle
_SOFT_WIDTHS = 0.3  # standard deviation of the smoothing along the line
_FLOOR_SOFT_M = 0.5
_REACH_WIDTHS = 3.0  # how far walls are looked for
_STEEP_DEG, _STEEP_OVER_M = 50.0, 2.0
_SHAFT_HEIGHTS = 2.5  # below a place so much higher than usual the floor is that of another level


@dataclass(frozen=True, slots=True, eq=False)
class Middle:
    """A branch as a line on the floor, stations 0.25 m apart.

    Attributes:
        ends: Numbers of the places where it begins and ends.
        points: (N, 3) on the floor, world frame, metres.
        right_m, left_m: (N,) room to the walls at the height of the drive; openings are bridged.
        height_m: (N,) room from floor to roof.
        roofless: Share of the stations without a roof above.
    """

    ends: tuple[int, int]
    points: Float64Array
    right_m: Float64Array
    left_m: Float64Array
    height_m: Float64Array
    roofless: float

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    @property
    def width_m(self) -> float:
        """Median width."""
        return float(np.median(self.right_m + self.left_m))

    def reversed(self) -> Middle:
        """Return the same line the other way."""
        points, right_m, left_m, height_m = (
            each[::-1] for each in (self.points, self.left_m, self.right_m, self.height_m)
        )
        return Middle((self.ends[1], self.ends[0]), points, right_m, left_m, height_m, self.roofless)


def find_middle(branch: Branch, caster: Caster, void: Void, width_m: float, is_met: tuple[bool, bool]) -> Middle:
    """Return a branch moved to the middle between the walls, on the floor; free ends go on to half a width before rock.

    Args:
        branch: Curve inside the void.
        caster: Walls that face the void.
        void: The inside.
        width_m: Typical width of the drifts.
        is_met: Whether other branches meet its first and its last point, which then stay.
    """
    points = _soften(resample(branch.points, STATION_M), _SOFT_WIDTHS * width_m, is_met)
    for side, met in zip((0, -1), is_met, strict=True):
        if not met:
            points = _go_on(points, side, caster, void, width_m)
    for _ in range(_ROUNDS):
        points = resample(points, STATION_M)
        middle = _look(points, branch.ends, caster, width_m)
        points = _move_between(middle, points, width_m, is_met)
    return _look(points, branch.ends, caster, width_m)


def is_steep(branch: Branch, width_m: float) -> bool:
    """Tell whether a branch rises over a width as nothing drives: a shaft, a raise, a step of a drift's height."""
    points = resample(branch.points, STATION_M)
    over = min(round(max(width_m, _STEEP_OVER_M) / STATION_M), len(points) - 1)
    rise_m = np.abs(points[over:, 2] - points[:-over, 2])
    run_m = np.linalg.norm(points[over:, :2] - points[:-over, :2], axis=1)
    return bool((rise_m > np.tan(np.deg2rad(_STEEP_DEG)) * run_m).any())


def _look(points: Float64Array, ends: tuple[int, int], caster: Caster, width_m: float) -> Middle:
    """Measure floor, roof and walls along points (N, 3) in the void."""
    floor_m = fill_gaps(floor_below(caster, points))
    floor_m = np.where(np.isfinite(floor_m), floor_m, points[:, 2])
    found_m = roof_above(caster, points)
    roof_m = fill_gaps(found_m)
    height_m = np.where(np.isfinite(roof_m), roof_m - floor_m, width_m)
    is_pierced = height_m > _SHAFT_HEIGHTS * np.median(height_m)
    floor_m, roof_m = (fill_gaps(np.where(is_pierced, np.nan, each)) for each in (floor_m, roof_m))
    height_m = np.where(np.isfinite(roof_m), roof_m - floor_m, width_m)
    floor_m = gaussian_filter1d(floor_m, _FLOOR_SOFT_M / STATION_M, mode="nearest")
    drive = np.column_stack([points[:, :2], floor_m + np.minimum(DRIVE_M, _DRIVE_SHARE * height_m)])
    sides = to_sides(caster, drive, left_of(headings_of(points)), _REACH_WIDTHS * width_m)
    right_m, left_m = (bridge_openings(room_m, is_opening(room_m)) for room_m in sides)
    on_floor = np.column_stack([points[:, :2], floor_m])
    return Middle(ends, on_floor, right_m, left_m, height_m, float(np.isnan(found_m).mean()))


def _move_between(middle: Middle, points: Float64Array, width_m: float, is_met: tuple[bool, bool]) -> Float64Array:
    """Return points (N, 3) shifted to the middle of the walls, halfway between floor and roof."""
    sigma = _SOFT_WIDTHS * width_m / STATION_M
    shift_m = np.clip((middle.left_m - middle.right_m) / 2, -width_m / 2, width_m / 2)
    shift_m = gaussian_filter1d(shift_m, sigma, mode="nearest")
    along_m = np.arange(len(points)) * STATION_M
    for met, away_m in zip(is_met, (along_m, along_m[::-1]), strict=True):
        if met:  # within half a width of a junction the walls are those of other drifts
            shift_m = shift_m * np.clip(away_m / width_m - 0.5, 0.0, 1.0)
    moved = points.copy()
    moved[:, :2] += shift_m[:, None] * left_of(headings_of(points))
    moved[:, 2] = middle.points[:, 2] + 0.5 * np.minimum(middle.height_m, _REACH_WIDTHS * width_m)
    return _soften(moved, sigma * STATION_M / 2, is_met)


def _soften(points: Float64Array, sigma_m: float, is_met: tuple[bool, bool]) -> Float64Array:
    """Return a line (N, 3) smoothed; ends that other lines meet stay where they are."""
    sigma = sigma_m / STATION_M
    pad = min(int(4 * sigma), len(points) - 1)
    padded = np.pad(points, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    soft = np.asarray(gaussian_filter1d(padded, sigma, axis=0)[pad : pad + len(points)])
    if is_met[0]:
        soft[0] = points[0]
    if is_met[1]:
        soft[-1] = points[-1]
    return soft


def _go_on(points: Float64Array, side: int, caster: Caster, void: Void, width_m: float) -> Float64Array:
    """Lengthen a line at a free end, straight and level, until half a width before rock or before the void ends."""
    back = min(len(points) - 1, round(width_m / STATION_M))
    way = (points[side] - points[back if side == 0 else -1 - back]) * (1.0, 1.0, 0.0)
    length_m = float(np.linalg.norm(way))
    if length_m < STATION_M:
        return points
    way /= length_m
    steps = points[side] + np.arange(1, round(1.5 * width_m / STATION_M) + 1)[:, None] * STATION_M * way
    floor_m = floor_below(caster, steps)
    drive = np.column_stack([steps[:, :2], np.where(np.isfinite(floor_m), floor_m + DRIVE_M, steps[:, 2])])
    ahead_m = np.minimum(caster.cast(steps, way)[0], caster.cast(drive, way)[0])
    is_good = void.holds(steps) & (ahead_m > width_m / 2)
    n_good = len(steps) if is_good.all() else int(np.argmin(is_good))
    more = steps[:n_good]
    return np.concatenate([more[::-1], points]) if side == 0 else np.concatenate([points, more])
