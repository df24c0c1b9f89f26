"""Answers that try to score better than they are, made without the truth. METRICS.md says why none of them pays."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose, yaw_pose
from cdpipe.model.report import ChangedObject, ChangeReport
from eval.scoring.scoring import score_stored
from eval.truth.ground_truth import GroundTruth, load_ground_truth
from tests.eval.scoring.test_scoring import ONES, scored, to_map, true_report, without_objects_and_regions

SCORES = (*ONES, "keyframe_coverage")


@pytest.fixture(name="honest")
def honest_fixture(tiny_pair: Path, tiny_merge: np.ndarray) -> ChangeReport:
    """A middling answer: it finds all but one change, has one false region, and ranks the keyframes by chance."""
    report = true_report(tiny_pair, tiny_merge)
    centres = report.regions.centres_map.copy()
    centres[1] += 50.0
    scores = np.cos(np.arange(14.0) * 2.1)
    regions = replace(report.regions, centres_map=centres, keyframe_scores=scores)
    objects = (report.objects[0], replace(report.objects[1], partner=-1))
    slipped = report.before_T_after @ make_pose(translation=(0.0, 0.2, 0.0))
    return replace(report, regions=regions, objects=objects, before_T_after=slipped)


def named(report: ChangeReport, before: np.ndarray, after: np.ndarray) -> ChangeReport:
    """Name some scans alone as keyframes."""
    regions = replace(report.regions, keyframe_scores=report.regions.keyframe_scores[before])
    return replace(report, regions=regions, keyframe_scans=(before, after))


def test_naming_the_keyframes_that_one_is_sure_of_does_not_pay(tiny_pair: Path, honest: ChangeReport) -> None:
    # the best and the worst of its own scores
    order = np.argsort(honest.regions.keyframe_scores)
    few = np.sort(order[[0, -1]])
    whole, part = scored(tiny_pair, honest).row, scored(tiny_pair, named(honest, few, few)).row
    judged = [row["scan"] for row in scored(tiny_pair, named(honest, few, few)).keyframes]
    assert judged == list(range(14))
    assert part["keyframe_coverage"] < whole["keyframe_coverage"] == 1.0
    # the same as if it had given all others its worst score
    spread = np.full(14, honest.regions.keyframe_scores.min() - 1.0)
    path_m = 1.5 * np.arange(14)
    nearest = few[np.abs(path_m[:, None] - path_m[few]).argmin(axis=1)]
    is_near = np.abs(path_m - path_m[nearest]) <= 2.5
    spread[is_near] = honest.regions.keyframe_scores[nearest[is_near]]
    plain = replace(honest, regions=replace(honest.regions, keyframe_scores=spread))
    assert part["region_auroc"] == scored(tiny_pair, plain).row["region_auroc"]


def test_naming_one_keyframe_does_not_mend_a_merge(tiny_pair: Path, honest: ChangeReport) -> None:
    honest = replace(honest, before_T_after=honest.before_T_after @ yaw_pose(0.02))
    errors = ("merge_error_m", "merge_error_m_p95", "merge_error_deg_p95", "n_merge_pairs")
    whole = scored(tiny_pair, honest).row
    for scan in range(14):
        one = scored(tiny_pair, named(honest, np.array([scan]), np.array([scan]))).row
        assert [one[name] for name in errors] == [whole[name] for name in errors]


def test_leaving_out_keyframe_scores_counts_as_chance_and_is_flagged(tiny_pair: Path, honest: ChangeReport) -> None:
    for scores in (np.zeros(0), np.full(14, np.nan)):
        row = scored(tiny_pair, replace(honest, regions=replace(honest.regions, keyframe_scores=scores))).row
        assert (row["region_auroc"], row["is_auroc_assumed"], row["keyframe_coverage"]) == (0.5, 1.0, 0.0)
    assert scored(tiny_pair, honest).row["is_auroc_assumed"] == 0.0


def test_an_answer_cannot_end_itself_at_the_merge(tiny_pair: Path, honest: ChangeReport) -> None:
    scored(tiny_pair, honest)
    file = tiny_pair.parent / "answer" / "answer.json"
    file.write_text(file.read_text().replace("{", '{"until": "merge",', 1))
    with pytest.raises(InputError, match="until"):
        score_stored(load_ground_truth(tiny_pair), tiny_pair.parent / "answer")


def everything_as_objects(truth: GroundTruth, merge: np.ndarray) -> tuple[ChangedObject, ...]:
    """Each 16th part of the scoring points of either session as an object."""
    objects = []
    for name in ("before", "after"):
        points = truth.sessions[name].scoring_points
        for rows in np.array_split(np.arange(len(points)), 16):
            returns = np.column_stack([points.scans(rows), points.pixels(rows)]).astype(np.int32)
            at = to_map(name, points.points_odom[rows].astype(np.float64), merge)
            objects.append(ChangedObject(name, "added", -1, returns, at, 1.0))
    return tuple(objects)


def test_calling_all_props_changes_costs_quality_and_f1(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report, truth = true_report(tiny_pair, tiny_merge), load_ground_truth(tiny_pair)
    taken = {tuple(pixel) for item in report.objects for pixel in item.returns.tolist()}
    others = []
    for item in everything_as_objects(truth, tiny_merge):
        free = np.array([tuple(pixel) not in taken for pixel in item.returns.tolist()])
        others.append(replace(item, returns=item.returns[free], points_map=item.points_map[free]))
    row = scored(tiny_pair, replace(report, objects=(*report.objects, *others))).row
    # the true objects are among them, so IoU alone sees nothing wrong
    assert row["object_iou_point"] == 1.0
    assert row["object_pq"] == row["object_f1_50"] == pytest.approx(3 / (3 + 32 / 2))


def test_padding_raises_the_associated_accuracy_and_lowers_iou(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    # each object lacks its last three returns, or has them and twelve of what stayed besides
    report, truth = true_report(tiny_pair, tiny_merge), load_ground_truth(tiny_pair)
    cut, padded = [], []
    for place, item in enumerate(report.objects):
        cut.append(replace(item, returns=item.returns[:-3], points_map=item.points_map[:-3]))
        points = truth.sessions[item.session].scoring_points
        rows = np.flatnonzero(points.change == 0)[12 * place : 12 * place + 12]
        walls = np.column_stack([points.scans(rows), points.pixels(rows)]).astype(np.int32)
        at = to_map(item.session, points.points_odom[rows].astype(np.float64), tiny_merge)
        padded.append(
            replace(
                item,
                returns=np.concatenate([item.returns, walls]),
                points_map=np.concatenate([item.points_map, at]),
            )
        )
    plain, more = (scored(tiny_pair, replace(report, objects=tuple(items))).row for items in (cut, padded))
    assert more["associated_accuracy"] > plain["associated_accuracy"]
    assert more["object_iou_point"] < plain["object_iou_point"]


def test_the_whole_map_as_one_object_scores_nearly_nothing(tiny_pair: Path, honest: ChangeReport) -> None:
    truth = load_ground_truth(tiny_pair)
    row = scored(tiny_pair, replace(honest, objects=everything_as_objects(truth, honest.before_T_after))).row
    assert row["object_iou_point"] < 0.2
    assert row["object_pq"] == 0.0


def test_spheres_everywhere_cost_precision_and_false_regions(tiny_pair: Path, honest: ChangeReport) -> None:
    truth = load_ground_truth(tiny_pair)
    centres = truth.before.odom_T_sensor[:, :3, 3] + np.array([0.0, 0.0, 3.5])
    n = len(centres)
    regions = replace(
        honest.regions,
        centres_map=centres,
        scores=np.ones(n),
        pairs=np.zeros((n, 2), np.int64),
        is_reported=np.ones(n, np.bool_),
    )
    row = scored(tiny_pair, replace(honest, regions=regions, objects=(), figures={})).row
    assert row["region_precision"] < 0.6
    assert row["false_regions_per_100m"] > 10


def test_regions_around_a_false_one_are_false_and_those_around_a_true_one_take_places(
    tiny_pair: Path, honest: ChangeReport
) -> None:
    regions, radius_m = honest.regions, load_ground_truth(tiny_pair).pair.score_radius_m
    beside = np.array([[-0.9 * radius_m, 0.0, 0.0], [0.0, 0.0, 0.0], [0.9 * radius_m, 0.0, 0.0]])
    n = 3 * len(regions.scores)
    more = replace(
        regions,
        centres_map=(regions.centres_map[:, None] + beside).reshape(-1, 3),
        scores=np.repeat(regions.scores, 3),
        pairs=np.zeros((n, 2), np.int64),
        is_reported=np.ones(n, np.bool_),
    )
    objects = tuple(replace(item, region=-1) for item in honest.objects)
    whole = scored(tiny_pair, honest).row
    row = scored(tiny_pair, replace(honest, regions=more, objects=objects, figures={})).row
    assert row["n_false_regions"] == 3 * whole["n_false_regions"] == 3
    assert row["region_recall_at_k"] <= whole["region_recall_at_k"]


def test_a_tiny_radius_moves_the_coverage_alone(tiny_pair: Path, honest: ChangeReport) -> None:
    row = scored(tiny_pair, honest).row
    tiny = scored(tiny_pair, replace(honest, regions=replace(honest.regions, radius_m=1e-9))).row
    assert {name for name in row if repr(tiny[name]) != repr(row[name])} == {"region_coverage"}
    assert tiny["region_coverage"] < row["region_coverage"]


def test_the_surest_object_alone_misses_all_other_changes(tiny_pair: Path, honest: ChangeReport) -> None:
    row = scored(tiny_pair, replace(honest, objects=honest.objects[:1])).row
    assert (row["kind_accuracy"], row["n_matched"]) == (1.0, 1)
    figures = ("object_iou_point", "object_f1_25", "object_f1_50", "object_pq")
    whole = scored(tiny_pair, honest).row
    assert all(row[name] < whole[name] for name in figures)


def test_linking_whatever_went_with_whatever_came_pays_among_twins_alone(
    tiny_pair: Path, tiny_merge: np.ndarray
) -> None:
    # the tiny pair has a move and an object that came; the one that went is linked with the one that came
    report = true_report(tiny_pair, tiny_merge)
    truth = load_ground_truth(tiny_pair)
    drawn = [change.kind for change in truth.pair.changes]
    went, came = drawn.index("moved"), drawn.index("added")
    items = [replace(item, kind="added", partner=-1) for item in report.objects]
    for index, partner in ((went, came), (came, went)):
        items[index] = replace(items[index], kind="moved", partner=partner)
    linked = replace(report, objects=tuple(items))
    assert scored(tiny_pair, report).row["kind_accuracy"] == 1.0
    assert scored(tiny_pair, linked).row["kind_accuracy"] == 0.0


def test_objects_without_regions_find_nothing(tiny_pair: Path, honest: ChangeReport) -> None:
    objects = tuple(replace(item, region=-1) for item in honest.objects)
    row = scored(tiny_pair, replace(without_objects_and_regions(honest), objects=objects)).row
    assert row["region_recall"] == row["region_precision"] == row["region_recall_at_k"] == 0.0


def test_objects_without_regions_are_false_where_nothing_changed(write_tiny_pair: Any, tiny_merge: np.ndarray) -> None:
    pair = write_tiny_pair(has_changes=False)
    silent = without_objects_and_regions(true_report(pair, tiny_merge))
    loud = scored(pair, with_wrong(silent, load_ground_truth(pair), "object")).row
    assert (loud["is_alarm"], loud["object_precision_50"]) == (False, 0.0)


def test_times_and_bytes_that_are_left_out_are_not_zero(tiny_pair: Path, honest: ChangeReport) -> None:
    row = scored(tiny_pair, replace(honest, seconds={"t_cd_s": 0.0}, evidence={})).row
    unknown = ("t_total_s", "t_total_with_merge_s", "t_total_paper_s", "bytes_map_before", "bytes_regions_before")
    assert all(np.isnan(row[name]) for name in unknown)


@pytest.mark.parametrize("what", ["region", "object"])
def test_something_wrong_raises_no_score(tiny_pair: Path, honest: ChangeReport, what: str) -> None:
    truth = load_ground_truth(tiny_pair)
    before = scored(tiny_pair, honest).row
    after = scored(tiny_pair, with_wrong(honest, truth, what)).row
    assert_nothing_rose(before, after)
    nothing = without_objects_and_regions(honest)
    assert_nothing_rose(scored(tiny_pair, nothing).row, scored(tiny_pair, with_wrong(nothing, truth, what)).row)


def with_wrong(report: ChangeReport, truth: GroundTruth, what: str) -> ChangeReport:
    if what == "object":
        walls = np.flatnonzero(truth.after.scoring_points.change == 0)[:40]
        points = truth.after.scoring_points
        returns = np.column_stack([points.scans(walls), points.pixels(walls)]).astype(np.int32)
        at = to_map("after", points.points_odom[walls].astype(np.float64), report.before_T_after)
        return replace(report, objects=(*report.objects, ChangedObject("after", "added", -1, returns, at, 9.0)))
    regions = report.regions
    n = len(regions.scores) + 1
    wrong = replace(
        regions,
        centres_map=np.concatenate([np.full((1, 3), 500.0), regions.centres_map]),
        scores=np.concatenate([[99.0], regions.scores]),
        pairs=np.zeros((n, 2), np.int64),
        is_reported=np.ones(n, np.bool_),
    )
    objects = tuple(replace(item, region=item.region + 1) for item in report.objects)
    return replace(report, regions=wrong, objects=objects, figures={})


def assert_nothing_rose(before: dict[str, Any], after: dict[str, Any]) -> None:
    rose = {name: (before[name], after[name]) for name in SCORES if not after[name] <= before[name]}
    assert not rose
    assert after["false_regions_per_100m"] >= before["false_regions_per_100m"]
    assert after["merge_error_m"] == before["merge_error_m"]


@pytest.mark.parametrize("what", ["region", "object"])
def test_on_an_unchanged_pair_something_wrong_helps_nothing(
    tmp_path: Path, write_tiny_pair: Any, tiny_merge: np.ndarray, what: str
) -> None:
    pair = write_tiny_pair(has_changes=False)
    report = without_objects_and_regions(true_report(pair, tiny_merge))
    silent = scored(pair, report).row
    loud = scored(pair, with_wrong(report, load_ground_truth(pair), what)).row
    # undefined where nothing changed and nothing was said; 0 as soon as something wrong is said
    names = [name for name in ONES if name != "static_accuracy"]
    assert all(np.isnan(silent[name]) and (np.isnan(loud[name]) or loud[name] == 0.0) for name in names)
    assert loud["static_accuracy"] <= silent["static_accuracy"] == 1.0
    assert loud["is_alarm"] >= silent["is_alarm"]


def test_proposed_centres_of_ones_own_choice_move_the_columns_of_proposals_alone(
    tiny_pair: Path, honest: ChangeReport
) -> None:
    # all regions lie on nothing; they are said to have been proposed where the honest ones are
    regions = honest.regions
    on_nothing = replace(regions, centres_map=regions.centres_map + 500.0)
    nothing = scored(tiny_pair, replace(honest, regions=on_nothing)).row
    stated = replace(on_nothing, proposed_centres_map=regions.centres_map)
    row = scored(tiny_pair, replace(honest, regions=stated)).row
    moved = {name for name, value in row.items() if value != nothing[name] and not name.startswith("t_")}
    moved -= {name for name, value in row.items() if isinstance(value, float) and np.isnan(value)}
    assert moved == {
        "region_recall_proposed", "region_precision_proposed", "false_regions_per_100m_proposed",
        "region_recall_at_k_proposed",
    }  # fmt: skip
    assert row["region_recall"] == 0.0
    assert row["region_recall_proposed"] == scored(tiny_pair, honest).row["region_recall"] > 0.5


def test_the_same_region_twice_counts_once(tiny_pair: Path, honest: ChangeReport) -> None:
    regions = honest.regions
    twice = replace(
        regions,
        centres_map=np.repeat(regions.centres_map, 2, axis=0),
        scores=np.repeat(regions.scores, 2),
        pairs=np.repeat(regions.pairs, 2, axis=0),
        is_reported=np.repeat(regions.is_reported, 2),
    )
    objects = tuple(replace(item, region=2 * item.region) for item in honest.objects)
    once, doubled = (
        scored(tiny_pair, honest).row,
        scored(tiny_pair, replace(honest, regions=twice, objects=objects, figures={})).row,
    )
    assert {name: doubled[name] for name in ("region_recall", "n_true_regions")} == {
        name: once[name] for name in ("region_recall", "n_true_regions")
    }
    assert doubled["region_precision"] <= once["region_precision"]
    assert doubled["region_recall_at_k"] <= once["region_recall_at_k"]
