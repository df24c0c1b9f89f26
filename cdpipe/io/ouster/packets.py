"""Write a session as PCAP: the UDP packets that the sensor would have sent, and its metadata as .json beside it.

Packets hold ranges, reflectivity, signal and stamps. They hold no poses and nothing that a caller adds.
"""

# ruff: noqa: PLC0415 - the vendor's SDK is an extra, and everybody else must be able to import this

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.progress import Progress
from cdpipe.io.ouster.osf import frame_of, sensor_info
from cdpipe.io.ouster.sdk import one_line, require_sdk
from cdpipe.io.session import Session

_PORT, _IMU_PORT = 7502, 7503


def write_pcap(session: Session, path: Path, metadata: Path, start_ns: int, on_progress: Progress) -> None:
    """Write a session as packets, and its sensor's metadata.

    Args:
        session: The session.
        path: New .pcap.
        metadata: New .json.
        start_ns: Time of the first column, above 0: the SDK takes 0 for a packet without a time.
        on_progress: Called with the stage, the number of finished revolutions and their total.

    Raises:
        InputError: A chunk is damaged, the files cannot be written, or the vendor's SDK is not installed or rejects
            this sensor.
    """
    require_sdk()
    from ouster.sdk import pcap

    info = sensor_info(session)
    info.config.udp_port_lidar, info.config.udp_port_imu = _PORT, _IMU_PORT
    try:
        packets = _packets(session, info, start_ns, on_progress)
        n_written = pcap.record(packets, str(path), lidar_port=_PORT, imu_port=_IMU_PORT)
        metadata.write_text(info.to_json_string(), encoding="utf-8")
        with closing(pcap.PcapPacketSource(str(path), sensor_info=[info])) as source:
            n_there = sum(1 for _ in source)
        if n_there != n_written:  # on a full disk its writer says nothing
            raise OSError(errno.ENOSPC, f"{n_there} of {n_written} packets are there")
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written ({one_line(error)}): give it a disk with room") from error


def _packets(session: Session, info: Any, start_ns: int, report: Progress) -> Iterator[Any]:
    core = require_sdk()
    layout = core.PacketFormat.from_info(info)
    done = 0
    shift_ns = start_ns - session.provenance.get("sensor_clock_start_ns", 0)
    for chunk in session.chunks():
        for row in range(len(chunk.range_mm)):
            frame = frame_of(core, info, session, chunk, {}, row, done)
            frame.timestamp[:] += shift_ns
            frame.packet_timestamp[:] += shift_ns
            yield from core.frame_to_packets(frame, layout, info.init_id, int(info.sn))
            done += 1
            report("write", done, session.n_scans)
