"""Scans of any format with one pose each, as the pipeline reads them."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, Int64Array, invert
from cdpipe.core.geometry.motion import Motion
from cdpipe.io.foreign.clouds import SWEEP_S, Cloud, Clouds, point_times
from cdpipe.mapping.deskew import deskew_points
from cdpipe.model.types import PosedScan

# Largest change of a pose entry, metres or radians, that odometry reports for a sensor at rest.
_STANDING = 0.1
_NO_SWEEP = f"they span no sweep, {SWEEP_S[0]} to {SWEEP_S[1]} s"


class PosedClouds:
    """The scans of a recording, each with one pose.

    Attributes:
        name: The recording.
        odom_T_sensor: (S, 4, 4) pose of each scan.
        stamps_s: (S,) time of each scan, seconds.
        descriptors_in: Folder that stores its descriptors.
        is_temporary: Whether its files go with this object.
        is_whole_map: Whether stations stand for scans that are not known.
    """

    descriptors_in: Path | None = None
    is_temporary = False
    is_whole_map = False

    def __init__(
        self,
        clouds: Clouds,
        odom_T_sensor: Float64Array,
        stamps_s: Float64Array,
        motion: Motion | None,
        *,
        deskew: bool = False,
    ) -> None:
        """Keep what to read.

        Args:
            clouds: The scans.
            odom_T_sensor: (S, 4, 4) pose of each.
            stamps_s: (S,) time of each, seconds.
            motion: The movement between the scans; None where there is none.
            deskew: Whether the motion deskews points that have times.
        """
        self.name = clouds.name
        self.odom_T_sensor = odom_T_sensor
        self._clouds, self.stamps_s, self._motion, self._deskew = clouds, stamps_s, motion, deskew
        self._stamps_ns: Int64Array = np.round((stamps_s - stamps_s[0]) * 1e9).astype(np.int64)

    def scan(self, index: int) -> PosedScan:
        """Read one scan.

        Raises:
            InputError: It cannot be read, holds no return, or a point that is not finite.
        """
        return self._make(index, self._clouds.read(index))[0]

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order; an `InputWarning` says how many missing returns were dropped, or scans not deskewed.

        Raises:
            InputError: As `scan`; or two scans are the same.
        """
        repeats = Repeats()
        n_missing, n_points, n_skewed = 0, 0, 0
        for index, cloud in enumerate(self._clouds.read_all()):
            scan, n_dropped = self._make(index, cloud)
            n_missing, n_points = n_missing + n_dropped, n_points + n_dropped + len(scan.pixels)
            n_skewed += self._deskew and _has_times(cloud) and not np.ptp(scan.stamps_ns)
            stamp_ns = int(self._stamps_ns[index])
            where = self._clouds.where(index)
            name = where.rsplit("/", 1)[-1]
            if not self.is_whole_map:  # its stations, which nobody recorded, may lie on a regular grid
                repeats.require_new(where, name, scan.points_sensor, self.odom_T_sensor[index], stamp_ns)
            yield scan
        if n_missing:
            told = (
                f"{n_missing} of {n_points} points are (0, 0, 0) or not finite: taken for missing returns and left out"
            )
            warnings.warn(f"{self.name}: {told}", InputWarning, stacklevel=2)
        if n_skewed:
            lack = "there are no two poses with times that rise" if self._motion is None else _NO_SWEEP
            told = f"{n_skewed} of {len(self.odom_T_sensor)} scans are not deskewed, though their points have times"
            warnings.warn(f"{self.name}: {told}: {lack} (--no-deskew if they are already)", InputWarning, stacklevel=2)

    def _make(self, index: int, cloud: Cloud) -> tuple[PosedScan, int]:
        """Return a scan, and the number of its missing returns; organised clouds store them as (0, 0, 0) or NaN.

        Other formats than PLY and KITTI's have their rows with one coordinate that is not finite made NaN by then.
        """
        where, points = self._clouds.where(index), cloud.points
        is_return = points.any(axis=1) & ~np.isnan(points).all(axis=1)
        if not is_return.any():
            raise InputError(f"{where}: holds no return: remove the scan and its line of the trajectory")
        is_wrong = is_return & ~np.isfinite(points).all(axis=1)
        if is_wrong.any():
            raise InputError(
                f"{where}: vertex {int(np.argmax(is_wrong))} is not finite ({np.count_nonzero(is_wrong)} are not): "
                "remove them from the file"
            )
        stamps_ns = np.full(np.count_nonzero(is_return), self._stamps_ns[index])
        kept = points[is_return]
        times = None if cloud.times is None else cloud.times[is_return]
        offset_s = point_times(times, float(self.stamps_s[index])) if self._deskew else None
        pose_ns = None
        if offset_s is not None and self._motion is not None:
            kept = deskew_points(kept, offset_s, float(self.stamps_s[index]), self._motion)
            stamps_ns = stamps_ns + np.round(offset_s * 1e9).astype(np.int64)
            pose_ns = int(self._stamps_ns[index])
        pixels = np.flatnonzero(is_return).astype(np.int32)
        shone = None if cloud.intensity is None else cloud.intensity[is_return]
        pose = self.odom_T_sensor[index]
        scan = PosedScan(index, kept, pose, stamps_ns, pixels, intensity=shone, pose_ns=pose_ns)
        return scan, len(points) - len(pixels)


def _has_times(cloud: Cloud) -> bool:
    """Return whether the points of a cloud have times that differ."""
    return cloud.times is not None and len(cloud.times) > 1 and bool((cloud.times != cloud.times[0]).any())


class Repeats:
    """Detects scans that were recorded twice: noise never gives bit-identical returns."""

    def __init__(self) -> None:
        self._seen: dict[bytes, tuple[str, Float64Array, int]] = {}

    def require_new(
        self, where: str, name: str, content: npt.NDArray[Any], odom_T_sensor: Float64Array, stamp_ns: int
    ) -> None:
        """Remember a scan; raise `InputError` if an identical scan has another pose or the same time."""
        digest = hashlib.blake2b(np.ascontiguousarray(content).data, digest_size=16).digest()
        if digest not in self._seen:
            self._seen[digest] = name, odom_T_sensor, stamp_ns
            return
        other, pose, other_ns = self._seen[digest]
        # a simulated noise-free sensor at rest gives identical scans at slightly different poses
        if stamp_ns == other_ns or np.abs(pose - odom_T_sensor).max() > _STANDING:
            raise InputError(
                f"{where} repeats {other}: the same returns to the last bit, recorded twice: remove one and its pose"
            )


def in_sensor_frames(clouds_odom: Clouds, odom_T_sensor: Float64Array) -> Clouds:
    """Return clouds whose points are moved from the frame of the poses (S, 4, 4) into that of the sensor."""
    return _Moved(clouds_odom, invert(odom_T_sensor))


class _Moved:
    def __init__(self, clouds: Clouds, dst_T_src: Float64Array) -> None:
        self.name, self.stamps_s, self.own, self.lacks = clouds.name, clouds.stamps_s, clouds.own, clouds.lacks
        self.is_stream = clouds.is_stream
        self._clouds, self._dst_T_src = clouds, dst_T_src

    def __len__(self) -> int:
        return len(self._clouds)

    def where(self, index: int) -> str:
        return self._clouds.where(index)

    def read(self, index: int) -> Cloud:
        return self._move(index, self._clouds.read(index))

    def read_all(self) -> Iterator[Cloud]:
        return (self._move(index, cloud) for index, cloud in enumerate(self._clouds.read_all()))

    def _move(self, index: int, cloud: Cloud) -> Cloud:
        pose = self._dst_T_src[index]
        is_missing = np.logical_not(cloud.points.any(axis=1))  # stays missing
        moved = cloud.points @ pose[:3, :3].T + pose[:3, 3]
        return Cloud(np.where(is_missing[:, None], 0.0, moved), intensity=cloud.intensity)
