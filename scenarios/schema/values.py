"""The kinds of value that a key may have, and rules that several models share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from cdpipe.core.yamlfile import Settings

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


class Lean(Settings):
    """Settings that leave keys added later out of their dump while these have their defaults.

    So the truth of an older scenario keeps its bytes.
    """

    _LATER: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _leave_out(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        dumped: dict[str, Any] = handler(self)
        is_later = {key: key in self._LATER and getattr(self, key) == fields[key].default for key in dumped}
        return {key: value for key, value in dumped.items() if not is_later[key]}
