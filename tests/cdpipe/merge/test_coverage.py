"""Metres of the before path that were compared, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, invert, make_pose, yaw_pose
from cdpipe.merge.coverage import measure_coverage
from tests.cdpipe.model.test_sentence import EMPTY


def straight(first_m: float, last_m: float) -> Float64Array:
    """Poses every two metres along x."""
    along = np.arange(first_m, last_m + 1e-9, 2.0)
    return make_pose(translation=np.column_stack([along, np.zeros((len(along), 2))]))


def test_a_step_is_compared_if_the_after_session_came_within_five_metres_of_both_ends() -> None:
    # the after session ends at x = 10, 3 m beside: before scans up to x = 14 are within 5 m of it (3-4-5), 16 is not
    before, after = straight(0, 40), straight(0, 10) @ make_pose(translation=(0.0, 3.0, 0.0))
    found = measure_coverage(EMPTY, before, after)
    assert found.is_near.tolist() == [x_m < 14 for x_m in range(0, 42, 2)]  # a distance of 5 m is not within it
    assert (found.compared_m, found.unseen_m) == (12.0, 28.0)


def test_the_after_path_is_placed_as_the_answer_aligns_it() -> None:
    before_T_after = yaw_pose(1.2, (5.0, -3.0, 0.4))
    before, after = straight(0, 20), invert(before_T_after) @ straight(-4, 8)
    found = measure_coverage(replace(EMPTY, before_T_after=before_T_after), before, after)
    assert (found.compared_m, found.unseen_m) == pytest.approx((12.0, 8.0))
    assert measure_coverage(EMPTY, before, after).compared_m < 12.0


def test_a_local_alignment_counts_where_it_holds() -> None:
    # the second half of the after path lies 100 m away, unless its own alignment brings it back
    before, after = straight(0, 20), straight(0, 20)
    after[6:, 1, 3] += 100.0
    local = make_pose(translation=np.where(np.arange(11)[:, None] < 6, 0.0, [[0.0, -100.0, 0.0]]))
    assert measure_coverage(EMPTY, before, after).unseen_m > 0
    found = measure_coverage(replace(EMPTY, local_before_T_after=local), before, after)
    assert (found.compared_m, found.unseen_m) == (20.0, 0.0)


def test_a_lost_odometry_that_lies_over_its_own_path_does_not_bend_it() -> None:
    # from its sixth scan on the after odometry comes back over its first half; the answer knows where it is
    before, after = straight(0, 20), np.concatenate([straight(0, 10), straight(0, 8)])
    local = make_pose(translation=np.where(np.arange(11)[:, None] < 6, 0.0, [[12.0, 0.0, 0.0]]))
    found = measure_coverage(replace(EMPTY, local_before_T_after=local), before, after)
    assert (found.compared_m, found.unseen_m) == (20.0, 0.0)


def test_a_path_of_one_scan_has_no_length() -> None:
    found = measure_coverage(EMPTY, straight(0, 0), straight(0, 4))
    assert (found.compared_m, found.unseen_m, found.is_near.tolist()) == (0.0, 0.0, [True])


def test_an_answer_to_longer_sessions_is_refused() -> None:
    scans = np.array([0, 7]), np.array([0, 1])
    with pytest.raises(InputError, match="names scan 7 of the before session, which has 3"):
        measure_coverage(replace(EMPTY, keyframe_scans=scans), straight(0, 4), straight(0, 4))
