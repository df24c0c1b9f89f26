"""Change detection between two sessions, on one screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

from cdpipe.core.errors import MergeFailedError
from cdpipe.core.geometry import Float64Array
from cdpipe.descriptors import describe_map, describe_scans
from cdpipe.extract.extract import assemble_objects, cut_out, region_figures, with_withdrawn
from cdpipe.mapping.mapping import build_map
from cdpipe.mapping.session_check import check_session, unit_hint
from cdpipe.merge.merge import merge_maps
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import (
    ChangeRegions,
    ChangeReport,
    DescriptorSet,
    MappedSession,
    MergedMaps,
    PointMap,
    ScanSource,
)
from cdpipe.query.query import find_regions

Comparison = Callable[[MergedMaps, DescriptorSet, DescriptorSet, PipelineConfig], ChangeReport]


def map_session(source: ScanSource, config: PipelineConfig) -> MappedSession:
    """Do what a robot does while it drives: thin its map and describe its keyframes.

    Raises:
        InputError: The session or one of its scans cannot be used; the text names it and says how to mend it.
    """
    check_session(source, config.map)
    thin_map = build_map(source, config.map)
    return MappedSession(thin_map, describe_mapped(source, thin_map, config))


def describe_mapped(source: ScanSource, thin_map: PointMap, config: PipelineConfig) -> DescriptorSet:
    """Describe the scans of a session's keyframes and, where spheres will be compared, the map around each."""
    return with_spheres(describe_scans(source, thin_map.keyframe_scans, config.descriptor), thin_map, config)


def with_spheres(descriptors: DescriptorSet, thin_map: PointMap, config: PipelineConfig) -> DescriptorSet:
    """Return descriptors with those of the spheres, if spheres will be compared."""
    if config.query.compare != "sphere":
        return descriptors
    return replace(descriptors, spheres=describe_map(thin_map, thin_map.odom_T_keyframe, config.descriptor))


def compare(merged: MergedMaps, before: DescriptorSet, after: DescriptorSet, config: PipelineConfig) -> ChangeReport:
    """Find the changed regions of two merged maps and cut the objects out of them.

    `t_returns_s` is the part of `t_oe_s` that lists the objects' returns and tells their kind and shape, which the
    paper's extraction does not have.
    """
    start = perf_counter()
    regions = find_regions(merged, before, after, config.query)
    return extracted(merged, regions, (before, after), perf_counter() - start, config)


def extracted(
    merged: MergedMaps,
    regions: ChangeRegions,
    described: tuple[DescriptorSet, DescriptorSet],
    t_cd_s: float,
    config: PipelineConfig,
) -> ChangeReport:
    """Cut the objects out of some regions, wherever these are from, and take back the regions that hold none.

    Args:
        merged: Both maps.
        regions: Candidates; the reported ones are looked at.
        described: Descriptors of the before and of the after session; only the scans of their keyframes are used.
        t_cd_s: How long it took to find the regions.
        config: All settings.
    """
    start = perf_counter()
    groups = cut_out(merged, regions, config)
    regions = with_withdrawn(regions, groups, config)
    grouped = perf_counter()
    objects = assemble_objects(merged, groups)
    end = perf_counter()
    return ChangeReport(
        before_T_after=merged.before_T_after,
        evidence=merged.evidence,
        regions=regions,
        objects=objects,
        seconds={"t_cd_s": t_cd_s, "t_oe_s": end - start, "t_returns_s": end - grouped},
        figures=region_figures(merged, regions, groups),
        keyframe_scans=(described[0].keyframe_scans, described[1].keyframe_scans),
        config=config.model_dump(),
        local_before_T_after=local_alignment(merged, described[1]),
    )


def local_alignment(merged: MergedMaps, after: DescriptorSet) -> Float64Array | None:
    """Return the (Ka, 4, 4) alignment at each after keyframe, for a report; None where it is rigid."""
    if merged.local is None:
        return None
    return merged.local.at(merged.after.odom_T_sensor[after.keyframe_scans, :3, 3])


def refusal(merged: MergedMaps) -> MergeFailedError:
    """Return the error of a merge that was not accepted: what failed, and what may help."""
    hint = unit_hint(merged.before, merged.after)
    return MergeFailedError(
        f"the sessions cannot be merged: {merged.reason}{'; ' if hint else ''}{hint}",
        merged.evidence,
        {name: merged.seconds[name] for name in ("t_index_s", "t_merge_s") if name in merged.seconds},
    )


def detect_changes(
    before: MappedSession, after: MappedSession, config: PipelineConfig, method: Comparison = compare
) -> ChangeReport:
    """Merge two mapped sessions and report what changed between them.

    Args:
        before: The earlier session.
        after: The later one.
        config: All settings.
        method: What compares the merged maps: the paper's chain, or a rival.

    Raises:
        MergeFailedError: The sessions could not be aligned with enough evidence; it carries what was measured.
    """
    merged = merge_maps(before, after, config.merge)
    if not merged.is_accepted:
        raise refusal(merged)
    report = method(merged, before.descriptors, after.descriptors, config)
    return replace(report, seconds={**merged.seconds, **report.seconds})
