"""Fit one object to another: clouds of points, and their registration by yaw, with a lean, or by any rotation.

Both directions count, and weights are robust, because the two sessions see an object from different sides. The search
is coarse from many guesses; the best of its results are registered finely.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose, transform, yaw_pose
from cdpipe.core.geometry.groups import label_groups
from cdpipe.core.geometry.voxel import thin
from cdpipe.extract.shape import upright_box

# Distance within which a point lies on the other surface, and scale of the likeness.
_SAME_WITHIN_M, _LIKE_WITHIN_M = 0.05, 0.1
# Tails: a beam that meets an edge also returns from behind it. Groups of points this far from the others are left out
# if they hold fewer of an object's points than this share. A registration starts from the centre of the box around
# the rest.
_TAIL_GAP_M, _TAIL_SHARE = 0.2, 0.05
# Yaws of the coarse registration, how many of its results are registered finely, and the robust scales of each.
_HEADINGS = 16
_REFINED, _REFINED_LEANING = 3, 6
_COARSE_STEPS_M = (0.3, 0.25, 0.2)
_FINE_STEPS_M = (0.15, 0.14, 0.13, 0.12, 0.11, 0.1, 0.08, 0.07, 0.06, 0.05)
_MOST_POINTS, _MOST_COARSE_POINTS = 150, 50
# Largest lean. Maps with KISS-ICP's poses are tilted by up to 10 degrees, another way at every place.
_MOST_LEAN_DEG = 15.0
# Leaf size of the k-d trees; fastest for points near a surface.
_LEAF_POINTS = 32


# The (4, 4) pose that fits sources (N, 3) to goals (N, 3) with weights (N,).
Fit = Callable[[Float64Array, Float64Array, Float64Array], Float64Array]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """An object's points, a thinned subset, and the target surface for its partner: its points and surroundings."""

    points: Float64Array
    few: Float64Array
    whole: Float64Array
    tree: cKDTree
    log_extents: Float64Array

    @classmethod
    def of(cls, points: Float64Array) -> Cloud:
        """Return the cloud of an object's points (P, 3), without surroundings."""
        return cls(points, _thin_to(points, _MOST_POINTS), points, _tree(points), _log_extents(points))

    def with_rest(self, rest: Float64Array) -> Cloud:
        """Return the cloud with its surroundings (R, 3) as a part of the target surface."""
        whole = np.concatenate([self.points, rest])
        return replace(self, whole=whole, tree=_tree(whole))

    def coarse(self) -> Cloud:
        """Return a thinner cloud with a thinner target for the coarse registration."""
        whole = thin(self.whole, _LIKE_WITHIN_M)
        return replace(self, few=_thin_to(self.few, _MOST_COARSE_POINTS), whole=whole, tree=_tree(whole))


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


def _tree(points: Float64Array) -> cKDTree:
    return cKDTree(points, leafsize=_LEAF_POINTS)


def align(start: Cloud, end: Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, yaw and translation.

    The search starts from coinciding box centres of the objects and from coinciding box centres of the objects with
    their surroundings.
    """
    middles = {(_middle(start.points), _middle(end.points)), (_middle(start.whole), _middle(end.whole))}
    return _register(start, end, _guess_upright(sorted(middles)), _upright_fit, _REFINED)


def align_leaning(start: Cloud, end: Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, yaw, translation and a lean.

    The search starts from coinciding box centres and from coinciding centroids of the objects.
    """
    middles = [(_middle(start.points), _middle(end.points)), (start.points.mean(axis=0), end.points.mean(axis=0))]
    return _register(start, end, _guess_upright(middles), _leaning_fit, _REFINED_LEANING)


def _guess_upright(middles: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[Float64Array]:
    """Return the (4, 4) poses with each of the headings that move the first of two middles (3,) to the second."""
    turns = [yaw_pose(float(yaw_rad))[:3, :3] for yaw_rad in np.arange(_HEADINGS) * (2 * np.pi / _HEADINGS)]
    return [_turn_about(turn, *ends) for turn in turns for ends in middles]


def align_freely(start: Cloud, end: Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, any rotation; the search starts from principal axes."""
    start_axes, end_axes = _principal_axes(start.points), _principal_axes(end.points)
    turns = [end_axes @ turn @ start_axes.T for turn in Rotation.create_group("O").as_matrix()]
    middles = start.points.mean(axis=0), end.points.mean(axis=0)
    return _register(start, end, [_turn_about(turn, *middles) for turn in turns], _rigid_fit, _REFINED)


def _turn_about(turn: Float64Array, start_middle: ArrayLike, end_middle: ArrayLike) -> Float64Array:
    """Return the (4, 4) pose of a (3, 3) rotation that moves one middle to the other."""
    return make_pose(turn, np.subtract(end_middle, turn @ np.asarray(start_middle)))


def _principal_axes(points: Float64Array) -> Float64Array:
    """Return the (3, 3) right-handed axes of the covariance of (P, 3) points, one a column, the shortest first."""
    axes = np.linalg.eigh(np.cov(points.T))[1]
    return np.asarray(axes * (1.0, 1.0, np.sign(np.linalg.det(axes))))


def _register(
    start: Cloud, end: Cloud, guesses: Sequence[Float64Array], fit: Fit, n_refined: int
) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start by ICP from several guesses, coarse, then the best finely."""
    coarse_start, coarse_end = start.coarse(), end.coarse()
    coarse = []
    for guess in guesses:
        pose = guess
        for scale_m in _COARSE_STEPS_M:
            pose = _step(coarse_start, coarse_end, pose, scale_m, fit)
        coarse.append((_likeness(coarse_start, coarse_end, pose), pose))
    coarse.sort(key=lambda item: -item[0])
    fine = []
    for _, guess in coarse[:n_refined]:
        pose = guess
        for scale_m in _FINE_STEPS_M:
            pose = _step(start, end, pose, scale_m, fit)
        fine.append((_likeness(start, end, pose), pose))
    return max(fine, key=lambda item: item[0])


def _step(start: Cloud, end: Cloud, end_T_start: Float64Array, scale_m: float, fit: Fit) -> Float64Array:
    """Do one ICP step, both directions, with robust weights of the given scale; return the new (4, 4) end_T_start."""
    (far_m, in_end), (far_back_m, in_start) = _nearest(start.few, end.few, start, end, end_T_start)
    weights = np.concatenate([_weights(far_m, scale_m) / len(start.few), _weights(far_back_m, scale_m) / len(end.few)])
    sources = np.concatenate([start.few, start.whole[in_start]])
    goals = np.concatenate([end.whole[in_end], end.few])
    return fit(sources, goals, weights)


def _weights(distances_m: Float64Array, scale_m: float) -> Float64Array:
    return np.asarray(1.0 / (1.0 + (distances_m / scale_m) ** 2) ** 2)


def _upright_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the (4, 4) pose, yaw and translation, of the weighted least-squares fit of sources to goals, (N, 3)."""
    shares = weights / weights.sum()
    source, goal = shares @ sources, shares @ goals
    a, b = (sources - source)[:, :2] * shares[:, None], (goals - goal)[:, :2]
    yaw_rad = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return make_pose(turn, goal - turn @ source)


def _leaning_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the rigid fit if it leans by `_MOST_LEAN_DEG` at most, otherwise the upright one.

    An odometry that drifts in roll and pitch tilts its map, and an object leans with the map of its place.
    """
    pose = _rigid_fit(sources, goals, weights)
    return pose if pose[2, 2] >= np.cos(np.deg2rad(_MOST_LEAN_DEG)) else _upright_fit(sources, goals, weights)


def _rigid_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the (4, 4) pose of the weighted least-squares fit of sources to goals, (N, 3) (Kabsch 1976)."""
    shares = weights / weights.sum()
    source, goal = shares @ sources, shares @ goals
    u, _, v = np.linalg.svd((goals - goal).T @ ((sources - source) * shares[:, None]))
    turn = (u * (1.0, 1.0, np.sign(np.linalg.det(u @ v)))) @ v
    return make_pose(turn, goal - turn @ source)


def _likeness(start: Cloud, end: Cloud, end_T_start: Float64Array) -> float:
    """Return the mean of 1 / (1 + (d / 0.1 m)^2) over both directions; 1 for identical objects."""
    found = _nearest(start.few, end.few, start, end, end_T_start)
    return sum(float((1.0 / (1.0 + (far_m / _LIKE_WITHIN_M) ** 2)).mean()) for far_m, _ in found) / 2


def measure_shares(start: Cloud, end: Cloud, end_T_start: Float64Array) -> tuple[float, float]:
    """Return the share of the points of either object within `_SAME_WITHIN_M` of the other's target surface."""
    (there_m, _), (back_m, _) = _nearest(start.points, end.points, start, end, end_T_start)
    return float((there_m < _SAME_WITHIN_M).mean()), float((back_m < _SAME_WITHIN_M).mean())


def _nearest(
    of_start: Float64Array, of_end: Float64Array, start: Cloud, end: Cloud, end_T_start: Float64Array
) -> tuple[tuple[Float64Array, Int64Array], tuple[Float64Array, Int64Array]]:
    """Return distance and index of the nearest target point, from start to end and from end to start."""
    there = end.tree.query(transform(end_T_start, of_start))
    back = start.tree.query(transform(invert(end_T_start), of_end))
    return (np.asarray(there[0]), np.asarray(there[1])), (np.asarray(back[0]), np.asarray(back[1]))


def _middle(points: Float64Array) -> tuple[float, float, float]:
    """Return the centre of the upright box around (P, 3) points."""
    x, y, z = upright_box(points)[0][:3, 3].tolist()
    return x, y, z


def _log_extents(points: Float64Array) -> Float64Array:
    """Return the (3,) logarithms of the sorted edges of the uniform box with the covariance of the (P, 3) points.

    They are invariant to rotation and, unlike a bounding box, robust against single points.
    """
    covariance = np.cov(points.T, bias=True) if len(points) > 1 else np.zeros((3, 3))
    return np.asarray(np.log(np.sqrt(12.0 * np.linalg.eigvalsh(covariance).clip(min=0.0)) + _LIKE_WITHIN_M / 2))
