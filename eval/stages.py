"""The stages of one pair, each run once for all variants that share the settings it depends on, and timed.

Times are wall clock of one process on fixed threads, one stage after the other: the first call warms up; where it took
less than a second, the median of three further calls is the time, otherwise the first call is.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar

from cdpipe.config import MapConfig, PipelineConfig
from cdpipe.descriptor import describe_scans
from cdpipe.errors import MergeFailedError
from cdpipe.mapping import build_map
from cdpipe.merge import merge_maps
from cdpipe.types import ChangeReport, DescriptorSet, MappedSession, MergedMaps, PointMap, ScanSource
from eval.rivals import METHODS, USES_DESCRIPTORS

REPEAT_BELOW_S = 1.0
REPEATS = 3
OnStage = Callable[[str, int, int], None]
T = TypeVar("T")


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
        self._merged: dict[str, tuple[MergedMaps, float]] = {}

    def maps(self, config: MapConfig) -> tuple[PointMap, PointMap]:
        """Return both maps, each in its session's own odom frame."""
        key = config.model_dump_json()
        if self._maps is None or key != self._map_key:
            # the old maps must be gone before the new ones are built: the large site fills gigabytes
            self._maps = None
            self._described.clear()
            self._merged.clear()
            self._maps = (self._map(0, config), self._map(1, config))
            self._map_key = key
        return self._maps

    def mapped(self, config: PipelineConfig) -> tuple[MappedSession, MappedSession, float]:
        """Return both sessions with their descriptors, and the seconds that all descriptors took."""
        maps = self.maps(config.map)
        key = config.descriptor.model_dump_json()
        if key not in self._described:
            self._described[key] = self._describe(maps, config)
        (before, after), seconds = self._described[key]
        return MappedSession(maps[0], before), MappedSession(maps[1], after), seconds

    def merged(self, config: PipelineConfig) -> tuple[MergedMaps, float]:
        """Return the merged maps and the seconds that merging took.

        Raises:
            MergeFailedError: The evidence does not suffice.
        """
        before, after, _ = self.mapped(config)
        key = config.descriptor.model_dump_json() + config.merge.model_dump_json()
        if key not in self._merged:
            self._on_stage("merge", 0, 1)
            self._merged[key] = timed(lambda: merge_maps(before, after, config.merge))
        merged, seconds = self._merged[key]
        if not merged.is_accepted:
            raise MergeFailedError(f"the sessions cannot be merged: {merged.reason}", merged.evidence)
        return merged, seconds

    def answer(self, config: PipelineConfig) -> ChangeReport:
        """Run one method to its end.

        Raises:
            MergeFailedError: The maps could not be merged.
            TunnelcdError: The input does not allow an answer.
        """
        before, after, t_descriptor_s = self.mapped(config)
        merged, t_merge_s = self.merged(config)
        method = METHODS[config.method]
        report, medians = timed_report(lambda: method(merged, before.descriptors, after.descriptors, config))
        seconds = {
            **medians,
            "t_merge_s": t_merge_s,
            "t_descriptor_s": t_descriptor_s if config.method in USES_DESCRIPTORS else 0.0,
        }
        sizes = {"map_points_before": len(before.map.points), "map_points_after": len(after.map.points)}
        return replace(report, seconds=seconds, evidence={**report.evidence, **sizes})

    def _map(self, which: int, config: MapConfig) -> PointMap:
        self._on_stage(f"map {('before', 'after')[which]}", 0, 1)
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


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """Return a call's result and its time by the rule of this module."""
    result, first_s = _stopwatch(call)
    if first_s >= REPEAT_BELOW_S:
        return result, first_s
    return result, statistics.median(_stopwatch(call)[1] for _ in range(REPEATS))


def timed_report(call: Callable[[], ChangeReport]) -> tuple[ChangeReport, Mapping[str, float]]:
    """Return a report and the seconds of its stages by the rule of this module."""
    report, first_s = _stopwatch(call)
    if first_s >= REPEAT_BELOW_S:
        return report, report.seconds
    repeats = [call().seconds for _ in range(REPEATS)]
    return report, {name: statistics.median(run[name] for run in repeats) for name in report.seconds}


def _stopwatch(call: Callable[[], T]) -> tuple[T, float]:
    start = time.perf_counter()
    result = call()
    return result, time.perf_counter() - start
