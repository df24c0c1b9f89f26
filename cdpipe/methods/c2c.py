"""Cloud-to-cloud distance (C2C) between the whole maps: new is what is far from the other map."""

from __future__ import annotations

from cdpipe.core.geometry import BoolArray
from cdpipe.extract.point_comparison import far_points_mask
from cdpipe.methods.whole_map import PlacedMaps, whole_map
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps, SessionName


def c2c(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what is farther than `extract.distance_m` from the other map.

    The distance to the nearest point, cloud to cloud (C2C), as CloudCompare and others measure it.
    """

    def new_mask(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
        return far_points_mask(maps.points[session], maps.points[other], config.extract)

    return whole_map(merged, before, after, config, new_mask)
