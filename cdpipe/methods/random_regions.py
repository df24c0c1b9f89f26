"""Regions drawn at random: the control of every table."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import stream
from cdpipe.methods.whole_map import nearest_of, placed_maps
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, MergedMaps
from cdpipe.query.query import rank_regions


class RandomRegions:
    """A registered method: regions drawn at random, objects cut out of them as the pipeline does."""

    def propose(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeRegions:
        """Give every before keyframe that the after session came near to a random score.

        The draw depends on `config.seed` and on the sizes of the maps, so that different pairs get independent draws.
        """
        maps = placed_maps(merged, before, after)
        sizes = f"{len(merged.before.points)} {len(merged.after.points)}"
        gaps_m, partners = nearest_of(maps.path["before"], maps.path["after"])
        scores = stream(config.seed, "random-regions", sizes).random(len(gaps_m))
        scores[gaps_m > config.query.max_pair_m] = np.nan
        pairs = np.column_stack([np.arange(len(scores)), partners])
        return rank_regions(maps.path["before"], scores, pairs, scores, config.query)
