"""A report as files for people: the answer itself, tables, and points with their scalars for CloudCompare."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cdpipe.core.errors import InputError
from cdpipe.core.whole_file import whole_file
from cdpipe.io.answer import write_answer
from cdpipe.io.ply import write_ply_points
from cdpipe.model.report import ChangeReport, SurfaceField

# The marker, and what not every answer has: of an older one it would tell what is not in the new one. The last two are
# written by `tunnelcd detect`.
_OF_AN_ANSWER = ("answer.json", "surface.csv", "surface.columns.txt", "surface.ply", "surface.png", "answer.html")
# What stands beside surface.csv, for those who have the folder alone.
_ROWS = (
    "One row of surface.csv is one metre of the before path and one sector of 45 degrees in which rock was measured."
)
SURFACE_COLUMNS = {
    "chainage_from_m, chainage_to_m": "stretch of the before path, metres from its start",
    "sector": "part of the section, looking along the path; on the way back from a turn on the spot still as before it",
    "n_places": "places with a displacement",
    "mean_displacement_m": "their mean, metres, positive into the void",
    "largest_displacement_m": "the displacement of the largest magnitude, metres, with its sign",
    "median_level_m": "median of their 95 % levels of detection, metres; empty where none is known",
    "share_beyond_level": "share of them beyond their own level, 0 to 1; 0.05 where nothing moved",
    "n_places_in_regions": "places in regions that moved",
}


def save_report(report: ChangeReport, folder: Path | str, method: str = "tunnelcd") -> None:
    """Write answer.json and answer.npz, regions.csv, objects.csv and objects.ply.

    A report that says how far the rock moved also becomes surface.csv (`ChangeReport.to_pandas`), surface.columns.txt,
    which explains its columns, and surface.ply, the places with their normals, displacement, level and region.
    answer.json, which marks an answer complete, goes first and is written last. What an older answer has beside these
    goes, too.

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
        folder.mkdir(parents=True, exist_ok=True)
        for name in _OF_AN_ANSWER:
            (folder / name).unlink(missing_ok=True)
        _write_table(report, "regions", folder)
        _write_table(report, "objects", folder)
        with whole_file(folder / "objects.ply") as partial:
            write_ply_points(partial, np.concatenate(points), {"object": np.concatenate(owners)})
        if report.surface is not None:
            _write_table(report, "surface", folder)
            with whole_file(folder / "surface.columns.txt") as partial:
                told = [f"{name}: {meaning}" for name, meaning in SURFACE_COLUMNS.items()]
                partial.write_text("\n".join([_ROWS, "", *told, ""]), encoding="utf-8")
            with whole_file(folder / "surface.ply") as partial:
                _write_surface(partial, report.surface)
        write_answer(folder, method, report)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: cannot be written: {error.strerror}") from error


def _write_table(report: ChangeReport, name: Literal["objects", "regions", "surface"], folder: Path) -> None:
    with whole_file(folder / f"{name}.csv") as partial:
        report.to_pandas(name).to_csv(partial, index=False)


def _write_surface(path: Path, surface: SurfaceField) -> None:
    scalars: dict[str, npt.NDArray[Any]] = dict(zip(("nx", "ny", "nz"), surface.normals_map.T, strict=True))
    scalars |= {"displacement": surface.displacement_m, "level": surface.level_m, "region": surface.region}
    write_ply_points(path, surface.points_map, scalars)
