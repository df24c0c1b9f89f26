"""Poses for evo and other tools: TUM lines with stamps, KITTI lines of 12 numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.io.tum import write_tum


def write_tum_poses(path: Path, stamps_ns: Int64Array, poses: Float64Array) -> None:
    """Write sensor poses (S, 4, 4) at (S,) times as TUM lines, stamps in seconds."""
    write_tum(path, stamps_ns / 1e9, poses)


def write_kitti_poses(path: Path, poses: Float64Array) -> None:
    """Write poses (S, 4, 4) as KITTI lines, `r11 r12 r13 tx r21 ... tz`."""
    np.savetxt(path, poses[:, :3].reshape(-1, 12), fmt="%.12g")
