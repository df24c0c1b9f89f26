"""Pose graph of the alignment along the path: registrations at anchors, odometry between them.

The unknowns are the pose of each anchor in the map frame and one stretch, the relative difference of the path lengths
that the two odometries measure. Most odometry drift is such a scale error, constant over a session. Three Gauss-Newton
steps solve it; each is a banded linear system with one extra column for the stretch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, make_pose, transform_each

# Prior on an unconstrained anchor; it keeps the system regular.
_WEAKEST = 1e-6
# Standard deviations: relative drift over one metre of path (translation, rotation), and the stretch.
_DRIFT_M, _DRIFT_RAD, _STRETCH = 0.01, np.deg2rad(0.05), 0.01
_STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """The solved pose graph.

    Attributes:
        positions: (A, 3) anchors in path order, after odom frame, metres.
        before_T_after: (A, 4, 4) alignment at each anchor.
        stretch: Relative excess of the path length in the before odom frame over that in the after odom frame.
    """

    positions: Float64Array
    before_T_after: Float64Array
    stretch: float

    def at(self, anchors_m: Float64Array, places_m: Float64Array, places: Float64Array) -> Float64Array:
        """Return the (K, 4, 4) alignments at places on the path, interpolated between the two neighbouring anchors.

        Args:
            anchors_m: (A,) path length of the anchors, rising, metres.
            places_m: (K,) path length of the places, metres.
            places: (K, 3) positions of the places, after odom frame, metres.
        """
        after = np.clip(np.searchsorted(anchors_m, places_m), 1, max(len(anchors_m) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(anchors_m) - 1)
        length_m = np.maximum(anchors_m[after] - anchors_m[before], 1e-9)
        share = np.clip((places_m - anchors_m[before]) / length_m, 0.0, 1.0)
        moved = (1 - share[:, None]) * self._predict(before, places) + share[:, None] * self._predict(after, places)
        rotations = self.before_T_after[before, :3, :3]
        turn = np.swapaxes(rotations, 1, 2) @ self.before_T_after[after, :3, :3]
        rotations = (
            rotations @ Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(turn).as_rotvec()).as_matrix()
        )
        return _make_poses(rotations, moved, places)

    def _predict(self, anchors: np.ndarray, places: Float64Array) -> Float64Array:
        """Return the (K, 3) map position of each place as predicted from one anchor, given by index."""
        apart = places - self.positions[anchors]
        stretched = self.positions[anchors] + (1 + self.stretch) * apart
        return transform_each(self.before_T_after[anchors], stretched)


def solve_pose_graph(
    positions: Float64Array, before_T_after: Float64Array, information: Float64Array, per_stretch: Float64Array
) -> PoseGraph:
    """Return the maximum-likelihood alignments along a path.

    The measurements are the registration at each anchor and the relative pose between neighbouring anchors, which is
    the stretched odometry up to its drift.

    Args:
        positions: (A, 3) anchors along the path, after odom frame, metres.
        before_T_after: (A, 4, 4) registrations.
        information: (A, 6, 6) information of each: rotation, then translation, after odom axes about the anchor; zero
            without a registration.
        per_stretch: (A, 6) error of each registration, rotation and translation, per unit of stretch.
    """
    measured = _State(before_T_after[:, :3, :3], transform_each(before_T_after, positions), 0.0)
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
    """Rotations (A, 3, 3) and map positions (A, 3) of the anchors, and the stretch."""

    rotations: Float64Array
    translations: Float64Array
    stretch: float


class _System(NamedTuple):
    """Normal equations: diagonal blocks (A, 6, 6), coupling (A - 1, 6, 6), the stretch's column and the gradient."""

    blocks: Float64Array
    coupling: Float64Array
    border: Float64Array
    gradient: Float64Array


def _add_odometry(system: _System, state: _State, steps: Float64Array) -> tuple[float, float]:
    """Add the odometry terms; return their contribution to the stretch's curvature and slope."""
    n = len(steps)
    back = np.swapaxes(state.rotations[:-1], 1, 2)
    bend = Rotation.from_matrix(back @ state.rotations[1:]).as_rotvec() if n else np.zeros((0, 3))
    slip = np.einsum("aij,aj->ai", back, np.diff(state.translations, axis=0)) - (1 + state.stretch) * steps
    residuals = np.hstack([bend, slip])
    length_m = np.maximum(np.linalg.norm(steps, axis=1), 1e-3)
    weights = np.repeat([1 / _DRIFT_RAD**2, 1 / _DRIFT_M**2], 3) / length_m[:, None]
    # derivatives: identity for the second anchor, minus the step for the stretch
    here = np.repeat(-np.eye(6)[None], n, axis=0)
    here[:, 3:, :3] = -np.cross(steps[:, None, :], np.eye(3)[None])  # the matrices [step]x of the cross product
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
    """Solve the bordered block-tridiagonal system; return the update of the poses (A, 6) and of the stretch."""
    n = len(system.blocks)
    banded = np.zeros((12, 6 * n))
    for row in range(6):
        for column in range(6):
            if row >= column:
                banded[row - column, column::6] = system.blocks[:, row, column]
            # the block below the diagonal is the transpose of the coupling
            banded[6 + row - column, column : 6 * (n - 1) : 6] = system.coupling[:, column, row]
    sides = np.stack([system.gradient.ravel(), system.border.ravel()], axis=1)
    of_gradient, of_border = np.asarray(solveh_banded(banded, sides, lower=True)).T
    border = system.border.ravel()
    stretch = -(slope - border @ of_gradient) / (corner - border @ of_border)
    return -(of_gradient + of_border * stretch).reshape(n, 6), float(stretch)


def _make_poses(rotations: Float64Array, translations: Float64Array, positions: Float64Array) -> Float64Array:
    """Return the (N, 4, 4) transforms with the given rotations that map positions to translations."""
    return make_pose(rotations, translations - np.einsum("aij,aj->ai", rotations, positions))
