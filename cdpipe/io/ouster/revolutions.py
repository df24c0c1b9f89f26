"""One revolution as the vendor's SDK decodes it: staggered arrays, stamps filled in, poses of the sensor itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.sensor.ouster import SensorMetadata


@dataclass(frozen=True, slots=True, eq=False)
class Revolution:
    """One revolution as the sensor sent it.

    Attributes:
        range_mm: (H, W) uint32 first (strongest) return, staggered, 0 where nothing returned or the column is missing.
        reflectivity: (H, W) uint8.
        signal: (H, W) uint16 photons; 0 where the recording holds no such channel.
        column_stamps_ns: (W,) int64 sensor clock; those of missing columns are put in between.
        is_valid: (W,) whether the column arrived.
        odom_T_column: (W, 4, 4) the recording's own poses of the sensor, meaningless in missing columns.
    """

    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    column_stamps_ns: Int64Array
    is_valid: BoolArray
    odom_T_column: Float64Array


def decode(frame: Any, sensor: SensorMetadata, sensor_to_body: Float64Array, where: str) -> Revolution:
    """Return one of the SDK's `LidarFrame`s.

    Args:
        frame: It, with at least one column.
        sensor: The recording's sensor.
        sensor_to_body: (4, 4) how it is mounted on what the frame's poses are of.
        where: What to call it in messages.

    Raises:
        InputError: It has no ranges, is of another size, or the stamps of its columns do not rise.
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
    """Return a channel (H, W), at most `most`; zeros in missing columns, or where the recording does not hold it."""
    if not frame.has_field(name):
        return np.zeros((frame.h, frame.w), np.uint8)
    return np.where(is_valid, np.minimum(frame.field(name), most), 0)


def _stamps_ns(stamps_ns: Int64Array, is_valid: BoolArray, sensor: SensorMetadata, where: str) -> Int64Array:
    """Fill in the stamps of missing columns: evenly between their neighbours, at the nominal rate beyond the ends."""
    known = np.flatnonzero(is_valid)
    if (np.diff(stamps_ns[known]) <= 0).any():
        raise InputError(f"{where}: the stamps of its columns do not rise: the sensor's clock was set, cut it there")
    nominal_ns = sensor.column_offsets_ns()
    start_ns = int(stamps_ns[known[0]])
    late_ns = (stamps_ns[known] - start_ns) - nominal_ns[known]
    filled_ns = nominal_ns + np.interp(np.arange(len(stamps_ns)), known, late_ns)
    return np.where(is_valid, stamps_ns, start_ns + np.round(filled_ns).astype(np.int64))
