"""PCD files, by the package pypcd4 (extra `formats`): points with an intensity, and where the sensor was."""

# ruff: noqa: PLC0415 - pypcd4 is an extra, and everybody else must be able to import this

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array, require_shape
from cdpipe.core.plugins import require_extra


def write_pcd(
    path: Path,
    points: Float64Array,
    intensity: npt.NDArray[np.number | np.bool_],
    frame_T_sensor: Float64Array | None = None,
) -> None:
    """Write points with an intensity as a binary PCD 0.7 of four float32 fields.

    Args:
        path: New file.
        points: (N, 3) points in any frame, metres.
        intensity: (N,) intensity of each.
        frame_T_sensor: (4, 4) pose of the sensor in the frame of the points, which becomes VIEWPOINT (x, y, z and the
            quaternion w, x, y, z); by default the identity.

    Raises:
        InputError: The extra `formats` is not installed.
        OSError: The file cannot be written.
    """
    require_shape("points", points, (len(intensity), 3))
    require_extra("formats", "a PCD file")
    from pypcd4.pypcd4 import PointCloud

    cloud = PointCloud.from_xyzi_points(np.column_stack([points, intensity]).astype(np.float32))
    if frame_T_sensor is not None:
        x, y, z, w = Rotation.from_matrix(frame_T_sensor[:3, :3]).as_quat().tolist()
        cloud.metadata.viewpoint = (*frame_T_sensor[:3, 3].tolist(), w, x, y, z)
    cloud.save(path)
