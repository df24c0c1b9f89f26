"""The pipeline: map, describe, merge, query, extract. This module alone defines the order of the stages.

`detect` takes two sessions, `detect_changes` two mapped sessions. `Hooks` are called around every stage: the command
line reports progress with them, a benchmark caches and times results. `regions.source` names what finds the regions
in the merged maps.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError, InputWarning, MergeFailedError
from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.threads import THREADS
from cdpipe.descriptors.describe import (
    describe_scans,
    insert_rows,
    list_checkpoints,
    load_descriptors,
    save_descriptors,
    use_threads,
)
from cdpipe.descriptors.sphere import anchor_frames, describe_map
from cdpipe.extract.extract import extract_changes, make_report
from cdpipe.io.known_merge import require_rigid
from cdpipe.io.readers import open_session
from cdpipe.mapping.airborne import clear
from cdpipe.mapping.counted import CountedScans
from cdpipe.mapping.mapping import build_map, choose_keyframes
from cdpipe.mapping.recorded_frames import regions_as_mapped, report_as_recorded
from cdpipe.mapping.scanless import adapt_to_whole_maps
from cdpipe.mapping.session_check import check_session, unit_hint
from cdpipe.merge.candidates import first_keyframes
from cdpipe.merge.coverage import measure_coverage
from cdpipe.merge.merge import merge_maps, take_known_merge
from cdpipe.methods.registry import list_extras, load_source
from cdpipe.model.config import PipelineConfig, Site, load_config
from cdpipe.model.report import ChangeRegions, ChangeReport
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, PointMap, ScanSource, Spheres
from cdpipe.query.drift_width import keyframe_radii
from cdpipe.surface.measure import measure_surface, require_method
from cdpipe.surface.rock_or_object import leave_out_rock

T = TypeVar("T")
Stage = Literal["maps", "descriptors", "spheres", "merge", "regions"]
OnStage = Callable[[str, int, int], None]
Merge = Callable[[MappedSession, MappedSession], MergedMaps]
Propose = Callable[[tuple[Int64Array, Int64Array], Float64Array], ChangeRegions]


@dataclass(frozen=True, slots=True, eq=False)
class Done(Generic[T]):
    """The result of a stage, and the wall-clock seconds of its parts by name."""

    value: T
    seconds: Mapping[str, float] = field(default_factory=dict)


class Hooks:
    """Hooks around the stages. Here each stage runs once; override `run` to cache results, `time` to repeat a step.

    Args:
        on_stage: Called before a stage with its name, the work done and the total work; while a session is mapped
            also with `stage: step`, and the scans done and in all.
    """

    def __init__(self, on_stage: OnStage = lambda name, done, total: None) -> None:
        self.on_stage = on_stage

    def run(self, stage: Stage, config: PipelineConfig, compute: Callable[[], Done[T]]) -> Done[T]:
        """Return the result of a stage that depends only on the sessions and the settings."""
        return compute()

    def time(self, compute: Callable[[], Done[T]]) -> Done[T]:
        """Return the result of a step that is not cached."""
        return compute()


def detect(
    before: Path | str | ScanSource,
    after: Path | str | ScanSource,
    preset: str = "tunnelcd",
    settings: Iterable[str] | Mapping[str, Any] = (),
    site: Site = "narrow",
    hooks: Hooks | None = None,
    before_T_after: npt.ArrayLike | None = None,
) -> ChangeReport:
    """Find what changed between two recorded sessions.

    Descriptors that `tunnelcd describe` stored beside a session are used if they have the same weights and keyframes;
    `t_descriptor_s` then does not include them.

    Args:
        before: The earlier session: its folder, or the session as opened by `open_session`.
        after: The later session.
        preset: Name of a preset, or the path of a .yaml file.
        settings: Settings that replace those of the preset, e.g. `{"query.radius_m": 6}`.
        site: Section of the preset that applies: for narrow or for wide drifts. A preset whose radius follows the width
            of the drift, as that of `tunnelcd`, has no such section.
        hooks: Called around the stages.
        before_T_after: (4, 4) transform of the after session's odom frame into the before session's, if it is known:
            no place is searched and no gate is asked. It is still refined along the path where `merge.refine` says so.

    Raises:
        MergeFailedError: The sessions could not be aligned with enough evidence; it contains the evidence.
        InputError: A session or a setting cannot be used, or the method's extra is not installed.
        ValueError: `before_T_after` is no rigid transform.
    """
    known = None if before_T_after is None else require_rigid(before_T_after)
    config = load_config(preset, settings, site)
    # report a missing extra, or bad weights, before the mapping
    load_source(config)
    require_method(config.surface.method)
    list_checkpoints(config)
    use_threads(THREADS)
    hooks = hooks or Hooks()
    (before, stored_before), (after, stored_after) = (_open(each, config) for each in (before, after))
    sources, stored = (before, after), (stored_before, stored_after)
    config = adapt_to_whole_maps(sources, config, is_merge_known=known is not None)
    mapped = map_pair(sources, config, hooks, stored)
    try:
        _warn_of_few_views(mapped.value, config)
        merge = None if known is None else partial(take_known_merge, before_T_after=known, config=config.merge)
        report = detect_changes(*mapped.value, config, hooks, merge=merge)
    except MergeFailedError as error:
        raise MergeFailedError(f"{before.name} and {after.name}: {error}", error.evidence, error.seconds) from error
    coverage = measure_coverage(report, before.odom_T_sensor, after.odom_T_sensor)
    return replace(report, seconds={**report.seconds, **mapped.seconds}, coverage=coverage)


def describe(
    session: Path | str | ScanSource, preset: str = "tunnelcd", settings: Iterable[str] | Mapping[str, Any] = ()
) -> tuple[DescriptorSet, Path]:
    """Describe the keyframes of a session and store the vectors beside it, as a robot would while mapping.

    Returns:
        The descriptors, and the file that holds them.

    Raises:
        InputError: The session or a setting cannot be used, or the session's folder cannot be written.
    """
    config = load_config(preset, settings)
    list_checkpoints(config)  # report bad weights before the mapping
    use_threads(THREADS)
    source, folder = _open_with_folder(session)
    if folder is None:
        raise InputError(f"{source.name}: descriptors are stored beside a recording: name its folder or file")
    if config.regions.source == "sphere":
        descriptors = map_session(source, config).descriptors
    else:
        chosen = choose_keyframes(source.odom_T_sensor, config.map.keyframe_spacing_m)
        descriptors = describe_scans(clear(source, config.map), chosen, config.descriptor)
    return descriptors, save_descriptors(folder, descriptors, source.odom_T_sensor, config.map, config.sphere)


def map_session(source: ScanSource, config: PipelineConfig) -> MappedSession:
    """Build the thinned map of a session and describe its keyframes, as a robot does while it drives.

    Raises:
        InputError: The session or one of its scans cannot be used; the message names it and a remedy.
    """
    check_session(source, config.map)
    source = clear(source, config.map)
    thin_map = build_map(source, config.map)
    descriptors = describe_scans(source, thin_map.keyframe_scans, config.descriptor)
    if config.regions.source == "sphere":
        anchors = anchor_frames(thin_map, thin_map.keyframe_scans, config.sphere)
        spheres = describe_map(thin_map, anchors, config.descriptor, config.sphere)
        descriptors = replace(descriptors, spheres=spheres)
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
        hooks: Called around the stages.
        stored: Stored descriptors of each session, used if they have the keyframes of its map.

    Returns:
        Both mapped sessions, and `t_descriptor_s` of all descriptors that were computed. With `merge.first_every` the
        scans of the other keyframes are described if the merge asks for them, as a part of its time.

    Raises:
        InputError: A session or one of its scans cannot be used.
    """
    maps = map_sources(sources, config, hooks)
    kept = [
        each if each is not None and np.array_equal(each.keyframe_scans, thin_map.keyframe_scans) else None
        for each, thin_map in zip(stored, maps, strict=True)
    ]

    every = config.described_every

    def keyframes(session: int, chosen: slice) -> DescriptorSet:
        scans = maps[session].keyframe_scans[chosen]
        source = clear(sources[session], config.map)
        if every == 1:
            return describe_scans(source, scans, config.descriptor)
        rows = first_keyframes(len(scans), every, session == 1)
        return insert_rows(describe_scans(source, scans[rows], config.descriptor), rows, scans)

    def surroundings(session: int, chosen: slice) -> Spheres:
        anchors = anchor_frames(maps[session], maps[session].keyframe_scans[chosen], config.sphere)
        return describe_map(maps[session], anchors, config.descriptor, config.sphere)

    scans = hooks.run("descriptors", config, lambda: _describe_both("describe keyframes", keyframes, kept, hooks))
    (before, after), seconds = scans.value, dict(scans.seconds)
    if config.regions.source == "sphere":
        known: list[Spheres | None] = [None if each is None else each.spheres for each in kept]
        spheres: Done[tuple[Spheres, Spheres]] = hooks.run(
            "spheres", config, lambda: _describe_both("describe spheres", surroundings, known, hooks)
        )
        before, after = (replace(a, spheres=b) for a, b in zip((before, after), spheres.value, strict=True))
        seconds["t_descriptor_s"] += spheres.seconds["t_descriptor_s"]
    mapped = []
    for session, described in enumerate((before, after)):
        rest = None
        if every > 1 and kept[session] is None:
            rest = partial(_describe_rest, sources[session], described, session == 1, config)
        mapped.append(MappedSession(maps[session], described, rest))
    return Done((mapped[0], mapped[1]), seconds)


def _describe_rest(source: ScanSource, first: DescriptorSet, is_after: bool, config: PipelineConfig) -> DescriptorSet:
    """Return the descriptors of all keyframes of a session of which the first ones are described."""
    scans = first.keyframe_scans
    rows = np.setdiff1d(np.arange(len(scans)), first_keyframes(len(scans), config.described_every, is_after))
    if not len(rows):
        return first
    return insert_rows(describe_scans(clear(source, config.map), scans[rows], config.descriptor), rows, scans, first)


def map_sources(sources: Sequence[ScanSource], config: PipelineConfig, hooks: Hooks) -> tuple[PointMap, PointMap]:
    """Return both thinned maps, each in its session's own odom frame.

    Raises:
        InputError: A session or one of its scans cannot be used.
    """

    def compute() -> Done[tuple[PointMap, PointMap]]:
        # check both sessions first: mapping may take minutes
        for source, other in (sources, sources[::-1]):
            check_session(source, config.map, other)
        maps = []
        for name, source in zip(("before", "after"), sources, strict=True):
            on_step = partial(_tell_step, hooks, f"map {name}")
            hooks.on_stage(f"map {name}", 0, 1)
            maps.append(build_map(clear(CountedScans(source, on_step), config.map), config.map, on_step=on_step))
        return Done((maps[0], maps[1]))

    return hooks.run("maps", config, compute).value


def _tell_step(hooks: Hooks, stage: str, step: str, done: int, total: int) -> None:
    hooks.on_stage(f"{stage}: {step}", done, total)


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
        after: The later session.
        config: All settings; `regions.source` names what finds the regions.
        hooks: Called around the stages.
        merge: Replaces the merge.
        propose: Replaces the source: returns regions from the keyframe scans of both sessions, and the radius of a
            region at each before keyframe.

    Raises:
        MergeFailedError: The sessions could not be aligned with enough evidence; it contains the evidence.
        InputError: The source of regions cannot be loaded, or does not go with the extraction; or the extra of
            `surface.method` is not installed.
    """
    hooks = hooks or Hooks()
    method = load_source(config)
    require_method(config.surface.method)
    merged = merge_mapped(before, after, config, hooks, merge)
    described = before.descriptors, after.descriptors
    regions: Done[ChangeRegions] | None = None

    def query() -> Done[ChangeRegions]:
        assert method.propose is not None
        hooks.on_stage("query", 0, 1)
        start = time.perf_counter()
        proposed = method.propose(merged, *described, config)
        return Done(proposed, {"t_cd_s": time.perf_counter() - start})

    def answer() -> Done[ChangeReport]:
        if regions is not None:
            report = extract_changes(merged, regions.value, described, regions.seconds["t_cd_s"], config)
        else:
            assert method.detect is not None  # a method has `propose` or `detect`
            report = method.detect(merged, *described, config)
        if config.surface.method != "none":
            hooks.on_stage("surface", 0, 1)
            surface, is_rock, seconds = measure_surface(merged, report.objects, config)
            report = replace(leave_out_rock(report, is_rock), surface=surface)
            report = replace(report, seconds={**report.seconds, "t_surface_s": seconds})
        return Done(report, report.seconds)

    if propose is not None:
        scans = described[0].keyframe_scans, described[1].keyframe_scans
        recorded = propose(scans, keyframe_radii(merged.before, scans[0], config.query))
        regions = Done(regions_as_mapped(recorded, merged.before), {"t_cd_s": 0.0})
    elif method.propose is not None:
        regions = hooks.run("regions", config, query) if merge is None else hooks.time(query)
    done = hooks.time(answer)
    return replace(
        report_as_recorded(done.value, merged.before, merged.after),
        seconds={**done.seconds, **merged.seconds},
        evidence={**done.value.evidence, **_sizes(merged)},
        checkpoints=list_checkpoints(config),
        extras=list_extras(config, merged.evidence, proposes=propose is None),
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
    radius_m = none if config.query.radius_m == "width" else config.query.radius_m
    regions = ChangeRegions(
        np.zeros((0, 3)), radius_m, none, np.zeros((0, 2), dtype=np.int64), none.astype(np.bool_), none
    )
    report = make_report(merged, (before.descriptors, after.descriptors), regions, (), {}, merged.seconds, config)
    report = report_as_recorded(report, merged.before, merged.after)
    return replace(
        report,
        evidence={**merged.evidence, **_sizes(merged)},
        checkpoints=list_checkpoints(config),
        extras=list_extras(config, merged.evidence, proposes=False, measures=False),
    )


def merge_mapped(
    before: MappedSession, after: MappedSession, config: PipelineConfig, hooks: Hooks, merge: Merge | None = None
) -> MergedMaps:
    """Merge two mapped sessions; arguments as in `detect_changes`.

    Raises:
        MergeFailedError: The evidence does not suffice.
    """

    def compute() -> Done[MergedMaps]:
        hooks.on_stage("merge", 0, 1)
        merged = merge(before, after) if merge else merge_maps(before, after, config.merge)
        return Done(merged, merged.seconds)

    done = hooks.run("merge", config, compute) if merge is None else compute()
    # a cached result belongs to equal maps, and may not contain them
    merged = replace(done.value, before=before.map, after=after.map, seconds=done.seconds)
    if merged.is_accepted:
        return merged
    hint = unit_hint(merged.before, merged.after)
    raise MergeFailedError(
        f"the sessions cannot be merged: {merged.reason}{'; ' if hint else ''}{hint}",
        merged.evidence,
        {name: merged.seconds[name] for name in ("t_index_s", "t_merge_s") if name in merged.seconds},
    )


def _warn_of_few_views(mapped: Sequence[MappedSession], config: PipelineConfig) -> None:
    """Warn where the sessions have too few keyframes for any object to be seen through often enough."""
    n_views = min(len(session.map.keyframe_scans) for session in mapped)
    if config.extract.method == "surface" and n_views < config.extract.min_views:
        asked = f"extract.min_views = {config.extract.min_views:g}"
        text = (
            f"{n_views} keyframes in the shorter session, {asked}: no object is seen through often enough to be found: "
            "record a path, or lower it (--set extract.min_views=0.5)"
        )
        warnings.warn(text, InputWarning, stacklevel=3)


def _open(session: Path | str | ScanSource, config: PipelineConfig) -> tuple[ScanSource, DescriptorSet | None]:
    """Return an opened session, and the descriptors stored in its folder."""
    source, folder = _open_with_folder(session)
    if folder is None:
        return source, None
    return source, load_descriptors(folder, config.descriptor, source.odom_T_sensor, config.map, config.sphere)


def _open_with_folder(session: Path | str | ScanSource) -> tuple[ScanSource, Path | None]:
    """Return an opened session, and the folder that its descriptors are stored in; None for one that is in no file."""
    if not isinstance(session, Path | str):
        return session, getattr(session, "descriptors_in", None)
    source = open_session(session)
    return source, getattr(source, "descriptors_in", None) or Path(session)


def _describe_both(
    name: str, describe: Callable[[int, slice], T], stored: Sequence[T | None], hooks: Hooks
) -> Done[tuple[T, T]]:
    """Describe the sessions, numbered 0 and 1, that have no stored descriptors; `describe` gets some keyframes."""
    hooks.on_stage(name, 0, 1)
    if any(each is None for each in stored):
        describe(0, slice(1))  # loads the network
    start = time.perf_counter()
    before, after = (describe(k, slice(None)) if each is None else each for k, each in enumerate(stored))
    return Done((before, after), {"t_descriptor_s": time.perf_counter() - start})


def _sizes(merged: MergedMaps) -> dict[str, float]:
    return {"map_points_before": len(merged.before.points), "map_points_after": len(merged.after.points)}
