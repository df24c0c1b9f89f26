"""A run folder as the page reads it: tables as plain rows, cases by pair, and what is missing."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from eval.core.statistics import bootstrap_interval, mean, median, statistic_of
from eval.core.tablefile import read_table, table_file
from eval.plans.coverage import Coverage, measure_coverage
from eval.plans.targets import read_targets
from eval.plans.worlds import find_references, is_other_odometry
from eval.running.cell_rows import TEXT_COLUMNS
from eval.running.runfolder import RunFolder, read_json
from eval.tables.conditions import COLUMNS as CONDITION_COLUMNS
from eval.tables.conditions import Condition, by_condition, of_condition
from eval.tables.rows import records, with_domain

Row = Mapping[str, Any]
_CASE = ("scenario", "seed", "variant")
REQUIRED = (*_CASE, "status")
# No figure of a pair is larger: a terabyte has 1e12 bytes, a century 3e9 seconds.
LARGEST = 1e15
# ends of bins and of intervals, of which the last bin has none
_UNBOUNDED = ("low", "high")
# columns of text of the derived tables
_DERIVED_TEXTS = {"domain", "variant", *CONDITION_COLUMNS}
_MORE_TEXTS = {
    "regions_targets": ("target", "asked", "is_met"), "objects_targets": ("target", "asked", "is_met"),
    "surface_targets": ("target", "asked", "is_met"), "regions_by_size": ("measure",), "budgets": ("site", "price"),
    "hard": ("axis", "unit", "value", "scenario"), "breaking_points": ("axis", "unit", "value", "is_measured"),
    "objects_by_group": ("measure", "value"),
}  # fmt: skip
_COUNT = re.compile(r"n(_|$)")
_NUMBER = re.compile(r"[-+.\deE]+")
_IDS = re.compile(r"\d{1,9}(;\d{1,9})*")
_ID_LISTS = ("found_changes", "found_changes_proposed")
_PICTURED = ("paper", "tunnelcd", "voxel-diff")


@dataclass(frozen=True, slots=True, eq=False)
class RunData:
    """The tables of a run.

    Attributes:
        folder: Where it lies.
        results: Rows of results.csv, in file order.
        changes: Rows of changes.csv.
        regions: Rows of regions.csv.
        provenance: Content of provenance.json, {} where there is none.
        missing: Files that a complete run folder holds and this one lacks, one sentence each.
        left_out: One sentence for each table with figures that are read as NaN: infinite, or larger than `LARGEST`.
        others: Rows of results.csv that `figures_of_plan` took out.
        condition: Of which pairs the rows of `results` are; None for all of them.
    """

    folder: RunFolder
    results: tuple[Row, ...]
    changes: tuple[Row, ...]
    regions: tuple[Row, ...]
    provenance: Mapping[str, Any]
    missing: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    others: tuple[Row, ...] = ()
    condition: Condition | None = None

    @property
    def every_result(self) -> tuple[Row, ...]:
        """All rows of results.csv."""
        return (*self.results, *self.others)


def figures_of_plan(data: RunData) -> RunData:
    """Return the part of a run that the figures of its plan are of, by odometry and sensor (`by_condition`)."""
    (condition, is_main), *others = by_condition(pd.DataFrame(list(data.results)), read_targets(data.provenance))
    if not others:
        return replace(data, condition=condition)
    results = tuple(row for row, is_of in zip(data.results, is_main, strict=True) if is_of)
    rest = tuple(row for row, is_of in zip(data.results, is_main, strict=True) if not is_of)
    pairs = {(row["scenario"], row["seed"]) for row in results}
    changes, regions = (
        tuple(row for row in rows if (row["scenario"], row["seed"]) in pairs) for rows in (data.changes, data.regions)
    )
    return replace(data, results=results, changes=changes, regions=regions, others=rest, condition=condition)


def read_run(run: Path) -> RunData:
    """Read a run folder for the page; everything but results.csv may be missing.

    Raises:
        InputError: There is no results.csv, it holds no row, lacks a column that names its rows, or one of them twice.
    """
    path = table_file(run / "results.csv")
    if not path.exists():
        raise InputError(f"{path}: missing: name a folder made by `tunnelcd run` or `tunnelcd demo`")
    left_out: list[str] = []
    results = _rows(path, left_out)
    if not results:
        raise InputError(f"{path}: holds no row: no case was finished, run the plan again")
    absent = [name for name in REQUIRED if name not in results[0]]
    if absent:
        raise InputError(f"{path}: column {', '.join(absent)} is missing: expected a table written by `tunnelcd run`")
    _require_cases(path, pd.DataFrame(results))
    missing = []
    items: dict[str, tuple[Row, ...]] = {"changes": (), "regions": ()}
    for name in items:
        if (path := table_file(run / f"{name}.csv")).exists():
            items[name] = _rows(path, left_out)
        else:
            missing.append(f"{path.name} is not in the run folder: what it would show is left out.")
    provenance = read_json(run / "provenance.json")
    if not provenance:
        missing.append(
            "provenance.json is not in the run folder or damaged: machine, command and versions are unknown."
        )
    tables = results, items["changes"], items["regions"]
    return RunData(RunFolder(run), *tables, provenance, tuple(missing), tuple(left_out))


def stored_table(data: RunData, name: str) -> pd.DataFrame:
    """Return a derived table of the run folder, empty where it is not there; what `read_run` leaves out is NaN.

    Raises:
        InputError: A column of numbers holds text, or a count is missing.
    """
    path = table_file(data.folder.path / f"{name}.csv")
    if not path.exists():
        return pd.DataFrame()
    frame = read_table(path)
    _require_numbers(path, frame, {*_DERIVED_TEXTS, *_MORE_TEXTS.get(name, ())})
    for column in frame:
        if _COUNT.match(str(column)) and frame[column].isna().any():
            raise InputError(
                f"{path}: column {column} lacks a count: `tunnelcd score {path.parent}` makes the table anew"
            )
    frame = _without_unusable(frame)
    return frame if data.condition is None else of_condition(frame, data.condition)


def every_condition(data: RunData, name: str) -> pd.DataFrame:
    """Return a derived table of the run folder as `stored_table` does, with the rows of every odometry and sensor."""
    return stored_table(replace(data, condition=None), name)


def plan_name(data: RunData) -> str:
    """Return the name of the plan of a run, "" where it is not known."""
    plan = data.provenance.get("plan")
    return str(plan.get("name", "")) if isinstance(plan, Mapping) else ""


def ends_at_merge(data: RunData) -> bool:
    """Tell whether a run's plan ended every method at the merge."""
    plan = data.provenance.get("plan")
    return isinstance(plan, Mapping) and plan.get("until") == "merge"


def shown_variant(data: RunData) -> str:
    """Return the variant whose cases a page shows: the one that the plan is about, or the first that was run."""
    return read_targets(data.provenance).shown_method([str(row["variant"]) for row in data.results])


def comparable(data: RunData) -> pd.DataFrame:
    """Return the rows of results.csv of methods that are neither grid points nor repetitions, with their `domain`."""
    names = [*scenarios(data, unchanged=False), *scenarios(data, unchanged=True)]
    wanted = {(scenario, variant) for scenario in names for variant in named_variants(data, scenario)}
    return with_domain([row for row in data.results if (row["scenario"], row["variant"]) in wanted])


def covered_by(data: RunData) -> Coverage:
    """Return how much of its plan a run holds."""
    cases = ((str(row["scenario"]), int(row["seed"]), str(row["variant"])) for row in data.every_result)
    return measure_coverage(data.provenance, cases)


def number(row: Row, column: str) -> float:
    """Return a cell as a number; NaN where it is empty, absent or not a number."""
    value = row.get(column)
    if value is None or isinstance(value, str):
        return math.nan
    return float(value)


def flag(row: Row, column: str) -> bool | None:
    """Return a cell as a truth value; None where it is empty or absent."""
    value = row.get(column)
    if isinstance(value, str):
        return {"true": True, "false": False}.get(value.strip().lower())
    return None if value is None or math.isnan(float(value)) else bool(value)


def text(row: Row, column: str) -> str:
    """Return a cell as text, "" where it is empty or absent."""
    value = row.get(column)
    return "" if value is None or (isinstance(value, float) and math.isnan(value)) else str(value)


def defined(rows: Iterable[Row], column: str) -> Float64Array:
    """Return the (N,) defined values of a column."""
    values = np.array([number(row, column) for row in rows], dtype=np.float64)
    return values[~np.isnan(values)]


def over_pairs(rows: Iterable[Row], column: str) -> float:
    """Return the mean of the defined values of a column, their median for times; NaN where there is none."""
    values = defined(rows, column)
    return median(values) if statistic_of(column) == "median" else mean(values)


def interval_over_pairs(rows: Iterable[Row], column: str) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of `over_pairs`; NaN for fewer than two defined values."""
    return bootstrap_interval(np.array([number(row, column) for row in rows], np.float64), statistic_of(column))


def of(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Return the rows with the given values."""
    found = list(rows)
    for name, value in wanted.items():  # column by column: five times faster than cell by cell
        found = [row for row in found if row.get(name) == value]
    return found


def rows_of_case(data: RunData, scenario: str, seed: int, variant: str) -> dict[str, list[Row]]:
    """Return the rows of the tables `changes` and `regions` that are about one answer."""
    wanted = {"scenario": scenario, "seed": seed, "variant": variant}
    return {"changes": of(data.changes, **wanted), "regions": of(data.regions, **wanted)}


def scenarios(data: RunData, *, unchanged: bool) -> list[str]:
    """Return the scenarios with changes, or those without, in the order of results.csv.

    Scenarios that only repeat another world under a setting are left out; `eval.report.settings.effects` shows them.
    """
    held = repeats(data)
    names = dict.fromkeys(world for world, variant, _ in _cases(data) if (world, variant) not in held)
    return [name for name in names if is_unchanged(data, name) == unchanged]


def repeats(data: RunData) -> dict[tuple[str, str], str]:
    """Return the reference world of each (world, variant) that is another with a setting (`eval.plans.worlds`)."""
    found = find_references(_cases(data))
    return {case: other for case, other in found.items() if not is_other_odometry(case[0], other)}


def is_unchanged(data: RunData, scenario: str) -> bool:
    """Tell whether every pair of a scenario is unchanged, by its rows."""
    flags = [flag(row, "is_unchanged_pair") for row in of(data.results, scenario=scenario)]
    known = [value for value in flags if value is not None]
    return bool(known) and all(known)


def named_variants(data: RunData, scenario: str) -> list[str]:
    """Return the variants of a scenario that are neither grid point nor repetition, in the order of results.csv."""
    held = repeats(data)
    names = dict.fromkeys(name for world, name, _ in _cases(data) if world == scenario and (world, name) not in held)
    points = grid_points(data)
    return [name for name in names if (scenario, name) not in points]


def pictured_variants(data: RunData, scenario: str) -> list[str]:
    """Return three variants for pictures and tables I and II: the paper's, ours and a rival, else the first ones."""
    names = named_variants(data, scenario)
    return list(dict.fromkeys([*(name for name in _PICTURED if name in names), *names]))[:3]


def first_seed(data: RunData, scenario: str) -> int:
    """Return the first seed of a scenario that is no repetition; the pictures show it."""
    held = repeats(data)
    return min(seed for world, name, seed in _cases(data) if world == scenario and (world, name) not in held)


@dataclass(frozen=True, slots=True, eq=False)
class GridOf:
    """The points of one preset on a grid of two settings.

    Attributes:
        scenario: Where it was run.
        preset: Over which preset, and what else was set to one value.
        keys: The two settings; rows first.
        values: Their values, as texts, in rising order.
        points: Name of the variant at each pair of values.
    """

    scenario: str
    preset: str
    keys: tuple[str, str]
    values: tuple[tuple[str, ...], tuple[str, ...]]
    points: Mapping[tuple[str, str], str]


def grids(data: RunData) -> list[GridOf]:
    """Find the grids: variants of one preset that set the same keys, two of them to several values, the rest to one."""
    found: dict[tuple[str, str, tuple[str, ...]], dict[str, dict[str, str]]] = {}
    for row in data.results:
        preset, settings = split_variant(str(row["variant"]))
        found.setdefault((str(row["scenario"]), preset, tuple(settings)), {})[str(row["variant"])] = settings
    result = []
    for (scenario, preset, keys), variants in found.items():
        values = {key: sorted_values({settings[key] for settings in variants.values()}) for key in keys}
        varied = [key for key in keys if len(values[key]) >= 2]
        if len(varied) == 2:
            row_key, column_key = varied
            fixed = ", ".join(f"{key}={values[key][0]}" for key in keys if key not in varied)
            points = {(settings[row_key], settings[column_key]): name for name, settings in variants.items()}
            axes = (values[row_key], values[column_key])
            name = f"{preset} with {fixed}" if fixed else preset
            result.append(GridOf(scenario, name, (row_key, column_key), axes, points))
    return result


def grid_points(data: RunData) -> set[tuple[str, str]]:
    """Return the scenario and the variant of every point of a grid."""
    return {(grid.scenario, name) for grid in grids(data) for name in grid.points.values()}


def off_grids(table: pd.DataFrame, data: RunData) -> pd.DataFrame:
    """Return the rows of a table whose `variant` is more than a point of a grid; all rows where none is.

    `eval.report.settings.grids` shows the points of grids, hundreds of them, in less space.
    """
    if "variant" not in table:
        return table
    points = grid_points(data)
    shown = {variant for world, variant, _ in _cases(data) if (world, variant) not in points}
    rows = table[table["variant"].isin(shown)]
    return rows if len(rows) else table


def split_variant(variant: str) -> tuple[str, dict[str, str]]:
    """Return the preset of a variant and its settings: "a[k=1,l=2]" gives "a" and {"k": "1", "l": "2"}."""
    preset, bracket, rest = variant.partition("[")
    if not bracket or not rest.endswith("]"):
        return variant, {}
    settings: dict[str, str] = {}
    for part in rest[:-1].split(","):
        key, _, value = part.partition("=")
        settings[key.strip()] = value.strip()
    return preset, settings


def _cases(data: RunData) -> list[tuple[str, str, int]]:
    return [(str(row["scenario"]), str(row["variant"]), int(row["seed"])) for row in data.results]


def sorted_values(values: Iterable[str]) -> tuple[str, ...]:
    """Return the values of a setting in rising order, numbers before words."""

    def order(value: str) -> tuple[int, float, str]:
        try:
            return 0, float(value), value
        except ValueError:
            return 1, 0.0, value

    return tuple(sorted(values, key=order))


def _require_cases(path: Path, results: pd.DataFrame) -> None:
    """Refuse rows without a valid seed and repeated cases: every mean would be wrong."""
    for line, seed in enumerate(results["seed"], start=2):
        if not float(pd.to_numeric(seed, errors="coerce")).is_integer():
            raise InputError(f"{path}:{line}: seed = {seed}: expected a whole number")
    is_repeated = results.duplicated(["scenario", "seed", "variant"]).to_numpy()
    if is_repeated.any():
        index = int(np.argmax(is_repeated))
        row = results.iloc[index]
        case = f"{row['scenario']}, seed {int(row['seed'])}, {row['variant']}"
        raise InputError(f"{path}:{index + 2}: {case} stands there twice")


def _rows(path: Path, left_out: list[str]) -> tuple[Row, ...]:
    """Return the rows of a table; a sentence about figures that are read as NaN is added to `left_out`."""
    frame = read_table(path)
    _require_values(path, frame)
    counts = {name: int((frame[name].abs() > LARGEST).sum()) for name in _figures(frame)}
    if told := ", ".join(f"{name} ({n})" for name, n in counts.items() if n):
        left_out.append(
            f"{path.name}: infinite or larger than {LARGEST:g}, and therefore left out: {told}. "
            f"`tunnelcd score {path.parent}` scores the answers again."
        )
    return tuple(records(_without_unusable(frame)))


def _require_values(path: Path, frame: pd.DataFrame) -> None:
    """Refuse text among numbers, which no mean or chart can hold, and rows without the columns that name them."""
    if absent := {*_CASE} - set(frame) if len(frame) else set():
        raise InputError(f"{path}: column {', '.join(sorted(absent))} is missing: expected a table of `tunnelcd run`")
    _require_numbers(path, frame, {*TEXT_COLUMNS, "seed"})  # seeds are checked by their values


def _require_numbers(path: Path, frame: pd.DataFrame, texts: Collection[str]) -> None:
    for name in frame:
        if pd.api.types.is_numeric_dtype(frame[name]) or (name in texts and name not in _ID_LISTS):
            continue
        are_ids = name in _ID_LISTS
        wrong = [
            (line, value)
            for line, value in enumerate(frame[name], start=2)
            if not (isinstance(value, bool) or pd.isna(value) or (are_ids and _IDS.fullmatch(str(value))))
        ]
        if wrong:  # one text makes all numbers of its column texts
            line, value = next((each for each in wrong if not _NUMBER.fullmatch(str(each[1]))), wrong[0])
            raise InputError(f"{path}:{line}: {name} = {value!r:.40}: expected a number")


def _without_unusable(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table with NaN for figures that no mean, axis or cell can hold."""
    names = _figures(frame)
    return frame.assign(**{name: frame[name].mask(frame[name].abs() > LARGEST) for name in names})


def _figures(frame: pd.DataFrame) -> list[str]:
    """Return the columns of a table that hold figures, ends of bins and intervals apart."""
    return [name for name in frame.select_dtypes("float").columns if name not in _UNBOUNDED]
