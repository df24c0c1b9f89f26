"""The surface rule: what stands out of the other session's surface, where that session looked, is a changed object.

Two steps, because a map point is the mean of a cell of 0.2 m and an object's foot is not:

1. In every reported sphere map points off the planes through the other map's points are candidates (`find_candidates`);
   those next to each other are a site.
2. Around each site all returns of both sessions are compared, in cells of 0.05 and 0.1 m (`compare_site`). Objects grow
   from cells that stand well clear of the surface and were seen through, down to what the surfaces differ by anyway
   (`grow_objects`).

Whatever the other session never looked at is unknown, and no change by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array
from cdpipe.core.voxel import cell_means
from cdpipe.extract.point_comparison import label_groups
from cdpipe.merge.registration import Surface
from cdpipe.model.config import ExtractConfig

# Map points this far off are candidates: less than the lowest objects stand out, more than a cell's mean is off.
_COARSE_M = 0.08
_MIN_CANDIDATES = 3  # `_are_three_together` is made for this number
# Candidates nearer than this are one site, and everything this near to them is looked at closely.
SITE_M = 0.5
# Beyond the site the other session's surface is needed too.
RIM_M = 0.3
CELL_M = 0.05
SURFACE_CELL_M = 0.1
_LINK_M = 0.15
_TABLE_CELL_M = 0.25
# A plane holds for as far as the points that it was fitted to.
_COARSE_PLANE_M, _PLANE_M = 0.4, 0.25
# Nor is what lies this flat beyond its edge off the surface: there the other map has a gap.
_GRAZING = 0.2
_MIN_SURFACE = 20
_NOISE_FACTOR = 5.0
_SEED_FACTOR = 2.5
_MAX_BORDER = 5.0
# An object's foot, which no ray can have passed, reaches this far from what was seen through.
_FOOT_M = 0.3
# Scans with a ray that passed a cell of 0.1 m on its last metre.
_MIN_SCANS_PAST = 3
# A quarter of a square metre in cells of 0.05 m: a lesser rise of the floor is the floor's.
_MIN_LOW_CELLS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """Cells around candidates of one session, and what the other session's surface is to them.

    Attributes:
        points: (N, 3) means of the returns of each occupied cell, map frame, metres.
        cell_of_return: (M,) cell of each return.
        distance_m: (N,) how far each stands off the other session's surface; infinite where there is none.
    """

    points: Float64Array
    cell_of_return: Int64Array
    distance_m: Float64Array


def distances_m(points: Float64Array, surface: Surface, plane_m: float) -> Float64Array:
    """Return how far (N, 3) points are from a surface.

    That is the distance from the plane through the nearest of the surface's points, as long as that point is within
    `plane_m` or the plane is nearly met; otherwise it is the distance from the point itself.
    """
    chosen, nearest_m = find_nearest(points, surface)
    offsets = points - surface.points.take(chosen, axis=0)
    along = np.einsum("ij,ij->i", offsets, surface.normals.take(chosen, axis=0))
    off_plane_m = np.abs(along)
    is_on_plane = (nearest_m < plane_m) | (off_plane_m < _GRAZING * nearest_m)
    return np.asarray(np.where(is_on_plane, off_plane_m, nearest_m))


def find_nearest(points: Float64Array, surface: Surface) -> tuple[Int64Array, Float64Array]:
    """Return the surface's point nearest to each of (N, 3) points, and how far it is."""
    # of one neighbour it returns arrays, where the search for the nearest returns lists that take as long again
    found, squared_m2 = surface.tree.batch_knn_search(points, 1)
    return found[:, 0].astype(np.int64), np.sqrt(squared_m2[:, 0])


class PlaneTable:
    """One plane of a surface for each cell of a grid over it: most points lie on it, which takes one lookup to see."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self._low = surface.points.min(axis=0)
        cells = self._cells(surface.points)
        self._shape = cells.max(axis=1) + 1
        self._table = np.full(int(self._shape.prod()), -1, dtype=np.int32)
        self._table[self._flat(cells)] = np.arange(len(surface.points), dtype=np.int32)

    def distances_m(self, points: Float64Array) -> Float64Array:
        """Return how far (N, 3) points are from the plane of their cell; infinite where it has none."""
        cells = self._cells(points)
        is_inside = ((cells >= 0) & (cells < self._shape[:, None])).all(axis=0)
        found = np.full(len(points), -1, dtype=np.int32)
        found[is_inside] = self._table.take(self._flat(cells[:, is_inside]))
        offsets = points - self.surface.points.take(found, axis=0)
        along = np.abs(np.einsum("ij,ij->i", offsets, self.surface.normals.take(found, axis=0)))
        return np.asarray(np.where(found >= 0, along, np.inf))

    def _cells(self, points: Float64Array) -> Int64Array:
        return np.stack([(points[:, axis] - self._low[axis]) // _TABLE_CELL_M for axis in range(3)]).astype(np.int64)

    def _flat(self, cells: Int64Array) -> Int64Array:
        return np.asarray((cells[0] * self._shape[1] + cells[1]) * self._shape[2] + cells[2])


def find_candidates(points: Float64Array, table: PlaneTable) -> tuple[Int64Array, float]:
    """Return the indices of the map points (N, 3) that stand off the other map's surface, three or more together.

    A point on the plane of its cell does not; of the others the distance from the nearest plane decides.

    Returns:
        The indices, and the median distance of all points: how well the two surfaces agree.
    """
    distance_m = table.distances_m(points)
    doubtful = np.flatnonzero(distance_m > _COARSE_M)
    distance_m[doubtful] = distances_m(points.take(doubtful, axis=0), table.surface, _COARSE_PLANE_M)
    standing = np.flatnonzero(distance_m > _COARSE_M)
    return standing[_are_three_together(points[standing])], float(np.median(distance_m))


def _are_three_together(points: Float64Array) -> BoolArray:
    """Mark the (N, 3) points in groups of three or more, as `label_groups` has them, without making the groups.

    Such a point has two neighbours, or one that has another.
    """
    is_together = np.zeros(len(points), dtype=np.bool_)
    if len(points) < _MIN_CANDIDATES:
        return is_together
    one, other = cKDTree(points).query_pairs(SITE_M, output_type="ndarray").T
    has_two = np.bincount(one, minlength=len(points)) + np.bincount(other, minlength=len(points)) >= 2
    is_strong = has_two[one] | has_two[other]
    is_together[one[is_strong]] = True
    is_together[other[is_strong]] = True
    return is_together


def compare_site(points: Float64Array, reference: Float64Array) -> Site:
    """Compare the (M, 3) returns around a site with the (R, 3) returns of the other session there, map frame."""
    means, cell_of_return = cell_means(points, CELL_M)
    if len(reference) == 0:
        return Site(means, cell_of_return, np.full(len(means), np.inf))
    surface_points, _ = cell_means(reference, SURFACE_CELL_M)
    if len(surface_points) < _MIN_SURFACE:
        return Site(means, cell_of_return, np.asarray(cKDTree(surface_points).query(means)[0]))
    return Site(means, cell_of_return, distances_m(means, Surface(surface_points), _PLANE_M))


def grow_objects(site: Site, free_space_votes: Int64Array, noise_m: float, config: ExtractConfig) -> list[Int64Array]:
    """Return the cells of each object of a site.

    What stands off the surface by more than the noise, and was seen through, belongs together where it touches; such a
    group is an object if enough of it stands well clear, and if `min_views` keyframes in the mean saw through it: where
    only one or two did, from afar, the edge of what they could see is no change. Its foot, at floor and wall, is too
    near to the surface for any ray to have passed behind it; it is the object's as far as it also stands off.

    Args:
        site: Its cells.
        free_space_votes: (N,) keyframes of the other session that saw through each cell, less those that hit it.
        noise_m: Median distance of the two maps' surfaces around here.
        config: Thresholds.
    """
    stands_off, is_free = site.distance_m > border_threshold_m(noise_m, config), free_space_votes > 0
    core, foot = np.flatnonzero(stands_off & is_free), np.flatnonzero(stands_off & ~is_free)
    labels, sizes = label_groups(site.points[core], _LINK_M)
    n_views = np.bincount(labels, free_space_votes[core], len(sizes))
    is_seen = n_views >= config.min_views * sizes
    kept = np.flatnonzero(is_seen & (_count_clear(site, core, labels, noise_m, config) >= config.min_cells))
    return _attach_feet(site, core, labels, kept, foot)


def unassigned_cells(site: Site, taken: list[Int64Array], noise_m: float, config: ExtractConfig) -> Int64Array:
    """Return the cells that stand off the surface and are in no object that was taken; none if few are clear of it."""
    is_left = site.distance_m > border_threshold_m(noise_m, config)
    is_left[np.concatenate([*taken, np.zeros(0, dtype=np.int64)])] = False
    left = np.flatnonzero(is_left)
    is_enough = np.count_nonzero(site.distance_m[left] > seed_threshold_m(noise_m, config)) >= _MIN_LOW_CELLS
    return left if is_enough else left[:0]


def grow_low_objects(
    site: Site, left: Int64Array, n_past: Int64Array, taken: list[Int64Array], noise_m: float, config: ExtractConfig
) -> list[Int64Array]:
    """Return the cells of each low object: no view of a keyframe can tell of it, but rays passed just above its foot.

    They pass a surface that is a little off as well. Of that some is clear; of a low object most is.

    Args:
        site: Its cells.
        left: (L,) cells that may be such an object's (`unassigned_cells`).
        n_past: (L,) scans of the other session with a ray that passed each of them.
        taken: Cells of the objects there are; what touches one is what is left of it.
        noise_m: As above.
        config: Thresholds.
    """
    is_passed = n_past >= _MIN_SCANS_PAST
    core, foot = left[is_passed], left[~is_passed]
    labels, sizes = label_groups(site.points[core], _LINK_M)
    n_clear = _count_clear(site, core, labels, noise_m, config)
    is_whole = (n_clear >= _MIN_LOW_CELLS) & (2 * n_clear >= sizes)
    if any(len(each) for each in taken):
        near = cKDTree(site.points[np.concatenate(taken)]).query(site.points[core], distance_upper_bound=_FOOT_M)[0]
        is_whole &= np.bincount(labels, np.isfinite(near), len(sizes)) == 0
    return _attach_feet(site, core, labels, np.flatnonzero(is_whole), foot)


def border_threshold_m(noise_m: float, config: ExtractConfig) -> float:
    """Return how far a cell must stand off to be an object's, where surfaces differ by a noise."""
    return float(np.clip(_NOISE_FACTOR * noise_m, config.border_m, _MAX_BORDER * config.border_m))


def seed_threshold_m(noise_m: float, config: ExtractConfig) -> float:
    """Return how far enough cells of an object must stand off."""
    return max(config.seed_m, _SEED_FACTOR * border_threshold_m(noise_m, config))


def _count_clear(site: Site, core: Int64Array, labels: Int64Array, noise_m: float, config: ExtractConfig) -> Int64Array:
    is_clear = site.distance_m[core] > seed_threshold_m(noise_m, config)
    return np.bincount(labels[is_clear], minlength=int(labels.max(initial=-1)) + 1)


def _attach_feet(
    site: Site, core: Int64Array, labels: Int64Array, kept: Int64Array, foot: Int64Array
) -> list[Int64Array]:
    """Return the cells of some groups of the core, each with those of the foot that are nearest to it."""
    if len(kept) == 0:
        return []
    is_kept = np.isin(labels, kept)
    core, labels = core[is_kept], labels[is_kept]
    _, nearest = cKDTree(site.points[core]).query(site.points[foot], distance_upper_bound=_FOOT_M)
    of_foot = np.append(labels, -1)[nearest]
    return [np.concatenate([core[labels == label], foot[of_foot == label]]) for label in kept]
