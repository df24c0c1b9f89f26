"""What a scenario is, once its seed has drawn every distribution. Lengths in metres, angles in degrees.

Frame: `world`, x forward, z up. A drift follows the polyline of its nodes; node z is floor level.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from cdpipe.yamlfile import Settings

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
SignedShare = Annotated[float, Field(ge=-1, le=1)]
Reflectivity = Annotated[float, Field(gt=0, le=1)]
PropKind = Literal["box", "chair", "trolley", "railing", "muck_pile", "barrel"]


class Section(Settings):
    """Cross-section of a drift."""

    shape: Literal["horseshoe", "rectangle"] = "horseshoe"
    width_m: Positive
    height_m: Positive


class Roughness(Settings):
    """One octave of overbreak: smooth noise of this amplitude (standard deviation) and correlation length."""

    amplitude_m: NotNegative
    length_m: Positive


class Drift(Settings):
    """A drift through two or more nodes; its own section if it differs from the tunnel's."""

    nodes: Annotated[tuple[str, ...], Field(min_length=2)]
    section: Section | None = None


class Tunnel(Settings):
    """The walls: a graph of drifts, meshed from one signed distance field."""

    nodes: dict[str, tuple[float, float, float]]
    drifts: Annotated[tuple[Drift, ...], Field(min_length=1)]
    section: Section
    roughness: tuple[Roughness, ...] = ()
    floor_roughness: Annotated[float, Field(ge=0, le=1)] = 0.3  # share of the wall's roughness that the floor has
    meander_m: NotNegative = 0.0  # amplitude of the sideways wander of every centreline
    meander_length_m: Positive = 25.0
    resolution_m: Positive = 0.15  # edge of the marching-cubes cell
    reflectivity: Reflectivity = 0.25

    @model_validator(mode="after")
    def _nodes_exist(self) -> Tunnel:
        for drift in self.drifts:
            for node in drift.nodes:
                if node not in self.nodes:
                    raise ValueError(f"drift {list(drift.nodes)} names node {node!r}, which is not in tunnel.nodes")
        return self


class Place(Settings):
    """Where a prop stands: a share of the way between two neighbouring nodes, and across the drift."""

    between: tuple[str, str]
    fraction: Annotated[float, Field(ge=0, le=1)]
    lateral: SignedShare = 0.0  # -1 right wall, +1 left wall, of the width the prop leaves free
    yaw_deg: float = 0.0  # against the direction of the drift


class Prop(Settings):
    """An object on the floor. What happens to it between the sessions is its `change`."""

    name: str
    kind: PropKind
    size_m: tuple[Positive, Positive, Positive]  # length, width, height of its bounding box
    place: Place
    change: Literal["none", "added", "removed", "moved"] = "none"
    to: Place | None = None  # where a moved prop stands in the after session
    reflectivity: Reflectivity = 0.4

    @model_validator(mode="after")
    def _moved_has_a_goal(self) -> Prop:
        if (self.change == "moved") != (self.to is not None):
            raise ValueError(f"prop {self.name!r}: change: moved and a place `to` go together")
        return self


class Sensor(Settings):
    """The LiDAR: an Ouster profile (shipped name or metadata .json), its mode, and which effects are on."""

    profile: str = "os1-32-nominal"
    mode: Annotated[str, Field(pattern=r"^\d+x\d+$")] = "1024x10"
    range_noise: bool = True
    dropouts: bool = True
    max_range_m: Positive = 120.0
    min_range_m: NotNegative = 0.3


class Platform(Settings):
    """What carries the sensor."""

    kind: Literal["ground_robot", "quadrotor"] = "ground_robot"
    sensor_height_m: Positive = 0.8  # above the floor
    speed_mps: Positive = 1.0
    scan_spacing_m: Positive = 0.25  # path between the recorded revolutions
    clearance_m: Positive = 0.5  # kept to walls and props
    tilt_deg: NotNegative = 1.0  # standard deviation of roll and pitch


class Odometry(Settings):
    """Systematic error of the session's own odometry, in KITTI's terms; the signs are drawn from the seed."""

    translation_percent: NotNegative = 0.0
    yaw_deg_per_100m: NotNegative = 0.0


class SessionPlan(Settings):
    """One drive through the tunnel."""

    route: Annotated[tuple[str, ...], Field(min_length=2)]
    lateral: SignedShare = 0.0  # which line: -1 right, +1 left, of the width the platform leaves free
    start_m: NotNegative = 0.0  # path left out at the start of the route
    end_m: NotNegative = 0.0  # and at its end
    height_m: Positive | None = None  # instead of platform.sensor_height_m
    odometry: Odometry = Odometry()


class Scenario(Settings):
    """A world, what changes in it, and the two drives."""

    family: str
    description: str = ""
    score_radius_m: Positive = 4.5
    tunnel: Tunnel
    props: tuple[Prop, ...] = ()
    sensor: Sensor = Sensor()
    platform: Platform = Platform()
    before: SessionPlan
    after: SessionPlan

    @model_validator(mode="after")
    def _places_exist(self) -> Scenario:
        names = [prop.name for prop in self.props]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two props are called {name!r}")
        edges = {
            frozenset(pair) for drift in self.tunnel.drifts for pair in zip(drift.nodes, drift.nodes[1:], strict=False)
        }
        for prop in self.props:
            for place in (prop.place, prop.to):
                if place is not None and frozenset(place.between) not in edges:
                    raise ValueError(f"prop {prop.name!r} stands between {list(place.between)}, which no drift joins")
        for session, plan in (("before", self.before), ("after", self.after)):
            for pair in pairwise(plan.route):
                if frozenset(pair) not in edges:
                    raise ValueError(f"{session}.route goes from {pair[0]!r} to {pair[1]!r}, which no drift joins")
        return self
