"""Every key of a scenario, with its field and what the comment beside it says."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from scenarios.schema.scenario import Scenario

_FIELD = re.compile(r"    (\w+): ")


@dataclass(frozen=True, slots=True, eq=False)
class Key:
    """A key.

    Attributes:
        name: Dotted; NAME stands for the name of an item of a list, N for the position of one that has no name.
        field: Its field.
        meaning: The comment beside it, "" where its name says all.
    """

    name: str
    field: FieldInfo
    meaning: str


def list_keys() -> list[Key]:
    """Return every key of a scenario. Where a part is like an earlier one, it is one key that names that."""
    return list(_walk(Scenario, "", {}))


def _walk(model: type[BaseModel], start: str, seen: dict[type[BaseModel], str]) -> Iterator[Key]:
    comments = _read_comments(model)
    for name, field in sorted(model.model_fields.items(), key=lambda item: _is_list(item[1].annotation)):
        key, meaning, part = f"{start}{name}", comments.get(name, ""), _find_model(field.annotation)
        if part is None:
            yield Key(key, field, meaning)
            continue
        if _is_list(field.annotation):
            key += ".NAME" if "name" in part.model_fields else ".N"
        if part in seen:
            yield Key(key, field, "; ".join(filter(None, (meaning, f"keys as of {seen[part]}"))))
            continue
        seen[part] = key
        if field.default is None:  # a part that may be left out
            yield Key(key, field, meaning or (part.__doc__ or "").partition(".")[0])
        yield from _walk(part, f"{key}.", seen)


def _is_list(annotation: Any) -> bool:
    return get_origin(annotation) is tuple and _find_model(annotation) is not None


def _find_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model that a field holds, alone, in a list, or where it is there."""
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for each in get_args(annotation) if (found := _find_model(each)) is not None), None)


def _read_comments(model: type[BaseModel]) -> dict[str, str]:
    """Return the comment on the lines of each field."""
    found: dict[str, str] = {}
    name = ""
    for line in inspect.getsource(model).splitlines():
        if match := _FIELD.match(line):
            name = match[1]
        elif line.startswith(("    def ", "    @")):
            break
        _, mark, comment = line.rpartition("  # ")
        if name and mark:
            found[name] = comment
    return found
