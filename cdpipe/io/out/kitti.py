"""Scans in the layout of SemanticKITTI: one folder of a data set's sequences.

velodyne/000000.bin   x, y, z, intensity as float32, deskewed, sensor frame, metres
labels/000000.label   uint32 of each point: the label in the low 16 bits, the instance in the high 16; with labels
poses.txt, calib.txt  KITTI's poses of a camera: `Tr` leads from the sensor to axes x right, y down, z forward
times.txt             seconds of the recording's clock
labels.yaml           names and colours of the labels; with labels
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from cdpipe.core.geometry import Float64Array, invert, make_pose
from cdpipe.core.progress import Progress
from cdpipe.io.out.poses import write_kitti_poses
from cdpipe.io.out.scans import Outgoing, OutScan

CAMERA_T_SENSOR = make_pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
LABEL = "label"
"""Name of the scalar that holds the uint32 label of each return."""


class Label(NamedTuple):
    """A class of returns: its number, its name, and its colour (blue, green, red), as that format has colours."""

    number: int
    name: str
    bgr: tuple[int, int, int]


def write_kitti(folder: Path, outgoing: Outgoing, labels: Sequence[Label], report: Progress) -> None:
    """Write a session or recording into an empty folder.

    Args:
        folder: The folder.
        outgoing: What to write; its scalar `label` becomes the labels.
        labels: The classes, named in labels.yaml; none for a session without labels.
        report: Called with the stage, the number of finished scans and their total.

    Raises:
        InputError: It is a map without its scans, or a scan cannot be read.
        OSError: A file cannot be written.
    """
    outgoing.require_scans()
    (folder / "velodyne").mkdir()
    if labels:
        (folder / "labels").mkdir()
        about = {
            "labels": {it.number: it.name for it in labels},
            "color_map": {it.number: list(it.bgr) for it in labels},
        }
        (folder / "labels.yaml").write_text(yaml.safe_dump(about, sort_keys=False), encoding="utf-8")
    _write_scans(folder, outgoing.scans(report), has_labels=bool(labels))
    world_T_camera = CAMERA_T_SENSOR @ outgoing.odom_T_sensor @ invert(CAMERA_T_SENSOR)
    write_kitti_poses(folder / "poses.txt", world_T_camera)
    rows = [*((f"P{number}", np.eye(4)) for number in range(4)), ("Tr", CAMERA_T_SENSOR)]
    (folder / "calib.txt").write_text("".join(f"{name}: {_numbers(pose)}\n" for name, pose in rows), encoding="utf-8")
    np.savetxt(folder / "times.txt", outgoing.stamps_ns() / 1e9, fmt="%.9f")


def _write_scans(folder: Path, scans: Iterable[OutScan], *, has_labels: bool) -> None:
    for scan in scans:
        intensity = scan.scalars.get("intensity", np.zeros(len(scan.points)))
        rows = np.column_stack([scan.points, intensity]).astype("<f4")
        (folder / "velodyne" / f"{scan.index:06d}.bin").write_bytes(rows.tobytes())
        if has_labels:
            content = scan.scalars[LABEL].astype("<u4").tobytes()
            (folder / "labels" / f"{scan.index:06d}.label").write_bytes(content)


def _numbers(pose: Float64Array) -> str:
    return " ".join(f"{number:g}" for number in pose[:3].ravel())
