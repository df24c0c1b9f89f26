"""One session of a grafted pair before anything is cast into it: some revolutions of a recording, at its poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float32Array, Float64Array, Int64Array, make_pose, transform
from cdpipe.io.session import Session
from cdpipe.io.tum import require_unit_poses
from sim.session.truth import SessionName


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Some revolutions of a recording.

    Attributes:
        name: Its part in the pair.
        source: The recording.
        scans: (S,) numbers of its revolutions in the recording, rising.
        world_T_odom: (4, 4) the recording's odom frame in the world, which is that of the before session.
    """

    name: SessionName
    source: Session
    scans: Int64Array
    world_T_odom: Float64Array

    @property
    def odom_T_sensor(self) -> Float64Array:
        """(S, 4, 4) poses as recorded."""
        return self.source.odom_T_sensor[self.scans]

    @property
    def world_T_sensor(self) -> Float64Array:
        """(S, 4, 4) the same poses in the world: the truth."""
        return np.asarray(self.world_T_odom @ self.odom_T_sensor)

    def revolutions(self, numbers: Int64Array | None = None) -> Iterator[RecordedRevolution]:
        """Yield its revolutions, or some of them by their numbers (N,), rising, in the part.

        Raises:
            InputError: A chunk is damaged, or a pose is none.
        """
        wanted = np.arange(len(self.scans)) if numbers is None else numbers
        index, chunk = -1, None
        for number in wanted.tolist():
            here, row = divmod(int(self.scans[number]), self.source.chunk_scans)
            if here != index or chunk is None:
                index, chunk = here, self.source.chunk(here)
            poses = chunk.column_poses[row]
            require_unit_poses(poses.astype(np.float64), lambda column: f"{self.source.path}: column {column}")
            told = chunk.range_mm[row], chunk.reflectivity[row], chunk.signal[row], chunk.column_stamps_ns[row], poses
            yield RecordedRevolution(number, *told)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRevolution:
    """One revolution as recorded; arrays as those of `ScanChunk` without the first axis."""

    number: int
    range_mm: npt.NDArray[np.uint32]
    reflectivity: npt.NDArray[np.uint8]
    signal: npt.NDArray[np.uint16]
    column_stamps_ns: Int64Array
    column_poses: Float32Array

    @property
    def sensor_T_column(self) -> Float64Array:
        """(W, 4, 4) pose of each column in the frame of the revolution."""
        poses = self.column_poses.astype(np.float64)
        return make_pose(Rotation.from_quat(poses[:, 3:]).as_matrix(), poses[:, :3])


def measured_points(part: Part, revolution: RecordedRevolution) -> tuple[Float64Array, npt.NDArray[np.bool_]]:
    """Return the places (H, W, 3) of the first returns, in the frame of their revolution, metres, and which exist."""
    height = part.source.sensor.height
    range_mm = revolution.range_mm[:height]
    columns = part.source.sensor.project(range_mm / 1000.0)
    poses = revolution.sensor_T_column
    points = np.einsum("wij,hwj->hwi", poses[:, :3, :3], columns) + poses[:, :3, 3]
    return np.asarray(points), range_mm > 0


def world_points(part: Part, revolution: RecordedRevolution) -> Float64Array:
    """Return the first returns (N, 3) of a revolution, world frame, metres."""
    points, is_return = measured_points(part, revolution)
    return transform(part.world_T_sensor[revolution.number], points[is_return])
