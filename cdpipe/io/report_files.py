"""A report as files for people: the answer itself, tables, and points with their scalars for CloudCompare."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.io.answer import write_answer
from cdpipe.io.ply import write_ply_points
from cdpipe.model.report import ChangeReport, SurfaceField


def save_report(report: ChangeReport, folder: Path | str, method: str = "tunnelcd") -> None:
    """Write answer.json and answer.npz, regions.csv, objects.csv and objects.ply.

    A report that says how far the rock moved also becomes surface.csv (`ChangeReport.to_pandas`) and surface.ply, the
    places with their normals, displacement, level of detection and region.

    Args:
        report: What `detect` returned.
        folder: Where; it may exist, and its files of these names are replaced.
        method: What the answer calls its method.

    Raises:
        InputError: The folder cannot be written.
    """
    folder = Path(folder)
    points = [np.zeros((0, 3)), *(item.points_map for item in report.objects)]
    owners = [np.zeros(0, np.int32), *(np.full(len(item.points_map), k) for k, item in enumerate(report.objects))]
    try:
        write_answer(folder, method, report)
        report.to_pandas("regions").to_csv(folder / "regions.csv", index=False)
        report.to_pandas("objects").to_csv(folder / "objects.csv", index=False)
        write_ply_points(folder / "objects.ply", np.concatenate(points), {"object": np.concatenate(owners)})
        if report.surface is not None:
            report.to_pandas("surface").to_csv(folder / "surface.csv", index=False)
            _write_surface(folder / "surface.ply", report.surface)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: cannot be written: {error.strerror}") from error


def _write_surface(path: Path, surface: SurfaceField) -> None:
    scalars: dict[str, npt.NDArray[Any]] = dict(zip(("nx", "ny", "nz"), surface.normals_map.T, strict=True))
    scalars |= {"displacement": surface.displacement_m, "level": surface.level_m, "region": surface.region}
    write_ply_points(path, surface.points_map, scalars)
