"""The LiDAR, and how its rays are cast."""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from cdpipe.core.yamlfile import GrownSettings, Settings
from scenarios.schema.values import NotNegative


class Sensor(GrownSettings):
    """The LiDAR: an Ouster profile (shipped name or metadata .json), its mode, and which effects are on.

    Every effect is a switch, so its influence on a result can be measured. sim/sensor/SENSOR.md names the constants.
    """

    newer: ClassVar[frozenset[str]] = frozenset({"returns", "retroreflectors", "glass"})

    profile: str = "os1-32-nominal"  # a name of `tunnelcd list sensors`, or a metadata .json
    mode: str | None = None  # columns x revolutions per second; left out: the profile's own, 1024x10 if shipped
    rolling_scan: bool = True  # a pose per column; off: the sensor stands still during each revolution
    range_noise: bool = True  # by range and by the strength of the return
    dropouts: bool = True  # weak returns are lost: reflectivity, incidence, range
    returns: Literal["strongest", "last", "dual"] = "strongest"  # of the echoes of a beam; dual: the two strongest
    sub_rays: Literal[1, 7, 19] = 1  # rays over each beam's width; 1: no divergence, no mixed pixels at edges
    false_positives: bool = True  # returns where nothing is
    retroreflectors: bool = False  # reflecting bands and plates are dazzling; off: they are white
    glass: bool = False  # panes let light through and mirror it; off: they are dark walls
    range_step_mm: Literal[1, 8] = 1  # 8: the vendor's low-bandwidth packets
    max_range_m: Annotated[float, Field(gt=0, le=524)] = 120.0  # the vendor's range field: 19 bits of millimetres
    min_range_m: NotNegative = 0.3  # nearer returns are lost

    @property
    def n_returns(self) -> int:
        """How many returns of a beam are recorded at most."""
        return 2 if self.returns == "dual" else 1

    @model_validator(mode="before")
    @classmethod
    def _name_usual_mode(cls, given: Any) -> Any:
        """Write down the mode of a shipped profile, as scenarios always did; a file's own is read with the file."""
        is_shipped = isinstance(given, dict) and not str(given.get("profile", "")).endswith(".json")
        return {"mode": "1024x10", **given} if is_shipped else given

    @field_validator("mode", mode="before")
    @classmethod
    def _has_columns_and_rate(cls, given: Any) -> Any:
        if given is not None and not re.fullmatch(r"\d+x\d+", str(given)):
            raise ValueError("expected a form such as 512x10: columns x revolutions per second")
        return given

    @model_validator(mode="after")
    def _sees_something(self) -> Sensor:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m = {self.min_range_m:g} leaves nothing below max_range_m")
        return self


class Simulation(Settings):
    """How a session is computed: not what is in the world, so `before` and `after` have the same."""

    backend: Literal["embree", "warp"] = "embree"  # casts the sensor's rays; warp: on a GPU where there is one
