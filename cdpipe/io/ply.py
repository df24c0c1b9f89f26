"""Read the vertices of a PLY file, ascii or binary, with any other properties and elements; write points.

General mesh readers do not fit scans: meshio rejects the `camera` element that PCL writes, fails on some ascii files
and accepts truncated ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes
from cdpipe.core.geometry import Float64Array

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
# Kind of an array -> its word in a header, and its bytes.
_WRITTEN = {"f": ("float", "<f4"), "i": ("int", "<i4"), "u": ("uint", "<u4")}
_N_WORDS = {"format": 3, "element": 3, "property": 3}
_MAX_HEADER_BYTES = 1 << 16
_BLOCK = 10_000


@dataclass(frozen=True, slots=True)
class _Header:
    encoding: str
    n_vertices: int
    properties: tuple[tuple[str, str], ...]
    size: int


def read_ply_points(path: Path) -> Float64Array:
    """Read the (N, 3) vertices of a PLY file, in file order and in the file's unit.

    Raises:
        InputError: The file is missing, not PLY, cut short, or its vertices have no x, y, z.
    """
    return read_ply(path)[0]


def read_ply(path: Path, scalars: Sequence[str] = ()) -> tuple[Float64Array, dict[str, Float64Array]]:
    """Read the (N, 3) vertices of a PLY file, and those of the named properties (N,) that it has, by their names.

    Args:
        path: The file.
        scalars: Names of properties, in lower case; those of the file may have capitals.

    Raises:
        InputError: As `read_ply_points`.
    """
    content = read_bytes(path)
    try:
        header = _parse_header(content)
        found = {name.lower(): name for name, _ in header.properties if name.lower() in scalars}
        columns = _vertices(content, header, ["x", "y", "z", *found.values()])
    except (OverflowError, ValueError) as error:
        raise InputError(f"{path}: not a readable PLY scan: {error}") from error
    return columns[:, :3].copy(), {name: columns[:, 3 + index].copy() for index, name in enumerate(found)}


def write_ply_points(path: Path, points: Float64Array, scalars: Mapping[str, npt.NDArray[Any]] | None = None) -> None:
    """Write (N, 3) points and (N,) scalars of each, as 32-bit numbers."""
    columns = {**dict(zip("xyz", points.T, strict=True)), **(scalars or {})}
    types = {name: _WRITTEN[values.dtype.kind] for name, values in columns.items()}
    vertices = np.empty(len(points), dtype=[(name, code) for name, (_, code) in types.items()])
    for name, values in columns.items():
        vertices[name] = values
    properties = "".join(f"property {word} {name}\n" for name, (word, _) in types.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + vertices.tobytes())


def _parse_header(content: bytes) -> _Header:
    if content[:3] != b"ply":
        raise ValueError('it does not begin with "ply"')
    end = content.find(b"end_header", 0, _MAX_HEADER_BYTES)
    newline = content.find(b"\n", end)
    if end < 0 or newline < 0:
        raise ValueError("its header has no end_header")
    encoding, elements, properties = "", 0, []
    n_vertices = -1
    for line in content[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        keyword = words[0] if words else ""
        if len(words) < _N_WORDS.get(keyword, 0):
            raise ValueError(f"its header line {line.strip()!r} is cut short")
        if keyword == "format":
            encoding = words[1]
        elif keyword == "element":
            elements += 1
            if elements == 1 and words[1] == "vertex":
                n_vertices = int(words[2])
        elif keyword == "property" and elements == 1:
            if words[1] not in _TYPES:
                raise ValueError(f'vertices with a property of type "{words[1]}" are not supported')
            properties.append((words[2], _TYPES[words[1]]))
    if encoding not in _BYTE_ORDERS:
        raise ValueError(f'unknown format "{encoding}"')
    if n_vertices < 0:
        raise ValueError('its first element is not "vertex"')
    if not {"x", "y", "z"} <= {name for name, _ in properties}:
        raise ValueError("its vertices have no x, y and z")
    return _Header(encoding, n_vertices, tuple(properties), newline + 1)


def _vertices(content: bytes, header: _Header, wanted: Sequence[str]) -> Float64Array:
    """Return the wanted properties (N, P) of all vertices."""
    if header.n_vertices > len(content):
        told = f"{header.n_vertices:.3g}" if header.n_vertices > 10**12 else str(header.n_vertices)
        raise ValueError(f"{told} vertices are announced in a file of {len(content)} bytes: it is damaged or cut short")
    names = [name for name, _ in header.properties]
    if header.encoding == "ascii":
        lines = content[header.size :].split(b"\n", header.n_vertices)[: header.n_vertices]
        columns = [names.index(name) for name in wanted]
        n_found, parts = 0, [np.zeros((0, len(wanted)))]
        # in blocks: a word as an object takes ten times its bytes
        for start in range(0, len(lines), _BLOCK):
            rows = [row for row in map(bytes.split, lines[start : start + _BLOCK]) if len(row) == len(names)]
            n_found += len(rows)
            parts.append(
                np.array([[row[c] for c in columns] for row in rows], dtype=np.float64).reshape(-1, len(wanted))
            )
        if n_found == header.n_vertices:
            return np.concatenate(parts)
    else:
        order = _BYTE_ORDERS[header.encoding]
        dtype = np.dtype([(f"{index}", order + kind) for index, (_, kind) in enumerate(header.properties)])
        n_found = (len(content) - header.size) // dtype.itemsize
        if n_found >= header.n_vertices:
            table = np.frombuffer(content, dtype, header.n_vertices, header.size)
            with np.errstate(invalid="ignore"):  # a NaN that signals; readers refuse any
                return np.column_stack([table[f"{names.index(name)}"] for name in wanted]).astype(np.float64)
    raise ValueError(f"{header.n_vertices} vertices are announced, {n_found} are there: it is damaged or cut short")
