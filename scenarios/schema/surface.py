"""Rock that moves, comes or goes between the sessions."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import Settings
from scenarios.schema.values import Degrees, Share, fill_in_usual, refuse_other_keys

SurfaceKind = Literal["convergence", "heave", "shotcrete", "scar", "fill", "face"]
# What each kind of surface change is like where its keys are left out; a kind has these keys and no other of them.
USUAL_SURFACES: dict[str, dict[str, Any]] = {
    "convergence": {"depth_m": 0.03, "length_m": 4.0, "sector_deg": (40.0, 120.0)},
    "heave": {"depth_m": 0.05, "length_m": 5.0, "sector_deg": (140.0, 220.0)},
    "shotcrete": {"thickness_m": 0.05, "length_m": 4.0, "sector_deg": (-105.0, 105.0)},
    "scar": {"depth_m": 0.4, "length_m": 1.6, "sector_deg": (30.0, 70.0), "swell": 1.45},
    "fill": {"height_m": 0.4, "length_m": 8.0},
    "face": {"advance_m": 3.0},
}


class SurfacePlace(Settings):
    """Where rock changes: between two nodes, in an area, at a blind end, or anywhere on the way of the drives."""

    between: tuple[str, str] | None = None
    fraction: Share | None = None  # of the way between the two nodes: the middle of the change
    area: str | None = None
    node: str | None = None  # the blind end of a drift: where a face advances, and from where fill reaches back

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> SurfacePlace:
        if (self.between is None) != (self.fraction is None):
            raise ValueError("between and fraction go together")
        if sum(way is not None for way in (self.between, self.area, self.node)) > 1:
            raise ValueError("give one of between, area and node")
        return self


class SurfaceChange(Settings):
    """Rock that moves, comes or goes between the sessions. sim/displacement/DISPLACEMENT.md has every kind.

    Sectors are degrees about the drift's axis, looking along it: 0 the crown of the roof, 90 the left wall, 180 the
    floor. They may go beyond 180: [140, 220] is the middle of the floor.
    """

    name: str
    kind: SurfaceKind
    place: SurfacePlace = SurfacePlace()
    depth_m: Annotated[float, Field(gt=0, le=2)] | None = None  # largest; a scar reaches 1.7 of it
    thickness_m: Annotated[float, Field(gt=0, le=0.3)] | None = None  # of shotcrete
    height_m: Annotated[float, Field(gt=0, le=3)] | None = None  # of fill above the floor
    advance_m: Annotated[float, Field(gt=0, le=4.5)] | None = None  # of a face
    length_m: Annotated[float, Field(ge=0.5, le=60)] | None = None  # along the drift
    sector_deg: tuple[Degrees, Degrees] | None = None
    swell: Annotated[float, Field(ge=1, le=2)] | None = None  # volume of the rubble over that of the scar

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        return fill_in_usual(given, USUAL_SURFACES)

    @model_validator(mode="after")
    def _keys_of_its_kind(self) -> SurfaceChange:
        refuse_other_keys(self, USUAL_SURFACES, f"surface {self.name!r}")
        if self.sector_deg is not None and not 5 <= self.sector_deg[1] - self.sector_deg[0] <= 360:
            raise ValueError(f"surface {self.name!r}: sector_deg: from and to are 5 to 360 degrees apart, from first")
        if (
            self.kind == "heave"
            and self.sector_deg is not None
            and not 90 <= self.sector_deg[0] < self.sector_deg[1] <= 270
        ):
            raise ValueError(f"surface {self.name!r}: sector_deg of a heave: the floor lies between 90 and 270 degrees")
        if self.kind == "face" and (self.place.between or self.place.area):
            raise ValueError(f"surface {self.name!r}: a face is at a node, the blind end of a drift")
        if self.place.node is not None and self.kind not in ("face", "fill"):
            raise ValueError(f"surface {self.name!r}: only a face or fill has place.node: give between and fraction")
        return self
