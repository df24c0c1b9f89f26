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
# A heap at the lower right: half length, half width as an angle, and height.
_HEAP_M, _HEAP_RAD, _HEAP_HEIGHT_M = 0.8, 0.2, 0.7
_HEAP_AT_RAD = -1.2


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
        self._radius_m, self._seed = radius_m, seed
        self._heaps_m = np.array(heaps_m, dtype=np.float64)
        self._way_m = np.arange(0.0, length_m + 1e-6, spacing_m)
        self._wall_m = radius_m + _relief(length_m + 2 * _MAX_RANGE_M)
        odom_T_world = make_pose() if odom_T_world is None else odom_T_world
        self.odom_T_sensor = odom_T_world @ _centreline(self._way_m)

    def scan(self, index: int) -> PosedScan:
        """Make one scan."""
        rng = stream(self._seed, "scan", str(index))
        row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
        elevation = _ELEVATION_RAD * (1 - 2 * (row + rng.uniform()) / ROWS)
        azimuth = -2 * np.pi * (column + rng.uniform()) / COLUMNS
        flat = np.cos(elevation)
        x, y, z = flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)
        ahead_m = self._radius_m * x / np.hypot(y, z)
        pixels = np.flatnonzero(np.hypot(ahead_m, self._radius_m) < _MAX_RANGE_M)
        way_m, angle_rad = self._way_m[index] + ahead_m[pixels], np.arctan2(z, y)[pixels]
        world_T_sensor = _centreline(self._way_m[index : index + 1])[0]
        points = transform(invert(world_T_sensor), self._wall(way_m, angle_rad))
        points += rng.normal(0.0, _NOISE_M, points.shape)
        stamps_ns = np.full(len(points), int(self._way_m[index] * 1e9))
        return PosedScan(index, points, self.odom_T_sensor[index], stamps_ns, pixels.astype(np.int32))

    def scans(self) -> Iterator[PosedScan]:
        """Make all scans in order."""
        return (self.scan(index) for index in range(len(self._way_m)))

    def _wall(self, way_m: Float64Array, angle_rad: Float64Array) -> Float64Array:
        """Return the (N, 3) points of the wall at (N,) path lengths and (N,) angles about the centreline."""
        nodes = (way_m + _MAX_RANGE_M) / _NODE_M, angle_rad / (2 * np.pi) * _NODES_AROUND
        radius_m = map_coordinates(self._wall_m, nodes, order=1, mode="grid-wrap")
        for heap_m in self._heaps_m[(self._heaps_m > way_m.min() - 1.0) & (self._heaps_m < way_m.max() + 1.0)]:
            aside = np.maximum(np.abs(way_m - heap_m) / _HEAP_M, np.abs(angle_rad - _HEAP_AT_RAD) / _HEAP_RAD)
            radius_m -= _HEAP_HEIGHT_M * np.clip(3 * (1 - aside), 0.0, 1.0)
        poses = _centreline(way_m)
        across_m, up_m = radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad)
        return np.asarray(poses[:, :3, 3] + across_m[:, None] * poses[:, :3, 1] + up_m[:, None] * poses[:, :3, 2])


def _centreline(way_m: Float64Array) -> Float64Array:
    """Return the (N, 4, 4) poses on the centreline, x forward and z up; the path length is that of its x axis."""
    turn = 2 * np.pi / _SWING_LENGTH_M
    yaw_rad = np.arctan(_SWING_M * turn * np.cos(turn * way_m))
    c, s, zero = np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(way_m)
    rotations = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=-1).reshape(-1, 3, 3)
    return make_pose(rotations, np.column_stack([way_m, _SWING_M * np.sin(turn * way_m), zero]))


def _relief(length_m: float) -> Float64Array:
    """Return the relief of the wall at nodes along and around the tunnel, metres."""
    rng = stream(0, "corridor")
    along = 2 * np.pi / np.exp(rng.uniform(*np.log(_WAVES_M), _N_WAVES))
    around = rng.integers(0, 8, _N_WAVES)
    phase = rng.uniform(0.0, 2 * np.pi, _N_WAVES)
    at_way = np.exp(1j * (np.outer(np.arange(0.0, length_m + _NODE_M, _NODE_M), along) + phase))
    at_angle = np.exp(1j * np.outer(around, np.linspace(0.0, 2 * np.pi, _NODES_AROUND, endpoint=False)))
    return np.asarray((at_way @ at_angle).real * (_ROUGHNESS_M * np.sqrt(2 / _N_WAVES)))
