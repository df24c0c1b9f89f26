"""The worlds of a plan: scenarios with settings, the labels of worlds, and the reference of each world.

scenarios:
  - paper/site1                      # a scenario as it is
  - name: narrow
    set: ["platform.speed_mps=0.5"]  # written over the file before the draw; part of the world's label
    each:                            # one more world for each of these, added to `set`: one setting, or a list
      - sensor.range_noise=false
      - [sensor.range_noise=false, sensor.dropouts=false]
    pair_kind: clean                 # kind of pair for the merge tables; fills the column of that name
    n_seeds: 6                       # only the first six of the plan's seeds
    odometry: own                    # the odometry of both sessions: own, kiss-icp or random-walk, or a list of them

These are four worlds: `paper/site1`, `narrow[platform.speed_mps=0.5]` and
`narrow[platform.speed_mps=0.5][sensor.range_noise=false]`, and so on. The column `scenario` holds that name; `family`
is the scenario's own. Settings of `each` have brackets of their own, so that the label alone determines the reference
of a world in any plan. An odometry that is not the scenario's own has the first brackets: `narrow[odometry=kiss-icp]`,
`narrow[odometry=kiss-icp][sensor.range_noise=false]`. An item without `odometry` has that of the plan.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

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
from cdpipe.core.files import YamlError, dump_yaml, parse_yaml_value
from cdpipe.core.names import path_part
from cdpipe.core.yamlfile import Settings, suggest
from cdpipe.model.config import PipelineConfig
from scenarios import check_scenario, scenario_names
from scenarios.catalogue import clean_family
from scenarios.schema import Scenario


def require_known_scenario(name: str) -> str:
    """Return the name of a scenario, or the path of a scenario's file, after checking it.

    Raises:
        ValueError: It does not exist, or the file has mistakes.
    """
    names = scenario_names()
    if name.endswith((".yaml", ".yml")):
        raise_as_value_error(lambda: check_scenario(name))
    elif name not in names:
        raise ValueError(f"unknown scenario{suggest(name, names) or ': `tunnelcd list` shows all'}")
    return name


def raise_as_value_error(check: Callable[[], object]) -> None:
    """Run a check that raises InputError inside pydantic, which collects only ValueErrors."""
    try:
        check()
    except InputError as error:
        raise ValueError("; ".join(_strip_option(str(error)))) from error


def format_setting(key: str, value: Any) -> str:
    """Return `key=value` as --set takes it."""
    text = dump_yaml(value, default_flow_style=True, width=10_000)
    return f"{key}={text.removesuffix('...' + chr(10)).strip()}"


def get_group(setting: str) -> str:
    """Return the first part of a setting's key."""
    return setting.partition("=")[0].partition(".")[0]


def _make_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _require_distinct(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise ValueError("expected each odometry once")
    return names


def _normalise_setting(setting: str) -> str:
    """Normalise the value as YAML reads it: `off` and `false ` give the same world as `false`."""
    key, equals, text = setting.partition("=")
    try:
        return format_setting(key, parse_yaml_value(text)) if equals else setting
    except YamlError:
        return setting


def _require_fit_on_top(settings: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
    if not settings:
        raise ValueError("an empty list sets nothing: leave it out")
    if "name" in info.data:
        require_draws(info.data["name"], (*info.data.get("set", ()), *settings))
    return settings


PairKind = Literal["clean", "drift", "smooth", "disjoint"]
PlanOdometry = Literal["own", "kiss-icp", "random-walk"]
OWN_ODOMETRY: PlanOdometry = "own"
_ODOMETRY = "odometry"  # stands for the settings of both sessions in a label
Odometries = Annotated[
    tuple[PlanOdometry, ...], BeforeValidator(_make_list), Field(min_length=1), AfterValidator(_require_distinct)
]
ScenarioName = Annotated[str, AfterValidator(require_known_scenario)]
OneOrMore = BeforeValidator(_make_list)
WorldSettings = Annotated[tuple[Annotated[str, AfterValidator(_normalise_setting)], ...], OneOrMore]


class ScenarioItem(Settings):
    """One item of a plan's scenarios, a name or a mapping; it defines one or several worlds."""

    name: ScenarioName
    set: WorldSettings = ()
    each: Annotated[tuple[Annotated[WorldSettings, AfterValidator(_require_fit_on_top)], ...], OneOrMore] = ()
    pair_kind: PairKind | None = None
    n_seeds: Annotated[int, Field(ge=1)] | None = None
    odometry: Odometries | None = None

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
            require_draws(info.data["name"], settings)
        return settings

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = {key: value for key, value in handler(self).items() if value}
        return self.name if list(written) == ["name"] else written


@dataclass(frozen=True, slots=True)
class World:
    """A scenario with `a.b=value` settings that are written over it before the draw.

    Attributes:
        name: The scenario.
        common: Settings that its item applies to all of its worlds.
        own: Further settings of this world.
        odometry: The odometry of both sessions, "own" for the scenario's.
        pair_kind: Kind of its pairs, "" if not given; no part of the label.
        n_seeds: Number of the plan's seeds used, the first ones; None for all.
    """

    name: str
    common: tuple[str, ...] = ()
    own: tuple[str, ...] = ()
    pair_kind: str = ""
    n_seeds: int | None = None
    odometry: PlanOdometry = OWN_ODOMETRY

    @property
    def settings(self) -> tuple[str, ...]:
        """All settings, in the order in which they are written over the scenario."""
        sessions = () if self.odometry == OWN_ODOMETRY else ("before", "after")
        return (*(f"{name}.odometry.source={self.odometry}" for name in sessions), *self.common, *self.own)

    @property
    def label(self) -> str:
        """Its name in tables: the scenario, with its settings in brackets if it has any."""
        odometry = () if self.odometry == OWN_ODOMETRY else (f"{_ODOMETRY}={self.odometry}",)
        return self.name + "".join(f"[{','.join(part)}]" for part in (odometry, self.common, self.own) if part)


def list_worlds(items: Iterable[ScenarioItem], odometry: tuple[PlanOdometry, ...] = (OWN_ODOMETRY,)) -> list[World]:
    """Return the worlds that the items of a plan define: every item with each odometry, in order.

    Args:
        items: The plan's scenarios.
        odometry: What an item has that names no odometry.
    """
    return [
        World(item.name, item.set, own, item.pair_kind or "", item.n_seeds, name)
        for item in items
        for name in item.odometry or odometry
        for own in ((), *item.each)
    ]


def require_known_label(label: str) -> str:
    """Return a scenario's name, or the label of one with settings, after checking that the scenario exists.

    Raises:
        ValueError: There is none.
    """
    name, bracket, _ = label.partition("[")
    require_known_scenario(name if bracket and label.endswith("]") else label)
    return label


def world_slug(label: str) -> str:
    """Return a world's label as a folder name."""
    return path_part(label.replace("/", "__"))


def find_references(cases: Iterable[tuple[str, str, int]], *, has_families: bool = False) -> dict[tuple[str, str], str]:
    """Return the reference of each world, for each variant that ran in both.

    The reference is the world whose label lacks the fewest brackets at the end: `narrow[a=1]` for `narrow[a=1][b=2]`,
    or else `narrow`.

    Args:
        cases: World, variant and seed of each row of a run.
        has_families: Whether a world without such a reference may have that of another family: `narrow` for
            `dust/narrow` (`scenarios.catalogue.clean_family`).

    Returns:
        The reference by (world, variant); no entry where no such world shares a seed.
    """
    seeds: dict[tuple[str, str], set[int]] = {}
    for world, variant, seed in cases:
        seeds.setdefault((world, variant), set()).add(seed)
    found: dict[tuple[str, str], str] = {}
    for (world, variant), own in seeds.items():
        others = (*_shorten(world), *(_clean(world) if has_families else ()))
        shared = (other for other in others if not own.isdisjoint(seeds.get((other, variant), ())))
        if (nearest := next(shared, None)) is not None:
            found[world, variant] = nearest
    return found


def is_other_odometry(world: str, reference: str) -> bool:
    """Tell whether a world is its reference with another odometry and nothing else: it repeats nothing."""
    return re.fullmatch(rf"\[{_ODOMETRY}=[^\]]*\]", world.removeprefix(reference)) is not None


def list_settings_over(world: str, reference: str) -> str:
    """Return the settings of a world beyond its reference: "a=1,b=2" for `narrow[a=1][b=2]` over `narrow`.

    Where the reference is of another family, that is the world's own: "dust/narrow" over `narrow`.
    """
    if not world.startswith(f"{reference}["):
        return world.partition("[")[0]
    return world[len(reference) + 1 : -1].replace("][", ",")


def _shorten(label: str) -> Iterator[str]:
    """Yield the part of a label before each bracket, longest first; not every part is a world."""
    if label.endswith("]"):
        yield from (label[:place] for place in range(len(label) - 1, 0, -1) if label[place] == "[")


def _clean(label: str) -> Iterator[str]:
    """Yield the label of the same world without the effect that its family is about."""
    name, bracket, settings = label.partition("[")
    if (base := clean_family(name)) is not None:
        yield base + bracket + settings


def require_draws(name: str, settings: tuple[str, ...]) -> None:
    """Check that settings fit a scenario.

    Raises:
        ValueError: They do not, for some seed, or belong to the method.
    """
    # `surface` is a list of the world and a section of the method; a setting of the world may name either key
    of_method = [
        setting
        for setting in settings
        if get_group(setting) in PipelineConfig.model_fields and get_group(setting) not in Scenario.model_fields
    ]
    lines = [f"{setting} belongs to the method, not to the world: set it under variants" for setting in of_method]
    try:
        check_scenario(name, [setting for setting in settings if setting not in of_method])
    except InputError as error:
        lines += _strip_option(str(error))
    if lines:
        raise ValueError("; ".join(dict.fromkeys(lines)))


def _strip_option(told: str) -> list[str]:
    """Return the lines of an error without a leading `--set`, which is wrong for a plan's file."""
    return [re.sub(r"^(--set)?:? ", "", line) for line in told.split("\n")]
