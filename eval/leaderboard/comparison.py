"""A method of others beside the reference rows of the same pairs: means, and differences pair by pair."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from eval.core.domains import domain_name
from eval.core.output import make_writable
from eval.core.statistics import interval_over_tunnels, mean, median, statistic_of
from eval.core.tablefile import csv_text
from eval.core.terminal.printing import count_pairs
from eval.leaderboard.calls import list_merges
from eval.leaderboard.reference import take_other_methods, why_no_pair
from eval.report.comparing.columns import COMPARED, figures_of, is_time
from eval.report.comparing.differences import NOT_JUDGED, paired_differences, verdict
from eval.report.render import write_file
from eval.running.results.run_data import RunData
from eval.running.results.sides import find_other_worlds
from eval.running.results.values import text
from eval.tables.conditions import odometry_of
from eval.tables.rows import PAIR, is_told_the_truth, numbers, stated, stated_columns, texts, tunnels_of

FIGURES = ("region_recall", "false_regions_per_100m", "is_alarm", "object_iou_point", "object_f1_50", "t_total_s")
HEADINGS = dict(zip(FIGURES, ("recall", "false/100m", "alarms", "IoU", "F1 at 0.5", "time [s]"), strict=True))
SHOWN = {column.key: column for column in COMPARED}
_MAIN_REFERENCE = "tunnelcd"
_NAME_WIDTH, _PAIRS_WIDTH = 18, 8
_WIDTHS = (10, 11, 10, 10, 12)  # of five figures

Pairs = Mapping[tuple[str, int], Mapping[str, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A method and the reference.

    Attributes:
        table: One row per kind of pairs (`part_pairs`) and method, the evaluated one first: `part`, method, n_pairs,
            n_answered, and of each of `FIGURES` the value with the ends of its 95 % interval, `<figure>_low` and
            `_high`.
        pairs: One row per pair and reference method: the figures of both, and their differences.
        paired: One row per kind of pairs, reference method and figure: the mean difference with its interval, and a
            verdict.
        notes: What a reader of the tables must know, one sentence each.
    """

    table: pd.DataFrame
    pairs: pd.DataFrame
    paired: pd.DataFrame
    notes: tuple[str, ...]


def compare_with_reference(results: pd.DataFrame, name: str, references: Sequence[RunData], calls: Pairs) -> Comparison:
    """Compare a method with the reference rows of the pairs that both have.

    Args:
        results: Rows of results.csv of the method.
        name: The method.
        references: Where reference rows are; of a method that several have, the first with rows of these pairs counts.
            Rows under `name` are no reference: they may be of another method that is called the same.
        calls: How the call about each pair ended, by (scenario, seed).
    """
    own = take_figures(results)
    references = [take_other_methods(data, name) for data in references]
    others = dict(list_variants(references, own.index))
    shared = own.index if not others else own.index[own.index.isin(_union(others))]
    rows, paired = [], []
    for part, members in part_pairs(own.loc[shared]).items():
        of_part = {variant: each.loc[each.index.intersection(members)] for variant, each in others.items()}
        tables = {name: own.loc[members], **{variant: each for variant, each in of_part.items() if len(each)}}
        rows += [{"part": part, **summarise_figures(variant, each)} for variant, each in tables.items()]
        paired += [
            {"part": part, "reference": variant, "n_pairs": len(each), **row,
             "verdict": NOT_JUDGED if is_time(row["metric"]) else verdict(row)}
            for variant, each in tables.items() if variant != name
            for row in paired_differences(stated_columns(each, FIGURES), stated_columns(own.loc[each.index], FIGURES))
        ]  # fmt: skip
    pairs = pd.DataFrame(list(_by_pair(own, others, calls)))
    return Comparison(
        pd.DataFrame(rows),
        pairs,
        pd.DataFrame(paired).drop(columns="is_same", errors="ignore"),
        (*_notes(own, others, references, shared), *note_other_worlds(results, references)),
    )


def write_tables_of(found: Comparison, folder: Path) -> None:
    """Write table.csv, differences.csv (pair by pair) and comparison.csv (their means) into a folder.

    Raises:
        InputError: The folder cannot be written.
    """
    make_writable(folder)
    for file, table in (("table", found.table), ("differences", found.pairs), ("comparison", found.paired)):
        write_file(folder / f"{file}.csv", csv_text(table))


def list_lines(found: Comparison) -> list[str]:
    """Return the table and what was found as lines of at most 80 characters: below each mean stands its interval.

    Alarms stand in the place of times where there are pairs without changes.
    """
    left_out = "is_alarm" if found.table["is_alarm"].isna().all() else "t_total_s"
    shown = [key for key in FIGURES if key != left_out]
    lines, part = [_line("method", "pairs", [HEADINGS[key] for key in shown])], ""
    for row in found.table.to_dict("records"):
        if row["part"] != part:
            part = str(row["part"])
            lines.append(f"{part}:")
        name = str(row["method"])
        name = name if len(name) < _NAME_WIDTH else f"{name[: _NAME_WIDTH - 2]}\u2026"
        spans = [show_span(key, row[f"{key}_low"], row[f"{key}_high"]) for key in shown]
        values = [show_figure(key, row[key]) for key in shown]
        lines.append(_line(name, f"{row['n_answered']}/{row['n_pairs']}", values))
        lines += [_line("", "", spans).rstrip()] if any(spans) else []
    return [*lines, *_list_differences(found)]


def _line(name: str, pairs: str, cells: Sequence[str]) -> str:
    shown = "".join(f"{cell:>{width}}" for cell, width in zip(cells, _WIDTHS, strict=True))
    return f"{name:<{_NAME_WIDTH}}{pairs:>{_PAIRS_WIDTH}}{shown}"


def _list_differences(found: Comparison) -> Iterator[str]:
    if not len(found.paired):
        return
    names = list(dict.fromkeys(found.paired["reference"]))
    main = _MAIN_REFERENCE if _MAIN_REFERENCE in names else names[0]
    yield f"pair by pair, {found.table['method'].iloc[0]} less {main}:"
    part = ""
    for row in found.paired[found.paired["reference"] == main].to_dict("records"):
        if row["part"] != part:
            part = str(row["part"])
            yield f" {part}:"
        low, difference, high = (show_figure(row["metric"], row[name]) for name in ("low", "difference", "high"))
        span = "" if math.isnan(row["low"]) else f" ({low} to {high})"
        yield f"  {HEADINGS[row['metric']]:<11}{difference:>7}{span}, {row['verdict']}"


def take_figures(results: pd.DataFrame) -> pd.DataFrame:
    """Return the figures by pair, with `status` and every one of `FIGURES`."""
    found = figures_of(results).assign(status=results["status"].to_numpy(), odometry=odometry_of(results))
    found = found.assign(**{key: numbers(found, key) for key in FIGURES})
    return found.set_index(PAIR)[["domain", "odometry", "variant", "status", *FIGURES]]


def part_pairs(figures: pd.DataFrame) -> dict[str, pd.Index[Any]]:
    """Return the pairs (scenario, seed) of each kind that figures are told apart for: domain and odometry.

    The name of a kind is "" where there is one alone. A pair that cannot be made does not tell its odometry, and is
    with the first.
    """
    odometry = figures["odometry"].astype(str)
    names = [name for name in dict.fromkeys(odometry) if name]
    odometry = odometry.where(odometry != "", names[0] if names else "")
    by = ", odometry " if len(names) > 1 else ""
    kinds = [
        f"{domain_name(domain)}{by}{name if by else ''}"
        for domain, name in zip(figures["domain"], odometry, strict=True)
    ]
    found = {kind: figures.index[[each == kind for each in kinds]] for kind in sorted(set(kinds))}
    return found if len(found) > 1 else {"": figures.index}


def list_variants(references: Sequence[RunData], pairs: pd.Index[Any]) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield each method that some runs have rows of about these pairs with its figures by pair.

    Of a method of several runs, those of the first that has such rows.
    """
    seen: set[str] = set()
    for data in references:
        if not data.results:
            continue
        found = take_figures(pd.DataFrame(list(data.results)))
        found = found.loc[found.index.isin(pairs)]
        for variant, rows in found.groupby("variant", sort=False):
            if variant not in seen:
                yield str(variant), rows
        seen |= set(found["variant"])


def _union(others: Mapping[str, pd.DataFrame]) -> pd.Index[Any]:
    first, *rest = (rows.index for rows in others.values())
    for index in rest:
        first = first.union(index)
    return first


def summarise_figures(name: str, rows: pd.DataFrame) -> dict[str, Any]:
    """Return a row of `Comparison.table` from the figures of a method by pair."""
    row: dict[str, Any] = {"method": name, "n_pairs": len(rows), "n_answered": int((rows["status"] == "ok").sum())}
    for key in FIGURES:
        values, statistic = stated(rows, key), statistic_of(key)
        row[key] = median(values) if statistic == "median" else mean(values)
        tunnels = tunnels_of(rows.index.to_frame())
        row[f"{key}_low"], row[f"{key}_high"] = interval_over_tunnels(values, tunnels, statistic)
        row[f"{key}_n"] = int(np.count_nonzero(~np.isnan(values)))
    return row


def _by_pair(own: pd.DataFrame, others: Mapping[str, pd.DataFrame], calls: Pairs) -> Iterator[dict[str, Any]]:
    rows: dict[str, dict[Any, Any]] = {variant: table.to_dict("index") for variant, table in others.items()}
    for pair, row in own.to_dict("index").items():
        scenario, seed = cast(tuple[str, int], pair)
        call = calls.get((scenario, seed), {})
        head = {"scenario": scenario, "seed": seed, "domain": row["domain"], "status": row["status"]}
        head |= {"error": call.get("error", ""), "command_s": call.get("seconds", float("nan"))}
        there = [(variant, found[pair]) for variant, found in rows.items() if pair in found]
        for variant, other in there or [("", {})]:
            yield {**head, "reference": variant, **_subtract(row, other)}


def _subtract(row: Mapping[Any, Any], other: Mapping[Any, Any]) -> dict[str, float]:
    """Return the figures of a pair by the method and by another one, and their differences."""
    figures: dict[str, float] = {}
    for key in FIGURES:
        value = float(other.get(key, "nan"))
        figures |= {key: row[key], f"{key}_reference": value, f"{key}_difference": row[key] - value}
    return figures


def _notes(
    own: pd.DataFrame, others: Mapping[str, pd.DataFrame], references: Sequence[RunData], shared: pd.Index[Any]
) -> Iterator[str]:
    yield "means over pairs (time: median) with 95 % intervals; time is what an answer states, without merge"
    if not others:
        yield from (why_no_pair(data, len(own)) for data in references if data.results)
        if not any(data.results for data in references):
            yield "no reference results of these pairs: name a run or a report with --reference"
        return
    if len(shared) < len(own):
        yield f"the table is over the {len(shared)} of {len(own)} pairs that have reference rows"
    if any(is_told_the_truth(variant) for variant in others):
        yield "oracle-* methods were told the true merge, or the true regions as well"
    merges = {name: merge for data in references for name, merge in list_merges(data.folder).items()}
    for variant in others:
        if merges.get(variant, "own") != "own":
            yield f"{variant} was given {'the true merge' if merges[variant] == 'given' else 'the merge of tunnelcd'}"
    yield "times of different machines do not compare; a method that leaves one out has none"


def note_other_worlds(results: pd.DataFrame, references: Sequence[RunData]) -> Iterator[str]:
    """Yield sentences about runs whose pairs are, or may be, others than those of the same name that were answered."""
    pairs = set(zip(results["scenario"], results["seed"], strict=True))
    # answers of others state no commit: nothing tells then which one simulated their pairs
    commits = set(texts(results, "commit")) - {""}
    for data in references:
        rows = [row for row in data.results if (row["scenario"], row["seed"]) in pairs]
        others = sorted({text(row, "commit")[:7] for row in rows if text(row, "commit") not in commits})
        if commits and others:
            told = ", ".join(other or "an unknown one" for other in others)
            yield (
                f"rows of {data.folder.path.name} are of commit {told}: sessions differ where the simulator has "
                "changed since"
            )
        if rows and (worlds := find_other_worlds(results, pd.DataFrame(rows))):
            where = f"{count_pairs(len(worlds))} of {data.folder.path.name}"
            yield f"{where} hold other changes, another drive or another score radius ({worlds[0]})"


def show_span(key: str, low: float, high: float) -> str:
    """Write an interval of a figure; "" where there is none."""
    return "" if math.isnan(low) or math.isnan(high) else f"{show_figure(key, low)}-{show_figure(key, high)}"


def show_figure(key: str, value: float) -> str:
    """Write a figure; times with two digits."""
    if is_time(key) and math.isfinite(value):
        return np.format_float_positional(value, precision=2, fractional=False, unique=False, trim="-")
    return SHOWN[key].shown(value)
