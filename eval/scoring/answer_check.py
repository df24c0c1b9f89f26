"""Checks an answer against the sessions of its pair before it is scored; another program may write anything."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import (
    FARTHEST_M,
    BoolArray,
    Float64Array,
    Int64Array,
    require_poses,
    require_shape,
    transform_each,
)
from cdpipe.core.yamlfile import suggest
from cdpipe.extract.extract import ASKED_POINTS
from cdpipe.io.answer import Answer
from cdpipe.model.aligned import merge_at_scans
from cdpipe.model.report import MAX_DISPLACEMENT_M, ChangedObject, ChangeRegions, ChangeReport, SurfaceField
from cdpipe.model.types import SessionName
from eval.scoring.answer_rows import POINT_RADIUS_M, find_rows_near_points
from eval.truth.ground_truth import SESSIONS, GroundTruth, SessionTruth
from eval.truth.scoring_points import ScoringPoints

SECONDS = tuple(f"t_{name}_s" for name in ("index", "merge", "refine", "descriptor", "cd", "oe", "returns", "surface"))
MAX_SECONDS = 1e8  # three years
MAX_AMOUNT = 1e15  # of bytes, points, scores and every other figure; a page shows no larger one
# What is stated of a session's map: at most all of its pixels, each with a point and 52 bytes of what a method adds.
MAX_BYTES_PER_PIXEL = 64
_UNIT_TOLERANCE = 1e-3  # of the length of a normal: arrays may come as float32
_MANY = 100  # so many valid returns include the first return of some cell
# An object lies where its returns are if so large a share of them is so near to its points. Measured: 0.90 and more in
# right answers, 0 to 0.31 in answers to another pair or to a bag made from the pair.
_MIN_BESIDE = 0.2
_BESIDE_M = 0.5
_ASIDE_M = 2.0  # median distance that one object alone may have
_JUDGES = 500  # returns of an object that are looked at


def check_answer(answer: Answer, truth: GroundTruth, folder: Path, *, is_of_pair: bool = False) -> None:
    """Raise `InputError`, naming the folder and the field, unless an ok answer can be scored against this pair.

    Args:
        answer: The answer.
        truth: Truth of the pair.
        folder: What a message names.
        is_of_pair: Whether a plan made the answer from this very pair.

    Raises:
        InputError: A number is NaN or too large to be one, an index lies outside of its session, a return is named
            twice, or none of the named returns or points exists.
    """
    report = answer.report
    try:
        _check_seconds(answer.seconds)
        _check_evidence(answer.evidence)
        points = {name: each.scoring_points for name, each in truth.sessions.items()}
        n_pixels = {name: each.n_scans * each.n_pixels for name, each in points.items()}
        _check_stated(answer.evidence, n_pixels)
        if report is None:
            return
        require_poses("before_T_after", report.before_T_after[None])
        _require_near("before_T_after", report.before_T_after[None, :3, 3])
        for session, scans in zip(SESSIONS, report.keyframe_scans, strict=True):
            _check_scans(f"{session}_keyframe_scans", scans, len(truth.sessions[session].odom_T_sensor))
        _check_local(report.local_before_T_after, len(report.keyframe_scans[1]), len(truth.after.odom_T_sensor))
        _check_regions(report.regions, len(report.keyframe_scans[0]), len(truth.before.odom_T_sensor))
        for name, values in report.figures.items():
            require_shape(f"figure_{name}", values, (len(report.regions.scores),))
            if not (np.isnan(values) | ((values >= 0) & (values <= MAX_AMOUNT))).all():
                raise ValueError(f"figure_{name}: expected numbers from 0 to {MAX_AMOUNT:g}, NaN where there is none")
        _check_asked(report.figures, n_pixels["before"])
        for index, item in enumerate(report.objects):
            _check_object(index, item, len(report.objects), len(report.regions.scores))
        for session in SESSIONS:
            _check_returns(session, report.objects, truth.sessions[session])
            _check_points(session, report.objects, answer.points_odom, truth.sessions[session].scoring_points)
        if not is_of_pair:
            _check_places(report, truth.sessions)
        if report.surface is not None:
            _check_surface(report.surface)
    except ValueError as error:
        raise InputError(f"{folder}: not an answer to this pair: {error}") from error


def _check_seconds(seconds: Mapping[str, float]) -> None:
    for name, value in seconds.items():
        if name not in SECONDS:
            raise ValueError(f"seconds.{name} is unknown{suggest(name, SECONDS)} (known: {', '.join(SECONDS)})")
        if not 0 <= value <= MAX_SECONDS:
            raise ValueError(
                f"seconds.{name} = {value}: expected 0 to {MAX_SECONDS:g} s; leave out what was not measured"
            )


def _check_evidence(evidence: Mapping[str, float]) -> None:
    for name, value in evidence.items():
        if not (np.isnan(value) or 0 <= value <= MAX_AMOUNT):
            raise ValueError(f"evidence.{name} = {value}: expected 0 to {MAX_AMOUNT:g}, NaN if it was not measured")


def _check_stated(evidence: Mapping[str, float], n_pixels: Mapping[SessionName, int]) -> None:
    """Raise where more points or bytes of a map are stated than its session can give."""
    most_bytes = MAX_BYTES_PER_PIXEL * n_pixels["before"]
    most = {f"map_points_{name}": (n, "one") for name, n in n_pixels.items()}
    most |= dict.fromkeys(("bytes_map_before", "bytes_regions_before"), (most_bytes, f"{MAX_BYTES_PER_PIXEL} bytes"))
    for name, (limit, told) in most.items():
        if (value := evidence.get(name, 0.0)) > limit:
            raise ValueError(f"evidence.{name} = {value:g}: expected at most {limit}, {told} for each pixel")


def _check_asked(figures: Mapping[str, Float64Array], n_pixels: int) -> None:
    """Raise where a region asks for more points of the before map than its session has pixels."""
    is_beyond = figures.get(ASKED_POINTS, np.zeros(0)) > n_pixels
    if is_beyond.any():
        index = int(np.argmax(is_beyond))
        raise ValueError(
            f"figure_{ASKED_POINTS}: entry {index} is {figures[ASKED_POINTS][index]:g}: expected at most {n_pixels}, "
            "one for each pixel of the before session"
        )


def _check_local(local_before_T_after: Float64Array | None, n_keyframes: int, n_scans: int) -> None:
    if local_before_T_after is None:
        return
    require_poses("local_before_T_after", local_before_T_after)
    _require_near("local_before_T_after", local_before_T_after[:, :3, 3])
    n_wanted = n_keyframes or n_scans
    if len(local_before_T_after) != n_wanted:
        raise ValueError(
            f"local_before_T_after has {len(local_before_T_after)} poses: expected one for each of the {n_wanted} "
            f"{'after keyframes' if n_keyframes else 'scans of the after session, as no keyframes are named'}"
        )


def _check_regions(regions: ChangeRegions, n_keyframes: int, n_scans: int) -> None:
    _require_near("region_centres_map", regions.centres_map)
    if regions.proposed_centres_map is not None:
        _require_near("region_proposed_centres_map", regions.proposed_centres_map)
    _require_finite("region_scores", regions.scores)
    _require_scores("region_scores", regions.scores)
    for radius_m in np.ravel(regions.radius_m):
        if not 0 < radius_m <= FARTHEST_M:
            raise ValueError(f"radius_m = {radius_m}: expected a length in metres, up to {FARTHEST_M:g}")
    if np.isinf(regions.keyframe_scores).any():
        raise ValueError("keyframe_scores: a score is infinite: expected a number, or NaN where nothing was compared")
    _require_scores("keyframe_scores", regions.keyframe_scores)
    n_scored = n_keyframes or n_scans
    if len(regions.keyframe_scores) not in (0, n_scored):
        raise ValueError(
            f"keyframe_scores has {len(regions.keyframe_scores)} entries: expected one for each of the {n_scored} "
            "before keyframes, or none"
        )


def _check_scans(name: str, scans: Int64Array, n_scans: int) -> None:
    if scans.ndim == 1 and len(scans) == 0:
        return  # no keyframes named; nothing has a type then
    if scans.ndim != 1 or not np.issubdtype(scans.dtype, np.integer):
        raise ValueError(f"{name} must be a list of whole numbers, got {scans.dtype} {scans.shape}")
    if not (scans.min() >= 0 and scans.max() < n_scans):
        raise ValueError(f"{name} names scans {scans.min()} to {scans.max()}, the session has 0 to {n_scans - 1}")
    if len(np.unique(scans)) < len(scans):
        raise ValueError(f"{name} names a scan twice")


def _check_object(index: int, item: ChangedObject, n_objects: int, n_regions: int) -> None:
    where = f"objects[{index}]"
    if item.partner == index:
        raise ValueError(f"{where}.partner = {item.partner}: that is itself; -1 means none")
    if not -1 <= item.partner < n_objects:
        raise ValueError(f"{where}.partner = {item.partner}: there are {n_objects} objects; -1 means none")
    if not -1 <= item.region < n_regions:
        raise ValueError(f"{where}.region = {item.region}: there are {n_regions} regions; -1 means none")
    _require_near(f"{where}: object_points_map", item.points_map)
    if not abs(item.score) <= MAX_AMOUNT:
        raise ValueError(f"{where}.score = {item.score}: expected a number, at most {MAX_AMOUNT:g} in size")
    if item.shape is not None:
        _require_near(f"{where}.shape: map_T_box", item.shape.map_T_box[None, :3, 3])
        edges = item.shape.box_m.tolist()
        if not (all(0 <= edge <= FARTHEST_M for edge in edges) and 0 <= item.shape.volume_m3 <= MAX_AMOUNT):
            raise ValueError(
                f"{where}.shape: edges {', '.join(f'{edge:g}' for edge in edges)} m and volume "
                f"{item.shape.volume_m3:g} m3: expected 0 to {FARTHEST_M:g} m and 0 to {MAX_AMOUNT:g} m3"
            )
    if item.displacement_map is not None:
        _require_near(f"{where}.displacement_map", item.displacement_map[None])


def _check_returns(session: SessionName, objects: tuple[ChangedObject, ...], truth: SessionTruth) -> None:
    n_scans, n_pixels = truth.scoring_points.n_scans, truth.scoring_points.n_pixels
    taken = []
    for index, item in enumerate(objects):
        if item.session != session:
            continue
        if not np.issubdtype(item.returns.dtype, np.integer):
            raise ValueError(f"objects[{index}]: object_returns must be whole numbers, got {item.returns.dtype}")
        if len(item.returns) == 0:
            continue
        if not ((item.returns >= 0).all() and (item.returns < (n_scans, n_pixels)).all()):
            bad = item.returns[((item.returns < 0) | (item.returns >= (n_scans, n_pixels))).any(axis=1)][0]
            raise ValueError(
                f"objects[{index}] names return (scan {bad[0]}, pixel {bad[1]}), outside of the {session} session's "
                f"{n_scans} scans of {n_pixels} pixels"
            )
        taken.append(item.returns[:, 0].astype(np.int64) * n_pixels + item.returns[:, 1])
    if not taken:
        return
    keys, counts = np.unique(np.concatenate(taken), return_counts=True)
    if (
        len(keys) >= _MANY
        and len(truth.scoring_points.rows_of_returns(np.column_stack(np.divmod(keys, n_pixels)))) == 0
    ):
        raise ValueError(
            f"object_returns of the {session} session: nothing returned at any of their {len(keys)} (scan, pixel): "
            "a pixel is row * columns + column of the staggered image"
        )
    if (counts > 1).any():
        scan, pixel = divmod(int(keys[counts > 1][0]), n_pixels)
        raise ValueError(
            f"object_returns name return (scan {scan}, pixel {pixel}) of the {session} session twice: "
            "a return belongs to one object at most"
        )


def _check_places(report: ChangeReport, sessions: Mapping[SessionName, SessionTruth]) -> None:
    """Raise if half of the objects or more do not lie where the returns that they name were measured.

    This finds an answer to another pair, to a converted copy with other pixels, or to swapped sessions: most pixels
    return in every session, so the other checks pass. Returns of the after session come into the map by the answer's
    own merge, each as it holds at its scan. One object alone may lie up to 2 m away: where an odometry drifts, the
    passes of a place lie apart.
    """
    distances_m: dict[int, Float64Array] = {}
    for index, item in enumerate(report.objects):
        scoring_points = sessions[item.session].scoring_points
        rows = scoring_points.rows_of_returns(item.returns) if len(item.returns) else np.zeros(0, np.int64)
        rows = rows[:: max(1, len(rows) // _JUDGES)]
        if len(rows) and len(item.points_map):
            points = scoring_points.points_odom[rows].astype(np.float64)
            if item.session == "after":
                points = transform_each(merge_at_scans(report, scoring_points.scans(rows)), points)
            # every search would look at all of many equal points
            distances_m[index] = np.asarray(cKDTree(np.unique(item.points_map, axis=0)).query(points)[0])
    far = [index for index, each in distances_m.items() if np.mean(each <= _BESIDE_M) < _MIN_BESIDE]
    if not far or 2 * len(far) < len(distances_m):
        return
    median_m = [float(np.median(distances_m[index])) for index in far]
    if len(far) > 1 or median_m[0] > _ASIDE_M:
        raise ValueError(
            f"{len(far)} of {len(distances_m)} objects do not lie where object_returns says: objects[{far[0]}] is "
            f"{median_m[0]:.1f} m from its returns in the {report.objects[far[0]].session} session: is "
            "object_points_map in another frame, or is it an answer to another pair, to a converted copy of this one, "
            "or to the sessions the other way round?"
        )


def _check_points(
    session: SessionName,
    objects: tuple[ChangedObject, ...],
    points_odom: tuple[Float64Array, ...] | None,
    scoring_points: ScoringPoints,
) -> None:
    if points_odom is None:
        return
    owners, all_points = [], []
    for index, (item, points) in enumerate(zip(objects, points_odom, strict=True)):
        require_shape(f"objects[{index}]: object_points_odom", points, (None, 3))
        _require_near(f"objects[{index}]: object_points_odom", points)
        if item.session == session:
            distinct = np.unique(points, axis=0)
            owners.append(np.full(len(distinct), index))
            all_points.append(distinct)
    if sum(map(len, all_points)) == 0:
        return
    if not any(len(rows) for rows in find_rows_near_points(scoring_points, all_points)):
        raise ValueError(
            f"object_points_odom of the {session} session: none of its {sum(map(len, all_points))} points is within "
            f"{POINT_RADIUS_M:g} m of a return of that session: give them in its own odom frame, not in the map's"
        )
    _, first, counts = np.unique(np.concatenate(all_points), axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        owner = int(np.concatenate(owners)[first[counts > 1][0]])
        raise ValueError(
            f"objects[{owner}] shares a point of object_points_odom with another object: one owner at most"
        )


def _check_surface(surface: SurfaceField) -> None:
    _require_near("surface_points_map", surface.points_map)
    lengths = np.linalg.norm(surface.normals_map, axis=1)
    is_unit = np.abs(lengths - 1.0) <= _UNIT_TOLERANCE
    if not is_unit.all():
        index = int(np.argmin(is_unit))
        raise ValueError(f"surface_normals_map: entry {index} has length {lengths[index]:g}: expected a unit vector")
    size_m, level_m = np.abs(surface.displacement_m), surface.level_m
    _require_all(
        "surface_displacement_m", np.isnan(size_m) | (size_m <= MAX_DISPLACEMENT_M), surface.displacement_m,
        f"expected at most {MAX_DISPLACEMENT_M:g} m in size, NaN where it was not measured",
    )  # fmt: skip
    _require_all(
        "surface_level_m", np.isnan(level_m) | ((level_m > 0) & (level_m <= MAX_DISPLACEMENT_M)), level_m,
        f"expected a length in metres, up to {MAX_DISPLACEMENT_M:g}, NaN where it is unknown",
    )  # fmt: skip
    for index, region in enumerate(surface.regions):
        where = f"surface_regions[{index}]"
        _require_near(f"{where}.centre_map", region.centre_map[None])
        if not 0 <= region.area_m2 <= MAX_AMOUNT:
            raise ValueError(f"{where}.area_m2 = {region.area_m2}: expected 0 to {MAX_AMOUNT:g} m2")
        if not abs(region.volume_m3) <= MAX_AMOUNT:
            raise ValueError(f"{where}.volume_m3 = {region.volume_m3}: expected at most {MAX_AMOUNT:g} m3 in size")
        for name, value in (("mean_m", region.mean_m), ("largest_m", region.largest_m)):
            if not abs(value) <= MAX_DISPLACEMENT_M:
                raise ValueError(f"{where}.{name} = {value}: expected at most {MAX_DISPLACEMENT_M:g} m in size")


def _require_all(name: str, is_right: BoolArray, values: Float64Array, expected: str) -> None:
    """Raise for the first of (N,) values that is not right."""
    if not is_right.all():
        index = int(np.argmin(is_right))
        raise ValueError(f"{name}: entry {index} is {values[index]:g}: {expected}")


def _require_near(name: str, places_m: Float64Array) -> None:
    """Raise unless (N, 3) places are finite and near enough to be places."""
    _require_finite(name, places_m)
    # whole numbers have a smallest one, whose size is no whole number: as such it would count as near
    is_far = (np.abs(places_m.astype(np.float64)) > FARTHEST_M).any(axis=1)
    if is_far.any():
        raise ValueError(f"{name}: entry {int(np.argmax(is_far))} is farther than {FARTHEST_M:g} m from the origin")


def _require_scores(name: str, scores: Float64Array) -> None:
    """Raise for a score that a page would leave out as too large; NaN passes."""
    is_beyond = (scores > MAX_AMOUNT) | (scores < -MAX_AMOUNT)
    if is_beyond.any():
        raise ValueError(f"{name}: entry {int(np.argmax(is_beyond))} is larger than {MAX_AMOUNT:g} in size")


def _require_finite(name: str, values: Float64Array) -> None:
    if not np.isfinite(values).all():
        raise ValueError(
            f"{name}: entry {int(np.argmin(np.isfinite(values).reshape(len(values), -1).all(axis=1)))} "
            "is not a finite number"
        )
