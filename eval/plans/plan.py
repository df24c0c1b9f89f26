"""A plan: scenarios x seeds x variants, read from a plan file and expanded into cells.

name: example
description: what the plan is for
scenarios:                           # eval/plans/worlds.py tells more
  - paper/site1
  - {name: paper/site2, each: [sensor.range_noise=false, sensor.mode=512x10]}  # unchanged, and with each of these
odometry: own                        # of all scenarios that do not say otherwise; [kiss-icp, own]: each with both
wide: [paper/site2]                  # wide drifts: presets apply their section `wide` there
seeds: "20000:20002"                 # B excluded, in quotes; or a list
report: [regions, objects]           # tables and plots of these, or of `surface`, rock that moved (eval/tables)
targets: main                        # what is asked: those of another plan, or of its own (eval/plans/targets.py)
until: null                          # merge: stop after the merge; only the columns of the merge are filled
set: [merge.refine=none]             # every method has these, below its own settings; part of no name
thresholds: {"paper[extract.voxel_m=0.4]": 1.1}  # query.threshold of a variant or grid point; part of no name
variants:
  - preset: paper                    # a shipped preset or the path of a .yaml file
    set: ["extract.voxel_m=0.4"]     # part of the variant's name
    per_scenario: {paper/site2: ["query.radius_m=10"]}  # belongs to the site and not to the variant's name
  - preset: tunnelcd
    oracle_merge: {noise_m: 0.1, noise_deg: 0.2}         # merged by the truth (eval/oracles/merge.py); {}: no noise
    oracle_regions: true                                 # a region around each change (eval/oracles/regions.py)
    scenarios: [paper/site1]                             # only in these worlds; in all worlds if left out
grid:
  - variant: tunnelcd                # a preset, or a list of presets
    scenarios: [paper/site1]         # some of the plan's worlds, e.g. paper/site2[sensor.mode=512x10]; all if left out
    keys: {extract.voxel_m: [0.2, 0.4], query.radius_m: [3, 4.5]}
    each: [[extract.method=surface], [extract.method=voxel, cluster.min_points=32]]  # lists of settings
axes:                                # eval/plans/axes.py: the first scenario, made harder in steps
  - {name: columns, steps: [{value: 1024}, {value: 512, set: sensor.mode=512x10}]}
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from cdpipe.core.errors import InputError
from cdpipe.core.names import folded
from cdpipe.core.yamlfile import Settings, suggest, validate
from cdpipe.model.config import OF_WHOLE_MAPS, Site
from eval.plans.axes import Axis, harder_item, method_steps
from eval.plans.files import read_plan
from eval.plans.parts import Grid, Label, MethodSettings, NotEmpty, Variant, get_key
from eval.plans.seeds import parse_seeds
from eval.plans.targets import PlanTargets, Targets
from eval.plans.variants import Method, Until
from eval.plans.worlds import (
    OWN_ODOMETRY,
    Odometries,
    OneOrMore,
    PlanOdometry,
    ScenarioItem,
    World,
    get_group,
    list_worlds,
    require_draws,
    world_slug,
)

_NO_THRESHOLDS: Mapping[str, Any] = {"thresholds": {}}
_MAY_BE_LEFT_OUT = ("split", "set", "thresholds", "axes")
_AFTER_MERGE = ("query", "extract", "outlier", "cluster", *OF_WHOLE_MAPS)


def _mistake(where: tuple[str | int, ...], written: str, rule: str) -> InitErrorDetails:
    """Return a mistake as pydantic takes it: the keys that lead to it, the written value, the rule that it breaks."""
    return InitErrorDetails(type=PydanticCustomError("plan", "{rule}", {"rule": rule}), loc=where, input=written)


def _refuse(mistakes: list[InitErrorDetails]) -> None:
    """Raise pydantic's error with all mistakes, if there are any."""
    if mistakes:
        raise ValidationError.from_exception_data("Plan", mistakes)


def _find_repeated_worlds(
    items: Iterable[ScenarioItem], odometry: tuple[PlanOdometry, ...]
) -> Iterator[InitErrorDetails]:
    """Yield the worlds that are listed twice, and those that would share a folder."""
    known: dict[object, str] = {}
    for place, item in enumerate(items):
        for index, world in enumerate(list_worlds([item], odometry)):
            names = (world.label, (world.name, world.settings), world_slug(world.label).casefold())
            other = next((known[name] for name in names if name in known), None)
            if other is not None:
                of_each = index % (1 + len(item.each))
                where = (place, "each", of_each - 1) if of_each else (place,)
                is_same = other == world.label or known.get(names[1]) == other
                rule = "is listed twice" if is_same else f"would share the folder of {other}: rename one"
                yield _mistake(where, ",".join(world.own) or world.name, f"scenario {world.label} {rule}")
            known |= {name: world.label for name in names if name not in known}


def _find_settings_past_the_end(plan: Plan) -> Iterator[InitErrorDetails]:
    if plan.until != "merge":
        return
    told = " and ".join(plan.report)
    if told:
        rule = f"report: {told} needs {told}, and the plan ends at the merge; leave one of them out"
        yield _mistake(("report",), told, rule)
    rule = "{} does nothing: the plan ends at the merge; leave it out, or leave out until"
    if plan.wide:
        yield _mistake(("wide",), ", ".join(plan.wide), rule.format("wide"))
    for place, variant in enumerate(plan.variants):
        for setting in filter(_acts_after_merge, variant.every_setting):
            yield _mistake(("variants", place), variant.preset, rule.format(f"{setting} of {variant.preset}"))
        if variant.oracle_regions:
            yield _mistake(("variants", place, "oracle_regions"), "true", rule.format("oracle_regions"))
    for place, grid in enumerate(plan.grid):
        for key in dict.fromkeys(get_key(setting) for setting in grid.every_setting if _acts_after_merge(setting)):
            yield _mistake(("grid", place, "keys", key), key, rule.format(f"{key} of the grid of {grid.name}"))
    for setting in filter(_acts_after_merge, plan.set):
        yield _mistake(("set",), setting, rule.format(setting))
    if plan.thresholds:
        yield _mistake(("thresholds",), ", ".join(plan.thresholds), rule.format("thresholds"))


def _acts_after_merge(setting: str) -> bool:
    return get_group(setting) in _AFTER_MERGE


def _find_unknown_worlds(plan: Plan) -> Iterator[InitErrorDetails]:
    worlds = plan.worlds
    labels = [world.label for world in worlds]
    for place, variant in enumerate(plan.variants):
        for index, name in enumerate(variant.scenarios):
            if name not in labels:
                rule = f"scenarios of {variant.preset} names {name!r}, which is no world of the plan"
                yield _mistake(("variants", place, "scenarios", index), name, rule + suggest(name, labels))
    known = dict.fromkeys(name for world in worlds for name in (world.name, world.label))
    asked: list[tuple[tuple[str | int, ...], str, str]]
    asked = [(("wide", index), "wide", name) for index, name in enumerate(plan.wide)]
    for place, variant in enumerate(plan.variants):
        who = f"per_scenario of {variant.preset}"
        asked += [(("variants", place, "per_scenario", name), who, name) for name in variant.per_scenario]
    for place, grid in enumerate(plan.grid):
        who = f"the grid of {grid.name}"
        asked += [(("grid", place, "scenarios", index), who, name) for index, name in enumerate(grid.scenarios)]
    for where, who, name in asked:
        if name not in known:
            yield _mistake(where, name, f"{who} names {name!r}, which is not in scenarios{suggest(name, known)}")


def _find_repeated_variants(plan: Plan) -> Iterator[InitErrorDetails]:
    """Yield the variants that a world has twice, and those that would share a folder."""
    told = set()
    for world in plan.worlds:
        names: dict[str, str] = {}
        for method in list_methods(plan, world):
            name, folder = method.variant, folded(method.variant)
            if folder in names and name not in told:
                told.add(name)
                twice, shared = (
                    f"stands twice in the plan for {world.label}",
                    f"would share the folder of {names[folder]}",
                )
                yield _mistake(("variants",), name, f"variant {name} {twice if names[folder] == name else shared}")
            names.setdefault(folder, name)


def _find_unknown_thresholds(plan: Plan) -> Iterator[InitErrorDetails]:
    """Yield the names under `thresholds` that no variant and no grid point has."""
    if not plan.thresholds:
        return
    every = [method for world in plan.worlds for method in list_methods(plan.model_copy(update=_NO_THRESHOLDS), world)]
    known = {method.variant for method in every if not method.oracle_regions}
    has_own = {method.variant for method in every if "query.threshold" in map(get_key, (*method.named, *method.silent))}
    for name, threshold in plan.thresholds.items():
        if name in has_own:
            rule = f"{name} has a threshold of its own: leave one of them out"
            yield _mistake(("thresholds", name), str(threshold), rule)
        elif name not in known:
            rule = f"no variant or grid point with a threshold is called {name}{suggest(name, known)}"
            yield _mistake(("thresholds", name), str(threshold), rule)


def _find_misfit_steps(plan: Plan) -> Iterator[InitErrorDetails]:
    """Yield the steps of axes that do not fit the first scenario, axes of one name, and axes that tell nothing."""
    names = [axis.name for axis in plan.axes]
    if plan.axes and plan.until == "merge":
        yield _mistake(("axes",), ", ".join(names), "axes ask for regions, and the plan ends at the merge")
    if plan.axes and len(plan.scenarios[0].odometry or plan.odometry) > 1:
        yield _mistake(("axes",), ", ".join(names), "expected one odometry of the first scenario, which the axes vary")
    for place, axis in enumerate(plan.axes):
        if axis.name in names[:place]:
            yield _mistake(("axes", place, "name"), axis.name, f"axis {axis.name!r} stands twice")
        for index, step in enumerate(axis.steps):
            if idle := [
                each for variant in plan.variants for each in step.method if not variant.keep_effective([each])
            ]:
                rule = f"{idle[0]} does nothing to a variant of this plan, which takes that part from the truth"
                yield _mistake(("axes", place, "steps", index, "method"), idle[0], rule)
            try:
                if step.set:
                    require_draws(plan.base.name, (*plan.base.settings, *step.set))
            except ValueError as error:
                yield _mistake(("axes", place, "steps", index, "set"), ",".join(step.set), str(error))


def _list_subjects(value: Any) -> Any:
    return [value] if isinstance(value, str) else () if value is None else value


class Plan(Settings):
    """A plan; `expand_cells` expands it.

    `split` is what `--split` wrote: "sealed", and the version that the seeds were drawn from; "" for the seeds of the
    file, and then a dump leaves it out.
    """

    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    odometry: Odometries = (OWN_ODOMETRY,)
    scenarios: Annotated[tuple[ScenarioItem, ...], NotEmpty]
    wide: Annotated[tuple[Label, ...], OneOrMore] = ()
    seeds: Annotated[tuple[int, ...], BeforeValidator(parse_seeds)]
    split: str = ""
    until: Until | None = None
    set: MethodSettings = ()
    thresholds: dict[str, float] = Field(default_factory=dict)
    report: Annotated[tuple[Literal["regions", "objects", "surface"], ...], BeforeValidator(_list_subjects)] = ()
    targets: PlanTargets = Targets()
    variants: Annotated[tuple[Variant, ...], NotEmpty]
    grid: tuple[Grid, ...] = ()
    axes: tuple[Axis, ...] = ()

    @field_validator("scenarios")
    @classmethod
    def _worlds_differ(cls, items: tuple[ScenarioItem, ...], info: ValidationInfo) -> tuple[ScenarioItem, ...]:
        _refuse(list(_find_repeated_worlds(items, info.data.get("odometry", (OWN_ODOMETRY,)))))
        return items

    @model_validator(mode="after")
    def _parts_fit(self) -> Plan:
        _refuse(list(_find_misfit_steps(self)))
        _refuse([*_find_settings_past_the_end(self), *_find_unknown_worlds(self), *_find_repeated_variants(self)])
        _refuse(list(_find_unknown_thresholds(self)))
        return self

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if name not in _MAY_BE_LEFT_OUT or value}

    @property
    def worlds(self) -> list[World]:
        """The worlds, in order: every item with each odometry, as it is, with each of its settings, and by the axes."""
        first, *others = self.scenarios
        return list_worlds([harder_item(first, self.axes), *others], self.odometry)

    @property
    def base(self) -> World:
        """The world that the axes make harder: the first one."""
        return self.worlds[0]


def load_plan(name_or_path: str) -> Plan:
    """Read a shipped plan by name, or any plan by the path of its .yaml file.

    Raises:
        InputError: It is unknown or has mistakes (one line each).
    """
    document = read_plan(name_or_path)
    if isinstance(document.value, dict) and "split" in document.value:
        raise InputError(f"{document.where(('split',))}: split: leave it out, and run the plan with --split sealed")
    return validate(Plan, document)


def list_methods(plan: Plan, world: World) -> list[Method]:
    """Return the methods that a plan runs in one of its worlds: variants first, then grid points."""
    places = dict.fromkeys((world.name, world.label))
    site: Site = "narrow" if places.keys().isdisjoint(plan.wide) else "wide"
    methods = [
        Method(
            preset=variant.preset,
            named=variant.set,
            silent=tuple(setting for place in places for setting in variant.per_scenario.get(place, ())),
            shared=variant.keep_effective(plan.set),
            site=site,
            oracle=variant.oracle_merge,
            oracle_regions=variant.oracle_regions,
        )
        for variant in plan.variants
        if not variant.scenarios or world.label in variant.scenarios
    ]
    for grid in plan.grid:
        if not grid.scenarios or not places.keys().isdisjoint(grid.scenarios):
            methods += [
                Method(preset, point, _silent(plan, preset, places, point), shared=plan.set, site=site)
                for preset in grid.variant for point in grid.points
            ]  # fmt: skip
    if world.label == plan.base.label:
        methods += [with_step(method, step) for step in method_steps(plan.axes) for method in [*methods]]
    return [_with_threshold(method, plan.thresholds.get(method.variant)) for method in methods]


def with_step(method: Method, step: tuple[str, ...]) -> Method:
    """Return a method with the settings of a step of an axis, over those of its own name and of its site."""
    keys = set(map(get_key, step))
    named, silent = (tuple(each for each in own if get_key(each) not in keys) for own in (method.named, method.silent))
    return replace(method, named=(*named, *step), silent=silent)


def _silent(plan: Plan, preset: str, places: Iterable[str], point: Sequence[str]) -> tuple[str, ...]:
    """Return the settings of a site at a grid point: those of the plan's plain variant of the preset, less its own."""
    plain = [each for each in plan.variants if each.preset == preset and not each.set and each.oracle_merge is None]
    own = set(map(get_key, point))
    found = (setting for each in plain[:1] for place in places for setting in each.per_scenario.get(place, ()))
    return tuple(setting for setting in found if get_key(setting) not in own)


def _with_threshold(method: Method, threshold: float | None) -> Method:
    if threshold is None:
        return method
    return replace(method, silent=(*method.silent, f"query.threshold={threshold!r}"))
