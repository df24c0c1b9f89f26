"""Fit one object to another: clouds of points, and their registration by yaw, with a lean, or by any rotation.

Both directions count, and weights are robust, because the two sessions see an object from different sides. All guesses
are registered at once, with the nearest points that a grid tells; the best of the results are registered finely.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int32Array, invert, make_pose, yaw_pose
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.geometry.voxel import thin
from cdpipe.extract.shape import upright_box

# Distance within which a point lies on the other surface, and scale of the likeness.
_SAME_WITHIN_M, _LIKE_WITHIN_M = 0.05, 0.1
# Tails: a beam that meets an edge also returns from behind it. Groups of points this far from the others are left out
# if they hold fewer of an object's points than this share. A registration starts from the centre of the box around
# the rest.
_TAIL_GAP_M, _TAIL_SHARE = 0.2, 0.05
# Yaws from which an upright registration starts, the robust scales of its steps, how many of its results are registered
# finely, and the scales of that. Results whose poses differ by less count once.
_HEADINGS = 16
_COARSE_STEPS_M = tuple(np.geomspace(0.3, 0.08, 10).tolist())
_REFINED, _APART = 3, 0.1
_FINE_STEPS_M = (0.1, 0.09, 0.08, 0.07, 0.06, 0.05)
_MOST_POINTS = 150
# Largest lean. Maps with KISS-ICP's poses are tilted by up to 10 degrees, another way at every place.
_MOST_LEAN_DEG = 15.0
# Leaf size of the k-d trees; fastest for points near a surface.
_LEAF_POINTS = 32
# The grid of the nearest points reaches this far beyond a surface. Its cells are larger than the least size if there
# would be more of them.
_GRID_MARGIN_M, _GRID_CELL_M, _MOST_CELLS = 0.4, 0.05, 100_000


Place = tuple[float, float, float]
# The (G, 4, 4) poses that fit sources (G, N, 3) to goals (G, N, 3) with weights (G, N).
Fit = Callable[[Float64Array, Float64Array, Float64Array], Float64Array]


@dataclass(frozen=True, eq=False)
class Cloud:
    """An object's points, a thinned subset, and the target surface for its partner: its points and surroundings."""

    points: Float64Array
    few: Float64Array
    whole: Float64Array
    log_extents: Float64Array

    @classmethod
    def of(cls, points: Float64Array) -> Cloud:
        """Return the cloud of an object's points (P, 3), without surroundings."""
        return cls(points, _thin_to(points, _MOST_POINTS), points, _log_extents(points))

    def with_rest(self, rest: Float64Array) -> Cloud:
        """Return the cloud with its surroundings (R, 3) as a part of the target surface."""
        return replace(self, whole=np.concatenate([self.points, rest]))

    def nearest(self, places: Float64Array) -> Float64Array:
        """Return the (..., 3) nearest points of the target surface to (..., 3) places."""
        return np.asarray(self.whole[self._tree.query(places)[1]])

    def roughly_nearest(self, places: Float64Array) -> Float64Array:
        """Return what `nearest` does, off by up to a cell of a grid: much faster for many places."""
        return self.whole[self._grid.nearest(places)]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.whole, leafsize=_LEAF_POINTS)

    @cached_property
    def _grid(self) -> _NearestGrid:
        return _NearestGrid.around(self.whole)


@dataclass(frozen=True, slots=True, eq=False)
class _NearestGrid:
    """The index of the nearest of some points at each cell of a grid around them.

    Attributes:
        low: (3,) lowest corner, metres.
        cell_m: Edge of a cell, metres.
        owners: (X, Y, Z) index of the point nearest to each cell.
    """

    low: Float64Array
    cell_m: float
    owners: Int32Array

    @classmethod
    def around(cls, points: Float64Array) -> _NearestGrid:
        low = points.min(axis=0) - _GRID_MARGIN_M
        size_m = points.max(axis=0) + _GRID_MARGIN_M - low
        cell_m = max(_GRID_CELL_M, float(np.cbrt(size_m.prod() / _MOST_CELLS)))
        owners = np.full(tuple(np.floor(size_m / cell_m).astype(np.int64) + 1), -1, dtype=np.int32)
        owners[tuple(np.floor((points - low) / cell_m).astype(np.int64).T)] = np.arange(len(points))
        taken = distance_transform_edt(owners < 0, return_distances=False, return_indices=True)
        return cls(low, cell_m, owners[tuple(taken)])

    def nearest(self, places: Float64Array) -> Int32Array:
        """Return the (...) index of the nearest point to (..., 3) places."""
        cells = np.clip((places - self.low) / self.cell_m, 0, np.array(self.owners.shape) - 1).astype(np.int64)
        return np.asarray(self.owners[cells[..., 0], cells[..., 1], cells[..., 2]])


def drop_tails(points: Float64Array) -> Float64Array:
    """Return the (P, 3) points without the groups of a few points that lie apart; all where there is nothing else."""
    groups, sizes = label_groups(points, _TAIL_GAP_M)
    is_body = sizes[groups] >= _TAIL_SHARE * len(points)
    return points[is_body] if is_body.any() else points


def _thin_to(points: Float64Array, most: int) -> Float64Array:
    few, cell_m = points, _LIKE_WITHIN_M
    while len(few) > most:
        few = thin(points, cell_m)
        cell_m *= 1.2
    return few


def align(start: Cloud, end: Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, yaw and translation.

    The search starts from coinciding box centres and centroids of the objects, and from coinciding box centres of the
    objects with their surroundings.
    """
    middles = [*_middles(start, end), (_middle(start.whole), _middle(end.whole))]
    return _register(start, end, _guess_upright(list(dict.fromkeys(middles))), _upright_fit)


def align_leaning(start: Cloud, end: Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, yaw, translation and a lean.

    The search starts from coinciding box centres and from coinciding centroids of the objects.
    """
    return _register(start, end, _guess_upright(_middles(start, end)), _leaning_fit)


def _middles(start: Cloud, end: Cloud) -> list[tuple[Place, Place]]:
    """Return the centres of the boxes around both objects, and their centroids."""
    return [(_middle(start.points), _middle(end.points)), (_centroid(start.points), _centroid(end.points))]


def _guess_upright(middles: Sequence[tuple[Place, Place]]) -> list[Float64Array]:
    """Return the (4, 4) poses with each of the headings that move the first of two middles (3,) to the second."""
    turns = [yaw_pose(float(yaw_rad))[:3, :3] for yaw_rad in np.arange(_HEADINGS) * (2 * np.pi / _HEADINGS)]
    return [_turn_about(turn, *ends) for turn in turns for ends in middles]


def align_freely(start: Cloud, end: Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, any rotation; the search starts from principal axes."""
    start_axes, end_axes = _principal_axes(start.points), _principal_axes(end.points)
    turns = [end_axes @ turn @ start_axes.T for turn in Rotation.create_group("O").as_matrix()]
    middles = _centroid(start.points), _centroid(end.points)
    return _register(start, end, [_turn_about(turn, *middles) for turn in turns], _rigid_fit)


def _turn_about(turn: Float64Array, start_middle: ArrayLike, end_middle: ArrayLike) -> Float64Array:
    """Return the (4, 4) pose of a (3, 3) rotation that moves one middle to the other."""
    return make_pose(turn, np.subtract(end_middle, turn @ np.asarray(start_middle)))


def _principal_axes(points: Float64Array) -> Float64Array:
    """Return the (3, 3) right-handed axes of the covariance of (P, 3) points, one a column, the shortest first."""
    axes = np.linalg.eigh(np.cov(points.T))[1]
    return np.asarray(axes * (1.0, 1.0, np.sign(np.linalg.det(axes))))


def _register(start: Cloud, end: Cloud, guesses: Sequence[Float64Array], fit: Fit) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start by ICP from all guesses, roughly, then from the best."""
    poses = np.stack(guesses)
    for scale_m in _COARSE_STEPS_M:
        poses = _step(start, end, poses, scale_m, fit, Cloud.roughly_nearest)
    poses = _first_apart(poses[np.argsort(-_likeness(start, end, poses, Cloud.roughly_nearest), kind="stable")])
    for scale_m in _FINE_STEPS_M:
        poses = _step(start, end, poses, scale_m, fit, Cloud.nearest)
    likeness = _likeness(start, end, poses, Cloud.nearest)
    best = int(np.argmax(likeness))
    return float(likeness[best]), poses[best]


def _first_apart(poses: Float64Array) -> Float64Array:
    """Return the first of (G, 4, 4) poses, at most `_REFINED`, of those that came together the first alone."""
    apart = poses[:1]
    for pose in poses[1:]:
        if len(apart) < _REFINED and (np.abs(apart - pose).max(axis=(1, 2)) > _APART).all():
            apart = np.concatenate([apart, pose[None]])
    return apart


# The nearest points of the target surface of a cloud to (..., 3) places.
Lookup = Callable[[Cloud, Float64Array], Float64Array]


def _step(
    start: Cloud, end: Cloud, end_T_start: Float64Array, scale_m: float, fit: Fit, nearest: Lookup
) -> Float64Array:
    """Do one ICP step, both directions, with robust weights of the given scale; return the new (G, 4, 4) poses."""
    (far_m, there), (far_back_m, back) = _nearest(start.few, end.few, start, end, end_T_start, nearest)
    sources = np.concatenate([np.broadcast_to(start.few, there.shape), back], axis=1)
    goals = np.concatenate([there, np.broadcast_to(end.few, back.shape)], axis=1)
    weights = [_weights(far_m, scale_m) / len(start.few), _weights(far_back_m, scale_m) / len(end.few)]
    return fit(sources, goals, np.concatenate(weights, axis=1))


def _weights(distances_m: Float64Array, scale_m: float) -> Float64Array:
    return np.asarray(1.0 / (1.0 + (distances_m / scale_m) ** 2) ** 2)


def _upright_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the (G, 4, 4) poses, yaw and translation, of the weighted least-squares fit of sources to goals."""
    source, goal, spread = _centre(sources, goals, weights)
    yaw_rad = np.arctan2(spread[:, 1, 0] - spread[:, 0, 1], spread[:, 0, 0] + spread[:, 1, 1])
    return _about(Rotation.from_euler("z", yaw_rad[:, None]).as_matrix(), source, goal)


def _leaning_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the rigid fits if they lean by `_MOST_LEAN_DEG` at most, otherwise the upright ones.

    An odometry that drifts in roll and pitch tilts its map, and an object leans with the map of its place.
    """
    poses = _rigid_fit(sources, goals, weights)
    leans = poses[:, 2, 2] < np.cos(np.deg2rad(_MOST_LEAN_DEG))
    return np.where(leans[:, None, None], _upright_fit(sources, goals, weights), poses)


def _rigid_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the (G, 4, 4) poses of the weighted least-squares fit of sources to goals (Kabsch 1976)."""
    source, goal, spread = _centre(sources, goals, weights)
    u, _, v = np.linalg.svd(spread)
    signs = np.ones((len(u), 1, 3))
    signs[:, 0, 2] = np.sign(np.linalg.det(u @ v))
    return _about((u * signs) @ v, source, goal)


def _centre(
    sources: Float64Array, goals: Float64Array, weights: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the weighted means (G, 3) of both, and their (G, 3, 3) cross-covariance, goals by sources."""
    shares = (weights / weights.sum(axis=1, keepdims=True))[:, None]
    source, goal = shares @ sources, shares @ goals
    spread = np.swapaxes(goals - goal, 1, 2) @ ((sources - source) * np.swapaxes(shares, 1, 2))
    return source[:, 0], goal[:, 0], spread


def _about(turns: Float64Array, sources: Float64Array, goals: Float64Array) -> Float64Array:
    """Return the (G, 4, 4) poses with (G, 3, 3) rotations that move sources (G, 3) to goals (G, 3)."""
    return make_pose(turns, goals - (turns @ sources[..., None])[..., 0])


def _likeness(start: Cloud, end: Cloud, end_T_start: Float64Array, nearest: Lookup) -> Float64Array:
    """Return (G,) the mean of 1 / (1 + (d / 0.1 m)^2) over both directions; 1 for identical objects."""
    found = _nearest(start.few, end.few, start, end, end_T_start, nearest)
    return np.asarray(sum((1.0 / (1.0 + (far_m / _LIKE_WITHIN_M) ** 2)).mean(axis=1) for far_m, _ in found) / 2)


def measure_shares(start: Cloud, end: Cloud, end_T_start: Float64Array) -> tuple[float, float]:
    """Return the share of the points of either object within `_SAME_WITHIN_M` of the other's target surface."""
    (there_m, _), (back_m, _) = _nearest(start.points, end.points, start, end, end_T_start[None], Cloud.nearest)
    return float((there_m < _SAME_WITHIN_M).mean()), float((back_m < _SAME_WITHIN_M).mean())


def _nearest(
    of_start: Float64Array, of_end: Float64Array, start: Cloud, end: Cloud, end_T_start: Float64Array, nearest: Lookup
) -> tuple[tuple[Float64Array, Float64Array], tuple[Float64Array, Float64Array]]:
    """Return distance and nearest target point, from start to end and from end to start.

    For (G, 4, 4) poses and (N, 3) points these are (G, N), metres, and (G, N, 3), in the frame of the target.
    """
    there, back = _transform_all(end_T_start, of_start), _transform_all(invert(end_T_start), of_end)
    in_end, in_start = nearest(end, there), nearest(start, back)
    return (np.linalg.norm(there - in_end, axis=-1), in_end), (np.linalg.norm(back - in_start, axis=-1), in_start)


def _transform_all(poses: Float64Array, points: Float64Array) -> Float64Array:
    """Return the (G, N, 3) points (N, 3), moved by each of (G, 4, 4) poses."""
    return points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def _middle(points: Float64Array) -> Place:
    """Return the centre of the upright box around (P, 3) points."""
    x, y, z = upright_box(points)[0][:3, 3].tolist()
    return x, y, z


def _centroid(points: Float64Array) -> Place:
    x, y, z = points.mean(axis=0).tolist()
    return x, y, z


def _log_extents(points: Float64Array) -> Float64Array:
    """Return the (3,) logarithms of the sorted edges of the uniform box with the covariance of the (P, 3) points.

    They are invariant to rotation and, unlike a bounding box, robust against single points.
    """
    covariance = np.cov(points.T, bias=True) if len(points) > 1 else np.zeros((3, 3))
    return np.asarray(np.log(np.sqrt(12.0 * np.linalg.eigvalsh(covariance).clip(min=0.0)) + _LIKE_WITHIN_M / 2))
