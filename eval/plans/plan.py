"""What is run: scenarios x seeds x variants, read from a plan file and spread out into cells.

name: example
description: what the plan is for
scenarios:                           # eval/plans/worlds.py tells more
  - paper/site1
  - {name: paper/site2, each: [sensor.range_noise=false, sensor.mode=512x10]}  # as it is, and again with each of these
wide: [paper/site2]                  # wide drifts: presets with what stands under their `wide`
seeds: "20000:20002"                 # B excluded, in quotes; or a list
report: [regions, objects]           # tables and plots of regions, of objects, or of both (eval/tables)
until: null                          # merge: stop after the merge; only the columns of the merge are filled
variants:
  - preset: paper                    # a shipped preset or the path of a .yaml file
    set: ["extract.voxel_m=0.4"]     # part of the variant's name
    per_scenario: {paper/site2: ["query.threshold=1"]}   # belongs to the site and not to the variant's name
  - preset: tunnelcd
    oracle_merge: {noise_m: 0.1, noise_deg: 0.2}         # merged by the truth (eval/oracles/merge.py); {}: no noise
    oracle_regions: true                                 # a region around each change (eval/oracles/regions.py)
    scenarios: [paper/site1]                             # only in these worlds; in all worlds if left out
grid:
  - variant: tunnelcd                # a preset
    scenarios: [paper/site1]         # out of the plan's; one world of several as paper/site2[sensor.mode=512x10]
    keys: {extract.voxel_m: [0.2, 0.4], query.radius_m: [3, 4.5]}
"""

from __future__ import annotations

import re
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import find_yaml
from cdpipe.core.yamlfile import Settings, read_yaml, suggest, validate
from eval.plans.checks import misfits, refuse, repeated_worlds
from eval.plans.parts import Grid, Label, NotEmpty, Variant
from eval.plans.variants import Cell, Until, methods_of
from eval.plans.worlds import OneOrMore, ScenarioItem, worlds_of


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


def _subjects(value: Any) -> Any:
    return [value] if isinstance(value, str) else () if value is None else value


class Plan(Settings):
    """What to run; `cells` spreads it out."""

    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    scenarios: Annotated[tuple[ScenarioItem, ...], NotEmpty]
    wide: Annotated[tuple[Label, ...], OneOrMore] = ()
    seeds: Annotated[tuple[int, ...], BeforeValidator(parse_seeds)]
    until: Until | None = None
    report: Annotated[tuple[Literal["regions", "objects"], ...], BeforeValidator(_subjects)] = ()
    variants: Annotated[tuple[Variant, ...], NotEmpty]
    grid: tuple[Grid, ...] = ()

    @field_validator("scenarios")
    @classmethod
    def _worlds_differ(cls, items: tuple[ScenarioItem, ...]) -> tuple[ScenarioItem, ...]:
        refuse(repeated_worlds(items))
        return items

    @model_validator(mode="after")
    def _parts_fit(self) -> Plan:
        refuse(misfits(self))
        return self


def load_plan(name_or_path: str) -> Plan:
    """Read a shipped plan by name, or any plan by the path of its .yaml file.

    Raises:
        InputError: It is unknown or has mistakes; all of them at once, one line each.
    """
    if name_or_path.endswith((".yaml", ".yml")):
        return validate(Plan, read_yaml(Path(name_or_path)))
    plans = _plans()
    if name_or_path not in plans:
        raise InputError(
            f"plan {name_or_path!r} is unknown{suggest(name_or_path, plans)} "
            f"(known: {', '.join(plans)}, or the path of a .yaml file)"
        )
    return validate(Plan, read_yaml(Path(f"{name_or_path}.yaml"), plans[name_or_path].read_text()))


def plan_names() -> list[str]:
    """Return the names of all plans: shipped, and on the search path."""
    return list(_plans())


def cells(plan: Plan) -> list[Cell]:
    """Return all cells: by scenario, then seed, then variant, grids last.

    Raises:
        InputError: The settings of a variant contradict each other or its preset.
    """
    found: list[Cell] = []
    mistakes: list[str] = []
    for world in worlds_of(plan.scenarios):
        methods = []
        for method in methods_of(plan, world):
            try:
                methods.append((method, method.config()))
            except InputError as error:
                mistakes += str(error).splitlines()
        found += [
            method.cell(world, seed, config, plan.until)
            for seed in plan.seeds[: world.n_seeds]
            for method, config in methods
        ]
    if mistakes:
        raise InputError("\n".join(dict.fromkeys(mistakes)))
    return found


def planned_cases(plan: Plan) -> set[tuple[str, int, str]]:
    """Return (scenario, seed, variant) of all cells."""
    return {
        (world.label, seed, method.variant)
        for world in worlds_of(plan.scenarios)
        for method in methods_of(plan, world)
        for seed in plan.seeds[: world.n_seeds]
    }


def _plans() -> dict[str, Traversable]:
    return find_yaml("plans", resources.files("eval") / "plans")
