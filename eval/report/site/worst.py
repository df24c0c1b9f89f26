"""The ten pairs on which one method did worst, each with its map: where its regions lie, and what they missed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cdpipe.core.errors import InputError
from cdpipe.io.answer import read_answer
from eval.report.site.site import region_picture
from eval.report.tables import Picture
from eval.running.results.cases import rows_of_case, scenarios
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, number, select_rows, text
from eval.tables.columns import share
from eval.truth.ground_truth import load_ground_truth

N_WORST = 10


@dataclass(frozen=True, slots=True, eq=False)
class WorstPair:
    """One of the worst pairs: where, in words how bad, and its picture if its files are there."""

    scenario: str
    seed: int
    words: str
    picture: Picture | None


def worst_rows(data: RunData, variant: str) -> list[Row]:
    """Return the rows of the ten worst pairs, worst first: lowest object IoU, then region recall, then most changes.

    None where a page shows all pairs anyway, that is where every scenario has one.
    """
    worlds = scenarios(data, unchanged=False)
    rows = [
        row
        for row in select_rows(data.results, variant=variant)
        if row["scenario"] in worlds and not math.isnan(number(row, "object_iou_point"))
    ]
    if len(rows) <= len(worlds):
        return []

    def badness(row: Row) -> tuple[float, ...]:
        recall = number(row, "region_recall")
        return number(row, "object_iou_point"), 1.0 if math.isnan(recall) else recall, -number(row, "n_observable")

    return sorted(rows, key=badness)[:N_WORST]


def draw_worst(data: RunData, variant: str, rows: Sequence[Row]) -> list[WorstPair]:
    """Return the worst pairs with what can be drawn of them."""
    return [
        WorstPair(str(row["scenario"]), int(row["seed"]), _words(row), _picture(data, variant, row)) for row in rows
    ]


def _words(row: Row) -> str:
    if text(row, "status") != "ok":
        error = text(row, "error")
        return f"no answer ({text(row, 'status').replace('_', ' ')})" + (f": {error}" if error else "")
    merge = (
        f", merge error {number(row, 'merge_error_m'):.3f} m" if not math.isnan(number(row, "merge_error_m")) else ""
    )
    n = number(row, "n_observable")
    of_changes = "" if math.isnan(n) else f" of {n:.0f} observable changes"
    return (
        f"object IoU {share(number(row, 'object_iou_point'))}, F1 at 0.5 {share(number(row, 'object_f1_50'))}, "
        f"region recall {share(number(row, 'region_recall'))}{of_changes}, "
        f"false regions per 100 m {share(number(row, 'false_regions_per_100m'))}{merge}"
    )


def _picture(data: RunData, variant: str, row: Row) -> Picture | None:
    """Return the map with regions and changes; None where answer, maps or truth cannot be read."""
    scenario, seed = str(row["scenario"]), int(row["seed"])
    try:
        report = read_answer(data.folder.answer(scenario, seed, variant)).report
        before = data.folder.read_maps(scenario, seed)[0]
        truth = load_ground_truth(data.folder.pair(scenario, seed))
    except InputError:
        return None
    if report is None or len(before) == 0:
        return None
    rows = rows_of_case(data, scenario, seed, variant)
    return region_picture(f"{scenario}, seed {seed}", before, report, truth, rows)
