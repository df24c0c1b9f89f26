"""The offset of both sessions' surfaces at a place, along its normal, and how sure it is.

Both surfaces are averaged over a sphere of the same size, each about its own surface: of rough rock both spheres then
hold the same humps and hollows. A place at which the after surface lies far off is searched along the normal first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.threads import allowed_threads, in_threads
from cdpipe.surface.cells import N_FOLDS, SurfaceCells
from cdpipe.surface.places import SurfacePlaces

# Spheres that hold too few cells are widened: a roof is sampled more thinly than a wall.
_WIDENINGS = (1.0, 1.5, 2.0)
_NEAREST = 120
# Cells are looked for in a sphere larger by this factor: the second sphere of a place takes them from the same search.
_SLACK = 1.15
# Variances are averaged over neighbouring places, and spheres overlap: every fourth place has one.
_EVERY = 4
_LEAST_CELLS = 12
_LEAST_OF_FOLD = 3
_BLOCK = 1 << 14
# The after surface is searched along the normal in these steps, where none is at the place itself: into the void as far
# as rubble, shotcrete and fill rise, and away from it as far as a face advances.
_STEP_M, _INTO_VOID_M, _INTO_ROCK_M = 0.1, 1.5, 5.0
_NEAR = 0.6  # a cell is near within that share of the radius of the spheres
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
        variance_m2: (Q,) variance of `along_m`, from the differences between folds, of every fourth place; else NaN.
        own_m: (Q,) mean height of the before surface around each place, along the normal; NaN as `along_m`.
        sampling: (Q,) sum of the inverse numbers of cells that either mean is over; NaN as `along_m`.
    """

    along_m: Float64Array
    nearest_m: Float64Array
    variance_m2: Float64Array
    own_m: Float64Array
    sampling: Float64Array


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
    along_m, variance_m2, own_m, sampling = (np.full(n, np.nan) for _ in range(4))
    if n == 0 or len(after.points) == 0:
        return Offsets(along_m, along_m.copy(), variance_m2, own_m, sampling)
    start_m = _find_surface(after, places, _NEAR * radius_m)
    for widening in _WIDENINGS:
        rest = np.flatnonzero(np.isfinite(start_m) & np.isnan(along_m))
        points, normals = places.points[rest], places.normals[rest]
        sphere = partial(_settle, points, normals, widening * radius_m, with_variance=with_variance)
        own_m[rest], own_m2, n_own = sphere(before, np.zeros(len(rest)))
        heights_m, other_m2, n_other = sphere(after, start_m[rest])
        along_m[rest], variance_m2[rest] = heights_m - own_m[rest], own_m2 + other_m2
        sampling[rest] = 1.0 / n_own + 1.0 / n_other
    far = np.flatnonzero(np.abs(along_m) > _FAR_M)
    hits = places.points[far] + along_m[far, None] * places.normals[far]
    along_m[far[before.tree.query(hits)[0] < NEW * np.abs(along_m[far])]] = np.nan
    far = far[np.isfinite(along_m[far])]
    nearest_m = along_m.copy()
    nearest_m[far] = np.sign(along_m[far]) * np.minimum(after.tree.query(places.points[far])[0], np.abs(along_m[far]))
    return Offsets(along_m, nearest_m, variance_m2, own_m, sampling)


def _find_surface(after: SurfaceCells, places: SurfacePlaces, near_m: float) -> Float64Array:
    """Return the (Q,) height along the normal at which the after surface is near; NaN where it is nowhere."""
    start_m = np.where(_is_near(after, places.points, near_m), 0.0, np.nan)
    rest = np.flatnonzero(np.isnan(start_m))
    for step in range(1, int(_INTO_ROCK_M / _STEP_M) + 1):
        for height_m in (step * _STEP_M, -step * _STEP_M):
            if height_m > _INTO_VOID_M or len(rest) == 0:
                continue
            is_near = _is_near(after, places.points[rest] + height_m * places.normals[rest], near_m)
            start_m[rest[is_near]] = height_m
            rest = rest[~is_near]
    return start_m


def _is_near(cells: SurfaceCells, points: Float64Array, near_m: float) -> BoolArray:
    """Mark the (N, 3) points that have a cell nearby."""
    distance_m, _ = cells.tree.query(points, distance_upper_bound=near_m, workers=allowed_threads())
    return np.asarray(distance_m <= near_m)


def _settle(
    points: Float64Array,
    normals: Float64Array,
    radius_m: float,
    cells: SurfaceCells,
    start_m: Float64Array,
    *,
    with_variance: bool,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return (N,) mean height along the normals in a sphere, its variance, and number of cells; NaN of too few cells.

    The first sphere stands `start_m` above each of the (N, 3) points, the second on the surface that the first found.
    Both sessions settle alike: at an edge the second sphere holds other cells than the first.
    """
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(points), _BLOCK)]
    settle = partial(_settle_block, cells, radius_m, with_variance)
    parts = in_threads(lambda rows: settle(points[rows], normals[rows], start_m[rows]), blocks)
    none = np.zeros(0)
    heights_m, variance_m2, counts = (np.concatenate(each) for each in zip((none, none, none), *parts, strict=True))
    return heights_m, variance_m2, counts


def _settle_block(
    cells: SurfaceCells,
    radius_m: float,
    with_variance: bool,
    points: Float64Array,
    normals: Float64Array,
    start_m: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Settle some spheres. Both spheres of a place take their cells from one search, but where they lie far apart."""
    distance_m, index, heights_m = _look_around(cells, points, normals, start_m, _SLACK * radius_m)
    settled_m = _average(heights_m, distance_m <= radius_m)
    shift_m = settled_m - start_m
    squared_m2 = distance_m**2 - 2 * shift_m[:, None] * (heights_m - start_m[:, None]) + shift_m[:, None] ** 2
    far = np.flatnonzero(np.abs(shift_m) > (_SLACK - 1) * radius_m)
    distance_m, index[far], heights_m[far] = _look_around(cells, points[far], normals[far], settled_m[far], radius_m)
    squared_m2[far] = distance_m**2
    is_inside = squared_m2 <= radius_m**2
    variance_m2, some = np.full(len(points), np.nan), slice(None, None, _EVERY)
    if with_variance:
        variance_m2[some] = _vary(cells, index[some], is_inside[some], normals[some])
    settled_m = _average(heights_m, is_inside)
    return settled_m, variance_m2, np.where(np.isfinite(settled_m), is_inside.sum(axis=1), np.nan)


def _look_around(
    cells: SurfaceCells, points: Float64Array, normals: Float64Array, start_m: Float64Array, reach_m: float
) -> tuple[Float64Array, Int64Array, Float64Array]:
    """Return (N, K) distance, infinite without a cell, index, and height over the point, of the cells at each sphere.

    The spheres stand (N,) `start_m` above the (N, 3) points.
    """
    centres = points + start_m[:, None] * normals
    distance_m, index = cells.tree.query(centres, k=_NEAREST, distance_upper_bound=reach_m)
    index = np.where(np.isfinite(distance_m), index, 0)
    offsets = cells.points.take(index, axis=0) - points[:, None]
    return np.asarray(distance_m), index.astype(np.int64), np.einsum("nki,ni->nk", offsets, normals)


def _average(heights_m: Float64Array, is_inside: BoolArray) -> Float64Array:
    """Return the (N,) mean of the heights inside, NaN of too few."""
    counts = is_inside.sum(axis=1)
    sums_m = np.einsum("nk,nk->n", heights_m, is_inside)
    return np.where(counts >= _LEAST_CELLS, sums_m / np.maximum(counts, 1), np.nan)


def _vary(cells: SurfaceCells, index: Int64Array, is_found: BoolArray, normals: Float64Array) -> Float64Array:
    """Return the (N,) variance of a mean height by the differences between folds; NaN with fewer than two folds."""
    means_m = np.full((len(index), N_FOLDS), np.nan)
    for fold in range(N_FOLDS):
        heights_m = np.einsum("nki,ni->nk", cells.fold_offsets[index, fold], normals)
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
