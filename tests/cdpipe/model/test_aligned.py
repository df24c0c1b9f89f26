from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import invert, make_pose, yaw_pose
from cdpipe.model.aligned import aligned_scans, alignment_of, is_torn, merge_at_scans
from cdpipe.model.report import ChangeRegions, ChangeReport

RIGID = yaw_pose(0.4, (3.0, -2.0, 0.5))
POSES = np.array([make_pose(translation=(0.5 * step, 0.0, 1.0)) for step in range(40)])
KEYFRAMES = np.arange(0, 40, 2)


def report(local: np.ndarray | None, after_keyframes: np.ndarray = KEYFRAMES) -> ChangeReport:
    none = np.zeros(0)
    regions = ChangeRegions(np.zeros((0, 3)), 4.5, none, np.zeros((0, 2), np.int64), none.astype(bool), none)
    scans = (np.zeros(0, np.int64), after_keyframes)
    return ChangeReport(RIGID, {}, regions, (), {}, {}, scans, local_before_T_after=local)


def test_a_rigid_answer() -> None:
    alignment = alignment_of(report(None), POSES)
    assert alignment.is_rigid
    np.testing.assert_array_equal(alignment.before_T_after[0], RIGID)


@pytest.mark.parametrize("keyframes", [KEYFRAMES, np.zeros(0, np.int64)])
def test_a_local_answer_lies_along_its_keyframes_or_all_scans(keyframes: np.ndarray) -> None:
    scans = keyframes if len(keyframes) else np.arange(40)
    local = np.array([make_pose(translation=(0, 0, 0.01 * scan)) @ RIGID for scan in scans])
    alignment = alignment_of(report(local, keyframes), POSES)
    np.testing.assert_array_equal(alignment.anchors_odom, POSES[scans, :3, 3])
    # 1 cm a scan; far from the ends the blend keeps a straight line, but for the few anchors it leaves out
    middle = alignment.to_map(POSES[18:23, :3, 3])
    expected = (RIGID @ POSES[18:23])[:, :3, 3] + np.outer(np.arange(18, 23), (0, 0, 0.01))
    np.testing.assert_allclose(middle, expected, atol=2e-3)


def test_answers_to_another_pair_are_refused() -> None:
    local = np.stack([RIGID] * len(KEYFRAMES))
    for wrong in (
        report(local[:3]),
        report(local, KEYFRAMES + 30),
        report(local, KEYFRAMES + 2),
        report(local, KEYFRAMES - 1),
    ):
        with pytest.raises(InputError, match="is it an answer to this pair"):
            alignment_of(wrong, POSES)
    bad = replace(report(local), local_before_T_after=local * 2)
    with pytest.raises(InputError, match=r"the answer's before_T_after|local_before_T_after\[0\] is not a rigid"):
        alignment_of(bad, POSES)
    assert np.isfinite(alignment_of(report(invert(local)), POSES).to_map(np.zeros((1, 3)))).all()


@pytest.mark.parametrize("keyframes", [KEYFRAMES, KEYFRAMES[::-1], np.zeros(0, np.int64)])
@pytest.mark.parametrize(("leap_m", "expected"), [(0.0, False), (0.8, False), (30.0, True)])
def test_an_answer_tells_where_the_odometry_lost_its_way(keyframes: np.ndarray, leap_m: float, expected: bool) -> None:
    scans = keyframes if len(keyframes) else np.arange(40)
    local = np.array([make_pose(translation=(leap_m * (scan >= 20), 0, 0)) @ RIGID for scan in scans])
    assert is_torn(report(local, keyframes), POSES) is expected
    assert not is_torn(report(None, keyframes), POSES)


def test_drift_between_keyframes_that_lie_far_apart_is_no_loss() -> None:
    poses = np.array([make_pose(translation=(60.0 * step, 0.0, 1.0)) for step in range(4)])
    local = np.array([make_pose(translation=(1.2 * step, 0, 0)) for step in range(4)])
    assert not is_torn(report(local, np.arange(4)), poses)
    assert not is_torn(report(local[:1], np.arange(1)), poses)


@pytest.mark.parametrize("keyframes", [[20, 0, 10], [0, 10, 20], [3, 2, 31], [7]])
def test_each_scan_has_the_merge_of_the_nearest_keyframe(keyframes: list[int]) -> None:
    local = np.array([make_pose(translation=(scan, 0, 0)) for scan in keyframes])
    scans = np.arange(40)
    found = merge_at_scans(report(local, np.array(keyframes)), scans)[:, 0, 3]
    # the earlier one of two that are as near
    np.testing.assert_array_equal(found, [min(keyframes, key=lambda each: (abs(each - scan), each)) for scan in scans])


def test_without_keyframes_each_scan_has_its_own_merge_and_a_rigid_one_holds_everywhere() -> None:
    local, none = np.array([make_pose(translation=(scan, 0, 0)) for scan in range(40)]), np.zeros(0, np.int64)
    scans = np.array([5, 3, 39])
    np.testing.assert_array_equal(merge_at_scans(report(local, none), scans), local[scans])
    np.testing.assert_array_equal(merge_at_scans(report(None, KEYFRAMES), scans), np.stack([RIGID] * 3))


def test_the_merge_is_stated_at_the_keyframes_in_order_or_at_all_scans() -> None:
    assert aligned_scans(report(None, np.array([20, 0, 10])), 40).tolist() == [0, 10, 20]
    assert aligned_scans(report(None, np.zeros(0, np.int64)), 3).tolist() == [0, 1, 2]


def test_a_drift_that_adds_up_is_no_loss() -> None:
    local = np.array([make_pose(translation=(0.5 * scan, 0, 0)) for scan in range(40)])
    assert not is_torn(report(local, np.zeros(0, np.int64)), POSES)


def test_who_stands_still_is_lost_from_more_than_a_metre_on() -> None:
    still = np.tile(np.eye(4), (40, 1, 1))
    for leap_m, expected in ((1.0, False), (1.02, True)):
        local = np.array([make_pose(translation=(leap_m * (scan >= 20), 0, 0)) for scan in range(40)])
        assert is_torn(report(local, np.zeros(0, np.int64)), still) is expected
        # two places are enough
        assert is_torn(report(local[[0, 39]], np.array([0, 39])), still) is expected
    # between scans half a metre apart drift is 2.5 cm at most
    for leap_m, expected in ((1.02, False), (1.04, True)):
        local = np.array([make_pose(translation=(leap_m * (scan >= 20), 0, 0)) for scan in range(40)])
        assert is_torn(report(local, np.zeros(0, np.int64)), POSES) is expected
