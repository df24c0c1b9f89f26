"""Change detection between two sessions, on one screen."""

from __future__ import annotations

from dataclasses import replace

from cdpipe.core.errors import MergeFailedError
from cdpipe.descriptors import describe_map, describe_scans
from cdpipe.mapping.mapping import build_map
from cdpipe.mapping.session_check import check_session, unit_hint
from cdpipe.merge.merge import merge_maps
from cdpipe.methods.registry import load_method
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import DescriptorSet, MappedSession, MergedMaps, PointMap, ScanSource


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


def refusal(merged: MergedMaps) -> MergeFailedError:
    """Return the error of a merge that was not accepted: what failed, and what may help."""
    hint = unit_hint(merged.before, merged.after)
    return MergeFailedError(
        f"the sessions cannot be merged: {merged.reason}{'; ' if hint else ''}{hint}",
        merged.evidence,
        {name: merged.seconds[name] for name in ("t_index_s", "t_merge_s") if name in merged.seconds},
    )


def detect_changes(before: MappedSession, after: MappedSession, config: PipelineConfig) -> ChangeReport:
    """Merge two mapped sessions and report what changed between them.

    Args:
        before: The earlier session.
        after: The later one.
        config: All settings; `method` names what compares the merged maps.

    Raises:
        MergeFailedError: The sessions could not be aligned with enough evidence; it carries what was measured.
    """
    method = load_method(config.method)
    merged = merge_maps(before, after, config.merge)
    if not merged.is_accepted:
        raise refusal(merged)
    report = method(merged, before.descriptors, after.descriptors, config)
    return replace(report, seconds={**merged.seconds, **report.seconds})
