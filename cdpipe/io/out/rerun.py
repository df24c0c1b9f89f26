"""Scans and the path as a recording for the viewer Rerun, by the package rerun-sdk (extra `rerun`)."""

# ruff: noqa: PLC0415 - rerun is an extra, and everybody else must be able to import this

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.plugins import require_extra
from cdpipe.core.progress import Progress
from cdpipe.io.out.scans import Outgoing, OutScan

_CLOCK = "clock"
_POINT_M = 0.02
_CHANGED_RGB = (230, 60, 40)


def write_rrd(path: Path, outgoing: Outgoing, report: Progress) -> None:
    """Write a session or recording as .rrd: `odom/lidar` moves along `odom/path` and carries `odom/lidar/points`.

    Points are grey by intensity; those with a `change` above 0, which the caller adds, are red.

    Raises:
        InputError: The extra `rerun` is not installed, it is a map without its scans, or a scan cannot be read.
        OSError: The file cannot be written.
    """
    require_extra("rerun", str(path))
    import rerun as rr

    outgoing.require_scans()
    try:
        with rr.RecordingStream("tunnelcd", recording_id=path.stem.strip(".")) as stream:
            stream.save(str(path))
            stream.log("odom", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            stream.log("odom/path", rr.LineStrips3D([outgoing.odom_T_sensor[:, :3, 3]]), static=True)
            for scan in outgoing.scans(report):
                stream.set_time(_CLOCK, duration=scan.stamp_ns / 1e9)
                pose = scan.odom_T_sensor
                stream.log("odom/lidar", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
                points: Any = rr.Points3D(scan.points.astype(np.float32), colors=_colours(scan), radii=_POINT_M)
                stream.log("odom/lidar/points", points)
    except RuntimeError as error:  # as of a full disk
        raise OSError(errno.EIO, str(error)) from error


def _colours(scan: OutScan) -> npt.NDArray[np.uint8]:
    intensity = scan.scalars.get("intensity", np.full(len(scan.points), 1.0))
    most = max(float(np.nanpercentile(intensity, 98)), 1e-6) if len(intensity) else 1.0
    grey = 60 + 180 * np.clip(np.nan_to_num(intensity) / most, 0.0, 1.0)
    colours = np.repeat(grey[:, None], 3, axis=1).astype(np.uint8)
    if "change" in scan.scalars:
        colours[scan.scalars["change"] > 0] = _CHANGED_RGB
    return colours
