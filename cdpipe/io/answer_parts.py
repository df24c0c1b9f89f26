"""Schema of the two files of an answer; all mistakes of a file are reported at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field, PositiveFloat

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArrayType
from cdpipe.core.yamlfile import Document, Settings, suggest, validate
from cdpipe.model.types import Kind, SessionName

FORMAT: Literal["tunnelcd-answer"] = "tunnelcd-answer"
FORMAT_VERSION: Literal[1] = 1
Until = Literal["merge"]

Failure = Literal["failed", "merge_refused", "worker_died"]
# Texts go into every table and page: a settings text of a variant has some hundred letters, a traceback some thousand.
MAX_ERROR = 10_000
_Name = Annotated[str, Field(max_length=1_000)]
# Rows of tables hold them as `name version;name version`.
_PackageName = Annotated[str, Field(max_length=1_000, pattern=r"^[^; ]+$")]
_PackageVersion = Annotated[str, Field(max_length=1_000, pattern=r"^[^;]*$")]
_Figures = Annotated[dict[_Name, float], Field(max_length=1_000)]
_Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
_Four = Field(min_length=4, max_length=4)
_Pose = Annotated[list[Annotated[list[float], _Four]], _Four]


class _Part(Settings):
    """Base of the parts: strict types, so text is no number; NaN means not measured."""

    model_config = ConfigDict(strict=True, allow_inf_nan=True)


class ShapePart(_Part):
    """The upright box of an object, metres, and its volume."""

    map_T_box: _Pose
    box_m: _Vector
    volume_m3: float


class ObjectPart(_Part):
    """One object in answer.json; its points are in answer.npz."""

    session: SessionName
    kind: Kind
    region: int = -1
    score: float = 0.0
    partner: int = -1
    shape: ShapePart | None = None
    displacement_map: _Vector | None = None


class SurfaceRegionPart(_Part):
    """One region of rock that moved, came or went in answer.json; its points are in answer.npz."""

    centre_map: _Vector
    area_m2: float
    volume_m3: float
    mean_m: float
    largest_m: float


class FailurePart(_Part):
    """answer.json of a failed or refused case; the base of `AnswerPart`."""

    format: Literal["tunnelcd-answer"]
    format_version: Literal[1]
    status: Literal["ok", Failure]
    method: _Name
    until: Until | None = None
    error: str = Field("", max_length=MAX_ERROR)
    seconds: _Figures = Field(default_factory=dict)
    evidence: _Figures = Field(default_factory=dict)
    config: dict[str, Any] = Field(default_factory=dict)
    checkpoints: dict[_Name, _Name] = Field(default_factory=dict, max_length=100)
    extras: dict[_PackageName, _PackageVersion] = Field(default_factory=dict, max_length=100)
    # fields of an answer are allowed and ignored
    before_T_after: Any = None
    radius_m: Any = None
    objects: Any = None
    surface_regions: Any = None


class AnswerPart(FailurePart):
    """answer.json of a case with an answer."""

    before_T_after: _Pose
    radius_m: PositiveFloat = float("nan")  # left out where answer.npz has that of each region
    objects: list[ObjectPart] = Field(default_factory=list)
    surface_regions: list[SurfaceRegionPart] = Field(default_factory=list)


# Arrays of answer.npz: R candidates, O objects, Kb before and Ka after keyframes, M returns, P points,
# Q points of the surface.
_SHAPES: dict[str, tuple[str | int, ...]] = {
    "region_centres_map": ("R", 3), "region_scores": ("R",), "region_pairs": ("R", 2), "region_is_reported": ("R",),
    "region_is_withdrawn": ("R",), "region_is_forced": ("R",), "region_direction": ("R",), "keyframe_scores": ("Kb",),
    "region_proposed_centres_map": ("R", 3), "region_radii_m": ("R",),
    "before_keyframe_scans": ("Kb",), "after_keyframe_scans": ("Ka",), "object_returns": ("M", 2),
    "object_return_offsets": ("O + 1",), "object_points_map": ("P", 3), "object_point_offsets": ("O + 1",),
    "object_points_odom": ("P", 3), "object_point_odom_offsets": ("O + 1",), "local_before_T_after": ("Ka", 4, 4),
    "surface_points_map": ("Q", 3), "surface_normals_map": ("Q", 3), "surface_displacement_m": ("Q",),
    "surface_level_m": ("Q",), "surface_region": ("Q",), "surface_chainage_m": ("Q",), "surface_angle_deg": ("Q",),
}  # fmt: skip
_REQUIRED = ("region_centres_map", "region_scores")
SURFACE_UNROLLED = ("surface_chainage_m", "surface_angle_deg")
SURFACE = tuple(name for name in _SHAPES if name.startswith("surface_") and name not in SURFACE_UNROLLED)
OFFSETS = {
    "object_returns": "object_return_offsets",
    "object_points_map": "object_point_offsets",
    "object_points_odom": "object_point_odom_offsets",
}
_MASKS = ("region_is_reported", "region_is_withdrawn", "region_is_forced")
_SCANS = ("before_keyframe_scans", "after_keyframe_scans")
_MOST_SCANS = 1e9
_FIGURE = "figure_"
_MOST_TOLD = 100


def check_document(path: Path, value: Any) -> AnswerPart | FailurePart:
    """Return the checked content of answer.json.

    Raises:
        InputError: One line for each mistake.
    """
    document = Document(str(path), value)
    is_failure = isinstance(value, dict) and value.get("status") in get_args(Failure)
    return validate(FailurePart if is_failure else AnswerPart, document)


def check_array_types(path: Path, arrays: Mapping[str, ArrayType], n_objects: int) -> None:
    """Check names, types, shapes and completeness of the arrays of answer.npz, before any is read.

    Raises:
        InputError: One line for each mistake.
    """
    mistakes: list[str] = []
    for name, array in arrays.items():
        if len(mistakes) == _MOST_TOLD:
            break
        shape = ("R",) if name.startswith(_FIGURE) else _SHAPES.get(name)
        if shape is None:
            near = suggest(name, _SHAPES) or f" (known: {', '.join(_SHAPES)})"
            mistakes.append(f"array {name[:200]} is unknown{near}")
        elif array.dtype.kind not in ("b" if name in _MASKS else "biuf"):
            wanted = "true or false" if name in _MASKS else "numbers"
            mistakes.append(f"array {name}: expected {wanted}, got {array.dtype}")
        elif array.ndim != len(shape) or array.shape[1:] != shape[1:]:
            mistakes.append(f"array {name} must be {_format_shape(shape)}, got {array.shape}")
    needed = [*_REQUIRED, *(OFFSETS[name] for name in OFFSETS if name in arrays)]
    needed += SURFACE if any(name in arrays for name in (*SURFACE, *SURFACE_UNROLLED)) else []
    mistakes += [
        f"array {name} is missing: expected {_format_shape(_SHAPES[name])}" for name in needed if name not in arrays
    ]
    if n_objects and "object_returns" not in arrays and "object_points_odom" not in arrays:
        mistakes.append(
            f"array object_points_odom is missing: the {n_objects} objects of answer.json need their points, (P, 3), "
            "or their object_returns, (M, 2)"
        )
    if "object_returns" in arrays and "object_points_odom" in arrays:
        mistakes.append("arrays object_returns and object_points_odom both say which points changed: leave one out")
    _raise_all(path, mistakes)


def check_offsets(path: Path, arrays: Mapping[str, npt.NDArray[Any]], n_objects: int) -> None:
    """Check that the offsets of answer.npz cut the points and returns into those of each object.

    Raises:
        InputError: One line for each mistake.
    """
    mistakes: list[str] = []
    for name, offsets in OFFSETS.items():
        if name in arrays:
            mistakes += _offset_mistakes(offsets, arrays[offsets], name, len(arrays[name]), n_objects)
    _raise_all(path, mistakes)


def take_scans(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays with the scans of keyframes as whole numbers, which some programs write as 3.0.

    Raises:
        InputError: One line for each array of other numbers.
    """
    found, mistakes = dict(arrays), []
    for name in _SCANS:
        scans = arrays.get(name)
        if scans is None or np.issubdtype(scans.dtype, np.integer):
            continue
        is_whole = scans.dtype.kind == "f" and (np.abs(scans) <= _MOST_SCANS) & (scans == np.round(scans))
        if np.all(is_whole):
            found[name] = scans.astype(np.int64)
        else:
            mistakes.append(f"array {name}: expected the whole numbers of scans, from 0 on, got {scans.dtype}")
    _raise_all(path, mistakes)
    return found


def _raise_all(path: Path, mistakes: Sequence[str]) -> None:
    if mistakes:
        raise InputError("\n".join(f"{path}: {mistake}" for mistake in mistakes))


def _offset_mistakes(name: str, offsets: npt.NDArray[Any], values: str, n_values: int, n_objects: int) -> list[str]:
    if not np.issubdtype(offsets.dtype, np.integer):
        return [f"array {name}: expected whole numbers, got {offsets.dtype}"]
    if len(offsets) != n_objects + 1:
        return [f"{name} has {len(offsets)} entries for {n_objects} objects: expected {n_objects + 1}"]
    if offsets[0] != 0 or (np.diff(offsets.astype(np.int64)) < 0).any() or offsets[-1] != n_values:
        rows = f"{n_values}, the rows of {values}"
        return [f"{name} goes from {offsets[0]} to {offsets[-1]}: expected rising from 0 to {rows}"]
    return []


def _format_shape(shape: tuple[str | int, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
