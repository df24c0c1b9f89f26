"""IoU, matching, instance scores and kinds: hand arithmetic on a row of cells, loops on random sets."""

import itertools

import numpy as np
import pytest

from cdpipe.core.geometry import stream
from cdpipe.model.report import ChangedObject
from eval.scoring.answer_rows import find_rows_near_points
from eval.scoring.object_metrics import (
    compute_box_iou,
    compute_voxel_iou,
    judge_kinds,
    match_best,
    match_objects,
    score_unanswered_objects,
    summarise_objects,
)
from eval.scoring.point_metrics import score_points
from eval.truth.ground_truth import GroundTruth, SessionTruth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import MIXED, Change, PairTruth
from tests.eval.changes import change

N_CELLS = 40
NAN = float("nan")


def line_points(change: list[int]) -> ScoringPoints:
    """One cell every 0.1 m along x: row i is pixel i of the only scan."""
    n = len(change)
    points = np.column_stack([0.05 + 0.1 * np.arange(n), np.full(n, 0.05), np.full(n, 0.05)])
    return ScoringPoints(
        returns=np.arange(n, dtype=np.int64),
        points_odom=points.astype(np.float32),
        change=np.array(change, dtype=np.int16),
        instance=np.zeros(n, dtype=np.int16),
        n_scans=1,
        n_pixels=n,
    )


def ground_truth(changes: list[Change], before: list[int] | None = None, after: list[int] | None = None) -> GroundTruth:
    poses = np.eye(4)[None]
    by_session = {"before": line_points(before or [0] * N_CELLS), "after": line_points(after or [0] * N_CELLS)}
    return GroundTruth(
        pair=PairTruth("test", 0, 4.5, tuple(changes), {}),
        sessions={name: SessionTruth(poses, poses, points) for name, points in by_session.items()},
        change_rows=tuple(by_session[item.session].rows_of_change(item.id) for item in changes),
        centroids_world=np.zeros((len(changes), 3)),
        is_observable=np.array([item.is_observable for item in changes], dtype=np.bool_),
        is_partial=np.array([item.group == "partial" for item in changes], dtype=np.bool_),
    )


def thing(session: str = "after", kind: str = "added", partner: int = -1) -> ChangedObject:
    return ChangedObject(session, kind, 0, np.zeros((0, 2), np.int32), np.zeros((0, 3)), 1.0, partner)


def span(first: int, end: int) -> np.ndarray:
    return np.arange(first, end)


def columns_of(
    truth: GroundTruth, objects: list[ChangedObject], rows: list[np.ndarray]
) -> tuple[dict[str, float], tuple[str, ...]]:
    matches = match_objects(objects, rows, truth)
    return summarise_objects(matches, judge_kinds(objects, matches, truth), truth), matches.outcomes


TWO_THINGS = [0] * 5 + [1] * 10 + [0] * 5 + [2] * 10 + [0] * 10


def test_the_truth_as_answer_scores_exactly_one() -> None:
    truth = ground_truth([change(1), change(2)], after=TWO_THINGS)
    columns, outcomes = columns_of(truth, [thing(), thing()], [span(5, 15), span(20, 30)])
    names = ("iou_point", "iou_voxel", "iou_box", "f1_25", "f1_50", "precision_50", "pq")
    assert [columns[f"object_{name}"] for name in names] == [1.0] * 7
    assert columns["kind_accuracy"] == 1.0
    assert outcomes == ("match", "match")


def test_every_column_by_hand() -> None:
    # change 1 is cells 5-14, answered 8-17: 7 shared of 13. change 2 is cells 20-29, answered 20-22: 3 of 10.
    # a third object at 34-39 lies on nothing.
    truth = ground_truth([change(1), change(2)], after=TWO_THINGS)
    objects = [thing(), thing(kind="moved"), thing()]
    columns, outcomes = columns_of(truth, objects, [span(8, 18), span(20, 23), span(34, 40)])
    assert outcomes == ("match", "match", "false")
    assert columns["object_iou_point"] == pytest.approx((7 / 13 + 3 / 10) / 2)
    # boxes are 0.1 m thick, so lengths decide: 0.7 of 1.3 m and 0.3 of 1.0 m, as for the points
    assert columns["object_iou_box"] == pytest.approx((7 / 13 + 3 / 10) / 2, abs=1e-6)
    # 0.25: both hit, one false; 0.5: one hit, one missed, two false
    assert columns["object_f1_25"] == 2 / (2 + 0.5)
    assert columns["object_f1_50"] == 1 / (1 + 0.5 * 3)
    assert columns["object_precision_50"] == 1 / 3
    assert columns["object_pq"] == pytest.approx((7 / 13) / 2.5)
    assert columns["kind_accuracy"] == 0.5
    assert (columns["n_objects"], columns["n_matched"], columns["n_ignored_objects"]) == (3, 2, 0)


def test_static_dynamic_and_associated_accuracy_by_hand() -> None:
    # as above, with a mixed return and a change that nobody could see: both are neither static nor dynamic
    labels = [0] * 5 + [1] * 10 + [0] * 5 + [2] * 10 + [MIXED] + [3] * 3 + [0] * 6
    truth = ground_truth([change(1), change(2), change(3, is_observable=False)], after=labels)
    objects = [thing(), thing(kind="moved"), thing(), thing("before")]
    found = score_points(objects, [span(8, 18), span(20, 23), span(29, 40), span(0, 4)], truth)
    # of 16 static points after and 40 before, 3 + 6 + 4 are called changed; of 20 dynamic ones 7 + 3 + 1 are
    assert found["static_accuracy"] == 43 / 56
    assert found["dynamic_accuracy"] == 11 / 20
    assert found["associated_accuracy"] == pytest.approx((43 / 56 * 11 / 20) ** 0.5)
    unchanged = score_points([thing()], [span(0, 20)], ground_truth([]))
    assert unchanged["static_accuracy"] == 60 / 80
    assert np.isnan([unchanged["dynamic_accuracy"], unchanged["associated_accuracy"]]).all()


def test_an_empty_answer_scores_zero() -> None:
    truth = ground_truth([change(1), change(2)], after=TWO_THINGS)
    columns, _ = columns_of(truth, [], [])
    names = ("iou_point", "iou_voxel", "iou_box", "f1_25", "f1_50", "pq")
    assert [columns[f"object_{name}"] for name in names] == [0.0] * 6
    # leaving a pair out of the means would pay
    assert (columns["object_precision_50"], columns["kind_accuracy"]) == (0.0, 0.0)


def test_a_case_without_an_answer_scores_zero_in_every_object_column() -> None:
    truth = ground_truth([change(1), change(2, group="partial")], after=TWO_THINGS)
    _, columns = score_unanswered_objects(truth)
    assert {name: value for name, value in columns.items() if not name.startswith("n_")} == {
        "object_iou_point": 0.0,
        "object_iou_voxel": 0.0,
        "object_iou_box": 0.0,
        "object_f1_25": 0.0,
        "object_f1_50": 0.0,
        "object_precision_50": 0.0,
        "object_pq": 0.0,
        "kind_accuracy": 0.0,
        "object_iou_point_partial": 0.0,
    }
    _, unchanged = score_unanswered_objects(ground_truth([]))
    assert all(np.isnan(value) for name, value in unchanged.items() if not name.startswith("n_"))


def test_objects_on_an_unchanged_pair_have_precision_zero_and_no_iou() -> None:
    columns, outcomes = columns_of(ground_truth([]), [thing()], [span(0, 5)])
    assert outcomes == ("false",)
    assert columns["object_precision_50"] == 0.0
    assert all(np.isnan(columns[f"object_{name}"]) for name in ("iou_point", "f1_25", "f1_50", "pq"))


def test_an_answer_in_the_other_session_does_not_match() -> None:
    truth = ground_truth([change(1)], after=TWO_THINGS)
    columns, outcomes = columns_of(truth, [thing("before", "removed")], [span(5, 15)])
    assert columns["object_iou_point"] == 0.0
    assert outcomes == ("false",)


def test_an_object_on_an_unobservable_change_is_ignored() -> None:
    truth = ground_truth([change(1), change(2, is_observable=False)], after=TWO_THINGS)
    columns, outcomes = columns_of(truth, [thing(), thing()], [span(5, 15), span(20, 25)])
    assert outcomes == ("match", "ignored")
    assert columns["object_precision_50"] == columns["object_iou_point"] == 1.0
    assert columns["n_ignored_objects"] == 1


def test_the_partial_group_stands_apart() -> None:
    # the answer to the partial change is poor, a second piece of it is neither match nor false
    truth = ground_truth([change(1), change(2, group="partial", kind="reshaped")], after=TWO_THINGS)
    objects = [thing(), thing(kind="reshaped"), thing()]
    columns, outcomes = columns_of(truth, objects, [span(5, 15), span(20, 24), span(26, 28)])
    assert outcomes == ("match", "match", "ignored")
    assert columns["object_iou_point"] == columns["object_precision_50"] == columns["object_pq"] == 1.0
    assert columns["object_iou_point_partial"] == 0.4
    assert columns["n_partial"] == 1
    assert columns["kind_accuracy"] == 1.0


def test_two_pieces_of_one_change_match_once() -> None:
    truth = ground_truth([change(1)], after=TWO_THINGS)
    columns, outcomes = columns_of(truth, [thing(), thing()], [span(5, 9), span(9, 15)])
    assert outcomes == ("false", "match")
    assert columns["object_iou_point"] == 0.6
    assert columns["object_precision_50"] == 0.5


def test_one_object_over_two_changes_matches_the_better_one() -> None:
    # cells 10-29 hold 5 of change 1 and all of change 2
    truth = ground_truth([change(1), change(2)], after=TWO_THINGS)
    matches = match_objects([thing()], [span(10, 30)], truth)
    assert matches.matched_object.tolist() == [-1, 0]
    np.testing.assert_allclose(matches.iou_point, [0.0, 0.5])


def test_the_order_of_objects_does_not_matter() -> None:
    draw = stream(0, "order")
    truth = ground_truth([change(1), change(2)], after=TWO_THINGS)
    objects = [thing(), thing(kind="moved"), thing(kind="reshaped"), thing("before")]
    rows = [span(8, 18), span(18, 23), span(23, 40), span(0, 7)]
    expected, outcomes = columns_of(truth, objects, rows)
    for _ in range(5):
        order = draw.permutation(4)
        columns, shuffled = columns_of(truth, [objects[i] for i in order], [rows[i] for i in order])
        assert columns == pytest.approx(expected, nan_ok=True)
        assert shuffled == tuple(outcomes[i] for i in order)


def test_an_iou_of_exactly_a_half_is_a_hit_at_a_half() -> None:
    # cells 5-9 of 5-14: 5 of 10
    columns, _ = columns_of(ground_truth([change(1)], after=TWO_THINGS), [thing()], [span(5, 10)])
    assert columns["object_f1_50"] == columns["object_precision_50"] == 1.0
    assert columns["object_pq"] == 0.5


def moved_pair(is_observable: bool = True) -> GroundTruth:
    changes = [
        change(1, "before", "moved", partner=2, is_observable=is_observable),
        change(2, "after", "moved", partner=1),
    ]
    return ground_truth(changes, before=[1] * 10 + [0] * 30, after=[0] * 20 + [2] * 10 + [0] * 10)


@pytest.mark.parametrize(
    ("kinds", "partners", "expected"),
    [
        (("moved", "moved"), (1, 0), [1.0, 1.0]),
        (("moved", "moved"), (-1, -1), [0.0, 0.0]),
        (("moved", "moved"), (1, -1), [1.0, 0.0]),
        (("removed", "added"), (1, 0), [0.0, 0.0]),
        (("moved", "added"), (1, 0), [1.0, 0.0]),
    ],
)
def test_a_move_is_right_with_its_kind_and_its_partner(
    kinds: tuple[str, str], partners: tuple[int, int], expected: list[float]
) -> None:
    truth = moved_pair()
    objects = [thing("before", kinds[0], partners[0]), thing("after", kinds[1], partners[1])]
    matches = match_objects(objects, [span(0, 10), span(20, 30)], truth)
    assert judge_kinds(objects, matches, truth).tolist() == expected


def test_a_move_linked_with_the_wrong_object_is_wrong() -> None:
    truth = moved_pair()
    objects = [thing("before", "moved", 2), thing("after", "moved", 0), thing("after", "moved", 0)]
    matches = match_objects(objects, [span(0, 10), span(20, 30), span(35, 38)], truth)
    assert judge_kinds(objects, matches, truth).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(("kind", "expected"), [("added", 1.0), ("moved", 1.0), ("removed", 0.0), ("reshaped", 0.0)])
def test_half_a_move_may_be_called_what_it_looks_like(kind: str, expected: float) -> None:
    truth = moved_pair(is_observable=False)
    matches = match_objects([thing("after", kind)], [span(20, 30)], truth)
    right = judge_kinds([thing("after", kind)], matches, truth)
    assert np.isnan(right[0])
    assert right[1] == expected


def corner_points(first: int, end: int) -> np.ndarray:
    return np.array([(i + 0.25, 0.25, 0.25) for i in range(first, end)])


def test_voxel_iou_by_hand() -> None:
    # cells 0..3 against 2..5: two shared, six in total, however the grid is shifted
    assert compute_voxel_iou(corner_points(0, 4), corner_points(2, 6), 1.0) == pytest.approx(2 / 6)
    # 0.2 m apart along x: one voxel on a grid at 0, two on a grid shifted by half a voxel
    a, b = np.array([[0.4, 0.25, 0.25]]), np.array([[0.6, 0.25, 0.25]])
    assert compute_voxel_iou(a, b, 1.0) == 0.5
    assert compute_voxel_iou(a, np.zeros((0, 3)), 1.0) == 0.0
    assert np.isnan(compute_voxel_iou(np.zeros((0, 3)), np.zeros((0, 3)), 1.0))


def test_voxel_iou_equals_sets_of_tuples() -> None:
    draw = stream(1, "voxels")
    a, b = draw.uniform(-1, 1, (60, 3)), draw.uniform(-1, 1, (50, 3))
    values = []
    for phase in itertools.product((0.0, 0.2), repeat=3):
        cells_a, cells_b = ({tuple(cell) for cell in np.floor((p + phase) / 0.4)} for p in (a, b))
        values.append(len(cells_a & cells_b) / len(cells_a | cells_b))
    assert compute_voxel_iou(a, b, 0.4) == pytest.approx(np.mean(values), abs=1e-12)


def test_box_iou_by_hand() -> None:
    # with half a cell around them, corners 0 and 1.9 make a cube of 2 m; shifted by 1 m along each axis: 1 of 8 + 8 - 1
    cube = np.array([[0.0, 0.0, 0.0], [1.9, 1.9, 1.9]])
    assert compute_box_iou(cube, cube + 1.0) == pytest.approx(1 / 15)
    assert compute_box_iou(cube, cube) == 1.0
    assert compute_box_iou(cube, cube + 5.0) == 0.0
    assert compute_box_iou(cube, np.zeros((0, 3))) == 0.0
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    assert compute_box_iou(flat, flat) == 1.0


@pytest.mark.parametrize("seed", range(10))
def test_matching_equals_trying_every_assignment(seed: int) -> None:
    draw = stream(seed, "matching")
    iou = draw.random((4, 5)) * (draw.random((4, 5)) < 0.6)
    assignments = itertools.permutations(range(5), 4)
    best = max(sum(iou[row, column] for row, column in enumerate(columns)) for columns in assignments)
    pairs = match_best(iou)
    assert sum(iou[pair] for pair in pairs) == pytest.approx(best)
    assert all(iou[pair] > 0 for pair in pairs)
    assert len({row for row, _ in pairs}) == len({column for _, column in pairs}) == len(pairs)


@pytest.mark.parametrize("seed", range(5))
def test_point_iou_equals_python_sets(seed: int) -> None:
    draw = stream(seed, "iou")
    labels = draw.integers(0, 4, N_CELLS).tolist()
    truth = ground_truth([change(number) for number in (1, 2, 3)], after=labels)
    owners = draw.integers(0, 4, N_CELLS)
    rows = [np.flatnonzero(owners == number) for number in (1, 2, 3)]
    matches = match_objects([thing()] * 3, rows, truth)
    for index, matched in enumerate(matches.matched_object):
        true = {row for row, label in enumerate(labels) if label == index + 1}
        answered = set(rows[matched].tolist()) if matched >= 0 else set()
        assert matches.iou_point[index] == pytest.approx(len(true & answered) / len(true | answered))


def test_rows_near_points_by_hand() -> None:
    scoring_points = line_points([0] * 6)  # cells at x = 0.05, 0.15, ... 0.55
    points = scoring_points.points_odom.astype(np.float64)
    # exactly on cell 1: its neighbours are 0.1 m away and within reach up to rounding, the next are not
    near = find_rows_near_points(scoring_points, [points[1:2]], radius_m=0.1001)
    assert near[0].tolist() == [0, 1, 2]
    # two objects compete for cells 2 and 3: each keeps the nearer one
    near = find_rows_near_points(scoring_points, [points[1:2] + np.array([0.04, 0, 0]), points[4:5]], radius_m=0.19)
    assert [rows.tolist() for rows in near] == [[0, 1, 2], [3, 4, 5]]
    assert [len(rows) for rows in find_rows_near_points(scoring_points, [np.zeros((0, 3)), points[:1] + 50.0])] == [
        0,
        0,
    ]
    assert find_rows_near_points(scoring_points, []) == []


def test_rows_near_points_equal_brute_force() -> None:
    draw = stream(2, "near")
    points = draw.uniform(0, 1, (400, 3)).astype(np.float32)
    zeros = np.zeros(400, dtype=np.int16)
    scoring_points = ScoringPoints(np.arange(400), points, zeros, zeros, 1, 400)
    objects = [draw.uniform(0, 1, (20, 3)), draw.uniform(0.3, 0.8, (30, 3)), draw.uniform(0, 0.5, (5, 3))]
    every, owners = np.concatenate(objects), np.repeat([0, 1, 2], [20, 30, 5])
    distances = np.linalg.norm(points[:, None].astype(np.float64) - every[None], axis=2)
    owner = np.where(distances.min(axis=1) <= 0.1, owners[distances.argmin(axis=1)], -1)
    for index, rows in enumerate(find_rows_near_points(scoring_points, objects)):
        assert rows.tolist() == np.flatnonzero(owner == index).tolist()


@pytest.mark.parametrize("fields", [{"is_observable": False}, {"group": "partial"}])
def test_an_object_is_excused_only_by_more_than_half_of_its_rows(fields: dict[str, object]) -> None:
    # change 2, cells 20-29, is outside of the main group
    truth = ground_truth([change(1), change(2, **fields)], after=TWO_THINGS)

    def is_excused(rows: np.ndarray) -> bool:
        return bool(match_objects([thing()], [rows], truth).is_excused[0])

    assert not is_excused(np.append(span(30, 40), 29))  # ten of wall, one of change 2
    assert not is_excused(span(25, 35))  # half and half
    assert is_excused(span(25, 34))  # five of nine
    # what it has of change 1 weighs no more than wall
    assert is_excused(np.concatenate([span(5, 9), span(25, 30)]))
    assert not is_excused(np.zeros(0, dtype=np.int64))


def test_an_object_of_wall_that_touches_an_unobservable_change_is_false() -> None:
    truth = ground_truth([change(1), change(2, is_observable=False)], after=TWO_THINGS)
    columns, outcomes = columns_of(truth, [thing(), thing()], [span(5, 15), span(29, 40)])
    assert outcomes == ("match", "false")
    assert (columns["object_precision_50"], columns["n_ignored_objects"]) == (0.5, 0)


@pytest.mark.parametrize(
    ("rows", "is_excused"),
    [(span(4, 5), True), (span(4, 6), True), (span(4, 7), False), (span(0, 0), False)],
)
def test_an_object_of_mixed_returns_alone_counts_neither_for_nor_against(rows: np.ndarray, is_excused: bool) -> None:
    truth = ground_truth([change(1)], after=[1, 1, 1, 1, MIXED, MIXED] + [0] * (N_CELLS - 6))
    matches = match_objects([thing(), thing()], [span(0, 4), rows], truth)
    assert matches.is_excused.tolist() == [False, is_excused]
    assert matches.iou_point.tolist() == [1.0]
