"""The map of an answer: both sessions in one frame, and of each point what the method found there."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, Int32Array, Int64Array
from cdpipe.core.progress import Progress
from cdpipe.io.answer import Answer, read_answer
from cdpipe.io.out.maps import PointMap, gather_map, join_scalars
from cdpipe.io.out.scans import Fields, Outgoing
from cdpipe.mapping.mapping import choose_keyframes
from cdpipe.model.aligned import alignment_of, is_torn
from cdpipe.model.report import ChangedObject, ChangeReport
from cdpipe.model.types import ScanSource, SessionName

KINDS = ("unchanged", "added", "removed", "moved", "reshaped")
"""What the values of `change` mean, in order."""
_SESSIONS: tuple[SessionName, SessionName] = ("before", "after")
_COVERED_M = 0.1  # around a point of an answer that names no returns
_NEAR_M = 0.3  # a place of the surface speaks for the points up to here
_FARTHEST_M = 5.0


def gather_answer_map(
    sessions: tuple[ScanSource, ScanSource], folder: Path, cell_m: float, report: Progress
) -> PointMap:
    """Return the points of the before and the after session, one a cell, in the map frame of an answer.

    The values are those of `gather_map`, NaN for the points of a session that lacks them, and

    - `session`: 0 before, 1 after;
    - `change`: place in `KINDS`; `instance`: 1 for the first object of the answer, 0 for none;
    - `distance`: metres to the closest point of the other session, NaN beyond 5 m;
    - `displacement`: of the rock, signed, as the answer has it within 0.3 m, or of a moved object; NaN elsewhere.

    Raises:
        InputError: The answer cannot be read, has no result, or does not fit the sessions.
    """
    answer = read_answer(folder)
    found = answer.report
    if found is None:
        raise InputError(f"{folder}: the method gave no answer ({answer.status}): convert the sessions one by one")
    for source, scans in zip(sessions, found.keyframe_scans, strict=True):
        require_own_keyframes(source, scans, found)
    after_T = alignment_of(found, sessions[1].odom_T_sensor)
    if is_torn(found, sessions[1].odom_T_sensor):
        text = (
            f"{sessions[1].name}: its odometry lost its way, so its points in this map lie wrong behind that place: "
            "tunnelcd view shows them where they were found"
        )
        warnings.warn(text, InputWarning, stacklevel=2)
    clouds = []
    for name, source in zip(_SESSIONS, sessions, strict=True):
        cloud = gather_map(Outgoing(source, _fields(found, name)), cell_m, report)
        _mark_points(cloud, answer, name)
        points = after_T.to_map(cloud.points) if name == "after" else cloud.points
        clouds.append(PointMap(points, cloud.scalars))
    return _join(clouds, found)


def require_own_keyframes(source: ScanSource, scans: Int64Array, report: ChangeReport) -> None:
    """Raise `InputError` if the keyframes of an answer are not those of a session, as far as its settings tell."""
    of_map = report.config.get("map")
    spacing_m = of_map.get("keyframe_spacing_m") if isinstance(of_map, Mapping) else None
    if isinstance(spacing_m, float) and len(scans) and spacing_m > 0:
        own = choose_keyframes(source.odom_T_sensor, spacing_m)
        if not np.array_equal(own, scans):
            raise InputError(
                f"{source.name}: the answer has {len(scans)} keyframes up to scan {scans.max()}, this session "
                f"{len(own)} up to scan {own[-1]}: is it an answer to this pair, and in this order?"
            )


def _fields(report: ChangeReport, name: SessionName) -> Fields:
    """Return what gives the object and the kind of change of returns of one session."""
    own = [(index, item) for index, item in enumerate(report.objects) if item.session == name and len(item.returns)]

    def of_scan(scan: int, pixels: Int32Array) -> Mapping[str, npt.NDArray[Any]]:
        instance: Int32Array = np.zeros(len(pixels), np.int32)
        for index, item in own:
            instance[np.isin(pixels, item.returns[item.returns[:, 0] == scan, 1])] = index + 1
        return {"change": _kinds(report.objects)[instance], "instance": instance}

    return of_scan


def _kinds(objects: Sequence[ChangedObject]) -> Int32Array:
    """Return the kind of change (O + 1,) of no object and of each."""
    return np.array([0, *(KINDS.index(item.kind) for item in objects)], np.int32)


def _mark_points(cloud: PointMap, answer: Answer, name: SessionName) -> None:
    """Mark the points of objects that name no returns: those within 0.1 m of the odom points that the answer has."""
    assert answer.report is not None
    if answer.points_odom is None:
        return
    for index, item in enumerate(answer.report.objects):
        if item.session == name and len(answer.points_odom[index]):
            away_m, _ = cKDTree(answer.points_odom[index]).query(cloud.points, distance_upper_bound=_COVERED_M)
            cloud.scalars["instance"][np.isfinite(away_m)] = index + 1
    cloud.scalars["change"][:] = _kinds(answer.report.objects)[cloud.scalars["instance"]]


def _join(clouds: Sequence[PointMap], report: ChangeReport) -> PointMap:
    trees = [cKDTree(cloud.points) for cloud in clouds]
    lengths = [len(cloud.points) for cloud in clouds]
    scalars = join_scalars([cloud.scalars for cloud in clouds], lengths)
    scalars["session"] = np.repeat(np.arange(2, dtype=np.int32), lengths)
    away_m = [_distance(cloud.points, tree) for cloud, tree in zip(clouds, trees[::-1], strict=True)]
    scalars["distance"] = np.concatenate(away_m)
    points = np.concatenate([cloud.points for cloud in clouds])
    scalars["displacement"] = _displacement(points, scalars["instance"], report)
    return PointMap(points, scalars)


def _distance(points: Float64Array, tree: cKDTree) -> npt.NDArray[np.float32]:
    away_m, _ = tree.query(points, distance_upper_bound=_FARTHEST_M)
    return np.where(np.isfinite(away_m), away_m, np.nan).astype(np.float32)


def _displacement(points: Float64Array, instance: Int32Array, report: ChangeReport) -> npt.NDArray[np.float32]:
    found = np.full(len(points), np.nan, np.float32)
    if report.surface is not None:
        measured = np.flatnonzero(np.isfinite(report.surface.displacement_m))
        tree = cKDTree(report.surface.points_map[measured])
        away_m, nearest = tree.query(points, distance_upper_bound=_NEAR_M)
        is_near = np.isfinite(away_m) & (instance == 0)
        found[is_near] = report.surface.displacement_m[measured[np.asarray(nearest)[is_near]]]
    for index, item in enumerate(report.objects):
        moved_m = np.nan if item.displacement_map is None else float(np.linalg.norm(item.displacement_map))
        found[instance == index + 1] = moved_m
    return found
