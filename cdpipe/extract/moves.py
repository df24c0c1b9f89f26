"""Moved objects: match a removed with an added object if their surfaces can be registered.

The two sessions see an object from different sides, so centres and edges do not agree; surfaces do. A removed object is
registered with an added one by yaw and translation. Where that fails it may lean, because an odometry that drifts in
roll and pitch tilts its map, and then turn in any way, because an object may lie where it stood. The share of both
surfaces that then coincides decides whether they are one object; the registration gives the displacement.

If an object moved by less than its own length, only two strips of it were extracted, and these need not be similar. The
overlap of both poses appears unchanged and is part of the surroundings. Neighbouring objects are therefore registered
together with the surroundings of the other session. Neighbours that are unlike and would have moved farther are judged
as objects elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, invert, transform
from cdpipe.extract.fitting import Cloud, align, align_freely, align_leaning, drop_tails, measure_shares
from cdpipe.extract.shape import upright_box

# Far moves: least share of both surfaces within 5 cm of the other, and largest factor between extents.
# On validation pairs all 20 moves pass (the least has 0.60), 11 % of 442 pairs of different kinds and similar extents,
# most of them crates and boxes, and 84 % of 219 pairs of the same kind.
_SAME_SHARE, _FAR_FACTOR = 0.55, 1.45
# Least upright likeness of a pair that may lean; chairs in maps that are tilted by 10 degrees have 0.6 and more.
_LEANS_FROM = 0.58
# Far moves of an object of which one session saw a part: largest factor between extents, least share and likeness.
_PART_FACTOR, _PART_SHARE, _PART_LIKENESS = 2.0, 0.65, 0.77
# Near moves, with the surroundings: largest gap, least mean share, least share of either, least likeness. On validation
# pairs 53 of 54 moves have a share of at least 0.46 and a likeness of at least 0.68.
_BESIDE_M = 1.5
_BESIDE_SHARE, _EITHER_SHARE = 0.4, 0.2
_LIKENESS = 0.62
# Share of its length from which an object has moved by all of it: then both sessions saw it whole, and not strips.
_WHOLE_LENGTH = 0.9
# Tipped objects, which may turn in any way: least mean share and least likeness.
_TIPPED_SHARE, _TIPPED_LIKENESS = 0.65, 0.72
_MIN_POINTS = 4
# Largest number of partners to try for one object; a registration takes about 20 ms.
_MOST_TRIED = 6
# Penalty of the score per metre of displacement, and the one with which twins (below) are told apart.
_TIE_PER_M, _TWIN_TIE_PER_M = 0.01, 0.1
# Twins, objects that may be of one shape: least likeness, and largest factor between extents. In worlds of equal
# barrels, crates and chairs (validation seeds) pairs of equal props have a likeness of at least 0.79 and, where one was
# seen in part, a factor of up to 1.36; the likeness of pairs of different kinds is below 0.68.
_TWIN_LIKENESS, _TWIN_FACTOR = 0.77, 1.45


# Returns the likeness of two objects and the (4, 4) end_T_start of their registration.
Search = Callable[[Cloud, Cloud], tuple[float, Float64Array]]


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
        nearest_twins: Whether tails are left out, twins are told apart by fit and way, and an object may lean, have
            been tipped on its way or been seen in part; otherwise all points of every pair count, as for objects cut
            out by whole map points.
    """
    kept = drop_tails if nearest_twins else np.asarray
    gone, come = ([Cloud.of(kept(points)) for points in objects] for objects in (removed, added))
    boxes = np.array([_box_xy(end) for end in come]).reshape(-1, 2, 2)
    extents = np.array([end.log_extents for end in come]).reshape(-1, 3)
    beside = [(r, a) for r, start in enumerate(gone) for a in _neighbours(start, come, boxes)]
    found: dict[tuple[int, int], _Match | None] = {}
    for (r, a), (before, after) in zip(beside, around(beside), strict=True):
        ends = gone[r].with_rest(before), come[a].with_rest(after)
        match = _match_pair(*ends, align, _BESIDE_SHARE, _LIKENESS)
        if match is None or match.are_strips or _misfits(gone[r], extents[a]) <= np.log(_FAR_FACTOR):
            found[r, a] = match
    for r, start in enumerate(gone):
        for a in _partners_elsewhere(start, come, extents, nearest_twins):
            if (r, a) not in found:
                found[r, a] = _match_elsewhere(start, come[a], in_any_way=nearest_twins)
        for a in _partners_in_part(start, extents) if nearest_twins else ():
            if (r, a) not in found:
                found[r, a] = _match_pair(start, come[a], align, _PART_SHARE, _PART_LIKENESS)
    matches = {pair: match for pair, match in found.items() if match is not None}
    if nearest_twins:
        matches = _equalise_twins(matches, gone, come)
    tie_per_m = _TWIN_TIE_PER_M if nearest_twins else _TIE_PER_M
    gain = np.zeros((len(gone), len(come)))
    for pair, match in matches.items():
        gain[pair] = match.points / (1.0 + tie_per_m * float(np.linalg.norm(match.shift_map)))
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
        are_strips: Whether it moved by less than its length, so that either object may be a strip of it.
    """

    points: float
    likeness: float
    share: float
    shift_map: Float64Array
    are_strips: bool

    @property
    def fit(self) -> float:
        return self.likeness * self.share


def _equalise_twins(
    matches: Mapping[tuple[int, int], _Match], gone: Sequence[Cloud], come: Sequence[Cloud]
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


def _box_xy(cloud: Cloud) -> tuple[Float64Array, Float64Array]:
    """Return the lower and the upper corner, (2,) each, of the upright box along x and y around an object."""
    return cloud.few[:, :2].min(axis=0), cloud.few[:, :2].max(axis=0)


def _neighbours(start: Cloud, come: Sequence[Cloud], boxes: Float64Array) -> list[int]:
    """Return the indices of the neighbouring objects, nearest first, at most `_MOST_TRIED`.

    Distances are measured only to the objects whose box, of (N, 2, 2) boxes, is near.
    """
    tree, (low, high) = cKDTree(start.few), _box_xy(start)
    apart_m = np.linalg.norm(np.maximum(np.maximum(boxes[:, 0] - high, low - boxes[:, 1]), 0.0), axis=1)
    gaps_m = np.full(len(come), np.inf)
    for a in np.flatnonzero(apart_m < 2 * _BESIDE_M).tolist():
        gaps_m[a] = np.min(tree.query(come[a].few)[0])
    return [a for a in np.argsort(gaps_m, kind="stable").tolist() if gaps_m[a] < _BESIDE_M][:_MOST_TRIED]


def _misfits(start: Cloud, extents: Float64Array) -> Float64Array:
    """Return the largest difference between the log extents of an object and (..., 3) others."""
    return np.asarray(np.abs(start.log_extents - extents).max(axis=-1))


def _partners_elsewhere(start: Cloud, come: Sequence[Cloud], extents: Float64Array, with_nearest: bool) -> list[int]:
    """Return the objects with similar ones of (N, 3) log extents: the most similar, and perhaps the nearest of these.

    At most `_MOST_TRIED` of each; the most similar first.
    """
    misfits = _misfits(start, extents)
    similar = [a for a in np.argsort(misfits, kind="stable").tolist() if misfits[a] <= np.log(_FAR_FACTOR)]
    chosen = similar[:_MOST_TRIED]
    if with_nearest:
        middle = start.points.mean(axis=0)
        nearest = sorted(similar, key=lambda a: float(np.linalg.norm(come[a].points.mean(axis=0) - middle)))
        chosen += [a for a in nearest[:_MOST_TRIED] if a not in chosen]
    return chosen


def _partners_in_part(start: Cloud, extents: Float64Array) -> list[int]:
    """Return the objects, of (N, 3) log extents, of which one session may have seen a part only.

    At most `_MOST_TRIED`; the most similar first.
    """
    misfits = _misfits(start, extents)
    in_part = (misfits > np.log(_FAR_FACTOR)) & (misfits <= np.log(_PART_FACTOR))
    return [a for a in np.argsort(misfits, kind="stable").tolist() if in_part[a]][:_MOST_TRIED]


def _match_elsewhere(start: Cloud, end: Cloud, *, in_any_way: bool) -> _Match | None:
    """Return the match of a pair that does not lie side by side, None if it is none.

    Strips of neighbours would fit in some way, so only here objects may lean and tip.
    """
    if min(len(start.points), len(end.points)) < _MIN_POINTS:
        return None
    likeness, end_T_start = align(start, end)
    match = _judge(start, end, likeness, end_T_start, _SAME_SHARE, _LIKENESS)
    if match is None and in_any_way and likeness >= _LEANS_FROM:
        match = _match_pair(start, end, align_leaning, _SAME_SHARE, _LIKENESS)
    if match is None and in_any_way:
        match = _match_pair(start, end, align_freely, _TIPPED_SHARE, _TIPPED_LIKENESS)
    return match


def _match_pair(start: Cloud, end: Cloud, search: Search, least_share: float, least_likeness: float) -> _Match | None:
    """Return the match of a pair by one kind of registration, None if it is none.

    The displacement is that of the centre of the upright box around both registered objects.
    """
    if min(len(start.points), len(end.points)) < _MIN_POINTS:
        return None
    return _judge(start, end, *search(start, end), least_share, least_likeness)


def _judge(
    start: Cloud, end: Cloud, likeness: float, end_T_start: Float64Array, least_share: float, least_likeness: float
) -> _Match | None:
    shares = measure_shares(start, end, end_T_start)
    share = sum(shares) / 2
    if share <= least_share or min(shares) < _EITHER_SHARE or likeness < least_likeness:
        return None
    together = np.concatenate([start.points, transform(invert(end_T_start), end.points)])
    map_T_box, size_m = upright_box(together)
    centre = map_T_box[:3, 3]
    shift = transform(end_T_start, centre[None])[0] - centre
    are_strips = bool(np.linalg.norm(shift) < _WHOLE_LENGTH * size_m[0])
    points = likeness * share * min(len(start.points), len(end.points))
    return _Match(points, likeness, max(shares), shift, are_strips)
