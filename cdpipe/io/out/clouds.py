"""Maps as LAZ and PLY, whose values CloudCompare shows as scalar fields."""

# ruff: noqa: PLC0415 - laspy is an extra, and everybody else must be able to import this

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.plugins import require_extra
from cdpipe.io.out.maps import PointMap
from cdpipe.io.ply import write_ply_points

_SCALE_M = 1e-4
_STANDARD = {"intensity": "intensity", "time": "gps_time"}
_MOST_NAME = 32
_LARGEST = 65535
_NO_DATE = date(1970, 1, 1)  # the day of writing would make equal maps differ


def write_laz(path: Path, cloud: PointMap) -> None:
    """Write a map as LAS 1.4, compressed where the name ends in .laz, coordinates rounded to 0.1 mm.

    `intensity` and `time` become fields of the format (uint16 and `gps_time`), all others extra dimensions. Intensities
    of 0 to 1 are scaled to the 16 bits, others rounded, each `session` by itself; NaN becomes 0 in either.

    Raises:
        InputError: The extra `formats` is not installed.
        OSError: The file cannot be written.
    """
    require_extra("formats", str(path))
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(cloud.points.min(axis=0)) if len(cloud.points) else np.zeros(3)
    header.generating_software, header.creation_date = "tunnelcd", _NO_DATE
    more = {name: values for name, values in cloud.scalars.items() if name not in _STANDARD}
    header.add_extra_dims([laspy.ExtraBytesParams(name[:_MOST_NAME], values.dtype) for name, values in more.items()])
    data = laspy.LasData(header)
    data.x, data.y, data.z = cloud.points.T
    for name, values in cloud.scalars.items():
        told = _as_16_bits(cloud) if name == "intensity" else np.nan_to_num(values) if name == "time" else values
        data[_STANDARD.get(name, name[:_MOST_NAME])] = told
    with path.open("wb") as file:
        data.write(file, do_compress=path.suffix.lower() == ".laz")


def _as_16_bits(cloud: PointMap) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Return the intensities; two sessions of one map may store them in different units."""
    values = np.nan_to_num(cloud.scalars["intensity"].astype(np.float64))
    sessions = cloud.scalars.get("session", np.zeros(len(values), np.int32))
    for session in np.unique(sessions):
        own = values[sessions == session]
        if own.max() <= 1.0 and (own != np.round(own)).any():
            values[sessions == session] = own * _LARGEST
    return np.asarray(np.clip(np.round(values), 0, _LARGEST), np.uint16)


def write_ply(path: Path, cloud: PointMap) -> None:
    """Write a map as binary PLY of 32-bit numbers; `time` counts from the first point of its session.

    Raises:
        OSError: The file cannot be written.
    """
    scalars = dict(cloud.scalars)
    if "time" in scalars and len(cloud.points):
        sessions = scalars.get("session", np.zeros(len(cloud.points)))
        first_s = {each: scalars["time"][sessions == each].min() for each in np.unique(sessions)}
        scalars["time"] = scalars["time"] - np.array([first_s[each] for each in sessions])
    write_ply_points(path, cloud.points, scalars)
