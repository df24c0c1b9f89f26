"""Cloud-to-cloud distance (C2C) between the whole maps: new is what is far from the other map."""

from __future__ import annotations

from cdpipe.core.geometry import BoolArray
from cdpipe.extract.point_comparison import is_within
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import SessionName


@WholeMap
def c2c(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` farther than `c2c.distance_m` from every point of `other`.

    CloudCompare and others measure this distance to the nearest point.
    """
    return ~is_within(maps.points[session], maps.points[other], config.c2c.distance_m)
