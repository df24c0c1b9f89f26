"""The table of contents of a GLB, read before its meshes are built: a few bytes of it can ask for any memory."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cdpipe.core.files import parse_json

_HEAD = struct.Struct("<5L")  # mark, version, length of the file; length and type of the table
# Views and accessors are copied one by one, and each may be the whole file: all together are bounded by its size.
_SMALL_BYTES = 256 << 20
_MAX_RATIO = 4
_NUMBER_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # by glTF's componentType
_N_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(frozen=True, slots=True)
class GlbCounts:
    """What the meshes of a GLB hold, before any of them is placed.

    Attributes:
        parts: Primitives; a reader makes a mesh of each.
        vertices: Vertices of all primitives; those that several share are counted for each.
        triangles: Triangles of all primitives, three indices each.
    """

    parts: int
    vertices: int
    triangles: int


def count_glb(path: Path) -> GlbCounts:
    """Count what a GLB holds by its table of contents.

    Raises:
        ValueError: The table is damaged, names another file, or asks for far more bytes than the file has. A table of
            another structure may raise AttributeError, LookupError or TypeError.
    """
    n_bytes = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise ValueError("cut short")
        _, _, _, n_table, _ = _HEAD.unpack(head)
        if n_table > n_bytes:
            raise ValueError(f"its table is said to be {n_table} bytes, the file is {n_bytes}")
        table = parse_json(file.read(n_table))
    for buffer in table.get("buffers", []):
        if "base64," not in buffer.get("uri", "base64,"):  # which readers look for
            raise ValueError("a part of it lies in another file: export it as one")
    accessors = table.get("accessors", [])
    n_asked = sum(_natural(view["byteLength"]) for view in table.get("bufferViews", []))
    n_asked += sum(map(_accessor_bytes, accessors))
    if n_asked > _SMALL_BYTES + _MAX_RATIO * n_bytes:
        raise ValueError(f"{n_bytes} bytes would expand to {n_asked}")
    primitives = [each for mesh in table.get("meshes", []) for each in mesh["primitives"]]
    n_vertices = sum(_counts(accessors, (each["attributes"].get("POSITION") for each in primitives)))
    n_indices = sum(_counts(accessors, (each.get("indices") for each in primitives)))
    return GlbCounts(len(primitives), n_vertices, n_indices // 3)


def _accessor_bytes(accessor: Any) -> int:
    n_values = _natural(accessor["count"]) * _N_NUMBERS[accessor["type"]]
    return n_values * _NUMBER_BYTES[accessor["componentType"]]


def _counts(accessors: Any, indices: Iterator[int | None]) -> Iterator[int]:
    return (accessors[index]["count"] for index in indices if index is not None)


def _natural(number: Any) -> int:
    if type(number) is not int or number < 0:
        raise ValueError(f"{number!r:.40} is no whole number")
    return number
