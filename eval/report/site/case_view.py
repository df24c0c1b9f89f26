"""One pair in three dimensions: both maps in one frame, the true changes, and what a method answered, as one file.

The file is viser's own offline page (`viser` of the extra `view`): client, scene and float32 points in one HTML file
that opens by a double click and asks no server and no network. Its scene tree, at the upper right, shows and hides
every layer.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.io.answer import read_answer
from cdpipe.model.aligned import alignment_of
from cdpipe.model.report import ChangeReport
from eval.report.answer.shapes import AFTER_RGB, BEFORE_RGB, REGION_RGB, WRONG_RGB, box_path, roof_mask, sphere_path
from eval.running.results.values import Row, flag, number, text
from eval.running.runfolder import RunFolder
from eval.truth.ground_truth import GroundTruth, load_ground_truth
from sim.view.returns import CHANGE_RGB, Cloud, Rgb
from sim.view.view import Label, Line, View
from sim.view.viewer import write_html

_TRUTH_RGB: dict[str, Rgb] = {
    "found": (0, 120, 90), "missed": WRONG_RGB, "unobservable": (150, 150, 150), "not scored": (60, 60, 60),
}  # fmt: skip
_REGION_RGB: dict[str, Rgb] = {"true": REGION_RGB, "false": WRONG_RGB, "not scored": (60, 60, 60)}
_MAP_POINT_M, _OBJECT_POINT_M = 0.05, 0.09
_MARGIN_M = 0.15


def write_case_view(run: RunFolder, case: tuple[str, int], variant: str, rows: Mapping[str, Sequence[Row]]) -> Path:
    """Write the view of one pair into `views/<world>/<seed>.html` of its run folder.

    Args:
        run: The run; pair, maps and answer must be in it.
        case: Scenario and seed.
        variant: Whose answer is shown.
        rows: Its rows of `changes` and `regions` for that pair.

    Returns:
        The file.

    Raises:
        InputError: Something is missing or damaged, the merge was refused, or viser is not installed.
    """
    scenario, seed = case
    answer = read_answer(run.answer(scenario, seed, variant))
    if answer.report is None:
        raise InputError(f"{scenario}, seed {seed}: {variant} gave no answer, so the maps have no common frame")
    truth = load_ground_truth(run.pair(scenario, seed))
    view = case_view(f"{scenario}, seed {seed}", run.read_maps(scenario, seed), truth, answer.report, rows)
    file = view_file(run, scenario, seed)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_html(view, file, _legend(view.title, variant))
    return file


def view_file(run: RunFolder, scenario: str, seed: int) -> Path:
    """Return where the view of a pair lies."""
    return run.path / "views" / run.maps(scenario, seed).parent.name / f"{seed}.html"


def case_view(
    title: str,
    maps: tuple[Float64Array, Float64Array],
    truth: GroundTruth,
    report: ChangeReport,
    rows: Mapping[str, Sequence[Row]],
) -> View:
    """Return what there is to see of a pair, all of it in the map frame.

    Args:
        title: What to call it.
        maps: (N, 3) before and (M, 3) after points, each in its session's odom frame, metres.
        truth: The pair's truth.
        report: What a method answered.
        rows: Its rows of `changes` and `regions`, which say what became of the changes and regions.

    Raises:
        InputError: The report's merge does not fit the pair.
    """
    alignment = alignment_of(report, truth.after.odom_T_sensor)
    paths = truth.before.odom_T_sensor[:, :3, 3], alignment.to_map(truth.after.odom_T_sensor[:, :3, 3])
    points = maps[0].astype(np.float64), alignment.to_map(maps[1].astype(np.float64))
    clouds: list[Cloud] = []
    for name, cloud, path, rgb in zip(("before", "after"), points, paths, (BEFORE_RGB, AFTER_RGB), strict=True):
        is_roof = roof_mask(cloud, path)
        clouds.append(_cloud(f"{name} map/floor and walls", cloud[~is_roof], rgb))
        clouds.append(_cloud(f"{name} map/roof", cloud[is_roof], rgb, is_shown=False))
    clouds += [
        _cloud(f"answer/{item.kind}/object {index}", item.points_map, CHANGE_RGB[item.kind], _OBJECT_POINT_M)
        for index, item in enumerate(report.objects)
    ]
    states = _states(truth, rows.get("changes", ()))
    lines, labels = [], []
    for index, change in enumerate(truth.pair.changes):
        cells = truth.points_odom(index)
        if len(cells) == 0:
            continue
        cells = cells if change.session == "before" else alignment.to_map(cells)
        low, high = cells.min(axis=0) - _MARGIN_M, cells.max(axis=0) + _MARGIN_M
        state, name = states[index], f"{change.id} {change.name}"
        lines.append(Line(f"truth/{state}/{name}", box_path(low, high), _TRUTH_RGB[state]))
        place = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2] + 0.2])
        labels.append(Label(f"names/{name}", place, f"{name}: {change.kind}, {state}"))
    lines += list(_regions(report, rows.get("regions", ())))
    lines += [Line(f"paths/{name}", path, rgb) for name, path, rgb in
              zip(("before", "after"), paths, (BEFORE_RGB, AFTER_RGB), strict=True)]  # fmt: skip
    target = _target(truth, labels, paths[0])
    eye = target + np.array([-7.0, -7.0, 9.0])
    return View(
        title, (), (), tuple(lines), tuple(each for each in clouds if len(each.points)), tuple(labels), eye, target
    )


def _states(truth: GroundTruth, rows: Sequence[Row]) -> list[str]:
    """Return what became of each change."""
    is_found = {int(number(row, "id")): flag(row, "is_found") for row in rows}
    rest = "missed" if rows else "not scored"
    return [
        "unobservable" if not is_observable else "found" if is_found.get(change.id) else rest
        for change, is_observable in zip(truth.pair.changes, truth.is_observable, strict=True)
    ]


def _regions(report: ChangeReport, rows: Sequence[Row]) -> Iterator[Line]:
    outcomes = {int(number(row, "region")): text(row, "outcome") for row in rows}
    for index in np.flatnonzero(report.regions.is_reported).tolist():
        word = "not scored" if not rows else "false" if outcomes.get(index) == "false" else "true"
        circles = sphere_path(report.regions.centres_map[index], report.regions.radii_m[index])
        yield Line(f"regions/{word}/region {index}", circles, _REGION_RGB[word])


def _target(truth: GroundTruth, labels: Sequence[Label], path: Float64Array) -> Float64Array:
    """Return what to look at first: a missed change, else any, else the middle of the way."""
    ranked = sorted(labels, key=lambda label: ("missed" not in label.text, "unobservable" in label.text))
    return np.asarray(ranked[0].position if ranked else path[len(path) // 2], dtype=np.float64)


def _cloud(name: str, points: Float64Array, rgb: Rgb, size_m: float = _MAP_POINT_M, *, is_shown: bool = True) -> Cloud:
    colours = np.tile(np.array(rgb, dtype=np.uint8), (len(points), 1))
    return Cloud(name, points.astype(np.float32), {"kind": colours}, size_m, is_shown)


def _legend(title: str, variant: str) -> str:
    """Return what the colours mean, to lie over the scene."""
    entries = [
        (BEFORE_RGB, "before map"), (AFTER_RGB, "after map"),
        *((rgb, f"answered: {kind}") for kind, rgb in CHANGE_RGB.items()),
        *((rgb, f"box: true change, {state}") for state, rgb in _TRUTH_RGB.items()),
        *((rgb, f"sphere: {word} region") for word, rgb in _REGION_RGB.items()),
    ]  # fmt: skip
    spans = "".join(
        f'<div><span style="color:rgb{rgb}">&#9632;</span> {html.escape(words)}</div>' for rgb, words in entries
    )
    style = (
        "position:fixed;left:12px;bottom:12px;padding:8px 12px;background:#fffffff0;border:1px solid #dcdcdc;"
        "border-radius:4px;font:12px/1.5 system-ui,sans-serif;color:#1a1a1a;z-index:9;pointer-events:none"
    )
    head = f"<b>{html.escape(title)}</b><div>answer of {html.escape(variant)}; metres, map frame</div>"
    tail = "<div>Layers: the button at the upper right; roofs are hidden.</div>"
    return f'<div style="{style}">{head}{spans}{tail}</div>'
