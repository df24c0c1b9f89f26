"""Read a sensor recording, OSF or PCAP, revolution by revolution with the vendor's SDK.

The SDK is an extra. It is imported only here and in `cdpipe.io.ouster.osf`, when a recording is opened.
"""

# ruff: noqa: PLC0415 - the vendor's SDK is an extra, and everybody else must be able to import this

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.yamlfile import read_json
from cdpipe.io.ouster.integrity import check_osf_integrity, check_pcap_integrity
from cdpipe.io.readers import RECORDING_SUFFIXES
from cdpipe.sensor.ouster import SensorMetadata, parse_metadata
from cdpipe.sensor.ouster_metadata import METADATA_FILE, require_mode

# A revolution needs more than this share of its columns: a recording starts and ends inside a revolution.
_LEAST_SHARE = 0.5
# Bytes of Ethernet, IP, UDP and PCAP headers per packet, to estimate the number of packets.
_PACKET_OVERHEAD_BYTES = 58
# Called with the stage, the number of finished revolutions, and their (estimated) total.
Progress = Callable[[str, int, int], None]
# Exceptions of the SDK for a faulty file; C++ exceptions arrive as any of these.
SDK_ERRORS = (OSError, RuntimeError, ValueError, LookupError, ArithmeticError)


@dataclass(frozen=True, slots=True, eq=False)
class Revolution:
    """One revolution of a recording.

    Attributes:
        range_mm: (H, W) uint32 staggered range of the first (strongest) return, millimetres; 0 for a miss or a missing
            column.
        reflectivity: (H, W) uint8.
        signal: (H, W) uint16 photons; 0 if the recording has no such channel.
        column_stamps_ns: (W,) int64 sensor clock; interpolated for missing columns.
        is_valid: (W,) whether the column arrived.
        odom_T_column: (W, 4, 4) sensor poses of the recording; undefined for missing columns.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    column_stamps_ns: Int64Array
    is_valid: BoolArray
    odom_T_column: Float64Array


@dataclass(frozen=True, slots=False, eq=False)
class Recording:
    """A recording of one sensor; it can be read several times.

    Attributes:
        path: The file.
        sensor: Its sensor.
        info: The SDK's description of the sensor.
        metadata: The metadata file of a PCAP; None for an OSF, which includes its metadata.
    """

    path: Path
    sensor: SensorMetadata
    info: Any
    metadata: Path | None

    @cached_property
    def n_guessed(self) -> int:
        """Estimated number of revolutions, for progress."""
        if self.metadata is None:
            with closing(_open_source(self)) as source:
                return max(len(source), 1)
        packet_bytes = _packet_bytes(self.info) + _PACKET_OVERHEAD_BYTES
        n_packets = max(self.info.format.lidar_packets_per_frame(), 1)
        return max(self.path.stat().st_size // int(packet_bytes * n_packets), 1)

    def revolutions(self, on_left_out: Callable[[int], object] = lambda number: None) -> Iterator[Revolution]:
        """Read all revolutions with more than half of their columns.

        Args:
            on_left_out: Called with the number of each revolution that is left out.

        Raises:
            InputError: The file is damaged, the clock went backwards, or no revolution qualifies.
        """
        n_kept, n_seen, last_ns = 0, 0, None
        mounting = np.asarray(self.info.sensor_to_body, dtype=np.float64)
        window = max(self.info.format.valid_columns_per_frame(), 1)
        with closing(_open_source(self)) as source:
            for frames in _read_guarded(source, self.path):
                frame = frames[0]
                if frame is None:
                    continue
                n_seen += 1
                if np.count_nonzero(frame.status & 1) <= _LEAST_SHARE * window:
                    on_left_out(n_seen - 1)
                    continue
                revolution = _decode(frame, self.sensor, mounting, f"{self.path}: revolution {n_seen - 1}")
                if last_ns is not None and revolution.column_stamps_ns[0] <= last_ns:
                    raise InputError(
                        f"{self.path}: revolution {n_seen - 1} does not come after the one before it: the sensor's "
                        "clock was set during the recording, cut it there"
                    )
                last_ns = revolution.column_stamps_ns[-1]
                n_kept += 1
                yield revolution
            self._check_end(source, n_seen, n_kept)

    def _check_end(self, source: Any, n_seen: int, n_kept: int) -> None:
        if self.metadata is None and n_seen < len(source):
            raise InputError(f"{self.path}: damaged: {n_seen} of its {len(source)} revolutions can be read")
        if n_kept:
            return
        if n_seen:
            raise InputError(
                f"{self.path}: no whole revolution: of none of its {n_seen} more than half the columns arrived; the "
                f"recording is too short, or was not made in mode {self.sensor.mode}"
            )
        if self.metadata is not None:
            n_other = source.size_error_count + source.id_error_count
            raise InputError(
                f"{self.path}: no lidar packet of the sensor in {self.metadata} ({self.sensor.product}, "
                f"{_packet_bytes(self.info)} bytes each); {n_other or 'none'} of its packets look like another Ouster's"
            )
        raise InputError(f"{self.path}: holds no revolution")


def open_recording(path: Path, metadata: Path | None = None) -> Recording:
    """Open an OSF, or a PCAP with its metadata: `metadata`, or the .json of the same name beside it.

    Raises:
        InputError: A file is missing, truncated or of another kind, the metadata is of another sensor or mode, the OSF
            holds several sensors, or the vendor's SDK is not installed.
    """
    core = require_sdk()
    suffix = path.suffix.lower()
    if suffix not in RECORDING_SUFFIXES:
        raise InputError(f"{path}: expected a recording, {', '.join(RECORDING_SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}: expected a recording")
    if suffix == ".osf":
        if metadata is not None:
            raise InputError(f"{path}: an OSF carries its sensor's metadata: leave --metadata out")
        check_osf_integrity(path)
        info = _only_sensor(path)
        sensor = parse_metadata(json.loads(info.to_json_string()), str(path))
        require_mode(sensor.mode, str(path))
        return Recording(path, sensor, info, None)
    check_pcap_integrity(path)
    beside = path.with_suffix(".json")
    if metadata is None and not beside.exists():
        raise InputError(f"{path}: {beside.name} is not beside it: give the sensor's metadata .json with --metadata")
    metadata = metadata or beside
    sensor = parse_metadata(read_json(metadata, METADATA_FILE), str(metadata))
    require_mode(sensor.mode, str(metadata))
    try:
        info = core.SensorInfo(metadata.read_text(encoding="utf-8"))
    except SDK_ERRORS as error:
        raise InputError(f"{metadata}: the vendor's SDK does not take it: {one_line(error)}") from error
    recording = Recording(path, sensor, info, metadata)
    _check_columns(recording)
    return recording


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


def _decode(frame: Any, sensor: SensorMetadata, sensor_to_body: Float64Array, where: str) -> Revolution:
    """Convert one of the SDK's `LidarFrame`s.

    Args:
        frame: The frame, with at least one column.
        sensor: The recording's sensor.
        sensor_to_body: (4, 4) pose of the sensor in the body frame, whose poses the frame holds.
        where: Name of the frame in messages.

    Raises:
        InputError: It has no ranges, another size, or its column stamps do not rise.
    """
    is_valid = (frame.status & 1).astype(bool)
    if not frame.has_field("RANGE"):
        raise InputError(f"{where} has no channel RANGE (there is {', '.join(frame.fields) or 'none'})")
    shape = (sensor.height, sensor.width)
    if frame.field("RANGE").shape != shape:
        raise InputError(f"{where} is {frame.field('RANGE').shape}, its metadata says {shape}")
    odom_T_column = np.asarray(frame.body_to_world, dtype=np.float64) @ sensor_to_body
    return Revolution(
        range_mm=_channel(frame, "RANGE", is_valid, 2**32 - 1).astype(np.uint32),
        reflectivity=_channel(frame, "REFLECTIVITY", is_valid, 255).astype(np.uint8),
        signal=_channel(frame, "SIGNAL", is_valid, 2**16 - 1).astype(np.uint16),
        column_stamps_ns=_stamps_ns(frame.timestamp.astype(np.int64), is_valid, sensor, where),
        is_valid=is_valid,
        odom_T_column=odom_T_column,
    )


def _channel(frame: Any, name: str, is_valid: BoolArray, most: int) -> npt.NDArray[Any]:
    """Return a channel (H, W), clipped to `most`; zero in missing columns and for a missing channel."""
    if not frame.has_field(name):
        return np.zeros((frame.h, frame.w), np.uint8)
    return np.where(is_valid, np.minimum(frame.field(name), most), 0)


def _stamps_ns(stamps_ns: Int64Array, is_valid: BoolArray, sensor: SensorMetadata, where: str) -> Int64Array:
    """Return the (W,) stamps, interpolated in missing columns and extrapolated at the nominal rate at the ends."""
    known = np.flatnonzero(is_valid)
    if (np.diff(stamps_ns[known]) <= 0).any():
        raise InputError(f"{where}: the stamps of its columns do not rise: the sensor's clock was set, cut it there")
    nominal_ns = sensor.column_offsets_ns()
    start_ns = int(stamps_ns[known[0]])
    late_ns = (stamps_ns[known] - start_ns) - nominal_ns[known]
    filled_ns = nominal_ns + np.interp(np.arange(len(stamps_ns)), known, late_ns)
    return np.where(is_valid, stamps_ns, start_ns + np.round(filled_ns).astype(np.int64))


def _open_source(recording: Recording) -> Any:
    """Return the SDK's source of a recording; the caller closes it."""
    from ouster.sdk import osf, pcap

    with _sdk_reads(recording.path):
        if recording.metadata is None:
            return osf.OsfFrameSetSource(str(recording.path))
        return pcap.PcapFrameSetSource(str(recording.path), sensor_info=[recording.info])


@contextmanager
def _sdk_reads(path: Path) -> Iterator[None]:
    try:
        yield
    except SDK_ERRORS as error:
        raise InputError(f"{path}: the vendor's SDK cannot read it: {one_line(error)}") from error


def _read_guarded(source: Any, path: Path) -> Iterator[Any]:
    with _sdk_reads(path):
        yield from source


def _only_sensor(path: Path) -> Any:
    from ouster.sdk import osf

    with _sdk_reads(path), closing(osf.OsfFrameSetSource(str(path))) as source:
        infos = list(source.sensor_info)
    if len(infos) != 1:
        sensors = ", ".join(f"{info.prod_line} {info.sn}" for info in infos) or "none"
        raise InputError(f"{path}: expected the recording of one sensor, it holds {len(infos)} ({sensors})")
    return infos[0]


def _packet_bytes(info: Any) -> int:
    from ouster.sdk import core

    return int(core.PacketFormat.from_info(info).lidar_packet_size)


def _check_columns(recording: Recording) -> None:
    """Raise `InputError` if packets have more columns than the metadata's mode: the SDK would drop them silently."""
    from ouster.sdk import core, pcap

    layout = core.PacketFormat.from_info(recording.info)
    n_looked_at = 2 * recording.sensor.width // max(layout.columns_per_packet, 1)
    highest = -1
    with _sdk_reads(recording.path):
        source = pcap.PcapPacketSource(str(recording.path), sensor_info=[recording.info])
    with closing(source):
        for _, packet in _read_guarded(source, recording.path):
            if isinstance(packet, core.LidarPacket):
                highest = max(highest, int(layout.packet_header(core.ColHeader.MEASUREMENT_ID, packet.buf).max()))
                n_looked_at -= 1
            if n_looked_at <= 0:
                break
    if highest >= recording.sensor.width:
        raise InputError(
            f"{recording.metadata}: lidar_mode = {recording.sensor.mode}, but the packets of {recording.path} count "
            f"columns up to {highest}: it is the metadata of another mode"
        )
