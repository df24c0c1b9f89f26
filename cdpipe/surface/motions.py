"""Rigid motions along a path that explain most of the measured offsets, however far the rest of them moved.

The merge leaves millimetres, drift bends a session by more, and rock that moved pulls the merge along. Windows of the
offsets are fitted by a rigid motion, point to plane, so robustly that rock that moved does not pull. The motion is
taken off, and its covariance is a part of the level of detection: drift neither hides nor makes a convergence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array, plane_jacobian
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.core.threads import allowed_threads, in_threads

_STEP_M = 2.0
_LEAST_OFFSETS = 100
_L1_ROUNDS, _ROUNDS = 10, 16
# Residuals below this share of their scale weigh alike in the first rounds. Rock that moved, a quarter of the round and
# more, enlarges the scale: with a share of 1 these rounds would be near to least squares, and half of it absorbed.
_L1_SHARE = 0.1
# Tukey's biweight: 95 % efficient for normal errors.
_TUKEY = 4.685
_TO_SIGMA = 1.4826
_LEAST_SIGMA_M = 3e-4
# Rotation and translation that nothing constrains stay zero, also where no offset has a lever for any rotation.
_DAMPING, _LEAST_DIAGONAL = 1e-3, 1e-9
# A residual that many times the noise says that much of a window moved. The fit is then begun on each half of the
# round alone, too. It is taken where that share of the window is within twice the noise, more of it than by the first
# fit, and most of what is within six times: what moved lies apart. No motion leaves such a part of a convergence all
# round.
_MUCH, _WITHIN, _NEAR = 3.0, 2.0, 6.0
_LEAST_SHARE, _MORE, _APART = 0.3, 0.1, 0.7
_EMPTY_SHARE = 1e-6  # a half with less of the weights holds no rock, as that below a floor without walls
_NOISE_SAMPLE = 20_000  # about so many offsets tell the noise
# Neighbouring places err together: a block of this edge counts as one observation in the covariance.
_BLOCK_M = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class PathMotions:
    """A small rigid motion at each of some stations along a path, linear between them.

    Attributes:
        first_m: Path position of the first station; the others follow every 2 m.
        centres: (A, 3) centre of rotation of each station, map frame, metres.
        motions: (A, 6) rotation vector and translation of each.
        covariances: (A, 6, 6) of each; NaN where too few offsets tell a motion, and the motion is zero.
    """

    first_m: float
    centres: Float64Array
    motions: Float64Array
    covariances: Float64Array

    def shifts(self, points: Float64Array, path_m: Float64Array) -> Float64Array:
        """Return the (N, 3) displacement of (N, 3) points, each by the motion at its (N,) path position."""
        shifts = np.empty((len(points), 3))
        (station, _), (following, share) = self._around(path_m)
        for number in np.unique(station):
            own = np.flatnonzero(station == number)
            other = following[own[0]]
            offsets = points[own] - self.centres[number]
            turn, slide = self._linear(number, self.centres[number])
            next_turn, next_slide = self._linear(other, self.centres[number])
            further = offsets @ (next_turn - turn) + (next_slide - slide)
            shifts[own] = offsets @ turn + slide + share[own, None] * further
        return shifts

    def _linear(self, station: int, origin: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the (3, 3) matrix and the (3,) shift of a motion: of offsets from an origin, as rows."""
        turn, slide = self.motions[station, :3], self.motions[station, 3:]
        return np.cross(turn, np.eye(3)), slide + np.cross(turn, origin - self.centres[station])

    def along(
        self, points: Float64Array, normals: Float64Array, path_m: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the (N,) displacement of points along their (N, 3) normals, and its variance, square metres."""
        along_m, variance_m2 = np.zeros(len(points)), np.zeros(len(points))
        for station, share in self._around(path_m):
            jacobian = plane_jacobian(points - self.centres[station], normals)
            along_m += share * np.einsum("ij,ij->i", jacobian, self.motions[station])
            variance_m2 = variance_m2 + share * np.einsum("ij,ijk,ik->i", jacobian, self.covariances[station], jacobian)
        return along_m, variance_m2

    def _around(self, path_m: Float64Array) -> list[tuple[Int64Array, Float64Array]]:
        """Return the station before and the one after each path position, and the share of either."""
        last = len(self.centres) - 1
        place = np.clip((path_m - self.first_m) / _STEP_M, 0.0, last)
        station = np.minimum(place.astype(np.int64), max(last - 1, 0))
        share = place - station
        return [(station, 1.0 - share), (np.minimum(station + 1, last), share)]


def fit_motions(
    points: Float64Array, normals: Float64Array, along_m: Float64Array, path_m: Float64Array, window_m: float
) -> PathMotions:
    """Return the motions that fit offsets along normals.

    Args:
        points: (N, 3) places, map frame, metres.
        normals: (N, 3) their normals.
        along_m: (N,) measured offsets along the normals; NaN where there is none, or none to be trusted.
        path_m: (N,) path position that each belongs to, metres.
        window_m: Half length of a window; offsets at its ends do not weigh.
    """
    known = np.flatnonzero(np.isfinite(along_m))
    order = known[np.argsort(path_m[known], kind="stable")]
    points, normals, along_m, path_m = points[order], normals[order], along_m[order], path_m[order]
    first_m, last_m = (float(path_m[0]), float(path_m[-1])) if len(path_m) else (0.0, 0.0)
    stations_m = np.arange(first_m, last_m + _STEP_M, _STEP_M)
    noise_m = _find_noise(points, along_m)

    def fit(station_m: float) -> tuple[Float64Array, Float64Array, Float64Array]:
        used = slice(*np.searchsorted(path_m, (station_m - window_m, station_m + window_m)))
        if used.stop - used.start < _LEAST_OFFSETS:
            return np.zeros(3), np.zeros(6), np.full((6, 6), np.nan)
        share = np.maximum(1 - ((path_m[used] - station_m) / window_m) ** 2, 0.0)
        if np.count_nonzero(share) < _LEAST_OFFSETS:  # those of a sensor that stood lie at one end of the window
            return np.zeros(3), np.zeros(6), np.full((6, 6), np.nan)
        centre = points[used].mean(axis=0)
        jacobian = plane_jacobian(points[used] - centre, normals[used])
        return centre, *_fit_best(jacobian, along_m[used], share, points[used], noise_m)

    centres, motions, covariances = zip(*in_threads(fit, stations_m), strict=True)
    return PathMotions(first_m, np.stack(centres), np.stack(motions), np.stack(covariances))


def _find_noise(points: Float64Array, along_m: Float64Array) -> float:
    """Return the standard deviation by which offsets of neighbours differ, of one of them."""
    if len(points) < _LEAST_OFFSETS:
        return 0.0
    some = np.arange(0, len(points), max(len(points) // _NOISE_SAMPLE, 1))
    nearest = np.asarray(cKDTree(points).query(points[some], k=[2], workers=allowed_threads())[1])[:, 0]
    return _TO_SIGMA * float(np.median(np.abs(along_m[some] - along_m[nearest])) / np.sqrt(2.0))


def _fit_best(
    jacobian: Float64Array, along_m: Float64Array, share: Float64Array, points: Float64Array, noise_m: float
) -> tuple[Float64Array, Float64Array]:
    """Return the (6,) motion that leaves most of a window within the noise, and its (6, 6) covariance.

    Where half of the round moved, a fit that begins on all of it splits the difference.
    """
    noise_m = max(noise_m, _LEAST_SIGMA_M)
    motion, covariance = _fit(jacobian, along_m, share, points)

    def count(motion: Float64Array, times: float) -> float:
        return float(share @ (np.abs(along_m - jacobian @ motion) < times * noise_m)) / max(float(share.sum()), 1e-12)

    if _TO_SIGMA * float(np.median(np.abs(along_m - jacobian @ motion))) <= _MUCH * noise_m:
        return motion, covariance
    best, normals = max(count(motion, _WITHIN) + _MORE, _LEAST_SHARE), jacobian[:, 3:]
    across = np.linalg.eigh((normals * share[:, None]).T @ normals)[1][:, 1:].T
    for half in (*across, *-across):
        start = share * (normals @ half > 0)
        if start.sum() <= _EMPTY_SHARE * share.sum():
            continue
        found = _fit(jacobian, along_m, share, points, start, noise_m)
        held = count(found[0], _WITHIN)
        if held > best and held > _APART * count(found[0], _NEAR):
            best, (motion, covariance) = held, found
    return motion, covariance


def _fit(
    jacobian: Float64Array,
    along_m: Float64Array,
    share: Float64Array,
    points: Float64Array,
    start: Float64Array | None = None,
    noise_m: float | None = None,
) -> tuple[Float64Array, Float64Array]:
    """Return the (6,) motion and its (6, 6) covariance: least absolute values first, then Tukey's biweight.

    The fit begins with the weights `start`. Without `noise_m` the residuals tell the scale of the biweight.
    """
    weights, motion = (share if start is None else start).copy(), np.zeros(6)
    for number in range(_ROUNDS):
        hessian = (jacobian * weights[:, None]).T @ jacobian
        of_block = np.maximum(np.diag(hessian).reshape(2, 3).max(axis=1), _LEAST_DIAGONAL)
        hessian += _DAMPING * np.diag(of_block.repeat(3))
        motion[:] = np.linalg.solve(hessian, (jacobian * weights[:, None]).T @ along_m)
        residual_m = np.abs(along_m - jacobian @ motion)
        sigma_m = noise_m or max(_TO_SIGMA * float(np.median(residual_m)), _LEAST_SIGMA_M)
        if number < _L1_ROUNDS:
            weights = share / np.maximum(residual_m, max(_L1_SHARE * sigma_m, _LEAST_SIGMA_M))
            continue
        near = share * np.maximum(1 - (residual_m / (_TUKEY * sigma_m)) ** 2, 0.0) ** 2
        if not near.any():  # all that weighs moved otherwise: the motion stands
            break
        weights = near
    _, block = np.unique(cell_keys(points, _BLOCK_M), return_inverse=True)
    counts = np.bincount(block)
    signed_m = np.clip(along_m - jacobian @ motion, -3 * sigma_m, 3 * sigma_m)
    block_sigma_m = _TO_SIGMA * float(np.median(np.abs(np.bincount(block, signed_m) / counts)))
    per_block = hessian / max(float(weights.sum()), 1e-12) * len(counts)
    return motion, np.asarray(np.linalg.inv(per_block) * block_sigma_m**2, dtype=np.float64)
