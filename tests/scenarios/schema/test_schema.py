from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from cdpipe.sensor.ouster import load_profile, profile_names
from scenarios import check_scenario
from scenarios.schema import (
    FITTED_WALK,
    GAITS,
    MeshFile,
    Odometry,
    Place,
    Platform,
    Prop,
    Scenario,
    Sensor,
    SessionPlan,
)
from sim.drive.trajectory import load_sensor


@pytest.mark.parametrize(
    ("model", "settings", "rule"),
    [
        (SessionPlan, {"route": ["a"]}, "a route of two nodes or more"),
        (SessionPlan, {"route": ["a"], "trajectory": "t.tum"}, "a route of two nodes or more"),
        (SessionPlan, {"route": ["a", "b"], "trajectory": "t.tum"}, "or a trajectory"),
        (SessionPlan, {"trajectory": "t.tum", "start_m": 8, "lateral": 0.1}, "leave lateral, start_m out"),
        (Odometry, {"source": "kiss-icp", "translation_percent": 1}, "source kiss-icp has no translation_percent"),
        (Odometry, {"source": "random-walk", "yaw_deg_per_100m": 1}, "source random-walk has no yaw_deg_per_100m"),
        (Odometry, {"jitter_yaw_deg": 1}, "source drift has no jitter_yaw_deg .of source random-walk.: leave that out"),
        (Odometry, {"source": "kiss-icp", "file": "a.tum"}, "source kiss-icp has no file"),
        (Odometry, {"file": "a.tum", "scale_percent": 1}, "source file has no scale_percent"),
        (Odometry, {"source": "file"}, "source file needs file"),
        (Platform, {"gait": {}}, "step_hz"),
        (Platform, {"gait": GAITS["legged"]}, "a ground_robot has no gait"),
        (Platform, {"mount_pitch_deg": 31}, "less than or equal to 30"),
        (Place, {"at": [1, 2, 0], "lateral": -0.5}, "lateral = -0.5: .*: leave lateral out"),
        (Sensor, {"min_range_m": 20, "max_range_m": 5}, "leaves nothing below max_range_m"),
        (
            Prop,
            {"name": "p", "kind": "muck_pile", "size_m": [2, 2, 1], "place": {"posture": "tipped"}},
            "it cannot be tipped",
        ),
        (
            Prop,
            {
                "name": "r",
                "kind": "railing",
                "size_m": [2, 0.1, 1],
                "change": "moved",
                "to": {"posture": "tipped"},
            },
            "it cannot be tipped",
        ),
    ],
)
def test_settings_that_would_be_ignored_are_refused(model: Any, settings: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValidationError, match=rule):
        model.model_validate(settings)


def test_a_recorded_drive_survives_being_written_down() -> None:
    plan = SessionPlan(trajectory="t.tum")
    assert SessionPlan.model_validate(plan.model_dump(mode="json")) == plan


def test_a_path_with_a_null_character_is_a_mistake() -> None:
    with pytest.raises(ValidationError, match="path"):
        MeshFile(path="mine\0.stl")


def test_keys_of_a_random_walk_and_of_a_gait_that_are_left_out_are_the_fitted_ones() -> None:
    walk = Odometry.model_validate({"source": "random-walk", "jitter_yaw_deg": 0.0, "scale_percent": None})
    assert walk.model_dump(exclude_defaults=True) == {"source": "random-walk", **FITTED_WALK, "jitter_yaw_deg": 0.0}
    hand = Platform.model_validate({"kind": "handheld", "gait": {"step_hz": 2.0}})
    assert hand.gait is not None and hand.gait.model_dump() == {**GAITS["handheld"], "step_hz": 2.0}
    assert Platform(kind="legged").gait is not None and Platform().gait is None
    for model in (walk, hand):
        assert type(model).model_validate(model.model_dump(mode="json")) == model


def test_the_dump_of_an_older_scenario_has_no_key_that_came_later() -> None:
    assert Odometry(source="kiss-icp").model_dump() == {
        "source": "kiss-icp",
        "translation_percent": 0.0,
        "yaw_deg_per_100m": 0.0,
    }
    assert not {"gait", "mount_yaw_deg", "mount_pitch_deg"} & Platform().model_dump().keys()
    assert Platform(mount_yaw_deg=90).model_dump()["mount_yaw_deg"] == 90


def test_a_sensor_without_a_mode_has_its_profile_s_own(tmp_path: Path) -> None:
    file = tmp_path / "own.json"
    file.write_text(json.dumps(load_profile("os1-32-u0", "2048x10").to_json()))
    sensors = {
        f"sensor: {{profile: {file}}}": "2048x10",
        f"sensor: {{profile: {file}, mode: 512x20}}": "512x20",
        "sensor: {profile: os1-32-u0}": "1024x10",
        f"sensor: {{profile: {file}}}\nafter: {{sensor: {{profile: os1-32-u0}}}}": "2048x10",
    }
    for told, mode in sensors.items():
        (tmp_path / "world.yaml").write_text(f"extends: smoke/one_box\n{told}\n")
        scenario = check_scenario(str(tmp_path / "world.yaml"))
        assert load_sensor(scenario, "before").mode == mode
        again = Scenario.model_validate(scenario.model_dump(mode="json"))  # as a pair's truth keeps it
        assert again == scenario and load_sensor(again, "before").mode == mode
    assert load_sensor(scenario, "after").mode == load_sensor(again, "after").mode == "1024x10"


def test_the_mode_of_a_shipped_profile_is_written_down() -> None:
    for name in profile_names():
        assert Sensor(profile=name).model_dump()["mode"] == load_profile(name).mode == "1024x10"
    assert Sensor().model_dump()["mode"] == "1024x10"
