"""Merges made of the truth: the error of each keyframe is the noise, whatever the odometries did."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import invert, make_pose, stream, travelled_m, yaw_pose
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, PointMap
from eval.oracles.merge import OracleMerge, merged_by_truth
from eval.scoring.merge_metrics import MergeErrors, compute_merge_errors
from eval.truth.ground_truth import SessionTruth
from eval.truth.scoring_points import ScoringPoints

N = 60


def winding(start_m: float, *, backwards: bool = False) -> np.ndarray:
    """Drive a slope that winds, half a metre a scan."""
    poses = []
    for index in range(N):
        way = start_m + 0.5 * index
        heading = 0.3 * np.sin(way / 9) + (np.pi if backwards else 0.0)
        turn = Rotation.from_euler("zyx", (heading, 0.05, 0.02))
        poses.append(make_pose(turn.as_matrix(), (way, 3 * np.sin(way / 10), 0.05 * way)))
    return np.stack(poses[::-1] if backwards else poses)


def session(world_T_sensor: np.ndarray, odom_T_world: np.ndarray, drift_deg_per_m: float = 0.0) -> SessionTruth:
    """Return a session whose odometry bends away and stretches the way by 1 % if it drifts."""
    travelled = travelled_m(world_T_sensor)
    slip = [
        yaw_pose(np.deg2rad(drift_deg_per_m * way), (0.01 * way * (drift_deg_per_m > 0), 0, 0)) for way in travelled
    ]
    none = np.zeros(0, dtype=np.int16)
    scoring_points = ScoringPoints(np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.float32), none, none, N, 1)
    return SessionTruth(odom_T_world @ np.stack(slip) @ world_T_sensor, world_T_sensor, scoring_points)


def mapped(truth: SessionTruth, keyframes: np.ndarray) -> MappedSession:
    none = np.zeros(0, dtype=np.int32)
    offsets = np.zeros(N + 1, dtype=np.int64)
    point_map = PointMap(
        np.zeros((0, 3)), np.zeros(0, np.float32), 0.2, truth.odom_T_sensor, keyframes, none, none, offsets
    )
    vectors = np.ones((len(keyframes), 4), dtype=np.float32)
    return MappedSession(point_map, DescriptorSet(vectors, None, keyframes, "test", ""))


def oracle(truth: tuple[SessionTruth, SessionTruth], noise: OracleMerge, seed: int = 3) -> MergedMaps:
    before, after = (mapped(each, each.judged_scans) for each in truth)
    return merged_by_truth(before, after, truth, noise, seed)


def errors_of(truth: tuple[SessionTruth, SessionTruth], merged: MergedMaps) -> MergeErrors:
    assert merged.local is not None
    return compute_merge_errors(*truth, merged.local.before_T_after)


def pair(drift_deg_per_m: float = 0.0, start_m: float = 4.0, *, backwards: bool = False) -> tuple[SessionTruth, ...]:
    return (
        session(winding(0.0), yaw_pose(0.7, (3.0, -8.0, 1.0)), drift_deg_per_m),
        session(winding(start_m, backwards=backwards), yaw_pose(-1.9, (-40.0, 5.0, 2.0)), -drift_deg_per_m / 2),
    )


@pytest.mark.parametrize("drift_deg_per_m", [0.0, 0.05])
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize(("metres", "degrees"), [(0.0, 0.0), (0.3, 0.0), (0.0, 1.0), (0.1, 0.2)])
def test_the_error_of_every_keyframe_is_the_noise(
    drift_deg_per_m: float, backwards: bool, metres: float, degrees: float
) -> None:
    truth = pair(drift_deg_per_m, backwards=backwards)
    merged = oracle(truth, OracleMerge(noise_m=metres, noise_deg=degrees))
    assert merged.is_accepted
    errors = errors_of(truth, merged)
    assert len(errors.metres) == len(truth[1].judged_scans)
    np.testing.assert_allclose(errors.metres, metres, atol=1e-9)
    np.testing.assert_allclose(errors.degrees, degrees, atol=1e-5)


def test_the_noise_stands_still_in_the_map_and_scales() -> None:
    truth = pair(0.05)
    exact, near, far = (oracle(truth, OracleMerge(noise_m=metres, noise_deg=1.0)) for metres in (0.0, 0.1, 0.3))
    places = []
    for merged in (exact, near, far):
        assert merged.local is not None
        places.append((merged.local.before_T_after @ truth[1].odom_T_sensor[truth[1].judged_scans])[:, :3, 3])
    shifts = places[1] - places[0]
    np.testing.assert_allclose(shifts - shifts[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(places[2] - places[0], 3 * shifts, atol=1e-9)
    # every pose is turned about itself by one and the same rotation of the map frame
    unturned = oracle(truth, OracleMerge())
    assert exact.local is not None
    assert unturned.local is not None
    turns = exact.local.before_T_after[:, :3, :3] @ unturned.local.before_T_after[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(turns - turns[0], 0.0, atol=1e-12)


def test_the_noise_is_drawn_once_per_seed() -> None:
    truth, noise = pair(), OracleMerge(noise_m=0.3, noise_deg=1.0)
    first, again, other = (oracle(truth, noise, seed).before_T_after for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.linalg.norm((first - other)[:3, 3]) > 0.01
    direction = stream(3, "oracle-merge").normal(size=(2, 3))[0]
    shift = (oracle(truth, OracleMerge(noise_m=0.3)).before_T_after - oracle(truth, OracleMerge()).before_T_after)[
        :3, 3
    ]
    np.testing.assert_allclose(shift, 0.3 * direction / np.linalg.norm(direction), atol=1e-9)


def test_keyframes_without_a_partner_take_the_alignment_of_the_nearest_that_has_one() -> None:
    truth = pair(0.05, start_m=20.0)
    merged = oracle(truth, OracleMerge(noise_m=0.1))
    assert merged.local is not None
    assert 0 < len(errors_of(truth, merged).metres) < len(truth[1].judged_scans)
    n_paired = len(errors_of(truth, merged).metres)
    # the drives part at the before session's end, and the after session drives on
    for index in range(n_paired, len(truth[1].judged_scans)):
        np.testing.assert_array_equal(merged.local.before_T_after[index], merged.local.before_T_after[n_paired - 1])
    np.testing.assert_array_equal(merged.before_T_after, merged.local.before_T_after[n_paired // 2])
    np.testing.assert_array_equal(merged.local.anchors_odom, truth[1].odom_T_sensor[truth[1].judged_scans, :3, 3])


def test_of_two_keyframes_at_one_place_each_keeps_its_own() -> None:
    there = winding(0.0)[: N // 2]
    world = np.concatenate([there, there[::-1]])
    truth = (session(winding(0.0), np.eye(4)), session(world, yaw_pose(1.0), 0.1))
    before, after = (mapped(each, each.judged_scans) for each in truth)
    merged = merged_by_truth(before, after, truth, OracleMerge(), 1)
    assert merged.local is not None
    errors = compute_merge_errors(*truth, merged.local.before_T_after)
    np.testing.assert_allclose(errors.metres, 0.0, atol=1e-9)


def test_tunnels_that_never_meet_are_refused_by_the_truth() -> None:
    merged = oracle(pair(start_m=500.0), OracleMerge())
    assert not merged.is_accepted
    assert "no after keyframe has a before keyframe within 5 m" in merged.reason
    assert merged.local is None
    assert merged.evidence == {"n_hypotheses": 0.0}


def test_an_oracle_needs_no_time_and_no_hypotheses() -> None:
    merged = oracle(pair(), OracleMerge())
    assert merged.seconds == {"t_index_s": 0.0, "t_merge_s": 0.0, "t_refine_s": 0.0}
    assert merged.evidence == {"n_hypotheses": 0.0}
    # without drift one transform is right everywhere
    true = yaw_pose(0.7, (3.0, -8.0, 1.0)) @ invert(yaw_pose(-1.9, (-40.0, 5.0, 2.0)))
    np.testing.assert_allclose(merged.before_T_after, true, atol=1e-9)
