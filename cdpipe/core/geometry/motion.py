"""Motion: poses over time, interpolated between samples, positions linearly and rotations by Slerp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry.arrays import Float64Array
from cdpipe.core.geometry.poses import make_pose

# Below this angle Slerp equals linear interpolation of the quaternions to the last bit.
_STRAIGHT_RAD = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The sensor pose at any time, extrapolated beyond both ends from the first and last interval.

    Attributes:
        time_s: (N,) rising times, N at least 2.
        way_m: (N,) path length up to each sample, metres.
        points: (N, 3) positions, metres.
        quaternions: (N, 4) unit quaternions x, y, z, w, each in the same hemisphere as its predecessor.
    """

    time_s: Float64Array
    way_m: Float64Array
    points: Float64Array
    quaternions: Float64Array

    def poses(self, time_s: Float64Array) -> Float64Array:
        """Return the poses (..., 4, 4) at times (...)."""
        points, quaternions = self.sample(time_s)
        return make_pose(rotation_matrices(quaternions), points)

    def sample(self, time_s: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the positions (..., 3) and unit quaternions (..., 4) at times (...)."""
        flat = time_s.ravel()
        first = np.clip(np.searchsorted(self.time_s, flat, side="right") - 1, 0, len(self.time_s) - 2)
        share = (flat - self.time_s[first]) / (self.time_s[first + 1] - self.time_s[first])
        points = self.points[first] + share[:, None] * (self.points[first + 1] - self.points[first])
        # terms that depend only on the interval are computed once per interval: columns share intervals
        low, high = int(first.min(initial=len(self.time_s))), int(first.max(initial=0)) + 2
        start, end = self.quaternions[low : high - 1], self.quaternions[low + 1 : high]
        angles = np.arccos(np.clip((start * end).sum(axis=1), -1.0, 1.0))
        stretch = first - low
        angle, sine = angles[stretch], np.maximum(np.sin(angles), _STRAIGHT_RAD)[stretch]
        is_straight = angle < _STRAIGHT_RAD
        before = np.where(is_straight, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
        after = np.where(is_straight, share, np.sin(share * angle) / sine)
        quaternions = before[:, None] * start[stretch] + after[:, None] * end[stretch]
        quaternions /= np.sqrt((quaternions * quaternions).sum(axis=1, keepdims=True))
        return points.reshape(*time_s.shape, 3), quaternions.reshape(*time_s.shape, 4)


def make_motion(time_s: Float64Array, way_m: Float64Array, points: Float64Array, rotations: Rotation) -> Motion:
    """Return the motion through N poses, given times (N,), path lengths (N,), positions (N, 3) and N rotations."""
    quaternions = rotations.as_quat()
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(flips)[:, None]
    return Motion(time_s, way_m, points, quaternions)


def rotation_matrices(quaternions: Float64Array) -> Float64Array:
    """Return the matrices (..., 3, 3) of unit quaternions x, y, z, w (..., 4)."""
    x, y, z, w = (quaternions[..., axis] for axis in range(4))
    matrices = np.empty((*quaternions.shape[:-1], 3, 3))
    matrices[..., 0, 0] = 1 - 2 * (y * y + z * z)
    matrices[..., 0, 1] = 2 * (x * y - z * w)
    matrices[..., 0, 2] = 2 * (x * z + y * w)
    matrices[..., 1, 0] = 2 * (x * y + z * w)
    matrices[..., 1, 1] = 1 - 2 * (x * x + z * z)
    matrices[..., 1, 2] = 2 * (y * z - x * w)
    matrices[..., 2, 0] = 2 * (x * z - y * w)
    matrices[..., 2, 1] = 2 * (y * z + x * w)
    matrices[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return matrices
