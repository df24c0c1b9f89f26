"""The cases of a run by scenario and variant, apart from those that only repeat others."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import pandas as pd

from eval.plans.worlds import find_references, is_other_odometry
from eval.running.results.grids import find_grids, grid_points
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, flag, number, over_pairs, select_rows, text
from eval.tables.rows import with_domain

_RUNS = 8  # whose cases are remembered
_PICTURED = ("paper", "tunnelcd", "voxel-diff")
BEST_POINTS = "of the points of a grid that of highest object PQ"


class _Variants(NamedTuple):
    """The variants of each world that repeat no other: those that are no points of a grid, and the points."""

    methods: dict[str, list[str]]
    points: dict[str, list[str]]


def comparable(data: RunData) -> pd.DataFrame:
    """Return the rows of results.csv of methods that are neither grid points nor repetitions, with their `domain`.

    Of a run of nothing but grid points, those of all points.
    """
    methods, points = _find_variants(data)
    wanted = {(scenario, name) for scenario, names in (methods or points).items() for name in names}
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
    """Return the variants of a scenario that are neither grid point nor repetition, in the order of results.csv.

    Of a scenario with nothing but grid points, the best point of each grid: `BEST_POINTS`, over all pairs of the run.
    """
    return _find_variants(data).methods.get(scenario) or list(_best_points(data).get(scenario, ()))


def shows_best_points(data: RunData) -> bool:
    """Tell whether `named_variants` names points of grids anywhere."""
    methods, points = _find_variants(data)
    return bool(points.keys() - methods.keys())


@lru_cache(maxsize=_RUNS)
def _find_variants(data: RunData) -> _Variants:
    held, on_grid = find_repeats(data), grid_points(data)
    found = _Variants({}, {})
    for world, name in dict.fromkeys((world, name) for world, name, _ in data.cases):
        if (world, name) not in held:
            kind = found.points if (world, name) in on_grid else found.methods
            kind.setdefault(world, []).append(name)
    return found


@lru_cache(maxsize=_RUNS)
def _best_points(data: RunData) -> dict[str, list[str]]:
    """Return the best point of each grid, by scenario; of equal ones that of highest region recall, then the first."""
    methods, points = _find_variants(data)
    rows: dict[str, list[Row]] = {}
    for row in data.results:
        rows.setdefault(str(row["variant"]), []).append(row)

    def rank(name: str) -> tuple[float, float]:
        pq, recall = (over_pairs(rows[name], key) for key in ("object_pq", "region_recall"))
        return math.inf if math.isnan(pq) else -pq, math.inf if math.isnan(recall) else -recall

    found: dict[str, list[str]] = {}
    for grid in find_grids(data):
        own = set(grid.points.values())
        names = [name for name in points.get(grid.scenario, ()) if name in own]
        if names and grid.scenario not in methods:
            found.setdefault(grid.scenario, []).append(min(names, key=rank))
    return found


def pictured_variants(data: RunData, scenario: str) -> list[str]:
    """Return three variants for pictures and tables I and II: the paper's, ours and a rival, else the first ones."""
    names = named_variants(data, scenario)
    return list(dict.fromkeys([*(name for name in _PICTURED if name in names), *names]))[:3]


def first_seed(data: RunData, scenario: str) -> int:
    """Return the first seed of a scenario that is no repetition; the pictures show it."""
    held = find_repeats(data)
    return min(seed for world, name, seed in data.cases if world == scenario and (world, name) not in held)
