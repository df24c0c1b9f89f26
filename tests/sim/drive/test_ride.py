from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array
from cdpipe.core.geometry.motion import Motion
from scenarios.schema import Platform, Scenario, SessionPlan
from sim.drive.path import Path
from sim.drive.ride import follow_floor, integrate_time, lean_angles, ride
from sim.geometry.mesh import Mesh
from sim.geometry.raycast import Caster

ROBOT = Platform(wheelbase_m=0.6, track_m=0.5, tilt_deg=0.0, sensor_height_m=0.8)
HEADING = 0.4
FORWARD = np.array([np.cos(HEADING), np.sin(HEADING)])
LEFT = np.array([-FORWARD[1], FORWARD[0]])


def floor_of(height: Callable[[Float64Array, Float64Array], Float64Array], roof_m: float = 5.0) -> Caster:
    """A floor whose height is a function of the way along and across the path, and a level roof."""
    along, across = np.meshgrid(np.arange(-3.0, 23.01, 0.05), np.arange(-1.5, 1.51, 0.05), indexing="ij")
    xy = along[..., None] * FORWARD + across[..., None] * LEFT
    floor = np.concatenate([xy, height(along, across)[..., None]], axis=-1).reshape(-1, 3)
    number = np.arange(along.size).reshape(along.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]).astype(
        np.int32
    )
    roof = floor * (1.0, 1.0, 0.0) + (0.0, 0.0, roof_m)
    return Caster([Mesh(floor, faces), Mesh(roof, faces[:, ::-1])])


def straight(slope: float = 0.0) -> Path:
    distance_m = np.linspace(0.0, 20.0, 401)
    points = np.column_stack([distance_m[:, None] * FORWARD, slope * distance_m])
    return Path(distance_m, points, np.full(len(points), HEADING))


def driven(make_scenario: Callable[..., Scenario], floor: Caster, platform: Platform, seed: int = 0) -> Motion:
    return ride(straight(), floor, floor, make_scenario(platform=platform), seed, "before")


def angles(motion: Motion) -> Float64Array:
    return np.asarray(Rotation.from_quat(motion.quaternions).as_euler("ZYX"))


def test_a_plane_gives_its_slope_as_pitch_and_its_crossfall_as_roll(make_scenario: Callable[..., Scenario]) -> None:
    plane = floor_of(lambda along, across: 0.12 * along + 0.07 * across)
    motion = ride(straight(0.12), plane, plane, make_scenario(platform=ROBOT), 0, "before")
    rotations = Rotation.from_quat(motion.quaternions).as_matrix()
    normal = np.array([*(-0.12 * FORWARD - 0.07 * LEFT), 1.0])
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(rotations[:, :, 2], np.tile(normal, (len(rotations), 1)), atol=2e-5)
    np.testing.assert_allclose(angles(motion)[:, 1], -np.arctan(0.12), atol=2e-5)  # nose up is negative about y
    # The mast stands on the plane at right angles to it.
    foot = motion.points - 0.8 * normal
    np.testing.assert_allclose(foot[:, :2], straight().points[:, :2], atol=1e-4)
    np.testing.assert_allclose(foot[:, 2], 0.12 * motion.way_m, atol=1e-4)


def test_a_step_lifts_the_front_first_and_the_middle_by_half(make_scenario: Callable[..., Scenario]) -> None:
    height_m, pitch, roll = follow_floor(straight(), floor_of(lambda along, _: 0.1 * (along > 9.99)), ROBOT)
    way_m = straight().distance_m
    # The front axle is 0.3 m ahead: over the step from 9.7 m on, the rear one from 10.3 m on.
    expected = np.select([way_m < 9.4, np.abs(way_m - 10.0) < 0.05, way_m > 10.6], [0.0, 0.05, 0.1], np.nan)
    known = np.isfinite(expected)
    np.testing.assert_allclose(height_m[known], expected[known], atol=1e-3)
    assert pitch[np.argmin(np.abs(way_m - 10.0))] == pytest.approx(-np.arctan(0.1 / 0.6), abs=1e-3)
    np.testing.assert_allclose(pitch[(way_m < 9.4) | (way_m > 10.6)], 0.0, atol=1e-4)
    np.testing.assert_allclose(roll, 0.0, atol=1e-4)


def test_a_bump_under_the_left_wheels_heaves_by_a_quarter_each_time_and_rolls() -> None:
    def bump(along: Float64Array, across: Float64Array) -> Float64Array:
        return 0.08 * ((np.abs(along - 10.0) < 0.26) & (across > 0.1))

    height_m, _, roll = follow_floor(straight(), floor_of(bump), ROBOT)
    for place_m in (9.7, 10.3):  # front wheel on top, then the rear one
        at = round(place_m / 0.05)
        assert height_m[at] == pytest.approx(0.02, abs=1e-3)
        assert roll[at] == pytest.approx(np.arctan(0.04 / 0.5), abs=2e-3)  # left side up
    assert height_m.max() < 0.025
    # A gravel of 1 cm and 10 cm long is swallowed by the tyres for the most part.
    gravel, _, _ = follow_floor(
        straight(), floor_of(lambda along, _: 0.01 * np.sign(np.sin(62.8 * along + 0.5))), ROBOT
    )
    assert gravel[20:-20].std() < 0.002


def test_speed_is_the_integral_of_the_way_over_time() -> None:
    distance_m = np.linspace(0.0, 4000.0, 80001)
    np.testing.assert_array_equal(integrate_time(distance_m, 1.6, 0.0, 3, "before"), distance_m / 1.6)
    time_s = integrate_time(distance_m, 1.6, 0.3, 3, "before")
    speed_mps = np.diff(distance_m) / np.diff(time_s)
    assert speed_mps.min() > 0.4
    assert speed_mps.mean() == pytest.approx(1.6, rel=0.03)
    assert speed_mps.std() == pytest.approx(0.3 * 1.6, rel=0.1)
    assert (np.abs(np.diff(speed_mps)) < 0.05).all()
    assert not np.allclose(time_s, integrate_time(distance_m, 1.6, 0.3, 3, "after"))


def test_tilt_and_bounce_have_their_standard_deviation_and_their_own_draws(
    make_scenario: Callable[..., Scenario],
) -> None:
    level = floor_of(lambda along, _: 0.0 * along)
    shaky = ROBOT.model_copy(update={"tilt_deg": 2.0, "bounce_m": 0.03})
    drives = [driven(make_scenario, level, shaky, seed) for seed in range(8)]
    tilt = np.concatenate([np.rad2deg(angles(drive)[:, 1:]) for drive in drives])
    assert tilt.std(axis=0) == pytest.approx([2.0, 2.0], rel=0.25)
    lift = np.concatenate([drive.points[:, 2] - 0.8 for drive in drives])
    assert lift.std() == pytest.approx(0.03, rel=0.25)
    only_bounce = driven(make_scenario, level, shaky.model_copy(update={"tilt_deg": 0.0}), 0)
    np.testing.assert_allclose(angles(only_bounce)[:, 1:], 0.0, atol=1e-5)
    # Tilting about the wheels moves the mast's top by centimetres, no more.
    assert np.abs(only_bounce.points - drives[0].points).max() < 0.8 * np.deg2rad(6.0)


def test_a_quadrotor_leans_into_its_turn_and_into_its_acceleration() -> None:
    radius_m, speed_mps = 8.0, 2.0
    distance_m = np.arange(0.0, 20.0, 0.05)
    turn = distance_m / radius_m
    points = radius_m * np.column_stack([np.sin(turn), 1 - np.cos(turn), np.zeros(len(turn))])
    pitch, roll = lean_angles(Path(distance_m, points, turn), distance_m / speed_mps)
    np.testing.assert_allclose(pitch, 0.0, atol=1e-9)
    np.testing.assert_allclose(roll, -np.arctan(4.0 / 8.0 / 9.81), rtol=1e-6)  # to the left: right side up
    # v^2 = 1 + 2 a s is a constant acceleration a: nose down by atan(a / g).
    pitch, roll = lean_angles(straight(), (np.sqrt(1 + straight().distance_m) - 1) / 0.5)
    np.testing.assert_allclose(pitch[30:-30], np.arctan(0.5 / 9.81), rtol=1e-3)
    np.testing.assert_allclose(roll, 0.0, atol=1e-12)


def test_a_quadrotor_smooths_the_floor_and_ducks_under_what_hangs(make_scenario: Callable[..., Scenario]) -> None:
    flying = Platform(kind="quadrotor", sensor_height_m=2.0, clearance_m=0.8, tilt_deg=0.0)
    rough = driven(make_scenario, floor_of(lambda along, _: 0.1 * np.sign(np.sin(6 * along))), flying)
    assert rough.points[40:-40, 2].std() < 0.02
    assert rough.points[:, 2].mean() == pytest.approx(2.0, abs=0.05)
    low_roof = driven(make_scenario, floor_of(lambda along, _: 0.0 * along, roof_m=2.5), flying)
    np.testing.assert_allclose(low_roof.points[:, 2], 2.5 - 0.8, atol=1e-5)
    wide = flying.model_copy(update={"clearance_m": 1.2})
    # By hand: 1.2 m below a roof at 1.6 m is lower than 0.5 m above the floor.
    with pytest.raises(ScenarioError, match=r"before: roof and floor .*0\.10 m"):
        driven(make_scenario, floor_of(lambda along, _: 0.0 * along, roof_m=1.6), wide)


def test_a_plan_s_own_speed_and_height_count(make_scenario: Callable[..., Scenario]) -> None:
    level = floor_of(lambda along, _: 0.0 * along)
    plan = SessionPlan(route=("a", "b"), speed_mps=2.5, height_m=1.3)
    motion = ride(straight(), level, level, make_scenario(platform=ROBOT, before=plan), 0, "before")
    assert motion.time_s[-1] == pytest.approx(20.0 / 2.5)
    np.testing.assert_allclose(motion.points[:, 2], 1.3, atol=1e-5)


@pytest.mark.parametrize(("kind", "step_hz"), [("handheld", 1.5), ("legged", 2.5)])
def test_who_walks_bobs_and_pitches_once_a_step_and_rolls_sways_and_turns_once_a_stride(
    make_scenario: Callable[..., Scenario], kind: str, step_hz: float
) -> None:
    gait = {"step_hz": step_hz, "bob_m": 0.04, "sway_m": 0.03, "pitch_deg": 0.6, "roll_deg": 0.4, "yaw_deg": 0.8}
    platform = Platform.model_validate({"kind": kind, "sensor_height_m": 1.2, "tilt_deg": 0, "gait": gait})
    motion = driven(make_scenario, floor_of(lambda along, _: 0.0 * along), platform)
    yaw, pitch, roll = np.rad2deg(angles(motion).T)
    across_m = motion.points[:, :2] @ LEFT
    for values, amplitude, hertz in (
        (motion.points[:, 2] - 1.2, 0.04, step_hz),
        (pitch, 0.6, step_hz),
        (roll, 0.4, step_hz / 2),
        (yaw - np.rad2deg(HEADING), 0.8, step_hz / 2),
        (across_m, 0.03, step_hz / 2),
    ):
        waves = np.stack([np.cos(2 * np.pi * hertz * motion.time_s), np.sin(2 * np.pi * hertz * motion.time_s)], axis=1)
        found, _, _, _ = np.linalg.lstsq(waves, values, rcond=None)
        assert np.linalg.norm(found) == pytest.approx(amplitude, rel=0.1)
        # the mast of a legged robot leans with it, and that moves its sensor by up to 2 cm more
        assert np.abs(values - waves @ found).max() < 0.1 * amplitude + (0.03 if kind == "legged" else 0.0)


@pytest.mark.parametrize(("kind", "step_hz"), [("handheld", 1.5), ("legged", 2.5)])
def test_a_slow_walk_keeps_its_amplitudes(make_scenario: Callable[..., Scenario], kind: str, step_hz: float) -> None:
    gait = {"step_hz": step_hz, "bob_m": 0.04, "sway_m": 0.0, "pitch_deg": 0.6, "roll_deg": 0.4, "yaw_deg": 0.8}
    level = floor_of(lambda along, _: 0.0 * along)
    for speed_mps in (1.0, 0.5, 0.15):
        told = {"kind": kind, "sensor_height_m": 1.2, "tilt_deg": 0, "gait": gait, "speed_mps": speed_mps}
        motion = driven(make_scenario, level, Platform.model_validate(told))
        assert np.isin(straight().distance_m, motion.way_m).all()
        time_s = np.arange(4.0, 12.0, 0.01)  # between the samples, too: 20 steps of a legged robot, 12 of a person
        points, quaternions = motion.sample(time_s)
        np.testing.assert_allclose(points[:, :2] @ FORWARD, speed_mps * time_s, atol=0.02)
        yaw, pitch, roll = np.rad2deg(Rotation.from_quat(quaternions).as_euler("ZYX").T)
        for values, amplitude, hertz in (
            (points[:, 2] - 1.2, 0.04, step_hz),
            (pitch, 0.6, step_hz),
            (roll, 0.4, step_hz / 2),
            (yaw - np.rad2deg(HEADING), 0.8, step_hz / 2),
        ):
            # orthogonal over whole periods; (sin(pi / 16) / (pi / 16))^2 = 0.987
            found = 2 * np.mean(values * np.exp(2j * np.pi * hertz * time_s))
            assert 0.986 * amplitude < abs(found) < 1.001 * amplitude, speed_mps


def test_a_walk_that_is_fast_enough_has_no_further_samples_and_one_of_weeks_is_refused(
    make_scenario: Callable[..., Scenario],
) -> None:
    level = floor_of(lambda along, _: 0.0 * along)
    # 0.05 m at 2.1 m/s are 23.8 ms; a sixteenth of a step at 2.6 Hz is 24.04 ms
    fast, slow = (Platform.model_validate({"kind": "legged", "speed_mps": speed}) for speed in (2.1, 1e-5))
    np.testing.assert_array_equal(driven(make_scenario, level, fast).way_m, straight().distance_m)
    with pytest.raises(ScenarioError, match=r"before: the walk takes 2e\+06 s: .*: walk faster"):
        driven(make_scenario, level, slow)


def test_a_hand_is_level_on_a_slope_and_a_legged_robot_is_not(make_scenario: Callable[..., Scenario]) -> None:
    still = dict.fromkeys(("bob_m", "sway_m", "pitch_deg", "roll_deg", "yaw_deg"), 0.0)
    slope = floor_of(lambda along, _: 0.1 * along)
    for kind, pitch in (("handheld", 0.0), ("legged", -np.arctan(0.1))):
        platform = Platform.model_validate({"kind": kind, "tilt_deg": 0, "sensor_height_m": 1.0, "gait": still})
        motion = ride(straight(0.1), slope, slope, make_scenario(platform=platform), 0, "before")
        np.testing.assert_allclose(angles(motion)[:, 1], pitch, atol=1e-4)
        foot = motion.points - Rotation.from_quat(motion.quaternions).as_matrix()[:, :, 2]
        np.testing.assert_allclose(foot[:, 2], 0.1 * (foot[:, :2] @ FORWARD), atol=1e-3)


def test_a_turned_mount_turns_the_sensor_where_it_is(make_scenario: Callable[..., Scenario]) -> None:
    rough = floor_of(lambda along, across: 0.1 * np.sin(along) + 0.05 * across)
    plain = driven(make_scenario, rough, ROBOT)
    mount = {"mount_yaw_deg": 130.0, "mount_pitch_deg": 20.0}
    turned = driven(make_scenario, rough, ROBOT.model_copy(update=mount))
    np.testing.assert_array_equal(turned.points, plain.points)
    body, sensor = (Rotation.from_quat(motion.quaternions).as_matrix() for motion in (plain, turned))
    # the x axis of the sensor in the platform: 130 degrees to the left, and 20 degrees down
    ahead = np.einsum("nji,nj->ni", body, sensor[:, :, 0])
    level = np.cos(np.deg2rad(20.0))
    expected = (level * np.cos(np.deg2rad(130.0)), level * np.sin(np.deg2rad(130.0)), -np.sin(np.deg2rad(20.0)))
    np.testing.assert_allclose(ahead, np.tile(expected, (len(ahead), 1)), atol=1e-9)
