"""Water that stands on the floor."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import Settings
from scenarios.schema.values import Share, SignedShare


class PuddlePlace(Settings):
    """Where water stands: a share of the way between two nodes, in an area, or anywhere on the way of the drives."""

    between: tuple[str, str] | None = None
    fraction: Share | None = None  # of the way between the two nodes
    area: str | None = None
    lateral: SignedShare | None = None  # of its middle: -1 right wall, +1 left wall; None: drawn

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> PuddlePlace:
        if (self.between is None) != (self.fraction is None):
            raise ValueError("between and fraction go together")
        if self.between is not None and self.area is not None:
            raise ValueError("give between or area, not both")
        return self


class Puddle(Settings):
    """Standing water: a level sheet that covers the lowest part of the floor around a place. Never a change.

    sim/sensor/SENSOR.md says what the sensor sees of it.
    """

    name: str
    sessions: Literal["both", "before", "after"] = "both"
    place: PuddlePlace = PuddlePlace()
    radius_m: Annotated[float, Field(gt=0, le=10)] = 1.5  # it reaches no farther than this from its middle
    depth_m: Annotated[float, Field(gt=0, le=0.5)] = 0.05  # above the lowest place of the floor within that
