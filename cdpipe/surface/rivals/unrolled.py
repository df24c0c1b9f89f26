"""Difference of unrolled tunnels: rasters of the mean radius by chainage and angle, one of each session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.model.config import PipelineConfig
from cdpipe.surface.cells import NearReturns, SurfaceCells, make_cells
from cdpipe.surface.method import Z95, Measured
from cdpipe.surface.places import SurfacePlaces
from cdpipe.surface.unrolled import unroll

_LEAST_CELLS = 3


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """(P,) key, mean radius and variance of the mean of each occupied pixel, sorted by key; NaN of too few cells."""

    keys: Int64Array
    mean_m: Float64Array
    variance_m2: Float64Array

    def at(self, keys: Int64Array) -> tuple[Float64Array, Float64Array]:
        """Return mean radius and variance at the pixels of (Q,) keys, NaN where the pixel is empty."""
        index = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        is_found = self.keys[index] == keys
        return np.where(is_found, self.mean_m[index], np.nan), np.where(is_found, self.variance_m2[index], np.nan)


def measure_unrolled(
    before: SurfaceCells, after: NearReturns, places: SurfacePlaces, chainage_m: Float64Array, config: PipelineConfig
) -> Measured:
    """Measure the mean radius of the before session less that of the after session, in the pixel of each place.

    Radii are distances from the axis of the drift, as of `unroll`: one axis for both sessions, that of all their cells
    together, because an axis of each session would follow what moved. The level is 1.96 standard errors of the
    difference of both means, from the spread of the radii within the pixel. That spread is larger where the surface is
    oblique to the radius. Pixels with fewer than three cells of a session are not measured.

    Arguments as of `Method`; `surface.raster_m` and `surface.reach_m` are used.
    """
    cells = make_cells(after)
    n = len(places.points)
    if min(n, len(before.points), len(cells.points)) == 0:
        unknown = np.full(n, np.nan)
        return Measured(unknown, unknown, unknown)
    raster_m = config.surface.raster_m
    clouds = before.points, cells.points, places.points
    chainages_m, angles_deg, radii_m = unroll(np.concatenate(clouds), before.map_T_sensor)
    # the height of a pixel is the raster's at the median radius; a whole number of them goes around
    n_around = max(round(2 * np.pi * float(np.median(radii_m)) / raster_m), 1)
    ends = np.cumsum([len(cloud) for cloud in clouds])[:-1]
    own, other, asked = np.split(_pixel_keys(chainages_m, angles_deg, raster_m, n_around), ends)
    own_radii_m, other_radii_m, _ = np.split(radii_m, ends)
    own_m, own_m2 = _average(own, own_radii_m).at(asked)
    other_m, other_m2 = _average(other, other_radii_m).at(asked)
    difference_m = own_m - other_m
    displacement_m = np.where(np.abs(difference_m) <= config.surface.reach_m, difference_m, np.nan)
    return Measured(displacement_m, displacement_m, Z95 * np.sqrt(own_m2 + other_m2))


def _pixel_keys(chainage_m: Float64Array, angle_deg: Float64Array, raster_m: float, n_around: int) -> Int64Array:
    """Return the (N,) key of the pixel of each point; `n_around` pixels go around the drift."""
    along = np.floor(chainage_m / raster_m).astype(np.int64)
    around = np.floor((angle_deg / 360.0 + 0.5) * n_around).astype(np.int64) % n_around
    return np.asarray(along * n_around + around)


def _average(keys: Int64Array, radius_m: Float64Array) -> _Pixels:
    """Return the pixels of (N,) radii."""
    pixels, pixel_of, counts = np.unique(keys, return_inverse=True, return_counts=True)
    mean_m = np.bincount(pixel_of, radius_m) / counts
    spread_m2 = np.bincount(pixel_of, (radius_m - mean_m[pixel_of]) ** 2) / np.maximum(counts - 1, 1)
    is_enough = counts >= _LEAST_CELLS
    return _Pixels(pixels, np.where(is_enough, mean_m, np.nan), np.where(is_enough, spread_m2 / counts, np.nan))
