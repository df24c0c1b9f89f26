"""The kinds of value that a setting may have."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag

from cdpipe.core.yamlfile import suggest


def _require_width(value: Any) -> Any:
    # pydantic would ask for the word alone
    if value != "width":
        raise ValueError(f"input should be a length in metres, above 0, or 'width'{suggest(str(value), ['width'])}")
    return value


Positive = Annotated[float, Field(gt=0)]
# Smaller cells hold only noise, and `cell_keys` could not number them a kilometre from the origin; of larger ones, one
# holds the whole tunnel.
Cell = Annotated[float, Field(ge=0.01, le=1000)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
NonNegative = Annotated[float, Field(ge=0)]
# A length, or the word; either kind of input breaks the rule of its own kind alone.
LengthOrWidth = Annotated[
    Annotated[Positive, Tag("length")] | Annotated[Literal["width"], BeforeValidator(_require_width), Tag("word")],
    Discriminator(lambda value: "word" if isinstance(value, str) else "length"),
]
