"""The cases of a run by scenario and variant, apart from those that only repeat others."""

from __future__ import annotations

import math
from functools import lru_cache

import pandas as pd

from eval.plans.worlds import find_references, is_other_odometry
from eval.running.results.grids import grid_points
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, flag, number, select_rows, text
from eval.tables.rows import with_domain

_RUNS = 8  # whose cases are remembered
_PICTURED = ("paper", "tunnelcd", "voxel-diff")


def comparable(data: RunData) -> pd.DataFrame:
    """Return the rows of results.csv of methods that are neither grid points nor repetitions, with their `domain`."""
    names = [*scenarios(data, unchanged=False), *scenarios(data, unchanged=True)]
    wanted = {(scenario, variant) for scenario in names for variant in named_variants(data, scenario)}
    return with_domain([row for row in data.results if (row["scenario"], row["variant"]) in wanted])


def rows_of_case(data: RunData, scenario: str, seed: int, variant: str) -> dict[str, list[Row]]:
    """Return the rows of the tables `changes` and `regions` that are about one answer."""
    wanted = {"scenario": scenario, "seed": seed, "variant": variant}
    return {"changes": select_rows(data.changes, **wanted), "regions": select_rows(data.regions, **wanted)}


def scenarios(data: RunData, *, unchanged: bool) -> list[str]:
    """Return the scenarios with changes, or those without, in the order of results.csv.

    Scenarios that only repeat another world under a setting are left out; `eval.report.settings.effects` shows them.
    """
    held = find_repeats(data)
    names = dict.fromkeys(world for world, variant, _ in data.cases if (world, variant) not in held)
    return [name for name in names if is_unchanged(data, name) == unchanged]


@lru_cache(maxsize=_RUNS)
def find_repeats(data: RunData) -> dict[tuple[str, str], str]:
    """Return the reference world of each (world, variant) that is another with a setting (`eval.plans.worlds`)."""
    found = find_references(data.cases)
    return {case: other for case, other in found.items() if not is_other_odometry(case[0], other)}


def is_unchanged(data: RunData, scenario: str) -> bool:
    """Tell whether every pair of a scenario is unchanged, by its rows."""
    flags = [flag(row, "is_unchanged_pair") for row in select_rows(data.results, scenario=scenario)]
    known = [value for value in flags if value is not None]
    return bool(known) and all(known)


def is_unmade(row: Row) -> bool:
    """Tell whether a case has no truth: its world could not be made, or its worker died over it."""
    return text(row, "status") != "ok" and "n_observable" in row and math.isnan(number(row, "n_observable"))


def named_variants(data: RunData, scenario: str) -> list[str]:
    """Return the variants of a scenario that are neither grid point nor repetition, in the order of results.csv."""
    return list(_name_variants(data).get(scenario, ()))


@lru_cache(maxsize=_RUNS)
def _name_variants(data: RunData) -> dict[str, dict[str, None]]:
    held, points, found = find_repeats(data), grid_points(data), dict[str, dict[str, None]]()
    for world, name, _ in data.cases:
        if (world, name) not in held and (world, name) not in points:
            found.setdefault(world, {})[name] = None
    return found


def pictured_variants(data: RunData, scenario: str) -> list[str]:
    """Return three variants for pictures and tables I and II: the paper's, ours and a rival, else the first ones."""
    names = named_variants(data, scenario)
    return list(dict.fromkeys([*(name for name in _PICTURED if name in names), *names]))[:3]


def first_seed(data: RunData, scenario: str) -> int:
    """Return the first seed of a scenario that is no repetition; the pictures show it."""
    held = find_repeats(data)
    return min(seed for world, name, seed in data.cases if world == scenario and (world, name) not in held)
