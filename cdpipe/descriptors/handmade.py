"""Hand-made scan descriptors: Scan Context and SOLiD, in the form of the learned one.

Each gives a place vector q that is invariant to yaw and an orientation vector w with one value per azimuth sector, so
merge and query use them as they use `3deg`. Two details differ from both papers. Places are compared by the distance of
q alone; the papers add a slower comparison of full images, which the merge's vote and registration replace here. And w
has 64 sectors instead of 60, like 3DEG's, and is compared by circular correlation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, require_shape
from cdpipe.core.geometry.voxel import cell_keys, max_coordinate_m

# Raised when the vectors change, so that stored ones are recomputed.
VERSION = 1
SECTORS = 64
# As published. Of 20, 40, 80 and 120 m, 80 m found most places on four validation pairs.
MAX_RANGE_M = 80.0

CONTEXT_RINGS = 20
# Height added to all returns, so that those below the sensor count; the authors' code adds 2 m.
LIFT_M = 3.0

SOLID_RINGS = 40
SOLID_ROWS = 32
SOLID_ELEVATION_RAD = np.deg2rad(22.8)  # an OS1-32's field of view, and half a beam more on either side
SOLID_VOXEL_M = 0.5

Vectors = tuple[Float32Array, Float32Array]


def scan_context(points_sensor: Float64Array) -> Vectors:
    """Return ring key and sector key of a Scan Context (Kim & Kim, IROS 2018, 10.1109/IROS.2018.8593953).

    The context is the height of the highest return in each bin of 20 rings by 64 sectors (the paper: 60) around the
    sensor, 0 for an empty bin. The ring key is the share of occupied bins in each ring, as in the paper; the authors'
    code uses the mean height. The sector key is the mean height of each sector, as in the authors' code.

    Args:
        points_sensor: (N, 3) deskewed returns, sensor frame, metres.

    Returns:
        q (20,) of unit length, and w (64,) of zero mean and unit length; zeros for an empty or uniform scan.
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

    The scan is thinned to the mean of each 0.5 m voxel. Its points are counted by range and elevation, and by azimuth
    and elevation. Elevation rows are weighted by their number of points, scaled to [0, 1]. The weighted sums over
    elevation are R-SOLiD (range) and A-SOLiD (azimuth). Points beyond the last ring count in it. The rows span the
    field of view of an OS1-32; returns outside are dropped.

    Args:
        points_sensor: (N, 3) deskewed returns, sensor frame, metres.

    Returns:
        q (40,) of unit length, and w (64,) of zero mean and unit length; zeros for an empty or uniform scan.
    """
    require_shape("points_sensor", points_sensor, (None, 3))
    # what some sensors write where nothing returned: no cell has a number there
    is_near = (np.abs(points_sensor) < max_coordinate_m(SOLID_VOXEL_M)).all(axis=1)
    x, y, z = _cell_means(points_sensor if is_near.all() else points_sensor[is_near], SOLID_VOXEL_M).T
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
    """Return the (C, 3) mean of the points of each occupied cell."""
    # neighbours in a scan mostly share a cell, so summing runs first leaves little to sort
    keys, sums = _sum_runs(cell_keys(points, cell_m), np.column_stack([points, np.ones(len(points))]))
    order = np.argsort(keys)
    _, sums = _sum_runs(keys[order], sums[order])
    return sums[:, :3] / sums[:, 3:]


def _sum_runs(keys: Int64Array, values: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the key of each run of equal keys, none negative, and the sum of the rows of the run."""
    starts = np.flatnonzero(np.diff(keys, prepend=-1))
    return keys[starts], np.add.reduceat(values, starts, axis=0) if len(starts) else values


def _normalise(values: Float64Array) -> Float32Array:
    length = float(np.linalg.norm(values))
    return np.asarray(values / length if length > 0 else np.zeros_like(values), dtype=np.float32)


def _centre_and_normalise(values: Float64Array) -> Float32Array:
    centred = values - values.mean()
    # a uniform ring has no orientation; the rest is rounding
    is_even = np.abs(centred).max() <= 1e-9 * np.abs(values).max()
    return _normalise(np.zeros_like(centred) if is_even else centred)
