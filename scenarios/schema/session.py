"""One drive through the tunnel, with the air that it meets."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import Field, field_serializer, model_validator

from cdpipe.core.yamlfile import GrownSettings, Settings
from scenarios.schema.odometry import Odometry
from scenarios.schema.platform import Platform
from scenarios.schema.sensor import Sensor
from scenarios.schema.values import NotNegative, Positive, SignedShare


class Mist(Settings):
    """Droplets of water, everywhere alike."""

    visibility_m: Annotated[float, Field(ge=5, le=2000)]  # meteorological optical range: 5 % of the contrast is left


class Dust(Settings):
    """Mineral dust, denser near the floor, in swathes that drift."""

    mg_per_m3: Annotated[float, Field(gt=0, le=5000)]  # mean at the floor
    scale_height_m: Positive = 2.0  # height above the floor at which 37 % are left
    patch_m: Annotated[float, Field(ge=2, le=40)] = 4.0  # correlation length of the swathes
    contrast: Annotated[float, Field(ge=0, le=1.5)] = 0.7  # standard deviation of the logarithm of the density
    drift_mps: NotNegative = 0.3  # speed of the air


class Air(Settings):
    """What is in the air of one session; the truth labels its returns."""

    mist: Mist | None = None
    dust: Dust | None = None


class SessionPlan(GrownSettings):
    """One drive through the tunnel: along a route, or on a recorded trajectory."""

    newer: ClassVar[frozenset[str]] = frozenset({"air", "sensor", "platform"})

    route: tuple[str, ...] = ()  # the nodes that it drives through
    trajectory: str | None = None  # TUM file of world_T_sensor, instead of a route; from the scenario's file
    lateral: SignedShare = 0.0  # which line: -1 right, +1 left, of the width the platform leaves free
    start_m: NotNegative = 0.0  # path left out at the start of the route
    end_m: NotNegative = 0.0  # and at its end
    height_m: Positive | None = None  # instead of platform.sensor_height_m
    speed_mps: Positive | None = None  # instead of platform.speed_mps
    odometry: Odometry = Odometry()
    air: Air | None = None  # mist and dust; left out: clear
    sensor: Sensor | None = None  # of this session alone; keys left out are those of the scenario's sensor
    platform: Platform | None = None  # likewise

    @field_serializer("sensor", "platform")
    def _dump_whole(self, part: Sensor | Platform | None) -> dict[str, Any] | None:
        """Dump every key: one that was left out would be the scenario's when read again."""
        if part is None:
            return None
        lean = part.model_dump(mode="json")
        return {name: lean.get(name, getattr(part, name)) for name in type(part).model_fields}

    @model_validator(mode="after")
    def _route_or_trajectory(self) -> SessionPlan:
        if len(self.route) == 1 or bool(self.route) == (self.trajectory is not None):
            raise ValueError("give a route of two nodes or more, or a trajectory")
        of_a_route = {"lateral": 0.0, "start_m": 0.0, "end_m": 0.0, "height_m": None, "speed_mps": None}
        said = [name for name, left_out in of_a_route.items() if getattr(self, name) != left_out]
        if self.trajectory is not None and said:
            raise ValueError(f"a trajectory is driven as recorded: leave {', '.join(said)} out")
        return self
