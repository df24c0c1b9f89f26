"""A scenario whose world is a recording: props are cast into its scans, and its own poses are the truth.

    recording: {sessions: [drive.osf]}      # one recording, split into two; or two recordings of one place
    props:
      - {name: box, kind: box, size_m: [0.8, 0.6, 0.7], change: added}

`sim/graft/GRAFT.md` tells more.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import Settings
from scenarios.schema import MeshFile, Positive, Scenario, SessionPlan, Tunnel

_NO_FILE = "the recording"
SplitName = Literal["auto", "passes", "halves", "alternate"]
FileName = Annotated[str, Field(pattern=r"^[^\x00]+$")]


class Recording(Settings):
    """What a pair is made of: one recording that is split, or two of one place. Paths start at the scenario's file."""

    sessions: Annotated[tuple[FileName, ...], Field(min_length=1, max_length=2)]
    split: SplitName = "auto"  # of one recording; auto: two passes of one way, else every other revolution
    before_T_after: FileName | None = None  # of two recordings: file of their merge; left out: found by `tunnelcd`
    trajectories: Annotated[tuple[FileName, ...], Field(max_length=2)] = ()  # poses of each recording
    metadata: Annotated[tuple[FileName, ...], Field(max_length=2)] = ()  # sensor of each PCAP
    odometry: Literal["kiss-icp", "genz-icp"] | None = None  # estimates the poses
    format: str | None = None
    topics: tuple[str, ...] = ()  # of a bag
    deskew: bool = True
    clearance_m: Positive = 0.8  # between a prop and the path of the sensor, on the floor
    reach_m: Positive = 10.0  # from the path within which props stand

    @model_validator(mode="after")
    def _fits_the_number(self) -> Recording:
        n = len(self.sessions)
        for name in ("trajectories", "metadata"):
            if getattr(self, name) and len(getattr(self, name)) != n:
                raise ValueError(f"{name}: give one for each of the {n} recordings")
        if n == 1 and self.before_T_after is not None:
            raise ValueError("before_T_after: the two parts of one recording are in one frame: leave it out")
        if n == 2 and self.split != "auto":
            raise ValueError("split: two recordings are not split: leave it out")
        if self.trajectories and self.odometry is not None:
            raise ValueError("trajectories and odometry both give the poses: leave one out")
        if self.reach_m <= self.clearance_m:
            raise ValueError("reach_m: expected more than clearance_m")
        return self


class GraftScenario(Scenario):
    """A scenario without a tunnel and drives of its own: those keys hold placeholders and are never dumped."""

    newer: ClassVar[frozenset[str]] = Scenario.newer | {"tunnel", "before", "after", "areas", "sensor", "platform"}

    tunnel: Tunnel = Tunnel(mesh=MeshFile(path=_NO_FILE))
    before: SessionPlan = SessionPlan(trajectory=_NO_FILE)
    after: SessionPlan = SessionPlan(trajectory=_NO_FILE)
    recording: Recording

    @model_validator(mode="after")
    def _only_props(self) -> GraftScenario:
        fields = type(self).model_fields
        own = ("tunnel", "before", "after", "areas", "movers", "puddles", "surface", "sensor", "platform")
        said = [name for name in own if getattr(self, name) != fields[name].default]
        if said:
            raise ValueError(f"{said[0]}: the recording has its own: leave {', '.join(said)} out")
        for prop in self.props:
            postures = {place.posture for place in (prop.place, prop.to) if place is not None}
            if postures != {"upright"}:
                raise ValueError(f"prop {prop.name!r}: posture: props are grafted upright")
        return self


def take_props(scenario: dict[Any, Any]) -> dict[Any, Any]:
    """Return the plain tree of any scenario without its world: only props, without their places between nodes."""
    kept = {key: scenario[key] for key in ("family", "description", "score_radius_m", "frozen") if key in scenario}
    return {**kept, "props": [_free(prop) for prop in scenario.get("props") or ()]}


def _free(prop: Any) -> Any:
    """Return the plain tree of a prop with places that a recording can have."""
    if not isinstance(prop, dict):
        return prop
    freed = dict(prop)
    if "one_of" in freed and isinstance(freed["one_of"], list):
        freed["one_of"] = [_free(option) for option in freed["one_of"]]
    for key in ("place", "to"):
        if isinstance(freed.get(key), dict):
            freed[key] = {name: freed[key][name] for name in ("at", "yaw_deg") if name in freed[key]}
    return freed
