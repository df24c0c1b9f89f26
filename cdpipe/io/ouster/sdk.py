"""Calls of the vendor's SDK on foreign recordings; they run in a process of their own (`cdpipe.core.isolated_reader`).

A damaged file with correct checksums can crash the SDK, which follows its offsets wherever they lead. These functions
hand over what the SDK reads, and `cdpipe.io.ouster.captures` checks it.
"""

# ruff: noqa: PLC0415 - the vendor's SDK is an extra, and everybody else must be able to import this

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.isolated_reader import Message

CHANNELS = ("RANGE", "REFLECTIVITY", "SIGNAL")
SECOND = "2"  # ends the name of a channel of second returns
# Exceptions of the SDK for a faulty file; C++ exceptions arrive as any of these.
_SDK_ERRORS = (OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError)


def require_sdk() -> Any:
    """Import the vendor's SDK and return its module `core`.

    Raises:
        InputError: It is not installed.
    """
    try:
        from ouster.sdk import core
    except ImportError as error:
        raise InputError("OSF and PCAP need the vendor's SDK: pip install 'tunnelcd[ouster]'") from error
    core.init_logger("off")  # the SDK also raises what it logs
    return core


def one_line(error: BaseException) -> str:
    """Return the text of an error of the SDK or the disk on one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())


def describe_osf(path: str) -> Iterator[Message]:
    """Yield the sensor of an OSF file: see `_describe`; `n_revolutions` is the number the file states."""
    require_sdk()
    from ouster.sdk import osf

    with _reads(path), closing(osf.OsfFrameSetSource(path)) as source:
        infos, n_revolutions = list(source.sensor_info), len(source)
        documents = [json.loads(info.to_json_string()) for info in infos]
    if len(infos) != 1:
        sensors = ", ".join(f"{info.prod_line} {info.sn}" for info in infos) or "none"
        raise InputError(f"{path}: expected the recording of one sensor, it holds {len(infos)} ({sensors})")
    yield _describe(infos[0]) | {"document": documents[0], "n_revolutions": n_revolutions}, {}


def describe_pcap(path: str, metadata: str) -> Iterator[Message]:
    """Yield the sensor of a PCAP's metadata file: see `_describe`.

    `highest_column` is the highest column number in the packets of the first two revolutions, -1 without a packet.
    """
    core = require_sdk()
    from ouster.sdk import pcap

    info = _sensor_info(metadata)
    layout = core.PacketFormat.from_info(info)
    n_looked_at = 2 * info.format.columns_per_frame // max(layout.columns_per_packet, 1)
    highest = -1
    with _reads(path), closing(pcap.PcapPacketSource(path, sensor_info=[info])) as source:
        for _, packet in source:
            if isinstance(packet, core.LidarPacket):
                highest = max(highest, int(layout.packet_header(core.ColHeader.MEASUREMENT_ID, packet.buf).max()))
                n_looked_at -= 1
            if n_looked_at <= 0:
                break
    sizes = {"packet_bytes": int(layout.lidar_packet_size), "n_packets": info.format.lidar_packets_per_frame()}
    yield _describe(info) | sizes | {"highest_column": highest}, {}


def read_frames(path: str, metadata: str | None) -> Iterator[Message]:
    """Yield each revolution of a recording, and at the end a message without arrays.

    The arrays of a revolution are its channels (H, W) among `CHANNELS` and those of second returns, `status` and
    `timestamp` (W,), and `body_to_world` (W, 4, 4); `fields` names all channels of the file. The last message has the
    number of revolutions that an OSF states, or the number of packets of a PCAP that look like another Ouster's.
    """
    require_sdk()
    from ouster.sdk import osf, pcap

    with _reads(path):
        source: Any
        if metadata is None:
            source = osf.OsfFrameSetSource(path)
        else:
            source = pcap.PcapFrameSetSource(path, sensor_info=[_sensor_info(metadata)])
    with closing(source):
        with _reads(path):
            for frames in source:
                if frames[0] is not None:
                    yield {"fields": list(frames[0].fields)}, _arrays(frames[0])
        if metadata is None:
            yield {"n_stated": len(source)}, {}
        else:
            yield {"n_other": source.size_error_count + source.id_error_count}, {}


def _arrays(frame: Any) -> dict[str, Any]:
    names = [*CHANNELS, *(name + SECOND for name in CHANNELS)]
    arrays = {name: frame.field(name) for name in names if frame.has_field(name)}
    arrays |= {"status": frame.status, "timestamp": frame.timestamp}
    return arrays | {"body_to_world": np.asarray(frame.body_to_world, dtype=np.float64)}


def _describe(info: Any) -> dict[str, Any]:
    """Return pose of the sensor in the body frame (4, 4), and the number of columns that a revolution sends."""
    return {"sensor_to_body": np.asarray(info.sensor_to_body).tolist(), "window": info.format.valid_columns_per_frame()}


def _sensor_info(metadata: str) -> Any:
    try:
        return require_sdk().SensorInfo(Path(metadata).read_text(encoding="utf-8"))
    except _SDK_ERRORS as error:
        raise InputError(f"{metadata}: the vendor's SDK does not take it: {one_line(error)}") from error


@contextmanager
def _reads(path: str) -> Iterator[None]:
    try:
        yield
    except _SDK_ERRORS as error:
        raise InputError(f"{path}: the vendor's SDK cannot read it: {one_line(error)}") from error
