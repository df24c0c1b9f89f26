"""Open a recording of any format: its scans, and poses from itself, a trajectory or KISS-ICP."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array
from cdpipe.core.geometry.motion import Motion
from cdpipe.core.plugins import require_extra
from cdpipe.core.progress import Progress
from cdpipe.io.foreign.clouds import Cloud, Clouds, point_times
from cdpipe.io.foreign.folders import E57Scans, open_folder
from cdpipe.io.foreign.points_files import cloud_reader
from cdpipe.io.foreign.scans import PosedClouds, in_sensor_frames
from cdpipe.io.foreign.sniff import FORMATS, guess_format, require_format_name
from cdpipe.io.foreign.trajectory import Trajectory, poses_at, read_poses, require_times_of_scans
from cdpipe.io.foreign.whole_map import MapStations
from cdpipe.io.ply import write_ply_points
from cdpipe.io.session import is_session
from cdpipe.io.tum import write_tum
from cdpipe.mapping.poses.odometry import ODOMETRIES, estimate_cloud_motion
from cdpipe.mapping.poses.pose_check import check_poses
from cdpipe.mapping.session_check import require_path_in_metres
from cdpipe.model.types import PosedScan

KISS_ICP = "kiss-icp"
# Called with the stage, the number of finished scans, and their (estimated) total.
_NOMINAL_S = 0.1  # between scans that have no times


@dataclass(frozen=True, slots=True)
class HowToRead:
    """What a person says about a recording; None is guessed.

    Attributes:
        format: Name in `FORMATS`.
        topics: Topics of a bag, of its clouds and of its poses.
        trajectory: File of the sensor's poses.
        odometry: "kiss-icp" or "genz-icp" estimates the poses.
        metadata: The .json of a PCAP's sensor.
        deskew: Whether points that have times are deskewed; False where they are already.
        origin_m: Metres to subtract from the points of a map and from the positions of poses, as of a map grid (UTM).
    """

    format: str | None = None
    topics: tuple[str, ...] = ()
    trajectory: Path | None = None
    odometry: str | None = None
    metadata: Path | None = None
    deskew: bool = True
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.format is not None:
            require_format_name(self.format)
        if self.odometry is not None and self.odometry not in ODOMETRIES:
            raise InputError(f"--odometry {self.odometry}: expected {' or '.join(ODOMETRIES)} (a file: --trajectory)")
        if self.odometry is not None and self.trajectory is not None:
            raise InputError("--trajectory and --odometry both give the poses: leave one out")

    def require_nothing(self, path: str | Path, why: str) -> None:
        """Refuse options where they have no use; the format `session` says of a session what it is.

        Raises:
            InputError: One is given.
        """
        values = {
            "format": None if self.format == "session" else self.format, "topic": self.topics,
            "trajectory": self.trajectory, "odometry": self.odometry, "metadata": self.metadata,
            "no-deskew": not self.deskew, "origin": any(self.origin_m),
        }  # fmt: skip
        for name in (name for name, value in values.items() if value):
            again = (
                ": it is subtracted where a recording becomes a session: convert that again" if name == "origin" else ""
            )
            raise InputError(f"{path}: {why}: leave --{name} out{again}")

    def subtracted_m(self, path: Path) -> tuple[float, float, float]:
        """Return what is subtracted from the positions of a recording: nothing from a session or estimated poses."""
        return (0.0, 0.0, 0.0) if is_session(path) or self.odometry is not None else self.origin_m


def folder_of_options(folder: Path, how: HowToRead) -> Path:
    """Return the folder that stores the descriptors of a recording: `folder`, or one in it for other options."""
    if how == HowToRead():
        return folder
    values = {name: each.resolve() if isinstance(each, Path) else each for name, each in asdict(how).items()}
    told = repr(sorted((name, str(value)) for name, value in values.items()))
    return folder / f"options-{hashlib.blake2b(told.encode(), digest_size=4).hexdigest()}"


class _Posed(PosedClouds):
    """Scans with poses, and where those came from."""

    def __init__(
        self,
        clouds: Clouds,
        poses: Float64Array,
        stamps_s: Float64Array,
        motion: Motion | None,
        poses_from: str,
        *,
        deskew: bool,
    ) -> None:
        super().__init__(clouds, poses, stamps_s, motion, deskew=deskew)
        self.clouds, self.poses_from = clouds, poses_from


def open_recording(path: Path, how: HowToRead, report: Progress) -> PosedClouds:
    """Open a recording that is no session folder and no Ouster's.

    A bag is first written to a temporary folder, which is removed with the source.

    Raises:
        InputError: It cannot be read, has no poses, or they do not fit its scans.
    """
    source = _pose(_open_clouds(path, how, report), how, report)
    source.is_whole_map = isinstance(source.clouds, MapStations)
    if source.is_whole_map:
        return source
    if not source.clouds.is_stream:
        if how.odometry is None and len(source.odom_T_sensor) > 1:
            check_poses(source, source.poses_from)
        return source
    with _removed_on_error(Path(tempfile.mkdtemp(prefix="tunnelcd-read-"))) as folder:
        opened = _write_stream(source, folder / "scans", how, report)
    opened.name, opened.is_temporary = str(path), True
    weakref.finalize(opened, shutil.rmtree, folder, ignore_errors=True)
    return opened


def convert_recording(path: Path, out: Path, how: HowToRead, report: Progress) -> tuple[int, str]:
    """Write a recording as PLY scans with a TUM trajectory; return the number of scans, and what the poses are from.

    Raises:
        InputError: As `open_recording`, or the folder cannot be written.
    """
    source = _pose(_open_clouds(path, how, report), how, report)
    if isinstance(source.clouds, MapStations):
        raise InputError(f"{path}: a map without its scans is no session: `detect` takes it as it is")
    if source.clouds.is_stream:
        _write_stream(source, out, how, report)
    else:
        if how.odometry is None:
            require_path_in_metres(source, source.poses_from)
            check_poses(source, source.poses_from)
        write_scans(source, out, report)
    return len(source.odom_T_sensor), source.poses_from


def _write_stream(source: _Posed, folder: Path, how: HowToRead, report: Progress) -> PosedClouds:
    """Write scans that can be read once, and open them; poses of a file are checked against them then."""
    write_scans(source, folder, report)
    clouds = open_folder(folder, "ply", has_poses=True)
    opened = PosedClouds(clouds, source.odom_T_sensor, source.stamps_s, None)
    if how.odometry is None:
        require_path_in_metres(opened, source.poses_from)
    if how.trajectory is not None:
        check_poses(opened, source.poses_from)
    return opened


def write_scans(source: _Posed, out: Path, report: Progress) -> None:
    """Write scans as `000000.ply` and so on, deskewed, and `trajectory.tum`, into a new or an empty folder.

    Raises:
        InputError: A scan cannot be read, or the folder not be written.
    """
    n_scans = len(source.odom_T_sensor)
    try:
        out.mkdir(exist_ok=True)
        for scan in source.scans():
            write_ply_points(out / f"{scan.index:06d}.ply", scan.points_sensor, _scalars(scan))
            report("write", scan.index + 1, n_scans)
        write_tum(out / "trajectory.tum", source.stamps_s, source.odom_T_sensor)
    except OSError as error:
        raise InputError(f"{error.filename or out}: cannot be written: {error.strerror}") from error


def _scalars(scan: PosedScan) -> dict[str, npt.NDArray[Any]]:
    """Return what a PLY scan keeps beside its points: intensity, and seconds after the first point, where known."""
    found: dict[str, npt.NDArray[Any]] = {} if scan.intensity is None else {"intensity": scan.intensity}
    since_ns = scan.stamps_ns - scan.stamps_ns.min()
    return found | ({"time": since_ns / 1e9} if since_ns.any() else {})


@contextmanager
def _removed_on_error(folder: Path) -> Iterator[Path]:
    try:
        yield folder
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _open_clouds(path: Path, how: HowToRead, report: Progress) -> Clouds:
    """Open what holds the scans; poses are not looked for where a person says where they come from."""
    name = guess_format(path, how.format)
    is_posed = how.trajectory is not None or how.odometry is not None
    if name == "e57":
        return _open_e57(path, how, is_posed)
    if name == "bag":
        from cdpipe.io.foreign.bags import BagScans  # noqa: PLC0415 - not before a bag is read

        return BagScans(path, how.topics, is_posed, report)
    if not FORMATS[name].in_folders:
        raise InputError(f"{path}: --format {name}: not here: expected a file that is {FORMATS[name].about}")
    if path.is_dir():
        return open_folder(path, name, has_poses=is_posed)
    if is_posed:
        raise InputError(
            f"{path}: one cloud, a map without its scans, has no poses: leave --trajectory and --odometry out, or name "
            "a folder with one file per scan"
        )
    return _stations(path, cloud_reader(name, path)(path), how)


def _open_e57(path: Path, how: HowToRead, is_posed: bool) -> Clouds:
    """Open E57 scans; a single one without a pose is a whole map, as one cloud of another format is."""
    scans = E57Scans(path, has_poses=is_posed)
    if len(scans) == 1 and scans.own is None and not is_posed:
        return _stations(path, scans.read(0), how)
    return scans


def _stations(path: Path, cloud: Cloud, how: HowToRead) -> MapStations:
    return MapStations(path, replace(cloud, points=cloud.points - np.array(how.origin_m)))


def _pose(clouds: Clouds, how: HowToRead, report: Progress) -> _Posed:
    """Give poses to scans: of a trajectory, of KISS-ICP, or their own."""
    if how.odometry is not None:
        return _estimate(clouds, how, report)
    trajectory = read_poses(how.trajectory) if how.trajectory is not None else clouds.own
    if trajectory is not None and not isinstance(clouds, MapStations):
        trajectory = trajectory.less(how.origin_m)
    if trajectory is None:
        raise InputError(
            f"{clouds.name}: {clouds.lacks}: give --trajectory FILE (poses of the sensor: TUM, KITTI or CSV), "
            f"or --odometry {KISS_ICP} to estimate them"
        )
    n_poses, n_scans = len(trajectory.poses), len(clouds)
    stamps_s, motion = clouds.stamps_s, trajectory.motion()
    if stamps_s is not None and trajectory.time_s is not None and (clouds.is_stream or n_poses != n_scans):
        poses = poses_at(trajectory, stamps_s, clouds.name)
    elif n_poses != n_scans:
        suffix = f"*{Path(clouds.where(0)).suffix} " if not clouds.is_stream else ""
        raise InputError(
            f"{trajectory.where}: {n_poses} poses for {n_scans} {suffix}scans: one line for each scan is needed, in "
            f"the order of the file names; or the times of both: {_lacking(trajectory, stamps_s)}"
        )
    else:
        poses = trajectory.poses
        require_times_of_scans(trajectory, stamps_s, clouds.name)
        if trajectory.time_s is not None:
            stamps_s = trajectory.time_s
        elif stamps_s is not None:
            motion = Trajectory("", poses, stamps_s).motion()
    if trajectory.holds_clouds:
        clouds = in_sensor_frames(clouds, Trajectory("", poses).less([-metres for metres in how.origin_m]).poses)
    times_s = stamps_s if stamps_s is not None else _nominal_s(n_scans)
    return _Posed(clouds, poses, times_s, motion, trajectory.where, deskew=how.deskew)


def _nominal_s(n_scans: int) -> Float64Array:
    return _NOMINAL_S * np.arange(n_scans, dtype=np.float64)


def _lacking(trajectory: Trajectory, stamps_s: Float64Array | None) -> str:
    lacks = ["the trajectory has none"] if trajectory.time_s is None else []
    if stamps_s is None:
        lacks.append(
            "the scans have none (add times.txt beside them, one line each, or name the files by their stamps)"
        )
    return "; ".join(lacks)


def _estimate(clouds: Clouds, how: HowToRead, report: Progress) -> _Posed:
    odometry = str(how.odometry)
    require_extra(ODOMETRIES[odometry], f"--odometry {odometry}")
    n_scans = len(clouds)
    stamps_s = clouds.stamps_s if clouds.stamps_s is not None else _nominal_s(n_scans)

    def frames() -> Iterator[tuple[Float64Array, Float64Array | None]]:
        for number, cloud in enumerate(clouds.read_all()):
            report("odometry", number, n_scans)
            is_return = cloud.points.any(axis=1) & np.isfinite(cloud.points).all(axis=1)
            times = point_times(cloud.times[is_return], float(stamps_s[number])) if cloud.times is not None else None
            yield cloud.points[is_return], times if how.deskew else None
        report("odometry", n_scans, n_scans)

    try:
        poses = estimate_cloud_motion(frames(), stamps_s, odometry)
    except InputError as error:
        raise InputError(f"{clouds.name}: {error}: give the poses with --trajectory") from error
    motion = Trajectory("", poses, stamps_s).motion()
    return _Posed(clouds, poses, stamps_s, motion, odometry, deskew=how.deskew)
