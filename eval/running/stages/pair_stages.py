"""The pipeline on one pair: each stage runs once for all variants that share its inputs, and is timed.

A result is found again by its inputs (stage_cache.py), also by a later process: another voxel of the
extraction runs the extraction alone, another radius the query and the extraction. A result that is found again keeps
the seconds that it took when it ran.

Times are wall clock of one process on fixed threads, one stage after the other. The first call warms up; where it takes
less than a second, the median of three further calls is the time, otherwise the first call is. Each part of a stage is
timed so by itself. Where workers share the machine times say little, and one call is enough.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cdpipe.core.progress import Progress, report_nothing
from cdpipe.methods.registry import load_source
from cdpipe.methods.whole_map import choose_scans
from cdpipe.model.config import MapConfig, PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import MappedSession, PointMap, ScanSource
from cdpipe.pipeline import Done, Hooks, Merge, Propose, Stage, T, detect_changes, detect_merge, map_pair, map_sources
from cdpipe.query.query import AFTER
from eval.plans.variants import Until
from eval.running.stages.stage_cache import Kept, StageCache
from eval.running.stages.stage_results import is_kept, name_result, pack, unpack

REPEAT_BELOW_S = 1.0
REPEATS = 3
_POSE_BYTES = 28.0
# Sources that compare the other map to single scans; their section of the settings says to which.
_SCAN_READERS = ("dufomap", "octomap", "removert", "erasor")
# These stages warm up by themselves and run once; they do not count for a method that uses no descriptors.
_OF_DESCRIPTORS = ("descriptors", "spheres")


class PairStages(Hooks):
    """Both sessions of a pair and the results of the stages so far.

    Only the maps of one map setting are held at a time, so cells that share it should run one after the other.

    Args:
        before: The before session.
        after: The after session.
        on_stage: Told the name of each stage.
        cache: Results of the pair, perhaps of an earlier process.
        is_shared: Whether workers share the machine.

    Attributes:
        is_contended: Whether workers shared the machine while any time of the last answer was measured.
    """

    def __init__(
        self,
        before: ScanSource,
        after: ScanSource,
        on_stage: Progress = report_nothing,
        cache: StageCache | None = None,
        *,
        is_shared: bool = False,
    ) -> None:
        super().__init__(on_stage)
        self._sources = (before, after)
        self._cache = cache or StageCache()
        self._is_shared = is_shared
        self._maps_name = ""
        self._maps: tuple[PointMap, PointMap] | None = None
        self.is_contended = is_shared
        self._are_descriptors_contended = False

    def run(self, stage: Stage, config: PipelineConfig, compute: Callable[[], Done[T]]) -> Done[T]:
        """Return the kept result of a stage, or run the stage and keep its result."""
        name = name_result(stage, config)
        if stage == "maps":
            maps: Any = self._find_maps(name, compute)
            return Done(maps)
        if not is_kept(stage, config):
            return self.time(compute)
        kept = self._cache.find(name)
        if kept is None:
            done = compute() if stage in _OF_DESCRIPTORS else self.time(compute)
            kept = Kept(pack(stage, done.value), done.seconds, self._is_shared)
            self._cache.keep(name, kept)
        if stage in _OF_DESCRIPTORS:
            self._are_descriptors_contended |= kept.is_contended
        else:
            self.is_contended |= kept.is_contended
        return Done(unpack(stage, kept.arrays, self._maps or ()), kept.seconds)

    def time(self, compute: Callable[[], Done[T]]) -> Done[T]:
        """Run a step, repeatedly where it is timed."""
        return compute() if self._is_shared else time_parts(compute)

    def maps(self, config: MapConfig) -> tuple[PointMap, PointMap]:
        """Return both maps, each in its session's own odom frame."""
        return map_sources(self._sources, PipelineConfig(map=config), self)

    def answer(
        self,
        config: PipelineConfig,
        merge: Merge | None = None,
        propose: Propose | None = None,
        until: Until | None = None,
    ) -> ChangeReport:
        """Run one method; until the merge gives an answer without regions and objects.

        Args:
            config: All settings.
            merge: What merges instead of the method.
            propose: What proposes regions instead of the method, as in `detect_changes`.
            until: Last stage, None for the whole method.

        Raises:
            MergeFailedError: The maps could not be merged.
            TunnelcdError: The input does not allow an answer.
        """
        self.is_contended, self._are_descriptors_contended = self._is_shared, False
        mapped = map_pair(self._sources, config, self)
        if until == "merge":
            report = detect_merge(*mapped.value, config, self, merge=merge)
            is_described = merge is None and config.merge.method != "kiss-matcher"
        else:
            report = detect_changes(*mapped.value, config, self, merge=merge, propose=propose)
            asked = report.regions.direction
            is_asked_after = asked is not None and len(asked) > 0 and bool(np.all(asked == AFTER))
            kept = kept_bytes(mapped.value[0], config, is_asked_after=is_asked_after)
            report = replace(report, evidence={**report.evidence, **kept})
            is_described = propose is None and load_source(config).uses_descriptors
        return replace(report, seconds={**report.seconds, **self._of_descriptors(mapped.seconds, is_described)})

    def _of_descriptors(self, seconds: Mapping[str, float], is_described: bool) -> Mapping[str, float]:
        self.is_contended |= is_described and self._are_descriptors_contended
        return seconds if is_described else {"t_descriptor_s": 0.0}

    def _find_maps(self, name: str, compute: Callable[[], Done[Any]]) -> tuple[PointMap, PointMap]:
        if self._maps is None or name != self._maps_name:
            # the old maps must be gone before the new ones are built: the large site fills gigabytes
            self._maps = None
            kept = self._cache.find(name)
            if kept is None:
                self._maps = compute().value
                self._cache.keep(name, Kept(pack("maps", self._maps)))
            else:
                self._maps = unpack("maps", kept.arrays)
            self._maps_name = name
        return self._maps


def time_parts(compute: Callable[[], Done[T]], clock: Callable[[], float] = time.perf_counter) -> Done[T]:
    """Return what the first call gives, with the seconds of its parts by the rule of this module.

    Args:
        compute: The step.
        clock: The time in seconds, by which a step is short enough to be repeated.
    """
    start = clock()
    done = compute()
    if clock() - start >= REPEAT_BELOW_S:
        return done
    runs = [compute().seconds for _ in range(REPEATS)]
    return Done(done.value, {name: statistics.median(run[name] for run in runs) for name in done.seconds})


def kept_bytes(before: MappedSession, config: PipelineConfig, *, is_asked_after: bool = False) -> dict[str, float]:
    """Return the bytes of the thinned before map, and of what a method keeps of that session to find regions.

    All as float32: x, y, z of every map point; for a descriptor one vector and one pose (7 numbers) per keyframe, and
    the width of the drift where the radius follows it. Random regions and every keyframe need no vector. Any other
    source keeps the map; those that read single scans also keep the returns of these. Spheres keep it where the
    keyframes of the after session are asked, as between the stations of a survey: the before map is rendered there.
    """
    map_bytes = 12.0 * len(before.map.points)
    source = config.regions.source
    spheres = None if is_asked_after else before.descriptors.spheres
    vectors = {"scan": before.descriptors.q, "sphere": spheres}.get(source)
    n_keyframes = len(before.map.keyframe_scans)
    pose_bytes = _POSE_BYTES + (4.0 if config.query.radius_m == "width" else 0.0)
    if source in ("random-regions", "every-keyframe"):
        kept = pose_bytes * n_keyframes
    elif vectors is not None:
        kept = pose_bytes * n_keyframes + float(vectors.nbytes)
    elif source in _SCAN_READERS:
        every_scan = getattr(config, source).every_scan
        read = choose_scans(before.map.odom_T_sensor, every_scan)
        kept = map_bytes + 12.0 * float(np.diff(before.map.scan_offsets)[read].sum())
    else:
        kept = map_bytes
    return {"bytes_map_before": map_bytes, "bytes_regions_before": kept}
