"""What is run: scenarios x seeds x variants, read from a plan file and spread out into cells.

name: example
description: what the plan is for
scenarios:                           # eval/worlds.py tells more
  - paper/site1
  - {name: paper/site2, each: [sensor.range_noise=false, sensor.mode=512x10]}  # as it is, and again with each of these
seeds: "20000:20002"                 # B excluded, in quotes; or a list
report: regions                      # also the tables and plots of `eval.region_table`; objects: `eval.object_table`
until: null                          # merge: map, describe, merge, and no further; only the columns of the merge
variants:
  - preset: paper                    # a shipped preset or the path of a .yaml file
    set: ["extract.voxel_m=0.4"]     # part of the variant's name
    per_scenario: {paper/site2: ["query.radius_m=10"]}   # belongs to the site, whatever is set there; not to the name
  - preset: tunnelcd
    oracle_merge: {noise_m: 0.1, noise_deg: 0.2}         # merged by the truth: eval/oracles.py; {} is without noise
    oracle_regions: true                                 # a region around each change: eval/oracle_regions.py
grid:
  - variant: tunnelcd                # a preset
    scenarios: [paper/site1]         # out of the plan's; one world of several as paper/site2[sensor.mode=512x10]
    keys: {extract.voxel_m: [0.2, 0.4], query.radius_m: [3, 4.5]}
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from cdpipe.config import PipelineConfig, load_config, preset_names
from cdpipe.errors import InputError
from cdpipe.yamlfile import Document, Settings, read_yaml, suggestion, validated, with_settings
from eval.oracles import OracleMerge
from eval.worlds import (
    OneOrMore,
    ScenarioItem,
    World,
    group_of,
    known_label,
    setting_text,
    told_as_values,
    world_slug,
    worlds_of,
)
from scenarios.schema import Scenario

ORACLE_MERGE, ORACLE_REGIONS = "oracle-merge", "oracle-regions"
_ORACLE_PRESET = "tunnelcd"
_AFTER_MERGE = ("query", "extract", "outlier", "cluster", "m3c2", "dufomap")
# what a region around each change still takes from the query
_OF_TRUE_REGIONS = ("query.radius_m", "query.suppression")
_LONGEST_SLUG = 200  # file systems take names of 255 bytes
_TOO_LONG = "is too long for a folder's name: put the settings into a file of their own"


def parse_seeds(value: Any) -> tuple[int, ...]:
    """Return the seeds of "A:B" (B excluded), of "A", or of a list of non-negative numbers.

    Raises:
        ValueError: It is something else, or names no seed, or one twice.
    """
    rule = 'expected "A:B" in quotes (B excluded) or a list of seeds, all 0 or larger'
    if isinstance(value, str):
        match = re.fullmatch(r"(\d+)(?::(\d+))?", value.strip())
        if match is None:
            raise ValueError(rule)
        first = int(match[1])
        value = list(range(first, int(match[2]))) if match[2] else [first]
        if not value:
            raise ValueError(f"{rule}; this range is empty")
    # YAML 1.1 reads an unquoted 1:40 as the number 100, so a bare number is not taken for a seed
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(rule)
    if not all(type(seed) is int and seed >= 0 for seed in value) or len(set(value)) < len(value):
        raise ValueError(f"{rule}, none twice")
    return tuple(value)


def _known_preset(name: str) -> str:
    if name.endswith((".yaml", ".yml")):
        told_as_values(lambda: load_config(name))
    elif name not in preset_names():
        raise ValueError(f"unknown preset{suggestion(name, preset_names())} (known: {', '.join(preset_names())})")
    return name


def _valid_setting(setting: str) -> str:
    if group_of(setting) in Scenario.model_fields:
        raise ValueError(
            "belongs to the world, not to the method: set it in the plan, under scenarios, "
            f'e.g. {{name: narrow, set: ["{setting}"]}}'
        )
    told_as_values(lambda: validated(PipelineConfig, with_settings(Document("", {}), [setting])))
    return setting


def _valid_keys(keys: dict[str, tuple[Any, ...]]) -> dict[str, tuple[Any, ...]]:
    for key, values in keys.items():
        for value in values:
            _valid_setting(setting_text(key, value))
    return keys


def _not_empty(value: Any) -> Any:
    # pydantic's own min_length counts only the items that passed, and so repeats their mistakes
    if isinstance(value, list | dict | tuple) and not value:
        raise ValueError("at least one is needed")
    return value


def _with_braces(value: Any) -> Any:
    # a bare `oracle_merge:` would be no oracle at all, and nothing would tell
    if not isinstance(value, dict | OracleMerge):
        raise ValueError("expected {noise_m: ..., noise_deg: ...}; {} is without noise")
    return value


Label = Annotated[str, AfterValidator(known_label)]
PresetName = Annotated[str, AfterValidator(_known_preset)]
Setting = Annotated[str, AfterValidator(_valid_setting)]
MethodSettings = Annotated[tuple[Setting, ...], OneOrMore]
NotEmpty = BeforeValidator(_not_empty)
Values = Annotated[tuple[Any, ...], NotEmpty]
Until = Literal["merge"]


class Variant(Settings):
    """One method to run: a preset and what is set over it, perhaps merged or told its regions by the truth."""

    preset: PresetName
    set: MethodSettings = ()
    per_scenario: dict[Label, MethodSettings] = Field(default_factory=dict)
    oracle_merge: Annotated[OracleMerge | None, BeforeValidator(_with_braces)] = None
    oracle_regions: bool = False

    @model_validator(mode="after")
    def _settings_act(self) -> Variant:
        for setting in self.every_setting:
            if self.oracle_merge is not None and group_of(setting) == "merge":
                raise ValueError(f"{setting} does nothing: this variant is merged by the truth; leave it out")
            if self.oracle_regions and not _acts_on_true_regions(setting):
                raise ValueError(f"{setting} does nothing: this variant's regions are the truth's; leave it out")
        return self

    @property
    def every_setting(self) -> tuple[str, ...]:
        """What is set over the preset anywhere."""
        return (*self.set, *itertools.chain(*self.per_scenario.values()))

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> Any:
        return {key: value for key, value in handler(self).items() if value is not None and value is not False}


class Grid(Settings):
    """Every combination of some values of some settings, over one preset."""

    variant: PresetName
    scenarios: Annotated[tuple[Label, ...], NotEmpty]
    keys: Annotated[dict[str, Values], NotEmpty, AfterValidator(_valid_keys)]


class Plan(Settings):
    """What to run; `cells` spreads it out."""

    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    scenarios: Annotated[tuple[ScenarioItem, ...], NotEmpty]
    seeds: Annotated[tuple[int, ...], BeforeValidator(parse_seeds)]
    until: Until | None = None
    report: Literal["regions", "objects"] | None = None
    variants: Annotated[tuple[Variant, ...], NotEmpty]
    grid: tuple[Grid, ...] = ()

    @field_validator("scenarios")
    @classmethod
    def _worlds_differ(cls, items: tuple[ScenarioItem, ...]) -> tuple[ScenarioItem, ...]:
        known: set[object] = set()
        mistakes: list[InitErrorDetails] = []
        for place, item in enumerate(items):
            for index, world in enumerate(worlds_of([item])):
                folder = world_slug(world.label)
                names = {folder, (world.name, world.settings)}
                rule = _TOO_LONG if len(folder) > _LONGEST_SLUG else "is listed twice" if known & names else ""
                if rule:
                    error = PydanticCustomError("world", "{rule}", {"rule": f"scenario {world.label} {rule}"})
                    where = (place, "each", index - 1) if index else (place,)
                    written = ",".join(world.own) or world.name
                    mistakes.append(InitErrorDetails(type=error, loc=where, input=written))
                known |= names
        if mistakes:
            raise ValidationError.from_exception_data(cls.__name__, mistakes)
        return items

    @model_validator(mode="after")
    def _settings_act(self) -> Plan:
        asked = [(variant.preset, setting) for variant in self.variants for setting in variant.every_setting]
        asked += [(f"the grid of {grid.variant}", key) for grid in self.grid for key in grid.keys]
        for who, setting in asked:
            if self.until == "merge" and group_of(setting) in _AFTER_MERGE:
                raise ValueError(
                    f"{setting} of {who} does nothing: the plan ends at the merge; leave it out, or leave out until"
                )
        if self.until == "merge" and any(variant.oracle_regions for variant in self.variants):
            raise ValueError(
                "oracle_regions does nothing: the plan ends at the merge; leave it out, or leave out until"
            )
        return self

    @model_validator(mode="after")
    def _report_has_its_subject(self) -> Plan:
        if self.report is not None and self.until == "merge":
            raise ValueError(
                f"report: {self.report} needs {self.report}, and the plan ends at the merge; leave one of them out"
            )
        return self

    @model_validator(mode="after")
    def _parts_fit(self) -> Plan:
        worlds = worlds_of(self.scenarios)
        names = dict.fromkeys(name for world in worlds for name in (world.name, world.label))
        asked = [
            (f"per_scenario of {variant.preset}", name) for variant in self.variants for name in variant.per_scenario
        ]
        asked += [(f"the grid of {grid.variant}", name) for grid in self.grid for name in grid.scenarios]
        for who, name in asked:
            if name not in names:
                raise ValueError(f"{who} names {name!r}, which is not in scenarios{suggestion(name, names)}")
        for world in worlds:
            folders = [slug(method.variant) for method in _methods(self, world)]
            for folder in folders:
                if folders.count(folder) > 1:
                    raise ValueError(f"variant {folder} stands twice in the plan for {world.label}")
                if len(folder) > _LONGEST_SLUG:
                    raise ValueError(f"variant {folder} {_TOO_LONG}")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One scenario, one seed, one variant: one row of results.csv.

    Attributes:
        scenario: Label of its world: the scenario's name, and what is set over it in brackets.
        seed: Its seed.
        preset: Name of the preset.
        variant: Preset and the settings that name the variant.
        config: The effective settings.
        oracle: What merges instead of the method, or None.
        until: Where it ends, None for the whole method.
        oracle_regions: Whether the regions are the truth's.
    """

    scenario: str
    seed: int
    preset: str
    variant: str
    config: PipelineConfig
    oracle: OracleMerge | None = None
    until: Until | None = None
    oracle_regions: bool = False


@dataclass(frozen=True, slots=True)
class _Method:
    """A variant or a grid point in one world: settings that make its name, and those that the site asks for."""

    preset: str
    named: tuple[str, ...]
    silent: tuple[str, ...] = ()
    oracle: OracleMerge | None = None
    oracle_regions: bool = False

    @property
    def variant(self) -> str:
        return variant_name(self.preset, self.named, self.oracle, oracle_regions=self.oracle_regions)

    def config(self) -> PipelineConfig:
        config = load_config(self.preset, [*self.named, *self.silent])
        if self.oracle_regions and config.method != "descriptor":
            raise InputError(f"{self.variant}: oracle_regions is for method: descriptor, this one is {config.method}")
        return config

    def cell(self, world: World, seed: int, config: PipelineConfig, until: Until | None) -> Cell:
        return Cell(
            scenario=world.label,
            seed=seed,
            preset=_stem(self.preset),
            variant=self.variant,
            config=config,
            oracle=self.oracle,
            until=until,
            oracle_regions=self.oracle_regions,
        )


def load_plan(name_or_path: str) -> Plan:
    """Read a shipped plan by name, or any plan by the path of its .yaml file.

    Raises:
        InputError: It is unknown or has mistakes; all of them at once, one line each.
    """
    if name_or_path.endswith((".yaml", ".yml")):
        return validated(Plan, read_yaml(Path(name_or_path)))
    names = plan_names()
    if name_or_path not in names:
        raise InputError(
            f"plan {name_or_path!r} is unknown{suggestion(name_or_path, names)} "
            f"(known: {', '.join(names)}, or the path of a .yaml file)"
        )
    file = _plans() / f"{name_or_path}.yaml"
    return validated(Plan, read_yaml(Path(f"{name_or_path}.yaml"), file.read_text()))


def plan_names() -> list[str]:
    """Return the names of the shipped plans."""
    return sorted(entry.name.removesuffix(".yaml") for entry in _plans().iterdir() if entry.name.endswith(".yaml"))


def changed_plan(
    plan: Plan, *, seeds: str | None = None, settings: Sequence[str] = (), grid: Sequence[str] = ()
) -> Plan:
    """Return the plan with --seeds, --set and --grid of the command line applied.

    Args:
        plan: The plan.
        seeds: "A:B", replaces the plan's seeds.
        settings: `key=value`, written over every variant and every grid point.
        grid: `key=v1,v2`; every variant is run at every combination. The plan's own grids stay as they are. Variants
            that are merged by the truth get neither settings nor grids of `merge`, those whose regions are the truth's
            none of `query` but radius and suppression.

    Raises:
        InputError: One of them cannot be read, or its key or value is wrong.
    """
    axes = [_grid_axis(text) for text in grid]
    for setting in (*settings, *itertools.chain(*axes)):
        try:
            _valid_setting(setting)
        except ValueError as error:
            raise InputError(f"--set {setting}: {error}") from error
    document = plan.model_dump(mode="json")
    if seeds is not None:
        try:
            document["seeds"] = parse_seeds(seeds)
        except ValueError as error:
            raise InputError(f"--seeds {seeds}: {error}") from error
    overridden = {_key(setting) for setting in (*settings, *itertools.chain(*axes))}
    document["variants"] = [
        {
            **variant,
            "set": [*_without(variant["set"], overridden), *added],
            "per_scenario": {name: _without(own, overridden) for name, own in variant["per_scenario"].items()},
        }
        for variant in document["variants"]
        for added in _additions(variant, axes, settings)
    ]
    for each in document["grid"]:
        each["keys"].update({_key(setting): [yaml.safe_load(setting.partition("=")[2])] for setting in settings})
    return validated(Plan, Document(f"plan {plan.name} with the settings of the command line", document))


def cells(plan: Plan) -> list[Cell]:
    """Return all cells: by scenario, then seed, then variant, grids last.

    Raises:
        InputError: The settings of a variant contradict each other or its preset.
    """
    found: list[Cell] = []
    for world in worlds_of(plan.scenarios):
        methods = [(method, method.config()) for method in _methods(plan, world)]
        found += [
            method.cell(world, seed, config, plan.until)
            for seed in plan.seeds[: world.n_seeds]
            for method, config in methods
        ]
    return found


def planned_cases(plan: Plan) -> set[tuple[str, int, str]]:
    """Return (scenario, seed, variant) of all cells."""
    return {
        (world.label, seed, method.variant)
        for world in worlds_of(plan.scenarios)
        for method in _methods(plan, world)
        for seed in plan.seeds[: world.n_seeds]
    }


def variant_name(
    preset: str, settings: Iterable[str], oracle: OracleMerge | None = None, *, oracle_regions: bool = False
) -> str:
    """Return the preset's name, followed by its settings in brackets where there are any.

    What takes its merge or its regions from the truth is called `oracle-merge`, `oracle-regions` or, both, joined by a
    plus; any preset but `tunnelcd` and the noise of the merge come first in the brackets.
    """
    stem = _stem(preset)
    if oracle is not None or oracle_regions:
        of_preset = [] if stem == _ORACLE_PRESET else [f"preset={stem}"]
        settings = (*of_preset, *(() if oracle is None else oracle.settings), *settings)
        stem = "+".join([ORACLE_MERGE] * (oracle is not None) + [ORACLE_REGIONS] * oracle_regions)
    joined = ",".join(settings)
    return f"{stem}[{joined}]" if joined else stem


def slug(variant: str) -> str:
    """Return a variant's name as a folder name."""
    return re.sub(r"[^A-Za-z0-9._=,-]", "_", variant)


def _methods(plan: Plan, world: World) -> list[_Method]:
    places = dict.fromkeys((world.name, world.label))
    methods = [
        _Method(
            preset=variant.preset,
            named=variant.set,
            silent=tuple(setting for place in places for setting in variant.per_scenario.get(place, ())),
            oracle=variant.oracle_merge,
            oracle_regions=variant.oracle_regions,
        )
        for variant in plan.variants
    ]
    for grid in plan.grid:
        if not places.keys().isdisjoint(grid.scenarios):
            methods += [_Method(grid.variant, point) for point in _points(grid.keys)]
    return methods


def _points(keys: Mapping[str, Sequence[Any]]) -> list[tuple[str, ...]]:
    axes = [[setting_text(key, value) for value in values] for key, values in keys.items()]
    return list(itertools.product(*axes))


def _additions(
    variant: Mapping[str, Any], axes: Sequence[Sequence[str]], settings: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return what the command line adds to a variant, once for each copy of it."""
    if "oracle_merge" in variant:
        axes = [axis for axis in axes if group_of(axis[0]) != "merge"]
        settings = [setting for setting in settings if group_of(setting) != "merge"]
    if variant.get("oracle_regions"):
        axes = [axis for axis in axes if _acts_on_true_regions(axis[0])]
        settings = [setting for setting in settings if _acts_on_true_regions(setting)]
    return [(*point, *settings) for point in itertools.product(*axes)]


def _acts_on_true_regions(setting: str) -> bool:
    """Tell whether a setting does anything where the regions are the truth's."""
    return group_of(setting) != "query" or _key(setting) in _OF_TRUE_REGIONS


def _grid_axis(text: str) -> list[str]:
    key, equals, values = text.partition("=")
    if not equals or not key or not all(values.split(",")):
        raise InputError(f"--grid {text}: expected key=v1,v2, e.g. extract.voxel_m=0.2,0.4")
    return [f"{key}={value}" for value in values.split(",")]


def _key(setting: str) -> str:
    return setting.partition("=")[0]


def _without(settings: Iterable[str], keys: set[str]) -> list[str]:
    return [setting for setting in settings if _key(setting) not in keys]


def _stem(preset: str) -> str:
    return Path(preset).stem if preset.endswith((".yaml", ".yml")) else preset


def _plans() -> Traversable:
    return resources.files("eval") / "plans"
