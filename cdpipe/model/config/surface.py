"""Settings of the displacement of rock."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from cdpipe.core.yamlfile import GrownSettings
from cdpipe.model.config.values import Cell, Positive


class SurfaceConfig(GrownSettings):
    """How far the rock moved."""

    newer: ClassVar[frozenset[str]] = frozenset({
        "method", "spacing_m", "normal_m", "radius_m", "window_m", "reach_m", "mesh_m", "raster_m", "least_m",
        "least_area_m2",
    })  # fmt: skip

    method: Literal["none", "planes", "m3c2", "m3c2-ep", "c2c", "c2m", "unrolled"] = Field(
        "none",
        description=(
            "displacement of the rock: not measured; by local planes; M3C2 and M3C2-EP; to the nearest point; to a "
            "mesh; the difference of unrolled tunnels"
        ),
    )
    spacing_m: Cell = Field(0.25, description="voxel of the before surface that has one place of measurement")
    normal_m: Positive = Field(
        0.3,
        description="radius within which the normal and roughness of a place are estimated, from the nearest 80 cells",
    )
    radius_m: Positive = Field(
        0.2,
        description="`planes`: radius of the spheres that both surfaces are averaged over, from the nearest 120 cells",
    )
    window_m: Positive = Field(
        8.0, description="`planes`: what most rock within this way along the path shares is the alignment's motion"
    )
    reach_m: Positive = Field(
        1.5, description="`c2c`, `c2m`, `unrolled`: a larger displacement is taken for another surface, not measured"
    )
    mesh_m: Cell = Field(0.15, description="`c2m`: the vertices of the mesh are the means of cells of this edge")
    raster_m: Cell = Field(0.15, description="`unrolled`: edge of a cell of the raster of chainage and angle")
    least_m: Positive = Field(0.005, description="a region of rock that moved has places that moved at least so far")
    least_area_m2: Positive = Field(0.75, description="least area of a region of rock that moved")
