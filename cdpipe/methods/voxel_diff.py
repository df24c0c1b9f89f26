"""Voxel difference of the whole maps: new is what lies in a voxel that the other map leaves empty."""

from __future__ import annotations

from cdpipe.core.geometry import BoolArray
from cdpipe.extract.point_comparison import new_points_mask
from cdpipe.methods.whole_map import PlacedMaps, whole_map
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName


def voxel_diff(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what lies in a voxel that is empty in the other (`extract.voxel_m`)."""

    def new_mask(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
        return new_points_mask(maps.points[session], maps.points[other], config.extract)

    return whole_map(merged, before, after, config, new_mask)
