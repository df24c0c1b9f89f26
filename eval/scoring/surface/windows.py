"""Windows for detection limits: discs of the before surface that the harness chooses, and the mean displacement there.

A window of a change lies on one surface change, wholly where the change is large enough. A null window holds no place
that moved. `eval.tables.surface.limits` turns the windows of a run into detection limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from eval.scoring.surface.places import PLACE_M, SurfaceAnswer, SurfacePlaces

AREAS_M2 = (1.0, 4.0, 16.0)
SPACING_M = 2.0
MAX_NULL_WINDOWS = 100  # for each area: a drift of 80 m has room for a few hundred
MAX_CHECK_WINDOWS = 50  # likewise, of those that are left over
MIN_FILLED = 0.5  # share of the cells of a flat disc that must be judged places
Window = tuple[float, int, int, Int64Array]
"""Area, surface change (0 for none), centre and places of a window; indices are of judged places."""


def list_windows(said: SurfaceAnswer, places: SurfacePlaces) -> list[dict[str, Any]]:
    """Return a row of surface_windows.csv for each window; which ones there are does not depend on the answer.

    Columns: `area_m2`; `is_null`; `is_check`, a null window that sets no threshold and counts in the share of false
    alarms alone; `surface_change`, 0 in a null window; `x_m`, `y_m`, `z_m`, its centre in the map frame; `n_places`;
    `true_m` and `answered_m`, means over its places, 0 where the answer has none; `cover`.
    """
    judged = np.flatnonzero(places.is_judged)
    windows, checks = _of_last_places(places)
    rows: list[dict[str, Any]] = []
    for area_m2, change, centre, inside in (*windows, *checks):
        own = judged[inside]
        rows.append(
            {
                "window": len(rows),
                "area_m2": area_m2,
                "is_null": change == 0,
                "is_check": len(rows) >= len(windows),
                "surface_change": change,
                **dict(zip(("x_m", "y_m", "z_m"), map(float, places.points_map[judged[centre]]), strict=True)),
                "n_places": len(own),
                "true_m": float(places.true_m[own].mean()),
                "answered_m": float(said.answered_m[own].mean()),
                "cover": float(said.is_covered[own].mean()),
            }
        )
    return rows


def find_windows(places: SurfacePlaces) -> tuple[tuple[Window, ...], tuple[Window, ...]]:
    """Return the windows of a pair, those that detection limits are computed from and those that check them."""
    points, is_changed = places.points_map[places.is_judged], places.is_changed[places.is_judged]
    windows = tuple(_windows(points, places.change[places.is_judged], is_changed))
    null = {area: [centre for its, change, centre, _ in windows if (its, change) == (area, 0)] for area in AREAS_M2}
    return windows, tuple(_check_windows(points, is_changed, null))


_of_last_places = lru_cache(maxsize=1)(find_windows)  # many answers to one pair are scored in a row


def _null_lengths(area_m2: float) -> tuple[float, float]:
    """Return the radius of a disc, and the least distance of the centres of null windows of its area."""
    radius_m = float(np.sqrt(area_m2 / np.pi))
    return radius_m, max(SPACING_M, 2 * radius_m)


def _least_places(area_m2: float) -> float:
    return MIN_FILLED * area_m2 / PLACE_M**2


def _windows(points: Float64Array, change: Int64Array, is_changed: BoolArray) -> Iterator[Window]:
    """Yield area, surface change, centre and places of each window, by change and area; indices are of judged places.

    Centres in a change come deepest inside first and stand 2 m apart. A window that is not wholly on its change is
    taken only where no other is.
    """
    tree = cKDTree(points)
    for number in [*np.unique(change[is_changed & (change > 0)]).tolist(), 0]:
        is_its = is_changed & (change == number) if number else ~is_changed
        for area_m2 in AREAS_M2:
            radius_m, apart_m = _null_lengths(area_m2)
            apart_m = SPACING_M if number else apart_m
            candidates = np.flatnonzero(is_its)
            others = points[~is_its]
            if number and len(others):
                depth_m, _ = cKDTree(others).query(points[candidates])
                candidates = candidates[np.argsort(-depth_m, kind="stable")]
            taken: list[int] = []
            for centre in candidates.tolist():
                if taken and np.linalg.norm(points[taken] - points[centre], axis=1).min() < apart_m:
                    continue
                inside = np.sort(np.asarray(tree.query_ball_point(points[centre], radius_m), dtype=np.int64))
                is_whole = bool(is_its[inside].all())
                if len(inside) < _least_places(area_m2) or not (is_whole or (number and not taken)):
                    continue
                taken.append(centre)
                yield area_m2, int(number), centre, inside
                if number == 0 and len(taken) == MAX_NULL_WINDOWS:
                    break


def _check_windows(
    points: Float64Array, is_changed: BoolArray, taken: Mapping[float, Sequence[int]]
) -> Iterator[Window]:
    """Yield null windows beside those that are taken, as `_windows` does, all over the surface.

    The windows that set a threshold lie at one end of a long drift. The order of these follows from how many places
    did not move, which nobody knows without the truth, so that no answer can be silent in them alone.
    """
    unmoved, tree = np.flatnonzero(~is_changed), cKDTree(points)
    for area_m2 in AREAS_M2:
        radius_m, apart_m = _null_lengths(area_m2)
        is_free = ~is_changed
        for centre in taken[area_m2]:
            is_free[tree.query_ball_point(points[centre], np.nextafter(apart_m, 0.0))] = False
        n_left = MAX_CHECK_WINDOWS
        for centre in stream(len(unmoved), "check windows").permutation(unmoved).tolist():
            if not is_free[centre]:
                continue
            inside = np.sort(np.asarray(tree.query_ball_point(points[centre], radius_m), dtype=np.int64))
            if len(inside) < _least_places(area_m2) or is_changed[inside].any():
                continue
            yield area_m2, 0, centre, inside
            is_free[tree.query_ball_point(points[centre], np.nextafter(apart_m, 0.0))] = False
            n_left -= 1
            if n_left == 0:
                break
