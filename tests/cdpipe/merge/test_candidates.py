from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, transform, yaw_pose
from cdpipe.merge.candidates import (
    Candidate,
    _fit_common_motion,
    count_votes,
    find_candidates,
    find_closest_pair,
    first_keyframes,
)
from cdpipe.model.config import MergeConfig
from cdpipe.model.types import MappedSession


def poses_at(*places: tuple[float, float]) -> Float64Array:
    return np.array([yaw_pose(0.0, (x, y, 0.0)) for x, y in places])


def test_only_right_pairs_vote_for_one_another() -> None:
    # three right pairs, turned by 90 degrees and moved; two wrong ones
    before = poses_at((0, 0), (10, 0), (25, 5), (40, 0), (7, 0))
    after = yaw_pose(np.pi / 2, (100, 50, 1)) @ before
    after[3:, :2, 3] = [[130.0, 20], [101, 95]]
    agrees, votes = count_votes(before, after, np.zeros(5))
    assert agrees.astype(int).tolist() == [
        [1, 1, 1, 0, 0],
        [1, 1, 1, 0, 0],
        [1, 1, 1, 0, 0],
        [0, 0, 0, 1, 0],
        [0, 0, 0, 0, 1],
    ]
    # a vote weighs exp(-distance / 40 m), its own 1
    far_m = np.hypot(25, 5)
    assert votes[0] == pytest.approx(1 + np.exp(-10 / 40) + np.exp(-far_m / 40))
    assert votes[3] == 1


@pytest.mark.parametrize(("stretch_m", "is_agreed"), [(3.9, True), (4.1, False)])
def test_two_metres_and_two_percent_are_tolerated(stretch_m: float, is_agreed: bool) -> None:
    before, after = poses_at((0, 0), (100, 0)), poses_at((0, 0), (100 + stretch_m, 0))
    # 2 m and 2 % of the after distance: 4.08 m
    assert bool(count_votes(before, after, np.zeros(2))[0][0, 1]) is is_agreed


@pytest.mark.parametrize(("turn_deg", "is_agreed"), [(18.0, True), (22.0, False)])
def test_pairs_of_another_yaw_do_not_agree(turn_deg: float, is_agreed: bool) -> None:
    places = poses_at((0, 0), (5, 0))
    agrees, _ = count_votes(places, places, np.deg2rad([0.0, turn_deg]))
    assert bool(agrees[0, 1]) is is_agreed


def test_a_shift_against_the_yaw_is_no_agreement() -> None:
    # as far apart in both sessions and of the same yaw, but in the other direction
    before, after = poses_at((0, 0), (30, 0)), poses_at((0, 0), (-30, 0))
    assert not count_votes(before, after, np.zeros(2))[0][0, 1]
    assert count_votes(before, after, np.full(2, np.pi))[0][0, 1]


@pytest.mark.parametrize(("rise_m", "is_agreed"), [(4.0, True), (4.2, False), (-4.2, False)])
def test_places_of_another_turn_of_a_decline_do_not_agree(rise_m: float, is_agreed: bool) -> None:
    # 2 m and 7 % of 30 m
    before, after = poses_at((0, 0), (30, 0)), poses_at((0, 0), (30, 0))
    after[1, 2, 3] = rise_m
    assert bool(count_votes(before, after, np.zeros(2))[0][0, 1]) is is_agreed


@pytest.mark.parametrize("is_upside_down", [False, True])
def test_however_the_sensor_hangs_yaws_and_places_say_the_same(is_upside_down: bool) -> None:
    # the after odom frame is turned by 40 degrees; at each place both sensors look another way
    mount = np.diag([1.0, -1.0, -1.0, 1.0]) if is_upside_down else np.eye(4)
    places, turn = [(0.0, 0.0), (12.0, 3.0), (30.0, -4.0)], np.deg2rad(40.0)
    before = np.array([yaw_pose(h, (x, y, 0.0)) @ mount for h, (x, y) in zip((0.3, 1.4, -2.0), places, strict=True)])
    seen_again = np.array([yaw_pose(h, (x, y, 0.0)) @ mount for h, (x, y) in zip((2.0, 0.1, 3.0), places, strict=True)])
    relative = invert(before) @ seen_again
    yaws_rad = np.arctan2(relative[:, 1, 0], relative[:, 0, 0])
    agrees, _ = count_votes(before, yaw_pose(-turn) @ seen_again, yaws_rad)
    assert agrees.all()
    guess = _fit_common_motion(before, yaw_pose(-turn) @ seen_again, yaws_rad, agrees[0], 0)
    np.testing.assert_allclose(guess, yaw_pose(turn), atol=1e-9)


def path_miss_m(found: Candidate, true: Float64Array, session: MappedSession) -> float:
    """Median displacement of the after path."""
    path = session.map.odom_T_keyframe[:, :3, 3]
    return float(np.median(np.linalg.norm(transform(found.before_T_after, path) - transform(true, path), axis=1)))


def test_where_all_pairs_agree_there_is_one_candidate_and_it_is_near_the_truth(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    (found,) = find_candidates(tunnel_before, tunnel_after, MergeConfig(n_candidates=4))
    assert path_miss_m(found, true_before_T_after, tunnel_after) < 1.0


def test_most_pairs_may_be_wrong(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    # two of three after keyframes are given the vector of a keyframe far away
    q = tunnel_after.descriptors.q.copy()
    is_wrong = np.arange(len(q)) % 3 != 0
    q[is_wrong] = np.random.default_rng(0).permutation(q[is_wrong])
    misled = MappedSession(tunnel_after.map, replace(tunnel_after.descriptors, q=q))
    found = find_candidates(tunnel_before, misled, MergeConfig(n_candidates=4))
    assert len(found) == 4
    miss_m = [path_miss_m(each, true_before_T_after, tunnel_after) for each in found]
    assert miss_m[0] < 3.0
    # the others are other motions, not the same again
    assert min(miss_m[1:]) > 3.0


def test_frames_candidate_is_the_closest_of_all_pairs(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    (found,) = find_closest_pair(tunnel_before, tunnel_after)
    q_before, q_after = tunnel_before.descriptors.q, tunnel_after.descriptors.q
    distances = np.linalg.norm(q_before[:, None] - q_after[None], axis=2)
    assert distances[found.before_keyframe, found.after_keyframe] == distances.min()
    turn = invert(true_before_T_after)[:3, :3] @ found.before_T_after[:3, :3]
    assert np.rad2deg(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 10


def test_no_descriptor_no_candidate(tunnel_before: MappedSession) -> None:
    nothing = replace(
        tunnel_before.descriptors,
        q=np.zeros((0, 64), np.float32),
        w=np.zeros((0, 64), np.float32),
        keyframe_scans=np.zeros(0, np.int64),
    )
    empty = MappedSession(tunnel_before.map, nothing)
    assert find_candidates(tunnel_before, empty, MergeConfig()) == []
    assert find_closest_pair(empty, tunnel_before) == []


@pytest.mark.parametrize("n", [0, 1, 9, 10, 57, 400])
def test_what_is_compared_first_is_spread_over_the_session(n: int) -> None:
    before, after = (first_keyframes(n, 4, is_after) for is_after in (False, True))
    for chosen in (before, after):
        assert min(n, 10) <= len(chosen) <= n
        assert (np.diff(chosen) > 0).all() and (n == 0 or chosen[0] == 0)
    assert (np.diff(before) <= 4).all() and (np.diff(after) <= 8).all()
    assert len(before) <= max(20, n / 4 + 1) and len(after) <= max(20, n / 8 + 1)


def test_no_more_after_keyframes_are_queried_than_are_compared_first() -> None:
    assert len(first_keyframes(5000, 4, True)) == 100
    np.testing.assert_array_equal(first_keyframes(7, 1, False), np.arange(7))
    assert len(first_keyframes(5000, 1, True)) == 100 and len(first_keyframes(5000, 1, False)) == 5000


def test_candidates_are_of_the_keyframes_compared_first(
    tunnel_before: MappedSession, tunnel_after: MappedSession, true_before_T_after: Float64Array
) -> None:
    sessions = tunnel_before, tunnel_after
    rows = [
        first_keyframes(len(each.descriptors.q), 2, is_after)
        for each, is_after in zip(sessions, (False, True), strict=True)
    ]
    # the other vectors must not count: without them the candidates are the same
    blank = []
    for session, kept in zip(sessions, rows, strict=True):
        q, w = np.zeros_like(session.descriptors.q), np.zeros_like(session.descriptors.q)
        assert session.descriptors.w is not None and len(kept) < len(q)
        q[kept], w[kept] = session.descriptors.q[kept], session.descriptors.w[kept]
        blank.append(MappedSession(session.map, replace(session.descriptors, q=q, w=w)))
    found, of_blank = (find_candidates(*each, MergeConfig(n_candidates=4), every=2) for each in (sessions, blank))
    assert path_miss_m(found[0], true_before_T_after, tunnel_after) < 1.0
    assert {each.before_keyframe for each in found} <= set(rows[0].tolist())
    for one, other in zip(found, of_blank, strict=True):
        np.testing.assert_array_equal(one.before_T_after, other.before_T_after)
