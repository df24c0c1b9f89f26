"""Voxel difference of the whole maps: new is what lies in a voxel that the other map leaves empty."""

from __future__ import annotations

from cdpipe.core.geometry import BoolArray
from cdpipe.extract.point_comparison import new_points_mask
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import ExtractConfig, PipelineConfig
from cdpipe.model.types import SessionName


@WholeMap
def voxel_diff(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` in a voxel (`voxel_diff.voxel_m`) that is empty in `other`."""
    return new_points_mask(maps.points[session], maps.points[other], ExtractConfig(voxel_m=config.voxel_diff.voxel_m))
