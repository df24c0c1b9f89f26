"""Convert a sensor recording to a session: revolutions, and poses from the recording, a trajectory or KISS-ICP.

Sources of the poses:

- `own`: an OSF has a pose for each column (`body_to_world`, with the sensor's mounting `sensor_to_body`);
- a TUM file of `odom_T_sensor` with stamps of the sensor's clock, interpolated to every column;
- `kiss-icp`, `genz-icp`: one pose per revolution at its middle column, interpolated; the odom frame is the first
  sensor frame.

Both returns of a beam are kept. A missing column has no returns and an interpolated stamp and pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float32Array, Float64Array, Int64Array, make_pose, require_poses
from cdpipe.core.geometry.motion import Motion, make_motion
from cdpipe.core.plugins import require_extra
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.io.foreign.trajectory import read_poses
from cdpipe.io.ouster.beams import check_beams
from cdpipe.io.ouster.captures import Recording, Revolution, open_recording
from cdpipe.io.readers import RecordedScans
from cdpipe.io.session import ScanChunk, Session, SessionWriter, fit_chunk
from cdpipe.io.tum import motion_along
from cdpipe.mapping.poses.odometry import ODOMETRIES, Image, estimate_motion
from cdpipe.mapping.poses.pose_check import check_poses
from cdpipe.mapping.session_check import require_path_in_metres
from cdpipe.model.types import PosedScan, WrappedScans

KISS_ICP = "kiss-icp"
_OWN_POSE_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Imported:
    """Summary of a converted recording.

    Attributes:
        n_scans: Number of revolutions in the session.
        poses: Source of the poses.
        sensor: Product line and mode.
        n_left_out: Number of revolutions left out because at most half of their columns arrived.
    """

    n_scans: int
    poses: str
    sensor: str
    n_left_out: int


@dataclass(frozen=True, slots=True, eq=False)
class _Times:
    """Of each revolution the first, middle and last stamp (S,), and whether it has poses and returns (S,); and counts.

    Attributes:
        n_left_out: Number of revolutions left out.
        n_returns: Returns of each beam.
    """

    first_ns: Int64Array
    middle_ns: Int64Array
    last_ns: Int64Array
    has_own_pose: BoolArray
    has_returns: BoolArray
    n_left_out: int
    n_returns: int


def import_recording(
    source: Path,
    out: Path,
    *,
    metadata: Path | None = None,
    trajectory: Path | None = None,
    odometry: str | None = None,
    origin_m: Sequence[float] = (0.0, 0.0, 0.0),
    on_progress: Progress | None = None,
) -> Imported:
    """Convert an OSF or a PCAP to a session folder; the folder gets its name when it is complete.

    Args:
        source: The recording.
        out: The new folder.
        metadata: The sensor's metadata .json of a PCAP; default: the file of the same name next to it.
        trajectory: TUM, KITTI or CSV file with the sensor's poses, which replaces the recording's own. Without times
            it has one pose for each revolution, at its first column.
        odometry: "kiss-icp" or "genz-icp" estimates the poses instead.
        origin_m: Metres to subtract from the positions of poses that are not estimated, as of a map grid (UTM).
        on_progress: Called with the stage, the number of finished revolutions and their estimated total.

    Raises:
        InputError: A file cannot be used, `out` exists, there are no poses, or those of the trajectory have w first.
    """
    if odometry is not None and odometry not in ODOMETRIES:
        raise InputError(f"--odometry {odometry}: expected {' or '.join(ODOMETRIES)}")
    if odometry is not None and trajectory is not None:
        raise InputError("--trajectory and --odometry both give the poses: leave one out")
    if odometry is not None:
        require_extra(ODOMETRIES[odometry], f"--odometry {odometry}")
    report = on_progress or report_nothing
    recording = open_recording(source, metadata)
    times = _read_times(recording, report)
    motion, poses = _choose_motion(recording, times, trajectory, odometry, report)
    provenance = {
        "made_by": "tunnelcd convert",
        "recording": source.name,
        "poses": poses,
        "sensor_clock_start_ns": int(times.first_ns[0]),
        "revolutions_left_out": times.n_left_out,
    }
    chunk_scans = fit_chunk(recording.sensor.height * times.n_returns, recording.sensor.width)
    with SessionWriter(out, recording.sensor, chunk_scans, provenance, times.n_returns) as writer:
        odom_T_sensor = _write(writer, chunk_scans, recording, times, motion, report)
        odom_T_sensor[:, :3, 3] -= origin_m if odometry is None else (0.0, 0.0, 0.0)
        if trajectory is not None:
            written = Session(
                writer.folder, recording.sensor, odom_T_sensor, chunk_scans, provenance, n_returns=times.n_returns
            )
            scans = _ScansWithReturns(written, times.has_returns)
            require_path_in_metres(scans, str(trajectory))
            check_poses(scans, str(trajectory))
        writer.close(odom_T_sensor)
    sensor = f"{recording.sensor.product}, {recording.sensor.mode}"
    return Imported(len(times.first_ns), poses, sensor, times.n_left_out)


class _ScansWithReturns(WrappedScans):
    """The revolutions of a session that is still being written, without those that nothing came back from."""

    def __init__(self, written: Session, has_returns: BoolArray) -> None:
        super().__init__(RecordedScans(written))
        self._kept = np.flatnonzero(has_returns)

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) pose of each."""
        return self._source.odom_T_sensor[self._kept]

    def scan(self, index: int) -> PosedScan:
        """Read one revolution."""
        return self._source.scan(int(self._kept[index]))

    def scans(self) -> Iterator[PosedScan]:
        """Read all of them in order."""
        return (self.scan(index) for index in range(len(self._kept)))


def _read_times(recording: Recording, report: Progress) -> _Times:
    stamps_ns: list[Int64Array] = []
    has_own_pose, has_returns, rows = [], [], set()
    left_out: list[int] = []
    middle = recording.sensor.width // 2
    for number, revolution in enumerate(recording.revolutions(left_out.append)):
        report("look through", number, recording.n_guessed)
        if recording.metadata is not None and not stamps_ns:
            first = revolution.range_mm[: recording.sensor.height]
            check_beams(first, recording.sensor, recording.metadata, recording.path)
        stamps_ns.append(revolution.column_stamps_ns[[0, middle, -1]])
        rows.add(len(revolution.range_mm))
        has_returns.append(bool(revolution.range_mm.any()))
        off = np.abs(revolution.odom_T_column[revolution.is_valid] - recording.sensor_to_body)
        has_own_pose.append(off.max() > _OWN_POSE_TOLERANCE)
    report("look through", len(stamps_ns), len(stamps_ns))
    if len(rows) > 1:
        raise InputError(f"{recording.path}: some revolutions have two returns of each beam and some one: cut it there")
    first_ns, middle_ns, last_ns = np.array(stamps_ns).T
    n_returns = rows.pop() // recording.sensor.height
    is_known = np.array(has_own_pose), np.array(has_returns)
    return _Times(first_ns, middle_ns, last_ns, *is_known, len(left_out), n_returns)


def _choose_motion(
    recording: Recording, times: _Times, trajectory: Path | None, odometry: str | None, report: Progress
) -> tuple[Motion | None, str]:
    """Return the motion, its time counted from the first column (None: each column has a pose), and its name."""
    start_ns = int(times.first_ns[0])
    if trajectory is not None:
        # the vendor's tool writes one pose per revolution, at its first column
        slack_s = 1.5 / recording.sensor.rate_hz
        rows = _pose_rows(trajectory, times)
        return motion_along(
            trajectory, start_ns, int(times.last_ns[-1]), slack_s, rows
        ), f"trajectory {trajectory.name}"
    if odometry is not None:
        offsets_ns = recording.sensor.column_offsets_ns()
        column_s = (offsets_ns - offsets_ns[len(offsets_ns) // 2]) / 1e9
        images = _images(recording, len(times.first_ns), report)
        try:
            middle_s = (times.middle_ns - start_ns) / 1e9
            return estimate_motion(images, recording.sensor, middle_s, column_s, make_pose(), odometry), odometry
        except InputError as error:
            raise InputError(f"{recording.path}: {error}: give the poses with --trajectory") from error
    # the first revolution may be at the origin of the pose frame, which looks like a missing pose
    bare = 1 + np.flatnonzero(~times.has_own_pose[1:])
    if times.has_own_pose.any() and not bare.size:
        return None, "own"
    lack = "no poses in it"
    if times.has_own_pose.any():
        lack = f"{bare.size} of its {len(times.first_ns)} revolutions have no poses, the first of them number {bare[0]}"
    raise InputError(
        f"{recording.path}: {lack}: give --trajectory FILE (the sensor's poses, stamped by its clock), or "
        f"--odometry {KISS_ICP} to estimate them"
    )


def _pose_rows(trajectory: Path, times: _Times) -> Float64Array | None:
    """Return the (N, 8) stamps and poses of a KITTI or CSV file, as rows of a TUM file; None of a TUM file.

    Raises:
        InputError: The file is no trajectory, or has no times and not one pose for each revolution.
    """
    found = read_poses(trajectory)
    if found.is_tum:
        return None
    n_poses, n_revolutions = len(found.poses), len(times.first_ns)
    if found.time_s is None and n_poses != n_revolutions:
        raise InputError(
            f"{trajectory}: {n_poses} poses without times for {n_revolutions} revolutions: one for each is needed"
        )
    if n_poses < 2:
        raise InputError(f"{trajectory}: {n_poses} poses: a trajectory needs two or more")
    stamps_s = times.first_ns / 1e9 if found.time_s is None else found.time_s
    quaternions = Rotation.from_matrix(found.poses[:, :3, :3]).as_quat()
    return np.column_stack([stamps_s, found.poses[:, :3, 3], quaternions])


def _images(recording: Recording, n_scans: int, report: Progress) -> Iterator[Image]:
    for number, revolution in enumerate(recording.revolutions()):
        report("odometry", number, n_scans)
        yield revolution.range_mm, revolution.signal
    report("odometry", n_scans, n_scans)


def _write(
    writer: SessionWriter,
    chunk_scans: int,
    recording: Recording,
    times: _Times,
    motion: Motion | None,
    report: Progress,
) -> Float64Array:
    """Write all chunks, of so many revolutions; return the (S, 4, 4) pose of each revolution at its middle column."""
    start_ns, n_scans = int(times.first_ns[0]), len(times.first_ns)
    odom_T_sensor: list[Float64Array] = []
    revolutions = recording.revolutions()
    while batch := list(islice(revolutions, chunk_scans)):
        column_poses = []
        for revolution in batch:
            stamps_s = (revolution.column_stamps_ns - start_ns) / 1e9
            drive = motion or _own_motion(revolution, stamps_s, f"{recording.path}: revolution {len(odom_T_sensor)}")
            pose, sensor_T_column = _column_poses(drive, stamps_s)
            odom_T_sensor.append(pose)
            column_poses.append(sensor_T_column)
        writer.add(
            ScanChunk(
                np.stack([each.range_mm for each in batch]),
                np.stack([each.reflectivity for each in batch]),
                np.stack([each.signal for each in batch]),
                np.stack([each.column_stamps_ns for each in batch]) - start_ns,
                np.stack(column_poses),
            )
        )
        report("write", len(odom_T_sensor), n_scans)
    return np.stack(odom_T_sensor)


def _own_motion(revolution: Revolution, stamps_s: Float64Array, where: str) -> Motion:
    """Return the motion through the poses of the columns that arrived, to interpolate the missing ones."""
    poses = revolution.odom_T_column[revolution.is_valid]
    try:
        require_poses("its column poses", poses)
    except ValueError as error:
        raise InputError(f"{where}: {error}: give the poses with --trajectory or --odometry {KISS_ICP}") from error
    known_s = stamps_s[revolution.is_valid]
    return make_motion(known_s, np.zeros(len(known_s)), poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]))


def _column_poses(motion: Motion, stamps_s: Float64Array) -> tuple[Float64Array, Float32Array]:
    """Return odom_T_sensor (4, 4) at the middle column, and sensor_T_column (W, 7) as a session stores it."""
    points, quaternions = motion.sample(stamps_s)
    rotations = Rotation.from_quat(quaternions)
    middle = len(stamps_s) // 2
    sensor_R_odom = rotations[middle].inv()
    stored = np.concatenate(
        [sensor_R_odom.apply(points - points[middle]), (sensor_R_odom * rotations).as_quat(canonical=True)], axis=1
    )
    return make_pose(rotations[middle].as_matrix(), points[middle]), stored.astype(np.float32)
