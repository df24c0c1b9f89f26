"""What `tunnelcd list` names: scenarios, plans, presets, sensors and settings with their descriptions, and more."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from textwrap import shorten, wrap
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from cdpipe.core.plugins import METHODS, METRICS, describe_entry_point, entry_points
from cdpipe.core.yamlfile import read_head_comment, read_yaml
from cdpipe.methods.registry import describe_method
from cdpipe.model.config import preset_files, setting_fields
from cdpipe.sensor.ouster import describe_profile, profile_names
from eval.graft.adapters import list_adapters
from eval.plans.files import plan_files, read_plan
from eval.tables.columns import RESULT_COLUMNS
from scenarios import prop_names
from scenarios.catalogue import describe_prop, family_files
from scenarios.schema.keys import list_keys

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

_UNITS = {"m": "m", "m2": "m2", "m3": "m3", "mm": "mm", "s": "s", "deg": "deg", "rad": "rad"}
_WORLD_UNITS = {"mps": "m/s", "hz": "Hz", "percent": "%", "share": "share"}
_RATE = re.compile(r"(?:(?:^|_)([a-z]+)_)?per_(100m|m[23]?)$")  # of the last part of a key, as yaw_deg_per_m
WITH_DEFAULTS = ("settings", "world")


@dataclass(frozen=True, slots=True)
class Entry:
    """A name and its description, "" where there is none; of a setting its default, and its unit or values, too."""

    name: str
    description: str = ""
    default: Any = None
    unit: str = ""


def list_entries(kind: str) -> list[Entry]:
    """Return what there is of a kind, one of `KINDS`.

    Raises:
        InputError: A file of that kind cannot be read.
    """
    return list(_LISTED[kind]())


def describe_entry(entry: Entry, others: Sequence[Entry], columns: int) -> str:
    """Return one line of at most so many columns: the name, as wide as the widest of all, and what fits after it."""
    start = f"{entry.name:<{max(len(each.name) for each in others)}}  "
    return (start + shorten(entry.description, max(columns - len(start), 20), placeholder=" ...")).rstrip()


def describe_setting(entry: Entry, columns: int) -> list[str]:
    """Return the lines about a setting: key, default and unit or values; below them what it means."""
    words = {"True": "true", "False": "false", "None": "null"}
    default = words.get(str(entry.default), entry.default)
    indent = "    "
    head = f"{entry.name} = {default}".rstrip() + (f"  [{entry.unit}]" if entry.unit else "")
    return [head, *wrap(entry.description, columns, initial_indent=indent, subsequent_indent=indent)]


def _scenarios() -> Iterable[Entry]:
    return (Entry(name, _one_line(read_yaml(path).get("description"))) for name, path in sorted(family_files().items()))


def _plans() -> Iterable[Entry]:
    return (Entry(name, _one_line(read_plan(name).get("description"))) for name in plan_files())


def _presets() -> Iterable[Entry]:
    """Yield the presets; the comment at the head of the file describes one, up to its first full stop."""
    for name, file in preset_files().items():
        yield Entry(name, _one_line(read_head_comment(file)))


def _settings() -> Iterable[Entry]:
    for key, field in setting_fields():
        yield Entry(key, field.description or "", field.default, _unit(key, field))


def _unit(key: str, field: FieldInfo) -> str:
    """Return the unit of a setting, by the end of its name; else its values."""
    if get_origin(field.annotation) is Literal:
        return " | ".join(map(str, get_args(field.annotation)))
    if isinstance(field.default, bool):
        return "true | false"
    unit = _UNITS.get(key.rpartition("_")[2], "")
    if unit:
        return f"{unit} | {field.default}" if isinstance(field.default, str) else unit
    limits = {type(limit).__name__: getattr(limit, type(limit).__name__.lower()) for limit in _limits(field)}
    if limits.get("Ge") == 0 and limits.get("Le") == 1:
        return "share"
    # a number, or nothing; the number may be annotated
    if any(int in (part, *get_args(part)) for part in get_args(field.annotation)):
        return "number | null"
    return {int: "number", float: "factor", str: "text", dict: "keys and values"}.get(type(field.default), "")


def _world() -> Iterable[Entry]:
    """Yield the keys of a scenario; a key that must be given has no default."""
    for key in list_keys():
        default = "" if key.field.is_required() else key.field.get_default(call_default_factory=True)
        shown = [*default] if isinstance(default, tuple) else default
        yield Entry(key.name, key.meaning, shown, _world_unit(key.name, key.field))


def _world_unit(key: str, field: FieldInfo) -> str:
    """Return the unit of a key of a scenario, by the end of its name; else its values."""
    if rate := _RATE.search(key.rpartition(".")[2]):
        return f"{rate[1] or 1}/{rate[2]}"
    return _WORLD_UNITS.get(key.rpartition("_")[2]) or _unit(key, field)


def _limits(field: FieldInfo) -> list[Any]:
    return [each for each in field.metadata if type(each).__name__ in ("Ge", "Le")]


def _recordings() -> Iterable[Entry]:
    for name, adapter in list_adapters().items():
        told = [adapter.description, f"licence: {adapter.licence}", adapter.url]
        yield Entry(name, "; ".join([*told, *(["cannot be grafted"] if adapter.unreadable else [])]))


def _metrics() -> Iterable[Entry]:
    """Yield the main columns of results.csv, and the metrics of plugins."""
    yield from (Entry(column.key, _one_line(column.meaning)) for column in RESULT_COLUMNS)
    yield from (Entry(name, describe_entry_point(METRICS, name)) for name in entry_points(METRICS))


def _one_line(text: object) -> str:
    """Return the first sentence of a text on one line."""
    words = " ".join(str(text or "").split())
    question, mark, _ = words.partition("? ")
    return (question + mark.strip() if mark else words.partition(". ")[0]).rstrip(".")


_LISTED: dict[str, Callable[[], Iterable[Entry]]] = {
    "scenarios": _scenarios,
    "props": lambda: (Entry(name, describe_prop(name)) for name in prop_names()),
    "plans": _plans,
    "presets": _presets,
    "methods": lambda: (Entry(name, describe_method(name)) for name in entry_points(METHODS)),
    "metrics": _metrics,
    "sensors": lambda: (Entry(name, _one_line(describe_profile(name))) for name in profile_names()),
    "recordings": _recordings,
    "settings": _settings,
    "world": _world,
}
