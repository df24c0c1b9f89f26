"""Where the after session's odom frame lies in the map frame, place by place along the after session's path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.geometry import Float64Array, Int64Array, invert, require_poses, require_shape, transform

_BLENDED = 4
# Anchors stand a metre or so apart; a wider blend would iron out real bends, a narrower one tears points apart.
_BLEND_M = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class PathAlignment:
    """A transform for each of some anchors along the path, blended between them.

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

    @classmethod
    def rigid(cls, before_T_after: Float64Array) -> PathAlignment:
        """Return the alignment that is one (4, 4) transform everywhere."""
        return cls(np.zeros((1, 3)), before_T_after[None])

    def at(self, positions_odom: Float64Array) -> Float64Array:
        """Return the (N, 4, 4) before_T_after at each of (N, 3) positions in the after odom frame."""
        require_shape("positions_odom", positions_odom, (None, 3))
        nearest, weights = _weights(self.anchors_odom, positions_odom)
        blended = np.einsum("nk,nkij->nij", weights, self.before_T_after[nearest])
        # the mean of rotations a degree apart is a rotation but for rounding, which the SVD takes out
        u, _, v = np.linalg.svd(blended[:, :3, :3])
        blended[:, :3, :3] = u @ v
        return np.asarray(blended)

    def to_map(self, points_odom: Float64Array) -> Float64Array:
        """Return (N, 3) points of the after odom frame in the map frame."""
        return _moved(points_odom, self.anchors_odom, self.before_T_after)

    def to_odom(self, points_map: Float64Array) -> Float64Array:
        """Return (N, 3) points of the map frame in the after odom frame.

        The inverse of `to_map` but for the blend's own bend between two anchors: millimetres.
        """
        rotated = np.einsum("aij,aj->ai", self.before_T_after[:, :3, :3], self.anchors_odom)
        return _moved(points_map, rotated + self.before_T_after[:, :3, 3], invert(self.before_T_after))


def _moved(points: Float64Array, anchors: Float64Array, dst_T_src: Float64Array) -> Float64Array:
    require_shape("points", points, (None, 3))
    if len(anchors) == 1:
        return transform(dst_T_src[0], points)
    nearest, weights = _weights(anchors, points)
    moved = np.zeros_like(points)
    for k in range(nearest.shape[1]):
        chosen = dst_T_src[nearest[:, k]]
        moved += weights[:, k, None] * (np.einsum("nij,nj->ni", chosen[:, :3, :3], points) + chosen[:, :3, 3])
    return moved


def _weights(anchors: Float64Array, positions: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the nearest anchors (N, k) of each position and their weights, which add up to 1."""
    n_blended = min(_BLENDED, len(anchors))
    found = cKDTree(anchors).query(positions, k=[*range(1, n_blended + 1)])
    distances_m, nearest = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
    # against the nearest one, so that far from the path the weights do not all vanish
    weights = np.exp((distances_m[:, :1] ** 2 - distances_m**2) / (2 * _BLEND_M**2))
    return nearest, weights / weights.sum(axis=1, keepdims=True)
