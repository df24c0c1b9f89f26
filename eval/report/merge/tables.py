"""The tables of the merge on the page."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from cdpipe.core.geometry import Float64Array
from cdpipe.merge.evidence import GATES
from eval.plans.targets import is_oracle
from eval.report.tables import Cell, Table
from eval.tables.columns import EN_DASH, UNDEFINED, Column, fine, significant
from eval.tables.conditions import told_apart
from eval.tables.merge_table import ALL_FAMILIES, RIGHT_DEG, RIGHT_M, RULES, TIMES, kinds
from eval.tables.rows import numbers, records, texts

# a variant that leaves a part out is done with it in microseconds
_NOTHING_S = 1e-4
MERGE_COLUMNS = (
    Column("within_target", "within target", "high", fine,
           "Share of all pairs, refused and failed ones included, that do what their kind asks for; below it the 95 % "
           "Wilson interval over tunnels.", "No target for an oracle."),
    Column("wrong", "wrong, accepted", "low", fine,
           f"Pairs that were accepted with a median error over {RIGHT_M:g} m or {RIGHT_DEG:g} deg, or although the "
           "sessions share no place, where the error is undefined."),
    Column("merge_error_m", "error [m], [deg], along [m]", "low", fine,
           "Median over the accepted pairs of a pair's median error; below it the 95th percentile over the pairs, and "
           "of how many where not of all. Along: the part along the tunnel.", "Undefined where nothing was accepted."),
    Column("merge_error_m_p95", "p95 along path [m]", "low", fine,
           "The same of a pair's 95th percentile over its keyframes."),
    Column("n_p95_over_half_m", "p95 over 0.5 m", "low", significant,
           f"Accepted pairs whose 95th percentile along the path is over {RIGHT_M:g} m, median right or not."),
    Column("overlap_true", "true overlap", None, fine,
           "Share of the after drive that lies within 5 m of the before drive."),
    Column("t_index_s", "t_index", "low", significant, "Indexing both maps; can be done while mapping."),
    Column("t_merge_s", "t_merge", "low", significant,
           "From indexed maps and stored vectors to an accepted transform: every candidate registered coarsely, the "
           "best judged along the path, the next only if it is refused."),
    Column("t_refine_s", "t_refine", "low", significant, "Local refinement along the path."),
)  # fmt: skip


_TARGET_HEADINGS = (
    "target", "verdict", "within target", "wrong, accepted", "pairs", "accepted", "refused", "failed",
    "error [m]", "error [deg]", "along [m]", "p95 along path [m]", "p95 over 0.5 m",
)  # fmt: skip


def kinds_table(table: pd.DataFrame, *, is_whole: bool = True) -> Table:
    """Return a row for every kind of pair and variant: counts, share within the target, errors, met or not.

    There is no verdict where the run does not hold all planned pairs.
    """
    own = table[table["family"] == ALL_FAMILIES]
    caption = "Kinds of pair: one row is one method; the group says what the kind asks for"
    rules = [f": {RULES[kind]}" if kind in RULES else "" for kind in own["pair_kind"]]
    groups = [f"{kind}{rule}" for kind, rule in zip(name_kinds(own), rules, strict=True)]
    return _targets_table(own.assign(pair_kind=groups), "variant", caption, is_whole=is_whole)


def families_table(table: pd.DataFrame, name: str, *, is_whole: bool = True) -> Table:
    """Return the same for one variant, family by family."""
    own = table[(table["family"] != ALL_FAMILIES) & (table["variant"] == name)]
    caption = f"The same by family: {name}; all variants are in merge.csv"
    return _targets_table(own.assign(pair_kind=name_kinds(own)), "family", caption, is_whole=is_whole)


def name_kinds(table: pd.DataFrame) -> list[str]:
    """Return (N,) the kind of pair of each row, with its odometry where the rows differ in it: "drift, kiss-icp"."""
    if not told_apart(table):
        return [str(kind) for kind in table["pair_kind"]]
    return [f"{kind}, {odometry}" for kind, odometry in zip(table["pair_kind"], table["odometry"], strict=True)]


def _targets_table(table: pd.DataFrame, first: str, caption: str, *, is_whole: bool) -> Table:
    """Return the rows of the merge table by their `pair_kind`; `first` is the column that names them."""
    rows = [
        (str(row["pair_kind"]), (Cell(str(row[first])), *_target_cells(row, is_whole=is_whole)))
        for row in records(table)
    ]
    return Table((first, *_TARGET_HEADINGS), tuple(rows), caption)


def refusals_table(results: pd.DataFrame) -> Table:
    """Return for every kind and variant how many refusals name which gate, and how many name none."""
    refused = results[results["status"] == "merge_refused"]
    refused = refused.assign(pair_kind=kinds(refused), error=texts(refused, "error"))
    rows: list[tuple[str, tuple[Cell, ...]]] = []
    for kind in [name for name in RULES if (refused["pair_kind"] == name).any()]:
        for variant, group in refused[refused["pair_kind"] == kind].groupby("variant", sort=False):
            named = [[setting in error for _, setting in GATES] for error in group["error"]]
            counts = [sum(column) for column in zip(*named, strict=True)]
            n_none = sum(not any(row) for row in named)
            cells = (Cell(str(variant)), Cell(str(len(group))), *(Cell(str(n)) for n in (*counts, n_none)))
            rows.append((kind, cells))
    headings = ("variant", "refused", *(name.replace("_", " ") for name, _ in GATES), "none of these")
    return Table(headings, tuple(rows), "Which gate the refusals name")


def times_table(results: pd.DataFrame) -> Table:
    """Return median, 95th percentile and number of the seconds of each part of the merge, a row for each variant."""
    headings = ["variant"]
    for column in TIMES:
        headings += [f"{column.removesuffix('_s')} [s]", "p95 [s]", "n"]
    rows = []
    for name in [each for each in dict.fromkeys(texts(results, "variant")) if not is_oracle(each)]:
        cells = [Cell(name)]
        for column in TIMES:
            seconds = stated_seconds(results[results["variant"] == name], column)
            median, p95 = np.percentile(seconds, (50, 95)) if len(seconds) else (math.nan, math.nan)
            cells += [Cell(significant(float(median))), Cell(significant(float(p95))), Cell(str(len(seconds)))]
        rows.append(("", tuple(cells)))
    caption = "Time of the merge: median and 95th percentile over the n accepted pairs whose variant has that part"
    return Table(tuple(headings), tuple(rows), caption)


def stated_seconds(results: pd.DataFrame, column: str) -> Float64Array:
    """Return the (N,) seconds of a part of the merge, without those of variants that leave it out."""
    values = numbers(results, column)
    return values[values >= _NOTHING_S]


def _target_cells(row: dict[str, Any], *, is_whole: bool) -> tuple[Cell, ...]:
    has_target = is_whole and not math.isnan(float(row["target_share"]))
    low, high = _percent(row["low"]).removesuffix(" %"), _percent(row["high"])
    n_wrong = int(row["n_wrong_accepted"])
    return (
        Cell(_percent(float(row["target_share"]))),
        Cell(("met" if row["is_met"] else "not met") if has_target else UNDEFINED, has_target and not row["is_met"]),
        Cell(_percent(row["share_within_target"]), interval=f"{low}{EN_DASH}{high}"),
        Cell(str(n_wrong), n_wrong > 0),
        *(Cell(str(row[name])) for name in ("n_pairs", "n_accepted", "n_refused", "n_failed")),
        *(_error_cell(row, f"merge_error_{name}") for name in ("m", "deg", "along_m", "m_p95")),
        Cell(str(row["n_p95_over_half_m"])),
    )


def _error_cell(row: dict[str, Any], column: str) -> Cell:
    median, p95, n = (float(row[f"{part}_{column}"]) for part in ("median", "p95", "n"))
    count_text = "" if n == row["n_accepted"] else f", n {n:.0f}"
    return Cell(fine(median), interval="" if math.isnan(median) else fine(p95) + count_text)


def _percent(value: float) -> str:
    return UNDEFINED if math.isnan(value) else f"{100 * value:.1f} %".replace(".0 %", " %")
