"""One answer from above: what changed, where, and, beside the truth, whether it is right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import transform
from cdpipe.io.answer import read_answer
from cdpipe.io.readers import open_session
from cdpipe.model.report import ChangeReport
from eval.report.answer.content import locate_objects
from eval.scoring.region_metrics import transform_to_map
from eval.truth.ground_truth import load_ground_truth
from sim.view.returns import CHANGE_RGB

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot(answer: ChangeReport | Path | str, pair: Path | str | None = None) -> Figure:
    """Draw an answer in the map frame, metres: regions as circles, objects in the colour of their kind.

    Args:
        answer: What `cdpipe.detect` returned, or the folder of an answer: of `tunnelcd detect`, or of another program
            that states its objects as points. Objects that are stated as returns alone are drawn where a pair is given.
        pair: Folder of the simulated pair: draws the before session's path, and a cross at each observable change.

    Returns:
        A matplotlib figure; `savefig` writes it.

    Raises:
        InputError: The pair has no truth, or the answer cannot be read or failed.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - a figure only where one is asked for

    report = answer if isinstance(answer, ChangeReport) else _read_report(Path(answer), pair)
    figure = Figure(figsize=(8, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x of the map frame [m]", ylabel="y of the map frame [m]")
    if pair is not None:
        truth = load_ground_truth(Path(pair), keeps_points=False)
        path_m = truth.before.odom_T_sensor[truth.before.judged_scans, :2, 3]
        axes.plot(*path_m.T, color="0.7", label="path of the before session")
        changes = truth.centroids_world[truth.is_observable].reshape(-1, 3)
        axes.plot(*transform_to_map(changes, truth.before)[:, :2].T, "kx", markersize=10, label="true change")
    angle = np.linspace(0.0, 2 * np.pi, 100)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    for region in np.flatnonzero(report.regions.is_reported):
        outline = report.regions.centres_map[region, :2] + report.regions.radii_m[region] * circle
        axes.plot(*outline.T, color="0.3", linewidth=0.8)
    for kind, colour in CHANGE_RGB.items():
        points = [item.points_map[:, :2] for item in report.objects if item.kind == kind]
        if points:
            axes.plot(*np.concatenate(points).T, ".", markersize=2, color=np.array(colour) / 255, label=kind)
    axes.legend(loc="best", fontsize="small")
    return figure


def _read_report(folder: Path, pair: Path | str | None) -> ChangeReport:
    """Return the report of a stored answer, its objects with map points.

    Without a pair nobody knows where the after path was, so that odom points are moved by the rigid merge.
    """
    answer = read_answer(folder)
    report, foreign = answer.report, answer.points_odom
    if report is None:
        raise InputError(f"{folder}: status is {answer.status}: there is nothing to draw")
    if pair is not None:
        return locate_objects(answer, (open_session(Path(pair) / "before"), open_session(Path(pair) / "after")))
    if foreign is None:
        return report
    before_T = {"before": np.eye(4), "after": report.before_T_after}
    objects = [
        item if len(item.points_map) else replace(item, points_map=transform(before_T[item.session], points))
        for item, points in zip(report.objects, foreign, strict=True)
    ]
    return replace(report, objects=tuple(objects))
