"""The run folder: its layout, its finished cells, and the tables made from them.

provenance.json                               marks a run folder; written first
copied.json                                   time of the newest cell that is at a URL (eval.running.scaling.mirror)
blind.json                                    opaque names of the pairs (eval.running.export), once exported
pairs/<world>/<seed>/{before,after,truth}     simulated pairs; a world is a scenario, with what is set over it
answers/<world>/<seed>/<variant>/             raw answers (cdpipe.io.answer)
maps/<world>/<seed>.npz                       thinned maps for pictures
stages/<world>/<seed>/                        what the pipeline's stages gave (eval.running.stages); may be removed
cells/<world>/<seed>/<variant>.json           a finished cell: key, order, row, items
results.csv changes.csv regions.csv objects.csv keyframes.csv summary.csv
surface_changes.csv surface_windows.csv       where rock moved, or an answer says so
merge.csv                                     where pairs have a kind (eval.tables.merge_table)
regions_table.csv regions_targets.csv regions_by_size.csv budgets.csv roc.csv froc.csv
                                              where the plan says `report: regions` (eval.tables.regions.table)
hard.csv breaking_points.csv                  where its plan has axes (eval.tables.hardness)
objects_table.csv objects_by_group.csv objects_targets.csv
                                              where it says `report: objects` (eval.tables.object_table)
surface_table.csv surface_targets.csv detection_limits.csv
                                              where it says `report: surface` (eval.tables.surface.table)
effects.csv                                   where a world was run with and without a setting (eval.tables.effects)
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from cdpipe.core import files
from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, read_npz
from cdpipe.core.geometry.voxel import require_reachable
from cdpipe.core.names import path_part, visible
from cdpipe.core.whole_file import whole_file
from eval.core.output import make_writable, only_writer, remove, removed_if_empty, require_no_links
from eval.core.provenance import FORMAT_VERSION, TOOL
from eval.core.statistics import summarise
from eval.core.tablefile import plain_texts, read_table, replace_table, write_rows
from eval.plans.coverage import explain_unreadable_plan, measure_coverage, read_stored_plan
from eval.plans.targets import read_targets
from eval.plans.worlds import world_slug
from eval.running.cell_rows import ITEM_TABLES, SURFACE_TABLES, collect_tables, holds_rows
from eval.running.results.tables import without_unusable
from eval.tables.alarms import with_counted_alarms
from eval.tables.effects import effects
from eval.tables.hardness import FILES as HARD_FILES
from eval.tables.hardness import breaking_points, hardness_table
from eval.tables.merge_table import merge_table
from eval.tables.object_table import FILES as OBJECT_FILES
from eval.tables.object_table import object_tables
from eval.tables.regions.table import FILES as REGION_FILES
from eval.tables.regions.table import region_tables
from eval.tables.rows import without_costs_of_failures
from eval.tables.surface.table import FILES as SURFACE_FILES
from eval.tables.surface.table import surface_tables

# What provenance.json says of the run that made the cells; plan, settings and checkpoints are those of the last run.
_OF_THE_START = ("started", "finished", "command", "machine")
_OF_THE_MAKING = (*_OF_THE_START, "git_commit", "versions", "extras", "parts")
NEW_TABLES = ".tables.partial"  # in the run folder, while tables are written
_MAP_CELL_M = 0.1  # pictures number no smaller cells
_MAPS = {"before_points": ArraySpec("N,3", "float32"), "after_points": ArraySpec("M,3", "float32")}


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The folder of one run and the places in it."""

    path: Path

    def pair(self, scenario: str, seed: int) -> Path:
        """Folder of a simulated pair."""
        return self.path / "pairs" / world_slug(scenario) / str(seed)

    def answer(self, scenario: str, seed: int, variant: str) -> Path:
        """Folder of a raw answer."""
        return self.path / "answers" / world_slug(scenario) / str(seed) / path_part(variant)

    def cell(self, scenario: str, seed: int, variant: str) -> Path:
        """File of a finished cell."""
        return self.path / "cells" / world_slug(scenario) / str(seed) / f"{path_part(variant)}.json"

    def maps(self, scenario: str, seed: int) -> Path:
        """File of the thinned maps of a pair."""
        return self.path / "maps" / world_slug(scenario) / f"{seed}.npz"

    def read_maps(self, scenario: str, seed: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Read the (N, 3) and (M, 3) points of the thinned before and after maps, each in its odom frame, metres.

        Raises:
            InputError: They are missing or damaged.
        """
        maps = read_npz(self.maps(scenario, seed), _MAPS)
        for name, points in maps.items():
            require_reachable(
                f"{self.maps(scenario, seed)}: {name}", float(np.abs(points).max(initial=0.0)), _MAP_CELL_M
            )
        return maps["before_points"], maps["after_points"]

    def stages(self, scenario: str, seed: int) -> Path:
        """Folder of what the stages of a pair gave."""
        return self.path / "stages" / world_slug(scenario) / str(seed)

    def finished_cells(self) -> list[dict[str, Any]]:
        """Return every finished cell, by its path."""
        return list(self.each_cell())

    def each_cell(self) -> Iterator[dict[str, Any]]:
        """Yield every finished cell, by its path; no more than one is held."""
        cells = map(self.read_cell, sorted(self.path.glob("cells/*/*/*.json")))
        return (cell for cell in cells if cell is not None)

    def read_cell(self, path: Path) -> dict[str, Any] | None:
        """Read a finished cell; None where there is none, or what is there was cut short.

        Raises:
            InputError: It is of a newer tunnelcd.
        """
        document = read_json(path)
        if not {"key", "order", "row", *ITEM_TABLES} <= set(document) or not holds_rows(document):
            return None
        _require_format(path, document)
        return document

    def any_row(self, world_folder: str) -> dict[str, Any] | None:
        """Return the row of a finished cell of a world, None where there is none; the row has the world's name."""
        cells = map(self.read_cell, sorted((self.path / "cells" / world_folder).glob("*/*.json")))
        return next((cell["row"] for cell in cells if cell is not None), None)

    def provenance(self) -> dict[str, Any]:
        """Read provenance.json.

        Raises:
            InputError: It is missing, damaged or another program's.
        """
        path = self.path / "provenance.json"
        if not path.exists():
            raise InputError(f"{self.path}: not a run folder (no provenance.json): name one made by `run`")
        document = files.read_json(path, f"name a run folder made by `{TOOL} run`")
        if document.get("tool") != TOOL:
            raise InputError(f"{path}: not written by {TOOL}: name a run folder made by `{TOOL} run`")
        _require_format(path, document)
        return document

    def stored_provenance(self) -> dict[str, Any]:
        """Read provenance.json; {} where there is none."""
        return self.provenance() if (self.path / "provenance.json").is_file() else {}


def start_run_folder(path: Path) -> RunFolder:
    """Open a folder to run in: new, empty, or of an earlier run.

    Raises:
        InputError: It holds something else or a link, or cannot be written.
    """
    make_writable(path)
    run = RunFolder(path)
    if any(path.iterdir()):
        if not (path / "provenance.json").exists():
            raise InputError(f"{path}: not empty and not a run folder: name a new folder, or empty this one")
        run.provenance()
        require_no_links(path)
    return run


@contextmanager
def held_run_folder(path: Path) -> Iterator[RunFolder]:
    """Open a folder to run in, as `start_run_folder` does, and hold it; a new one that stays empty is removed."""
    with removed_if_empty(path):
        run = start_run_folder(path)
        with only_writer(path):
            yield run


def open_run_folder(path: Path) -> RunFolder:
    """Open the folder of an earlier run.

    Raises:
        InputError: There is none, or it holds a link.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such run folder: name one that `tunnelcd run PLAN --out RUN` made")
    run = RunFolder(path)
    run.provenance()
    require_no_links(path)
    return run


def write_tables(run: RunFolder) -> pd.DataFrame:
    """Write results.csv, the item tables, summary.csv and the other tables from the finished cells.

    All of them are written before the first takes the place of an earlier one.

    Returns:
        The rows of results.csv.

    Raises:
        InputError: No cell is finished.
    """
    collected = collect_tables(run)
    results, items = collected["results"], {table: collected[table] for table in ITEM_TABLES}
    usable = {table: without_unusable(frame) for table, frame in collected.items()}
    usable["results"] = without_costs_of_failures(usable["results"])
    counted = with_counted_alarms(usable["results"], run.stored_provenance().get("plan"))
    tables = {
        "summary": summarise(counted, keyframes=usable["keyframes"]),
        **{table: collected[table] for table in SURFACE_TABLES},
        "effects": effects(counted),
        "merge": merge_table(usable["results"], read_targets(run.stored_provenance())),
        **_report_tables(run, usable["results"], usable),
    }
    is_readable = not explain_unreadable_plan(run.stored_provenance())
    hidden = run.path / NEW_TABLES
    remove(hidden)
    try:
        for name, frame in {"results": results, **items}.items():
            write_rows(hidden / f"{name}.csv", frame)
        for name, frame in tables.items():
            if len(frame) or name == "summary":
                _write_csv(hidden / f"{name}.csv", frame)
        for name in (*items, "results", *tables):
            if (hidden / f"{name}.csv").exists():
                replace_table(hidden / f"{name}.csv", run.path / f"{name}.csv")
            elif name not in HARD_FILES or is_readable:
                remove(run.path / f"{name}.csv")
    finally:
        remove(hidden)
    return results


def current_results(run: RunFolder, earlier: Mapping[str, Any], now: Mapping[str, Any]) -> pd.DataFrame | None:
    """Return the rows of results.csv if the tables are up to date; None where they may not be.

    Args:
        run: The folder.
        earlier: The provenance of the run before.
        now: That of the present run. Plan, code and packages must be the same; code with uncommitted changes or of an
            unknown commit counts as changed.
    """
    commit, subjects = now["git_commit"], reported(now)
    if commit is None or commit.endswith("+") or "finished" not in earlier:
        return None
    if _lasting(earlier) != _lasting(json.loads(json.dumps(now, default=_plain))):
        return None
    names = ["results", "summary", *ITEM_TABLES]
    names += [*(REGION_FILES if "regions" in subjects else ()), *(OBJECT_FILES if "objects" in subjects else ())]
    names += SURFACE_FILES if "surface" in subjects else ()
    tables, cells = [run.path / f"{name}.csv" for name in names], [*run.path.glob("cells/*/*/*.json")]
    if not cells or not all(table.is_file() for table in tables):
        return None
    if max(cell.stat().st_mtime_ns for cell in cells) >= min(table.stat().st_mtime_ns for table in tables):
        return None
    results = read_table(run.path / "results.csv")
    return results if len(results) == len(cells) else None


def keep_makers(now: Mapping[str, Any], earlier: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance of a run that made no cell: who made the cells, when and how stays.

    Args:
        now: The provenance of the present run.
        earlier: That of the run before, {} where there was none. Code and packages that differ from its own and write
            the tables now go under "tables".
    """
    made = {name: earlier[name] for name in _OF_THE_MAKING if name in earlier}
    if "versions" in made:  # runs of before did not record extras, and those of today made no cell
        now = {name: value for name, value in now.items() if name != "extras"}
    tables = {name: now[name] for name in ("git_commit", "versions") if made.get(name, now[name]) != now[name]}
    return {**now, **made, **({"tables": tables} if tables else {})}


def _lasting(provenance: Mapping[str, Any]) -> dict[str, Any]:
    tables = provenance.get("tables")
    told = {**provenance, **tables} if isinstance(tables, Mapping) else provenance
    return {name: value for name, value in told.items() if name not in {*_OF_THE_START, "tables", "parts"}}


def reported(provenance: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what the plan of a run asks a report of: "regions", "objects", "surface"; () for nothing."""
    plan = provenance.get("plan")
    subjects = (plan.get("report") or ()) if isinstance(plan, Mapping) else ()
    return tuple(subjects) if isinstance(subjects, list | tuple) else (str(subjects),)


def _report_tables(
    run: RunFolder, results: pd.DataFrame, items: Mapping[str, pd.DataFrame]
) -> Mapping[str, pd.DataFrame]:
    """Return the tables that the plan asks for, and empty ones for those that it does not."""
    tables = {name: pd.DataFrame() for name in (*REGION_FILES, *OBJECT_FILES, *HARD_FILES, *SURFACE_FILES)}
    provenance = run.stored_provenance()
    subjects, targets = reported(provenance), read_targets(provenance)
    plan = read_stored_plan(provenance)
    has_axes = plan is not None and bool(plan.axes)
    if not (subjects or has_axes) or "region_auroc" not in results:
        return tables
    cases = zip(results["scenario"], results["seed"].astype(int), results["variant"], strict=True)
    is_whole = measure_coverage(provenance, cases).is_whole
    if "regions" in subjects:
        tables |= region_tables(results, items, targets, is_whole=is_whole)
    if plan is not None and has_axes:
        steps = hardness_table(results, items["regions"], items["changes"], plan)
        tables |= dict(zip(HARD_FILES, (steps, breaking_points(steps)), strict=True))
    if "objects" in subjects:
        tables |= object_tables(results, items["changes"], targets, is_whole=is_whole)
    if "surface" in subjects:
        tables |= surface_tables(results, items["surface_windows"], targets, is_whole=is_whole)
    return tables


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; {} where it is missing or damaged.

    Raises:
        InputError: It cannot be read, for example because its disk is not mounted.
    """
    try:
        return files.read_json(path, "")
    except InputError as error:
        if isinstance(error.__cause__, OSError) and not isinstance(error.__cause__, FileNotFoundError):
            raise
        return {}


def _require_format(path: Path, document: Mapping[str, Any]) -> None:
    """Refuse a file of a newer format; the first cells carry no number and hold the same as those of format 1."""
    found = TOOL, document.get("format_version", 1)
    files.require_format(path, found, TOOL, FORMAT_VERSION, "run the plan again in a new folder")


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write JSON that appears whole or not at all; numpy scalars become plain numbers.

    Raises:
        InputError: A text of it, as a name of a file in a command line, is not UTF-8: it could not be read again.
    """
    text = json_text(document)
    try:
        if "\\ud" in text:  # half a surrogate pair stands for a byte that is not UTF-8
            json.dumps(json.loads(text), ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        odd = visible(error.object[max(error.start - 30, 0) : error.end + 10])
        raise InputError(f"{path}: cannot hold {odd}, which is not UTF-8: give it another name") from error
    with whole_file(path) as partial:
        partial.write_text(text)


def json_text(document: Mapping[str, Any]) -> str:
    """Return what `write_json` writes."""
    return json.dumps(document, indent=1, default=_plain)


def _write_csv(path: Path, frame: pd.DataFrame) -> None:
    with whole_file(path) as partial:
        plain_texts(frame).to_csv(partial, index=False)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} does not fit into JSON")
