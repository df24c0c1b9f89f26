"""Which removed and which added object are one and the same, moved: those that fit onto each other.

Each is seen from where its session drove by, so that neither the centres nor the edges of two halves of a move agree.
What agrees is surface: the one is turned about the vertical and shifted until it lies on the other, and the share of
both that does so tells whether they are one. The same fit tells how far the object went.

Of an object that moved by less than its own length, only what sticks out of the other place was cut out: two strips
that need not be alike. The rest of it seems to have stayed, and is part of what else stands around them. So what was
removed is laid on all that the after session has there, and what was added on all that the before session has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose, transform, yaw_pose
from cdpipe.core.voxel import thin
from cdpipe.extract.shape import upright_box

# An object that went far shows the same faces but for what is hidden: so large a share of both must lie within
# `_SAME_WITHIN_M` of the other, and the extents must agree within so large a factor. On validation pairs that holds for
# 21 of 21 moves, for a tenth of 638 pairs of objects of other kinds and half of 322 of the same: two barrels are alike.
_SAME_SHARE, _FAR_FACTOR = 0.55, 1.45
_SAME_WITHIN_M = 0.05
# Of two that stand so near, what else stands around may belong to either. On validation pairs, some of them full of
# short moves, 53 of 54 moves then share 0.46 and more with a likeness of 0.68 and more; neighbours of other kinds share
# less than 0.4, or one of them next to nothing, or are hardly alike.
_BESIDE_M = 1.5
_BESIDE_SHARE, _EITHER_SHARE = 0.4, 0.2
_LIKENESS = 0.62
_LIKE_WITHIN_M = 0.1
_MIN_POINTS = 4
# A whole-map rival may cut out a hundred objects; a fit takes some 20 ms.
_MOST_TRIED = 6
# A coarse fit from each of so many headings, a fine one from the best of them.
_HEADINGS = 16
_REFINED = 3
_COARSE_STEPS_M = (0.3, 0.25, 0.2)
_FINE_STEPS_M = (0.15, 0.14, 0.13, 0.12, 0.11, 0.1, 0.08, 0.07, 0.06, 0.05)
_MOST_POINTS, _MOST_COARSE_POINTS = 150, 50
# Half as long for points beside the surface as with the library's own choice.
_LEAF_POINTS = 32
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
    removed: Sequence[Float64Array],
    added: Sequence[Float64Array],
    may_go_far: Sequence[bool],
    around: Callable[[Sequence[tuple[int, int]]], Sequence[tuple[Float64Array, Float64Array]]],
) -> list[Move]:
    """Pair removed with added objects that look like one, each in at most one pair.

    Two may be one where enough of their surfaces lies on each other, and, unless they stand beside each other, their
    extents agree within a factor. All pairs together exceed what is asked for by as many points as they can; of equally
    like ones the nearer is taken.

    Args:
        removed: Points (P, 3) of each object of the before session, map frame, metres.
        added: The same of the after session.
        may_go_far: Whether each of the removed may stand elsewhere than beside where it stood.
        around: Gives, for pairs (removed, added) of neighbours, the points (Q, 3) and (R, 3) that the before and the
            after session have around the two, without the ground; those of the objects themselves may be among them.
    """
    gone, come = [_Cloud.of(points) for points in removed], [_Cloud.of(points) for points in added]
    beside = [(r, a) for r, start in enumerate(gone) for a in _neighbours(start, come)]
    gain = np.zeros((len(gone), len(come)))
    moves: dict[tuple[int, int], Move] = {}

    def note(r: int, a: int, found: tuple[float, Float64Array] | None) -> None:
        if found is not None:
            gain[r, a], shift = found
            moves[r, a] = Move(r, a, shift)

    for (r, a), (before, after) in zip(beside, around(beside), strict=True):
        note(r, a, _match_pair(gone[r].with_rest(before), come[a].with_rest(after), _BESIDE_SHARE))
    for r, start in enumerate(gone):
        for a in _similar(start, come) if may_go_far[r] else ():
            if (r, a) not in beside:
                note(r, a, _match_pair(start, come[a], _SAME_SHARE))
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return [moves[r, a] for r, a in zip(rows.tolist(), columns.tolist(), strict=True) if (r, a) in moves]


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """An object's points, a thinned choice of them, and what the other one may lie on: its points and a rest."""

    points: Float64Array
    few: Float64Array
    whole: Float64Array
    tree: cKDTree
    log_extents: Float64Array

    @classmethod
    def of(cls, points: Float64Array) -> _Cloud:
        return cls(points, _thin_to(points, _MOST_POINTS), points, _tree(points), _log_extents(points))

    def with_rest(self, rest: Float64Array) -> _Cloud:
        whole = np.concatenate([self.points, rest])
        return replace(self, whole=whole, tree=_tree(whole))

    def coarse(self) -> _Cloud:
        """Return fewer points, to lie on fewer: for a first guess in a quarter of the time."""
        whole = thin(self.whole, _LIKE_WITHIN_M)
        return replace(self, few=_thin_to(self.few, _MOST_COARSE_POINTS), whole=whole, tree=_tree(whole))


def _thin_to(points: Float64Array, most: int) -> Float64Array:
    few, cell_m = points, _LIKE_WITHIN_M
    while len(few) > most:
        few = thin(points, cell_m)
        cell_m *= 1.2
    return few


def _tree(points: Float64Array) -> cKDTree:
    return cKDTree(points, leafsize=_LEAF_POINTS)


def _neighbours(start: _Cloud, come: Sequence[_Cloud]) -> list[int]:
    """Return the objects that stand beside one, the nearest first, no more than are tried."""
    tree = cKDTree(start.few[:, :2])
    gaps_m = [float(np.min(tree.query(end.few[:, :2])[0])) for end in come]
    order = sorted(range(len(come)), key=lambda a: gaps_m[a])
    return [a for a in order if gaps_m[a] < _BESIDE_M][:_MOST_TRIED]


def _similar(start: _Cloud, come: Sequence[_Cloud]) -> list[int]:
    """Return the objects that one may have become somewhere else: those of its extents, no more than are tried."""
    misfits = [float(np.abs(start.log_extents - end.log_extents).max()) for end in come]
    order = sorted(range(len(come)), key=lambda a: misfits[a])
    return [a for a in order if misfits[a] <= np.log(_FAR_FACTOR)][:_MOST_TRIED]


def _match_pair(start: _Cloud, end: _Cloud, least_share: float) -> tuple[float, Float64Array] | None:
    """Return how many points more than they need to two objects share, and the displacement; None if too few.

    The displacement is that of the middle of the upright box around both, laid on each other.
    """
    if min(len(start.points), len(end.points)) < _MIN_POINTS:
        return None
    likeness, end_T_start = _align(start, end)
    shares = _shares(start, end, end_T_start)
    excess = likeness * (sum(shares) / 2 - least_share)  # of two that share all, the liker one
    if excess <= 0.0 or min(shares) < _EITHER_SHARE or likeness < _LIKENESS:
        return None
    together = np.concatenate([start.points, transform(invert(end_T_start), end.points)])
    centre = upright_box(together)[0][:3, 3]
    shift = transform(end_T_start, centre[None])[0] - centre
    distance_m = float(np.linalg.norm(shift[:2]))
    return excess * min(len(start.points), len(end.points)) / (1.0 + _TIE_PER_M * distance_m), shift


def _align(start: _Cloud, end: _Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and the pose (4, 4), a turn about the vertical and a shift, that reaches it.

    The search begins with the middles of both objects on each other and, as those of two strips do not belong there,
    with the middles of all that stands around them.
    """
    middles = {(_middle(start.points), _middle(end.points)), (_middle(start.whole), _middle(end.whole))}
    coarse_start, coarse_end = start.coarse(), end.coarse()
    coarse = []
    for yaw_rad in np.arange(_HEADINGS) * (2 * np.pi / _HEADINGS):
        turn = yaw_pose(float(yaw_rad))
        for start_middle, end_middle in sorted(middles):
            guess = make_pose(turn[:3, :3], np.subtract(end_middle, transform(turn, np.array([start_middle]))[0]))
            for scale_m in _COARSE_STEPS_M:
                guess = _step(coarse_start, coarse_end, guess, scale_m)
            coarse.append((_likeness(coarse_start, coarse_end, guess), guess))
    coarse.sort(key=lambda item: -item[0])
    fine = []
    for _, guess in coarse[:_REFINED]:
        pose = guess
        for scale_m in _FINE_STEPS_M:
            pose = _step(start, end, pose, scale_m)
        fine.append((_likeness(start, end, pose), pose))
    return max(fine, key=lambda item: item[0])


def _step(start: _Cloud, end: _Cloud, end_T_start: Float64Array, scale_m: float) -> Float64Array:
    """Lay each point on its nearest in the other cloud, both ways; what is far beyond the scale hardly counts."""
    (far_m, in_end), (far_back_m, in_start) = _nearest(start.few, end.few, start, end, end_T_start)
    weights = np.concatenate([_weights(far_m, scale_m) / len(start.few), _weights(far_back_m, scale_m) / len(end.few)])
    sources = np.concatenate([start.few, start.whole[in_start]])
    goals = np.concatenate([end.whole[in_end], end.few])
    return _upright_fit(sources, goals, weights)


def _weights(distances_m: Float64Array, scale_m: float) -> Float64Array:
    return np.asarray(1.0 / (1.0 + (distances_m / scale_m) ** 2) ** 2)


def _upright_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the pose (4, 4), a turn about the vertical and a shift, with the least weighted squared distances."""
    shares = weights / weights.sum()
    source, goal = shares @ sources, shares @ goals
    a, b = (sources - source)[:, :2] * shares[:, None], (goals - goal)[:, :2]
    yaw_rad = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return make_pose(turn, goal - turn @ source)


def _likeness(start: _Cloud, end: _Cloud, end_T_start: Float64Array) -> float:
    """Return the share of both objects that lies on the other, softly cut off; 1 for two copies."""
    found = _nearest(start.few, end.few, start, end, end_T_start)
    return sum(float((1.0 / (1.0 + (far_m / _LIKE_WITHIN_M) ** 2)).mean()) for far_m, _ in found) / 2


def _shares(start: _Cloud, end: _Cloud, end_T_start: Float64Array) -> tuple[float, float]:
    """Return the share of either object, all its points, that lies within `_SAME_WITHIN_M` of the other."""
    (there_m, _), (back_m, _) = _nearest(start.points, end.points, start, end, end_T_start)
    return float((there_m < _SAME_WITHIN_M).mean()), float((back_m < _SAME_WITHIN_M).mean())


def _nearest(
    of_start: Float64Array, of_end: Float64Array, start: _Cloud, end: _Cloud, end_T_start: Float64Array
) -> tuple[tuple[Float64Array, Int64Array], tuple[Float64Array, Int64Array]]:
    """Return how far points of the one are from the whole other and the index of the nearest there; and the reverse."""
    there = end.tree.query(transform(end_T_start, of_start))
    back = start.tree.query(transform(invert(end_T_start), of_end))
    return (np.asarray(there[0]), np.asarray(there[1])), (np.asarray(back[0]), np.asarray(back[1]))


def _middle(points: Float64Array) -> tuple[float, float, float]:
    """Return the middle of the upright box around (P, 3) points."""
    x, y, z = upright_box(points)[0][:3, 3].tolist()
    return x, y, z


def _log_extents(points: Float64Array) -> Float64Array:
    """Return the logarithms (3,) of the sorted edges of the evenly filled box with the same spread as the points.

    Unlike the edges of the bounding box they do not change when the object is turned, nor with a stray point.
    """
    covariance = np.cov(points.T, bias=True) if len(points) > 1 else np.zeros((3, 3))
    return np.asarray(np.log(np.sqrt(12.0 * np.linalg.eigvalsh(covariance).clip(min=0.0)) + _LIKE_WITHIN_M / 2))
