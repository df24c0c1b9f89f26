"""What a finished cell holds, and the tables of all cells in the order of the plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from cdpipe.core.errors import InputError
from eval.running.scaling.frames import RowTable, sort_cells

if TYPE_CHECKING:
    from eval.running.runfolder import RunFolder

IDENTITY = ("scenario", "seed", "variant")
# columns of text of results.csv and the item tables; every other one holds numbers or truth values
TEXT_COLUMNS = {
    "scenario", "variant", "preset", "family", "pair_kind", "domain", "commit", "status", "error", "session", "name",
    "kind", "prop_kind", "group", "why_not", "matched_kind", "outcome", "found_changes",
    "found_changes_proposed", "twins", "checkpoints", "extras", "odometry_before", "odometry_after", "sensor_profile",
}  # fmt: skip
_NAMED = {"scenario": str, "seed": int, "variant": str}
ITEM_TABLES = ("changes", "regions", "objects", "keyframes")
# tables of rock that moved: a cell has their rows, and a run their files, only where there are some
SURFACE_TABLES = ("surface_changes", "surface_windows")
# what readers of an empty table may ask for
_MINIMAL_COLUMNS = {"keyframes": ("keyframe", "score", "label")}


def is_row_of_unmade(row: Mapping[str, Any]) -> bool:
    """Tell whether the row of a cell is of a pair without a truth: its world cannot be made, or its worker died."""
    n_observable = row.get("n_observable")
    return row.get("status") != "ok" and (n_observable is None or n_observable != n_observable)  # noqa: PLR0124 - NaN


def holds_rows(document: Mapping[str, Any]) -> bool:
    """Return whether a cell holds rows of numbers, and of texts where texts belong, and names its case in each."""
    tables = [[document["row"]], *(document[table] for table in ITEM_TABLES)]
    tables += [document[table] for table in SURFACE_TABLES if table in document]
    order = document["order"]
    is_placed = isinstance(order, list) and [type(place) for place in order] == [int, int]
    return is_placed and all(isinstance(rows, list) and all(map(_is_row, rows)) for rows in tables)


def _is_row(row: Any) -> bool:
    if not isinstance(row, dict) or any(type(row.get(name)) is not kind for name, kind in _NAMED.items()):
        return False
    for name, value in row.items():
        kind = type(value)
        if kind is list or kind is dict or (kind is str and name not in TEXT_COLUMNS):
            return False
    return True


def collect_tables(run: RunFolder) -> dict[str, pd.DataFrame]:
    """Return the table `results`, and the item tables, of all finished cells in the order of the plan.

    Raises:
        InputError: No cell is finished.
    """
    paths = list(run.path.glob("cells/*/*/*.json"))
    worlds = {path.parts[-3] for path in paths}
    names = {world: row["scenario"] for world in worlds if (row := run.any_row(world)) is not None}
    tables, places = _read_tables(run, sort_cells(paths, names))
    if not places:
        raise InputError(f"{run.path}: no finished cell: run a plan first")
    ordered = sorted(places, key=lambda path: places[path])
    if ordered != list(places):  # a cell lies in the folder of another world or seed
        tables, _ = _read_tables(run, ordered)
    return tables


def _read_tables(
    run: RunFolder, paths: Sequence[Path]
) -> tuple[dict[str, pd.DataFrame], dict[Path, tuple[int, str, int, int]]]:
    """Return the tables of some cells, and the place of each finished one among the rows."""
    places = {}
    collected = {table: RowTable() for table in ("results", *ITEM_TABLES, *SURFACE_TABLES)}
    for path in paths:
        if (cell := run.read_cell(path)) is None:
            continue
        row, order = cell["row"], cell["order"]
        places[path] = order[0], row["scenario"], row["seed"], order[1]
        # older cells lack the column; they were run without workers
        collected["results"].add([{**row, "is_contended": row.get("is_contended", False)}])
        for table in (*ITEM_TABLES, *SURFACE_TABLES):
            collected[table].add(cell.get(table, ()))
    frames = {table: rows.frame() for table, rows in collected.items()}
    return {table: frame if len(frame) else _empty(table) for table, frame in frames.items()}, places


def _empty(table: str) -> pd.DataFrame:
    return pd.DataFrame(columns=[*IDENTITY, *_MINIMAL_COLUMNS.get(table, ())])
