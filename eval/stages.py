"""The stages of one pair, each run once for all variants that share the settings it depends on, and timed.

Times are wall clock of one process on fixed threads, one stage after the other: the first call warms up; where it took
less than a second, the median of three further calls is the time, otherwise the first call is. Of a stage with parts
each part is timed so, and the parts by themselves.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np

from cdpipe.config import MapConfig, PipelineConfig
from cdpipe.descriptor import describe_map, describe_scans
from cdpipe.detect import local_alignment, refusal
from cdpipe.mapping import build_map
from cdpipe.merge import merge_maps
from cdpipe.session_check import check_session
from cdpipe.types import (
    ChangeRegions,
    ChangeReport,
    DescriptorSet,
    MappedSession,
    MergedMaps,
    PointMap,
    ScanSource,
    Spheres,
)
from eval.oracle_regions import Regions, with_regions
from eval.rivals import METHODS, USES_DESCRIPTORS

REPEAT_BELOW_S = 1.0
REPEATS = 3
_POSE_BYTES = 28.0
OnStage = Callable[[str, int, int], None]
Merge = Callable[[MappedSession, MappedSession], MergedMaps]


class HasSeconds(Protocol):
    """What says itself how long each of its parts took."""

    @property
    def seconds(self) -> Mapping[str, float]:
        """Wall-clock seconds by name."""


TimedT = TypeVar("TimedT", bound=HasSeconds)


class PairStages:
    """Both sessions of a pair and what has been computed from them so far.

    Only the maps of one map setting are held at a time, and what was computed from them; cells that share it should
    therefore come one after the other.
    """

    def __init__(
        self, before: ScanSource, after: ScanSource, on_stage: OnStage = lambda name, done, total: None
    ) -> None:
        self._sources = (before, after)
        self._on_stage = on_stage
        self._map_key = ""
        self._maps: tuple[PointMap, PointMap] | None = None
        self._described: dict[str, tuple[tuple[DescriptorSet, DescriptorSet], float]] = {}
        self._spheres: dict[str, tuple[tuple[Spheres, Spheres], float]] = {}
        self._merged: dict[str, tuple[MergedMaps, Mapping[str, float]]] = {}

    def maps(self, config: MapConfig) -> tuple[PointMap, PointMap]:
        """Return both maps, each in its session's own odom frame."""
        key = config.model_dump_json()
        if self._maps is None or key != self._map_key:
            # the old maps must be gone before the new ones are built: the large site fills gigabytes
            self._maps = None
            self._described.clear()
            self._spheres.clear()
            self._merged.clear()
            self._maps = (self._map(0, config), self._map(1, config))
            self._map_key = key
        return self._maps

    def mapped(self, config: PipelineConfig) -> tuple[MappedSession, MappedSession, float]:
        """Return both sessions with their descriptors, and the seconds that all descriptors took."""
        maps = self.maps(config.map)
        key = config.descriptor.method
        if key not in self._described:
            self._described[key] = self._describe(maps, config)
        (before, after), seconds = self._described[key]
        if config.query.compare == "sphere":
            if config.descriptor.precision not in self._spheres:
                self._spheres[config.descriptor.precision] = self._describe_spheres(maps, config)
            (of_before, of_after), more_seconds = self._spheres[config.descriptor.precision]
            before, after = replace(before, spheres=of_before), replace(after, spheres=of_after)
            seconds += more_seconds
        return MappedSession(maps[0], before), MappedSession(maps[1], after), seconds

    def merged(self, config: PipelineConfig, merge: Merge | None = None) -> tuple[MergedMaps, Mapping[str, float]]:
        """Return the merged maps and the seconds of the merge's parts.

        Args:
            config: All settings.
            merge: What merges instead of the method; called once, and its result is not kept.

        Raises:
            MergeFailedError: The evidence does not suffice.
        """
        before, after, _ = self.mapped(config)
        self._on_stage("merge", 0, 1)
        if merge is None:
            key = config.descriptor.method + config.merge.model_dump_json()
            if key not in self._merged:
                self._merged[key] = timed_parts(lambda: merge_maps(before, after, config.merge))
            merged, seconds = self._merged[key]
        else:
            merged = merge(before, after)
            seconds = merged.seconds
        if not merged.is_accepted:
            raise refusal(replace(merged, seconds=seconds))
        return merged, seconds

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
        before, after, t_descriptor_s = self.mapped(config)
        merged, of_merge = self.merged(config, merge)
        method = METHODS[config.method] if regions is None else with_regions(regions)
        report, medians = timed_parts(lambda: method(merged, before.descriptors, after.descriptors, config))
        is_described = regions is None and config.method in USES_DESCRIPTORS
        of_descriptors = {"t_descriptor_s": t_descriptor_s if is_described else 0.0}
        return replace(
            report,
            seconds={**medians, **of_merge, **of_descriptors},
            evidence={**report.evidence, **_sizes(before, after), **kept_bytes(before, config)},
        )

    def merge_answer(self, config: PipelineConfig, merge: Merge | None = None) -> ChangeReport:
        """Run one method up to its merge: an answer without regions and objects, and descriptors timed if it used them.

        Raises:
            MergeFailedError: The maps could not be merged.
            TunnelcdError: The input does not allow an answer.
        """
        before, after, t_descriptor_s = self.mapped(config)
        merged, of_merge = self.merged(config, merge)
        uses_descriptors = merge is None and config.merge.method != "kiss-matcher"
        return ChangeReport(
            before_T_after=merged.before_T_after,
            evidence={**merged.evidence, **_sizes(before, after)},
            regions=_no_regions(config.query.radius_m),
            objects=(),
            seconds={**of_merge, "t_descriptor_s": t_descriptor_s if uses_descriptors else 0.0},
            figures={},
            keyframe_scans=(before.descriptors.keyframe_scans, after.descriptors.keyframe_scans),
            config=config.model_dump(),
            local_before_T_after=local_alignment(merged, after.descriptors),
        )

    def _map(self, which: int, config: MapConfig) -> PointMap:
        self._on_stage(f"map {('before', 'after')[which]}", 0, 1)
        check_session(self._sources[which], config)
        return build_map(self._sources[which], config)

    def _describe(
        self, maps: tuple[PointMap, PointMap], config: PipelineConfig
    ) -> tuple[tuple[DescriptorSet, DescriptorSet], float]:
        self._on_stage("describe keyframes", 0, 1)
        describe_scans(self._sources[0], maps[0].keyframe_scans[:1], config.descriptor)  # loads the network
        start = time.perf_counter()
        before, after = (
            describe_scans(source, pointmap.keyframe_scans, config.descriptor)
            for source, pointmap in zip(self._sources, maps, strict=True)
        )
        return (before, after), time.perf_counter() - start

    def _describe_spheres(
        self, maps: tuple[PointMap, PointMap], config: PipelineConfig
    ) -> tuple[tuple[Spheres, Spheres], float]:
        self._on_stage("describe spheres", 0, 1)
        describe_map(maps[0], maps[0].odom_T_keyframe[:1], config.descriptor)  # loads the network
        start = time.perf_counter()
        before, after = (describe_map(pointmap, pointmap.odom_T_keyframe, config.descriptor) for pointmap in maps)
        return (before, after), time.perf_counter() - start


def timed_parts(call: Callable[[], TimedT]) -> tuple[TimedT, Mapping[str, float]]:
    """Return a call's result and the seconds of its parts by the rule of this module."""
    start = time.perf_counter()
    result = call()
    if time.perf_counter() - start >= REPEAT_BELOW_S:
        return result, result.seconds
    repeats = [call().seconds for _ in range(REPEATS)]
    return result, {name: statistics.median(run[name] for run in repeats) for name in result.seconds}


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
        kept = _POSE_BYTES * n_keyframes + 4.0 * vectors.size
    elif config.method == "dufomap":
        kept = map_bytes + 12.0 * float(np.diff(before.map.scan_offsets)[:: config.dufomap.every_scan].sum())
    else:
        kept = map_bytes
    return {"bytes_map_before": map_bytes, "bytes_regions_before": kept}


def _no_regions(radius_m: float) -> ChangeRegions:
    none = np.zeros(0)
    pairs, is_reported = np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.bool_)
    return ChangeRegions(np.zeros((0, 3)), radius_m, none, pairs, is_reported, none)
