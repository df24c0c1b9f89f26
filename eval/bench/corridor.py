"""A rough tunnel of any length whose scans are made when they are read: large input that needs no disk and little time.

The wall is a closed form: its distance from the centreline is a sum of waves along and around the tunnel, minus heaps.
A return lies on the wall where its ray would meet a straight tube; occlusion is not modelled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.ndimage import map_coordinates

from cdpipe.core.geometry import Float64Array, invert, make_pose, stream, transform
from cdpipe.model.types import PosedScan

ROWS, COLUMNS = 32, 1024
_ELEVATION_RAD = np.deg2rad(22.1)
_MAX_RANGE_M = 55.0
_NOISE_M = 0.01
# Waves of the wall: number, shortest and longest length along the tunnel, and the standard deviation of their sum.
_N_WAVES, _WAVES_M, _ROUGHNESS_M = 60, (1.5, 60.0), 0.25
# The wall is computed at nodes and interpolated between them.
_NODE_M, _NODES_AROUND = 0.25, 96
# The centreline swings to either side by this much, once in this length.
_SWING_M, _SWING_LENGTH_M = 12.0, 330.0
# A heap on the lower left wall: where around the centreline, half length, half width as an angle, and height.
_HEAP_AT_RAD, _HEAP_M, _HEAP_RAD, _HEAP_HEIGHT_M = -1.2, 0.8, 0.2, 0.7


class CorridorScans:
    """A session in the tunnel: a scan source.

    Args:
        length_m: Path from the first scan to the last.
        radius_m: Mean radius of the tunnel.
        spacing_m: Path between scans.
        heaps_m: Path at which heaps lie. The wall is the same in all sessions; different heaps are changes.
        seed: Seed of the noise.
        odom_T_world: (4, 4) pose of the world in the session's odom frame.
    """

    def __init__(
        self,
        length_m: float,
        radius_m: float = 4.0,
        spacing_m: float = 1.0,
        heaps_m: Sequence[float] = (),
        seed: int = 0,
        odom_T_world: Float64Array | None = None,
    ) -> None:
        self.name = f"corridor {seed}"
        self._seed = seed
        self._heaps_m = np.array(heaps_m, dtype=np.float64)
        self._way_m = np.arange(0.0, length_m + 1e-6, spacing_m)
        self._wall_m = radius_m + _relief(length_m + 2 * _MAX_RANGE_M)
        row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
        elevation, azimuth = _ELEVATION_RAD * (1 - 2 * (row + 0.5) / ROWS), -2 * np.pi * (column + 0.5) / COLUMNS
        y, z = np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ahead_m = radius_m * np.cos(elevation) * np.cos(azimuth) / np.hypot(y, z)
        self._pixels = np.flatnonzero(np.hypot(ahead_m, radius_m) < _MAX_RANGE_M).astype(np.int32)
        self._ahead_m, self._angle_rad = ahead_m[self._pixels], np.arctan2(z, y)[self._pixels]
        centre, left = _centreline(self._way_m)
        forward = np.column_stack([left[:, 1], -left[:, 0], left[:, 2]])
        up = np.broadcast_to((0.0, 0.0, 1.0), left.shape)
        self._world_T_sensor = make_pose(np.stack([forward, left, up], axis=2), centre)
        self.odom_T_sensor = (make_pose() if odom_T_world is None else odom_T_world) @ self._world_T_sensor

    def scan(self, index: int) -> PosedScan:
        """Make one scan."""
        rng = stream(self._seed, "scan", str(index))
        # every scan looks in slightly other directions
        way_m = self._way_m[index] + self._ahead_m * rng.uniform(0.97, 1.03)
        angle_rad = self._angle_rad + rng.uniform(0.0, 2 * np.pi / COLUMNS)
        points = transform(invert(self._world_T_sensor[index]), self._wall(way_m, angle_rad))
        points += _NOISE_M * rng.standard_normal(points.shape, dtype=np.float32)
        stamps_ns = np.full(len(points), int(self._way_m[index] * 1e9))
        return PosedScan(index, points, self.odom_T_sensor[index], stamps_ns, self._pixels)

    def scans(self) -> Iterator[PosedScan]:
        """Make all scans in order."""
        return (self.scan(index) for index in range(len(self._way_m)))

    def _wall(self, way_m: Float64Array, angle_rad: Float64Array) -> Float64Array:
        """Return the (N, 3) points of the wall at (N,) path lengths and (N,) angles about the centreline."""
        nodes = (way_m + _MAX_RANGE_M) / _NODE_M, angle_rad / (2 * np.pi) * _NODES_AROUND
        radius_m = map_coordinates(self._wall_m, nodes, order=1, mode="grid-wrap")
        for heap_m in self._heaps_m[(self._heaps_m > way_m.min() - 1.0) & (self._heaps_m < way_m.max() + 1.0)]:
            near = np.flatnonzero(np.abs(way_m - heap_m) < _HEAP_M)
            aside = np.maximum(
                np.abs(way_m[near] - heap_m) / _HEAP_M, np.abs(angle_rad[near] - _HEAP_AT_RAD) / _HEAP_RAD
            )
            radius_m[near] -= _HEAP_HEIGHT_M * np.clip(3 * (1 - aside), 0.0, 1.0)
        points, left = _centreline(way_m)
        points += left * (radius_m * np.cos(angle_rad))[:, None]
        points[:, 2] += radius_m * np.sin(angle_rad)
        return points


def _centreline(way_m: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the (N, 3) points of the centreline and the (N, 3) directions to its left, at path lengths along x."""
    turn = 2 * np.pi / _SWING_LENGTH_M
    slope = _SWING_M * turn * np.cos(turn * way_m)
    cosine, zero = 1 / np.sqrt(1 + slope * slope), np.zeros_like(way_m)
    points = np.column_stack([way_m, _SWING_M * np.sin(turn * way_m), zero])
    return points, np.column_stack([-slope * cosine, cosine, zero])


def _relief(length_m: float) -> Float64Array:
    """Return the relief of the wall at nodes along and around the tunnel, metres."""
    rng = stream(0, "corridor")
    shortest, longest = np.log(_WAVES_M).tolist()
    along = 2 * np.pi / np.exp(rng.uniform(shortest, longest, _N_WAVES))
    around = rng.integers(0, 8, _N_WAVES)
    phase = rng.uniform(0.0, 2 * np.pi, _N_WAVES)
    at_way = np.exp(1j * (np.outer(np.arange(0.0, length_m + _NODE_M, _NODE_M), along) + phase))
    at_angle = np.exp(1j * np.outer(around, np.linspace(0.0, 2 * np.pi, _NODES_AROUND, endpoint=False)))
    return np.asarray((at_way @ at_angle).real * (_ROUGHNESS_M * np.sqrt(2 / _N_WAVES)))
