"""The middle of a drift measured by rays: floor, roof and walls at stations along its length."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d, percentile_filter
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from scenarios.schema import Section
from sim.geometry.raycast import Caster
from sim.rock.centreline import STEP_M, Centreline, headings_of, left_of, resample

STATION_M = 0.25
UP = np.array([0.0, 0.0, 1.0])
_FACE_M = 1.0  # nothing is hung nearer to the face of a blind drift
_ASKEW = np.array([1.3e-3, 1.7e-3, 1.1e-3])
_NOTHING_M = 1e3  # distance where a ray leaves through a hole of a foreign mesh


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """Stations 0.25 m apart along one drift.

    Attributes:
        points: (S, 3) on the floor as measured (smoothed over some metres), world frame, metres.
        forward: (S, 2) unit direction of the drift in the x-y plane.
        left: (S, 2) unit direction to its left.
        clear_m: (S,) free height above `points`.
        height_m: (S,) height of the drift, smoothed over some metres, at most the nominal one.
        section: Nominal section.
        is_inside: (S,) in the void, and not just before the face of a blind drift.
        gives_way: (S,) inside another drift that continues where this one ends, or that the scenario names earlier.
        ways: (M, 4) samples of all drifts' centrelines, x, y, z, and the width of the drift there.
        walls: Caster of the bare rock.
    """

    points: Float64Array
    forward: Float64Array
    left: Float64Array
    clear_m: Float64Array
    height_m: Float64Array
    section: Section
    is_inside: BoolArray
    gives_way: BoolArray
    ways: Float64Array
    walls: Caster

    def at(self, across_m: Float64Array | float, up_m: Float64Array | float) -> Float64Array:
        """Return the (S, 3) world points at a distance to the left of the axis and a height above the floor."""
        across = np.broadcast_to(across_m, len(self.points))
        up = np.broadcast_to(up_m, len(self.points))
        return np.asarray(self.points + np.column_stack([self.left * across[:, None], up]))

    def to_side(self, up_m: Float64Array | float, side: float) -> Float64Array:
        """Return the (S,) distance to the wall at a height above the floor; side 1 is left, -1 right."""
        up = np.minimum(up_m, self.clear_m - 0.1)
        sideways = np.insert(side * self.left, 2, 0.0, axis=1)
        return fill_from_nearest(wall_distances(self.walls, self.at(0.0, up), sideways), self.is_inside)

    def to_roof(self, across_m: Float64Array | float) -> Float64Array:
        """Return the (S,) height of the roof above the floor, seen from half the drift's height."""
        middle_m = 0.5 * self.height_m
        return fill_from_nearest(middle_m + wall_distances(self.walls, self.at(across_m, middle_m), UP), self.is_inside)


def measure_axes(centreline: Centreline, walls: Caster) -> list[Axis]:
    """Measure the drifts of a centreline; a drift that lies in the rock of a foreign mesh is left out.

    The line is rounded where drifts meet at an angle, so that a line parallel to it never turns back on itself.
    """
    axes: list[Axis] = []
    ways = [np.insert(line.points, 3, line.section.width_m, axis=1) for line in centreline.drifts]
    for index, line in enumerate(centreline.drifts):
        points = resample(_round_corners(resample(line.points, STATION_M), line.section.width_m), STATION_M)
        axis = _measure(points, line.section, walls, _given_way(points, index, centreline), np.concatenate(ways))
        if axis.is_inside.sum() * STATION_M > 2.0:
            axes.append(axis)
    return axes


def wall_distances(walls: Caster, origins: Float64Array, directions: Float64Array) -> Float64Array:
    """Return the (N,) float64 distance to the rock along directions (N, 3) or (3,), 1000 m where there is none."""
    ranges_m, _ = _hits(walls, origins, directions)
    return np.where(np.isfinite(ranges_m), ranges_m, _NOTHING_M)


def fill_from_nearest(values: Float64Array, is_inside: BoolArray) -> Float64Array:
    """Replace the values (S, ...) of stations in the rock by that of the nearest station in the void."""
    inside = np.flatnonzero(is_inside)
    after = np.minimum(np.searchsorted(inside, np.arange(len(values))), len(inside) - 1)
    before = np.maximum(after - 1, 0)
    stations = np.arange(len(values))
    is_before = np.abs(inside[before] - stations) < np.abs(inside[after] - stations)
    return np.asarray(values[np.where(is_before, inside[before], inside[after])])


def find_nearest(known: Float64Array, points: Float64Array, within_m: float) -> tuple[Float64Array, Int64Array]:
    """Return the distance (N,) to the nearest known point, infinite beyond `within_m`, and which one (N,) it is."""
    distance_m, which = cKDTree(known).query(points, distance_upper_bound=within_m)
    return np.asarray(distance_m), np.asarray(which, dtype=np.int64)


def is_opening(distance_m: Float64Array) -> BoolArray:
    """Mark the stations (S, ...) at branches, niches and crossings: the rock is much farther than nearby."""
    every = 4
    thin = distance_m[::every]
    size = (17,) + (1,) * (distance_m.ndim - 1)  # 17 m
    usual_m = np.repeat(percentile_filter(thin, 35, size=size, mode="nearest"), every, axis=0)[: len(distance_m)]
    return np.asarray(distance_m > 1.25 * usual_m + 0.5)


def bridge_openings(distance_m: Float64Array, is_open: BoolArray) -> Float64Array:
    """Return the distances (S,) with openings spanned by straight lines, never farther than the rock."""
    if is_open.all():
        return distance_m
    stations = np.arange(len(distance_m))
    return np.minimum(distance_m, np.interp(stations, stations[~is_open], distance_m[~is_open]))


def lower_envelope(values: Float64Array, reach: int) -> Float64Array:
    """Return a smooth line (S,) nowhere above the values (S,); it descends `reach` stations before they do."""
    lowest = minimum_filter1d(values, 2 * reach + 1, mode="nearest")
    window = np.hanning(2 * reach + 3)[1:-1]
    return np.convolve(np.pad(lowest, reach, mode="edge"), window / window.sum(), mode="valid")


def find_runs(mask: BoolArray, shortest: int = 1) -> Iterator[tuple[int, int]]:
    """Yield (first, end) of every run of True, end excluded, that has at least `shortest` entries."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    for first, end in edges.reshape(-1, 2):
        if end - first >= shortest:
            yield int(first), int(end)


def _round_corners(points: Float64Array, width_m: float) -> Float64Array:
    sigma = 0.25 * width_m / STATION_M
    pad = min(int(4 * sigma), len(points) - 1)
    padded = np.pad(points, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(padded, sigma, axis=0)[pad : pad + len(points)])


def _given_way(points: Float64Array, index: int, centreline: Centreline) -> BoolArray:
    """Mark the stations (S,) inside a drift that continues where this one ends, or inside an earlier drift."""
    gives_way = np.zeros(len(points), dtype=bool)
    for number, other in enumerate(centreline.drifts):
        if number == index:
            continue
        reach_m = 0.5 * other.section.width_m
        distance_m, nearest = find_nearest(other.points, points, reach_m)
        samples_to_end: Int64Array = np.minimum(nearest, len(other.points) - 1 - nearest)
        is_in_other = np.isfinite(distance_m) & (samples_to_end * STEP_M > reach_m)
        for first, end in find_runs(is_in_other):
            if number < index or first == 0 or end == len(points):
                gives_way[first:end] = True
    return gives_way


def _measure(points: Float64Array, section: Section, walls: Caster, gives_way: BoolArray, ways: Float64Array) -> Axis:
    forward = headings_of(points)
    middle = points + np.array([0.0, 0.0, 0.5 * section.height_m])
    level = np.insert(forward, 2, 0.0, axis=1)
    floor, roof, ahead, behind = (_face(walls, middle, way) for way in (-UP, UP, level, -level))
    is_inside = np.isfinite(floor) & np.isfinite(roof) & ~(ahead < _FACE_M) & ~(behind < _FACE_M)
    stations = np.arange(len(points))
    if is_inside.any():
        floor, roof = (np.interp(stations, stations[is_inside], heights[is_inside]) for heights in (floor, roof))
    floor_z = middle[:, 2] - gaussian_filter1d(floor, 1.0 / STATION_M, mode="nearest")
    clear_m = middle[:, 2] + roof - floor_z
    height_m = np.minimum(gaussian_filter1d(clear_m, 3.0 / STATION_M, mode="nearest"), section.height_m)
    on_floor = np.column_stack([points[:, :2], floor_z])
    return Axis(on_floor, forward, left_of(forward), clear_m, height_m, section, is_inside, gives_way, ways, walls)


def _face(walls: Caster, origins: Float64Array, directions: Float64Array) -> Float64Array:
    """Distance (N,) to rock that faces the origin; NaN where there is none or the origin lies in the rock."""
    ranges_m, normals = _hits(walls, origins, directions)
    is_front = np.isfinite(ranges_m) & ((normals * directions).sum(axis=1) < 0)
    return np.where(is_front, ranges_m, np.nan)


def _hits(walls: Caster, origins: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return distances (N,), infinite for a miss, and normals (N, 3); a miss is cast again slightly tilted."""
    ranges_m, _, normals = walls.hits(origins, directions)
    missed = np.flatnonzero(~np.isfinite(ranges_m))
    if len(missed):
        askew = np.broadcast_to(directions, origins.shape)[missed] + _ASKEW
        askew /= np.linalg.norm(askew, axis=1, keepdims=True)
        ranges_m[missed], _, normals[missed] = walls.hits(origins[missed], askew)
    return ranges_m.astype(np.float64), normals.astype(np.float64)
