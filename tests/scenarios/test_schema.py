from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from scenarios.schema import MeshFile, Odometry, Prop, Sensor, SessionPlan


@pytest.mark.parametrize(
    ("model", "settings", "rule"),
    [
        (SessionPlan, {"route": ["a"]}, "a route of two nodes or more"),
        (SessionPlan, {"route": ["a"], "trajectory": "t.tum"}, "a route of two nodes or more"),
        (SessionPlan, {"route": ["a", "b"], "trajectory": "t.tum"}, "or a trajectory"),
        (SessionPlan, {"trajectory": "t.tum", "start_m": 8, "lateral": 0.1}, "leave lateral, start_m out"),
        (Odometry, {"source": "kiss-icp", "translation_percent": 1}, "kiss-icp has an error of its own"),
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
