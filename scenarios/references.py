"""What one part of a scenario says about another: nodes, drifts, places and routes that have to agree."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from cdpipe.yamlfile import Key, suggestion
from scenarios.schema import Scenario, SessionPlan, Tunnel

Mistake = tuple[Key, str]

_NO_DRIFT = "no drift joins"


def reference_mistakes(tree: Any) -> list[Mistake]:
    """Return every dangling reference of a drawn scenario as (key path, rule).

    Takes the plain tree, not the model, so that these mistakes are told together with those of the schema; parts of
    the wrong type are passed over, the schema speaks of them.
    """
    tunnel = _mapping(tree, "tunnel")
    nodes = [str(name) for name in _mapping(tunnel, "nodes")]
    edges = {
        frozenset(pair)
        for drift in _items(tunnel, "drifts")
        for pair in pairwise(_names(_items(drift, "nodes")))
        if len(set(pair)) == 2
    }
    of_drifts = list(_drift_mistakes(tunnel, nodes))
    others = [*_prop_mistakes(tree, nodes, edges), *_route_mistakes(tree, nodes, edges)]
    if of_drifts:  # a misspelt drift joins nothing; what follows from that is not worth telling
        others = [(key, rule) for key, rule in others if not rule.startswith(_NO_DRIFT)]
    return of_drifts + others


def route_length_m(tunnel: Tunnel, plan: SessionPlan) -> float:
    """Return the length of a session's route along the straight lines between its nodes, start_m and end_m left out."""
    path_m = sum(math.dist(tunnel.nodes[first], tunnel.nodes[second]) for first, second in pairwise(plan.route))
    return path_m - plan.start_m - plan.end_m


def contradictions(scenario: Scenario) -> list[Mistake]:
    """Return what cannot be driven in a scenario whose references hold, as (key path, rule)."""
    found: list[Mistake] = []
    for name, plan in (("before", scenario.before), ("after", scenario.after)):
        left_m = route_length_m(scenario.tunnel, plan)
        if left_m < scenario.platform.scan_spacing_m:
            whole_m = left_m + plan.start_m + plan.end_m
            found.append(((name, "start_m"), f"start_m and end_m leave nothing of the route, which is {whole_m:.1f} m"))
    sections = [scenario.tunnel.section, *(drift.section for drift in scenario.tunnel.drifts if drift.section)]
    free_m = min(section.width_m for section in sections) - 2 * scenario.platform.clearance_m
    if free_m <= 0:
        rule = f"leaves the platform no room in a drift {free_m + 2 * scenario.platform.clearance_m:.1f} m wide"
        found.append((("platform", "clearance_m"), rule))
    for name, height_m in (("before", scenario.before.height_m), ("after", scenario.after.height_m)):
        is_own = height_m is not None
        flown_m = height_m if height_m is not None else scenario.platform.sensor_height_m
        roof_m = min(section.height_m for section in sections)
        if flown_m >= roof_m:
            key: Key = (name, "height_m") if is_own else ("platform", "sensor_height_m")
            found.append((key, f"the sensor would be above the roof of a drift {roof_m:.1f} m high"))
    return found


def _drift_mistakes(tunnel: Any, nodes: list[str]) -> Iterator[Mistake]:
    for index, drift in enumerate(_items(tunnel, "drifts")):
        names = _items(drift, "nodes")
        for position, name in enumerate(names):
            key: Key = ("tunnel", "drifts", index, "nodes", position)
            if isinstance(name, str) and name not in nodes:
                yield key, _unknown_node(name, nodes)
            elif position and name == names[position - 1]:
                yield key, "a drift cannot go from a node to itself"


def _prop_mistakes(tree: Any, nodes: list[str], edges: set[frozenset[str]]) -> Iterator[Mistake]:
    seen: set[str] = set()
    for index, prop in enumerate(_items(tree, "props")):
        name = prop.get("name") if isinstance(prop, dict) else None
        if isinstance(name, str):
            if name in seen:
                yield ("props", index, "name"), "another prop has this name"
            seen.add(name)
        for place in ("place", "to"):
            pair = _items(_mapping(prop, place), "between")
            if len(_names(pair)) == 2 and frozenset(pair) not in edges:
                yield ("props", index, place, "between"), _no_drift(pair, nodes)


def _route_mistakes(tree: Any, nodes: list[str], edges: set[frozenset[str]]) -> Iterator[Mistake]:
    for session in ("before", "after"):
        route = _items(_mapping(tree, session), "route")
        for position, pair in enumerate(pairwise(route), start=1):
            if len(_names(list(pair))) == 2 and frozenset(pair) not in edges:
                yield (session, "route", position), _no_drift(list(pair), nodes)


def _no_drift(pair: list[str], nodes: list[str]) -> str:
    unknown = [name for name in pair if name not in nodes]
    return _unknown_node(unknown[0], nodes) if unknown else f"{_NO_DRIFT} {pair[0]} and {pair[1]}"


def _unknown_node(name: str, nodes: list[str]) -> str:
    return f"no node of the tunnel is called {name}{suggestion(name, nodes)}"


def _mapping(tree: Any, key: str) -> dict[str, Any]:
    value = tree.get(key) if isinstance(tree, dict) else None
    return value if isinstance(value, dict) else {}


def _items(tree: Any, key: str) -> list[Any]:
    value = tree.get(key) if isinstance(tree, dict) else None
    return value if isinstance(value, list) else []


def _names(values: list[Any]) -> list[str]:
    return [value for value in values if isinstance(value, str)]
