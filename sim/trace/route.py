"""A route through traced drifts: the longest of the shortest ways without a sharp turn."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np

from cdpipe.core.geometry import Float64Array
from sim.rock.centreline import STEP_M, Centreline

_SHARPEST_DEG = 110.0  # the simulator turns back no farther than 150
_AHEAD = round(0.8 / STEP_M)  # samples over which a direction is taken
_MOST_STARTS = 60
Edge = tuple[str, str]


def find_route(centreline: Centreline, most_m: float) -> tuple[str, ...]:
    """Return the nodes of the longest of the shortest ways between two places, cut to `most_m`.

    Args:
        centreline: The drifts.
        most_m: Length at which the route ends, at the next node.
    """
    lengths_m = {edge: _length_m(centreline.edge(*edge)[0]) for edge in centreline.edges}
    following = _following(centreline)
    best: tuple[float, tuple[Edge, ...]] = (0.0, ())
    for start in _starts(centreline):
        best = max(best, _farthest(start, lengths_m, following), key=lambda way: way[0])
    route, driven_m = [best[1][0][0]], 0.0
    for edge in best[1]:
        route.append(edge[1])
        driven_m += lengths_m[edge]
        if driven_m >= most_m:
            break
    return tuple(route)


def _starts(centreline: Centreline) -> list[Edge]:
    """Return the edges that leave places where a drift ends; any edges if there are none."""
    degrees: dict[str, int] = {}
    for first, _ in centreline.edges:
        degrees[first] = degrees.get(first, 0) + 1
    ends = [edge for edge in centreline.edges if degrees[edge[0]] == 1]
    return (ends or list(centreline.edges))[:_MOST_STARTS]


def _following(centreline: Centreline) -> dict[Edge, list[Edge]]:
    """Return the edges on which one may go on after each edge."""
    leaving: dict[str, list[Edge]] = {}
    for edge in centreline.edges:
        leaving.setdefault(edge[0], []).append(edge)
    ways = {edge: _directions(centreline.edge(*edge)[0]) for edge in centreline.edges}
    least = np.cos(np.deg2rad(_SHARPEST_DEG))
    return {
        edge: [on for on in leaving[edge[1]] if on[1] != edge[0] and float(ways[edge][1] @ ways[on][0]) > least]
        for edge in centreline.edges
    }


def _farthest(
    start: Edge, lengths_m: dict[Edge, float], following: dict[Edge, list[Edge]]
) -> tuple[float, tuple[Edge, ...]]:
    """Return the way to the node that is farthest from a start, with its length: Dijkstra over directed edges."""
    done: dict[Edge, tuple[float, Edge | None]] = {}
    waiting: list[tuple[float, Edge, Edge | None]] = [(lengths_m[start], start, None)]
    while waiting:
        far_m, edge, before = heappop(waiting)
        if edge in done:
            continue
        done[edge] = far_m, before
        for on in following[edge]:
            if on not in done:
                heappush(waiting, (far_m + lengths_m[on], on, edge))
    first_to: dict[str, Edge] = {start[0]: start}  # edges come off the heap in the order of their distance
    for edge in done:
        first_to.setdefault(edge[1], edge)
    last = max(first_to.values(), key=lambda edge: done[edge][0])
    at: Edge | None = last
    far_m, way = done[last][0], []
    while at is not None:
        way.append(at)
        at = done[at][1]
    return far_m, tuple(way[::-1])


def _length_m(points: Float64Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _directions(points: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the unit directions (2,) at the start and at the end of a line (N, 3)."""
    reach = min(_AHEAD, len(points) - 1)
    pair = points[reach] - points[0], points[-1] - points[-1 - reach]
    first, last = (way[:2] / max(float(np.linalg.norm(way[:2])), 1e-9) for way in pair)
    return np.asarray(first), np.asarray(last)
