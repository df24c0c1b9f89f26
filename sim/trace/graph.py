"""Nodes and drifts: middles joined through junctions, and the few nodes that hold each of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from skimage.measure import approximate_polygon

from cdpipe.core.geometry import Float64Array, Int64Array
from sim.rock.axis import STATION_M
from sim.trace.middle import Middle
from sim.trace.skeleton import LEAST_STEP_M

_STRAIGHT_DEG = 50.0  # two middles that turn less than this at a junction are one drift
_ALIKE = 1.5  # if neither is so much wider
_MOST_STEP_M = 30.0  # between nodes
_UP_TOLERANCE_M = 0.5  # of the floor from the straight line between nodes


@dataclass(frozen=True, slots=True, eq=False)
class TracedDrift:
    """A drift: its nodes in order, and the middles between its junctions.

    Attributes:
        nodes: Names; the first is also the last in a ring.
        middles: The lines, end to end.
        width_m, height_m: Medians.
    """

    nodes: tuple[str, ...]
    middles: tuple[Middle, ...]
    width_m: float
    height_m: float

    @property
    def points(self) -> Float64Array:
        """(N, 3) whole line on the floor."""
        return np.concatenate([middle.points for middle in self.middles])

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return sum(middle.length_m for middle in self.middles)


def join_drifts(middles: Sequence[Middle], width_m: float) -> list[list[Middle]]:
    """Return the middles as drifts: those that go straight on through a junction are one, head to tail."""
    partner: dict[tuple[int, int], tuple[int, int]] = {}  # (middle, its side) to the same of the next
    for pair in _straightest(middles, width_m):
        if any(one in partner for one in pair):
            continue
        partner[pair[0]], partner[pair[1]] = pair[1], pair[0]
        if _repeats(middles, partner, pair[0][0]):
            del partner[pair[0]], partner[pair[1]]
    chains: list[list[Middle]] = []
    done: set[int] = set()
    for start in range(len(middles)):
        if start not in done:
            chain = _chain(middles, partner, start)
            done.update(index for index, _ in chain)
            chains.append([middles[index] if forward else middles[index].reversed() for index, forward in chain])
    return sorted(chains, key=lambda chain: -sum(middle.length_m for middle in chain))


def name_nodes(
    drifts: Sequence[Sequence[Middle]], tolerance_m: float
) -> tuple[dict[str, tuple[float, float, float]], list[TracedDrift]]:
    """Return the nodes by name, and the drifts through them.

    Args:
        drifts: Middles, end to end.
        tolerance_m: How far the straight lines between nodes may lie beside the line.
    """
    uses = Counter(end for drift in drifts for middle in drift for end in middle.ends)
    parallel = Counter(frozenset(middle.ends) for drift in drifts for middle in drift)
    names: dict[int, str] = {}
    places: dict[str, Float64Array] = {}

    def name_of(kind: str, point: Float64Array) -> str:
        name = f"{kind}-{sum(known.startswith(kind) for known in places) + 1}"
        places[name] = point
        return name

    traced = []
    for drift in drifts:
        nodes: list[str] = []
        for middle in drift:
            inner = _inner_nodes(middle, tolerance_m, parallel[frozenset(middle.ends)] > 1)
            stops = [(middle.ends[0], middle.points[0]), *((None, middle.points[at]) for at in inner)]
            for end, point in [*stops, (middle.ends[1], middle.points[-1])]:
                if end is None:
                    nodes.append(name_of("node", point))
                    continue
                if end not in names:
                    names[end] = name_of("junction" if uses[end] > 2 else "end", point)
                if not nodes or nodes[-1] != names[end]:
                    nodes.append(names[end])
        widths = np.concatenate([middle.right_m + middle.left_m for middle in drift])
        heights = np.concatenate([middle.height_m for middle in drift])
        traced.append(TracedDrift(tuple(nodes), tuple(drift), float(np.median(widths)), float(np.median(heights))))
    return {name: tuple(round(float(value), 2) for value in point) for name, point in places.items()}, traced  # type: ignore[misc]


def _straightest(middles: Sequence[Middle], width_m: float) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the pairs of ends (middle, side) that may be joined at a junction, the straightest first."""
    at: dict[int, list[tuple[int, int]]] = {}
    for index, middle in enumerate(middles):
        for side, end in enumerate(middle.ends):
            at.setdefault(end, []).append((index, side))
    ways = {(i, side): _way_out(middles[i], side, width_m) for i in range(len(middles)) for side in (0, 1)}
    found = []
    for meeting in at.values():
        for first, one in enumerate(meeting):
            for other in meeting[first + 1 :]:
                cosine = float(-(ways[one] @ ways[other]))
                widths = sorted(middles[index].width_m for index, _ in (one, other))
                is_ring = one[0] == other[0]
                if not is_ring and cosine > np.cos(np.deg2rad(_STRAIGHT_DEG)) and widths[1] < _ALIKE * widths[0]:
                    found.append((cosine, (one, other)))
    return [pair for _, pair in sorted(found, key=lambda each: -each[0])]


def _way_out(middle: Middle, side: int, width_m: float) -> Float64Array:
    """Return the unit direction (2,) in which a middle leaves its end, over one and a half widths."""
    points = middle.points if side == 0 else middle.points[::-1]
    ahead = points[min(len(points) - 1, round(1.5 * width_m / STATION_M)), :2] - points[0, :2]
    return np.asarray(ahead / max(float(np.linalg.norm(ahead)), 1e-9))


def _chain(
    middles: Sequence[Middle], partner: dict[tuple[int, int], tuple[int, int]], start: int
) -> list[tuple[int, bool]]:
    """Return the drift that a middle is part of: (number, whether forward), head to tail."""
    chain = [(start, True)]
    for side, grow in ((1, 1), (0, -1)):
        at = (start, side)
        while at in partner:
            index, entered = partner[at]
            if any(index == known for known, _ in chain):
                break
            is_forward = (entered == 0) == (grow == 1)
            chain.insert(len(chain) if grow == 1 else 0, (index, is_forward))
            at = (index, 1 - entered)
    return chain


def _repeats(middles: Sequence[Middle], partner: dict[tuple[int, int], tuple[int, int]], start: int) -> bool:
    """Tell whether the drift that a middle is part of would come to a place twice."""
    chain = _chain(middles, partner, start)
    ends = Counter(end for index, _ in chain for end in middles[index].ends)
    return len(ends) != len(chain) + 1 or max(ends.values()) > 2


def _inner_nodes(middle: Middle, tolerance_m: float, is_parallel: bool) -> list[int]:
    """Return the stations of a middle at which it has nodes, its ends left out."""
    points = middle.points
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])
    profile = np.column_stack([along_m, points[:, 2]])
    corners = approximate_polygon(points[:, :2], tolerance_m)
    kept = {int(np.argmin(np.linalg.norm(points[:, :2] - corner, axis=1))) for corner in corners[1:-1]}
    kept |= {int(np.searchsorted(along_m, at)) for at, _ in approximate_polygon(profile, _UP_TOLERANCE_M)[1:-1]}
    n_least = 2 if middle.ends[0] == middle.ends[1] else int(is_parallel)
    if len(kept) < n_least:
        kept |= {int(share * (len(points) - 1)) for share in np.arange(1, n_least + 1) / (n_least + 1)}
    return _spaced(sorted({*kept, *_between(sorted({0, *kept, len(points) - 1}), along_m)}), points, along_m)


def _between(stops: Sequence[int], along_m: Float64Array) -> set[int]:
    """Return stations that cut long straight pieces."""
    more: set[int] = set()
    for first, last in pairwise(stops):
        n_pieces = int(np.ceil((along_m[last] - along_m[first]) / _MOST_STEP_M))
        wanted: Int64Array = np.searchsorted(along_m, np.linspace(along_m[first], along_m[last], n_pieces + 1)[1:-1])
        more |= {int(station) for station in wanted}
    return more


def _spaced(stations: Sequence[int], points: Float64Array, along_m: Float64Array) -> list[int]:
    """Return the stations that lie far enough from one another and from both ends."""
    kept: list[int] = []
    for station in stations:
        neighbours = [points[0], points[-1], *(points[known] for known in kept[-1:])]
        if min(float(np.linalg.norm(points[station, :2] - other[:2])) for other in neighbours) >= LEAST_STEP_M:
            kept.append(station)
    return kept
