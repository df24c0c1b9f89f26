"""The merges on the page: targets and charts of a plan with kinds of pairs, evidence of single merges, and maps."""

from __future__ import annotations

import numpy as np
import pandas as pd

from eval.plans.targets import is_oracle, read_targets
from eval.report.drawing.charts import Chart
from eval.report.merge.cases import MAX_ROWS, Case, case_table, distinct_cases, draw_case, read_case
from eval.report.merge.charts import error_chart, time_chart
from eval.report.merge.tables import families_table, kinds_table, refusals_table, stated_seconds, times_table
from eval.report.tables import Section, Table, with_rows
from eval.running.results.cases import find_repeats
from eval.running.results.run_data import RunData, covered_by, ends_at_merge, shown_variant
from eval.running.results.values import text
from eval.tables.merge_table import EXACT_M, RIGHT_DEG, RIGHT_M, RULES, TIMES, is_within_target, kinds, merge_table
from eval.tables.rows import numbers, with_pair

N_WORST = 10
MAX_PICTURES = 24


def draw_merge(data: RunData) -> Section:
    """Return tables and pictures of the merges of a run.

    Where pairs have a kind, the cases are the worst accepted merges and all that miss their target; elsewhere all.
    """
    results = pd.DataFrame(list(data.results))
    missing: list[str] = []
    notes: list[str] = []
    by_kind, name = bool((kinds(results) != "").any()), shown_variant(data)
    tables = [times_table(results)] if by_kind or ends_at_merge(data) else []
    if by_kind:
        table, is_whole = merge_table(results, read_targets(data.provenance)), covered_by(data).is_whole
        of_targets = kinds_table(table, is_whole=is_whole), families_table(table, name, is_whole=is_whole)
        tables = [*of_targets, refusals_table(results), *tables]
        cases, shown = _chosen_cases(data, results, name, notes)
    else:
        cases, shown = _every_case(data, name, notes)
    drawn = [draw_case(data, case, missing) for case in shown[:MAX_PICTURES]]
    if len(shown) > MAX_PICTURES:
        notes.append(f"The aligned maps of {len(shown) - MAX_PICTURES} further cases are left out of this page.")
    return Section(
        with_rows(tables), tuple(_plots(results) if by_kind else ()), with_rows(cases),
        tuple(picture for picture in drawn if picture is not None), tuple(notes), tuple(missing),
    )  # fmt: skip


def _plots(results: pd.DataFrame) -> list[Chart]:
    """Draw errors and times of every variant that does not merge by the truth."""
    own = results[[not is_oracle(str(name)) for name in results["variant"]]]
    if len(own) == 0:
        return []
    errors = Chart(
        "merge_errors",
        "Merge error against the true overlap",
        error_chart(own),
        f"One mark per pair: dots were accepted, crosses not. Dashed: {EXACT_M:g} m, the target of clean pairs; solid: "
        f"{RIGHT_M:g} m, above which an accepted merge is wrong. Errors below 0.1 mm stand at 0.1 mm.",
    )
    if not any(len(stated_seconds(own, column)) for column in TIMES):
        return [errors]
    times = Chart(
        "merge_times",
        "Time of the merge",
        time_chart(own),
        "One dot per accepted pair (n of them; refused ones state no time), a bar at the median, logarithmic; one "
        "thread. Indexing can be done while mapping.",
    )
    return [errors, times]


def _chosen_cases(data: RunData, results: pd.DataFrame, name: str, notes: list[str]) -> tuple[list[Table], list[Case]]:
    """Return the worst accepted merges of the variant that is shown, and all of its pairs outside their target."""
    has_pair = results.index.isin(with_pair(results).index)
    mine = np.flatnonzero((results["variant"] == name).to_numpy() & has_pair)
    badness = np.fmax(numbers(results, "merge_error_m") / RIGHT_M, numbers(results, "merge_error_deg") / RIGHT_DEG)
    # an error that is undefined is the worst: the sessions share no place
    badness = np.nan_to_num(badness, nan=np.inf)
    status, kind = results["status"].to_numpy(), kinds(results)
    accepted = mine[status[mine] == "ok"]
    worst = accepted[np.argsort(-badness[accepted], kind="stable")][:N_WORST].tolist()
    outside = mine[~is_within_target(results)[mine] & np.isin(kind[mine], list(RULES))]
    # not merged first, in the order of the table; then the worst of those that were accepted
    outside = outside[np.lexsort((-badness[outside], status[outside] == "ok"))].tolist()
    cases = {index: read_case(data, data.results[index]) for index in dict.fromkeys([*outside, *worst])}
    captions = {
        f"The worst accepted merges of {name}, worst first": worst,
        f"Every pair of {name} that is outside its target": outside,
    }
    tables = [case_table([cases[at] for at in own], caption, by_kind=True) for caption, own in captions.items()]
    if not outside:
        notes.append(f"{name}: every pair is within its target.")
    return tables, list(cases.values())


def _every_case(data: RunData, name: str, notes: list[str]) -> tuple[list[Table], list[Case]]:
    """Return every distinct merge of an ordinary run and, of each scenario, one whose maps are shown.

    Repeated worlds and accepted merges without evidence are left out. Where there are too many for a table, merges that
    were not accepted come first.
    """
    held = find_repeats(data)
    rows = [row for row in data.results if (row["scenario"], row["variant"]) not in held]
    cases = distinct_cases(data, rows, name)
    shown = [case for case in cases if case.evidence or text(case.row, "status") != "ok"]
    if len(shown) > MAX_ROWS:
        n_left = len(shown) - MAX_ROWS
        shown = sorted(shown, key=lambda case: text(case.row, "status") == "ok")[:MAX_ROWS]
        notes.append(f"{n_left} further merges are left out of the table; results.csv holds them all.")
    table = case_table(shown, "What every merge measured", by_kind=False)
    first: dict[str, Case] = {}
    for case in sorted(cases, key=lambda case: (text(case.row, "status") != "ok", name not in case.variants)):
        first.setdefault(str(case.row["scenario"]), case)
    return [table], list(first.values())
