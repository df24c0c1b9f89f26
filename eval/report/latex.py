"""The tables of a run as LaTeX, typeset by pandas in the style of booktabs.

Bold: the best value of its group, compared as written. Dagger: not distinguishable from the best, because the paired
difference is within noise or fewer than six pairs have both values. A value with neither mark is worse than the best
beyond noise; the caption names the columns that are not tested. Methods that are told the truth get no mark.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from cdpipe.core.names import visible
from eval.core.statistics import ENOUGH_PAIRS
from eval.core.terminal.printing import count_pairs
from eval.report.comparing.columns import COMPARED
from eval.report.comparing.differences import is_told_apart
from eval.report.objects.tables import OBJECT_COLUMNS, OBJECT_COUNTS
from eval.report.regions.regions import REGION_COLUMNS
from eval.report.summary import means_by_method
from eval.report.tables import Table, methods_table
from eval.running.results.cases import comparable, is_unmade
from eval.running.results.grids import off_grids
from eval.running.results.run_data import RunData, plan_name, stored_table
from eval.running.results.sides import is_contended
from eval.tables.columns import EN_DASH, RESULT_COLUMNS, THIN_SPACE, Column, select
from eval.tables.rows import ALL_DOMAINS, PAIR, is_told_the_truth, records, texts, with_domain

_MARKS = {"bold": r"\textbf{%s}", "small": r"{\scriptsize %s}", "dagger": r"%s$^\dagger$", "": "%s"}
_HEADING_WIDTH = 13
_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", EN_DASH: "--", THIN_SPACE: r"\,", "³": r"$^3$",
    "†": r"$^\dagger$",
}  # fmt: skip
(_KEPT,) = select(COMPARED, "bytes_regions_before")
SUMMARY_COLUMNS = (*RESULT_COLUMNS, replace(_KEPT, heading="kept [kB]"))
_SUBJECTS = {"regions_table": ("Finding the changed places", REGION_COLUMNS, {}),
             "objects_table": ("Cutting out the objects", OBJECT_COLUMNS, OBJECT_COUNTS)}  # fmt: skip


def latex_tables(data: RunData) -> dict[str, str]:
    """Return summary.tex, and regions_table.tex and objects_table.tex where the tables of that name are in the run.

    Points of grids are left out beside other methods: their CSV files and the charts of the page hold them.

    Returns:
        LaTeX sources by file name; each needs nothing but the package booktabs.
    """
    every, cases = with_domain(data.results), comparable(data)
    found = {}
    if len(cases):
        words = "Every method over all its session pairs, times as medians, the rest as means"
        table = means_by_method(cases, SUMMARY_COLUMNS)
        found["summary.tex"] = _float(data, "summary", words, table, SUMMARY_COLUMNS, cases)
    for name, (subject, columns, counts) in _SUBJECTS.items():
        table = off_grids(stored_table(data, name), data)
        if len(table):
            found[f"{name}.tex"] = _float(data, name, subject, table, columns, every, counts)
    return found


def to_latex(table: Table) -> str:
    """Return a table of the page as a LaTeX tabular, best values in bold, the group, if there is one, in front."""
    has_groups = any(group for group, _ in table.rows)
    lines = [
        [_escaped(group)] * has_groups + [_marked(cell.text, "bold" if cell.is_best else "") for cell in cells]
        for group, cells in table.rows
    ]
    return _typeset(["scenario"] * has_groups + list(table.headings), lines, n_names=1 + has_groups)


def _float(
    data: RunData,
    name: str,
    words: str,
    table: pd.DataFrame,
    columns: Sequence[Column],
    cases: pd.DataFrame,
    counts: Mapping[str, str] | None = None,
) -> str:
    """Return one `table*`: a line of values for each method and, where there are intervals, a small one below it."""
    shown = [column for column in columns if column.key in table and table[column.key].notna().any()]
    lines: list[list[str]] = []
    untested: set[str] = set()
    domains = table.groupby("domain", sort=False)
    groups = methods_table(table, shown, cases, counts=counts).groups()
    for (domain, own), (group, rows) in zip(domains, groups, strict=True):
        of_domain = cases if domain == ALL_DOMAINS else cases[cases["domain"] == domain]
        of_method = {str(name): part.set_index(PAIR).sort_index() for name, part in of_domain.groupby("variant")}
        marks = [
            _marks(records(own), column, [cells[place].is_best for cells in rows], of_method, data, untested)
            for place, column in enumerate(shown, start=2)
        ]
        for place, (method, n_pairs, *values) in enumerate(rows):
            marked = [_marked(cell.text, of_column[place]) for cell, of_column in zip(values, marks, strict=True)]
            lines.append([_escaped("" if place else group), _escaped(method.text), n_pairs.text, *marked])
            below = [cell.interval.replace("\n", "; ") for cell in values]
            if any(below):
                lines.append(["", "", "", *(_marked(word, "small" if word else "") for word in below)])
    names = ", ".join(column.heading for column in shown if column.key in untested)
    caption = f"{_caption(words, data, cases)}{f' Not tested: {names}.' if names else ''}"
    headings = ["pairs of", "method", "pairs", *(column.heading for column in shown)]
    return _typeset(headings, lines, caption=_escaped(caption), label=f"tab:{name}")


def _typeset(
    headings: Sequence[str], lines: Sequence[Sequence[str]], caption: str = "", label: str = "", *, n_names: int = 2
) -> str:
    """Return lines of LaTeX cells as pandas typesets them: a tabular, or a wide float where there is a caption.

    The first `n_names` columns are names, all others values.
    """
    frame = pd.DataFrame(lines, columns=[_stacked(heading) for heading in headings])
    formats = "l" * n_names + "r" * (len(headings) - n_names)
    source = str(
        frame.to_latex(index=False, escape=False, column_format=formats, caption=caption or None, label=label or None)
    )
    small = "\\centering\n\\footnotesize\n\\setlength{\\tabcolsep}{3pt}\n"
    wide = source.replace("{table}", "{table*}").replace("\\begin{tabular}", f"{small}\\begin{{tabular}}")
    return "% needs \\usepackage{booktabs}\n" + (wide if caption else source)


def _marks(
    rows: Sequence[Mapping[str, Any]],
    column: Column,
    is_best: Sequence[bool],
    of_method: Mapping[str, pd.DataFrame],
    data: RunData,
    untested: set[str],
) -> list[str]:
    """Return "bold", "dagger" or "" for each row; a column whose differences cannot be taken is added to `untested`."""
    marks = ["bold" if each else "" for each in is_best]
    if not any(is_best):
        return marks
    top = (max if column.better == "high" else min)(
        (float(row[column.key]), place) for place, row in enumerate(rows) if is_best[place]
    )[1]
    for place, row in enumerate(rows):
        if not marks[place] and not is_told_the_truth(str(row["variant"])) and not math.isnan(float(row[column.key])):
            apart = is_told_apart(of_method, column, str(rows[top]["variant"]), str(row["variant"]), data)
            marks[place] = "dagger" if apart is False else ""
            if apart is None:
                untested.add(column.key)
    return marks


def _caption(words: str, data: RunData, results: pd.DataFrame) -> str:
    """Return the caption: the subject of a table, its number of pairs, and the meaning of its marks."""
    n_pairs, n_failed = len(results[PAIR].drop_duplicates()), int((texts(results, "status") != "ok").sum())
    name = plan_name(data)
    of_plan = f", plan {name}" if name else ""
    told = f"{words}{of_plan}: {count_pairs(n_pairs)} of sessions, {results['variant'].nunique()} methods"
    n_unmade = sum(is_unmade(row) for row in records(results))
    failed = f"{n_failed - n_unmade} of {len(results)} cases without an answer, which miss all their changes"
    if n_unmade:
        failed += f", {n_unmade} of pairs that could not be made, which are in no mean"
    beside_work = " Times were measured beside other work." if is_contended(data) else ""
    return (
        f"{told}, {failed if n_failed else 'every case answered'}.{beside_work} In small type: 95 % bootstrap "
        f"intervals over tunnels. Bold: the best of its group as written; †: not told from it by the paired "
        f"difference over session pairs, or by fewer than {ENOUGH_PAIRS} tunnels."
    )


def _marked(words: str, mark: str) -> str:
    return _MARKS[mark] % _escaped(words)


def _stacked(heading: str) -> str:
    """Return a heading on as many lines as it needs."""
    lines = [_escaped(line) for line in textwrap.wrap(heading, _HEADING_WIDTH, break_long_words=False)]
    return r"\shortstack[r]{" + r" \\ ".join(lines) + "}" if len(lines) > 1 else "".join(lines)


def _escaped(words: str) -> str:
    """Return text that LaTeX sets as it is; after the end of a line it would read `*` or `[` as an argument."""
    safe = re.sub("|".join(map(re.escape, _LATEX)), lambda found: _LATEX[found[0]], visible(words))
    return f"{{}}{safe}" if safe.startswith(("*", "[")) else safe
