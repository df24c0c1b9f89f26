"""The stages of one pair, each run once for all variants that share what it reads, and timed.

What a stage gave is found again by all that it read (eval/running/stage_cache.py), also by a later process: another
voxel of the extraction runs the extraction alone, another radius the query and the extraction. What is found again has
the seconds that it took when it ran (eval/running/stage_times.py).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cdpipe.descriptors import describe_map, describe_scans
from cdpipe.extract.extract import local_alignment
from cdpipe.mapping.mapping import build_map
from cdpipe.mapping.session_check import check_session
from cdpipe.merge.merge import merge_maps
from cdpipe.methods.registry import load_method
from cdpipe.model.config import MapConfig, PipelineConfig
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import MappedSession, MergedMaps, PointMap, ScanSource
from cdpipe.pipeline import refusal
from cdpipe.query.query import find_regions
from eval.oracles.regions import Regions, with_regions
from eval.running.stage_cache import Kept, StageCache
from eval.running.stage_results import (
    descriptors_arrays,
    descriptors_from,
    descriptors_name,
    maps_arrays,
    maps_from,
    maps_name,
    merge_name,
    merged_arrays,
    merged_from,
    regions_arrays,
    regions_from,
    regions_name,
    spheres_arrays,
    spheres_from,
    spheres_name,
)
from eval.running.stage_times import REPEATS, TimedT, timed_parts

_POSE_BYTES = 28.0
OnStage = Callable[[str, int, int], None]
Merge = Callable[[MappedSession, MappedSession], MergedMaps]


class PairStages:
    """Both sessions of a pair and what has been computed from them so far.

    Only the maps of one map setting are held at a time; cells that share it should therefore come one after the other.

    Args:
        before: The before session.
        after: The after session.
        on_stage: Told what is computed.
        cache: What is kept of the pair, perhaps of an earlier process.
        is_shared: Whether workers share the machine, and so the times.

    Attributes:
        is_contended: Whether workers shared the machine while any of the times of the last answer was taken.
    """

    def __init__(
        self,
        before: ScanSource,
        after: ScanSource,
        on_stage: OnStage = lambda name, done, total: None,
        cache: StageCache | None = None,
        *,
        is_shared: bool = False,
    ) -> None:
        self._sources = (before, after)
        self._on_stage = on_stage
        self._cache = cache or StageCache()
        self._is_shared = is_shared
        self._maps_name = ""
        self._maps: tuple[PointMap, PointMap] | None = None
        self.is_contended = is_shared

    def maps(self, config: MapConfig) -> tuple[PointMap, PointMap]:
        """Return both maps, each in its session's own odom frame."""
        name = maps_name(config)
        if self._maps is None or name != self._maps_name:
            # the old maps must be gone before the new ones are built: the large site fills gigabytes
            self._maps = None
            kept = self._cache.find(name)
            if kept is None:
                self._maps = self._map(0, config), self._map(1, config)
                self._cache.keep(name, Kept(maps_arrays(self._maps)))
            else:
                self._maps = maps_from(kept.arrays)
            self._maps_name = name
        return self._maps

    def mapped(self, config: PipelineConfig) -> tuple[MappedSession, MappedSession, list[Kept]]:
        """Return both sessions with their descriptors, and what was kept of these, with their seconds."""
        maps = self.maps(config.map)
        kept = [self._kept(descriptors_name(config), lambda: self._describe(maps, config))]
        before, after = descriptors_from(kept[0].arrays)
        if config.query.compare == "sphere":
            kept.append(self._kept(spheres_name(config), lambda: self._describe_spheres(maps, config)))
            of_before, of_after = spheres_from(kept[1].arrays)
            before, after = replace(before, spheres=of_before), replace(after, spheres=of_after)
        return MappedSession(maps[0], before), MappedSession(maps[1], after), kept

    def merged(self, config: PipelineConfig, merge: Merge | None = None) -> tuple[MergedMaps, Mapping[str, float]]:
        """Return the merged maps and the seconds of the merge's parts.

        Args:
            config: All settings.
            merge: What merges instead of the method; called once, and its result is not kept.

        Raises:
            MergeFailedError: The evidence does not suffice.
        """
        before, after, _ = self.mapped(config)
        if merge is None:
            kept = self._kept(merge_name(config), lambda: self._merge(before, after, config))
            merged = merged_from(kept.arrays, (before.map, after.map), self._spent(kept))
        else:
            self._on_stage("merge", 0, 1)
            merged = merge(before, after)
        if not merged.is_accepted:
            raise refusal(merged)
        return merged, merged.seconds

    def answer(
        self, config: PipelineConfig, merge: Merge | None = None, regions: Regions | None = None
    ) -> ChangeReport:
        """Run one method to its end.

        Args:
            config: All settings.
            merge: What merges instead of the method (`merged`).
            regions: What proposes regions instead of the method, from the scans of the keyframes of both sessions.

        Raises:
            MergeFailedError: The maps could not be merged.
            TunnelcdError: The input does not allow an answer.
        """
        self.is_contended = self._is_shared
        before, after, described = self.mapped(config)
        merged, of_merge = self.merged(config, merge)
        is_described = regions is None and config.method == "descriptor"
        of_query: Mapping[str, float] = {}
        if regions is not None:
            method = with_regions(regions)
        elif config.method == "descriptor" and merge is None:
            query = self._kept(regions_name(config), lambda: self._query(merged, before, after, config))
            method, of_query = with_regions(lambda _: regions_from(query.arrays)), self._spent(query)
        else:
            method = load_method(config.method)
        report, medians = self._timed(lambda: method(merged, before.descriptors, after.descriptors, config))
        return replace(
            report,
            seconds={**medians, **of_query, **of_merge, **self._of_descriptors(described if is_described else ())},
            evidence={**report.evidence, **_sizes(before, after), **kept_bytes(before, config)},
        )

    def merge_answer(self, config: PipelineConfig, merge: Merge | None = None) -> ChangeReport:
        """Run one method up to its merge: an answer without regions and objects, and descriptors timed if it used them.

        Raises:
            MergeFailedError: The maps could not be merged.
            TunnelcdError: The input does not allow an answer.
        """
        self.is_contended = self._is_shared
        before, after, described = self.mapped(config)
        merged, of_merge = self.merged(config, merge)
        uses_descriptors = merge is None and config.merge.method != "kiss-matcher"
        return ChangeReport(
            before_T_after=merged.before_T_after,
            evidence={**merged.evidence, **_sizes(before, after)},
            regions=_no_regions(config.query.radius_m),
            objects=(),
            seconds={**of_merge, **self._of_descriptors(described if uses_descriptors else ())},
            figures={},
            keyframe_scans=(before.descriptors.keyframe_scans, after.descriptors.keyframe_scans),
            config=config.model_dump(),
            local_before_T_after=local_alignment(merged, after.descriptors),
        )

    def _kept(self, name: str, compute: Callable[[], Kept]) -> Kept:
        kept = self._cache.find(name)
        if kept is None:
            kept = compute()
            self._cache.keep(name, kept)
        return kept

    def _spent(self, kept: Kept) -> Mapping[str, float]:
        """Return the seconds of a stage for the present answer."""
        self.is_contended |= kept.is_contended
        return kept.seconds

    def _of_descriptors(self, kept: Sequence[Kept]) -> Mapping[str, float]:
        return {"t_descriptor_s": sum((self._spent(each)["t_descriptor_s"] for each in kept), 0.0)}

    def _timed(self, call: Callable[[], TimedT]) -> tuple[TimedT, Mapping[str, float]]:
        return timed_parts(call, 0 if self._is_shared else REPEATS)

    def _map(self, which: int, config: MapConfig) -> PointMap:
        self._on_stage(f"map {('before', 'after')[which]}", 0, 1)
        check_session(self._sources[which], config)
        return build_map(self._sources[which], config)

    def _describe(self, maps: tuple[PointMap, PointMap], config: PipelineConfig) -> Kept:
        self._on_stage("describe keyframes", 0, 1)
        describe_scans(self._sources[0], maps[0].keyframe_scans[:1], config.descriptor)  # loads the network
        start = time.perf_counter()
        descriptors = [
            describe_scans(source, pointmap.keyframe_scans, config.descriptor)
            for source, pointmap in zip(self._sources, maps, strict=True)
        ]
        seconds = {"t_descriptor_s": time.perf_counter() - start}
        return Kept(descriptors_arrays(descriptors), seconds, self._is_shared)

    def _describe_spheres(self, maps: tuple[PointMap, PointMap], config: PipelineConfig) -> Kept:
        self._on_stage("describe spheres", 0, 1)
        describe_map(maps[0], maps[0].odom_T_keyframe[:1], config.descriptor)  # loads the network
        start = time.perf_counter()
        spheres = [describe_map(pointmap, pointmap.odom_T_keyframe, config.descriptor) for pointmap in maps]
        return Kept(spheres_arrays(spheres), {"t_descriptor_s": time.perf_counter() - start}, self._is_shared)

    def _merge(self, before: MappedSession, after: MappedSession, config: PipelineConfig) -> Kept:
        self._on_stage("merge", 0, 1)
        merged, seconds = self._timed(lambda: merge_maps(before, after, config.merge))
        return Kept(merged_arrays(merged), seconds, self._is_shared)

    def _query(self, merged: MergedMaps, before: MappedSession, after: MappedSession, config: PipelineConfig) -> Kept:
        def query() -> _Query:
            start = time.perf_counter()
            regions = find_regions(merged, before.descriptors, after.descriptors, config.query)
            return _Query(regions, {"t_cd_s": time.perf_counter() - start})

        self._on_stage("query", 0, 1)
        found, seconds = self._timed(query)
        return Kept(regions_arrays(found.regions), seconds, self._is_shared)


@dataclass(frozen=True, slots=True, eq=False)
class _Query:
    """Regions, and how long it took to find them."""

    regions: ChangeRegions
    seconds: Mapping[str, float]


def _sizes(before: MappedSession, after: MappedSession) -> dict[str, float]:
    return {"map_points_before": len(before.map.points), "map_points_after": len(after.map.points)}


def kept_bytes(before: MappedSession, config: PipelineConfig) -> dict[str, float]:
    """Return the bytes of the thinned before map, and of what a method keeps of that session to find regions.

    Both as float32: x, y, z of every map point; for a descriptor one vector and one pose (7 numbers) per keyframe. What
    compares points, or sees the before map anew from other places, keeps the map; `dufomap` also the returns of the
    scans whose rays are cast. Random regions keep poses alone.
    """
    map_bytes = 12.0 * len(before.map.points)
    vectors = {"scan": before.descriptors.q, "sphere": before.descriptors.spheres}.get(config.query.compare)
    n_keyframes = len(before.map.keyframe_scans)
    if config.method == "random-regions":
        kept = _POSE_BYTES * n_keyframes
    elif config.method == "descriptor" and vectors is not None:
        kept = _POSE_BYTES * n_keyframes + float(vectors.nbytes)
    elif config.method == "dufomap":
        kept = map_bytes + 12.0 * float(np.diff(before.map.scan_offsets)[:: config.dufomap.every_scan].sum())
    else:
        kept = map_bytes
    return {"bytes_map_before": map_bytes, "bytes_regions_before": kept}


def _no_regions(radius_m: float) -> ChangeRegions:
    none = np.zeros(0)
    pairs, is_reported = np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.bool_)
    return ChangeRegions(np.zeros((0, 3)), radius_m, none, pairs, is_reported, none)
