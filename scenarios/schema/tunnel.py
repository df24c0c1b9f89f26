"""The tunnel: its drifts, its walls and floor, and what is fixed to them."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import GrownSettings, Settings
from scenarios.schema.values import Finite, NotNegative, Positive, Reflectivity, Share, Side, SignedShare

FARTHEST_M = 20_000.0  # of rock from the origin: MuJoCo keeps vertices in float32, in steps of 2 mm there
Across = Annotated[float, Field(gt=0, le=100)]  # the widest caverns in use are 60 m across
_FINEST_SHARE = 0.25  # of a cell of the mesh; rock that is rougher on a shorter length is not drawn, and fills memory


class Section(Settings):
    """Cross-section of a drift at its nominal size; in a foreign mesh about how wide and high its drifts are."""

    shape: Literal["horseshoe", "d", "arch", "rectangle", "cave"] = "horseshoe"
    width_m: Across = 5.0
    height_m: Across = 4.0


class Variation(Settings):
    """Slow change of width and of height along every drift."""

    share: Annotated[float, Field(ge=0, le=0.4)]  # standard deviation, as a share of the nominal size
    length_m: Positive = 12.0  # correlation length


class Roughness(Settings):
    """One octave of overbreak: smooth noise of this amplitude (standard deviation) and correlation length."""

    amplitude_m: NotNegative
    length_m: Positive


class Ruts(Settings):
    """Two wheel tracks along the middle of every drift."""

    depth_m: Positive
    gauge_m: Positive = 1.6  # between the middles of the two tracks
    width_m: Positive = 0.45


class Stones(Settings):
    """Loose fragments on the floor, sizes after Rosin-Rammler, smaller ones left out."""

    per_m2: Annotated[float, Field(ge=0, le=100)]
    size_m: Positive = 0.12  # characteristic size
    max_size_m: Positive = 0.35


class Floor(Settings):
    """What makes the floor more than a plane."""

    roughness: Share = 0.3  # share of the wall's roughness that the floor has
    crossfall_percent: Finite = 0.0  # falls to the right where positive
    ruts: Ruts | None = None
    stones: Stones | None = None


class Drift(Settings):
    """A drift through two or more nodes; its own section if it differs from the tunnel's."""

    nodes: Annotated[tuple[str, ...], Field(min_length=2)]
    section: Section | None = None


class Niche(Settings):
    """A recess in one wall, floor level with the drift's."""

    between: tuple[str, str]
    fraction: Share
    side: Side
    width_m: Across
    depth_m: Across
    height_m: Across


class Pipe(Settings):
    """A pipe on brackets along one wall of every drift."""

    diameter_m: Positive
    side: Side
    height_share: Share = 0.5  # of the drift's height


class Duct(Settings):
    """A ventilation duct hung below the roof of every drift."""

    diameter_m: Positive
    lateral: SignedShare = 0.5  # -1 right, +1 left


class CableTray(Settings):
    """A cable tray on brackets along one wall of every drift, with cables in it."""

    width_m: Positive = 0.3
    side: Side = "left"
    height_share: Share = 0.7


class Bolts(Settings):
    """Rock bolts with plates, in a square pattern over roof and upper walls."""

    spacing_m: Annotated[float, Field(ge=0.1, allow_inf_nan=False)] = 1.2


class Screen(Settings):
    """Welded wire mesh on roof and shoulders, in panels."""

    share: Share = 1.0  # of the length of every drift
    opening_m: Annotated[float, Field(ge=0.01, allow_inf_nan=False)] = 0.1


class Markers(Settings):
    """Plates of retroreflecting sheet, flat along one wall of every drift, as chainage is marked."""

    every_m: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 10.0
    size_m: Positive = 0.3
    side: Side = "left"
    height_share: Share = 0.3  # of the drift's height


class Furniture(GrownSettings):
    """What is fixed to the rock in both sessions and must never count as a change."""

    newer: ClassVar[frozenset[str]] = frozenset({"markers"})

    pipes: tuple[Pipe, ...] = ()
    ducts: tuple[Duct, ...] = ()
    cable_trays: tuple[CableTray, ...] = ()
    bolts: Bolts | None = None
    screen: Screen | None = None
    markers: Markers | None = None


class MeshFile(Settings):
    """A surface someone else made: STL, OBJ, PLY or GLB. A relative path starts at the scenario's file."""

    path: Annotated[str, Field(pattern=r"^[^\x00]+$")]
    units: Literal["m", "cm", "mm", "in", "ft"] = "m"
    up: Literal["x", "y", "z"] = "z"  # which axis of the file points up
    flip: bool = False  # turn the surface inside out
    allow_open: bool = False  # rays may leave through its holes


class Tunnel(Settings):
    """The walls: a graph of drifts, meshed from one signed distance field; or a mesh that nodes and drifts lie in."""

    mesh: MeshFile | None = None
    nodes: dict[str, tuple[Finite, Finite, Finite]] = Field(default_factory=dict)
    drifts: tuple[Drift, ...] = ()
    niches: tuple[Niche, ...] = ()
    section: Section = Section()
    variation: Variation | None = None
    roughness: tuple[Roughness, ...] = ()
    floor: Floor = Floor()
    meander_m: NotNegative = 0.0  # amplitude of the sideways wander of every centreline
    meander_length_m: Positive = 25.0
    furniture: Furniture = Furniture()
    resolution_m: Annotated[float, Field(ge=0.01, allow_inf_nan=False)] = 0.15  # edge of the marching-cubes cell
    reflectivity: Reflectivity = 0.25

    @model_validator(mode="after")
    def _has_walls(self) -> Tunnel:
        if not self.drifts and self.mesh is None:
            raise ValueError("a tunnel needs drifts, or a mesh")
        return self

    @model_validator(mode="after")
    def _lies_near_the_origin(self) -> Tunnel:
        for name, place in self.nodes.items():
            reach_m = max(map(abs, place))
            if reach_m > FARTHEST_M:
                raise ValueError(
                    f"node {name!r} lies {reach_m / 1000:.0f} km from the origin, where millimetres are lost: subtract "
                    "one offset from all nodes, places and trajectories"
                )
        return self

    @model_validator(mode="after")
    def _is_no_rougher_than_its_mesh(self) -> Tunnel:
        finest_m = _FINEST_SHARE * self.resolution_m
        for number, octave in enumerate(self.roughness):
            if self.mesh is None and octave.amplitude_m > 0 and octave.length_m < finest_m:
                raise ValueError(
                    f"roughness.{number}.length_m = {octave.length_m:g}: cells of resolution_m = {self.resolution_m:g} "
                    f"cannot show it: expected at least {finest_m:g}, or leave this octave out"
                )
        return self
