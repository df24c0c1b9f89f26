"""Smooth random fields: cubic B-splines over lattices of hashed numbers, so that a value depends on its place alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float64Array

# Mean of the squared cubic B-spline weights along one axis, 151/315: what the spline leaves of the lattice's variance.
_VARIANCE_PER_AXIS = 151.0 / 315.0
# The autocorrelation of a cubic B-spline is close to a Gaussian of variance 2/3 lattice steps squared.
_STEPS_PER_LENGTH = float(np.sqrt(4.0 / 3.0))

UInt64Array = npt.NDArray[np.uint64]


def smooth_noise(axes_m: tuple[Float64Array, ...], length_m: float, key: int) -> Float64Array:
    """Return noise of unit variance on a regular grid.

    Args:
        axes_m: Coordinates of the grid along each axis, metres; one, two or three axes.
        length_m: Distance at which the correlation has fallen to 1/e.
        key: Which field; the same key gives the same value at the same place, whatever the grid.

    Returns:
        Values, shape (len(axis), ...).
    """
    step_m = length_m / _STEPS_PER_LENGTH
    taps = [_spline_taps(axis / step_m) for axis in axes_m]
    lattices = [np.arange(first.min(), first.max() + 4) for first, _ in taps]
    values = lattice_values(np.meshgrid(*lattices, indexing="ij"), key)
    for axis in reversed(range(len(taps))):
        first, weights = taps[axis]
        moved = np.moveaxis(values, axis, 0)
        start = first - lattices[axis][0]
        shape = (-1,) + (1,) * (moved.ndim - 1)
        total = moved[start] * weights[0].reshape(shape)
        for tap in (1, 2, 3):
            total += moved[start + tap] * weights[tap].reshape(shape)
        values = np.moveaxis(total, 0, axis)
    return np.asarray(values / _VARIANCE_PER_AXIS ** (len(taps) / 2))


def noise_at(points_m: Float64Array, length_m: float, key: int) -> Float64Array:
    """Return the values (N,) of the same field as `smooth_noise` at scattered points (N, 1), (N, 2) or (N, 3)."""
    step_m = length_m / _STEPS_PER_LENGTH
    n_axes = points_m.shape[1]
    indices, weight = [], np.ones((len(points_m),) + (1,) * n_axes)
    for axis in range(n_axes):
        first, weights = _spline_taps(points_m[:, axis] / step_m)
        shape = [len(points_m)] + [4 if other == axis else 1 for other in range(n_axes)]
        indices.append((first[:, None] + np.arange(4)).reshape(shape))
        weight = weight * weights.T.reshape(shape)
    values = lattice_values(np.broadcast_arrays(*indices), key)
    total = (values * weight).reshape(len(points_m), -1).sum(axis=1)
    return np.asarray(total / _VARIANCE_PER_AXIS ** (n_axes / 2))


def lattice_values(index: Sequence[npt.NDArray[np.int64]], key: int) -> Float64Array:
    """Return numbers of mean 0 and variance 1, uniform, hashed from integer coordinates and a key."""
    state = np.full(index[0].shape, np.uint64(key & 0xFFFFFFFFFFFFFFFF))
    for coordinate in index:
        state = _mix(state ^ _mix(coordinate.astype(np.uint64)))
    unit = (state >> np.uint64(11)).astype(np.float64) / 2.0**53
    return np.asarray((2.0 * unit - 1.0) * np.sqrt(3.0))


def _mix(state: UInt64Array) -> UInt64Array:
    """SplitMix64 (Steele, Lea, Flood 2014)."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(state ^ (state >> np.uint64(31)))


def _spline_taps(position: Float64Array) -> tuple[npt.NDArray[np.int64], Float64Array]:
    """First lattice index (N,) and the four weights (4, N) of the cubic B-spline at each position."""
    cell = np.floor(position)
    t = position - cell
    weights = np.stack(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3],
    )
    return cell.astype(np.int64) - 1, weights / 6.0
