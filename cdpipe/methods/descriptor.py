"""Regions by descriptors, as in the paper and as `tunnelcd` does it; `query.compare` says which descriptors."""

from __future__ import annotations

from time import perf_counter

from cdpipe.extract.extract import extract_changes
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MergedMaps
from cdpipe.query.query import find_regions


def compare(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Find the changed regions of two merged maps and cut the objects out of them.

    `t_returns_s` is the part of `t_oe_s` that lists the objects' returns and tells their kind and shape, which the
    paper's extraction does not have.
    """
    start = perf_counter()
    regions = find_regions(merged, before, after, config.query)
    return extract_changes(merged, regions, (before, after), perf_counter() - start, config)
