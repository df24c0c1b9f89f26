"""A session's own map made consistent: every scan is registered once more with the scans around it.

Odometry errs from scan to scan, mostly along the drift and in roll. Walls then stand twice in the map, centimetres
apart, and metres where the odometry found no start. Here each scan is registered, point to plane, with the map of other
scans within a few metres of path. The relative pose of the odometry to its neighbours is the prior: it decides where
the walls do not.

1. From the middle of the session to both ends, each scan is registered with the scans before it (`_follow`).
2. Sweeps register every scan with those on both sides (`_register_all`): first each with every second scan alone, never
   with itself, as a scan that is off would find itself; then with all, which ties even and odd scans together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose, plane_jacobian, transform, travelled_m
from cdpipe.core.spooled import SpooledArray
from cdpipe.core.voxel import cell_keys
from cdpipe.model.types import PosedScan, ScanSource

# Points nearer than this are used: farther ones carry more of the rotation's error than of the walls.
_REACH_M = 20.0
# One point per cell of a scan makes the map, and one per larger cell is registered with it.
_MAP_CELL_M, _SCAN_CELL_M = 0.2, 0.6
# A block of path is registered with one map: its scans, and those within this way before and after it.
_BLOCK_M, _AROUND_M = 4.0, 6.0
# A scan is followed in the map of the scans within this way behind it, which is made anew once per metre.
_BEHIND_M, _RENEWED_M = 10.0, 1.0
_NEIGHBOURS = 10
# Standard deviation of a point's distance to its plane, and its correlation with its neighbours is in here, too.
_POINT_M = 0.05
_STEPS, _CONVERGED = 4, 2e-4
# Noise of the normals alone makes information along a smooth drift, a small share of that across it (validation: 0.002
# to 0.011; rough drifts 0.012 to 0.33). Nothing counts up to this share, and all from twice as much.
_NOISE_SHARE = 0.006
_MIN_PAIRS = 50
# Scans agree already if a sweep moves nine of ten by no more than this: 0.4 to 0.6 cm at constant drift, 4 cm with
# KISS-ICP (validation tunnels of `narrow` and `wide`).
_AGREE_M = 0.015


@dataclass(frozen=True, slots=True)
class _Sweep:
    """Settings of one sweep over all scans.

    Attributes:
        voxel_m: Cell of the map.
        correspondence_m: Longest correspondence.
        robust_m: Scale of the robust weight, 1 / (1 + (d / robust_m)^2)^2.
        step_m: Standard deviation of the odometry from scan to scan.
        step_rad: The same of its rotation.
        by_halves: Whether a scan is compared with every second scan alone.
    """

    voxel_m: float
    correspondence_m: float
    robust_m: float
    step_m: float
    step_rad: float
    by_halves: bool


_FOLLOWING = _Sweep(0.3, 1.0, 0.2, 0.2, 0.02, by_halves=False)
_SWEEPS = (
    _Sweep(0.2, 0.5, 0.07, 0.1, 0.01, by_halves=True),
    _Sweep(0.2, 0.5, 0.05, 0.1, 0.01, by_halves=False),
)


class ConsistentScans(ScanSource):
    """A session with other poses than those that were recorded."""

    def __init__(self, source: ScanSource, odom_T_sensor: Float64Array) -> None:
        self._source, self._poses = source, odom_T_sensor

    @property
    def name(self) -> str:
        """Name of the session in messages."""
        return self._source.name

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) consistent pose of each scan, odom frame."""
        return self._poses

    def scan(self, index: int) -> PosedScan:
        """Read one scan."""
        return replace(self._source.scan(index), odom_T_sensor=self._poses[index])

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order."""
        for scan in self._source.scans():
            yield replace(scan, odom_T_sensor=self._poses[scan.index])


def make_consistent(source: ScanSource) -> ConsistentScans:
    """Return a session with poses under which its scans agree with one another; the recorded ones where they do so.

    Time grows with the number of scans; the points of a long session are in a temporary file.

    Raises:
        InputError: A scan cannot be read.
    """
    scans, recorded = _Samples(source), source.odom_T_sensor
    moved_m = np.linalg.norm((_register_all(scans, recorded, _SWEEPS[-1]) - recorded)[:, :3, 3], axis=1)
    if np.percentile(moved_m, 90) <= _AGREE_M:
        return ConsistentScans(source, recorded)
    poses = _follow(scans, _FOLLOWING)
    for sweep in _SWEEPS:
        poses = _register_all(scans, poses, sweep)
    return ConsistentScans(source, poses)


class _Samples:
    """Points of every scan, in its sensor frame, and the recorded path."""

    def __init__(self, source: ScanSource) -> None:
        self.recorded = source.odom_T_sensor
        self.path_m = travelled_m(self.recorded)
        of_map, of_scan = SpooledArray(np.float32, (3,)), SpooledArray(np.float32, (3,))
        sizes = []
        for scan in source.scans():
            points = scan.points_sensor[np.einsum("ij,ij->i", scan.points_sensor, scan.points_sensor) < _REACH_M**2]
            parts = [_first_per_cell(points, cell_m) for cell_m in (_MAP_CELL_M, _SCAN_CELL_M)]
            for part, spooled in zip(parts, (of_map, of_scan), strict=True):
                spooled.append(part)
            sizes.append([len(part) for part in parts])
        self._points = of_map.finish(), of_scan.finish()
        self._offsets = np.concatenate([np.zeros((1, 2), np.int64), np.cumsum(sizes, axis=0)])

    def of_map(self, index: int) -> Float64Array:
        """Return the (N, 3) points that a scan adds to a map."""
        return self._part(0, index)

    def of_scan(self, index: int) -> Float64Array:
        """Return the (N, 3) points that are registered."""
        return self._part(1, index)

    def _part(self, kind: int, index: int) -> Float64Array:
        start, end = self._offsets[index : index + 2, kind]
        return self._points[kind][start:end].astype(np.float64)


def _first_per_cell(points: Float64Array, cell_m: float) -> Float64Array:
    _, first = np.unique(cell_keys(points, cell_m), return_index=True)
    return points[np.sort(first)]


class _Target:
    """The map of some scans about a (3,) centre, with a plane at every point."""

    def __init__(
        self, scans: _Samples, poses: Float64Array, chosen: Int64Array, centre: Float64Array, voxel_m: float
    ) -> None:
        cloud = np.concatenate([transform(poses[index], scans.of_map(index)) for index in chosen]) - centre
        self._voxel_m = voxel_m
        thinned, self._tree = small_gicp.preprocess_points(cloud, voxel_m, _NEIGHBOURS, num_threads=1)
        self._points = np.ascontiguousarray(thinned.points()[:, :3])
        self._normals = np.ascontiguousarray(thinned.normals()[:, :3])

    def planes(self, points: Float64Array, within_m: float) -> tuple[Int64Array, Float64Array, Float64Array]:
        """Return which of (N, 3) points have a plane, their (M,) signed distances, and the (M, 3) normals."""
        nearest, squared_m2 = self._tree.batch_knn_search(points, 1)
        chosen = np.flatnonzero(squared_m2[:, 0] < within_m**2)
        nearest = nearest[chosen, 0].astype(np.int64)
        normals = self._normals.take(nearest, axis=0)
        offsets = points.take(chosen, axis=0) - self._points.take(nearest, axis=0)
        distances_m = np.einsum("ij,ij->i", offsets, normals)
        # what lies beyond the map's end would draw the scan back
        is_over = squared_m2[chosen, 0] - distances_m**2 < self._voxel_m**2
        return chosen[is_over], distances_m[is_over], normals[is_over]


def _follow(scans: _Samples, sweep: _Sweep) -> Float64Array:
    """Return the (S, 4, 4) poses, each found from its neighbour's; the middle scan keeps its recorded pose."""
    found, path_m = scans.recorded.copy(), scans.path_m
    n, middle = len(found), len(found) // 2
    for way in (range(middle + 1, n), range(middle - 1, -1, -1)):
        target, made_m, centre = None, np.inf, np.zeros(3)
        for index in way:
            last = index - way.step
            guess = found[last] @ invert(scans.recorded[last]) @ scans.recorded[index]
            if target is None or abs(path_m[index] - made_m) >= _RENEWED_M:
                behind = np.arange(middle, index, way.step)
                near = behind[np.abs(path_m[behind] - path_m[index]) <= _BEHIND_M]
                made_m, centre = path_m[index], guess[:3, 3]
                target = _Target(scans, found, near if len(near) else behind[-1:], centre, sweep.voxel_m)
            found[index] = _register(scans.of_scan(index), guess, [guess], target, centre, sweep)
    return found


def _register_all(scans: _Samples, poses: Float64Array, sweep: _Sweep) -> Float64Array:
    """Return the (S, 4, 4) poses after one sweep; all scans of a block are registered with the poses before it."""
    found = poses.copy()
    steps = invert(scans.recorded[:-1]) @ scans.recorded[1:]
    path_m = scans.path_m
    blocks = np.floor(path_m / _BLOCK_M)
    for block in np.unique(blocks):
        own = np.flatnonzero(blocks == block)
        is_near = (path_m >= path_m[own[0]] - _AROUND_M) & (path_m <= path_m[own[-1]] + _AROUND_M)
        near = np.flatnonzero(is_near)
        centre = poses[own[len(own) // 2], :3, 3]
        halves = [near[near % 2 == 1], near[near % 2 == 0]] if sweep.by_halves else [near, near]
        if not all(len(half) for half in halves):
            continue
        first = _Target(scans, poses, halves[0], centre, sweep.voxel_m)
        second = _Target(scans, poses, halves[1], centre, sweep.voxel_m) if sweep.by_halves else first
        for index in own.tolist():
            predicted = [poses[index - 1] @ steps[index - 1]] if index else []
            predicted += [poses[index + 1] @ invert(steps[index])] if index + 1 < len(poses) else []
            target = first if index % 2 == 0 else second
            found[index] = _register(scans.of_scan(index), poses[index], predicted, target, centre, sweep)
    return found


def _register(
    points: Float64Array,
    guess: Float64Array,
    predicted: list[Float64Array],
    target: _Target,
    centre: Float64Array,
    sweep: _Sweep,
) -> Float64Array:
    """Return the (4, 4) pose of a scan by Gauss-Newton on its distances to planes and on the odometry."""
    shift = make_pose(translation=-centre)
    pose, priors = shift @ guess, [invert(shift @ each) for each in predicted]
    information = np.repeat([1 / sweep.step_rad**2, 1 / sweep.step_m**2], 3) / max(len(priors), 1)
    for _ in range(_STEPS):
        chosen, distances_m, normals = target.planes(transform(pose, points), sweep.correspondence_m)
        if len(chosen) < _MIN_PAIRS:
            return guess
        jacobian = plane_jacobian(points.take(chosen, axis=0), normals @ pose[:3, :3])
        weighted = jacobian / (_POINT_M * (1 + (distances_m / sweep.robust_m) ** 2))[:, None] ** 2
        told = _discount_normal_noise(weighted.T @ jacobian)
        hessian, slope = told @ (weighted.T @ jacobian) @ told, told @ weighted.T @ distances_m
        for prior in priors:
            error = prior @ pose
            residual = np.concatenate([Rotation.from_matrix(error[:3, :3]).as_rotvec(), error[:3, 3]])
            turned = np.eye(6)
            turned[3:, 3:] = error[:3, :3]
            hessian += (turned.T * information) @ turned
            slope += (turned.T * information) @ residual
        step = -np.linalg.solve(hessian, slope)
        pose = pose @ make_pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        if np.abs(step).max() < _CONVERGED:
            break
    return invert(shift) @ pose


def _discount_normal_noise(hessian: Float64Array) -> Float64Array:
    """Return the (6, 6) shares of a motion that walls tell: none along a drift that the normals' noise alone tells."""
    values, axes = np.linalg.eigh(hessian[3:, 3:])
    told = np.eye(6)
    told[3:, 3:] = axes * np.clip(values / (_NOISE_SHARE * values[-1]) - 1, 0, 1) @ axes.T
    return told
