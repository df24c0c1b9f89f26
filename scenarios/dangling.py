"""References of a scenario that lead nowhere: to nodes, drifts and areas that it does not have, and names given twice.

Works on the plain tree and not on the model, so that these mistakes are told together with those of the schema; parts
of the wrong type are passed over, the schema speaks of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from cdpipe.core.yamlfile import Key, suggest

Mistake = tuple[Key, str]

_NO_DRIFT = "no drift joins"


def find_dangling(tree: Any) -> list[Mistake]:
    """Return every dangling reference of a drawn scenario as (key path, rule)."""
    tunnel = mapping_at(tree, "tunnel")
    nodes = [str(name) for name in mapping_at(tunnel, "nodes")]
    edges = {
        frozenset(pair)
        for drift in items_at(tunnel, "drifts")
        for pair in pairwise(_names(items_at(drift, "nodes")))
        if len(set(pair)) == 2
    }
    of_drifts = list(_drift_mistakes(tunnel, nodes))
    others = [
        *_niche_mistakes(tunnel, nodes, edges),
        *_area_mistakes(tree),
        *_prop_mistakes(tree, nodes, edges),
        *_route_mistakes(tree, nodes, edges),
    ]
    if of_drifts:  # a misspelt drift joins nothing; what follows from that is not worth telling
        others = [(key, rule) for key, rule in others if not rule.startswith(_NO_DRIFT)]
    return of_drifts + others


def _drift_mistakes(tunnel: Any, nodes: list[str]) -> Iterator[Mistake]:
    for index, drift in enumerate(items_at(tunnel, "drifts")):
        names = items_at(drift, "nodes")
        for position, name in enumerate(names):
            key: Key = ("tunnel", "drifts", index, "nodes", position)
            if isinstance(name, str) and name not in nodes:
                yield key, _unknown_node(name, nodes)
            elif position and name == names[position - 1]:
                yield key, "a drift cannot go from a node to itself"


def _niche_mistakes(tunnel: Any, nodes: list[str], edges: set[frozenset[str]]) -> Iterator[Mistake]:
    for index, niche in enumerate(items_at(tunnel, "niches")):
        pair = items_at(niche, "between")
        if len(_names(pair)) == 2 and frozenset(pair) not in edges:
            yield ("tunnel", "niches", index, "between"), _no_drift(pair, nodes)


def _area_mistakes(tree: Any) -> Iterator[Mistake]:
    names = [mapping_at({"area": area}, "area").get("name") for area in items_at(tree, "areas")]
    for index, name in enumerate(names):
        if isinstance(name, str) and name in names[:index]:
            yield ("areas", index, "name"), "another area has this name"
    known = _names(names)
    for index, prop in enumerate(items_at(tree, "props")):
        for place in ("place", "to"):
            area = mapping_at(prop, place).get("area")
            if isinstance(area, str) and area not in known:
                rule = f"no area is called {area}{suggest(area, known)}" if known else "there are no areas"
                yield ("props", index, place, "area"), rule


def _prop_mistakes(tree: Any, nodes: list[str], edges: set[frozenset[str]]) -> Iterator[Mistake]:
    seen: set[str] = set()
    for index, prop in enumerate(items_at(tree, "props")):
        name = prop.get("name") if isinstance(prop, dict) else None
        if isinstance(name, str):
            if name in seen:
                yield ("props", index, "name"), "another prop has this name"
            seen.add(name)
        for place in ("place", "to"):
            pair = items_at(mapping_at(prop, place), "between")
            if len(_names(pair)) == 2 and frozenset(pair) not in edges:
                yield ("props", index, place, "between"), _no_drift(pair, nodes)


def _route_mistakes(tree: Any, nodes: list[str], edges: set[frozenset[str]]) -> Iterator[Mistake]:
    for session in ("before", "after"):
        route = items_at(mapping_at(tree, session), "route")
        for position, pair in enumerate(pairwise(route), start=1):
            if len(_names(list(pair))) == 2 and frozenset(pair) not in edges:
                yield (session, "route", position), _no_drift(list(pair), nodes)


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
