from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, invert, require_poses, travelled_m, yaw_rad
from cdpipe.core.geometry.motion import Motion, make_motion
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Floor, Odometry, Platform, Prop, Scenario, SessionPlan, Stones
from sim.drive.obstacles import pass_obstacles, sidestep
from sim.drive.path import plan_path
from sim.drive.ride import follow_floor
from sim.drive.trajectory import Trajectory, plan_trajectory, record
from sim.geometry.line import smooth_between, smooth_line
from sim.geometry.raycast import Caster
from sim.geometry.sweep import bars
from sim.placement.placing import standing_corners
from sim.scene import build_world


def straight(length_m: float, speed_mps: float = 1.0, heading_rad: float = 0.4) -> Motion:
    way_m = np.linspace(0.0, length_m, round(length_m / 0.05) + 1)
    points = way_m[:, None] * [np.cos(heading_rad), np.sin(heading_rad), 0.0] + [3.0, -2.0, 1.0]
    heading = Rotation.from_euler("z", np.full((len(way_m), 1), heading_rad))
    return make_motion(way_m / speed_mps, way_m, points, heading)


@pytest.fixture(scope="module")
def recorded(make_scenario: Callable[..., Scenario], sensor: SensorMetadata) -> Callable[..., Trajectory]:
    def make(motion: Motion, odometry: Odometry, seed: int = 0, spacing_m: float = 0.5) -> Trajectory:
        plan = SessionPlan(route=("a", "b"), odometry=odometry)
        scenario = make_scenario(platform=Platform(scan_spacing_m=spacing_m), before=plan)
        return record(motion, scenario, sensor, seed, "before")

    return make


def test_odometry_drifts_by_exactly_its_figures_on_a_straight_line(recorded: Callable[..., Trajectory]) -> None:
    signs = set()
    for seed in range(8):
        drive = recorded(straight(100.1), Odometry(translation_percent=1.5, yaw_deg_per_100m=2.0), seed)
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


def test_perfect_odometry_is_the_truth_seen_from_the_first_revolution(recorded: Callable[..., Trajectory]) -> None:
    drive = recorded(straight(30.0), Odometry())
    world_T_odom = drive.world_T_sensor[0]
    np.testing.assert_allclose(drive.odom_T_sensor[0], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(world_T_odom @ drive.odom_T_sensor, drive.world_T_sensor, atol=1e-9)


def test_the_odom_frame_is_upright_even_where_the_platform_tilts(recorded: Callable[..., Trajectory]) -> None:
    level = straight(60.0)
    angles = np.array([0.4, 0.0, 0.0]) + 0.05 * np.sin(level.way_m[:, None] * [0.0, 1.1, 1.7] + 0.3)
    tilted = make_motion(level.time_s, level.way_m, level.points, Rotation.from_euler("ZYX", angles))
    drive = recorded(tilted, Odometry(yaw_deg_per_100m=1.0), 1)
    first = drive.odom_T_sensor[0]
    np.testing.assert_allclose(first[:3, 3], 0.0, atol=1e-9)
    assert yaw_rad(first) == pytest.approx(0.0, abs=1e-9)
    # Gravity is the same in both frames.
    np.testing.assert_allclose(drive.odom_T_sensor[:, 2, :3], drive.world_T_sensor[:, 2, :3], atol=1e-9)
    assert np.abs(drive.odom_T_sensor[:, 2, 0]).max() > 0.04


def test_the_pose_of_a_revolution_is_that_of_its_middle_column(
    recorded: Callable[..., Trajectory], sensor: SensorMetadata
) -> None:
    drive = recorded(straight(20.0), Odometry(translation_percent=1.0), spacing_m=0.7)
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


def test_column_poses_of_a_sensor_that_tumbles(sensor: SensorMetadata) -> None:
    time_s = np.linspace(0.0, 1.0, 11)
    rotations = Rotation.random(11, random_state=3)
    motion = make_motion(time_s, time_s, np.random.default_rng(1).normal(size=(11, 3)), rotations)
    column_s = (np.arange(sensor.width) - sensor.width // 2) / sensor.width * 0.1
    drive = Trajectory(motion, motion, np.array([0.25, 0.55, 0.75]), column_s, sensor.column_offsets_ns())
    columns = drive.sensor_T_column(slice(0, 3))
    assert (columns[..., 6] >= 0).all()
    for number, revolution_s in enumerate(drive.revolution_s):
        middle = motion.poses(np.array([revolution_s]))[0]
        wanted = np.linalg.inv(middle) @ motion.poses(revolution_s + column_s)
        np.testing.assert_allclose(columns[number, :, :3], wanted[:, :3, 3], atol=1e-6)
        np.testing.assert_allclose(Rotation.from_quat(columns[number, :, 3:]).as_matrix(), wanted[:, :3, :3], atol=1e-6)


def test_stamps_are_true_to_a_speed_that_varies(recorded: Callable[..., Trajectory], sensor: SensorMetadata) -> None:
    # By hand: speed 1 + t / 50 m/s gives the way t + t^2 / 100.
    time_s = np.linspace(0.0, 20.0, 401)
    way_m = time_s + time_s**2 / 100
    motion = make_motion(time_s, way_m, way_m[:, None] * [1.0, 0.0, 0.0], Rotation.identity(len(time_s)))
    drive = recorded(motion, Odometry(), spacing_m=0.5)
    stamps_s = drive.column_stamps_ns(slice(None)) / 1e9 + drive.revolution_s[0] + drive.column_s[0]
    columns = drive.world_T_column(slice(None))
    np.testing.assert_allclose(columns[:, :, 0, 3], stamps_s + stamps_s**2 / 100, atol=1e-4)
    # The head turns at 10 Hz whatever the speed, so kept revolutions lie a whole number of turns apart.
    turns = (drive.revolution_s - 0.05) * 10
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    # Each is the first one at or after its half metre.
    late_m = drive.world_T_sensor[:, 0, 3] - drive.world_T_sensor[0, 0, 3] - 0.5 * np.arange(drive.n_scans)
    assert (late_m > -1e-6).all()
    assert (late_m < 0.1 * (1 + drive.revolution_s / 50)).all()
    in_turn_m = columns[:, -1, 0, 3] - columns[:, 0, 0, 3]
    np.testing.assert_allclose(in_turn_m, 0.1 * (1 + drive.revolution_s / 50) * (1 - 1 / sensor.width), atol=1e-4)


def test_a_standing_robot_records_once_where_it_stands(recorded: Callable[..., Trajectory]) -> None:
    time_s = np.array([0.0, 4.0, 14.0, 20.0])
    way_m = np.array([0.0, 4.0, 4.0, 10.0])
    drive = recorded(make_motion(time_s, way_m, way_m[:, None] * [1.0, 0.0, 0.0], Rotation.identity(4)), Odometry())
    assert drive.n_scans == 1 + 2 * 9 + 1
    assert (np.diff(drive.world_T_sensor[:, 0, 3]) > 0.35).all()


def test_rotations_turn_evenly_between_samples_and_beyond() -> None:
    turns = Rotation.from_rotvec(np.outer([0.0, 1.2, 1.2], [0.6, 0.0, 0.8]))
    motion = make_motion(np.array([0.0, 2.0, 3.0]), np.zeros(3), np.array([[0.0] * 3, [4.0, 0, 0], [4.0, 0, 0]]), turns)
    poses = motion.poses(np.array([-0.5, 0.5, 1.5, 2.5]))
    require_poses("poses", poses)
    expected = Rotation.from_rotvec(np.outer([-0.3, 0.3, 0.9, 1.2], [0.6, 0.0, 0.8])).as_matrix()
    np.testing.assert_allclose(poses[:, :3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(poses[:, 0, 3], [-1.0, 1.0, 3.0, 4.0], atol=1e-12)
    # q and -q are the same rotation: no way round.
    flipped = Rotation.from_quat(turns.as_quat() * [[1], [-1], [1]])
    again = make_motion(motion.time_s, motion.way_m, motion.points, flipped)
    np.testing.assert_allclose(again.poses(np.array([1.5]))[0], poses[2], atol=1e-12)


def test_a_line_keeps_to_its_side(make_scenario: Callable[..., Scenario]) -> None:
    scenario = make_scenario()
    world = build_world(scenario, 0)
    for session, lateral, start_m, end_m in (("before", -0.2, 2.0, 2.0), ("after", 0.2, 3.0, 1.0)):
        path = plan_path(world, scenario, 0, session)
        # A drift 4 m wide leaves 1.5 m to either side of a platform that keeps 0.5 m.
        np.testing.assert_allclose(path.points[:, 1], lateral * 1.5, atol=0.02)
        assert path.points[0, 0] == pytest.approx(start_m, abs=0.1)
        assert path.points[-1, 0] == pytest.approx(20 - end_m, abs=0.1)
        np.testing.assert_allclose(np.diff(path.distance_m), 0.05, rtol=0.05)


def test_the_other_way_round_is_the_same_line_driven_backwards(make_scenario: Callable[..., Scenario]) -> None:
    there = make_scenario()
    world = build_world(there, 0)
    back = there.model_copy(update={"before": SessionPlan(route=("b", "a"), lateral=0.2, start_m=2.0, end_m=2.0)})
    ahead, reverse = plan_path(world, there, 0, "before"), plan_path(world, back, 0, "before")
    np.testing.assert_allclose(reverse.points[::-1], ahead.points, atol=0.01)
    np.testing.assert_allclose(np.abs(reverse.yaw_rad[::-1] - ahead.yaw_rad), np.pi, atol=0.01)


def test_a_line_wanders_where_there_is_room(make_scenario: Callable[..., Scenario]) -> None:
    scenario = make_scenario(platform=Platform(wander_m=0.3))
    world = build_world(scenario, 0)
    lines = [plan_path(world, scenario, seed, "before").points[:, 1] + 0.3 for seed in range(12)]
    assert (
        0.2
        < np.concatenate([np.interp(np.linspace(0, 1, 50), np.linspace(0, 1, len(y)), y) for y in lines]).std()
        < 0.4
    )
    wild = scenario.model_copy(update={"platform": Platform(wander_m=30.0)})
    points = plan_path(world, wild, 0, "before").points
    assert np.abs(points[:, 1]).max() <= 1.5 + 1e-9  # 2 m less the clearance
    assert np.ptp(points[:, 1]) > 1.0


def test_a_line_bends_round_props_and_quadrotors_fly_over_low_ones(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    scenario = make_scenario(props=(make_prop("box", 0.5, -0.1, 30.0),))
    world = build_world(scenario, 0)
    path = plan_path(world, scenario, 0, "before")
    corners = standing_corners(world.standing[0])
    outline = np.concatenate([np.linspace(corners[i], corners[(i + 1) % 4], 40) for i in range(4)])
    gap_m = np.linalg.norm(path.points[:, None, :2] - outline[None], axis=2).min()
    assert 0.45 < gap_m < 0.75  # platform.clearance_m is 0.5
    assert np.abs(np.diff(path.yaw_rad)).max() < np.deg2rad(5.0)
    flying = scenario.model_copy(update={"platform": Platform(kind="quadrotor", sensor_height_m=1.6)})
    np.testing.assert_allclose(plan_path(world, flying, 0, "before").points[:, 1], -0.3, atol=0.05)


def test_a_line_winds_between_props_on_both_sides(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    left, right = (make_prop(name, place, side, size_m=(0.7, 1.6, 0.7)) for name, place, side in _CHICANE)
    scenario = make_scenario(props=(left, right))
    world = build_world(scenario, 0)
    path = plan_path(world, scenario, 0, "before")
    for item in world.standing:
        corners = standing_corners(item)
        outline = np.concatenate([np.linspace(corners[i], corners[(i + 1) % 4], 40) for i in range(4)])
        gap_m = np.linalg.norm(path.points[:, None, :2] - outline[None], axis=2).min()
        assert gap_m > 0.7 * 0.5 - 0.02  # of the clearance of 0.5 m at most 30 % may be given up
    left, right = (make_prop(name, place, side, size_m=(0.7, 2.0, 0.7)) for name, place, side in _CLOSE)
    closer = make_scenario(props=(left, right))
    with pytest.raises(ScenarioError, match="before: props "):
        plan_path(build_world(closer, 0), closer, 0, "before")


def barring(first: int, end: int, low_m: float, high_m: float) -> tuple[Float64Array, Float64Array]:
    """What an obstacle forbids, of a line of 200 samples."""
    low, high = np.full(200, np.nan), np.full(200, np.nan)
    low[first:end], high[first:end] = low_m, high_m
    return low, high


@pytest.mark.parametrize("more", [(), (barring(95, 140, 1.0, 3.5),)])
def test_sides_are_chosen_together_where_the_nearest_ones_leave_no_room(
    more: tuple[tuple[Float64Array, Float64Array], ...],
) -> None:
    wanted, low, high = (np.full(200, each) for each in (-2.0, -3.0, 3.0))
    # alone, the first one is passed between it and the wall, half a metre away; the second leaves no room there
    obstacles = (barring(50, 90, -2.5, -1.0), barring(70, 110, -3.5, -2.2), *more)
    assert sidestep(wanted, low.copy(), high.copy(), *obstacles[0]) is None
    assert pass_obstacles(wanted, low, high, obstacles) is None
    assert (low[50:90] == -1.0).all() and (low[90:110] == -2.2).all() and (low[110:] == -3.0).all()
    assert (high[:95] == 3.0).all() and high[100] == (1.0 if more else 3.0)


def test_the_way_back_passes_on_the_other_side() -> None:
    wanted, low, high = np.zeros(200), np.full(200, -2.0), np.full(200, 2.0)
    spans = [
        (barring(50, 60, -0.3, 1.0), barring(150, 160, -1.0, 0.3)),
        (barring(50, 60, -3, 0.5), barring(150, 160, -0.5, 3)),
    ]
    obstacles = [tuple(np.where(np.isnan(out), back, out) for out, back in zip(*each, strict=True)) for each in spans]
    assert pass_obstacles(wanted, low, high, obstacles) is None
    assert (low[50:60] == 1.0).all() and (high[150:160] == -1.0).all()


def test_what_bars_the_way_on_every_side_is_named_with_its_place() -> None:
    wanted, low, high = (np.full(200, each) for each in (-2.0, -3.0, 3.0))
    obstacles = (barring(50, 90, -2.5, -1.0), barring(60, 80, -1.5, 3.5), barring(70, 110, -3.5, -2.2))
    assert pass_obstacles(wanted, low, high, obstacles) == (2, 70)
    assert (low == -3.0).all() and (high == 3.0).all()


_CHICANE = (("left", 0.4, 1.0), ("right", 0.5, -1.0))
_CLOSE = (("left", 0.4, 1.0), ("right", 0.487, -1.0))


def test_impossible_drives_are_refused(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], sensor: SensorMetadata
) -> None:
    def plan(**override: object) -> None:
        scenario = make_scenario(**override)
        plan_trajectory(build_world(scenario, 0), scenario, sensor, 0, "before")

    with pytest.raises(ScenarioError, match=r"before: prop 'wall' .*\d+\.\d m"):
        plan(props=(make_prop("wall", 0.5, 0.0, size_m=(0.5, 2.9, 0.8)),))
    with pytest.raises(ScenarioError, match=r"before: the walls .*\d\.\d\d m .* 4\.40 m"):
        plan(platform=Platform(clearance_m=2.2))
    with pytest.raises(ScenarioError, match=r"before: .*20\.0 m"):
        plan(before=SessionPlan(route=("a", "b"), start_m=12.0, end_m=7.0))
    with pytest.raises(ScenarioError, match=r"before: the sensor .* m .*, at \("):
        plan(before=SessionPlan(route=("a", "b"), height_m=2.94))
    with pytest.raises(ScenarioError, match=r"before\.route .*'b'"):
        plan(before=SessionPlan(route=("a", "b", "a")))
    with pytest.raises(ScenarioError, match=r"before: platform\.scan_spacing_m = 0\.05: at 1 m/s, .* are 0\.1 m apart"):
        plan(platform=Platform(scan_spacing_m=0.05))
    with pytest.raises(ScenarioError, match=r"before: the drive takes .* at most 10000000 are simulated: drive faster"):
        plan(platform=Platform(speed_mps=1e-9))
    with pytest.raises(ScenarioError, match=r"at 1\.\d+ m/s, \d+\.\d m along the way, .* give at least that, or drive"):
        plan(platform=Platform(scan_spacing_m=0.1, speed_variation=0.3))
    with pytest.raises(ScenarioError, match=r"before: the drive takes 0\.\d+ s, less than one revolution at 10 Hz"):
        plan(before=SessionPlan(route=("a", "b"), speed_mps=300.0))


def test_a_line_that_comes_too_near_to_something_hung_is_planned_anew(
    make_scenario: Callable[..., Scenario], sensor: SensorMetadata
) -> None:
    scenario = make_scenario(platform=Platform(scan_spacing_m=2.0, sensor_height_m=1.4, tilt_deg=0.1))
    bare = build_world(scenario, 0)

    def driven(starts: list[list[float]], ends: list[list[float]]) -> Float64Array:
        hung = replace(bare, fixed=Caster([bare.before.meshes[0], bars(np.array(starts), np.array(ends), 0.2)]))
        return plan_trajectory(hung, scenario, sensor, 0, "before").true.points

    # The line runs at y = -0.3; 0.1 m above the sensor a bar hangs along it, which nothing level with it meets.
    points = driven([[8.0, -0.5, 1.6]], [[11.0, -0.3, 1.6]])
    abreast = points[(points[:, 0] > 8.0) & (points[:, 0] < 11.0)]
    assert (abreast[:, 1] > np.interp(abreast[:, 0], [8.0, 11.0], [-0.5, -0.3]) + 0.1 + 0.45).all()
    np.testing.assert_allclose(points[points[:, 0] < 4.0, 1], -0.3, atol=0.03)
    # Between two of them 0.65 m are left: the first line's fault is told.
    with pytest.raises(ScenarioError, match=r"before: the sensor .*0\.\d\d m"):
        driven([[8.0, -0.35, 1.6], [8.0, 0.5, 1.6]], [[11.0, -0.35, 1.6], [11.0, 0.5, 1.6]])


def test_smoothing_keeps_straight_lines_and_ends() -> None:
    ramp = np.linspace(2.0, 9.0, 200)
    np.testing.assert_allclose(smooth_line(ramp, 1.0), ramp, atol=1e-12)
    bent = np.abs(np.linspace(-1, 1, 201))
    assert smooth_line(bent, 1.0)[[0, -1]] == pytest.approx([1.0, 1.0])
    assert smooth_line(bent, 1.0)[100] > 0.02
    low, high = np.where(np.arange(200) == 100, 0.5, -1.0), np.full(200, 1.0)
    kept = smooth_between(np.zeros(200), low, high, 0.5)
    assert (kept >= low - 1e-12).all()
    assert np.abs(kept[[0, 60, 140, 199]]).max() < 1e-12


def test_a_line_goes_round_high_stones_and_over_low_ones(make_scenario: Callable[..., Scenario]) -> None:
    def driven(size_m: float, max_size_m: float, per_m2: float) -> tuple[float, float]:
        floor = Floor(roughness=0.0, stones=Stones(per_m2=per_m2, size_m=size_m, max_size_m=max_size_m))
        base = make_scenario(before=SessionPlan(route=("a", "b"), start_m=1.0, end_m=1.0))
        scenario = base.model_copy(update={"tunnel": base.tunnel.model_copy(update={"floor": floor})})
        world = build_world(scenario, 3)
        path = plan_path(world, scenario, 3, "before")
        heave_m, _, _ = follow_floor(path, world.fixed, scenario.platform)
        level_m, _, _ = follow_floor(path, world.walls, scenario.platform)
        return float(np.ptp(path.points[:, 1])), float(np.abs(heave_m - level_m).max())

    wind_m, heave_m = driven(0.6, 0.8, 0.4)
    assert wind_m > 0.2
    assert heave_m < 0.03  # through the middle it would be over 0.05
    wind_m, heave_m = driven(0.1, 0.12, 3.0)
    assert wind_m < 0.05
    assert 0.002 < heave_m < 0.05
