"""AUROC and average precision against hand arithmetic and the definitions written out as loops."""

import itertools

import numpy as np
import pytest

from cdpipe.core.geometry import stream
from cdpipe.core.ranking import auroc, average_precision, last_of_ties


def auroc_by_pairs(scores: np.ndarray, is_positive: np.ndarray) -> float:
    wins = [
        1.0 if high > low else 0.5 if high == low else 0.0
        for high, low in itertools.product(scores[is_positive], scores[~is_positive])
    ]
    return float(np.mean(wins))


def average_precision_by_thresholds(scores: np.ndarray, is_positive: np.ndarray) -> float:
    total, recall_before = 0.0, 0.0
    for threshold in sorted(set(scores), reverse=True):
        above = scores >= threshold
        recall = (above & is_positive).sum() / is_positive.sum()
        total += (above & is_positive).sum() / above.sum() * (recall - recall_before)
        recall_before = recall
    return total


def test_auroc_by_hand() -> None:
    # positives 0.9 and 0.4 against negatives 0.5 and 0.4: wins 1, 1, 0 and a tie: 2.5 of 4
    assert auroc(np.array([0.9, 0.4, 0.5, 0.4]), np.array([True, True, False, False])) == 2.5 / 4


def test_average_precision_by_hand() -> None:
    # falling: + - (+ -) where the last two tie: 1 * 1/2 + 2/4 * 1/2
    scores = np.array([0.9, 0.5, 0.4, 0.4])
    assert average_precision(scores, np.array([True, False, True, False])) == 0.5 + 0.25


@pytest.mark.parametrize("seed", range(20))
def test_equal_the_definitions_with_many_ties(seed: int) -> None:
    draw = stream(seed, "ranking")
    n = int(draw.integers(3, 40))
    scores = draw.integers(0, 6, n) / 4.0
    is_positive = draw.random(n) < 0.4
    is_positive[:2] = True, False
    assert auroc(scores, is_positive) == pytest.approx(auroc_by_pairs(scores, is_positive), abs=1e-12)
    expected = average_precision_by_thresholds(scores, is_positive)
    assert average_precision(scores, is_positive) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("is_positive", [[True, True], [False, False], []])
def test_one_class_alone_is_undefined(is_positive: list[bool]) -> None:
    labels = np.array(is_positive, dtype=np.bool_)
    scores = np.arange(len(labels), dtype=np.float64)
    assert np.isnan(auroc(scores, labels))
    assert np.isnan(average_precision(scores, labels))


def test_a_keyframe_without_a_score_ranks_last() -> None:
    labels = np.array([True, False, False])
    for score in (auroc, average_precision):
        assert score(np.array([-5.0, np.nan, np.nan]), labels) == 1.0
        assert score(np.array([np.nan, -5.0, 0.0]), labels) == score(np.array([-9.0, -5.0, 0.0]), labels)


@pytest.mark.parametrize(
    ("falling", "last"),
    [([3.0, 3.0, 2.0, 1.0, 1.0], [1, 2, 4]), ([5.0], [0]), ([2.0, 1.0], [0, 1]), ([1.0, 1.0], [1]), ([], [])],
)
def test_a_threshold_lies_behind_the_last_of_equal_scores(falling: list[float], last: list[int]) -> None:
    found = last_of_ties(np.array(falling))
    assert found.tolist() == last
    assert found.dtype == np.int64
