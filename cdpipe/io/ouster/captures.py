"""Read a sensor recording, OSF or PCAP, revolution by revolution.

The vendor's SDK reads it in a process of its own (`cdpipe.io.ouster.sdk`); what comes from there is checked here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.isolated_reader import Arrays, IsolatedReader
from cdpipe.core.plugins import require_extra
from cdpipe.io.foreign.sniff import RECORDING_SUFFIXES
from cdpipe.io.ouster.integrity import check_osf_integrity, check_pcap_integrity
from cdpipe.io.ouster.sdk import SECOND
from cdpipe.sensor.ouster import SensorMetadata, parse_metadata
from cdpipe.sensor.ouster_metadata import METADATA_FILE, require_mode

# A revolution needs more than this share of its columns: a recording starts and ends inside a revolution.
_LEAST_SHARE = 0.5
# Bytes of Ethernet, IP, UDP and PCAP headers per packet, to estimate the number of packets.
_PACKET_OVERHEAD_BYTES = 58
# Called with the stage, the number of finished revolutions, and their (estimated) total.
_SDK_CALLS = "cdpipe.io.ouster.sdk"


@dataclass(frozen=True, slots=True, eq=False)
class Revolution:
    """One revolution of a recording.

    Attributes:
        range_mm: (R, W) uint32 staggered range, millimetres; 0 for a miss or a missing column. R is H, or 2 H where the
            second returns of all beams follow the first (strongest) ones.
        reflectivity: (R, W) uint8.
        signal: (R, W) uint16 photons; 0 if the recording has no such channel.
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


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A recording of one sensor; it can be read several times.

    Attributes:
        path: The file.
        sensor: Its sensor.
        metadata: The metadata file of a PCAP; None for an OSF, which includes its metadata.
        sensor_to_body: (4, 4) pose of the sensor in the body frame, metres.
        n_window_columns: Number of columns that the sensor sends per revolution.
        n_guessed: Estimated number of revolutions, for progress.
        packet_bytes: Size of a lidar packet of a PCAP.
        reader: Process of the vendor's SDK.
    """

    path: Path
    sensor: SensorMetadata
    metadata: Path | None
    sensor_to_body: Float64Array
    n_window_columns: int
    n_guessed: int
    packet_bytes: int
    reader: IsolatedReader

    def revolutions(self, on_left_out: Callable[[int], object] = lambda number: None) -> Iterator[Revolution]:
        """Read all revolutions with more than half of their columns.

        Args:
            on_left_out: Called with the number of each revolution that is left out.

        Raises:
            InputError: The file is damaged, the clock went backwards, or no revolution qualifies.
        """
        n_kept, n_seen, last_ns = 0, 0, None
        metadata = None if self.metadata is None else str(self.metadata)
        for about, arrays in self.reader.read("read_frames", path=str(self.path), metadata=metadata):
            if not arrays:
                self._check_end(about, n_seen, n_kept)
                continue
            n_seen += 1
            where = f"{self.path}: revolution {n_seen - 1}"
            _check_shapes(arrays, self.sensor, about["fields"], where)
            if np.count_nonzero(arrays["status"] & 1) <= _LEAST_SHARE * max(self.n_window_columns, 1):
                on_left_out(n_seen - 1)
                continue
            revolution = _decode(arrays, self.sensor, self.sensor_to_body, where)
            if last_ns is not None and revolution.column_stamps_ns[0] <= last_ns:
                raise InputError(
                    f"{where} does not come after the one before it: the sensor's clock was set during the recording, "
                    "cut it there"
                )
            last_ns = revolution.column_stamps_ns[-1]
            n_kept += 1
            yield revolution

    def _check_end(self, about: dict[str, Any], n_seen: int, n_kept: int) -> None:
        if self.metadata is None and n_seen < about["n_stated"]:
            raise InputError(f"{self.path}: damaged: {n_seen} of its {about['n_stated']} revolutions can be read")
        if n_kept:
            return
        if n_seen:
            raise InputError(
                f"{self.path}: no whole revolution: of none of its {n_seen} more than half the columns arrived; the "
                f"recording is too short, or was not made in mode {self.sensor.mode}"
            )
        if self.metadata is not None:
            raise InputError(
                f"{self.path}: no lidar packet of the sensor in {self.metadata} ({self.sensor.product}, "
                f"{self.packet_bytes} bytes each); {about['n_other'] or 'none'} of its packets look like another "
                "Ouster's"
            )
        raise InputError(f"{self.path}: holds no revolution")


def open_recording(path: Path, metadata: Path | None = None) -> Recording:
    """Open an OSF, or a PCAP with its metadata: `metadata`, or the .json of the same name beside it.

    Raises:
        InputError: A file is missing, truncated or of another kind, the metadata is of another sensor or mode, the OSF
            holds several sensors, or the vendor's SDK is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in RECORDING_SUFFIXES:
        raise InputError(f"{path}: expected a recording, {', '.join(RECORDING_SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}: expected a recording")
    require_extra("ouster", str(path))
    if suffix == ".osf":
        if metadata is not None:
            raise InputError(f"{path}: an OSF carries its sensor's metadata: leave --metadata out")
        return _open_osf(path)
    check_pcap_integrity(path)
    beside = path.with_suffix(".json")
    if metadata is None and not beside.exists():
        raise InputError(
            f"{path}: {beside.name} is not beside it: give the sensor's metadata .json with --metadata; only Ouster's "
            "PCAPs are read: those of other sensors as a bag or as PCD"
        )
    return _open_pcap(path, metadata or beside)


def _open_osf(path: Path) -> Recording:
    check_osf_integrity(path)
    reader = IsolatedReader(_SDK_CALLS, path, "the vendor's SDK")
    ((about, _),) = reader.read("describe_osf", path=str(path))
    sensor = parse_metadata(about["document"], str(path))
    require_mode(sensor.mode, str(path))
    n_guessed = max(about["n_revolutions"], 1)
    return Recording(path, sensor, None, np.array(about["sensor_to_body"]), about["window"], n_guessed, 0, reader)


def _open_pcap(path: Path, metadata: Path) -> Recording:
    sensor = parse_metadata(read_json(metadata, METADATA_FILE), str(metadata))
    require_mode(sensor.mode, str(metadata))
    reader = IsolatedReader(_SDK_CALLS, path, "the vendor's SDK")
    ((about, _),) = reader.read("describe_pcap", path=str(path), metadata=str(metadata))
    if about["highest_column"] >= sensor.width:
        raise InputError(
            f"{metadata}: lidar_mode = {sensor.mode}, but the packets of {path} count columns up to "
            f"{about['highest_column']}: it is the metadata of another mode"
        )
    n_bytes = (about["packet_bytes"] + _PACKET_OVERHEAD_BYTES) * max(about["n_packets"], 1)
    n_guessed = max(path.stat().st_size // n_bytes, 1)
    pose = np.array(about["sensor_to_body"])
    return Recording(path, sensor, metadata, pose, about["window"], n_guessed, about["packet_bytes"], reader)


def _check_shapes(arrays: Arrays, sensor: SensorMetadata, fields: list[str], where: str) -> None:
    """Raise `InputError` if a revolution has no ranges, or an array has another size than the metadata says."""
    if "RANGE" not in arrays:
        raise InputError(f"{where} has no channel RANGE (there is {', '.join(fields) or 'none'})")
    columns = (sensor.width,)
    shapes = {"status": columns, "timestamp": columns, "body_to_world": (*columns, 4, 4)}
    for name, array in arrays.items():
        if array.shape != (expected := shapes.get(name, (sensor.height, sensor.width))):
            raise InputError(f"{where}: {name} is {array.shape}, its metadata says {expected}")


def _decode(arrays: Arrays, sensor: SensorMetadata, sensor_to_body: Float64Array, where: str) -> Revolution:
    """Convert the arrays of one revolution with at least one column.

    Args:
        arrays: As `cdpipe.io.ouster.sdk.read_frames` yields them, of the sensor's size.
        sensor: The recording's sensor.
        sensor_to_body: (4, 4) pose of the sensor in the body frame, whose poses the revolution holds.
        where: Name of the revolution in messages.

    Raises:
        InputError: Its column stamps do not rise.
    """
    is_valid = (arrays["status"] & 1).astype(bool)
    return Revolution(
        range_mm=_channel(arrays, "RANGE", is_valid, 2**32 - 1).astype(np.uint32),
        reflectivity=_channel(arrays, "REFLECTIVITY", is_valid, 255).astype(np.uint8),
        signal=_channel(arrays, "SIGNAL", is_valid, 2**16 - 1).astype(np.uint16),
        column_stamps_ns=_stamps_ns(arrays["timestamp"].astype(np.int64), is_valid, sensor, where),
        is_valid=is_valid,
        odom_T_column=arrays["body_to_world"] @ sensor_to_body,
    )


def _channel(arrays: Arrays, name: str, is_valid: BoolArray, most: int) -> npt.NDArray[Any]:
    """Return a channel (R, W), clipped to `most`; zero in missing columns and for a missing channel."""
    suffixes = ("", SECOND) if "RANGE" + SECOND in arrays else ("",)
    missing = np.zeros(arrays["RANGE"].shape, np.uint32)
    parts = [arrays.get(name + suffix, missing) for suffix in suffixes]
    return np.concatenate([np.where(is_valid, np.minimum(part, most), 0) for part in parts])


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
