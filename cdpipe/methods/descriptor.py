"""Regions by descriptors, as in the paper and in `tunnelcd`; `query.compare` names the descriptors."""

from __future__ import annotations

from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, MergedMaps
from cdpipe.query.query import find_regions


class DescriptorQuery:
    """A registered method: the inverted query of the paper (section III), or the comparison of spheres."""

    uses_descriptors = True

    def propose(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeRegions:
        """Return the candidate regions, ranked by the descriptors of the keyframes."""
        return find_regions(merged, before, after, config.query, config.sphere)
