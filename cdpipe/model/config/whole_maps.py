"""Settings of the sources that compare whole maps, one model for each."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from cdpipe.core.yamlfile import GrownSettings, Settings
from cdpipe.model.config.values import Cell, Count, NonNegative, Positive, Share


class VoxelDiffConfig(Settings):
    """Voxels of the whole maps."""

    voxel_m: Cell = Field(0.5, description="`voxel-diff`: edge of a voxel")


class C2CConfig(Settings):
    """Distances to the nearest point (C2C)."""

    distance_m: Positive = Field(0.2, description="`c2c`: a point farther than this from the other map is new")


class M3C2Config(GrownSettings):
    """Distances along normals (M3C2)."""

    newer: ClassVar[frozenset[str]] = frozenset({"distance_m", "registration_m"})

    distance_m: Positive = Field(
        0.1, description="`m3c2`: a surface that moved farther than this along its normal is new"
    )
    normal_m: Positive = Field(1.0, description="`m3c2`, `m3c2-ep`: radius within which a point's normal is estimated")
    cylinder_m: Positive = Field(0.25, description="`m3c2`, `m3c2-ep`: radius of the cylinder along the normal")
    depth_m: Positive = Field(1.5, description="`m3c2`, `m3c2-ep`: length of the cylinder to either side")
    registration_m: NonNegative = Field(
        0.0, description="`m3c2` as a surface method: error of the registration in the level of detection"
    )


class DufomapConfig(Settings):
    """Voxels that rays passed through (DUFOMap)."""

    voxel_m: Cell = Field(0.1, description="`dufomap`: voxel of the void map")
    hit_inflation_m: NonNegative = Field(0.2, description="`dufomap`: not void within this distance of a return (d_s)")
    every_scan: Count = Field(1, description="`dufomap`: the rays of every n-th scan are cast, and of stations")


class RemovertConfig(Settings):
    """Range images that see through what is not there (Removert)."""

    pixel_deg: Annotated[float, Field(ge=0.1, le=10)] = Field(
        1.4, description="`removert`: pixel of the fine range image; that of the coarse one is 2.5 times as wide"
    )
    margin: Share = Field(
        0.05, description="`removert`: a scan sees through a point if it is farther by this share of the point's range"
    )
    every_scan: Count = Field(1, description="`removert`: every n-th scan is compared, and stations")


class OctomapConfig(Settings):
    """Probability that a voxel is occupied (OctoMap)."""

    voxel_m: Cell = Field(0.1, description="`octomap`: voxel of the occupancy map")
    free_below: Share = Field(0.5, description="`octomap`: a voxel is free if its probability is lower")
    every_scan: Count = Field(1, description="`octomap`: the rays of every n-th scan are cast, and of stations")


class M3C2EPConfig(Settings):
    """Standard deviations from which M3C2-EP propagates its level of detection."""

    range_m: Positive = Field(0.02, description="`m3c2-ep`: standard deviation of a range")
    angle_deg: Positive = Field(0.1, description="`m3c2-ep`: standard deviation of the angles of a return")
    alignment_m: NonNegative = Field(0.02, description="`m3c2-ep`: standard deviation of the alignment, each axis")


class ErasorConfig(Settings):
    """Heights of columns around the sensor (ERASOR)."""

    max_range_m: Positive = Field(80.0, description="`erasor`: radius of the 20 rings of columns")
    max_height_m: Positive = Field(3.0, description="`erasor`: points higher above the floor are not used")
    scan_ratio: Share = Field(0.2, description="`erasor`: a column is flat if it is lower than this share of the map's")
    every_scan: Count = Field(1, description="`erasor`: every n-th scan is compared, and stations")


class RangeNetConfig(GrownSettings):
    """A network that compares range images of both maps."""

    newer: ClassVar[frozenset[str]] = frozenset({"weights"})

    threshold: Annotated[float, Field(gt=0, le=1)] = Field(
        0.5, description="`range-net`: a point is new from this mean probability of a change"
    )
    depth_m: Positive = Field(
        0.3, description="`range-net`: an image shows the points no farther than this behind the nearest of their pixel"
    )
    weights: str = Field(
        "", description="`range-net`: file of weights that `tunnelcd train` wrote; empty: the shipped ones"
    )
