"""The pictures of one site: its maps, its regions, and every change cut out beside its truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.io.answer import Answer, read_answer
from cdpipe.model.aligned import alignment_of
from cdpipe.model.report import ChangeReport
from eval.report.maps import Points, RegionMark, State, TruthMark, distance_map, overlay_map, region_map
from eval.report.objects.objects import object_pictures
from eval.report.tables import Picture
from eval.running.results.cases import first_seed, named_variants, pictured_variants, rows_of_case
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, flag, number, text
from eval.running.runfolder import RunFolder
from eval.scoring.region_metrics import transform_to_map
from eval.truth.ground_truth import GroundTruth, load_ground_truth

_STATES: dict[bool | None, State] = {True: "found", False: "missed", None: "not scored"}


@dataclass(frozen=True, slots=True)
class Site:
    """What the page shows of one scenario, and what it cannot show."""

    scenario: str
    seed: int
    maps: tuple[Picture, ...]
    regions: tuple[Picture, ...]
    objects: tuple[Picture, ...]
    missing: tuple[str, ...]


def draw_site(data: RunData, scenario: str) -> Site:
    """Draw the first pair of a scenario; what cannot be drawn is named in `missing`."""
    seed = first_seed(data, scenario)
    missing: list[str] = []
    answers = _answers(data, scenario, seed, missing)
    maps = _maps(data.folder, scenario, seed, missing)
    truth = _truth(data.folder.pair(scenario, seed), missing)
    maps_drawn = [] if maps is None else _map_pictures(maps, answers, truth, missing)
    regions = []
    for name in pictured_variants(data, scenario):
        report = answers[name].report if name in answers else None
        if maps is not None and report is not None:
            rows = rows_of_case(data, scenario, seed, name)
            regions.append(region_picture(f"Changed regions: {name}", maps[0], report, truth, rows))
    objects = [] if truth is None else object_pictures(data, scenario, seed, answers, truth)
    return Site(scenario, seed, tuple(maps_drawn), tuple(regions), tuple(objects), tuple(missing))


def _answers(data: RunData, scenario: str, seed: int, missing: list[str]) -> dict[str, Answer]:
    """Return the readable answers with a report, the shown presets first."""
    variants = named_variants(data, scenario)
    found: dict[str, Answer] = {}
    refused: dict[str, list[str]] = {}
    for name in dict.fromkeys([*pictured_variants(data, scenario), *variants]):
        try:
            answer = read_answer(data.folder.answer(scenario, seed, name))
        except InputError:
            missing.append(f"The stored answer of {name} on {scenario} cannot be read.")
            continue
        if answer.report is None:
            refused.setdefault(answer.status.replace("_", " "), []).append(name)
        else:
            found[name] = answer
    missing += [f"No answer of {', '.join(names)} on {scenario} ({why})." for why, names in refused.items()]
    return found


def _maps(run: RunFolder, scenario: str, seed: int, missing: list[str]) -> tuple[Points, Points] | None:
    path = run.maps(scenario, seed)
    try:
        maps = run.read_maps(scenario, seed)
    except InputError:
        missing.append(f"The maps for pictures (maps/{path.parent.name}/{path.name}) are missing or damaged.")
        return None
    if any(len(cloud) == 0 for cloud in maps):
        missing.append(f"The maps for pictures (maps/{path.parent.name}/{path.name}) hold no points.")
        return None
    return maps


def _truth(pair: Path, missing: list[str]) -> GroundTruth | None:
    try:
        return load_ground_truth(pair)
    except InputError as error:
        missing.append(
            f"The truth of pairs/{pair.parent.name}/{pair.name} cannot be read, so no change is shown: {error}"
        )
        return None


def _map_pictures(
    maps: tuple[Points, Points], answers: Mapping[str, Answer], truth: GroundTruth | None, missing: list[str]
) -> list[Picture]:
    before, after = maps
    overlay = Picture(
        "Both maps before alignment",
        overlay_map(before, after),
        f"Seen from above, each in the frame its robot started in: {len(before):,} points before, {len(after):,} "
        "after, thinned.",
    )
    name, report = next(((name, answer.report) for name, answer in answers.items()), ("", None))
    if report is None:
        missing.append("No answer holds a merge, so the aligned maps are not shown.")
        return [overlay]
    if truth is None and report.local_before_T_after is not None:
        missing.append(
            f"The poses that the merge of {name} bends along cannot be read, so the aligned maps are missing."
        )
        return [overlay]
    try:
        # a rigid merge asks for no poses
        alignment = alignment_of(report, np.zeros((0, 4, 4)) if truth is None else truth.after.odom_T_sensor)
    except InputError as error:
        missing.append(f"The merge of {name} does not fit the pair, so the aligned maps are missing: {error}")
        return [overlay]
    aligned = Picture(
        "The after map, aligned by the pipeline",
        distance_map(before, alignment.to_map(after.astype(np.float64))),
        f"With the merge of {name}. Colour: distance to the nearest before point, the farthest one on top; dark "
        "where something is new, but also where the before session never looked.",
    )
    return [overlay, aligned]


def region_picture(
    title: str, before: Points, report: ChangeReport, truth: GroundTruth | None, rows: Mapping[str, Sequence[Row]]
) -> Picture:
    """Draw the reported regions of an answer over the before map, and where the changes truly are.

    Args:
        title: What stands above it.
        before: (N, 3) points of the before map, metres.
        report: The answer.
        truth: The pair's truth; None where it cannot be read.
        rows: The rows of `changes` and `regions` that the answer has in the tables of those names.
    """
    outcomes = {int(number(row, "region")): text(row, "outcome") for row in rows["regions"]}
    radii_m = report.regions.radii_m.tolist()
    regions = [
        RegionMark(float(x_m), float(y_m), radii_m[index], outcomes.get(index) == "false")
        for index, (x_m, y_m, _) in enumerate(report.regions.centres_map)
        if report.regions.is_reported[index]
    ]
    marks = [] if truth is None else truth_marks(truth, rows["changes"])
    states = [mark.state for mark in marks]
    n_false = sum(mark.is_false for mark in regions)
    count = "1 region" if len(regions) == 1 else f"{len(regions)} regions"
    false = f", {n_false} of them false" if outcomes or not regions else ""  # without regions.csv it is not known
    words = [f"{count}{_name_radii(regions)} reported{false}."]
    if states and "not scored" not in states:
        n_observable = len(states) - states.count("unobservable")
        words.append(f"{states.count('found')} of {n_observable} observable changes found.")
    if states:
        words.append("Numbers are those of the changes below.")
    return Picture(title, region_map(before, regions, marks), " ".join(words))


def _name_radii(regions: Sequence[RegionMark]) -> str:
    """Return the radius of regions, or the smallest and the largest, in words."""
    radii = sorted({f"{mark.radius_m:.3g}" for mark in regions}, key=float)
    return f" of {' to '.join(dict.fromkeys([radii[0], radii[-1]]))} m" if radii else ""


def truth_marks(truth: GroundTruth, rows: Sequence[Row]) -> list[TruthMark]:
    """Return where the changes are on the before map, and what became of them.

    Args:
        truth: The pair's truth.
        rows: Rows of changes.csv of one variant.
    """
    is_found = {int(number(row, "id")): flag(row, "is_found") for row in rows}
    places = transform_to_map(truth.centroids_world, truth.before)
    marks = []
    for change, (x_m, y_m, _), is_observable in zip(truth.pair.changes, places, truth.is_observable, strict=True):
        state = _STATES[is_found.get(change.id)] if is_observable else "unobservable"
        marks.append(TruthMark(float(x_m), float(y_m), str(change.id), state))
    return marks
