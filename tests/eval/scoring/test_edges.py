"""Edges of the definitions, each with an answer or a truth on which a nearly right metric would be wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose, stream
from eval.scoring.answer_rows import find_rows_near_points
from eval.scoring.merge_metrics import _along, compute_merge_errors, find_travel_directions, measure_overlap
from eval.scoring.object_metrics import compute_box_iou, judge_kinds, match_objects
from eval.scoring.region_metrics import measure_covered_share, transform_to_map, transform_to_world
from eval.truth.ground_truth import SessionTruth, ground_truth, load_ground_truth
from eval.truth.scoring_points import ScoringPoints
from tests.eval.changes import change
from tests.eval.scoring.test_object_metrics import ground_truth as object_truth
from tests.eval.scoring.test_object_metrics import moved_pair, span, thing
from tests.eval.scoring.test_region_metrics import EMPTY
from tests.eval.scoring.test_scoring import scored, true_report


def at(*places: tuple[float, float, float]) -> np.ndarray:
    return np.stack([make_pose(translation=place) for place in places])


# a shaft: the robot is twice at the same place in plan, 6 m apart in height; odometry is 0.1 and 1 m off up there
SHAFT = at((0.0, 0.0, 0.0), (3.0, 0.0, 3.0), (0.0, 0.0, 6.0))
SHAFT_ODOM = at((0.0, 0.0, 0.0), (3.0, 0.0, 3.0), (0.1, 0.0, 7.0))


def test_the_nearest_place_is_nearest_in_height_as_well() -> None:
    before = SessionTruth(SHAFT_ODOM, SHAFT, EMPTY)
    assert before.judged_scans.tolist() == [0, 1, 2]
    # in plan, each centre lies nearer to the place on the other level
    centres_map = np.array([(0.1, 0.0, 0.0), (0.0, 0.0, 7.0)])
    places_world = np.array([(0.1, 0.0, 0.0), (-0.1, 0.0, 6.0)])
    np.testing.assert_allclose(transform_to_world(centres_map, before), places_world)
    np.testing.assert_allclose(transform_to_map(places_world, before), centres_map)


def test_a_merge_is_judged_against_the_place_that_is_nearest_in_height_as_well() -> None:
    before = SessionTruth(SHAFT_ODOM, SHAFT, EMPTY)
    after = SessionTruth(SHAFT, SHAFT, EMPTY)
    errors = compute_merge_errors(before, after, np.eye(4))
    # at the top, the before odometry is off and the after odometry is right
    np.testing.assert_allclose(errors.metres, [0.0, 0.0, np.hypot(0.1, 1.0)], atol=1e-12)
    # 5 m are 5 m in any direction
    for height_m, n_pairs in ((4.9, 1), (5.0, 1), (5.1, 0)):
        above = at((0.0, 0.0, 6.0 + height_m))
        errors = compute_merge_errors(before, SessionTruth(above, above, EMPTY), np.eye(4))
        assert [len(part) for part in (errors.metres, errors.degrees, errors.along_m)] == [n_pairs] * 3


@pytest.mark.parametrize(("height_m", "share"), [(4.9, 1.0), (5.0, 1.0), (5.1, 0.0)])
def test_a_level_above_overlaps_only_within_five_metres(height_m: float, share: float) -> None:
    level = at((0.0, 0.0, 0.0), (10.0, 0.0, 0.0))
    assert measure_overlap(level, level + make_pose(translation=(0, 0, height_m)) - np.eye(4)) == share


def test_coverage_is_of_reported_regions_alone(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    report = true_report(tiny_pair, tiny_merge)
    first = replace(report.regions, is_reported=np.array([True, False, False]))
    alone = replace(
        report.regions,
        centres_map=report.regions.centres_map[:1],
        scores=np.ones(1),
        pairs=np.zeros((1, 2), np.int64),
        is_reported=np.ones(1, np.bool_),
    )
    without = replace(report, objects=(), figures={})
    coverage = [
        scored(tiny_pair, replace(without, regions=regions)).row["region_coverage"]
        for regions in (report.regions, first, alone)
    ]
    assert coverage[1] == coverage[2] < coverage[0]


def test_a_change_that_no_row_belongs_to_is_not_observable(tiny_pair: Path) -> None:
    truth = load_ground_truth(tiny_pair)
    unseen = replace(
        truth.pair.changes[0], id=9, partner=None, world_T_object=make_pose(translation=(7, 8, 9)).tolist()
    )
    more = ground_truth(replace(truth.pair, changes=(*truth.pair.changes, unseen)), truth.sessions)
    assert unseen.is_observable
    assert more.is_observable.tolist() == [*truth.is_observable.tolist(), False]
    assert more.n_observable == truth.n_observable == 3
    np.testing.assert_allclose(more.centroids_world[3], (7, 8, 9))


def test_a_half_of_a_move_that_names_no_partner_is_wrong_where_the_other_half_was_missed() -> None:
    truth = moved_pair()
    objects = [thing("after", "moved", -1)]
    matches = match_objects(objects, [span(20, 30)], truth)
    assert matches.matched_object.tolist() == [-1, 0]
    right = judge_kinds(objects, matches, truth)
    assert np.isnan(right[0])
    assert right[1] == 0.0


def test_the_middle_of_a_step_at_exactly_the_radius_is_covered() -> None:
    x_m = np.arange(41) * 0.25
    positions = np.column_stack([x_m, np.zeros(41), np.zeros(41)])
    sphere = np.array([(2.0, 0.0, 0.0)])
    # the middles at 1.875 and 2.125 m
    assert measure_covered_share(positions, x_m, sphere, np.array([0.125])) == 2 / 40
    assert measure_covered_share(positions, x_m, sphere, np.nextafter([0.125], 0.0)) == 0.0


@pytest.mark.parametrize(
    ("length_m", "middles_m"),
    [(0.0, []), (0.05, [0.025]), (0.1, [0.05]), (0.25, [0.25 / 6, 0.125, 1.25 / 6])],
)
def test_a_path_is_cut_into_equal_steps_of_at_most_a_tenth_of_a_metre(length_m: float, middles_m: list[float]) -> None:
    # two thirds of the way along x, the last third along z; a robot at rest at either end adds nothing
    corner, end = (length_m * 2 / 3, 1.0, 2.0), (length_m * 2 / 3, 1.0, 2.0 + length_m / 3)
    found = _along(at((0.0, 1.0, 2.0), (0.0, 1.0, 2.0), corner, end, end))
    on_x = np.minimum(middles_m, length_m * 2 / 3)
    np.testing.assert_allclose(found[:, 0], on_x, atol=1e-12)
    np.testing.assert_allclose(found[:, 2] - 2.0, middles_m - on_x, atol=1e-12)
    assert found.shape == (len(middles_m), 3) and (found[:, 1] == 1.0).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_direction_of_travel_equals_its_slow_twin(seed: int) -> None:
    draw = stream(seed, "travel")
    # steps of 0, 1/8 or 1/2 m along the axes, so that chords end exactly half a metre away
    steps = np.eye(3)[draw.integers(0, 3, 40)] * draw.choice([0.0, 0.125, 0.5], 40)[:, None]
    places = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    found = find_travel_directions(at(*(tuple(place) for place in places)))
    for index in range(len(places)):
        behind = [k for k in range(len(places)) if along[k] <= along[index] - 0.5] or [0]
        ahead = [k for k in range(len(places)) if along[k] >= along[index] + 0.5] or [len(places) - 1]
        chord = places[ahead[0]] - places[behind[-1]]
        np.testing.assert_allclose(found[index], chord / np.linalg.norm(chord), atol=1e-12)


def test_an_object_with_exactly_half_of_its_rows_elsewhere_is_false() -> None:
    # cells 20 to 29 are on a change that nobody could see
    hidden = change(1, is_observable=False)
    truth = object_truth([hidden], after=[0] * 20 + [1] * 10 + [0] * 10)
    matches = match_objects([thing(), thing()], [span(15, 25), span(14, 25)], truth)
    assert matches.outcomes == ("false", "false")
    assert match_objects([thing()], [span(16, 25)], truth).outcomes == ("ignored",)
    assert (matches.matched_object.tolist(), matches.matched_change.tolist()) == ([-1], [-1, -1])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rows_at_exactly_the_radius_belong_to_a_point(axis: int) -> None:
    cells = np.zeros((3, 3), dtype=np.float32)
    cells[:, axis] = (-0.25, 0.25, 0.2501)
    zeros = np.zeros(3, dtype=np.int16)
    (near,) = find_rows_near_points(ScoringPoints(np.arange(3), cells, zeros, zeros, 1, 3), [np.zeros((1, 3))], 0.25)
    assert near.tolist() == [0, 1]


@pytest.mark.parametrize("n_points", [(0, 0), (0, 1)])
def test_an_object_without_points_has_no_rows(n_points: tuple[int, int]) -> None:
    scoring_points = ScoringPoints(np.arange(1), np.zeros((1, 3), np.float32), *[np.zeros(1, np.int16)] * 2, 1, 1)
    rows = find_rows_near_points(scoring_points, [np.zeros((n, 3)) for n in n_points])
    assert [len(own) for own in rows] == list(n_points)
    assert [own.dtype for own in rows] == [np.int64] * 2


def test_the_box_of_one_point_is_a_cell() -> None:
    one = np.array([(0.05, 0.05, 0.05)])
    assert compute_box_iou(one, one) == 1.0
    # two cells in a row, one of them shared
    assert compute_box_iou(one, np.concatenate([one, one + np.array([0.1, 0.0, 0.0])])) == pytest.approx(0.5)


@pytest.mark.parametrize(("kind", "expected"), [("removed", 1.0), ("moved", 1.0), ("added", 0.0), ("reshaped", 0.0)])
def test_what_went_may_be_called_removed_where_nobody_could_see_it_arrive(kind: str, expected: float) -> None:
    halves = [change(1, "before", "moved", partner=2), change(2, "after", "moved", partner=1, is_observable=False)]
    truth = object_truth(halves, before=[1] * 10 + [0] * 30, after=[0] * 20 + [2] * 10 + [0] * 10)
    objects = [thing("before", kind)]
    right = judge_kinds(objects, match_objects(objects, [span(0, 10)], truth), truth)
    assert right[0] == expected
    assert np.isnan(right[1])


def test_changes_may_be_numbered_in_any_order() -> None:
    labels = [0] * 5 + [1] * 10 + [2] * 10 + [3] * 10 + [0] * 5
    truth = object_truth([change(3), change(1), change(2)], after=labels)
    matches = match_objects([thing(), thing(), thing()], [span(5, 15), span(15, 25), span(25, 35)], truth)
    assert matches.matched_object.tolist() == [2, 0, 1]
    assert matches.iou_point.tolist() == [1.0, 1.0, 1.0]


def test_one_cell_answered_by_one_cell_is_a_whole_match() -> None:
    matches = match_objects([thing()], [span(5, 6)], object_truth([change(1)], after=[0] * 5 + [1] + [0] * 34))
    assert matches.iou_point.tolist() == [1.0]
