"""A tiny world from each platform, and from a sensor that is mounted askew."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, transform
from cdpipe.sensor.ouster import SensorMetadata
from scenarios.schema import Odometry, Platform, Scenario, SessionPlan
from sim.drive import trajectory
from sim.scene import build_world
from sim.session.simulate import HeldPair, simulate_in_memory

ODOMETRY = Odometry(source="random-walk")


@pytest.fixture(scope="module")
def simulate_with(make_scenario: Callable[..., Scenario]) -> Callable[..., HeldPair]:
    def simulate(**platform: Any) -> HeldPair:
        plan = SessionPlan(route=("a", "b"), start_m=6.0, end_m=6.0, odometry=ODOMETRY)
        settings = {"scan_spacing_m": 4.0, **platform}
        return simulate_in_memory(
            make_scenario(platform=Platform.model_validate(settings), before=plan, after=plan), seed=2
        )

    return simulate


def cloud(pair: HeldPair) -> Float64Array:
    """Returns of the before session in the world frame, placed by its true poses at the middle of each revolution."""
    labelled = pair.sessions["before"]
    chunk = labelled.session.chunk(0)
    points = []
    for number, pose in enumerate(labelled.world_T_sensor):
        seen = labelled.session.sensor.project(chunk.range_mm[number] / 1000.0)[chunk.range_mm[number] > 0]
        points.append(transform(pose, seen))
    return np.concatenate(points)


@pytest.mark.parametrize(
    "platform",
    [
        {"kind": "handheld", "sensor_height_m": 1.4, "tilt_deg": 3.0},
        {"kind": "legged", "sensor_height_m": 0.7},
        {"kind": "quadrotor", "sensor_height_m": 1.5, "clearance_m": 0.4},
        {"mount_yaw_deg": 135.0, "mount_pitch_deg": -20.0},
    ],
    ids=["handheld", "legged", "quadrotor", "turned"],
)
def test_true_poses_put_the_returns_of_every_platform_on_the_same_walls(
    simulate_with: Callable[..., HeldPair], platform: dict[str, Any]
) -> None:
    walls = cKDTree(cloud(simulate_with(scan_spacing_m=1.0, tilt_deg=0.0)))
    pair = simulate_with(**platform)
    away_m, _ = walls.query(cloud(pair))
    assert len(away_m) > 20_000
    assert np.median(away_m) < 0.06
    assert np.quantile(away_m, 0.9) < 0.25
    sessions = pair.sessions
    assert sessions["before"].world_T_sensor.shape == sessions["before"].session.odom_T_sensor.shape
    assert pair.truth.scenario["platform"].items() >= platform.items()


def test_the_clearance_of_a_walk_is_checked_at_the_same_places_at_every_speed(
    make_scenario: Callable[..., Scenario], sensor: SensorMetadata, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked = []
    monkeypatch.setattr(trajectory, "check_clearance", lambda *told: checked.append(told[-2:]))
    still = dict.fromkeys(("bob_m", "sway_m", "pitch_deg", "roll_deg", "yaw_deg"), 0.0)
    for speed_mps in (2.0, 0.2):
        told = {"kind": "handheld", "speed_mps": speed_mps, "scan_spacing_m": 2.0, "gait": still}
        scenario = make_scenario(platform=Platform.model_validate(told))
        trajectory.plan_trajectory(build_world(scenario, 1), scenario, sensor, 1, "before")
    (fast_m, fast), (slow_m, slow) = checked
    assert np.diff(slow_m).max() < 0.06
    np.testing.assert_array_equal(slow_m, fast_m)
    np.testing.assert_array_equal(slow, fast)
