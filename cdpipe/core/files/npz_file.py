"""npz: arrays in a zip archive, read whole or not at all; nothing is unpickled."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.files.array_spec import ArrayType, Expected, check_types, check_values
from cdpipe.core.files.plain_file import require_plain_file
from cdpipe.core.files.zip_file import list_members, open_archive, read_member

_MAX_HEADER_BYTES = 2048  # of plain arrays: numpy writes 128
_MAX_AXIS = 2**40
_KINDS = "biufU"


def read_npz(
    path: Path, expected: Expected, *, lengths: Mapping[str, int] | None = None, remedy: str = ""
) -> dict[str, npt.NDArray[Any]]:
    """Read the arrays of an npz file.

    Args:
        path: The file.
        expected: What it may hold.
        remedy: What to do about a damaged file, at the end of the message.
        lengths: The lengths of axes that are known already, by letter of `ArraySpec.shape`.

    Returns:
        The arrays by name, in the order of the file, of the machine's byte order; they can be written to.

    Raises:
        InputError: The file is missing, cut short, damaged, no npz of plain arrays, or holds other arrays than
            expected.
    """
    n_bytes = require_plain_file(path, expected=remedy)
    end = f": {remedy}" if remedy else ""
    try:
        with path.open("rb") as file, open_archive(file, n_bytes) as archive:
            members = _list_arrays(file, archive, n_bytes)
            contents = {name: read_member(archive, member) for name, member in members.items()}
        types = {name: _parse_header(name, content) for name, content in contents.items()}
    except Exception as error:  # zipfile, zlib and numpy let through whatever a damaged file provokes
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: unreadable, the file is damaged or cut short ({said:.200}){end}") from error
    try:
        check_types({name: each for name, (each, _, _) in types.items()}, expected, lengths or {})
        arrays = {name: _view(contents[name], *each) for name, each in types.items()}
        check_values(arrays, expected)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: damaged, or not the file expected: {error}{end}") from error
    return arrays


def _list_arrays(file: IO[bytes], archive: zipfile.ZipFile, n_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Return the members by the name of their array."""
    members = list_members(file, archive, n_bytes)
    if not all(name.endswith(".npy") for name in members):
        raise ValueError("its members are not arrays")
    return {name.removesuffix(".npy"): member for name, member in members.items()}


def _parse_header(name: str, content: npt.NDArray[np.uint8]) -> tuple[ArrayType, bool, int]:
    """Return the type of an array, whether its first axis varies fastest, and where its values begin."""
    start = io.BytesIO(content[: _MAX_HEADER_BYTES + 12].tobytes())
    version = np.lib.format.read_magic(start)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"{name[:40]!r} is no plain array")
    shape, is_fortran, dtype = read(start, max_header_size=_MAX_HEADER_BYTES)
    if (
        dtype.kind not in _KINDS
        or dtype.itemsize == 0
        or any(type(n) is not int or not 0 <= n < _MAX_AXIS for n in shape)
    ):
        raise ValueError(f"{name[:40]!r} is no plain array of numbers or text")
    n_declared = math.prod(shape) * dtype.itemsize
    if n_declared != len(content) - start.tell():
        raise ValueError(f"{name[:40]!r} declares {n_declared} bytes and holds {len(content) - start.tell()}")
    return ArrayType(dtype, shape), is_fortran, start.tell()


def _view(content: npt.NDArray[np.uint8], each: ArrayType, is_fortran: bool, begin: int) -> npt.NDArray[Any]:
    flat = content[begin:].view(each.dtype)
    array = flat.reshape(each.shape[::-1]).T if is_fortran else flat.reshape(each.shape)
    return array.astype(array.dtype.newbyteorder("="), copy=False)
