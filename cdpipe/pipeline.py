"""The pipeline: map, describe, merge, query, extract. The one place that puts the stages in order.

`detect` takes two sessions, `detect_changes` two mapped ones. `Hooks` stand around every stage: the command line tells
progress with them, a benchmark keeps and times what the stages give. `PipelineConfig.method` names what compares the
merged maps, whoever calls.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from cdpipe.core.errors import MergeFailedError
from cdpipe.core.geometry import Int64Array
from cdpipe.core.threads import THREADS
from cdpipe.descriptors.describe import describe_scans, load_descriptors, save_descriptors, use_threads
from cdpipe.descriptors.sphere import describe_map
from cdpipe.extract.extract import extract_changes, make_report
from cdpipe.io.readers import open_session
from cdpipe.mapping.mapping import build_map, choose_keyframes
from cdpipe.mapping.session_check import check_session, unit_hint
from cdpipe.merge.merge import merge_maps
from cdpipe.methods import registry
from cdpipe.methods.registry import load_method
from cdpipe.model.config import PipelineConfig, Site, load_config
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, PointMap, ScanSource, Spheres

T = TypeVar("T")
Stage = Literal["maps", "descriptors", "spheres", "merge", "regions"]
OnStage = Callable[[str, int, int], None]
Merge = Callable[[MappedSession, MappedSession], MergedMaps]
Propose = Callable[[tuple[Int64Array, Int64Array]], ChangeRegions]


@dataclass(frozen=True, slots=True, eq=False)
class Done(Generic[T]):
    """What a stage gave, and the wall-clock seconds of its parts by name."""

    value: T
    seconds: Mapping[str, float] = field(default_factory=dict)


class Hooks:
    """What stands around the stages. As it is, each stage runs once; override `run` to keep results, `time` to repeat.

    Args:
        on_stage: Told the name of a stage before it runs, what of it is done, and how much there is.
    """

    def __init__(self, on_stage: OnStage = lambda name, done, total: None) -> None:
        self.on_stage = on_stage

    def run(self, stage: Stage, config: PipelineConfig, compute: Callable[[], Done[T]]) -> Done[T]:
        """Return what a stage gives; it depends on the sessions and on the settings alone."""
        return compute()

    def time(self, compute: Callable[[], Done[T]]) -> Done[T]:
        """Return what a step gives that depends on more than that, or is not worth keeping."""
        return compute()


def detect(
    before: Path | str | ScanSource,
    after: Path | str | ScanSource,
    preset: str = "tunnelcd",
    settings: Iterable[str] | Mapping[str, Any] = (),
    site: Site = "narrow",
    hooks: Hooks | None = None,
) -> ChangeReport:
    """Find what changed between two recorded sessions.

    Descriptors that are stored beside a session (`tunnelcd describe`) are used where they are of the same weights and
    keyframes; `t_descriptor_s` then does not contain them.

    Args:
        before: The earlier session: its folder, or opened by `open_session`.
        after: The later one.
        preset: Name of a preset, or the path of a .yaml file.
        settings: Written over the preset, e.g. `{"query.radius_m": 6}`.
        site: Which section of the preset holds: that for narrow or that for wide drifts.
        hooks: What stands around the stages.

    Raises:
        MergeFailedError: The sessions could not be put into one frame; it carries what was measured.
        InputError: A session or a setting cannot be used, or the method's extra is not installed.
    """
    config = load_config(preset, settings, site)
    load_method(config.method)  # a missing extra is told before anything is mapped
    use_threads(THREADS)
    sources = [open_session(Path(each)) if isinstance(each, Path | str) else each for each in (before, after)]
    stored = [
        load_descriptors(Path(each), config.descriptor, source.odom_T_sensor, config.map)
        if isinstance(each, Path | str)
        else None
        for each, source in zip((before, after), sources, strict=True)
    ]
    hooks = hooks or Hooks()
    mapped = map_pair(sources, config, hooks, stored)
    try:
        report = detect_changes(*mapped.value, config, hooks)
    except MergeFailedError as error:
        names = f"{sources[0].name} and {sources[1].name}"
        raise MergeFailedError(f"{names}: {error}", error.evidence, error.seconds) from error
    return replace(report, seconds={**report.seconds, **mapped.seconds})


def describe(
    session: Path | str, preset: str = "tunnelcd", settings: Iterable[str] | Mapping[str, Any] = ()
) -> tuple[DescriptorSet, Path]:
    """Describe the keyframes of a session and store the vectors beside it, as a robot would while mapping.

    Returns:
        The descriptors, and the file that holds them.

    Raises:
        InputError: The session or a setting cannot be used, or the session's folder cannot be written.
    """
    config = load_config(preset, settings)
    use_threads(THREADS)
    source = open_session(Path(session))
    if config.query.compare == "sphere":
        descriptors = map_session(source, config).descriptors
    else:
        chosen = choose_keyframes(source.odom_T_sensor, config.map.keyframe_spacing_m)
        descriptors = describe_scans(source, chosen, config.descriptor)
    return descriptors, save_descriptors(Path(session), descriptors, source.odom_T_sensor, config.map)


def map_session(source: ScanSource, config: PipelineConfig) -> MappedSession:
    """Do what a robot does while it drives: thin its map and describe its keyframes.

    Raises:
        InputError: The session or one of its scans cannot be used; the text names it and says how to mend it.
    """
    check_session(source, config.map)
    thin_map = build_map(source, config.map)
    descriptors = describe_scans(source, thin_map.keyframe_scans, config.descriptor)
    if config.query.compare == "sphere":
        descriptors = replace(descriptors, spheres=describe_map(thin_map, thin_map.odom_T_keyframe, config.descriptor))
    return MappedSession(thin_map, descriptors)


def map_pair(
    sources: Sequence[ScanSource],
    config: PipelineConfig,
    hooks: Hooks,
    stored: Sequence[DescriptorSet | None] = (None, None),
) -> Done[tuple[MappedSession, MappedSession]]:
    """Map both sessions and describe their keyframes.

    Args:
        sources: The before and the after session.
        config: All settings.
        hooks: What stands around the stages.
        stored: Descriptors of each session, used where they are of the keyframes of its map.

    Returns:
        Both, and `t_descriptor_s` of all descriptors that were computed.

    Raises:
        InputError: A session or one of its scans cannot be used.
    """
    maps = map_sources(sources, config, hooks)
    kept = [
        each if each is not None and np.array_equal(each.keyframe_scans, thin_map.keyframe_scans) else None
        for each, thin_map in zip(stored, maps, strict=True)
    ]
    scans = hooks.run("descriptors", config, lambda: _describe_scans(sources, maps, kept, config, hooks))
    (before, after), seconds = scans.value, dict(scans.seconds)
    if config.query.compare == "sphere":
        spheres = hooks.run("spheres", config, lambda: _describe_spheres(maps, kept, config, hooks))
        before, after = (replace(a, spheres=b) for a, b in zip((before, after), spheres.value, strict=True))
        seconds["t_descriptor_s"] += spheres.seconds["t_descriptor_s"]
    return Done((MappedSession(maps[0], before), MappedSession(maps[1], after)), seconds)


def map_sources(sources: Sequence[ScanSource], config: PipelineConfig, hooks: Hooks) -> tuple[PointMap, PointMap]:
    """Return both thinned maps, each in its session's own odom frame.

    Raises:
        InputError: A session or one of its scans cannot be used.
    """

    def compute() -> Done[tuple[PointMap, PointMap]]:
        # both before either is mapped, which may take minutes
        for source, other in (sources, sources[::-1]):
            check_session(source, config.map, other)
        maps = []
        for name, source in zip(("before", "after"), sources, strict=True):
            hooks.on_stage(f"map {name}", 0, 1)
            maps.append(build_map(source, config.map))
        return Done((maps[0], maps[1]))

    return hooks.run("maps", config, compute).value


def detect_changes(
    before: MappedSession,
    after: MappedSession,
    config: PipelineConfig,
    hooks: Hooks | None = None,
    *,
    merge: Merge | None = None,
    propose: Propose | None = None,
) -> ChangeReport:
    """Merge two mapped sessions and report what changed between them.

    Args:
        before: The earlier session.
        after: The later one.
        config: All settings; `method` names what compares the merged maps.
        hooks: What stands around the stages.
        merge: What merges instead of the method's merge.
        propose: What proposes regions instead of the method, from the scans of the keyframes of both sessions.

    Raises:
        MergeFailedError: The sessions could not be aligned with enough evidence; it carries what was measured.
    """
    hooks = hooks or Hooks()
    merged = merge_mapped(before, after, config, hooks, merge)
    report = compare_maps(merged, before.descriptors, after.descriptors, config, hooks, merge, propose)
    return replace(
        report,
        seconds={**report.seconds, **merged.seconds},
        evidence={**report.evidence, **_sizes(merged)},
    )


def detect_merge(
    before: MappedSession,
    after: MappedSession,
    config: PipelineConfig,
    hooks: Hooks | None = None,
    *,
    merge: Merge | None = None,
) -> ChangeReport:
    """Stop after the merge: a report without regions and objects; as `detect_changes` otherwise."""
    merged = merge_mapped(before, after, config, hooks or Hooks(), merge)
    none = np.zeros(0)
    regions = ChangeRegions(
        np.zeros((0, 3)), config.query.radius_m, none, np.zeros((0, 2), dtype=np.int64), none.astype(np.bool_), none
    )
    report = make_report(merged, (before.descriptors, after.descriptors), regions, (), {}, merged.seconds, config)
    return replace(report, evidence={**merged.evidence, **_sizes(merged)})


def merge_mapped(
    before: MappedSession, after: MappedSession, config: PipelineConfig, hooks: Hooks, merge: Merge | None = None
) -> MergedMaps:
    """Merge two mapped sessions; arguments as in `detect_changes`.

    Raises:
        MergeFailedError: The evidence does not suffice.
    """

    def compute() -> Done[MergedMaps]:
        hooks.on_stage("merge", 0, 1)
        merged = (merge or _merge_by(config))(before, after)
        return Done(merged, merged.seconds)

    done = hooks.run("merge", config, compute) if merge is None else compute()
    # what is found again is of equal maps, and may hold none itself
    merged = replace(done.value, before=before.map, after=after.map, seconds=done.seconds)
    if merged.is_accepted:
        return merged
    hint = unit_hint(merged.before, merged.after)
    raise MergeFailedError(
        f"the sessions cannot be merged: {merged.reason}{'; ' if hint else ''}{hint}",
        merged.evidence,
        {name: merged.seconds[name] for name in ("t_index_s", "t_merge_s") if name in merged.seconds},
    )


def compare_maps(
    merged: MergedMaps,
    before: DescriptorSet,
    after: DescriptorSet,
    config: PipelineConfig,
    hooks: Hooks | None = None,
    merge: Merge | None = None,
    propose: Propose | None = None,
) -> ChangeReport:
    """Compare two merged maps by `config.method`; arguments as in `detect_changes`."""
    hooks = hooks or Hooks()
    method = load_method(config.method)
    described = before, after
    if propose is not None:
        regions = Done(propose((before.keyframe_scans, after.keyframe_scans)), {"t_cd_s": 0.0})
    elif method.propose is not None:
        query = partial(_query, method.propose, merged, described, config, hooks)
        regions = hooks.run("regions", config, query) if merge is None else hooks.time(query)
    else:
        assert method.detect is not None  # a method has one of both
        return _timed_report(hooks, partial(method.detect, merged, before, after, config))
    t_cd_s = regions.seconds["t_cd_s"]
    return _timed_report(hooks, lambda: extract_changes(merged, regions.value, described, t_cd_s, config))


def _query(
    propose: registry.Propose,
    merged: MergedMaps,
    described: tuple[DescriptorSet, DescriptorSet],
    config: PipelineConfig,
    hooks: Hooks,
) -> Done[ChangeRegions]:
    hooks.on_stage("query", 0, 1)
    start = time.perf_counter()
    regions = propose(merged, *described, config)
    return Done(regions, {"t_cd_s": time.perf_counter() - start})


def _timed_report(hooks: Hooks, answer: Callable[[], ChangeReport]) -> ChangeReport:
    def compute() -> Done[ChangeReport]:
        report = answer()
        return Done(report, report.seconds)

    done = hooks.time(compute)
    return replace(done.value, seconds=done.seconds)


def _merge_by(config: PipelineConfig) -> Merge:
    return lambda before, after: merge_maps(before, after, config.merge)


def _describe_scans(
    sources: Sequence[ScanSource],
    maps: Sequence[PointMap],
    stored: Sequence[DescriptorSet | None],
    config: PipelineConfig,
    hooks: Hooks,
) -> Done[tuple[DescriptorSet, DescriptorSet]]:
    hooks.on_stage("describe keyframes", 0, 1)
    if None in stored:
        describe_scans(sources[0], maps[0].keyframe_scans[:1], config.descriptor)  # loads the network
    start = time.perf_counter()
    before, after = (
        kept or describe_scans(source, thin_map.keyframe_scans, config.descriptor)
        for source, thin_map, kept in zip(sources, maps, stored, strict=True)
    )
    return Done((before, after), {"t_descriptor_s": time.perf_counter() - start})


def _describe_spheres(
    maps: Sequence[PointMap], stored: Sequence[DescriptorSet | None], config: PipelineConfig, hooks: Hooks
) -> Done[tuple[Spheres, Spheres]]:
    hooks.on_stage("describe spheres", 0, 1)
    describe_map(maps[0], maps[0].odom_T_keyframe[:1], config.descriptor)  # loads the network
    start = time.perf_counter()
    before, after = (
        describe_map(thin_map, thin_map.odom_T_keyframe, config.descriptor)
        if kept is None or kept.spheres is None
        else kept.spheres
        for thin_map, kept in zip(maps, stored, strict=True)
    )
    return Done((before, after), {"t_descriptor_s": time.perf_counter() - start})


def _sizes(merged: MergedMaps) -> dict[str, float]:
    return {"map_points_before": len(merged.before.points), "map_points_after": len(merged.after.points)}
