"""Small worlds that the tests of this folder share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from cdpipe.sensor.ouster import SensorMetadata, load_profile
from scenarios.schema import (
    Drift,
    Mover,
    Place,
    Platform,
    Prop,
    Roughness,
    Scenario,
    Section,
    Sensor,
    SessionPlan,
    Tunnel,
)


@pytest.fixture(scope="session")
def sensor() -> SensorMetadata:
    return load_profile("os1-32-nominal", "512x10")


@pytest.fixture(scope="session")
def make_scenario() -> Callable[..., Scenario]:
    """A straight drift of 20 m, 4 m wide, driven along its middle; anything can be overridden."""

    def make(**override: Any) -> Scenario:
        settings: dict[str, Any] = {
            "family": "test",
            "tunnel": Tunnel(
                nodes={"a": (0, 0, 0), "b": (20, 0, 0)},
                drifts=(Drift(nodes=("a", "b")),),
                section=Section(width_m=4.0, height_m=3.2),
                roughness=(Roughness(amplitude_m=0.06, length_m=1.5),),
                resolution_m=0.2,
            ),
            "sensor": Sensor(mode="512x10"),
            "platform": Platform(scan_spacing_m=2.0),
            "before": SessionPlan(route=("a", "b"), lateral=-0.2, start_m=2.0, end_m=2.0),
            "after": SessionPlan(route=("a", "b"), lateral=0.2, start_m=3.0, end_m=1.0),
        }
        return Scenario(**(settings | override))

    return make


@pytest.fixture(scope="session")
def make_prop() -> Callable[..., Prop]:
    """A box at the left wall, 8 m along the drift; anything can be overridden."""

    def make(name: str, fraction: float = 0.4, lateral: float = 0.9, yaw_deg: float = 0.0, **override: Any) -> Prop:
        settings: dict[str, Any] = {
            "kind": "box",
            "size_m": (0.8, 0.6, 0.7),
            "place": Place(between=("a", "b"), fraction=fraction, lateral=lateral, yaw_deg=yaw_deg),
        }
        return Prop(name=name, **(settings | override))

    return make


@pytest.fixture(scope="session")
def moving_scenario(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    """A drift of 20 m in which a person walks, a forklift drives and a curtain hangs."""
    tunnel = make_scenario().tunnel.model_copy(update={"section": Section(width_m=5.0, height_m=3.2)})
    movers: list[dict[str, Any]] = [
        {"name": "walker", "kind": "person"},
        {"name": "truck", "kind": "forklift", "sessions": "after", "path": {"length_m": 5}},
        {"name": "curtain", "kind": "curtain", "width_m": 0.9, "sessions": "before"},
    ]
    return make_scenario(
        tunnel=tunnel,
        props=(
            make_prop("box", 0.35, change="added"),
            make_prop("barrel", 0.6, 0.8, kind="barrel", size_m=(0.6, 0.6, 0.9)),
        ),
        movers=tuple(Mover.model_validate(each) for each in movers),
        sensor=Sensor(mode="512x10", sub_rays=7),
    )


@pytest.fixture(scope="session")
def junction_tunnel() -> Tunnel:
    """Two drifts that meet, two that cross a bend, blind ends, slopes and two octaves of overbreak."""
    return Tunnel(
        nodes={"a": (0, 0, 0), "b": (15, 1, 0.4), "c": (28, -3, 0.2), "d": (14, 14, 0.6), "e": (26, 12, 0)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d", "e")), Drift(nodes=("e", "c"))),
        section=Section(width_m=3.4, height_m=3.0),
        roughness=(Roughness(amplitude_m=0.12, length_m=2.0), Roughness(amplitude_m=0.05, length_m=0.6)),
        meander_m=0.5,
        resolution_m=0.2,
    )
