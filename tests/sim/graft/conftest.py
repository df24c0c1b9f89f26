"""A simulated session that the tests of this folder take for a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cdpipe.io.session import Session, read_session
from scenarios.grafted import GraftScenario, Recording, RockChange
from scenarios.schema import Platform, Prop, Scenario

SEED = 10007
PROPS: tuple[dict[str, Any], ...] = (
    {"name": "box", "kind": "box", "size_m": (0.7, 0.6, 0.7), "change": "added"},
    {"name": "barrel", "kind": "barrel", "size_m": (0.6, 0.6, 0.9), "change": "removed"},
    {"name": "crate", "kind": "crate", "size_m": (0.7, 0.6, 0.6), "change": "moved", "to": {}},
    {"name": "stays", "kind": "box", "size_m": (0.5, 0.5, 0.6)},
)


@pytest.fixture(scope="session")
def recording(simulated_once: Callable[[Scenario, int], Path], make_scenario: Callable[..., Scenario]) -> Session:
    """A drift of 20 m driven once, 15 revolutions."""
    pair = simulated_once(make_scenario(platform=Platform(scan_spacing_m=1.1)), SEED)
    return read_session(pair / "before")


def make_graft(*props: dict[str, Any], surface: tuple[RockChange, ...] = (), **override: Any) -> GraftScenario:
    told = {"sessions": ("drive",), "split": "alternate", "reach_m": 4.0, "clearance_m": 0.5, **override}
    recording, placed = Recording(**told), tuple(Prop(**prop) for prop in props)
    return GraftScenario(family="test", props=placed, surface=surface, recording=recording)
