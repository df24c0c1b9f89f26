import numpy as np

from cdpipe.descriptors.sphere import average_neighbours, max_within_reach


def _along(*metres: float) -> np.ndarray:
    return np.array([(x, 0.0, 0.0) for x in metres])


def test_neighbours_weigh_half_each_and_a_missing_one_is_the_keyframe_itself() -> None:
    logits = np.array([[4.0, 0.0], [8.0, 0.0], [0.0, 4.0], [0.0, 0.0]])
    # 0, 1 and 2 m, then a gap of 7 m
    expected = [[5.0, 0.0], [5.0, 1.0], [2.0, 3.0], [0.0, 0.0]]
    np.testing.assert_array_equal(average_neighbours(logits, _along(0, 1, 2, 9)), expected)
    assert average_neighbours(np.zeros((0, 2)), np.zeros((0, 3))).shape == (0, 2)
    np.testing.assert_array_equal(average_neighbours(logits[:1], _along(3)), logits[:1])


def test_the_best_within_reach_counts_the_border_included() -> None:
    scores = np.array([1.0, 5.0, 2.0, 3.0])
    np.testing.assert_array_equal(max_within_reach(scores, _along(0, 2, 4, 9), 2.0), [5.0, 5.0, 5.0, 3.0])
    assert len(max_within_reach(np.zeros(0), np.zeros((0, 3)), 2.0)) == 0
