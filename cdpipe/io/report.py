"""A report on disk: the raw answer, and beside it the tables and the point cloud that people open."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.io.answer import write_answer
from cdpipe.model.report import ChangeReport


def save_report(report: ChangeReport, folder: Path | str, method: str = "tunnelcd") -> None:
    """Write answer.json and answer.npz, regions.csv, objects.csv and objects.ply.

    Args:
        report: What `detect` returned.
        folder: Where; it may exist, and its files of these names are replaced.
        method: What the answer calls its method.

    Raises:
        InputError: The folder cannot be written.
    """
    folder = Path(folder)
    try:
        write_answer(folder, method, report)
        report.to_pandas("regions").to_csv(folder / "regions.csv", index=False)
        report.to_pandas("objects").to_csv(folder / "objects.csv", index=False)
        _write_ply(folder / "objects.ply", report)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: cannot be written: {error.strerror}") from error


def _write_ply(path: Path, report: ChangeReport) -> None:
    """Write the points of all objects, map frame, each with the index of its object."""
    vertex = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("object", "<i4")])
    parts = []
    for index, item in enumerate(report.objects):
        part = np.empty(len(item.points_map), dtype=vertex)
        part["x"], part["y"], part["z"] = item.points_map.T
        part["object"] = index
        parts.append(part)
    vertices = np.concatenate(parts) if parts else np.empty(0, dtype=vertex)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty int object\nend_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes())
