"""Local refinement: maps of two drifting odometries bend apart by metres, what is compared must agree to centimetres.

Every few metres along the overlap a sphere of the after map is registered finely with the before map, walking
outwards from where the merge was found. Each registration is a measurement of its own uncertainty; where a tunnel is
smooth and straight it knows little about the way along the axis. So all of them are fitted together: what each
measured, weighed by its Hessian, against how little odometry can drift between neighbours. That is a chain of poses,
solved as one banded linear system (Gauss-Newton, two steps).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from cdpipe.alignment import PathAlignment
from cdpipe.config import MergeConfig
from cdpipe.geometry import Float64Array, Int64Array
from cdpipe.registration import IndexedMap
from cdpipe.walk import Step, Walk, walk

# Every 2 m and thinned to 0.3 m is three times the work for the same centimetres (validation, cdpipe/README.md).
_SPACING_M = 4.0
# What was seen from afar stands where the odometry of then put it, and so does what is far from the anchor. From afar
# is 2.5 times as far as the walls pass by, which is the 20th percentile of the map's shortest ranges; 6 m at least.
_SEEN_WITHIN, _WALL_PERCENTILE, _SEEN_WITHIN_M = 2.5, 20, 6.0
_RADIUS_M = 5.0
_VOXEL_M = 0.4
_CORRESPONDENCE_M = 1.0
# How far a map point is off the surface, one standard deviation. Of 0.03 to 0.4 m the one with the smallest errors on
# validation pairs whose sessions drift apart by 1 %; without drift a larger one averages more.
_POINT_M = 0.05
# What holds an anchor that nothing else holds, so that the system can be solved.
_WEAKEST = 1e-6
# What two odometries may drift apart over a metre of path, one standard deviation.
_DRIFT_M, _DRIFT_RAD = 0.02, np.deg2rad(0.05)
# Registrations that fit worse than this are left to their neighbours.
_MIN_FIT = 0.6
# Where fewer of them fit, the whole of it is left alone.
_MIN_GOOD_SHARE = 0.5
_STEPS = 2


def refined(
    before: IndexedMap, after: IndexedMap, found: Walk, config: MergeConfig
) -> tuple[PathAlignment | None, dict[str, float]]:
    """Return the alignment along the after path, and what was measured of it.

    Evidence: `n_refined` registrations, `refined_inlier_share` (their mean share of inliers), `max_correction_m` (how
    far the refinement moved any of the places).

    Args:
        before: The before map, a target.
        after: The after map.
        found: The walk along the path that was accepted.
        config: Settings of the merge.

    Returns:
        The alignment, or None where fewer than half of the registrations fit.
    """
    if not np.isfinite(found.fits).any():
        return None, {"n_refined": 0.0}
    wall_m = float(np.percentile(after.map.nearest_m, _WALL_PERCENTILE))
    seen_within_m = min(max(_SEEN_WITHIN * wall_m, _SEEN_WITHIN_M), config.seen_within_m)
    closer = config.model_copy(update={"seen_within_m": seen_within_m})
    before = IndexedMap(before.map, closer, is_target=True)
    after = IndexedMap(after.map, closer, is_target=False)
    keyframes, start = _anchors(after, found)
    coarse = PathAlignment(after.positions[found.keyframes], found.before_T_after)
    first = int(np.nanargmax(found.fits))
    step = Step(_RADIUS_M, _VOXEL_M, _CORRESPONDENCE_M)
    walked = walk(before, after, keyframes, start, found.before_T_after[first], step, config)
    is_good = walked.fits >= _MIN_FIT
    evidence = {"n_refined": float(np.count_nonzero(is_good))}
    if np.count_nonzero(is_good) < _MIN_GOOD_SHARE * np.count_nonzero(np.isfinite(walked.fits)) or not is_good.any():
        return None, evidence
    information = walked.information * np.where(is_good, 1 / _POINT_M**2, 0.0)[:, None, None]
    positions = np.where(is_good[:, None], walked.held_at, after.positions[walked.keyframes])
    smooth = smoothed(positions, walked.before_T_after, information)
    alignment = PathAlignment(positions, smooth)
    moved_m = np.linalg.norm(alignment.to_map(positions) - coarse.to_map(positions), axis=1)
    return alignment, {
        **evidence,
        "refined_inlier_share": float(walked.fits[is_good].mean()),
        "max_correction_m": float(moved_m[is_good].max()),
    }


def smoothed(positions: Float64Array, before_T_after: Float64Array, information: Float64Array) -> Float64Array:
    """Return the likeliest alignments along a path.

    Unknown is the pose of each anchor in the map frame. Measured is each with its own information, and that the pose of
    one anchor relative to the one before it is what the odometry says, to within its drift.

    Args:
        positions: (A, 3) anchors along the path, after odom frame, metres.
        before_T_after: (A, 4, 4) measured alignments.
        information: (A, 6, 6) of each: turn, then shift, in after odom axes about the anchor; zero where not measured.

    Returns:
        (A, 4, 4) alignments.
    """
    n = len(positions)
    measured = _Poses(before_T_after[:, :3, :3], _applied(before_T_after, positions))
    steps = np.diff(positions, axis=0)
    length_m = np.maximum(np.linalg.norm(steps, axis=1), 1e-3)
    weights = np.repeat(1 / np.array([_DRIFT_RAD**2, _DRIFT_M**2]), 3) / length_m[:, None]
    state = measured
    for _ in range(_STEPS):
        # residuals at the present state: against what was measured, and against the step of the odometry
        turned = Rotation.from_matrix(np.swapaxes(measured.rotations, 1, 2) @ state.rotations).as_rotvec()
        shifted = np.einsum("aji,aj->ai", state.rotations, state.translations - measured.translations)
        back = np.swapaxes(state.rotations[:-1], 1, 2)
        bend = Rotation.from_matrix(back @ state.rotations[1:]).as_rotvec() if n > 1 else np.zeros((0, 3))
        slip = np.einsum("aij,aj->ai", back, np.diff(state.translations, axis=0)) - steps

        blocks, gradient = (
            information + _WEAKEST * np.eye(6),
            np.einsum("aij,aj->ai", information, np.hstack([turned, shifted])),
        )
        coupling = np.zeros((max(n - 1, 0), 6, 6))
        for a in range(n - 1):
            here, there = np.zeros((6, 6)), np.eye(6)
            here[:3, :3] = here[3:, 3:] = -np.eye(3)
            here[3:, :3] = _cross(steps[a])
            residual = np.concatenate([bend[a], slip[a]])
            blocks[a] += here.T @ (weights[a][:, None] * here)
            blocks[a + 1] += there * weights[a]
            coupling[a] = here.T * weights[a]
            gradient[a] += here.T @ (weights[a] * residual)
            gradient[a + 1] += weights[a] * residual
        change = -_solved(blocks, coupling, gradient)
        state = _Poses(
            state.rotations @ Rotation.from_rotvec(change[:, :3]).as_matrix(),
            state.translations + np.einsum("aij,aj->ai", state.rotations, change[:, 3:]),
        )
    result = np.repeat(np.eye(4)[None], n, axis=0)
    result[:, :3, :3] = state.rotations
    result[:, :3, 3] = state.translations - np.einsum("aij,aj->ai", state.rotations, positions)
    return result


class _Poses(NamedTuple):
    """Poses (A,) of the anchors in the map frame: turn of the after odom axes, and position."""

    rotations: Float64Array
    translations: Float64Array


def _anchors(after: IndexedMap, found: Walk) -> tuple[Int64Array, int]:
    """Return after keyframes about 4 m apart, and where among them the best place of the walk stands."""
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(after.positions, axis=0), axis=1))])
    start = int(found.keyframes[np.nanargmax(found.fits)])
    _, first = np.unique(np.floor((path_m - path_m[start]) / _SPACING_M + 1e-6), return_index=True)
    keyframes = np.unique(np.append(first, start)).astype(np.int64)
    return keyframes, int(np.searchsorted(keyframes, start))


def _solved(blocks: Float64Array, coupling: Float64Array, gradient: Float64Array) -> Float64Array:
    """Solve the block tridiagonal system of (A, 6, 6) blocks, (A - 1, 6, 6) blocks beside them, (A, 6) right side."""
    n = len(blocks)
    banded = np.zeros((12, 6 * n))
    for row in range(6):
        for column in range(6):
            if row >= column:
                banded[row - column, column::6] = blocks[:, row, column]
            # below the diagonal block stands the transpose of the coupling
            banded[6 + row - column, column : 6 * (n - 1) : 6] = coupling[:, column, row]
    return np.asarray(solveh_banded(banded, gradient.ravel(), lower=True)).reshape(n, 6)


def _applied(dst_T_src: Float64Array, points: Float64Array) -> Float64Array:
    return np.asarray(np.einsum("aij,aj->ai", dst_T_src[:, :3, :3], points) + dst_T_src[:, :3, 3])


def _cross(vector: Float64Array) -> Float64Array:
    """Return the (3, 3) matrix M with M @ turn = d/dturn of (turn x vector) taken to the left side: [vector]x."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
