"""Stations of props along the tunnel: given ones, and those that the seed draws on the routes of both sessions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from scenarios.schema import Area, Place, Scenario, SessionPlan
from sim.placement.fitting import Spot
from sim.rock.centreline import Centreline

# Areas keep this many score radii of free tunnel between them where there is room, one from the ends of the drives.
_APART_RADII = 4.0
_AREA_TRIES = 64
_MOUTH_WIDTHS = 0.75
PLACE_TRIES = 80

Edge = tuple[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """Places along some edges of the tunnel, about 0.1 m apart.

    Attributes:
        edges: The edges, each as it is driven.
        edge: (N,) which edge.
        fraction: (N,) share of the way along it.
        points: (N, 3) on the centreline.
    """

    edges: tuple[Edge, ...]
    edge: Int64Array
    fraction: Float64Array
    points: Float64Array

    def __len__(self) -> int:
        return len(self.edge)

    def part(self, chosen: slice | BoolArray) -> Stations:
        """Return some of the stations."""
        return Stations(self.edges, self.edge[chosen], self.fraction[chosen], self.points[chosen])


def stations_of(edges: Sequence[Edge], centreline: Centreline) -> Stations:
    """Return the stations of some edges, in the order given."""
    points = [centreline.edge(a, b)[0] for a, b in edges]
    counts = [len(each) for each in points]
    fractions = np.concatenate([np.zeros(0), *(np.linspace(0.0, 1.0, count) for count in counts)])
    numbers = np.repeat(np.arange(len(edges)), np.array(counts, np.int64))
    return Stations(tuple(edges), numbers, fractions, np.concatenate([np.zeros((0, 3)), *points]))


def spot_between(edge: Edge, fraction: float, centreline: Centreline, over_humps: bool) -> Spot:
    """Return the spot a share of the way along an edge."""
    point, heading, section = centreline.at(*edge, fraction)
    where = f"between {edge[0]!r} and {edge[1]!r} at {fraction:.2f}"
    return Spot(point, heading, section.width_m, section.height_m, where, over_humps=over_humps)


def given_spot(place: Place, scenario: Scenario, centreline: Centreline) -> Spot | None:
    """Return the spot that a place names, or None where the seed is to draw it."""
    if place.at is not None:
        x, y, z = place.at
        section = scenario.tunnel.section
        where = f"at ({x:g}, {y:g}, {z:g})"
        point, heading = np.array(place.at), np.array([1.0, 0.0])
        return Spot(point, heading, section.width_m, section.height_m, where, is_line=False, over_humps=True)
    if place.between is None or place.fraction is None:
        return None
    return spot_between(place.between, place.fraction, centreline, over_humps=True)


def drawn_spots(
    generator: np.random.Generator, stations: Stations, scenario: Scenario, centreline: Centreline, over_humps: bool
) -> Iterator[Spot]:
    """Yield the spots at up to 80 drawn stations, those in the mouth of a junction left out."""
    is_free = ~_in_mouth(stations.points, scenario)
    for index in (generator.random(PLACE_TRIES) * len(stations)).astype(int).tolist():
        if is_free[index]:
            edge, fraction = stations.edges[stations.edge[index]], float(stations.fraction[index])
            yield spot_between(edge, fraction, centreline, over_humps)


def way(scenario: Scenario, centreline: Centreline) -> Stations:
    """Return the stations of every edge that either session drives."""
    edges = [*_driven_edges(scenario, scenario.before), *_driven_edges(scenario, scenario.after)]
    return stations_of(list(dict.fromkeys(edges)), centreline)


def draw_areas(scenario: Scenario, centreline: Centreline, seed: int) -> dict[str, tuple[Stations, Stations]]:
    """Return the stretch of each area, and the stretch extended by its own length to either side; both are driven.

    Up to 64 centres are drawn for an area. The first that keeps four score radii to the areas before it is taken, else
    the one farthest from them.

    Raises:
        ScenarioError: The sessions have no stretch in common that is long enough.
    """
    if not scenario.areas:
        return {}
    shared = stations_of(_driven_edges(scenario, scenario.before), centreline)
    is_driven = np.ones(len(shared), dtype=bool)
    for plan in (scenario.before, scenario.after):
        is_driven &= _is_driven(shared, scenario, plan, centreline, 0.0)
    chosen: dict[str, tuple[tuple[Stations, Stations], Area, Float64Array]] = {}
    for area in scenario.areas:
        starts, count = _possible(area, shared, scenario, centreline)
        draws = starts[(stream(seed, "areas", area.name).random(_AREA_TRIES) * len(starts)).astype(int)]
        centres = shared.points[draws + count // 2]
        spare_m = np.full(_AREA_TRIES, np.inf)
        for _, other, centre in chosen.values():
            wanted_m = _APART_RADII * scenario.score_radius_m + (area.length_m + other.length_m) / 2
            spare_m = np.minimum(spare_m, np.linalg.norm(centres - centre, axis=1) - wanted_m)
        best = int(np.argmax(spare_m >= 0)) if (spare_m >= 0).any() else int(np.argmax(spare_m))
        offset = np.arange(len(shared)) - int(draws[best])
        stretch = shared.part((offset >= 0) & (offset < count))
        longer = shared.part((offset >= -count) & (offset < 2 * count) & is_driven)
        chosen[area.name] = ((stretch, longer), area, centres[best])
    return {name: stretches for name, (stretches, _, _) in chosen.items()}


def _possible(area: Area, shared: Stations, scenario: Scenario, centreline: Centreline) -> tuple[Int64Array, int]:
    """First stations (N,) at which an area may start so that both sessions see it whole, and its length in stations."""
    radius_m = scenario.score_radius_m
    steps_m = np.linalg.norm(np.diff(shared.points, axis=0), axis=1)
    count = max(2, round(area.length_m / float(np.median(steps_m)))) if len(steps_m) else 2
    is_free = ~_in_mouth(shared.points, scenario)
    for may_hold_junction in (False, True):
        for margin_m in (radius_m, radius_m / 2, 0.0):
            is_good = is_free | may_hold_junction
            for plan in (scenario.before, scenario.after):
                is_good &= _is_driven(shared, scenario, plan, centreline, margin_m)
            if len(shared) >= count:
                starts = np.flatnonzero(np.lib.stride_tricks.sliding_window_view(is_good, count).all(axis=1))
                if len(starts):
                    return starts, count
    raise ScenarioError(
        f"area {area.name!r}: no stretch of {area.length_m:g} m is driven by both sessions: "
        "make it shorter, or the routes overlap more"
    )


def _is_driven(
    shared: Stations, scenario: Scenario, plan: SessionPlan, centreline: Centreline, margin_m: float
) -> BoolArray:
    """Mark the stations (N,) that a session passes at least `margin_m` from the ends of its drive."""
    if not plan.route:
        return np.ones(len(shared), dtype=bool)
    own = stations_of(_driven_edges(scenario, plan), centreline)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(own.points, axis=0), axis=1))])
    is_inside = (along_m >= plan.start_m + margin_m) & (along_m <= along_m[-1] - plan.end_m - margin_m)
    marked = np.zeros(len(shared), dtype=bool)
    for index, (a, b) in enumerate(own.edges):
        fractions = own.fraction[is_inside & (own.edge == index)]
        if len(fractions) == 0:
            continue
        for number, edge in enumerate(shared.edges):
            if edge in ((a, b), (b, a)):
                at = shared.fraction if edge == (a, b) else 1.0 - shared.fraction
                marked |= (shared.edge == number) & (at >= fractions.min()) & (at <= fractions.max())
    return marked


def _driven_edges(scenario: Scenario, plan: SessionPlan) -> list[Edge]:
    """Edges of a route; on a recorded trajectory any edge may be driven."""
    if plan.route:
        return list(pairwise(plan.route))
    return [edge for drift in scenario.tunnel.drifts for edge in pairwise(drift.nodes)]


def _in_mouth(points: Float64Array, scenario: Scenario) -> BoolArray:
    """Mark the points (N, 3) that lie where drifts meet, within three quarters of a drift's width of the node."""
    tunnel = scenario.tunnel
    # A node inside a drift that another one joins counts, its own two edges do not.
    used = [node for drift in tunnel.drifts for node in set(drift.nodes)]
    is_in = np.zeros(len(points), dtype=bool)
    for drift in tunnel.drifts:
        reach_m = _MOUTH_WIDTHS * (drift.section or tunnel.section).width_m
        for node in drift.nodes:
            if used.count(node) > 1:
                is_in |= np.linalg.norm(points[:, :2] - tunnel.nodes[node][:2], axis=1) < reach_m
    return is_in
