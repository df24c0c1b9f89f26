"""Open a recorded session: a session folder, or PLY scans with a TUM trajectory."""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.geometry import Float64Array, Int64Array, make_pose
from cdpipe.io.ply import read_ply_points
from cdpipe.io.session import ScanChunk, Session, chunk_path, is_session, read_session
from cdpipe.io.tum import TUM_LINE, read_tum, require_unit_poses
from cdpipe.mapping.deskew import deskew
from cdpipe.model.types import PosedScan, ScanSource

RECORDING_SUFFIXES = (".osf", ".pcap", ".pcapng")
"""File suffixes of sensor recordings, which `cdpipe.io.ouster` reads."""
_NUMBERS = re.compile(r"(\d+)")
# Largest change of a pose entry, metres or radians, that odometry reports for a sensor at rest.
_STANDING = 0.1


def open_session(path: str | Path) -> ScanSource:
    """Open a folder of scans.

    Args:
        path: A session folder (`cdpipe.io.session`), or a folder of `*.ply` scans in the order of their names with one
            trajectory `*.txt` or `*.tum`: one line `stamp tx ty tz qx qy qz qw` for each scan, in the same order. PLY
            points are deskewed and in the sensor frame of their pose, metres; `pixels` are rows of the file. Points
            at (0, 0, 0), and those that are all NaN, are missing returns.

    Raises:
        InputError: The folder is missing or holds neither, or its trajectory does not fit its scans. Mistakes inside a
            single scan are raised when it is read.
    """
    path = Path(path)
    if path.suffix.lower() in RECORDING_SUFFIXES and not path.is_dir():
        raise InputError(
            f"{path}: a sensor's own recording: turn it into a session first, `tunnelcd convert {path} FOLDER`, and "
            "name that folder"
        )
    if not path.is_dir():
        raise InputError(f"{path}: no such folder: expected a session, or a folder of PLY scans with a TUM trajectory")
    return RecordedScans(read_session(path)) if is_session(path) else _open_ply_scans(path)


class RecordedScans:
    """The scans of a session folder, deskewed by its own odometry; the chunk read last is cached.

    Attributes:
        name: The session's folder.
        odom_T_sensor: (S, 4, 4) pose of each revolution.
    """

    def __init__(self, session: Session) -> None:
        self.name = str(session.path)
        self.odom_T_sensor = session.odom_T_sensor
        self._session = session
        self._chunk_index = -1
        self._chunk: ScanChunk | None = None

    def scan(self, index: int) -> PosedScan:
        """Read and deskew one revolution.

        Raises:
            InputError: Its chunk is damaged, its column poses are not rigid, or nothing returned.
        """
        chunk_index, row = divmod(index, self._session.chunk_scans)
        if self._chunk is None or chunk_index != self._chunk_index:
            self._chunk, self._chunk_index = self._session.chunk(chunk_index), chunk_index
        where = f"{chunk_path(self._session.path, chunk_index)}: scan {index}"
        column_poses = self._chunk.column_poses[row].astype(np.float64)
        require_unit_poses(column_poses, lambda column: f"{where}, column {column}")
        range_mm = self._chunk.range_mm[row]
        is_hit = range_mm > 0
        if not is_hit.any():
            raise InputError(f"{where} holds no return: remove the scan and its pose from the recording")
        points = deskew(self._session.sensor.project(range_mm / 1000.0), column_poses)
        stamps = np.broadcast_to(self._chunk.column_stamps_ns[row], is_hit.shape)
        return PosedScan(
            index=index,
            points_sensor=points[is_hit],
            odom_T_sensor=self.odom_T_sensor[index],
            stamps_ns=stamps[is_hit],
            pixels=np.flatnonzero(is_hit).astype(np.int32),
            signal=self._chunk.signal[row][is_hit] if self._chunk.signal[row].any() else None,
            second_from=is_hit.size // 2 if self._session.n_returns == 2 else None,
        )

    def scans(self) -> Iterator[PosedScan]:
        """Read all revolutions in order; each chunk is read once.

        Raises:
            InputError: As `scan`; or a revolution was recorded twice.
        """
        repeats = _Repeats()
        for index, pose in enumerate(self.odom_T_sensor):
            scan = self.scan(index)
            assert self._chunk is not None
            row = index % self._session.chunk_scans
            stamp_ns = int(self._chunk.column_stamps_ns[row, 0])
            where = f"{chunk_path(self._session.path, self._chunk_index)}: scan {index}"
            repeats.require_new(where, f"scan {index}", self._chunk.range_mm[row], pose, stamp_ns)
            yield scan


class PlyScans:
    """Scans in PLY files, each with one pose.

    Attributes:
        name: The folder.
        odom_T_sensor: (S, 4, 4) pose of each scan.
    """

    def __init__(self, folder: Path, files: list[Path], odom_T_sensor: Float64Array, stamps_ns: Int64Array) -> None:
        self.name = str(folder)
        self.odom_T_sensor = odom_T_sensor
        self._files = files
        self._stamps_ns = stamps_ns

    def scan(self, index: int) -> PosedScan:
        """Read one file.

        Raises:
            InputError: It is not a PLY scan, holds no return, or a point that is not finite.
        """
        return self._read(index)[0]

    def scans(self) -> Iterator[PosedScan]:
        """Read all scans in order; an `InputWarning` says how many missing returns were dropped.

        Raises:
            InputError: As `scan`; or two files hold the same scan.
        """
        repeats = _Repeats()
        n_missing, n_points = 0, 0
        for index, file in enumerate(self._files):
            scan, n_dropped = self._read(index)
            n_missing, n_points = n_missing + n_dropped, n_points + n_dropped + len(scan.pixels)
            stamp_ns = int(self._stamps_ns[index])
            repeats.require_new(str(file), file.name, scan.points_sensor, self.odom_T_sensor[index], stamp_ns)
            yield scan
        if n_missing:
            told = f"{n_missing} of {n_points} points are (0, 0, 0) or NaN: taken for missing returns and left out"
            warnings.warn(f"{self.name}: {told}", InputWarning, stacklevel=2)

    def _read(self, index: int) -> tuple[PosedScan, int]:
        """Return a scan, and the number of its missing returns; organised clouds store them as (0, 0, 0) or NaN."""
        path = self._files[index]
        points = read_ply_points(path)
        is_return = points.any(axis=1) & ~np.isnan(points).all(axis=1)
        if not is_return.any():
            raise InputError(f"{path}: holds no return: remove the scan and its line of the trajectory")
        is_wrong = is_return & ~np.isfinite(points).all(axis=1)
        if is_wrong.any():
            raise InputError(
                f"{path}: vertex {int(np.argmax(is_wrong))} is not finite ({np.count_nonzero(is_wrong)} are not): "
                "remove them from the file"
            )
        pixels = np.flatnonzero(is_return).astype(np.int32)
        scan = PosedScan(
            index=index,
            points_sensor=points[is_return],
            odom_T_sensor=self.odom_T_sensor[index],
            stamps_ns=np.full(len(pixels), self._stamps_ns[index]),
            pixels=pixels,
        )
        return scan, len(points) - len(pixels)


class _Repeats:
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


def _open_ply_scans(folder: Path) -> PlyScans:
    files = sorted(folder.glob("*.ply"))
    if not files:
        raise InputError(
            f"{folder}: no scans in it: expected session.json (a session of ours), or *.ply scans with a TUM trajectory"
        )
    by_number = sorted(
        files, key=lambda file: [int(part) if part.isdigit() else part for part in _NUMBERS.split(file.name)]
    )
    if by_number != files:
        raise InputError(
            f"{folder}: the *.ply files are numbered without leading zeros, so that their names sort as "
            f"{files[0].name}, {files[1].name}, ...: pad the numbers to equal length"
        )
    trajectories = sorted([*folder.glob("*.txt"), *folder.glob("*.tum")])
    if len(trajectories) != 1:
        found = ", ".join(file.name for file in trajectories) or "none"
        raise InputError(f"{folder}: expected exactly one trajectory (*.txt or *.tum, lines {TUM_LINE}), found {found}")
    rows, _ = read_tum(trajectories[0])
    if len(rows) != len(files):
        raise InputError(
            f"{trajectories[0]}: {len(rows)} poses for {len(files)} *.ply scans: one line for each scan is "
            "needed, in the order of the file names"
        )
    poses = make_pose(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4])
    stamps_ns = np.round((rows[:, 0] - rows[0, 0]) * 1e9).astype(np.int64)
    return PlyScans(folder, files, poses, stamps_ns)
