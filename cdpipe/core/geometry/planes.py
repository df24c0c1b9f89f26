"""Planes through points."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry.arrays import Float32Array, Float64Array

# A plane within this angle of level may be a floor.
_LEVEL = np.cos(np.deg2rad(20.0))


def fit_plane(points: Float64Array | Float32Array) -> tuple[Float64Array, Float64Array]:
    """Return the centre (3,) and the upward unit normal (3,) of the plane that (N, 3) points are nearest to."""
    centre = np.asarray(points.mean(axis=0), dtype=np.float64)
    normal = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 0]
    return centre, -normal if normal[2] < 0 else normal


def is_level_sheet(points: Float64Array | Float32Array, thickness_m: float) -> bool:
    """Return whether (N, 3) points lie on one level plane, as a floor does: the middle 90 % are within a thickness."""
    centre, normal = fit_plane(points)
    low_m, high_m = np.quantile((points - centre) @ normal, (0.05, 0.95))
    return bool(normal[2] > _LEVEL and high_m - low_m < thickness_m)
