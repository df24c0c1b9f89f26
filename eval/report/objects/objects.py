"""Every change of a pair cut out of its session: the truth beside what each method answered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array
from cdpipe.io.answer import Answer
from eval.core.charts import BLACK, BLUE, CONTEXT, ORANGE, VERMILLION
from eval.report.objects.figures import Layers, Panel, object_panels
from eval.report.tables import Picture
from eval.running.results.cases import pictured_variants
from eval.running.results.run_data import RunData
from eval.running.results.values import flag, number, select_rows, text
from eval.scoring.answer_rows import find_answer_rows
from eval.tables.columns import share
from eval.truth.ground_truth import GroundTruth
from eval.truth.scoring_points import CELL_M
from sim.session.truth import Change

_CONTEXT_M = 1.5


def object_pictures(
    data: RunData, scenario: str, seed: int, answers: Mapping[str, Answer], truth: GroundTruth
) -> list[Picture]:
    """Draw every observable change of a pair beside what the shown presets answered."""
    names = pictured_variants(data, scenario)
    pair = AnsweredPair(data, (scenario, seed), truth, {name: answers[name] for name in names if name in answers})
    pictures = []
    for index in np.flatnonzero(truth.is_observable).tolist():
        change = truth.pair.changes[index]
        partly = "; only part of it changed" if change.group == "partial" else ""
        caption = f"{change.n_returns:,} returns in the {change.session} session{partly}"
        address = pair.draw(index, dict(zip(names, names, strict=True)))
        pictures.append(Picture(f"{change.id}. {object_title(change)}", address, caption))
    return pictures


class AnsweredPair:
    """A pair, its truth, and the answers of some variants that are drawn beside the truth.

    Args:
        data: The run.
        case: Scenario and seed.
        truth: The pair's truth.
        answers: By variant.
    """

    def __init__(self, data: RunData, case: tuple[str, int], truth: GroundTruth, answers: Mapping[str, Answer]) -> None:
        self.truth = truth
        self._rows = select_rows(data.changes, scenario=case[0], seed=case[1])
        reports = {name: answer.report for name, answer in answers.items()}
        self._objects = {name: report.objects for name, report in reports.items() if report is not None}
        self._object_rows = {name: find_answer_rows(answers[name], truth) for name in self._objects}

    def draw(self, index: int, titles: Mapping[str, str]) -> str:
        """Draw one change: its truth, and beside it what each variant answered.

        Args:
            index: Which change of the truth.
            titles: What to call each variant; one without an answer is drawn as having none.
        """
        change, true_rows = self.truth.pair.changes[index], self.truth.change_rows[index]
        session = self.truth.sessions[change.session]
        places, true_points = session.scoring_points.points_odom, session.scoring_points.points_odom[true_rows]
        low, high = true_points.min(axis=0) - _CONTEXT_M, true_points.max(axis=0) + _CONTEXT_M
        rows = np.flatnonzero(((places > low) & (places < high)).all(axis=1))
        points, is_true = places[rows].astype(np.float64), np.isin(rows, true_rows)
        none = np.zeros_like(is_true)
        n_cells = f"{len(true_rows):,} cells of {CELL_M:g} m"
        panels = [Panel("truth", n_cells, _layers(points, is_true, is_true, none))]
        for name, title in titles.items():
            if name not in self._objects:
                panels.append(Panel(title, "no answer", _layers(points, is_true, none, none)))
                continue
            row = next(iter(select_rows(self._rows, variant=name, id=change.id)), {})
            matched = number(row, "matched_object")
            is_mine, is_other = none.copy(), none.copy()
            answered = zip(self._objects[name], self._object_rows[name], strict=True)
            for place, (item, rows_of_item) in enumerate(answered):
                if item.session == change.session:
                    target = is_mine if place == matched else is_other
                    target |= np.isin(rows, rows_of_item)
            is_found = flag(row, "is_found")
            where = "" if is_found is None else "region found, " if is_found else "region missed, "
            called = text(row, "matched_kind") if matched >= 0 else ""
            note = f"{where}IoU {share(number(row, 'iou_point'))}" + (f", {called}" if called else "")
            panels.append(Panel(title, note, _layers(points, is_true, is_mine, is_other)))
        sensor = session.odom_T_sensor[:, :3, 3]
        nearest = np.argmin(np.linalg.norm(sensor - true_points.mean(axis=0), axis=1))
        return object_panels(panels, points[is_true], sensor[nearest])


def _layers(points: Float64Array, is_true: BoolArray, is_mine: BoolArray, is_other: BoolArray) -> Layers:
    """Colour points from back to front: right blue, missed black, wrong vermillion, part of other objects orange."""
    return (
        (points[~is_true & ~is_mine & ~is_other], CONTEXT),
        (points[is_other & ~is_mine & ~is_true], ORANGE),
        (points[is_true & ~is_mine], BLACK),
        (points[is_mine & ~is_true], VERMILLION),
        (points[is_true & is_mine], BLUE),
    )


def object_title(change: Change) -> str:
    """Return what a change is: its prop, and what happened to it."""
    where = f", its place {change.session}" if change.kind == "moved" else ""
    kind = change.prop_kind.replace("_", " ")
    name = "" if change.name == change.prop_kind else f" “{change.name}”"
    return f"{kind[0].upper()}{kind[1:]}{name}: {change.kind}{where}"
