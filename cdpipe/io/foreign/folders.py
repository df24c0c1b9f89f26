"""Folders with one file per scan: PLY, PCD, LAS and KITTI, with their trajectory and times; E57, one or several."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.files import read_bytes
from cdpipe.core.geometry import Float64Array, invert, make_pose
from cdpipe.core.isolated_reader import IsolatedReader
from cdpipe.core.plugins import require_extra
from cdpipe.io.foreign.clouds import Cloud, CloudFiles, Clouds, check_cloud, stamps_of_names
from cdpipe.io.foreign.points_files import MOST_POINTS, cloud_reader, read_viewpoints
from cdpipe.io.foreign.scans import in_sensor_frames
from cdpipe.io.foreign.sniff import find_scans
from cdpipe.io.foreign.trajectory import Trajectory, read_poses, read_times
from cdpipe.io.tum import TUM_LINE, require_unit_poses

_NUMBERS = re.compile(r"(\d+)")
_TIMES = ("times.txt", "timestamps.txt", "stamps.txt")
_CALIBRATION = "calib.txt"
_MOST_SCANS = 10_000


def open_folder(folder: Path, name: str, has_poses: bool) -> Clouds:
    """Open a folder of scans.

    Args:
        folder: The folder; the scans may lie in a sub-folder such as velodyne/ or pcd/.
        name: Format of the scans, of `cdpipe.io.foreign.sniff.FORMATS`.
        has_poses: Whether the poses come from elsewhere, so that none are looked for.

    Raises:
        InputError: There are no scans, their names do not sort by number, or the poses cannot be read.
    """
    files = find_scans(folder, name)
    if not files:
        raise InputError(f"{folder}: no scans of the format {name} in it")
    _require_padded(folder, files)
    if has_poses and name == "kitti" and (folder / _CALIBRATION).is_file():
        told = "is not applied to a trajectory from elsewhere, which is taken for that of the lidar"
        told += f": KITTI's poses of the camera belong beside it, as {folder / 'poses.txt'}"
        warnings.warn(f"{folder / _CALIBRATION}: {told}", InputWarning, stacklevel=2)
    own = None if has_poses else _find_poses(folder, files[0].parent, name)
    clouds = CloudFiles(folder, files, cloud_reader(name, folder), own, _find_stamps(folder, files))
    clouds.lacks = f"expected exactly one trajectory (*.txt, *.tum or *.csv, lines {TUM_LINE}), found none"
    if own is None and not has_poses and name == "pcd" and files[0].parent == folder / "pcd":
        return _with_viewpoints(clouds, folder, files)
    return clouds


def _require_padded(folder: Path, files: list[Path]) -> None:
    if stamps_of_names(files) is not None:  # 1700000000.15 before 1700000000.2
        return
    if sorted(files, key=_by_number) != files:
        raise InputError(
            f"{folder}: the *{files[0].suffix} files are numbered without leading zeros, so that their names sort as "
            f"{files[0].name}, {files[1].name}, ...: pad the numbers to equal length"
        )


def _by_number(file: Path) -> list[int | str]:
    return [int(part) if part.isdecimal() else part for part in _NUMBERS.split(file.name)]


def _find_poses(folder: Path, scans: Path, name: str) -> Trajectory | None:
    """Return the one trajectory of a folder, None for none."""
    places = dict.fromkeys((folder, scans))
    found = sorted(file for place in places for kind in ("*.txt", "*.tum", "*.csv") for file in place.glob(kind))
    found = [file for file in found if file.name not in (*_TIMES, _CALIBRATION)]
    if name == "kitti" and (folder / "poses.txt") in found:
        found = [folder / "poses.txt"]
    if len(found) > 1:
        raise InputError(
            f"{folder}: expected exactly one trajectory (*.txt, *.tum or *.csv, lines {TUM_LINE}), found "
            f"{', '.join(file.name for file in found[:5])}: name it with --trajectory FILE"
        )
    if not found:
        return None
    trajectory = read_poses(found[0])
    if name == "kitti" and (folder / _CALIBRATION).is_file():
        camera_T_sensor = read_calibration(folder / _CALIBRATION)
        poses = invert(camera_T_sensor) @ trajectory.poses @ camera_T_sensor
        trajectory = Trajectory(trajectory.where, poses, trajectory.time_s)
    elif name == "kitti" and trajectory.time_s is None:
        told = (
            f"no {_CALIBRATION} beside it: its poses are taken for those of the lidar. KITTI's are of the camera: then"
        )
        usual = "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0"
        warnings.warn(f"{found[0]}: {told} add {_CALIBRATION} with its line `{usual}`", InputWarning, stacklevel=2)
    return trajectory


def read_calibration(path: Path) -> Float64Array:
    """Return the (4, 4) `camera_T_lidar` of KITTI's calib.txt: its line `Tr:` (or `Tr_velo_to_cam:`) of 12 numbers.

    KITTI's poses are those of the left camera; the lidar's are `Tr^-1 pose Tr`.

    Raises:
        InputError: There is no such line, or it is no rigid transform.
    """
    text = read_bytes(path, 1 << 20).decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        key, _, rest = line.partition(":")
        if key.strip() not in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
            continue
        try:
            rows = np.array([float(word) for word in rest.split()]).reshape(3, 4)
        except ValueError as error:
            raise InputError(f"{path}:{number}: expected `Tr:` and 12 numbers: {error}") from error
        if not np.isfinite(rows).all() or np.abs(rows[:, :3] @ rows[:, :3].T - np.eye(3)).max() > 1e-3:
            raise InputError(
                f"{path}:{number}: Tr is no rotation with a translation: expected 12 numbers of a 3x4 matrix"
            )
        if np.linalg.det(rows[:, :3]) < 0:
            raise InputError(f"{path}:{number}: Tr mirrors: expected a right-handed rotation")
        return make_pose(Rotation.from_matrix(rows[:, :3]).as_matrix(), rows[:, 3])
    raise InputError(f"{path}: no line `Tr:` in it, the pose of the lidar in the camera's frame: remove it, or add it")


def _find_stamps(folder: Path, files: list[Path]) -> Float64Array | None:
    for place in (files[0].parent, folder, files[0].parent.parent):
        for name in _TIMES:
            if (place / name).is_file() and (place == folder or folder in place.parents):
                stamps_s = read_times(place / name)
                if len(stamps_s) != len(files):
                    raise InputError(
                        f"{place / name}: {len(stamps_s)} times for {len(files)} scans: one line each is needed"
                    )
                return stamps_s
    return stamps_of_names(files)


def _with_viewpoints(clouds: CloudFiles, folder: Path, files: list[Path]) -> Clouds:
    """Return scans as DynamicMap_Benchmark has them: points in one frame, VIEWPOINT the sensor's pose in it."""
    rows = read_viewpoints(folder, files)
    if np.allclose(rows, rows[0]):
        return clouds
    require_unit_poses(rows, lambda index: f"{files[index]}: VIEWPOINT")
    poses = make_pose(Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3])
    clouds.own = Trajectory(f"VIEWPOINT of {folder}", poses)
    return in_sensor_frames(clouds, poses)


class E57Scans:
    """The scans of an E57 file, or of all E57 files of a folder, one for each place where a scanner stood: `Clouds`."""

    is_stream = False

    def __init__(self, path: Path, has_poses: bool) -> None:
        """List the scans; those of a folder are in the order of the numbers in the names of its files.

        Args:
            path: The file or folder.
            has_poses: Whether the poses come from elsewhere, so that none are looked for.

        Raises:
            InputError: There are no scans, too many or too large ones, or their poses cannot be used.
        """
        require_extra("formats", str(path))
        self.name, self.lacks = str(path), "no pose of its scans in it"
        self.stamps_s: Float64Array | None = None
        self._path, self._reader = path, IsolatedReader("cdpipe.io.foreign.points_files", path, "pye57")
        files = find_scans(path, "e57") if path.is_dir() else [path]
        if stamps_of_names(files) is None:
            files.sort(key=_by_number)
        self._scans: list[tuple[Path, int]] = []
        poses: list[list[float] | None] = []
        for file in files:
            for number, (about, _) in enumerate(self._reader.read("read_e57_heads", path=str(file))):
                self._scans.append((file, number))
                _require_few(self.where(-1), about["points"])
                poses.append(about["pose"])
        if not 0 < len(self) <= _MOST_SCANS:
            raise InputError(f"{path}: {len(self)} scans: expected 1 to {_MOST_SCANS}")
        self.own: Trajectory | None = None if has_poses else self._make_poses(poses)
        if has_poses and path.is_dir():
            _require_padded(path, sorted(files))

    def _make_poses(self, poses: list[list[float] | None]) -> Trajectory | None:
        """Return the poses of the scanner, those of x, y, z and qw, qx, qy, qz in E57; None if a scan has none."""
        known = [pose for pose in poses if pose is not None]
        if len(known) < len(poses):
            return None
        rows = np.array(known, np.float64)[:, [0, 1, 2, 4, 5, 6, 3]]
        require_unit_poses(rows, self.where)
        return Trajectory(self.name, make_pose(Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3]))

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._scans)

    def where(self, index: int) -> str:
        """Name a scan."""
        file, number = self._scans[index]
        return f"{file}: scan {number}"

    def read(self, index: int) -> Cloud:
        """Read one scan."""
        file, number = self._scans[index]
        ((_, arrays),) = self._reader.read("read_e57", path=str(file), index=number)
        return check_cloud(self.where(index), arrays)

    def read_all(self) -> Iterator[Cloud]:
        """Read all scans."""
        return (self.read(index) for index in range(len(self)))


def _require_few(where: str, n_points: int) -> None:
    if not 0 <= n_points <= MOST_POINTS:
        raise InputError(f"{where}: {n_points} points: at most {MOST_POINTS} are read: thin it")
