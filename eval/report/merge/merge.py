"""The merge on the page: the table of a plan's targets and its plots, or the evidence of every merge, and the maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from eval.core.figures import picture_address
from eval.plans.targets import is_oracle, read_targets
from eval.report.merge.cases import MAX_ROWS, Case, case_table, distinct_cases, draw_case, read_case
from eval.report.merge.charts import MergedPairs, error_chart, time_chart
from eval.report.merge.tables import (
    families_table,
    kinds_table,
    refusals_table,
    stated_seconds,
    times_table,
)
from eval.report.tables import Picture, Table
from eval.running.run_data import RunData, covered_by, ends_at_merge, repeats, shown_variant, text
from eval.tables.merge_table import (
    EXACT_M,
    RIGHT_DEG,
    RIGHT_M,
    RULES,
    TIMES,
    is_within_target,
    kinds,
    merge_table,
)
from eval.tables.rows import numbers

N_WORST = 10
MAX_PICTURES = 24
_TIME_NAMES = {"t_index_s": "t_index [s]", "t_merge_s": "t_merge [s]", "t_refine_s": "t_refine [s]"}


@dataclass(frozen=True, slots=True)
class MergePart:
    """What the page shows of the merge.

    Attributes:
        is_main: Whether the run ended at the merge, so that this is all there is.
        tables: Of the targets: over all families, by family; of the reasons for refusals; of the times.
        plots: Errors against overlap, times.
        cases: What was measured of single merges: the worst accepted ones and all outside their target, or all of an
            ordinary run.
        pictures: Aligned maps of those.
        notes: What was left out for space.
        missing: What could not be drawn.
    """

    is_main: bool
    tables: tuple[Table, ...]
    plots: tuple[Picture, ...]
    cases: tuple[Table, ...]
    pictures: tuple[Picture, ...]
    notes: tuple[str, ...]
    missing: tuple[str, ...]


def draw_merge(data: RunData) -> MergePart:
    """Return tables and pictures of the merges of a run."""
    results = pd.DataFrame(list(data.results))
    missing: list[str] = []
    notes: list[str] = []
    by_kind = bool((kinds(results) != "").any())
    table = merge_table(results, read_targets(data.provenance))
    is_main, covered, name = ends_at_merge(data), covered_by(data), shown_variant(data)
    is_whole = covered.is_whole
    tables: tuple[Table, ...] = (times_table(results),) if by_kind or is_main else ()
    if by_kind:
        of_targets = kinds_table(table, is_whole=is_whole), families_table(table, name, is_whole=is_whole)
        tables = (*of_targets, refusals_table(results), *tables)
    plots = (_error_plot(results), _time_plot(results)) if by_kind else ()
    if by_kind:
        cases, shown = _chosen_cases(data, results, name, notes)
    else:
        cases, shown = _every_case(data, name, notes)
    drawn = [draw_case(data, case, missing) for case in shown[:MAX_PICTURES]]
    if len(shown) > MAX_PICTURES:
        notes.append(f"The aligned maps of {len(shown) - MAX_PICTURES} further cases are left out of this page.")
    return MergePart(
        is_main,
        tuple(part for part in tables if part.rows),
        tuple(plot for plot in plots if plot is not None),
        tuple(part for part in cases if part.rows),
        tuple(picture for picture in drawn if picture is not None),
        tuple(notes),
        tuple(missing),
    )


def _error_plot(results: pd.DataFrame) -> Picture | None:
    variants = [name for name in dict.fromkeys(str(v) for v in results["variant"]) if not is_oracle(name)]
    words = {"ok": "accepted", "merge_refused": "refused"}
    panels = {}
    for name in variants:
        own = results[results["variant"] == name]
        outcomes = [words.get(str(status), "failed") for status in own["status"]]
        overlaps, errors_m = numbers(own, "overlap_true"), numbers(own, "merge_error_m")
        panels[name] = MergedPairs(list(kinds(own)), overlaps, errors_m, outcomes)
    if not panels:
        return None
    return Picture(
        "Merge error against the true overlap",
        picture_address(error_chart(panels, EXACT_M, RIGHT_M)),
        f"One mark per pair: dots were accepted, crosses not. Dashed: {EXACT_M:g} m, the target of clean pairs; solid: "
        f"{RIGHT_M:g} m, above which an accepted merge is wrong. Errors below 0.1 mm stand at 0.1 mm.",
    )


def _time_plot(results: pd.DataFrame) -> Picture | None:
    variants = [name for name in dict.fromkeys(str(v) for v in results["variant"]) if not is_oracle(name)]
    panels = {
        _TIME_NAMES[column]: {name: stated_seconds(results[results["variant"] == name], column) for name in variants}
        for column in TIMES
    }
    if not any((values > 0).any() for panel in panels.values() for values in panel.values()):
        return None
    return Picture(
        "Time of the merge",
        picture_address(time_chart(panels)),
        "One dot per accepted pair (n of them; refused ones state no time), a bar at the median, logarithmic; one "
        "thread. Indexing can be done while mapping.",
    )


def _chosen_cases(data: RunData, results: pd.DataFrame, name: str, notes: list[str]) -> tuple[list[Table], list[Case]]:
    """Return the worst accepted merges of the variant that is shown, and all of its pairs outside their target."""
    mine = np.flatnonzero((results["variant"] == name).to_numpy())
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
    tables = [
        case_table(
            [cases[index] for index in worst], f"The worst accepted merges of {name}, worst first", by_kind=True
        ),
        case_table(
            [cases[index] for index in outside], f"Every pair of {name} that is outside its target", by_kind=True
        ),
    ]
    if not outside:
        notes.append(f"{name}: every pair is within its target.")
    return tables, list(cases.values())


def _every_case(data: RunData, name: str, notes: list[str]) -> tuple[list[Table], list[Case]]:
    """Return every distinct merge of an ordinary run and, of each scenario, one whose maps are shown.

    Worlds that only repeat another one are left out, and merges of which nothing is told. Where there are too many for
    a table, those that were not accepted come first.
    """
    held = repeats(data)
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
