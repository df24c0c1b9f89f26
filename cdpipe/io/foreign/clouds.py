"""The scans of a recording before they have poses: what a format yields, and files with one scan each."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float32Array, Float64Array
from cdpipe.io.foreign.trajectory import Trajectory

# Longest and shortest sweep of a scan, which tell the unit of the times of its points.
SWEEP_S = (0.004, 1.5)
TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "timeoffset", "point_time", "gps_time")
"""Names, in lower case, under which formats keep the time of each point."""
_FIRST_S = 1e8  # of 1973: file names with fewer seconds are counters
INTENSITY_FIELDS = ("intensity", "reflectivity", "remission", "scalar_intensity", "i")
"""Names, in lower case, under which formats keep how strongly each point shone, the usual one first."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """One scan as it was recorded.

    Attributes:
        points: (N, 3) float64 points in the sensor frame, metres; a missing return is NaN or (0, 0, 0).
        times: (N,) time of each point in any unit and from any start, None where the format has none.
        intensity: (N,) intensity of each point in the format's own unit, None where the format has none.
    """

    points: Float64Array
    times: npt.NDArray[np.number] | None = None
    intensity: Float32Array | None = None


class Clouds(Protocol):
    """The scans of a recording.

    Attributes:
        name: The recording, for messages.
        stamps_s: (S,) time of each scan, seconds; None where the recording does not tell.
        own: Poses that the recording itself has, None for none.
        lacks: Why there are none, for messages.
        is_stream: Whether scans can only be read in order.
    """

    name: str
    stamps_s: Float64Array | None
    own: Trajectory | None
    lacks: str
    is_stream: bool

    def __len__(self) -> int:
        """Return the number of scans S."""

    def where(self, index: int) -> str:
        """Name one scan in messages."""

    def read(self, index: int) -> Cloud:
        """Read one scan."""

    def read_all(self) -> Iterator[Cloud]:
        """Read all scans in order."""


class CloudFiles:
    """Scans in files, one each: `Clouds`."""

    is_stream = False

    def __init__(
        self,
        folder: Path,
        files: list[Path],
        read: Callable[[Path], Cloud],
        own: Trajectory | None,
        stamps_s: Float64Array | None,
    ) -> None:
        self.name, self.lacks = str(folder), "no trajectory in it"
        self.own, self.stamps_s = own, stamps_s
        self.files, self._read = files, read

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.files)

    def where(self, index: int) -> str:
        """Name the file of a scan."""
        return str(self.files[index])

    def read(self, index: int) -> Cloud:
        """Read one file."""
        return self._read(self.files[index])

    def read_all(self) -> Iterator[Cloud]:
        """Read all files."""
        return (self.read(index) for index in range(len(self.files)))


def check_cloud(where: str, arrays: dict[str, npt.NDArray[Any]]) -> Cloud:
    """Return the cloud of what a reader in another process sent: `points` and perhaps `times` and `intensity`.

    Raises:
        InputError: An array has another shape or kind.
    """
    points, times = arrays.get("points"), arrays.get("times")
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(f"{where}: holds no x, y and z")
    if times is not None and times.shape != (len(points),):
        raise InputError(f"{where}: {len(times)} times for {len(points)} points")
    intensity = arrays.get("intensity")
    if intensity is not None and (intensity.shape != (len(points),) or intensity.dtype.kind not in "fiu"):
        raise InputError(f"{where}: {len(intensity)} intensities for {len(points)} points")
    with np.errstate(invalid="ignore", over="ignore"):  # a NaN that signals
        shone = None if intensity is None else intensity.astype(np.float32)
        return Cloud(points.astype(np.float64), times, shone)


def field_of(names: Iterable[str], usual: Sequence[str]) -> str | None:
    """Return the name that comes first among the usual ones, in lower case; None if there is none."""
    found = {name.lower(): name for name in names}
    return next((found[name] for name in usual if name in found), None)


def point_times(times: npt.NDArray[np.number] | None, stamp_s: float) -> Float64Array | None:
    """Return the time of each point after the stamp of its scan, seconds; None unless they span one sweep.

    The unit follows from the span, s to ns. Times that begin near the stamp are of its clock; those that begin near
    zero count from the stamp; others are of another clock, and their first one is the stamp's.
    """
    if times is None or len(times) < 2 or not np.isfinite(times).all():
        return None
    first = times.min()
    span = float(times.max()) - float(first)
    scale = next((unit for unit in (1.0, 1e-3, 1e-6, 1e-9) if SWEEP_S[0] <= span * unit <= SWEEP_S[1]), None)
    if scale is None:
        return None
    since_s: Float64Array = (times - first).astype(np.float64) * scale
    start_s = min(float(first) * scale, float(first) * scale - stamp_s, key=abs)
    return since_s + (start_s if abs(start_s) <= SWEEP_S[1] else 0.0)


def stamps_of_names(files: list[Path]) -> Float64Array | None:
    """Return the times (S,) in file names, `1700000000.125`, `1700000000_125000000` or nanoseconds; else None."""
    stamps = []
    for file in files:
        stem = file.name.removesuffix(file.suffix)
        if match := re.search(r"(?<!\d)(\d{9,10})[._](\d{1,9})(?!\d)", stem):
            whole, rest = match.groups()
            if int(whole) < _FIRST_S:  # a counter
                return None
            # after an underscore nanoseconds, which may lack their leading zeros
            share = int(rest) / 1e9 if "_" in match.group() else float(f"0.{rest}")
            stamps.append(int(whole) + share)
        elif match := re.search(r"(?<!\d)(\d{16}|\d{19})(?!\d)", stem):
            stamps.append(int(match.group()) / (1e9 if len(match.group()) == 19 else 1e6))
        else:
            return None
    found = np.array(stamps)
    return found if (np.diff(found) > 0).all() else None
