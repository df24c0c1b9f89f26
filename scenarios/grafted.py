"""A scenario whose world is a recording: props are cast into its scans, its rock moves, its own poses are the truth.

    recording: {sessions: [drive.osf]}      # one recording, split into two; or two recordings of one place
    props:
      - {name: box, kind: box, size_m: [0.8, 0.6, 0.7], change: added}
    surface:
      - {name: squeezed, kind: convergence, depth_m: 0.04, length_m: 3, width_m: 2}

`sim/graft/GRAFT.md` tells more.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import Settings
from scenarios.schema import MeshFile, Positive, Scenario, SessionPlan, SurfaceChange, SurfacePlace, Tunnel
from scenarios.schema.surface import USUAL_SURFACES
from scenarios.schema.values import Finite, fill_in_usual, refuse_other_keys

_NO_FILE = "the recording"
SplitName = Literal["auto", "passes", "halves", "alternate"]
FileName = Annotated[str, Field(pattern=r"^[^\x00]+$")]
# What each kind of rock change in a recording is like where its keys are left out; a kind has these keys and no other.
USUAL_ROCK: dict[str, dict[str, Any]] = {
    "convergence": {"depth_m": 0.03, "length_m": 4.0, "width_m": 3.0},
    "heave": {"depth_m": 0.05, "length_m": 4.0, "width_m": 3.0},
    "shotcrete": {"thickness_m": 0.05, "length_m": 4.0, "width_m": 3.0},
}
_FLAT = 20  # the shorter side of a smooth change over its depth, at least: its flank is no steeper than 18 degrees
_STILL_M = 1e-3  # rock that moves by no more is no change (`sim.displacement.displace.MOVED_M`)
_Side = Annotated[float, Field(ge=0.5, le=12)]


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
    origin_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)  # to subtract from poses in a map grid (UTM)
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


class RockPlace(SurfacePlace):
    """The middle of a rock change in the before session's odom frame; left out, the seed draws it."""

    at: tuple[Finite, Finite, Finite] | None = None

    @model_validator(mode="after")
    def _only_at(self) -> RockPlace:
        said = [name for name in ("between", "area", "node") if getattr(self, name) is not None]
        if said:
            raise ValueError(f"{said[0]}: a recording has no nodes and no areas: give at, or leave place out")
        return self


class RockChange(SurfaceChange):
    """Rock of a recording that moves, with the keys of a simulated surface change where their meaning is the same."""

    kind: Literal["convergence", "heave", "shotcrete"]
    place: RockPlace = RockPlace()
    depth_m: Annotated[float, Field(ge=-0.3, le=0.3)] | None = None  # largest; positive into the void
    length_m: _Side | None = None  # along the drift; on a wall, level
    width_m: _Side | None = None
    area_m2: Annotated[float, Field(ge=0.25, le=144)] | None = None  # of a square, in place of length and width

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        filled = fill_in_usual(given, USUAL_ROCK)
        if isinstance(given, dict) and given.get("area_m2") is not None:
            for name in ("length_m", "width_m"):
                if given.get(name) is not None:
                    raise ValueError(f"surface {given.get('name')!r}: give area_m2, or length_m and width_m")
                filled.pop(name, None)
        return filled

    @model_validator(mode="after")
    def _keys_of_its_kind(self) -> RockChange:
        told = f"surface {self.name!r}"
        refuse_other_keys(self, {**USUAL_SURFACES, **USUAL_ROCK}, told)
        shorter_m = min(self.sides_m)
        if self.depth_m is not None and not 0 < _FLAT * abs(self.depth_m) <= shorter_m:
            most_m = shorter_m / _FLAT
            raise ValueError(
                f"{told}: depth_m = {self.depth_m:g}: expected -{most_m:g} to {most_m:g} without 0, a twentieth of "
                f"its shorter side ({shorter_m:g} m)"
            )
        for key, size_m in (("depth_m", self.depth_m), ("thickness_m", self.thickness_m)):
            if size_m is not None and abs(size_m) <= _STILL_M:
                raise ValueError(
                    f"{told}: {key} = {size_m:g}: rock that moves by {_STILL_M:g} m or less is no change: give more, "
                    "or leave this change out"
                )
        return self

    @property
    def sides_m(self) -> tuple[float, float]:
        """Length and width, metres."""
        if self.length_m is None or self.width_m is None:
            side_m = math.sqrt(self.area_m2 or 0.0)
            return side_m, side_m
        return self.length_m, self.width_m


class GraftScenario(Scenario):
    """A scenario without a tunnel and drives of its own: those keys hold placeholders and are never dumped."""

    newer: ClassVar[frozenset[str]] = Scenario.newer | {"tunnel", "before", "after", "areas", "sensor", "platform"}

    tunnel: Tunnel = Tunnel(mesh=MeshFile(path=_NO_FILE))
    before: SessionPlan = SessionPlan(trajectory=_NO_FILE)
    after: SessionPlan = SessionPlan(trajectory=_NO_FILE)
    surface: tuple[RockChange, ...] = ()
    recording: Recording


def take_props(scenario: dict[Any, Any]) -> dict[Any, Any]:
    """Return the plain tree of any scenario without its world: only props, without their places in its tunnel."""
    own = ("family", "description", "score_radius_m", "frozen", "turnover")
    kept = {key: scenario[key] for key in own if key in scenario}
    props = scenario.get("props") or []
    return {**kept, "props": [_free(prop) for prop in props] if isinstance(props, list) else props}


def _free(prop: Any) -> Any:
    """Return the plain tree of a prop without the places that only its tunnel has; a move stays one."""
    if not isinstance(prop, dict):
        return prop
    freed = dict(prop)
    if "one_of" in freed and isinstance(freed["one_of"], list):
        freed["one_of"] = [_free(option) for option in freed["one_of"]]
    for key in ("place", "to"):
        if isinstance(freed.get(key), dict):
            freed[key] = {name: value for name, value in freed[key].items() if name == "yaw_deg"}
    return freed
