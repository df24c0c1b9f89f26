"""One answer to one pair in memory: every column of every table, worked out by hand."""

from __future__ import annotations

import json
import math
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from cdpipe.io.answer import Answer
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, ObjectShape
from eval.scoring import scoring
from eval.scoring.answer_check import MAX_AMOUNT, check_answer
from eval.scoring.judged_places import carry_merge, carry_scores, find_nearest_keyframes
from eval.scoring.merge_metrics import EVIDENCE
from eval.scoring.region_metrics import score_regions, score_unanswered_regions
from eval.scoring.scoring import METRICS_VERSION, CaseScore, score, score_answer
from eval.truth.ground_truth import GroundTruth, SessionTruth, ground_truth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import PairTruth
from tests.eval.changes import change
from tests.eval.scoring.test_scoring import scored, true_report

NAN = float("nan")
CUBE = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
POSES = np.stack([make_pose(translation=(float(x), 0.0, 0.0)) for x in range(51)])


def cube_at(x_m: float) -> np.ndarray:
    return CUBE + np.array([x_m, 0.0, 0.0])


def session(cube_x_m: float, change_id: int, nearest_m: tuple[float, ...]) -> SessionTruth:
    """Scan 2 saw the corners of a cube of a change as pixels 0 to 7, and four places of the wall."""
    walls = np.array([(30.0 + i, 2.0, 0.0) for i in range(4)])
    points = ScoringPoints(
        returns=2 * 12 + np.arange(12),
        points_odom=np.concatenate([cube_at(cube_x_m), walls]).astype(np.float32),
        change=np.array([change_id] * 8 + [0] * 4, dtype=np.int16),
        instance=np.zeros(12, dtype=np.int16),
        n_scans=51,
        n_pixels=12,
        nearest_m=np.array(nearest_m, dtype=np.float32),
    )
    return SessionTruth(POSES, POSES, points)


SCENARIO = {
    "props": [], "before": {"odometry": {"source": "kiss-icp"}}, "after": {"odometry": {"source": "drift"}},
    "sensor": {"profile": "os1-32"},
}  # fmt: skip


@pytest.fixture(name="truth")
def truth_fixture() -> GroundTruth:
    """A box that came at x = 5 to 6, a pile that went at x = 20 to 21, and one that nobody could see at x = 49."""
    changes = (
        change(1, "after", "added", name="crate", hull_volume_m3=0.9, mesh_volume_m3=0.8),
        change(2, "before", "removed", name="heap", prop_kind="muck_pile", hull_volume_m3=2.0),
        change(3, "after", "added", is_observable=False, world_T_object=make_pose(translation=(49, 0, 0)).tolist()),
    )
    sessions = {"before": session(20.0, 2, (np.inf, np.inf, 3.5)), "after": session(5.0, 1, (np.inf, 2.5))}
    return ground_truth(PairTruth("narrow", 7, 3.0, changes, SCENARIO), sessions)


def pixels(first: int, end: int) -> np.ndarray:
    return np.array([(2, pixel) for pixel in range(first, end)], dtype=np.int32)


@pytest.fixture(name="report")
def report_fixture() -> ChangeReport:
    # best first: withdrawn and right; right; again the same; false; on the unseen change; withdrawn and false; not said
    x_m = (20.0, 5.5, 6.0, 35.0, 49.0, 28.0, 12.0)
    regions = ChangeRegions(
        centres_map=np.array([(x, 0.5, 0.5) for x in x_m]),
        radius_m=2.0,
        scores=np.linspace(7.0, 1.0, 7),
        pairs=np.zeros((7, 2), dtype=np.int64),
        is_reported=np.array([False, True, True, True, True, False, False]),
        keyframe_scores=np.where(np.arange(51) <= 40, -np.arange(51.0), np.nan),
        is_withdrawn=np.array([True, False, False, False, False, True, False]),
    )
    crate = ChangedObject(
        "after", "added", 1, pixels(0, 8), cube_at(5.0), 2.5,
        shape=ObjectShape(np.eye(4), np.ones(3), 1.0), displacement_map=np.array([0.0, 3.0, 4.0]),
    )  # fmt: skip
    half = ChangedObject(
        "before", "added", 0, pixels(0, 4), cube_at(20.0)[:4], 1.5,
        shape=ObjectShape(np.eye(4), np.ones(3), 1.5),
    )  # fmt: skip
    wall = ChangedObject("after", "added", -1, pixels(8, 12), np.zeros((0, 3)), 0.5)
    return ChangeReport(
        before_T_after=make_pose(translation=(0.3, 0.4, 0.0)),
        evidence={"overlap": 0.75, "map_points_before": 11.0, "map_points_after": 13.0, "bytes_map_before": 17.0,
                  "bytes_regions_before": 19.0, "residual_m": np.inf},
        regions=regions,
        objects=(crate, half, wall),
        seconds={"t_index_s": 1.0, "t_merge_s": 2.0, "t_refine_s": 4.0, "t_descriptor_s": 8.0, "t_cd_s": 16.0,
                 "t_oe_s": 32.0, "t_returns_s": 64.0},
        figures={"v_sphere_m3": np.array([9.0, 1.0, 2.0, 3.0, 4.0, 9.0, 9.0]), "s_points": np.full(7, NAN),
                 "asked_points": np.arange(7.0)},
        keyframe_scans=(np.arange(51), np.arange(0, 51, 2)),
    )  # fmt: skip


@pytest.fixture(name="case")
def case_fixture(report: ChangeReport, truth: GroundTruth) -> CaseScore:
    used = {"3deg": "ab", "sphere": "cd"}
    return score_answer(Answer("ok", "", "mine", report, report.seconds, report.evidence, checkpoints=used), truth)


def assert_equal(found: dict[str, Any], expected: dict[str, Any]) -> None:
    assert list(found) == list(expected)
    numbers = {name: value for name, value in expected.items() if isinstance(value, float)}
    assert {name: found[name] for name in numbers} == pytest.approx(numbers, nan_ok=True, rel=1e-6, abs=1e-9)
    others = {name: value for name, value in expected.items() if name not in numbers}
    assert {name: (type(found[name]), found[name]) for name in others} == {
        name: (type(value), value) for name, value in others.items()
    }


def test_the_row(case: CaseScore) -> None:
    # places within 3 m of a centroid, 0.7 m aside of the path, and those farther than 4.5 m from every change
    near = [x for x in range(51) if min(np.hypot(x - c, np.hypot(0.5, 0.5)) for c in (5.5, 20.5)) <= 3.0]
    far = [
        x for x in range(51) if all(np.linalg.norm([x - c, y, y]) > 4.5 for c, y in ((5.5, 0.5), (20.5, 0.5), (49, 0)))
    ]
    assert (near, far[:3], far[-1]) == ([3, 4, 5, 6, 7, 8, 18, 19, 20, 21, 22, 23], [0, 1, 10], 44)
    beaten = sum((x < y and x <= 40) or (x <= 40 < y) for x in near for y in far)
    ranked = sorted(near + [y for y in far if y <= 40])
    precisions = [sum(x in near for x in ranked[: n + 1]) / (n + 1) for n, x in enumerate(ranked) if x in near]
    expected = {
        "scenario": "narrow", "family": "narrow", "pair_kind": "", "seed": 7, "variant": "mine", "preset": "mine",
        "status": "ok", "error": "", "metrics_version": METRICS_VERSION, "domain": "in", "n_changes": 3,
        "n_observable": 2, "score_radius_m": 3.0, "odometry_before": "kiss-icp",
        "odometry_after": "drift", "sensor_profile": "os1-32", "checkpoints": "3deg ab;sphere cd", "extras": "",
        # one of two is found by what stands, both by what was proposed
        "region_recall": 0.5, "region_precision": 0.5, "false_regions_per_100m": 2.0,
        "region_recall_proposed": 1.0, "region_precision_proposed": 0.5, "false_regions_per_100m_proposed": 4.0,
        "region_recall_at_k": 0.5, "region_recall_at_k_proposed": 1.0,
        "region_auroc": beaten / (len(near) * len(far)), "region_ap": float(np.mean(precisions)),
        "keyframe_coverage": 41 / 51, "is_auroc_assumed": 0.0,
        # middles of steps within 2 m of (x, 0.5, 0.5), so 1.87 m along the path: 4 to 7.5, 33.5 to 36.5, 47.5 to 49.5
        "region_coverage": (4 + 4 + 3) / 50,
        "n_regions": 4, "n_withdrawn": 2, "n_true_regions": 1, "n_false_regions": 1, "n_duplicate_regions": 1,
        "n_ignored_regions": 1, "n_found_changes": 1,
        "false_regions_on_movers_per_100m": NAN, "n_false_regions_on_movers": 0,
        # the crate whole, and half of the heap
        "object_iou_point": 0.75, "object_iou_voxel": 0.75, "object_iou_box": (1 + 0.1 / 1.1) / 2,
        "object_f1_25": 2 / 2.5, "object_f1_50": 2 / 2.5, "object_precision_50": 2 / 3, "object_pq": 1.5 / 2.5,
        "kind_accuracy": 0.5, "n_objects": 3, "n_matched": 2, "n_ignored_objects": 0, "n_partial": 0,
        # 4 of 8 points of walls are called changed; 8 of the crate's and 4 of the heap's 16 are
        "object_iou_point_partial": NAN, "static_accuracy": 0.5, "dynamic_accuracy": 0.75,
        "associated_accuracy": (0.5 * 0.75) ** 0.5, "displacement_error_m": NAN, "pile_volume_error": 0.25,
        "merge_error_m": 0.5, "merge_error_m_p95": 0.5, "merge_error_deg": 0.0, "merge_error_deg_p95": 0.0,
        "merge_error_along_m": 0.3, "merge_error_along_m_p95": 0.3, "n_merge_pairs": 51, "overlap_true": 1.0,
        **{f"evidence_{name}": 0.75 if name == "overlap" else NAN for name in EVIDENCE},
        "t_index_s": 1.0, "t_merge_s": 2.0, "t_refine_s": 4.0, "t_descriptor_s": 8.0,
        "t_descriptor_per_keyframe_s": 8.0 / (51 + 26), "t_cd_s": 16.0, "t_cd_per_region_s": 16.0 / 6, "t_oe_s": 32.0,
        "t_oe_per_region_s": 32.0 / 6, "t_returns_s": 64.0, "t_total_s": 56.0, "t_total_with_merge_s": 63.0,
        "t_total_paper_s": 48.0,
        "v_sphere_m3": 2.5, "v_oe_m3": NAN, "s_points": NAN, "oe_points": NAN,
        "map_points_before": 11.0, "map_points_after": 13.0, "n_keyframes_before": 51, "n_keyframes_after": 26,
        "bytes_map_before": 17.0, "bytes_regions_before": 19.0, "after_path_m": 50.0, "is_unchanged_pair": False,
        "is_alarm": NAN,
    }  # fmt: skip
    assert_equal(case.row, expected)


@pytest.mark.parametrize(
    ("seen_before", "seen_after", "n_false", "rate"),
    [
        ([], [], 0, NAN),
        ([(35.0, 3.5, 0.5)], [], 1, 2.0),  # 3 m from the false region at (35, 0.5, 0.5): the radius
        ([], [(35.0, 3.51, 0.5)], 0, 0.0),
        ([(5.5, 0.5, 0.5)], [(49.0, 0.5, 0.5), (28.0, 0.5, 0.5)], 0, 0.0),  # on true, ignored and withdrawn ones
        ([(34.0, 0.5, 0.5)], [(36.0, 0.5, 0.5)], 1, 2.0),  # seen in both sessions, one region
    ],
)
def test_false_regions_on_movers(
    report: ChangeReport,
    truth: GroundTruth,
    seen_before: list[tuple[float, float, float]],
    seen_after: list[tuple[float, float, float]],
    n_false: int,
    rate: float,
) -> None:
    seen = {"before": seen_before, "after": seen_after}
    sessions = {
        name: replace(of_session, seen_movers_world=np.array(seen[name], dtype=np.float64).reshape(-1, 3))
        for name, of_session in truth.sessions.items()
    }
    columns = score_regions(report, replace(truth, sessions=sessions), np.arange(51.0)).columns
    assert columns["n_false_regions_on_movers"] == n_false
    assert columns["false_regions_on_movers_per_100m"] == pytest.approx(rate, nan_ok=True)
    assert columns["n_false_regions"] == 1


def test_a_case_without_an_answer_has_the_columns_of_one_with_an_answer(
    report: ChangeReport, truth: GroundTruth
) -> None:
    answered = score_regions(report, truth, np.arange(51.0)).columns
    assert set(score_unanswered_regions(truth).columns) == set(answered)


def test_withdrawn_regions_alone_have_no_place_among_the_k_best(report: ChangeReport, truth: GroundTruth) -> None:
    is_withdrawn = np.array([False, False, False, False, False, True, False])
    kept = replace(report, regions=replace(report.regions, is_withdrawn=is_withdrawn))
    assert score_regions(kept, truth, np.arange(51.0)).columns["region_recall_at_k"] == 1.0


def test_without_a_region_none_is_false(report: ChangeReport, truth: GroundTruth) -> None:
    nothing = ChangeRegions(
        np.zeros((0, 3)), 2.0, np.zeros(0), np.zeros((0, 2), np.int64), np.zeros(0, np.bool_), np.zeros(0)
    )
    after = replace(truth.after, seen_movers_world=np.array([(35.0, 0.0, 0.0)]))
    seen = replace(truth, sessions={"before": truth.before, "after": after})
    columns = score_regions(replace(report, regions=nothing), seen, np.arange(51.0)).columns
    assert (columns["n_false_regions_on_movers"], columns["false_regions_on_movers_per_100m"]) == (0, 0.0)


@pytest.mark.parametrize(("path_m", "rate"), [(0.0, NAN), (0.5, 200.0), (1.0, 100.0)])
def test_the_rate_of_false_regions_on_movers_needs_a_path(
    report: ChangeReport, truth: GroundTruth, path_m: float, rate: float
) -> None:
    # the false region lies at x = 35
    after = replace(truth.after, seen_movers_world=np.array([(35.0, 0.0, 0.0)]))
    seen = replace(truth, sessions={"before": truth.before, "after": after})
    columns = score_regions(report, seen, np.linspace(0.0, path_m, 51)).columns
    assert columns["n_false_regions_on_movers"] == 1
    assert columns["false_regions_on_movers_per_100m"] == pytest.approx(rate, nan_ok=True)


def test_the_changes(case: CaseScore) -> None:
    for name, values in {
        "id": [1, 2, 3],
        "name": ["crate", "heap", "thing 3"],
        "is_found": [True, False, True],
        "best_region": [1, -1, 4],
        "iou_point": [1.0, 0.5, NAN],
        "iou_voxel": [1.0, 0.5, NAN],
        "iou_box": [1.0, 0.1 / 1.1, NAN],
        "matched_object": [0, 1, -1],
        "matched_kind": ["added", "added", ""],
        "is_kind_right": [1.0, 0.0, NAN],
        "displacement_error_m": [NAN, NAN, NAN],
        "volume_error_share": [0.25, -0.25, NAN],
        "n_truth_cells": [8, 8, 0],
        "seen_hull_volume_m3": [1.0, 1.0, 0.0],
        "range_m": [2.5, 3.5, NAN],
        "is_in_distribution": [True, True, True],
        "twins": ["", "", ""],
    }.items():
        found = [row[name] for row in case.changes]
        assert list(map(type, found)) == list(map(type, values)), name
        if isinstance(values[0], float):
            assert found == pytest.approx(values, nan_ok=True, abs=1e-6), name
        else:
            assert found == values, name
    own = {"is_found", "best_region", "iou_point", "iou_voxel", "iou_box", "matched_object", "matched_kind"}
    own |= {"is_kind_right", "displacement_error_m", "volume_error_share", "n_truth_cells", "seen_hull_volume_m3"}
    of_change = {name for name in change(1).__dataclass_fields__ if name != "world_T_object"}
    assert set(case.changes[0]) == own | of_change | {"range_m", "is_in_distribution", "twins"}


def test_the_regions(case: CaseScore) -> None:
    outcomes = ["unreported", "true", "duplicate", "false", "ignored", "unreported", "unreported"]
    found = ["2", "1", "1", "", "3", "", ""]
    spheres = [9.0, 1.0, 2.0, 3.0, 4.0, 9.0, 9.0]
    x_m = (20.0, 5.5, 6.0, 35.0, 49.0, 28.0, 12.0)
    for index, row in enumerate(case.regions):
        expected = {
            "region": index, "score": 7.0 - index, "is_reported": index in (1, 2, 3, 4),
            "is_withdrawn": index in (0, 5), "is_forced": False,
            "outcome": outcomes[index], "x_m": x_m[index], "y_m": 0.5, "z_m": 0.5,
            "radius_m": 2.0,
            "found_changes": found[index], "found_changes_proposed": found[index], "v_sphere_m3": spheres[index],
            "v_oe_m3": NAN, "s_points": NAN, "oe_points": NAN, "asked_points": float(index),
        }  # fmt: skip
        assert_equal(row, expected)
    assert len(case.regions) == 7


def test_what_was_proposed_is_judged_where_it_was_proposed(report: ChangeReport, truth: GroundTruth) -> None:
    # the second candidate was proposed 3.5 m aside of its change, the false one on the other change; the last two are
    # neither reported nor withdrawn
    proposed = report.regions.centres_map.copy()
    proposed[1, 0], proposed[3, 0] = 5.5 + 3.5, 20.5
    report = replace(report, regions=replace(report.regions, proposed_centres_map=proposed))
    case = score_answer(Answer("ok", "", "mine", report, report.seconds, report.evidence), truth)
    assert [row["found_changes"] for row in case.regions] == ["2", "1", "1", "", "3", "", ""]
    assert [row["found_changes_proposed"] for row in case.regions] == ["2", "", "1", "2", "3", "", ""]
    assert (case.row["region_recall"], case.row["region_precision"]) == (0.5, 0.5)
    assert (case.row["region_recall_proposed"], case.row["region_precision_proposed"]) == (1.0, 0.5)
    assert case.row["false_regions_per_100m_proposed"] == 4.0  # candidates 1 and 5
    # the two best find one of two where they were proposed; without the withdrawn ones, and centred, one of two
    assert (case.row["region_recall_at_k_proposed"], case.row["region_recall_at_k"]) == (0.5, 0.5)
    assert case.changes[0]["best_region"] == 1


def test_the_objects(case: CaseScore) -> None:
    first = {
        "object": 0, "session": "after", "kind": "added", "region": 1, "score": 2.5, "n_returns": 8, "n_cells": 8,
        "matched_change": 1, "iou_point": 1.0, "outcome": "match", "min_x_m": 5.0, "min_y_m": 0.0, "min_z_m": 0.0,
        "max_x_m": 6.0, "max_y_m": 1.0, "max_z_m": 1.0, "hull_volume_m3": 1.0, "volume_m3": 1.0, "moved_m": 5.0,
    }  # fmt: skip
    second = {
        **first, "object": 1, "session": "before", "region": 0, "score": 1.5, "n_returns": 4, "n_cells": 4,
        "matched_change": 2, "iou_point": 0.5, "min_x_m": 20.0, "max_x_m": 20.0, "hull_volume_m3": 0.0,
        "volume_m3": 1.5, "moved_m": NAN,
    }  # fmt: skip
    corners = dict.fromkeys((f"{end}_{axis}_m" for end in ("min", "max") for axis in "xyz"), NAN)
    third = {
        **first, "object": 2, "region": -1, "score": 0.5, "n_returns": 4, "n_cells": 4, "matched_change": -1,
        "iou_point": 0.0, "outcome": "false", **corners, "hull_volume_m3": 0.0, "volume_m3": NAN, "moved_m": NAN,
    }  # fmt: skip
    assert len(case.objects) == 3
    for row, expected in zip(case.objects, (first, second, third), strict=True):
        assert_equal(row, expected)


def test_the_keyframes(case: CaseScore) -> None:
    assert len(case.keyframes) == 51
    for index in (0, 8, 12, 23, 40, 44, 50):
        label = {0: 0, 8: 1, 12: 0, 23: 1, 40: 0, 44: 0, 50: -1}[index]
        score = -float(index) if index <= 40 else NAN
        assert_equal(case.keyframes[index], {"keyframe": index, "scan": index, "score": score, "label": label})


def test_a_case_without_an_answer(truth: GroundTruth) -> None:
    case = score_answer(
        Answer("failed", "too dark", "mine", None, {"t_merge_s": 2.0, "t_descriptor_s": 8.0}, {"overlap": 0.5}), truth
    )
    zeros = [
        "region_recall", "region_recall_at_k", "region_precision", "region_recall_proposed",
        "region_recall_at_k_proposed", "region_precision_proposed", "object_iou_point", "object_iou_voxel",
        "object_iou_box", "object_f1_25", "object_f1_50", "object_precision_50", "object_pq", "kind_accuracy",
        "keyframe_coverage", "static_accuracy", "dynamic_accuracy", "associated_accuracy",
    ]  # fmt: skip
    counts = [
        "n_regions", "n_withdrawn", "n_true_regions", "n_false_regions", "n_duplicate_regions", "n_ignored_regions",
        "n_found_changes", "n_false_regions_on_movers", "n_objects", "n_matched", "n_ignored_objects", "n_partial",
        "n_merge_pairs",
    ]  # fmt: skip
    # no place has a score: all tie
    n_far = sum(row["label"] == 0 for row in case.keyframes)
    known = {
        "scenario": "narrow", "family": "narrow", "pair_kind": "", "seed": 7, "variant": "mine", "preset": "mine",
        "status": "failed", "error": "too dark", "metrics_version": METRICS_VERSION, "domain": "in", "n_changes": 3,
        "n_observable": 2, "score_radius_m": 3.0, "odometry_before": "kiss-icp",
        "odometry_after": "drift", "sensor_profile": "os1-32", "checkpoints": "", "extras": "",
        "region_auroc": 0.5, "region_ap": 12 / (12 + n_far),
        "is_auroc_assumed": 1.0, "overlap_true": 1.0, "evidence_overlap": 0.5, "t_merge_s": 2.0, "t_descriptor_s": 8.0,
        "after_path_m": 50.0,
        "is_unchanged_pair": False, **dict.fromkeys(zeros, 0.0), **dict.fromkeys(counts, 0),
    }  # fmt: skip
    assert_equal({name: value for name, value in case.row.items() if value == value}, {
        name: known[name] for name in case.row if name in known
    })  # fmt: skip
    assert len(known) + sum(value != value for value in case.row.values()) == len(case.row)
    assert (case.regions, case.objects) == ([], [])
    for found in (score_unanswered_regions(truth).matches, score_unanswered_regions(truth).proposed):
        assert (found.outcomes, found.best_region.tolist()) == ((), [-1, -1, -1])
    for row in case.changes:
        assert (row["is_found"], row["best_region"], row["matched_object"], row["matched_kind"]) == (False, -1, -1, "")
    assert np.isnan([row[name] for row in case.changes for name in ("is_kind_right", "volume_error_share")]).all()
    assert [row["label"] for row in case.keyframes].count(1) == 12
    assert np.isnan([row["score"] for row in case.keyframes]).all()


@pytest.mark.parametrize(
    ("n_regions", "has_changes", "is_alarm"), [(0, False, False), (1, False, True), (0, True, NAN), (1, True, NAN)]
)
def test_an_alarm_is_a_region_on_an_unchanged_pair(
    report: ChangeReport, truth: GroundTruth, n_regions: int, has_changes: bool, is_alarm: float
) -> None:
    if not has_changes:
        truth = ground_truth(replace(truth.pair, changes=()), truth.sessions)
    reported = np.arange(7) < n_regions
    regions = replace(report.regions, is_reported=reported, is_withdrawn=None)
    answer = Answer("ok", "", "mine", replace(report, regions=regions, objects=()), {}, {})
    row = score_answer(answer, truth).row
    assert row["is_unchanged_pair"] is not has_changes
    assert row["is_alarm"] is is_alarm or (np.isnan(is_alarm) and np.isnan(row["is_alarm"]))
    # nothing was proposed: no time for each of them
    assert np.isnan(row["t_cd_per_region_s"])
    ended = score_answer(replace(answer, until="merge", seconds={"t_cd_s": 1.0}), truth)
    assert np.isnan([ended.row["is_alarm"], ended.row["t_cd_per_region_s"]]).all()
    assert (ended.changes, ended.regions, ended.objects, ended.keyframes) == ([], [], [], [])


def test_scores_and_merges_are_carried_to_places_near_on_the_path(report: ChangeReport, truth: GroundTruth) -> None:
    # keyframes at 10 and 20 m: places up to 2.5 m before and after them take their scores
    named = np.array([10, 20])
    some = replace(
        report, keyframe_scans=(named, named), regions=replace(report.regions, keyframe_scores=np.array([5.0, 7.0]))
    )
    expected = np.full(51, NAN)
    expected[8:13], expected[18:23] = 5.0, 7.0
    np.testing.assert_array_equal(carry_scores(some, truth.before), expected)
    nearest, gaps_m = find_nearest_keyframes(truth.after, named)
    assert nearest.tolist() == [0] * 15 + [nearest[15]] + [1] * 35
    np.testing.assert_allclose(gaps_m, np.minimum(np.abs(np.arange(51) - 10), np.abs(np.arange(51) - 20)))
    assert nearest.dtype == np.int64
    local = np.stack([make_pose(translation=(0, 0, z)) for z in (1.0, 2.0)])
    carried = carry_merge(replace(some, local_before_T_after=local), truth.after)
    assert carried[:, 2, 3].tolist() == [float(1 + each) for each in nearest]
    np.testing.assert_array_equal(carry_merge(some, truth.after), report.before_T_after)
    for silent in (None, replace(some, regions=replace(some.regions, keyframe_scores=np.zeros(0)))):
        assert np.isnan(carry_scores(silent, truth.before)).all()
        assert carry_scores(silent, truth.before).shape == (51,)


def test_a_place_where_the_robot_waited_takes_the_keyframe_nearest_in_time() -> None:
    # scans 5 to 25 lie at one place; the path is 5 m, then 5 more
    x_m = np.concatenate([np.arange(5.0), np.full(21, 5.0), np.arange(6.0, 11.0)])
    poses = np.stack([make_pose(translation=(x, 0.0, 0.0)) for x in x_m])
    points = session(0.0, 1, ()).scoring_points
    waiting = SessionTruth(poses, poses, points)
    assert waiting.judged_scans.tolist() == [0, 1, 2, 3, 4, 5, 26, 27, 28, 29, 30]
    nearest, gaps_m = find_nearest_keyframes(waiting, np.array([24, 8]))
    assert nearest.tolist() == [1] * 6 + [0] * 5
    np.testing.assert_allclose(gaps_m, [5, 4, 3, 2, 1, 0, 1, 2, 3, 4, 5])
    # an answer that names no keyframe has one at every scan
    nearest, gaps_m = find_nearest_keyframes(waiting, np.zeros(0, dtype=np.int64))
    assert nearest.tolist() == waiting.judged_scans.tolist()
    assert gaps_m.max() == 0.0


@pytest.mark.parametrize(("path_m", "rate"), [(0.0, NAN), (0.5, 200.0), (200.0, 0.5)])
def test_false_regions_are_counted_per_length_of_the_path(
    report: ChangeReport, truth: GroundTruth, path_m: float, rate: float
) -> None:
    travelled_m = np.linspace(0.0, path_m, 51)
    columns = score_regions(report, truth, travelled_m).columns
    assert columns["false_regions_per_100m"] == pytest.approx(rate, nan_ok=True)
    assert columns["false_regions_per_100m_proposed"] == pytest.approx(2 * rate, nan_ok=True)


def test_a_score_is_carried_two_and_a_half_metres_and_no_farther(report: ChangeReport) -> None:
    poses = np.stack([make_pose(translation=(0.5 * step, 0.0, 0.0)) for step in range(60)])
    before = SessionTruth(poses, poses, session(0.0, 1, ()).scoring_points)
    # the one keyframe stands at 10.5 m, the judged places at 0, 1, 2, ...
    one = replace(report.regions, keyframe_scores=np.array([5.0]))
    carried = carry_scores(replace(report, keyframe_scans=(np.array([21]), np.zeros(0)), regions=one), before)
    assert np.flatnonzero(~np.isnan(carried)).tolist() == [8, 9, 10, 11, 12, 13]


def test_metrics_of_others_add_columns(
    report: ChangeReport, truth: GroundTruth, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = Answer("ok", "", "mine", report, {}, {})
    metrics = {
        "first": lambda truth, answer: {"theirs": np.float32(0.5), "n_theirs": len(answer.report.objects)},
        "second": lambda truth, answer: {"radius": truth.pair.score_radius_m, "undefined": NAN},
    }

    def load(group: str, name: str) -> Any:
        assert group == "tunnelcd.metrics"
        return metrics[name]

    monkeypatch.setattr(scoring, "entry_points", lambda group: metrics if group == "tunnelcd.metrics" else {})
    monkeypatch.setattr(scoring, "load_entry_point", load)
    row = score_answer(answer, truth).row
    assert_equal(
        {name: row[name] for name in list(row)[-4:]}, {"theirs": 0.5, "n_theirs": 3.0, "radius": 3.0, "undefined": NAN}
    )
    assert type(row["theirs"]) is float
    for columns, told in (
        ({"region_recall": 1.0}, "tunnelcd.metrics: 'third': column 'region_recall' exists already"),
        ({"theirs": 1.0}, "tunnelcd.metrics: 'third': column 'theirs' exists already"),
        ({"commit": 1.0}, "tunnelcd.metrics: 'third': column 'commit' exists already"),
        ({"new": "high"}, "tunnelcd.metrics: 'third': column 'new' = 'high': expected a number"),
        ({"new": math.inf}, "tunnelcd.metrics: 'third': column 'new' = inf: expected a number"),
    ):
        metrics["third"] = lambda truth, answer, columns=columns: columns
        with pytest.raises(InputError, match=told):
            score_answer(answer, truth)


def test_a_row_names_the_package_that_made_the_poses(tiny_pair: Path, tiny_merge: np.ndarray, tmp_path: Path) -> None:
    shutil.copytree(tiny_pair, tmp_path / "told")
    path = tmp_path / "told" / "after" / "session.json"
    document = json.loads(path.read_text())
    document["provenance"]["odometry"] = "kiss-icp 9.9"
    path.write_text(json.dumps(document))
    report = replace(true_report(tiny_pair, tiny_merge), config={"method": "ours"}, extras={"py4dgeo": "1.0"})
    assert score(report, tmp_path / "told")["extras"] == "py4dgeo 1.0;kiss-icp 9.9"


def test_a_report_in_memory_scores_like_the_stored_one(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report = replace(true_report(tiny_pair, tiny_merge), config={"method": "ours"}, checkpoints={"3deg": "ab"})
    report = replace(report, extras={"kiss-matcher": "1.0", "py4dgeo": "absent"})
    stored = scored(tiny_pair, report).row
    row = score(report, str(tiny_pair))
    assert (row["variant"], row["preset"]) == ("ours", "ours")
    np.testing.assert_equal(row, {**stored, "variant": "ours", "preset": "ours"})
    np.testing.assert_equal(score(str(tiny_pair.parent / "answer"), tiny_pair), stored)
    assert (row["checkpoints"], row["extras"]) == ("3deg ab", "kiss-matcher 1.0;py4dgeo absent")
    assert score(replace(report, config={"regions": {"source": "sphere"}}), tiny_pair)["variant"] == "sphere"
    unnamed = score(replace(report, config={}), tiny_pair)
    assert (unnamed["variant"], unnamed["status"], unnamed["error"]) == ("", "ok", "")
    assert (unnamed["t_merge_s"], unnamed["map_points_before"]) == (1.0, 123.0)
    with pytest.raises(InputError, match=r"^report: not an answer to this pair: evidence\.overlap"):
        score(replace(report, evidence={"overlap": -1.0}), tiny_pair)


def test_the_first_region_may_find_several_changes(report: ChangeReport, truth: GroundTruth) -> None:
    regions = report.regions
    one = replace(
        regions,
        centres_map=regions.centres_map[1:2],
        scores=np.ones(1),
        pairs=np.zeros((1, 2), np.int64),
        is_reported=np.ones(1, np.bool_),
        is_withdrawn=None,
    )
    near = replace(truth, centroids_world=np.repeat(truth.centroids_world[:1], 3, axis=0))
    figures = {"s_points": np.array([3], dtype=np.int32)}
    answer = Answer("ok", "", "mine", replace(report, regions=one, objects=(), figures=figures), {}, {})
    case = score_answer(answer, near)
    assert [(row["is_found"], row["best_region"]) for row in case.changes] == [(True, 0)] * 3
    assert case.regions[0]["found_changes"] == case.regions[0]["found_changes_proposed"] == "1;2;3"
    assert (type(case.row["s_points"]), case.row["s_points"]) == (float, 3.0)
    assert scoring.read_figure(answer.report, "s_points").dtype == np.float64


def test_a_figure_at_the_limit_is_taken_and_one_above_is_refused(report: ChangeReport, truth: GroundTruth) -> None:
    for value, is_refused in (
        (MAX_AMOUNT, False),
        (0.0, False),
        (np.nextafter(MAX_AMOUNT, np.inf), True),
        (-0.1, True),
    ):
        answer = Answer("ok", "", "mine", replace(report, figures={"s_points": np.full(7, value)}), {}, {})
        with pytest.raises(InputError, match="figure_s_points: expected") if is_refused else nullcontext():
            check_answer(answer, truth, Path("answer"))


def test_a_region_that_asks_for_more_points_than_there_are_pixels_is_refused(
    report: ChangeReport, truth: GroundTruth
) -> None:
    points = truth.sessions["before"].scoring_points
    n_pixels = points.n_scans * points.n_pixels
    for asked, is_refused in ((n_pixels, False), (n_pixels + 1, True)):
        answer = Answer("ok", "", "mine", replace(report, figures={"asked_points": np.full(7, asked)}), {}, {})
        with pytest.raises(InputError, match="figure_asked_points: ") if is_refused else nullcontext():
            check_answer(answer, truth, Path("answer"))


@pytest.mark.parametrize(
    "scenario", [{}, {"before": None, "after": {"odometry": "kiss-icp"}, "sensor": {"profile": None}}]
)
def test_a_part_of_a_scenario_that_is_not_there_has_no_name(scenario: dict[str, Any]) -> None:
    assert set(scoring.describe_recording(scenario).values()) == {""}


@pytest.mark.parametrize(
    ("own", "named"),
    [
        ({}, "os1"),
        ({"after": {"sensor": {"profile": "os0"}}}, "os1 then os0"),
        ({"before": {"sensor": {"profile": "os0"}}, "after": {"sensor": {"profile": "os0"}}}, "os0"),
    ],
)
def test_the_profile_names_both_sensors_where_they_differ(own: dict[str, Any], named: str) -> None:
    assert scoring.describe_recording({"sensor": {"profile": "os1"}, **own})["sensor_profile"] == named
