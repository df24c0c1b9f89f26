"""Every change of a pair cut out of its session: the truth beside what each method answered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.io.answer import Answer
from eval.core.charts import BLACK, BLUE, CONTEXT, ORANGE, VERMILLION
from eval.report.objects.figures import Panel, object_panels
from eval.report.tables import Picture
from eval.running.run_data import SHOWN_PRESETS, Row, RunData, flag, named_variants, number, of, text
from eval.scoring.answer_rows import find_answer_rows
from eval.tables.columns import share
from eval.truth.ground_truth import GroundTruth
from eval.truth.universe import CELL_M
from sim.session.truth import Change

_CONTEXT_M = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What one method answered on a pair, to be drawn beside the truth of a change.

    Attributes:
        title: What to call the method.
        answer: What it answered; None where there is nothing.
        object_rows: Per answered object, the rows of its session's universe (`eval.scoring.answer_rows`).
        row: Its row of changes.csv for that change, {} where there is none.
    """

    title: str
    answer: Answer | None
    object_rows: Sequence[Int64Array]
    row: Row


def object_pictures(
    data: RunData, scenario: str, seed: int, answers: Mapping[str, Answer], truth: GroundTruth
) -> list[Picture]:
    """Draw every observable change of a pair beside what the shown presets answered."""
    names = [name for name in SHOWN_PRESETS if name in named_variants(data, scenario)]
    object_rows = {name: find_answer_rows(answers[name], truth) for name in names if name in answers}
    pictures = []
    for index, change in enumerate(truth.pair.changes):
        if not truth.is_observable[index]:
            continue
        shown = []
        for name in names:
            rows = of(data.changes, scenario=scenario, seed=seed, variant=name, id=change.id)
            shown.append(Shown(name, answers.get(name), object_rows.get(name, ()), rows[0] if rows else {}))
        pictures.append(
            Picture(f"{change.id}. {object_title(change)}", change_panels(index, truth, shown), _object_caption(change))
        )
    return pictures


def change_panels(index: int, truth: GroundTruth, shown: Sequence[Shown]) -> str:
    """Draw one change: its truth, and beside it what some methods answered."""
    change = truth.pair.changes[index]
    cutout = _cut_out(change, index, truth)
    true_points, others = cutout.points[cutout.is_true], cutout.points[~cutout.is_true]
    n_cells = f"{len(true_points):,} cells of {CELL_M:g} m"
    panels = [Panel("truth", n_cells, ((others, CONTEXT), (true_points, BLUE)))]
    for each in shown:
        if each.answer is None:
            panels.append(Panel(each.title, "no answer", ((others, CONTEXT), (true_points, BLACK))))
        else:
            panels.append(_answer_panel(each.title, each.answer, each.object_rows, each.row, change, cutout))
    return object_panels(panels, true_points, cutout.view_from)


@dataclass(frozen=True, slots=True, eq=False)
class _CutOut:
    """The rows of a universe around one change.

    Attributes:
        rows: (N,) which rows they are, rising.
        points: (N, 3) their points, odom frame, metres.
        is_true: (N,) which of them belong to the change.
        view_from: (3,) where the sensor passed nearest, odom frame.
    """

    rows: Int64Array
    points: Float64Array
    is_true: BoolArray
    view_from: Float64Array


def _cut_out(change: Change, index: int, truth: GroundTruth) -> _CutOut:
    session = truth.sessions[change.session]
    universe, true_rows = session.universe, truth.change_rows[index]
    true_points = universe.points_odom[true_rows]
    low, high = true_points.min(axis=0) - _CONTEXT_M, true_points.max(axis=0) + _CONTEXT_M
    rows = np.flatnonzero(((universe.points_odom > low) & (universe.points_odom < high)).all(axis=1))
    sensor = session.odom_T_sensor[:, :3, 3]
    nearest = np.argmin(np.linalg.norm(sensor - true_points.mean(axis=0), axis=1))
    points = universe.points_odom[rows].astype(np.float64)
    return _CutOut(rows, points, np.isin(rows, true_rows), sensor[nearest])


def _answer_panel(
    name: str, answer: Answer, object_rows: Sequence[Int64Array], row: Row, change: Change, cutout: _CutOut
) -> Panel:
    """Colour one method's answer: right blue, missed black, wrong vermillion, part of other objects orange."""
    matched = number(row, "matched_object")
    objects = answer.report.objects if answer.report is not None else ()
    is_mine, is_other = np.zeros_like(cutout.is_true), np.zeros_like(cutout.is_true)
    for index, (item, rows) in enumerate(zip(objects, object_rows, strict=True)):
        if item.session == change.session:
            target = is_mine if index == matched else is_other
            target |= np.isin(cutout.rows, rows)
    points, is_true = cutout.points, cutout.is_true
    layers = (
        (points[~is_true & ~is_mine & ~is_other], CONTEXT),
        (points[is_other & ~is_mine & ~is_true], ORANGE),
        (points[is_true & ~is_mine], BLACK),
        (points[is_mine & ~is_true], VERMILLION),
        (points[is_true & is_mine], BLUE),
    )
    is_found = flag(row, "is_found")
    where = "" if is_found is None else "region found, " if is_found else "region missed, "
    called = text(row, "matched_kind") if matched >= 0 else ""
    return Panel(name, f"{where}IoU {share(number(row, 'iou_point'))}" + (f", {called}" if called else ""), layers)


def object_title(change: Change) -> str:
    """Return what a change is: its prop, and what happened to it."""
    where = f", its place {change.session}" if change.kind == "moved" else ""
    kind = change.prop_kind.replace("_", " ")
    name = "" if change.name == change.prop_kind else f" “{change.name}”"
    return f"{kind[0].upper()}{kind[1:]}{name}: {change.kind}{where}"


def _object_caption(change: Change) -> str:
    partly = "; only part of it changed" if change.group == "partial" else ""
    return f"{change.n_returns:,} returns in the {change.session} session{partly}"
