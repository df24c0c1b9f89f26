"""Scan descriptors made by hand: Scan Context and SOLiD, in the form that the learned one has.

Both turn a scan into q, a place vector that a turn of the sensor leaves alone, and w, one value per azimuth sector that
a turn shifts, so that the merge and the query use them as they use `3deg`. Two things differ from both papers. Places
are compared by the distance of q alone: the merge's votes and its registration do what the papers do by a second,
slower comparison of whole images. And w has 64 sectors instead of 60, as 3DEG's has 64 values, and is compared by
circular correlation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, require_shape
from cdpipe.core.voxel import cell_keys

# Of the vectors: raised when they change, so that stored ones are made anew.
VERSION = 1
SECTORS = 64
# As published, over streets. A drift is 4 to 10 m wide, but its far ends are what tells one place from the next: of 20,
# 40, 80 and 120 m, 80 m found most places with either descriptor on four validation pairs.
MAX_RANGE_M = 80.0

CONTEXT_RINGS = 20
# What lies under the sensor counts as height too (the authors' code lifts by 2 m): 3 m, for a drone in a high drift.
LIFT_M = 3.0

SOLID_RINGS = 40
SOLID_ROWS = 32
SOLID_ELEVATION_RAD = np.deg2rad(22.8)  # an OS1-32's field of view, and half a beam more on either side
SOLID_VOXEL_M = 0.5

Vectors = tuple[Float32Array, Float32Array]


def scan_context(points_sensor: Float64Array) -> Vectors:
    """Return ring key and sector key of a Scan Context (Kim & Kim, IROS 2018, 10.1109/IROS.2018.8593953).

    The context is the height of the highest return in each of 20 rings by 64 sectors (the paper: 60) about the sensor,
    seen from above; 0 where there is none. The ring key is the share of each ring's bins that hold a return, as in the
    paper (the authors' code takes their mean height, which found fewer places here); the sector key, which the paper
    does not have, is the mean height of each sector, as in the authors' code.

    Args:
        points_sensor: (N, 3) deskewed returns, sensor frame, metres.

    Returns:
        q (20,) of unit length, and w (64,) of zero mean and unit length; zeros for a scan that has nothing to tell.
    """
    require_shape("points_sensor", points_sensor, (None, 3))
    x, y, z = np.ascontiguousarray(points_sensor.T)
    ring = (np.sqrt(x * x + y * y) * (CONTEXT_RINGS / MAX_RANGE_M)).astype(np.int64)
    inside = ring < CONTEXT_RINGS
    highest = np.full(CONTEXT_RINGS * SECTORS, -np.inf, dtype=np.float32)
    np.maximum.at(highest, (ring * SECTORS + _sectors(x, y))[inside], z[inside].astype(np.float32))
    is_occupied = np.isfinite(highest).reshape(CONTEXT_RINGS, SECTORS)
    context = np.where(is_occupied, highest.reshape(CONTEXT_RINGS, SECTORS).astype(np.float64) + LIFT_M, 0.0)
    return _normalise(is_occupied.mean(axis=1)), _centre_and_normalise(context.mean(axis=0))


def solid(points_sensor: Float64Array) -> Vectors:
    """Return R-SOLiD and A-SOLiD of a scan (Kim, Choi, Sim, Kim & Cho, RA-L 2024, arXiv 2408.07330).

    The scan is thinned to the mean of each 0.5 m cell, and its points are counted by range and elevation and by azimuth
    and elevation. Each row of elevation then weighs by the number of its points, scaled so that the emptiest row counts
    nothing and the fullest one; the weighted sums over elevation tell of range (R-SOLiD) and of azimuth (A-SOLiD). What
    lies beyond the last ring counts in it. Rows are the beams of an OS1-32; returns above and below them are left out.

    Args:
        points_sensor: (N, 3) deskewed returns, sensor frame, metres.

    Returns:
        q (40,) of unit length, and w (64,) of zero mean and unit length; zeros for a scan that has nothing to tell.
    """
    require_shape("points_sensor", points_sensor, (None, 3))
    x, y, z = _cell_means(points_sensor, SOLID_VOXEL_M).T
    across_m = np.hypot(x, y)
    row = np.floor((np.arctan2(z, across_m) / SOLID_ELEVATION_RAD + 1) * (SOLID_ROWS / 2)).astype(np.int64)
    inside = (row >= 0) & (row < SOLID_ROWS)
    row = row[inside]
    ring = np.minimum((across_m[inside] * (SOLID_RINGS / MAX_RANGE_M)).astype(np.int64), SOLID_RINGS - 1)
    by_range = np.bincount(ring * SOLID_ROWS + row, minlength=SOLID_RINGS * SOLID_ROWS).reshape(SOLID_RINGS, -1)
    sector = _sectors(x, y)[inside]
    by_azimuth = np.bincount(sector * SOLID_ROWS + row, minlength=SECTORS * SOLID_ROWS).reshape(SECTORS, -1)
    counts = by_range.sum(axis=0)
    weights = (counts - counts.min()) / max(int(np.ptp(counts)), 1)
    return _normalise(by_range @ weights), _centre_and_normalise(by_azimuth @ weights)


HANDMADE: Mapping[str, Callable[[Float64Array], Vectors]] = {"scan-context": scan_context, "solid": solid}


def _sectors(x: Float64Array, y: Float64Array) -> Int64Array:
    """Return the sector of each point, counter-clockwise from sensor +x."""
    return np.floor(np.arctan2(y, x) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS


def _cell_means(points: Float64Array, cell_m: float) -> Float64Array:
    """Return the mean of the points of each occupied cell."""
    # neighbours in a scan mostly share a cell: of their runs far fewer are left to sort
    keys, sums = _sum_runs(cell_keys(points, cell_m), np.column_stack([points, np.ones(len(points))]))
    order = np.argsort(keys)
    _, sums = _sum_runs(keys[order], sums[order])
    return sums[:, :3] / sums[:, 3:]


def _sum_runs(keys: Int64Array, values: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the key of each run of equal keys (none is negative), and the sum of its rows."""
    starts = np.flatnonzero(np.diff(keys, prepend=-1))
    return keys[starts], np.add.reduceat(values, starts, axis=0) if len(starts) else values


def _normalise(values: Float64Array) -> Float32Array:
    length = float(np.linalg.norm(values))
    return np.asarray(values / length if length > 0 else np.zeros_like(values), dtype=np.float32)


def _centre_and_normalise(values: Float64Array) -> Float32Array:
    centred = values - values.mean()
    # an even ring tells no direction: what is left of it is rounding
    is_even = np.abs(centred).max() <= 1e-9 * np.abs(values).max()
    return _normalise(np.zeros_like(centred) if is_even else centred)
