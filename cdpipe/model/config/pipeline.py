"""All settings of the pipeline in one model, each with a dotted key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator
from pydantic.fields import FieldInfo

from cdpipe.core.yamlfile import Settings
from cdpipe.model.config.comparison import (
    SOURCES_AT_KEYFRAMES,
    WHOLE_MAP_SOURCES,
    ClusterConfig,
    ExtractConfig,
    OutlierConfig,
    QueryConfig,
    RegionsConfig,
)
from cdpipe.model.config.mapping import DescriptorConfig, MapConfig, MergeConfig, SphereConfig
from cdpipe.model.config.surface import SurfaceConfig
from cdpipe.model.config.whole_maps import (
    C2CConfig,
    DufomapConfig,
    ErasorConfig,
    M3C2Config,
    M3C2EPConfig,
    OctomapConfig,
    RangeNetConfig,
    RemovertConfig,
    VoxelDiffConfig,
)

OF_WHOLE_MAPS = tuple(source.replace("-", "_") for source in WHOLE_MAP_SOURCES)
"""The section of settings that each of them has. `m3c2-ep` reads that of `m3c2`, too."""
# Every dump has held these two. One leaves the others out where they are the defaults, but for that of its own source.
_IN_EVERY_DUMP = ("m3c2", "dufomap")


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


def setting_fields() -> Iterator[tuple[str, FieldInfo]]:
    """Yield the dotted key of every setting, and its field."""
    for name, info in PipelineConfig.model_fields.items():
        if isinstance(info.default, Settings):
            yield from ((f"{name}.{key}", inner) for key, inner in type(info.default).model_fields.items())
        else:
            yield name, info


def settings_table() -> list[tuple[str, str, str]]:
    """Return (key, default, meaning) of every setting, for documentation; other choices stand behind a default."""
    return [(key, _show_choices(info), info.description or "") for key, info in setting_fields()]


def _show_choices(info: FieldInfo) -> str:
    is_choice = get_origin(info.annotation) is Literal
    others = [str(value) for value in get_args(info.annotation) if is_choice and value != info.default]
    return f"{info.default}; {', '.join(others)}" if others else f"{info.default}"
