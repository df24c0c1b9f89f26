"""Both sessions together: merge, query, extraction and the report of changes."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError, InputWarning, MergeFailedError
from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.core.plugins import require_extra
from cdpipe.core.threads import THREADS
from cdpipe.core.yamlfile import setting_lines
from cdpipe.descriptors.describe import list_checkpoints, load_descriptors, require_weights_are_read, use_threads
from cdpipe.extract.extract import extract_changes, make_report
from cdpipe.io.known_merge import require_rigid
from cdpipe.mapping.free_space import views_of_one
from cdpipe.mapping.poses.recorded_frames import regions_as_mapped, report_as_recorded
from cdpipe.mapping.scanless import adapt_to_whole_maps
from cdpipe.mapping.session_check import are_swapped, unit_hint
from cdpipe.merge.coverage import measure_coverage
from cdpipe.merge.merge import merge_maps, take_known_merge
from cdpipe.methods.registry import list_extras, load_source
from cdpipe.model.config import PipelineConfig, Site, load_config, require_settings_are_read, warn_of_unread_settings
from cdpipe.model.report import ChangeRegions, ChangeReport, SurfaceField
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, ScanSource
from cdpipe.pipeline.hooks import Done, Hooks
from cdpipe.pipeline.mapping import map_pair, open_with_folder
from cdpipe.query.drift_width import keyframe_radii
from cdpipe.surface.measure import measure_surface, require_method
from cdpipe.surface.rock_or_object import leave_out_rock

_Answer = TypeVar("_Answer", ChangeRegions, ChangeReport)
Merge = Callable[[MappedSession, MappedSession], MergedMaps]
Propose = Callable[[tuple[Int64Array, Int64Array], Float64Array], ChangeRegions]


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
    settings = setting_lines(settings)
    config = load_config(preset, settings, site)
    require_usable(config, is_merge_known=known is not None)
    require_settings_are_read(config, settings)
    warn_of_unread_settings(config, settings)
    use_threads(THREADS)
    hooks = hooks or Hooks()
    (before, stored_before), (after, stored_after) = (_open(each, config) for each in (before, after))
    if are_swapped(before, after):
        told = (
            f"{after.name} was recorded before {before.name}, by the clocks of both: is the earlier session the first?"
        )
        warnings.warn(f"{told} What was added is told as removed otherwise", InputWarning, stacklevel=2)
    sources, stored = (before, after), (stored_before, stored_after)
    config = adapt_to_whole_maps(sources, config, is_merge_known=known is not None)
    mapped = map_pair(sources, config, hooks, stored)
    try:
        _warn_of_few_views(mapped.value, config)
        merge = None if known is None else partial(take_known_merge, before_T_after=known, config=config.merge)
        report = detect_changes(*mapped.value, config, hooks, merge=merge)
    except MergeFailedError as error:
        raise MergeFailedError(f"{before.name} and {after.name}: {error}", error.evidence, error.seconds) from error
    _warn_of_no_level(report.surface, config.surface.method)
    coverage = measure_coverage(report, before.odom_T_sensor, after.odom_T_sensor)
    return replace(report, seconds={**report.seconds, **mapped.seconds}, coverage=coverage)


def require_usable(config: PipelineConfig, *, is_merge_known: bool = False) -> None:
    """Refuse settings that cannot be run here, before anything is read or mapped.

    Args:
        config: The settings.
        is_merge_known: Whether nothing has to be merged.

    Raises:
        InputError: An extra is missing, or weights are damaged or read by nobody.
    """
    load_source(config)
    require_method(config.surface.method)
    if config.merge.method == "kiss-matcher" and not is_merge_known:
        require_extra("kiss", "merge.method = kiss-matcher")
    require_weights_are_read(config)
    list_checkpoints(config)


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
        InputError: The source of regions cannot be loaded, does not go with the extraction, or returned another type
            than it should; or the extra of `surface.method` is not installed.
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
        proposed = _require(ChangeRegions, method.propose(merged, *described, config), config)
        return Done(proposed, {"t_cd_s": time.perf_counter() - start})

    def answer() -> Done[ChangeReport]:
        if regions is not None:
            report = extract_changes(merged, regions.value, described, regions.seconds["t_cd_s"], config)
        else:
            assert method.detect is not None  # a method has `propose` or `detect`
            report = _require(ChangeReport, method.detect(merged, *described, config), config)
        if config.surface.method != "none":
            hooks.on_stage("surface", 0, 1)
            surface, is_rock, seconds = measure_surface(merged, report.objects, config)
            report = replace(leave_out_rock(report, is_rock, config.extract), surface=surface)
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


def _require(kind: type[_Answer], found: Any, config: PipelineConfig) -> _Answer:
    """Return what a source of regions returned; one of a plugin may return anything."""
    if not isinstance(found, kind):
        text = f"regions.source = {config.regions.source} returned {type(found).__name__}: expected {kind.__name__}"
        raise InputError(text)
    return found


def _warn_of_few_views(mapped: Sequence[MappedSession], config: PipelineConfig) -> None:
    """Warn where the sessions have too few keyframes for any object to be seen through often enough."""
    n_keyframes, n_views = min(
        (len(poses), len(poses) * views_of_one(poses))
        for poses in (each.map.odom_T_sensor[each.map.keyframe_scans] for each in mapped)
    )
    if config.extract.method == "surface" and n_views < config.extract.min_views:
        asked = f"extract.min_views = {config.extract.min_views:g}"
        text = (
            f"{n_keyframes} keyframes in the shorter session, {asked}: no object is seen through often enough to be "
            "found: record a path, or lower it (--set extract.min_views=0.5)"
        )
        warnings.warn(text, InputWarning, stacklevel=3)


def _warn_of_no_level(field: SurfaceField | None, method: str) -> None:
    """Warn where displacement was measured and nothing tells how sure it is: then no region of rock is found."""
    if field is not None and np.isfinite(field.displacement_m).any() and not np.isfinite(field.level_m).any():
        text = (
            f"surface.method = {method}: no displacement has a level of detection, so no rock is "
            "reported to have moved: scans of different metres of path tell the error: record a path of 2 m and more "
            "past the rock, or ask for --set surface.method=m3c2-ep"
        )
        warnings.warn(text, InputWarning, stacklevel=3)


def _open(session: Path | str | ScanSource, config: PipelineConfig) -> tuple[ScanSource, DescriptorSet | None]:
    """Return an opened session, and the descriptors stored in its folder."""
    source, folder = open_with_folder(session)
    if folder is None:
        return source, None
    return source, load_descriptors(folder, config.descriptor, source.odom_T_sensor, config.map, config.sphere)


def _sizes(merged: MergedMaps) -> dict[str, float]:
    return {"map_points_before": len(merged.before.points), "map_points_after": len(merged.after.points)}
