from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, yaw_pose
from cdpipe.io.readers import open_session
from cdpipe.io.session import ScanChunk, SessionWriter
from cdpipe.mapping.deskew import deskew, deskew_anew
from cdpipe.mapping.poses.scan_registration import motion_through
from cdpipe.model.types import PosedScan
from cdpipe.sensor.ouster import SensorMetadata, load_profile

ROOM_M = np.array([6.0, 4.0, 2.5])  # half extents


@pytest.fixture(scope="module")
def sensor() -> SensorMetadata:
    return load_profile("os1-32-u0", "512x10")


def pose_at(turn: float) -> Float64Array:
    """World pose after `turn` revolutions: 2 m/s forward, half a turn a second, nodding."""
    time_s = turn / 10.0
    rotation = Rotation.from_euler("zyx", [np.pi * time_s, 0.05 * np.sin(40 * time_s), 0.03 * np.cos(30 * time_s)])
    return make_pose(rotation.as_matrix(), (2.0 * time_s - 1.0, 0.3 * time_s, 0.1 * np.sin(20 * time_s)))


def revolution(sensor: SensorMetadata, index: int) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Ranges (H, W), column poses (W, 7) and world_T_sensor of one revolution in a box room, in closed form."""
    world_T_sensor = pose_at(index + 0.5)
    ranges = np.empty((sensor.height, sensor.width))
    column_poses = np.empty((sensor.width, 7))
    for column in range(sensor.width):
        world_T_column = pose_at(index + column / sensor.width)
        sensor_T_column = invert(world_T_sensor) @ world_T_column
        column_poses[column, :3] = sensor_T_column[:3, 3]
        column_poses[column, 3:] = Rotation.from_matrix(sensor_T_column[:3, :3]).as_quat()
        origins = transform(world_T_column, sensor.origins[:, column])
        directions = sensor.directions[:, column] @ world_T_column[:3, :3].T
        to_walls = (np.sign(directions) * ROOM_M - origins) / directions
        ranges[:, column] = to_walls.min(axis=1) + sensor.beam_origin_m
    return ranges, column_poses, world_T_sensor


def wall_distance_m(points_world: Float64Array) -> Float64Array:
    return np.abs(np.abs(points_world) - ROOM_M).min(axis=-1)


def test_a_moving_turning_sensor_sees_flat_walls(sensor: SensorMetadata) -> None:
    ranges, column_poses, world_T_sensor = revolution(sensor, 0)
    skewed = sensor.project(ranges)
    points = deskew(skewed, column_poses)
    assert wall_distance_m(transform(world_T_sensor, points.reshape(-1, 3))).max() < 1e-9
    # without deskewing the same points miss the walls by far: the test can fail
    assert np.quantile(wall_distance_m(transform(world_T_sensor, skewed.reshape(-1, 3))), 0.9) > 0.1


def test_through_the_session_format_walls_stay_flat_to_the_range_step(sensor: SensorMetadata, tmp_path: Path) -> None:
    revolutions = [revolution(sensor, index) for index in range(3)]
    stamps = np.arange(3)[:, None] * 100_000_000 + sensor.column_offsets_ns().astype(np.int64)
    range_mm = np.round(np.array([ranges for ranges, _, _ in revolutions]) * 1000).astype(np.uint32)
    range_mm[:, 5, 7] = 0
    poses = np.array([pose for _, _, pose in revolutions])
    with SessionWriter(tmp_path / "room", sensor, chunk_scans=2, provenance={}) as writer:
        for part in (slice(0, 2), slice(2, 3)):
            columns = np.array([column_poses for _, column_poses, _ in revolutions[part]], dtype=np.float32)
            dark = np.zeros(range_mm[part].shape, dtype=np.uint8)
            writer.add(ScanChunk(range_mm[part], dark, dark.astype(np.uint16), stamps[part], columns))
        writer.close(poses)
    source = open_session(tmp_path / "room")
    assert len(source.odom_T_sensor) == 3
    for index, scan in enumerate(source.scans()):
        assert scan.index == index
        assert len(scan.pixels) == sensor.height * sensor.width - 1
        assert 5 * sensor.width + 7 not in scan.pixels
        assert wall_distance_m(transform(scan.odom_T_sensor, scan.points_sensor)).max() < 0.5e-3 + 1e-6
        np.testing.assert_array_equal(scan.stamps_ns, stamps[index][scan.pixels % sensor.width])


def test_deskewing_commutes_with_a_rigid_motion_of_the_revolution() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4, 3, 3))
    turn = yaw_pose(0.4, (1.0, 2.0, 3.0))
    identity = np.tile([0.0, 0, 0, 0, 0, 0, 1], (3, 1))
    moved = np.tile([*turn[:3, 3], *Rotation.from_matrix(turn[:3, :3]).as_quat()], (3, 1))
    np.testing.assert_allclose(deskew(points, identity), points, atol=1e-15)
    expected = transform(turn, points.reshape(-1, 3)).reshape(points.shape)
    np.testing.assert_allclose(deskew(points, moved), expected, atol=1e-14)


def test_the_number_of_column_poses_must_fit() -> None:
    with pytest.raises(ValueError, match=r"column_poses must be \(3, 7\), got \(2, 7\)"):
        deskew(np.zeros((4, 3, 3)), np.zeros((2, 7)))


def test_a_scan_is_deskewed_anew_by_another_motion(sensor: SensorMetadata) -> None:
    ranges, _, world_T_sensor = revolution(sensor, 0)
    time_s = np.arange(0, 0.1001, 0.0005)
    true = motion_through(time_s, np.array([pose_at(10 * each) for each in time_s]))
    wrong = motion_through(np.array([0.0, 0.1]), np.array([pose_at(0), yaw_pose(-1.0, (0.3, 0.2, 0.0))]))
    column_s = np.arange(sensor.width) / sensor.width * 0.1
    sensor_T_column = invert(wrong.poses(np.array([0.05]))) @ wrong.poses(column_s)
    quaternions = Rotation.from_matrix(sensor_T_column[:, :3, :3]).as_quat()
    points = deskew(sensor.project(ranges), np.column_stack([sensor_T_column[:, :3, 3], quaternions])).reshape(-1, 3)
    stamps_ns = np.tile(np.round(column_s * 1e9).astype(np.int64), sensor.height)
    pixels = np.arange(len(points), dtype=np.int32)
    scan = PosedScan(0, points, np.eye(4), stamps_ns, pixels, pose_ns=50_000_000)
    assert np.median(wall_distance_m(transform(world_T_sensor, points))) > 0.1
    anew = deskew_anew(scan, wrong, true)
    assert wall_distance_m(transform(world_T_sensor, anew.points_sensor)).max() < 1e-3
    assert deskew_anew(replace(scan, pose_ns=None), wrong, true).points_sensor is points
