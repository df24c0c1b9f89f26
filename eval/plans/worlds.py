"""The worlds of a plan: a scenario with settings over it, what such a world is called, and what it is held against.

scenarios:
  - paper/site1                      # a scenario as it is
  - name: narrow
    set: ["platform.speed_mps=0.5"]  # written over the file before anything is drawn, and part of the world's name
    each:                            # the same again with each of these on top: one setting, or a list
      - sensor.range_noise=false
      - [sensor.range_noise=false, sensor.dropouts=false]
    pair_kind: clean                 # what the plan expects of the merge there: the column of that name, nothing else
    n_seeds: 6                       # only the first six of the plan's seeds

These are four worlds: `paper/site1`, `narrow[platform.speed_mps=0.5]` and
`narrow[platform.speed_mps=0.5][sensor.range_noise=false]`, and so on. The column `scenario` holds that name; `family`
is the scenario's own, whatever was set. What comes on top stands in brackets of its own, so that the name alone tells
what a world is held against, whichever plan ran it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Settings, suggest
from cdpipe.model.config import PipelineConfig
from scenarios import check_scenario, scenario_names


def known_scenario(name: str) -> str:
    """Return the name of a shipped scenario or the path of a scenario's file, if there is such a one without mistakes.

    Raises:
        ValueError: There is none, or the file has mistakes.
    """
    names = scenario_names()
    if name.endswith((".yaml", ".yml")):
        told_as_values(lambda: check_scenario(name))
    elif name not in names:
        raise ValueError(f"unknown scenario{suggest(name, names) or ': `tunnelcd list` shows all'}")
    return name


def told_as_values(check: Callable[[], object]) -> None:
    """Run a check of ours inside pydantic, which collects ValueErrors only."""
    try:
        check()
    except InputError as error:
        raise ValueError("; ".join(_without_option(str(error)))) from error


def setting_text(key: str, value: Any) -> str:
    """Return `key=value` as --set takes it."""
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000)
    return f"{key}={text.removesuffix('...' + chr(10)).strip()}"


def group_of(setting: str) -> str:
    """Return the first part of a setting's key."""
    return setting.partition("=")[0].partition(".")[0]


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _one_spelling(setting: str) -> str:
    """Write the value as YAML reads it: `off` and `false ` are the same world as `false`."""
    key, equals, text = setting.partition("=")
    try:
        return setting_text(key, yaml.safe_load(text)) if equals else setting
    except yaml.YAMLError:
        return setting


def _fit_on_top(settings: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
    if not settings:
        raise ValueError("an empty list sets nothing: leave it out")
    if "name" in info.data:
        _check_draws(info.data["name"], (*info.data.get("set", ()), *settings))
    return settings


PairKind = Literal["clean", "drift", "smooth", "disjoint"]
ScenarioName = Annotated[str, AfterValidator(known_scenario)]
OneOrMore = BeforeValidator(_as_list)
WorldSettings = Annotated[tuple[Annotated[str, AfterValidator(_one_spelling)], ...], OneOrMore]


class ScenarioItem(Settings):
    """One item of a plan's scenarios: a name, or a mapping; it stands for one world or for several."""

    name: ScenarioName
    set: WorldSettings = ()
    each: Annotated[tuple[Annotated[WorldSettings, AfterValidator(_fit_on_top)], ...], OneOrMore] = ()
    pair_kind: PairKind | None = None
    n_seeds: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if isinstance(value, str):
            return {"name": value}
        if not isinstance(value, dict):
            raise ValueError("expected a scenario's name, or {name: ..., set: [...], each: [...], pair_kind: ...}")
        return value

    @field_validator("set")
    @classmethod
    def _set_fits(cls, settings: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        if settings and "name" in info.data:
            _check_draws(info.data["name"], settings)
        return settings

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = {key: value for key, value in handler(self).items() if value}
        return self.name if list(written) == ["name"] else written


@dataclass(frozen=True, slots=True)
class World:
    """A scenario, and the `a.b=value` settings that are written over it before a seed draws it.

    Attributes:
        name: The scenario.
        common: What its item sets in all of its worlds.
        own: What this world has on top.
        pair_kind: What its item calls its pairs, "" where it does not say; no part of the label.
        n_seeds: How many of the plan's seeds it is run with, the first ones; None for all.
    """

    name: str
    common: tuple[str, ...] = ()
    own: tuple[str, ...] = ()
    pair_kind: str = ""
    n_seeds: int | None = None

    @property
    def settings(self) -> tuple[str, ...]:
        """All that is set, in the order in which it is written over the scenario."""
        return (*self.common, *self.own)

    @property
    def label(self) -> str:
        """What it is called in tables: the scenario, and its settings in brackets where there are any."""
        return self.name + "".join(f"[{','.join(part)}]" for part in (self.common, self.own) if part)


def worlds_of(items: Iterable[ScenarioItem]) -> list[World]:
    """Return the worlds that the items of a plan stand for, in their order."""
    return [
        World(item.name, item.set, own, item.pair_kind or "", item.n_seeds)
        for item in items
        for own in ((), *item.each)
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


def references(cases: Iterable[tuple[str, str, int]]) -> dict[tuple[str, str], str]:
    """Return the world that each world is held against, for each variant that both were run with.

    That is the nearest world whose label is its own less one or more brackets at the end: `narrow[a=1]` for
    `narrow[a=1][b=2]`, or else `narrow`.

    Args:
        cases: World, variant and seed of each row of a run.

    Returns:
        The other world by (world, variant); nothing where there is none with a seed in common.
    """
    seeds: dict[tuple[str, str], set[int]] = {}
    for world, variant, seed in cases:
        seeds.setdefault((world, variant), set()).add(seed)
    found: dict[tuple[str, str], str] = {}
    for (world, variant), own in seeds.items():
        shared = (other for other in _barer(world) if not own.isdisjoint(seeds.get((other, variant), ())))
        if (nearest := next(shared, None)) is not None:
            found[world, variant] = nearest
    return found


def settings_over(world: str, reference: str) -> str:
    """Return the settings that a world has on top of its reference: "a=1,b=2" for `narrow[a=1][b=2]` over `narrow`."""
    return world[len(reference) + 1 : -1].replace("][", ",")


def _barer(label: str) -> Iterator[str]:
    """Yield what stands before each bracket of a label, longest first; not all of it need be a world."""
    if label.endswith("]"):
        yield from (label[:place] for place in range(len(label) - 1, 0, -1) if label[place] == "[")


def _check_draws(name: str, settings: tuple[str, ...]) -> None:
    """Refuse settings that do not fit a scenario, whatever the seed."""
    of_method = [setting for setting in settings if group_of(setting) in PipelineConfig.model_fields]
    lines = [f"{setting} belongs to the method, not to the world: set it under variants" for setting in of_method]
    try:
        check_scenario(name, [setting for setting in settings if setting not in of_method])
    except InputError as error:
        lines += _without_option(str(error))
    if lines:
        raise ValueError("; ".join(dict.fromkeys(lines)))


def _without_option(told: str) -> list[str]:
    """Return the lines of an error without the option of the command line that they seem to come from."""
    return [re.sub(r"^(--set)?:? ", "", line) for line in told.splitlines()]
