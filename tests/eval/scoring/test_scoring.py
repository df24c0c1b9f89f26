"""A whole pair scored from its files: truth as the answer, no answer, foreign answers, and answers that cannot be."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import invert, make_pose, transform
from cdpipe.io.answer import write_answer, write_failure
from cdpipe.io.readers import open_session
from cdpipe.io.session import read_session
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, ObjectShape
from eval.core.domains import domain_of, is_change_in_distribution
from eval.scoring.scoring import METRICS_VERSION, CaseScore, score, score_stored
from eval.truth.ground_truth import GroundTruth, load_ground_truth
from sim.session.truth import MIXED, read_labels, write_labels

ONES = (
    "region_recall",
    "region_precision",
    "region_recall_at_k",
    "region_auroc",
    "region_ap",
    "object_iou_point",
    "object_iou_voxel",
    "object_iou_box",
    "object_f1_25",
    "object_f1_50",
    "object_precision_50",
    "object_pq",
    "static_accuracy",
    "dynamic_accuracy",
    "associated_accuracy",
    "kind_accuracy",
)
COLUMN_TEXT = """
scenario family domain pair_kind seed variant preset status error metrics_version n_changes n_observable score_radius_m
region_recall region_precision region_recall_at_k region_auroc region_ap keyframe_coverage is_auroc_assumed
false_regions_per_100m region_coverage
n_regions n_true_regions n_false_regions n_duplicate_regions n_ignored_regions n_found_changes
false_regions_on_movers_per_100m n_false_regions_on_movers
object_iou_point object_iou_voxel object_iou_box object_f1_25 object_f1_50 object_precision_50 object_pq kind_accuracy
region_recall_proposed region_recall_at_k_proposed region_precision_proposed false_regions_per_100m_proposed n_withdrawn
n_objects n_matched n_ignored_objects n_partial object_iou_point_partial
static_accuracy dynamic_accuracy associated_accuracy displacement_error_m pile_volume_error
merge_error_m merge_error_deg merge_error_along_m merge_error_m_p95 merge_error_deg_p95 merge_error_along_m_p95
n_merge_pairs overlap_true evidence_overlap evidence_inlier_share evidence_residual_m evidence_hessian_ratio
evidence_agreement evidence_descriptor_distance evidence_n_hypotheses evidence_is_fallback evidence_n_refined
evidence_distinctness evidence_refined_inlier_share evidence_max_correction_m t_index_s t_merge_s t_refine_s
t_descriptor_s t_descriptor_per_keyframe_s t_cd_s t_cd_per_region_s t_oe_s t_oe_per_region_s t_returns_s
t_total_s t_total_with_merge_s t_total_paper_s v_sphere_m3 v_oe_m3 s_points oe_points
map_points_before map_points_after bytes_map_before bytes_regions_before
n_keyframes_before n_keyframes_after after_path_m is_unchanged_pair is_alarm checkpoints extras
odometry_before odometry_after sensor_profile
"""
COLUMNS = COLUMN_TEXT.split()


def to_map(session: str, points_odom: np.ndarray, merge: np.ndarray) -> np.ndarray:
    return points_odom if session == "before" else transform(merge, points_odom)


def true_objects(truth: GroundTruth, merge: np.ndarray) -> tuple[ChangedObject, ...]:
    place = {change.id: index for index, change in enumerate(truth.pair.changes)}
    objects = []
    for change, rows in zip(truth.pair.changes, truth.change_rows, strict=True):
        scoring_points = truth.sessions[change.session].scoring_points
        returns = np.column_stack([scoring_points.scans(rows), scoring_points.pixels(rows)]).astype(np.int32)
        partner = -1 if change.partner is None else place[change.partner]
        points = to_map(change.session, scoring_points.points_odom[rows].astype(np.float64), merge)
        objects.append(ChangedObject(change.session, change.kind, place[change.id], returns, points, 1.0, partner))
    return tuple(objects)


def true_report(pair: Path, merge: np.ndarray) -> ChangeReport:
    """The truth in the form of an answer: one region at each centroid, keyframes scored by nearness to a change."""
    truth = load_ground_truth(pair)
    odom_T_world = truth.before.odom_T_sensor[0] @ invert(truth.before.world_T_sensor[0])
    n = len(truth.pair.changes)
    positions = truth.before.world_T_sensor[:, :3, 3]
    distances = np.linalg.norm(positions[:, None] - truth.centroids_world[None], axis=2)
    regions = ChangeRegions(
        centres_map=transform(odom_T_world, truth.centroids_world),
        radius_m=2.0,
        scores=np.linspace(1.0, 0.5, n),
        pairs=np.zeros((n, 2), dtype=np.int64),
        is_reported=np.ones(n, dtype=np.bool_),
        keyframe_scores=-distances.min(axis=1, initial=100.0),
    )
    return ChangeReport(
        before_T_after=merge,
        evidence={"map_points_before": 123.0},
        regions=regions,
        objects=true_objects(truth, merge),
        seconds={
            "t_index_s": 0.5,
            "t_merge_s": 1.0,
            "t_refine_s": 0.25,
            "t_descriptor_s": 2.8,
            "t_cd_s": 0.3,
            "t_oe_s": 0.06,
        },
        figures={"v_sphere_m3": np.arange(n, dtype=np.float64)},
        keyframe_scans=(np.arange(14), np.arange(14)),
    )


def scored(pair: Path, report: ChangeReport) -> CaseScore:
    write_answer(pair.parent / "answer", "test-method", report)
    return score_stored(load_ground_truth(pair), pair.parent / "answer")


def test_the_truth_as_answer_scores_exactly_one(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    case = scored(tiny_pair, true_report(tiny_pair, tiny_merge))
    assert {name: case.row[name] for name in ONES} == dict.fromkeys(ONES, 1.0)
    assert case.row["merge_error_m"] == pytest.approx(0.0, abs=1e-9)
    assert case.row["merge_error_deg"] == pytest.approx(0.0, abs=1e-5)
    assert case.row["n_merge_pairs"] == 14
    assert (case.row["n_observable"], case.row["n_found_changes"], case.row["n_false_regions"]) == (3, 3, 0)
    assert [row["outcome"] for row in case.objects] == ["match"] * 3
    assert [row["is_kind_right"] for row in case.changes] == [1.0] * 3
    assert [row["n_truth_cells"] for row in case.changes] == [row["n_cells"] for row in case.objects]


def mix_columns(session: Path, columns: list[int]) -> None:
    """Make all returns of some columns of a session mixed."""
    for index, (instance, change) in enumerate(list(read_labels(session, read_session(session).n_chunks))):
        is_mixed = instance >= 0
        is_mixed[:, :, [column for column in range(is_mixed.shape[2]) if column not in columns]] = False
        write_labels(session, index, instance, np.where(is_mixed, MIXED, change).astype(np.int16))


def naming_also(report: ChangeReport, added: list[tuple[int, int]]) -> ChangeReport:
    """Add returns to the first object of a report."""
    first, *others = report.objects
    returns = np.concatenate([first.returns, np.array(added, np.int32).reshape(-1, 2)])
    return replace(report, objects=(replace(first, returns=returns), *others))


def test_mixed_returns_in_an_answer_are_neither_right_nor_wrong(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    # Thing 1 is seen in columns 4 to 13 of scans 2 to 4. Its right rim and the wall beside it are mixed.
    n_cells = len(load_ground_truth(tiny_pair).change_rows[0])
    mix_columns(tiny_pair / "after", [12, 13, 14])
    report = true_report(tiny_pair, tiny_merge)
    assert n_cells > len(load_ground_truth(tiny_pair).change_rows[0]) > 0
    mixed = [(scan, row * 64 + column) for scan in range(2, 5) for row in range(4) for column in (12, 13, 14)]
    plain, with_tail = scored(tiny_pair, report), scored(tiny_pair, naming_also(report, mixed))
    assert {name: plain.row[name] for name in ONES} == dict.fromkeys(ONES, 1.0)
    np.testing.assert_equal(with_tail.row, plain.row)
    np.testing.assert_equal(with_tail.changes, plain.changes)
    assert [row["n_cells"] for row in with_tail.objects] == [row["n_cells"] for row in plain.objects]
    # a middling answer gets no better by them: half of the thing, and as many returns of the wall
    first = report.objects[0]
    wall = [(scan, 2 * 64 + column) for scan in range(2, 5) for column in range(15, 20)]
    half = replace(report, objects=(replace(first, returns=first.returns[::2]), *report.objects[1:]))
    poor = scored(tiny_pair, naming_also(half, wall))
    assert 0.0 < poor.changes[0]["iou_point"] < 0.6
    np.testing.assert_equal(scored(tiny_pair, naming_also(half, wall + mixed)).row, poor.row)
    # an ordinary return of the wall is wrong
    assert scored(tiny_pair, naming_also(report, wall[:1])).row["object_iou_point"] < 1.0


def test_an_object_of_mixed_returns_alone_is_no_false_object(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    mix_columns(tiny_pair / "after", [20, 21, 22])
    report = true_report(tiny_pair, tiny_merge)
    mixed = [(scan, row * 64 + column) for scan in range(14) for row in range(4) for column in (20, 21, 22)]
    wall = [(5, 2 * 64 + 30)]
    tail = replace(report.objects[0], returns=np.array(mixed, np.int32), region=-1, kind="added", partner=-1)
    for returns, outcome, precision in ((mixed, "ignored", 1.0), (mixed + wall, "false", 0.75), (wall, "false", 0.75)):
        objects = (*report.objects, replace(tail, returns=np.array(returns, np.int32)))
        case = scored(tiny_pair, replace(report, objects=objects))
        assert case.objects[3]["outcome"] == outcome
        assert case.row["object_precision_50"] == precision
        assert case.objects[3]["n_cells"] == (0 if returns == mixed else 1)


def test_the_row_has_the_promised_columns_and_the_items_lead_back_to_it(
    tiny_pair: Path, tiny_merge: np.ndarray
) -> None:
    case = scored(tiny_pair, true_report(tiny_pair, tiny_merge))
    assert sorted(case.row) == sorted(COLUMNS)
    assert case.row["metrics_version"] == METRICS_VERSION
    assert (case.row["family"], case.row["seed"], case.row["preset"]) == ("test", 7, "test-method")
    assert np.mean([row["iou_point"] for row in case.changes]) == case.row["object_iou_point"]
    assert sum(row["outcome"] == "true" for row in case.regions) == case.row["n_true_regions"]
    assert len(case.keyframes) == 14
    assert "world_T_object" not in case.changes[0]
    json.dumps([case.row, case.changes, case.regions, case.objects, case.keyframes])


def test_times_and_sizes_by_hand(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    row = scored(tiny_pair, true_report(tiny_pair, tiny_merge)).row
    assert row["t_descriptor_per_keyframe_s"] == pytest.approx(0.1)
    assert row["t_cd_per_region_s"] == pytest.approx(0.1)
    assert row["t_oe_per_region_s"] == pytest.approx(0.02)
    assert row["t_total_s"] == pytest.approx(3.16)
    assert (row["t_index_s"], row["t_merge_s"], row["t_refine_s"]) == (0.5, 1.0, 0.25)
    assert row["t_total_with_merge_s"] == pytest.approx(4.91)
    assert row["t_total_paper_s"] == pytest.approx(0.36)
    assert row["v_sphere_m3"] == 1.0
    assert np.isnan(row["v_oe_m3"])
    assert row["map_points_before"] == 123.0
    assert np.isnan(row["map_points_after"])
    assert row["after_path_m"] == pytest.approx(13 * 1.5)


def test_figures_are_means_over_the_reported_regions(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report = true_report(tiny_pair, tiny_merge)
    some = replace(report.regions, is_reported=np.array([False, True, True]))
    figures = {"v_sphere_m3": np.array([np.nan, 3.0, 4.0]), "v_oe_m3": np.array([9.0, 1.0, np.nan])}
    row = scored(tiny_pair, replace(report, regions=some, figures=figures)).row
    assert (row["v_sphere_m3"], row["v_oe_m3"]) == (3.5, 1.0)


def test_coverage_is_by_the_spheres_of_the_answer(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    row = scored(tiny_pair, true_report(tiny_pair, tiny_merge)).row
    truth = load_ground_truth(tiny_pair)
    middles = np.array([(1.5 * step + 0.75, 0.0, 1.0) for step in range(13)])
    distances = np.linalg.norm(middles[:, None] - truth.centroids_world[None], axis=2).min(axis=1)
    # spheres of 2 m, though regions are judged at 3 m
    assert row["region_coverage"] == pytest.approx(np.mean(distances <= 2.0))
    assert 0 < row["region_coverage"] < np.mean(distances <= 3.0)


def test_centroids_are_true_places_even_when_the_odometry_drifts(write_tiny_pair: Callable[..., Path]) -> None:
    pair = write_tiny_pair(stretch=1.05)
    truth = load_ground_truth(pair)
    for change, rows, centroid in zip(truth.pair.changes, truth.change_rows, truth.centroids_world, strict=True):
        session = truth.sessions[change.session]
        scans = {scan.index: scan for scan in open_session(pair / change.session).scans()}
        places = []
        for index, pixel in zip(session.scoring_points.scans(rows), session.scoring_points.pixels(rows), strict=True):
            scan = scans[int(index)]
            point = scan.points_sensor[scan.pixels == pixel]
            places.append(transform(session.world_T_sensor[index], point)[0])
        np.testing.assert_allclose(centroid, np.mean(places, axis=0), atol=1e-5)


def test_a_false_region_by_hand(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report = true_report(tiny_pair, tiny_merge)
    regions = report.regions
    far = np.concatenate([regions.centres_map[:2], regions.centres_map[2:] + np.array([0.0, 0.0, 50.0])])
    case = scored(tiny_pair, replace(report, regions=replace(regions, centres_map=far)))
    assert [row["outcome"] for row in case.regions].count("false") == 1
    assert case.row["region_precision"] == 2 / 3
    assert case.row["region_recall"] == 2 / 3
    assert case.row["false_regions_per_100m"] == pytest.approx(100 / 19.5)


def test_withdrawn_regions_count_before_and_not_after(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    # the three regions of the truth, a false one above the threshold, and one that is below it
    report = true_report(tiny_pair, tiny_merge)
    centres = report.regions.centres_map
    far = centres[:1] + np.array([0.0, 0.0, 50.0])
    regions = replace(
        report.regions,
        centres_map=np.concatenate([centres, far, far]),
        scores=np.array([1.0, 0.9, 0.8, 0.7, 0.1]),
        pairs=np.zeros((5, 2), dtype=np.int64),
        is_reported=np.array([True, True, False, False, False]),
        is_withdrawn=np.array([False, False, True, True, False]),
    )
    case = scored(tiny_pair, replace(report, regions=regions, objects=(), figures={}))
    rates = ("region_recall", "region_precision", "false_regions_per_100m")
    assert [case.row[name] for name in rates] == pytest.approx([2 / 3, 1.0, 0.0])
    assert [case.row[f"{name}_proposed"] for name in rates] == pytest.approx([1.0, 3 / 4, 100 / 19.5])
    assert (case.row["n_regions"], case.row["n_withdrawn"], case.row["n_false_regions"]) == (2, 2, 0)
    assert [row["is_withdrawn"] for row in case.regions] == [False, False, True, True, False]
    assert [row["outcome"] for row in case.regions][2:] == ["unreported"] * 3
    # time was spent on what was withdrawn as well
    assert case.row["t_oe_per_region_s"] == pytest.approx(0.06 / 4)
    # K = 3: the third that stands finds nothing, the third that was proposed finds the change withdrawn with it
    assert (case.row["region_recall_at_k"], case.row["region_recall_at_k_proposed"]) == (2 / 3, 1.0)
    # where nothing is ever withdrawn, before is after
    plain = scored(tiny_pair, report).row
    assert [plain[f"{name}_proposed"] for name in rates] == [plain[name] for name in rates]
    assert plain["n_withdrawn"] == 0


def test_the_row_of_a_region_says_whether_it_is_looked_at_whatever_the_threshold(
    tiny_pair: Path, tiny_merge: np.ndarray
) -> None:
    report = true_report(tiny_pair, tiny_merge)
    forced = replace(report.regions, is_forced=np.array([True, False, True]))
    case = scored(tiny_pair, replace(report, regions=forced))
    assert [row["is_forced"] for row in case.regions] == [True, False, True]


def test_displacement_and_volume_are_in_the_row_and_the_items(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    # every thing of the tiny pair stands at the world's origin, has 1 m3, and "moved" by nothing
    report = true_report(tiny_pair, tiny_merge)
    box = ObjectShape(np.eye(4), np.array([1.0, 1.0, 1.2]), 1.2)
    objects = [replace(item, shape=box) for item in report.objects]
    objects[1] = replace(objects[1], displacement_map=np.array([0.0, 0.0, 0.1]))
    objects[2] = replace(objects[2], displacement_map=np.array([0.3, 0.0, 0.0]))
    case = scored(tiny_pair, replace(report, objects=tuple(objects)))
    np.testing.assert_allclose([row["displacement_error_m"] for row in case.changes], [np.nan, 0.1, 0.3])
    np.testing.assert_allclose([row["volume_error_share"] for row in case.changes], 0.2)
    assert case.row["displacement_error_m"] == pytest.approx(0.2)
    assert np.isnan(case.row["pile_volume_error"])
    np.testing.assert_allclose([row["moved_m"] for row in case.objects], [np.nan, 0.1, 0.3])
    assert [row["volume_m3"] for row in case.objects] == [1.2] * 3
    bare = scored(tiny_pair, report)
    assert np.isnan([bare.row["displacement_error_m"], bare.objects[0]["volume_m3"]]).all()


def test_an_empty_keyframe_list_may_be_of_any_type(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report = true_report(tiny_pair, tiny_merge)
    whole, floats = (
        scored(tiny_pair, replace(report, keyframe_scans=(np.zeros(0, t), np.zeros(0, t)))).row
        for t in (np.int64, np.float64)
    )
    np.testing.assert_equal(floats, whole)
    assert {name: floats[name] for name in ONES} == dict.fromkeys(ONES, 1.0)
    with pytest.raises(InputError, match="after_keyframe_scans: expected the whole"):
        scored(tiny_pair, replace(report, keyframe_scans=(np.zeros(0), np.array([0.5, 1.5, 2.5]))))


def without_objects_and_regions(report: ChangeReport) -> ChangeReport:
    nothing = replace(
        report.regions,
        centres_map=np.zeros((0, 3)),
        scores=np.zeros(0),
        pairs=np.zeros((0, 2), dtype=np.int64),
        is_reported=np.zeros(0, dtype=np.bool_),
        keyframe_scores=np.zeros(14),
    )
    return replace(report, regions=nothing, objects=(), figures={})


def test_an_empty_answer_scores_zero(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    row = scored(tiny_pair, without_objects_and_regions(true_report(tiny_pair, tiny_merge))).row
    zeros = [name for name in ONES if name not in ("region_auroc", "region_ap", "static_accuracy")]
    assert {name: row[name] for name in zeros} == dict.fromkeys(zeros, 0.0)
    assert (row["region_auroc"], row["region_coverage"]) == (0.5, 0.0)
    assert np.isnan(row["t_cd_per_region_s"])


def test_a_refused_case_scores_zero_and_has_the_times_of_its_merge(tiny_pair: Path) -> None:
    folder = tiny_pair.parent / "answer"
    seconds = {"t_index_s": 0.25, "t_merge_s": 0.5}
    write_failure(folder, "paper", "merge_refused", "overlap too small", {"overlap": 0.1}, {}, seconds=seconds)
    case = score_stored(load_ground_truth(tiny_pair), folder)
    empty = scored(tiny_pair, without_objects_and_regions(true_report(tiny_pair, np.eye(4)))).row
    # an empty answer calls every point unchanged, a case without an answer calls none anything
    expected = {name: empty[name] for name in ONES} | {"static_accuracy": 0.0}
    assert {name: case.row[name] for name in ONES} == expected
    assert (case.row["region_auroc"], case.row["keyframe_coverage"], case.row["is_auroc_assumed"]) == (0.5, 0.0, 1.0)
    assert [row["label"] for row in case.keyframes].count(1) > 0
    undefined = ("false_regions_per_100m", "merge_error_m", "t_total_s", "t_refine_s", "region_coverage")
    assert np.isnan([case.row[name] for name in (*undefined, "t_total_with_merge_s")]).all()
    assert (case.row["t_index_s"], case.row["t_merge_s"]) == (0.25, 0.5)
    assert (case.row["status"], case.row["error"]) == ("merge_refused", "overlap too small")
    assert sorted(case.row) == sorted(COLUMNS)
    assert [row["is_found"] for row in case.changes] == [False] * 3
    assert (case.regions, case.objects) == ([], [])


NOT_OF_THE_MERGE = [name for name in COLUMNS if name.startswith(("region_", "object_", "kind_", "false_regions"))]
NOT_OF_THE_MERGE += [name for name in COLUMNS if name.startswith("n_") and name.endswith(("_regions", "_objects"))]
NOT_OF_THE_MERGE += ["n_regions", "n_objects", "n_found_changes", "n_matched", "n_partial", "is_alarm"]
NOT_OF_THE_MERGE += [
    "keyframe_coverage",
    "is_auroc_assumed",
    "n_withdrawn",
    "displacement_error_m",
    "pile_volume_error",
]


def test_what_a_plan_made_from_the_pair_itself_may_lie_anywhere(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    right = true_report(tiny_pair, tiny_merge)
    elsewhere = tuple(replace(each, points_map=each.points_map + 40.0) for each in right.objects)
    folder = tiny_pair.parent / "answer"
    write_answer(folder, "test-method", replace(right, objects=elsewhere))
    truth = load_ground_truth(tiny_pair)
    with pytest.raises(InputError, match=r"3 of 3 objects do not lie where object_returns says"):
        score_stored(truth, folder)
    case = score_stored(truth, folder, may_end_early=True)
    assert (case.row["status"], case.row["n_found_changes"]) == ("ok", 3)


@pytest.mark.parametrize("until", [None, "merge"])
def test_a_score_says_which_columns_metrics_of_others_made(
    tiny_pair: Path, tiny_merge: np.ndarray, until: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eval.scoring.scoring.compute_plugin_columns", lambda *_: {"mine": 1.0, "other": 2.0})
    report = without_objects_and_regions(true_report(tiny_pair, tiny_merge))
    write_answer(tiny_pair.parent / "answer", "test-method", report, until)
    case = score_stored(load_ground_truth(tiny_pair), tiny_pair.parent / "answer", may_end_early=True)
    assert case.plugins == {"mine", "other"} and (case.row["mine"], case.row["other"]) == (1.0, 2.0)


@pytest.mark.parametrize("has_changes", [True, False])
def test_an_answer_that_ends_at_the_merge_is_scored_up_to_it(
    write_tiny_pair: Callable[..., Path], tiny_merge: np.ndarray, has_changes: bool
) -> None:
    pair = write_tiny_pair(has_changes=has_changes)
    report = without_objects_and_regions(true_report(pair, tiny_merge))
    folder = pair.parent / "answer"
    write_answer(folder, "test-method", report, "merge")
    # a plan alone may end a method early: another program would leave out what it cannot do
    with pytest.raises(InputError, match=r"answer\.json: until = 'merge': a plan alone"):
        score_stored(load_ground_truth(pair), folder)
    case = score_stored(load_ground_truth(pair), folder, may_end_early=True)
    assert case.row["status"] == "ok"
    assert np.isnan([case.row[name] for name in NOT_OF_THE_MERGE]).all()
    assert case.row["merge_error_m"] == pytest.approx(0.0, abs=1e-9)
    assert (case.row["t_merge_s"], case.row["n_merge_pairs"]) == (1.0, 14)
    assert (case.row["n_changes"], case.row["n_observable"]) == ((3, 3) if has_changes else (0, 0))
    assert (case.changes, case.regions, case.objects, case.keyframes) == ([], [], [], [])
    assert sorted(case.row) == sorted(COLUMNS)
    write_failure(folder, "paper", "merge_refused", "too smooth", {"overlap": 0.1}, {}, "merge")
    refused = score_stored(load_ground_truth(pair), folder, may_end_early=True)
    assert (refused.row["status"], refused.row["error"]) == ("merge_refused", "too smooth")
    assert np.isnan([refused.row[name] for name in (*NOT_OF_THE_MERGE, "merge_error_m", "t_merge_s")]).all()
    assert (refused.row["evidence_overlap"], refused.changes) == (0.1, [])


def test_a_local_merge_is_scored_at_every_metre(write_tiny_pair: Callable[..., Path], tiny_merge: np.ndarray) -> None:
    # both odometries stretch the way by 1 %, so that one transform fits; keyframe k is put 0.1 k m too high, and each
    # place takes the transform of the keyframe nearest along the path
    pair = write_tiny_pair(stretch=1.01)
    report = true_report(pair, tiny_merge)
    keyframes = np.array([2, 3, 7])
    local = np.repeat(tiny_merge[None], 3, axis=0)
    local[:, 2, 3] += 0.1 * keyframes
    named = replace(report, keyframe_scans=(np.arange(14), keyframes))
    assert scored(pair, named).row["merge_error_m"] == pytest.approx(0.0, abs=1e-9)
    row = scored(pair, replace(named, local_before_T_after=local)).row
    errors_m = 0.1 * np.array([2, 2, 2, 3, 3, 3, 7, 7, 7, 7, 7, 7, 7, 7])
    assert row["merge_error_m"] == pytest.approx(np.median(errors_m))
    assert row["merge_error_m_p95"] == pytest.approx(np.percentile(errors_m, 95))
    assert row["n_merge_pairs"] == 14


def test_evidence_is_in_the_row_whatever_came_of_the_merge(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report = replace(true_report(tiny_pair, tiny_merge), evidence={"agreement": 0.9, "residual_m": np.nan, "own": 3.0})
    row = scored(tiny_pair, report).row
    assert row["evidence_agreement"] == 0.9
    assert np.isnan([row["evidence_residual_m"], row["evidence_overlap"]]).all()
    assert "evidence_own" not in row


def test_the_true_overlap_is_there_whatever_the_status(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    assert scored(tiny_pair, true_report(tiny_pair, tiny_merge)).row["overlap_true"] == 1.0
    write_failure(tiny_pair.parent / "answer", "paper", "failed", "", {}, {})
    assert score_stored(load_ground_truth(tiny_pair), tiny_pair.parent / "answer").row["overlap_true"] == 1.0


def test_parts_of_the_merge_that_are_not_stated_are_undefined_and_so_is_the_sum(
    tiny_pair: Path, tiny_merge: np.ndarray
) -> None:
    report = true_report(tiny_pair, tiny_merge)
    seconds = {name: value for name, value in report.seconds.items() if name != "t_index_s"}
    row = scored(tiny_pair, replace(report, seconds=seconds)).row
    assert np.isnan([row["t_index_s"], row["t_total_with_merge_s"]]).all()
    assert (row["t_merge_s"], row["t_refine_s"], row["t_total_s"]) == (1.0, 0.25, pytest.approx(3.16))


def test_an_unchanged_pair(write_tiny_pair: Callable[..., Path], tiny_merge: np.ndarray) -> None:
    pair = write_tiny_pair(has_changes=False)
    report = true_report(pair, tiny_merge)
    silent = scored(pair, report).row
    assert silent["is_unchanged_pair"] is True
    assert silent["is_alarm"] is False
    assert silent["false_regions_per_100m"] == 0.0
    assert np.isnan([silent[name] for name in ONES if name != "static_accuracy"]).all()
    assert silent["static_accuracy"] == 1.0
    regions = replace(
        report.regions,
        centres_map=np.zeros((1, 3)),
        scores=np.ones(1),
        pairs=np.zeros((1, 2), dtype=np.int64),
        is_reported=np.ones(1, dtype=np.bool_),
    )
    loud = scored(pair, replace(report, regions=regions, figures={})).row
    assert loud["is_alarm"] is True
    assert loud["region_precision"] == 0.0
    write_failure(pair.parent / "refused", "paper", "merge_refused", "", {}, {})
    refused = score_stored(load_ground_truth(pair), pair.parent / "refused").row
    assert np.isnan(refused["is_alarm"])
    assert np.isnan(refused["region_recall"])


def test_every_change_says_how_large_how_near_and_how_familiar_it_is(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    case = scored(tiny_pair, true_report(tiny_pair, tiny_merge))
    truth = load_ground_truth(tiny_pair)
    for index, row in enumerate(case.changes):
        # the tiny pair puts every thing 2.5 m from the sensor of each scan that sees it
        assert row["range_m"] == pytest.approx(2.5, abs=1e-3)
        assert row["seen_hull_volume_m3"] == pytest.approx(ConvexHull(truth.points_odom(index)).volume)
        assert row["is_in_distribution"] is False
    assert case.row["domain"] == "out"
    evidence = {"bytes_map_before": 1200.0, "bytes_regions_before": 284.0}
    row = scored(tiny_pair, replace(true_report(tiny_pair, tiny_merge), evidence=evidence)).row
    assert (row["bytes_map_before"], row["bytes_regions_before"]) == (1200.0, 284.0)


@pytest.mark.parametrize(
    ("family", "kind", "domain", "is_familiar"),
    [
        ("narrow", "box", "in", True),
        ("null/wide", "box", "in", True),
        ("network", "trolley", "in", False),
        ("narrow", "mesh", "in", False),
        ("cave", "box", "out", False),
        ("regions/cave", "railing", "out", False),
        ("paper/site1", "box", "out", False),
        ("smooth", "box", "out", False),
        ("mine/narrow", "box", "out", False),
        ("dynamic/narrow", "box", "out", False),  # nothing was trained or tuned on movers
    ],
)
def test_what_is_in_distribution(family: str, kind: str, domain: str, is_familiar: bool) -> None:
    assert domain_of(family) == domain
    assert is_change_in_distribution(family, kind) is is_familiar


def make_foreign(folder: Path, points_odom: list[np.ndarray]) -> None:
    """Turn a stored answer into one that gives points instead of returns and names no keyframes."""
    with np.load(folder / "answer.npz") as archive:
        arrays = {name: archive[name] for name in archive.files if not name.startswith("object_return")}
    arrays["object_points_odom"] = np.concatenate(points_odom)
    arrays["object_point_odom_offsets"] = np.cumsum([0, *map(len, points_odom)])
    arrays["before_keyframe_scans"] = arrays["after_keyframe_scans"] = np.zeros(0, dtype=np.int64)
    np.savez(folder / "answer.npz", **arrays)


def own_points(report: ChangeReport) -> list[np.ndarray]:
    """The points of each object in the odom frame of its own session."""
    frames = {"before": np.eye(4), "after": invert(report.before_T_after)}
    return [transform(frames[item.session], item.points_map) for item in report.objects]


def test_a_foreign_answer_of_points_is_scored_alike(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report = true_report(tiny_pair, tiny_merge)
    own = scored(tiny_pair, report).row
    folder = tiny_pair.parent / "answer"
    # 1 mm off: neighbouring cells of the tiny pair are farther than 0.1 m apart
    make_foreign(folder, [points + 0.001 for points in own_points(report)])
    foreign = score_stored(load_ground_truth(tiny_pair), folder).row
    assert {name: foreign[name] for name in ONES} == {name: own[name] for name in ONES}
    assert foreign["n_merge_pairs"] == 14
    assert np.isnan(foreign["n_keyframes_before"])


def test_foreign_points_that_are_not_numbers_or_have_two_owners_are_refused(
    tiny_pair: Path, tiny_merge: np.ndarray
) -> None:
    report = true_report(tiny_pair, tiny_merge)
    folder = tiny_pair.parent / "answer"
    write_answer(folder, "foreign", report)
    points = own_points(report)
    make_foreign(folder, [points[0], points[1], np.concatenate([points[2], points[0][:1]])])
    with pytest.raises(InputError, match="one owner at most"):
        score_stored(load_ground_truth(tiny_pair), folder)
    points[1][0, 2] = np.nan
    write_answer(folder, "foreign", report)
    make_foreign(folder, points)
    with pytest.raises(InputError, match=r"objects\[1\]: object_points_odom: entry 0 "):
        score_stored(load_ground_truth(tiny_pair), folder)


def with_returns(report: ChangeReport, *returns: tuple[int, int]) -> ChangeReport:
    first = replace(report.objects[0], returns=np.array(returns, dtype=np.int32))
    return replace(report, objects=(first, *report.objects[1:]))


def broken(name: str, report: ChangeReport) -> ChangeReport:
    regions, objects = report.regions, report.objects
    nan_merge = report.before_T_after.copy()
    nan_merge[0, 3] = np.nan
    local = np.repeat(report.before_T_after[None], 14, axis=0)
    far_local = local.copy()
    far_local[3, 1, 3] = 1e9
    bent = local.copy()
    bent[4, :3, :3] *= 1.01
    nan_centres = regions.centres_map.copy()
    nan_centres[1, 0] = np.nan
    return {
        "twice": lambda: with_returns(report, (3, 70), (3, 70)),
        "two objects": lambda: replace(report, objects=(*objects, replace(objects[0], partner=-1))),
        "scan": lambda: with_returns(report, (14, 0)),
        "pixel": lambda: with_returns(report, (0, 256)),
        "negative": lambda: with_returns(report, (0, -1)),
        "merge": lambda: replace(report, before_T_after=nan_merge),
        "local": lambda: replace(report, local_before_T_after=local[:13]),
        "local of every scan": lambda: replace(
            report, local_before_T_after=local[:2], keyframe_scans=(np.arange(14), np.zeros(0, dtype=np.int64))
        ),
        "bent": lambda: replace(report, local_before_T_after=bent),
        "flat": lambda: replace(report, local_before_T_after=local[0]),
        "evidence": lambda: replace(report, evidence={"overlap": "high"}),
        "infinite bytes": lambda: replace(report, evidence={"bytes_regions_before": np.inf}),
        "negative bytes": lambda: replace(report, evidence={"bytes_map_before": -1.0}),
        "endless": lambda: replace(report, seconds={"t_cd_s": 1e308, "t_oe_s": 1e308}),
        "far merge": lambda: replace(report, before_T_after=make_pose(translation=(1e300, 0.0, 0.0))),
        "far local": lambda: replace(report, local_before_T_after=far_local),
        "far centre": lambda: replace(report, regions=replace(regions, centres_map=regions.centres_map + 1e8)),
        "far points": lambda: replace(report, objects=(replace(objects[0], points_map=np.full((1, 3), -1e8)),)),
        "huge figure": lambda: replace(report, figures={"v_sphere_m3": np.full(3, 1e200)}),
        "object score": lambda: replace(report, objects=(replace(objects[0], score=np.inf),)),
        "seconds": lambda: replace(report, seconds={"t_cd_s": None}),
        "centre": lambda: replace(report, regions=replace(regions, centres_map=nan_centres)),
        "score": lambda: replace(report, regions=replace(regions, scores=np.full(3, np.nan))),
        "radius": lambda: replace(report, regions=replace(regions, radius_m=float("nan"))),
        "keyframe": lambda: replace(report, keyframe_scans=(np.arange(14) + 1, np.arange(14))),
        "keyframe scores": lambda: replace(report, regions=replace(regions, keyframe_scores=np.zeros(3))),
        "kind": lambda: replace(report, objects=(replace(objects[0], kind="vanished"),)),
        "session": lambda: replace(report, objects=(replace(objects[0], session="later"),)),
        "partner": lambda: replace(report, objects=(replace(objects[0], partner=5),)),
        "region": lambda: replace(report, objects=(replace(objects[0], region=3),)),
        "figure": lambda: replace(report, figures={"v_sphere_m3": np.zeros(2)}),
    }[name]()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("twice", r"\(scan 3, pixel 70\)"),
        ("two objects", "of the after session twice"),
        ("scan", r"objects\[0\] .*\(scan 14, pixel 0\).* 14 scans"),
        ("pixel", r"\(scan 0, pixel 256\).* 256 pixels"),
        ("negative", r"pixel -1\), outside"),
        ("merge", r"before_T_after\[0\] "),
        ("local", "local_before_T_after has 13 poses: .* 14 "),
        ("local of every scan", "has 2 poses: .* 14 scans"),
        ("bent", r"local_before_T_after\[4\] "),
        ("flat", r"local_before_T_after must be \(Ka, 4, 4\), got \(4, 4\)"),
        ("evidence", "evidence.overlap = 'high': "),
        ("seconds", "seconds.t_cd_s = None: "),
        ("infinite bytes", "evidence.bytes_regions_before = inf: expected 0 to 1e.15"),
        ("negative bytes", "evidence.bytes_map_before = -1.0: "),
        ("endless", r"seconds.t_cd_s = 1e\+308: expected 0 to 1e\+08 s"),
        ("far merge", r"before_T_after: entry 0 is farther than 1e\+07 m"),
        ("far local", "local_before_T_after: entry 3 is farther"),
        ("far centre", "region_centres_map: entry 0 is farther"),
        ("far points", r"objects\[0\]: object_points_map: entry 0 is farther"),
        ("huge figure", "figure_v_sphere_m3: expected numbers from 0"),
        ("object score", r"objects\[0\].score = inf: "),
        ("centre", "region_centres_map: entry 1 "),
        ("score", "region_scores: entry 0 "),
        ("radius", "radius_m = nan"),
        ("keyframe", "before_keyframe_scans .*1 to 14.*0 to 13"),
        ("keyframe scores", "keyframe_scores has 3 entries: .* 14"),
        ("kind", r"objects.0.kind = 'vanished': .*'added'"),
        ("session", r"objects.0.session = 'later'"),
        ("partner", r"objects\[0\].partner = 5: "),
        ("region", r"objects\[0\].region = 3: "),
        ("figure", r"figure_v_sphere_m3 must be \(3\), got \(2,\)"),
    ],
)
def test_answers_that_cannot_be_are_refused_in_one_line(
    tiny_pair: Path, tiny_merge: np.ndarray, name: str, message: str
) -> None:
    report = broken(name, true_report(tiny_pair, tiny_merge))
    with pytest.raises(InputError, match=message) as error:
        scored(tiny_pair, report)
    assert "\n" not in str(error.value)
    assert str(tiny_pair.parent / "answer") in str(error.value)


def test_a_pair_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="only simulated pairs have truth"):
        score_stored(load_ground_truth(tmp_path), tmp_path)


def test_scoring_writes_nothing_into_the_pair(tiny_pair: Path, tmp_path: Path) -> None:
    write_failure(tmp_path / "answer", "nothing", "failed", "none", {}, {})
    before = {path: path.stat().st_mtime_ns for path in (tiny_pair, *tiny_pair.rglob("*"))}
    assert score(tmp_path / "answer", tiny_pair)["region_recall"] == 0
    assert {path: path.stat().st_mtime_ns for path in (tiny_pair, *tiny_pair.rglob("*"))} == before
