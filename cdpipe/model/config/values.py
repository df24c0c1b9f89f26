"""The kinds of value that a setting may have."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

Positive = Annotated[float, Field(gt=0)]
# Smaller cells hold only noise, and `cell_keys` could not number them a kilometre from the origin.
Cell = Annotated[float, Field(ge=0.01)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
NonNegative = Annotated[float, Field(ge=0)]
# A length, or the word; either kind of input breaks the rule of its own kind alone.
LengthOrWidth = Annotated[
    Annotated[Positive, Tag("length")] | Annotated[Literal["width"], Tag("word")],
    Discriminator(lambda value: "word" if isinstance(value, str) else "length"),
]
