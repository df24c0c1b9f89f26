from __future__ import annotations

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, make_pose, yaw_pose
from cdpipe.merge.pose_graph import PoseGraph
from cdpipe.merge.pose_graph import solve_pose_graph as solve


def solve_pose_graph(positions: Float64Array, measured: Float64Array, information: Float64Array) -> Float64Array:
    """What registrations that no stretch misleads come to."""
    return solve(positions, measured, information, np.zeros((len(positions), 6))).before_T_after


def line(n: int) -> Float64Array:
    return np.column_stack([2.0 * np.arange(n), np.zeros(n), np.zeros(n)])


def stack(pose: Float64Array, n: int) -> Float64Array:
    return np.repeat(pose[None], n, axis=0)


def known(n: int, weight: float = 1e6) -> Float64Array:
    return np.repeat(weight * np.eye(6)[None], n, axis=0)


def positions_map(before_T_after: Float64Array, positions: Float64Array) -> Float64Array:
    return np.einsum("aij,aj->ai", before_T_after[:, :3, :3], positions) + before_T_after[:, :3, 3]


def test_measurements_that_agree_are_kept() -> None:
    truth = stack(yaw_pose(0.8, (30.0, -5.0, 2.0)), 12)
    np.testing.assert_allclose(solve_pose_graph(line(12), truth, known(12)), truth, atol=1e-9)


def test_what_was_not_measured_follows_its_neighbours() -> None:
    truth = stack(yaw_pose(0.8, (30.0, -5.0, 2.0)), 12)
    measured, information = truth.copy(), known(12)
    measured[5:8] = make_pose(translation=(0.0, 9.0, 0.0)) @ truth[5:8]
    information[5:8] = 0.0
    np.testing.assert_allclose(solve_pose_graph(line(12), measured, information), truth, atol=1e-6)


def test_the_way_along_a_smooth_drift_comes_from_its_ends() -> None:
    # along x nothing is known but at both ends, where the maps have drifted 0.2 m apart
    measured, information = stack(np.eye(4), 11), known(11)
    information[1:-1, 3, :] = information[1:-1, :, 3] = 0.0
    measured[-1, 0, 3] = 0.2
    measured[1:-1, 0, 3] = 7.0
    found = solve_pose_graph(line(11), measured, information)
    np.testing.assert_allclose(found[:, 0, 3], np.linspace(0, 0.2, 11), atol=1e-3)


def test_noise_is_averaged_and_a_steady_drift_is_not() -> None:
    n, rng = 60, np.random.default_rng(3)
    positions = line(n)
    truth = np.array([yaw_pose(np.deg2rad(0.01 * x), (0.004 * x, 0.0, 0.0)) for x in positions[:, 0]])
    noise_m = 0.03
    measured = truth.copy()
    measured[:, :3, 3] += rng.normal(0, noise_m, (n, 3))
    information = np.repeat(np.diag([1e7] * 3 + [1 / noise_m**2] * 3)[None], n, axis=0)
    found = solve_pose_graph(positions, measured, information)
    off_m = positions_map(found, positions) - positions_map(truth, positions)
    assert np.sqrt(np.mean(off_m**2)) < 0.6 * noise_m
    assert abs(off_m.mean()) < 0.01


def test_one_anchor_is_what_was_measured() -> None:
    measured = yaw_pose(0.3, (1.0, 2.0, 3.0))[None]
    np.testing.assert_allclose(solve_pose_graph(np.zeros((1, 3)), measured, known(1)), measured, atol=1e-12)


@pytest.mark.parametrize("n", [2, 7])
def test_the_answer_moves_with_the_frames(n: int) -> None:
    rng = np.random.default_rng(n)
    positions = rng.normal(0, 10, (n, 3))
    measured = np.array([yaw_pose(a, rng.normal(0, 0.1, 3)) for a in rng.normal(0, 0.01, n)])
    information = known(n, 1e3)
    moved = yaw_pose(1.1, (100.0, 50.0, -3.0))
    np.testing.assert_allclose(
        solve_pose_graph(positions, moved @ measured, information),
        moved @ solve_pose_graph(positions, measured, information),
        atol=1e-6,
    )


@pytest.mark.parametrize("stretch", [0.01, -0.006])
def test_a_stretch_is_found_and_what_it_misled_is_put_right(stretch: float) -> None:
    # registrations that look ahead: 5 m times the stretch too far along, and only the odd one holds the way along
    positions = line(30)
    misled = np.zeros((30, 6))
    misled[:, 3] = 5.0
    measured = stack(np.eye(4), 30)
    measured[:, 0, 3] = stretch * (positions[:, 0] + 5.0)
    information = known(30)
    information[np.arange(30) % 4 != 0, 3] = 0.0
    graph = solve(positions, measured, information, misled)
    assert graph.stretch == pytest.approx(stretch, rel=0.02)
    np.testing.assert_allclose(
        positions_map(graph.before_T_after, positions)[:, 0], (1 + stretch) * positions[:, 0], atol=2e-3
    )


def test_between_anchors_and_beyond_them_the_stretch_goes_on() -> None:
    graph = PoseGraph(np.array([[0.0, 0, 0], [10.0, 0, 0]]), stack(np.eye(4), 2), 0.01)
    graph.before_T_after[1, 0, 3] = 0.1
    along = np.array([-3.0, 0.0, 2.0, 10.0, 14.0])
    places = np.column_stack([along, np.ones(5), np.zeros(5)])
    found = graph.at(np.array([0.0, 10.0]), along, places)
    expected = places + 0.01 * places * np.array([1, 0, 0])
    # a place beside the path is a metre from it in both frames, but for the stretch
    np.testing.assert_allclose(positions_map(found, places), expected, atol=0.011)
    np.testing.assert_allclose(positions_map(found, places)[:, 0], expected[:, 0], atol=1e-12)


def test_turns_are_shared_between_two_anchors() -> None:
    graph = PoseGraph(np.array([[0.0, 0, 0], [10.0, 0, 0]]), np.array([np.eye(4), yaw_pose(0.1)]), 0.0)
    (found,) = graph.at(np.array([0.0, 10.0]), np.array([2.5]), np.array([[2.5, 0, 0]]))
    np.testing.assert_allclose(found[:3, :3], yaw_pose(0.025)[:3, :3], atol=1e-12)


def test_one_anchor_speaks_for_all_places() -> None:
    graph = PoseGraph(np.array([[1.0, 2, 3]]), yaw_pose(0.3, (1.0, 2.0, 3.0))[None], 0.0)
    found = graph.at(np.zeros(1), np.array([0.0, 5.0]), np.array([[1.0, 2, 3], [6.0, 2, 3]]))
    np.testing.assert_allclose(found, stack(yaw_pose(0.3, (1.0, 2.0, 3.0)), 2), atol=1e-12)
