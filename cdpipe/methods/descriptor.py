"""Regions at keyframes: by descriptors, as in the paper and in `tunnelcd`, by points, or at every one of them."""

from __future__ import annotations

from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, MergedMaps
from cdpipe.query.query import find_regions


class DescriptorQuery:
    """Registered as `scan`, the inverted query of the paper (section III), and as `sphere`."""

    uses_descriptors = True

    def propose(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeRegions:
        """Return the candidate regions, ranked by the descriptors of the keyframes."""
        return find_regions(merged, before, after, config)


class KeyframeQuery(DescriptorQuery):
    """Registered as `sphere-difference` and `every-keyframe`, which read no descriptors."""

    uses_descriptors = False
