"""Small worlds that the tests of this folder share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from cdpipe.sensor.ouster import SensorMetadata, load_profile
from scenarios.schema import Drift, Place, Platform, Prop, Roughness, Scenario, Section, Sensor, SessionPlan, Tunnel


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
