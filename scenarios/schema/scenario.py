"""A scenario: a world, what changes and moves in it, and both drives."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import model_validator

from cdpipe.core.yamlfile import GrownSettings
from scenarios.dangling import find_dangling
from scenarios.schema.movers import Mover
from scenarios.schema.platform import Platform
from scenarios.schema.props import Area, Prop
from scenarios.schema.puddles import Puddle
from scenarios.schema.sensor import Sensor, Simulation
from scenarios.schema.session import SessionPlan
from scenarios.schema.surface import SurfaceChange
from scenarios.schema.tunnel import Tunnel
from scenarios.schema.values import Positive


def _fill_in(scenario: dict[Any, Any], plan: Any) -> Any:
    """Return the plain tree of a session with the keys that its own sensor and platform leave out."""
    if not isinstance(plan, dict):
        return plan
    filled = dict(plan)
    for part in ("sensor", "platform"):
        usual, own = scenario.get(part), plan.get(part)
        if isinstance(usual, dict) and isinstance(own, dict):
            filled[part] = usual | own
            if own.get("kind", usual.get("kind")) != usual.get("kind"):  # another kind of platform has another gait
                filled[part]["gait"] = own.get("gait")
            elif isinstance(own.get("gait"), dict) and isinstance(usual.get("gait"), dict):
                filled[part]["gait"] = usual["gait"] | own["gait"]
    return filled


class Scenario(GrownSettings):
    """A world, what changes in it, what moves in it, and the two drives."""

    newer: ClassVar[frozenset[str]] = frozenset({"movers", "puddles", "surface", "sim"})

    family: str
    description: str = ""
    score_radius_m: Positive = 4.5
    tunnel: Tunnel
    areas: tuple[Area, ...] = ()
    props: tuple[Prop, ...] = ()
    movers: tuple[Mover, ...] = ()
    puddles: tuple[Puddle, ...] = ()
    surface: tuple[SurfaceChange, ...] = ()
    sensor: Sensor = Sensor()
    platform: Platform = Platform()
    sim: Simulation = Simulation()
    before: SessionPlan
    after: SessionPlan

    @model_validator(mode="before")
    @classmethod
    def _fill_in_sessions(cls, given: Any) -> Any:
        """Give each session's own sensor and platform the keys that it leaves out."""
        if not isinstance(given, dict):
            return given
        return {**given, **{name: _fill_in(given, given[name]) for name in ("before", "after") if name in given}}

    def plan(self, session: str) -> SessionPlan:
        """Return the drive of one session."""
        return self.after if session == "after" else self.before

    def of(self, session: str) -> Scenario:
        """Return the scenario as one session has it: with the sensor and the platform of this session."""
        plan = self.plan(session)
        own = {"sensor": plan.sensor or self.sensor, "platform": plan.platform or self.platform}
        return self if plan.sensor is None and plan.platform is None else self.model_copy(update=own)

    @model_validator(mode="after")
    def _references_hold(self) -> Scenario:
        for key, rule in find_dangling(self.model_dump(mode="json")):
            raise ValueError(f"{'.'.join(map(str, key))}: {rule}")
        return self
