"""What the pipeline is measured against: comparisons of whole maps without regions, and regions drawn at random.

Every method takes two merged maps and gives the same report, so that `METHODS` can be run side by side. Their clocks
favour the rivals: what is computed for the tables only (figures, keyframe scores) is not counted.
"""

from __future__ import annotations

import importlib.util
from time import perf_counter

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, stream
from cdpipe.extract.point_comparison import far_points_mask, new_points_mask
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import ChangeReport, DescriptorSet, MergedMaps, SessionName
from cdpipe.pipeline import Comparison, compare, extracted
from cdpipe.query.query import rank_regions
from eval.rival_dufomap import void_mask
from eval.rival_m3c2 import m3c2_mask
from eval.whole_map import PlacedMaps, nearest_of, placed_maps, whole_map


def voxel_diff(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what lies in a voxel that is empty in the other (`extract.voxel_m`)."""

    def new_mask(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
        return new_points_mask(maps.points[session], maps.points[other], config.extract)

    return whole_map(merged, before, after, config, new_mask)


def c2c(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what is farther than `extract.distance_m` from the other map.

    The distance to the nearest point, cloud to cloud (C2C), as CloudCompare and others measure it.
    """

    def new_mask(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
        return far_points_mask(maps.points[session], maps.points[other], config.extract)

    return whole_map(merged, before, after, config, new_mask)


def m3c2(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what moved along its normal (`eval.rival_m3c2`).

    Raises:
        InputError: The extra `m3c2` is not installed.
    """
    require_method("m3c2")
    return whole_map(merged, before, after, config, m3c2_mask)


def dufomap(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Compare the maps by `whole_map`: new is what stands where the other session saw a void (`eval.rival_dufomap`).

    Raises:
        InputError: The extra `dufomap` is not installed.
    """
    require_method("dufomap")
    return whole_map(merged, before, after, config, void_mask)


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
    return extracted(merged, regions, (before, after), perf_counter() - start, config)


def require_method(method: str) -> None:
    """Raise `InputError` with the way out where the extra of a method is not installed."""
    package = _PACKAGES.get(method)
    if package is not None and importlib.util.find_spec(package) is None:
        raise InputError(f"method {method} needs a package more: pip install 'tunnelcd[{method}]'")


METHODS: dict[str, Comparison] = {
    "descriptor": compare,
    "voxel-diff": voxel_diff,
    "c2c": c2c,
    "m3c2": m3c2,
    "dufomap": dufomap,
    "random-regions": random_regions,
}
USES_DESCRIPTORS = frozenset({"descriptor"})
_PACKAGES = {"m3c2": "py4dgeo", "dufomap": "dufomap"}  # the extra is called as the method
