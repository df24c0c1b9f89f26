"""The worlds of a plan: a scenario with settings over it, what such a world is called, and what it is held against.

scenarios:
  - paper/site1                      # a scenario as it is
  - name: narrow
    set: ["platform.speed_mps=0.5"]  # written over the file before anything is drawn, and part of the world's name
    each:                            # the same again with each of these on top: one setting, or a list
      - sensor.range_noise=false
      - [sensor.range_noise=false, sensor.dropouts=false]

These are four worlds: `paper/site1`, `narrow[platform.speed_mps=0.5]` and
`narrow[platform.speed_mps=0.5,sensor.range_noise=false]`, and so on. The column `scenario` holds that name; `family` is
the scenario's own, whatever was set.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from cdpipe.config import PipelineConfig
from cdpipe.errors import InputError
from cdpipe.yamlfile import Settings, suggestion
from scenarios.library import check_scenario, scenario_names


def known_scenario(name: str) -> str:
    """Return the name of a shipped scenario or the path of a scenario's file, if there is such a one without mistakes.

    Raises:
        ValueError: There is none, or the file has mistakes.
    """
    names = scenario_names()
    if name.endswith((".yaml", ".yml")):
        told_as_values(lambda: check_scenario(name))
    elif name not in names:
        raise ValueError(f"unknown scenario{suggestion(name, names)} (known: {', '.join(names)})")
    return name


def told_as_values(check: Callable[[], object]) -> None:
    """Run a check of ours inside pydantic, which collects ValueErrors only."""
    try:
        check()
    except InputError as error:
        raise ValueError("; ".join(line.removeprefix(": ") for line in str(error).splitlines())) from error


def group_of(setting: str) -> str:
    """Return the first part of a setting's key."""
    return setting.partition("=")[0].partition(".")[0]


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


ScenarioName = Annotated[str, AfterValidator(known_scenario)]
OneOrMore = Annotated[tuple[str, ...], BeforeValidator(_as_list)]


class ScenarioItem(Settings):
    """One item of a plan's scenarios: a name, or a mapping; it stands for one world or for several."""

    name: ScenarioName
    set: tuple[str, ...] = ()
    each: tuple[OneOrMore, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if isinstance(value, str):
            return {"name": value}
        if not isinstance(value, dict):
            raise ValueError("expected a scenario's name, or {name: ..., set: [...], each: [...]}")
        return value

    @field_validator("set")
    @classmethod
    def _set_fits(cls, settings: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        if settings and "name" in info.data:
            _draws(info.data["name"], [settings])
        return settings

    @field_validator("each")
    @classmethod
    def _each_fits(cls, each: tuple[tuple[str, ...], ...], info: ValidationInfo) -> tuple[tuple[str, ...], ...]:
        if not all(each):
            raise ValueError("an empty list sets nothing: leave it out")
        if "name" in info.data:
            _draws(info.data["name"], [(*info.data.get("set", ()), *more) for more in each])
        return each

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> Any:
        if not self.set and not self.each:
            return self.name
        return {key: value for key, value in handler(self).items() if value}


@dataclass(frozen=True, slots=True)
class World:
    """A scenario, and the `a.b=value` settings that are written over it before a seed draws it."""

    name: str
    settings: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """What it is called in tables: the scenario, and its settings in brackets where there are any."""
        return f"{self.name}[{','.join(self.settings)}]" if self.settings else self.name


def worlds_of(items: Iterable[ScenarioItem]) -> list[World]:
    """Return the worlds that the items of a plan stand for, in their order."""
    return [
        World(item.name, settings)
        for item in items
        for settings in (item.set, *((*item.set, *own) for own in item.each))
    ]


def known_label(label: str) -> str:
    """Return a scenario's name, or the label of one with settings, if there is such a scenario.

    Raises:
        ValueError: There is none.
    """
    name, bracket, _ = label.partition("[")
    known_scenario(name if bracket and label.endswith("]") else label)
    return label


def world_slug(label: str) -> str:
    """Return a world's label as a folder name."""
    return re.sub(r"[^A-Za-z0-9._=,-]", "_", label.replace("/", "__"))


def settings_over(label: str, reference: str) -> str:
    """Return the settings that a world has on top of another one, "" where it is no such world.

    `narrow[a=1,b=2]` has "b=2" over `narrow[a=1]` and "a=1,b=2" over `narrow`.
    """
    head = f"{reference[:-1]}," if reference.endswith("]") else f"{reference}["
    return label[len(head) : -1] if label.startswith(head) and label.endswith("]") else ""


def references(labels: Iterable[str]) -> dict[str, str]:
    """Return the world that each world is held against: of those it adds settings to, the one with the fewest.

    Args:
        labels: All worlds of a run; one that adds to no other has no reference and is left out.
    """
    known = list(dict.fromkeys(labels))
    found = {label: [other for other in known if settings_over(label, other)] for label in known}
    return {label: min(others, key=len) for label, others in found.items() if others}


def _draws(name: str, worlds: Iterable[tuple[str, ...]]) -> None:
    """Refuse settings that do not fit a scenario, whatever the seed; each mistake is told once."""
    lines: dict[str, None] = {}
    for settings in worlds:
        of_method = [setting for setting in settings if group_of(setting) in PipelineConfig.model_fields]
        lines |= {
            f"{setting} belongs to the method, not to the world: set it under variants": None for setting in of_method
        }
        try:
            check_scenario(name, [setting for setting in settings if setting not in of_method])
        except InputError as error:
            lines |= dict.fromkeys(str(error).splitlines())
    if lines:
        raise ValueError("; ".join(lines))
