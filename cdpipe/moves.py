"""Which removed and which added object are one and the same, moved: those that fit onto each other.

Each is seen from where its session drove by, so that neither the centres nor the edges of two halves of a move agree.
What agrees is surface: the one is turned about the vertical and shifted until it lies on the other, and the share of
both that does so is their likeness. The same fit tells how far the object went.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from cdpipe.geometry import Float64Array, Int64Array, invert, make_pose, transform, yaw_pose
from cdpipe.shape import upright_box
from cdpipe.voxel import thinned

# An object that went far shows the same faces but for what is hidden: so large a share of both must lie within
# `_SAME_WITHIN_M` of the other, and the extents must agree within so large a factor. On validation pairs that holds for
# 21 of 21 moves, for a tenth of 638 pairs of objects of other kinds and half of 322 of the same: two barrels are alike.
_SAME_SHARE, _FAR_FACTOR = 0.55, 1.45
_SAME_WITHIN_M = 0.05
# Of one that moved by less than its own length only what sticks out of the other place was found: a softer likeness,
# and extents count less. Found on 10 such moves, with up to a fifth of each one's cells left out and as many wrong in.
_LIKENESS, _NEAR_FACTOR = 0.45, 1.6
_MISFIT_WEIGHT = 0.3
_LIKE_WITHIN_M = 0.1
_MIN_POINTS = 4
# A whole-map rival may cut out a hundred objects; a fit takes some 30 ms.
_MOST_TRIED = 6
# A coarse fit from each of so many headings, a fine one from the best of them.
_HEADINGS = 16
_REFINED = 3
_COARSE_STEPS_M = (0.3, 0.25, 0.2)
_FINE_STEPS_M = (0.15, 0.14, 0.13, 0.12, 0.11, 0.1, 0.08, 0.07, 0.06, 0.05)
_MOST_POINTS = 150
# A metre takes a hundredth off what two objects are too much alike: it decides between equals only.
_TIE_PER_M = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """One object that stands elsewhere.

    Attributes:
        removed: Index of the object of the before session.
        added: Index of the object of the after session.
        displacement_map: (3,) from where it stood to where it stands, map frame, metres.
    """

    removed: int
    added: int
    displacement_map: Float64Array


def find_moves(
    removed: Sequence[Float64Array], added: Sequence[Float64Array], may_go_far: Sequence[bool]
) -> list[Move]:
    """Pair removed with added objects that look like one, each in at most one pair.

    All pairs together exceed the likeness that is asked for by as much as they can. Two may be one where their extents
    agree within a factor and enough of their surfaces lies on each other. Where an object moved by less than its own
    length, only what stuck out of the other place was found, so less is asked for. Of equally like ones the nearer is
    taken.

    Args:
        removed: Points (P, 3) of each object of the before session, map frame, metres.
        added: The same of the after session.
        may_go_far: Whether each of the removed may have gone farther than its own length.
    """
    gone, come = [_Cloud.of(points) for points in removed], [_Cloud.of(points) for points in added]
    gain = np.zeros((len(gone), len(come)))
    moves: dict[tuple[int, int], Move] = {}
    for r, start in enumerate(gone):
        for a, pair in _likely(start, come, may_go_far[r]):
            found = _one_object(start, come[a], pair)
            if found is not None:
                gain[r, a], shift = found
                moves[r, a] = Move(r, a, shift)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return [moves[r, a] for r, a in zip(rows.tolist(), columns.tolist(), strict=True) if (r, a) in moves]


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """An object's points, a thinned choice of them, and trees of both."""

    points: Float64Array
    few: Float64Array
    tree: cKDTree
    few_tree: cKDTree
    log_extents: Float64Array
    centre: Float64Array
    length_m: float

    @classmethod
    def of(cls, points: Float64Array) -> _Cloud:
        few, cell_m = points, _LIKE_WITHIN_M
        while len(few) > _MOST_POINTS:
            few = thinned(points, cell_m)
            cell_m *= 1.2
        map_T_box, box_m = upright_box(points)
        log_extents = np.log(_extents_m(points) + _LIKE_WITHIN_M / 2)
        return cls(points, few, cKDTree(points), cKDTree(few), log_extents, map_T_box[:3, 3], float(box_m[0]))


class _Pair(NamedTuple):
    """How far apart two objects are, level, by how much their extents differ at most (log), whether that is near."""

    distance_m: float
    misfit: float
    is_near: bool


def _likely(start: _Cloud, come: Sequence[_Cloud], may_go_far: bool) -> list[tuple[int, _Pair]]:
    """Return the objects that one may have become: those near, then those of its extents, no more than are tried."""
    pairs = []
    for a, end in enumerate(come):
        distance_m = float(np.linalg.norm(end.centre[:2] - start.centre[:2]))
        misfit = float(np.abs(start.log_extents - end.log_extents).max())
        is_near = distance_m < max(start.length_m, end.length_m)
        size_factor = _NEAR_FACTOR if is_near else _FAR_FACTOR
        if min(len(start.points), len(end.points)) >= _MIN_POINTS and misfit <= np.log(size_factor):
            pairs.append((a, _Pair(distance_m, misfit, is_near)))
    allowed = [(a, pair) for a, pair in pairs if pair.is_near or may_go_far]
    return sorted(allowed, key=lambda item: (not item[1].is_near, item[1].misfit))[:_MOST_TRIED]


def _one_object(start: _Cloud, end: _Cloud, pair: _Pair) -> tuple[float, Float64Array] | None:
    """Return by how much two objects are more alike than they need to be, and the displacement; None if they are not.

    The displacement is that of the middle of the upright box around both, laid on each other.
    """
    likeness, end_T_start = _laid_on(start, end)
    if pair.is_near:
        excess = likeness - _MISFIT_WEIGHT * pair.misfit - _LIKENESS
    else:
        excess = likeness * (_shared(start, end, end_T_start) - _SAME_SHARE)  # of two that share all, the liker one
    if excess <= 0.0:
        return None
    together = np.concatenate([start.points, transform(invert(end_T_start), end.points)])
    centre = upright_box(together)[0][:3, 3]
    shift = transform(end_T_start, centre[None])[0] - centre
    return excess / (1.0 + _TIE_PER_M * pair.distance_m), shift


def _laid_on(start: _Cloud, end: _Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and the pose (4, 4), a turn about the vertical and a shift, that reaches it."""
    coarse = []
    for yaw_rad in np.arange(_HEADINGS) * (2 * np.pi / _HEADINGS):
        turn = yaw_pose(float(yaw_rad))
        guess = make_pose(turn[:3, :3], end.centre - transform(turn, start.centre[None])[0])
        for scale_m in _COARSE_STEPS_M:
            guess = _step(start.few, start.few_tree, end.few, end.few_tree, guess, scale_m, (start.few, end.few))
        coarse.append((_likeness(start.few, start.few_tree, end.few, end.few_tree, guess), guess))
    coarse.sort(key=lambda item: -item[0])
    fine = []
    for _, guess in coarse[:_REFINED]:
        pose = guess
        for scale_m in _FINE_STEPS_M:
            pose = _step(start.few, start.tree, end.few, end.tree, pose, scale_m, (start.points, end.points))
        fine.append((_likeness(start.few, start.tree, end.few, end.tree, pose), pose))
    return max(fine, key=lambda item: item[0])


def _step(
    start: Float64Array,
    start_tree: cKDTree,
    end: Float64Array,
    end_tree: cKDTree,
    end_T_start: Float64Array,
    scale_m: float,
    targets: tuple[Float64Array, Float64Array],
) -> Float64Array:
    """Lay each point on its nearest in the other cloud, in both directions; what is far beyond the scale hardly counts.

    The trees are of the targets.
    """
    (far_m, in_end), (far_back_m, in_start) = _nearest(start, start_tree, end, end_tree, end_T_start)
    weights = np.concatenate([_weights(far_m, scale_m) / len(start), _weights(far_back_m, scale_m) / len(end)])
    sources = np.concatenate([start, targets[0][in_start]])
    goals = np.concatenate([targets[1][in_end], end])
    return _upright_fit(sources, goals, weights)


def _weights(distances_m: Float64Array, scale_m: float) -> Float64Array:
    return np.asarray(1.0 / (1.0 + (distances_m / scale_m) ** 2) ** 2)


def _upright_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the pose (4, 4), a turn about the vertical and a shift, with the least weighted squared distances."""
    shares = weights / weights.sum()
    source, goal = shares @ sources, shares @ goals
    a, b = (sources - source)[:, :2] * shares[:, None], (goals - goal)[:, :2]
    yaw_rad = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turn = yaw_pose(float(yaw_rad))
    return make_pose(turn[:3, :3], goal - transform(turn, source[None])[0])


def _likeness(
    start: Float64Array, start_tree: cKDTree, end: Float64Array, end_tree: cKDTree, end_T_start: Float64Array
) -> float:
    """Return the share of both objects that lies on the other, softly cut off; 1 for two copies."""
    found = _nearest(start, start_tree, end, end_tree, end_T_start)
    return sum(float((1.0 / (1.0 + (far_m / _LIKE_WITHIN_M) ** 2)).mean()) for far_m, _ in found) / 2


def _shared(start: _Cloud, end: _Cloud, end_T_start: Float64Array) -> float:
    """Return the share of both objects, whole, that lies within `_SAME_WITHIN_M` of the other."""
    found = _nearest(start.points, start.tree, end.points, end.tree, end_T_start)
    return sum(float((far_m < _SAME_WITHIN_M).mean()) for far_m, _ in found) / 2


def _nearest(
    start: Float64Array, start_tree: cKDTree, end: Float64Array, end_tree: cKDTree, end_T_start: Float64Array
) -> tuple[tuple[Float64Array, Int64Array], tuple[Float64Array, Int64Array]]:
    """Return the distance to the nearest target and its index, of each point of the one cloud and of the other."""
    there = end_tree.query(transform(end_T_start, start))
    back = start_tree.query(transform(invert(end_T_start), end))
    return (np.asarray(there[0]), np.asarray(there[1])), (np.asarray(back[0]), np.asarray(back[1]))


def _extents_m(points: Float64Array) -> Float64Array:
    """Return the sorted edges (3,) of the evenly filled box with the same spread as the points.

    Unlike the edges of the bounding box they do not change when the object is turned, nor with a stray point.
    """
    covariance = np.cov(points.T, bias=True) if len(points) > 1 else np.zeros((3, 3))
    return np.sqrt(12.0 * np.linalg.eigvalsh(covariance).clip(min=0.0))
