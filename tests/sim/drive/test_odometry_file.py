"""A TUM file of one's own as a session's odometry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.io.tum import motion_through
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Odometry, Platform, Scenario, SessionPlan
from sim.drive.odometry import read_odometry
from sim.session.simulate import simulate_in_memory


def written(path: Path, stamps_s: Float64Array, shift_m: float = 0.0) -> Path:
    """A path of 1 m/s along x that turns by 0.1 rad/s."""
    turns = Rotation.from_euler("z", 0.1 * stamps_s[:, None]).as_quat()
    points = np.column_stack([stamps_s + shift_m, np.zeros((len(stamps_s), 2))])
    np.savetxt(path, np.column_stack([stamps_s, points, turns]))
    return path


def poses(path: Path, sensor: SensorMetadata, middle_s: Float64Array) -> Float64Array:
    return read_odometry(path, middle_s, sensor.column_offsets_ns(), "after").poses(middle_s)


def test_poses_are_interpolated_at_the_time_since_the_session_s_first_column(
    tmp_path: Path, sensor: SensorMetadata
) -> None:
    middle_s = np.array([7.0, 7.5, 9.0])  # of the drive; the clock of the session starts half a revolution earlier
    found = poses(written(tmp_path / "own.tum", np.arange(0.0, 3.01, 0.25)), sensor, middle_s)
    stamps_s = middle_s - 7.0 + sensor.column_offsets_ns()[sensor.width // 2] / 1e9
    np.testing.assert_allclose(found[:, 0, 3], stamps_s, atol=1e-12)
    np.testing.assert_allclose(np.arctan2(found[:, 1, 0], found[:, 0, 0]), 0.1 * stamps_s, atol=1e-12)


def test_one_pose_for_each_revolution_is_enough_however_far_they_are_apart(
    tmp_path: Path, sensor: SensorMetadata
) -> None:
    middle_s = np.array([7.0, 9.5, 13.0])
    stamps_s = middle_s - 7.0 + sensor.column_offsets_ns()[sensor.width // 2] / 1e9
    found = poses(written(tmp_path / "own.tum", stamps_s), sensor, middle_s)
    np.testing.assert_allclose(found[:, 0, 3], stamps_s, atol=1e-12)


def test_an_open_end_goes_on_as_over_the_revolution_beside_it_not_as_between_two_noisy_poses(
    tmp_path: Path, sensor: SensorMetadata
) -> None:
    middle_s = np.array([7.0, 8.5, 10.0])  # the session's clock: columns from 0.0 to 3.1 s
    path = written(tmp_path / "own.tum", np.arange(0.09, 3.011, 0.005))
    rows = np.loadtxt(path)
    rows[[1, -2], 2] += 0.003  # 5 ms from the ends: without care, 0.003 / 0.005 * 0.09 = 54 mm at the first column
    rows[[1, -2], 4:] = (Rotation.from_rotvec([0.001, 0, 0]) * Rotation.from_quat(rows[[1, -2], 4:])).as_quat()
    np.savetxt(path, rows)
    stamps_s = np.array([[0.0, 0.04], [3.05, 3.09]])
    found = read_odometry(path, middle_s, sensor.column_offsets_ns(), "after").poses(stamps_s + 6.95)
    np.testing.assert_allclose(found[..., :3, 3], stamps_s[..., None] * [1.0, 0.0, 0.0], atol=1e-9)
    turns = Rotation.from_euler("z", 0.1 * stamps_s.reshape(-1, 1)).as_matrix()
    np.testing.assert_allclose(found[..., :3, :3].reshape(-1, 3, 3), turns, atol=1e-9)


@pytest.mark.parametrize(
    "stamps_s",
    [
        np.arange(0.05, 3.1, 0.1) + 0.004 * np.arange(31) % 0.009,
        np.arange(-0.2, 3.4, 0.005),
        np.array([0.05, 1.0, 1.5]),
    ],
    ids=["one a revolution", "dense and whole", "sparse"],
)
def test_a_file_that_is_sparse_or_whole_has_the_poses_of_its_lines_to_the_bit(
    tmp_path: Path, sensor: SensorMetadata, stamps_s: Float64Array
) -> None:
    path = written(tmp_path / "own.tum", stamps_s)
    middle_s = np.array([7.0, 7.5, 8.5])
    found = read_odometry(path, middle_s, sensor.column_offsets_ns(), "after")
    plain = motion_through(np.loadtxt(path), 0.05 - 7.0)
    column_s = np.linspace(6.95, 8.55, 999)
    np.testing.assert_array_equal(found.poses(column_s), plain.poses(column_s))


@pytest.mark.parametrize(
    ("stamps_s", "rule"),
    [
        (np.arange(0.0, 1.01, 0.25), r"after: .*own.tum: covers 0.000 to 1.000 s, the session 0.050 to 3.050 s"),
        (np.arange(100.0, 104.0, 0.25), r"own.tum: covers 100.000 to 103.750 s"),
        (np.array([0.0, 0.5, 2.5, 3.1]), r"own.tum:3: no pose for 2.00 s before it, .* a revolution at 1.550 s"),
    ],
)
def test_a_file_that_does_not_cover_the_session_is_refused(
    tmp_path: Path, sensor: SensorMetadata, stamps_s: Float64Array, rule: str
) -> None:
    path = written(tmp_path / "own.tum", stamps_s)
    with pytest.raises(InputError, match=rule) as error:
        poses(path, sensor, np.array([7.0, 8.5, 10.0]))
    assert len(str(error.value).splitlines()) == 1


def test_positions_beyond_what_cells_of_the_truth_number_are_refused_when_the_file_is_read(
    tmp_path: Path, sensor: SensorMetadata
) -> None:
    stamps_s, middle_s = np.arange(0.0, 3.01, 0.25), np.array([7.0, 8.5, 10.0])
    limit_m = (2**20 - 1) * 0.1  # 21 bits for each axis
    assert poses(written(tmp_path / "near.tum", stamps_s, limit_m - 540.0), sensor, middle_s).shape == (3, 4, 4)
    path = written(tmp_path / "grid.tum", stamps_s, 500_000.0)
    with pytest.raises(InputError, match=r"^after: .*grid.tum: .*subtract") as error:
        poses(path, sensor, middle_s)
    assert len(str(error.value).splitlines()) == 1


def test_a_session_has_the_poses_of_its_file_and_the_truth_its_digest(
    tmp_path: Path, make_scenario: Callable[..., Scenario]
) -> None:
    path = written(tmp_path / "own.tum", np.arange(0.0, 20.0, 0.1), shift_m=5.0)
    plan = SessionPlan(route=("a", "b"), start_m=6.0, end_m=6.0, odometry=Odometry(file=str(path)))
    assert plan.odometry.source == "file"
    pair = simulate_in_memory(make_scenario(before=plan, platform=Platform(scan_spacing_m=4.0)), 1)
    found = pair.sessions["before"].session.odom_T_sensor
    np.testing.assert_allclose(found[:, :3, 3], [(5.05, 0.0, 0.0), (9.05, 0.0, 0.0)], atol=1e-3)
    assert list(pair.truth.files) == [str(path)]
