"""The tables of objects on the page: every rule, regions before and after withdrawal, kinds of prop and sizes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd

from eval.core.domains import domain_name
from eval.report.tables import Cell, Table, beside, best, used_pairs
from eval.tables.columns import EN_DASH, Column, share, significant, spaced
from eval.tables.object_table import ORACLE_VARIANT
from eval.tables.region_table import ALL_DOMAINS


def _cm(metres: float) -> str:
    return significant(100.0 * metres)


def _percent(value: float) -> str:
    return significant(100.0 * value)


def _ms(seconds: float) -> str:
    return significant(1000.0 * seconds)


OBJECT_COLUMNS = (
    Column("object_iou_point", "point IoU", "high", share,
           "Returns shared by answer and truth, of those in either, one per 0.1 m cell; mean over the observable "
           "changes of a pair, missed ones 0, then over pairs. Below it the 95 % bootstrap interval over pairs.", ""),
    Column("iou_matched_median", "of those matched", "high", share,
           "Median over the objects that were matched at all, all pairs together.",
           "Undefined where none was matched."),
    Column("object_iou_voxel", "voxel IoU", "high", share, "The same with 0.1 m voxels, mean over 8 grids.", ""),
    Column("object_f1_25", "F1 at 0.25", "high", share, "Objects matched with at least this IoU, against missed and "
           "false ones; mean over pairs.", ""),
    Column("object_f1_50", "F1 at 0.5", "high", share, "", ""),
    Column("object_precision_50", "precision at 0.5", "high", share, "Matched objects among all that count.",
           "Undefined where none was answered."),
    Column("kind_accuracy", "kind right", "high", share,
           "Added, removed, moved (with the right partner), reshaped, among those matched.",
           "Undefined where none was matched."),
    Column("displacement_error_m", "moved, off by [cm]", None, _cm,
           "Answered displacement against the true one, map frame: median over matched halves of moves.",
           "Undefined where no displacement was answered."),
    Column("pile_volume_error", "piles, volume off by [%]", None, _percent,
           "Median size of (answered - true) / true over matched muck piles.",
           "Undefined where no volume was answered."),
    Column("object_iou_point_partial", "short moves, reshaped: IoU", "high", share,
           "Point IoU of the group `partial`, which is in no other column but kind and displacement.", ""),
)  # fmt: skip
_COUNTS = {
    "iou_matched_median": "n_matched", "displacement_error_m": "n_displacements",
    "pile_volume_error": "n_piles", "object_iou_point_partial": "n_partial",
}  # fmt: skip
_REGION_COLUMNS = (
    Column("region_recall_proposed", "recall, proposed", "high", share, "", ""),
    Column("region_recall", "recall, kept", "high", share, "", ""),
    Column("false_regions_per_100m_proposed", "false / 100 m, proposed", "low", share, "", ""),
    Column("false_regions_per_100m", "false / 100 m, kept", "low", share, "", ""),
    Column("t_oe_per_region_s", "t_oe / region [ms]", None, _ms, "", ""),
    Column("t_returns_per_region_s", "of that returns, kinds, shapes [ms]", None, _ms, "", ""),
)  # fmt: skip


def methods_table(table: pd.DataFrame, cases: pd.DataFrame) -> Table:
    """Return every method in and out of distribution; the best that asks no truth is marked.

    Args:
        table: Rows of objects_table.csv.
        cases: Rows of results.csv with their `domain`, which tell over how many pairs a mean is.
    """
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for domain, own in _by_domain(table):
        marks = {column.key: _marks(own, column, cases) for column in OBJECT_COLUMNS}
        for index, row in enumerate(own):
            cells = (_cell(row, column, marks[column.key][index], cases) for column in OBJECT_COLUMNS)
            failed = f"{row['n_failed']} failed" if row["n_failed"] else ""
            rows.append(
                (domain, (Cell(spaced(str(row["variant"]))), Cell(str(row["n_pairs"]), interval=failed), *cells))
            )
    headings = ("method", "pairs", *(column.heading for column in OBJECT_COLUMNS))
    return Table(headings, tuple(rows), "Objects: every rule, in and out of the training distribution")


def withdrawal_table(table: pd.DataFrame, cases: pd.DataFrame) -> Table:
    """Return recall and false alarms of the regions before and after those without an object were withdrawn.

    Args:
        table: As of `methods_table`.
        cases: As there.
    """
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for domain, own in _by_domain(table):
        marks = {column.key: _marks(own, column, cases) for column in _REGION_COLUMNS}
        for index, row in enumerate(own):
            cells = (_cell(row, column, marks[column.key][index], cases) for column in _REGION_COLUMNS)
            rows.append((domain, (Cell(spaced(str(row["variant"]))), Cell(str(row["n_withdrawn"])), *cells)))
    headings = ("method", "withdrawn", *(column.heading for column in _REGION_COLUMNS))
    return Table(headings, tuple(rows), "Regions before and after those in which nothing survives are withdrawn")


def groups_table(groups: pd.DataFrame, domain: str, main: str, rivals: Sequence[str]) -> Table:
    """Return IoU and the rest by kind of prop and size of hull, of the main variant, with the IoU of others beside."""
    headings = (
        "", "objects", f"IoU, {main}", "of those matched", "IoU of 0.5 or more", "region found", "kind right",
        "moved, off by [cm]", "volume off by [%]",
    )  # fmt: skip
    own = groups[(groups["domain"] == domain)] if len(groups) else groups
    others = [name for name in (*rivals, ORACLE_VARIANT) if len(own) and (own["variant"] == name).any()]
    rows = []
    for row in records(own[own["variant"] == main] if len(own) else own):
        of_others = [_same_group(own[own["variant"] == name], row) for name in others]
        cells = (
            Cell(_group_name(row)), Cell(str(row["n_changes"]), interval=_pairs(int(row["n_pairs"]))),
            Cell(share(row["iou_point"]), interval=_interval(row, "iou_point", share)),
            Cell(share(row["iou_matched_median"])), Cell(share(row["share_50"])), Cell(share(row["share_found"])),
            Cell(share(row["kind_accuracy"])), Cell(_cm(row["displacement_error_m"])),
            Cell(_percent(row["volume_error"])),
            *(Cell(share(value)) for value in of_others),
        )  # fmt: skip
        rows.append((_MEASURES[str(row["measure"])], cells))
    names = ("IoU, oracles" if name == ORACLE_VARIANT else "IoU, voxel rule" for name in others)
    return Table((*headings, *names), tuple(rows), f"By what an object is and how large, {domain_name(domain)}")


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as dictionaries."""
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]


_MEASURES = {"prop_kind": "kind of prop", "hull_volume_m3": "hull of the object [m³]"}


def is_told_the_truth(variant: str) -> bool:
    """Tell whether a variant takes its merge or its regions from the truth."""
    return variant.startswith("oracle-")


def _by_domain(table: pd.DataFrame) -> list[tuple[str, list[dict[str, Any]]]]:
    """Return the rows of each domain under a line that says how much they are over."""
    found = []
    for domain, own in table.groupby("domain", sort=False):
        rows = records(own)
        n_objects = max(int(row["n_changes"]) for row in rows)
        pairs = _pairs(max(int(row["n_pairs"]) for row in rows))
        found.append((f"{domain_name(str(domain))}: {pairs}, {n_objects} observable objects", rows))
    return found


def _marks(rows: Sequence[Mapping[str, Any]], column: Column, cases: pd.DataFrame) -> list[bool]:
    """Mark the best of the rows that are not told the truth."""
    fair = [index for index, row in enumerate(rows) if not is_told_the_truth(str(row["variant"]))]
    counts = [_used(rows[index], column, cases)[0] for index in fair]
    is_best = best([float(rows[index][column.key]) for index in fair], column, counts)
    return [index in fair and is_best[fair.index(index)] for index in range(len(rows))]


def _used(row: Mapping[str, Any], column: Column, cases: pd.DataFrame) -> tuple[int, int]:
    """Return over how many pairs a figure is and of how many it could be; of a median over objects their number."""
    if column.key in _COUNTS:
        return int(row[_COUNTS[column.key]]), int(row[_COUNTS[column.key]])
    of_domain = cases if row["domain"] == ALL_DOMAINS else cases[cases["domain"] == row["domain"]]
    return used_pairs(of_domain, str(row["variant"]), column.key)


def _cell(row: Mapping[str, Any], column: Column, is_best: bool, cases: pd.DataFrame) -> Cell:
    below = beside(_interval(row, column.key, column.shown), *_used(row, column, cases))
    if column.key in _COUNTS:
        below = "\n".join(filter(None, (below, f"n {row[_COUNTS[column.key]]}")))
    return Cell(column.shown(float(row[column.key])), is_best, below)


def _interval(row: Mapping[str, Any], name: str, shown: Callable[[float], str]) -> str:
    low, high = (float(row.get(f"{name}_{end}", math.nan)) for end in ("low", "high"))
    return "" if math.isnan(low) else f"{shown(low)}{EN_DASH}{shown(high)}"


def _pairs(n_pairs: int) -> str:
    return "1 pair" if n_pairs == 1 else f"{n_pairs} pairs"


def _group_name(row: Mapping[str, Any]) -> str:
    if row["measure"] == "prop_kind":
        return str(row["value"]).replace("_", " ")
    low, high = float(row["low"]), float(row["high"])
    return f"≥ {low:g}" if math.isinf(high) else f"< {high:g}" if low == 0 else f"{low:g}{EN_DASH}{high:g}"


def _same_group(groups: pd.DataFrame, row: Mapping[str, Any]) -> float:
    """Return the IoU of another variant's row for the same kind or bin; NaN without one."""
    is_same = groups["measure"] == row["measure"]
    is_same &= (groups["value"] == row["value"]) if row["measure"] == "prop_kind" else (groups["low"] == row["low"])
    found = groups["iou_point"][is_same]
    return float(found.iloc[0]) if len(found) else math.nan
