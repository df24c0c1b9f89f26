"""The likeliest course of an alignment along a path: registrations against what odometry can drift between them.

Unknown are the pose of each anchor in the map frame and one stretch, the ratio of the lengths that two odometries give
the same way: most of what odometry drifts is such a scale, the same for a whole session. Solved as one banded linear
system with one more column (Gauss-Newton, three steps).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array

# What holds an anchor that nothing else holds, so that the system can be solved.
_WEAKEST = 1e-6
# What two odometries may drift apart over a metre of path, and the stretch between them, one standard deviation each.
_DRIFT_M, _DRIFT_RAD, _STRETCH = 0.01, np.deg2rad(0.05), 0.01
_STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Alignments along a path.

    Attributes:
        positions: (A, 3) anchors in the order of the path, after odom frame, metres.
        before_T_after: (A, 4, 4) what holds at each.
        stretch: By what share the way is longer in the before odom frame than in the after odom frame.
    """

    positions: Float64Array
    before_T_after: Float64Array
    stretch: float

    def at(self, anchors_m: Float64Array, places_m: Float64Array, places: Float64Array) -> Float64Array:
        """Return the (K, 4, 4) alignments at places on the same path: both anchors' word, the nearer one's the most.

        Args:
            anchors_m: (A,) where on the path the anchors stand, rising.
            places_m: (K,) where on it the places are.
            places: (K, 3) the places, after odom frame, metres.
        """
        after = np.clip(np.searchsorted(anchors_m, places_m), 1, max(len(anchors_m) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(anchors_m) - 1)
        length_m = np.maximum(anchors_m[after] - anchors_m[before], 1e-9)
        share = np.clip((places_m - anchors_m[before]) / length_m, 0.0, 1.0)
        moved = (1 - share[:, None]) * self._moved(before, places) + share[:, None] * self._moved(after, places)
        rotations = self.before_T_after[before, :3, :3]
        turn = np.swapaxes(rotations, 1, 2) @ self.before_T_after[after, :3, :3]
        rotations = (
            rotations @ Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(turn).as_rotvec()).as_matrix()
        )
        return _make_poses(rotations, moved, places)

    def _moved(self, anchors: np.ndarray, places: Float64Array) -> Float64Array:
        """Return where each place is in the map frame as seen from its anchor, by index."""
        apart = places - self.positions[anchors]
        stretched = self.positions[anchors] + (1 + self.stretch) * apart
        return _apply(self.before_T_after[anchors], stretched)


def solve_pose_graph(
    positions: Float64Array, before_T_after: Float64Array, information: Float64Array, per_stretch: Float64Array
) -> PoseGraph:
    """Return the likeliest alignments along a path.

    Measured is the pose of each anchor with its own information, and that the pose of one anchor relative to the one
    before it is what the odometry says, stretched, to within its drift.

    Args:
        positions: (A, 3) anchors along the path, after odom frame, metres.
        before_T_after: (A, 4, 4) measured alignments.
        information: (A, 6, 6) of each: turn, then shift, in after odom axes about the anchor; zero where not measured.
        per_stretch: (A, 6) by how much each was measured wrong, turn and shift, for a stretch of 1.
    """
    measured = _State(before_T_after[:, :3, :3], _apply(before_T_after, positions), 0.0)
    state = measured
    steps = np.diff(positions, axis=0)
    for _ in range(_STEPS):
        turned = Rotation.from_matrix(np.swapaxes(measured.rotations, 1, 2) @ state.rotations).as_rotvec()
        shifted = np.einsum("aji,aj->ai", state.rotations, state.translations - measured.translations)
        residuals = np.hstack([turned, shifted]) + state.stretch * per_stretch
        system = _System(
            information + _WEAKEST * np.eye(6),
            np.zeros((max(len(positions) - 1, 0), 6, 6)),
            np.einsum("aij,aj->ai", information, per_stretch),
            np.einsum("aij,aj->ai", information, residuals),
        )
        corner = 1 / _STRETCH**2 + np.einsum("ai,aij,aj", per_stretch, information, per_stretch)
        slope = state.stretch / _STRETCH**2 + np.einsum("ai,aij,aj", per_stretch, information, residuals)
        of_steps = _add_odometry(system, state, steps)
        change, stretched = _solve(system, corner + of_steps[0], slope + of_steps[1])
        state = _State(
            state.rotations @ Rotation.from_rotvec(change[:, :3]).as_matrix(),
            state.translations + np.einsum("aij,aj->ai", state.rotations, change[:, 3:]),
            state.stretch + stretched,
        )
    return PoseGraph(positions, _make_poses(state.rotations, state.translations, positions), state.stretch)


class _State(NamedTuple):
    """Poses (A,) of the anchors in the map frame, turn of the after odom axes and position, and the stretch."""

    rotations: Float64Array
    translations: Float64Array
    stretch: float


class _System(NamedTuple):
    """Normal equations of the poses: (A, 6, 6) blocks and (A - 1, 6, 6) beside them; the stretch's column."""

    blocks: Float64Array
    coupling: Float64Array
    border: Float64Array
    gradient: Float64Array


def _add_odometry(system: _System, state: _State, steps: Float64Array) -> tuple[float, float]:
    """Add what odometry says of each step; return its share of the stretch's own curvature and slope."""
    n = len(steps)
    back = np.swapaxes(state.rotations[:-1], 1, 2)
    bend = Rotation.from_matrix(back @ state.rotations[1:]).as_rotvec() if n else np.zeros((0, 3))
    slip = np.einsum("aij,aj->ai", back, np.diff(state.translations, axis=0)) - (1 + state.stretch) * steps
    residuals = np.hstack([bend, slip])
    length_m = np.maximum(np.linalg.norm(steps, axis=1), 1e-3)
    weights = np.repeat([1 / _DRIFT_RAD**2, 1 / _DRIFT_M**2], 3) / length_m[:, None]
    # of the anchor after the step the derivative is one; of the stretch it is the step, back
    here = np.repeat(-np.eye(6)[None], n, axis=0)
    here[:, 3:, :3] = _cross_matrices(steps)
    per_stretch = np.hstack([np.zeros((n, 3)), -steps])
    weighted = np.swapaxes(here, 1, 2) * weights[:, None]
    system.blocks[:-1] += weighted @ here
    system.blocks[1:] += weights[:, :, None] * np.eye(6)
    system.coupling[:] = weighted
    system.border[:-1] += np.einsum("aij,aj->ai", weighted, per_stretch)
    system.border[1:] += weights * per_stretch
    system.gradient[:-1] += np.einsum("aij,aj->ai", weighted, residuals)
    system.gradient[1:] += weights * residuals
    return float(np.sum(weights * per_stretch**2)), float(np.sum(weights * per_stretch * residuals))


def _solve(system: _System, corner: float, slope: float) -> tuple[Float64Array, float]:
    """Solve the block tridiagonal system with its border; return the change of the poses (A, 6) and of the stretch."""
    n = len(system.blocks)
    banded = np.zeros((12, 6 * n))
    for row in range(6):
        for column in range(6):
            if row >= column:
                banded[row - column, column::6] = system.blocks[:, row, column]
            # below the diagonal block stands the transpose of the coupling
            banded[6 + row - column, column : 6 * (n - 1) : 6] = system.coupling[:, column, row]
    sides = np.stack([system.gradient.ravel(), system.border.ravel()], axis=1)
    of_gradient, of_border = np.asarray(solveh_banded(banded, sides, lower=True)).T
    border = system.border.ravel()
    stretch = -(slope - border @ of_gradient) / (corner - border @ of_border)
    return -(of_gradient + of_border * stretch).reshape(n, 6), float(stretch)


def _make_poses(rotations: Float64Array, translations: Float64Array, positions: Float64Array) -> Float64Array:
    """Return the (N, 4, 4) transforms with these rotations that take the positions to the translations."""
    result = np.repeat(np.eye(4)[None], len(positions), axis=0)
    result[:, :3, :3] = rotations
    result[:, :3, 3] = translations - np.einsum("aij,aj->ai", rotations, positions)
    return result


def _apply(dst_T_src: Float64Array, points: Float64Array) -> Float64Array:
    return np.asarray(np.einsum("aij,aj->ai", dst_T_src[:, :3, :3], points) + dst_T_src[:, :3, 3])


def _cross_matrices(vectors: Float64Array) -> Float64Array:
    """Return the (N, 3, 3) matrices [v]x of (N, 3) vectors: [v]x @ turn = v x turn."""
    return -np.cross(vectors[:, None, :], np.eye(3)[None])
