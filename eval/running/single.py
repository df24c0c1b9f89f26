"""One pair of sessions through the pipeline, as `tunnelcd detect` and `describe` do it: no truth, no plan."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from cdpipe.core.errors import InputError, MergeFailedError
from cdpipe.core.geometry import yaw_rad
from cdpipe.core.threads import THREADS
from cdpipe.descriptors import describe_scans, load_descriptors, save_descriptors, use_threads
from cdpipe.io.answer import write_answer
from cdpipe.io.readers import open_scans
from cdpipe.mapping.mapping import build_map, keyframes
from cdpipe.mapping.session_check import check_session, is_same_session
from cdpipe.merge.evidence import GATES
from cdpipe.model.config import PipelineConfig
from cdpipe.model.report import ChangeReport, ObjectShape
from cdpipe.model.types import DescriptorSet, MappedSession, PointMap, ScanSource
from cdpipe.pipeline import describe_mapped, detect_changes, map_session, with_spheres
from eval.running.stages import OnStage

_SIZES = ("map_points_before", "map_points_after")


def describe_session(folder: Path, config: PipelineConfig) -> tuple[DescriptorSet, Path]:
    """Describe the keyframes of a session and store the vectors beside it; return them and the file.

    Raises:
        InputError: The session is damaged, or its folder cannot be written.
    """
    use_threads(THREADS)
    source = open_scans(folder)
    if config.query.compare == "sphere":
        descriptors = map_session(source, config).descriptors
    else:
        chosen = keyframes(source.odom_T_sensor, config.map.keyframe_spacing_m)
        descriptors = describe_scans(source, chosen, config.descriptor)
    return descriptors, save_descriptors(folder, descriptors, source.odom_T_sensor, config.map)


def detect_pair(before: Path, after: Path, config: PipelineConfig, on_stage: OnStage) -> ChangeReport:
    """Find what changed between two recorded sessions.

    Stored descriptors are used where they are of the same weights and keyframes; `t_descriptor_s` then does not contain
    them.

    Raises:
        MergeFailedError: The sessions could not be put into one frame.
        InputError: A session is missing or damaged, or the method's extra is not installed.
    """
    use_threads(THREADS)
    sources = open_scans(before), open_scans(after)
    # both before either is mapped, which may take minutes
    for source, other in (sources, sources[::-1]):
        check_session(source, config.map, other)
    mapped: list[MappedSession] = []
    t_descriptor_s = 0.0
    for folder, source in zip((before, after), sources, strict=True):
        on_stage(f"map {source.name}", 0, 1)
        pointmap = build_map(source, config.map)
        on_stage(f"describe {source.name}", 0, 1)
        start = time.perf_counter()
        mapped.append(MappedSession(pointmap, _descriptors(folder, source, pointmap, config)))
        t_descriptor_s += time.perf_counter() - start
    on_stage("merge and compare", 0, 1)
    try:
        report = detect_changes(mapped[0], mapped[1], config)
    except MergeFailedError as error:
        raise MergeFailedError(f"{before} and {after}: {error}", error.evidence, error.seconds) from error
    seconds = {**report.seconds, "t_descriptor_s": t_descriptor_s}
    sizes = {name: len(each.map.points) for name, each in zip(_SIZES, mapped, strict=True)}
    return replace(report, seconds=seconds, evidence={**report.evidence, **sizes})


def notes_on(before: Path, after: Path) -> list[str]:
    """Return what is legal about two sessions and yet should be said.

    Raises:
        InputError: A session is missing or damaged.
    """
    if is_same_session(open_scans(before), open_scans(after)):
        return [f"{before} and {after} are one and the same recording: nothing can have changed between them"]
    return []


def evidence_table(evidence: Mapping[str, float], config: PipelineConfig) -> pd.DataFrame:
    """Return one row per figure that a merge measured: what it is, from where on it is accepted, and whether it is."""
    gates = {name: (f"merge.{setting}", getattr(config.merge, setting)) for name, setting in GATES}
    rows = []
    for name, value in evidence.items():
        if name in _SIZES:
            continue
        setting, least = gates.get(name, ("", np.nan))
        passed = "-" if name not in gates else ("yes" if value >= least else "no")
        rows.append((name, float(value), least, passed, setting))
    return pd.DataFrame(rows, columns=["evidence", "measured", "at least", "passed", "setting"])


def write_detection(folder: Path, method: str, report: ChangeReport) -> None:
    """Write the raw answer, and beside it what people open: regions.csv, objects.csv and objects.ply."""
    write_answer(folder, method, report)
    region_table(report).to_csv(folder / "regions.csv", index=False)
    object_table(report).to_csv(folder / "objects.csv", index=False)
    _write_ply(folder / "objects.ply", report)


def region_table(report: ChangeReport) -> pd.DataFrame:
    """Return one row per region that was let through, best first; positions in the map frame, metres.

    One that is withdrawn does not stand in the answer: nothing could be cut out of it.
    """
    regions = report.regions
    shown = np.flatnonzero(regions.is_proposed)
    columns = {
        "region": shown,
        "score": regions.scores[shown],
        "is_withdrawn": ~regions.is_reported[shown],
        **{f"{axis}_m": regions.centres_map[shown, k] for k, axis in enumerate("xyz")},
        **{name: values[shown] for name, values in report.figures.items()},
    }
    return pd.DataFrame(columns)


def object_table(report: ChangeReport) -> pd.DataFrame:
    """Return one row per object: what happened to it, where it is, how large it is; map frame, metres.

    Centroid and corners of its points, centre, level edges (the longer one is the length), height and yaw of its
    upright box, volume, and how far a moved one went. What is not known is empty.
    """
    names = ["object", "session", "kind", "partner", "region", "score", "n_returns", "n_points"]
    places = ["x_m", "y_m", "z_m", *(f"{end}_{axis}_m" for end in ("min", "max") for axis in "xyz")]
    boxes = ["box_x_m", "box_y_m", "box_z_m", "box_length_m", "box_width_m", "box_height_m", "box_yaw_deg", "volume_m3"]
    shifts = [f"displacement_{axis}_m" for axis in "xyz"]
    unknown = np.full(3, np.nan)
    rows = []
    for index, item in enumerate(report.objects):
        points = item.points_map if len(item.points_map) else np.full((1, 3), np.nan)
        identity = index, item.session, item.kind, item.partner, item.region, item.score
        counts = len(item.returns), len(item.points_map)
        corners = *points.mean(axis=0), *points.min(axis=0), *points.max(axis=0)
        shift = unknown if item.displacement_map is None else item.displacement_map
        rows.append((*identity, *counts, *corners, *_box_row(item.shape), *shift))
    return pd.DataFrame(rows, columns=[*names, *places, *boxes, *shifts])


def _box_row(shape: ObjectShape | None) -> tuple[float, ...]:
    """Return centre (3,), edges (3,), yaw in degrees and volume, NaN where nothing is known."""
    if shape is None:
        return (np.nan,) * 8
    yaw_deg = float(np.rad2deg(yaw_rad(shape.map_T_box)))
    return (*shape.map_T_box[:3, 3], *shape.box_m, yaw_deg, shape.volume_m3)


def _descriptors(folder: Path, source: ScanSource, pointmap: PointMap, config: PipelineConfig) -> DescriptorSet:
    stored = load_descriptors(folder, config.descriptor, source.odom_T_sensor, config.map)
    if stored is None or not np.array_equal(stored.keyframe_scans, pointmap.keyframe_scans):
        return describe_mapped(source, pointmap, config)
    return stored if stored.spheres is not None else with_spheres(stored, pointmap, config)


def _write_ply(path: Path, report: ChangeReport) -> None:
    """Write the points of all objects, map frame, each with the index of its object."""
    vertex = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("object", "<i4")])
    parts = []
    for index, item in enumerate(report.objects):
        part = np.empty(len(item.points_map), dtype=vertex)
        part["x"], part["y"], part["z"] = item.points_map.T
        part["object"] = index
        parts.append(part)
    vertices = np.concatenate(parts) if parts else np.empty(0, dtype=vertex)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty int object\nend_header\n"
    )
    try:
        path.write_bytes(header.encode() + vertices.tobytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
