"""Settings of the comparison: where regions come from, and how objects are cut out of them."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, field_validator

from cdpipe.core.plugins import METHODS, entry_points
from cdpipe.core.yamlfile import GrownSettings, Settings, suggest
from cdpipe.model.config.values import Cell, Count, LengthOrWidth, Positive

# Sources that score keyframes; they read nothing but descriptors, maps and `query`, and cut out nothing.
SOURCES_AT_KEYFRAMES = ("scan", "sphere", "sphere-difference", "every-keyframe", "random-regions")
WHOLE_MAP_SOURCES = ("voxel-diff", "c2c", "m3c2", "m3c2-ep", "dufomap", "octomap", "removert", "erasor", "range-net")
"""Shipped sources that compare whole maps."""


class RegionsConfig(GrownSettings):
    """Where regions come from."""

    newer: ClassVar[frozenset[str]] = frozenset({"min_points"})

    source: str = Field(
        "scan",
        description=(
            "`scan`: the paper's query of scan descriptors; `sphere`: sphere descriptors; `sphere-difference`, "
            "`every-keyframe`, `random-regions`; `voxel-diff`, `c2c`, `m3c2`, `m3c2-ep`, `dufomap`, `octomap`, "
            "`removert`, `erasor`, `range-net`: clusters of a whole-map comparison; or a plugin's, by its registered "
            "name"
        ),
    )

    min_points: Count = Field(16, description="smaller clusters of a whole-map comparison are no region")

    @field_validator("source")
    @classmethod
    def _is_registered(cls, source: str) -> str:
        known = entry_points(METHODS)
        if source not in known:
            hint = suggest(source, known) or ": install the package that has it"
            raise ValueError(f"no such source (registered: {', '.join(known)}){hint}")
        return source


class QueryConfig(Settings):
    """From scored places to changed regions: reading, radius, threshold, suppression."""

    reading: Literal["nearest", "paired"] = Field(
        "nearest", description="`scan`: A: nearest in descriptor space; B: the same place after alignment"
    )
    radius_m: LengthOrWidth = Field(
        4.5,
        description="radius of a region's sphere (paper: 4.5 and 10), or `width`: 4.5 to 10 by the drift's width",
    )
    threshold: float = Field(
        0.0, description="score from which a region is reported (`sphere`: log-odds); calibrated on validation seeds"
    )
    n_regions: Count | None = Field(None, description="report this many regions instead of using the threshold")
    suppression: Positive = Field(1.0, description="candidates nearer than this many radii to a better one are dropped")
    max_pair_m: Positive = Field(5.0, description="keyframes farther apart are not the same place")


class ExtractConfig(GrownSettings):
    """Object extraction: the paper's point-to-voxel comparison, distances, surfaces, or what the source cut out."""

    newer: ClassVar[frozenset[str]] = frozenset({"recentre", "movers"})

    method: Literal["surface", "voxel", "nearest", "clusters"] = Field(
        "surface",
        description=(
            "distance from the other session's surface; the paper's voxels; the nearest point's; or the clusters of a "
            "source that compares whole maps"
        ),
    )
    withdraw: bool = Field(True, description="withdraw regions in which no object is found")
    recentre: bool = Field(True, description="`surface`: centre each reported region on its objects")
    voxel_m: Cell = Field(0.65, description="`voxel`: size (paper: 0.65)")
    min_points: Count = Field(1, description="`voxel`: points that make a voxel occupied")
    origin_m: float = Field(0.0, ge=-1000, le=1000, description="`voxel`: offset of the grid along every axis")
    distance_m: Positive = Field(0.3, description="`nearest`: a point farther than this from the other cloud is new")
    realign: bool = Field(True, description="`surface`: align each sphere once more before comparing")
    seed_m: Positive = Field(0.12, description="`surface`: an object has cells at least this far from the surface")
    border_m: Positive = Field(
        0.04, description="`surface`: its other cells are this far from it, or 5 times the local noise if that is more"
    )
    min_cells: Count = Field(
        30, description="`surface`: fewest cells of 0.05 m that are `seed_m` from the surface and were seen through"
    )
    min_views: Positive = Field(
        2.5,
        description=(
            "`surface`: least mean number of keyframes that saw through a cell, minus those that hit it; one that lies "
            "over 3 m from the next counts as up to three"
        ),
    )
    movers: Literal["keep", "drop"] = Field(
        "drop", description="`surface`: objects that are people, or came and left while their session was recorded"
    )


class OutlierConfig(Settings):
    """Statistical outlier removal on the new points, (mu - lambda sigma, mu + lambda sigma)."""

    neighbours: Count = Field(8, description="k, neighbours of the outlier filter")
    sigmas: Positive = Field(2.0, description="lambda, standard deviations that the outlier filter allows")


class ClusterConfig(Settings):
    """From new points to objects."""

    radius_m: Positive = Field(0.5, description="points nearer than this are one object")
    min_points: Count = Field(16, description="`voxel`, `nearest`: smaller clusters are dropped")
