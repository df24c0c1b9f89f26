"""zip archives: their members as the directory lists them, after checking that nothing is hidden or too large.

The directory at the end of a zip archive is the only place that says how many members there are: a few flipped bits in
it drop a member without a word. Therefore members must follow one another without a gap from the first byte of the file
to the directory, and the directory must reach to the end of the file.
"""

from __future__ import annotations

import errno
import io
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError

# Deflate shrinks zeros a thousandfold: what a file may expand to is bounded by its own size.
_SMALL_BYTES = 128 << 20
_MAX_RATIO = 8
# A directory is parsed before its members are looked at: a member takes 46 bytes there at least, and 800 in memory.
_MOST_DIRECTORY_BYTES = 16 << 20
_LOCAL_HEADER = struct.Struct("<4s5H3L2H")
_END = struct.Struct("<4s4H2LH")
_LOCATOR, _RECORD = struct.Struct("<4sLQL"), struct.Struct("<4sQ2H2L4Q")
_IN_ZIP64_RECORD = 0xFFFF
_HAS_DESCRIPTOR = 0x08
_DESCRIPTOR_BYTES = (12, 16, 20, 24)  # checksum and both sizes, of 32 or 64 bits, with or without a signature
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@contextmanager
def opened_zip(
    path: Path, n_bytes: int, expected: str
) -> Iterator[tuple[zipfile.ZipFile, Mapping[str, zipfile.ZipInfo]]]:
    """Yield an archive and its members by name.

    Args:
        path: The file.
        n_bytes: Its size.
        expected: What the file should be, at the end of the message.

    Raises:
        InputError: Whatever a damaged archive provokes, here or in the block, on one line.
        OSError: The disk does not give or take what it is asked for.
    """
    try:
        with path.open("rb") as file, open_archive(file, n_bytes) as archive:
            yield archive, list_members(file, archive, n_bytes)
    except Exception as error:  # zipfile and zlib let through whatever a damaged file provokes
        # a damaged directory may lead to before the start of the file
        is_of_disk = isinstance(error, OSError) and error.errno != errno.EINVAL
        if is_of_disk or isinstance(error, InputError):
            raise
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: {said:.300}: {expected}") from error


def open_archive(file: IO[bytes], n_bytes: int) -> zipfile.ZipFile:
    """Return an open file as an archive, after checking that its directory is no larger than can be parsed.

    Raises:
        ValueError: It is larger, or not at the end of a large file.
        zipfile.BadZipFile: It is damaged.
    """
    if n_bytes > _MOST_DIRECTORY_BYTES and _directory_bytes(file) > _MOST_DIRECTORY_BYTES:
        raise ValueError(f"its directory takes more than {_MOST_DIRECTORY_BYTES >> 20} MB")
    return zipfile.ZipFile(file)


def _directory_bytes(file: IO[bytes]) -> int:
    """Return the size of the directory of a large archive as its end tells it."""
    end = file.seek(-_END.size, io.SEEK_END)
    signature, *_, n_bytes, _, n_comment = _END.unpack(file.read(_END.size))
    if signature != b"PK\x05\x06" or n_comment:
        raise ValueError("its directory is not at its end")
    file.seek(end - _LOCATOR.size)
    signature, _, start, _ = _LOCATOR.unpack(file.read(_LOCATOR.size))
    if signature == b"PK\x06\x07":  # an archive of 64 bits: the record lies there, or right before, as readers differ
        for place in (start, end - _LOCATOR.size - _RECORD.size):
            file.seek(place)
            signature, *_, size, _ = _RECORD.unpack(file.read(_RECORD.size))
            n_bytes = max(n_bytes, size) if signature == b"PK\x06\x06" else n_bytes
    return int(n_bytes)


def list_members(file: IO[bytes], archive: zipfile.ZipFile, n_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Return the members by name, after checking that they and the directory are the whole file.

    Args:
        file: The open file.
        archive: The same, as `zipfile` opened it.
        n_bytes: Its size.

    Raises:
        ValueError: Bytes belong to no member, members would expand too far, or two have one name.
    """
    members = archive.infolist()
    file.seek(-_END.size, io.SEEK_END)
    signature, _, _, n_here, n_all, _, _, n_comment = _END.unpack(file.read(_END.size))
    if signature != b"PK\x05\x06" or n_comment or {n_here, n_all} - {len(members), _IN_ZIP64_RECORD}:
        raise ValueError(f"its directory lists {len(members)} members and counts {n_all}")
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
    found = {member.filename: member for member in members}
    if len(found) < len(members):
        raise ValueError("two members have one name")
    return found


def read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[np.uint8]:
    """Return the bytes of a member that `list_members` returned; its checksum is compared at its end.

    Raises:
        ValueError: It is compressed by another method than deflate, or ends early.
    """
    if member.compress_type not in _METHODS:
        raise ValueError(f"{member.filename} is compressed by a method that is not read")
    content = np.empty(member.file_size, dtype=np.uint8)
    with archive.open(member) as file:
        n_read = cast(io.BufferedIOBase, file).readinto(content.data)
    if n_read != member.file_size:
        raise ValueError(f"{member.filename} ends after {n_read} of {member.file_size} bytes")
    return content


def _require_adjacent(end: int, begin: int, allowed_gaps: set[int]) -> None:
    if begin - end not in allowed_gaps:
        raise ValueError(f"its directory says nothing of bytes {end} to {begin}: a member may be lost")
