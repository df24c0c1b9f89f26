"""Merge errors by hand, and what must not change them."""

import numpy as np
import pytest

from cdpipe.core.geometry import invert, make_pose, stream, yaw_pose
from eval.scoring.merge_metrics import (
    compute_merge_errors,
    find_travel_directions,
    list_evidence,
    measure_overlap,
    summarise_merge_errors,
)
from eval.truth.ground_truth import SessionTruth
from eval.truth.scoring_points import ScoringPoints


def session(world_T_sensor: np.ndarray, odom_T_world: np.ndarray) -> SessionTruth:
    empty = ScoringPoints(
        returns=np.zeros(0, dtype=np.int64),
        points_odom=np.zeros((0, 3), dtype=np.float32),
        change=np.zeros(0, dtype=np.int16),
        instance=np.zeros(0, dtype=np.int16),
        n_scans=len(world_T_sensor),
        n_pixels=1,
    )
    return SessionTruth(odom_T_world @ world_T_sensor, world_T_sensor, empty)


def drive(n: int, start_x_m: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    return np.stack([yaw_pose(yaw_rad, (start_x_m + 1.0 * i, 0.0, 0.0)) for i in range(n)])


BEFORE_T_WORLD = yaw_pose(0.4, (3.0, -2.0, 0.5))
AFTER_T_WORLD = yaw_pose(-1.1, (10.0, 4.0, 0.0))
TRUE_MERGE = BEFORE_T_WORLD @ invert(AFTER_T_WORLD)


def test_the_true_merge_without_drift_has_no_error() -> None:
    errors = compute_merge_errors(session(drive(20), BEFORE_T_WORLD), session(drive(20), AFTER_T_WORLD), TRUE_MERGE)
    assert len(errors.metres) == 20
    np.testing.assert_allclose(errors.metres, 0.0, atol=1e-9)
    np.testing.assert_allclose(errors.degrees, 0.0, atol=1e-6)
    np.testing.assert_allclose(errors.along_m, 0.0, atol=1e-9)


@pytest.mark.parametrize("heading_rad", [0.0, 2.0])
def test_a_shift_by_hand(heading_rad: float) -> None:
    # 0.3 m along the drive (world x) and 0.4 m across: 0.5 m in all, whatever way the sensor looks
    slip = BEFORE_T_WORLD @ make_pose(translation=(0.3, 0.4, 0.0)) @ invert(BEFORE_T_WORLD)
    after = session(drive(20, yaw_rad=heading_rad), AFTER_T_WORLD)
    errors = compute_merge_errors(session(drive(20), BEFORE_T_WORLD), after, slip @ TRUE_MERGE)
    np.testing.assert_allclose(errors.metres, 0.5, atol=1e-9)
    np.testing.assert_allclose(errors.along_m, 0.3, atol=1e-9)


def test_a_turn_by_hand() -> None:
    # a turn by 2 degrees about the world's origin shifts a keyframe at x by 2 x sin(1 deg)
    slip = BEFORE_T_WORLD @ yaw_pose(np.deg2rad(2.0)) @ invert(BEFORE_T_WORLD)
    before, after = session(drive(20), BEFORE_T_WORLD), session(drive(20), AFTER_T_WORLD)
    errors = compute_merge_errors(before, after, slip @ TRUE_MERGE)
    np.testing.assert_allclose(errors.degrees, 2.0, atol=1e-6)
    np.testing.assert_allclose(errors.metres, 2 * np.arange(20) * np.sin(np.deg2rad(1.0)), atol=1e-9)


def test_only_places_with_a_true_neighbour_within_five_metres_count() -> None:
    # after places at 9.5, 10.5, ... 28.5: the last before place stands at 19
    before, after = session(drive(20), BEFORE_T_WORLD), session(drive(20, start_x_m=9.5), AFTER_T_WORLD)
    assert len(compute_merge_errors(before, after, TRUE_MERGE).metres) == 15
    far = session(drive(20, start_x_m=100.0), AFTER_T_WORLD)
    columns = summarise_merge_errors(compute_merge_errors(before, far, TRUE_MERGE))
    assert columns["n_merge_pairs"] == 0
    assert np.isnan(columns["merge_error_m"])


def test_drift_of_either_session_counts_as_misalignment() -> None:
    # the after odometry stretches the way by 1 %: place k believes to be 0.01 k ahead of itself
    after = drive(20)
    stretched = after.copy()
    stretched[:, 0, 3] *= 1.01
    truth = SessionTruth(AFTER_T_WORLD @ stretched, after, session(after, AFTER_T_WORLD).scoring_points)
    errors = compute_merge_errors(session(drive(20), BEFORE_T_WORLD), truth, TRUE_MERGE)
    np.testing.assert_allclose(errors.along_m, 0.01 * np.arange(20), atol=1e-9)
    columns = summarise_merge_errors(errors)
    assert columns["merge_error_along_m"] == pytest.approx(0.01 * 9.5)
    assert columns["merge_error_along_m_p95"] == pytest.approx(0.01 * 0.95 * 19)


def test_a_local_merge_is_taken_at_each_after_place() -> None:
    # the after odometry believes place k to be 0.005 k ahead of itself, and the local merge takes it back
    after = drive(20, start_x_m=-6.0)
    stretched = after.copy()
    stretched[:, 0, 3] += 0.005 * np.arange(20)
    truth = SessionTruth(AFTER_T_WORLD @ stretched, after, session(after, AFTER_T_WORLD).scoring_points)
    back = np.stack([make_pose(translation=(-0.005 * k, 0.0, 0.0)) for k in range(20)])
    local = BEFORE_T_WORLD @ back @ invert(AFTER_T_WORLD)
    before = session(drive(20), BEFORE_T_WORLD)
    # the first stands farther than 5 m from every before place
    errors = compute_merge_errors(before, truth, local)
    assert len(errors.metres) == 19
    np.testing.assert_allclose(errors.metres, 0.0, atol=1e-9)
    drifted = compute_merge_errors(before, truth, TRUE_MERGE)
    np.testing.assert_allclose(drifted.along_m, 0.005 * np.arange(1, 20), atol=1e-9)


def line(start: tuple[float, float], end: tuple[float, float], n: int) -> np.ndarray:
    return np.stack([make_pose(translation=(*place, 0.0)) for place in np.linspace(start, end, n)])


@pytest.mark.parametrize(
    ("after", "share"),
    [
        (line((0, 0), (20, 0), 41), 1.0),
        # the other way, and without a scan between the ends
        (line((20, 4.9), (0, 4.9), 2), 1.0),
        (line((0, 5.1), (20, 5.1), 41), 0.0),
        # 15 of 40 m: the before path ends at 20, and 5 m beyond it are near
        (line((10, 0), (50, 0), 3), 15 / 40),
        # across: 5 m on either side of 24
        (line((10, -12), (10, 12), 7), 10 / 24),
        (line((500, 0), (600, 0), 9), 0.0),
    ],
)
@pytest.mark.parametrize("n_before", [2, 33])
def test_true_overlap_by_hand(after: np.ndarray, share: float, n_before: int) -> None:
    assert measure_overlap(line((0, 0), (20, 0), n_before), after) == pytest.approx(share, abs=0.1 / 24)


def test_true_overlap_is_by_length_and_not_by_scans() -> None:
    # it waits for long where the before session was, and then leaves
    after = np.concatenate([line((20, 0), (20, 0), 500), line((20, 0), (20, 50), 3)])
    assert measure_overlap(line((0, 0), (20, 0), 9), after) == pytest.approx(5 / 50, abs=1e-9)
    assert np.isnan(measure_overlap(line((0, 0), (20, 0), 9), line((3, 0), (3, 0), 4)))
    # a before session that never moved is still somewhere
    assert measure_overlap(line((0, 0), (0, 0), 4), line((-10, 0), (10, 0), 5)) == pytest.approx(0.5, abs=0.01)


def test_evidence_columns_by_hand() -> None:
    columns = list_evidence({"overlap": 1, "hessian_ratio": 0.25, "residual_m": np.inf, "unknown": 7.0})
    assert (columns["evidence_overlap"], columns["evidence_hessian_ratio"]) == (1.0, 0.25)
    assert sum(map(np.isnan, columns.values())) == len(columns) - 2
    assert "evidence_unknown" not in columns


def one_per_metre(odom_T_sensor: np.ndarray) -> list[int]:
    chosen, since_m = [0], 0.0
    for index in range(1, len(odom_T_sensor)):
        since_m += float(np.linalg.norm(odom_T_sensor[index, :3, 3] - odom_T_sensor[index - 1, :3, 3]))
        if since_m >= 1.0 - 1e-6:
            chosen.append(index)
            since_m = 0.0
    return chosen


def test_errors_equal_the_definition_written_out() -> None:
    draw = stream(5, "merge")
    world_i = np.stack([yaw_pose(draw.uniform(-3, 3), draw.uniform(0, 8, 3)) for _ in range(9)])
    world_j = np.stack([yaw_pose(draw.uniform(-3, 3), draw.uniform(0, 8, 3)) for _ in range(7)])
    odom_i = np.stack([yaw_pose(draw.uniform(-3, 3), draw.uniform(0, 8, 3)) for _ in range(9)])
    odom_j = np.stack([yaw_pose(draw.uniform(-3, 3), draw.uniform(0, 8, 3)) for _ in range(7)])
    guess = yaw_pose(0.7, (1.0, 2.0, 3.0))
    scoring_points = session(world_i, np.eye(4)).scoring_points
    errors = compute_merge_errors(
        SessionTruth(odom_i, world_i, scoring_points),
        SessionTruth(odom_j, world_j, scoring_points),
        guess,
    )
    metres, degrees = [], []
    for j in one_per_metre(odom_j):
        judged = one_per_metre(odom_i)
        distances = {i: np.linalg.norm(world_i[i][:3, 3] - world_j[j][:3, 3]) for i in judged}
        i = min(judged, key=lambda k: distances[k])
        if distances[i] <= 5.0:
            true = np.linalg.inv(world_i[i]) @ world_j[j]
            error = np.linalg.inv(true) @ np.linalg.inv(odom_i[i]) @ guess @ odom_j[j]
            metres.append(np.linalg.norm(error[:3, 3]))
            degrees.append(np.rad2deg(np.arccos((np.trace(error[:3, :3]) - 1) / 2)))
    np.testing.assert_allclose(errors.metres, metres, atol=1e-9)
    np.testing.assert_allclose(errors.degrees, degrees, atol=1e-5)


def test_direction_of_travel_follows_the_path_and_not_the_sensor() -> None:
    poses = np.concatenate([drive(5, yaw_rad=1.0), np.stack([yaw_pose(0, (4.0, 1.0 * i, 0.0)) for i in range(1, 5)])])
    directions = find_travel_directions(poses)
    np.testing.assert_allclose(directions[:4], [(1, 0, 0)] * 4, atol=1e-12)
    np.testing.assert_allclose(directions[4], np.array([1, 1, 0]) / np.sqrt(2), atol=1e-12)
    np.testing.assert_allclose(directions[5:], [(0, 1, 0)] * 4, atol=1e-12)


def test_a_robot_that_never_moved_has_no_direction() -> None:
    still = np.stack([np.eye(4)] * 3)
    assert np.isnan(find_travel_directions(still)).all()
    columns = summarise_merge_errors(compute_merge_errors(*[session(still, np.eye(4))] * 2, np.eye(4)))
    assert np.isnan(columns["merge_error_along_m"])
    assert columns["merge_error_m"] == 0.0
    assert np.isnan(summarise_merge_errors(None)["merge_error_m"])
