"""A person who stands, told by shape: a head, wider shoulders and chest, narrower legs.

Free space cannot tell who stands for as long as the robot looks. The widths of level slices can: Kidono et al. tell
pedestrians in lidar scans by them (IEEE Intelligent Vehicles Symposium 2011, cited from memory).
"""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.geometry.voxel import cell_means

_CELL_M = 0.05
# Cells with fewer returns than such a share of the usual number hold mixed returns, from between the person and what is
# behind; a head that few beams reach has few, too.
_DENSE_SHARES = (0.15, 0.6)
# Slices from the crown down: the head is the first, shoulders and chest are three, legs begin below the sixth.
_SLICE_M = 0.2
_CHEST, _LEGS = slice(1, 4), slice(6, None)
_MIN_CELLS, _MIN_RETURNS = 4, 20
# Stature between quantiles, and widths that hold 90 % of the returns, metres. People of 1.6 to 1.95 m in 8 validation
# pairs of `dynamic/*`: 1.57 to 1.80; head 0.16 to 0.19, chest 0.51 to 0.64 wide and 0.09 to 0.21 deep, legs 0.33.
_STATURE_M = (1.4, 2.0)
_HEAD_M, _CHEST_M, _DEPTH_M = 0.3, (0.38, 0.8), 0.4
# Largest share of the chest that head and legs are wide: 0.4 and 0.6 of those people; tall stones taper less.
_HEAD, _LEG = 0.6, 0.75
# The head is above the chest.
_OFF_M = 0.2


def is_person(points: Float64Array) -> bool:
    """Return whether (N, 3) returns of an object, z up, metres, have the shape of a person who stands."""
    places, cell_of_return = cell_means(points, _CELL_M)
    n_returns = np.bincount(cell_of_return)
    usual = np.average(n_returns, weights=n_returns)
    dense = (n_returns >= share * usual for share in _DENSE_SHARES)
    return any(_has_shape(places[is_dense], n_returns[is_dense]) for is_dense in dense)


def _has_shape(places: Float64Array, n_returns: Int64Array) -> bool:
    """Return whether (C, 3) cells with (C,) returns each are a head above a chest above legs."""
    bottom_m, crown_m = _weighted_quantiles(places[:, 2], n_returns, (0.01, 0.99))
    if not _STATURE_M[0] <= crown_m - bottom_m <= _STATURE_M[1]:
        return False
    slice_of = np.maximum(np.floor((crown_m - places[:, 2]) / _SLICE_M), 0.0).astype(np.int64)
    n_slices = int((crown_m - bottom_m) / _SLICE_M)
    widths = np.array([_widths_m(places[slice_of == k], n_returns[slice_of == k]) for k in range(n_slices)])
    if not np.isfinite(widths).all():
        return False
    head_m, (chest_m, depth_m), legs_m = widths[0, 0], widths[_CHEST].T, widths[_LEGS, 0]
    head, chest = (np.average(places[of], axis=0, weights=n_returns[of])[:2] for of in (slice_of == 0, slice_of == 1))
    return bool(
        head_m <= min(_HEAD_M, _HEAD * chest_m.mean())
        and np.all((chest_m >= _CHEST_M[0]) & (chest_m <= _CHEST_M[1]) & (depth_m <= _DEPTH_M))
        and np.linalg.norm(head - chest) <= _OFF_M
        and np.all(legs_m <= _LEG * chest_m.mean())
    )


def _widths_m(places: Float64Array, n_returns: Int64Array) -> tuple[float, float]:
    """Return the larger and the smaller level width of a slice that holds 90 % of its returns; infinite of too few."""
    if len(places) < _MIN_CELLS or n_returns.sum() < _MIN_RETURNS:
        return np.inf, np.inf
    off = places[:, :2] - np.average(places[:, :2], axis=0, weights=n_returns)
    along = off @ np.linalg.eigh((off * n_returns[:, None]).T @ off)[1]
    ends = [_weighted_quantiles(along[:, axis], n_returns, (0.05, 0.95)) for axis in (1, 0)]
    return float(ends[0][1] - ends[0][0]), float(ends[1][1] - ends[1][0])


def _weighted_quantiles(values: Float64Array, weights: Int64Array, shares: tuple[float, float]) -> Float64Array:
    order = np.argsort(values, kind="stable")
    return np.interp(shares, np.cumsum(weights[order]) / weights.sum(), values[order])
