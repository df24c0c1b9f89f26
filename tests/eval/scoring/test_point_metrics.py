"""Static, dynamic and associated accuracy by hand, of answers and of cases without one."""

import math

import numpy as np
import pytest

from eval.scoring.point_metrics import score_points, score_unanswered_points
from tests.eval.changes import change
from tests.eval.scoring.test_object_metrics import ground_truth, span, thing

NAMES = ("static_accuracy", "dynamic_accuracy", "associated_accuracy")
# 40 points after: 10 of change 1, 10 of change 2
LABELS = [0] * 5 + [1] * 10 + [0] * 5 + [2] * 10 + [0] * 10


def approx(static: float, dynamic: float) -> dict[str, float]:
    values = (static, dynamic, math.sqrt(static * dynamic))
    return pytest.approx(dict(zip(NAMES, values, strict=True)), nan_ok=True)


def test_an_empty_answer_calls_everything_static_and_no_answer_is_right_nowhere() -> None:
    truth = ground_truth([change(1), change(2)], after=LABELS)
    assert score_points((), (), truth) == approx(1.0, 0.0)
    assert score_unanswered_points(truth) == dict.fromkeys(NAMES, 0.0)


def test_where_nothing_changed_the_unchanged_points_alone_are_asked() -> None:
    truth = ground_truth([])
    assert score_points((), (), truth) == approx(1.0, math.nan)
    assert score_unanswered_points(truth) == pytest.approx(dict(zip(NAMES, (0.0, math.nan, math.nan), strict=True)),
                                                           nan_ok=True)  # fmt: skip


def test_where_everything_changed_no_static_point_is_asked() -> None:
    truth = ground_truth([change(1)], before=[1] * 40, after=[1] * 40)
    found = score_points([thing()], [span(0, 10)], truth)
    assert math.isnan(found["static_accuracy"])
    assert math.isnan(found["associated_accuracy"])
    # of the change's session alone
    assert found["dynamic_accuracy"] == 10 / 40


def test_partial_and_unobservable_changes_are_left_out() -> None:
    for other in (change(2, group="partial"), change(2, is_observable=False)):
        truth = ground_truth([change(1), other], after=LABELS)
        # 60 static points, 10 dynamic ones; the object holds 2 static ones, 5 of change 1 and 10 of change 2
        found = score_points([thing()], [np.concatenate([span(10, 17), span(20, 30)])], truth)
        assert found == approx(58 / 60, 5 / 10)


def test_a_point_that_two_objects_hold_counts_once_and_each_session_has_its_own_points() -> None:
    truth = ground_truth([change(1), change(2)], after=LABELS)
    twice = score_points([thing(), thing()], [span(3, 9), span(5, 12)], truth)
    once = score_points([thing()], [span(3, 12)], truth)
    assert twice == once == approx(58 / 60, 7 / 20)
    # the same rows of the before session are points of rock
    assert score_points([thing("before")], [span(3, 12)], truth) == approx(51 / 60, 0.0)


def test_calling_everything_changed_leaves_nothing_right_that_did_not() -> None:
    truth = ground_truth([change(1), change(2)], after=LABELS)
    found = score_points([thing(), thing("before")], [span(0, 40), span(0, 40)], truth)
    assert found == approx(0.0, 1.0)


def test_a_changed_label_of_the_other_session_is_no_dynamic_point() -> None:
    # a label 1 among the points of before, while change 1 is of after: neither static nor dynamic there
    truth = ground_truth([change(1), change(2, "before")], before=[1] * 4 + [2] * 6 + [0] * 30, after=LABELS)
    found = score_points([thing("before")], [span(0, 10)], truth)
    assert found == approx(1.0, 6 / 16)
