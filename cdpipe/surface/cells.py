"""The returns of a session in cells of 0.05 m, map frame: the surface that displacement is measured on.

A map point is the mean of a cell of 0.2 m, and rock is rough: two sessions sample a cell at different places, and the
means differ by centimetres where nothing moved. Cells of 0.05 m that count alike remove the effect of how densely a
session sampled a place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float32Array, Float64Array, Int32Array, Int64Array, transform, travelled_m
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.core.threads import in_threads
from cdpipe.model.types import MergedMaps, PointMap, SessionName
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
_LEAST_RETURNS, _THINNED = 2, 0.05
# At most so many scans are averaged at once, and so many points moved.
_SCANS, _BLOCK = 16, 1 << 18
# So many stretches are averaged before their means are put together.
_STRETCHES = 64
_NONE = np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class NearReturns:
    """The returns of a session within 16 m. Those of one stretch of the path in one cell are averaged: N means.

    Attributes:
        points: (N, 3) weighted means, map frame, metres.
        path_m: (N,) mean path position of the sensor, metres.
        weights: (N,) sum of the inverse variances: noise of the range, width of the beam, drift.
        counts: (N,) number of returns of each mean.
        cell_of: (N,) number of the cell of each.
        map_T_sensor: (S, 4, 4) poses of the scans of the session.
    """

    points: Float64Array
    path_m: Float64Array
    weights: Float64Array
    counts: Int32Array
    cell_of: Int64Array
    map_T_sensor: Float64Array

    def without(self, motions: PathMotions) -> NearReturns:
        """Return the returns with the motion of the scans taken off. What was in one cell stays together."""
        parts = [slice(start, start + _BLOCK) for start in range(0, len(self.points), _BLOCK)]
        moved = in_threads(lambda part: self.points[part] - motions.shifts(self.points[part], self.path_m[part]), parts)
        return replace(self, points=np.concatenate([self.points[:0], *moved]))


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceCells:
    """The occupied cells of a session.

    Attributes:
        points: (C, 3) weighted mean of the returns of each cell, map frame, metres.
        fold_offsets: (C, N_FOLDS, 3) float32 mean of the returns of each fold, less the point; NaN without returns.
        tree: k-d tree of the points.
        map_T_sensor: (S, 4, 4) poses of the scans of the session.
        numbers: (C,) number of each cell among the returns (`NearReturns.cell_of`).
    """

    points: Float64Array
    fold_offsets: Float32Array
    tree: cKDTree
    map_T_sensor: Float64Array
    numbers: Int64Array


def near_returns(merged: MergedMaps, session: SessionName) -> NearReturns:
    """Return near returns of a session. A scan moves into the map frame as a whole, by the alignment at its pose."""
    point_map = merged.map_of(session)
    poses = point_map.odom_T_sensor
    path_m = travelled_m(poses)
    map_T_odom = None if session == "before" else merged.alignment.at(poses[:, :3, 3])
    average = partial(_average_stretch, point_map, map_T_odom, path_m)
    stretches, n_returns, n = _stretches(path_m), int(point_map.scan_offsets[-1]), 0
    # there are no more means than returns; what is not written takes no memory
    found = tuple(np.empty((n_returns, *each.shape[1:]), dtype=each.dtype) for each in _NONE)
    for first in range(0, len(stretches), _STRETCHES):
        for part in in_threads(average, stretches[first : first + _STRETCHES]):
            end = n + len(part[0])
            for whole, each in zip(found, part, strict=True):
                whole[n:end] = each
            n = end
    points, paths_m, weights, counts, keys = (each[:n] for each in found)
    cell_of = number_cells(keys)
    return NearReturns(points, paths_m, weights, counts, cell_of, poses if map_T_odom is None else map_T_odom @ poses)


def number_cells(keys: Int64Array) -> Int64Array:
    """Return the number of the cell of each of (N,) keys, in the order of the keys.

    Most neighbours are in order, and such keys are found faster than sorted with their places.
    """
    ordered = np.sort(keys)
    ordered = ordered[np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]]
    blocks = [keys[start : start + _BLOCK] for start in range(0, len(keys), _BLOCK)]
    return np.concatenate([_NONE[-1], *in_threads(partial(np.searchsorted, ordered), blocks)])


def _stretches(path_m: Float64Array) -> list[range]:
    """Return the scans of each stretch of the path. Scans of a sensor that stands are dealt out to several."""
    stretch = np.floor(path_m / _FOLD_M)
    starts = np.flatnonzero(np.append(True, stretch[1:] != stretch[:-1])[: len(path_m)])
    ends = np.append(starts[1:], len(path_m))
    return [
        range(first, min(first + _SCANS, end))
        for start, end in zip(starts, ends, strict=True)
        for first in range(start, end, _SCANS)
    ]


def _average_stretch(
    point_map: PointMap, map_T_odom: Float64Array | None, path_m: Float64Array, scans: range
) -> tuple[Float64Array, Float64Array, Float64Array, Int32Array, Int64Array]:
    """Return points, path positions, weights, counts and keys of the cells of the means of some scans."""
    points, weights, paths_m = [], [], []
    for scan in scans:
        found = point_map.positions_of(slice(*point_map.scan_offsets[scan : scan + 2]))
        x, y, z = (found - point_map.odom_T_sensor[scan, :3, 3]).T
        range_m = np.sqrt(x * x + y * y + z * z)
        near = np.flatnonzero(range_m < _REACH_M)
        found, range_m = found[near], range_m[near]
        points.append(found if map_T_odom is None else transform(map_T_odom[scan], found))
        weights.append(1.0 / (_RANGE_M**2 + (_BEAM_RAD**2 + _DRIFT**2) * range_m**2))
        paths_m.append(np.full(len(near), path_m[scan]))
    everywhere, weight, path = np.concatenate(points), np.concatenate(weights), np.concatenate(paths_m)
    keys, group = np.unique(cell_keys(everywhere, CELL_M), return_inverse=True)
    summed: Float64Array = np.bincount(group, weight).astype(np.float64)
    # from the stretch's start on, so that rounding moves no mean into the stretch before
    start_m = np.floor(path_m[scans[0]] / _FOLD_M) * _FOLD_M
    *means, since_start_m = (np.bincount(group, weight * each) / summed for each in (*everywhere.T, path - start_m))
    counts = np.bincount(group).astype(np.int32)
    return np.stack(means, axis=1), since_start_m + start_m, summed, counts, keys


def make_cells(returns: NearReturns, *, with_folds: bool = True) -> SurfaceCells:
    """Return the cells of a session. False returns lie alone: a cell of one return is left out.

    In a map that was thinned before, nearly every cell holds one, and all are kept. Without folds, all returns of a
    cell are in one.
    """
    n, n_folds = int(returns.cell_of.max(initial=-1)) + 1, N_FOLDS if with_folds else 1
    group = returns.cell_of * n_folds
    # numbered where there are returns: stations of a survey at multiples of all folds would else share one
    group += np.unique(np.floor(returns.path_m / _FOLD_M), return_inverse=True)[1].reshape(-1) % n_folds
    counts = np.bincount(returns.cell_of, returns.counts, n)
    is_thinned = np.count_nonzero(counts > 1) < _THINNED * n
    kept = np.flatnonzero(counts >= (1 if is_thinned else _LEAST_RETURNS))

    weights = np.bincount(group, returns.weights, n * n_folds).reshape(n, n_folds)[kept]
    points, fold_offsets = np.empty((len(kept), 3)), np.empty((len(kept), n_folds, 3), dtype=np.float32)

    def average(axis: int) -> None:
        sums = np.bincount(group, returns.weights * returns.points[:, axis], n * n_folds).reshape(n, n_folds)[kept]
        points[:, axis] = sums.sum(axis=1) / weights.sum(axis=1)
        with np.errstate(invalid="ignore"):
            fold_offsets[:, :, axis] = sums / weights - points[:, axis, None]

    in_threads(average, range(3))
    return SurfaceCells(points, fold_offsets, cKDTree(points, balanced_tree=False), returns.map_T_sensor, kept)
