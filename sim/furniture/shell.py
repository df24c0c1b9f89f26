"""Roof and upper walls of a drift unrolled: stations along it, lengths of arc to both sides of the crown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates, minimum_filter, uniform_filter

from cdpipe.core.geometry import BoolArray, Float64Array
from sim.rock.axis import STATION_M, Axis, fill_from_nearest, is_opening, wall_distances

_ANGLES = np.deg2rad(np.linspace(-120.0, 120.0, 97))  # from the crown, to the left positive
_ARC_STEP_M = 0.1
_EYE_SHARE = 0.45  # of the drift's height: from here the rays go out


@dataclass(frozen=True, slots=True, eq=False)
class Shell:
    """The unrolled surface.

    Attributes:
        axis: The drift.
        eye: (S, 3) where the rays of a station start.
        rock_m: (S, A) distance to the rock at each of the fixed angles.
        taut_m: (S, A) smooth surface inside the rock, never farther than the rock around.
        is_open: (S, A) in a branch, a niche or a crossing.
        angle_of_arc: (S, U) angle at steps of 0.1 m of arc, the crown in the middle.
        half_arc_m: (S,) arc from the crown down to `lowest_share` of the height, the shorter of both sides.
    """

    axis: Axis
    eye: Float64Array
    rock_m: Float64Array
    taut_m: Float64Array
    is_open: BoolArray
    angle_of_arc: Float64Array
    half_arc_m: Float64Array

    @property
    def length_m(self) -> float:
        """Length of the drift along its stations."""
        return (len(self.eye) - 1) * STATION_M

    def angles_at(self, along_m: Float64Array, arc_m: Float64Array) -> Float64Array:
        """Return the angle from the crown at places (any shape) on the unrolled surface."""
        middle = self.angle_of_arc.shape[1] // 2
        return self._look_up(self.angle_of_arc, along_m, arc_m / _ARC_STEP_M + middle)

    def radii_at(self, grid: Float64Array, along_m: Float64Array, angle: Float64Array) -> Float64Array:
        """Return a quantity of the (S, A) grid at places on the unrolled surface."""
        return self._look_up(grid, along_m, (angle - _ANGLES[0]) / (_ANGLES[1] - _ANGLES[0]))

    def rays_at(self, along_m: Float64Array, angle: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return origins (..., 3) and unit directions (..., 3) of the rays that look at places on the surface."""
        stations = np.arange(len(self.eye)) * STATION_M
        eye = np.stack([np.interp(along_m, stations, self.eye[:, k]) for k in range(3)], axis=-1)
        left = np.stack([np.interp(along_m, stations, self.axis.left[:, k]) for k in range(2)], axis=-1)
        left /= np.linalg.norm(left, axis=-1, keepdims=True)
        return eye, np.concatenate([np.sin(angle)[..., None] * left, np.cos(angle)[..., None]], axis=-1)

    def is_bare(self, along_m: Float64Array, angle: Float64Array) -> BoolArray:
        """Mark the places where there is wall or roof of this drift to fix something to."""
        station = np.clip(np.rint(along_m / STATION_M).astype(np.int64), 0, len(self.eye) - 1)
        column = np.rint((angle - _ANGLES[0]) / (_ANGLES[1] - _ANGLES[0])).astype(np.int64)
        is_open = self.is_open[station, np.clip(column, 0, len(_ANGLES) - 1)]
        return np.asarray(self.axis.is_inside[station] & ~is_open)

    def _look_up(self, grid: Float64Array, along_m: Float64Array, column: Float64Array) -> Float64Array:
        where = np.stack([np.broadcast_to(along_m / STATION_M, column.shape), column]).reshape(2, -1)
        return np.asarray(map_coordinates(grid, where, order=1, mode="nearest").reshape(column.shape))


def measure_shell(axis: Axis, lowest_share: float) -> Shell:
    """Measure the surface of a drift from its crown down to a share of its height."""
    eye = axis.at(0.0, _EYE_SHARE * axis.height_m)
    n_stations, n_angles = len(eye), len(_ANGLES)
    across = np.concatenate([axis.left, np.zeros((n_stations, 1))], axis=1)
    directions = np.sin(_ANGLES)[None, :, None] * across[:, None] + np.cos(_ANGLES)[None, :, None] * [0.0, 0.0, 1.0]
    origins = np.repeat(eye, n_angles, axis=0)
    rock_m = wall_distances(axis.walls, origins, directions.reshape(-1, 3)).reshape(n_stations, n_angles)
    rock_m = np.minimum(rock_m, 4 * max(axis.section.width_m, axis.section.height_m))
    rock_m = fill_from_nearest(rock_m, axis.is_inside)
    is_open = is_opening(rock_m)
    # Half a metre to every side: a stiff mat lies on what stands out.
    half_angle = round(0.35 / (_ANGLES[1] - _ANGLES[0]) / (0.4 * axis.section.width_m))
    size = (3, 2 * max(half_angle, 1) + 1)
    taut_m = uniform_filter(minimum_filter(rock_m, size, mode="nearest"), size, mode="nearest")
    usual_m = gaussian_filter1d(np.where(is_open, np.median(taut_m, axis=0), taut_m), 2.0, axis=0, mode="nearest")
    angle_of_arc, half_arc_m = _arcs(axis, usual_m, lowest_share)
    return Shell(axis, eye, rock_m, taut_m, is_open, angle_of_arc, half_arc_m)


def _arcs(axis: Axis, radius_m: Float64Array, lowest_share: float) -> tuple[Float64Array, Float64Array]:
    across, up = radius_m * np.sin(_ANGLES), radius_m * np.cos(_ANGLES)
    steps = np.hypot(np.diff(across, axis=1), np.diff(up, axis=1))
    arc_m = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    crown = len(_ANGLES) // 2
    arc_m -= arc_m[:, [crown]]
    is_low = up < (lowest_share - _EYE_SHARE) * axis.height_m[:, None]
    low_m = np.where(is_low, np.abs(arc_m), np.inf)
    ends = [np.min(low_m[:, part], axis=1) for part in (slice(crown), slice(crown + 1, None))]
    half_arc_m = np.minimum(np.min(ends, axis=0), np.minimum(arc_m[:, -1], -arc_m[:, 0]))
    n_steps = int(np.ceil(np.abs(arc_m).max() / _ARC_STEP_M))
    wanted = np.arange(-n_steps, n_steps + 1) * _ARC_STEP_M
    angles = np.stack([np.interp(wanted, row, _ANGLES) for row in arc_m])
    return angles, half_arc_m
