"""Moved objects: match a removed with an added object if their surfaces can be registered.

The two sessions see an object from different sides, so centres and edges do not agree; surfaces do. A removed object is
registered with an added one by yaw and translation, and where that fails by any rotation, because an object may lie
where it stood. The share of both surfaces that then coincides decides whether they are one object; the registration
gives the displacement.

If an object moved by less than its own length, only two strips of it were extracted, and these need not be similar. The
overlap of both poses appears unchanged and is part of the surroundings. Neighbouring objects are therefore registered
together with the surroundings of the other session.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, Int64Array, invert, make_pose, transform, yaw_pose
from cdpipe.core.groups import label_groups
from cdpipe.core.voxel import thin
from cdpipe.extract.shape import upright_box

# Far moves: least share of both surfaces within `_SAME_WITHIN_M` of the other, and largest factor between extents.
# On validation pairs 21 of 21 moves pass, 10 % of 638 pairs of different kinds, 50 % of 322 pairs of the same kind.
_SAME_SHARE, _FAR_FACTOR = 0.55, 1.45
_SAME_WITHIN_M = 0.05
# Near moves, with the surroundings: largest gap, least mean share, least share of either, least likeness. On validation
# pairs 53 of 54 moves have a share of at least 0.46 and a likeness of at least 0.68.
_BESIDE_M = 1.5
_BESIDE_SHARE, _EITHER_SHARE = 0.4, 0.2
_LIKENESS = 0.62
_LIKE_WITHIN_M = 0.1
# Tipped objects, which may turn in any way: least mean share and least likeness.
_TIPPED_SHARE, _TIPPED_LIKENESS = 0.65, 0.72
_MIN_POINTS = 4
# Tails: a beam that meets an edge also returns from behind it. Groups of points this far from the others are left out
# if they hold fewer of an object's points than this share. A registration starts from the centre of the box around
# the rest.
_TAIL_GAP_M, _TAIL_SHARE = 0.2, 0.05
# Largest number of partners to try for one object; a registration takes about 20 ms.
_MOST_TRIED = 6
# Yaws of the coarse registration, how many of its results are registered finely, and the robust scales of each.
_HEADINGS = 16
_REFINED = 3
_COARSE_STEPS_M = (0.3, 0.25, 0.2)
_FINE_STEPS_M = (0.15, 0.14, 0.13, 0.12, 0.11, 0.1, 0.08, 0.07, 0.06, 0.05)
_MOST_POINTS, _MOST_COARSE_POINTS = 150, 50
# Leaf size of the k-d trees; fastest for points near a surface.
_LEAF_POINTS = 32
# Penalty of the score per metre of displacement, and the one with which twins (below) are told apart.
_TIE_PER_M, _TWIN_TIE_PER_M = 0.01, 0.1
# Twins, objects that may be of one shape: least likeness, and largest factor between extents. In worlds of equal
# barrels, crates and chairs (validation seeds) pairs of equal props have a likeness of at least 0.79 and, where one was
# seen in part, a factor of up to 1.36; the likeness of pairs of different kinds is below 0.68.
_TWIN_LIKENESS, _TWIN_FACTOR = 0.77, 1.45


# The (4, 4) pose that fits sources (N, 3) to goals (N, 3) with weights (N,).
Fit = Callable[[Float64Array, Float64Array, Float64Array], Float64Array]


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A removed and an added object that are the same object.

    Attributes:
        removed: Index of the object of the before session.
        added: Index of the object of the after session.
        displacement_map: (3,) displacement from before to after, map frame, metres.
    """

    removed: int
    added: int
    displacement_map: Float64Array


def find_moves(
    removed: Sequence[Float64Array],
    added: Sequence[Float64Array],
    around: Callable[[Sequence[tuple[int, int]]], Sequence[tuple[Float64Array, Float64Array]]],
    *,
    nearest_twins: bool = True,
) -> list[Move]:
    """Match removed with added objects by their surfaces, one to one, so that the total score is largest.

    The score of a pair is its number of matching points, less for a longer way. The number of points of an object
    depends on the place from which it was seen. So all pairs of a group of twins, objects that may be of one shape,
    have the mean number, and fit and way decide between them.

    Args:
        removed: Points (P, 3) of each object of the before session, map frame, metres.
        added: The same of the after session.
        around: Returns, for pairs (removed, added) of neighbours, the points (Q, 3) and (R, 3) above the ground that
            the before and the after session have around both objects; the objects' own points may be included.
        nearest_twins: Whether tails are left out, twins are told apart by fit and way, and an object may have been
            tipped on its way; otherwise all points of every pair count, as for objects cut out by whole map points.
    """
    kept = _without_tails if nearest_twins else np.asarray
    gone, come = ([_Cloud.of(kept(points)) for points in objects] for objects in (removed, added))
    boxes = np.array([_box_xy(end) for end in come]).reshape(-1, 2, 2)
    extents = np.array([end.log_extents for end in come]).reshape(-1, 3)
    beside = [(r, a) for r, start in enumerate(gone) for a in _neighbours(start, come, boxes)]
    found: dict[tuple[int, int], _Match | None] = {}
    for (r, a), (before, after) in zip(beside, around(beside), strict=True):
        found[r, a] = _match_pair(gone[r].with_rest(before), come[a].with_rest(after), _BESIDE_SHARE)
    for r, start in enumerate(gone):
        for a in _partners_elsewhere(start, come, extents, nearest_twins):
            if (r, a) not in found:
                found[r, a] = _match_pair(start, come[a], _SAME_SHARE)
                if found[r, a] is None and nearest_twins:  # strips of neighbours would fit in some way
                    found[r, a] = _match_tipped(start, come[a])
    matches = {pair: match for pair, match in found.items() if match is not None}
    if nearest_twins:
        matches = _equalise_twins(matches, gone, come)
    tie_per_m = _TWIN_TIE_PER_M if nearest_twins else _TIE_PER_M
    gain = np.zeros((len(gone), len(come)))
    for pair, match in matches.items():
        gain[pair] = match.points / (1.0 + tie_per_m * float(np.linalg.norm(match.shift_map[:2])))
    pairs = zip(*(each.tolist() for each in linear_sum_assignment(gain, maximize=True)), strict=True)
    return [Move(r, a, matches[r, a].shift_map) for r, a in pairs if (r, a) in matches]


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """A registered pair.

    Attributes:
        points: Score of the pair without its way, in points.
        likeness: 1 for identical objects.
        share: The larger share of a surface on the other. If an object was seen sparsely in one session, its points
            still lie on the surface of the other.
        shift_map: (3,) displacement, metres.
    """

    points: float
    likeness: float
    share: float
    shift_map: Float64Array

    @property
    def fit(self) -> float:
        return self.likeness * self.share


def _equalise_twins(
    matches: Mapping[tuple[int, int], _Match], gone: Sequence[_Cloud], come: Sequence[_Cloud]
) -> dict[tuple[int, int], _Match]:
    """Return the matches; the points of pairs of twins are the mean of their group, more for a better fit.

    A group is a connected component of the pairs whose objects may be of one shape.
    """
    twins = [
        (r, a)
        for (r, a), match in matches.items()
        if match.likeness >= _TWIN_LIKENESS
        and np.abs(gone[r].log_extents - come[a].log_extents).max() <= np.log(_TWIN_FACTOR)
    ]
    ends = np.array(twins, dtype=np.int64).reshape(-1, 2).T
    n_objects = len(gone) + len(come)
    edges = coo_matrix((np.ones(len(twins)), (ends[0], len(gone) + ends[1])), (n_objects, n_objects))
    label = connected_components(edges, directed=False)[1]
    groups: dict[int, list[tuple[int, int]]] = {}
    for r, a in twins:
        groups.setdefault(int(label[r]), []).append((r, a))
    equal = dict(matches)
    for pairs in groups.values():
        points_per_fit = sum(matches[pair].points for pair in pairs) / sum(matches[pair].fit for pair in pairs)
        equal |= {pair: replace(matches[pair], points=points_per_fit * matches[pair].fit) for pair in pairs}
    return equal


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """An object's points, a thinned subset, and the target surface for its partner: its points and surroundings."""

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
        """Return a thinner cloud with a thinner target for the coarse registration."""
        whole = thin(self.whole, _LIKE_WITHIN_M)
        return replace(self, few=_thin_to(self.few, _MOST_COARSE_POINTS), whole=whole, tree=_tree(whole))


def _without_tails(points: Float64Array) -> Float64Array:
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


def _box_xy(cloud: _Cloud) -> tuple[Float64Array, Float64Array]:
    """Return the lower and the upper corner, (2,) each, of the upright box along x and y around an object."""
    return cloud.few[:, :2].min(axis=0), cloud.few[:, :2].max(axis=0)


def _neighbours(start: _Cloud, come: Sequence[_Cloud], boxes: Float64Array) -> list[int]:
    """Return the indices of the neighbouring objects, nearest first, at most `_MOST_TRIED`.

    Distances are measured only to the objects whose box, of (N, 2, 2) boxes, is near.
    """
    tree, (low, high) = cKDTree(start.few[:, :2]), _box_xy(start)
    apart_m = np.linalg.norm(np.maximum(np.maximum(boxes[:, 0] - high, low - boxes[:, 1]), 0.0), axis=1)
    gaps_m = np.full(len(come), np.inf)
    for a in np.flatnonzero(apart_m < 2 * _BESIDE_M).tolist():
        gaps_m[a] = np.min(tree.query(come[a].few[:, :2])[0])
    return [a for a in np.argsort(gaps_m, kind="stable").tolist() if gaps_m[a] < _BESIDE_M][:_MOST_TRIED]


def _partners_elsewhere(start: _Cloud, come: Sequence[_Cloud], extents: Float64Array, with_nearest: bool) -> list[int]:
    """Return the objects with similar ones of (N, 3) log extents: the most similar, and perhaps the nearest of these.

    At most `_MOST_TRIED` of each; the most similar first.
    """
    misfits = np.abs(start.log_extents - extents).max(axis=1)
    similar = [a for a in np.argsort(misfits, kind="stable").tolist() if misfits[a] <= np.log(_FAR_FACTOR)]
    chosen = similar[:_MOST_TRIED]
    if with_nearest:
        middle = start.points.mean(axis=0)
        nearest = sorted(similar, key=lambda a: float(np.linalg.norm(come[a].points.mean(axis=0) - middle)))
        chosen += [a for a in nearest[:_MOST_TRIED] if a not in chosen]
    return chosen


def _match_pair(start: _Cloud, end: _Cloud, least_share: float) -> _Match | None:
    """Return the match of a pair, None if it is none.

    The displacement is that of the centre of the upright box around both registered objects.
    """
    if min(len(start.points), len(end.points)) < _MIN_POINTS:
        return None
    return _judge(start, end, *_align(start, end), least_share, _LIKENESS)


def _match_tipped(start: _Cloud, end: _Cloud) -> _Match | None:
    """Return the match of a pair of which one object may lie where the other stands, None if it is none."""
    if min(len(start.points), len(end.points)) < _MIN_POINTS:
        return None
    return _judge(start, end, *_align_freely(start, end), _TIPPED_SHARE, _TIPPED_LIKENESS)


def _judge(
    start: _Cloud, end: _Cloud, likeness: float, end_T_start: Float64Array, least_share: float, least_likeness: float
) -> _Match | None:
    shares = _shares(start, end, end_T_start)
    excess = likeness * (sum(shares) / 2 - least_share)  # the likeness decides between pairs with a full share
    if excess <= 0.0 or min(shares) < _EITHER_SHARE or likeness < least_likeness:
        return None
    together = np.concatenate([start.points, transform(invert(end_T_start), end.points)])
    centre = upright_box(together)[0][:3, 3]
    shift = transform(end_T_start, centre[None])[0] - centre
    return _Match(excess * min(len(start.points), len(end.points)), likeness, max(shares), shift)


def _align(start: _Cloud, end: _Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, yaw and translation.

    The search starts from coinciding box centres of the objects and from coinciding box centres of the objects with
    their surroundings.
    """
    middles = {(_middle(start.points), _middle(end.points)), (_middle(start.whole), _middle(end.whole))}
    turns = [yaw_pose(float(yaw_rad))[:3, :3] for yaw_rad in np.arange(_HEADINGS) * (2 * np.pi / _HEADINGS)]
    guesses = [_turn_about(turn, *ends) for turn in turns for ends in sorted(middles)]
    return _register(start, end, guesses, _upright_fit)


def _align_freely(start: _Cloud, end: _Cloud) -> tuple[float, Float64Array]:
    """Return the best likeness and its (4, 4) end_T_start, any rotation; the search starts from principal axes."""
    start_axes, end_axes = _principal_axes(start.points), _principal_axes(end.points)
    turns = [end_axes @ turn @ start_axes.T for turn in Rotation.create_group("O").as_matrix()]
    middles = start.points.mean(axis=0), end.points.mean(axis=0)
    return _register(start, end, [_turn_about(turn, *middles) for turn in turns], _rigid_fit)


def _turn_about(turn: Float64Array, start_middle: ArrayLike, end_middle: ArrayLike) -> Float64Array:
    """Return the (4, 4) pose of a (3, 3) rotation that moves one middle to the other."""
    return make_pose(turn, np.subtract(end_middle, turn @ np.asarray(start_middle)))


def _principal_axes(points: Float64Array) -> Float64Array:
    """Return the (3, 3) right-handed axes of the covariance of (P, 3) points, one a column, the shortest first."""
    axes = np.linalg.eigh(np.cov(points.T))[1]
    return np.asarray(axes * (1.0, 1.0, np.sign(np.linalg.det(axes))))


def _register(start: _Cloud, end: _Cloud, guesses: Sequence[Float64Array], fit: Fit) -> tuple[float, Float64Array]:
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
    for _, guess in coarse[:_REFINED]:
        pose = guess
        for scale_m in _FINE_STEPS_M:
            pose = _step(start, end, pose, scale_m, fit)
        fine.append((_likeness(start, end, pose), pose))
    return max(fine, key=lambda item: item[0])


def _step(start: _Cloud, end: _Cloud, end_T_start: Float64Array, scale_m: float, fit: Fit) -> Float64Array:
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


def _rigid_fit(sources: Float64Array, goals: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the (4, 4) pose of the weighted least-squares fit of sources to goals, (N, 3) (Kabsch 1976)."""
    shares = weights / weights.sum()
    source, goal = shares @ sources, shares @ goals
    u, _, v = np.linalg.svd((goals - goal).T @ ((sources - source) * shares[:, None]))
    turn = (u * (1.0, 1.0, np.sign(np.linalg.det(u @ v)))) @ v
    return make_pose(turn, goal - turn @ source)


def _likeness(start: _Cloud, end: _Cloud, end_T_start: Float64Array) -> float:
    """Return the mean of 1 / (1 + (d / 0.1 m)^2) over both directions; 1 for identical objects."""
    found = _nearest(start.few, end.few, start, end, end_T_start)
    return sum(float((1.0 / (1.0 + (far_m / _LIKE_WITHIN_M) ** 2)).mean()) for far_m, _ in found) / 2


def _shares(start: _Cloud, end: _Cloud, end_T_start: Float64Array) -> tuple[float, float]:
    """Return the share of the points of either object within `_SAME_WITHIN_M` of the other's target surface."""
    (there_m, _), (back_m, _) = _nearest(start.points, end.points, start, end, end_T_start)
    return float((there_m < _SAME_WITHIN_M).mean()), float((back_m < _SAME_WITHIN_M).mean())


def _nearest(
    of_start: Float64Array, of_end: Float64Array, start: _Cloud, end: _Cloud, end_T_start: Float64Array
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
