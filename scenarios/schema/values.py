"""The kinds of value that a key may have, and rules that several models share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
SignedShare = Annotated[float, Field(ge=-1, le=1)]
Reflectivity = Annotated[float, Field(gt=0, le=1)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Side = Literal["left", "right"]


def fill_in_usual(given: Any, usual: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return what is given of a thing of several kinds, with the usual values of the keys that its kind has."""
    if not isinstance(given, dict):
        return given
    said = {key: value for key, value in given.items() if value is not None}
    return {**usual.get(str(given.get("kind")), {}), **said}


def refuse_other_keys(thing: Any, usual: Mapping[str, Mapping[str, Any]], what: str) -> None:
    """Raise `ValueError` where a thing says a key that other kinds have and its own has not."""
    known = {key for keys in usual.values() for key in keys}
    said = sorted(key for key in known - usual[thing.kind].keys() if getattr(thing, key) is not None)
    if said:
        raise ValueError(f"{what}: a {thing.kind} has no {', '.join(said)}: leave that out")
