"""Measures of a LiDAR's revolutions that need no truth: the same for a recording and for a simulation.

A spread is the median absolute deviation times 1.4826 (that of a normal distribution), so that edges do not count.
Neighbours are those of the destaggered image: rows are beams, columns azimuth, and the first column follows the last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, require_shape
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.sensor.ouster import SensorMetadata

ISOLATED_M = 1.0
EDGE_M = 1.0
BETWEEN_M = 0.25  # a mixed pixel keeps this far from both surfaces
_NORMAL = 1.4826
_REACH = 3  # columns each way that a window has
_SMOOTH_SHARE = 0.02  # of the range: the ends of a smooth window agree within this
_ALIKE_SHARE = 0.03  # of the range: neighbours on one surface
_PLANE_M = 0.05  # largest distance of a plane's points from it
_FACING = 0.85  # cosine of incidence


@dataclass(frozen=True, slots=False, eq=False)
class Revolutions:
    """Some revolutions of one sensor, destaggered.

    Attributes:
        sensor: Whose beam table it is.
        range_m: (N, H, W) float64, 0 where nothing returned.
        signal: (N, H, W) float64 photons.
        reflectivity: (N, H, W) float64 in counts.
    """

    sensor: SensorMetadata
    range_m: Float64Array
    signal: Float64Array
    reflectivity: Float64Array

    def __post_init__(self) -> None:
        require_shape("range_m", self.range_m, (None, self.sensor.height, self.sensor.width))
        require_shape("signal", self.signal, self.range_m.shape)
        require_shape("reflectivity", self.reflectivity, self.range_m.shape)

    @property
    def is_return(self) -> BoolArray:
        """(N, H, W) mask of the pixels with a return."""
        return self.range_m > 0

    @cached_property
    def is_smooth(self) -> BoolArray:
        """(N, H, W) mask of returns in a run of seven whose two ends on either side are alike within 2 %.

        The middle pixel is left out of the test, so that the selection does not depend on its noise.
        """
        window = np.stack([np.roll(self.range_m, shift, -1) for shift in range(-_REACH, _REACH + 1)])
        ends = window[[0, 1, -2, -1]]
        return np.asarray((window > 0).all(axis=0) & (np.ptp(ends, axis=0) < _SMOOTH_SHARE * self.range_m))

    @cached_property
    def incidence_cosine(self) -> Float64Array:
        """(N, H, W) cosine between beam and surface, from a plane through 3 beams x 7 columns; NaN where none fits."""
        return np.stack([_compute_incidence_cosine(self.sensor, range_m) for range_m in self.range_m])

    @property
    def is_facing(self) -> BoolArray:
        """(N, H, W) mask of the returns from planes met at less than 32 degrees."""
        return np.nan_to_num(self.incidence_cosine) > _FACING


def destagger(sensor: SensorMetadata, image: npt.NDArray[np.generic]) -> Float64Array:
    """Return a staggered image (..., H, W) with each row shifted so that columns are azimuths."""
    rows = [np.roll(image[..., row, :], shift, -1) for row, shift in enumerate(sensor.pixel_shift)]
    return np.stack(rows, axis=-2).astype(np.float64)


def stagger(sensor: SensorMetadata, image: Float64Array) -> Float64Array:
    """Undo `destagger`."""
    return np.stack([np.roll(image[..., row, :], -shift, -1) for row, shift in enumerate(sensor.pixel_shift)], axis=-2)


def measure_spread(values: npt.NDArray[np.floating]) -> float:
    """Return the robust standard deviation of some values; NaN for none."""
    return float(_NORMAL * np.median(np.abs(values - np.median(values)))) if len(values) else float("nan")


def measure_return_share(revolutions: Revolutions) -> Float64Array:
    """Return the share (H,) of each beam's pixels that returned."""
    return np.asarray(revolutions.is_return.mean(axis=(0, 2)))


def measure_noise_sigma_m(revolutions: Revolutions, where: BoolArray) -> float:
    """Return the standard deviation of the range noise over some pixels (N, H, W), metres.

    Second differences along a beam, r(-1) - 2 r(0) + r(+1), have six times the variance of independent noise; a
    surface that bends evenly shifts them all alike and does not spread them.
    """
    range_m = revolutions.range_m
    second_m = np.roll(range_m, 1, -1) - 2.0 * range_m + np.roll(range_m, -1, -1)
    return measure_spread(second_m[where]) / math.sqrt(6.0)


def measure_photons_per_percent(revolutions: Revolutions, where: BoolArray) -> Float64Array:
    """Return signal x range^2 / reflectivity (n,) of the returns of 10 to 99 % among some pixels, photons m^2."""
    is_diffuse = where & revolutions.is_return & (revolutions.reflectivity >= 10) & (revolutions.reflectivity < 100)
    signal, range_m = revolutions.signal[is_diffuse], revolutions.range_m[is_diffuse]
    return np.asarray(signal * range_m**2 / revolutions.reflectivity[is_diffuse])


def estimate_photons(revolutions: Revolutions) -> Float64Array:
    """Return the expected signal (N, H, W) of each pixel: the geometric mean of its two neighbours along the beam.

    NaN unless both returned from one surface. The pixel itself is not considered.
    """
    left_m, right_m = (np.roll(revolutions.range_m, shift, -1) for shift in (1, -1))
    left, right = (np.roll(revolutions.signal, shift, -1) for shift in (1, -1))
    nearer_m = np.minimum(left_m, right_m)
    is_one = (nearer_m > 0) & (np.abs(left_m - right_m) < _ALIKE_SHARE * nearer_m)
    return np.where(is_one, np.sqrt(np.maximum(left, 1.0) * np.maximum(right, 1.0)), np.nan)


def find_isolated(revolutions: Revolutions) -> BoolArray:
    """Mark the returns (N, H, W) that differ by more than 1 m from all eight neighbours, missing ones included."""
    range_m = revolutions.range_m
    padded = np.pad(range_m, ((0, 0), (1, 1), (0, 0)))
    alone = revolutions.is_return
    height = range_m.shape[1]
    for row in (0, 1, 2):
        for shift in (-1, 0, 1):
            if (row, shift) != (1, 0):
                neighbour_m = np.roll(padded[:, row : row + height], shift, -1)
                alone = alone & ((neighbour_m == 0) | (np.abs(neighbour_m - range_m) > ISOLATED_M))
    return alone


def find_edges(revolutions: Revolutions) -> tuple[Float64Array, BoolArray, BoolArray]:
    """Find the pixels that lie at a jump of range along a beam: two columns agree before it, and two behind it.

    Returns:
        (N, H, W) height of the jump, metres, NaN where there is none of 1 m or more; masks (N, H, W) of the pixels at
        a jump that lie between the two surfaces, 0.25 m from both, and of those that did not return.
    """
    range_m = revolutions.range_m
    far_left, left, right, far_right = (np.roll(range_m, shift, -1) for shift in (2, 1, -1, -2))
    is_whole = (np.minimum(far_left, left) > 0) & (np.minimum(right, far_right) > 0)
    is_whole &= (np.abs(far_left - left) < 0.02 * left) & (np.abs(far_right - right) < 0.02 * right)
    jump_m = np.where(is_whole & (np.abs(left - right) > EDGE_M), np.abs(left - right), np.nan)
    is_edge = np.isfinite(jump_m)
    is_between = (range_m > np.minimum(left, right) + BETWEEN_M) & (range_m < np.maximum(left, right) - BETWEEN_M)
    return jump_m, is_edge & is_between, is_edge & (range_m == 0)


def measure_novel_share(points: Float64Array, others: Float64Array, cell_m: float) -> float:
    """Return the share of some points (N, 3) that lie in cells which none of the other points (M, 3) occupies."""
    keys: Int64Array = cell_keys(points, cell_m)
    return float(np.isin(keys, cell_keys(others, cell_m), invert=True).mean())


def measure_novel_shares(halves: Sequence[Float64Array], cells_m: Sequence[float]) -> Float64Array:
    """Return for each size of cell the share of novel points, the mean of first half against second and back."""
    first, second = halves
    return np.array(
        [
            (measure_novel_share(first, second, cell_m) + measure_novel_share(second, first, cell_m)) / 2.0
            for cell_m in cells_m
        ]
    )


def _compute_incidence_cosine(sensor: SensorMetadata, range_m: Float64Array) -> Float64Array:
    """Return the cosines (H, W) of one revolution."""
    points = sensor.project(stagger(sensor, range_m))
    axes = [destagger(sensor, points[..., axis]) for axis in range(3)]
    beams = np.stack([destagger(sensor, sensor.directions[..., axis]) for axis in range(3)], axis=-1)
    window = np.stack([_gather_windows(axis) for axis in axes], axis=-1)
    reach = _gather_windows(range_m)
    middle = reach[..., 2 * _REACH + 1 : 4 * _REACH + 2]
    is_whole = (reach > 0).all(axis=-1) & (np.ptp(middle, axis=-1) < 0.05 * range_m)
    window = window[is_whole]
    centred = window - window.mean(axis=1, keepdims=True)
    variances, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    off_m = np.sqrt(np.maximum(variances[:, 0], 0.0) / (window.shape[1] - 3))
    cosine = np.abs((vectors[:, :, 0] * beams[is_whole]).sum(axis=-1))
    found = np.full(range_m.shape, np.nan)
    found[is_whole] = np.where(off_m < _PLANE_M, cosine, np.nan)
    return found


def _gather_windows(image: Float64Array) -> Float64Array:
    """Return each pixel's 3 beams x 7 columns (H, W, 21), beam by beam; 0 beyond the first and last beam."""
    padded = np.pad(image, ((1, 1), (0, 0)))
    height = len(image)
    shifts = range(_REACH, -_REACH - 1, -1)
    return np.stack([np.roll(padded[row : row + height], shift, -1) for row in range(3) for shift in shifts], axis=-1)
