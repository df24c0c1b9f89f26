"""Roughness of the walls of a mesh, measured by rays from the centreline.

Every 0.2 m a fan of rays at right angles to the drift meets walls and roof. The deviation of a hit is its distance from
the smooth section of the drift, overbreak positive. The contour roughness is the root mean square of the deviations.
Mouths of other drifts, niches and the faces of blind ends are left out.

The section of a foreign mesh is not known well. There the running mean over `fit_m` of each ray's deviation is the
section, and features longer than about `fit_m` along the drift do not count as roughness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array
from sim.geometry.raycast import Caster
from sim.rock.axis import find_runs
from sim.rock.centreline import STEP_M, Centreline, DriftLine, left_of
from sim.rock.sections import profile_distance

_EVERY = 2  # samples of the centreline
_STATION_M = _EVERY * STEP_M
_ANGLES_DEG = np.linspace(-10.0, 190.0, 25)  # from the left wall over the roof to the right one
_ORIGIN_UP = 0.45  # of the height
_LEAST_RUN = 16  # stations without a gap
_WILD_SIGMA = 6.0  # robust standard deviations beyond which a hit is an opening
_LONGEST_LAG_M = 12.0


@dataclass(frozen=True, slots=True)
class ContourRoughness:
    """Roughness of walls and roof; NaN without measurements.

    Attributes:
        rms_m: Standard deviation about the smooth section.
        length_m: Distance along the drift at which the correlation of deviations has fallen to 1/e; NaN below 1 mm.
        n_rays: Number of deviations.
    """

    rms_m: float
    length_m: float
    n_rays: int


def contour_roughness(walls: Caster, centreline: Centreline, fit_m: float | None = None) -> ContourRoughness:
    """Measure the contour roughness of a tunnel.

    Args:
        walls: Caster of the bare rock.
        centreline: Its drifts, with the size they have along the way.
        fit_m: For foreign meshes: length of the running mean that stands for the section.
    """
    runs = [run for index in range(len(centreline.drifts)) for run in _deviations(walls, centreline, index)]
    runs = _without_openings(runs)
    if fit_m is not None:
        runs = [run - gaussian_filter1d(run, fit_m / 4 / _STATION_M, axis=0) for run in runs]
    n_rays = sum(run.size for run in runs)
    if n_rays == 0:
        return ContourRoughness(float("nan"), float("nan"), 0)
    rms_m = float(np.sqrt(sum((run**2).sum() for run in runs) / n_rays))
    length_m = _correlation_length_m(runs) if rms_m > 1e-3 else float("nan")
    return ContourRoughness(rms_m, length_m, n_rays)


def _deviations(walls: Caster, centreline: Centreline, index: int) -> list[Float64Array]:
    """Deviations (stations, rays) of a drift, one array for each stretch without junction, niche or face."""
    line = centreline.drifts[index]
    samples = np.arange(0, len(line.points), _EVERY)
    points, left = line.points[samples], left_of(line.headings[samples])
    half_m, height_m = line.width_m[samples, None] / 2, line.height_m[samples, None]
    origins = points + np.column_stack([np.zeros((len(points), 2)), _ORIGIN_UP * height_m])
    angles = np.deg2rad(_ANGLES_DEG)
    directions = np.concatenate(
        [
            np.cos(angles)[None, :, None] * left[:, None],
            np.broadcast_to(np.sin(angles)[None, :, None], (len(points), len(angles), 1)),
        ],
        axis=2,
    )
    flat = np.ascontiguousarray(directions.reshape(-1, 3))
    ranges_m, _, normals = walls.hits(np.repeat(origins, len(angles), axis=0), flat)
    is_front = np.isfinite(ranges_m) & ((normals * flat).sum(axis=1) < 0)
    reach_m = np.where(is_front, ranges_m, np.nan).reshape(len(points), len(angles)).astype(np.float64)
    side_m, up_m = reach_m * np.cos(angles), _ORIGIN_UP * height_m + reach_m * np.sin(angles)
    deviation_m = profile_distance(line.section.shape, half_m, height_m, side_m, up_m)
    is_plain = _is_plain(centreline, index, points) & np.isfinite(deviation_m).all(axis=1)
    return [deviation_m[first:end] for first, end in find_runs(is_plain, _LEAST_RUN)]


def _is_plain(centreline: Centreline, index: int, points: Float64Array) -> BoolArray:
    """Mark the stations (S,) away from other drifts, niches and the ends of the line."""
    line = centreline.drifts[index]
    half_m = line.section.width_m / 2
    is_plain = np.ones(len(points), dtype=bool)
    for end, is_blind in zip((0, -1), line.is_blind, strict=True):
        if is_blind:
            is_plain &= np.linalg.norm(points[:, :2] - line.points[end, :2], axis=1) > half_m
    for number, other in enumerate(centreline.drifts):
        if number != index:
            distance_m, _ = cKDTree(other.points).query(points)
            is_plain &= distance_m > half_m + 1.3 * other.section.width_m / 2
    for recess in centreline.recesses:
        if recess.drift == index:
            is_plain &= np.linalg.norm(points - recess.point, axis=1) > recess.width_m / 2 + half_m
    return is_plain & ~_is_near_kink(line, points)


def _is_near_kink(line: DriftLine, points: Float64Array) -> BoolArray:
    """Mark the stations (S,) near sharp corners, where rays at right angles do not measure the section."""
    start, end = line.headings[:-2], line.headings[2:]
    turn = np.abs(start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0])
    corners = line.points[1:-1][turn > 0.2]
    if len(corners) == 0:
        return np.zeros(len(points), dtype=bool)
    return np.asarray(cKDTree(corners).query(points)[0] < line.section.width_m)


def _without_openings(runs: Sequence[Float64Array]) -> list[Float64Array]:
    """Replace outliers, rays that leave through openings, by the median of all deviations."""
    if not runs:
        return []
    every = np.concatenate([run.ravel() for run in runs])
    middle = float(np.median(every))
    limit_m = _WILD_SIGMA * 1.4826 * float(np.median(np.abs(every - middle))) + 0.05
    return [np.where(np.abs(run - middle) > limit_m, middle, run) for run in runs]


def _correlation_length_m(runs: Sequence[Float64Array]) -> float:
    """First lag at which the correlation along the way, over all rays, falls below 1/e; NaN if none does."""
    before = 1.0
    for lag in range(1, round(_LONGEST_LAG_M / _STATION_M)):
        pairs = [(run[:-lag], run[lag:]) for run in runs if len(run) > 2 * lag]
        if not pairs:
            break
        energy = sum((a**2).sum() + (b**2).sum() for a, b in pairs) / 2
        now = float(sum((a * b).sum() for a, b in pairs) / energy)
        if now < np.exp(-1.0):
            return float((lag - 1 + (before - np.exp(-1.0)) / (before - now)) * _STATION_M)
        before = now
    return float("nan")
