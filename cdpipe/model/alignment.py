"""Alignment of the after session along its path: rigid transforms at anchors, blended between them.

Two drifting odometries fit only locally, so the transform from the after session's odom frame to the map frame depends
on the position.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array, invert, require_poses, require_shape, transform
from cdpipe.core.geometry.voxel import cell_keys

# Anchors stand 4 m apart. A wider blend smooths real bends away; a narrower one tears neighbouring points apart.
_BLEND_M = 2.0
# Anchors used per point: four blending lengths to either side. The first one left out has a weight of 0.0003.
_BLENDED = 16
# Points are moved by trilinear interpolation between the corners of cells of this size: error below a millimetre, ten
# times as fast.
_CELL_M = 2.0
_CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
_MIN_POINTS_PER_CELL = 3
_BLOCK_POINTS = 1 << 12


class _Anchors(NamedTuple):
    """k-d tree of the (A, 3) anchors in one frame, and the (A, 4, 4) poses of that frame in the other."""

    tree: cKDTree
    dst_T_src: Float64Array


@dataclass(frozen=True, eq=False)
class PathAlignment:
    """A transform for each of some anchors along the path, blended between them.

    The trees of the anchors are made once: a crop moves a single point, and a long path has ten thousand anchors.

    Attributes:
        anchors_odom: (A, 3) positions, after odom frame, metres.
        before_T_after: (A, 4, 4) pose of the after session's odom frame in the map frame, as it holds at each anchor.
    """

    anchors_odom: Float64Array
    before_T_after: Float64Array

    def __post_init__(self) -> None:
        require_shape("anchors_odom", self.anchors_odom, (len(self.before_T_after), 3))
        require_poses("before_T_after", self.before_T_after)
        if len(self.before_T_after) == 0:
            raise ValueError("an alignment needs an anchor")

    @property
    def is_rigid(self) -> bool:
        """Whether one transform holds everywhere."""
        return len(self.anchors_odom) == 1

    @classmethod
    def rigid(cls, before_T_after: Float64Array) -> PathAlignment:
        """Return the alignment that is one (4, 4) transform everywhere."""
        return cls(np.zeros((1, 3)), before_T_after[None])

    def at(self, positions_odom: Float64Array) -> Float64Array:
        """Return the (N, 4, 4) before_T_after at each of (N, 3) positions in the after odom frame.

        Each transform agrees with `to_map` at its own position to a millimetre.
        """
        require_shape("positions_odom", positions_odom, (None, 3))
        if self.is_rigid:
            return np.repeat(self.before_T_after, len(positions_odom), axis=0)
        nearest, weights = _weights(self._of_odom.tree, positions_odom)
        poses = np.einsum("nk,nkij->nij", weights, self.before_T_after[nearest])
        moved = np.einsum("nij,nj->ni", poses[:, :3, :3], positions_odom) + poses[:, :3, 3]
        # the mean of rotations a degree apart is nearly a rotation; the SVD projects it onto one
        u, _, v = np.linalg.svd(poses[:, :3, :3])
        poses[:, :3, :3] = u @ v
        poses[:, 3] = 0.0, 0.0, 0.0, 1.0
        # the frame's origin may be a kilometre away: rotate about the position, not about the origin
        poses[:, :3, 3] = moved - np.einsum("nij,nj->ni", poses[:, :3, :3], positions_odom)
        return np.asarray(poses)

    def to_map(self, points_odom: Float64Array) -> Float64Array:
        """Return (N, 3) points of the after odom frame in the map frame."""
        return _move(points_odom, self._of_odom)

    def to_odom(self, points_map: Float64Array) -> Float64Array:
        """Return (N, 3) points of the map frame in the after odom frame.

        The inverse of `to_map` up to millimetres, the bend of the blend between two anchors.
        """
        return _move(points_map, self._of_map)

    @cached_property
    def _of_odom(self) -> _Anchors:
        return _Anchors(cKDTree(self.anchors_odom), self.before_T_after)

    @cached_property
    def _of_map(self) -> _Anchors:
        rotated = np.einsum("aij,aj->ai", self.before_T_after[:, :3, :3], self.anchors_odom)
        return _Anchors(cKDTree(rotated + self.before_T_after[:, :3, 3]), invert(self.before_T_after))


def _move(points: Float64Array, anchors: _Anchors) -> Float64Array:
    """Move points by interpolating the blend between the corners of their cells; exactly where that is no slower."""
    require_shape("points", points, (None, 3))
    if len(anchors.dst_T_src) == 1:
        return transform(anchors.dst_T_src[0], points)
    cells, first, cell_of = np.unique(cell_keys(points, _CELL_M), return_index=True, return_inverse=True)
    if len(points) <= _MIN_POINTS_PER_CELL * len(cells):
        return _blend(points, anchors)
    low = np.floor(points[first] / _CELL_M)
    around = (low[:, None] + _CORNERS).reshape(-1, 3) * _CELL_M
    _, first, corner_of = np.unique(cell_keys(around, _CELL_M), return_index=True, return_inverse=True)
    corners = _blend(around[first], anchors)
    corners_of_cell = corners[corner_of].reshape(len(cells), 3 * len(_CORNERS))
    return np.concatenate(
        [
            _between_corners(points[part], low[cell_of[part]], corners_of_cell.take(cell_of[part], axis=0))
            for part in (slice(start, start + _BLOCK_POINTS) for start in range(0, len(points), _BLOCK_POINTS))
        ]
    )


def _between_corners(points: Float64Array, low: Float64Array, corners: Float64Array) -> Float64Array:
    """Return (N, 3) the corners (N, 8 x 3) of each point's cell, weighed by where in the cell it lies."""
    share = points / _CELL_M - low
    shares = np.stack([1.0 - share, share], axis=1)
    in_plane = shares[:, :, None, 0] * shares[:, None, :, 1]
    weights = in_plane[:, :, :, None] * shares[:, None, None, :, 2]
    return np.asarray(np.einsum("nk,nkj->nj", weights.reshape(-1, 8), corners.reshape(-1, 8, 3)))


def _blend(points: Float64Array, anchors: _Anchors) -> Float64Array:
    moved = np.zeros_like(points)
    nearest, weights = _weights(anchors.tree, points)
    for k in range(nearest.shape[1]):
        chosen = anchors.dst_T_src[nearest[:, k]]
        moved += weights[:, k, None] * (np.einsum("nij,nj->ni", chosen[:, :3, :3], points) + chosen[:, :3, 3])
    return moved


def _weights(anchors: cKDTree, positions: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the nearest anchors (N, k) of each position and their weights, which add up to 1."""
    n_blended = min(_BLENDED, anchors.n)
    found = anchors.query(positions, k=[*range(1, n_blended + 1)])
    distances_m, nearest = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
    # against the nearest one, so that far from the path the weights do not all vanish
    weights = np.exp((distances_m[:, :1] ** 2 - distances_m**2) / (2 * _BLEND_M**2))
    return nearest, weights / weights.sum(axis=1, keepdims=True)
