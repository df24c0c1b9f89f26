"""Regions drawn at random: the control of every table."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from cdpipe.core.geometry import stream
from cdpipe.extract.extract import extract_changes
from cdpipe.methods.whole_map import nearest_of, placed_maps
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps
from cdpipe.query.query import rank_regions


def random_regions(
    merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig
) -> ChangeReport:
    """Give every before keyframe that the after session came near to a random score; extract as the pipeline does.

    The draw depends on `config.seed` and on the sizes of the maps, so that different pairs get independent draws.
    """
    start = perf_counter()
    maps = placed_maps(merged, before, after)
    sizes = f"{len(merged.before.points)} {len(merged.after.points)}"
    gaps_m, partners = nearest_of(maps.path["before"], maps.path["after"])
    scores = stream(config.seed, "random-regions", sizes).random(len(gaps_m))
    scores[gaps_m > config.query.max_pair_m] = np.nan
    pairs = np.column_stack([np.arange(len(scores)), partners])
    regions = rank_regions(maps.path["before"], scores, pairs, scores, config.query)
    return extract_changes(merged, regions, (before, after), perf_counter() - start, config)
