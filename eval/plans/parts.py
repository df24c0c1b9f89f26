"""The parts of a plan that name methods: variants and grids, with checks of their settings."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from cdpipe.core.names import require_table_name
from cdpipe.core.yamlfile import Document, Settings, apply_settings, suggest, validate
from cdpipe.model.config import PipelineConfig, load_config, preset_names
from eval.oracles.merge import OracleMerge
from eval.plans.worlds import OneOrMore, format_setting, get_group, raise_as_value_error, require_known_label
from scenarios.schema import Scenario

# a source that goes with every `extract.method`
_WITH_EVERY_RULE = "voxel-diff"
# settings of the query that regions from the truth still use
_OF_TRUE_REGIONS = ("query.radius_m", "query.suppression")


def has_effect_on_true_regions(setting: str) -> bool:
    """Return whether a setting has an effect on a variant with regions from the truth."""
    return get_group(setting) not in ("query", "regions") or get_key(setting) in _OF_TRUE_REGIONS


def get_key(setting: str) -> str:
    """Return the key of a `key=value`."""
    return setting.partition("=")[0]


def require_valid_setting(setting: str) -> str:
    """Return a `key=value` setting of the method if its key exists and accepts the value.

    Raises:
        ValueError: There is no such key, the value is wrong, or the key belongs to the world.
    """
    # `surface` is a list of the world and a section of the method
    if get_group(setting) in Scenario.model_fields and get_group(setting) not in PipelineConfig.model_fields:
        raise ValueError(
            "belongs to the world, not to the method: set it in the plan, under scenarios, "
            f'e.g. {{name: narrow, set: ["{setting}"]}}'
        )
    base = Document("", {"regions": {"source": _WITH_EVERY_RULE}})
    raise_as_value_error(lambda: validate(PipelineConfig, apply_settings(base, [setting])))
    return setting


def require_valid_settings(settings: Iterable[str]) -> None:
    """Check `key=value` settings of the method.

    Raises:
        ValueError: All mistakes in one message.
    """
    mistakes = []
    for setting in settings:
        try:
            require_valid_setting(setting)
        except ValueError as error:
            mistakes.append(str(error))
    if mistakes:
        raise ValueError("; ".join(dict.fromkeys(mistakes)))


def _require_known_preset(name: str) -> str:
    if name.endswith((".yaml", ".yml")):
        raise_as_value_error(lambda: load_config(name))
        require_table_name(Path(name).stem)
    elif name not in preset_names():
        raise ValueError(f"unknown preset{suggest(name, preset_names())} (known: {', '.join(preset_names())})")
    return name


def _require_valid_keys(keys: dict[str, tuple[Any, ...]]) -> dict[str, tuple[Any, ...]]:
    require_valid_settings(format_setting(key, value) for key, values in keys.items() for value in values)
    return keys


def _require_some(value: Any) -> Any:
    # pydantic's min_length counts only valid items and would report their mistakes twice
    if isinstance(value, list | dict | tuple) and not value:
        raise ValueError("at least one is needed")
    return value


def _require_braces(value: Any) -> Any:
    # a bare `oracle_merge:` would silently be no oracle
    if not isinstance(value, dict | OracleMerge):
        raise ValueError("expected {noise_m: ..., noise_deg: ...}; {} is without noise")
    return value


Label = Annotated[str, AfterValidator(require_known_label)]
PresetName = Annotated[str, AfterValidator(_require_known_preset)]
Setting = Annotated[str, AfterValidator(require_valid_setting)]
MethodSettings = Annotated[tuple[Setting, ...], OneOrMore]
NotEmpty = BeforeValidator(_require_some)
Values = Annotated[tuple[Any, ...], NotEmpty]


class Variant(Settings):
    """One method to run: a preset, settings over it, and perhaps a merge or regions from the truth."""

    preset: PresetName
    set: MethodSettings = ()
    per_scenario: dict[Label, MethodSettings] = Field(default_factory=dict)
    scenarios: Annotated[tuple[Label, ...], OneOrMore] = ()
    oracle_merge: Annotated[OracleMerge | None, BeforeValidator(_require_braces)] = None
    oracle_regions: bool = False

    @model_validator(mode="after")
    def _settings_act(self) -> Variant:
        for setting in self.every_setting:
            if self.oracle_merge is not None and get_group(setting) == "merge":
                raise ValueError(f"{setting} does nothing: this variant is merged by the truth; leave it out")
            if self.oracle_regions and not has_effect_on_true_regions(setting):
                raise ValueError(f"{setting} does nothing: this variant's regions are the truth's; leave it out")
        return self

    def keep_effective(self, settings: Iterable[str]) -> tuple[str, ...]:
        """Return those of some settings that the parts from the truth leave an effect."""
        return tuple(
            setting
            for setting in settings
            if not (self.oracle_merge is not None and get_group(setting) == "merge")
            and (not self.oracle_regions or has_effect_on_true_regions(setting))
        )

    @property
    def every_setting(self) -> tuple[str, ...]:
        """All settings over the preset, in any scenario."""
        return (*self.set, *itertools.chain(*self.per_scenario.values()))

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> Any:
        return {
            key: value
            for key, value in handler(self).items()
            if value is not None and value is not False and (key != "scenarios" or value)
        }


class Grid(Settings):
    """Every combination of values of some settings, and of some lists of settings, over one preset or several.

    A grid without `scenarios` runs in all worlds of its plan.
    """

    variant: Annotated[tuple[PresetName, ...], OneOrMore, NotEmpty]
    scenarios: Annotated[tuple[Label, ...], OneOrMore] = ()
    keys: Annotated[dict[str, Values], AfterValidator(_require_valid_keys)] = Field(default_factory=dict)
    each: Annotated[tuple[MethodSettings, ...], OneOrMore] = ()

    @model_validator(mode="after")
    def _varies(self) -> Grid:
        if not self.keys and not self.each:
            raise ValueError("expected keys, each or both: at least one is needed")
        if twice := self.keys.keys() & set(map(get_key, itertools.chain(*self.each))):
            raise ValueError(f"{min(twice)} stands in keys and in each: leave one of them out")
        return self

    @property
    def name(self) -> str:
        """Its presets."""
        return ", ".join(self.variant)

    @property
    def points(self) -> list[tuple[str, ...]]:
        """The settings of every combination: those of `each` first."""
        axes = [[(format_setting(key, value),) for value in values] for key, values in self.keys.items()]
        return [tuple(itertools.chain(*point)) for point in itertools.product(self.each or ((),), *axes)]

    @property
    def every_setting(self) -> tuple[str, ...]:
        """Every setting of any combination."""
        return tuple(dict.fromkeys(itertools.chain(*self.points)))

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> Any:
        document = handler(self)
        presets = document["variant"]
        document["variant"] = presets[0] if len(presets) == 1 else presets
        return {key: value for key, value in document.items() if value or key == "keys"}
