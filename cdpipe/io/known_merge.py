"""A merge that the user knows: the transform of the after session's odom frame into the before session's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.files import parse_json, read_bytes
from cdpipe.core.geometry import Float64Array, make_pose

_EXPECTED = "expected a 4x4 rigid transform, four lines of four numbers or JSON"
_MOST_BYTES = 100_000_000  # an answer.json is one, too
# Largest difference of an entry from the nearest rotation's: files are rounded to six digits.
_ROUNDED = 1e-6


def read_known_merge(path: Path) -> Float64Array:
    """Read a (4, 4) `before_T_after`: four lines of numbers, JSON, or JSON that has it by that name, as answers do.

    Raises:
        InputError: The file is missing, or holds no rigid transform.
    """
    content = read_bytes(path, _MOST_BYTES, _EXPECTED)
    try:
        return require_rigid(_parse(content))
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: {error}: {_EXPECTED}") from error


def require_rigid(matrix: Any) -> Float64Array:
    """Return the exact rigid transform next to a (4, 4) matrix that was perhaps rounded.

    Raises:
        ValueError: It is none to 1e-6.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
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


def _parse(content: bytes) -> Any:
    text = content.decode()
    if text.lstrip()[:1] in ("[", "{"):
        value = parse_json(content)
        return value.get("before_T_after") if isinstance(value, dict) else value
    return [[float(word) for word in line.split()] for line in text.splitlines() if line.strip()]
