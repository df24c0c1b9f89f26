"""The stages before the merge: maps of sessions, and descriptors of their keyframes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.threads import THREADS
from cdpipe.descriptors.describe import (
    describe_scans,
    insert_rows,
    list_checkpoints,
    require_weights_are_read,
    save_descriptors,
    use_threads,
)
from cdpipe.descriptors.sphere import anchor_frames, describe_map
from cdpipe.io.readers import open_session
from cdpipe.mapping.airborne import clear_air
from cdpipe.mapping.counted import CountedScans
from cdpipe.mapping.mapping import build_map, choose_keyframes
from cdpipe.mapping.reach import require_cells_reach
from cdpipe.mapping.scanless import warn_of_whole_map
from cdpipe.mapping.session_check import check_session
from cdpipe.merge.candidates import first_keyframes
from cdpipe.model.config import PipelineConfig, load_config
from cdpipe.model.types import DescriptorSet, MappedSession, PointMap, ScanSource, Spheres
from cdpipe.pipeline.hooks import Done, Hooks, T


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
    require_weights_are_read(config)
    list_checkpoints(config)  # report bad weights before the mapping
    use_threads(THREADS)
    source, folder = open_with_folder(session)
    if folder is None:
        raise InputError(f"{source.name}: descriptors are stored beside a recording: name its folder or file")
    warn_of_whole_map(source)
    if config.regions.source == "sphere":
        descriptors = map_session(source, config).descriptors
    else:
        check_session(source, config.map)
        chosen = choose_keyframes(source.odom_T_sensor, config.map.keyframe_spacing_m)
        descriptors = describe_scans(clear_air(source, config.map), chosen, config.descriptor)
    return descriptors, save_descriptors(folder, descriptors, source.odom_T_sensor, config.map, config.sphere)


def map_session(source: ScanSource, config: PipelineConfig) -> MappedSession:
    """Build the thinned map of a session and describe its keyframes, as a robot does while it drives.

    Raises:
        InputError: The session or one of its scans cannot be used; the message names it and a remedy.
    """
    check_session(source, config.map)
    require_cells_reach(source, config)
    source = clear_air(source, config.map)
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
        source = clear_air(sources[session], config.map)
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
    return insert_rows(
        describe_scans(clear_air(source, config.map), scans[rows], config.descriptor), rows, scans, first
    )


def map_sources(sources: Sequence[ScanSource], config: PipelineConfig, hooks: Hooks) -> tuple[PointMap, PointMap]:
    """Return both thinned maps, each in its session's own odom frame.

    Raises:
        InputError: A session or one of its scans cannot be used.
    """

    def compute() -> Done[tuple[PointMap, PointMap]]:
        # check both sessions first: mapping may take minutes
        for source, other in (sources, sources[::-1]):
            check_session(source, config.map, other)
            require_cells_reach(source, config)
        maps = []
        for name, source in zip(("before", "after"), sources, strict=True):
            on_step = partial(_tell_step, hooks, f"map {name}")
            hooks.on_stage(f"map {name}", 0, 1)
            maps.append(build_map(clear_air(CountedScans(source, on_step), config.map), config.map, on_step=on_step))
        return Done((maps[0], maps[1]))

    maps = hooks.run("maps", config, compute).value
    for source in sources:  # stored maps may be of other settings of later stages
        require_cells_reach(source, config)
    return maps


def _tell_step(hooks: Hooks, stage: str, step: str, done: int, total: int) -> None:
    hooks.on_stage(f"{stage}: {step}", done, total)


def open_with_folder(session: Path | str | ScanSource) -> tuple[ScanSource, Path | None]:
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
