"""safetensors: a length, a JSON table of tensors, and their bytes one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.files.array_spec import ArrayType, Expected, check_types, check_values
from cdpipe.core.files.json_file import parse_json
from cdpipe.core.files.plain_file import require_plain_file

_LENGTH_BYTES = 8
_MAX_TABLE_BYTES = 8 << 20
_MAX_AXES = 32
_DTYPES = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1",
    "U64": "<u8", "U32": "<u4", "U16": "<u2", "U8": "|u1", "BOOL": "|b1",
}  # fmt: skip
_METADATA = "__metadata__"
_Read = Callable[[int, int], npt.NDArray[np.uint8]]  # new bytes of a file, from one place to another


@dataclass(frozen=True, slots=True)
class _Tensor:
    type: ArrayType
    begin: int
    end: int


def read_tensors(
    path: Path, expected: Expected, names: Collection[str] | None = None, *, remedy: str = ""
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, str]]:
    """Read tensors of a safetensors file as arrays; the others are checked by name, type and shape alone.

    Args:
        path: The file.
        expected: What it may hold.
        names: The tensors to read, by default all.
        remedy: What to do about a damaged file, at the end of the message.

    Returns:
        The arrays by name, and the texts of the file's metadata.

    Raises:
        InputError: The file is missing, damaged, or holds other tensors than expected.
    """
    n_bytes = require_plain_file(path, expected=remedy)
    end = f": {remedy}" if remedy else ""
    try:
        if n_bytes < _LENGTH_BYTES:
            raise ValueError("cut short")
        # no memory map: a file that is cut meanwhile would end the process by SIGBUS
        with path.open("rb") as file:
            return _parse(partial(_read_part, file), n_bytes, expected, names)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}){end}") from error
    except ValueError as error:
        raise InputError(f"{path}: damaged ({error}){end}") from error


def parse_tensors(
    content: bytes, expected: Expected, names: Collection[str] | None = None
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, str]]:
    """Return the tensors and the metadata of the bytes of a safetensors file, as `read_tensors`.

    Raises:
        ValueError: They are damaged, or hold other tensors than expected.
    """
    held = np.frombuffer(content, np.uint8)
    return _parse(lambda begin, end: held[begin:end].copy(), len(held), expected, names)


def _read_part(file: BufferedReader, begin: int, end: int) -> npt.NDArray[np.uint8]:
    file.seek(begin)
    content = np.empty(end - begin, np.uint8)
    if file.readinto(content.data) != len(content):
        raise ValueError("cut short while it is read")
    return content


def _parse(
    read: _Read, n_bytes: int, expected: Expected, names: Collection[str] | None
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, str]]:
    tensors, metadata, begin = _parse_table(read, n_bytes)
    check_types({name: tensor.type for name, tensor in tensors.items()}, expected, {})
    arrays = {}
    for name in tensors if names is None else names:
        tensor = tensors[name]
        values = read(begin + tensor.begin, begin + tensor.end).view(tensor.type.dtype)
        arrays[name] = values.astype(tensor.type.dtype.newbyteorder("="), copy=False).reshape(tensor.type.shape)
    check_values(arrays, expected)
    return arrays, metadata


def _parse_table(read: _Read, n_bytes: int) -> tuple[dict[str, _Tensor], dict[str, str], int]:
    """Return the tensors of a file, its metadata, and where its data begins."""
    n_table = int.from_bytes(read(0, min(_LENGTH_BYTES, n_bytes)).tobytes(), "little")
    begin = _LENGTH_BYTES + n_table
    if n_bytes < _LENGTH_BYTES or n_table > _MAX_TABLE_BYTES or begin > n_bytes:
        raise ValueError(f"its table is said to be {n_table} bytes, the file is {n_bytes}")
    table = parse_json(read(_LENGTH_BYTES, begin).tobytes())
    if not isinstance(table, dict):
        raise ValueError("its table is no JSON object")
    metadata = table.pop(_METADATA, {})
    if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
        raise ValueError("its metadata is no table of texts")
    tensors = {name: _parse_tensor(name, entry) for name, entry in table.items()}
    end = 0
    for name, tensor in sorted(tensors.items(), key=lambda item: (item[1].begin, item[1].end)):
        n_declared = math.prod(tensor.type.shape) * tensor.type.dtype.itemsize
        if tensor.begin != end or tensor.end - tensor.begin != n_declared:
            raise ValueError(
                f"{name[:40]!r} declares {n_declared} bytes at {tensor.begin} to {tensor.end}, not at {end}"
            )
        end = tensor.end
    if begin + end != n_bytes:
        raise ValueError(f"its tensors end at byte {begin + end}, the file at {n_bytes}")
    return tensors, metadata, begin


def _parse_tensor(name: str, entry: Any) -> _Tensor:
    try:
        dtype, shape, (begin, end) = np.dtype(_DTYPES[entry["dtype"]]), tuple(entry["shape"]), entry["data_offsets"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name[:40]!r} is no tensor of numbers") from error
    if len(shape) > _MAX_AXES:
        raise ValueError(f"{name[:40]!r} has {len(shape)} axes, more than {_MAX_AXES}")
    if not all(type(number) is int and number >= 0 for number in (*shape, begin, end)):
        raise ValueError(f"{name[:40]!r} has a shape or place that is no whole number")
    return _Tensor(ArrayType(dtype, shape), begin, end)
