"""Truth against a stored answer: every column of results.csv and the rows of the item tables.

The specification of every figure, with worked examples, is in METRICS.md. Nothing is run here: an answer can be
scored again whenever the metrics change, and so can an answer that another program wrote.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import travelled_m
from cdpipe.core.plugins import METRICS, entry_points, load_entry_point
from cdpipe.extract.extract import FIGURES
from cdpipe.io.answer import Answer, read_answer
from cdpipe.model.report import ChangeReport
from eval.core.domains import domain_of
from eval.core.statistics import mean
from eval.scoring.answer_check import SECONDS, check_answer
from eval.scoring.answer_rows import find_answer_rows
from eval.scoring.item_rows import make_change_rows, make_object_rows, make_region_rows, read_figure
from eval.scoring.judged_places import carry_merge
from eval.scoring.merge_metrics import compute_merge_errors, list_evidence, measure_overlap, summarise_merge_errors
from eval.scoring.object_metrics import (
    judge_kinds,
    match_objects,
    score_unanswered_objects,
    summarise_objects,
)
from eval.scoring.object_sizes import SizeErrors, compute_size_errors, summarise_size_errors
from eval.scoring.point_metrics import score_points, score_unanswered_points
from eval.scoring.region_metrics import score_regions, score_unanswered_regions
from eval.scoring.surface.metrics import score_surface
from eval.truth.ground_truth import GroundTruth, load_ground_truth

METRICS_VERSION = 7
_NAN = float("nan")
_OF_THE_RUN = ("commit", "is_contended")  # columns that a run adds to the row
Metric = Callable[[GroundTruth, Answer], Mapping[str, float]]
"""`metric(truth, answer)`: columns by name; NaN where undefined. `answer.report` is None where a method gave none."""


@dataclass(frozen=True, slots=True, eq=False)
class CaseScore:
    """The scores of one answer.

    Attributes:
        row: Its row of results.csv; the caller overwrites scenario, variant and preset.
        changes: One dict per change of the truth.
        regions: One dict per candidate region.
        objects: One dict per answered object.
        keyframes: One dict per judged place of the before session: keyframe (its number), scan, score (NaN where the
            answer states none), label (1, 0, or -1 for left out).
        surface_changes: One dict per surface change of the truth.
        surface_windows: One dict per window for detection limits.
        plugins: Columns of the row that metrics of others made.
    """

    row: dict[str, Any]
    changes: list[dict[str, Any]]
    regions: list[dict[str, Any]]
    objects: list[dict[str, Any]]
    keyframes: list[dict[str, Any]] = field(default_factory=list)
    surface_changes: list[dict[str, Any]] = field(default_factory=list)
    surface_windows: list[dict[str, Any]] = field(default_factory=list)
    plugins: frozenset[str] = frozenset()


def score(answer: ChangeReport | Path | str, pair: Path | str) -> dict[str, Any]:
    """Score a report, or the folder of a stored answer, against a simulated pair: one row of results.csv.

    A report is called as its config says under `method`, or else by its source of regions. The pair is not written to.

    Raises:
        InputError: The pair has no truth, a file is damaged, or the answer cannot be an answer to this pair.
    """
    truth = load_ground_truth(Path(pair), keeps_points=False)
    if not isinstance(answer, ChangeReport):
        return score_stored(truth, Path(answer)).row
    config: dict[str, Any] = dict(answer.config)
    method = config.get("method", config.get("regions", {}).get("source", ""))
    measured = answer.seconds, answer.evidence
    whole = Answer("ok", "", str(method), answer, *measured, checkpoints=answer.checkpoints, extras=answer.extras)
    check_answer(whole, truth, Path("report"))
    return score_answer(whole, truth).row


def score_stored(truth: GroundTruth, folder: Path, *, may_end_early: bool = False) -> CaseScore:
    """Score the answer stored in a folder.

    Args:
        truth: The pair's truth.
        folder: Folder of the answer.
        may_end_early: Whether a plan asked for the answer, and may have ended it at the merge.

    Raises:
        InputError: A file is damaged, or the answer cannot be an answer to this pair.
    """
    answer = read_answer(folder)
    if answer.until is not None and not may_end_early:
        raise InputError(
            f"{folder / 'answer.json'}: until = {answer.until!r}: a plan alone ends a method early; leave it out, and "
            "give the whole answer"
        )
    check_answer(answer, truth, folder, is_of_pair=may_end_early)
    return score_answer(answer, truth)


def score_answer(answer: Answer, truth: GroundTruth) -> CaseScore:
    """Score an answer that was checked (`eval.scoring.answer_check`) against a pair's truth.

    An answer that ends at the merge has NaN in all region and object columns, also where the merge was refused or
    failed, and it has no items.
    """
    after_travelled_m = travelled_m(truth.after.odom_T_sensor)
    report = answer.report
    if report is None or answer.until == "merge":
        regions = score_unanswered_regions(truth)
        objects, object_scores = score_unanswered_objects(truth)
        object_scores |= score_unanswered_points(truth)
        right = np.full(len(truth.pair.changes), np.nan)
        sizes = SizeErrors(right, right)
        items: list[dict[str, Any]] = []
    else:
        regions = score_regions(report, truth, after_travelled_m)
        rows = find_answer_rows(answer, truth)
        objects = match_objects(report.objects, rows, truth)
        right = judge_kinds(report.objects, objects, truth)
        object_scores = {**summarise_objects(objects, right, truth), **score_points(report.objects, rows, truth)}
        sizes = compute_size_errors(report.objects, objects, truth)
        items = make_object_rows(report.objects, objects, truth)
    surface = score_surface(answer, truth, float(after_travelled_m[-1]))
    n_regions = int(regions.columns["n_regions"])
    found: dict[str, float] = {**regions.columns, **object_scores, **summarise_size_errors(sizes, truth)}
    row = {
        **_make_identity(answer, truth),
        **(found if answer.until is None else dict.fromkeys(found, _NAN)),
        **_score_merge(answer, truth),
        **_list_times(answer, n_regions + int(regions.columns["n_withdrawn"])),
        **{name: mean(read_figure(report, name)[report.regions.is_reported]) if report else _NAN for name in FIGURES},
        **_list_sizes(answer, truth, n_regions, float(after_travelled_m[-1])),
        **surface.columns,
    }
    plugin_columns = compute_plugin_columns(truth, answer, {**row, **dict.fromkeys(_OF_THE_RUN)})
    row |= plugin_columns
    if answer.until == "merge":
        return CaseScore(row=row, changes=[], regions=[], objects=[], plugins=frozenset(plugin_columns))
    judged = zip(truth.before.judged_scans, regions.keyframe_scores, regions.keyframe_labels, strict=True)
    return CaseScore(
        row=row,
        plugins=frozenset(plugin_columns),
        changes=make_change_rows(regions, (objects, sizes), right, truth, report),
        regions=make_region_rows(report, regions, truth),
        objects=items,
        keyframes=[
            {"keyframe": index, "scan": int(scan), "score": float(score), "label": int(label)}
            for index, (scan, score, label) in enumerate(judged)
        ],
        surface_changes=surface.changes,
        surface_windows=surface.windows,
    )


def compute_plugin_columns(truth: GroundTruth, answer: Answer, taken: Mapping[str, object]) -> dict[str, float]:
    """Return the columns of every metric of others, an entry point of the group `tunnelcd.metrics` (HOWTO.md).

    Args:
        truth: The pair's truth.
        answer: What a method answered.
        taken: Columns that the row has already.

    Raises:
        InputError: A metric cannot be imported, gives no numbers, or a column that the row has already.
    """
    columns: dict[str, float] = {}
    for name in entry_points(METRICS):
        metric: Metric = load_entry_point(METRICS, name)
        for column, value in metric(truth, answer).items():
            if column in taken or column in columns:
                raise InputError(f"{METRICS}: {name!r}: column {column!r} exists already: give it another name")
            if not isinstance(value, Real) or math.isinf(value):
                raise InputError(
                    f"{METRICS}: {name!r}: column {column!r} = {value!r}: expected a number, finite or NaN"
                )
            columns[column] = float(value)
    return columns


def describe_recording(scenario: Mapping[str, Any]) -> dict[str, str]:
    """Return the columns that say how a pair was recorded: the odometry of either session and the sensor's profile.

    Where each session has a sensor of its own, both are named: `os0-128 then os1-32-nominal`.

    Args:
        scenario: The scenario as drawn, as the truth of a pair holds it; a part that is not there gives "".
    """

    def named(*path: str) -> str:
        value: Any = scenario
        for key in path:
            value = value.get(key) if isinstance(value, Mapping) else None
        return "" if value is None else str(value)

    usual = named("sensor", "profile")
    before, after = (named(session, "sensor", "profile") or usual for session in ("before", "after"))
    return {
        "odometry_before": named("before", "odometry", "source"),
        "odometry_after": named("after", "odometry", "source"),
        "sensor_profile": before if before == after else f"{before} then {after}",
    }


def _make_identity(answer: Answer, truth: GroundTruth) -> dict[str, Any]:
    extras = [f"{name} {version}" for name, version in answer.extras.items()]
    extras += sorted({session.made_poses for session in truth.sessions.values()} - {""})
    return {
        "scenario": truth.pair.family,
        "family": truth.pair.family,
        "pair_kind": "",
        "seed": truth.pair.seed,
        "variant": answer.method,
        "preset": answer.method,
        "status": answer.status,
        "error": answer.error,
        "metrics_version": METRICS_VERSION,
        "domain": domain_of(truth.pair.family),
        "n_changes": len(truth.pair.changes),
        "n_observable": truth.n_observable,
        "score_radius_m": truth.pair.score_radius_m,
        **describe_recording(truth.pair.scenario),
        "checkpoints": ";".join(f"{name} {digest}" for name, digest in answer.checkpoints.items()),
        "extras": ";".join(extras),
    }


def _score_merge(answer: Answer, truth: GroundTruth) -> dict[str, float]:
    report, errors = answer.report, None
    if report is not None:
        errors = compute_merge_errors(truth.before, truth.after, carry_merge(report, truth.after))
    overlap = measure_overlap(truth.before.world_T_sensor, truth.after.world_T_sensor)
    return {**summarise_merge_errors(errors), "overlap_true": overlap, **list_evidence(answer.evidence)}


def _list_times(answer: Answer, n_proposed: int) -> dict[str, float]:
    """Return the time columns; a time that the answer does not state is NaN, and so are its sums.

    Withdrawn regions were compared and extracted as well, so times per region count them.
    """
    index, merge, refine, descriptor, cd, oe, returns = (float(answer.seconds.get(name, _NAN)) for name in SECONDS[:-1])
    n_keyframes = 0 if answer.report is None else sum(len(scans) for scans in answer.report.keyframe_scans)
    return {
        "t_index_s": index,
        "t_merge_s": merge,
        "t_refine_s": refine,
        "t_descriptor_s": descriptor,
        "t_descriptor_per_keyframe_s": descriptor / n_keyframes if n_keyframes else _NAN,
        "t_cd_s": cd,
        "t_cd_per_region_s": cd / n_proposed if n_proposed else _NAN,
        "t_oe_s": oe,
        "t_oe_per_region_s": oe / n_proposed if n_proposed else _NAN,
        "t_returns_s": returns,
        "t_total_s": descriptor + cd + oe,
        "t_total_with_merge_s": index + merge + refine + descriptor + cd + oe,
        "t_total_paper_s": cd + oe,
    }


def _list_sizes(answer: Answer, truth: GroundTruth, n_regions: int, after_path_m: float) -> dict[str, Any]:
    keyframes = (None, None) if answer.report is None else answer.report.keyframe_scans
    is_unchanged = len(truth.pair.changes) == 0
    return {
        **{f"map_points_{name}": float(answer.evidence.get(f"map_points_{name}", _NAN)) for name in truth.sessions},
        **{
            f"n_keyframes_{name}": len(scans) if scans is not None and len(scans) else _NAN
            for name, scans in zip(truth.sessions, keyframes, strict=True)
        },
        **{name: float(answer.evidence.get(name, _NAN)) for name in ("bytes_map_before", "bytes_regions_before")},
        "after_path_m": after_path_m,
        "is_unchanged_pair": is_unchanged,
        # a refused pair, or one that ends at the merge, is neither silent nor an alarm
        "is_alarm": n_regions > 0 if is_unchanged and answer.report is not None and answer.until is None else _NAN,
    }
