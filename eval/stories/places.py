"""Displacement over the sessions of a story, at chosen places of the rock as session 1 saw it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.model.report import SurfaceField
from cdpipe.surface import middle_place
from eval.core.statistics import median
from eval.scoring.surface.places import ANSWERED_M, SurfacePlaces, find_surface_places
from eval.stories.comparisons import Comparison

RADIUS_M = 0.3
_SAME_M = 0.5
MOST_PLACES = 8
_NAN = float("nan")
_MEASURED = ("chainage_m", "angle_deg", "n_points", "displacement_m", "level_m", "is_beyond_level")
COLUMNS = (
    "place", "chosen_by", "x_m", "y_m", "z_m", "chainage_m", "angle_deg", "session", "n_points", "displacement_m",
    "level_m", "is_beyond_level", "true_m",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class ChosenPlace:
    """A place whose displacement is followed.

    Attributes:
        name: P1, P2 and so on.
        chosen_by: "region" for the largest displacement of a region, "given" for a place that the user named.
        point_map: (3,) in the odom frame of session 1, metres.
    """

    name: str
    chosen_by: str
    point_map: Float64Array


def choose_places(comparisons: Sequence[Comparison], given: Sequence[Float64Array]) -> list[ChosenPlace]:
    """Return the places that the user names, then up to 8 of the largest displacements, one for each region.

    Regions of the last session come first, then those of earlier sessions that are not the same rock: their largest
    displacement is more than 0.5 m from all points of the regions before.

    Args:
        comparisons: Session 1 against each later one.
        given: Places (3,) in the odom frame of session 1, metres.
    """
    peaks: list[Float64Array] = []
    taken = np.zeros((0, 3))
    for comparison in reversed(comparisons):
        surface = None if comparison.answer.report is None else comparison.answer.report.surface
        for peak, points in [] if surface is None else _list_peaks(surface):
            if len(peaks) < MOST_PLACES and not (np.linalg.norm(taken - peak, axis=1) <= _SAME_M).any():
                peaks.append(peak)
            taken = np.concatenate([taken, points])
    every = [("given", np.asarray(point, dtype=np.float64)) for point in given]
    every += [("region", peak) for peak in peaks]
    return [ChosenPlace(f"P{index}", how, point) for index, (how, point) in enumerate(every, start=1)]


def _list_peaks(surface: SurfaceField) -> list[tuple[Float64Array, Float64Array]]:
    """Return the point (3,) of the largest displacement and all points (N, 3) of each region, the largest first."""
    order = sorted(range(len(surface.regions)), key=lambda index: -abs(surface.regions[index].largest_m))
    peaks = []
    for index in order:
        rows = np.flatnonzero((surface.region == index) & np.isfinite(surface.displacement_m))
        if len(rows):
            points = surface.points_map[rows].astype(np.float64)
            peaks.append((points[np.argmax(np.abs(surface.displacement_m[rows]))], points))
    return peaks


def follow_places(comparisons: Sequence[Comparison], places: Sequence[ChosenPlace]) -> pd.DataFrame:
    """Return a row for each place and later session.

    The displacement is the median of the answer's points within 0.3 m of the place, the level the median of their
    95 % levels of detection, and the true displacement the median of the truth at the same points. What nobody measured
    is NaN.

    Raises:
        InputError: A place that the user names is nowhere near rock that session 1 saw.
    """
    rows = []
    for comparison in comparisons:
        report = comparison.answer.report
        surface = None if report is None else report.surface
        true = None if comparison.truth is None else find_surface_places(comparison.truth)
        for place in places:
            position = dict(zip(("x_m", "y_m", "z_m"), place.point_map.tolist(), strict=True))
            told = {"place": place.name, "chosen_by": place.chosen_by, **position, "session": comparison.number}
            rows.append({**told, **_measure(surface, place.point_map), "true_m": _true_m(true, surface, place)})
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    order = {place.name: index for index, place in enumerate(places)}
    table = table.iloc[np.lexsort((table["session"], table["place"].map(order)))]
    for name in order:
        own = table[table["place"] == name]
        is_seen = (own["n_points"] > 0) | own["true_m"].notna()
        if not is_seen.any() and any(each.answer.report is not None for each in comparisons):
            x, y, z = own[["x_m", "y_m", "z_m"]].iloc[0]
            raise InputError(
                f"--at {x:g},{y:g},{z:g}: no rock was measured within {RADIUS_M:g} m of it: give metres in the "
                "odometry frame of session 1, as in surface.ply"
            )
    return table.reset_index(drop=True)


def is_measured(comparisons: Sequence[Comparison]) -> bool:
    """Tell whether the rock of any session was measured."""
    return any(each.answer.report is not None and each.answer.report.surface is not None for each in comparisons)


def _measure(surface: SurfaceField | None, point: Float64Array) -> dict[str, float | None]:
    found: dict[str, float | None] = {**dict.fromkeys(_MEASURED, _NAN), "n_points": 0, "is_beyond_level": None}
    rows = _rows_near(surface, point)
    if surface is None or not len(rows):
        return found
    levels_m = surface.level_m[rows]
    moved_m, level_m = median(surface.displacement_m[rows]), median(levels_m[np.isfinite(levels_m)])
    found |= {"n_points": len(rows), "displacement_m": moved_m, "level_m": level_m}
    found["is_beyond_level"] = None if np.isnan(level_m) else abs(moved_m) > level_m
    if surface.chainage_m is not None and surface.angle_deg is not None:
        chainage_m, angle_deg = middle_place(
            surface.points_map[rows], surface.chainage_m[rows], surface.angle_deg[rows]
        )
        found |= {"chainage_m": chainage_m, "angle_deg": angle_deg}
    return found


def _rows_near(surface: SurfaceField | None, point: Float64Array) -> Int64Array:
    if surface is None:
        return np.zeros(0, np.int64)
    is_near = np.linalg.norm(surface.points_map - point, axis=1) <= RADIUS_M
    return np.flatnonzero(is_near & np.isfinite(surface.displacement_m))


def _true_m(places: SurfacePlaces | None, surface: SurfaceField | None, place: ChosenPlace) -> float:
    """Return the median of the truth at the measured points of a place; at the place itself where there are none."""
    if places is None or not len(places.true_m):
        return _NAN
    rows = _rows_near(surface, place.point_map)
    points = place.point_map[None] if surface is None or not len(rows) else surface.points_map[rows]
    apart_m, nearest = cKDTree(places.points_map).query(points)
    is_known = np.asarray(apart_m) <= ANSWERED_M
    return float(np.median(places.true_m[np.asarray(nearest)[is_known]])) if is_known.any() else _NAN
