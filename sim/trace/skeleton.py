"""The skeleton of a void: thinned to curves, cut into branches, without spurs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from sim.trace.inside import Void

LEAST_STEP_M = 2.5  # a drift needs 2 m between nodes
_SPUR_WIDTHS = 1.2  # a branch that ends and is no longer than this is the corner of a face, a niche or noise
_SAME_WIDTHS = 0.75  # junctions nearer than this are one
_PILLAR_WIDTHS = 2.5  # a loop shorter than this leads round a pillar or a hole of the mesh
_WHOLE = 0.9  # a skeleton with so many of the cells of the longest one is as good
_MAJORITY = 27 * 2**3 // 2  # of the votes in `_make_odd`
Width = Callable[[Float64Array], float]


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """A curve between two places where the skeleton ends or branches.

    Attributes:
        ends: Numbers of the two places; the same twice in a ring.
        points: (N, 3) from the first to the second, world frame, metres.
    """

    ends: tuple[int, int]
    points: Float64Array

    @property
    def length_m(self) -> float:
        """Length of the curve."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    def reversed(self) -> Branch:
        """Return the same curve the other way."""
        return Branch((self.ends[1], self.ends[0]), self.points[::-1])


def find_branches(void: Void, width_at: Width) -> list[Branch]:
    """Return the middle curves of a void, branch by branch.

    The cells are thinned to curves (Lee, Kashyap and Chu 1994). Junctions close to each other become one, and branches
    that end within about a width of the drift that they leave are dropped.

    Args:
        void: The inside.
        width_at: The width of the drift at a point (3,).
    """
    thin = np.argwhere(_thin(_make_odd(void.is_inside))).astype(np.int64)
    if len(thin) < 2:
        return []
    branches = _cut_at_junctions(thin, void.low_m + thin * (void.cell_m / 2))
    while True:
        pruned = join_through(_drop_spurs(_merge_junctions(branches, width_at), width_at))
        if len(pruned) == len(branches):
            return pruned
        branches = pruned


def _thin(cells: BoolArray) -> BoolArray:
    """Return the skeleton of cells (X, Y, Z), or of cells that are grown by one along some axes if much more is left.

    Thinning eats a bar whose section is an even number of cells wide and high from its ends, see `_make_odd`. A smooth
    section at an angle to the grid may still be such a bar, and is none with one more cell.
    """
    plain = np.asarray(skeletonize(cells), dtype=np.bool_)
    least = np.count_nonzero(plain) / _WHOLE
    longest = plain
    for axes in (axes for number in (1, 2, 3) for axes in combinations(range(3), number)):
        grown = cells
        for axis in axes:
            grown = grown | np.roll(grown, 1, axis)  # the border is empty
        found = np.asarray(skeletonize(grown), dtype=np.bool_)
        if np.count_nonzero(found) > max(least, np.count_nonzero(longest)):
            longest = found
    return longest


def count_uses(branches: Iterable[Branch]) -> dict[int, int]:
    """Return how many ends of branches meet at each place."""
    uses: dict[int, int] = {}
    for branch in branches:
        for end in branch.ends:
            uses[end] = uses.get(end, 0) + 1
    return uses


def _make_odd(is_inside: BoolArray) -> BoolArray:
    """Return cells (X, Y, Z) with one more between each two, (2 X - 1, 2 Y - 1, 2 Z - 1), and a smooth surface.

    Inside is where the majority of the 27 cells around is, interpolated between cells. What is symmetric is then an odd
    number of cells wide. Thinning eats a bar that is an even number of cells wide and high from its ends until nothing
    is left: when two cells remain across, none of them is an end.
    """
    votes = is_inside.astype(np.int16)
    for axis in range(3):
        padded = np.pad(np.moveaxis(votes, axis, 0), ((1, 1), (0, 0), (0, 0)))
        near = padded[:-2] + padded[1:-1] + padded[2:]
        doubled = np.zeros((2 * len(near) - 1, *near.shape[1:]), dtype=np.int16)
        doubled[::2] = 2 * near
        doubled[1::2] = near[:-1] + near[1:]
        votes = np.moveaxis(doubled, 0, axis)
    return votes > _MAJORITY


def _cut_at_junctions(cells: Int64Array, points: Float64Array) -> list[Branch]:
    """Cut a skeleton, its cells (N, 3) at points (N, 3), into branches where cells have three and more neighbours."""
    pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    count = np.bincount(pairs.ravel(), minlength=len(cells))
    is_fork = count > 2
    fork = _label(pairs[is_fork[pairs].all(axis=1)], len(cells))
    between = pairs[~is_fork[pairs].any(axis=1)]
    path = _label(between, len(cells))
    neighbours: list[list[int]] = [[] for _ in cells]
    for a, b in pairs.tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    middles = {int(label): points[is_fork & (fork == label)].mean(axis=0) for label in np.unique(fork[is_fork])}
    n_places = len(cells)
    branches = []
    for label in np.unique(path[~is_fork]):
        walked = _walk(np.flatnonzero(~is_fork & (path == label)), neighbours, is_fork)
        ends = [[int(fork[other]) for other in neighbours[cell] if is_fork[other]] for cell in (walked[0], walked[-1])]
        if len(walked) == 1:
            ends = [ends[0][:1], ends[0][1:2]]
        curve, places = [points[walked]], [0, 0]
        for side, found in enumerate(ends):
            if found:
                places[side] = found[0]
                curve.insert(0 if side == 0 else len(curve), middles[found[0]][None])
            else:
                places[side], n_places = n_places, n_places + 1
        if not any(ends) and len(walked) > 2 and walked[0] in neighbours[walked[-1]]:  # a ring without a junction
            places[1] = places[0]
            curve.append(points[walked[:1]])
        branches.append(Branch((places[0], places[1]), np.concatenate(curve)))
    return branches


def _walk(members: Int64Array, neighbours: list[list[int]], is_fork: np.ndarray) -> Int64Array:
    """Return the cells of a path in order; of a ring from any cell on."""
    inner = {int(cell): [other for other in neighbours[cell] if not is_fork[other]] for cell in members}
    at = next((cell for cell, others in inner.items() if len(others) < 2), int(members[0]))
    walked, seen = [at], {at}
    while (following := next((other for other in inner[at] if other not in seen), None)) is not None:
        at = following
        walked.append(at)
        seen.add(at)
    return np.array(walked, dtype=np.int64)


def _label(pairs: Int64Array, n_cells: int) -> Int64Array:
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n_cells, n_cells))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _merge_junctions(branches: list[Branch], width_at: Width) -> list[Branch]:
    """Shrink short branches between two junctions to one place, and drop rings about pillars."""
    while True:
        uses = count_uses(branches)
        rings = [each for each in branches if each.ends[0] == each.ends[1]]
        small = [ring for ring in rings if ring.length_m < _PILLAR_WIDTHS * width_at(ring.points[0])]
        if small:
            branches = [each for each in branches if not any(each is ring for ring in small)]
            continue
        short = next((each for each in branches if _is_inner(each, uses) and _is_short(each, width_at)), None)
        if short is None:
            return branches
        branches = _shrink([each for each in branches if each is not short], short)


def _is_inner(branch: Branch, uses: dict[int, int]) -> bool:
    return branch.ends[0] != branch.ends[1] and min(uses[end] for end in branch.ends) > 2


def _is_short(branch: Branch, width_at: Width) -> bool:
    return branch.length_m < max(LEAST_STEP_M, _SAME_WIDTHS * width_at(branch.points[len(branch.points) // 2]))


def _shrink(others: list[Branch], short: Branch) -> list[Branch]:
    """Return the other branches with both ends of a short one at its middle."""
    middle = short.points[[0, -1]].mean(axis=0)
    kept, gone = short.ends
    moved = []
    for branch in others:
        points = branch.points.copy()
        for side, end in zip((0, -1), branch.ends, strict=True):
            if end in short.ends:
                points[side] = middle
        first, last = (kept if end == gone else end for end in branch.ends)
        moved.append(Branch((first, last), points))
    return moved


def _drop_spurs(branches: list[Branch], width_at: Width) -> list[Branch]:
    """Drop the branches that end and are short; of a place where all are short the two longest stay."""
    uses = count_uses(branches)
    kept: list[Branch] = []
    spurs: list[Branch] = []
    for branch in branches:
        is_spur = False
        for end, inner, at in ((0, 1, -1), (1, 0, 0)):
            if uses[branch.ends[end]] == 1 and uses[branch.ends[inner]] > 2:
                is_spur = branch.length_m < _SPUR_WIDTHS * width_at(branch.points[at])
        (spurs if is_spur else kept).append(branch)
    if not kept:
        return sorted(spurs, key=lambda branch: branch.length_m)[-2:]
    return kept


def join_through(branches: list[Branch]) -> list[Branch]:
    """Join the branches at places where only two meet."""
    uses = count_uses(branches)
    joined = list(branches)
    for place in [place for place, used in uses.items() if used == 2]:
        here = [branch for branch in joined if place in branch.ends]
        if len(here) != 2:
            continue  # a ring
        first = here[0] if here[0].ends[1] == place else here[0].reversed()
        second = here[1] if here[1].ends[0] == place else here[1].reversed()
        whole = Branch((first.ends[0], second.ends[1]), np.concatenate([first.points, second.points[1:]]))
        joined = [branch for branch in joined if branch is not here[0] and branch is not here[1]] + [whole]
    return joined
