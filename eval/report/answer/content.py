"""What there is to see of an answer: thinned maps, paths, objects, regions and rock that moved, in the map frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, Int32Array, transform, travelled_m
from cdpipe.core.geometry.voxel import FINEST_CELL_M, max_coordinate_m, require_reachable, thin
from cdpipe.core.progress import Progress
from cdpipe.io.answer import Answer, read_answer
from cdpipe.io.out.answer_map import require_own_keyframes
from cdpipe.io.readers import open_session
from cdpipe.mapping.mapping import choose_keyframes
from cdpipe.merge.coverage import measure_coverage
from cdpipe.model.aligned import aligned_scans, alignment_of, is_torn, merge_at_scans
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.report import ChangeReport
from cdpipe.model.types import PosedScan, ScanSource, WrappedScans

# Of each session: about so many scans along the path, returns within this range, and at most so many points.
_SCANS, _REACH_M, MAX_POINTS = 120, 40.0, 120_000
# First cell of the thinned maps, and how much larger the next one is while there are too many points.
_CELL_M, _LARGER = 0.1, 1.25


@dataclass(frozen=True, slots=True, eq=False)
class AnswerContent:
    """An answer and what surrounds it.

    Attributes:
        names: What the before and the after session are called.
        method: What the answer calls its method.
        report: The answer, with its coverage and with the points of all its objects.
        maps: (N, 3) points of the before and of the after session, map frame, metres.
        cells_m: Edge of the cells that the points of each were thinned by.
        paths: (S, 3) positions of the sensor in both, map frame, metres.
    """

    names: tuple[str, str]
    method: str
    report: ChangeReport
    maps: tuple[Float64Array, Float64Array]
    cells_m: tuple[float, float]
    paths: tuple[Float64Array, Float64Array]


def read_content(
    before: Path | ScanSource, after: Path | ScanSource, folder: Path, on_stage: Progress
) -> AnswerContent:
    """Return the content of a stored answer.

    Args:
        before: The earlier session, or its folder.
        after: The later session, or its folder.
        folder: Holds the answer.
        on_stage: Told the name of each stage, how much of it is done, and how much there is.

    Raises:
        InputError: A session or the answer cannot be read, the answer has no result, or it is one to another pair.
    """
    answer = read_answer(folder)
    if answer.report is None:
        why = f"{answer.status.replace('_', ' ')}{': ' if answer.error else ''}{answer.error}"
        raise InputError(f"{folder}: the method gave no answer ({why}): view the sessions one by one")
    first, second = (open_session(each) if isinstance(each, Path) else each for each in (before, after))
    sessions = first, second
    report = locate_objects(answer, sessions)
    _require_shown(folder, report)
    return gather_content(sessions, answer.method, report, on_stage)


def _require_shown(folder: Path, report: ChangeReport) -> None:
    """Require that the places of an answer can be thinned to the finest cells of its page."""
    told = {f"objects[{index}]": item.points_map for index, item in enumerate(report.objects)}
    if report.surface is not None:
        told["surface_points"] = report.surface.points_map
    for name, points in told.items():
        farthest_m = float(np.abs(points).max(initial=0.0))
        if not farthest_m < (most_m := max_coordinate_m(FINEST_CELL_M)):
            where = f"{folder}: {name} reaches {farthest_m:g} m from the origin"
            raise InputError(f"{where}: expected places in the sessions' odom frames, within {most_m:.0f} m")


def gather_content(
    sessions: tuple[ScanSource, ScanSource], method: str, report: ChangeReport, on_stage: Progress
) -> AnswerContent:
    """Return the content of an answer to two opened sessions; other arguments and errors as of `read_content`."""
    before, after = sessions
    for source, scans in zip(sessions, report.keyframe_scans, strict=True):
        require_own_keyframes(source, scans, report)
    if report.coverage is None:
        report = replace(report, coverage=measure_coverage(report, before.odom_T_sensor, after.odom_T_sensor))
    alignment, path_after = alignment_of(report, after.odom_T_sensor), after.odom_T_sensor[:, :3, 3]
    if is_torn(report, after.odom_T_sensor):  # its path lies over itself: no place of it has one place in the map
        after = _Found(after, report)
        alignment, path_after = PathAlignment.rigid(np.eye(4)), after.path
    (seen, cell_m), (seen_after, cell_after_m) = (
        _thin_session(each, f"points {name}", on_stage) for each, name in zip((before, after), _WORDS, strict=True)
    )
    maps, cells_m = (seen, alignment.to_map(seen_after)), (cell_m, cell_after_m)
    paths = before.odom_T_sensor[:, :3, 3], alignment.to_map(path_after)
    return AnswerContent((before.name, after.name), method, report, maps, cells_m, paths)


class _Found(WrappedScans):
    """The keyframes of a lost after session, in the map frame, where an answer found them anew."""

    def __init__(self, source: ScanSource, report: ChangeReport) -> None:
        super().__init__(source)
        self._keyframes = aligned_scans(report, len(source.odom_T_sensor))
        self._poses = merge_at_scans(report, self._keyframes) @ source.odom_T_sensor[self._keyframes]

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(K, 4, 4) pose of each keyframe in the map frame."""
        return self._poses

    @property
    def path(self) -> Float64Array:
        """(S, 3) places of all scans, between keyframes on the line between theirs."""
        scans = np.arange(len(self._source.odom_T_sensor))
        return np.column_stack([np.interp(scans, self._keyframes, each) for each in self._poses[:, :3, 3].T])

    def scan(self, index: int) -> PosedScan:
        """Read one keyframe."""
        found = self._source.scan(int(self._keyframes[index]))
        return replace(found, odom_T_sensor=self._poses[index])


_WORDS = ("before", "after")


def near_stretches(is_near: BoolArray, *, wanted: bool) -> Iterator[slice]:
    """Yield the scans of each stretch of a path whose steps were compared (`wanted`), or were not."""
    is_step = (is_near[1:] & is_near[:-1]) == wanted
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_step, [False]]).astype(np.int8)))
    for start, end in edges.reshape(-1, 2).tolist():
        yield slice(start, end + 1)


def locate_objects(answer: Answer, sessions: tuple[ScanSource, ScanSource]) -> ChangeReport:
    """Return the report of an answer, the map points of its objects from its odom points or returns if it has none."""
    report = answer.report
    assert report is not None
    alignment = alignment_of(report, sessions[1].odom_T_sensor)

    def points_map(index: int) -> Float64Array:
        item = report.objects[index]
        if len(item.points_map):
            return item.points_map
        is_after = item.session == "after"
        foreign = answer.points_odom
        odom = _points_of(item.returns, sessions[is_after]) if foreign is None else foreign[index].astype(np.float64)
        return alignment.to_map(odom) if is_after and len(odom) else odom

    objects = (replace(item, points_map=points_map(index)) for index, item in enumerate(report.objects))
    return replace(report, objects=tuple(objects))


def _points_of(returns: Int32Array, source: ScanSource) -> Float64Array:
    """Return the (M, 3) places of (M, 2) returns, scan and pixel, in the odom frame; those that do not exist left out.

    Raises:
        InputError: There is no such scan.
    """
    points = [np.zeros((0, 3))]
    for index in np.unique(returns[:, 0]).tolist():
        if not 0 <= index < len(source.odom_T_sensor):
            raise InputError(f"{source.name}: the answer names scan {index}: is it an answer to this pair?")
        scan = source.scan(index)
        is_own = np.isin(scan.pixels, returns[returns[:, 0] == index, 1])
        points.append(transform(scan.odom_T_sensor, scan.points_sensor[is_own]))
    return np.concatenate(points)


def _thin_session(source: ScanSource, stage: str, on_stage: Progress) -> tuple[Float64Array, float]:
    """Return at most `MAX_POINTS` points of scans along the path, one per cell, odom frame, and the edge of a cell."""
    poses = source.odom_T_sensor
    scans = choose_keyframes(poses, max(float(travelled_m(poses)[-1]) / _SCANS, 1e-3))
    if getattr(source, "is_whole_map", False):  # each station has the points that are nearest to it
        scans = np.arange(len(poses))
    require_reachable(source.name, float(np.abs(poses[:, :3, 3]).max(initial=0.0)) + _REACH_M, _CELL_M)
    cell_m, points = _CELL_M, np.zeros((0, 3))
    for done, index in enumerate(scans.tolist()):
        on_stage(stage, done, len(scans))
        scan = source.scan(index)
        near = scan.points_sensor[np.linalg.norm(scan.points_sensor, axis=1) < _REACH_M]
        points = thin(np.concatenate([points, transform(scan.odom_T_sensor, near)]), cell_m)
        while len(points) > MAX_POINTS:
            cell_m *= _LARGER
            points = thin(points, cell_m)
    on_stage(stage, len(scans), len(scans))
    return points, cell_m
