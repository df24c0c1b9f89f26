"""Which families and kinds of props lie in the distribution that networks are trained and thresholds chosen on."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Literal

from scenarios.catalogue import EFFECT_GROUPS

Domain = Literal["in", "out"]
TRAINED_FAMILIES = frozenset({"narrow", "wide", "network"})
# Families with an effect of a mine that `train/mine` has, too.
TRAINED_EFFECTS = frozenset(
    {f"{effect}/{name}" for effect in ("cross", "dust", "water") for name in ("narrow", "null")}
    | {"dust/mist", "dust/wide"}
)
TRAINED_KINDS = frozenset({"box", "crate", "chair", "barrel", "cone", "pallet", "rock", "vehicle", "muck_pile"})
SURFACE_OUT = frozenset({"wide", "cave"})
_NAMES = {"in": "in distribution", "out": "out of distribution", "all": "all pairs"}


@cache
def domain_of(family: str) -> Domain:
    """Return "in" for the trained families and their shipped variations (`unchanged/wide`), "out" for all others.

    Variations with an effect of a mine are in where the network has seen it: dust, mist, puddles, two sensors that scan
    (`cross/survey` is out). Those with movers or glare are out. Families `surface/*` are in but for `surface/wide` and
    `surface/cave`, on which nothing is tuned.
    """
    group, _, name = family.rpartition("/")
    is_trained = family in TRAINED_EFFECTS or (name in TRAINED_FAMILIES and group not in EFFECT_GROUPS)
    if group == "surface":
        is_trained = name not in SURFACE_OUT
    return "in" if is_trained and (resources.files("scenarios") / "families" / f"{family}.yaml").is_file() else "out"


def domain_name(domain: str) -> str:
    """Return a domain as headings and captions write it."""
    return _NAMES.get(domain, domain)


def is_change_in_distribution(family: str, prop_kind: str) -> bool:
    """Tell whether a change is in a trained family and of a kind that such families hold."""
    return domain_of(family) == "in" and prop_kind in TRAINED_KINDS
