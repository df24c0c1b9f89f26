"""What moves while a session is recorded."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import GrownSettings, Settings
from scenarios.schema.values import (
    NotNegative,
    Positive,
    Reflectivity,
    Share,
    SignedShare,
    fill_in_usual,
    refuse_other_keys,
)


class Stretch(Settings):
    """Where a mover goes to and fro: between two nodes, in an area, or (neither) anywhere on the way of the drives.

    In the last two cases the seed draws a stretch of `length_m`, and draws again until nothing is in its way.
    """

    between: tuple[str, str] | None = None
    fractions: tuple[Share, Share] | None = None  # of the way between the two nodes: where it starts and turns round
    area: str | None = None
    length_m: Positive = 8.0  # of a stretch that the seed draws
    lateral: SignedShare | None = None  # -1 right wall, +1 left wall, of the width the mover leaves free; None: drawn

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> Stretch:
        if (self.between is None) != (self.fractions is None):
            raise ValueError("between and fractions go together")
        if self.between is not None and self.area is not None:
            raise ValueError("give between or area, not both")
        return self


# What each kind of mover is like where its keys are left out; a kind has these keys and no other of them.
USUAL_MOVERS: dict[str, dict[str, Any]] = {
    "person": {"speed_mps": 1.3, "pause_s": 2.0, "height_m": 1.75},
    "forklift": {"speed_mps": 2.0, "pause_s": 4.0, "size_m": (3.4, 1.15, 2.1)},
    "loader": {"speed_mps": 2.0, "pause_s": 6.0, "size_m": (8.6, 2.2, 2.2)},
    "curtain": {"width_m": 1.6, "swing_deg": 10.0},
}


# Half a step is shorter than the leg up to this speed of a person of 1 m, and goes with the square of the height:
# `sim.movers.person` has steps of the root of 0.387 m s times the speed, and legs of 0.484 of the height.
_FASTEST_MPS = 2.4154


class Mover(GrownSettings):
    """Something that moves while a session is recorded; never a change. sim/movers/MOVERS.md has every kind."""

    newer: ClassVar[frozenset[str]] = frozenset({"dust_mg_per_m"})

    name: str
    kind: Literal["person", "forklift", "loader", "curtain"]
    sessions: Literal["both", "before", "after"] = "both"
    path: Stretch = Stretch()
    speed_mps: NotNegative | None = None  # 0: a person stands at the start of the stretch; a curtain has none
    pause_s: NotNegative | None = None  # at either end; a person turns round meanwhile, a machine lifts or lowers
    height_m: Annotated[float, Field(ge=1.2, le=2.2)] | None = None  # of a person
    size_m: tuple[Positive, Positive, Positive] | None = None  # of a machine: length, width, height
    width_m: Positive | None = None  # of a curtain; it hangs from the roof down to the floor
    swing_deg: Annotated[float, Field(ge=0, le=30)] | None = None  # amplitude of a curtain's lowest strip
    reflectivity: Reflectivity | None = None  # of every part; left out: what each part is made of
    dust_mg_per_m: Annotated[float, Field(ge=0, le=10000)] | None = None  # that a machine raises on its way

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        return fill_in_usual(given, USUAL_MOVERS)

    @model_validator(mode="after")
    def _keys_of_its_kind(self) -> Mover:
        refuse_other_keys(self, USUAL_MOVERS, f"mover {self.name!r}")
        if self.dust_mg_per_m is not None and self.kind not in ("forklift", "loader"):
            raise ValueError(f"mover {self.name!r}: a {self.kind} raises no dust: leave dust_mg_per_m out")
        if self.speed_mps == 0 and self.kind != "person":
            raise ValueError(f"mover {self.name!r}: a {self.kind} that never moves is a prop: give it a speed_mps")
        return self

    @model_validator(mode="after")
    def _takes_steps_that_legs_can_take(self) -> Mover:
        if self.height_m is not None and (self.speed_mps or 0.0) > (fastest_mps := _FASTEST_MPS * self.height_m**2):
            raise ValueError(
                f"mover {self.name!r}: speed_mps = {self.speed_mps:g}: a person of height_m = {self.height_m:g} takes "
                f"steps for at most {fastest_mps:.2f} m/s: lower speed_mps, or raise height_m"
            )
        return self
