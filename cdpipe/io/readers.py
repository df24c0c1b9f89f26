"""Open a recorded session: a session folder, or a recording of another format."""

from __future__ import annotations

import shutil
import tempfile
import warnings
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.io.foreign.opening import HowToRead, folder_of_options, open_recording
from cdpipe.io.foreign.scans import Repeats
from cdpipe.io.foreign.sniff import OUSTER, RECORDING_SUFFIXES, guess_format
from cdpipe.io.session import ScanChunk, Session, chunk_path, read_session
from cdpipe.io.tum import require_unit_poses
from cdpipe.mapping.deskew import deskew
from cdpipe.model.types import PosedScan, ScanSource

if TYPE_CHECKING:
    from cdpipe.io.ouster.recording import Imported

__all__ = ["RECORDING_SUFFIXES", "HowToRead", "RecordedScans", "import_ouster", "open_session"]


def open_session(path: str | Path, how: HowToRead | None = None, report: Progress = report_nothing) -> ScanSource:
    """Open a session folder, or a recording of another format.

    Args:
        path: A session folder (`cdpipe.io.session`); a folder of scans, PLY, PCD, LAS or KITTI .bin, with a trajectory;
            a bag, an E57, an OSF or a PCAP (RECORDINGS.md). A bag, an OSF and a PCAP are first written to a temporary
            folder, which is removed with the returned source.
        how: What is not to be guessed.
        report: Called with the stage, the number of finished scans and their estimated total.

    Raises:
        InputError: It does not exist, is of no known format, has no poses, or they do not fit its scans. Mistakes
            inside a single scan are raised when it is read.
    """
    path, how = Path(path), how or HowToRead()
    name = guess_format(path, how.format)
    if name == "session":
        how.require_nothing(path, "a session has its own poses and sensor")
        return RecordedScans(read_session(path))
    source = _open_ouster(path, how, report) if name in OUSTER else open_recording(path, how, report)
    own = path if path.is_dir() else path.with_name(f"{path.name}.tunnelcd")
    source.descriptors_in = folder_of_options(own, how)
    return source


def import_ouster(path: Path, out: Path, how: HowToRead, report: Progress = report_nothing) -> Imported:
    """Convert an OSF or a PCAP to a session folder, read as `how` says.

    Raises:
        InputError: As `cdpipe.io.ouster.recording.import_recording`.
    """
    from cdpipe.io.ouster.recording import import_recording  # noqa: PLC0415 - it needs the module of this function

    if not how.deskew:
        told = "its points are in the frames of their columns, and are deskewed in spite of --no-deskew"
        warnings.warn(f"{path}: {told}", InputWarning, stacklevel=2)
    return import_recording(
        path,
        out,
        metadata=how.metadata,
        trajectory=how.trajectory,
        odometry=how.odometry,
        origin_m=how.origin_m,
        on_progress=report,
    )


def _open_ouster(path: Path, how: HowToRead, report: Progress) -> RecordedScans:
    """Convert an OSF or a PCAP to a session in a temporary folder, and open that."""
    folder = Path(tempfile.mkdtemp(prefix="tunnelcd-read-"))
    try:
        import_ouster(path, folder / path.stem, how, report)
        source = RecordedScans(read_session(folder / path.stem))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    source.name, source.is_temporary = str(path), True
    weakref.finalize(source, shutil.rmtree, folder, ignore_errors=True)
    return source


class RecordedScans:
    """The scans of a session folder, deskewed by its own odometry; the chunk read last is cached.

    Attributes:
        name: The session's folder.
        odom_T_sensor: (S, 4, 4) pose of each revolution.
        session: What is read.
        descriptors_in: Folder beside the recording that stores its descriptors; None for a session folder.
        is_temporary: Whether the folder goes with this object.
    """

    descriptors_in: Path | None = None
    is_temporary = False

    def __init__(self, session: Session) -> None:
        self.name = str(session.path)
        self.odom_T_sensor = session.odom_T_sensor
        self.session = session
        self._chunk_index = -1
        self._chunk: ScanChunk | None = None

    def scan(self, index: int) -> PosedScan:
        """Read and deskew one revolution.

        Raises:
            InputError: Its chunk is damaged, its column poses are not rigid, or nothing returned.
        """
        chunk_index, row = divmod(index, self.session.chunk_scans)
        if self._chunk is None or chunk_index != self._chunk_index:
            self._chunk, self._chunk_index = self.session.chunk(chunk_index), chunk_index
        where = f"{chunk_path(self.session.path, chunk_index)}: scan {index}"
        column_poses = self._chunk.column_poses[row].astype(np.float64)
        require_unit_poses(column_poses, lambda column: f"{where}, column {column}")
        range_mm = self._chunk.range_mm[row]
        hits = np.flatnonzero(range_mm > 0)
        if not len(hits):
            raise InputError(f"{where} holds no return: remove the scan and its pose from the recording")
        points = deskew(self.session.sensor.project(range_mm / 1000.0), column_poses)
        rows, columns = np.divmod(hits, range_mm.shape[1])
        by_column = points.swapaxes(0, 1).reshape(-1, 3)  # as `deskew` made them: no copy
        signal = self._chunk.signal[row]
        return PosedScan(
            index=index,
            points_sensor=by_column.take(columns * len(range_mm) + rows, axis=0),
            odom_T_sensor=self.odom_T_sensor[index],
            stamps_ns=self._chunk.column_stamps_ns[row].take(columns),
            pixels=hits.astype(np.int32),
            signal=signal.ravel().take(hits) if signal.any() else None,
            second_from=range_mm.size // 2 if self.session.n_returns == 2 else None,
            intensity=self._chunk.reflectivity[row].ravel().take(hits).astype(np.float32),
            pose_ns=int(self._chunk.column_stamps_ns[row, range_mm.shape[1] // 2]),
        )

    def scans(self) -> Iterator[PosedScan]:
        """Read all revolutions in order; each chunk is read once.

        Raises:
            InputError: As `scan`; or a revolution was recorded twice.
        """
        repeats = Repeats()
        for index, pose in enumerate(self.odom_T_sensor):
            scan = self.scan(index)
            assert self._chunk is not None
            row = index % self.session.chunk_scans
            stamp_ns = int(self._chunk.column_stamps_ns[row, 0])
            where = f"{chunk_path(self.session.path, self._chunk_index)}: scan {index}"
            repeats.require_new(where, f"scan {index}", self._chunk.range_mm[row], pose, stamp_ns)
            yield scan
