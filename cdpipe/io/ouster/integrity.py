"""Recording integrity: checks of OSF and PCAP files before the vendor's SDK opens them.

The SDK silently drops the end of a truncated file, and a damaged OSF can terminate the process inside the SDK.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from cdpipe.core.errors import InputError

_OSF_MAGIC = b"OSF$"
_OSF_HEADER_BYTES = 56
_PCAP_HEADER_BYTES = 24
_PCAP_RECORD_BYTES = 16
# First four bytes -> byte order of the file; the second pair stamps nanoseconds.
_PCAP_ORDERS = {
    b"\xd4\xc3\xb2\xa1": "<",
    b"\xa1\xb2\xc3\xd4": ">",
    b"\x4d\x3c\xb2\xa1": "<",
    b"\xa1\xb2\x3c\x4d": ">",
}
_PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"
_PCAPNG_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}


def check_osf_integrity(path: Path) -> None:
    """Check the length of an OSF file against its header, and the checksums of header and metadata.

    Raises:
        InputError: It is no OSF file, was never closed, is truncated, or its header or metadata are damaged.
    """
    n_bytes = _size(path)
    with path.open("rb") as file:
        header = file.read(_OSF_HEADER_BYTES)
    if header[8:12] != _OSF_MAGIC:
        raise InputError(f"{path}: not an OSF file: it does not begin as one")
    metadata_at, stated_bytes = _osf_header(header)
    if metadata_at == 0:
        raise InputError(f"{path}: the recording was never finished: its writer was not closed, record it again")
    if n_bytes < stated_bytes:
        raise InputError(f"{path}: cut short: {n_bytes} of {stated_bytes} bytes are there: copy it again")
    if n_bytes > stated_bytes:
        raise InputError(f"{path}: damaged: {n_bytes} bytes where its header says {stated_bytes}: copy it again")
    with path.open("rb") as file:
        for part, at in (("header", 0), ("metadata", metadata_at)):
            if not _is_sound(file, at, n_bytes):
                raise InputError(f"{path}: damaged: its {part} and the checksum of it do not agree: copy it again")


def check_pcap_integrity(path: Path) -> None:
    """Check that a PCAP or PCAPNG file consists of complete packets.

    Raises:
        InputError: It is neither format, holds no packet, or ends inside a packet.
    """
    if _size(path) < _PCAP_HEADER_BYTES:
        raise InputError(f"{path}: not a PCAP file: {_size(path)} bytes are less than its header")
    n_bytes = _size(path)
    with path.open("rb") as file:  # no memory map: a file that is cut meanwhile would end the process by SIGBUS
        head = file.read(12)
        magic, order = head[:4], head[8:]
        if magic in _PCAP_ORDERS:
            end, n_packets = _walk_pcap(file, n_bytes, _PCAP_ORDERS[magic])
        elif magic == _PCAPNG_MAGIC and order in _PCAPNG_ORDERS:
            end, n_packets = _walk_pcapng(file, n_bytes, _PCAPNG_ORDERS[order])
        else:
            raise InputError(f"{path}: neither PCAP nor PCAPNG: it does not begin as one")
    if end != n_bytes:
        raise InputError(
            f"{path}: cut short or damaged after {n_packets} packets: copy it again, or save the whole packets with "
            f"`tcpdump -r {path.name} -w whole.pcap`"
        )
    if n_packets == 0:
        raise InputError(f"{path}: holds no packet")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _osf_header(header: bytes) -> tuple[int, int]:
    """Return the offset of the metadata and the length of the file, in bytes; 0 for a missing field.

    They are the third and fourth field of the flatbuffer table in the header.
    """
    try:
        table = 4 + struct.unpack_from("<I", header, 4)[0]
        fields = table - struct.unpack_from("<i", header, table)[0]
        metadata, length = struct.unpack_from("<HH", header, fields + 8)
        return (
            struct.unpack_from("<Q", header, table + metadata)[0] if metadata else 0,
            struct.unpack_from("<Q", header, table + length)[0] if length else 0,
        )
    except struct.error:
        return 0, 0


def _is_sound(file: BinaryIO, at: int, n_bytes: int) -> bool:
    """Return whether the block at an offset is complete and its CRC-32, over length and content, is correct."""
    if at + 8 > n_bytes:
        return False
    file.seek(at)
    prefix = file.read(4)
    end = at + 4 + int.from_bytes(prefix, "little")
    if end + 4 > n_bytes:
        return False
    return zlib.crc32(prefix + file.read(end - at - 4)) == int.from_bytes(file.read(4), "little")


def _walk_pcap(file: BinaryIO, n_bytes: int, order: str) -> tuple[int, int]:
    """Return the offset of the end of the last complete packet, and the number of packets."""
    at, n_packets, lengths = _PCAP_HEADER_BYTES, 0, struct.Struct(f"{order}I")
    while at + _PCAP_RECORD_BYTES <= n_bytes:
        file.seek(at + 8)
        if len(word := file.read(lengths.size)) < lengths.size:
            break
        end = at + _PCAP_RECORD_BYTES + lengths.unpack(word)[0]
        if end > n_bytes:
            break
        at, n_packets = end, n_packets + 1
    return at, n_packets


def _walk_pcapng(file: BinaryIO, n_bytes: int, order: str) -> tuple[int, int]:
    """Return the offset of the end of the last complete block, and the number of packets."""
    at, n_packets, block = 0, 0, struct.Struct(f"{order}II")
    while at + 12 <= n_bytes:
        file.seek(at)
        if len(head := file.read(block.size)) < block.size:
            break
        kind, n_block = block.unpack(head)
        if n_block < 12 or at + n_block > n_bytes:
            break
        at, n_packets = at + n_block, n_packets + (kind in (3, 6))
    return at, n_packets
