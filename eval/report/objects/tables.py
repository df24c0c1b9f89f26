"""The tables of objects on the page: every rule, regions before and after withdrawal, kinds of prop and sizes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from eval.core.domains import domain_name
from eval.core.terminal.printing import count_pairs
from eval.report.tables import Cell, Table, interval_of_row
from eval.tables.columns import EN_DASH, Column, count, scaled, share
from eval.tables.object_table import ORACLE_VARIANT
from eval.tables.rows import records

_cm = _percent = scaled(100.0)
_ms = scaled(1000.0)
OBJECT_COLUMNS = (
    Column("object_iou_point", "point IoU", "high", share,
           "Returns shared by answer and truth, of those in either, one per 0.1 m cell; mean over the observable "
           "changes of a pair, missed ones 0, then over pairs. Below it the 95 % interval, drawn over tunnels."),
    Column("iou_matched_median", "of those matched", "high", share,
           "Median over the objects that were matched at all, all pairs together.",
           "Undefined where none was matched."),
    Column("object_iou_voxel", "voxel IoU", "high", share, "The same with 0.1 m voxels, mean over 8 grids."),
    Column("object_f1_25", "F1 at 0.25", "high", share, "Objects matched with at least this IoU, against missed and "
           "false ones; mean over pairs."),
    Column("object_f1_50", "F1 at 0.5", "high", share),
    Column("object_precision_50", "precision at 0.5", "high", share, "Matched objects among all that count.",
           "0 where none was answered; undefined where nothing changed and none was."),
    Column("kind_accuracy", "kind right", "high", share,
           "Added, removed, moved (with the right partner), reshaped, among those matched; mean over pairs. n: how "
           "many observable objects of all pairs were matched, short moves and reshaped ones left out.",
           "0 where none was matched; undefined where nothing changed."),
    Column("displacement_error_m", "moved, off by [cm]", None, _cm,
           "Answered displacement against the true one, map frame: median over matched halves of moves.",
           "Undefined where no displacement was answered."),
    Column("pile_volume_error", "piles, volume off by [%]", None, _percent,
           "Median size of (answered - true) / true over matched muck piles.",
           "Undefined where no volume was answered."),
    Column("object_iou_point_partial", "short moves, reshaped: IoU", "high", share,
           "Point IoU of the group `partial`, which is in no other column but kind and displacement."),
    Column("associated_accuracy", "AA", None, share,
           "Associated accuracy of DynamicMap_Benchmark: the root of the share of unchanged points that no object "
           "holds times the share of changed points that one holds; mean over pairs. Padded objects raise it and lower "
           "IoU, so it is read beside IoU and F1, and none is marked as best.", is_newer=True),
)  # fmt: skip
OBJECT_COUNTS = {
    "iou_matched_median": "n_matched", "kind_accuracy": "n_matched", "displacement_error_m": "n_displacements",
    "pile_volume_error": "n_piles", "object_iou_point_partial": "n_partial",
}  # fmt: skip
WITHDRAWAL_COLUMNS = (
    Column("n_withdrawn", "withdrawn", None, count),
    Column("region_recall_proposed", "recall, proposed", "high", share),
    Column("region_recall", "recall, kept", "high", share),
    Column("false_regions_per_100m_proposed", "false / 100 m, proposed", "low", share),
    Column("false_regions_per_100m", "false / 100 m, kept", "low", share),
    Column("t_oe_per_region_s", "t_oe / region [ms]", None, _ms),
    Column("t_returns_per_region_s", "of that returns, kinds, shapes [ms]", None, _ms),
)  # fmt: skip


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
            Cell(_group_name(row)), Cell(str(row["n_changes"]), interval=count_pairs(int(row["n_pairs"]))),
            Cell(share(row["iou_point"]), interval=interval_of_row(row, "iou_point", share)),
            Cell(share(row["iou_matched_median"])), Cell(share(row["share_50"])), Cell(share(row["share_found"])),
            Cell(share(row["kind_accuracy"])), Cell(_cm(row["displacement_error_m"])),
            Cell(_percent(row["volume_error"])),
            *(Cell(share(value)) for value in of_others),
        )  # fmt: skip
        rows.append((_MEASURES[str(row["measure"])], cells))
    names = ("IoU, oracles" if name == ORACLE_VARIANT else "IoU, voxel rule" for name in others)
    return Table((*headings, *names), tuple(rows), f"By what an object is and how large, {domain_name(domain)}")


_MEASURES = {"prop_kind": "kind of prop", "hull_volume_m3": "hull of the object [m³]"}


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
