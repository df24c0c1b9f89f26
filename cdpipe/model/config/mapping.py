"""Settings of all before the comparison: maps, descriptors and their merge."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import GrownSettings
from cdpipe.model.config.values import Cell, Count, Positive, Share


class MapConfig(GrownSettings):
    """From scans to a thinned map and keyframes."""

    newer: ClassVar[frozenset[str]] = frozenset({"consistency", "airborne", "movers"})

    voxel_m: Cell = Field(0.2, description="cell of the thinned map")
    max_range_m: Positive = Field(60.0, description="returns beyond this range are not mapped")
    keyframe_spacing_m: Positive = Field(1.0, description="path between keyframes")
    consistency: Literal["none", "scan-to-map", "graph"] = Field(
        "none",
        description="map with the recorded poses; register every scan once more with those around it; close loops, too",
    )
    airborne: Literal["keep", "drop"] = Field(
        "keep", description="returns of mist and dust; dropped where they are over 1 in 100 of a scan"
    )
    movers: Literal["keep", "drop"] = Field(
        "keep", description="what moved while the session was recorded: what the session itself saw through as well"
    )


class DescriptorConfig(GrownSettings):
    """The descriptor of every keyframe, computed while mapping."""

    newer: ClassVar[frozenset[str]] = frozenset({"weights", "device"})

    method: Literal["3deg", "untrained", "scan-context", "solid"] = Field(
        "3deg", description="trained weights, the same network untrained, or one made by hand"
    )
    precision: Literal["float32", "int8"] = Field("float32", description="of stored sphere descriptors")
    weights: str = Field("", description="`3deg`: file of weights that `tunnelcd train` wrote; empty: the shipped ones")
    device: Literal["cpu", "cuda"] = Field("cpu", description="`3deg`: where the network computes; `cuda`: a GPU")

    @model_validator(mode="after")
    def _uses_weights(self) -> DescriptorConfig:
        if self.weights and self.method != "3deg":
            raise ValueError(
                f"descriptor.weights = {self.weights}: descriptor.method = {self.method} has no weights of its own: "
                "expected 3deg"
            )
        return self


class SphereConfig(GrownSettings):
    """The sphere descriptor."""

    newer: ClassVar[frozenset[str]] = frozenset({"frames", "weights"})

    frames: Literal["sensor", "path"] = Field(
        "sensor", description="axes of its images: the sensor's; path and gravity"
    )
    weights: str = Field("", description="file of weights that `tunnelcd train` wrote; empty: the shipped ones")


class MergeConfig(GrownSettings):
    """Alignment of both maps: candidate pairs of places, registration of spheres, acceptance, local refinement."""

    newer: ClassVar[frozenset[str]] = frozenset({"first_every"})

    method: Literal["voting", "frame", "kiss-matcher"] = Field(
        "voting", description="candidates that agree; FRAME's closest pair; or KISS-Matcher on the whole maps"
    )
    n_candidates: Count = Field(4, description="hypotheses tried by `voting`")
    first_every: Count = Field(
        1,
        description="`voting`: compare every n-th keyframe first, every 2n-th of the after session; all if refused",
    )
    sphere_radius_m: Positive = Field(10.0, description="submap around a pair (FRAME: 10 m)")
    voxel_m: Cell = Field(0.4, description="thinning of a sphere before it is registered")
    seen_within_m: Positive = Field(15.0, description="map points seen only from farther away are not used")
    target_voxel_m: Cell = Field(0.3, description="thinning of the before map, which the spheres are registered to")
    coarse_voxel_m: Cell = Field(0.8, description="the same while hypotheses are tried")
    gicp_correspondence_m: Positive = Field(3.0, description="FRAME: 3 m")
    vgicp_correspondence_m: Positive = Field(1.0, description="FRAME: 1 m")
    inlier_m: Positive = Field(0.1, description="a point within this distance of the other map's surface is an inlier")
    min_overlap: Share = Field(0.15, description="accept at least this share of the shorter path beside the other")
    min_inlier_share: Share = Field(0.85, description="accept at least this share of inliers in the sphere")
    min_hessian_ratio: Share = Field(0.015, description="smallest to largest translational eigenvalue: degeneracy")
    min_agreement: Share = Field(0.8, description="accept at least this share of inliers along both paths")
    # without a rival, or a near one, the evidence is 10
    min_distinctness: Annotated[float, Field(ge=1, le=10)] = Field(
        1.3, description="accept if any other alignment that fits has a residual this many times larger"
    )
    accept_all: bool = Field(False, description="accept every alignment, as FRAME does")
    fallback: bool = Field(True, description="if nothing is accepted, try KISS-Matcher (extra `kiss`)")
    kiss_voxel_m: Cell = Field(0.6, description="cell of KISS-Matcher")
    refine: Literal["none", "local", "checked"] = Field(
        "local",
        description="align again every few metres along the overlap; `checked`: where held-out points then fit better",
    )
