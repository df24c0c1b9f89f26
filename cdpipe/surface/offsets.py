"""The offset of both sessions' surfaces at a place, along its normal, and how sure it is.

Both surfaces are averaged over a sphere of the same size, each about its own surface: of rough rock both spheres then
hold the same humps and hollows. A place at which the after surface lies far off is searched along the normal first.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.threads import allowed_threads
from cdpipe.surface.cells import N_FOLDS, SurfaceCells
from cdpipe.surface.places import SurfacePlaces

# Spheres that hold too few cells are widened: a roof is sampled more thinly than a wall.
_WIDENINGS = (1.0, 1.5, 2.0)
_NEAREST = 100
_LEAST_CELLS = 12
_LEAST_OF_FOLD = 3
_BLOCK = 1 << 14
# The after surface is searched along the normal in these steps, where none is at the place itself: into the void as far
# as rubble, shotcrete and fill rise, and away from it as far as a face advances.
_STEP_M, _INTO_VOID_M, _INTO_ROCK_M = 0.1, 1.5, 5.0
_NEAR_M = 0.12
# Displacements beyond this are distances to the nearest cell of the after surface: at the flank of a heap the normal of
# the floor is not that of the heap.
_FAR_M = 0.1
# A surface that far off is new only if the before session had none there: its distance to the nearest cell of the
# before session, over the displacement. Else it is another surface, and the place was hidden from the after session.
NEW = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Q displacements as measured, before what the alignment may have absorbed is taken off.

    Attributes:
        along_m: (Q,) offset of the after surface from the before surface, along the normal; NaN where either session
            has too few cells.
        nearest_m: (Q,) the same by the distance to the nearest cell of the after surface, where that is far.
        variance_m2: (Q,) variance of `along_m`, from the differences between folds; NaN if unknown.
        own_m: (Q,) mean height of the before surface around each place, along the normal; NaN as `along_m`.
    """

    along_m: Float64Array
    nearest_m: Float64Array
    variance_m2: Float64Array
    own_m: Float64Array


def measure_offsets(
    before: SurfaceCells,
    after: SurfaceCells,
    places: SurfacePlaces,
    radius_m: float,
    *,
    with_variance: bool = True,
) -> Offsets:
    """Measure the displacement at every place.

    Args:
        before: Cells of the before session, map frame.
        after: Cells of the after session, map frame.
        places: Where to measure.
        radius_m: Radius of the spheres, metres.
        with_variance: Whether `variance_m2` is asked for; otherwise it is NaN.
    """
    n = len(places.points)
    along_m, variance_m2, own_m = (np.full(n, np.nan) for _ in range(3))
    if n == 0 or len(after.points) == 0:
        return Offsets(along_m, along_m.copy(), variance_m2, own_m)
    start_m = _find_surface(after, places)
    for widening in _WIDENINGS:
        rest = np.flatnonzero(np.isfinite(start_m) & np.isnan(along_m))
        points, normals = places.points[rest], places.normals[rest]
        sphere = partial(_settle, points, normals, widening * radius_m, with_variance=with_variance)
        own_m[rest], own_m2 = sphere(before, np.zeros(len(rest)))
        heights_m, other_m2 = sphere(after, start_m[rest])
        along_m[rest], variance_m2[rest] = heights_m - own_m[rest], own_m2 + other_m2
    far = np.flatnonzero(np.abs(along_m) > _FAR_M)
    hits = places.points[far] + along_m[far, None] * places.normals[far]
    along_m[far[before.tree.query(hits)[0] < NEW * np.abs(along_m[far])]] = np.nan
    far = far[np.isfinite(along_m[far])]
    nearest_m = along_m.copy()
    nearest_m[far] = np.sign(along_m[far]) * np.minimum(after.tree.query(places.points[far])[0], np.abs(along_m[far]))
    return Offsets(along_m, nearest_m, variance_m2, own_m)


def _find_surface(after: SurfaceCells, places: SurfacePlaces) -> Float64Array:
    """Return the (Q,) height along the normal at which the after surface is near; NaN where it is nowhere."""
    start_m = np.where(after.tree.query(places.points)[0] <= _NEAR_M, 0.0, np.nan)
    rest = np.flatnonzero(np.isnan(start_m))
    for step in range(1, int(_INTO_ROCK_M / _STEP_M) + 1):
        for height_m in (step * _STEP_M, -step * _STEP_M):
            if height_m > _INTO_VOID_M or len(rest) == 0:
                continue
            probes = places.points[rest] + height_m * places.normals[rest]
            is_near = after.tree.query(probes, distance_upper_bound=_NEAR_M)[0] <= _NEAR_M
            start_m[rest[is_near]] = height_m
            rest = rest[~is_near]
    return start_m


def _settle(
    points: Float64Array,
    normals: Float64Array,
    radius_m: float,
    cells: SurfaceCells,
    start_m: Float64Array,
    *,
    with_variance: bool,
) -> tuple[Float64Array, Float64Array]:
    """Return the (N,) mean height along the normals in a sphere, and its variance.

    The first sphere stands `start_m` above each of the (N, 3) points, the second on the surface that the first found.
    Both sessions settle alike: at an edge the second sphere holds other cells than the first.
    """
    heights_m, variance_m2 = start_m, np.zeros(len(points))
    for is_last in (False, True):
        centres = points + np.nan_to_num(heights_m)[:, None] * normals
        shift_m, variance_m2 = _average(cells, centres, normals, radius_m, with_variance and is_last)
        heights_m = heights_m + shift_m
    return heights_m, variance_m2


def _average(
    cells: SurfaceCells, centres: Float64Array, normals: Float64Array, radius_m: float, with_variance: bool
) -> tuple[Float64Array, Float64Array]:
    """Return the (N,) mean height of the cells around each (N, 3) centre, NaN of too few, and its variance, or NaN."""
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(centres), _BLOCK)]
    with ThreadPoolExecutor(allowed_threads()) as pool:
        averaged = partial(_average_block, cells, radius_m, with_variance)
        parts = list(pool.map(averaged, (centres[rows] for rows in blocks), (normals[rows] for rows in blocks)))
    heights_m, variance_m2 = zip(*parts, strict=True) if parts else ((np.zeros(0),), (np.zeros(0),))
    return np.concatenate(heights_m), np.concatenate(variance_m2)


def _average_block(
    cells: SurfaceCells, radius_m: float, with_variance: bool, centres: Float64Array, normals: Float64Array
) -> tuple[Float64Array, Float64Array]:
    distance_m, index = cells.tree.query(centres, k=_NEAREST, distance_upper_bound=radius_m)
    is_found = np.isfinite(distance_m)
    index = np.where(is_found, index, 0)
    counts = is_found.sum(axis=1)
    offsets = cells.points.take(index, axis=0) - centres[:, None]
    heights_m = np.einsum("nki,ni->nk", offsets, normals) * is_found
    mean_m = heights_m.sum(axis=1) / np.maximum(counts, 1)
    variance_m2 = _vary(cells, index, is_found, normals) if with_variance else np.full(len(centres), np.nan)
    return np.where(counts >= _LEAST_CELLS, mean_m, np.nan), variance_m2


def _vary(cells: SurfaceCells, index: Int64Array, is_found: BoolArray, normals: Float64Array) -> Float64Array:
    """Return the (N,) variance of a mean height by the differences between folds; NaN with fewer than two folds."""
    means_m = np.full((len(index), N_FOLDS), np.nan)
    for fold in range(N_FOLDS):
        heights_m = np.einsum("nki,ni->nk", cells.fold_offsets[:, fold].take(index, axis=0), normals)
        is_known = is_found & np.isfinite(heights_m)
        counts = is_known.sum(axis=1)
        sums = np.where(is_known, heights_m, 0.0).sum(axis=1)
        means_m[:, fold] = np.where(counts >= _LEAST_OF_FOLD, sums / np.maximum(counts, 1), np.nan)
    n_folds = np.isfinite(means_m).sum(axis=1)
    centred = (
        means_m - np.divide(np.nansum(means_m, axis=1), n_folds, out=np.zeros(len(index)), where=n_folds > 0)[:, None]
    )
    of_one = np.nansum(centred**2, axis=1) / np.maximum(n_folds - 1, 1)
    return np.where(n_folds >= 2, of_one / np.maximum(n_folds, 1), np.nan)
