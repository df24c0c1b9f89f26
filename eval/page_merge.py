"""The merge on the page: the table of a plan's targets and its plots, or the evidence of every merge, and the maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from cdpipe.geometry import Float64Array
from eval.merge_plots import MergedPairs, error_plot, time_plot
from eval.merge_table import EXACT_M, RIGHT_DEG, RIGHT_M, TIMES, kinds, merge_table, numbers
from eval.page_merge_cases import MAX_ROWS, Case, case_table, distinct_cases, draw_case, read_case
from eval.page_merge_tables import families_table, is_oracle, main_variant, refusals_table, story, targets_table
from eval.page_objects import Picture
from eval.page_run import RunData, repeats, text
from eval.page_tables import Table

N_WORST = 10
MAX_PICTURES = 24
# a variant that leaves a part out is done with it in microseconds
_NOTHING_S = 1e-4
_TIME_NAMES = {"t_index_s": "t_index [s]", "t_merge_s": "t_merge [s]", "t_refine_s": "t_refine [s]"}


@dataclass(frozen=True, slots=True)
class MergePart:
    """What the page shows of the merge.

    Attributes:
        is_main: Whether the run ended at the merge, so that this is all there is.
        sentences: The first paragraph of such a page.
        tables: Of the targets: over all families, by family, and of the reasons for refusals.
        plots: Errors against overlap, times.
        cases: What was measured of single merges: the worst accepted and the refused ones, or all of an ordinary run.
        pictures: Aligned maps of those.
        notes: What was left out for space.
        missing: What could not be drawn.
    """

    is_main: bool
    sentences: tuple[str, ...]
    tables: tuple[Table, ...]
    plots: tuple[Picture, ...]
    cases: tuple[Table, ...]
    pictures: tuple[Picture, ...]
    notes: tuple[str, ...]
    missing: tuple[str, ...]


def ends_at_merge(data: RunData) -> bool:
    """Tell whether a run's plan ended every method at the merge."""
    plan = data.provenance.get("plan")
    return isinstance(plan, dict) and plan.get("until") == "merge"


def draw_merge(data: RunData) -> MergePart:
    """Return tables and pictures of the merges of a run."""
    results = pd.DataFrame(list(data.results))
    missing: list[str] = []
    notes: list[str] = []
    by_kind = bool((kinds(results) != "").any())
    table = merge_table(results)
    tables = (targets_table(table), families_table(table), refusals_table(results)) if by_kind else ()
    plots = (_error_plot(results), _time_plot(results)) if by_kind else ()
    if by_kind:
        cases, shown = _chosen_cases(data, results, notes)
    else:
        cases, shown = _every_case(data, notes)
    drawn = [draw_case(data, case, missing) for case in shown[:MAX_PICTURES]]
    if len(shown) > MAX_PICTURES:
        notes.append(f"The aligned maps of {len(shown) - MAX_PICTURES} further cases are left out of this page.")
    is_main = ends_at_merge(data)
    return MergePart(
        is_main,
        tuple(story(table, results)) if is_main else (),
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
        error_plot(panels, EXACT_M, RIGHT_M),
        f"One mark per pair: dots were accepted, crosses not. Dashed: {EXACT_M:g} m, the target of clean pairs; solid: "
        f"{RIGHT_M:g} m, above which an accepted merge is wrong. Errors below 0.1 mm stand at 0.1 mm.",
    )


def _time_plot(results: pd.DataFrame) -> Picture | None:
    variants = [name for name in dict.fromkeys(str(v) for v in results["variant"]) if not is_oracle(name)]
    panels = {
        _TIME_NAMES[column]: {name: _seconds(results[results["variant"] == name], column) for name in variants}
        for column in TIMES
    }
    if not any((values > 0).any() for panel in panels.values() for values in panel.values()):
        return None
    return Picture(
        "Time of the merge",
        time_plot(panels),
        "One dot per pair, a bar at the median, logarithmic; one thread. Indexing can be done while mapping.",
    )


def _seconds(results: pd.DataFrame, column: str) -> Float64Array:
    values = numbers(results, column)
    return values[values >= _NOTHING_S]


def _chosen_cases(data: RunData, results: pd.DataFrame, notes: list[str]) -> tuple[list[Table], list[Case]]:
    """Return the worst accepted merges of the variant that is shown, and clean and drift pairs it did not merge."""
    name = main_variant([str(variant) for variant in results["variant"]])
    mine = np.flatnonzero((results["variant"] == name).to_numpy())
    badness = np.fmax(numbers(results, "merge_error_m") / RIGHT_M, numbers(results, "merge_error_deg") / RIGHT_DEG)
    # an error that is undefined is the worst: the sessions share no place
    badness = np.nan_to_num(badness, nan=np.inf)
    status, kind = results["status"].to_numpy(), kinds(results)
    accepted = mine[status[mine] == "ok"]
    worst = [
        read_case(data, data.results[index])
        for index in accepted[np.argsort(-badness[accepted], kind="stable")][:N_WORST]
    ]
    unmerged = [
        read_case(data, data.results[index])
        for index in mine[(status[mine] != "ok") & np.isin(kind[mine], ("clean", "drift"))]
    ]
    tables = [
        case_table(worst, f"The worst accepted merges of {name}, worst first", by_kind=True),
        case_table(unmerged, f"Clean and drift pairs that {name} did not merge", by_kind=True),
    ]
    if not unmerged:
        notes.append(f"{name} merged every clean and every drift pair.")
    return tables, [*unmerged, *worst]


def _every_case(data: RunData, notes: list[str]) -> tuple[list[Table], list[Case]]:
    """Return every distinct merge of an ordinary run and, of each scenario, one whose maps are shown.

    Worlds that only repeat another one are left out, and merges of which nothing is told. Where there are too many for
    a table, those that were not accepted come first.
    """
    held = repeats(data)
    rows = [row for row in data.results if (row["scenario"], row["variant"]) not in held]
    name = main_variant([str(row["variant"]) for row in data.results])
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
