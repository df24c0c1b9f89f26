"""Regions drawn at random: the control of every table."""

from __future__ import annotations

import numpy as np

from cdpipe.core.geometry import stream
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, MergedMaps
from cdpipe.query.drift_width import keyframe_radii
from cdpipe.query.query import query_nearest, rank_regions


class RandomRegions:
    """A registered source that draws regions at random."""

    def propose(
        self, merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
    ) -> ChangeRegions:
        """Give a random score to every before keyframe that the after session passed.

        The draw depends on `config.seed` and on the sizes of the maps, so that different pairs get independent draws.
        """
        before_path, after_path = merged.keyframe_positions(before, after)
        sizes = f"{len(merged.before.points)} {len(merged.after.points)}"
        gaps_m, partners = query_nearest(before_path, after_path)
        scores = stream(config.seed, "random-regions", sizes).random(len(gaps_m))
        scores[gaps_m > config.query.max_pair_m] = np.nan
        pairs = np.column_stack([np.arange(len(scores)), partners])
        radii_m = keyframe_radii(merged.before, before.keyframe_scans, config.query)
        return rank_regions(before_path, scores, pairs, scores, config.query, radii_m=radii_m)
