"""Places of the before surface at which every displacement field is judged, and what an answer says there.

The harness chooses the places from the truth. An answer that names other points, or fewer, is judged at the same ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.geometry.voxel import cell_keys
from cdpipe.model.report import SurfaceField
from eval.truth.ground_truth import GroundTruth, SurfaceLabels

PLACE_M = 0.25
ANSWERED_M = 0.3
SEEN_M = 0.5
MIN_SEEN = 5
CHANGED_M = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePlaces:
    """P places on the rock as the before session saw it.

    Attributes:
        points_map: (P, 3) a scoring point each, map frame (the before session's odom frame), metres.
        true_m: (P,) true displacement, positive into the void; 0 on a pair without surface changes.
        change: (P,) int64 id of the surface change that the place belongs to, 0 for none.
        is_judged: (P,) whether the after session saw the place too.
    """

    points_map: Float64Array
    true_m: Float64Array
    change: Int64Array
    is_judged: BoolArray

    @property
    def is_changed(self) -> BoolArray:
        """(P,) places that moved by more than 1 mm."""
        return np.abs(self.true_m) > CHANGED_M


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceAnswer:
    """What an answer says at P places.

    Attributes:
        answered_m: (P,) displacement, 0 where the answer has none.
        level_m: (P,) level of detection, NaN where the answer states none.
        region: (P,) int64 region of the answer, -1 for none.
        is_covered: (P,) places with a displacement.
    """

    answered_m: Float64Array
    level_m: Float64Array
    region: Int64Array
    is_covered: BoolArray


@lru_cache(maxsize=1)
def find_surface_places(truth: GroundTruth) -> SurfacePlaces:
    """Return the places of a pair; the last pair's are kept, because many answers to one pair are scored in a row.

    A place is a cell of 0.25 m of the before session's odom frame that holds scoring points on rock. Its displacement
    is their median. It stands at the one nearest to their mean, of equal ones the first. It is judged if at least 5
    scoring points of the after session on rock lie within 0.5 m and the size of its displacement, in the world.
    """
    before, after = truth.before, truth.after
    points = before.scoring_points
    labels = before.surface or _unmoved(len(points))
    rows = np.flatnonzero((points.instance == 0) & (points.change == 0) & np.isfinite(labels.displacement_m))
    points_map = points.points_odom[rows].astype(np.float64)
    _, cell = np.unique(cell_keys(points_map, PLACE_M), return_inverse=True)
    chosen, median_m = _one_per_cell(points_map, labels.displacement_m[rows].astype(np.float64), cell)
    rows = rows[chosen]

    seen = after.scoring_points
    seen_rows = np.flatnonzero((seen.instance == 0) & (seen.change == 0))
    seen_world = after.to_world(seen.points_odom[seen_rows].astype(np.float64), seen.scans(seen_rows))
    places_world = before.to_world(points_map[chosen], points.scans(rows))
    if len(seen_world) and len(rows):
        near = cKDTree(seen_world).query_ball_point(places_world, SEEN_M + np.abs(median_m), return_length=True)
        is_judged = np.asarray(near) >= MIN_SEEN
    else:
        is_judged = np.zeros(len(rows), dtype=np.bool_)
    return SurfacePlaces(points_map[chosen], median_m, labels.change[rows].astype(np.int64), is_judged)


def _unmoved(n: int) -> SurfaceLabels:
    return SurfaceLabels(np.zeros(n, dtype=np.float32), np.zeros(n, dtype=np.int16))


def _one_per_cell(points: Float64Array, values: Float64Array, cell: Int64Array) -> tuple[Int64Array, Float64Array]:
    """Return, for each of C cells, the row nearest to the mean of its points and the median of its values."""
    counts = np.bincount(cell)
    means = np.column_stack([np.bincount(cell, points[:, axis]) for axis in range(3)]) / counts[:, None]
    away = np.linalg.norm(points - means[cell], axis=1)
    starts = np.cumsum(counts) - counts
    chosen = np.lexsort((np.arange(len(cell)), away, cell))[starts]
    rising = values[np.lexsort((values, cell))]
    median = (rising[starts + (counts - 1) // 2] + rising[starts + counts // 2]) / 2
    return chosen, median


def carry_surface(surface: SurfaceField | None, places: SurfacePlaces) -> SurfaceAnswer:
    """Return what an answer says at each place: the nearest of its points that has a displacement, within 0.3 m.

    Points that lie at one place count once. Without such a point a place is not covered: displacement 0, no region.
    """
    n = len(places.true_m)
    empty = SurfaceAnswer(np.zeros(n), np.full(n, np.nan), np.full(n, -1), np.zeros(n, dtype=np.bool_))
    if surface is None or n == 0:
        return empty
    rows = np.flatnonzero(~np.isnan(surface.displacement_m))
    if len(rows) == 0:
        return empty
    order = (surface.level_m[rows], surface.region[rows], surface.displacement_m[rows], *surface.points_map[rows].T)
    rows = rows[np.lexsort(order)]  # the order in which an answer lists its points decides nothing
    points = surface.points_map[rows]
    rows = rows[np.append(True, (points[1:] != points[:-1]).any(axis=1))]
    distance_m, nearest = cKDTree(surface.points_map[rows]).query(places.points_map)
    is_covered = np.asarray(distance_m) <= ANSWERED_M
    row = rows[nearest]
    return SurfaceAnswer(
        answered_m=np.where(is_covered, surface.displacement_m[row], 0.0),
        level_m=np.where(is_covered, surface.level_m[row], np.nan),
        region=np.where(is_covered, surface.region[row], -1).astype(np.int64),
        is_covered=is_covered,
    )


def mark_true_regions(surface: SurfaceField, places: SurfacePlaces) -> BoolArray:
    """Mark the answered regions of which some point lies within 0.3 m of a place that changed, judged or not."""
    is_true = np.zeros(len(surface.regions), dtype=np.bool_)
    changed = places.points_map[places.is_changed]
    of_region = np.flatnonzero(surface.region >= 0)
    if len(changed) and len(of_region):
        distance_m, _ = cKDTree(changed).query(surface.points_map[of_region])
        is_true[surface.region[of_region[np.asarray(distance_m) <= ANSWERED_M]]] = True
    return is_true
