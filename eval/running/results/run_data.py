"""A run folder as reports read it: its tables as plain rows, its provenance, and what is missing."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from eval.core.tablefile import read_table, table_file
from eval.plans.coverage import Coverage, measure_coverage
from eval.plans.targets import read_targets
from eval.running.results.tables import REQUIRED, read_rows, require_cases, require_numbers, without_unusable
from eval.running.results.values import Row
from eval.running.runfolder import RunFolder, read_json
from eval.tables.conditions import COLUMNS as CONDITION_COLUMNS
from eval.tables.conditions import Condition, by_condition, of_condition
from eval.tables.rows import records, without_costs_of_failures

# columns of text of the derived tables
_DERIVED_TEXTS = {"domain", "variant", *CONDITION_COLUMNS}
_MORE_TEXTS = {
    "regions_targets": ("target", "asked", "is_met"), "objects_targets": ("target", "asked", "is_met"),
    "surface_targets": ("target", "asked", "is_met"), "regions_by_size": ("measure",), "budgets": ("site", "price"),
    "hard": ("axis", "unit", "value", "scenario"), "breaking_points": ("axis", "unit", "value", "is_measured"),
    "objects_by_group": ("measure", "value"),
}  # fmt: skip
_COUNT = re.compile(r"n(_|$)")


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

    @property
    def cases(self) -> list[tuple[str, str, int]]:
        """Scenario, variant and seed of every row of `results`."""
        return [(str(row["scenario"]), str(row["variant"]), int(row["seed"])) for row in self.results]


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
    results = read_rows(path, left_out)
    if not results:
        raise InputError(f"{path}: holds no row: no case was finished, run the plan again")
    absent = [name for name in REQUIRED if name not in results[0]]
    if absent:
        raise InputError(f"{path}: column {', '.join(absent)} is missing: expected a table written by `tunnelcd run`")
    frame = pd.DataFrame(results)
    require_cases(path, frame)
    results = tuple(records(without_costs_of_failures(frame)))
    missing = []
    items: dict[str, tuple[Row, ...]] = {"changes": (), "regions": ()}
    for name in items:
        if (path := table_file(run / f"{name}.csv")).exists():
            items[name] = read_rows(path, left_out)
        else:
            missing.append(f"{path.name} is not in the run folder: what it would show is left out.")
    provenance = read_json(run / "provenance.json")
    if not provenance:
        missing.append(
            "provenance.json is not in the run folder or damaged: machine, command and versions are unknown."
        )
    tables = results, items["changes"], items["regions"]
    return RunData(RunFolder(run), *tables, provenance, tuple(missing), tuple(left_out))


def read_told_merges(run: RunFolder) -> dict[str, str]:
    """Return what told each method of an evaluation its merge, "the truth" or "tunnelcd"; nothing of other methods."""
    found = (read_json(path) for path in sorted(run.path.glob("evaluations/*/evaluation.json")))
    sources = {"given": "the truth", "ours": "tunnelcd"}
    merges = {str(each.get("name")): str(each.get("merge")) for each in found}
    return {name: sources[merge] for name, merge in merges.items() if merge in sources}


def without_told_merges(data: RunData) -> tuple[RunData, RunData]:
    """Return a run in which methods that were told their merge have no merge error, and the run without these methods.

    A sentence of `left_out` says so. Where no method merged by itself none is compared, and all stay as they are.
    """
    told = read_told_merges(data.folder)
    variants = {str(row["variant"]) for row in data.every_result}
    notes = tuple(f"merge given: {name} was told the merge by {told[name]}, so its merge errors are left out."
                  for name in sorted(variants & told.keys()))  # fmt: skip
    own = tuple(row for row in data.results if row["variant"] not in told)
    if not notes or not own:
        return data, data
    shown = tuple(_blank_merge(row) if row["variant"] in told else row for row in data.results)
    return replace(data, results=shown, left_out=(*data.left_out, *notes)), replace(data, results=own)


def _blank_merge(row: Row) -> Row:
    return {name: math.nan if name.startswith("merge_error_") else value for name, value in row.items()}


def stored_table(data: RunData, name: str) -> pd.DataFrame:
    """Return a derived table of the run folder, empty where it is not there; what `read_run` leaves out is NaN.

    Raises:
        InputError: A column of numbers holds text, or a count is missing.
    """
    path = table_file(data.folder.path / f"{name}.csv")
    if not path.exists():
        return pd.DataFrame()
    frame = read_table(path)
    require_numbers(path, frame, {*_DERIVED_TEXTS, *_MORE_TEXTS.get(name, ())})
    for column in frame:
        if _COUNT.match(str(column)) and frame[column].isna().any():
            raise InputError(
                f"{path}: column {column} lacks a count: `tunnelcd score {path.parent}` makes the table anew"
            )
    frame = without_unusable(frame)
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


def covered_by(data: RunData) -> Coverage:
    """Return how much of its plan a run holds."""
    cases = ((str(row["scenario"]), int(row["seed"]), str(row["variant"])) for row in data.every_result)
    return measure_coverage(data.provenance, cases)
