"""Dangling references of a scenario, to nodes, drifts and areas that do not exist, and repeated names.

The functions read the plain tree, so that these mistakes are reported together with those of the schema. They skip
values of the wrong type, which the schema reports.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from difflib import get_close_matches
from itertools import pairwise
from typing import Any

from cdpipe.core.files import Key
from cdpipe.core.yamlfile import suggest

Mistake = tuple[Key, str]

_NO_DRIFT = "no drift joins"
_RECORDED = ("tunnel", "before", "after", "areas", "movers", "puddles", "sensor", "platform")
# What a place of a prop cannot say in a recording: the value that says nothing, and why.
_NOT_RECORDED: dict[str, tuple[Any, str]] = {
    "between": (None, "a recording has no nodes: give at, or leave it out"),
    "fraction": (None, "a recording has no nodes: give at, or leave it out"),
    "area": (None, "in a recording there are no areas: give at, or leave it out"),
    "lateral": (0, "a recording has no walls to stand at: give at, or leave it out"),
    "posture": ("upright", "props are grafted upright: leave it out"),
}


def find_dangling(tree: Any) -> list[Mistake]:
    """Return every dangling reference of a drawn scenario as (key path, rule).

    Of a scenario with a recording, what that has of its own or lacks.

    Where the nodes stand under a misspelt key, or are no mapping, the schema says so, and no reference to one is told.
    """
    if isinstance(tree, dict) and "recording" in tree:
        return [*_repeated_names(tree), *_recorded_mistakes(tree)]
    tunnel = mapping_at(tree, "tunnel")
    nodes = [str(name) for name in mapping_at(tunnel, "nodes")]
    elsewhere = [*_repeated_names(tree), *_area_mistakes(tree)]
    others = [str(key) for key in tunnel if key != "nodes"]
    is_misspelt = not tunnel or tunnel.get("nodes", {}) != {} or bool(get_close_matches("nodes", others, cutoff=0.75))
    if not nodes and is_misspelt:
        return elsewhere
    edges = {
        frozenset(pair)
        for drift in items_at(tunnel, "drifts")
        for pair in pairwise(_names(items_at(drift, "nodes")))
        if len(set(pair)) == 2
    }
    of_drifts = list(_drift_mistakes(tunnel, nodes))
    named = _edges_named(tree, nodes)
    of_edges = [(key, _no_drift(pair, nodes)) for key, pair in named if frozenset(pair) not in edges]
    if of_drifts:  # a misspelt drift joins nothing: only nodes that do not exist are worth a line of their own
        of_edges = [(key, rule) for key, rule in of_edges if not rule.startswith(_NO_DRIFT)]
    return [*of_drifts, *_route_mistakes(tree, nodes), *of_edges, *_node_mistakes(tree, nodes), *elsewhere]


def _drift_mistakes(tunnel: Any, nodes: list[str]) -> Iterator[Mistake]:
    for index, drift in enumerate(items_at(tunnel, "drifts")):
        names = items_at(drift, "nodes")
        for position, name in enumerate(names):
            key: Key = ("tunnel", "drifts", index, "nodes", position)
            if isinstance(name, str) and name not in nodes:
                yield key, _unknown_node(name, nodes)
            elif position and name == names[position - 1]:
                yield key, "a drift cannot go from a node to itself"


def _route_mistakes(tree: Any, nodes: list[str]) -> Iterator[Mistake]:
    for session in ("before", "after"):
        for position, name in enumerate(items_at(mapping_at(tree, session), "route")):
            if isinstance(name, str) and name not in nodes:
                yield (session, "route", position), _unknown_node(name, nodes)


def _edges_named(tree: Any, nodes: list[str]) -> list[tuple[Key, list[str]]]:
    """Return every pair of nodes between which something lies, or that are known and driven, as (key path, pair)."""
    found: list[tuple[Key, Any]] = []
    for index, niche in enumerate(items_at(mapping_at(tree, "tunnel"), "niches")):
        found.append((("tunnel", "niches", index, "between"), items_at(niche, "between")))
    for key, place in _places(tree):
        found.append(((*key, "between"), items_at(place, "between")))
    for session in ("before", "after"):
        for position, pair in enumerate(pairwise(items_at(mapping_at(tree, session), "route")), start=1):
            found += [((session, "route", position), list(pair))] if all(name in nodes for name in pair) else []
    return [(key, pair) for key, pair in found if len(pair) == len(_names(pair)) == 2]


def _repeated_names(tree: Any) -> Iterator[Mistake]:
    keys = {"areas": "area", "props": "prop", "movers": "mover", "puddles": "puddle", "surface": "surface change"}
    for key, kind in keys.items():
        names = [item.get("name") if isinstance(item, dict) else None for item in items_at(tree, key)]
        for index, name in enumerate(names):
            if isinstance(name, str) and name in names[:index]:
                yield (key, index, "name"), f"another {kind} has this name"


def _node_mistakes(tree: Any, nodes: list[str]) -> Iterator[Mistake]:
    uses = Counter(
        node for drift in items_at(mapping_at(tree, "tunnel"), "drifts") for node in _names(items_at(drift, "nodes"))
    )
    ends = {node for drift in items_at(mapping_at(tree, "tunnel"), "drifts") for node in _ends(drift)}
    for index, change in enumerate(items_at(tree, "surface")):
        node = mapping_at(change, "place").get("node")
        if isinstance(node, str) and node not in nodes:
            yield ("surface", index, "place", "node"), _unknown_node(node, nodes)
        elif isinstance(node, str) and (uses[node] != 1 or node not in ends):
            yield ("surface", index, "place", "node"), f"{node} is no blind end of a drift"


def _ends(drift: Any) -> list[str]:
    names = _names(items_at(drift, "nodes"))
    return [names[0], names[-1]] if names else []


def _recorded_mistakes(tree: Any) -> Iterator[Mistake]:
    for name in _RECORDED:
        if tree.get(name):
            yield (name,), f"the recording has its own: leave {name} out"
    if tree.get("sim"):
        yield ("sim",), "no ray of a recording is simulated, and its props are cast with embree: leave sim out"
    for key, place in _places({"props": tree.get("props")}):
        for name, (nothing, why) in _NOT_RECORDED.items():
            if place.get(name, nothing) not in (nothing, None):
                yield (*key, name), why


def _area_mistakes(tree: Any) -> Iterator[Mistake]:
    known = _names([area.get("name") for area in items_at(tree, "areas") if isinstance(area, dict)])
    for key, place in _places(tree):
        area = place.get("area")
        if isinstance(area, str) and area not in known:
            yield (*key, "area"), f"no area is called {area}{suggest(area, known)}" if known else "there are no areas"


def _places(tree: Any) -> Iterator[tuple[Key, dict[str, Any]]]:
    """Yield the places of props, paths of movers, places of puddles and surface changes; empty where none is."""
    for index, prop in enumerate(items_at(tree, "props")):
        yield from ((("props", index, name), mapping_at(prop, name)) for name in ("place", "to"))
    for index, mover in enumerate(items_at(tree, "movers")):
        yield ("movers", index, "path"), mapping_at(mover, "path")
    for index, puddle in enumerate(items_at(tree, "puddles")):
        yield ("puddles", index, "place"), mapping_at(puddle, "place")
    for index, change in enumerate(items_at(tree, "surface")):
        yield ("surface", index, "place"), mapping_at(change, "place")


def _no_drift(pair: list[str], nodes: list[str]) -> str:
    unknown = [name for name in pair if name not in nodes]
    return _unknown_node(unknown[0], nodes) if unknown else f"{_NO_DRIFT} {pair[0]} and {pair[1]}"


def _unknown_node(name: str, nodes: list[str]) -> str:
    return f"no node of the tunnel is called {name}{suggest(name, nodes)}"


def mapping_at(tree: Any, key: str) -> dict[str, Any]:
    """Return the mapping under a key, empty where there is none."""
    value = tree.get(key) if isinstance(tree, dict) else None
    return value if isinstance(value, dict) else {}


def items_at(tree: Any, key: str) -> list[Any]:
    """Return the list under a key, empty where there is none."""
    value = tree.get(key) if isinstance(tree, dict) else None
    return value if isinstance(value, list) else []


def _names(values: list[Any]) -> list[str]:
    return [value for value in values if isinstance(value, str)]
