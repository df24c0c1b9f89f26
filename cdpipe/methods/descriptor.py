"""Regions by descriptors, as in the paper and as `tunnelcd` does it; `query.compare` says which descriptors."""

from __future__ import annotations

from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, MergedMaps
from cdpipe.query.query import find_regions


class DescriptorQuery:
    """The inverted query of the paper (section III), or its comparison of spheres; a registered method."""

    uses_descriptors = True

    def propose(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeRegions:
        """Return the places that changed, ranked, by the descriptors of the keyframes."""
        return find_regions(merged, before, after, config.query)
