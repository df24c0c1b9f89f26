"""Registration of one scan with the map of others, point to plane, with poses that the odometry predicts as prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import (
    Float32Array,
    Float64Array,
    Int64Array,
    invert,
    make_pose,
    plane_jacobian,
    transform,
    travelled_m,
)
from cdpipe.core.geometry.motion import Motion, make_motion
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.core.spooled import SpooledArray
from cdpipe.model.types import ScanSource

# Points nearer than this are used: farther ones carry more of the rotation's error than of the walls.
_REACH_M = 20.0
# One point per cell of a scan makes the map, and one per larger cell is registered with it.
_MAP_CELL_M, _SCAN_CELL_M = 0.2, 0.6
_NEIGHBOURS = 10
# Standard deviation of a point's distance to its plane, and its correlation with its neighbours is in here, too.
_POINT_M = 0.05
# A sensor that stands sees one place in all its scans; more of them tell nothing new and take 1 MB each.
_MOST_SCANS = 200
_STEPS, _CONVERGED = 4, 2e-4
# Noise of the normals alone makes information along a smooth drift, a small share of that across it (validation: 0.002
# to 0.011; rough drifts 0.012 to 0.33). Nothing counts up to this share, and all from twice as much.
_NOISE_SHARE = 0.006
MIN_PAIRS = 50
_ROUNDING = 1e-12  # of a rotation in float64
_WALL_M = 3.0  # usual distance of a wall
# A point at this distance from the planes of a map is not on its walls.
_OFF_WALLS_M = 0.1


@dataclass(frozen=True, slots=True)
class Registration:
    """Settings of a registration.

    Attributes:
        voxel_m: Cell of the map.
        correspondence_m: Longest correspondence.
        robust_m: Scale of the robust weight, 1 / (1 + (d / robust_m)^2)^2.
        step_m: Standard deviation of the odometry from scan to scan.
        step_rad: The same of its rotation.
    """

    voxel_m: float
    correspondence_m: float
    robust_m: float
    step_m: float
    step_rad: float


class Registered(NamedTuple):
    """A scan that was registered.

    Attributes:
        pose: (4, 4) its pose, odom frame.
        off_share: Share of the points with a counterpart that lie 0.1 m and more off the walls.
        on_share: Share of all points that lie on the walls.
    """

    pose: Float64Array
    off_share: float
    on_share: float

    @property
    def misfit(self) -> float:
        """The share of points off the walls; 1 where too few have a counterpart, or none lies on them."""
        return self.off_share if self.on_share > 0 else 1.0


class Samples:
    """Points of every scan, in its sensor frame, and the path of the odometry.

    Rotations that are exact only to float32 are made orthonormal: their inverses are taken, and errors would add up.

    Attributes:
        source: The session.
        odometry: (S, 4, 4) recorded poses, or what they are mended to.
        path_m: (S,) length of this path up to each scan.
        motion: That through the recorded poses; None where it deskewed no points.
    """

    def __init__(self, source: ScanSource) -> None:
        self.source, self.odometry = source, orthonormal(source.odom_T_sensor)
        self.path_m = travelled_m(self.odometry)
        of_map, of_scan = SpooledArray(np.float32, (3,)), SpooledArray(np.float32, (3,))
        sizes, times_ns = [], []
        for scan in source.scans():
            parts = [scan.points_sensor.take(rows, axis=0) for rows in sample_rows(scan.points_sensor)]
            for part, spooled in zip(parts, (of_map, of_scan), strict=True):
                spooled.append(part)
            sizes.append([len(part) for part in parts])
            times_ns.append(-1 if scan.pose_ns is None else scan.pose_ns)
        self._points = of_map.finish(), of_scan.finish()
        self._offsets = np.concatenate([np.zeros((1, 2), np.int64), np.cumsum(sizes, axis=0)])
        self.motion = _motion(self.odometry, times_ns)
        self._replaced: dict[int, list[Float32Array]] = {}

    @property
    def n_points(self) -> Int64Array:
        """(S,) how many points of each scan are registered."""
        return np.diff(self._offsets[:, 1])

    def mend(self, odometry: Float64Array) -> None:
        """Take other (S, 4, 4) poses for those of the odometry."""
        self.odometry, self.path_m = odometry, travelled_m(odometry)

    def restore(self) -> None:
        """Take the points of all scans as they are recorded."""
        self._replaced.clear()

    def replace(self, index: int, points: Float64Array) -> None:
        """Take other (N, 3) points of a scan, sensor frame."""
        self._replaced[index] = [points.take(rows, axis=0).astype(np.float32) for rows in sample_rows(points)]

    def of_map(self, index: int) -> Float64Array:
        """Return the (N, 3) points that a scan adds to a map."""
        return self._part(0, index)

    def of_scan(self, index: int) -> Float64Array:
        """Return the (N, 3) points that are registered."""
        return self._part(1, index)

    def _part(self, kind: int, index: int) -> Float64Array:
        if index in self._replaced:
            return self._replaced[index][kind].astype(np.float64)
        start, end = self._offsets[index : index + 2, kind]
        return self._points[kind][start:end].astype(np.float64)


def _motion(poses: Float64Array, times_ns: list[int]) -> Motion | None:
    """Return the motion through (S, 4, 4) poses, or None where a time is unknown (-1) or not after the one before."""
    time_s = np.array(times_ns) / 1e9
    if len(poses) < 2 or min(times_ns) < 0 or (np.diff(time_s) <= 0).any():
        return None
    return motion_through(time_s, poses)


def motion_through(time_s: Float64Array, poses: Float64Array) -> Motion:
    """Return the motion through (S, 4, 4) poses at (S,) times."""
    return make_motion(time_s, travelled_m(poses), poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]))


def moved_m(poses: Float64Array, found: Float64Array) -> Float64Array:
    """Return the (N,) shifts from (N, 4, 4) poses to others, or what turns move at a wall where that is more."""
    motions = invert(poses) @ found
    # scipy 1.14 refuses to make no rotation at all
    turns_rad = Rotation.from_matrix(motions[:, :3, :3]).magnitude() if len(motions) else np.zeros(0)
    return np.asarray(np.maximum(np.linalg.norm(motions[:, :3, 3], axis=1), _WALL_M * turns_rad))


def orthonormal(poses: Float64Array) -> Float64Array:
    """Return the (S, 4, 4) poses with orthonormal rotations; those that are so to the rounding of float64 stay."""
    rotations = poses[:, :3, :3]
    defects = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    if not (is_off := defects > _ROUNDING).any():
        return poses
    poses = poses.copy()
    poses[is_off, :3, :3] = Rotation.from_matrix(rotations[is_off]).as_matrix()
    return poses


def spread(scans: Int64Array) -> Int64Array:
    """Return (N,) scans, or 200 of them from the first to the last."""
    n = len(scans)
    return scans if n <= _MOST_SCANS else scans[np.linspace(0, n - 1, _MOST_SCANS).astype(np.int64)]


def sample_rows(points: Float64Array) -> list[Int64Array]:
    """Return of (N, 3) points of a scan the rows of those that it adds to a map, and of those that are registered."""
    near = np.flatnonzero(np.einsum("ij,ij->i", points, points) < _REACH_M**2)
    return [near[_first_per_cell(points.take(near, axis=0), cell_m)] for cell_m in (_MAP_CELL_M, _SCAN_CELL_M)]


def _first_per_cell(points: Float64Array, cell_m: float) -> Int64Array:
    keys = cell_keys(points, cell_m)
    # neighbours in a scan mostly share a cell, so sorting one key per run is faster
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1])[: len(keys)])
    _, first = np.unique(keys[starts], return_index=True)
    return np.asarray(starts[np.sort(first)])


class Target:
    """The map of some scans, 200 of them at most, about a (3,) centre, with a plane at every point.

    Attributes:
        centre: (3,) its origin in the odom frame: rotations are found about it.
    """

    def __init__(
        self, scans: Samples, poses: Float64Array, chosen: Int64Array, centre: Float64Array, voxel_m: float
    ) -> None:
        self.centre = centre
        self._voxel_m = voxel_m
        chosen = spread(chosen)
        cloud = np.concatenate([transform(poses[index], scans.of_map(index)) for index in chosen]) - centre
        thinned, self._tree = small_gicp.preprocess_points(cloud, voxel_m, _NEIGHBOURS, num_threads=1)
        self._points = np.ascontiguousarray(thinned.points()[:, :3])
        self._normals = np.ascontiguousarray(thinned.normals()[:, :3])

    def planes(self, points: Float64Array, within_m: float) -> tuple[Int64Array, Float64Array, Float64Array]:
        """Return which of (N, 3) points have a plane, their (M,) signed distances, and the (M, 3) normals."""
        if not len(self._points):  # small_gicp dies of a search among none
            return np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))
        nearest, squared_m2 = self._tree.batch_knn_search(points, 1)
        chosen = np.flatnonzero(squared_m2[:, 0] < within_m**2)
        nearest = nearest[chosen, 0].astype(np.int64)
        normals = self._normals.take(nearest, axis=0)
        offsets = points.take(chosen, axis=0) - self._points.take(nearest, axis=0)
        distances_m = np.einsum("ij,ij->i", offsets, normals)
        # what lies beyond the map's end would draw the scan back
        is_over = squared_m2[chosen, 0] - distances_m**2 < self._voxel_m**2
        return chosen[is_over], distances_m[is_over], normals[is_over]


def register_scan(
    points: Float64Array,
    guess: Float64Array,
    predicted: Sequence[Float64Array],
    target: Target,
    settings: Registration,
) -> Registered:
    """Return the pose of a scan, and how it lies on the walls.

    It is found by Gauss-Newton on the distances to planes and on the odometry.

    Args:
        points: (N, 3) points, sensor frame, metres.
        guess: (4, 4) first pose, odom frame; it is the answer, with shares of 0, where too few points have a
            counterpart.
        predicted: (4, 4) poses that the odometry predicts from neighbours, one at least.
        target: The map.
        settings: Of the registration.
    """
    shift = make_pose(translation=-target.centre)
    pose, priors = shift @ guess, invert(shift @ np.stack(predicted))
    information = np.repeat([1 / settings.step_rad**2, 1 / settings.step_m**2], 3) / len(priors)
    for _ in range(_STEPS):
        chosen, distances_m, normals = target.planes(transform(pose, points), settings.correspondence_m)
        if len(chosen) < MIN_PAIRS:
            return Registered(guess, 0.0, 0.0)
        jacobian = plane_jacobian(points.take(chosen, axis=0), normals @ pose[:3, :3])
        weighted = jacobian / (_POINT_M * (1 + (distances_m / settings.robust_m) ** 2))[:, None] ** 2
        told = _discount_normal_noise(weighted.T @ jacobian)
        hessian, slope = told @ (weighted.T @ jacobian) @ told, told @ weighted.T @ distances_m
        errors = priors @ pose
        turns = Rotation.from_matrix(errors[:, :3, :3]).as_rotvec()  # one call: its checks take longer than its work
        for error, turn in zip(errors, turns, strict=True):
            residual = np.concatenate([turn, error[:3, 3]])
            turned = np.eye(6)
            turned[3:, 3:] = error[:3, :3]
            hessian += (turned.T * information) @ turned
            slope += (turned.T * information) @ residual
        step = -np.linalg.solve(hessian, slope)
        pose = pose @ make_pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        if np.abs(step).max() < _CONVERGED:
            break
    n_off = int(np.count_nonzero(np.abs(distances_m) > _OFF_WALLS_M))
    return Registered(invert(shift) @ pose, n_off / len(chosen), (len(chosen) - n_off) / len(points))


def _discount_normal_noise(hessian: Float64Array) -> Float64Array:
    """Return the (6, 6) shares of a motion that walls tell: none along a drift that the normals' noise alone tells."""
    values, axes = np.linalg.eigh(hessian[3:, 3:])
    told = np.eye(6)
    told[3:, 3:] = axes * np.clip(values / (_NOISE_SHARE * values[-1]) - 1, 0, 1) @ axes.T
    return told
