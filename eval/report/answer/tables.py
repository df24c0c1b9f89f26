"""The objects, regions and places of rock of an answer as short tables, for people: eighty columns hold each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cdpipe.core.geometry import Float64Array
from cdpipe.model.report import ChangedObject, ChangeReport, SurfaceField
from cdpipe.model.sentence import moved_m
from cdpipe.surface import middle_place

if TYPE_CHECKING:
    import pandas as pd


def tabulate_objects(report: ChangeReport) -> pd.DataFrame:
    """Return one row per object: what happened to it, where it is, its size and volume, and how far it moved.

    A moved object has two rows, which name each other: `2.30 to 4` is its place before, `2.30 from 3` the one after.
    """
    import pandas as pd  # noqa: PLC0415 - importing the command line must stay fast

    rows = [_object_row(index, item, report.objects) for index, item in enumerate(report.objects)]
    columns = ["object", "kind", "x y z [m]", "size [m]", "volume [m3]", "moved [m]"]
    return pd.DataFrame(rows, columns=columns)


def tabulate_regions(report: ChangeReport) -> pd.DataFrame:
    """Return one row per region that passed the threshold, best first: where it is, and how many objects it holds."""
    import pandas as pd  # noqa: PLC0415 - importing the command line must stay fast

    regions = report.regions
    rows = []
    for index in np.flatnonzero(regions.is_proposed).tolist():
        n_objects = sum(item.region == index for item in report.objects)
        place, state = _place(regions.centres_map[index]), "reported" if regions.is_reported[index] else "withdrawn"
        rows.append((index, float(regions.scores[index]), place, float(regions.radii_m[index]), n_objects, state))
    return pd.DataFrame(rows, columns=["region", "score", "x y z [m]", "radius [m]", "objects", "state"])


def tabulate_rock(surface: SurfaceField) -> pd.DataFrame:
    """Return one row per region of rock that moved: its place on the unrolled surface, its size and displacement."""
    import pandas as pd  # noqa: PLC0415 - importing the command line must stay fast

    columns = ["region", "chainage_m", "angle_deg", "area_m2", "mean_mm", "largest_mm", "volume_m3"]
    rows = []
    for number, item in enumerate(surface.regions):
        own = surface.region == number
        places = np.nan, np.nan
        if own.any() and surface.chainage_m is not None and surface.angle_deg is not None:
            places = middle_place(surface.points_map[own], surface.chainage_m[own], surface.angle_deg[own])
        sizes = item.area_m2, 1000 * item.mean_m, 1000 * item.largest_m, item.volume_m3
        rows.append((number, *places, *sizes))
    return pd.DataFrame(rows, columns=columns)


def object_place(item: ChangedObject) -> Float64Array:
    """Return the mean (3,) of the points of an object, map frame, metres; NaN without points."""
    return item.points_map.mean(axis=0) if len(item.points_map) else np.full(3, np.nan)


def _object_row(index: int, item: ChangedObject, objects: tuple[ChangedObject, ...]) -> tuple[object, ...]:
    size, volume_m3 = "-", None
    if item.shape is not None:
        size, volume_m3 = _size(item.shape.box_m), item.shape.volume_m3
    elif len(item.points_map):
        size = _size(np.ptp(item.points_map, axis=0))
    moved = "-"
    if item.kind == "moved":
        way_m = moved_m(item, objects)
        way = "" if np.isnan(way_m) else f"{way_m:.2f}"
        towards = "" if item.partner < 0 else f"{'to' if item.session == 'before' else 'from'} {item.partner}"
        moved = " ".join(part for part in (way, towards) if part) or "-"
    return index, item.kind, _place(object_place(item)), size, volume_m3, moved


def _size(edges_m: Float64Array) -> str:
    return "x".join(f"{edge:.2f}" for edge in edges_m)


def _place(position: Float64Array) -> str:
    return "-" if np.isnan(position).any() else " ".join(f"{each:z.1f}" for each in position)
