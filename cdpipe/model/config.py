"""All settings of the pipeline in one pydantic model, each with a dotted key; a preset is a named set of settings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic.fields import FieldInfo

from cdpipe.core.errors import InputError
from cdpipe.core.plugins import METHODS, PRESETS, entry_points, find_yaml
from cdpipe.core.yamlfile import (
    Document,
    Settings,
    apply_settings,
    read_yaml,
    setting_lines,
    split_section,
    suggest,
    validate,
)

Positive = Annotated[float, Field(gt=0)]
# Smaller cells hold only noise, and `cell_keys` could not number them a kilometre from the origin.
Cell = Annotated[float, Field(ge=0.01)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
NonNegative = Annotated[float, Field(ge=0)]
# A length, or the word; either kind of input breaks the rule of its own kind alone.
LengthOrWidth = Annotated[
    Annotated[Positive, Tag("length")] | Annotated[Literal["width"], Tag("word")],
    Discriminator(lambda value: "word" if isinstance(value, str) else "length"),
]
Site = Literal["narrow", "wide"]
WEIGHTS = ("descriptor.weights", "sphere.weights", "range_net.weights")
"""Settings that name a file; a relative path starts at the file that holds the setting."""


class _Grown(Settings):
    """Settings that grew: a dump leaves out the newer ones where they have their defaults, as older answers do."""

    newer: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def _without_newer_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        defaults = {name: type(self).model_fields[name].default for name in self.newer}
        return {name: value for name, value in handler(self).items() if name not in defaults or value != defaults[name]}


class MapConfig(_Grown):
    """From scans to a thinned map and keyframes."""

    newer: ClassVar[tuple[str, ...]] = ("consistency", "airborne", "movers")

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


class DescriptorConfig(_Grown):
    """The descriptor of every keyframe, computed while mapping."""

    newer: ClassVar[tuple[str, ...]] = ("weights", "device")

    method: Literal["3deg", "untrained", "scan-context", "solid"] = Field(
        "3deg", description="trained weights, the same network untrained, or one made by hand"
    )
    precision: Literal["float32", "int8"] = Field("float32", description="of stored sphere descriptors")
    weights: str = Field("", description="`3deg`: file of weights that `tunnelcd train` wrote; empty: the shipped ones")
    device: Literal["cpu", "cuda"] = Field("cpu", description="`3deg`: where the network computes; `cuda`: a GPU")


class SphereConfig(_Grown):
    """The sphere descriptor."""

    newer: ClassVar[tuple[str, ...]] = ("frames", "weights")

    frames: Literal["sensor", "path"] = Field(
        "sensor", description="axes of its images: the sensor's; path and gravity"
    )
    weights: str = Field("", description="file of weights that `tunnelcd train` wrote; empty: the shipped ones")


class MergeConfig(_Grown):
    """Alignment of both maps: candidate pairs of places, registration of spheres, acceptance, local refinement."""

    newer: ClassVar[tuple[str, ...]] = ("first_every",)

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
    min_distinctness: Annotated[float, Field(ge=1)] = Field(
        1.3, description="accept if any other alignment that fits has a residual this many times larger"
    )
    accept_all: bool = Field(False, description="accept every alignment, as FRAME does")
    fallback: bool = Field(True, description="if nothing is accepted, try KISS-Matcher (extra `kiss`)")
    kiss_voxel_m: Cell = Field(0.6, description="cell of KISS-Matcher")
    refine: Literal["none", "local", "checked"] = Field(
        "local",
        description="align again every few metres along the overlap; `checked`: where held-out points then fit better",
    )


# Sources that score keyframes; they read nothing but descriptors, maps and `query`, and cut out nothing.
SOURCES_AT_KEYFRAMES = ("scan", "sphere", "sphere-difference", "every-keyframe", "random-regions")
WHOLE_MAP_SOURCES = ("voxel-diff", "c2c", "m3c2", "m3c2-ep", "dufomap", "octomap", "removert", "erasor", "range-net")
"""Shipped sources that compare whole maps."""
OF_WHOLE_MAPS = tuple(source.replace("-", "_") for source in WHOLE_MAP_SOURCES)
"""The section of settings that each of them has. `m3c2-ep` reads that of `m3c2`, too."""
# Every dump has held these two. One leaves the others out where they are the defaults, but for that of its own source.
_IN_EVERY_DUMP = ("m3c2", "dufomap")


class RegionsConfig(_Grown):
    """Where regions come from."""

    newer: ClassVar[tuple[str, ...]] = ("min_points",)

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


class ExtractConfig(_Grown):
    """Object extraction: the paper's point-to-voxel comparison, distances, surfaces, or what the source cut out."""

    newer: ClassVar[tuple[str, ...]] = ("recentre",)

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
        2.5, description="`surface`: least mean number of keyframes that saw through a cell, minus those that hit it"
    )


class OutlierConfig(Settings):
    """Statistical outlier removal on the new points, (mu - lambda sigma, mu + lambda sigma)."""

    neighbours: Count = Field(8, description="k, neighbours of the outlier filter")
    sigmas: Positive = Field(2.0, description="lambda, standard deviations that the outlier filter allows")


class ClusterConfig(Settings):
    """From new points to objects."""

    radius_m: Positive = Field(0.5, description="points nearer than this are one object")
    min_points: Count = Field(16, description="`voxel`, `nearest`: smaller clusters are dropped")


class VoxelDiffConfig(Settings):
    """Voxels of the whole maps."""

    voxel_m: Cell = Field(0.5, description="`voxel-diff`: edge of a voxel")


class C2CConfig(Settings):
    """Distances to the nearest point (C2C)."""

    distance_m: Positive = Field(0.2, description="`c2c`: a point farther than this from the other map is new")


class M3C2Config(_Grown):
    """Distances along normals (M3C2)."""

    newer: ClassVar[tuple[str, ...]] = ("distance_m", "registration_m")

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
    every_scan: Count = Field(1, description="`dufomap`: the rays of every n-th scan are cast")


class RemovertConfig(Settings):
    """Range images that see through what is not there (Removert)."""

    pixel_deg: Annotated[float, Field(ge=0.1, le=10)] = Field(
        1.4, description="`removert`: pixel of the fine range image; that of the coarse one is 2.5 times as wide"
    )
    margin: Share = Field(
        0.05, description="`removert`: a scan sees through a point if it is farther by this share of the point's range"
    )
    every_scan: Count = Field(1, description="`removert`: every n-th scan is compared")


class OctomapConfig(Settings):
    """Probability that a voxel is occupied (OctoMap)."""

    voxel_m: Cell = Field(0.1, description="`octomap`: voxel of the occupancy map")
    free_below: Share = Field(0.5, description="`octomap`: a voxel is free if its probability is lower")
    every_scan: Count = Field(1, description="`octomap`: the rays of every n-th scan are cast")


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
    every_scan: Count = Field(1, description="`erasor`: every n-th scan is compared")


class RangeNetConfig(_Grown):
    """A network that compares range images of both maps."""

    newer: ClassVar[tuple[str, ...]] = ("weights",)

    threshold: Annotated[float, Field(gt=0, le=1)] = Field(
        0.5, description="`range-net`: a point is new from this mean probability of a change"
    )
    depth_m: Positive = Field(
        0.3, description="`range-net`: an image shows the points no farther than this behind the nearest of their pixel"
    )
    weights: str = Field(
        "", description="`range-net`: file of weights that `tunnelcd train` wrote; empty: the shipped ones"
    )


class SurfaceConfig(_Grown):
    """How far the rock moved."""

    newer: ClassVar[tuple[str, ...]] = (
        "method", "spacing_m", "normal_m", "radius_m", "window_m", "reach_m", "mesh_m", "raster_m", "least_m",
        "least_area_m2",
    )  # fmt: skip

    method: Literal["none", "planes", "m3c2", "m3c2-ep", "c2c", "c2m", "unrolled"] = Field(
        "none",
        description=(
            "displacement of the rock: not measured; by local planes; M3C2 and M3C2-EP; to the nearest point; to a "
            "mesh; the difference of unrolled tunnels"
        ),
    )
    spacing_m: Cell = Field(0.25, description="voxel of the before surface that has one place of measurement")
    normal_m: Positive = Field(0.3, description="radius within which the normal and roughness of a place are estimated")
    radius_m: Positive = Field(0.2, description="`planes`: radius of the spheres that both surfaces are averaged over")
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


class PipelineConfig(Settings):
    """All settings of one method: where regions come from, how objects are cut out of them, and all before that."""

    renamed: ClassVar[Mapping[str, str]] = {
        "method": (
            "regions.source now: scan or sphere for descriptor; voxel-diff, c2c, m3c2 and dufomap go with "
            "extract.method = clusters"
        ),
        "query.compare": "regions.source now: sphere-difference for difference",
    }

    seed: Annotated[int, Field(ge=0)] = Field(0, description="for methods that draw at random")
    map: MapConfig = MapConfig()
    descriptor: DescriptorConfig = DescriptorConfig()
    sphere: SphereConfig = SphereConfig()
    merge: MergeConfig = MergeConfig()
    regions: RegionsConfig = RegionsConfig()
    query: QueryConfig = QueryConfig()
    extract: ExtractConfig = ExtractConfig()
    outlier: OutlierConfig = OutlierConfig()
    cluster: ClusterConfig = ClusterConfig()
    voxel_diff: VoxelDiffConfig = VoxelDiffConfig()
    c2c: C2CConfig = C2CConfig()
    m3c2: M3C2Config = M3C2Config()
    dufomap: DufomapConfig = DufomapConfig()
    removert: RemovertConfig = RemovertConfig()
    octomap: OctomapConfig = OctomapConfig()
    m3c2_ep: M3C2EPConfig = M3C2EPConfig()
    erasor: ErasorConfig = ErasorConfig()
    range_net: RangeNetConfig = RangeNetConfig()
    surface: SurfaceConfig = SurfaceConfig()
    options: dict[str, bool | int | float | str] = Field(
        {}, description="settings of a plugin's method, by its own names"
    )

    @property
    def described_every(self) -> int:
        """Every which keyframe is described before the merge: `merge.first_every` where the merge alone reads q and w.

        1 for the query of scan descriptors, and for a plugin's source, which may read them.
        """
        is_read = self.regions.source not in (*SOURCES_AT_KEYFRAMES[1:], *WHOLE_MAP_SOURCES)
        return 1 if is_read or self.merge.method != "voting" else self.merge.first_every

    @model_validator(mode="after")
    def _has_clusters(self) -> PipelineConfig:
        if self.extract.method == "clusters" and self.regions.source in SOURCES_AT_KEYFRAMES:
            raise ValueError(
                f"extract.method = clusters: regions.source = {self.regions.source} cuts out nothing itself: expected "
                "surface, voxel or nearest"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_empty_groups(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        own, fields = self.regions.source.replace("-", "_"), type(self).model_fields
        idle = [name for name in OF_WHOLE_MAPS if name not in (own, *_IN_EVERY_DUMP)]
        of_others = [name for name in idle if getattr(self, name) == fields[name].default]
        found = {name: value for name, value in handler(self).items() if name not in of_others}
        return {name: value for name, value in found.items() if name not in ("options", "sphere", "surface") or value}


def preset_names() -> list[str]:
    """Return the names of all presets: shipped, of plugins, and on the search path."""
    return list(preset_files())


def load_config(
    preset: str = "tunnelcd", settings: Iterable[str] | Mapping[str, Any] = (), site: Site = "narrow"
) -> PipelineConfig:
    """Read a preset and apply settings to it.

    Args:
        preset: Name of a preset, or the path of a .yaml file. Its settings are for narrow drifts; the section `wide`
            has those that differ in wide drifts: the radius, and with it the threshold. Where the radius follows the
            width of the drift, a preset needs no such section. Relative paths in it start at that file.
        settings: Replace those of the preset: `["query.radius_m=6"]`, `{"query.radius_m": 6}` or
            `{"query": {"radius_m": 6}}`. Relative paths start at the working folder.
        site: Narrow or wide drifts; no matter for a preset whose radius follows the width.

    Raises:
        InputError: The preset is unknown or has no settings for the site, or keys or values are wrong. All mistakes for
            both sites are reported at once.
    """
    settings = setting_lines(settings)
    narrow, wide = split_section(_preset_document(preset), "wide")
    found: dict[str, PipelineConfig] = {}
    mistakes: dict[str, None] = {}
    for name, document in (("narrow", narrow), ("wide", wide)):
        try:
            if document is not None:
                found[name] = validate(PipelineConfig, apply_settings(document, settings))
        except InputError as error:
            mistakes |= dict.fromkeys(str(error).splitlines())
    if mistakes:
        raise InputError("\n".join(mistakes))
    if site in found:
        return found[site]
    if found["narrow"].query.radius_m == "width" or _follows_width(narrow):
        return found["narrow"]
    raise InputError(
        f"{narrow.source}: wide: missing: this preset does not say what it needs in wide drifts; "
        "expected e.g. wide: {query: {radius_m: 10, threshold: 0.5}}"
    )


def setting_fields() -> Iterator[tuple[str, FieldInfo]]:
    """Yield the dotted key of every setting, and its field."""
    for name, info in PipelineConfig.model_fields.items():
        if isinstance(info.default, Settings):
            yield from ((f"{name}.{key}", inner) for key, inner in type(info.default).model_fields.items())
        else:
            yield name, info


def settings_table() -> list[tuple[str, Any, str]]:
    """Return (key, default, meaning) of every setting, for documentation."""
    return [(key, info.default, info.description or "") for key, info in setting_fields()]


def _preset_document(preset: str) -> Document:
    if preset.endswith((".yaml", ".yml")):
        return _resolve_files(read_yaml(Path(preset)), Path(preset).parent)
    presets = preset_files()
    if preset not in presets:
        raise InputError(f"preset {preset!r} is unknown{suggest(preset, presets)} (known: {', '.join(presets)})")
    document = read_yaml(Path(f"{preset}.yaml"), presets[preset].read_text(encoding="utf-8"))
    return _resolve_files(document, Path(str(presets[preset])).parent)


def _follows_width(preset: Document) -> bool:
    """Return whether the radius of a preset, before settings over it, follows the width of the drift."""
    query = preset.value.get("query")
    return isinstance(query, dict) and query.get("radius_m") == "width"


def _resolve_files(document: Document, folder: Path) -> Document:
    """Return a preset whose relative paths start at its folder, as seen from the working folder."""

    def resolve(tree: Any, key: str = "") -> Any:
        if isinstance(tree, dict):
            return {name: resolve(value, f"{key}.{name}".removeprefix(".")) for name, value in tree.items()}
        is_file = key.removeprefix("wide.") in WEIGHTS and isinstance(tree, str) and tree
        return str(folder / tree) if is_file else tree

    return replace(document, value=resolve(document.value))


def preset_files() -> dict[str, Traversable]:
    """Return the file of every preset by its name: shipped, of plugins, and on the search path."""
    return find_yaml("presets", resources.files("cdpipe") / "methods" / "presets", group=PRESETS)
