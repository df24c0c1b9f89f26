"""Where neighbouring displacements scatter by more than their levels say, the levels are too small.

Wire mesh in front of the rock is an example. Each session sees wires and rock in another mixture, and the means of
both surfaces differ by centimetres where nothing moved. Rock that moved does not scatter: it moved like its neighbours.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.threads import in_threads
from cdpipe.surface.method import Z95

# A displacement is held against the median of so many nearest places. So many of every fourth place tell their scatter.
_NEIGHBOURS, _TOGETHER, _EVERY = 24, 25, 4
_TO_SIGMA = 1.4826
_BLOCK = 1 << 14


def excess_scatter(points: Float64Array, along_m: Float64Array, level_m: Float64Array) -> Float64Array:
    """Return the (Q,) factor, at least 1, by which displacements scatter more than their levels say.

    Args:
        points: (Q, 3) places.
        along_m: (Q,) displacement of each, NaN where it was not measured.
        level_m: (Q,) its 95 % level of detection, NaN if unknown.
    """
    known = np.flatnonzero(np.isfinite(along_m) & np.isfinite(level_m))
    factor = np.ones(len(points))
    if len(known) < _NEIGHBOURS:
        return factor
    points, along_m, told = points[known], along_m[known], slice(None, None, _EVERY)
    usual_m = _medians(points, points[told], along_m, _NEIGHBOURS)
    in_sigmas = np.abs(along_m[told] - usual_m) / (level_m[known][told] / Z95)
    factor[known] = np.maximum(_TO_SIGMA * _medians(points[told], points, in_sigmas, _TOGETHER), 1.0)
    return factor


def _medians(points: Float64Array, asked: Float64Array, values: Float64Array, count: int) -> Float64Array:
    """Return the (A,) median of the (N,) values at the nearest of (N, 3) points, at (A, 3) asked ones."""
    tree, count = cKDTree(points), min(count, len(points))
    blocks = [asked[start : start + _BLOCK] for start in range(0, len(asked), _BLOCK)]
    return np.concatenate(in_threads(lambda block: np.median(values[_nearest(tree, block, count)], axis=1), blocks))


def _nearest(tree: cKDTree, asked: Float64Array, count: int) -> Int64Array:
    return np.asarray(tree.query(asked, k=[*range(1, count + 1)])[1], dtype=np.int64)
