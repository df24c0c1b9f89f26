from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cdpipe.errors import ScenarioError
from cdpipe.geometry import invert, make_pose, require_poses, travelled_m, yaw_rad
from cdpipe.ouster import SensorMetadata
from scenarios.schema import Odometry, Platform, Prop, Scenario, SessionPlan
from sim.path import Path, plan_path, smoothed
from sim.placing import standing_corners
from sim.scene import build_world
from sim.trajectory import Motion, plan_trajectory, record, true_motion


def straight_path(length_m: float, heading_rad: float = 0.4) -> Path:
    distance_m = np.linspace(0.0, length_m, round(length_m / 0.05) + 1)
    points = distance_m[:, None] * [np.cos(heading_rad), np.sin(heading_rad), 0.0] + [3.0, -2.0, 1.0]
    return Path(distance_m, points, np.full(len(points), heading_rad), np.zeros(len(points)))


def recorded(path: Path, odometry: Odometry, sensor: SensorMetadata, seed: int = 0, spacing_m: float = 0.5):  # type: ignore[no-untyped-def] # noqa: ANN201 - the fixture's type says nothing to a test
    platform = Platform(scan_spacing_m=spacing_m, tilt_deg=0.0)
    return record(true_motion(path, platform, seed, "before"), odometry, platform, sensor, seed, "before")


def test_odometry_drifts_by_exactly_its_figures_on_a_straight_line(sensor: SensorMetadata) -> None:
    signs = set()
    for seed in range(8):
        drive = recorded(straight_path(100.1), Odometry(translation_percent=1.5, yaw_deg_per_100m=2.0), sensor, seed)
        true, estimated = drive.world_T_sensor, drive.odom_T_sensor
        way_m = travelled_m(true)[200]
        assert way_m == pytest.approx(100.0, abs=1e-9)
        # Chords of a heading that drifts by 2 deg over 200 steps are shorter than their arcs by less than 1e-8.
        scale = travelled_m(estimated)[200] / way_m
        turn_deg = np.rad2deg(yaw_rad(invert(estimated[0]) @ estimated[200]))
        assert abs(scale - 1.0) == pytest.approx(0.015, abs=1e-7)
        assert abs(turn_deg) == pytest.approx(2.0, abs=1e-9)
        # The straight line becomes an arc: radius L / theta, end at (R sin theta, R (1 - cos theta)).
        theta, arc_m = np.deg2rad(turn_deg), 100.0 * scale
        end = (arc_m / theta * np.sin(theta), arc_m / theta * (1 - np.cos(theta)), 0.0)
        np.testing.assert_allclose(estimated[200, :3, 3], end, atol=1e-6)
        signs.add((scale > 1.0, turn_deg > 0.0))
    assert len(signs) > 2


def test_perfect_odometry_is_the_truth_seen_from_the_first_revolution(sensor: SensorMetadata) -> None:
    drive = recorded(straight_path(30.0), Odometry(), sensor)
    world_T_odom = drive.world_T_sensor[0]
    np.testing.assert_allclose(drive.odom_T_sensor[0], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(world_T_odom @ drive.odom_T_sensor, drive.world_T_sensor, atol=1e-9)


def test_the_odom_frame_is_upright_even_where_the_platform_tilts(sensor: SensorMetadata) -> None:
    platform = Platform(tilt_deg=3.0, scan_spacing_m=0.5)
    motion = true_motion(straight_path(60.0), platform, 1, "after")
    drive = record(motion, Odometry(yaw_deg_per_100m=1.0), platform, sensor, 1, "after")
    first = drive.odom_T_sensor[0]
    np.testing.assert_allclose(first[:3, 3], 0.0, atol=1e-9)
    assert yaw_rad(first) == pytest.approx(0.0, abs=1e-9)
    # Gravity is the same in both frames.
    np.testing.assert_allclose(drive.odom_T_sensor[:, 2, :3], drive.world_T_sensor[:, 2, :3], atol=1e-9)
    tilt_deg = np.rad2deg(motion.angles_rad[:, 1:])
    assert 1.5 < tilt_deg.std() < 4.5


def test_the_pose_of_a_revolution_is_that_of_its_middle_column(sensor: SensorMetadata) -> None:
    drive = recorded(straight_path(20.0), Odometry(translation_percent=1.0), sensor, spacing_m=0.7)
    scans = slice(3, 9)
    columns = drive.world_T_column(scans)
    middle = sensor.width // 2
    np.testing.assert_allclose(columns[:, middle], drive.world_T_sensor[scans], atol=1e-12)
    # At 1 m/s and 10 Hz the head moves 10 cm in a revolution, less the last column's step.
    moved_m = np.linalg.norm(columns[:, -1, :3, 3] - columns[:, 0, :3, 3], axis=1)
    np.testing.assert_allclose(moved_m, 0.1 * (1 - 1 / sensor.width), atol=1e-9)
    relative = drive.sensor_T_column(scans)
    np.testing.assert_allclose(relative[:, middle], np.tile([0, 0, 0, 0, 0, 0, 1.0], (6, 1)), atol=1e-7)
    assert abs(np.linalg.norm(relative[:, 0, :3], axis=1) - 0.05).max() < 1e-3
    stamps = drive.column_stamps_ns(slice(0, 3))
    assert stamps[0, 0] == 0
    np.testing.assert_array_equal(np.diff(stamps[:, 0]), 700_000_000)
    assert stamps[1, -1] - stamps[1, 0] == round(1e8 * (1 - 1 / sensor.width))


def test_rotation_is_yaw_then_pitch_then_roll() -> None:
    motion = Motion(np.array([0.0, 1.0]), np.zeros((2, 3)), np.tile([0.3, 0.2, 0.1], (2, 1)))
    pose = motion.poses(np.array([0.5]))
    require_poses("pose", pose)
    # A nose-down pitch of a sensor that looks along +x is positive about y: x ends below the horizon.
    assert pose[0, 2, 0] == pytest.approx(-np.sin(0.2))
    assert yaw_rad(pose[0]) == pytest.approx(0.3)
    assert pose[0, 2, 1] == pytest.approx(np.cos(0.2) * np.sin(0.1))


def test_a_line_keeps_to_its_side_and_height(make_scenario: Callable[..., Scenario]) -> None:
    scenario = make_scenario()
    world = build_world(scenario, 0)
    for session, lateral, start_m, end_m in (("before", -0.2, 2.0, 2.0), ("after", 0.2, 3.0, 1.0)):
        path = plan_path(world, scenario, session)
        # A drift 4 m wide leaves 1.5 m to either side of a platform that keeps 0.5 m.
        np.testing.assert_allclose(path.points[:, 1], lateral * 1.5, atol=0.02)
        assert path.points[0, 0] == pytest.approx(start_m, abs=0.1)
        assert path.points[-1, 0] == pytest.approx(20 - end_m, abs=0.1)
        floor_m, _, _ = world.walls.cast(path.points, np.tile([0.0, 0.0, -1.0], (len(path.points), 1)))
        assert np.abs(floor_m - 0.8).max() < 0.05
        np.testing.assert_allclose(np.diff(path.distance_m), 0.05, rtol=0.05)


def test_a_line_bends_round_props_and_quadrotors_fly_over_low_ones(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    scenario = make_scenario(props=(make_prop("box", 0.5, -0.1, 30.0),))
    world = build_world(scenario, 0)
    path = plan_path(world, scenario, "before")
    corners = standing_corners(world.standing[0])
    outline = np.concatenate([np.linspace(corners[i], corners[(i + 1) % 4], 40) for i in range(4)])
    gap_m = np.linalg.norm(path.points[:, None, :2] - outline[None], axis=2).min()
    assert 0.45 < gap_m < 0.75  # platform.clearance_m is 0.5
    assert np.abs(np.diff(path.yaw_rad)).max() < np.deg2rad(5.0)
    flying = scenario.model_copy(update={"platform": Platform(kind="quadrotor", sensor_height_m=1.6)})
    np.testing.assert_allclose(plan_path(world, flying, "before").points[:, 1], -0.3, atol=0.05)


def test_a_line_winds_between_props_on_both_sides(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    left, right = (make_prop(name, place, side, size_m=(0.7, 1.6, 0.7)) for name, place, side in _CHICANE)
    scenario = make_scenario(props=(left, right))
    world = build_world(scenario, 0)
    path = plan_path(world, scenario, "before")
    for item in world.standing:
        corners = standing_corners(item)
        outline = np.concatenate([np.linspace(corners[i], corners[(i + 1) % 4], 40) for i in range(4)])
        gap_m = np.linalg.norm(path.points[:, None, :2] - outline[None], axis=2).min()
        assert gap_m > 0.7 * 0.5 - 0.02  # of the clearance of 0.5 m at most 30 % may be given up
    left, right = (make_prop(name, place, side, size_m=(0.7, 2.0, 0.7)) for name, place, side in _CLOSE)
    closer = make_scenario(props=(left, right))
    with pytest.raises(ScenarioError, match="before: props on both sides leave no smooth way"):
        plan_path(build_world(closer, 0), closer, "before")


_CHICANE = (("left", 0.4, 1.0), ("right", 0.5, -1.0))
_CLOSE = (("left", 0.4, 1.0), ("right", 0.487, -1.0))


def test_impossible_drives_are_refused(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata
) -> None:
    def plan(**override: object) -> None:
        scenario = make_scenario(**override)
        plan_trajectory(build_world(scenario, 0), scenario, sensor, 0, "before")

    with pytest.raises(ScenarioError, match=r"before: prop 'wall' bars the way \d+\.\d m along the route"):
        plan(props=(make_prop("wall", 0.5, 0.0, size_m=(0.5, 2.9, 0.8)),))
    with pytest.raises(ScenarioError, match=r"before: the walls leave \d\.\d\d m .* 4\.40 m are needed"):
        plan(platform=Platform(clearance_m=2.2))
    with pytest.raises(ScenarioError, match=r"before: the route is 20\.0 m long"):
        plan(before=SessionPlan(route=("a", "b"), start_m=12.0, end_m=7.0))
    with pytest.raises(ScenarioError, match="before: the sensor comes within"):
        plan(before=SessionPlan(route=("a", "b"), height_m=2.94))
    with pytest.raises(ScenarioError, match=r"before\.route turns back at node 'b'"):
        plan(before=SessionPlan(route=("a", "b", "a")))
    with pytest.raises(ScenarioError, match=r"platform\.scan_spacing_m = 0\.05: .* revolutions are 0\.1 m apart"):
        plan(platform=Platform(scan_spacing_m=0.05))


def test_smoothing_keeps_straight_lines_and_ends() -> None:
    ramp = np.linspace(2.0, 9.0, 200)
    np.testing.assert_allclose(smoothed(ramp, 1.0), ramp, atol=1e-12)
    bent = np.abs(np.linspace(-1, 1, 201))
    assert smoothed(bent, 1.0)[[0, -1]] == pytest.approx([1.0, 1.0])
    assert smoothed(bent, 1.0)[100] > 0.02
    assert make_pose().shape == (4, 4)
