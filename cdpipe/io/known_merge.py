"""A merge that is known: the transform of the after session's odom frame into the before session's.

One file holds one transform, or JSON with one transform for the whole path and one at each of some anchors along it:

    {"format": "tunnelcd-merge", "format_version": 1, "source": "truth",
     "before_T_after": [[...], ...], "anchors_odom": [[x, y, z], ...], "before_T_after_at_anchors": [[[...], ...], ...]}
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.files import parse_json, read_bytes, require_format
from cdpipe.core.geometry import Float64Array, make_pose
from cdpipe.io.answer_parts import FORMAT as ANSWER_FORMAT
from cdpipe.model.alignment import PathAlignment

FORMAT, FORMAT_VERSION = "tunnelcd-merge", 1
_EXPECTED = "expected a 4x4 rigid transform, three or four lines of four numbers or JSON"
_MOST_BYTES = 100_000_000  # an answer.json is one, too
_ZERO = (0.0, 0.0, 0.0)
# Largest difference of an entry from the nearest rotation's: files are rounded to six digits.
_ROUNDED = 1e-6


def read_known_merge(path: Path, origins_m: Sequence[Sequence[float]] = (_ZERO, _ZERO)) -> Float64Array:
    """Read a (4, 4) `before_T_after`: lines of numbers, JSON, or JSON that has it by that name, as answers do.

    Args:
        path: The file.
        origins_m: What is subtracted from the positions of the before and of the after session when they are read,
            metres. A file's transform is between the frames without that, an answer's between those that were read.

    Raises:
        InputError: The file is missing, of a newer format, or holds no rigid transform.
    """
    content = read_bytes(path, _MOST_BYTES, _EXPECTED)
    try:
        document = _parse(path, content)
        before_T_after = require_rigid(_matrix_of(document))
        if isinstance(document, dict) and document.get("format") == ANSWER_FORMAT:
            return before_T_after
        before_m, after_m = (np.asarray(each, dtype=np.float64) for each in origins_m)
        before_T_after[:3, 3] += before_T_after[:3, :3] @ after_m - before_m
        return before_T_after
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: {error}: {_EXPECTED}") from error


def read_alignment(path: Path) -> PathAlignment:
    """Read a merge along the path, as `write_alignment` writes it; a file of one transform gives a rigid one.

    Raises:
        InputError: The file is missing, of a newer format, or holds no rigid transforms.
    """
    content = read_bytes(path, _MOST_BYTES, _EXPECTED)
    try:
        document = _parse(path, content)
        if not isinstance(document, dict) or "anchors_odom" not in document:
            return PathAlignment.rigid(require_rigid(_matrix_of(document)))
        anchors = np.asarray(document["anchors_odom"], dtype=np.float64)
        if not np.isfinite(anchors).all():
            raise ValueError("anchors_odom is not finite")
        poses = np.asarray(document.get("before_T_after_at_anchors"), dtype=np.float64)
        return PathAlignment(anchors, poses)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: {error}: {_EXPECTED}") from error


def write_alignment(path: Path, before_T_after: Float64Array, along: PathAlignment, source: str) -> None:
    """Write a merge along the path as JSON that `read_alignment` and `read_known_merge` read.

    Args:
        path: The file.
        before_T_after: (4, 4) transform for the whole path.
        along: The transforms along the path.
        source: What made the merge.
    """
    document = {"format": FORMAT, "format_version": FORMAT_VERSION, "source": source}
    document |= {"before_T_after": before_T_after.tolist(), "anchors_odom": along.anchors_odom.tolist()}
    document |= {"before_T_after_at_anchors": along.before_T_after.tolist()}
    path.write_text(json.dumps(document))


def require_rigid(matrix: Any) -> Float64Array:
    """Return the exact rigid transform next to a (4, 4) matrix, or its upper three rows, that was perhaps rounded.

    The rows may be in one line of twelve numbers, as KITTI writes poses.

    Raises:
        ValueError: It is none to 1e-6.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.size == 12 and matrix.shape != (4, 3):
        matrix = np.vstack([matrix.reshape(3, 4), (0.0, 0.0, 0.0, 1.0)])
    if matrix.shape != (4, 4):
        raise ValueError(f"before_T_after is {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError("before_T_after is not finite")
    u, _, v = np.linalg.svd(matrix[:3, :3])
    rotation = u @ v
    off = float(np.abs(rotation - matrix[:3, :3]).max())
    if off > _ROUNDED or np.linalg.det(rotation) < 0 or (matrix[3] != (0, 0, 0, 1)).any():
        raise ValueError(f"before_T_after is not rigid (the nearest rotation differs by {off:.1g})")
    return make_pose(rotation, matrix[:3, 3])


def _matrix_of(value: Any) -> Any:
    return value.get("before_T_after") if isinstance(value, dict) else value


def _parse(path: Path, content: bytes) -> Any:
    text = content.decode()
    if text.lstrip()[:1] not in ("[", "{"):
        return [[float(word) for word in line.split()] for line in text.splitlines() if line.strip()]
    document = parse_json(content)
    if isinstance(document, dict) and document.get("format") == FORMAT:
        found = FORMAT, document.get("format_version", FORMAT_VERSION)
        require_format(path, found, FORMAT, FORMAT_VERSION, "write it again")
    return document
