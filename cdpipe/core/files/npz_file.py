"""npz: arrays in a zip archive, read whole or not at all; nothing is unpickled.

The directory at the end of a zip archive is the only place that says how many members there are: a few flipped bits in
it drop an array without a word. Therefore members must follow one another without a gap from the first byte of the file
to the directory, and the directory must reach to the end of the file.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.files.array_spec import ArrayType, Expected, check_types, check_values
from cdpipe.core.files.plain_file import require_plain_file

# Deflate shrinks zeros a thousandfold: what a file may expand to is bounded by its own size.
_SMALL_BYTES = 128 << 20
_MAX_RATIO = 8
_LOCAL_HEADER = struct.Struct("<4s5H3L2H")
_END = struct.Struct("<4s4H2LH")
_IN_ZIP64_RECORD = 0xFFFF
_HAS_DESCRIPTOR = 0x08
_DESCRIPTOR_BYTES = (12, 16, 20, 24)  # checksum and both sizes, of 32 or 64 bits, with or without a signature
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
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
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            members = _list_members(file, archive, n_bytes)
            contents = {name: _read_member(archive, member) for name, member in members.items()}
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


def _list_members(file: IO[bytes], archive: zipfile.ZipFile, n_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Return the members by the name of their array, after checking that they and the directory are the whole file."""
    members = archive.infolist()
    file.seek(-_END.size, io.SEEK_END)
    signature, _, _, n_here, n_all, _, _, n_comment = _END.unpack(file.read(_END.size))
    if signature != b"PK\x05\x06" or n_comment or {n_here, n_all} - {len(members), _IN_ZIP64_RECORD}:
        raise ValueError(f"its directory lists {len(members)} arrays and counts {n_all}")
    end, allowed_gaps = 0, {0}
    for member in sorted(members, key=lambda member: member.header_offset):
        _require_adjacent(end, member.header_offset, allowed_gaps)
        file.seek(member.header_offset)
        _, _, flags, *_, n_name, n_extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        end = member.header_offset + _LOCAL_HEADER.size + n_name + n_extra + member.compress_size
        allowed_gaps = {0, *_DESCRIPTOR_BYTES} if flags & _HAS_DESCRIPTOR else {0}
    _require_adjacent(end, archive.start_dir, allowed_gaps)
    expanded = sum(member.file_size for member in members)
    if expanded > _SMALL_BYTES + _MAX_RATIO * n_bytes:
        raise ValueError(f"{n_bytes} bytes would expand to {expanded}")
    names = [member.filename for member in members]
    if len(set(names)) < len(names) or not all(name.endswith(".npy") for name in names):
        raise ValueError("its members are not arrays, each with a name of its own")
    return {name.removesuffix(".npy"): member for name, member in zip(names, members, strict=True)}


def _require_adjacent(end: int, begin: int, allowed_gaps: set[int]) -> None:
    if begin - end not in allowed_gaps:
        raise ValueError(f"its directory says nothing of bytes {end} to {begin}: an array may be lost")


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[np.uint8]:
    """Return the bytes of a member; its checksum is compared at its end."""
    if member.compress_type not in _METHODS:
        raise ValueError(f"{member.filename} is compressed by a method that npz files do not use")
    content = np.empty(member.file_size, dtype=np.uint8)
    with archive.open(member) as file:
        n_read = cast(io.BufferedIOBase, file).readinto(content.data)
    if n_read != member.file_size:
        raise ValueError(f"{member.filename} ends after {n_read} of {member.file_size} bytes")
    return content


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
