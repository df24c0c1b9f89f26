"""What a recording shows of the place where props are to stand: its floor, what stands there already, and the path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, invert, transform, travelled_m
from cdpipe.core.geometry.voxel import require_reachable, thin
from sim.graft.part import Part, world_points

_CELL_M = 0.07  # one return of each cell is kept
_SCAN_EVERY_M = 0.4
_MOST_SCANS, _MOST_POINTS, _BATCH = 1500, 30_000, 50
_BELOW_SENSOR_M, _DEEPEST_M = 0.2, 6.0
_BANDS_M = (0.25, 0.12, 0.08, 0.08)  # about the plane, narrower from fit to fit
_LEAST_POINTS, _MOST_FITTED, _LEAST_QUADRANTS = 12, 1000, 3
_ROUGHEST_M, _STEEPEST_DEG = 0.05, 15.0


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """A plane through the recorded floor about a place: height there, unit normal (3,), and its points of each part."""

    height_m: float
    normal: Float64Array
    n_points: tuple[int, ...]


class Surroundings:
    """The returns of all parts of a pair within reach of the path, thinned, world frame.

    Attributes:
        path: (P, 3) places of the sensor in all parts.
        paths: The same for each part.
        n_points: Number of returns.
    """

    def __init__(self, parts: Sequence[Part], reach_m: float) -> None:
        clouds = [_gather(part, reach_m) for part in parts]
        self.paths = tuple(part.world_T_sensor[:, :3, 3] for part in parts)
        self.path = np.concatenate(self.paths)
        self._n_parts = len(clouds)
        self._points = np.concatenate(clouds)
        self.n_points = len(self._points)
        self._part = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
        self._tree = cKDTree(self._points[:, :2])

    def near(self, place: Float64Array, radius_m: float) -> Int64Array:
        """Return the rows (N,) of the returns within some distance of a place (2,) as seen from above."""
        return np.asarray(self._tree.query_ball_point(place, radius_m, return_sorted=True), dtype=np.int64)

    def points(self, rows: Int64Array) -> Float64Array:
        """Return some returns (N, 3)."""
        return self._points[rows]

    def part_of(self, rows: Int64Array) -> Int64Array:
        """Return the number (N,) of the part that some returns belong to."""
        return np.asarray(self._part[rows], dtype=np.int64)

    def in_ball(self, place: Float64Array, radius_m: float) -> Int64Array:
        """Return the rows (N,) of the returns within some distance of a place (3,)."""
        rows = self.near(place[:2], radius_m)
        return np.asarray(rows[((self._points[rows] - place) ** 2).sum(axis=1) < radius_m**2])

    def nearest(self, place: Float64Array, within_m: float) -> Float64Array | None:
        """Return the return (3,) nearest to a place (3,); None where none is within some distance."""
        rows = self.in_ball(place, within_m)
        if not len(rows):
            return None
        return np.asarray(self._points[rows[((self._points[rows] - place) ** 2).sum(axis=1).argmin()]])

    def find_floor(self, place: Float64Array, radius_m: float, sensor_z_m: float) -> Floor | None:
        """Fit a plane to the lowest returns around a place (2,); None where they are few, rough, steep or one-sided.

        Args:
            place: Place as seen from above.
            radius_m: How far around it the floor is looked at.
            sensor_z_m: Height of the sensor nearby, below which the floor lies.
        """
        rows = self.near(place, radius_m)
        depth_m = sensor_z_m - self._points[rows, 2]
        rows = rows[(depth_m > _BELOW_SENSOR_M) & (depth_m < _DEEPEST_M)]
        if len(rows) < _LEAST_POINTS:
            return None
        rows = rows[:: -(-len(rows) // _MOST_FITTED)]
        local = self._points[rows] - [*place, 0.0]
        slope = np.array([0.0, 0.0, np.percentile(local[:, 2], 5)])
        design = np.column_stack([local[:, :2], np.ones(len(local))])
        for band_m in _BANDS_M:
            is_floor = np.abs(local[:, 2] - design @ slope) < band_m
            if not _surrounds(local[is_floor]):
                return None
            slope = np.linalg.lstsq(design[is_floor], local[is_floor, 2], rcond=None)[0]
        rough_m = float(np.std(local[is_floor, 2] - design[is_floor] @ slope))
        normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1.0 + slope[0] ** 2 + slope[1] ** 2)
        if rough_m > _ROUGHEST_M or normal[2] < np.cos(np.deg2rad(_STEEPEST_DEG)):
            return None
        counts = np.bincount(self._part[rows[is_floor]], minlength=self._n_parts)
        return Floor(float(slope[2]), normal, tuple(counts.tolist()))


def _surrounds(local: Float64Array) -> bool:
    """Return whether there are enough points (N, 3), in at least three quadrants about the origin."""
    quadrants = {(x > 0, y > 0) for x, y in local[:, :2].tolist()} if len(local) >= _LEAST_POINTS else set()
    return len(quadrants) >= _LEAST_QUADRANTS


def _gather(part: Part, reach_m: float) -> Float64Array:
    """Return the thinned returns (N, 3) of a part within some distance of the sensor.

    Raises:
        InputError: The part is too far from its origin.
    """
    way_m = travelled_m(part.odom_T_sensor)
    steps = np.floor(way_m / _SCAN_EVERY_M).astype(np.int64)
    chosen = np.flatnonzero(_starts(steps)) if steps[-1] > 20 else np.arange(len(steps))
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, min(_MOST_SCANS, len(chosen))).astype(np.int64))]
    farthest_m = float(np.abs(part.world_T_sensor[:, :3, 3]).max(initial=0.0)) + 2 * reach_m
    require_reachable(str(part.source.path), farthest_m, _CELL_M)
    kept, pending = np.zeros((0, 3)), []
    for revolution in part.revolutions(chosen):
        points = world_points(part, revolution)
        sensor = part.world_T_sensor[revolution.number][:3, 3]
        points = points[np.hypot(*(points - sensor)[:, :2].T) < reach_m + 2.0]
        pending.append(points[:: max(1, len(points) // _MOST_POINTS)])
        if len(pending) == _BATCH:
            kept, pending = thin(np.concatenate([kept, *pending]), _CELL_M), []
    return thin(np.concatenate([kept, *pending]), _CELL_M)


def _starts(steps: Int64Array) -> BoolArray:
    return np.append(True, np.diff(steps) > 0)


def in_object_frame(world_T_object: Float64Array, points: Float64Array) -> Float64Array:
    """Return points (N, 3) of the world in the frame of an object at a pose (4, 4)."""
    return transform(invert(world_T_object), points)
