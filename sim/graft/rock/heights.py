"""A smooth surface through recorded returns: height over a plane, by local linear regression."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array

_NODE_M = 0.25
_RADIUS_M = 0.6  # of the returns that a node looks at; half of it is the standard deviation of their weights
_LEAST_RETURNS = 8
_BANDS_M = (0.6, 0.25, 0.12, 0.12)  # about the surface, narrower from fit to fit; the first one is about the plane
_STIFF = 1e-3  # share of the weights that holds the slope of a node with one-sided returns at 0


@dataclass(frozen=True, slots=True, eq=False)
class Heights:
    """A smooth surface over a rectangle about the origin of a frame whose z axis is its normal, metres."""

    spline: RectBivariateSpline

    def at(self, places: Float64Array) -> Float64Array:
        """Return the height (N,) at places (N, 2)."""
        return np.asarray(self.spline.ev(places[:, 0], places[:, 1]))

    def slopes(self, places: Float64Array) -> Float64Array:
        """Return the slopes (N, 2) along x and y at places (N, 2)."""
        x, y = places[:, 0], places[:, 1]
        return np.column_stack([self.spline.ev(x, y, dx=1), self.spline.ev(x, y, dy=1)])

    def normals(self, places: Float64Array) -> Float64Array:
        """Return the unit normals (N, 3), positive along z, at places (N, 2)."""
        normals = np.column_stack([-self.slopes(places), np.ones(len(places))])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def off_m(self, points: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return how far points (N, 3) lie off the surface (N,), positive above it, and the normals (N, 3) there."""
        normals = self.normals(points[:, :2])
        return (points[:, 2] - self.at(points[:, :2])) * normals[:, 2], normals


def fit_heights(points: Float64Array, half_m: tuple[float, float]) -> Heights | None:
    """Fit a surface to points (N, 3) over a rectangle of half sizes `half_m`; None where too few lie near it.

    Every 0.25 m a plane is fitted to the points within 0.6 m, with Gaussian weights, and a bicubic spline goes through
    the heights of these nodes. A node with fewer than eight points has the height of the nearest one that has more.
    Points off the surface are left out, by 0.12 m at the last.
    """
    axes = [np.linspace(-half, half, max(4, 1 + round(2 * half / _NODE_M))) for half in half_m]
    keeps = np.abs(points[:, 2]) < _BANDS_M[0]
    surface: Heights | None = None
    for band_m in (*_BANDS_M[1:], None):
        nodes = _fit_nodes(points[keeps], axes)
        if nodes is None:
            return None
        surface = Heights(RectBivariateSpline(axes[0], axes[1], nodes))
        if band_m is not None:
            keeps = np.abs(surface.off_m(points)[0]) < band_m
    return surface


def _fit_nodes(points: Float64Array, axes: list[Float64Array]) -> Float64Array | None:
    """Return the height (A, B) of each node of a grid."""
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    if len(points) < _LEAST_RETURNS:
        return None
    pairs = cKDTree(grid).sparse_distance_matrix(cKDTree(points[:, :2]), _RADIUS_M, output_type="coo_matrix")
    weight = np.exp(-2.0 * (pairs.data / _RADIUS_M) ** 2)
    node, (x, y) = pairs.row, (points[pairs.col, :2] - grid[pairs.row]).T
    terms = np.stack([np.ones_like(x), x, y])

    def total(values: Float64Array) -> Float64Array:
        return np.asarray(np.bincount(node, weight * values, minlength=len(grid)), np.float64)

    moments = np.array([[total(one * other) for other in terms] for one in terms]).transpose(2, 0, 1)
    told = np.array([total(each * points[pairs.col, 2]) for each in terms]).T
    is_told = np.bincount(node, minlength=len(grid)) >= _LEAST_RETURNS
    if not is_told.any():
        return None
    moments[:, [1, 2], [1, 2]] += _STIFF * _RADIUS_M**2 * moments[:, :1, 0]
    heights = np.linalg.solve(moments[is_told], told[is_told][..., None])[:, 0, 0]
    nearest = np.asarray(cKDTree(grid[is_told]).query(grid)[1])
    return np.asarray(heights[nearest].reshape([len(axis) for axis in axes]))


def cells_seen(places: Float64Array, half_m: tuple[float, float], cell_m: float) -> BoolArray:
    """Mark the cells (A, B) of a rectangle of half sizes `half_m` that hold one of some places (N, 2) at least."""
    shape = np.array([max(1, round(2 * half / cell_m)) for half in half_m])
    cell = ((places / np.array(half_m) + 1.0) / 2.0 * shape).astype(np.int64).clip(0, shape - 1)
    is_seen = np.zeros(tuple(shape.tolist()), dtype=np.bool_)
    is_seen[cell[:, 0], cell[:, 1]] = True
    return is_seen


def list_corners(half_m: tuple[float, float]) -> Iterator[tuple[float, float]]:
    """Yield the corners of a rectangle of half sizes `half_m`, one after the other around it."""
    yield from ((u * half_m[0], v * half_m[1]) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
