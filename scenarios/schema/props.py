"""Props: what they are, where they stand, and what happens to them between the sessions."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, get_args

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import GrownSettings, Settings
from scenarios.schema.tunnel import MeshFile
from scenarios.schema.values import Finite, Positive, Reflectivity, Share, SignedShare

PropKind = Literal[
    "box", "crate", "chair", "trolley", "barrel", "cone", "railing", "pallet", "rock", "vehicle", "muck_pile", "mesh"
]
PROP_KINDS: tuple[str, ...] = get_args(PropKind)


class Area(Settings):
    """A stretch of the tunnel that both sessions drive, where things change; the seed draws where it lies.

    Areas keep as far from one another as four score radii where the tunnel is long enough.
    """

    name: str
    length_m: Positive = 6.0


class Place(Settings):
    """Where a prop stands: between two nodes, at a point, in an area, or (none of these) anywhere on the way.

    In the last two cases the seed draws the station, and draws again until the prop fits and stands in no other.
    """

    between: tuple[str, str] | None = None
    fraction: Share | None = None  # of the way between the two nodes
    at: tuple[Finite, Finite, Finite] | None = None  # world; the floor is looked for below it
    area: str | None = None
    lateral: SignedShare = 0.0  # -1 right wall, +1 left wall, of the width the prop leaves free; not with `at`
    yaw_deg: Finite = 0.0  # against the direction of the drift; with `at` against the x axis
    posture: Literal["upright", "tipped", "leaning"] = "upright"  # leaning: against the nearer wall; a pile: banked up

    @model_validator(mode="after")
    def _one_way_to_say_where(self) -> Place:
        if (self.between is None) != (self.fraction is None):
            raise ValueError("between and fraction go together")
        if sum(way is not None for way in (self.between, self.at, self.area)) > 1:
            raise ValueError("give one of between, at and area")
        if self.at is not None and self.lateral:
            raise ValueError(f"lateral = {self.lateral:g}: at says where across the drift, too: leave lateral out")
        return self


class PropFile(Settings):
    """A kind of prop on the search path: a surface, and how much light it sends back."""

    mesh: MeshFile  # a relative path starts at this file
    reflectivity: Reflectivity | None = None


class Shift(Settings):
    """A short move from where a prop stands."""

    distance_m: Positive
    heading_deg: Finite = 0.0  # direction, against that of the drift
    turn_deg: Finite = 0.0


class Aged(Settings):
    """What time did to a prop that nobody touched: in the after session it stands a little otherwise; no change.

    The pose of the before session is displaced as a whole; nothing settles again, or keeps it out of a wall.
    """

    shift_m: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    heading_deg: Finite = 0.0  # direction of the shift, against the x axis of the world
    turn_deg: Annotated[float, Field(ge=-20, le=20)] = 0.0
    lean_deg: Annotated[float, Field(ge=-20, le=20)] = 0.0  # about the prop's own x axis
    sag_m: Annotated[float, Field(ge=0, le=0.2)] = 0.0  # into the floor


class Prop(GrownSettings):
    """An object on the floor. What happens to it between the sessions is its `change`."""

    newer: ClassVar[frozenset[str]] = frozenset({"aged"})

    name: str
    kind: str  # a PropKind, or the name of a prop on the search path, which has a mesh
    size_m: tuple[Positive, Positive, Positive] | None = None  # length, width, height when upright; a mesh has its own
    mesh: MeshFile | None = None
    place: Place = Place()
    change: Literal["none", "added", "removed", "moved", "reshaped"] = "none"
    to: Place | None = None  # where a moved prop stands in the after session
    shift: Shift | None = None  # or how far from its first place
    aged: Aged | None = None  # of a prop that stays: how it stands in the after session
    loaded_share: Annotated[float, Field(gt=0, lt=1)] | None = None  # of a reshaped pile's volume, taken away
    repose_deg: Annotated[float, Field(ge=30, le=45)] = 37.0  # flanks of a pile; blasted rock has 34 to 40
    fragment_m: Annotated[float, Field(ge=0.02, le=2.0)] = 0.25  # characteristic size of a pile's fragments
    reflectivity: Reflectivity | None = None  # of every part; left out: what each part is made of

    @model_validator(mode="after")
    def _parts_go_together(self) -> Prop:
        if self.mesh is None and self.kind not in PROP_KINDS:
            raise ValueError(f"prop {self.name!r}: no prop is called {self.kind}")
        if (self.kind not in PROP_KINDS or self.kind == "mesh") != (self.mesh is not None):
            raise ValueError(f"prop {self.name!r}: kind: mesh and a file `mesh` go together")
        if (self.mesh is None) == (self.size_m is None):
            wanted = (
                "size_m: [length, width, height] is missing"
                if self.mesh is None
                else "a mesh has its own size: leave size_m out"
            )
            raise ValueError(f"prop {self.name!r}: {wanted}")
        if (self.change == "moved") != ((self.to is not None) != (self.shift is not None)):
            raise ValueError(f"prop {self.name!r}: change: moved goes with a place `to` or a `shift`, not both")
        if (self.change == "reshaped") != (self.loaded_share is not None):
            raise ValueError(f"prop {self.name!r}: change: reshaped and loaded_share go together")
        if self.aged is not None and self.change != "none":
            raise ValueError(f"prop {self.name!r}: aged: only of a prop that stays (change: none)")
        if self.change == "reshaped" and self.kind != "muck_pile":
            raise ValueError(f"prop {self.name!r}: only a muck_pile can be reshaped")
        if self.kind in ("muck_pile", "railing") and "tipped" in (self.place.posture, self.to and self.to.posture):
            raise ValueError(f"prop {self.name!r}: a {self.kind} is set into the floor, it cannot be tipped")
        return self
