"""The returns of a session in cells of 0.05 m, map frame: the surface that displacement is measured on.

A map point is the mean of a cell of 0.2 m, and rock is rough: two sessions sample a cell at different places, and the
means differ by centimetres where nothing moved. Cells of 0.05 m that count alike remove the effect of how densely a
session sampled a place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float32Array, Float64Array, transform, travelled_m
from cdpipe.core.voxel import cell_keys
from cdpipe.model.types import MergedMaps, SessionName
from cdpipe.surface.motions import PathMotions

CELL_M = 0.05
# Scans of one stretch of path err together, so the stretches are dealt out to this many folds. How the folds of a place
# differ tells the error of their mean.
N_FOLDS = 4
_FOLD_M = 1.0
# Standard deviation of a range (Ouster OS1 data sheet: 0.7 to 3 cm), and half the width of a beam (0.18 deg, same
# sheet): a return is uncertain across the beam, too, and on a slanting wall that counts.
_RANGE_M, _BEAM_RAD = 0.015, np.deg2rad(0.09)
# Share of the range by which a return is off, as the odometry drifts between the place that it is seen from and the
# place itself. Near returns therefore decide where there are any; a roof 3 m above the sensor is seen from 8 m on.
_DRIFT = 0.01
_REACH_M = 16.0
_LEAST_RETURNS = 2


@dataclass(frozen=True, slots=True, eq=False)
class NearReturns:
    """The returns of a session within 16 m.

    Attributes:
        points: (N, 3) map frame, metres.
        path_m: (N,) path position of the sensor at each, metres.
        weights: (N,) inverse of the variance of each: noise of the range, width of the beam, drift.
        map_T_sensor: (S, 4, 4) poses of the scans of the session.
    """

    points: Float64Array
    path_m: Float64Array
    weights: Float64Array
    map_T_sensor: Float64Array

    def without(self, motions: PathMotions) -> NearReturns:
        """Return the returns with the motion of the scans taken off."""
        points = self.points.copy()
        for start in range(0, len(points), 1 << 20):
            part = slice(start, start + (1 << 20))
            points[part] -= motions.shifts(self.points[part], self.path_m[part])
        return replace(self, points=points)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceCells:
    """The occupied cells of a session.

    Attributes:
        points: (C, 3) weighted mean of the returns of each cell, map frame, metres.
        fold_offsets: (C, N_FOLDS, 3) float32 mean of the returns of each fold, less the point; NaN without returns.
        tree: k-d tree of the points.
        map_T_sensor: (S, 4, 4) poses of the scans of the session.
    """

    points: Float64Array
    fold_offsets: Float32Array
    tree: cKDTree
    map_T_sensor: Float64Array


def near_returns(merged: MergedMaps, session: SessionName) -> NearReturns:
    """Return near returns of a session. A scan moves into the map frame as a whole, by the alignment at its pose."""
    point_map = merged.map_of(session)
    poses = point_map.odom_T_sensor
    positions, path_m = poses[:, :3, 3], travelled_m(poses)
    map_T_odom = np.tile(np.eye(4), (len(poses), 1, 1)) if session == "before" else merged.alignment.at(positions)
    points, paths_m, weights = ([np.zeros(shape)] for shape in ((0, 3), (0,), (0,)))
    for scan, (start, end) in enumerate(zip(point_map.scan_offsets[:-1], point_map.scan_offsets[1:], strict=True)):
        found = point_map.positions_of(np.arange(start, end))
        range_m = np.linalg.norm(found - positions[scan], axis=1)
        near = np.flatnonzero(range_m < _REACH_M)
        points.append(transform(map_T_odom[scan], found[near]))
        paths_m.append(np.full(len(near), path_m[scan]))
        variance_m2 = _RANGE_M**2 + (_BEAM_RAD**2 + _DRIFT**2) * range_m[near] ** 2
        weights.append(1.0 / variance_m2)
    return NearReturns(np.concatenate(points), np.concatenate(paths_m), np.concatenate(weights), map_T_odom @ poses)


def make_cells(returns: NearReturns) -> SurfaceCells:
    """Return the cells of a session. False returns lie alone: a cell of one return is left out."""
    _, cell_of = np.unique(cell_keys(returns.points, CELL_M), return_inverse=True)
    n = int(cell_of.max()) + 1 if len(cell_of) else 0
    group = cell_of * N_FOLDS + np.floor(returns.path_m / _FOLD_M).astype(np.int64) % N_FOLDS
    weights = np.bincount(group, returns.weights, n * N_FOLDS).reshape(n, N_FOLDS)
    sums = np.stack(
        [np.bincount(group, returns.weights * values, n * N_FOLDS) for values in returns.points.T], axis=-1
    ).reshape(n, N_FOLDS, 3)
    kept = np.flatnonzero(np.bincount(cell_of, minlength=n) >= _LEAST_RETURNS)
    weights, sums = weights[kept], sums[kept]
    points = sums.sum(axis=1) / weights.sum(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        fold_offsets = (sums / weights[:, :, None] - points[:, None]).astype(np.float32)
    return SurfaceCells(points, fold_offsets, cKDTree(points), returns.map_T_sensor)
