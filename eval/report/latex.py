"""The tables of a run as LaTeX floats in the style of booktabs, with what is best in bold and counts in the caption.

Bold is the best value of its group as written, equal ones too. A dagger marks a value that cannot be told from the
best: the paired difference over the session pairs of both is not beyond noise, or fewer than six pairs have it. So what
stands neither bold nor marked is worse than the best beyond noise, in every column but those that the caption names as
not tested. Methods that are told the truth take no part.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from eval.core.domains import domain_name
from eval.core.statistics import bootstrap_interval, mean_with_interval
from eval.core.tablefile import table_file
from eval.report.compared_columns import COMPARED, POOLED, is_time
from eval.report.comparing import BETTER, WORSE, pooled_difference, verdict
from eval.report.cost.pareto import comparable, with_domain
from eval.report.objects.tables import OBJECT_COLUMNS, is_told_the_truth
from eval.report.regions.regions import REGION_COLUMNS
from eval.report.story import is_unmade
from eval.report.tables import beside, best, escape_latex, used_pairs
from eval.running.run_data import RunData, off_grids
from eval.running.sides import Side, is_contended
from eval.tables.columns import EN_DASH, RESULT_COLUMNS, Column, spaced
from eval.tables.merge_table import numbers, texts
from eval.tables.region_curves import PAIR
from eval.tables.region_table import ALL_DOMAINS, DOMAINS

_DAGGER = r"$^\dagger$"
_HEADING_WIDTH = 13
_KEPT = next(column for column in COMPARED if column.key == "bytes_regions_before")
SUMMARY_COLUMNS = (*RESULT_COLUMNS, replace(_KEPT, heading="kept [kB]"))
_SUBJECTS = {"regions_table": ("Finding the changed places", REGION_COLUMNS),
             "objects_table": ("Cutting out the objects", OBJECT_COLUMNS)}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Methods that compete with each other.

    Attributes:
        name: What stands above them.
        rows: A row for each, with `variant`, `n_pairs`, and for each column its value and `_low`, `_high`.
        results: Their rows of results.csv.
    """

    name: str
    rows: Sequence[Mapping[str, Any]]
    results: pd.DataFrame


def latex_tables(data: RunData) -> dict[str, str]:
    """Return summary.tex, and regions_table.tex and objects_table.tex where the tables of that name are in the run.

    Points of grids are left to the tables' own files and to the charts of the page.

    Returns:
        LaTeX sources by file name; each needs nothing but the package booktabs.
    """
    every, results = with_domain(data.results), comparable(data)
    found = {}
    for name, (words, columns) in _SUBJECTS.items():
        path = table_file(data.folder.path / f"{name}.csv")
        if path.is_file():
            groups = _stored_groups(off_grids(pd.read_csv(path), data), every)
            found[f"{name}.tex"] = latex_float(f"tab:{name}", _caption(words, data, every), groups, columns, data)
    if results.empty:  # every variant is a point of a grid
        return found
    caption = _caption("Every method over all its session pairs", data, results, " Times are medians, the rest means.")
    found["summary.tex"] = latex_float("tab:summary", caption, _summary_groups(results), SUMMARY_COLUMNS, data)
    return found


def latex_float(label: str, caption: str, groups: Sequence[Group], columns: Sequence[Column], data: RunData) -> str:
    """Return one `table*`: a line of values for each method and, where there are intervals, a small one below it.

    Args:
        label: What references call it.
        caption: Its caption, as LaTeX; how marks are meant is added.
        groups: Methods that compete, each group under its name.
        columns: The columns; one without a number is left out.
        data: The run, whose candidates are drawn again for the recall at a rate.
    """
    shown = [
        column for column in columns if any(not math.isnan(row[column.key]) for each in groups for row in each.rows)
    ]
    body: list[str] = []
    untested: set[str] = set()
    for group in groups:
        marks = [_marks(group, column, data, untested) for column in shown]
        body += [r"\midrule", rf"\multicolumn{{{len(shown) + 2}}}{{l}}{{\textit{{{escape_latex(group.name)}}}}} \\"]
        for index, row in enumerate(group.rows):
            body += _lines(row, shown, [of_column[index] for of_column in marks], group.results)
    names = [column.heading for column in shown if column.key in untested]
    return "\n".join(
        [
            r"% needs \usepackage{booktabs}",
            r"\begin{table*}",
            r"\centering",
            rf"\caption{{{caption} {_meaning(names)}}}",
            rf"\label{{{label}}}",
            r"\footnotesize",
            r"\setlength{\tabcolsep}{3pt}",
            rf"\begin{{tabular}}{{l{'r' * (len(shown) + 1)}}}",
            r"\toprule",
            " & ".join(["method", "pairs", *(_stacked(column.heading) for column in shown)]) + r" \\",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table*}",
            "",
        ]
    )


def _marks(group: Group, column: Column, data: RunData, untested: set[str]) -> list[str]:
    """Return "bold", "dagger" or "" for each row; a column whose differences cannot be taken is added to `untested`."""
    marks = [""] * len(group.rows)
    fair = [place for place, row in enumerate(group.rows) if not is_told_the_truth(row["variant"])]
    values = [float(group.rows[place][column.key]) for place in fair]
    counts = [used_pairs(group.results, str(group.rows[place]["variant"]), column.key)[0] for place in fair]
    is_best = best(values, column, counts)
    if not any(is_best):
        return marks
    top = (max if column.better == "high" else min)(
        (value, place) for value, place, is_top in zip(values, fair, is_best, strict=True) if is_top
    )[1]
    for place, value, is_top in zip(fair, values, is_best, strict=True):
        if is_top:
            marks[place] = "bold"
        elif not math.isnan(value):
            apart = _is_told_apart(group, column, group.rows[top]["variant"], group.rows[place]["variant"], data)
            marks[place] = "dagger" if apart is False else ""
            if apart is None:
                untested.add(column.key)
    return marks


def _is_told_apart(group: Group, column: Column, first: str, second: str, data: RunData) -> bool | None:
    """Tell whether two methods differ beyond noise in a column; None where it has no number for each pair."""
    own = [group.results[group.results["variant"] == name].set_index(PAIR).sort_index() for name in (first, second)]
    pairs = own[0].index.intersection(own[1].index)
    if column.key == POOLED:
        rows = pooled_difference((Side(data), Side(data)), (first, second), pairs)
        if not rows:
            return None
        n_used, difference, interval = rows[0]["n_used"], rows[0]["difference"], (rows[0]["low"], rows[0]["high"])
    elif column.key in group.results:
        values = [numbers(frame.loc[pairs], column.key) for frame in own]
        difference, low, high, n_used = mean_with_interval(values[1] - values[0])
        interval = (low, high)
    else:
        return None
    return verdict("high", n_used, difference, interval) in (BETTER, WORSE)


def _lines(row: Mapping[str, Any], columns: Sequence[Column], marks: Sequence[str], results: pd.DataFrame) -> list[str]:
    """Return the line of values of a method and, where it has any, that of intervals and of counts."""
    values, intervals = [], []
    for column, mark in zip(columns, marks, strict=True):
        written = escape_latex(column.shown(float(row[column.key])))
        values.append({"bold": rf"\textbf{{{written}}}", "dagger": f"{written}{_DAGGER}"}.get(mark, written))
        low, high = (float(row.get(f"{column.key}_{end}", math.nan)) for end in ("low", "high"))
        told = "" if math.isnan(low) else f"{column.shown(low)}{EN_DASH}{column.shown(high)}"
        used = used_pairs(results, str(row["variant"]), column.key)
        told = escape_latex(beside(told, *used).replace("\n", "; "))
        intervals.append(rf"{{\scriptsize {told}}}" if told else "")
    lines = [" & ".join([escape_latex(spaced(str(row["variant"]))), str(row["n_pairs"]), *values]) + r" \\"]
    if any(intervals):
        lines.append(" & ".join(["", "", *intervals]).strip() + r" \\")
    return lines


def _stored_groups(table: pd.DataFrame, results: pd.DataFrame) -> list[Group]:
    """Return the rows of regions_table.csv or objects_table.csv by domain."""
    groups = []
    for domain, own in table.groupby("domain", sort=False):
        rows = [{str(key): value for key, value in row.items()} for row in own.to_dict("records")]
        n_changes = max(int(row.get("n_observable", row.get("n_changes", 0))) for row in rows)
        cases = results if domain == ALL_DOMAINS else results[results["domain"] == domain]
        groups.append(Group(f"{_over(str(domain), rows)}, {n_changes} observable changes", rows, cases))
    return groups


def _summary_groups(results: pd.DataFrame) -> list[Group]:
    """Return means (of times the median) over the pairs of each method, by domain."""
    present = [name for name in DOMAINS[:2] if (results["domain"] == name).any()]
    groups = []
    for domain in [*present, *([ALL_DOMAINS] if len(present) > 1 else [])]:
        cases = results if domain == ALL_DOMAINS else results[results["domain"] == domain]
        rows = [_summary_row(str(variant), own) for variant, own in cases.groupby("variant", sort=False)]
        groups.append(Group(_over(domain, rows), rows, cases))
    return groups


def _summary_row(variant: str, own: pd.DataFrame) -> dict[str, Any]:
    row: dict[str, Any] = {"variant": variant, "n_pairs": len(own)}
    for column in SUMMARY_COLUMNS:
        values = numbers(own, column.key)
        values = values[~np.isnan(values)]
        low, high = bootstrap_interval(values, "median" if is_time(column.key) else "mean")
        value = (np.median(values) if is_time(column.key) else values.mean()) if len(values) else math.nan
        row |= {column.key: float(value), f"{column.key}_low": low, f"{column.key}_high": high}
    return row


def _caption(words: str, data: RunData, results: pd.DataFrame, more: str = "") -> str:
    """Return what a table shows and over how much: session pairs, methods, cases without an answer."""
    n_pairs, n_failed = len(results[PAIR].drop_duplicates()), int((texts(results, "status") != "ok").sum())
    plan = data.provenance.get("plan")
    name = str(plan.get("name") or "") if isinstance(plan, Mapping) else ""
    told = f"{words}{f', plan {name}' if name else ''}: {n_pairs} session pairs, {results['variant'].nunique()} methods"
    n_unmade = sum(is_unmade({str(name): value for name, value in row.items()}) for row in results.to_dict("records"))
    failed = f"{n_failed - n_unmade} of {len(results)} cases without an answer, which miss all their changes"
    if n_unmade:
        failed += f", {n_unmade} without a world, which are left out"
    beside = " Times were measured beside other work." if is_contended(data) else ""
    return escape_latex(f"{told}, {failed if n_failed else 'every case answered'}.{more}{beside}")


def _meaning(untested: Sequence[str]) -> str:
    told = (
        "In small type: 95\\,\\% bootstrap intervals over session pairs. Bold: the best of its group as written; "
        f"{_DAGGER}: not told from it by the paired difference over session pairs, or by fewer than six pairs."
    )
    return f"{told} Not tested: {escape_latex(', '.join(untested))}." if untested else told


def _over(domain: str, rows: Sequence[Mapping[str, Any]]) -> str:
    n_pairs = max(int(row["n_pairs"]) for row in rows)
    return f"{domain_name(domain)}: {n_pairs} {'pair' if n_pairs == 1 else 'pairs'}"


def _stacked(heading: str) -> str:
    """Return a heading on as many lines as it needs."""
    lines = [escape_latex(line) for line in textwrap.wrap(heading, _HEADING_WIDTH, break_long_words=False)]
    return r"\shortstack[r]{" + r" \\ ".join(lines) + "}" if len(lines) > 1 else lines[0]
