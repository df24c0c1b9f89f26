"""What a recording shows at each range: noise of the range, how bright returns are, and how many are lost.

Noise is the residual of a return to a plane through its 24 neighbours in direction. A plane is linear in the inverse of
the range, 1 / r = a d for a unit vector d, so `a` is a linear least-squares fit. Of all such places in a range bin the
smoother half is kept, by the residual of the neighbours and not of the return itself. What is left of the roughness of
rock counts as noise. A fit of k neighbours has an error of its own, the leverage h of the return: the residual is
divided by sqrt(1 + h).

Lost is a beam without a return between four neighbours of its row whose ranges agree to 5 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, Int64Array
from sim.graft.part import Part, RecordedRevolution, measured_points

EDGES_M = np.array([1.0, 1.5, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96])
N_BINS = len(EDGES_M) + 1
_SHARES = np.linspace(0.005, 0.995, 100)  # of the residuals: what is drawn is no farther out
_SCANS, _PLACES, _NEIGHBOURS = 12, 1500, 24
_WIDEST_RAD, _NEAR_SHARE, _AGREE_SHARE = 0.12, 0.2, 0.05
_LEAST_SPREAD = 1e-5  # of the directions of neighbours: below, they lie on one line
_LEAST = 100  # residuals, or gaps, that make a bin
_KEPT = 512  # returns of a bin that are drawn from
_STEPS = (-2, -1, 1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class RangeNoise:
    """The figures of a recording by bins of range.

    Attributes:
        residual_m: (B, 100) quantiles of the residual of the range in each bin between the edges, about a median of 0.
        n_residuals: (B,) number of residuals that were measured in each.
        lost: (B,) share of beams without a return.
        n_gaps: (B,) number of beams that this is a share of; all 0 where a recording does not tell of lost beams.
        intensity: (B, 512, 2) reflectivity and signal of returns.
        step_mm: Ranges are multiples of this.
    """

    residual_m: Float64Array
    n_residuals: Int64Array
    lost: Float64Array
    n_gaps: Int64Array
    intensity: Int64Array
    step_mm: int

    def draw(self, range_m: Float64Array, number: Float64Array) -> Float64Array:
        """Return noise (N,), metres, at ranges (N,) for numbers (N,) drawn evenly from 0 to 1."""
        place = np.clip((number - _SHARES[0]) / (_SHARES[1] - _SHARES[0]), 0, len(_SHARES) - 1 - 1e-9)
        low = place.astype(np.int64)
        rows = find_bins(range_m)
        start, end = self.residual_m[rows, low], self.residual_m[rows, low + 1]
        return np.asarray(start + (place - low) * (end - start))

    def describe(self) -> dict[str, Any]:
        """Return the figures as plain values: sigma is half of the middle 68 % of the residuals."""
        low, high = (np.argmin(np.abs(_SHARES - share)) for share in (0.16, 0.84))
        sigma_m = (self.residual_m[:, high] - self.residual_m[:, low]) / 2
        return {
            "edges_m": EDGES_M.tolist(),
            "sigma_m": np.round(sigma_m, 5).tolist(),
            "n_residuals": self.n_residuals.tolist(),
            "lost": np.round(self.lost, 5).tolist(),
            "n_gaps": self.n_gaps.tolist(),
            "reflectivity": np.median(self.intensity[..., 0], axis=1).tolist(),
            "step_mm": self.step_mm,
        }


def find_bins(range_m: Float64Array) -> Int64Array:
    """Return the bin (N,) of each range (N,)."""
    return np.searchsorted(EDGES_M, range_m, side="right")


def measure_noise(parts: Sequence[Part]) -> RangeNoise:
    """Measure a recording from twelve revolutions of each of its parts.

    Raises:
        ScenarioError: There are too few returns.
    """
    residuals, gaps, bright, steps = [], [], [], []
    for part in parts:
        for revolution in _sample(part):
            points, is_return = measured_points(part, revolution)
            residuals.append(plane_residuals(points[is_return]))
            gaps.append(_find_gaps(revolution, part.source.sensor.height))
            bright.append(_list_bright(revolution, part.source.sensor.height))
            steps.append(_step_mm(revolution))
    return _tabulate(np.concatenate(residuals), np.concatenate(gaps), np.concatenate(bright), steps, parts)


def measure_step_mm(parts: Sequence[Part]) -> int:
    """Return the step of the ranges of some parts of a recording, from twelve revolutions of each."""
    return max(1, math.gcd(*(_step_mm(revolution) for part in parts for revolution in _sample(part))))


def _sample(part: Part) -> Iterator[RecordedRevolution]:
    """Yield twelve revolutions of a part, or all of fewer, spread evenly."""
    n_scans = len(part.scans)
    return part.revolutions(np.unique(np.linspace(0, n_scans - 1, min(_SCANS, n_scans)).astype(np.int64)))


def _step_mm(revolution: RecordedRevolution) -> int:
    """Return the greatest common divisor of the ranges of a revolution, 0 where it has no return."""
    return int(np.gcd.reduce(revolution.range_mm[revolution.range_mm > 0], initial=0))


def _tabulate(
    residuals: Float64Array, gaps: Float64Array, bright: Float64Array, steps: Sequence[int], parts: Sequence[Part]
) -> RangeNoise:
    """Sort what was measured into bins; a bin with too little takes that of the nearest one with enough."""
    of_residual, of_gap, of_bright = (find_bins(each[:, 0]) for each in (residuals, gaps, bright))
    n_residuals, n_gaps, n_bright = (np.bincount(each, minlength=N_BINS) for each in (of_residual, of_gap, of_bright))
    least = min(_LEAST, int(n_residuals.max(initial=0)))
    if least < 10:
        raise ScenarioError(f"{parts[0].source.path}: too few returns to tell its noise: give a longer recording")
    quantiles = np.zeros((N_BINS, len(_SHARES)))
    for number in np.flatnonzero(n_residuals >= least):
        own = np.quantile(residuals[of_residual == number, 1], _SHARES)
        quantiles[number] = own - np.interp(0.5, _SHARES, own)
    lost = np.bincount(of_gap, gaps[:, 1], minlength=N_BINS) / np.maximum(n_gaps, 1)
    intensity = np.zeros((N_BINS, _KEPT, 2), np.int64)
    for number in np.flatnonzero(n_bright):
        own = bright[of_bright == number, 1:]
        intensity[number] = own[np.linspace(0, len(own) - 1, _KEPT).astype(np.int64)]
    quantiles = quantiles[_nearest(n_residuals >= least)]
    intensity = intensity[_nearest(n_bright > 0)]
    if n_gaps.any():
        lost = lost[_nearest(n_gaps >= min(_LEAST, int(n_gaps.max())))]
    return RangeNoise(quantiles, n_residuals, lost, n_gaps, intensity, max(1, math.gcd(*steps)))


def _nearest(is_filled: npt.NDArray[np.bool_]) -> Int64Array:
    """Return for each bin (B,) the nearest filled one."""
    filled = np.flatnonzero(is_filled)
    return np.asarray(filled[np.abs(np.arange(len(is_filled))[:, None] - filled).argmin(axis=1)])


def plane_residuals(points: Float64Array) -> Float64Array:
    """Return range and residual along the ray (M, 2), metres, of some of the points (N, 3) of a scan, sensor frame."""
    range_m = np.linalg.norm(points, axis=1)
    points, range_m = points[range_m > 0], range_m[range_m > 0]
    if len(points) <= _NEIGHBOURS:
        return np.zeros((0, 2))
    ways = points / range_m[:, None]
    asked = np.unique(np.linspace(0, len(points) - 1, _PLACES).astype(np.int64))
    angle, near = (np.asarray(each) for each in cKDTree(ways).query(ways[asked], _NEIGHBOURS + 1))
    # the first one is the place itself, or one of the same direction
    near, around = near[:, 1:], range_m[near[:, 1:]]
    own, fits = range_m[asked], ways[near]
    is_patch = (angle[:, -1] < _WIDEST_RAD) & (np.abs(around / own[:, None] - 1).max(axis=1) < _NEAR_SHARE)
    normal = fits.swapaxes(1, 2) @ fits
    spread, axes = np.linalg.eigh(normal)
    is_told = spread > _LEAST_SPREAD * _NEIGHBOURS  # neighbours on one row of beams tell the slope along it alone
    is_patch &= is_told[:, 1]
    asked, around, own, fits, spread, axes, is_told = (
        each[is_patch] for each in (asked, around, own, fits, spread, axes, is_told)
    )
    if not len(asked):
        return np.zeros((0, 2))
    inverse = np.einsum("nik,nk,njk->nij", axes, np.where(is_told, 1.0 / np.maximum(spread, 1e-12), 0.0), axes)
    plane = (inverse @ (fits.swapaxes(1, 2) @ (1.0 / around)[..., None]))[..., 0]
    leverage = np.einsum("ni,nij,nj->n", ways[asked], inverse, ways[asked])
    far_off = around - 1.0 / (fits @ plane[..., None])[..., 0]
    residual = (own - 1.0 / (ways[asked] * plane).sum(axis=1)) / np.sqrt(1.0 + leverage)
    return _smoother_half(own, residual, np.sqrt((far_off**2).mean(axis=1)))


def _smoother_half(range_m: Float64Array, residual_m: Float64Array, rough_m: Float64Array) -> Float64Array:
    """Return range and residual (M, 2) of the places whose neighbours scatter less than the median of their bin."""
    bins, keeps = find_bins(range_m), np.isfinite(residual_m)
    for number in np.unique(bins):
        own = bins == number
        keeps[own] &= rough_m[own] <= np.median(rough_m[own])
    return np.column_stack([range_m[keeps], residual_m[keeps]])


def _find_gaps(revolution: RecordedRevolution, height: int) -> Float64Array:
    """Return range and loss (M, 2) of the beams between four neighbours of their row that agree; 1 is lost."""
    range_mm = revolution.range_mm[:height].astype(np.float64)
    if height == 1:  # one ray per return: nothing is known of beams without one
        return np.zeros((0, 2))
    around = np.stack([np.roll(range_mm, step, axis=1) for step in _STEPS])
    mean = around.mean(axis=0)
    is_asked = (around > 0).all(axis=0) & (np.ptp(around, axis=0) <= _AGREE_SHARE * mean)
    is_asked &= (range_mm > 0).any(axis=0)  # a column without any return did not arrive
    return np.column_stack([mean[is_asked] / 1000.0, (range_mm == 0)[is_asked]])


def _list_bright(revolution: RecordedRevolution, height: int) -> Float64Array:
    """Return range, reflectivity and signal (M, 3) of the first returns of a revolution."""
    channels = revolution.range_mm[:height] / 1000.0, revolution.reflectivity[:height], revolution.signal[:height]
    is_return = revolution.range_mm[:height] > 0
    return np.column_stack([each[is_return].astype(np.float64) for each in channels])
