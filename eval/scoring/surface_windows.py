"""Windows for detection limits: discs of the before surface that the harness chooses, and the mean displacement there.

A window of a change lies on one surface change, wholly where the change is large enough. A null window holds no place
that moved. `eval.tables.surface_limits` turns the windows of a run into detection limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from eval.scoring.surface_places import PLACE_M, SurfaceAnswer, SurfacePlaces

AREAS_M2 = (1.0, 4.0, 16.0)
SPACING_M = 2.0
MAX_NULL_WINDOWS = 100  # for each area: a drift of 80 m has room for a few hundred
MIN_FILLED = 0.5  # share of the cells of a flat disc that must be judged places


def list_windows(said: SurfaceAnswer, places: SurfacePlaces) -> list[dict[str, Any]]:
    """Return a row of surface_windows.csv for each window; which ones there are does not depend on the answer.

    Columns: `area_m2`; `is_null`; `surface_change`, 0 in a null window; `x_m`, `y_m`, `z_m`, its centre in the map
    frame; `n_places`; `true_m` and `answered_m`, means over its places, 0 where the answer has none; `cover`.
    """
    judged = np.flatnonzero(places.is_judged)
    points = places.points_map[judged]
    rows: list[dict[str, Any]] = []
    for area_m2, change, centre, inside in _windows(points, places.change[judged], places.is_changed[judged]):
        own = judged[inside]
        rows.append(
            {
                "window": len(rows),
                "area_m2": area_m2,
                "is_null": change == 0,
                "surface_change": change,
                **dict(zip(("x_m", "y_m", "z_m"), map(float, points[centre]), strict=True)),
                "n_places": len(own),
                "true_m": float(places.true_m[own].mean()),
                "answered_m": float(said.answered_m[own].mean()),
                "cover": float(said.is_covered[own].mean()),
            }
        )
    return rows


def _windows(
    points: Float64Array, change: Int64Array, is_changed: BoolArray
) -> Iterator[tuple[float, int, int, Int64Array]]:
    """Yield area, surface change, centre and places of each window, by change and area; indices are of judged places.

    Centres in a change come deepest inside first and stand 2 m apart. A window that is not wholly on its change is
    taken only where no other is.
    """
    if len(points) == 0:
        return
    tree = cKDTree(points)
    for number in [*np.unique(change[is_changed & (change > 0)]).tolist(), 0]:
        is_its = is_changed & (change == number) if number else ~is_changed
        for area_m2 in AREAS_M2:
            radius_m = float(np.sqrt(area_m2 / np.pi))
            least = MIN_FILLED * area_m2 / PLACE_M**2
            apart_m = SPACING_M if number else max(SPACING_M, 2 * radius_m)
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
                if len(inside) < least or not (is_whole or (number and not taken)):
                    continue
                taken.append(centre)
                yield area_m2, int(number), centre, inside
                if number == 0 and len(taken) == MAX_NULL_WINDOWS:
                    break
