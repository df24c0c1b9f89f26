"""A tiny world from each platform, and from a sensor that is mounted askew."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, transform
from scenarios.schema import Odometry, Platform, Scenario, SessionPlan
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
