"""The scans of a session or a recording as they leave: points, stamps of one clock, poses, and a value per return."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int32Array, Int64Array, make_pose
from cdpipe.core.progress import Progress
from cdpipe.io.foreign.scans import PosedClouds
from cdpipe.io.readers import RecordedScans
from cdpipe.io.session import ScanChunk
from cdpipe.model.types import PosedScan, ScanSource
from cdpipe.sensor.ouster import BARE_POINTS

Fields = Callable[[int, Int32Array], Mapping[str, npt.NDArray[Any]]]
"""Returns further values (N,) by name of the returns at (N,) pixels of a scan, given its index."""
START_NS = 1_000_000_000
"""Time at which the clock of a simulated session starts: in ROS a stamp of 0 means "no time"."""
_STEPS = 21  # poses in one sweep: points that a reader deskews by them are off by less than 1 mm


@dataclass(frozen=True, slots=True, eq=False)
class OutScan:
    """One scan.

    Attributes:
        index: Its position in the session.
        stamp_ns: Time of its pose, of the recording's clock.
        odom_T_sensor: (4, 4) pose of the sensor at that time.
        points: (N, 3) returns, metres; deskewed into the sensor frame of that pose, or (`Outgoing.sweeps`) each in the
            sensor frame at its own time.
        offset_ns: (N,) int64 time of each return after the stamp; None where the recording has none.
        scalars: (N,) values of each return by name: `intensity` and `ring` where known, then those of the caller.
        path_ns: (P,) times at which the poses within the sweep are known, from the stamp on.
        path: (P, 4, 4) these poses.
    """

    index: int
    stamp_ns: int
    odom_T_sensor: Float64Array
    points: Float64Array
    offset_ns: Int64Array | None
    scalars: dict[str, npt.NDArray[Any]]
    path_ns: Int64Array
    path: Float64Array


class Outgoing:
    """A session or recording that is to be written in another format.

    Attributes:
        name: The source.
        odom_T_sensor: (S, 4, 4) pose of each scan.
        session: Its session folder; None of other recordings.
        has_scans: Whether somebody recorded the scans; those of a whole map are of stations, whose times mean nothing.
    """

    def __init__(self, source: ScanSource, fields: Fields | None = None) -> None:
        """Keep what to write.

        Args:
            source: Of `cdpipe.io.readers.open_session`.
            fields: What is known of each return beside what the sensor measured; None for nothing.
        """
        self.name, self.odom_T_sensor = source.name, source.odom_T_sensor
        self._source, self._fields = source, fields
        self.session = source.session if isinstance(source, RecordedScans) else None
        self.has_scans = not getattr(source, "is_whole_map", False)

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.odom_T_sensor)

    @property
    def start_ns(self) -> int:
        """Time of the recording's clock from which stamps of its scans count."""
        if self.session is not None:
            return int(self.session.provenance.get("sensor_clock_start_ns", START_NS))
        return round(float(self._posed_clouds().stamps_s[0]) * 1e9)

    def span_s(self) -> tuple[float, float]:
        """Return the first and the last time at which a column of a session, or a scan, was taken."""
        if self.session is None:
            stamps_s = self._posed_clouds().stamps_s
            return float(stamps_s.min()), float(stamps_s.max())
        first_ns = int(self.session.chunk(0).column_stamps_ns.min()) + self.start_ns
        last_ns = int(self.session.chunk(self.session.n_chunks - 1).column_stamps_ns.max()) + self.start_ns
        return first_ns / 1e9, last_ns / 1e9

    def require_scans(self) -> None:
        """Raise `InputError` of a whole map: its stations were no scans, and only a map can be made of it."""
        if not self.has_scans:
            told = "a map without its scans has no poses or times"
            raise InputError(f"{self.name}: {told}: name a new .laz or .ply")

    def stamps_ns(self) -> Int64Array:
        """Return the time (S,) of the pose of each scan.

        Raises:
            InputError: As `require_scans`.
        """
        self.require_scans()
        return self._stamps_ns()

    def _stamps_ns(self) -> Int64Array:
        if self.session is None:
            return np.round(self._posed_clouds().stamps_s * 1e9).astype(np.int64)
        middle = self.session.sensor.width // 2
        found = [chunk.column_stamps_ns[:, middle] for chunk in self.session.chunks()]
        return np.concatenate(found) + self.start_ns

    def scans(self, report: Progress) -> Iterator[OutScan]:
        """Read the scans in order, deskewed.

        Raises:
            InputError: As `ScanSource.scans`.
        """
        stamps_ns, start_ns = self._stamps_ns(), self.start_ns
        for scan in self._source.scans():
            stamp_ns = int(stamps_ns[scan.index])
            offset_ns = scan.stamps_ns + start_ns - stamp_ns
            yield OutScan(
                scan.index,
                stamp_ns,
                scan.odom_T_sensor,
                scan.points_sensor,
                offset_ns if offset_ns.any() else None,
                self._scalars(scan),
                np.array([stamp_ns]),
                scan.odom_T_sensor[None],
            )
            report("write", scan.index + 1, len(self))

    def sweeps(self, report: Progress) -> Iterator[OutScan]:
        """Read the scans in order as the sensor measures them: stamped at their first column, and not deskewed.

        Those of a recording that is no session are deskewed, and without offsets. So are those of a session with a ray
        for each return, which `graft` makes of bare points: its columns are no sweep.

        Raises:
            InputError: As `ScanSource.scans`.
        """
        if self.session is None or self.session.sensor.product == BARE_POINTS:
            yield from (replace(scan, offset_ns=None) for scan in self.scans(report))
            return
        chunks = enumerate(self.session.chunks())
        chunk_index, chunk = -1, None
        for scan in self._source.scans():
            if chunk is None or scan.index // self.session.chunk_scans != chunk_index:
                chunk_index, chunk = next(chunks)
            yield self._sweep(scan, chunk, scan.index % self.session.chunk_scans)
            report("write", scan.index + 1, len(self))

    def _sweep(self, scan: PosedScan, chunk: ScanChunk, row: int) -> OutScan:
        assert self.session is not None
        sensor = self.session.sensor
        points = sensor.project(chunk.range_mm[row] / 1000.0).reshape(-1, 3)[scan.pixels]
        columns = np.unique(np.linspace(0, sensor.width - 1, _STEPS).astype(np.int64))
        poses = chunk.column_poses[row][columns].astype(np.float64)
        path = scan.odom_T_sensor @ make_pose(Rotation.from_quat(poses[:, 3:]).as_matrix(), poses[:, :3])
        stamps_ns = chunk.column_stamps_ns[row]
        first_ns = int(stamps_ns[0])
        clock_ns = self.start_ns or START_NS  # 0 is no time to players
        path_ns, start_ns = stamps_ns[columns] + clock_ns, first_ns + clock_ns
        scalars = self._scalars(scan)
        return OutScan(scan.index, start_ns, path[0], points, scan.stamps_ns - first_ns, scalars, path_ns, path)

    def _scalars(self, scan: PosedScan) -> dict[str, npt.NDArray[Any]]:
        found: dict[str, npt.NDArray[Any]] = {} if scan.intensity is None else {"intensity": scan.intensity}
        if self.session is not None:
            rings = scan.pixels // self.session.sensor.width % self.session.sensor.height
            found["ring"] = rings.astype(np.uint16)
        return found | dict(self._fields(scan.index, scan.pixels) if self._fields is not None else {})

    def _posed_clouds(self) -> PosedClouds:
        if not isinstance(self._source, PosedClouds):
            raise InputError(f"{self.name}: no recording with stamps: convert it to a session first")
        return self._source
