"""Shards: the training data of one tunnel in one safetensors file.

The metadata of the file has one entry, `tunnelcd`: a JSON object with family, seed, split, the digest of all inputs,
and the values that are no arrays (`about`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from safetensors.numpy import save

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, parse_json, read_tensors, require_format

FORMAT = "tunnelcd-dataset"
FORMAT_VERSION = 1
SUFFIX = ".safetensors"
CHANGE_KINDS = ("added", "removed", "moved", "reshaped")
Split = Literal["train", "validation", "test", "unused"]


@dataclass(frozen=True, slots=True)
class Field:
    """One array of a shard.

    Attributes:
        name: Name in the file.
        shape: Axes: K before keyframes (the anchors), J after keyframes, C changes, D draws, R x W range image of a
            scan, I image of the map (one or more axes), V x U pixels of that image.
        dtype: numpy name of the type.
        unit: Unit of the values, or "".
        frame: Frame of the values, or "".
        meaning: Description.
    """

    name: str
    shape: str
    dtype: str
    unit: str
    frame: str
    meaning: str


FIELDS = (
    Field("before_scans", "K", "int64", "", "", "revolution of each before keyframe"),
    Field("after_scans", "J", "int64", "", "", "revolution of each after keyframe"),
    Field("before_stamps_ns", "K", "int64", "ns", "", "time of its first return since the session's start"),
    Field("after_stamps_ns", "J", "int64", "ns", "", "the same of the after keyframes"),
    Field("before_world_T_keyframe", "K,4,4", "float64", "m", "world", "true pose of the sensor"),
    Field("after_world_T_keyframe", "J,4,4", "float64", "m", "world", "true pose of the sensor"),
    Field("before_odom_T_keyframe", "K,4,4", "float64", "m", "before odom", "poses as believed"),
    Field("after_odom_T_keyframe", "J,4,4", "float64", "m", "after odom", "poses as believed"),
    Field("before_ranges_m", "K,R,W", "float16", "m", "sensor", "range image of the scan, 0 where nothing returned"),
    Field("after_ranges_m", "J,R,W", "float16", "m", "sensor", "the same of the after keyframes"),
    Field("before_images", "K,I", "float32", "m", "anchor", "before map, in the anchors' frames by path and gravity"),
    Field("after_images", "D,K,I", "float32", "m", "anchor", "after map, merged by the truth and off by a draw, there"),
    Field("before_labels", "K,V,U", "uint8", "", "", "id of the change whose returns are in the pixel, 0 for none"),
    Field("after_labels", "D,K,V,U", "uint8", "", "", "the same of each after image"),
    Field("before_visible", "K,C", "int32", "pixels", "", "pixels of the before image that bear each change"),
    Field("after_visible", "D,K,C", "int32", "pixels", "", "pixels of each after image that bear each change"),
    Field("labels", "K", "int8", "", "", "1 near an observable change, 0 far from all, -1 left out"),
    Field("is_covered", "K", "bool", "", "", "whether an after keyframe stands within 5 m"),
    Field("nearest_after", "K", "int64", "", "", "after keyframe that truly stands nearest"),
    Field("nearest_m", "K", "float64", "m", "world", "how far off it stands"),
    Field("nearest_yaw_rad", "K", "float64", "rad", "world", "its heading minus the before keyframe's, in (-pi, pi]"),
    Field("change_ids", "C", "int64", "", "", "id of each change, 1 to C"),
    Field("change_session", "C", "uint8", "", "", "session that holds its returns: 0 before, 1 after"),
    Field("change_kind", "C", "uint8", "", "", "0 added, 1 removed, 2 moved, 3 reshaped"),
    Field("change_is_partial", "C", "bool", "", "", "group partial: moved by less than its length, or reshaped"),
    Field("change_is_observable", "C", "bool", "", "", "whether it counts"),
    Field("change_n_cells", "C", "int64", "cells", "", "0.1 m cells of its session that its truth fills"),
    Field("change_centroid_world", "C,3", "float64", "m", "world", "centroid of these cells"),
    Field("change_centroid_odom", "C,3", "float64", "m", "before odom", "the same through the nearest before keyframe"),
    Field("draw_shift_m", "D,3", "float64", "m", "before odom", "merge error of each draw: shift; draw 0 has none"),
    Field("draw_turn_rad", "D,3", "float64", "rad", "before odom", "and turn about the anchor, a rotation vector"),
)  # fmt: skip

_MAY_BE_UNDEFINED = ("nearest_m", "nearest_yaw_rad", "change_centroid_world", "change_centroid_odom")
_SPECS = {
    field.name: ArraySpec(field.shape.replace("I", "..."), field.dtype, is_finite=field.name not in _MAY_BE_UNDEFINED)
    for field in FIELDS
}
_REMEDY = "remove it, and run the command that made the folder again"


def split_of(seed: int) -> Split:
    """Return the split of a seed."""
    if seed < 10_000:
        return "train"
    if seed < 20_000:
        return "validation"
    return "test" if seed < 900_000 else "unused"


def encode_shard(arrays: Mapping[str, npt.NDArray[Any]], about: Mapping[str, Any]) -> bytes:
    """Return the bytes of a shard; equal content gives equal bytes.

    Raises:
        ValueError: The arrays are not those of `FIELDS`, in name, number of axes or type.
    """
    if list(arrays) != [field.name for field in FIELDS]:
        raise ValueError(f"a shard holds {[field.name for field in FIELDS]}, in that order, got {list(arrays)}")
    for field in FIELDS:
        if arrays[field.name].dtype != field.dtype:
            raise ValueError(f"{field.name} must be {field.dtype}, got {arrays[field.name].dtype}")
    text = json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **about}, sort_keys=True)
    # a single entry, because safetensors writes several in no fixed order
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, {"tunnelcd": text})


def read_about(path: Path) -> dict[str, Any]:
    """Read only the metadata of a shard.

    Raises:
        InputError: It is missing, damaged, or of another format.
    """
    return _read(path, ())[1]


def read_shard(path: Path, names: tuple[str, ...] = ()) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Read the named arrays of a shard, by default all, and its metadata.

    Raises:
        InputError: It is missing, damaged, of another format, or has no array of a name.
    """
    for name in names:
        if name not in _SPECS:
            raise InputError(f"{path}: holds no {name}: expected one of {', '.join(sorted(_SPECS))}")
    return _read(path, names or tuple(_SPECS))


def _read(path: Path, names: tuple[str, ...]) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    arrays, metadata = read_tensors(path, _SPECS, names, remedy=_REMEDY)
    try:
        about = parse_json(metadata["tunnelcd"])
        found = about["format"], about["format_version"]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a shard of `tunnelcd dataset`: {_REMEDY}") from error
    require_format(path, found, FORMAT, FORMAT_VERSION, _REMEDY)
    return arrays, about
