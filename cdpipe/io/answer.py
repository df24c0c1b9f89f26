"""The answer of a method on disk, written by `detect` or another program and read by `score`.

    answer.json   format, status, method, config, checkpoints (digest of each descriptor's weights), extras (version of
                  each optional package that it depends on, left out without one), seconds, evidence, before_T_after,
                  radius_m of all regions (left out where each has its own), objects (session, kind,
                  region, score and partner of each; if known, shape: map_T_box (4, 4), box_m (3,) and volume_m3; for
                  moved objects displacement_map (3,)); until: "merge" if the method was stopped after the merge
    answer.npz    region_centres_map (R, 3), region_scores (R,), region_pairs (R, 2), region_is_reported (R,),
                  region_radii_m (R,), where radii differ along the path (without radius_m),
                  region_is_withdrawn (R,), regions above the threshold without an object of their own (optional),
                  region_direction (R,) uint8, session of the queried keyframe, 0 before, 1 after (optional),
                  region_proposed_centres_map (R, 3), where regions were proposed that are now centred on their objects
                  (optional),
                  region_is_forced (R,), regions that are looked at whatever the threshold (optional),
                  keyframe_scores (Kb,), before_keyframe_scans (Kb,), after_keyframe_scans (Ka,),
                  object_returns (M, 2) int32 with object_return_offsets (O + 1,),
                  object_points_map (P, 3) with object_point_offsets (O + 1,), and figure_<name> (R,) each;
                  local_before_T_after (Ka, 4, 4), local alignment at each after keyframe (optional);
                  surface_points_map (Q, 3), surface_normals_map (Q, 3), surface_displacement_m (Q,), surface_level_m
                  (Q,) and surface_region (Q,), how far the rock moved (all or none of them), surface_chainage_m (Q,)
                  and surface_angle_deg (Q,) (optional): see `SurfaceField`; surface_regions of answer.json are its
                  regions

`seconds` holds t_index_s, t_merge_s, t_refine_s, t_descriptor_s, t_cd_s, t_oe_s and t_surface_s as far as they were
measured.

A refused or failed case has an answer.json with status and error, and no answer.npz. An answer of another program may
replace object_returns by object_points_odom with object_point_odom_offsets: points in the odom frame of the session
that holds the object; each covers 0.1 m around it. `answer_parts` lists all optional fields. Unknown names are refused,
so that a misspelt field does not pass as a missing one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json, read_npz, require_plain_file
from cdpipe.core.files.json_file import MAX_BYTES
from cdpipe.core.geometry import Float64Array
from cdpipe.core.whole_file import whole_file
from cdpipe.io.answer_parts import (
    FORMAT,
    FORMAT_VERSION,
    MAX_ERROR,
    OFFSETS,
    SURFACE,
    SURFACE_UNROLLED,
    AnswerPart,
    ShapePart,
    Until,
    check_array_types,
    check_document,
    check_offsets,
    take_scans,
)
from cdpipe.model.report import (
    ChangedObject,
    ChangeRegions,
    ChangeReport,
    ObjectShape,
    SurfaceField,
    SurfaceRegion,
)

ANSWER_FILES = ("answer.json", "answer.npz")
_MOST_BYTES = {"answer.json": MAX_BYTES, "answer.npz": 2 << 30}  # 10 million points of a surface are 0.8 GB
# Fields of an object that answer.json holds as they are.
_OF_SURFACE = (*SURFACE, *SURFACE_UNROLLED)
_OBJECT_FIELDS = ("session", "kind", "region", "score", "partner")


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A stored answer.

    Attributes:
        status: "ok", "merge_refused", "failed" or "worker_died".
        error: The message if the status is not ok, else "".
        method: Name of the preset or of the foreign method.
        report: The answer; None if the status is not ok.
        seconds: Seconds per stage.
        evidence: Evidence of the merge.
        points_odom: For each object the (P, 3) odom points of a foreign answer without returns; None otherwise.
        until: Last stage of a method that was stopped on purpose; None if it ran to its end.
        checkpoints: Digest of the weights of each descriptor that was used, by its name.
        extras: Version of each optional package that it depends on, "absent" if one was wanted in vain.
    """

    status: str
    error: str
    method: str
    report: ChangeReport | None
    seconds: Mapping[str, float]
    evidence: Mapping[str, float]
    points_odom: tuple[Float64Array, ...] | None = None
    until: Until | None = None
    checkpoints: Mapping[str, str] = field(default_factory=dict)
    extras: Mapping[str, str] = field(default_factory=dict)


def write_answer(folder: Path | str, method: str, report: ChangeReport, until: Until | None = None) -> None:
    """Write an answer into `folder`, which may exist; answer.json is written last and marks it complete.

    That of an older answer goes first: the folder holds one whole answer or none.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "answer.json").unlink(missing_ok=True)
    regions, objects = report.regions, report.objects
    arrays = {
        "region_centres_map": regions.centres_map,
        "region_scores": regions.scores,
        "region_pairs": regions.pairs,
        "region_is_reported": regions.is_reported,
        "keyframe_scores": regions.keyframe_scores,
        "before_keyframe_scans": report.keyframe_scans[0],
        "after_keyframe_scans": report.keyframe_scans[1],
        **_join("object_returns", np.zeros((0, 2), np.int32), [item.returns for item in objects]),
        **_join("object_points_map", np.zeros((0, 3)), [item.points_map for item in objects]),
        **{f"figure_{name}": values for name, values in report.figures.items()},
    }
    has_own_radii = isinstance(regions.radius_m, np.ndarray)
    optional = {
        "region_radii_m": regions.radii_m if has_own_radii else None,
        "region_is_withdrawn": regions.is_withdrawn,
        "region_direction": regions.direction,
        "region_proposed_centres_map": regions.proposed_centres_map,
        "region_is_forced": regions.is_forced,
        "local_before_T_after": report.local_before_T_after,
    }
    arrays |= {name: array for name, array in optional.items() if array is not None}
    if report.surface is not None:
        of_surface = {name: getattr(report.surface, name.removeprefix("surface_")) for name in _OF_SURFACE}
        arrays |= {name: array for name, array in of_surface.items() if array is not None}
    with whole_file(folder / "answer.npz") as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    document = {
        "status": "ok",
        "error": "",
        "method": method,
        "before_T_after": report.before_T_after.tolist(),
        **({} if has_own_radii else {"radius_m": regions.radius_m}),
        "seconds": dict(report.seconds),
        "evidence": dict(report.evidence),
        "config": dict(report.config),
        "checkpoints": dict(report.checkpoints),
        **({"extras": dict(report.extras)} if report.extras else {}),
        "objects": [_object_document(item) for item in objects],
    }
    if report.surface is not None:
        document["surface_regions"] = [_surface_document(item) for item in report.surface.regions]
    _write_json(folder, document, until)


def write_failure(
    folder: Path,
    method: str,
    status: str,
    error: str,
    evidence: Mapping[str, float],
    config: Mapping[str, Any],
    until: Until | None = None,
    seconds: Mapping[str, float] | None = None,
    checkpoints: Mapping[str, str] | None = None,
    extras: Mapping[str, str] | None = None,
) -> None:
    """Write the record of a case without an answer, with 10,000 letters of its error and the seconds until then."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ANSWER_FILES:
        (folder / name).unlink(missing_ok=True)
    document: dict[str, Any] = {"status": status, "error": error[:MAX_ERROR], "method": method}
    document |= {"seconds": dict(seconds or {}), "evidence": dict(evidence)}
    document |= {"config": dict(config), "checkpoints": dict(checkpoints or {})}
    document |= {"extras": dict(extras)} if extras else {}
    _write_json(folder, document, until)


def require_answer_sizes(folder: Path) -> None:
    """Raise `InputError` if a file of an answer is larger than one that is read, or no plain file."""
    for name, most_bytes in _MOST_BYTES.items():
        if (folder / name).exists():
            require_plain_file(folder / name, most_bytes)


def read_answer(folder: Path | str) -> Answer:
    """Read an answer.

    Raises:
        InputError: It is missing, damaged, too large or inconsistent; the text names the file and the field.
    """
    folder = Path(folder)
    require_answer_sizes(folder)
    path = folder / "answer.json"
    value = read_json(path, "expected an answer written by `tunnelcd detect` or by another method")
    document = check_document(path, value)
    if not isinstance(document, AnswerPart):
        failed = document.status, document.error, document.method, None, document.seconds, document.evidence
        return Answer(*failed, until=document.until, checkpoints=document.checkpoints, extras=document.extras)
    file, n_objects = folder / "answer.npz", len(document.objects)
    stored = read_npz(file, lambda types: check_array_types(file, types, n_objects))
    arrays = take_scans(file, {name: _computable(array) for name, array in stored.items()})
    check_offsets(file, arrays, n_objects)
    if math.isnan(document.radius_m) != ("region_radii_m" in arrays):
        raise InputError(
            f"{path}: radius_m: expected here for all regions, or array region_radii_m of answer.npz for each"
        )
    try:
        report, points_odom = _report(document, arrays)
    except ValueError as error:
        raise InputError(f"{file}: arrays that do not go together: {error}") from error
    measured = report.seconds, report.evidence
    used = report.checkpoints, report.extras
    return Answer("ok", "", document.method, report, *measured, points_odom, document.until, *used)


def _computable(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return an array; floating-point numbers that linear algebra does not take, of 16 or 128 bits, as 64 bits."""
    return array.astype(np.float64) if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8) else array


def _report(
    document: AnswerPart, arrays: Mapping[str, npt.NDArray[Any]]
) -> tuple[ChangeReport, tuple[Float64Array, ...] | None]:

    def split(name: str, empty: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        if name not in arrays:
            return [empty] * len(document.objects)
        return [arrays[name][start:end] for start, end in pairwise(arrays[OFFSETS[name]])]

    no_points = np.zeros((0, 3))
    points_odom = None
    if "object_points_odom" in arrays and "object_returns" not in arrays:
        points_odom = tuple(split("object_points_odom", no_points))
    returns, points_map = split("object_returns", np.zeros((0, 2), np.int32)), split("object_points_map", no_points)
    objects = tuple(
        ChangedObject(
            session=part.session,
            kind=part.kind,
            region=part.region,
            score=part.score,
            partner=part.partner,
            returns=of_object,
            points_map=points,
            shape=None if part.shape is None else _shape(part.shape),
            displacement_map=None if part.displacement_map is None else _numbers(part.displacement_map),
        )
        for part, of_object, points in zip(document.objects, returns, points_map, strict=True)
    )
    scores = arrays["region_scores"]
    regions = ChangeRegions(
        centres_map=arrays["region_centres_map"],
        radius_m=arrays.get("region_radii_m", document.radius_m),
        scores=scores,
        pairs=arrays.get("region_pairs", np.full((len(scores), 2), -1)),
        is_reported=arrays.get("region_is_reported", np.ones(len(scores), dtype=np.bool_)),
        keyframe_scores=arrays.get("keyframe_scores", np.zeros(0)),
        is_withdrawn=arrays.get("region_is_withdrawn"),
        direction=arrays.get("region_direction"),
        proposed_centres_map=arrays.get("region_proposed_centres_map"),
        is_forced=arrays.get("region_is_forced"),
    )
    no_scans = np.zeros(0, dtype=np.int64)
    report = ChangeReport(
        before_T_after=_numbers(document.before_T_after),
        evidence=document.evidence,
        regions=regions,
        objects=objects,
        seconds=document.seconds,
        figures={name[7:]: values for name, values in arrays.items() if name.startswith("figure_")},
        keyframe_scans=(arrays.get("before_keyframe_scans", no_scans), arrays.get("after_keyframe_scans", no_scans)),
        config=document.config,
        local_before_T_after=arrays.get("local_before_T_after"),
        checkpoints=document.checkpoints,
        extras=document.extras,
        surface=_surface(document, arrays),
    )
    return report, points_odom


def _surface(document: AnswerPart, arrays: Mapping[str, npt.NDArray[Any]]) -> SurfaceField | None:
    if "surface_points_map" not in arrays:
        return None
    regions = tuple(
        SurfaceRegion(_numbers(part.centre_map), part.area_m2, part.volume_m3, part.mean_m, part.largest_m)
        for part in document.surface_regions
    )
    found = {name.removeprefix("surface_"): arrays[name] for name in _OF_SURFACE if name in arrays}
    return SurfaceField(**found, regions=regions)


def _surface_document(item: SurfaceRegion) -> dict[str, Any]:
    return {**asdict(item), "centre_map": item.centre_map.tolist()}


def _object_document(item: ChangedObject) -> dict[str, Any]:
    document: dict[str, Any] = {name: getattr(item, name) for name in _OBJECT_FIELDS}
    if item.shape is not None:
        map_T_box, box_m = item.shape.map_T_box.tolist(), item.shape.box_m.tolist()
        document["shape"] = {"map_T_box": map_T_box, "box_m": box_m, "volume_m3": item.shape.volume_m3}
    if item.displacement_map is not None:
        document["displacement_map"] = item.displacement_map.tolist()
    return document


def _shape(part: ShapePart) -> ObjectShape:
    return ObjectShape(_numbers(part.map_T_box), _numbers(part.box_m), part.volume_m3)


def _numbers(values: Sequence[Any]) -> Float64Array:
    return np.asarray(values, dtype=np.float64)


def _write_json(folder: Path, document: Mapping[str, Any], until: Until | None) -> None:
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, **({} if until is None else {"until": until})}
    with whole_file(folder / "answer.json") as partial:
        partial.write_text(json.dumps({**head, **document}, indent=1))


def _join(name: str, empty: npt.NDArray[Any], parts: Sequence[npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Return the rows of all objects as one array, and the offsets of each object, under their names in the file."""
    return {name: np.concatenate([empty, *parts]), OFFSETS[name]: np.cumsum([0, *map(len, parts)])}
