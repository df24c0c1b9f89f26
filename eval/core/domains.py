"""What lies inside and what outside of the distribution that descriptors are trained and thresholds are chosen on."""

from __future__ import annotations

from typing import Literal

Domain = Literal["in", "out"]
TRAINED_FAMILIES = frozenset({"narrow", "wide", "network"})
HELD_BACK_KINDS = frozenset({"trolley", "railing", "mesh"})
_NAMES = {"in": "in distribution", "out": "out of distribution", "all": "all pairs"}


def domain_of(family: str) -> Domain:
    """Return "in" for the trained families and their variations (`unchanged/wide`), "out" for all others."""
    return "in" if family.rpartition("/")[2] in TRAINED_FAMILIES else "out"


def domain_name(domain: str) -> str:
    """Return a domain as headings and captions write it."""
    return _NAMES.get(domain, domain)


def is_change_in_distribution(family: str, prop_kind: str) -> bool:
    """Tell whether a change is of a kind that a trained family holds, in such a family."""
    return domain_of(family) == "in" and prop_kind not in HELD_BACK_KINDS
