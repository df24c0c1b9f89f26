"""The pictures of one site: its maps, its regions, and every change cut out beside its truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, invert, transform
from cdpipe.io.answer import Answer, read_answer
from cdpipe.io.session import load_arrays
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.report import ChangeReport
from eval.report.maps import Points, RegionMark, State, TruthMark, distance_map, overlay_map, region_map
from eval.report.objects.objects import object_pictures
from eval.report.tables import Picture
from eval.running.run_data import SHOWN_PRESETS, Row, RunData, first_seed, flag, named_variants, number, of, text
from eval.truth.aligned import alignment_of
from eval.truth.ground_truth import GroundTruth, SessionTruth, load_ground_truth

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
    maps = _maps(data.folder.maps(scenario, seed), missing)
    truth = _truth(data.folder.pair(scenario, seed), missing)
    maps_drawn = [] if maps is None else _map_pictures(maps, answers, truth, missing)
    regions = [] if maps is None else _region_pictures(data, scenario, seed, maps[0], answers, truth)
    objects = [] if truth is None else object_pictures(data, scenario, seed, answers, truth)
    return Site(scenario, seed, tuple(maps_drawn), tuple(regions), tuple(objects), tuple(missing))


def _answers(data: RunData, scenario: str, seed: int, missing: list[str]) -> dict[str, Answer]:
    """Readable answers with a report, the shown presets first."""
    variants = named_variants(data, scenario)
    missing += [f"Preset {name} was not run on {scenario}." for name in SHOWN_PRESETS if name not in variants]
    order = [name for name in SHOWN_PRESETS if name in variants]
    order += [name for name in variants if name not in SHOWN_PRESETS]
    found: dict[str, Answer] = {}
    refused: dict[str, list[str]] = {}
    for name in order:
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


def _maps(path: Path, missing: list[str]) -> tuple[Points, Points] | None:
    try:
        arrays = load_arrays(path)
        maps = arrays["before_points"], arrays["after_points"]
    except (InputError, KeyError):
        missing.append(f"The maps for pictures (maps/{path.parent.name}/{path.name}) are missing or damaged.")
        return None
    if any(cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0 for cloud in maps):
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
    pictures = [
        Picture(
            "Both maps before alignment",
            overlay_map(before, after),
            f"Seen from above, each in the frame its robot started in: {len(before):,} points before, {len(after):,} "
            "after, thinned.",
        )
    ]
    chosen = next(((name, answer.report) for name, answer in answers.items() if answer.report is not None), None)
    if chosen is None:
        missing.append("No answer holds a merge, so the aligned maps are not shown.")
        return pictures
    name, report = chosen
    alignment = _alignment(name, report, truth, missing)
    if alignment is None:
        return pictures
    aligned = alignment.to_map(after.astype(np.float64))
    pictures.append(
        Picture(
            "The after map, aligned by the pipeline",
            distance_map(before, aligned),
            f"With the merge of {name}. Colour: distance to the nearest before point, the farthest one on top; dark "
            "where something is new, but also where the before session never looked.",
        )
    )
    return pictures


def _alignment(name: str, report: ChangeReport, truth: GroundTruth | None, missing: list[str]) -> PathAlignment | None:
    """Return what the after map was aligned with; None where that needs the session's poses and they cannot be read."""
    if report.local_before_T_after is None:
        return PathAlignment.rigid(report.before_T_after)
    if truth is None:
        missing.append(
            f"The poses that the merge of {name} bends along cannot be read, so the aligned maps are missing."
        )
        return None
    try:
        return alignment_of(report, truth.after.odom_T_sensor)
    except InputError as error:
        missing.append(f"The merge of {name} does not fit the pair, so the aligned maps are missing: {error}")
        return None


def _region_pictures(
    data: RunData,
    scenario: str,
    seed: int,
    before: Points,
    answers: Mapping[str, Answer],
    truth: GroundTruth | None,
) -> list[Picture]:
    pictures = []
    for name in SHOWN_PRESETS:
        report = answers[name].report if name in answers else None
        if report is None:
            continue
        rows = of(data.changes, scenario=scenario, seed=seed, variant=name)
        marks = [] if truth is None else truth_marks(truth, rows)
        regions = region_marks(report, of(data.regions, scenario=scenario, seed=seed, variant=name))
        caption = region_caption(regions, report.regions.radius_m, [mark.state for mark in marks])
        pictures.append(
            Picture(f"Changed regions: {name}", region_map(before, regions, report.regions.radius_m, marks), caption)
        )
    return pictures


def region_caption(regions: Sequence[RegionMark], radius_m: float, states: Sequence[State]) -> str:
    """Return what stands below a map of regions: how many, how many of them false, and how many changes they find."""
    n_false = sum(mark.is_false for mark in regions)
    words = [f"{len(regions)} regions of {radius_m:g} m reported, {n_false} of them false."]
    if states and "not scored" not in states:
        n_observable = len(states) - states.count("unobservable")
        words.append(f"{states.count('found')} of {n_observable} observable changes found.")
    if states:
        words.append("Numbers are those of the changes below.")
    return " ".join(words)


def truth_marks(truth: GroundTruth, rows: Sequence[Row]) -> list[TruthMark]:
    """Return where the changes are on the before map, and what became of them.

    Args:
        truth: The pair's truth.
        rows: Rows of changes.csv of one variant.
    """
    is_found = {int(number(row, "id")): flag(row, "is_found") for row in rows}
    marks = []
    for change, centroid, is_observable in zip(
        truth.pair.changes, truth.centroids_world, truth.is_observable, strict=True
    ):
        place = world_to_odom(truth.before, centroid)
        state: State = _STATES[is_found.get(change.id)] if is_observable else "unobservable"
        marks.append(TruthMark(float(place[0]), float(place[1]), str(change.id), state))
    return marks


def world_to_odom(session: SessionTruth, point_world: Float64Array) -> Float64Array:
    """Carry a (3,) world point into a session's odom frame through its truly nearest scan."""
    nearest = int(np.argmin(np.linalg.norm(session.world_T_sensor[:, :3, 3] - point_world, axis=1)))
    odom_T_world = session.odom_T_sensor[nearest] @ invert(session.world_T_sensor[nearest])
    return np.asarray(transform(odom_T_world, point_world[None])[0])


def region_marks(report: ChangeReport, rows: Sequence[Row]) -> list[RegionMark]:
    """Return the reported regions; `rows` of regions.csv say which of them are false."""
    outcomes = {int(number(row, "region")): text(row, "outcome") for row in rows}
    reported = np.flatnonzero(report.regions.is_reported)
    centres = report.regions.centres_map
    return [RegionMark(float(centres[i, 0]), float(centres[i, 1]), outcomes.get(int(i)) == "false") for i in reported]
